//! Guided matching: scene points are projected with a known pose and searched for nearby.

use std::collections::BTreeMap;

use setloc_features::{NearbyKeypoints, squared_distance};
use setloc_index::{NearestPoints, SceneIndex};
use setloc_sfm::{PointId, Rigid};

use crate::evidence::PhotoRays;
use crate::{GuidedParams, SceneMatch};

/// Matches between scene points and the photo's features near their projections, sorted by feature.
///
/// `nearest[i]` are the scene points nearest to feature `i`: a feature is accepted for a point only when the point
/// is (nearly) as close as the closest point of the whole scene, so that a wrong pose finds hardly anything.
pub(crate) fn guided_matches(
    params: &GuidedParams,
    index: &SceneIndex,
    photo: &PhotoRays<'_>,
    nearest: &[NearestPoints],
    world_from_camera: &Rigid,
) -> Vec<SceneMatch> {
    let keypoints = NearbyKeypoints::new(&photo.rays, |_| true);
    let slack2 = params.slack * params.slack;
    let ratio2 = params.ratio * params.ratio;
    // Per feature the best point: (squared distance, point).
    let mut chosen: BTreeMap<u32, (u32, PointId)> = BTreeMap::new();
    for point in (0..index.point_count() as u32).map(PointId) {
        let offset = index.position(point) - world_from_camera.translation;
        let distance = offset.norm();
        let direction_in_camera = world_from_camera.rotation.inverse_transform_vector(&offset);
        let Some(pixel) =
            photo.camera.project(&direction_in_camera).filter(|pixel| photo.camera.contains(pixel))
        else {
            continue;
        };
        let Some(angle) = photo.camera.pixel_angle(&pixel).filter(|angle| *angle > 0.0) else { continue };
        let views: Vec<u32> = index
            .rows_of(point)
            .iter()
            .copied()
            .filter(|&row| {
                let row = index.row(row);
                index.center(row.image).is_some_and(|center| {
                    let view = index.position(point) - center;
                    view.angle(&offset) < params.max_view_angle_rad
                })
            })
            .collect();
        if views.is_empty() {
            continue;
        }
        let (mut best, mut second) = (None::<(u32, u32)>, u32::MAX);
        for feature in keypoints.within(&direction_in_camera, params.radius_px * angle) {
            let size = f64::from(photo.features.keypoints[feature as usize].size);
            let descriptor = photo.features.descriptor(feature as usize);
            let distance2 = views
                .iter()
                .filter(|&&row| {
                    let expected = f64::from(index.row(row).extent) / distance / angle;
                    let factor = size / expected;
                    !(expected > 0.0)
                        || (factor < params.max_scale_factor && factor * params.max_scale_factor > 1.0)
                })
                .map(|&row| squared_distance(descriptor, index.descriptor(row)))
                .min();
            let Some(distance2) = distance2 else { continue };
            match best {
                Some((_, least)) if distance2 >= least => second = second.min(distance2),
                _ => {
                    second = best.map_or(second, |(_, least)| second.min(least));
                    best = Some((feature, distance2));
                }
            }
        }
        let Some((feature, distance2)) = best else { continue };
        let global = nearest[feature as usize].first.map_or(u32::MAX, |first| first.distance2);
        let distinct = second == u32::MAX || f64::from(distance2) < ratio2 * f64::from(second);
        if distinct && f64::from(distance2) <= slack2 * f64::from(global) {
            let entry = chosen.entry(feature).or_insert((distance2, point));
            if distance2 < entry.0 {
                *entry = (distance2, point);
            }
        }
    }
    chosen.into_iter().map(|(feature, (_, point))| SceneMatch { feature, point }).collect()
}
