//! A scene file: everything that localization needs, in one file.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use setloc_camset::GrownImage;
use setloc_features::{ImageFeatures, Wgs84};
use setloc_index::SceneIndex;
use setloc_sfm::{CorrectedCamera, FrameErrors, ImageId, ModelErrors, Reconstruction, Rigid};

use crate::codec::{self, Artifact};
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::serde_artifact;

/// A built scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SceneFile {
    /// Components, largest first; all list the same images.
    pub components: Vec<Reconstruction>,
    /// Searchable descriptors of each component.
    pub indices: Vec<SceneIndex>,
    /// Whether measured positions place each component in the frame of `origin`; if not, its frame is its own.
    pub placed: Vec<bool>,
    /// What each component may be off in that frame as a whole, where that is told.
    pub frame_errors: Vec<Option<FrameErrors>>,
    /// Images of each component about which it may be wrong; ascending.
    pub doubtful: Vec<Vec<ImageId>>,
    /// Cameras whose told intrinsics the images contradict; photos of the same camera are contradicted with them.
    pub corrected: Vec<CorrectedCamera>,
    /// What each component may be off, where that is told.
    pub errors: Vec<Option<ModelErrors>>,
    /// Features of the images, by image id, as artifacts; empty where no component has registered an image. Photos that
    /// share too little with the points are matched with them ([`SceneFile::features_of`]).
    pub features: Vec<Block>,
    /// WGS84 place of the world's origin, when positions were given; at [`NO_ALTITUDE`] when none of them has one.
    pub origin: Option<Wgs84>,
    /// What the mapper found worth saying.
    pub warnings: Vec<String>,
    /// What it did that is worth knowing and no reason for doubt.
    pub notes: Vec<String>,
    /// The configuration it was built with, as TOML: of the stages that a scene depends on.
    pub config: String,
    /// Images of the first component that are photos which it has grown by, ascending; they come after all others.
    pub grown: Vec<GrownImage>,
    /// Contents of these photos' files, in the same order.
    pub grown_from: Vec<ContentHash>,
    /// Hash of what localization depends on: the models, the index and the version of what else is made of them, not how images are
    /// called or what was set.
    pub content: ContentHash,
}

serde_artifact!(SceneFile, "scene", 18);

/// Altitude of an origin where none was measured: heights are relative. A measured zero is positive.
pub const NO_ALTITUDE: f64 = -0.0;

/// Whether altitudes were measured, of which this is the scene's origin.
pub fn has_altitude(origin: Wgs84) -> bool {
    origin.alt.to_bits() != NO_ALTITUDE.to_bits()
}

/// Bytes that are stored as one block.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Block(#[serde(with = "setloc_index::bytes")] pub Vec<u8>);

impl SceneFile {
    /// The features of an image; `None` where no component has registered it.
    ///
    /// # Errors
    /// When the file is damaged.
    pub fn features_of(&self, image: ImageId) -> Result<Option<ImageFeatures>> {
        let Some(block) = self.features.get(image.index()).filter(|block| !block.0.is_empty()) else {
            return Ok(None);
        };
        let features = ImageFeatures::from_payload(&block.0);
        Ok(Some(features.with_context(|| format!("features of image {} of the scene", image.0))?))
    }

    /// Reads a scene file.
    ///
    /// # Errors
    /// When it is missing, damaged or no scene.
    pub fn read(path: &Path) -> Result<Self> {
        Ok(Self::read_with_hash(path)?.0)
    }

    /// The same with the hash of the file.
    ///
    /// # Errors
    /// As [`SceneFile::read`].
    pub fn read_with_hash(path: &Path) -> Result<(Self, ContentHash)> {
        if path.is_dir() {
            let file = path.with_extension("setloc");
            let is_there = file.is_file() && file != path;
            let example = if is_there { format!(", as {}", file.display()) } else { String::new() };
            return Err(Hinted::error(
                format!("{} is a folder, and no scene", path.display()),
                format!("name the file that `setloc build` wrote (-o){example}"),
            ));
        }
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let scene = codec::decode(&bytes).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("{} is no usable scene", path.display()));
            Hinted::wrap(error, "build it again with `setloc build PANORAMAS -o scene.setloc`")
        })?;
        Ok((scene, ContentHash::of(&bytes)))
    }

    /// Names of the images that are photos which it has grown by.
    pub fn grown_names(&self) -> BTreeSet<&str> {
        let images = self.main().map_or(&[][..], |model| &model.images);
        self.grown.iter().filter_map(|grown| Some(images.get(grown.image.index())?.name.as_str())).collect()
    }

    /// Whether measured positions place a component in the frame of `origin`.
    pub fn is_placed(&self, component: usize) -> bool {
        self.placed.get(component) == Some(&true)
    }

    /// What a component that is placed in the frame of `origin` may be off there as a whole, where that is told.
    pub fn frame_errors_of(&self, component: usize) -> Option<&FrameErrors> {
        self.frame_errors.get(component).filter(|_| self.is_placed(component))?.as_ref()
    }

    /// Whether a component's frame is that of the largest.
    pub fn shares_frame(&self, component: usize) -> bool {
        component == 0 || (self.is_placed(0) && self.is_placed(component))
    }

    /// Names and poses of the images in the frame of `origin`, by name: those of all components that measured positions
    /// place.
    pub fn placed_poses(&self) -> Vec<(String, Rigid)> {
        let placed = self.components.iter().enumerate().filter(|(at, _)| self.is_placed(*at));
        let poses = placed.flat_map(|(_, component)| &component.images);
        let mut poses: Vec<_> =
            poses.filter_map(|image| Some((image.name.clone(), image.world_from_camera?))).collect();
        poses.sort_by(|(a, _), (b, _)| a.cmp(b));
        poses
    }

    /// Names of the images that no component has a pose of; ascending.
    pub fn unregistered(&self) -> Vec<&str> {
        let images = self.main().map_or(&[][..], |main| &main.images);
        let is_nowhere = |at: &usize| {
            let poses =
                self.components.iter().filter_map(|component| component.images.get(*at)?.world_from_camera);
            poses.count() == 0
        };
        let mut names: Vec<&str> =
            (0..images.len()).filter(is_nowhere).map(|at| images[at].name.as_str()).collect();
        names.sort_unstable();
        names
    }

    /// The largest component.
    pub fn main(&self) -> Option<&Reconstruction> {
        self.components.first()
    }
}

#[cfg(test)]
mod tests {
    use setloc_sfm::{CameraId, ReconstructionImage};

    use super::*;

    #[test]
    fn components_keep_their_indices_and_frames() {
        let scene = SceneFile {
            components: vec![Reconstruction::default(); 3],
            indices: vec![SceneIndex::default(); 3],
            placed: vec![true, false, true],
            errors: vec![None, Some(ModelErrors::new(1e-4, vec![vec![None, Some(Rigid::identity())]])), None],
            ..SceneFile::default()
        };
        let read: SceneFile = codec::decode(&codec::encode(&scene).unwrap()).unwrap();
        assert_eq!(read, scene);
        assert_eq!([0, 1, 2, 3].map(|component| read.shares_frame(component)), [true, false, true, false]);
        let own = SceneFile { placed: vec![false, false, true], ..scene };
        assert_eq!([0, 1, 2].map(|component| own.shares_frame(component)), [true, false, false]);
    }

    #[test]
    fn a_folder_of_exports_is_no_scene_and_the_file_beside_it_is_named() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("s");
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(root.path().join("s.setloc"), "").unwrap();
        let error = SceneFile::read(&folder).unwrap_err();
        let hint = error.downcast_ref::<Hinted>().unwrap().hint();
        assert!(
            error.to_string().ends_with("s is a folder, and no scene") && hint.ends_with("s.setloc"),
            "{hint}"
        );
    }

    #[test]
    fn an_altitude_of_zero_is_one_and_none_is_kept_apart() {
        let scene =
            |alt| SceneFile { origin: Some(Wgs84 { lat: 47.0, lon: 8.0, alt }), ..SceneFile::default() };
        let read = |alt| {
            let scene: SceneFile = codec::decode(&codec::encode(&scene(alt)).unwrap()).unwrap();
            has_altitude(scene.origin.unwrap())
        };
        assert_eq!([0.0, 400.0, NO_ALTITUDE].map(read), [true, true, false]);
    }

    #[test]
    fn poses_on_the_map_are_of_all_components_that_are_placed_there() {
        let component = |registered: usize| Reconstruction {
            images: ["c", "b", "a"]
                .iter()
                .enumerate()
                .map(|(at, name)| ReconstructionImage {
                    name: (*name).to_owned(),
                    camera: CameraId(0),
                    world_from_camera: (at == registered).then(Rigid::identity),
                })
                .collect(),
            ..Reconstruction::default()
        };
        let scene = SceneFile {
            components: (0..3).map(component).collect(),
            placed: vec![true, false, true],
            ..SceneFile::default()
        };
        let names: Vec<String> = scene.placed_poses().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["a", "c"]);
    }

    #[test]
    fn features_are_read_image_by_image_and_damage_is_said() {
        let features = ImageFeatures { width: 20, height: 10, ..ImageFeatures::default() };
        let mut block = Block::default();
        features.write_payload(&mut block.0).unwrap();
        let damaged = Block(block.0[..10].to_vec());
        let scene = SceneFile { features: vec![Block::default(), block, damaged], ..SceneFile::default() };
        let bytes = codec::encode(&scene).unwrap();
        let scene: SceneFile = codec::decode(&bytes).unwrap();
        assert_eq!(scene.features_of(ImageId(0)).unwrap(), None);
        assert_eq!(scene.features_of(ImageId(1)).unwrap(), Some(features));
        let error = scene.features_of(ImageId(2)).unwrap_err();
        assert!(error.to_string().contains("image 2 of the scene"), "{error:#}");
        assert_eq!(scene.features_of(ImageId(3)).unwrap(), None);
    }
}
