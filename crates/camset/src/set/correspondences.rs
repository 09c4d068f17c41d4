//! What ties a local model to the scene: 3D-to-3D matches with all their rays, and lone rays.

use std::collections::BTreeSet;

use nalgebra::Vector3;
use setloc_index::{LocalDescriptors, NearestPoints, SceneIndex};
use setloc_sfm::{PointId, Reconstruction, Rigid, Similarity};

use crate::evidence::PhotoRays;
use crate::observability::SetRay;
use crate::{CamsetParams, PhotoEvidence, Verdict};

/// A scene point and the features of the set that are believed to see it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SetCorrespondence {
    pub scene: PointId,
    /// Index of the local point; `None` for a lone ray.
    pub local: Option<usize>,
    /// Slots of the photos in the component, with their features.
    pub seen_by: Vec<(usize, u32)>,
}

/// All correspondences of a component: 3D-to-3D first, then lone rays to scene points not used yet.
pub(crate) fn correspondences(
    params: &CamsetParams,
    index: &SceneIndex,
    model: &Reconstruction,
    members: &[usize],
    rays: &[PhotoRays<'_>],
    evidence: &[PhotoEvidence<'_>],
) -> Vec<SetCorrespondence> {
    let mut slot_of = vec![None; model.images.len()];
    for (slot, &photo) in members.iter().enumerate() {
        slot_of[photo] = Some(slot);
    }
    let mut local = LocalDescriptors::default();
    let mut nearest: Vec<NearestPoints> = Vec::new();
    let mut tracks: Vec<Vec<(usize, u32)>> = Vec::with_capacity(model.points.len());
    let mut in_tracks: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); members.len()];
    for (number, point) in model.points.iter().enumerate() {
        let mut track = Vec::with_capacity(point.track.len());
        for observation in &point.track {
            let Some(slot) = slot_of.get(observation.image.index()).copied().flatten() else { continue };
            let feature = observation.feature;
            if feature as usize >= rays[slot].features.len() {
                continue;
            }
            local.push(number as u32, rays[slot].features.descriptor(feature as usize));
            nearest.push(evidence[members[slot]].nearest[feature as usize]);
            in_tracks[slot].insert(feature);
            track.push((slot, feature));
        }
        tracks.push(track);
    }
    let matched = index.point_correspondences(&local, &nearest, params.ratio, params.reverse_ratio);
    let mut used: BTreeSet<PointId> = BTreeSet::new();
    let mut found: Vec<SetCorrespondence> = Vec::with_capacity(matched.len());
    for matched in matched {
        used.insert(matched.scene);
        let local = matched.local as usize;
        found.push(SetCorrespondence {
            scene: matched.scene,
            local: Some(local),
            seen_by: tracks[local].clone(),
        });
    }
    // What a photo that is localized alone sees has been confirmed by its pose, the ratio test or not.
    for (slot, &photo) in members.iter().enumerate() {
        let alone = evidence[photo];
        for seen in alone.inliers.iter().filter(|_| alone.photo.verdict == Verdict::Localized) {
            if used.insert(seen.point) {
                let seen_by = vec![(slot, seen.feature)];
                found.push(SetCorrespondence { scene: seen.point, local: None, seen_by });
            }
        }
    }
    if params.lone_rays {
        for (slot, &photo) in members.iter().enumerate() {
            for lone in
                index.correspondences(&evidence[photo].nearest[..rays[slot].features.own_len()], params.ratio)
            {
                if !in_tracks[slot].contains(&lone.feature) && !used.contains(&lone.point) {
                    let seen_by = vec![(slot, lone.feature)];
                    found.push(SetCorrespondence { scene: lone.point, local: None, seen_by });
                }
            }
        }
    }
    found
}

/// Rays of correspondences in the set's frame, and which correspondence and camera each belongs to.
pub(crate) struct SetRays {
    pub rays: Vec<SetRay>,
    pub correspondence: Vec<usize>,
    pub slot: Vec<usize>,
}

/// Rays with standard deviations that admit `drift_px` of drift besides the noise of keypoint and scene point.
pub(crate) fn set_rays(
    params: &CamsetParams,
    index: &SceneIndex,
    set_from_camera: &[Rigid],
    rays: &[PhotoRays<'_>],
    correspondences: &[SetCorrespondence],
) -> SetRays {
    let mut all = SetRays { rays: Vec::new(), correspondence: Vec::new(), slot: Vec::new() };
    for (number, correspondence) in correspondences.iter().enumerate() {
        let scene_sigma = index.angular_sigma(correspondence.scene);
        for &(slot, feature) in &correspondence.seen_by {
            let photo = &rays[slot];
            let sigma = photo.rays.sigmas[feature as usize];
            let pixel = photo.features.keypoints[feature as usize].pixel();
            let Some(angle) = photo.camera.pixel_angle(&pixel).filter(|_| sigma.is_finite()) else {
                continue;
            };
            let drift = params.drift_px * angle / params.max_error_sigmas;
            let direction: Vector3<f64> =
                set_from_camera[slot].rotation * photo.rays.bearings[feature as usize];
            all.rays.push(SetRay {
                origin: set_from_camera[slot].translation,
                direction,
                sigma: (sigma * sigma + scene_sigma * scene_sigma + drift * drift).sqrt(),
                point: index.position(correspondence.scene),
            });
            all.correspondence.push(number);
            all.slot.push(slot);
        }
    }
    all
}

impl SetRays {
    /// Truncated score: Σ over correspondences, each as much as it is worth, of the mean of 1 − min(1, (e/T)²) over their
    /// rays.
    pub(crate) fn score(&self, world_from_set: &Similarity, max_error_sigmas: f64, worth: &[f64]) -> f64 {
        let set_from_world = world_from_set.inverse();
        let (mut gain, mut count) = (vec![0.0; worth.len()], vec![0_usize; worth.len()]);
        for (ray, &correspondence) in self.rays.iter().zip(&self.correspondence) {
            gain[correspondence] +=
                1.0 - (ray.error_sigmas(&set_from_world) / max_error_sigmas).min(1.0).powi(2);
            count[correspondence] += 1;
        }
        gain.iter()
            .zip(&count)
            .zip(worth)
            .filter(|((_, count), _)| **count > 0)
            .map(|((gain, &count), worth)| worth * gain / count as f64)
            .sum()
    }

    /// Correspondences of which at least half of the rays agree with a pose, ascending.
    pub(crate) fn agreeing(
        &self,
        world_from_set: &Similarity,
        max_error_sigmas: f64,
        correspondences: usize,
    ) -> Vec<usize> {
        let set_from_world = world_from_set.inverse();
        let (mut good, mut count) = (vec![0_usize; correspondences], vec![0_usize; correspondences]);
        for (ray, &correspondence) in self.rays.iter().zip(&self.correspondence) {
            good[correspondence] += usize::from(ray.error_sigmas(&set_from_world) < max_error_sigmas);
            count[correspondence] += 1;
        }
        (0..correspondences).filter(|&i| good[i] > 0 && 2 * good[i] >= count[i]).collect()
    }

    /// The rays of some correspondences (`keep[i]` of correspondence `i`).
    pub(crate) fn subset(&self, keep: &[bool]) -> Self {
        let kept: Vec<usize> = (0..self.rays.len()).filter(|&i| keep[self.correspondence[i]]).collect();
        Self {
            rays: kept.iter().map(|&i| self.rays[i]).collect(),
            correspondence: kept.iter().map(|&i| self.correspondence[i]).collect(),
            slot: kept.iter().map(|&i| self.slot[i]).collect(),
        }
    }
}
