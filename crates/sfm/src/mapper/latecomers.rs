//! Images that were refused for what they ought to see and do not, once all else is mapped.
//!
//! Through a door a panorama shares its room with the one in the door and little with any third, and all that the corridor's
//! panoramas see lies behind walls: by [`super::register::Visibility`] it stands in the wrong place. In a repeated
//! structure it would, too, so nobody comes in by less while the model grows. At the end the places that it could be taken for
//! are mapped, and two things tell right from wrong: the verified pairs agree on one pose, and the image shares with
//! those next to it what neighbours do ([`super::neighbours`]).
//!
//! An image that one pair alone joins has a place where depths tell how far it is ([`super::depths`]). That pair is believed where
//! pairs like it are right in the model ([`super::support::Worth`]), nothing much speaks against it, and it is not of what
//! stands several times: its matches spread over many directions, or lie on the floor that all stand on.

use std::{cmp::Reverse, f64::consts::PI};

use nalgebra::Vector3;

use super::{
    Part,
    correspondence::CorrespondenceGraph,
    depths::{self, Floor},
    input::PairsByImage,
    model::Model,
    register::PoseHypothesis,
    support::{MIN_FOR, Support},
    witnesses::count_agreeing,
};
use crate::{
    BaselineLength, ImageId, PairGeometry, Rigid, TwoViewKind,
    robust::{KnownView, RansacParams, refine_pose_from_views},
    solvers::triangulation::length_along,
};

/// Largest part whose images are asked whether they belong to a larger one.
pub(super) const FEW_IMAGES: usize = 3;
/// How many times more matches the strongest pair of an image of a part must have with an image elsewhere than the strongest
/// within for it to belong there.
const ELSEWHERE_LEAD: f64 = 2.0;
/// Pairs of an image, the strongest, whose directions are crossed with each other.
const CROSSED_PAIRS: usize = 12;
/// Largest difference between the rotations that two pairs give, and between a direction and the place that two cross in.
const SAME_DIRECTION_RAD: f64 = 0.03;
/// How many times farther off than those of a pair that is for a pose the matches of one may be that is nearly for it.
const NEARLY: f64 = 4.0;
/// Smallest angle between two directions that a place is told by.
const MIN_CROSSING_RAD: f64 = 0.1;

/// Whether the images of a part may leave it for a larger one: they are few, or the pairs of each say that it belongs elsewhere.
///
/// In a rendered floor the strongest pair of each of four images of a part that was wrong in itself (4.2 m) had 48 to 99 matches
/// within it and 272 to 310 with an image of another part; of right parts it is within.
pub(super) fn may_be_left(pairs: &PairsByImage<'_>, part: &Part) -> bool {
    part.size() <= FEW_IMAGES
        || part.component.registered().all(|image| belongs_elsewhere(pairs.of_image(image), part, image))
}

/// Whether the strongest of the pairs of an image of a part is by far with an image that the part does not hold.
pub(super) fn belongs_elsewhere<'p>(
    pairs: impl Iterator<Item = &'p PairGeometry>,
    part: &Part,
    image: ImageId,
) -> bool {
    let is_within = |other: ImageId| part.component.images[other.index()].world_from_camera.is_some();
    lead_elsewhere(pairs, image, is_within) >= ELSEWHERE_LEAD
}

/// How many times more matches the strongest pair of an image has with one that is not within than with one that is.
pub(super) fn lead_elsewhere<'p>(
    pairs: impl Iterator<Item = &'p PairGeometry>,
    image: ImageId,
    is_within: impl Fn(ImageId) -> bool,
) -> f64 {
    let mut strongest = [0; 2];
    for pair in pairs {
        let Some((other, _)) = pair.seen_from(image) else { continue };
        let most = &mut strongest[usize::from(is_within(other))];
        *most = pair.two_view.inliers.len().max(*most);
    }
    let [elsewhere, within] = strongest.map(|most| most as f64);
    elsewhere / within
}

/// A verified pair of the image that is sought and a registered one.
struct Edge {
    other: ImageId,
    /// Centre of the other image.
    from: Vector3<f64>,
    /// Pose of the image that is sought, the length of the baseline arbitrary.
    world_from_image: Rigid,
}

/// The pose where the directions of two verified pairs cross for which most matches of all pairs are.
///
/// Rotation and direction are those of one pair, so that its matches meet; the other gives the length. Of few matches both are a
/// degree or two off, by which a third pair of the same place would count as against it: so the pose is the one that all pairs
/// agree on which are nearly for it, if more of them are for that.
pub(super) fn hypothesize_from_crossings(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    taken: &[bool],
    image: ImageId,
    max_error_sigma: f64,
) -> Option<PoseHypothesis> {
    let pose = best_crossing(model, taken, image, max_error_sigma)?;
    Some(PoseHypothesis::at(model, graph, image, pose, max_error_sigma))
}

/// The same pose by itself.
pub(super) fn best_crossing(
    model: &Model<'_>,
    taken: &[bool],
    image: ImageId,
    max_error_sigma: f64,
) -> Option<Rigid> {
    let edge = |pair: &PairGeometry| {
        let (other, image_from_other) = pair.seen_from(image)?;
        let pose = model.poses[other.index()].as_ref()?;
        Some(Edge {
            other,
            from: *pose.center(),
            world_from_image: pose.world_from_camera * image_from_other.inverse(),
        })
    };
    let edges: Vec<Edge> =
        pairs_with(model, image).into_iter().take(CROSSED_PAIRS).filter_map(edge).collect();
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
    let (matches, pose) = best?;
    let agreed = agreed_by_pairs(model, image, &pose, max_error_sigma);
    let is_better = Support::of(model, taken, image, &agreed, max_error_sigma).matches > matches;
    Some(if is_better { agreed } else { pose })
}

/// The pose that those pairs agree on that are nearly for a pose.
fn agreed_by_pairs(model: &Model<'_>, image: ImageId, pose: &Rigid, max_error_sigma: f64) -> Rigid {
    let view = |pair: &PairGeometry| {
        let (other, _) = pair.seen_from(image)?;
        let world_from_camera = model.poses[other.index()].as_ref()?.world_from_camera;
        let image_from_other = pose.inverse() * world_from_camera;
        let near = count_agreeing(model, pair, image, &image_from_other, NEARLY * max_error_sigma);
        let is_near = near as f64 >= MIN_FOR * pair.two_view.inliers.len() as f64;
        is_near.then(|| {
            let matches = pair.matches_from(other);
            let (known, sought) = (&model.rays[other.index()], &model.rays[image.index()]);
            KnownView {
                world_from_camera,
                bearings: matches.iter().map(|m| known.bearings[m.first as usize]).collect(),
                sigmas: matches.iter().map(|m| known.sigmas[m.first as usize]).collect(),
                sought_bearings: matches.iter().map(|m| sought.bearings[m.second as usize]).collect(),
                sought_sigmas: matches.iter().map(|m| sought.sigmas[m.second as usize]).collect(),
            }
        })
    };
    let views: Vec<KnownView> = pairs_with(model, image).into_iter().filter_map(view).collect();
    refine_pose_from_views(&RansacParams { max_error_sigma, ..RansacParams::default() }, &views, pose)
}

/// The pose by one verified pair whose length depths tell ([`depths`]), above the floor of all images, that most speaks for.
pub(super) fn hypothesize_from_depths(
    model: &Model<'_>,
    floor: Option<Floor>,
    graph: &CorrespondenceGraph,
    taken: &[bool],
    image: ImageId,
    max_error_sigma: f64,
) -> Option<PoseHypothesis> {
    let mut best: Option<(usize, Rigid, BaselineLength)> = None;
    for pair in pairs_with(model, image).into_iter().take(CROSSED_PAIRS) {
        let Some((other, image_from_other)) = pair.seen_from(image) else { continue };
        let Some(world_from_other) = &model.poses[other.index()] else { continue };
        let matches = pair.matches_from(other);
        let Some((step, length)) = depths::step(
            model,
            floor,
            [other, image],
            &model.rays[image.index()],
            &image_from_other,
            &matches,
        ) else {
            continue;
        };
        let pose = world_from_other.world_from_camera * step;
        let spread = Support::of(model, taken, image, &pose, max_error_sigma).spread;
        if best.is_none_or(|(most, ..)| spread > most) {
            best = Some((spread, pose, length));
        }
    }
    let (_, pose, length) = best?;
    let hypothesis = PoseHypothesis::at(model, graph, image, pose, max_error_sigma);
    Some(PoseHypothesis { length: Some(length), ..hypothesis })
}

/// Matches of the verified pairs of an image with registered ones, and the points that these see: what such a pose hangs on.
pub(super) fn count_held_by_pairs(model: &Model<'_>, image: ImageId) -> usize {
    let held = |pair: &PairGeometry| {
        let other = pair.seen_from(image).map_or(0, |(other, _)| model.observed_points(other));
        pair.two_view.inliers.len() + other
    };
    pairs_with(model, image).into_iter().map(held).sum()
}

/// The verified pairs with parallax of an image with registered ones, strongest first.
fn pairs_with<'a>(model: &Model<'a>, image: ImageId) -> Vec<&'a PairGeometry> {
    let is_open = |pair: &&PairGeometry| {
        let other = pair.seen_from(image).map(|(other, _)| other);
        other.is_some_and(|other| model.is_registered(other))
            && pair.two_view.kind != TwoViewKind::PureRotation
    };
    let mut pairs: Vec<&PairGeometry> = model.pairs_of(image).filter(is_open).collect();
    pairs.sort_by_key(|pair| (Reverse(pair.two_view.inliers.len()), pair.first, pair.second));
    pairs
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
    use setloc_features::{Camera, ImageFeatures};

    use super::super::MapperInput;
    use super::*;
    use crate::{CameraId, Reconstruction, ReconstructionImage, TwoView};

    fn edge(other: u32, from: [f64; 3], truth: &Rigid, askew_rad: f64) -> Edge {
        let from = Vector3::from(from);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), askew_rad);
        let step = turn * (truth.translation - from).normalize();
        let world_from_image = Rigid::new(turn * truth.rotation, from + step);
        Edge { other: ImageId(other), from, world_from_image }
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

    /// Pairs by their images and matches, of six images of which the first four are a part.
    fn may_four_leave(pairs: &[(u32, u32, u32)]) -> bool {
        let features = ImageFeatures::default();
        let pair = |&(first, second, matches): &(u32, u32, u32)| PairGeometry {
            first: ImageId(first),
            second: ImageId(second),
            two_view: TwoView::of_equal_features(Rigid::identity(), 0..matches),
        };
        let pairs: Vec<PairGeometry> = pairs.iter().map(pair).collect();
        let camera = Camera::equirectangular(2048, 1024);
        let input = MapperInput::of_one_camera(&camera, [&features; 6], &pairs);
        let image = |at: u32| ReconstructionImage {
            name: at.to_string(),
            camera: CameraId(0),
            world_from_camera: (at < 4).then(Rigid::identity),
        };
        let images = (0..6).map(image).collect();
        let component = Reconstruction { cameras: vec![camera], images, ..Reconstruction::default() };
        may_be_left(&PairsByImage::of(&input), &Part { component, anchors: vec![None; 6] })
    }

    #[test]
    fn a_part_may_be_left_whose_pairs_all_say_that_its_images_belong_elsewhere() {
        let within = [(0, 1, 90), (1, 2, 60), (2, 3, 99), (0, 3, 50)];
        let elsewhere = [(0, 4, 270), (1, 4, 180), (2, 5, 300), (3, 5, 198)];
        assert!(may_four_leave(&[within, elsewhere].concat()));
        assert!(!may_four_leave(&within));
        // One that belongs where it is keeps the part together.
        assert!(!may_four_leave(&[&within[..], &elsewhere[..3], &[(3, 5, 190)]].concat()));
    }
}
