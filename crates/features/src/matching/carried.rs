//! Matches of what panoramas show that moves with the camera: a tripod, a car's roof, a rider's helmet, a logo over the nadir.
//!
//! It stands at the same place below every camera, so that its matches agree with all others of their kind that nothing but the
//! heading changed between two panoramas, and a logo that covers the nadir is half of all matches of a hall with bare walls. Ground
//! moves: 25° below the horizon it is no farther than 2.2 times the camera's height, and a step of a hundredth of
//! that height moves it by more than [`SAME`].
//!
//! A logo may be drawn larger in one panorama than in another, as if seen from another height: then it is as many times as far
//! from the nadir in all directions. Whatever the turn and the scale, one place of the ground at most agrees with both.

use std::collections::BTreeMap;
use std::f32::consts::{PI, TAU};

use super::{Elevations, Match};
use crate::{ImageFeatures, Keypoint};

/// Elevation below which things that a camera carries are sought.
const BELOW: f32 = -25.0 * PI / 180.0;
/// How far a thing may move in the panorama, beside what all others of its kind do.
const SAME: f32 = 0.5 * PI / 180.0;
/// Fewest matches that show a thing that is carried along. Of the ground, matches that one heading explains are few: they lie
/// half way between two cameras, and each is turned by another angle.
const FEWEST: usize = 8;
/// Share of all other matches that one heading explains, too, where both panoramas were taken at one place.
const ONE_PLACE: f64 = 0.5;
/// Headings that are told apart.
const HEADINGS: usize = 720;
/// Elevation of what is taken for the nadir.
const AT_NADIR: f32 = -89.9 * PI / 180.0;
/// Logarithms of scales that are told apart.
const SCALE_STEP: f32 = 0.02;
/// Parts of the full turn, each of which has to show a thing of another scale: what is below the camera lies on all sides.
const SIDES: usize = 3;
/// Fewest matches on each side.
const FEWEST_A_SIDE: usize = 2;

/// Where a match lies in two level panoramas.
#[derive(Debug, Clone, Copy)]
struct Place {
    /// Its elevations.
    elevations: [f32; 2],
    /// The higher of the two.
    highest: f32,
    /// By how much they differ.
    risen: f32,
    /// Its azimuth in the first, from 0 to a full turn.
    azimuth: f32,
    /// How far the second is turned from the first, from 0 to a full turn.
    turned: f32,
}

impl Place {
    fn of([first, second]: [&Keypoint; 2], [of_first, of_second]: [Elevations; 2]) -> Self {
        let [from, to] = [of_first.at(first.y), of_second.at(second.y)];
        let azimuth = |keypoint: &Keypoint, elevations: Elevations| keypoint.x * elevations.per_column();
        let azimuth_in_first = azimuth(first, of_first).rem_euclid(TAU);
        let turned = (azimuth(second, of_second) - azimuth(first, of_first)).rem_euclid(TAU);
        let (highest, risen) = (from.max(to), (from - to).abs());
        Self { elevations: [from, to], highest, risen, azimuth: azimuth_in_first, turned }
    }

    /// Whether nothing but this heading is between the two.
    fn keeps(&self, heading: f32) -> bool {
        self.risen <= SAME && self.is_turned_by(heading)
    }

    fn is_turned_by(&self, heading: f32) -> bool {
        self.turned_beyond(heading).abs() * self.highest.cos() <= SAME
    }

    /// The logarithm of how many times as far from the nadir the second shows it on the ground, which is level.
    fn log_scale(&self) -> f32 {
        // The nadir itself is as far from it at any scale.
        let log_slope = |elevation: f32| (-elevation.max(AT_NADIR).tan()).ln();
        log_slope(self.elevations[0]) - log_slope(self.elevations[1])
    }

    /// Whether nothing but this heading and this scale, given by its logarithm, is between the two.
    fn keeps_scaled(&self, [heading, log_scale]: [f32; 2]) -> bool {
        let scaled = (self.elevations[0].max(AT_NADIR).tan() * (-log_scale).exp()).atan();
        (scaled - self.elevations[1]).abs() <= SAME && self.is_turned_by(heading)
    }

    /// How much farther the second is turned than by a heading, from minus to plus half a turn.
    fn turned_beyond(&self, heading: f32) -> f32 {
        (self.turned - heading + PI).rem_euclid(TAU) - PI
    }
}

/// The matches without those of what the cameras carry.
pub(super) fn without_carried(
    matches: Vec<Match>,
    elevations: [Elevations; 2],
    first: &ImageFeatures,
    second: &ImageFeatures,
) -> Vec<Match> {
    let place = |m: &Match| {
        let keypoints = [&first.keypoints[m.first as usize], &second.keypoints[m.second as usize]];
        Place::of(keypoints, elevations)
    };
    let places: Vec<Place> = matches.iter().map(place).collect();
    let is_low = |place: &Place| place.highest < BELOW;
    let (low, others): (Vec<&Place>, Vec<&Place>) = places.iter().partition(|place| is_low(place));
    let is_most = |some: usize, of: usize| of > 0 && some as f64 >= ONE_PLACE * of as f64;
    let without = |is_carried: &dyn Fn(&Place) -> bool| {
        let stays = |place: &Place| !(is_low(place) && is_carried(place));
        matches.iter().zip(&places).filter(|(_, place)| stays(place)).map(|(m, _)| *m).collect()
    };
    if let Some(heading) = common_heading(&low) {
        let kept_of = |some: &[&Place]| some.iter().filter(|place| place.keeps(heading)).count();
        if kept_of(&low) >= FEWEST {
            let is_one_place = is_most(kept_of(&others), others.len());
            return if is_one_place { matches } else { without(&|place| place.keeps(heading)) };
        }
    }
    if let Some(scaled) = common_scale(&low) {
        // From two heights over one place all that is near rises or sinks.
        let kept = others.iter().filter(|place| place.is_turned_by(scaled[0])).count();
        if !is_most(kept, others.len()) {
            return without(&|place| place.keeps_scaled(scaled));
        }
    }
    matches
}

/// The heading, and the logarithm of the scale, that matches on all sides of the nadir have in common.
fn common_scale(places: &[&Place]) -> Option<[f32; 2]> {
    let bin = |place: &Place| {
        let heading = (place.turned / TAU * HEADINGS as f32) as i32 % HEADINGS as i32;
        (heading, (place.log_scale() / SCALE_STEP).floor() as i32)
    };
    let mut counts = BTreeMap::<(i32, i32), usize>::new();
    for place in places {
        *counts.entry(bin(place)).or_default() += 1;
    }
    let around = |(heading, scale): (i32, i32)| {
        let headings = [-1, 0, 1].map(|off| (heading + off).rem_euclid(HEADINGS as i32));
        headings.into_iter().flat_map(move |heading| [-1, 0, 1].map(|off| (heading, scale + off)))
    };
    let count = |at| around(at).filter_map(|at| counts.get(&at)).sum::<usize>();
    let best = counts.keys().copied().max_by_key(|&at| (count(at), std::cmp::Reverse(at)))?;
    let near: Vec<&&Place> = places.iter().filter(|place| around(best).any(|at| at == bin(place))).collect();
    let heading = mean_heading(best.0 as usize, near.iter().map(|place| **place), near.len());
    let log_scale = near.iter().map(|place| place.log_scale()).sum::<f32>() / near.len() as f32;
    let found = [heading, log_scale];
    let mut sides = [0; SIDES];
    for place in places.iter().filter(|place| place.keeps_scaled(found)) {
        sides[(place.azimuth / TAU * SIDES as f32) as usize % SIDES] += 1;
    }
    let is_thing = sides.iter().sum::<usize>() >= FEWEST && sides.iter().all(|&count| count >= FEWEST_A_SIDE);
    is_thing.then_some(found)
}

/// The heading between two panoramas that most of these matches have in common.
fn common_heading(places: &[&Place]) -> Option<f32> {
    let mut counts = [0_u32; HEADINGS];
    let bin = |place: &Place| (place.turned / TAU * HEADINGS as f32) as usize % HEADINGS;
    let level = || places.iter().filter(|place| place.risen <= SAME);
    for place in level() {
        counts[bin(place)] += 1;
    }
    let around = |at: usize| [at + HEADINGS - 1, at, at + 1].map(|at| at % HEADINGS);
    let (best, count) = (0..HEADINGS)
        .map(|at| (at, around(at).map(|at| counts[at]).iter().sum::<u32>()))
        .max_by_key(|&(at, count)| (count, std::cmp::Reverse(at)))?;
    if count == 0 {
        return None;
    }
    let near = level().filter(|place| around(best).contains(&bin(place)));
    Some(mean_heading(best, near.copied(), count as usize))
}

/// The heading of places about one of the headings that are told apart.
fn mean_heading<'p>(bin: usize, near: impl Iterator<Item = &'p Place>, count: usize) -> f32 {
    let middle = (bin as f32 + 0.5) / HEADINGS as f32 * TAU;
    let off: f32 = near.map(|place| place.turned_beyond(middle)).sum();
    (middle + off / count as f32).rem_euclid(TAU)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Posture};

    const WIDTH: u32 = 2000;

    fn elevations() -> [Elevations; 2] {
        let camera = Camera::equirectangular(WIDTH, WIDTH / 2);
        let Posture::Level(elevations) = Posture::of([&camera; 2]) else { panic!("a panorama is level") };
        elevations
    }

    /// What a camera that heads so far from north shows of a thing to the east, north and up of it.
    fn shown(heading: f32, thing: [f32; 3]) -> Keypoint {
        let [east, north, up] = thing;
        let azimuth = (east.atan2(north) - heading).rem_euclid(TAU);
        let elevation = up.atan2(east.hypot(north));
        let per_px = TAU / WIDTH as f32;
        Keypoint {
            x: azimuth / per_px,
            y: (PI / 2.0 - elevation) / per_px,
            size: 5.0,
            orientation: 0.0,
            noise_px: 1.0,
        }
    }

    fn features(keypoints: Vec<Keypoint>) -> ImageFeatures {
        ImageFeatures { keypoints, ..ImageFeatures::default() }
    }

    /// A pattern of things about a place.
    fn things(count: usize, [radius, up]: [f32; 2]) -> Vec<[f32; 3]> {
        let at = |k: usize| {
            let (turn, out) = (k as f32 * 2.4, radius * (0.3 + 0.7 * k as f32 / count as f32));
            [out * turn.sin(), out * turn.cos(), up]
        };
        (0..count).map(at).collect()
    }

    /// How many matches of ground, of walls and of what is carried stay, where a camera goes so far north and turns.
    fn stay(step: f32, turn: f32, counts: [usize; 3]) -> [usize; 3] {
        let [ground, walls] = [things(counts[0], [4.0, -1.6]), things(counts[1], [9.0, 1.0])];
        let carried = things(counts[2], [0.6, -1.5]);
        let from = ground.iter().chain(&walls).map(|&thing| shown(0.0, thing));
        let to = ground.iter().chain(&walls).map(|&[east, north, up]| shown(turn, [east, north - step, up]));
        // A tripod is turned with the camera.
        let rig: Vec<Keypoint> = carried.iter().map(|&thing| shown(0.3, thing)).collect();
        let first = features(from.chain(rig.iter().copied()).collect());
        let second = features(to.chain(rig.iter().copied()).collect());
        let all = (0..first.keypoints.len() as u32).map(|at| Match { first: at, second: at }).collect();
        let kept = without_carried(all, elevations(), &first, &second);
        let bounds = [counts[0], counts[0] + counts[1]];
        let of = |range: std::ops::Range<usize>| {
            kept.iter().filter(|m| range.contains(&(m.first as usize))).count()
        };
        [of(0..bounds[0]), of(bounds[0]..bounds[1]), of(bounds[1]..usize::MAX)]
    }

    #[test]
    fn what_the_camera_carries_is_left_out_and_ground_and_walls_stay() {
        for (step, turn) in [(0.3, 0.0), (2.0, 0.0), (2.0, 1.9), (6.0, 4.0)] {
            let [ground, walls, carried] = stay(step, turn, [100, 60, 40]);
            assert!(ground >= 98 && walls == 60, "{ground} of 100, {walls} of 60 at {step} m");
            assert_eq!(carried, 0);
        }
        assert_eq!(stay(2.0, 1.0, [0, 0, 40]), [0, 0, 0]);
    }

    #[test]
    fn a_logo_that_is_drawn_larger_in_one_panorama_is_left_out() {
        let [ground, walls] = [things(100, [4.0, -1.6]), things(60, [9.0, 1.0])];
        let logo = |scale: f32| things(40, [0.6 * scale, -1.0]).into_iter().map(|thing| shown(0.3, thing));
        let rest = |step: f32| {
            let all = ground.iter().chain(&walls);
            all.map(move |&[east, north, up]| shown(0.2 * step, [east, north - step, up]))
        };
        for scale in [0.6, 0.865, 1.3] {
            let (first, second): (Vec<_>, Vec<_>) =
                (rest(0.0).chain(logo(1.0)).collect(), rest(2.0).chain(logo(scale)).collect());
            let all = (0..first.len() as u32).map(|at| Match { first: at, second: at }).collect();
            let kept = without_carried(all, elevations(), &features(first), &features(second));
            let of_logo = kept.iter().filter(|m| m.first >= 160).count();
            assert!(of_logo == 0 && kept.len() >= 157, "{of_logo} of the logo in {} at {scale}", kept.len());
        }
    }

    #[test]
    fn panoramas_at_two_heights_over_one_place_keep_all() {
        let all: Vec<[f32; 3]> = things(100, [4.0, -1.6]).into_iter().chain(things(60, [9.0, 1.0])).collect();
        let seen =
            |lift: f32| all.iter().map(move |&[east, north, up]| shown(lift, [east, north, up - lift]));
        let matches: Vec<Match> = (0..160).map(|at| Match { first: at, second: at }).collect();
        let [first, second] = [0.0, 0.5].map(|lift| features(seen(lift).collect()));
        assert_eq!(without_carried(matches, elevations(), &first, &second).len(), 160);
    }

    #[test]
    fn panoramas_of_one_place_keep_all() {
        assert_eq!(stay(0.0, 0.0, [100, 60, 40]), [100, 60, 40]);
        assert_eq!(stay(0.0, 0.0, [100, 60, 0]), [100, 60, 0]);
    }

    #[test]
    fn ground_alone_is_not_taken_for_something_carried() {
        for (step, turn) in [(0.3, 0.0), (1.0, 2.5), (3.0, 0.5)] {
            assert_eq!(stay(step, turn, [300, 0, 0]), [300, 0, 0], "{step} m");
        }
    }
}
