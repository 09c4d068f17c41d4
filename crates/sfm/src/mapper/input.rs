//! What the mapper works on.

use std::sync::Arc;

use nalgebra::Vector3;
use setloc_features::{Calibration, Camera, ImageFeatures, Match};

use super::Mosaic;
use crate::{CameraId, ImageId, PairGeometry, TwoViewParams};

/// One image to map.
#[derive(Debug, Clone, Copy)]
pub struct InputImage<'a> {
    /// Name as the user knows it.
    pub name: &'a str,
    /// Index into [`MapperInput::cameras`].
    pub camera: CameraId,
    /// Its features.
    pub features: &'a ImageFeatures,
    /// Measured centre in local east-north-up metres, when GPS is given.
    pub position_prior: Option<Vector3<f64>>,
    /// What it covers, when it is a mosaic of photos from one standpoint; `None` for plain images.
    pub mosaic: Option<&'a Mosaic>,
}

impl<'a> InputImage<'a> {
    /// A plain image whose centre was not measured.
    pub fn new(name: &'a str, camera: CameraId, features: &'a ImageFeatures) -> Self {
        Self { name, camera, features, position_prior: None, mosaic: None }
    }
}

/// What the mapper works on.
#[derive(Debug, Clone)]
pub struct MapperInput<'a> {
    /// Cameras, shared by images.
    pub cameras: Vec<Camera>,
    /// How well each camera is known; all but guesses stay fixed.
    pub calibrations: Vec<Calibration>,
    /// All images; ids are indices.
    pub images: Vec<InputImage<'a>>,
    /// Verified pairs.
    pub pairs: &'a [PairGeometry],
    /// All matches of the pairs, also those that no geometry explains; pairs left out count with their inliers.
    pub putative: &'a [PutativePair],
    /// How pairs of mosaics are verified.
    pub two_view: TwoViewParams,
}

#[cfg(test)]
impl<'a> MapperInput<'a> {
    /// Plain images of one known camera.
    pub(crate) fn of_one_camera(
        camera: &Camera,
        features: impl IntoIterator<Item = &'a ImageFeatures>,
        pairs: &'a [PairGeometry],
    ) -> Self {
        let image = |features| InputImage::new("image", CameraId(0), features);
        Self {
            cameras: vec![camera.clone()],
            calibrations: vec![Calibration::Known],
            images: features.into_iter().map(image).collect(),
            pairs,
            putative: &[],
            two_view: TwoViewParams::default(),
        }
    }
}

impl MapperInput<'_> {
    /// Whether the intrinsics of a camera stay as they are.
    pub(crate) fn is_fixed(&self, camera: usize) -> bool {
        self.calibrations[camera].is_settled()
    }

    /// The index of an image's camera.
    pub(crate) fn camera_index(&self, image: ImageId) -> usize {
        self.images[image.index()].camera.index()
    }

    /// The camera of an image.
    pub(crate) fn camera_of(&self, image: ImageId) -> &Camera {
        &self.cameras[self.camera_index(image)]
    }

    /// Whether an image is a panorama.
    pub(crate) fn is_panoramic(&self, image: ImageId) -> bool {
        self.camera_of(image).is_panoramic()
    }
}

/// The verified pairs of each image, in their order: to look through all of them for one image takes long where there are many.
#[derive(Debug, Clone)]
pub(super) struct PairsByImage<'a>(Arc<Vec<Vec<&'a PairGeometry>>>);

impl<'a> PairsByImage<'a> {
    pub fn of(input: &MapperInput<'a>) -> Self {
        let mut of_image = vec![Vec::new(); input.images.len()];
        for pair in input.pairs {
            for image in [pair.first, pair.second] {
                of_image[image.index()].push(pair);
            }
        }
        Self(Arc::new(of_image))
    }

    pub fn of_image(&self, image: ImageId) -> impl Iterator<Item = &'a PairGeometry> + '_ {
        self.0[image.index()].iter().copied()
    }
}

/// All matches of two images, before verification.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PutativePair {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Its matches.
    pub matches: Vec<Match>,
}

#[cfg(test)]
mod tests {
    use super::super::test_street::{POINTS, Street};
    use super::*;

    #[test]
    fn the_pairs_of_an_image_come_in_their_order() {
        let street = Street::new("pairs", 60, POINTS);
        let pairs = PairsByImage::of(&street.input());
        let images = |of: u32| -> Vec<[u32; 2]> {
            pairs.of_image(ImageId(of)).map(|pair| [pair.first.0, pair.second.0]).collect()
        };
        assert_eq!([images(0), images(1), images(2)], [[[0, 1], [0, 2]], [[0, 1], [1, 2]], [[0, 2], [1, 2]]]);
    }
}
