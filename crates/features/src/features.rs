use std::ops::Range;

use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::Camera;

/// Length of one descriptor in bytes (RootSIFT quantized to `u8`).
pub const DESCRIPTOR_LEN: usize = 128;

/// Euclidean length of a stored descriptor, up to rounding and clipping of single components at 255.
pub const DESCRIPTOR_NORM: u16 = 512;

/// A detected point of one image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Keypoint {
    /// Column in pixels; the centre of the first pixel is 0.5.
    pub x: f32,
    /// Row in pixels; the centre of the first pixel is 0.5.
    pub y: f32,
    /// Diameter of the described region in pixels of the image, at this place.
    pub size: f32,
    /// Orientation in radians, clockwise from image right.
    pub orientation: f32,
    /// Expected standard deviation of the position, in pixels of the image at this place.
    pub noise_px: f32,
}

impl Keypoint {
    /// The position in pixels.
    pub fn pixel(&self) -> Vector2<f64> {
        Vector2::new(f64::from(self.x), f64::from(self.y))
    }
}

/// Where the keypoints of a simulated view are in [`ImageFeatures::keypoints`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SimulatedView {
    /// Its first keypoint.
    pub start: u32,
    /// How many of its keypoints are brighter than their surround; they come first.
    pub light: u32,
}

/// Keypoints, descriptors and colours of one image, index by index.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ImageFeatures {
    /// Image width in pixels, after EXIF orientation.
    pub width: u32,
    /// Image height in pixels, after EXIF orientation.
    pub height: u32,
    /// The detected points: first those brighter than their surround, then those darker; in each part the strongest
    /// first. Those of simulated views follow, each view in the same order.
    pub keypoints: Vec<Keypoint>,
    /// How many of the image's own keypoints are brighter than their surround.
    pub light: u32,
    /// Where the keypoints of simulated views are (see [`crate::FeatureParams::simulated_tilt`]); they come after the
    /// image's own.
    pub simulated: Vec<SimulatedView>,
    /// Row-major descriptors, `keypoints.len() × DESCRIPTOR_LEN`.
    pub descriptors: Vec<u8>,
    /// sRGB colour of the image at each keypoint.
    pub colors: Vec<[u8; 3]>,
}

impl ImageFeatures {
    /// Number of keypoints.
    pub fn len(&self) -> usize {
        self.keypoints.len()
    }

    /// Whether nothing was detected.
    pub fn is_empty(&self) -> bool {
        self.keypoints.is_empty()
    }

    /// The descriptor of one keypoint.
    pub fn descriptor(&self, index: usize) -> &[u8] {
        &self.descriptors[index * DESCRIPTOR_LEN..(index + 1) * DESCRIPTOR_LEN]
    }

    /// Number of keypoints found in the image itself.
    pub fn own_len(&self) -> usize {
        self.simulated.first().map_or(self.len(), |view| (view.start as usize).min(self.len()))
    }

    /// The strongest keypoints of the image itself: up to so many brighter than their surround, and as many darker.
    #[must_use]
    pub fn strongest(&self, of_each: usize) -> Self {
        let [bright, dark] = self.parts().map(|part| part.start..part.end.min(part.start + of_each));
        let [bright_colors, dark_colors] =
            [&bright, &dark].map(|part| self.colors.get(part.clone()).unwrap_or(&[]));
        Self {
            width: self.width,
            height: self.height,
            keypoints: [&self.keypoints[bright.clone()], &self.keypoints[dark.clone()]].concat(),
            light: bright.len() as u32,
            simulated: Vec::new(),
            descriptors: [self.descriptors_of(&bright), self.descriptors_of(&dark)].concat(),
            colors: [bright_colors, dark_colors].concat(),
        }
    }

    /// The indices of the image's own keypoints that are brighter than their surround, and of those darker.
    pub fn parts(&self) -> [Range<usize>; 2] {
        let own = self.own_len();
        let light = (self.light as usize).min(own);
        [0..light, light..own]
    }

    /// The same of each simulated view.
    pub fn simulated_parts(&self) -> impl Iterator<Item = [Range<usize>; 2]> + '_ {
        self.simulated.iter().enumerate().map(|(at, view)| {
            let next = self.simulated.get(at + 1).map_or(self.len(), |next| next.start as usize);
            let end = next.min(self.len());
            let start = (view.start as usize).min(end);
            let light = start.saturating_add(view.light as usize).min(end);
            [start..light, light..end]
        })
    }

    /// The image's own features alone.
    #[must_use]
    pub fn without_simulated_views(&self) -> Self {
        let own = self.own_len();
        let mut features = self.clone();
        features.simulated.clear();
        features.keypoints.truncate(own);
        features.descriptors.truncate(own * DESCRIPTOR_LEN);
        features.colors.truncate(own);
        features
    }

    /// The descriptors of some keypoints.
    pub(crate) fn descriptors_of(&self, indices: &Range<usize>) -> &[u8] {
        &self.descriptors[indices.start * DESCRIPTOR_LEN..indices.end * DESCRIPTOR_LEN]
    }

    /// The keypoints as rays of `camera`; `None` bearings never occur for keypoints that the camera can see.
    ///
    /// Keypoints outside the domain of κ get the zero vector and an infinite standard deviation, so that no
    /// estimator can use them.
    pub fn rays(&self, camera: &Camera) -> Rays {
        let (bearings, sigmas) = self.keypoints.iter().map(|keypoint| ray(keypoint, camera)).unzip();
        Rays { bearings, sigmas }
    }

    /// [`Self::rays`] of some keypoints by index, the others as where the camera model has no ray. Indices of no keypoint
    /// are ignored.
    pub fn rays_of(&self, camera: &Camera, keypoints: impl IntoIterator<Item = u32>) -> Rays {
        let (bearings, sigmas) = (vec![Vector3::zeros(); self.len()], vec![f64::INFINITY; self.len()]);
        let mut rays = Rays { bearings, sigmas };
        for index in keypoints.into_iter().map(|index| index as usize).filter(|&index| index < self.len()) {
            (rays.bearings[index], rays.sigmas[index]) = ray(&self.keypoints[index], camera);
        }
        rays
    }
}

/// The bearing of a keypoint and its angular standard deviation.
fn ray(keypoint: &Keypoint, camera: &Camera) -> (Vector3<f64>, f64) {
    match camera.ray(&keypoint.pixel()) {
        Some((bearing, angle)) => (bearing, angle * f64::from(keypoint.noise_px)),
        None => (Vector3::zeros(), f64::INFINITY),
    }
}

/// Unit rays of one image's keypoints in its camera frame, with their angular standard deviations.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rays {
    /// Unit vectors in the camera frame (x right, y down, z forward).
    pub bearings: Vec<Vector3<f64>>,
    /// Angular standard deviation of each bearing in radians.
    pub sigmas: Vec<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_strongest_are_the_first_of_either_kind() {
        let keypoint = |x: f32| Keypoint { x, y: 1.0, size: 3.0, orientation: 0.0, noise_px: 0.1 };
        let features = ImageFeatures {
            width: 10,
            height: 8,
            keypoints: (0..7_u8).map(|at| keypoint(f32::from(at))).collect(),
            light: 3,
            simulated: vec![SimulatedView { start: 6, light: 1 }],
            descriptors: (0..7).flat_map(|at| [at; DESCRIPTOR_LEN]).collect(),
            colors: (0..7).map(|at| [at; 3]).collect(),
        };
        let strongest = features.strongest(2);
        let places: Vec<f32> = strongest.keypoints.iter().map(|keypoint| keypoint.x).collect();
        assert_eq!(places, [0.0, 1.0, 3.0, 4.0]);
        assert_eq!((strongest.light, strongest.colors[2], strongest.descriptor(3)[0]), (2, [3; 3], 4));
        assert!(strongest.simulated.is_empty());
        assert_eq!(features.strongest(9).len(), 6, "views of other tilts are no own keypoints");
    }
}
