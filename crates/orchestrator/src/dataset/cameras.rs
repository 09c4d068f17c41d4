use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::de::{Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use setloc_features::Camera;

use super::find_by_name;
use crate::error::Hinted;
use crate::text::read_text;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CamerasFile {
    #[serde(default, rename = "convention")]
    _convention: String,
    #[serde(deserialize_with = "unique")]
    cameras: BTreeMap<String, Camera>,
    #[serde(deserialize_with = "unique")]
    images: BTreeMap<String, String>,
}

/// A map in which no key is twice: one of the two would be meant for nothing.
fn unique<'de, D, T>(deserializer: D) -> Result<BTreeMap<String, T>, D::Error>
where
    D: Deserializer<'de>,
    T: Deserialize<'de>,
{
    struct Unique<T>(PhantomData<T>);
    impl<'de, T: Deserialize<'de>> Visitor<'de> for Unique<T> {
        type Value = BTreeMap<String, T>;

        fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
            formatter.write_str("a map")
        }

        fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
            let mut map = BTreeMap::new();
            while let Some(key) = entries.next_key::<String>()? {
                if map.contains_key(&key) {
                    return Err(A::Error::custom(format!("`{key}` is there twice")));
                }
                map.insert(key, entries.next_value()?);
            }
            Ok(map)
        }
    }
    deserializer.deserialize_map(Unique(PhantomData))
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
    /// With file, line and key, when it is not one or a camera is not usable or cannot be that of its image.
    pub fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = read_text(path)?;
        let file: CamerasFile =
            serde_json::from_str(&text).with_context(|| format!("{shown} is no cameras.json"))?;
        for (name, camera) in &file.cameras {
            let checked = camera.validate().and_then(|()| camera.check_plausible());
            checked.with_context(|| format!("{shown}: camera `{name}`")).map_err(|error| {
                let params = camera.model.param_names().join(", ");
                let size = format!("{} × {}", camera.width, camera.height);
                let hint =
                    format!("its params are {params}, in pixels of an image of {size} that begins at (0, 0)");
                Hinted::wrap(error, hint)
            })?;
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
        Some(find_by_name(&self.by_image, name, path)?.1)
    }

    /// What an image is called in the file, if it names it.
    pub(super) fn listed_name(&self, name: &str, path: &Path) -> Option<&str> {
        Some(find_by_name(&self.by_image, name, path)?.0)
    }

    /// The first image that the file names.
    pub(super) fn first_name(&self) -> Option<&str> {
        self.by_image.keys().next().map(String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(camera: &str) -> Result<CameraBook> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cameras.json");
        let images = r#"{"a.jpg": "lens"}"#;
        std::fs::write(&path, format!(r#"{{"cameras": {{"lens": {camera}}}, "images": {images}}}"#)).unwrap();
        CameraBook::read(&path)
    }

    #[test]
    fn cameras_that_no_image_has_are_named_with_file_value_and_remedy() {
        let pinhole = |params: &str| {
            read(&format!(r#"{{"model": "PINHOLE", "width": 1024, "height": 768, "params": [{params}]}}"#))
        };
        assert!(pinhole("760, 760, 512, 384").is_ok());
        let error = pinhole("760, 760, 5120, 3840").unwrap_err();
        let said = format!("{error:#}");
        assert!(said.contains("cameras.json: camera `lens`") && said.contains("(5120, 3840)"), "{said}");
        let hint = error.downcast_ref::<Hinted>().unwrap().hint();
        assert_eq!(
            hint,
            "its params are fx, fy, cx, cy, in pixels of an image of 1024 × 768 that begins at (0, 0)"
        );
    }

    #[test]
    fn a_name_that_is_there_twice_is_refused_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cameras.json");
        let lens = r#"{"model": "PINHOLE", "width": 1024, "height": 768, "params": [760, 760, 512, 384]}"#;
        let read = |cameras: &str, images: &str| {
            let text = format!("\u{feff}{{\n\"cameras\": {{{cameras}}},\n\"images\": {{{images}}}}}");
            std::fs::write(&path, text.replace('@', lens)).unwrap();
            CameraBook::read(&path).map_err(|error| format!("{error:#}"))
        };
        assert!(read(r#""a": @, "b": @"#, r#""1.jpg": "a", "2.jpg": "b""#).is_ok());
        let of_cameras = read(r#""a": @, "a": @"#, "").unwrap_err();
        assert!(of_cameras.contains("`a` is there twice at line 2"), "{of_cameras}");
        let of_images = read(r#""a": @, "b": @"#, r#""1.jpg": "a", "1.jpg": "b""#).unwrap_err();
        assert!(of_images.contains("`1.jpg` is there twice at line 3"), "{of_images}");
    }
}
