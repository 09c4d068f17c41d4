//! Images that were refused for what they ought to see and do not, once all else is mapped.
//!
//! Through a door a panorama shares its room with the one in the door and little with any third, and all that the corridor's
//! panoramas see lies behind walls: by [`super::register::Visibility`] it stands in the wrong place. In a repeated
//! structure it would, too, so nobody comes in by less while the model grows. At the end the places that it could be taken for
//! are mapped, and two things tell right from wrong: the verified pairs agree on one pose, and the image shares with
//! those next to it what neighbours do ([`super::neighbours`]).

use std::{cmp::Reverse, f64::consts::PI};

use nalgebra::Vector3;

use super::{
    correspondence::CorrespondenceGraph,
    model::Model,
    register::{PoseHypothesis, scene_matches, visibility},
    support::Support,
};
use crate::{ImageId, PairGeometry, PointId, Rigid, TwoViewKind, solvers::triangulation::length_along};

/// Largest part whose images are asked whether they belong to a larger one.
pub(super) const FEW_IMAGES: usize = 3;
/// Pairs of an image, the strongest, whose directions are crossed with each other.
const CROSSED_PAIRS: usize = 12;
/// Largest difference between the rotations that two pairs give, and between a direction and the place that two cross in.
const SAME_DIRECTION_RAD: f64 = 0.03;
/// Smallest angle between two directions that a place is told by.
const MIN_CROSSING_RAD: f64 = 0.1;
/// A verified pair of the image that is sought and a registered one.
struct Edge {
    matches: usize,
    other: ImageId,
    /// Centre of the other image.
    from: Vector3<f64>,
    /// Pose of the image that is sought, the length of the baseline arbitrary.
    world_from_image: Rigid,
}

/// The pose where the directions of two verified pairs cross for which most matches of all pairs are.
///
/// Rotation and direction are those of one pair, so that its matches meet; the other gives the length.
pub(super) fn hypothesize_from_crossings(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    taken: &[bool],
    image: ImageId,
    max_error_sigma: f64,
) -> Option<PoseHypothesis> {
    let edge = |pair: &PairGeometry| {
        let (other, image_from_other) = pair.seen_from(image)?;
        let pose = model.poses[other.index()].as_ref()?;
        (pair.two_view.kind != TwoViewKind::PureRotation).then(|| Edge {
            matches: pair.two_view.inliers.len(),
            other,
            from: *pose.center(),
            world_from_image: pose.world_from_camera * image_from_other.inverse(),
        })
    };
    let mut edges: Vec<Edge> = model.input.pairs.iter().filter_map(edge).collect();
    edges.sort_by_key(|edge| (Reverse(edge.matches), edge.other));
    edges.truncate(CROSSED_PAIRS);
    let mut best: Option<(usize, Rigid)> = None;
    for (at, first) in edges.iter().enumerate() {
        for second in edges.iter().skip(at + 1).filter(|second| second.other != first.other) {
            let Some(pose) = crossing(first, second) else { continue };
            let matches = Support::of(model, taken, image, &pose, max_error_sigma).matches;
            if best.is_none_or(|(most, _)| matches > most) {
                best = Some((matches, pose));
            }
        }
    }
    let (_, pose) = best?;
    let matches = scene_matches(model, graph, image);
    let rays = &model.rays[image.index()];
    let agrees = |&(feature, id): &(u32, PointId)| {
        let Some(point) = model.point(id) else { return false };
        let direction = pose.inverse_transform_point(&point.position).normalize();
        let error = (direction - rays.bearings[feature as usize]).norm();
        error <= max_error_sigma * rays.sigmas[feature as usize]
    };
    let inliers: Vec<(u32, PointId)> = matches.iter().copied().filter(agrees).collect();
    let visibility = visibility(model, image, &pose, &inliers);
    Some(PoseHypothesis { world_from_camera: pose, inliers, candidates: matches.len(), visibility })
}

/// The pose on the direction of one pair where that of another crosses it.
fn crossing(first: &Edge, second: &Edge) -> Option<Rigid> {
    let rotation = first.world_from_image.rotation;
    if rotation.angle_to(&second.world_from_image.rotation) > SAME_DIRECTION_RAD {
        return None;
    }
    let [step, other_step] = [first, second].map(|edge| edge.world_from_image.translation - edge.from);
    let angle = step.angle(&other_step);
    if !(MIN_CROSSING_RAD..=PI - MIN_CROSSING_RAD).contains(&angle) {
        return None;
    }
    let length = length_along(&step, &(second.from - first.from), &other_step.normalize())?;
    let center = first.from + step * length;
    let is_ahead = (center - second.from).angle(&other_step) <= SAME_DIRECTION_RAD;
    is_ahead.then(|| Rigid::new(rotation, center))
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    fn edge(other: u32, from: [f64; 3], truth: &Rigid, askew_rad: f64) -> Edge {
        let from = Vector3::from(from);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), askew_rad);
        let step = turn * (truth.translation - from).normalize();
        let world_from_image = Rigid::new(turn * truth.rotation, from + step);
        Edge { matches: 100, other: ImageId(other), from, world_from_image }
    }

    #[test]
    fn two_directions_cross_in_the_place_that_is_sought() {
        let truth =
            Rigid::new(UnitQuaternion::from_euler_angles(0.1, -2.0, 0.3), Vector3::new(5.0, 0.4, 6.0));
        let first = edge(0, [0.0, 0.0, 0.0], &truth, 0.0);
        let found = crossing(&first, &edge(1, [1.0, 0.0, 8.0], &truth, 0.0)).expect("they cross");
        assert!((found.translation - truth.translation).norm() < 1e-9, "{found:?}");
        assert!(found.rotation.angle_to(&truth.rotation) < 1e-9);
        let nearly = crossing(&first, &edge(1, [1.0, 0.0, 8.0], &truth, 0.01)).expect("they nearly cross");
        assert!((nearly.translation - truth.translation).norm() < 0.2, "{nearly:?}");
    }

    #[test]
    fn directions_that_do_not_cross_give_no_place() {
        let truth = Rigid::new(UnitQuaternion::identity(), Vector3::new(5.0, 0.4, 6.0));
        let first = edge(0, [0.0, 0.0, 0.0], &truth, 0.0);
        // Another rotation, one line, another place, and behind.
        assert!(crossing(&first, &edge(1, [1.0, 0.0, 8.0], &truth, 0.05)).is_none());
        assert!(crossing(&first, &edge(1, [2.5, 0.2, 3.0], &truth, 0.0)).is_none());
        let elsewhere = Rigid::new(truth.rotation, Vector3::new(5.0, 3.0, 6.0));
        assert!(crossing(&first, &edge(1, [1.0, 0.0, 8.0], &elsewhere, 0.0)).is_none());
        let mut behind = edge(1, [1.0, 0.0, 8.0], &truth, 0.0);
        behind.world_from_image.translation = 2.0 * behind.from - behind.world_from_image.translation;
        assert!(crossing(&first, &behind).is_none());
    }
}
