//! Where the files of a scene's images are.
//!
//! A scene holds what is needed of its images but their pixels: these are looked at only where nothing else tells a set's
//! scale, and panoramas are large. So they stay where they are, and a file beside the scene says where.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::dataset::SourceImage;
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::store::write_atomically;

/// The file that says where the images of a scene are: the scene's name with another ending.
pub fn beside(scene: &Path) -> PathBuf {
    scene.with_extension("images.json")
}

/// Where the files of a scene's images are, by the image's name.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PictureBook(BTreeMap<String, PictureFile>);

/// A file and what was in it when the scene was built.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PictureFile {
    /// Where it was.
    pub path: PathBuf,
    /// Hash of its bytes.
    pub hash: ContentHash,
}

impl PictureBook {
    /// Of images that are read, with absolute paths where these can be told; without those whose paths are no UTF-8, as which the file
    /// beside the scene could not be written.
    pub fn of(images: &[SourceImage]) -> Self {
        let file = |image: &SourceImage| {
            let path = std::path::absolute(&image.path).unwrap_or_else(|_| image.path.clone());
            path.to_str()?;
            Some((image.name.clone(), PictureFile { path, hash: image.hash }))
        };
        Self(images.iter().filter_map(file).collect())
    }

    /// Those of a scene; none where nothing says where they were.
    ///
    /// # Errors
    /// When the file that says it is damaged.
    pub fn read(scene: &Path) -> Result<Self> {
        let path = beside(scene);
        let Ok(bytes) = std::fs::read(&path) else { return Ok(Self::default()) };
        serde_json::from_slice(&bytes).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("{} is not readable", path.display()));
            Hinted::wrap(error, "build the scene again, or remove the file to do without its images' pixels")
        })
    }

    /// Those that are where they were.
    #[must_use]
    pub fn at_hand(&self) -> Self {
        let is_there = |(_, file): &(&String, &PictureFile)| file.path.is_file();
        let there = self.0.iter().filter(is_there);
        Self(there.map(|(name, file)| (name.clone(), file.clone())).collect())
    }

    /// Writes it beside a scene, if that does not say the same.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, scene: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).context("cannot encode the places of images")? + "\n";
        let path = beside(scene);
        if std::fs::read(&path).is_ok_and(|present| present == text.as_bytes()) {
            return Ok(());
        }
        write_atomically(&path, text.as_bytes())
    }

    /// Whether it names none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The file of an image.
    pub fn get(&self, name: &str) -> Option<&PictureFile> {
        self.0.get(name)
    }

    /// One hash for which images there are and what is in them.
    pub fn content(&self) -> ContentHash {
        let hashes = self.0.iter().flat_map(|(name, file)| [ContentHash::of(name.as_bytes()), file.hash]);
        ContentHash::of_all(&hashes.collect::<Vec<_>>())
    }
}

#[cfg(test)]
mod tests {
    use setloc_features::Camera;

    use super::*;

    fn image(path: &Path) -> SourceImage {
        let bytes = std::fs::read(path).unwrap_or_default();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let camera = Camera::equirectangular(64, 32);
        SourceImage {
            path: path.to_owned(),
            hash: ContentHash::of(&bytes),
            ..SourceImage::guessed(&name, camera)
        }
    }

    #[test]
    fn images_that_are_still_there_are_found_again() {
        let root = tempfile::tempdir().unwrap();
        let [kept, gone] = ["a.jpg", "b.jpg"].map(|name| root.path().join(name));
        std::fs::write(&kept, "a").unwrap();
        std::fs::write(&gone, "b").unwrap();
        let book = PictureBook::of(&[image(&kept), image(&gone)]);
        let scene = root.path().join("street.setloc");
        book.write(&scene).unwrap();
        assert!(root.path().join("street.images.json").is_file());
        assert_eq!(PictureBook::read(&scene).unwrap(), book);
        std::fs::remove_file(gone).unwrap();
        assert_eq!(PictureBook::read(&scene).unwrap(), book, "they may come back");
        let left = book.at_hand();
        assert_eq!(left.get("a.jpg").map(|file| file.hash), Some(ContentHash::of(b"a")));
        assert!(left.get("b.jpg").is_none() && left.content() != book.content());
    }

    #[test]
    fn no_file_is_no_error_and_a_damaged_one_is() {
        let root = tempfile::tempdir().unwrap();
        let scene = root.path().join("street.setloc");
        assert_eq!(PictureBook::read(&scene).unwrap(), PictureBook::default());
        std::fs::write(beside(&scene), "{").unwrap();
        let error = format!("{:#}", PictureBook::read(&scene).unwrap_err());
        assert!(error.contains("street.images.json is not readable"), "{error}");
    }
}
