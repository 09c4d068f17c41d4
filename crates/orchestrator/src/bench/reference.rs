//! What photos' poses are compared with where there is no truth: a reconstruction of scene and photos together, as in the
//! image-set-localization paper.
//!
//! It shares its features, pairs and mapper with what it is compared with, so it tells what localizing in a scene loses against
//! mapping everything anew, and not how far both are off.

use std::collections::BTreeMap;

use anyhow::Result;
use serde::Serialize;
use setloc_sfm::Rigid;

use super::figures::extent;
use super::run::{BenchOptions, poses_of};
use crate::building::{BuildOutcome, SceneSource, build_scene};
use crate::dataset::ImageFolder;
use crate::session::Session;

/// Images of the scene that a joint reconstruction must hold beside photos: fewer do not tell how it lies.
const MIN_SCENE_IMAGES: usize = 3;

/// A joint reconstruction of the scene's images and all sets' photos.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct JointReference {
    /// Images of the scene in its largest model.
    pub scene_images: usize,
    /// Photos in that model.
    pub photos: usize,
    /// Photos of all sets.
    pub of_photos: usize,
    /// Largest distance between the centres of the scene's images, in the units of all errors against it.
    pub extent: f64,
    /// World-from-camera poses of both in its largest model; none where it does not hold both.
    #[serde(skip)]
    pub poses: BTreeMap<String, Rigid>,
}

impl JointReference {
    /// Maps the images of a scene and the photos of sets together.
    ///
    /// # Errors
    /// When the run was stopped or the store cannot be written.
    pub(super) fn build(
        session: &Session,
        scene: &ImageFolder,
        sets: &[&ImageFolder],
        options: &BenchOptions,
        name: &str,
    ) -> Result<Self> {
        let mut folder = scene.clone();
        folder.images.extend(sets.iter().flat_map(|set| set.images.iter().cloned()));
        folder.images.sort_by(|a, b| a.name.cmp(&b.name));
        let source =
            SceneSource { folder: &folder, config: &options.config, seed: options.seed, name, present: None };
        let BuildOutcome::Built(built) = build_scene(session, source, |_| Ok(()))? else {
            anyhow::bail!("the joint reconstruction was not read: this is a bug");
        };
        let poses = built.scene.main().map(poses_of).unwrap_or_default();
        let names = |folder: &ImageFolder| -> Vec<String> {
            folder.images.iter().map(|image| image.name.clone()).collect()
        };
        let photos: Vec<String> = sets.iter().copied().flat_map(names).collect();
        Ok(Self::of(poses, &names(scene), &photos))
    }

    fn of(poses: BTreeMap<String, Rigid>, scene: &[String], photos: &[String]) -> Self {
        let of_scene: Vec<&Rigid> = scene.iter().filter_map(|name| poses.get(name)).collect();
        let among = |names: &[String]| names.iter().filter(|name| poses.contains_key(*name)).count();
        let reference = Self {
            scene_images: of_scene.len(),
            photos: among(photos),
            of_photos: photos.len(),
            extent: extent(of_scene.iter().copied()),
            poses: BTreeMap::new(),
        };
        if reference.scene_images >= MIN_SCENE_IMAGES && reference.photos > 0 {
            Self { poses, ..reference }
        } else {
            reference
        }
    }

    /// Percent of the extent in one of its units.
    pub fn percent(&self) -> f64 {
        100.0 / self.extent
    }

    /// Whether there is anything to compare with.
    pub fn is_usable(&self) -> bool {
        !self.poses.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    fn reference(scene: usize, photos: usize) -> JointReference {
        let pose = |x: usize| Rigid::new(UnitQuaternion::identity(), Vector3::new(x as f64, 0.0, 0.0));
        let named = |of: &str, count: usize| (0..count).map(|at| format!("{of}{at}")).collect::<Vec<_>>();
        let all = named("s", scene).into_iter().chain(named("p", photos));
        let poses = all.enumerate().map(|(at, name)| (name, pose(2 * at))).collect();
        JointReference::of(poses, &named("s", 5), &named("p", 4))
    }

    #[test]
    fn its_extent_is_that_of_the_scene_s_images() {
        let found = reference(4, 3);
        assert_eq!((found.scene_images, found.photos, found.of_photos, found.extent), (4, 3, 4, 6.0));
        assert!(found.is_usable() && found.poses.len() == 7);
    }

    #[test]
    fn a_model_without_photos_or_of_few_scene_images_is_no_reference() {
        for (scene, photos) in [(5, 0), (2, 4), (0, 4)] {
            let found = reference(scene, photos);
            assert!(!found.is_usable(), "{scene} {photos}");
            assert_eq!((found.scene_images, found.photos), (scene, photos));
        }
    }
}
