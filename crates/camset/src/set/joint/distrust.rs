//! What photos that are localized alone say against their local model.

use std::collections::BTreeSet;

use setloc_sfm::Rigid;

use super::{Component, Joint};
use crate::evidence::same_pose;
use crate::refine::JointPhoto;
use crate::verdict::weaker;
use crate::{PhotoLocalization, Verdict};

/// Standpoints with a photo that is localized alone elsewhere than its local model has it, from which on the model is not
/// trusted: one may be wrong itself.
const MIN_CONTRADICTING: usize = 2;

/// Error of a photo's place in a bent local model, as a share of its distance to the nearest photo that is right in it.
const MAX_BEND: f64 = 0.5;

/// Said of photos that stand beyond that.
const OUTWEIGHED: &str = "by its local model it stands far from where others, localized alone with more matches, would have it (is there a copy of what it shows?)";

/// Whether too many of the photos stand elsewhere when localized alone.
pub(super) fn is_distrusted(photos: &[JointPhoto], elsewhere: &[bool]) -> bool {
    let contradicting = photos.iter().zip(elsewhere).filter(|(_, elsewhere)| **elsewhere);
    let standpoints: BTreeSet<usize> = contradicting.map(|(photo, _)| photo.standpoint).collect();
    standpoints.len() >= MIN_CONTRADICTING
}

impl Component<'_> {
    /// Takes the photos' own word where several contradict the local model: it is bent, or two places are one in it, and then
    /// no other pose that rests on it is sure. Says which they are.
    ///
    /// Those that are outweighed ([`Self::outweighed`]) are not sure either.
    pub(super) fn distrust(
        &self,
        refined: &mut [PhotoLocalization],
        rigid: &mut [PhotoLocalization],
        (elsewhere, is_outweighed): (&mut [bool], &[bool]),
    ) -> String {
        let contradicting: Vec<&str> = (refined.iter().zip(elsewhere.iter()))
            .filter(|(_, elsewhere)| **elsewhere)
            .map(|(photo, _)| photo.name.as_str())
            .collect();
        let reason =
            format!("its local model is contradicted by {}, localized alone", contradicting.join(", "));
        for (slot, photo) in refined.iter_mut().enumerate() {
            let alone = &self.evidence[self.members[slot]].photo;
            if alone.verdict == Verdict::Localized {
                photo.clone_from(alone);
                if is_outweighed[slot] {
                    photo.verdict = Verdict::Uncertain;
                    photo.reasons.push(OUTWEIGHED.to_owned());
                }
            } else {
                photo.verdict = weaker(photo.verdict, Verdict::Uncertain);
            }
            photo.reasons.push(reason.clone());
        }
        for photo in rigid {
            photo.verdict = weaker(photo.verdict, Verdict::Uncertain);
        }
        elsewhere.fill(false);
        reason
    }

    /// Photos localized alone that stand far from where others, localized alone, put them by the local model, if these agree
    /// on it from two standpoints and have more matches.
    ///
    /// A building that stands twice in a scene localizes photos at its copy. A bent model, too, is contradicted by photos
    /// that are right, but not by so much of the distance between them.
    pub(super) fn outweighed(&self, joint: &Joint) -> Vec<bool> {
        let photos = &joint.model.photos;
        let alone: Vec<(usize, Rigid)> = (0..photos.len())
            .filter_map(|slot| {
                let alone = &self.evidence[self.members[slot]].photo;
                Some((slot, alone.world_from_camera.filter(|_| alone.verdict == Verdict::Localized)?))
            })
            .collect();
        let depths: Vec<f64> = (0..photos.len()).map(|slot| self.depth(joint, slot)).collect();
        let placed = |moved: &Rigid, slot: usize| *moved * photos[slot].world_from_camera;
        let agreeing = |moved: &Rigid| -> Vec<usize> {
            let agrees = |(slot, own): &&(usize, Rigid)| same_pose(&placed(moved, *slot), own, depths[*slot]);
            alone.iter().filter(agrees).map(|(slot, _)| *slot).collect()
        };
        let matches = |slots: &[usize]| -> usize {
            slots.iter().map(|&slot| self.evidence[self.members[slot]].photo.inliers).sum()
        };
        let by_photo = alone.iter().map(|(slot, own)| *own * photos[*slot].world_from_camera.inverse());
        let moves = std::iter::once(Rigid::identity()).chain(by_photo);
        let sides: Vec<(Rigid, Vec<usize>)> = moves.map(|moved| (moved, agreeing(&moved))).collect();
        let mut is_outweighed = vec![false; photos.len()];
        // Of equals the first.
        let Some((moved, best)) = sides.iter().rev().max_by_key(|(_, slots)| matches(slots)) else {
            return is_outweighed;
        };
        let standpoints: BTreeSet<usize> = best.iter().map(|&slot| photos[slot].standpoint).collect();
        if standpoints.len() < 2 {
            return is_outweighed;
        }
        for (slot, own) in alone.iter().filter(|(slot, _)| !best.contains(slot)) {
            let by_model = placed(moved, *slot).translation;
            let nearest = best.iter().map(|&other| (placed(moved, other).translation - by_model).norm());
            let nearest = nearest.fold(f64::INFINITY, f64::min);
            is_outweighed[*slot] = (own.translation - by_model).norm() > MAX_BEND * nearest;
        }
        is_outweighed
    }
}
