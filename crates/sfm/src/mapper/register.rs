use nalgebra::Vector3;
use setloc_features::{GuidedParams, match_guided_among};

use super::{correspondence::CorrespondenceGraph, model::Model};
use crate::{
    BaselineLength, ImageId, Observation, PointId, Rigid, TwoViewKind, direction,
    robust::{RansacParams, estimate_absolute_pose, refine_absolute_pose},
    solvers::{essential::essential_from_pose, triangulation::length_along},
    visibility::{is_in_image, is_same_view},
};

/// A pose for an unregistered image, with the evidence for and against it.
#[derive(Debug, Clone)]
pub(super) struct PoseHypothesis {
    pub world_from_camera: Rigid,
    /// Keypoints and points that agree.
    pub inliers: Vec<(u32, PointId)>,
    /// 2D-to-3D matches it was chosen from.
    pub candidates: usize,
    pub visibility: Visibility,
    /// The length of the baseline that holds it, where points do not tell it.
    pub length: Option<BaselineLength>,
}

impl PoseHypothesis {
    /// A pose with those of the 2D-to-3D matches that agree with it.
    pub fn at(
        model: &Model<'_>,
        graph: &CorrespondenceGraph,
        image: ImageId,
        world_from_camera: Rigid,
        max_error_sigma: f64,
    ) -> Self {
        let matches = scene_matches(model, graph, image);
        let rays = &model.rays[image.index()];
        let agrees = |&(feature, id): &(u32, PointId)| {
            let Some(point) = model.point(id) else { return false };
            let direction = world_from_camera.inverse_transform_point(&point.position).normalize();
            let error = (direction - rays.bearings[feature as usize]).norm();
            let sigma = rays.sigmas[feature as usize];
            sigma.is_finite() && error <= max_error_sigma * sigma
        };
        let inliers: Vec<(u32, PointId)> = matches.iter().copied().filter(agrees).collect();
        let visibility = visibility(model, image, &world_from_camera, &inliers);
        Self { world_from_camera, inliers, candidates: matches.len(), visibility, length: None }
    }
}

/// How much of what the image ought to see from here was matched.
///
/// Two places that share a façade module pass every inlier test: the module's matches are geometrically perfect. What
/// gives the wrong place away is everything around the module, which ought to be seen from there and is not (the
/// *missing correspondences* of C. Zach, A. Irschara, H. Bischof, "What can missing correspondences tell us about 3D
/// structure and motion?", CVPR 2008).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Visibility {
    /// Points that a registered camera with nearly the same view of them sees.
    pub expected: usize,
    /// Those of them that are inliers.
    pub matched: usize,
    /// Directions in which enough such points lie.
    pub expected_cells: usize,
    /// Directions among them in which at least one was matched.
    pub matched_cells: usize,
}

impl Visibility {
    pub fn recall(&self) -> f64 {
        self.matched as f64 / self.expected.max(1) as f64
    }

    /// Share of the directions with points in plain view in which any was matched.
    pub fn coverage(&self) -> f64 {
        self.matched_cells as f64 / self.expected_cells.max(1) as f64
    }
}

impl std::iter::Sum for Visibility {
    /// What several images see in common.
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            expected: sum.expected + one.expected,
            matched: sum.matched + one.matched,
            expected_cells: sum.expected_cells + one.expected_cells,
            matched_cells: sum.matched_cells + one.matched_cells,
        })
    }
}

/// Number of 2D-to-3D matches that [`scene_matches`] would find.
pub(super) fn count_scene_matches(model: &Model<'_>, graph: &CorrespondenceGraph, image: ImageId) -> usize {
    // Most images wait far from the model.
    let partners = graph.partners_of(image);
    if !partners.iter().any(|partner| model.is_registered(partner.image)) {
        return 0;
    }
    scene_matches(model, graph, image).len()
}

/// 2D-to-3D matches of an unregistered image through its verified pairs.
pub(super) fn scene_matches(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    image: ImageId,
) -> Vec<(u32, PointId)> {
    let mut matches = Vec::new();
    for feature in 0..model.input.images[image.index()].features.len() as u32 {
        let start = matches.len();
        for &partner in graph.partners(image, feature) {
            if let Some(id) = model.point_of(partner)
                && !matches[start..].contains(&(feature, id))
            {
                matches.push((feature, id));
            }
        }
    }
    matches
}

/// Up to `max_hypotheses` poses, best first: each is sought among the matches that the ones before leave over.
pub(super) fn hypothesize(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    image: ImageId,
    params: &RansacParams,
    max_hypotheses: usize,
    seed: u64,
) -> Vec<PoseHypothesis> {
    let mut matches = scene_matches(model, graph, image);
    let rays = &model.rays[image.index()];
    matches.retain(|(feature, _)| rays.sigmas[*feature as usize].is_finite());
    let candidates = matches.len();
    let mut hypotheses = Vec::new();
    for round in 0..max_hypotheses {
        let bearings: Vec<Vector3<f64>> =
            matches.iter().map(|(feature, _)| rays.bearings[*feature as usize]).collect();
        let sigmas: Vec<f64> = matches.iter().map(|(feature, _)| rays.sigmas[*feature as usize]).collect();
        let points: Vec<Vector3<f64>> =
            matches.iter().filter_map(|(_, id)| model.point(*id).map(|point| point.position)).collect();
        if points.len() != bearings.len() {
            break;
        }
        let Some(estimate) =
            estimate_absolute_pose(params, &bearings, &sigmas, &points, seed.wrapping_add(round as u64))
        else {
            break;
        };
        let inliers: Vec<(u32, PointId)> =
            estimate.inliers.iter().map(|&index| matches[index as usize]).collect();
        let visibility = visibility(model, image, &estimate.world_from_camera, &inliers);
        let mut is_inlier = vec![false; matches.len()];
        for &index in &estimate.inliers {
            is_inlier[index as usize] = true;
        }
        let mut keep = is_inlier.iter().map(|inlier| !inlier);
        matches.retain(|_| keep.next().unwrap_or(false));
        hypotheses.push(PoseHypothesis {
            world_from_camera: estimate.world_from_camera,
            inliers,
            candidates,
            visibility,
            length: None,
        });
    }
    hypotheses
}

/// Points from which a pose is determined better than by the pair: fewer, and mostly in one corner, only give the
/// length of the baseline.
const FREE_POSE_POINTS: usize = 15;

/// Poses that single verified pairs suggest, best supported first: rotation and direction are the pair's, the length of
/// the baseline is the median over the 2D-to-3D matches.
///
/// After a turn, the points in common lie in one corner and have been seen along the road only, so that their depths
/// are poor; resection then fits a wrong pose to them, while the essential matrix does not use depths at all.
pub(super) fn hypothesize_from_pairs(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    image: ImageId,
    params: &RansacParams,
) -> Vec<PoseHypothesis> {
    let matches = scene_matches(model, graph, image);
    let rays = &model.rays[image.index()];
    let (mut bearings, mut sigmas, mut points, mut ids) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for &(feature, id) in &matches {
        if let Some(point) = model.point(id)
            && rays.sigmas[feature as usize].is_finite()
        {
            bearings.push(rays.bearings[feature as usize]);
            sigmas.push(rays.sigmas[feature as usize]);
            points.push(point.position);
            ids.push((feature, id));
        }
    }
    let agreeing = |pose: &Rigid, bound: f64| -> Vec<u32> {
        let agrees = |&index: &usize| {
            let direction = pose.inverse_transform_point(&points[index]).normalize();
            (direction - bearings[index]).norm() <= bound * sigmas[index]
        };
        (0..points.len()).filter(agrees).map(|index| index as u32).collect()
    };
    let mut hypotheses = Vec::new();
    for pair in model.pairs_of(image) {
        let Some((other, image_from_other)) = pair.seen_from(image) else { continue };
        let Some(pose) = &model.poses[other.index()] else { continue };
        if pair.two_view.kind == TwoViewKind::PureRotation {
            continue;
        }
        let world_from_image = pose.world_from_camera * image_from_other.inverse();
        let step = world_from_image.translation - pose.center();
        // The centre lies at other + s·step; each point asks for the s that puts it on its ray.
        let mut lengths: Vec<f64> = (0..points.len())
            .filter_map(|index| {
                let ray = world_from_image.rotation * bearings[index];
                length_along(&step, &(points[index] - pose.center()), &ray)
            })
            .collect();
        if lengths.len() < params.min_inliers {
            continue;
        }
        let middle = lengths.len() / 2;
        let length = *lengths.select_nth_unstable_by(middle, f64::total_cmp).1;
        let mut found = Rigid::new(world_from_image.rotation, pose.center() + step * length);
        for widening in [6.0, 3.0, 1.0] {
            let near = agreeing(&found, widening * params.max_error_sigma);
            if near.len() >= FREE_POSE_POINTS {
                found = refine_absolute_pose(params, &bearings, &sigmas, &points, &near, &found);
            }
        }
        let inliers: Vec<(u32, PointId)> =
            agreeing(&found, params.max_error_sigma).into_iter().map(|index| ids[index as usize]).collect();
        if inliers.len() >= params.min_inliers {
            let visibility = visibility(model, image, &found, &inliers);
            hypotheses.push(PoseHypothesis {
                world_from_camera: found,
                inliers,
                candidates: matches.len(),
                visibility,
                length: None,
            });
        }
    }
    hypotheses.sort_by_key(|hypothesis| std::cmp::Reverse(hypothesis.inliers.len()));
    hypotheses
}

/// Fewest points that must agree on the length of a baseline.
const MIN_BASELINE_POINTS: usize = 8;
/// How many times more points must agree on it than on any other length.
const BASELINE_LEAD: f64 = 2.5;
/// Lengths by less than this factor apart are one.
const SAME_LENGTH: f64 = 1.25;

/// The pose of `image` from its verified geometry with the registered image `other`, the length of the baseline from
/// matches along the pair's epipolar circles; `None` unless one length stands out.
pub(super) fn hypothesize_baseline(
    model: &Model<'_>,
    image: ImageId,
    other: ImageId,
    image_from_other: &Rigid,
    params: &RansacParams,
) -> Option<PoseHypothesis> {
    let pose = model.poses[other.index()].as_ref()?;
    let world_from_image = pose.world_from_camera * image_from_other.inverse();
    let step = world_from_image.translation - pose.center();
    let features = |image: ImageId| (model.input.images[image.index()].features, &model.rays[image.index()]);
    let (of_other, of_image) = (model.carriers(other), vec![false; features(image).0.len()]);
    let guided = match_guided_among(
        &GuidedParams::default(),
        features(other),
        features(image),
        &essential_from_pose(image_from_other),
        [&of_other, &of_image],
    );
    let rays = &model.rays[image.index()];
    let mut candidates: Vec<(u32, PointId, Vector3<f64>)> = Vec::new();
    let mut lengths: Vec<f64> = Vec::new();
    for m in &guided {
        let Some(id) = model.point_of(Observation { image: other, feature: m.first }) else { continue };
        let Some(point) = model.point(id) else { continue };
        let ray = world_from_image.rotation * rays.bearings[m.second as usize];
        if let Some(length) = length_along(&step, &(point.position - pose.center()), &ray)
            && rays.sigmas[m.second as usize].is_finite()
        {
            candidates.push((m.second, id, point.position));
            lengths.push(length);
        }
    }
    let agreeing = |length: f64| -> Vec<usize> {
        let center = pose.center() + step * length;
        let agrees = |&at: &usize| {
            let (feature, _, position) = &candidates[at];
            let direction = world_from_image.rotation.inverse_transform_vector(&(position - center));
            let error = (direction.normalize() - rays.bearings[*feature as usize]).norm();
            error <= params.max_error_sigma * rays.sigmas[*feature as usize]
        };
        (0..candidates.len()).filter(agrees).collect()
    };
    let mut counts: Vec<(usize, f64)> =
        lengths.iter().map(|&length| (agreeing(length).len(), length)).collect();
    counts.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.total_cmp(&b.1)));
    let &(most, length) = counts.first()?;
    let runner_up = counts
        .iter()
        .find(|(_, other)| (other / length).max(length / other) > SAME_LENGTH)
        .map_or(0, |&(count, _)| count);
    if most < MIN_BASELINE_POINTS || (most as f64) < BASELINE_LEAD * runner_up as f64 {
        return None;
    }
    let found = Rigid::new(world_from_image.rotation, pose.center() + step * length);
    let inliers: Vec<(u32, PointId)> =
        agreeing(length).into_iter().map(|at| (candidates[at].0, candidates[at].1)).collect();
    let visibility = visibility(model, image, &found, &inliers);
    let candidates = candidates.len();
    Some(PoseHypothesis { world_from_camera: found, inliers, candidates, visibility, length: None })
}

/// Points in plain view that make a direction worth judging.
const CELL_POINTS: usize = 5;

/// Counts the points that a camera at this pose ought to see, and those among `inliers`.
///
/// Only images that were matched with this one make a point expected. Down a street of 200 panoramas those far off
/// see the same far points alike, but nobody compared them.
pub(super) fn visibility(
    model: &Model<'_>,
    image: ImageId,
    world_from_camera: &Rigid,
    inliers: &[(u32, PointId)],
) -> Visibility {
    visibility_beside(model, image, world_from_camera, inliers, &model.registered_neighbours(image))
}

/// [`visibility`] of what these registered images see.
pub(super) fn visibility_beside(
    model: &Model<'_>,
    image: ImageId,
    world_from_camera: &Rigid,
    inliers: &[(u32, PointId)],
    others: &[ImageId],
) -> Visibility {
    let mut is_inlier = vec![false; model.points.len()];
    for (_, id) in inliers {
        is_inlier[id.index()] = true;
    }
    let center = world_from_camera.translation;
    let mut counts = Visibility::default();
    let mut cells = vec![(0_usize, 0_usize); direction::CELLS];
    let mut familiar = vec![false; model.points.len()];
    for &other in others {
        let Some(pose) = &model.poses[other.index()] else { continue };
        for (_, id) in model.observations_of(other) {
            let Some(point) = model.point(id).filter(|_| !familiar[id.index()]) else { continue };
            if !is_same_view(&point.position, pose.center(), &center) {
                continue;
            }
            familiar[id.index()] = true;
            if is_in_view(model, image, world_from_camera, &point.position) {
                counts.expected += 1;
                counts.matched += usize::from(is_inlier[id.index()]);
                if let Some(cell) = direction::cell(&(point.position - center)) {
                    cells[cell].0 += 1;
                    cells[cell].1 += usize::from(is_inlier[id.index()]);
                }
            }
        }
    }
    let full = || cells.iter().filter(|(expected, _)| *expected >= CELL_POINTS);
    counts.expected_cells = full().count();
    counts.matched_cells = full().filter(|(_, matched)| *matched > 0).count();
    counts
}

/// Whether a point falls into an image at this pose.
pub(super) fn is_in_view(
    model: &Model<'_>,
    image: ImageId,
    world_from_camera: &Rigid,
    position: &Vector3<f64>,
) -> bool {
    let direction = world_from_camera.inverse_transform_point(position);
    let source = &model.input.images[image.index()];
    match source.mosaic {
        Some(mosaic) => mosaic.covers(&direction),
        None => is_in_image(&model.cameras[source.camera.index()], &direction),
    }
}

/// Registers an image at an accepted pose: its inliers become observations.
pub(super) fn register(model: &mut Model<'_>, image: ImageId, hypothesis: &PoseHypothesis) {
    model.set_pose(image, Some(hypothesis.world_from_camera));
    model.lengths.extend(hypothesis.length);
    for &(feature, id) in &hypothesis.inliers {
        let observation = Observation { image, feature };
        let free = model.point_of(observation).is_none()
            && model.point(id).is_some_and(|point| !point.track.iter().any(|seen| seen.image == image));
        if free {
            model.add_observation(id, observation);
        }
    }
}
