//! Pixels of photos and of a scene's images, read when they are asked for.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use setloc_camset::{Picture, Pictures, Scene};

use super::alignment::Pyramids;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::pictures::PictureBook;

/// The files of a set's photos and of the scene's images.
pub(super) struct PicturesAtHand {
    book: Arc<PictureBook>,
    photos: Vec<(PathBuf, ContentHash)>,
    pyramids: Arc<Pyramids>,
    failures: Arc<Mutex<Vec<String>>>,
}

impl PicturesAtHand {
    pub fn new(book: &Arc<PictureBook>, photos: &[&SourceImage]) -> Self {
        Self {
            book: Arc::clone(book),
            photos: photos.iter().map(|photo| (photo.path.clone(), photo.hash)).collect(),
            pyramids: Arc::default(),
            failures: Arc::default(),
        }
    }

    /// Those of one component of the scene; none where none of its images is at hand.
    pub fn of(&self, scene: &Scene<'_>) -> Pictures {
        let images = &scene.reconstruction.images;
        let file = |at: usize| {
            let file = self.book.get(&images[at].name)?;
            let wraps = scene.reconstruction.cameras[images[at].camera.index()].wraps_around();
            Some((file.path.clone(), file.hash, wraps))
        };
        let files: Vec<Option<(PathBuf, ContentHash, bool)>> = (0..images.len()).map(file).collect();
        if files.iter().all(Option::is_none) {
            return Pictures::default();
        }
        let (photos, pyramids) = (self.photos.clone(), Arc::clone(&self.pyramids));
        let failures = Arc::clone(&self.failures);
        Pictures::new(move |picture| {
            let (path, hash, wraps) = match picture {
                Picture::Photo(at) => photos.get(at).map(|(path, hash)| (path, *hash, false))?,
                Picture::Scene(image) => {
                    let file = files.get(image.index())?.as_ref()?;
                    (&file.0, file.1, file.2)
                }
            };
            let read = pyramids.get((path, hash), wraps);
            read.map_err(|error| {
                let text = format!("{error:#}: its pixels tell nothing");
                let mut failures = failures.lock().unwrap_or_else(PoisonError::into_inner);
                if !failures.contains(&text) {
                    failures.push(text);
                }
            })
            .ok()
        })
    }

    /// What could not be read, and why; sorted.
    pub fn failures(&self) -> Vec<String> {
        let mut failures = self.failures.lock().unwrap_or_else(PoisonError::into_inner).clone();
        failures.sort();
        failures
    }
}
