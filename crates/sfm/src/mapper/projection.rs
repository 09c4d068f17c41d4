use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::{DESCRIPTOR_LEN, DESCRIPTOR_NORM, ImageFeatures, NearbyKeypoints, squared_distance};

use super::{
    model::{Model, ModelPoint},
    register::is_in_view,
};
use crate::{ImageId, Observation, PointId, Reconstruction};

/// Points that three images see from which on an image has enough: what is found like this is seen from far apart, and placed
/// worse than what the ratio test finds (0.50 px of residual on a dense street in place of 0.41).
const ENOUGH_POINTS: usize = 150;
/// Largest distance of descriptors of one point, as a share of their length: 97 % of right ratio-tested matches between
/// panoramas 10 m apart have 0.40 or less.
const MAX_DESCRIPTOR_DISTANCE: f64 = 0.5;
/// Largest angle at the point between the new view and one that is known.
const MAX_VIEW_ANGLE_RAD: f64 = 1.0;
/// Largest ratio of the distances of both to the point.
const MAX_DISTANCE_RATIO: f64 = 3.0;

/// Whether points are worth seeking in any image.
pub(super) fn has_images_with_few_points(component: &Reconstruction) -> bool {
    let tracks = component.points.iter().map(|point| &*point.track);
    let counts = points_of_three(component.images.len(), tracks);
    component.registered().any(|image| counts[image.index()] < ENOUGH_POINTS)
}

/// How many of these tracks that three images see each image sees.
fn points_of_three<'t>(images: usize, tracks: impl Iterator<Item = &'t [Observation]>) -> Vec<usize> {
    let mut counts = vec![0; images];
    for seen in tracks.filter(|track| track.len() > 2).flatten() {
        counts[seen.image.index()] += 1;
    }
    counts
}

/// Gives points to keypoints of images with few that lie where they ought to be seen and look alike; returns how many.
///
/// A ratio test over whole images refuses most of what a third image, far from the two that a point is from, shows of it.
/// Once the poses are known, a point leaves a few pixels to search. Where images stand far apart, this adds half as many
/// again to the points that three of them see, which alone tell how long one step is against the next.
pub(super) fn search_by_projection(model: &mut Model<'_>, max_error_sigma: f64) -> usize {
    let images: Vec<ImageId> = model.registered().collect();
    let is_described = |image: &ImageId| {
        let features = model.input.images[image.index()].features;
        features.descriptors.len() == features.len() * DESCRIPTOR_LEN
    };
    // The mapper itself needs places only.
    if !images.iter().all(is_described) {
        return 0;
    }
    let counts = points_of_three(model.poses.len(), model.live_points().map(|(_, point)| &*point.track));
    let few: Vec<ImageId> =
        images.into_iter().filter(|image| counts[image.index()] < ENOUGH_POINTS).collect();
    let found: Vec<Vec<(u32, PointId)>> = {
        let model = &*model;
        few.par_iter().with_max_len(1).map(|&image| seen_again(model, image, max_error_sigma)).collect()
    };
    let mut added = 0;
    for (&image, found) in few.iter().zip(&found) {
        for &(feature, id) in found {
            model.add_observation(id, Observation { image, feature });
            added += 1;
        }
    }
    added
}

/// Free keypoints of an image with the points that they show, both at most once.
fn seen_again(model: &Model<'_>, image: ImageId, max_error_sigma: f64) -> Vec<(u32, PointId)> {
    let Some(pose) = &model.poses[image.index()] else { return Vec::new() };
    let (features, rays) = (model.input.images[image.index()].features, &model.rays[image.index()]);
    let is_free = |feature: u32| {
        (feature as usize) < features.own_len() && model.point_of(Observation { image, feature }).is_none()
    };
    let free = NearbyKeypoints::new(rays, is_free);
    let widest = free.keypoints().iter().map(|&feature| rays.sigmas[feature as usize]).fold(0.0, f64::max);
    let radius = max_error_sigma * widest;
    let mut wanted: Vec<PointId> = (model.registered_neighbours(image).into_iter())
        .flat_map(|other| model.observations_of(other))
        .map(|(_, id)| id)
        .collect();
    wanted.sort_unstable();
    wanted.dedup();
    let largest = (MAX_DESCRIPTOR_DISTANCE * f64::from(DESCRIPTOR_NORM)).powi(2) as u32;
    // Least distance first, so that each keypoint goes to the point that it looks most like.
    let mut alike: Vec<(u32, u32, PointId)> = Vec::new();
    for id in wanted {
        let Some(point) = model.point(id) else { continue };
        let is_seen = point.track.iter().any(|seen| seen.image == image);
        if is_seen || !is_in_view(model, image, &pose.world_from_camera, &point.position) {
            continue;
        }
        let known = views_alike(model, point, pose.center());
        if known.is_empty() {
            continue;
        }
        let direction = pose.world_from_camera.inverse_transform_point(&point.position);
        let distance = |feature: u32| {
            let descriptor = features.descriptor(feature as usize);
            known.iter().map(|(of, at)| squared_distance(descriptor, of.descriptor(*at))).min()
        };
        let candidates = free.within(&direction, radius).into_iter().filter(|&feature| {
            let error = model.error_sigma(Observation { image, feature }, &point.position);
            error.is_some_and(|error| error <= max_error_sigma)
        });
        let best = candidates.filter_map(|feature| Some((distance(feature)?, feature))).min();
        alike
            .extend(best.filter(|best| best.0 <= largest).map(|(distance, feature)| (distance, feature, id)));
    }
    alike.sort_unstable();
    let mut is_taken = vec![false; features.len()];
    alike.retain(|&(_, feature, _)| !std::mem::replace(&mut is_taken[feature as usize], true));
    alike.into_iter().map(|(_, feature, id)| (feature, id)).collect()
}

/// The keypoints that a point is known from, of those that saw it not too differently.
fn views_alike<'m>(
    model: &Model<'m>,
    point: &ModelPoint,
    center: &Vector3<f64>,
) -> Vec<(&'m ImageFeatures, usize)> {
    let to_new = center - point.position;
    let is_alike = |seen: &&Observation| {
        model.poses[seen.image.index()].as_ref().is_some_and(|pose| {
            let to_known = pose.center() - point.position;
            let ratio = to_known.norm() / to_new.norm();
            ratio < MAX_DISTANCE_RATIO
                && ratio * MAX_DISTANCE_RATIO > 1.0
                && to_known.angle(&to_new) < MAX_VIEW_ANGLE_RAD
        })
    };
    let known = point.track.iter().filter(is_alike);
    known.map(|seen| (model.input.images[seen.image.index()].features, seen.feature as usize)).collect()
}

#[cfg(test)]
mod tests {
    use super::super::{
        MapperParams,
        test_street::{POINTS, Street, first_two},
    };
    use super::*;

    #[test]
    fn points_are_found_where_they_ought_to_be_seen_and_look_alike() {
        let mut street = Street::new("projection", 12, 12);
        // In the third image every tenth keypoint looks different, and every tenth is elsewhere.
        let third = street.features_mut(2);
        for at in (3..POINTS).step_by(10) {
            third.descriptors[at * DESCRIPTOR_LEN..(at + 1) * DESCRIPTOR_LEN].reverse();
            third.keypoints[at + 1].x = (third.keypoints[at + 1].x + 300.0) % 2048.0;
        }
        let input = street.input();
        let mut model = first_two(&street, &input);
        model.set_pose(ImageId(2), Some(street.poses[2]));
        let limit = MapperParams::default().max_error_sigma;
        let found = search_by_projection(&mut model, limit);
        assert!(found > POINTS / 2, "{found} of {POINTS}");
        for (feature, id) in model.observations_of(ImageId(2)) {
            assert!(!matches!(feature % 10, 3 | 4), "{feature}");
            let point = model.point(id).expect("is alive");
            assert!(point.track.iter().all(|seen| seen.feature == feature));
        }
        assert_eq!(search_by_projection(&mut model, limit), 0);
    }
}
