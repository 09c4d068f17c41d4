//! What panoramas share with those that stand next to them.
//!
//! Round a corner a panorama ought to see, by all that [`super::register::Visibility`] asks, the whole street that it
//! comes from. Walls hide it, and walls so near match in no second panorama, so that no point tells that they are there.
//! What two neighbours share is another matter: it hardly depends on where the street turns. So a model's own pairs tell
//! how many of their matches lie on the epipolar circles of their poses, by how far apart they stand, and a pose is
//! measured by the pairs that it brings as near together as neighbours are. A repeated façade explains a tenth of that, as it
//! fills few directions.

use std::collections::BTreeMap;

use rayon::prelude::*;
use setloc_features::Rays;

use super::{MapperInput, witnesses::on_circles};
use crate::{ImageId, Rigid, direction, robust::median};

/// Fewest pairs of about the same distance whose mean is what one of that distance ought to share.
const MIN_PAIRS_AVERAGED: usize = 5;
/// The same as a share of all.
const SHARE_AVERAGED: f64 = 0.05;
/// Share of what neighbours have in common from which two images stand as near as neighbours.
const NEAR_SHARE: f64 = 0.5;
/// Fewest matches of neighbours, counted so, that mean something: a few lie on the circles of any pose. Rendered streets
/// have 96 to 260.
const MIN_MATCHES: f64 = 40.0;
/// Share of what neighbours ought to have in common that they must have. Of rendered streets right joins have 0.6 to 1.3 of
/// it, joins in the wrong place up to 0.16.
const MIN_SHARED: f64 = 0.4;
/// The same for the one that an image shares most with.
const MIN_SHARED_WITH_ONE: f64 = 0.5;
/// Share of it below which they stand where they do not belong, in the open. Where parts of a rendered town of equal façades were laid
/// onto others, 14 to 35 such pairs had 0.08 to 0.14; where they meet, one or two have 0.75 to 1.1.
const MAX_OF_STRANGERS: f64 = 0.25;
/// Fewest such pairs that tell: parts that meet at a corner have a few, which may be hard to match, parts that lie on each other many.
const MIN_STRANGE_PAIRS: usize = 10;

/// Two panoramas that were matched with each other, at their poses.
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbours {
    pub images: [ImageId; 2],
    log_distance: f64,
    /// Matches that lie on the epipolar circles, by [`direction::spread`].
    matches: f64,
}

/// The pairs of panoramas that `counts` lets count and whose poses and rays are known.
pub(super) fn neighbours<'r>(
    input: &MapperInput<'_>,
    placed: impl Fn(ImageId) -> Option<(Rigid, &'r Rays)> + Sync,
    counts: impl Fn(ImageId, ImageId) -> bool + Sync,
    max_error_sigma: f64,
) -> Vec<Neighbours> {
    let pairs = input.putative.par_iter().with_max_len(8);
    pairs
        .filter(|pair| [pair.first, pair.second].into_iter().all(|image| input.is_panoramic(image)))
        .filter(|pair| counts(pair.first, pair.second))
        .filter_map(|pair| {
            let ((first, first_rays), (second, second_rays)) = (placed(pair.first)?, placed(pair.second)?);
            let distance = (first.translation - second.translation).norm();
            let rays = [first_rays, second_rays];
            let second_from_first = second.inverse() * first;
            let on_circles = on_circles(rays, &second_from_first, &pair.matches, max_error_sigma);
            let matches = direction::spread(on_circles.map(|m| &first_rays.bearings[m.first as usize]));
            (distance > 0.0).then(|| Neighbours {
                images: [pair.first, pair.second],
                log_distance: distance.ln(),
                matches: matches as f64,
            })
        })
        .collect()
}

/// Whether the pairs that stand as near as neighbours share as much as neighbours do, by what those share that are known.
pub(super) fn share_as_neighbours(known: &[Neighbours], asked: &[Neighbours]) -> bool {
    shared(known, asked).is_some_and(|shared| shared.share() >= MIN_SHARED)
}

/// Whether many pairs stand as near as neighbours and share next to nothing of what neighbours do: in the open, one of two parts is
/// in the wrong place.
pub(super) fn are_strangers(known: &[Neighbours], asked: &[Neighbours]) -> bool {
    shared(known, asked)
        .is_some_and(|shared| shared.pairs >= MIN_STRANGE_PAIRS && shared.share() < MAX_OF_STRANGERS)
}

/// Whether one of the pairs shares [`MIN_SHARED_WITH_ONE`] of what one of its distance ought to: a room behind a door shares
/// as much with the door only.
pub(super) fn share_with_one(known: &[Neighbours], asked: &[Neighbours]) -> bool {
    let Some(typical) = typical_matches(known).filter(|matches| *matches >= MIN_MATCHES) else {
        return false;
    };
    let by_distance = ByDistance::of(known);
    asked.iter().any(|pair| {
        let ought = by_distance.matches_at(pair.log_distance);
        ought >= NEAR_SHARE * typical && pair.matches >= MIN_SHARED_WITH_ONE * ought
    })
}

/// What pairs share that stand as near as neighbours.
#[derive(Debug, Clone, Copy, Default)]
struct Shared {
    pairs: usize,
    /// Matches that they ought to have, by what those share that are known, and those that they have.
    expected: f64,
    found: f64,
}

impl Shared {
    fn share(&self) -> f64 {
        self.found / self.expected
    }
}

/// What the pairs share that stand as near as neighbours; `None` where no pair stands so near, or too little is known.
fn shared(known: &[Neighbours], asked: &[Neighbours]) -> Option<Shared> {
    let typical = typical_matches(known).filter(|matches| *matches >= MIN_MATCHES)?;
    let (by_distance, mut shared) = (ByDistance::of(known), Shared::default());
    for pair in asked {
        let ought = by_distance.matches_at(pair.log_distance);
        if ought >= NEAR_SHARE * typical {
            shared.pairs += 1;
            shared.expected += ought;
            shared.found += pair.matches;
        }
    }
    (shared.expected > 0.0).then_some(shared)
}

/// What an image shares with the nearest one, in the median over the images; `None` for few pairs.
fn typical_matches(known: &[Neighbours]) -> Option<f64> {
    if known.len() < MIN_PAIRS_AVERAGED {
        return None;
    }
    let mut nearest = BTreeMap::new();
    for pair in known {
        for image in pair.images {
            let best: &mut &Neighbours = nearest.entry(image).or_insert(pair);
            if pair.log_distance < best.log_distance {
                *best = pair;
            }
        }
    }
    median(nearest.values().map(|pair| pair.matches).collect())
}

/// Distances, as logarithms, and matches of pairs, nearest first.
struct ByDistance(Vec<(f64, f64)>);

impl ByDistance {
    fn of(known: &[Neighbours]) -> Self {
        let mut all: Vec<(f64, f64)> = known.iter().map(|pair| (pair.log_distance, pair.matches)).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        Self(all)
    }

    /// What the pairs of about this distance share in the mean.
    fn matches_at(&self, log_distance: f64) -> f64 {
        let all = &self.0;
        let count = MIN_PAIRS_AVERAGED.max((SHARE_AVERAGED * all.len() as f64) as usize).min(all.len());
        let mut start = all.partition_point(|(at, _)| *at < log_distance);
        let mut end = start;
        while end - start < count {
            let before = start.checked_sub(1).map_or(f64::INFINITY, |at| log_distance - all[at].0);
            let after = all.get(end).map_or(f64::INFINITY, |(at, _)| at - log_distance);
            if before <= after {
                start -= 1;
            } else {
                end += 1;
            }
        }
        all[start..end].iter().map(|(_, matches)| matches).sum::<f64>() / count.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Images a step apart along a line: `matches` with the next one, a quarter with the one after.
    fn street(images: u32, matches: f64) -> Vec<Neighbours> {
        let pair = |a: u32, b: u32| Neighbours {
            images: [ImageId(a), ImageId(b)],
            log_distance: f64::from(b - a).ln(),
            matches: if b - a == 1 { matches } else { matches / 4.0 },
        };
        let next = (1..images).map(|b| pair(b - 1, b));
        next.chain((2..images).map(|b| pair(b - 2, b))).collect()
    }

    fn beyond(steps: f64, matches: f64) -> Neighbours {
        Neighbours { images: [ImageId(5), ImageId(6)], log_distance: steps.ln(), matches }
    }

    #[test]
    fn the_next_image_round_a_corner_shares_what_neighbours_do() {
        let known = street(6, 200.0);
        // Nothing of the street is seen from there.
        assert!(share_as_neighbours(&known, &[beyond(1.0, 180.0), beyond(2.0, 0.0)]));
        assert!(!share_as_neighbours(&known, &[beyond(1.0, 30.0), beyond(2.0, 50.0)]));
    }

    #[test]
    fn an_image_among_others_must_share_with_all_of_them() {
        let known = street(6, 200.0);
        assert!(!share_as_neighbours(&known, &[beyond(1.0, 200.0), beyond(0.5, 20.0), beyond(0.7, 10.0)]));
    }

    #[test]
    fn many_that_share_next_to_nothing_stand_in_the_wrong_place() {
        let known = street(6, 200.0);
        let facade = [beyond(0.5, 20.0), beyond(0.7, 10.0), beyond(1.0, 60.0), beyond(0.9, 30.0)].repeat(3);
        assert!(are_strangers(&known, &facade));
        assert!(!are_strangers(&known, &facade[..6]));
        assert!(!are_strangers(&known, &[&facade[..9], &[beyond(1.0, 180.0); 3]].concat()));
        // Far apart, little means nothing.
        let far = facade.iter().map(|pair| Neighbours { log_distance: 2.0_f64.ln(), ..*pair });
        assert!(!are_strangers(&known, &far.collect::<Vec<_>>()));
    }

    #[test]
    fn a_room_shares_with_its_door_only() {
        let known = street(6, 200.0);
        let behind_walls = [beyond(0.5, 20.0), beyond(0.7, 10.0)];
        assert!(share_with_one(&known, &[[beyond(1.0, 120.0)].as_slice(), &behind_walls].concat()));
        assert!(!share_with_one(&known, &[[beyond(1.0, 60.0)].as_slice(), &behind_walls].concat()));
        // Far apart, even much means nothing.
        assert!(!share_with_one(&known, &[beyond(2.0, 500.0)]));
    }

    #[test]
    fn far_or_few_pairs_tell_nothing() {
        assert!(!share_as_neighbours(&street(6, 200.0), &[beyond(2.0, 500.0)]));
        assert!(!share_as_neighbours(&street(3, 200.0), &[beyond(1.0, 200.0)]));
        assert!(!share_as_neighbours(&street(6, 30.0), &[beyond(1.0, 30.0)]));
        assert!(!share_as_neighbours(&[], &[]));
    }
}
