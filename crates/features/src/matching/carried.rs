//! Matches of what panoramas show that moves with the camera: a tripod, a car's roof, a rider's helmet, a logo over the nadir.
//!
//! It stands at the same place below every camera, so that its matches agree with all others of their kind that nothing but the
//! heading changed between two panoramas, and a logo that covers the nadir is half of all matches of a hall with bare walls. Ground
//! moves: 25° below the horizon it is no farther than 2.2 times the camera's height, and a step of a hundredth of
//! that height moves it by more than [`SAME`].

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

/// Where a match lies in two level panoramas.
#[derive(Debug, Clone, Copy)]
struct Place {
    /// The higher of the two elevations.
    highest: f32,
    /// By how much they differ.
    risen: f32,
    /// How far the second is turned from the first, from 0 to a full turn.
    turned: f32,
}

impl Place {
    fn of([first, second]: [&Keypoint; 2], [of_first, of_second]: [Elevations; 2]) -> Self {
        let [from, to] = [of_first.at(first.y), of_second.at(second.y)];
        let azimuth = |keypoint: &Keypoint, elevations: Elevations| keypoint.x * elevations.per_row();
        let turned = (azimuth(second, of_second) - azimuth(first, of_first)).rem_euclid(TAU);
        Self { highest: from.max(to), risen: (from - to).abs(), turned }
    }

    /// Whether nothing but this heading is between the two.
    fn keeps(&self, heading: f32) -> bool {
        self.risen <= SAME && self.turned_beyond(heading).abs() * self.highest.cos() <= SAME
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
    let Some(heading) = common_heading(&low) else { return matches };
    let kept_of = |some: &[&Place]| some.iter().filter(|place| place.keeps(heading)).count();
    let is_one_place = || !others.is_empty() && kept_of(&others) as f64 >= ONE_PLACE * others.len() as f64;
    if kept_of(&low) < FEWEST || is_one_place() {
        return matches;
    }
    let is_carried = |place: &Place| is_low(place) && place.keeps(heading);
    matches.into_iter().zip(&places).filter(|(_, place)| !is_carried(place)).map(|(m, _)| m).collect()
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
    let middle = (best as f32 + 0.5) / HEADINGS as f32 * TAU;
    let near = level().filter(|place| around(best).contains(&bin(place)));
    let off: f32 = near.map(|place| place.turned_beyond(middle)).sum();
    Some((middle + off / count as f32).rem_euclid(TAU))
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
