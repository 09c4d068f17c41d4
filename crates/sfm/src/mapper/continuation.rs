//! The length of a baseline from planes that go on.
//!
//! Where an image shares nothing with any but one image of the model, and what it shares has no points yet, its rotation
//! and the direction of its baseline are known and the length is not. But walls go on: what the two see lies on planes
//! that the model has beside it. Each match, triangulated with a baseline of length one, meets the plane's continuation
//! at a depth, and the quotient of the two depths is a vote for the length. The right length gathers votes of many
//! directions; points of other surfaces scatter.
//!
//! Two things are asked before a point may vote for a plane. What stands across tells nothing (the end of a street is
//! parallel to the front that one has just passed, and all its points agree on a wrong length): the plane must not be
//! seen through, so points of the model near the ray must not lie behind it. And what lies on a plane of the pair itself
//! with another normal is no continuation. Where all agree on a length unlike the model's own steps, none is taken.
//!
//! How well the pair itself is known is told by the homography of the wall that it sees ([`super::wall`]).

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6, Vector3};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use setloc_features::{GuidedParams, Match, match_guided};

use super::{
    corner::PairByWall,
    model::Model,
    plane::{Plane, SeenPoint, find_planes},
    votes::{LEAD, Opinion, peaks},
    witnesses::count_on_circles,
};
use crate::{
    BaselineLength, ImageId, Observation, Rigid, StepPose,
    robust::{RansacParams, estimate_relative_pose, refine_relative_pose},
    solvers::{
        essential::essential_from_pose,
        triangulation::{WorldRay, triangulate},
    },
};

/// Fewest points of a plane.
const MIN_PLANE_POINTS: usize = 20;
/// Largest standard deviation of the logarithm of a depth that votes.
const MAX_VOTE_SIGMA: f64 = 0.15;
/// Relief of walls, as a share of their distance: adds to the noise of each vote.
const RELIEF: f64 = 0.01;
/// Points of the model near a ray that say whether a plane is seen through there.
const WITNESSES: usize = 5;
/// How far behind a plane a point must lie to say so, as a share of the plane's distance.
const BEHIND: f64 = 0.05;
/// Largest angle between the normals of a plane of the model and its continuation, beside what noise leaves open.
const MAX_NORMAL_RAD: f64 = 0.17;
/// How far a plane may go on beyond its points, in distances from the image.
const MAX_GAP: f64 = 2.0;
/// Which of the nearest points of a plane tells how far it is to go on: one may be astray.
const GAP_POINT: usize = 3;
/// Fewest votes that must agree.
const MIN_VOTES: f64 = 9.0;
/// Least logarithm of the likelihood of a length, relative to none.
const MIN_LOG_LIKELIHOOD: f64 = 20.0;
/// How many times more it must be than for depths dealt out anew.
const CHANCE_LEAD: f64 = 2.0;
/// Largest factor between the length and that of the reference baseline. Who takes photos on the way somewhere takes
/// steps of one kind; what gives another length is a wall that is parallel to a nearer one.
pub(super) const MAX_STEP_RATIO: f64 = 4.0;
/// How often depths are dealt out anew to see what chance gives.
const SHUFFLES: usize = 8;
/// Beyond its points by this share of its distance, a wall may have a step.
const STEP_GAP: f64 = 0.1;
/// Standard deviation of a wall's distance within its points and beyond, as a share of it.
const STEP_DEVIATION: [f64; 2] = [0.02, 0.05];
/// Votes that must lie within a plane's points to say that it is the same wall.
const INSIDE: usize = 5;
/// Fewest points that two images of a reference baseline share.
const MIN_REFERENCE_POINTS: usize = 10;

/// One match's opinion.
#[derive(Debug, Clone, Copy)]
pub(super) struct Vote {
    /// The match, by its place in the list.
    pub found: usize,
    /// Depth of the plane along the ray, and of the match at a baseline of length one: logarithms.
    pub plane_depth: f64,
    depth: f64,
    /// Standard deviation of their difference.
    sigma: f64,
    /// How far the plane is to go on, in its distances from the image.
    gap: f64,
    /// What the plane's own noise leaves open there.
    plane_sigma: f64,
}

impl Vote {
    fn opinion(&self) -> Opinion {
        Opinion { length: self.plane_depth - self.depth, sigma: self.sigma }
    }
}

/// A length and the votes that agree on it.
pub(super) struct Peaked {
    /// Logarithm of the length.
    pub length: f64,
    pub log_likelihood: f64,
    pub agreeing: Vec<Vote>,
}

/// An image's pose by planes that go on.
pub(super) struct Continued {
    pub world_from_camera: Rigid,
    pub length: BaselineLength,
    /// Matches of keypoints of the known image with its own that agree with the pose.
    pub matches: Vec<Match>,
}

/// The pose of `image` from its verified geometry with the registered image `other`, where planes tell the length.
pub(super) fn continue_planes(
    model: &Model<'_>,
    image: ImageId,
    other: ImageId,
    (image_from_other, verified): (&Rigid, &[Match]),
    seed: u64,
) -> Option<Continued> {
    let pose = model.poses[other.index()].as_ref()?;
    let reference = reference_of(model, other)?;
    let center = *pose.center();
    let baseline = (center - model.poses[reference.index()].as_ref()?.center()).norm();
    let known: Vec<SeenPoint> = known_points(model, other, &center);
    let planes = find_planes(&known, MIN_PLANE_POINTS, seed);
    if planes.is_empty() {
        return None;
    }
    let is_step = |length: f64| (MAX_STEP_RATIO.recip()..=MAX_STEP_RATIO).contains(&(length / baseline));
    let scene = Surroundings::new(&known, &planes);
    let measured =
        PairByWall::find(model, image, other, (image_from_other, verified), &scene, baseline, seed).filter(
            |found| {
                let step = found.measured.pair.second_from_first();
                is_step(step.translation.norm()) && explains(model, [other, image], &step, verified)
            },
        );
    let (step, either, votes, matches) = if let Some(found) = measured {
        let (step, either) = found.step();
        (step, either, found.votes, found.matches)
    } else {
        let pair = Pair::new(model, image, other, (image_from_other, verified), seed);
        let votes = votes(&scene, &pair.points(&pair.image_from_other), seed);
        let Peaked { length, agreeing, .. } = length_of(&votes, seed)?;
        let length = length.exp();
        if !is_step(length) {
            return None;
        }
        let deviation = stated(&agreeing)?.hypot(pair.deviation(&agreeing)?);
        let mut other_from_image = pair.image_from_other.inverse();
        other_from_image.translation *= length;
        let covariance = of_unknown_direction(&other_from_image.translation, deviation);
        let step = StepPose { first_from_second: other_from_image, covariance };
        (step, None, agreeing.len(), pair.matches)
    };
    let length = BaselineLength::of_step([reference, other, image], &step, baseline, votes)?;
    Some(Continued {
        world_from_camera: pose.world_from_camera * step.first_from_second,
        length: BaselineLength {
            either: either.map(|poses| poses.map(|pose| pose.scaled(baseline.recip()))),
            ..length
        },
        matches,
    })
}

/// Least share of the verified matches that a wall's pose must have on its circles: who sees two walls is told by both.
const MIN_ON_CIRCLES: f64 = 0.8;

fn explains(model: &Model<'_>, images: [ImageId; 2], second_from_first: &Rigid, verified: &[Match]) -> bool {
    let rays = images.map(|image| &model.rays[image.index()]);
    let on_circles = count_on_circles(rays, second_from_first, verified, RANSAC.max_error_sigma);
    on_circles as f64 >= MIN_ON_CIRCLES * verified.len() as f64
}

/// Standard deviations of the direction of a baseline and of the rotation where no homography tells them.
///
/// On five rendered corners the directions of such pairs were off by 0.03–4.0° and the rotations by 0.03–0.8°, up to
/// forty times what their residuals state.
const PAIR_DIRECTION_RAD: f64 = 0.045;
const PAIR_ROTATION_RAD: f64 = 0.009;

/// Covariance of rotation and centre after a step whose length has this relative standard deviation.
pub(super) fn of_unknown_direction(step: &Vector3<f64>, deviation: f64) -> Matrix6<f64> {
    let along = step * step.transpose() / step.norm_squared();
    let across = Matrix3::identity() - along;
    let mut covariance = Matrix6::identity() * PAIR_ROTATION_RAD.powi(2);
    let of_center = (along * deviation.powi(2) + across * PAIR_DIRECTION_RAD.powi(2)) * step.norm_squared();
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&of_center);
    covariance
}

/// The image that shares most points with this one from another place.
pub(super) fn reference_of(model: &Model<'_>, image: ImageId) -> Option<ImageId> {
    let center = model.poses[image.index()].as_ref()?.center();
    let seen = model.observations_of(image);
    let tracks = seen.iter().filter_map(|(_, id)| Some(&model.point(*id)?.track[..]));
    reference_among(tracks, center, |other| model.poses[other.index()].as_ref().map(|pose| *pose.center()))
}

/// The image that these tracks of points show most and that does not stand at `center`; `None` where they show it too
/// little.
pub(crate) fn reference_among<'t>(
    tracks: impl Iterator<Item = &'t [Observation]>,
    center: &Vector3<f64>,
    center_of: impl Fn(ImageId) -> Option<Vector3<f64>>,
) -> Option<ImageId> {
    let mut shared: BTreeMap<ImageId, usize> = BTreeMap::new();
    for seen in tracks.flatten() {
        *shared.entry(seen.image).or_default() += 1;
    }
    let is_elsewhere = |other: ImageId| center_of(other).is_some_and(|at| at != *center);
    let (_, std::cmp::Reverse(most)) = (shared.into_iter())
        .filter(|&(other, count)| count >= MIN_REFERENCE_POINTS && is_elsewhere(other))
        .map(|(other, count)| (count, std::cmp::Reverse(other)))
        .max()?;
    Some(most)
}

/// The points that an image sees, from its centre in the axes of the world.
pub(super) fn known_points(model: &Model<'_>, image: ImageId, center: &Vector3<f64>) -> Vec<SeenPoint> {
    let seen = |(_, id)| {
        let point = model.point(id)?;
        let rays: Vec<WorldRay> = point.track.iter().filter_map(|&seen| model.world_ray(seen)).collect();
        SeenPoint::new(center, &point.position, &rays)
    };
    model.observations_of(image).into_iter().filter_map(seen).collect()
}

/// Two images, the second at a baseline of length one from the first.
pub(super) struct Pair<'m, 'a> {
    pub model: &'m Model<'a>,
    pub image: ImageId,
    pub other: ImageId,
    pub image_from_other: Rigid,
    /// Matches that agree with it, of the other image with this one.
    pub matches: Vec<Match>,
}

impl<'m, 'a> Pair<'m, 'a> {
    /// The pair with more matches, and its geometry estimated from them.
    ///
    /// Where nearly all verified matches lie on one far wall, they fit baselines of many directions (off by 10–30° on
    /// rendered street corners); what would tell them apart was refused by the ratio test over the whole image.
    fn new(
        model: &'m Model<'a>,
        image: ImageId,
        other: ImageId,
        (image_from_other, verified): (&Rigid, &[Match]),
        seed: u64,
    ) -> Self {
        let mut pair = Self { model, image, other, image_from_other: *image_from_other, matches: Vec::new() };
        for (round, max_angle_rad) in BANDS_RAD.into_iter().enumerate() {
            pair.seek(max_angle_rad, verified);
            let matches = std::mem::take(&mut pair.matches);
            let [first, second] = pair.rays(&matches);
            let seed = seed.wrapping_add(round as u64);
            let estimate = estimate_relative_pose(&RANSAC, &first.0, &second.0, &first.1, &second.1, seed);
            let Some(estimate) = estimate else { break };
            pair.image_from_other = estimate.second_from_first;
            pair.matches = estimate.inliers.iter().map(|&at| matches[at as usize]).collect();
        }
        pair.matches.dedup_by_key(|found| found.first);
        pair
    }

    /// Takes the verified matches and those in a band about the epipolar circles.
    pub fn seek(&mut self, max_angle_rad: f64, verified: &[Match]) {
        let guide = GuidedParams { max_angle_rad, ..GuidedParams::default() };
        let essential = essential_from_pose(&self.image_from_other);
        let features = |image: ImageId| {
            (self.model.input.images[image.index()].features, &self.model.rays[image.index()])
        };
        self.matches = match_guided(&guide, features(self.other), features(self.image), &essential);
        self.matches.extend_from_slice(verified);
        self.matches.sort_unstable();
        self.matches.dedup();
    }

    /// Bearings and their standard deviations of both sides of matches.
    pub fn rays(&self, matches: &[Match]) -> [(Vec<Vector3<f64>>, Vec<f64>); 2] {
        let side = |image: ImageId, feature: fn(&Match) -> u32| {
            let rays = &self.model.rays[image.index()];
            let ray = |found: &Match| {
                (rays.bearings[feature(found) as usize], rays.sigmas[feature(found) as usize])
            };
            matches.iter().map(ray).unzip()
        };
        [side(self.other, |found| found.first), side(self.image, |found| found.second)]
    }

    /// Pose of the first image.
    pub fn world_from_other(&self) -> Option<Rigid> {
        Some(self.model.poses[self.other.index()].as_ref()?.world_from_camera)
    }

    /// What both see, with the place of each match in the list, at this relative pose.
    pub fn points(&self, image_from_other: &Rigid) -> Vec<(usize, SeenPoint)> {
        let numbered = self.matches.iter().enumerate();
        numbered.filter_map(|(at, found)| Some((at, self.point(image_from_other, *found)?))).collect()
    }

    fn point(&self, image_from_other: &Rigid, found: Match) -> Option<SeenPoint> {
        let world_from_other = self.world_from_other()?;
        let first = self.model.world_ray(Observation { image: self.other, feature: found.first })?;
        let rays = &self.model.rays[self.image.index()];
        let (bearing, sigma) = (rays.bearings[found.second as usize], rays.sigmas[found.second as usize]);
        let world_from_image = world_from_other * image_from_other.inverse();
        let second = sigma.is_finite().then(|| WorldRay::new(&world_from_image, &bearing, sigma))?;
        let position = triangulate(&[first, second])?;
        let fits = |ray: &WorldRay| ray.angular_error(&position) <= RANSAC.max_error_sigma * ray.sigma;
        let point = SeenPoint::new(&first.origin, &position, &[first, second])?;
        (fits(&first) && fits(&second)).then_some(point)
    }

    /// Standard deviation of the mean of these votes that the noise of the matches makes, by their own depths and by
    /// the pair's geometry: the delete-group jackknife.
    fn deviation(&self, agreeing: &[Vote]) -> Option<f64> {
        let [first, second] = self.rays(&self.matches);
        let mut means = Vec::new();
        for group in 0..GROUPS {
            let kept: Vec<u32> =
                (0..self.matches.len()).filter(|at| at % GROUPS != group).map(|at| at as u32).collect();
            let without = refine_relative_pose(
                &RANSAC,
                &first.0,
                &second.0,
                &first.1,
                &second.1,
                &kept,
                &self.image_from_other,
            );
            let (mut sum, mut weights) = (0.0, 0.0);
            for vote in agreeing.iter().filter(|vote| vote.found % GROUPS != group) {
                if let Some(point) = self.point(&without, self.matches[vote.found]) {
                    let weight = vote.sigma.powi(-2);
                    sum += weight * (vote.plane_depth - point.position.norm().ln());
                    weights += weight;
                }
            }
            means.push(sum / weights);
        }
        let middle = means.iter().sum::<f64>() / GROUPS as f64;
        let squares: f64 = means.iter().map(|mean| (mean - middle).powi(2)).sum();
        let deviation = ((GROUPS - 1) as f64 / GROUPS as f64 * squares).sqrt();
        deviation.is_finite().then_some(deviation)
    }
}

/// Half widths of the bands about the epipolar circles in which matches are sought, one after the other.
pub(super) const BANDS_RAD: [f64; 4] = [0.1, 0.02, 0.004, 0.004];
/// How a pair's geometry is estimated from them.
///
/// A sample from one wall alone has the support of that wall, so drawing does not end with the first that has much.
const RANSAC: RansacParams = RansacParams {
    max_error_sigma: 4.0,
    min_iterations: 1000,
    max_iterations: 4000,
    confidence: 0.9999,
    min_inliers: 30,
};
/// Groups of matches of which each is left out once.
const GROUPS: usize = 8;
/// Standard deviation of the logarithm of a point's depth.
pub(super) fn depth_sigma(point: &SeenPoint) -> f64 {
    let direction = point.position.normalize();
    direction.dot(&(point.covariance * direction)).max(0.0).sqrt() / point.position.norm()
}

/// Where a direction meets the continuation of a plane.
pub(super) struct Met {
    /// The plane, by its place in the list.
    pub plane: usize,
    pub depth: f64,
    /// How far the plane is to go on, in its distances from the image.
    pub gap: f64,
    /// What the plane's own noise leaves open there.
    pub sigma: f64,
}

/// What the first image of a pair knows: points, and planes among them.
pub(super) struct Surroundings<'a> {
    known: &'a [SeenPoint],
    pub planes: &'a [Plane],
    /// Points on planes (others may be mere chance), and their directions.
    sound: Vec<&'a SeenPoint>,
    directions: Vec<Vector3<f64>>,
}

impl<'a> Surroundings<'a> {
    fn new(known: &'a [SeenPoint], planes: &'a [Plane]) -> Self {
        let sound: Vec<&SeenPoint> =
            planes.iter().flat_map(|plane| &plane.members).map(|&member| &known[member]).collect();
        let directions = sound.iter().map(|point| point.position.normalize()).collect();
        Self { known, planes, sound, directions }
    }

    /// The plane, of those that may be meant, that a unit direction meets nearest to its points and that is not seen
    /// through there.
    pub fn meets(&self, direction: &Vector3<f64>, may_be: impl Fn(&Plane) -> bool) -> Option<Met> {
        let mut near: Vec<(f64, usize)> =
            self.directions.iter().enumerate().map(|(at, known)| (-known.dot(direction), at)).collect();
        let count = WITNESSES.min(near.len());
        near.select_nth_unstable_by(count.checked_sub(1)?, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let witnesses: Vec<&SeenPoint> = near[..count].iter().map(|&(_, at)| self.sound[at]).collect();
        let met = |(number, plane): (usize, &Plane)| {
            let depth = plane.depth_along(direction)?;
            let seen_through = witnesses.iter().filter(|witness| plane.is_before(witness)).count();
            if !may_be(plane) || 2 * seen_through > witnesses.len() {
                return None;
            }
            let place = direction * depth;
            let gap = gap(self.known, plane, &place)?;
            (gap <= MAX_GAP).then(|| Met { plane: number, depth, gap, sigma: plane.relative_sigma(&place) })
        };
        self.planes.iter().enumerate().filter_map(met).reduce(|a, b| if b.gap < a.gap { b } else { a })
    }
}

/// The votes of what a pair sees for planes among what its first image knows.
pub(super) fn votes(scene: &Surroundings<'_>, points: &[(usize, SeenPoint)], seed: u64) -> Vec<Vote> {
    let (matches, points): (Vec<usize>, Vec<SeenPoint>) =
        points.iter().filter(|(_, point)| depth_sigma(point) <= MAX_VOTE_SIGMA).copied().unzip();
    let of_pair = find_planes(&points, MIN_PLANE_POINTS, seed ^ 1);
    let mut own: Vec<Option<&Plane>> = vec![None; points.len()];
    for plane in &of_pair {
        for &member in &plane.members {
            own[member] = Some(plane);
        }
    }
    let vote = |((found, point), own): ((usize, &SeenPoint), Option<&Plane>)| {
        let goes_on = |plane: &Plane| own.is_none_or(|own| plane.may_go_on(&own.normal, own.normal_sigma()));
        let met = scene.meets(&point.position.normalize(), goes_on)?;
        Some(Vote {
            found,
            plane_depth: met.depth.ln(),
            depth: point.position.norm().ln(),
            sigma: depth_sigma(point).hypot(RELIEF),
            gap: met.gap,
            plane_sigma: met.sigma,
        })
    };
    matches.into_iter().zip(&points).zip(own).filter_map(vote).collect()
}

impl Plane {
    /// Whether what has this normal, known to a standard deviation in radians, may be its continuation.
    pub(super) fn may_go_on(&self, normal: &Vector3<f64>, sigma: f64) -> bool {
        self.normal.dot(normal).abs().min(1.0).acos() <= MAX_NORMAL_RAD + 2.0 * sigma
    }

    /// Whether a point that the image sees lies behind this plane.
    fn is_before(&self, point: &SeenPoint) -> bool {
        let behind = self.normal.dot(&point.position) - self.distance;
        let sigma = self.normal.dot(&(point.covariance * self.normal)).max(0.0).sqrt();
        behind > (BEHIND * self.distance).max(3.0 * sigma)
    }
}

/// How far a place of a plane is from the plane's points, in distances of the plane.
fn gap(known: &[SeenPoint], plane: &Plane, place: &Vector3<f64>) -> Option<f64> {
    let mut gaps: Vec<f64> =
        plane.members.iter().map(|&member| (known[member].position - place).norm()).collect();
    let at = GAP_POINT.min(gaps.len()).checked_sub(1)?;
    Some(*gaps.select_nth_unstable_by(at, f64::total_cmp).1 / plane.distance)
}

/// The length that votes agree on; `None` unless one length stands out.
pub(super) fn length_of(votes: &[Vote], seed: u64) -> Option<Peaked> {
    let opinions: Vec<Opinion> = votes.iter().map(Vote::opinion).collect();
    let (best, second) = peaks(&opinions)?;
    let chance = by_chance(votes, seed);
    let enough = best.votes >= MIN_VOTES && best.log_likelihood >= MIN_LOG_LIKELIHOOD;
    if !enough || best.log_likelihood < LEAD * second || best.log_likelihood < CHANCE_LEAD * chance {
        return None;
    }
    let agreeing: Vec<Vote> =
        votes.iter().filter(|vote| vote.opinion().agrees(best.length)).copied().collect();
    Some(Peaked { length: best.length, log_likelihood: best.log_likelihood, agreeing })
}

/// The best likelihood of any length when the depths of the pair are dealt out anew among the votes.
fn by_chance(votes: &[Vote], seed: u64) -> f64 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 2);
    let mut dealt: Vec<usize> = (0..votes.len()).collect();
    let mut most = 0.0_f64;
    for _ in 0..SHUFFLES {
        dealt.shuffle(&mut rng);
        let opinion = |(vote, &other): (&Vote, &usize)| Opinion {
            length: vote.plane_depth - votes[other].depth,
            sigma: vote.sigma.max(votes[other].sigma),
        };
        let opinions: Vec<Opinion> = votes.iter().zip(&dealt).map(opinion).collect();
        most = most.max(peaks(&opinions).map_or(0.0, |(best, _)| best.log_likelihood));
    }
    most
}

/// Standard deviation of the logarithm of a length by what these votes rest on.
///
/// Votes for one plane share its error, so their number does not count. What counts is what the noise of the plane's
/// points leaves open at the votes, and how far the wall must go on: beyond its points it may have a step.
fn stated(agreeing: &[Vote]) -> Option<f64> {
    of_planes(
        agreeing.iter().map(|vote| vote.gap).collect(),
        agreeing.iter().map(|vote| vote.plane_sigma).collect(),
    )
}

/// The same of how far planes are to go on, and of what their own noise leaves open.
pub(super) fn of_planes(mut gaps: Vec<f64>, mut of_planes: Vec<f64>) -> Option<f64> {
    let at = INSIDE.min(gaps.len()).checked_sub(1)?;
    let gap = *gaps.select_nth_unstable_by(at, f64::total_cmp).1;
    let [inside, beyond] = STEP_DEVIATION;
    let step = if gap <= STEP_GAP { inside } else { beyond * gap.hypot(1.0) };
    let middle = of_planes.len() / 2;
    let of_plane = *of_planes.select_nth_unstable_by(middle, f64::total_cmp).1;
    let deviation = step.hypot(of_plane);
    deviation.is_finite().then_some(deviation)
}
