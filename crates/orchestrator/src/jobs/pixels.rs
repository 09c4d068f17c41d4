//! Pixels of photos and of a scene's images, read when they are asked for.

use std::collections::BTreeMap;
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

    /// Theirs and those of a scene's components; none where none of its images is at hand.
    pub fn of(&self, components: &[Scene<'_>]) -> Pictures {
        let files_of = |scene: &Scene<'_>| -> Vec<Option<(PathBuf, ContentHash, bool)>> {
            let images = &scene.reconstruction.images;
            let file = |at: usize| {
                let file = self.book.get(&images[at].name)?;
                let wraps = scene.reconstruction.cameras[images[at].camera.index()].wraps_around();
                Some((file.path.clone(), file.hash, wraps))
            };
            (0..images.len()).map(file).collect()
        };
        let files: BTreeMap<usize, Vec<_>> =
            components.iter().map(|scene| (scene.component, files_of(scene))).collect();
        if files.values().flatten().all(Option::is_none) {
            return Pictures::default();
        }
        let (photos, pyramids) = (self.photos.clone(), Arc::clone(&self.pyramids));
        let failures = Arc::clone(&self.failures);
        Pictures::new(move |picture| {
            let (path, hash, wraps) = match picture {
                Picture::Photo(at) => photos.get(at).map(|(path, hash)| (path, *hash, false))?,
                Picture::Scene { component, image } => {
                    let (path, hash, wraps) = files.get(&component)?.get(image.index())?.as_ref()?;
                    (path, *hash, *wraps)
                }
            };
            let read = pyramids.get((path, hash), wraps);
            read.map_err(|error| {
                let text =
                    format!("{} is not looked at, since it is not what it was: {error:#}", path.display());
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

#[cfg(test)]
mod tests {
    use setloc_features::Camera;
    use setloc_index::SceneIndex;
    use setloc_sfm::{CameraId, ImageId, Reconstruction, ReconstructionImage};

    use super::*;

    #[test]
    fn an_image_that_is_not_what_it_was_is_named_and_not_looked_at() {
        let root = tempfile::tempdir().unwrap();
        let camera = Camera::equirectangular(256, 128);
        let source = |name: &str, grey: u8| {
            let path = root.path().join(name);
            image::GrayImage::from_pixel(256, 128, image::Luma([grey])).save(&path).unwrap();
            let hash = ContentHash::of(&std::fs::read(&path).unwrap());
            SourceImage { path, hash, ..SourceImage::guessed(name, camera.clone()) }
        };
        let [kept, changed] = ["a.png", "b.png"].map(|name| source(name, 80));
        let book = Arc::new(PictureBook::of(&[kept.clone(), changed.clone()]));
        source("b.png", 90);
        let listed = |name: &str| ReconstructionImage {
            name: name.to_owned(),
            camera: CameraId(0),
            world_from_camera: None,
        };
        let reconstruction = Reconstruction {
            cameras: vec![camera.clone()],
            images: ["a.png", "b.png", "c.png"].map(listed).to_vec(),
            ..Reconstruction::default()
        };
        let scene = Scene {
            component: 0,
            is_placed: false,
            reconstruction: &reconstruction,
            index: &SceneIndex::default(),
            grown: &[],
            doubtful: &[],
            errors: None,
        };
        let at_hand = PicturesAtHand::new(&book, &[&kept]);
        let pictures = at_hand.of(&[scene]);
        let is_there = |picture| pictures.get(picture).is_some();
        let of_scene = |at| Picture::Scene { component: 0, image: ImageId(at) };
        assert!(is_there(Picture::Photo(0)) && !is_there(Picture::Photo(1)));
        assert_eq!([0, 1, 2, 3].map(|at| is_there(of_scene(at))), [true, false, false, false]);
        let [failure] = &at_hand.failures()[..] else { panic!("{:?}", at_hand.failures()) };
        assert!(failure.contains("b.png is not looked at"), "{failure}");
        // Without any of the scene's images there is nothing to lay photos over.
        assert!(!PicturesAtHand::new(&Arc::default(), &[&kept]).of(&[scene]).are_some());
    }
}
