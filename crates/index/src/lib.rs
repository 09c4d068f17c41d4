//! The scene's descriptors made searchable: 2D-to-3D and 3D-to-3D matching.

use serde::{Deserialize, Serialize};
use setloc_features::ImageFeatures;
use setloc_sfm::Reconstruction;

/// How to index a scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IndexParams {}

/// Searchable descriptors of a scene; self-contained (needs no features once built).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SceneIndex {}

impl SceneIndex {
    /// Indexes the descriptors of all observations of all points; `features[i]` belongs to image `i`.
    pub fn build(_params: &IndexParams, _reconstruction: &Reconstruction, _features: &[&ImageFeatures]) -> Self {
        Self {}
    }
}
