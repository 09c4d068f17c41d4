//! Matching of keypoints that can show the same in two level images.

use std::f32::consts::{PI, TAU};
use std::ops::Range;

use super::kernel::{BASE_BLOCK, BlockPairs, QUERY_BLOCK};
use super::{Elevations, Match, MatchParams, halved, kernel, mutual};
use crate::{DESCRIPTOR_LEN, ImageFeatures, Keypoint};

/// Sectors that the full turn is divided into, 22.5° each.
const SECTORS: usize = 16;
/// Sectors beside a keypoint's own that it is compared with: what is up to 45° off always, beyond 67.5° never.
const BESIDE: usize = 2;
/// Octaves up to which keypoints differ in extent ([`Aspect::extent`]) that are compared. (Of the right matches of plaza,
/// `small`, `lzr` and `street` 99.8–99.98 % are, and 95–98 % where one image is tilted by 20°.)
const OCTAVES: f32 = 1.5;
/// Bright and as many dark keypoints of each image whose matches tell whether the two are level.
pub(super) const SAMPLE: usize = 1024;
/// Fewer matches than this do not tell whether images are level: by chance 6 to 20 match, and of these any share is compared.
const ENOUGH: usize = 30;
/// Share of the matches of level images that are compared at least. (Of all matches of pairs of the sets named above 0.7–1
/// are, right ones or wrong; of the right ones with an image that is tilted by 30° 0.82–0.87, by 45° 0.52–0.56.)
const SHARE: f64 = 0.6;

/// Elevation up to which there is ground. What lies between two standpoints is seen from opposite sides, so that it
/// may be turned anyhow.
const GROUND: f32 = -15.0 * PI / 180.0;
/// Elevation from which a thing is above the camera wherever it is seen from: what is ground in the other image is not.
const ABOVE: f32 = 10.0 * PI / 180.0;
/// Elevation from which there are ceilings. Façades that high are not seen from where they would look turned.
const CEILING: f32 = 45.0 * PI / 180.0;

/// Where a keypoint lies, seen from the camera's height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Zone {
    Ground,
    Middle,
    Above,
    Ceiling,
}

/// Zone and sector of orientation, as one number.
type Group = usize;
const NUM_GROUPS: usize = 4 * SECTORS;
/// A bit for each group.
type Groups = u64;

/// Bits of a keypoint's index, beside those of its group and its extent.
const INDEX_BITS: u32 = 26;
const INDEX_MASK: u64 = (1 << INDEX_BITS) - 1;

/// What of a keypoint in a level image tells which keypoints of another show the same.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Aspect {
    group: Group,
    /// Size over height above or below the camera, in octaves.
    ///
    /// A thing of size S at height h, as seen from two cameras of one height, at the elevation e is as far away as h / sin e and
    /// spans the angle S sin e / h. So the angle over sin e is the same in both. At less than 10° an error of the elevation
    /// would tell more than it does, and the angles themselves are compared.
    extent: f32,
}

impl Aspect {
    fn of(keypoint: &Keypoint, elevations: Elevations) -> Self {
        let elevation = elevations.at(keypoint.y);
        let zone = if elevation < GROUND {
            Zone::Ground
        } else if elevation < ABOVE {
            Zone::Middle
        } else if elevation < CEILING {
            Zone::Above
        } else {
            Zone::Ceiling
        };
        let turns = keypoint.orientation / TAU;
        // Rounding may make a whole turn of the part, and an orientation that is no number is one of none.
        let sector = ((turns - turns.floor()) * SECTORS as f32) as usize % SECTORS;
        // Rows are stretched along the parallels, and the size is that of the picture.
        let angle = keypoint.size * elevation.cos().max(0.0).sqrt() * elevations.per_row();
        let height = elevation.abs().max(ABOVE).sin();
        Self {
            group: zone as usize * SECTORS + sector,
            extent: (angle / height).max(f32::MIN_POSITIVE).log2(),
        }
    }

    /// Where the keypoint of this index is sorted in, that index in the last bits.
    ///
    /// Every other group is backwards: a block with the end of one and the beginning of the next is of like extents.
    fn place(&self, index: usize) -> u64 {
        let along = if self.group.is_multiple_of(2) { self.extent } else { -self.extent };
        let bits = along.to_bits();
        // Integers in the order of the numbers that these are the bits of.
        let ordered = if along.is_sign_negative() { !bits } else { bits | 1 << 31 };
        (self.group as u64) << (INDEX_BITS + 32) | u64::from(ordered) << INDEX_BITS | index as u64
    }

    fn is_compared_with(&self, other: &Self) -> bool {
        partners(self.group) >> other.group & 1 != 0 && (self.extent - other.extent).abs() <= OCTAVES
    }
}

/// Whether keypoints of these sectors are turned alike.
fn is_alike(a: usize, b: usize) -> bool {
    let apart = a.abs_diff(b);
    apart.min(SECTORS - apart) <= BESIDE
}

/// The groups that keypoints of one are compared with.
fn partners(group: Group) -> Groups {
    let zone = |group: Group| [Zone::Ground, Zone::Middle, Zone::Above, Zone::Ceiling][group / SECTORS];
    let is_partner = |&other: &Group| match (zone(group), zone(other)) {
        (Zone::Ground, Zone::Ground) | (Zone::Ceiling, Zone::Ceiling) => true,
        (Zone::Ground, Zone::Above | Zone::Ceiling) | (Zone::Above | Zone::Ceiling, Zone::Ground) => false,
        _ => is_alike(group % SECTORS, other % SECTORS),
    };
    (0..NUM_GROUPS).filter(is_partner).fold(0, |groups, other| groups | 1 << other)
}

/// Whether matches are such as level images do not have.
pub(super) fn contradict(
    matches: &[Match],
    elevations: [Elevations; 2],
    first: &ImageFeatures,
    second: &ImageFeatures,
) -> bool {
    let is_compared = |m: &&Match| {
        let first = Aspect::of(&first.keypoints[m.first as usize], elevations[0]);
        first.is_compared_with(&Aspect::of(&second.keypoints[m.second as usize], elevations[1]))
    };
    let num_compared = matches.iter().filter(is_compared).count();
    matches.len() >= ENOUGH && (num_compared as f64) < SHARE * matches.len() as f64
}

/// Some keypoints of an image, like beside like.
struct Sorted {
    /// Their indices in the image.
    order: Vec<u32>,
    aspects: Vec<Aspect>,
    descriptors: Vec<u8>,
}

impl Sorted {
    fn new(features: &ImageFeatures, part: Range<usize>, elevations: Elevations) -> Self {
        let of_part: Vec<Aspect> = features.keypoints[part.clone()]
            .iter()
            .map(|keypoint| Aspect::of(keypoint, elevations))
            .collect();
        let mut places: Vec<u64> = of_part.iter().enumerate().map(|(at, aspect)| aspect.place(at)).collect();
        places.sort_unstable();
        let within: Vec<usize> = places.into_iter().map(|place| (place & INDEX_MASK) as usize).collect();
        let aspects = within.iter().map(|&at| of_part[at]).collect();
        let order: Vec<u32> = within.into_iter().map(|at| (part.start + at) as u32).collect();
        let mut descriptors = Vec::with_capacity(order.len() * DESCRIPTOR_LEN);
        for &at in &order {
            descriptors.extend(halved(features.descriptor(at as usize)));
        }
        Self { order, aspects, descriptors }
    }

    fn blocks(&self, of: usize) -> Vec<Block> {
        self.aspects.chunks(of).map(Block::new).collect()
    }
}

/// What the keypoints of a block are like.
struct Block {
    groups: Groups,
    partners: Groups,
    smallest: f32,
    largest: f32,
}

impl Block {
    fn new(aspects: &[Aspect]) -> Self {
        let mut block = Self { groups: 0, partners: 0, smallest: f32::INFINITY, largest: f32::NEG_INFINITY };
        for aspect in aspects {
            if block.groups >> aspect.group & 1 == 0 {
                block.groups |= 1 << aspect.group;
                block.partners |= partners(aspect.group);
            }
            block.smallest = block.smallest.min(aspect.extent);
            block.largest = block.largest.max(aspect.extent);
        }
        block
    }

    /// Whether keypoints of the two may show the same; no fewer than [`Aspect::is_compared_with`] says.
    fn is_compared_with(&self, other: &Self) -> bool {
        self.partners & other.groups != 0
            && self.smallest - other.largest <= OCTAVES
            && other.smallest - self.largest <= OCTAVES
    }
}

/// Matches keypoints of these parts that can show the same, ascending.
pub(super) fn match_parts(
    params: &MatchParams,
    (first, first_part, first_elevations): (&ImageFeatures, Range<usize>, Elevations),
    (second, second_part, second_elevations): (&ImageFeatures, Range<usize>, Elevations),
) -> Vec<Match> {
    let first = Sorted::new(first, first_part, first_elevations);
    let second = Sorted::new(second, second_part, second_elevations);
    let (queries, base) = (first.blocks(QUERY_BLOCK), second.blocks(BASE_BLOCK));
    let compared = BlockPairs::new(queries.len(), base.len(), |a, b| queries[a].is_compared_with(&base[b]));
    let (forward, backward) = kernel::two_nearest_both(&first.descriptors, &second.descriptors, &compared);
    let mut matches = mutual(params, &forward, &backward);
    for m in &mut matches {
        *m = Match { first: first.order[m.first as usize], second: second.order[m.second as usize] };
    }
    matches.sort_unstable();
    matches
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_by_group_then_extent_to_and_fro_then_index() {
        let extents = [-3.5, -0.25, 0.0, 1.0e-3, 2.0];
        let along = |group: Group| {
            let mut extents = extents;
            if group % 2 == 1 {
                extents.reverse();
            }
            extents.map(|extent| Aspect { group, extent })
        };
        let sorted = [0, 1, 7, NUM_GROUPS - 1].into_iter().flat_map(along);
        let places: Vec<u64> =
            sorted.flat_map(|aspect| [3, 1 << 20].map(|index| aspect.place(index))).collect();
        assert!(places.is_sorted_by(|a, b| a < b));
        assert_eq!(places.last().map(|place| place & INDEX_MASK), Some(1 << 20));
    }
}
