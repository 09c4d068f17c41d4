//! Whether a placed set shows the scene's surfaces as its images do.

use std::cmp::Reverse;

use nalgebra::Vector3;
use setloc_sfm::{Likeness, PlacedPhoto, SurfacePlace, likeness_of, places_on_surfaces};

use super::{Component, Joint};
use crate::pictures::Picture;

/// Most photos that are looked at, and places of these that are enough.
const MAX_PHOTOS: usize = 6;
const ENOUGH: usize = 400;
/// Fewest places that tell.
const MIN_COMPARED: usize = 24;
/// Share of places that look alike, of those that do not by chance, below which a set is elsewhere. Right sets have 0.47 (shade where the
/// scene has sun) to 1, one before another poster of the same series has 0.17.
const MIN_SHARE: f64 = 0.3;

impl Component<'_> {
    /// Why a placed set is not where it seems: what it shows between its matches looks otherwise in the scene's images.
    pub(super) fn looks_otherwise(&self, joint: &Joint) -> Option<String> {
        let likeness = self.likeness(joint)?;
        let is_otherwise = likeness.compared >= MIN_COMPARED && likeness.share() < MIN_SHARE;
        is_otherwise.then(|| {
            format!(
                "of {} places of its photos between these matches that lie on surfaces of the scene {} look as in the scene's images, \
                 by chance {:.0} % (do other things look alike in part?)",
                likeness.compared,
                likeness.alike,
                100.0 * likeness.by_chance()
            )
        })
    }

    /// How much of what is not matched looks alike, of the photos that show most of it.
    fn likeness(&self, joint: &Joint) -> Option<Likeness> {
        let pictures = self.pictures.filter(|pictures| pictures.are_some())?;
        let mut looks: Vec<(usize, PlacedPhoto<'_>, Vec<SurfacePlace>)> = (0..self.members.len())
            .map(|slot| {
                let camera = joint.model.camera_of(slot);
                let world_from_camera = joint.model.photos[slot].world_from_camera;
                let photo = PlacedPhoto { camera, world_from_camera };
                let shown = self.shown_unmatched(joint, slot);
                let places = places_on_surfaces(self.scene.reconstruction, &photo, &shown);
                (slot, photo, places)
            })
            .collect();
        looks.sort_by_key(|(slot, _, places)| (Reverse(places.len()), *slot));
        if looks.iter().map(|(.., places)| places.len()).sum::<usize>() < MIN_COMPARED {
            return None;
        }
        let mut likeness = Likeness::default();
        for (slot, photo, places) in looks.iter().take(MAX_PHOTOS) {
            if places.is_empty() || likeness.compared >= ENOUGH {
                break;
            }
            let Some(pyramid) = pictures.get(Picture::Photo(self.members[*slot])) else { continue };
            let of_photo = likeness_of(self.scene.reconstruction, (photo, &pyramid), places, |image| {
                pictures.get(Picture::Scene { component: self.scene.component, image })
            });
            likeness = likeness.and(&of_photo);
        }
        Some(likeness)
    }

    /// The local points that a photo shows, but for those that are matched with the scene.
    fn shown_unmatched(&self, joint: &Joint, slot: usize) -> Vec<Vector3<f64>> {
        let is_matched = |&(slot, feature): &(usize, u32)| {
            let direct = &joint.direct[slot];
            let at = direct.partition_point(|seen| seen.feature < feature);
            direct.get(at).is_some_and(|seen| seen.feature == feature)
        };
        let shown = |&local: &usize| {
            let track = self.track(local);
            track.iter().any(|&(seer, _)| seer == slot) && !track.iter().any(is_matched)
        };
        (0..self.model.points.len()).filter(shown).map(|local| joint.model.points[local]).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;
    use std::sync::Arc;

    use nalgebra::Vector2;
    use setloc_features::{Camera, GreyImage, ImagePyramid};
    use setloc_sfm::Rigid;

    use crate::synthetic::{Place, World};
    use crate::{
        CamsetParams, LocalModels, Picture, Pictures, SetLocalization, SingleLocalization, SingleParams,
        Verdict, Views, locate_set, locate_single,
    };

    /// Half of the distance between the walls of a street.
    const WALL: f64 = 8.0;

    fn noise(seed: u32, x: i64, y: i64) -> f64 {
        let mut h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77);
        h ^= seed.wrapping_mul(0x27d4_eb2f);
        h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
        f64::from(h ^ (h >> 15)) / f64::from(u32::MAX)
    }

    /// What a camera sees of the walls of a street that are painted by `seed`.
    fn painted(seed: u32, camera: &Camera, pose: &Rigid) -> Option<Arc<ImagePyramid>> {
        let grey = |at: u32| {
            let pixel = Vector2::new(f64::from(at % camera.width) + 0.5, f64::from(at / camera.width) + 0.5);
            let ray = pose.rotation * camera.unproject(&pixel)?;
            let hit = pose.translation + ray * ((WALL * ray.x.signum() - pose.translation.x) / ray.x);
            let tile = |size: f64| {
                let (u, v) = (hit.y / size, hit.z / size);
                let at = |dx, dy| noise(seed, u.floor() as i64 + dx, v.floor() as i64 + dy);
                let (u, v) = (u - u.floor(), v - v.floor());
                (at(0, 0) * (1.0 - u) + at(1, 0) * u) * (1.0 - v) + (at(0, 1) * (1.0 - u) + at(1, 1) * u) * v
            };
            Some((120.0 * (tile(0.4) + tile(0.15))) as u8)
        };
        let values = (0..camera.width * camera.height).map(|at| grey(at).unwrap_or(0)).collect();
        let image = GreyImage::from_values(camera.width, camera.height, values).ok()?;
        Some(Arc::new(ImagePyramid::new(image, camera.wraps_around())))
    }

    #[test]
    fn a_set_that_shows_the_scene_s_walls_painted_otherwise_is_in_doubt() {
        let world = Arc::new(World::chain_in(&Place::street(3500, 1).flat(WALL), 6, 0.2, 1));
        let (scene, photos) = (world.scene(), world.queries());
        let alone: Vec<_> =
            photos.iter().map(|photo| locate_single(&SingleParams::default(), &scene, photo, 7)).collect();
        let alone: Vec<_> = alone.iter().map(SingleLocalization::evidence).collect();
        let located = |pictures: Option<&Pictures>| -> SetLocalization {
            let models = LocalModels { pictures, ..std::slice::from_ref(&world.local).into() };
            let views = || Ok::<_, Infallible>(Views::default());
            let Ok(found) = locate_set(&CamsetParams::default(), &scene, &photos, &alone, models, views, 7);
            found
        };
        let painted_by = |seed: u32| {
            let world = Arc::clone(&world);
            Pictures::new(move |picture| match picture {
                Picture::Photo(at) => painted(seed, &world.camera, &world.photos[at].pose),
                Picture::Scene { image, .. } => {
                    let model = world.scene().reconstruction;
                    painted(1, model.camera_of(image), &model.images[image.index()].world_from_camera?)
                }
            })
        };
        let is_localized =
            |found: &SetLocalization| found.refined.iter().all(|photo| photo.verdict == Verdict::Localized);
        assert!(is_localized(&located(None)));
        assert!(is_localized(&located(Some(&painted_by(1)))));
        let other = located(Some(&painted_by(2)));
        for photo in other.refined.iter().chain(&other.rigid) {
            assert_eq!(photo.verdict, Verdict::Uncertain, "{photo:?}");
        }
        let reasons = &other.refined[0].reasons;
        assert!(reasons.iter().any(|reason| reason.contains("look as in the scene's images")), "{reasons:?}");
    }
}
