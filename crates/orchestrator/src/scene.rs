//! A scene file: everything that localization needs, in one file.

use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use setloc_features::Wgs84;
use setloc_index::SceneIndex;
use setloc_sfm::Reconstruction;

use crate::codec;
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::serde_artifact;

/// A built scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SceneFile {
    /// Components, largest first; the index is of the first.
    pub components: Vec<Reconstruction>,
    /// Searchable descriptors of the first component.
    pub index: SceneIndex,
    /// WGS84 place of the world's origin, when positions were given.
    pub origin: Option<Wgs84>,
    /// What the mapper found worth saying.
    pub warnings: Vec<String>,
    /// What it did that is worth knowing and no reason for doubt.
    pub notes: Vec<String>,
    /// The configuration it was built with, as TOML: of the stages that a scene depends on.
    pub config: String,
    /// Hash of what localization depends on: the models and the index, not how images are called or what was set.
    pub content: ContentHash,
}

serde_artifact!(SceneFile, "scene", 7);

impl SceneFile {
    /// Reads a scene file.
    ///
    /// # Errors
    /// When it is missing, damaged or no scene.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        codec::decode(&bytes).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("{} is no usable scene", path.display()));
            Hinted::wrap(error, "build it again with `setloc build PANORAMAS -o scene.setloc`")
        })
    }

    /// The largest component.
    pub fn main(&self) -> Option<&Reconstruction> {
        self.components.first()
    }
}
