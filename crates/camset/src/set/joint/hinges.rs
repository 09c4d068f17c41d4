//! Standpoints that alone tie others to the rest of a set.
//!
//! What two standpoints share with one more, but nobody else, tells the directions of both baselines and nothing of the quotient of their
//! lengths: what lies beyond such a hinge has a scale of its own. Scene points that are seen from there tell it, or local points that are
//! seen from both sides, or planes ([`BaselineLength`](setloc_sfm::BaselineLength)).

use std::collections::BTreeSet;

use super::ties::Ties;
use super::{Component, Joint};
use crate::PhotoLocalization;

/// Standard deviation of a scale that few matches give, which are as likely chance as not, as a share of it. Of real sets such scales
/// were 2, 5, 12 and 500 % off.
const CHANCE_SCALE_SIGMA: f64 = 0.5;

/// Photos that stand nearer to the hinge than this share of the farthest tell next to nothing of the scale.
const NEAR_HINGE: f64 = 0.2;

/// Photos beyond a hinge.
#[derive(Debug, PartialEq)]
pub(super) struct Beyond {
    /// Slot of the standpoint that ties them.
    hinge: usize,
    /// Their slots, ascending.
    slots: Vec<usize>,
}

impl Joint {
    /// Adds to the covariances of photos by how much their distance from a standpoint is off, if its scale may be chance.
    pub(super) fn doubt_scale(&mut self, standpoint: usize, slots: &[usize]) {
        let hinge = self.model.photos[standpoint].world_from_camera.translation;
        for &slot in slots {
            let off = CHANCE_SCALE_SIGMA * (self.model.photos[slot].world_from_camera.translation - hinge);
            if let Some(covariance) = &mut self.covariances[slot] {
                let mut of_center = covariance.fixed_view_mut::<3, 3>(3, 3);
                of_center += off * off.transpose();
            }
        }
    }

    /// How much of the scene, and of what is seen from both sides, tells the scale beyond a hinge.
    fn scale_support(&self, beyond: &Beyond, tracks: &[Vec<usize>]) -> usize {
        let is_beyond = |standpoint: &usize| beyond.slots.binary_search(standpoint).is_ok();
        let of_scene = |&slot: &usize| self.direct[slot].len() + self.viewed[slot] + self.walls[slot];
        let crosses = |track: &&Vec<usize>| {
            track.iter().any(is_beyond) && track.iter().any(|at| *at != beyond.hinge && !is_beyond(at))
        };
        let center = |slot: usize| self.model.photos[slot].world_from_camera.translation;
        let step = |slot: usize| (center(slot) - center(beyond.hinge)).norm();
        let farthest = beyond.slots.iter().map(|&slot| step(slot)).fold(0.0, f64::max);
        let tells = |slot: &&usize| step(**slot) >= NEAR_HINGE * farthest;
        beyond.slots.iter().filter(tells).map(of_scene).sum::<usize>() + tracks.iter().filter(crosses).count()
    }
}

impl Component<'_> {
    /// What lies beyond hinges and whose scale rests on too little, with how many matches it rests on; their covariances say so.
    ///
    /// Photos that see the scene themselves are where that says.
    pub(super) fn doubt_beyond_hinges(&self, joint: &mut Joint) -> Vec<(Beyond, usize)> {
        let standpoints: Vec<usize> = joint.model.photos.iter().map(|photo| photo.standpoint).collect();
        let seen_by = |local| {
            let all: BTreeSet<usize> = self.track(local).iter().map(|&(slot, _)| standpoints[slot]).collect();
            Vec::from_iter(all)
        };
        let tracks: Vec<Vec<usize>> = (0..self.model.points.len()).map(seen_by).collect();
        let mut doubtful = Vec::new();
        for mut beyond in beyond_hinges(&standpoints, &tracks, joint.main_standpoint()) {
            let support = joint.scale_support(&beyond, &tracks);
            if support < self.params.verdict.min_inliers / 2 && !self.has_length(&standpoints, &beyond) {
                beyond.slots.retain(|&slot| joint.direct[slot].len() < self.params.verdict.min_inliers);
                joint.doubt_scale(beyond.hinge, &beyond.slots);
                doubtful.push((beyond, support));
            }
        }
        doubtful
    }

    /// Whether planes tell it by as many points as a pose needs.
    fn has_length(&self, standpoints: &[usize], beyond: &Beyond) -> bool {
        let is_beyond = |slot: usize| beyond.slots.binary_search(&slot).is_ok();
        self.lengths().any(|([reference, from, to], length)| {
            let ties = standpoints[from] == beyond.hinge && is_beyond(to) != is_beyond(reference);
            ties && length.votes >= self.params.verdict.min_inliers
        })
    }

    /// Makes photos uncertain whose scale rests on too little.
    pub(super) fn doubt_photos(&self, doubtful: &[(Beyond, usize)], answers: &mut [PhotoLocalization]) {
        for (beyond, support) in doubtful {
            let hinge = self.photos[self.members[beyond.hinge]].name;
            let matches = if *support == 1 { "match" } else { "matches" };
            for &slot in &beyond.slots {
                answers[slot].doubt(format!("how far it is from {hinge} rests on {support} {matches}"));
            }
        }
    }
}

/// What only one standpoint ties to the main one, or, where that is the main one, to the rest: for each such hinge the photos of each
/// part beyond it. `tracks` are the standpoints that see each local point, each once.
fn beyond_hinges(standpoints: &[usize], tracks: &[Vec<usize>], main: usize) -> Vec<Beyond> {
    let count = standpoints.len();
    let ties = Ties::new(count, tracks);
    let all: BTreeSet<usize> = standpoints.iter().copied().collect();
    let mut found = Vec::new();
    for &hinge in &all {
        let mut left: BTreeSet<usize> = all.iter().copied().filter(|&at| at != hinge).collect();
        while let Some(first) = left.pop_first() {
            let part = ties.reached(first, |a, b| a == hinge || b == hinge);
            left.retain(|&at| !part[at]);
            if !part[main] {
                let slots = (0..count).filter(|&slot| part[standpoints[slot]]).collect();
                found.push(Beyond { hinge, slots });
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_one_standpoint_alone_ties_lies_beyond_it() {
        // Photos 0 and 1 of one standpoint, 2 and 3 with them, and 4 and 5 with 3 alone.
        let standpoints = [0, 0, 2, 3, 4, 5];
        let track = |seen: &[usize], times: usize| vec![seen.to_vec(); times];
        let tracks =
            [track(&[0, 2, 3], 9), track(&[3, 4], 20), track(&[4, 5], 20), track(&[3, 5], 8)].concat();
        let beyond = |hinge, slots: &[usize]| Beyond { hinge, slots: slots.to_vec() };
        let from_main = || beyond(0, &[2, 3, 4, 5]);
        assert_eq!(beyond_hinges(&standpoints, &tracks, 0), [from_main(), beyond(3, &[4, 5])]);
        assert_eq!(
            beyond_hinges(&standpoints, &tracks, 4),
            [beyond(3, &[0, 1, 2]), beyond(4, &[0, 1, 2, 3, 5])]
        );
        assert_eq!(beyond_hinges(&standpoints, &tracks, 3), [beyond(3, &[0, 1, 2]), beyond(3, &[4, 5])]);
        // With the last tie looser 5 hangs on 4.
        assert_eq!(
            beyond_hinges(&standpoints, &tracks[..tracks.len() - 1], 0),
            [from_main(), beyond(3, &[4, 5]), beyond(4, &[5])]
        );
        // Seen from both sides as well.
        let crossing = [tracks, track(&[2, 4], 8)].concat();
        assert_eq!(beyond_hinges(&standpoints, &crossing, 0), [from_main()]);
    }
}
