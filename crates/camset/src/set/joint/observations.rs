//! What of a component's matches is observed: scene points, local points tied to these, and free ones.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Matrix3;
use rayon::prelude::*;
use setloc_features::Keypoint;
use setloc_sfm::{ImageId, Place, PointId, Similarity};

use super::Component;
use crate::evidence::{PhotoRays, median};
use crate::guided::guided_matches;
use crate::refine::{JointModel, JointObservations, SceneView, Sighting, TiedPoint};
use crate::set::correspondences::SetCorrespondence;
use crate::set::rigid::RigidPose;
use crate::set::sights::Sights;
use crate::single::{inliers, union};
use crate::{GuidedParams, SceneMatch};

impl Component<'_> {
    /// Correspondences that agree with the rigid pose, as they are.
    pub(super) fn rigid_observations(
        &self,
        candidates: &[SetCorrespondence],
        rigid: &RigidPose,
    ) -> JointObservations {
        let mut direct = vec![Vec::new(); self.members.len()];
        let (mut locals, mut tied) = (BTreeSet::new(), Vec::new());
        for &number in &rigid.agreeing {
            let candidate = &candidates[number];
            for &(slot, feature) in &candidate.seen_by {
                direct[slot].push(SceneMatch { feature, point: candidate.scene });
            }
            if let Some(local) = candidate.local.filter(|local| locals.insert(*local)) {
                tied.extend(self.tied(local, candidate.scene, &rigid.world_from_set));
            }
        }
        let direct = direct.into_iter().map(unique).collect();
        JointObservations { direct, tied, tracks: self.free_tracks(&locals), ..JointObservations::default() }
    }

    /// A local point as a scene point with all its sightings, where it is aligned.
    fn tied(&self, local: usize, scene: PointId, world_from_set: &Similarity) -> Option<TiedPoint> {
        let aligned = self.model.points[local].aligned.as_ref()?;
        let spot = world_from_set.transform_covariance(&aligned.spot.cast());
        Some(TiedPoint { scene, seen: self.sightings(local), spot })
    }

    /// Correspondences and guided matches that agree with the present poses.
    ///
    /// A local point that is a scene point is replaced by it, in all photos that see it.
    pub(super) fn observations(
        &self,
        model: &JointModel,
        rays: &[PhotoRays<'_>],
        candidates: &[SetCorrespondence],
        world_from_set: &Similarity,
        widening: f64,
    ) -> JointObservations {
        let index = self.scene.index;
        let bound = self.params.max_error_sigmas * widening;
        let guided_params =
            GuidedParams { radius_px: self.params.guided.radius_px * widening, ..self.params.guided.clone() };
        let guided: Vec<Vec<SceneMatch>> = (0..self.members.len())
            .into_par_iter()
            .with_max_len(1)
            .map(|slot| {
                let pose = &model.photos[slot].world_from_camera;
                let nearest = self.evidence[self.members[slot]].nearest;
                guided_matches(&guided_params, index, &rays[slot], nearest, pose)
            })
            .collect();
        let agrees = |slot: usize, feature: u32, point: PointId| {
            let found = SceneMatch { feature, point };
            rays[slot].error_sigmas(index, &model.photos[slot].world_from_camera, found) < bound
        };
        let local_of = self.local_points_of_features();
        let mut votes: BTreeMap<usize, BTreeMap<PointId, usize>> = BTreeMap::new();
        let mut lone: Vec<Vec<SceneMatch>> = vec![Vec::new(); self.members.len()];
        for candidate in candidates {
            match candidate.local {
                Some(local) => *votes.entry(local).or_default().entry(candidate.scene).or_default() += 1,
                None => lone[candidate.seen_by[0].0]
                    .push(SceneMatch { feature: candidate.seen_by[0].1, point: candidate.scene }),
            }
        }
        for (slot, found) in guided.iter().enumerate() {
            let mut own = Vec::new();
            for &found in found {
                match local_of[slot].get(&found.feature) {
                    Some(&local) => *votes.entry(local).or_default().entry(found.point).or_default() += 1,
                    None => own.push(found),
                }
            }
            lone[slot] = union(
                &inliers(&rays[slot], index, &model.photos[slot].world_from_camera, &lone[slot], bound),
                &own,
            );
        }
        let mut direct: Vec<Vec<SceneMatch>> = vec![Vec::new(); self.members.len()];
        let (mut locals, mut tied) = (BTreeSet::new(), Vec::new());
        for (local, votes) in votes {
            let track = self.track(local);
            let best = votes
                .into_iter()
                .map(|(point, votes)| {
                    let agreeing =
                        track.iter().filter(|&&(slot, feature)| agrees(slot, feature, point)).count();
                    (agreeing, votes, std::cmp::Reverse(point))
                })
                .max();
            let Some((agreeing, _, std::cmp::Reverse(point))) = best else { continue };
            if agreeing == 0 || 2 * agreeing < track.len() {
                continue;
            }
            locals.insert(local);
            for (slot, feature) in track {
                if agrees(slot, feature, point) {
                    direct[slot].push(SceneMatch { feature, point });
                }
            }
            if let Some(mut point_seen) = self.tied(local, point, world_from_set) {
                let position = index.position(point);
                let noise = index.position_covariance(point);
                point_seen.seen.retain(|seen| {
                    let pose = &model.photos[seen.photo].world_from_camera;
                    rays[seen.photo].sighting_error_sigmas(pose, seen, &position, &noise) < bound
                });
                tied.push(point_seen);
            }
        }
        for (slot, lone) in lone.iter().enumerate() {
            let agreeing = inliers(&rays[slot], index, &model.photos[slot].world_from_camera, lone, bound);
            direct[slot] = unique(union(&direct[slot], &agreeing));
        }
        let tracks = agreeing_tracks(model, rays, self.free_tracks(&locals), bound);
        JointObservations { direct, tied, tracks, ..JointObservations::default() }
    }

    /// Slots and features that see a local point.
    pub(super) fn track(&self, local: usize) -> Vec<(usize, u32)> {
        self.seen_by_keypoints(local).map(|(_, slot, feature, _)| (slot, feature)).collect()
    }

    /// The keypoints of a local point: place in its track, slot, feature and the keypoint.
    fn seen_by_keypoints(&self, local: usize) -> impl Iterator<Item = (usize, usize, u32, &Keypoint)> {
        self.model.points[local].track.iter().enumerate().filter_map(|(at, seen)| {
            let slot = self.members.binary_search(&seen.image.index()).ok()?;
            let keypoints = &self.photos[self.members[slot]].features.keypoints;
            Some((at, slot, seen.feature, keypoints.get(seen.feature as usize)?))
        })
    }

    /// Where the photos show a local point: by their pixels where it is aligned, else by their keypoints.
    fn sightings(&self, local: usize) -> Vec<Sighting> {
        let point = &self.model.points[local];
        let slot_of = |image: ImageId| self.members.binary_search(&image.index()).ok();
        let by_keypoint = self.seen_by_keypoints(local).filter_map(|(at, photo, feature, keypoint)| {
            let own = Place::from(keypoint);
            let place = match &point.aligned {
                Some(aligned) => *aligned.places.get(at)?,
                None => own,
            };
            Some(Sighting { photo, feature: Some(feature), place, keypoint_noise_px: own.noise_px })
        });
        let mut sightings: Vec<Sighting> = by_keypoint.collect();
        if let Some(aligned) = &point.aligned {
            let noise = sightings.iter().map(|seen| seen.keypoint_noise_px).collect();
            let keypoint_noise_px = median(noise).unwrap_or(0.0);
            let further = aligned.further.iter().filter_map(|&(image, place)| {
                Some(Sighting { photo: slot_of(image)?, feature: None, place, keypoint_noise_px })
            });
            sightings.extend(further);
        }
        sightings
    }

    fn local_points_of_features(&self) -> Vec<BTreeMap<u32, usize>> {
        let mut local_of = vec![BTreeMap::new(); self.members.len()];
        for local in 0..self.model.points.len() {
            for (slot, feature) in self.track(local) {
                local_of[slot].insert(feature, local);
            }
        }
        local_of
    }

    /// Sightings of all local points that are not scene points.
    fn free_tracks(&self, tied: &BTreeSet<usize>) -> Vec<(usize, Sighting)> {
        (0..self.model.points.len())
            .filter(|local| !tied.contains(local))
            .flat_map(|local| {
                let seen = self.sightings(local);
                let seen_twice = seen.len() >= 2;
                seen.into_iter().filter(move |_| seen_twice).map(move |seen| (local, seen))
            })
            .collect()
    }
}

/// Those of some sights whose local points are free.
pub(super) fn free_views(
    sights: &Sights,
    agreeing: &[usize],
    tracks: &[(usize, Sighting)],
) -> Vec<(usize, SceneView)> {
    let free: BTreeSet<usize> = tracks.iter().map(|(local, _)| *local).collect();
    let view = |&at: &usize| {
        let sight = &sights.all[at];
        let view = SceneView { image: sight.seen.image, place: sight.place };
        free.contains(&sight.local).then_some((sight.local, view))
    };
    agreeing.iter().filter_map(view).collect()
}

/// The observations that agree with the present poses and local points; points seen once only are left out.
fn agreeing_tracks(
    model: &JointModel,
    rays: &[PhotoRays<'_>],
    tracks: Vec<(usize, Sighting)>,
    bound: f64,
) -> Vec<(usize, Sighting)> {
    let mut views = vec![0_usize; model.points.len()];
    let mut agreeing = tracks;
    agreeing.retain(|(point, seen)| {
        let pose = &model.photos[seen.photo].world_from_camera;
        let error =
            rays[seen.photo].sighting_error_sigmas(pose, seen, &model.points[*point], &Matrix3::zeros());
        views[*point] += usize::from(error < bound);
        error < bound
    });
    agreeing.retain(|(point, _)| views[*point] >= 2);
    agreeing
}

/// Each feature once, by its first match; sorted.
fn unique(mut matches: Vec<SceneMatch>) -> Vec<SceneMatch> {
    matches.sort_unstable();
    matches.dedup_by_key(|m| m.feature);
    matches
}
