use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::Deserialize;
use setloc_features::Camera;

use super::find_by_name;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CamerasFile {
    #[serde(default, rename = "convention")]
    _convention: String,
    cameras: BTreeMap<String, Camera>,
    images: BTreeMap<String, String>,
}

/// Known cameras, by image.
#[derive(Debug, Clone, Default)]
pub struct CameraBook {
    /// Where they were read from.
    pub(super) file: Option<PathBuf>,
    by_image: BTreeMap<String, Camera>,
}

impl CameraBook {
    /// Reads a `cameras.json`.
    ///
    /// # Errors
    /// With file, line and key, when it is not one or a camera is not usable.
    pub fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {shown}"))?;
        let file: CamerasFile =
            serde_json::from_str(&text).with_context(|| format!("{shown} is no cameras.json"))?;
        for (name, camera) in &file.cameras {
            camera.validate().with_context(|| format!("{shown}: camera `{name}`"))?;
        }
        let mut by_image = BTreeMap::new();
        for (image, name) in file.images {
            let known = || file.cameras.keys().cloned().collect::<Vec<_>>().join(", ");
            let camera = file.cameras.get(&name);
            let camera = camera.with_context(|| {
                format!("{shown}: image `{image}` has camera `{name}`, known are: {}", known())
            })?;
            by_image.insert(image, camera.clone());
        }
        Ok(Self { file: Some(path.to_owned()), by_image })
    }

    /// The camera of an image, if the file names it.
    pub fn find(&self, name: &str, path: &Path) -> Option<&Camera> {
        find_by_name(&self.by_image, name, path)
    }

    /// The first image that the file names.
    pub(super) fn first_name(&self) -> Option<&str> {
        self.by_image.keys().next().map(String::as_str)
    }
}
