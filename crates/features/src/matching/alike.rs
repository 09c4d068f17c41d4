//! Matching of keypoints of like orientation.

use std::f32::consts::TAU;
use std::ops::Range;

use super::{Match, MatchParams, halved, kernel, mutual};
use crate::{DESCRIPTOR_LEN, ImageFeatures, Keypoint};

/// Sectors that the full turn is divided into, 22.5° each.
const SECTORS: usize = 16;
/// Sectors beside a keypoint's own that it is compared with: what is up to 45° off always, beyond 67.5° never.
const BESIDE: usize = 2;
/// Bright and as many dark keypoints of each image whose matches tell whether the two are level.
pub(super) const SAMPLE: usize = 2048;
/// Fewer matches than this do not tell whether images are level: by chance some 20 match.
const ENOUGH: usize = 30;
/// Share of the matches of level images that are turned alike at least. (Of rendered panoramas 4–60 m apart 0.75–1 of the right
/// matches are and 0.2–0.9 of the wrong ones, which pairs far apart mostly have; of images turned by a quarter hardly any.)
const SHARE: f64 = 0.35;

/// The sector of a keypoint's orientation.
fn sector(keypoint: &Keypoint) -> usize {
    let turns = keypoint.orientation / TAU;
    // Rounding may make a whole turn of the part, and an orientation that is no number is one of none.
    ((turns - turns.floor()) * SECTORS as f32) as usize % SECTORS
}

/// Whether keypoints of these sectors are turned alike.
fn is_alike(a: usize, b: usize) -> bool {
    let apart = a.abs_diff(b);
    apart.min(SECTORS - apart) <= BESIDE
}

/// Whether matches are turned as those of level images are not.
pub(super) fn contradict(matches: &[Match], first: &ImageFeatures, second: &ImageFeatures) -> bool {
    let of = |features: &ImageFeatures, at: u32| sector(&features.keypoints[at as usize]);
    let num_alike = matches.iter().filter(|m| is_alike(of(first, m.first), of(second, m.second))).count();
    matches.len() >= ENOUGH && (num_alike as f64) < SHARE * matches.len() as f64
}

/// Below this height above the horizon, as a share of the picture, there is ground: −15° in a panorama. What lies between two
/// standpoints is seen from opposite sides, so that it may be turned anyhow.
const GROUND: f32 = -15.0 / 180.0;
/// Above this one there are ceilings: 45°. Façades that high are not seen from where they would look turned.
const CEILING: f32 = 45.0 / 180.0;

/// Keypoints that are compared with the same others.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Group {
    zone: Zone,
    sector: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Zone {
    Between,
    Ceiling,
    Ground,
}

impl Group {
    const COUNT: usize = 3 * SECTORS;

    fn of(keypoint: &Keypoint, height: u32) -> usize {
        let above_horizon = 0.5 - keypoint.y / height as f32;
        let zone = if above_horizon < GROUND {
            Zone::Ground
        } else if above_horizon > CEILING {
            Zone::Ceiling
        } else {
            Zone::Between
        };
        zone as usize * SECTORS + sector(keypoint)
    }

    fn numbered(number: usize) -> Self {
        let zone = [Zone::Between, Zone::Ceiling, Zone::Ground][number / SECTORS];
        Self { zone, sector: number % SECTORS }
    }

    fn is_compared_with(self, other: Self) -> bool {
        is_alike(self.sector, other.sector) || self.zone == other.zone && self.zone != Zone::Between
    }
}

/// Some keypoints of an image, group by group.
struct Sorted {
    /// Their indices in the image.
    order: Vec<u32>,
    /// Where each group ends.
    ends: Vec<usize>,
    descriptors: Vec<u8>,
}

impl Sorted {
    fn new(features: &ImageFeatures, part: Range<usize>) -> Self {
        let group = |&at: &u32| Group::of(&features.keypoints[at as usize], features.height);
        let mut order: Vec<u32> = (part.start as u32..part.end as u32).collect();
        order.sort_by_cached_key(group);
        let ends = (0..Group::COUNT).map(|number| order.partition_point(|at| group(at) <= number)).collect();
        let mut descriptors = Vec::with_capacity(order.len() * DESCRIPTOR_LEN);
        for &at in &order {
            descriptors.extend(halved(features.descriptor(at as usize)));
        }
        Self { order, ends, descriptors }
    }
}

/// Matches keypoints of these parts that are turned alike, ascending.
pub(super) fn match_parts(
    params: &MatchParams,
    (first, first_part): (&ImageFeatures, Range<usize>),
    (second, second_part): (&ImageFeatures, Range<usize>),
) -> Vec<Match> {
    let (first, second) = (Sorted::new(first, first_part), Sorted::new(second, second_part));
    let (forward, backward) = kernel::two_nearest_of_groups(
        (&first.descriptors, &first.ends),
        (&second.descriptors, &second.ends),
        |a, b| Group::numbered(a).is_compared_with(Group::numbered(b)),
    );
    let mut matches = mutual(params, &forward, &backward);
    for m in &mut matches {
        *m = Match { first: first.order[m.first as usize], second: second.order[m.second as usize] };
    }
    matches.sort_unstable();
    matches
}
