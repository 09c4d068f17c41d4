mod alike;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod carried;
mod carried_cells;
mod guided;
mod kernel;
#[cfg(target_arch = "x86_64")]
mod tiles;

use std::collections::BTreeMap;
use std::f32::consts::{PI, TAU};
use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::{Camera, DESCRIPTOR_LEN, DESCRIPTOR_NORM, FeatureError, ImageFeatures, Keypoint};
pub use carried_cells::{CarriedCells, ComparedPhoto, without_carried_cells};
pub use guided::{GuidedParams, match_guided, match_guided_among};
pub use kernel::{DescriptorBlock, TwoNearest, offer_nearer, squared_distance, squared_norm, two_nearest};

/// A putative or verified match: keypoint `first` of one image shows what keypoint `second` of another shows.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    bytemuck::Pod,
    bytemuck::Zeroable,
)]
#[repr(C)]
pub struct Match {
    /// Keypoint index in the first image.
    pub first: u32,
    /// Keypoint index in the second image.
    pub second: u32,
}

impl Match {
    /// The same match with the two images exchanged.
    #[must_use]
    pub fn swapped(self) -> Self {
        Self { first: self.second, second: self.first }
    }
}

/// How to match two images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MatchParams {
    /// Largest ratio of the nearest to the second-nearest descriptor distance, in (0, 1]; lower is stricter.
    pub ratio: f64,
    /// Whether each keypoint must also be the other's nearest.
    pub mutual: bool,
    /// Largest distance of two descriptors as unit vectors, in (0, √2]: √2 is orthogonal, so no limit.
    pub max_distance: f64,
    /// So many of the strongest bright and as many of the strongest dark keypoints of each image are matched first; 0
    /// matches all at once. Images with less than twice as many are never screened.
    pub screen_features: usize,
    /// Least matches among those for which all keypoints are matched; with fewer, those matches are the result.
    pub screen_matches: usize,
    /// With fewer matches than this between two images themselves, their simulated views are matched too. Matches of
    /// simulated views are less exact, so they are for pairs that need them.
    pub simulate_below: usize,
}

impl MatchParams {
    /// Changes whenever the same parameters and features give other matches.
    ///
    /// 1: exact two nearest neighbours, ratio and mutual test.
    /// 2: bright and dark spots apart, screened by the strongest. 3: simulated views. 4: which do not count among those
    /// that are worth screening. 5: without the last bit of descriptors; keypoints of level images that are turned alike.
    /// 6: small images are taken for level by their strongest keypoints, too. 7: keypoints of level images that can show the
    /// same by height and size, too. 9: these in simulated views as well. 10: without logos below of another scale. 11: across the seam of
    /// panoramas that are not quite twice as wide as high, too.
    pub const VERSION: u32 = 11;

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`FeatureError::InvalidParameter`] with the value at fault.
    pub fn validate(&self) -> Result<(), FeatureError> {
        crate::error::check("ratio", self.ratio, "in (0, 1]", self.ratio > 0.0 && self.ratio <= 1.0)?;
        let in_range = self.max_distance > 0.0 && self.max_distance <= std::f64::consts::SQRT_2 + 1e-9;
        crate::error::check("max_distance", self.max_distance, "in (0, sqrt 2]", in_range)
    }

    /// The ratio and distance tests on squared distances of [halved] descriptors.
    fn accepts(&self, nearest: &TwoNearest) -> bool {
        passes(nearest, self.ratio, self.max_distance * f64::from(DESCRIPTOR_NORM) / 2.0)
    }
}

impl Default for MatchParams {
    fn default() -> Self {
        Self {
            ratio: 0.8,
            mutual: true,
            max_distance: 1.0,
            screen_features: 1024,
            screen_matches: 5,
            simulate_below: 300,
        }
    }
}

/// The ratio test, and that on the distance itself, in the units of `nearest`.
fn passes(nearest: &TwoNearest, ratio: f64, max_distance: f64) -> bool {
    let distance2 = f64::from(nearest.distance2);
    nearest.index != TwoNearest::NO_INDEX
        && distance2 <= max_distance * max_distance
        // A lone candidate has no second to be confused with.
        && (nearest.second_distance2 == TwoNearest::NO_DISTANCE
            || distance2 < ratio * ratio * f64::from(nearest.second_distance2))
}

/// How two images are held.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Posture {
    /// Their columns are vertical, as those of street-view panoramas are: what stands upright in one does in the other,
    /// and what is above the camera's height in one is in the other. (Of each image, first and second.)
    Level([Elevations; 2]),
    /// Anyhow.
    Any,
}

impl Posture {
    /// Level where both are panoramas.
    pub fn of(cameras: [&Camera; 2]) -> Self {
        match cameras.map(Elevations::of) {
            [Some(first), Some(second)] => Self::Level([first, second]),
            _ => Self::Any,
        }
    }
}

/// Which elevation each row of a panorama shows, and which part of the turn a column.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Elevations {
    /// Rows of the whole panorama, from pole to pole.
    rows: f32,
    /// How many of them are cropped above the image.
    top: f32,
    /// Columns of the whole turn, about twice as many as rows.
    columns: f32,
}

impl Elevations {
    fn of(camera: &Camera) -> Option<Self> {
        let (rows, top) = camera.half_turn_px()?;
        Some(Self { rows: rows as f32, top: top as f32, columns: camera.full_turn_px()? as f32 })
    }

    /// The elevation that a row shows, in radians above the horizon.
    fn at(self, row: f32) -> f32 {
        (0.5 - (row + self.top) / self.rows) * PI
    }

    /// Radians that a row spans.
    fn per_row(self) -> f32 {
        PI / self.rows
    }

    /// Radians that a column spans on the horizon.
    fn per_column(self) -> f32 {
        TAU / self.columns
    }
}

/// Matches two images by exact two-nearest-neighbour search, ratio test and mutual test.
///
/// Spots brighter than their surround are compared with such spots only, darker ones with darker ones. Most pairs of a
/// large set show different places; they are recognized by their strongest keypoints, which then match no more than
/// by chance (some 10 of 2048), and spare nearly all of the work.
/// Distances are those of descriptors without the last bit of each byte, exact integers, and ties go to the lower index
/// (in level images to the first of those that are like each other), so the result is the same on every processor. With
/// `mutual` both images' keypoints must pass the ratio test. Single-threaded: callers work on many pairs in parallel.
/// Matches come in ascending order.
///
/// In level images what shows the same is turned alike, so keypoints are compared only with those turned by up to some
/// 45° from them, but all keypoints of the ground with each other, and all of ceilings. What is above one camera
/// is not below the other; and how large a thing looks, relative to the sine of its elevation, is the same in both,
/// so that keypoints up to 1.5 octaves apart in this are compared: a quarter of the work, and fewer to
/// be confused with. All that is so in simulated views, which are squeezed along the horizon or across it. Where the
/// strongest keypoints match otherwise the images are not level, and all are compared.
///
/// Simulated views are matched one by one, each with the other image itself, so that a keypoint does not compete in
/// the ratio test with its own likes of other views. Of matches that say the same (both ends within
/// 3 pixels) one stays, for they are one piece of evidence: the images' own before a simulated view's, then
/// the nearer.
///
/// Of level images those matches are left out that show what moves with the camera, as a tripod does or a logo over the nadir.
pub fn match_features(
    params: &MatchParams,
    posture: Posture,
    first: &ImageFeatures,
    second: &ImageFeatures,
) -> Vec<Match> {
    match_beside(params, posture, first, second, None)
}

/// What [`match_features`] finds of two images of which it found `own` without their simulated views.
pub fn match_simulated_views(
    params: &MatchParams,
    posture: Posture,
    first: &ImageFeatures,
    second: &ImageFeatures,
    own: &[Match],
) -> Vec<Match> {
    match_beside(params, posture, first, second, Some(own))
}

/// [`match_features`], with what the images' own keypoints match where that is known.
fn match_beside(
    params: &MatchParams,
    posture: Posture,
    first: &ImageFeatures,
    second: &ImageFeatures,
    known: Option<&[Match]>,
) -> Vec<Match> {
    let worth_screening = |features: &ImageFeatures| features.own_len() >= 8 * params.screen_features;
    let mut strongest = None;
    if params.screen_features > 0 && worth_screening(first) && worth_screening(second) {
        let found = match_strongest(params, params.screen_features, first, second);
        if found.len() < params.screen_matches {
            return found;
        }
        strongest = Some(found);
    }
    let level = level_of(params, posture, first, second, strongest);
    let of_parts = |a: Parts, b: Parts| match level {
        Some(elevations) => {
            let of_part =
                |(a, b)| alike::match_parts(params, (first, a, elevations[0]), (second, b, elevations[1]));
            a.into_iter().zip(b).flat_map(of_part).collect()
        }
        None => match_all(params, (first, a), (second, b)),
    };
    let own = || without_carried(of_parts(first.parts(), second.parts()), posture, first, second);
    let own = known.map_or_else(own, <[Match]>::to_vec);
    if own.len() >= params.simulate_below || (first.simulated.is_empty() && second.simulated.is_empty()) {
        return own;
    }
    without_carried(match_simulated(first, second, own, of_parts), posture, first, second)
}

/// Matches of two images without those of what moves with the camera.
pub fn without_carried(
    matches: Vec<Match>,
    posture: Posture,
    first: &ImageFeatures,
    second: &ImageFeatures,
) -> Vec<Match> {
    match posture {
        Posture::Level(elevations) => carried::without_carried(matches, elevations, first, second),
        Posture::Any => matches,
    }
}

/// The elevations of two images' rows where the images are level: told so, and not contradicted by their strongest keypoints,
/// whose matches are `strongest` if they are known.
fn level_of(
    params: &MatchParams,
    posture: Posture,
    first: &ImageFeatures,
    second: &ImageFeatures,
    strongest: Option<Vec<Match>>,
) -> Option<[Elevations; 2]> {
    let Posture::Level(elevations) = posture else { return None };
    let sample = strongest.unwrap_or_else(|| match_strongest(params, alike::SAMPLE, first, second));
    (!alike::contradict(&sample, elevations, first, second)).then_some(elevations)
}

/// Matches so many bright and so many dark keypoints of each image, the strongest.
fn match_strongest(
    params: &MatchParams,
    most: usize,
    first: &ImageFeatures,
    second: &ImageFeatures,
) -> Vec<Match> {
    let strongest = |features: &ImageFeatures| {
        features.parts().map(|part| part.start..part.end.min(part.start.saturating_add(most)))
    };
    match_all(params, (first, strongest(first)), (second, strongest(second)))
}

/// Bright and dark keypoints to match.
type Parts = [Range<usize>; 2];

/// Adds the matches of simulated views, each with the other image itself, to the images' own.
fn match_simulated(
    first: &ImageFeatures,
    second: &ImageFeatures,
    own: Vec<Match>,
    of_views: impl Fn(Parts, Parts) -> Vec<Match>,
) -> Vec<Match> {
    let mut simulated = Vec::new();
    simulated.extend(first.simulated_parts().flat_map(|a| of_views(a, second.parts())));
    simulated.extend(second.simulated_parts().flat_map(|b| of_views(first.parts(), b)));
    simulated.sort_by_cached_key(|m| {
        let (a, b) = (first.descriptor(m.first as usize), second.descriptor(m.second as usize));
        (squared_distance(a, b), *m)
    });
    let mut matches = distinct(first, second, own.into_iter().chain(simulated));
    matches.sort_unstable();
    matches
}

/// Ends of two matches that are nearer than this in both images are the same, in pixels.
const SAME_PLACE_PX: f32 = 3.0;

/// The first of each group of matches that say the same.
fn distinct(first: &ImageFeatures, second: &ImageFeatures, found: impl Iterator<Item = Match>) -> Vec<Match> {
    let cell = |x: f32, y: f32| ((x / SAME_PLACE_PX) as i32, (y / SAME_PLACE_PX) as i32);
    let ends = |m: &Match| (&first.keypoints[m.first as usize], &second.keypoints[m.second as usize]);
    let near = |a: &Keypoint, b: &Keypoint| (a.x - b.x).hypot(a.y - b.y) < SAME_PLACE_PX;
    let mut kept_in: BTreeMap<(i32, i32), Vec<Match>> = BTreeMap::new();
    let mut kept = Vec::new();
    for candidate in found {
        let (a, b) = ends(&candidate);
        let (column, row) = cell(a.x, a.y);
        let repeats = (column - 1..=column + 1).any(|column| {
            (row - 1..=row + 1).any(|row| {
                kept_in.get(&(column, row)).is_some_and(|others| {
                    others.iter().any(|other| {
                        let (c, d) = ends(other);
                        near(a, c) && near(b, d)
                    })
                })
            })
        });
        if !repeats {
            kept_in.entry((column, row)).or_default().push(candidate);
            kept.push(candidate);
        }
    }
    kept
}

/// Matches some bright and some dark keypoints of two images.
fn match_all(
    params: &MatchParams,
    (first, first_parts): (&ImageFeatures, Parts),
    (second, second_parts): (&ImageFeatures, Parts),
) -> Vec<Match> {
    // A spot brighter than its surround never shows what a darker one does, so half the products suffice.
    let mut matches = Vec::new();
    for (first_part, second_part) in first_parts.into_iter().zip(second_parts) {
        let found =
            match_parts(params, first.descriptors_of(&first_part), second.descriptors_of(&second_part));
        let (first, second) = (first_part.start as u32, second_part.start as u32);
        matches.extend(found.iter().map(|m| Match { first: m.first + first, second: m.second + second }));
    }
    matches
}

fn match_parts(params: &MatchParams, first: &[u8], second: &[u8]) -> Vec<Match> {
    if first.is_empty() || second.is_empty() {
        return Vec::new();
    }
    let [first, second] = [first, second].map(|part| halved(part).collect::<Vec<_>>());
    let (first, second) = (&first[..], &second[..]);
    if params.mutual {
        let (forward, backward) = kernel::two_nearest_both(first, second, kernel::All);
        mutual(params, &forward, &backward)
    } else {
        collect(&two_nearest(first, second), |nearest| params.accepts(nearest), |_, _| true)
    }
}

/// The nearest that pass the tests, both ways if so asked.
fn mutual(params: &MatchParams, forward: &[TwoNearest], backward: &[TwoNearest]) -> Vec<Match> {
    let agrees = |first: u32, second: u32| {
        let back = &backward[second as usize];
        !params.mutual || back.index == first && params.accepts(back)
    };
    collect(forward, |nearest| params.accepts(nearest), agrees)
}

/// All bytes without their last bit.
///
/// Their squared distances are within a few hundredths of a quarter of the bytes' own, 353 of some 355 matches of two
/// panoramas are the same, and processors without byte products in 32 bits search them twice as fast.
fn halved(descriptors: &[u8]) -> impl Iterator<Item = u8> + '_ {
    descriptors.iter().map(|byte| byte / 2)
}

fn collect(
    nearest: &[TwoNearest],
    accepts: impl Fn(&TwoNearest) -> bool,
    agrees: impl Fn(u32, u32) -> bool,
) -> Vec<Match> {
    (0u32..)
        .zip(nearest)
        .filter(|(first, nearest)| accepts(nearest) && agrees(*first, nearest.index))
        .map(|(first, nearest)| Match { first, second: nearest.index })
        .collect()
}

/// Number of descriptors in a row-major array.
fn count(descriptors: &[u8]) -> usize {
    debug_assert_eq!(descriptors.len() % DESCRIPTOR_LEN, 0);
    descriptors.len() / DESCRIPTOR_LEN
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{CameraModel, SimulatedView};

    fn features(descriptors: Vec<u8>) -> ImageFeatures {
        let keypoints = vec![bytemuck::Zeroable::zeroed(); count(&descriptors)];
        ImageFeatures { keypoints, descriptors, ..ImageFeatures::default() }
    }

    fn random(rng: &mut ChaCha8Rng, count: usize) -> Vec<u8> {
        (0..count * DESCRIPTOR_LEN).map(|_| rng.random_range(0..90)).collect()
    }

    #[test]
    fn finds_noisy_copies_and_nothing_else() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let first = random(&mut rng, 300);
        let mut second = random(&mut rng, 200);
        for index in 0..100 {
            let copy = &first[index * DESCRIPTOR_LEN..(index + 1) * DESCRIPTOR_LEN];
            for (target, &value) in
                second[(199 - index) * DESCRIPTOR_LEN..(200 - index) * DESCRIPTOR_LEN].iter_mut().zip(copy)
            {
                *target = value.saturating_add(rng.random_range(0..6));
            }
        }
        let matches =
            match_features(&MatchParams::default(), Posture::Any, &features(first), &features(second));
        let expected: Vec<Match> = (0..100).map(|first| Match { first, second: 199 - first }).collect();
        assert_eq!(matches, expected);
    }

    #[test]
    fn repeated_structure_fails_the_ratio_test() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let first = random(&mut rng, 1);
        let second = [first.clone(), first.clone()].concat();
        let matches = match_features(
            &MatchParams::default(),
            Posture::Any,
            &features(first.clone()),
            &features(second),
        );
        assert!(matches.is_empty());
        let alone =
            match_features(&MatchParams::default(), Posture::Any, &features(first.clone()), &features(first));
        assert_eq!(alone, [Match { first: 0, second: 0 }]);
    }

    #[test]
    fn mutual_test_drops_all_but_the_nearest_of_several() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let base = random(&mut rng, 1);
        let mut near = base.clone();
        near[0] += 1;
        let mut far = base.clone();
        far[..40].iter_mut().for_each(|value| *value += 20);
        let first = features([far, near].concat());
        let second = features([base, random(&mut rng, 5)].concat());
        let with = |mutual| {
            match_features(&MatchParams { mutual, ..MatchParams::default() }, Posture::Any, &first, &second)
        };
        assert_eq!(with(true), [Match { first: 1, second: 0 }]);
        assert_eq!(with(false), [Match { first: 0, second: 0 }, Match { first: 1, second: 0 }]);
    }

    /// Whole panoramas of 3600 × 1800 pixels.
    fn level() -> Posture {
        let camera = Camera {
            model: CameraModel::Equirectangular,
            width: 3600,
            height: 1800,
            params: vec![3600.0, 1800.0],
        };
        Posture::of([&camera; 2])
    }

    /// The same descriptors once for each of these elevations in degrees, orientations and sizes in pixels.
    fn seen(descriptors: &[u8], aspects: &[(f32, f32, f32)]) -> ImageFeatures {
        let mut features = features(descriptors.repeat(aspects.len()));
        let num_each = count(descriptors);
        for (at, keypoint) in features.keypoints.iter_mut().enumerate() {
            let (elevation, orientation, size) = aspects[at / num_each];
            // Spots all round, some degrees up and down.
            let row = 900.0 - 10.0 * (elevation + (at % num_each % 5) as f32 - 2.0);
            *keypoint = Keypoint { y: row, size, ..*keypoint };
            keypoint.orientation = orientation + (at % num_each) as f32 * 0.1;
        }
        features
    }

    /// What share of 1000 keypoints so seen matches first and second ones, in percent; nothing else does.
    fn matched(posture: Posture, first: &[(f32, f32, f32)], second: &[(f32, f32, f32)]) -> usize {
        let descriptors = random(&mut ChaCha8Rng::seed_from_u64(8), 1000);
        let images = [first, second].map(|aspects| seen(&descriptors, aspects));
        let found = match_features(&MatchParams::default(), posture, &images[0], &images[1]);
        assert!(found.iter().all(|m| m.first % 1000 == m.second % 1000));
        found.len() / 10
    }

    #[test]
    fn keypoints_of_level_images_match_those_turned_alike() {
        // Twice the place, the second time turned about: a repetition for all keypoints, none for those alike.
        let (once, twice) = ([(30.0, 0.0, 8.0)], [(30.0, 0.6, 8.0), (30.0, 3.0, 8.0)]);
        assert_eq!(matched(Posture::Any, &once, &twice), 0);
        assert_eq!(matched(level(), &once, &twice), 100);
        // Not level after all.
        assert_eq!(matched(level(), &once, &[(30.0, 2.0, 8.0)]), 100);
        // What is on the ground may be turned anyhow.
        let below = |aspects: &[(f32, f32, f32)]| {
            aspects.iter().map(|&(elevation, turn, size)| (-elevation, turn, size)).collect::<Vec<_>>()
        };
        assert_eq!(matched(level(), &below(&once), &below(&twice)), 0);
    }

    #[test]
    fn keypoints_of_level_images_match_those_of_like_height_and_size() {
        // Blocks that have both of what is told apart are compared with either, so not all can match.
        // The same things above and below the camera.
        let above = (30.0, 0.0, 8.0);
        assert_eq!(matched(Posture::Any, &[above], &[above, (-30.0, 0.0, 8.0)]), 0);
        assert!(matched(level(), &[above], &[above, (-30.0, 0.0, 8.0)]) > 90);
        // The same things from farther off, half as high and as large (sin 30° ≈ 2 sin 14°), and much larger there.
        let (farther, larger) = ((14.0, 0.0, 4.0), (14.0, 0.0, 40.0));
        assert_eq!(matched(Posture::Any, &[above], &[farther, larger]), 0);
        assert!(matched(level(), &[above], &[farther, larger]) > 60);
    }

    #[test]
    fn elevations_of_crops_are_those_of_the_whole() {
        let crop = Camera {
            model: CameraModel::Equirectangular,
            width: 3600,
            height: 600,
            params: vec![3600.0, 1800.0, 0.0, 500.0],
        };
        let elevations = Elevations::of(&crop).unwrap();
        assert!((elevations.at(100.0).to_degrees() - 30.0).abs() < 1e-4);
        assert!((elevations.at(700.0).to_degrees() + 30.0).abs() < 1e-4);
    }

    #[test]
    fn bright_spots_never_match_dark_ones() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let descriptors = random(&mut rng, 4);
        let with = |light| ImageFeatures { light, ..features(descriptors.clone()) };
        let matched = |first, second| {
            let found = match_features(&MatchParams::default(), Posture::Any, &with(first), &with(second));
            found.iter().map(|m| (m.first, m.second)).collect::<Vec<_>>()
        };
        assert_eq!(matched(2, 2), [(0, 0), (1, 1), (2, 2), (3, 3)]);
        assert_eq!(matched(0, 4), []);
        let found = matched(3, 1);
        assert!(found.contains(&(0, 0)) && found.contains(&(3, 3)));
        assert!(found.iter().all(|(first, second)| (*first < 3) == (*second < 1)));
    }

    #[test]
    fn images_whose_strongest_points_differ_are_not_matched_further() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let (strong, weak) = (random(&mut rng, 50), random(&mut rng, 50));
        let first = features([&strong[..], &weak].concat());
        let same = features([&strong[..], &weak].concat());
        let other = features([&random(&mut rng, 50)[..], &weak].concat());
        let params = MatchParams { screen_features: 12, screen_matches: 10, ..MatchParams::default() };
        assert_eq!(match_features(&params, Posture::Any, &first, &same).len(), 100);
        assert_eq!(match_features(&params, Posture::Any, &first, &other).len(), 0);
        let all = MatchParams { screen_features: 0, ..params };
        assert_eq!(match_features(&all, Posture::Any, &first, &other).len(), 50);
        // Simulated views do not count among what is worth screening: they may be all that two images share.
        let viewed = |own: &[u8], simulated: &[u8]| {
            let mut features = features([own, simulated].concat());
            features.simulated = vec![SimulatedView { start: 50, light: 0 }];
            for (at, keypoint) in features.keypoints.iter_mut().enumerate() {
                keypoint.x = 10.0 * at as f32;
            }
            features
        };
        let (first, second) = (viewed(&weak, &strong), viewed(&strong, &weak));
        let found = match_features(&params, Posture::Any, &first, &second);
        assert_eq!(found.len(), 100);
        // What the images' own keypoints match need not be found again.
        let alone = [&first, &second].map(ImageFeatures::without_simulated_views);
        let own = match_features(&params, Posture::Any, &alone[0], &alone[1]);
        assert_eq!(match_simulated_views(&params, Posture::Any, &first, &second, &own), found);
    }

    #[test]
    fn empty_images_match_nothing() {
        let some = features(vec![7; DESCRIPTOR_LEN]);
        let none = ImageFeatures::default();
        assert!(match_features(&MatchParams::default(), Posture::Any, &some, &none).is_empty());
        assert!(match_features(&MatchParams::default(), Posture::Any, &none, &some).is_empty());
    }

    #[test]
    fn parameters_out_of_range_are_named() {
        let error = MatchParams { ratio: 1.5, ..MatchParams::default() }.validate().unwrap_err();
        assert_eq!(error.to_string(), "ratio is 1.5, expected in (0, 1]");
        assert!(MatchParams { max_distance: f64::NAN, ..MatchParams::default() }.validate().is_err());
    }
}
