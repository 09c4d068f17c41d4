//! The scale of a set by the scene's walls that its photos show.

use std::cmp::Reverse;

use setloc_sfm::{DistantPhoto, ImageId, Rigid, Similarity, WallSight, scale_by_walls};

use super::{Component, Joint};
use crate::evidence::{log10_chance_of_more, ray_error_sigmas};
use crate::pictures::Picture;
use crate::refine::JointModel;
use crate::set::scale::About;

/// Most images of the scene whose walls are sought.
const MAX_IMAGES: usize = 4;
/// Most photos that are looked at.
const MAX_PHOTOS: usize = 4;
/// How many times more patches must look alike than at any scale far off; as neighbouring ones err alike, chance alone says too
/// little. Right scales of rendered and real sets have 2.1 to 18 times as many, wrong ones (a copy of the building; what a photo
/// shows not in sight of the others), by patches that are less alike, up to 1.24.
const MIN_LEAD: f64 = 1.75;
/// Largest log₁₀ of the chance of as many where as many as at the best of all scales far off are expected: that is the most of some
/// hundred already.
const MAX_LOG10_BY_CHANCE: f64 = -3.0;

/// A set's pose at the scale of the walls.
pub(super) struct ByWalls {
    pub world_from_set: Similarity,
    /// What photos show of them; photos by their slot.
    pub sights: Vec<WallSight>,
    /// Why it is taken, in words.
    pub reason: String,
}

impl Component<'_> {
    /// The scale at which the photos away from the main standpoint show the walls that it sees, where that stands out from
    /// what they show at other scales.
    pub(super) fn by_walls(&self, joint: &Joint, set_from_camera: &[Rigid]) -> Option<ByWalls> {
        let pictures = &self.views.pictures;
        if !self.params.scale_by_walls || !pictures.are_some() {
            return None;
        }
        let main = (0..self.members.len())
            .filter(|&slot| joint.model.photos[slot].standpoint == joint.main_standpoint())
            .max_by_key(|&slot| (joint.direct[slot].len(), Reverse(slot)))?;
        let at_main = joint.model.photos[main].world_from_camera;
        let axes =
            Rigid::new(at_main.rotation * set_from_camera[main].rotation.inverse(), at_main.translation);
        let about = About::photo(&axes, set_from_camera[main].translation);
        let mut away = joint.away_from_main();
        away.sort_by(|&a, &b| {
            let step = |slot: usize| about.step(&set_from_camera[slot].translation).norm();
            step(a).total_cmp(&step(b)).then(a.cmp(&b))
        });
        away.truncate(MAX_PHOTOS);
        let mut photos = Vec::new();
        for slot in away {
            let Some(pyramid) = pictures.get(Picture::Photo(self.members[slot])) else { continue };
            let photo = DistantPhoto {
                camera: joint.model.camera_of(slot),
                rotation: axes.rotation * set_from_camera[slot].rotation,
                step: about.step(&set_from_camera[slot].translation),
                pyramid,
            };
            photos.push((slot, photo));
        }
        let (slots, photos): (Vec<usize>, Vec<DistantPhoto<'_>>) = photos.into_iter().unzip();
        let found = scale_by_walls(
            self.scene.reconstruction,
            &self.images_of(joint, main),
            |point| self.scene.index.position_covariance(point),
            |image| pictures.get(Picture::Scene { component: self.scene.component, image }),
            &at_main.translation,
            &photos,
        )?;
        let by_chance = found.by_chance as f64 + 1.0;
        if (found.found as f64) < MIN_LEAD * by_chance
            || log10_chance_of_more(found.found, by_chance) > MAX_LOG10_BY_CHANCE
        {
            return None;
        }
        let sights: Vec<WallSight> =
            found.sights.iter().map(|sight| WallSight { photo: slots[sight.photo], ..*sight }).collect();
        let reason = format!(
            "its scale is that at which {} patches of walls look as in the scene's images, at others {} at the most",
            found.found, found.by_chance
        );
        Some(ByWalls { world_from_set: about.scaled(found.scale), sights, reason })
    }

    /// The images of the scene that see most of what a photo sees.
    fn images_of(&self, joint: &Joint, slot: usize) -> Vec<ImageId> {
        let scene = self.scene.reconstruction;
        let mut votes = vec![0_usize; scene.images.len()];
        for seen in &joint.direct[slot] {
            for seen in &scene.points[seen.point.index()].track {
                votes[seen.image.index()] += 1;
            }
        }
        let mut images: Vec<ImageId> = scene.registered().filter(|image| votes[image.index()] > 0).collect();
        images.sort_by_key(|image| (Reverse(votes[image.index()]), *image));
        images.truncate(MAX_IMAGES);
        images
    }
}

/// Those that agree with the photos' poses.
pub(super) fn agreeing_walls(model: &JointModel, sights: &[WallSight], bound: f64) -> Vec<WallSight> {
    let agrees = |sight: &&WallSight| {
        let pose = &model.photos[sight.photo].world_from_camera;
        let error = model.camera_of(sight.photo).ray(&sight.place.pixel).map(|(bearing, angle)| {
            let (bearing, sigma) = (pose.rotation * bearing, angle * sight.place.noise_px);
            ray_error_sigmas(&bearing, sigma, &(sight.position - pose.translation), &sight.covariance)
        });
        error.is_some_and(|error| error < bound)
    };
    sights.iter().filter(agrees).copied().collect()
}
