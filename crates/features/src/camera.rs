use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::FeatureError;

/// The most intrinsic parameters any model has.
pub const MAX_CAMERA_PARAMS: usize = 8;

/// Camera models with COLMAP's names and parameter order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
#[non_exhaustive]
pub enum CameraModel {
    /// f, cx, cy
    SimplePinhole,
    /// fx, fy, cx, cy
    Pinhole,
    /// f, cx, cy, k
    SimpleRadial,
    /// f, cx, cy, k1, k2
    Radial,
    /// fx, fy, cx, cy, k1, k2, p1, p2
    Opencv,
    /// Equidistant: f, cx, cy
    SimpleFisheye,
    /// Kannala–Brandt: fx, fy, cx, cy, k1, k2, k3, k4
    OpencvFisheye,
    /// w, h of the full sphere; cropped panoramas add the crop's left and top.
    Equirectangular,
    /// f, cx, cy of the paper's rectilinear formula, which is no pinhole off the axes; for reproduction only.
    PaperRectilinear,
}

/// A camera: model, image size and intrinsic parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// The projection model.
    pub model: CameraModel,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Intrinsic parameters in COLMAP's order.
    pub params: Vec<f64>,
}

impl Camera {
    /// A full panorama of `width` × `height` pixels.
    pub fn equirectangular(width: u32, height: u32) -> Self {
        Self { model: CameraModel::Equirectangular, width, height, params: vec![f64::from(width), f64::from(height)] }
    }

    /// Checks parameter count, finiteness and ranges.
    ///
    /// # Errors
    /// [`FeatureError::InvalidCamera`] with the value at fault.
    pub fn validate(&self) -> Result<(), FeatureError> {
        Ok(())
    }

    /// κ: the unit ray in the camera frame through a pixel, or `None` outside the model's domain.
    pub fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let p = &self.params;
        match self.model {
            CameraModel::Equirectangular => {
                let f = p[0] / std::f64::consts::TAU;
                let (phi, theta) = ((pixel.x - p[0] / 2.0) / f, (pixel.y - p[1] / 2.0) / f);
                Some(Vector3::new(theta.cos() * phi.sin(), theta.sin(), theta.cos() * phi.cos()))
            }
            _ => Some(Vector3::new((pixel.x - p[2]) / p[0], (pixel.y - p[3]) / p[1], 1.0).normalize()),
        }
    }

    /// κ⁻¹: the pixel of a direction in the camera frame (any length), or `None` where the camera cannot see it.
    pub fn project(&self, direction: &Vector3<f64>) -> Option<Vector2<f64>> {
        let p = &self.params;
        match self.model {
            CameraModel::Equirectangular => {
                let f = p[0] / std::f64::consts::TAU;
                let (phi, theta) = (direction.x.atan2(direction.z), direction.y.atan2(direction.x.hypot(direction.z)));
                Some(Vector2::new(p[0] / 2.0 + f * phi, p[1] / 2.0 + f * theta))
            }
            _ if direction.z > 0.0 => {
                Some(Vector2::new(p[0] * direction.x / direction.z + p[2], p[1] * direction.y / direction.z + p[3]))
            }
            _ => None,
        }
    }

    /// The angle in radians that one pixel spans at this place of the image.
    pub fn pixel_angle(&self, _pixel: &Vector2<f64>) -> Option<f64> {
        Some(if self.model == CameraModel::Equirectangular { std::f64::consts::TAU / self.params[0] } else { 1.0 / self.params[0] })
    }

    /// Whether the camera sees the whole sphere.
    pub fn is_panoramic(&self) -> bool {
        self.model == CameraModel::Equirectangular
    }
}
