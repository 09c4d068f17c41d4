//! What a component's poses come to: an answer for each photo.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use setloc_features::{Calibration, CameraModel};
use setloc_sfm::{ImageId, Rigid};

use super::{Component, Joint};
use crate::evidence::{PhotoRays, median, same_pose};
use crate::misfit::Misfit;
use crate::refine::JointPhoto;
use crate::set::correspondences::SetCorrespondence;
use crate::set::cut::Size;
use crate::set::rigid::RigidPose;
use crate::single::{own_matches, shows_cut, union};
use crate::underfoot::Ground;
use crate::verdict::{judge_precision, weaker};
use crate::{PhotoLocalization, SceneMatch, Verdict};

/// Share of the rigid pose's correspondences that the joint refinement has to bring within the inlier bound.
const MIN_KEPT: f64 = 0.5;
/// Share of the scene points that a photo shows alone that it has to show as its set places it. Of held-out photos of rendered and
/// real places 0.98 and more are left where the set is right; 0.7 of one that a wrong relative pose drew aside, less of others.
const MIN_KEPT_OF_ALONE: f64 = 0.8;
/// Photos of one size that are asked whether they were cut from larger pictures.
const MOST_ASKED_OF_SIZE: usize = 4;
/// Scene points that tell the focal length of a photo whose local model does not.
const MIN_TELLING: usize = 30;

impl Component<'_> {
    pub(super) fn rigid_answers(
        &self,
        set_from_camera: &[Rigid],
        candidates: &[SetCorrespondence],
        rigid: &RigidPose,
        verdict: Verdict,
        reasons: &[String],
    ) -> Vec<PhotoLocalization> {
        let mut seen = vec![0; self.members.len()];
        for &(slot, _) in rigid.agreeing.iter().flat_map(|&number| &candidates[number].seen_by) {
            seen[slot] += 1;
        }
        let spread = &rigid.observability;
        // One photo has no scale, nor has a set of which the rays tell none.
        let scale =
            spread.log_scale.is_finite().then(|| format!(", scale ± {:.1} %", 100.0 * spread.log_scale));
        let precision = format!(
            "as a rigid set: rotation ± {:.2}°, position ± {:.1} % of the viewing distance{}",
            spread.rotation_rad.to_degrees(),
            100.0 * spread.position,
            scale.unwrap_or_default()
        );
        (0..self.members.len())
            .map(|slot| PhotoLocalization {
                name: self.photos[self.members[slot]].name.to_owned(),
                camera: self.model.cameras[self.camera_of(slot)].clone(),
                component: self.scene.component,
                world_from_camera: Some(rigid.world_from_set.transform_pose(&set_from_camera[slot])),
                covariance: None,
                inliers: seen[slot],
                verdict,
                reasons: reasons.iter().cloned().chain([precision.clone()]).collect(),
            })
            .collect()
    }

    /// The answers, and whether each photo stands elsewhere when localized alone.
    pub(super) fn refined_answers(
        &self,
        candidates: &[SetCorrespondence],
        rigid: &RigidPose,
        joint: &Joint,
        support: Verdict,
        reasons: &[String],
    ) -> (Vec<PhotoLocalization>, Vec<bool>) {
        let kept = rigid.agreeing.iter().filter(|&&number| {
            let candidate = &candidates[number];
            let seen = |&(slot, feature): &(usize, u32)| {
                joint.direct[slot].binary_search(&SceneMatch { feature, point: candidate.scene }).is_ok()
            };
            candidate.seen_by.iter().any(seen)
        });
        let supporting = rigid.agreeing.len() + rigid.sights.len() + rigid.lone.len();
        let kept = (kept.count() + joint.kept_sights) as f64 / supporting.max(1) as f64;
        let misfits = self.misfits(joint);
        (0..self.members.len())
            .map(|slot| {
                let photo = self.members[slot];
                let pose = joint.model.photos[slot].world_from_camera;
                let mut reasons = reasons.to_vec();
                let depth = self.depth(joint, slot);
                let covariance = joint.covariances.get(slot).copied().flatten();
                let precision =
                    judge_precision(&self.params.verdict, covariance.as_ref(), depth, &mut reasons);
                let mut verdict = support;
                if kept < MIN_KEPT {
                    reasons.push(format!(
                        "{:.0} % of these matches fit after the joint refinement only",
                        100.0 * kept
                    ));
                    verdict = weaker(verdict, Verdict::Uncertain);
                }
                let is_elsewhere = self.agrees_alone(&joint.model.photos, slot, depth) == Some(false);
                match self.standpoint_agrees_alone(&joint.model.photos, slot, depth) {
                    // The photos' own matches are evidence that the set's pose did not create, but no remedy for one that the
                    // joint refinement left behind.
                    Some(true) => {
                        reasons.push("localized alone, it stands at the same place".to_owned());
                        let lost = self.lost_of_alone(joint, slot);
                        if let Some((left, shown)) = lost {
                            reasons.push(format!(
                                "its set leaves {left} of the {shown} scene points that it shows alone"
                            ));
                        }
                        if kept >= MIN_KEPT && lost.is_none() {
                            verdict = Verdict::Localized;
                        } else if let Some(alone) = self.localized_alone(slot) {
                            reasons.push(
                                "its place and how well that is known are those of the photo alone"
                                    .to_owned(),
                            );
                            return (PhotoLocalization { reasons, ..alone.clone() }, false);
                        }
                    }
                    Some(false) => {
                        let which = if is_elsewhere { "it" } else { "another photo of its standpoint" };
                        reasons.push(format!("localized alone, {which} stands elsewhere"));
                        verdict = Verdict::Uncertain;
                    }
                    None => {
                        let seen = joint.direct[slot].len() + joint.viewed[slot];
                        if seen < MIN_TELLING && !self.is_camera_told(slot) {
                            reasons.push(format!("nothing but {seen} scene points tells its focal length"));
                            verdict = weaker(verdict, Verdict::Uncertain);
                        }
                    }
                }
                if let Some((misfit, of)) = misfits.get(&joint.model.photos[slot].camera) {
                    reasons.push(format!("of its camera {of}: {misfit}"));
                    verdict = weaker(verdict, Verdict::Uncertain);
                }
                let of_standpoint =
                    |to: usize| joint.model.photos[to].standpoint == joint.model.photos[slot].standpoint;
                let lengths = self.lengths().filter(|&([.., to], _)| of_standpoint(to));
                reasons.extend(lengths.map(|(slots, length)| self.basis(slots, &length)));
                let verdict = weaker(verdict, precision);
                let answer = PhotoLocalization {
                    name: self.photos[photo].name.to_owned(),
                    camera: joint.model.camera_of(slot).clone(),
                    component: self.scene.component,
                    world_from_camera: Some(pose),
                    covariance,
                    inliers: joint.direct[slot].len() + joint.viewed[slot] + joint.walls[slot],
                    verdict,
                    reasons,
                };
                (answer, is_elsewhere)
            })
            .unzip()
    }

    /// By camera, what residuals of the photo with most matches have in common, and its name, if that is more than noise and errors
    /// of a scene.
    fn misfits(&self, joint: &Joint) -> BTreeMap<usize, (Misfit, &str)> {
        let mut most: BTreeMap<usize, usize> = BTreeMap::new();
        for (slot, photo) in joint.model.photos.iter().enumerate() {
            let of_camera = most.entry(photo.camera).or_insert(slot);
            if joint.direct[slot].len() > joint.direct[*of_camera].len() {
                *of_camera = slot;
            }
        }
        let misfit = |(camera, slot): (usize, usize)| {
            let photo = &self.photos[self.members[slot]];
            let rays = PhotoRays::new(photo.features, joint.model.camera_of(slot));
            let pose = &joint.model.photos[slot].world_from_camera;
            let misfit = Misfit::of(&rays, self.scene.index, pose, &joint.direct[slot])?;
            misfit.is_clear().then_some((camera, (misfit, photo.name)))
        };
        most.into_iter().filter_map(misfit).collect()
    }

    /// Where the principal point is of photos that show clearly more of the scene as parts of larger pictures than as their set has them.
    ///
    /// Of one [`Size`] those are asked that show most, as what one shows holds for all.
    pub(super) fn cut_pictures(&self, joint: &Joint, ground: &Ground) -> Vec<Option<Vector2<f64>>> {
        let mut of_size: BTreeMap<Size, Vec<usize>> = BTreeMap::new();
        for slot in 0..self.members.len() {
            let (photo, camera) = (self.members[slot], joint.model.camera_of(slot));
            let is_usual = matches!(camera.model, CameraModel::Radial | CameraModel::Opencv);
            if self.photos[photo].calibration != Calibration::Known && is_usual {
                of_size.entry(Size::of(self.photos, photo)).or_default().push(slot);
            }
        }
        let asked = of_size.into_values().flat_map(|mut slots| {
            slots.sort_by_key(|&slot| Reverse(joint.direct[slot].len()));
            slots.into_iter().take(MOST_ASKED_OF_SIZE)
        });
        let asked: BTreeSet<usize> = asked.collect();
        let cut = |slot: usize| {
            let (photo, evidence) = (&self.photos[self.members[slot]], &self.evidence[self.members[slot]]);
            let own = own_matches(self.scene.index, photo, evidence.nearest, self.params.ratio);
            let matches = union(&own, &joint.direct[slot]);
            let placed = (joint.model.camera_of(slot), &joint.model.photos[slot].world_from_camera);
            shows_cut(self.params.max_error_sigmas, (self.scene, ground), photo, &matches, placed)
        };
        let slots = (0..self.members.len()).into_par_iter().with_max_len(1);
        slots.map(|slot| asked.contains(&slot).then(|| cut(slot))?).collect()
    }

    /// Whether intrinsics are known, shared with another photo of the model or told by its points.
    ///
    /// With one other photo an unknown focal length fits as well as a step ahead does, and a few scene points fit both.
    fn is_camera_told(&self, slot: usize) -> bool {
        let photo = self.members[slot];
        let shares_it = |other: usize| other != slot && self.camera_of(other) == self.camera_of(slot);
        self.photos[photo].calibration != Calibration::Guessed
            || (0..self.members.len()).any(shares_it)
            || self.model.tells_camera_of(&[ImageId(photo as u32)])
    }

    /// How many scene points the set leaves a photo of those that it shows alone, and these, where that are too few: then its local
    /// model is wrong about it, though not by so much that it stood elsewhere.
    fn lost_of_alone(&self, joint: &Joint, slot: usize) -> Option<(usize, usize)> {
        let (left, shown) = (joint.direct[slot].len(), self.localized_alone(slot)?.inliers);
        ((left as f64) < MIN_KEPT_OF_ALONE * shown as f64).then_some((left, shown))
    }

    /// Makes photos uncertain that are held by nothing but a local model that loses what others of it show alone, and the rigid pose
    /// of those others.
    pub(super) fn doubt_beside_lost(
        &self,
        joint: &Joint,
        refined: &mut [PhotoLocalization],
        rigid: &mut [PhotoLocalization],
    ) {
        let slots = || 0..self.members.len();
        let lost: Vec<usize> = slots().filter(|&slot| self.lost_of_alone(joint, slot).is_some()).collect();
        let Some(&first) = lost.first() else { return };
        let reason = format!(
            "its local model leaves {} too few of the scene points that it shows alone",
            self.photos[self.members[first]].name
        );
        let is_held = |slot: usize| {
            self.localized_alone(slot).is_some()
                || joint.direct[slot].len() + joint.viewed[slot] >= self.params.verdict.min_inliers
        };
        for slot in slots().filter(|&slot| !is_held(slot)) {
            refined[slot].doubt(reason.clone());
            rigid[slot].doubt(reason.clone());
        }
        for slot in lost {
            rigid[slot].doubt(reason.clone());
        }
    }

    /// What the photo alone says, where it is localized.
    fn localized_alone(&self, slot: usize) -> Option<&PhotoLocalization> {
        Some(self.evidence[self.members[slot]].photo).filter(|alone| alone.verdict == Verdict::Localized)
    }

    /// Whether the photo stands at the same place when localized alone; `None` when it is not.
    fn agrees_alone(&self, joint: &[JointPhoto], slot: usize, depth: f64) -> Option<bool> {
        let own = self.localized_alone(slot)?.world_from_camera?;
        Some(same_pose(&joint[slot].world_from_camera, &own, depth))
    }

    /// The same of all photos of its standpoint.
    fn standpoint_agrees_alone(&self, joint: &[JointPhoto], slot: usize, depth: f64) -> Option<bool> {
        let mates = (0..joint.len()).filter(|&mate| joint[mate].standpoint == joint[slot].standpoint);
        mates.filter_map(|mate| self.agrees_alone(joint, mate, depth)).reduce(|a, b| a && b)
    }

    /// Median distance of what a photo sees: the scene points that it or its standpoint sees, else these and the local points that
    /// another standpoint sees, too; zero where they are fewer than half of what a verdict asks for.
    ///
    /// A few of the scene may be chance, at any distance, and what one standpoint sees alone has none. Where nothing but one
    /// standpoint is placed, local points have no scale: so the scene's come first.
    pub(super) fn depth(&self, joint: &Joint, slot: usize) -> f64 {
        let photos = &joint.model.photos;
        let standpoint = |slot: usize| photos[slot].standpoint;
        let center = photos[slot].world_from_camera.translation;
        let beside: Vec<usize> =
            (0..photos.len()).filter(|&other| standpoint(other) == standpoint(slot)).collect();
        let of_scene = |slot: usize| {
            let direct = joint.direct[slot].iter().map(|seen| self.scene.index.position(seen.point));
            direct.chain(joint.met[slot].iter().copied())
        };
        let local = |slot: usize| {
            let is_seen = move |local: &usize| {
                let track = self.track(*local);
                track.iter().any(|&(seer, _)| seer == slot)
                    && track.iter().any(|&(seer, _)| standpoint(seer) != standpoint(slot))
            };
            (0..self.model.points.len()).filter(is_seen).map(|local| joint.model.points[local])
        };
        let median_of = |least: usize, points: &mut dyn Iterator<Item = Vector3<f64>>| {
            let distances: Vec<f64> = points.map(|point| (point - center).norm()).collect();
            (distances.len() >= least).then(|| median(distances)).flatten()
        };
        let (many, some) = (self.params.verdict.min_inliers, self.params.verdict.min_inliers / 2);
        median_of(many, &mut of_scene(slot))
            .or_else(|| median_of(many, &mut beside.iter().copied().flat_map(of_scene)))
            .or_else(|| median_of(some, &mut of_scene(slot).chain(local(slot))))
            .or_else(|| {
                median_of(some, &mut beside.iter().flat_map(|&slot| of_scene(slot).chain(local(slot))))
            })
            .unwrap_or(0.0)
    }
}
