//! The length of a baseline from depths that lie side by side.
//!
//! Through a door, round a corner, in a room with bare walls, an image shares one part of its surroundings with one image and
//! another part with the next, and hardly any point is seen from three places. The rotation and the direction of each baseline
//! are known then, its length is not. But what two images share lies beside what others share with them, on the same walls,
//! floors and furniture: in nearly the same direction an image sees both at nearly the same depth. So each match of a pair,
//! at the depth that a baseline of length one gives it, is compared with the points of the model that the known image sees next to
//! it; the quotient is a vote for the length, and where a wall ends, votes scatter.
//!
//! Unlike planes that go on ([`super::continuation`]) this needs no planes, and works as far as the two kinds of points
//! lie among each other, which panoramas make likely.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use setloc_features::{Match, Rays};

use super::{
    continuation::{depth_sigma, known_points, of_unknown_direction, reference_of},
    model::Model,
    plane::SeenPoint,
    support::is_for,
    votes::{LEAD, Opinion, peaks},
};
use crate::{
    BaselineLength, ImageId, Rigid, StepPose, direction,
    robust::median,
    solvers::triangulation::{WorldRay, triangulate},
};

/// Largest standard deviation of the logarithm of a depth that is compared, and of a quotient of two that votes.
const MAX_DEPTH_SIGMA: f64 = 0.15;
/// Largest angle between two directions whose depths are compared.
const SIDE_BY_SIDE_RAD: f64 = 0.1;
/// How much the logarithm of a depth changes with the direction, as a standard deviation: that of a wall seen at 45°, and of
/// the floor at most.
const SLOPE: f64 = 1.0;
const MAX_SLOPE: f64 = 4.0;
/// Relief of walls, as a share of their depth.
const RELIEF: f64 = 0.01;
/// Least sine of the angle below the horizon of what may be the floor.
const MIN_DOWN: f64 = 0.25;
/// How uneven a floor is, as a share of the drop to it.
const UNEVEN: f64 = 0.03;
/// Fewest points of a floor.
const MIN_FLOOR_POINTS: f64 = 5.0;
/// Points of its own floor from which an image is not asked how high others stand.
const MANY_FLOOR_POINTS: f64 = 20.0;
/// How many times more the logarithm of the likelihood of a floor must be than that of any other drop.
const FLOOR_LEAD: f64 = 2.0;
/// Largest difference between the logarithms of two drops to one floor.
const SAME_FLOOR: f64 = 0.08;
/// Fewest matches of an image that must lie on it.
const MIN_ON_FLOOR: usize = 4;
/// How many times as far as the floor rooms reach in most directions, at most.
const MAX_HEIGHTS: f64 = 3.0;
/// Fewest images that tell how high all stand.
const MIN_FLOORS: usize = 3;
/// Fewest matches that must agree on a length.
const MIN_MATCHES: usize = 8;
/// Least logarithm of the likelihood of a length, relative to none.
const MIN_LOG_LIKELIHOOD: f64 = 20.0;
/// Matches that count as one: those on one wall share its error.
const ALIKE: f64 = 4.0;
/// Least standard deviation of the logarithm of a length. On rendered floors and streets such lengths are 0.4 to 0.5 % off in the
/// median, 2 % in the worst tenth.
const LEAST_DEVIATION: f64 = 0.01;

/// How far it is in a direction.
#[derive(Debug, Clone, Copy)]
struct Depth {
    /// Unit vector in the frame of the camera.
    direction: Vector3<f64>,
    /// Logarithm of the depth.
    log: f64,
    /// Standard deviation of that.
    sigma: f64,
}

impl Depth {
    /// How much the logarithm of the depth may change with the direction: as that of a wall or, below the horizon, of the floor.
    fn slope(&self) -> f64 {
        let down = self.direction.y;
        if down > 0.0 { ((1.0 - down * down).max(0.0).sqrt() / down).clamp(SLOPE, MAX_SLOPE) } else { SLOPE }
    }

    /// Logarithm of how far it is down; `None` of what is not well below the horizon.
    fn drop(&self) -> Option<f64> {
        (self.direction.y >= MIN_DOWN).then(|| self.log + self.direction.y.ln())
    }

    fn of(direction: Vector3<f64>, point: &SeenPoint) -> Option<Self> {
        let (log, sigma) = (point.position.norm().ln(), depth_sigma(point));
        (sigma <= MAX_DEPTH_SIGMA).then_some(Self { direction, log, sigma })
    }
}

/// The depths of the points that an image of a model sees.
fn of_points(model: &Model<'_>, image: ImageId) -> Vec<Depth> {
    let Some(pose) = &model.poses[image.index()] else { return Vec::new() };
    let depth =
        |point: &SeenPoint| Depth::of((pose.camera_from_world * point.position).try_normalize(0.0)?, point);
    known_points(model, image, pose.center()).iter().filter_map(depth).collect()
}

/// The depths of matches as the first of two images sees them, where the second is at distance one.
fn of_pair(rays: [&Rays; 2], second_from_first: &Rigid, matches: &[Match]) -> Vec<Depth> {
    let first_from_second = second_from_first.inverse();
    let Some(step) = first_from_second.translation.try_normalize(0.0) else { return Vec::new() };
    let second_pose = Rigid::new(first_from_second.rotation, step);
    let depth = |found: &Match| {
        let ray = |of: &Rays, pose: &Rigid, feature: u32| {
            let (bearing, sigma) = (of.bearings[feature as usize], of.sigmas[feature as usize]);
            sigma.is_finite().then(|| WorldRay::new(pose, &bearing, sigma))
        };
        let first = ray(rays[0], &Rigid::identity(), found.first)?;
        let second = ray(rays[1], &second_pose, found.second)?;
        let position = triangulate(&[first, second])?;
        let is_ahead = |ray: &WorldRay| ray.direction.dot(&(position - ray.origin)) > 0.0;
        let point = SeenPoint::new(&Vector3::zeros(), &position, &[first, second])?;
        (is_ahead(&first) && is_ahead(&second)).then(|| Depth::of(first.direction, &point))?
    };
    matches.iter().filter_map(depth).collect()
}

/// How far the floor is below an image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Floor {
    /// Logarithm of the drop to it.
    drop: f64,
    /// Standard deviation of that.
    sigma: f64,
    /// Points that agree.
    points: f64,
}

/// The floor below an image, by the drops of what it sees that most agree on; `None` unless one stands out.
fn floor(known: &[Depth]) -> Option<Floor> {
    let drops: Vec<Opinion> = known
        .iter()
        .filter_map(|depth| Some(Opinion { length: depth.drop()?, sigma: depth.sigma.hypot(UNEVEN) }))
        .collect();
    let (best, second) = peaks(&drops)?;
    let stands_out = best.votes >= MIN_FLOOR_POINTS && best.log_likelihood >= FLOOR_LEAD * second;
    stands_out.then_some(Floor { drop: best.length, sigma: UNEVEN, points: best.votes })
}

/// A length that depths agree on.
#[derive(Debug, Clone, Copy)]
struct Found {
    /// In units of the known depths.
    length: f64,
    /// Standard deviation of its logarithm.
    deviation: f64,
    /// Matches that agree.
    votes: usize,
}

/// The length of the baseline of a pair by what its first image knows beside its matches; `None` unless one length stands out.
fn length(known: &[Depth], floor: Option<Floor>, of_pair: &[Depth]) -> Option<Found> {
    let mut opinions = Vec::new();
    let mut matches = Vec::new();
    for (at, of_match) in of_pair.iter().enumerate() {
        let beside = known
            .iter()
            .map(|depth| ((depth.direction - of_match.direction).norm(), depth))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((chord, depth)) = beside.filter(|(chord, _)| *chord <= SIDE_BY_SIDE_RAD) {
            let sigma = of_match.sigma.hypot(depth.sigma).hypot(of_match.slope() * chord + RELIEF);
            if sigma <= MAX_DEPTH_SIGMA {
                opinions.push(Opinion { length: depth.log - of_match.log, sigma });
                matches.push(at);
            }
        }
        if let Some((floor, drop)) = floor.zip(of_match.drop()) {
            let sigma = of_match.sigma.hypot(floor.sigma).hypot(UNEVEN);
            opinions.push(Opinion { length: floor.drop - drop, sigma });
            matches.push(at);
        }
    }
    let (best, second) = peaks(&opinions)?;
    if best.log_likelihood < MIN_LOG_LIKELIHOOD.max(LEAD * second) {
        return None;
    }
    let agreeing = || opinions.iter().zip(&matches).filter(|(opinion, _)| opinion.agrees(best.length));
    let mut agreeing_matches: Vec<usize> = agreeing().map(|(_, &at)| at).collect();
    agreeing_matches.dedup();
    let votes = agreeing_matches.len();
    let squares: f64 = agreeing().map(|(opinion, _)| (opinion.length - best.length).powi(2)).sum();
    let scatter = (squares / agreeing().count() as f64).sqrt();
    let deviation = LEAST_DEVIATION.hypot(scatter / (votes as f64 / ALIKE).sqrt());
    (votes >= MIN_MATCHES).then(|| Found { length: best.length.exp(), deviation, votes })
}

/// The floor below the images of a model that see theirs, where they stand alike above it.
pub(super) fn floor_of_all(model: &Model<'_>) -> Option<Floor> {
    common_floor(model.registered().map(|image| of_points(model, image)))
}

/// The floor below images that know these depths, where they stand alike above it.
fn common_floor(known: impl Iterator<Item = Vec<Depth>>) -> Option<Floor> {
    let floors: Vec<f64> = known.filter_map(|known| Some(floor(&known)?.drop)).collect();
    let drop = median(floors.clone())?;
    let sigma = median(floors.iter().map(|of_image| (of_image - drop).abs()).collect())?;
    (floors.len() >= MIN_FLOORS && sigma <= UNEVEN).then_some(Floor {
        drop,
        sigma: UNEVEN.hypot(sigma),
        points: 0.0,
    })
}

/// Whether the images of a model stand in rooms: in most directions they see no farther than a few times their height above the
/// floor.
///
/// Depths beside are as good as walls are near. In a rendered street of 9 m steps they put panoramas 1 m off.
pub(super) fn is_indoors(model: &Model<'_>) -> bool {
    let in_each_direction = |known: &Vec<Depth>| {
        let mut cells: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
        for depth in known {
            if let Some(cell) = direction::cell(&depth.direction) {
                cells.entry(cell).or_default().push(depth.log);
            }
        }
        cells.into_values().filter_map(median)
    };
    let known: Vec<Vec<Depth>> = model.registered().map(|image| of_points(model, image)).collect();
    let depths = known.iter().flat_map(in_each_direction).collect();
    let is_near = |(floor, depth): (Floor, f64)| depth - floor.drop <= MAX_HEIGHTS.ln();
    common_floor(known.into_iter()).zip(median(depths)).is_some_and(is_near)
}

/// Whether the matches of the pairs that are for a pose of an image lie on the floor of all images, those that are well below the horizon, if
/// the image stands as high above it as all others.
///
/// What a façade repeats is not the floor before it, unless that repeats itself, too: of 67 wrong pairs of two rendered streets none
/// has four such matches (of 277 of plaza and floors of equal tiles two fifths do), of right pairs of a real house two thirds.
pub(super) fn stands_on_floor(
    model: &Model<'_>,
    floor: Option<Floor>,
    image: ImageId,
    world_from_camera: &Rigid,
    max_error_sigma: f64,
) -> bool {
    let Some(floor) = floor else { return false };
    let (mut on_floor, mut below) = (0, 0);
    for pair in model.pairs_of(image) {
        let Some((other, _)) = pair.seen_from(image) else { continue };
        let Some(pose) = &model.poses[other.index()] else { continue };
        let other_from_image = pose.world_from_camera.inverse() * *world_from_camera;
        if !is_for(model, pair, other, &other_from_image, max_error_sigma) {
            continue;
        }
        let rays = [image, other].map(|image| &model.rays[image.index()]);
        let length = other_from_image.translation.norm().ln();
        for depth in of_pair(rays, &other_from_image, &pair.matches_from(image)) {
            let Some(drop) = depth.drop() else { continue };
            below += 1;
            on_floor += usize::from((drop + length - floor.drop).abs() <= SAME_FLOOR);
        }
    }
    on_floor >= MIN_ON_FLOOR && 2 * on_floor >= below
}

/// The step from an image of a model to another one by their verified pair and what the first knows beside its matches, in
/// units of the model; `of_all` is the floor below all its images.
pub(super) fn step(
    model: &Model<'_>,
    of_all: Option<Floor>,
    [from, to]: [ImageId; 2],
    rays_of_to: &Rays,
    to_from_from: &Rigid,
    matches: &[Match],
) -> Option<(Rigid, BaselineLength)> {
    let rays = [&model.rays[from.index()], rays_of_to];
    let known = of_points(model, from);
    let own = floor(&known);
    let floor = own.filter(|floor| floor.points >= MANY_FLOOR_POINTS).or(of_all).or(own);
    let found = length(&known, floor, &of_pair(rays, to_from_from, matches))?;
    step_of(model, [from, to], to_from_from, found)
}

/// The same step in a model where nothing beside tells its length, by a model that knows it and by the floor, above which the
/// images of both stand alike: `floors` are those of this model and of that one.
pub(super) fn step_by_floors(
    model: &Model<'_>,
    floors: [Floor; 2],
    images: [ImageId; 2],
    to_from_from: &Rigid,
    (known, known_length): &(Rigid, BaselineLength),
) -> Option<(Rigid, BaselineLength)> {
    let [floor, known_floor] = floors;
    let found = Found {
        length: known.translation.norm() * (floor.drop - known_floor.drop).exp(),
        deviation: known_length.deviation.hypot(floor.sigma).hypot(known_floor.sigma),
        votes: known_length.votes,
    };
    step_of(model, images, to_from_from, found)
}

fn step_of(
    model: &Model<'_>,
    [from, to]: [ImageId; 2],
    to_from_from: &Rigid,
    found: Found,
) -> Option<(Rigid, BaselineLength)> {
    let reference = reference_of(model, from)?;
    let center = |image: ImageId| model.poses[image.index()].as_ref().map(|pose| *pose.center());
    let baseline = (center(from)? - center(reference)?).norm();
    let from_from_to = to_from_from.inverse();
    let along = from_from_to.translation.try_normalize(0.0)? * found.length;
    let step = StepPose {
        first_from_second: Rigid::new(from_from_to.rotation, along),
        covariance: of_unknown_direction(&along, found.deviation),
    };
    let length = BaselineLength::of_step([reference, from, to], &step, baseline, found.votes)?;
    Some((step.first_from_second, length))
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::super::test_street::{POINTS, Street, first_two};
    use super::*;
    use crate::synthetic::{normal, seeded};

    /// Depths in a room of 5 × 4 m, 1.4 m above its floor, with 1 % of noise, times a factor; `is_in` chooses the directions.
    fn room(seed: &str, count: usize, factor: f64, is_in: impl Fn(&Vector3<f64>) -> bool) -> Vec<Depth> {
        let mut rng = seeded(seed);
        let mut depths = Vec::new();
        while depths.len() < count {
            let direction = Vector3::from_fn(|_, _| normal(&mut rng)).normalize();
            let walls = [2.0, 1.4, 3.0].map(f64::from);
            let distance =
                (0..3).map(|axis| walls[axis] / direction[axis].abs()).fold(f64::INFINITY, f64::min);
            if is_in(&direction) {
                let log = (factor * distance).ln() + 0.01 * normal(&mut rng);
                depths.push(Depth { direction, log, sigma: 0.01 });
            }
        }
        depths
    }

    #[test]
    fn the_walls_beside_tell_the_length() {
        for seed in 0..50 {
            let known = room(&format!("known {seed}"), 300, 1.0, |_| true);
            let of_pair = room(&format!("pair {seed}"), 120, 1.0 / 1.7, |_| true);
            let found = length(&known, None, &of_pair).expect("walls all around");
            let error = (found.length / 1.7).ln();
            assert!(error.abs() < 0.03 && found.votes >= 20, "{error} {found:?}");
            assert!((0.01..0.04).contains(&found.deviation), "{found:?}");
        }
    }

    #[test]
    fn the_floor_tells_it_where_nothing_lies_beside() {
        let known = room("left", 300, 1.0, |direction| direction.x < -0.2);
        let of_pair = room("right", 80, 1.0 / 0.6, |direction| direction.x > 0.2);
        assert!(length(&known, None, &of_pair).is_none());
        let below = floor(&known).expect("it sees its floor");
        assert!((below.drop.exp() / 1.4 - 1.0).abs() < 0.01, "{below:?}");
        let found = length(&known, Some(below), &of_pair).expect("it sees the floor, too");
        assert!((found.length / 0.6).ln().abs() < 0.03, "{found:?}");
    }

    #[test]
    fn depths_that_have_nothing_to_do_with_each_other_tell_nothing() {
        let mut rng = seeded("scattered");
        let known = room("known", 300, 1.0, |_| true);
        for _ in 0..300 {
            let mut of_pair = room("pair", 60, 1.0, |_| true);
            for depth in &mut of_pair {
                depth.log += rng.random_range(-1.5..1.5);
            }
            assert!(length(&known, floor(&known), &of_pair).is_none());
        }
        assert!(length(&[], None, &room("pair", 60, 1.0, |_| true)).is_none());
        assert!(floor(&[]).is_none());
    }

    #[test]
    fn a_length_is_carried_from_a_model_to_another_by_the_floor_below_both() {
        let street = Street::new("floors", 60, POINTS);
        let input = street.input();
        let model = first_two(&street, &input);
        let to_from_from = street.poses[2].inverse() * street.poses[1];
        let truth = to_from_from.inverse();
        let floor = |drop: f64| Floor { drop: drop.ln(), sigma: 0.03, points: 0.0 };
        // The other model's unit is 2.5 times as small.
        let images = [ImageId(1), ImageId(2)];
        let length = Found { length: 2.5 * truth.translation.norm(), deviation: 0.02, votes: 12 };
        let known = step_of(&model, images, &to_from_from, length).expect("the two share points");
        let found = step_by_floors(&model, [floor(1.4), floor(3.5)], images, &to_from_from, &known);
        let (step, length) = found.expect("the two share points");
        assert!((step.translation - truth.translation).norm() < 1e-9, "{step:?} {truth:?}");
        assert!(step.rotation.angle_to(&truth.rotation) < 1e-9);
        let deviation = (0.02_f64.powi(2) + 2.0 * 0.03_f64.powi(2)).sqrt();
        assert!((length.deviation - deviation).abs() < 1e-9 && length.votes == 12, "{length:?}");
        assert_eq!([length.reference, length.from, length.to], [0, 1, 2].map(ImageId));
    }

    #[test]
    fn a_match_is_as_far_as_two_rays_say_and_one_behind_is_left_out() {
        let camera = setloc_features::Camera::equirectangular(2048, 1024);
        let pose = Rigid::new(
            nalgebra::UnitQuaternion::from_euler_angles(0.1, 0.4, 0.2),
            Vector3::new(0.5, 0.1, 0.2),
        );
        let points = [Vector3::new(2.0, 1.0, 3.0), Vector3::new(-1.0, 0.3, 0.5)];
        let rays_of = |pose: &Rigid, points: &[Vector3<f64>]| {
            let mut features =
                setloc_features::ImageFeatures { width: 2048, height: 1024, ..Default::default() };
            for point in points {
                let pixel = camera.project(&pose.inverse_transform_point(point)).expect("sees all around");
                let [x, y] = [pixel.x as f32, pixel.y as f32];
                let keypoint = setloc_features::Keypoint { x, y, size: 4.0, orientation: 0.0, noise_px: 0.3 };
                features.keypoints.push(keypoint);
                features.colors.push([128; 3]);
            }
            features.rays(&camera)
        };
        let rays = [rays_of(&Rigid::identity(), &points), rays_of(&pose, &[points[0], -points[1]])];
        let matches = [0, 1].map(|at| Match { first: at, second: at });
        let found = of_pair([&rays[0], &rays[1]], &pose.inverse(), &matches);
        let [depth] = found[..] else { panic!("{found:?}") };
        let expected = points[0].norm() / pose.translation.norm();
        assert!((depth.log.exp() / expected - 1.0).abs() < 1e-3, "{depth:?} {expected}");
        assert!((depth.direction - points[0].normalize()).norm() < 1e-3 && depth.sigma < 0.05, "{depth:?}");
    }
}
