use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};
use setloc_features::Camera;

use super::RobustLoss;
use crate::Rigid;

/// Which intrinsic parameters of a camera are estimated.
///
/// A role that the camera's model does not have (distortion of a pinhole, anything of a panorama) has no effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntrinsicsFreedom {
    /// Focal length or lengths.
    pub focal: bool,
    /// Principal point.
    pub principal_point: bool,
    /// Distortion coefficients.
    pub distortion: bool,
}

impl IntrinsicsFreedom {
    /// All intrinsics are known.
    pub const FIXED: Self = Self { focal: false, principal_point: false, distortion: false };
    /// Focal lengths and distortion are estimated, the principal point is known.
    pub const LENS: Self = Self { focal: true, principal_point: false, distortion: true };
}

/// One image of a bundle problem.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundlePose {
    /// Index into [`BundleProblem::cameras`].
    pub camera: u32,
    /// The pose.
    pub world_from_camera: Rigid,
    /// Whether the pose is known and stays as it is, bit for bit.
    pub fixed: bool,
}

/// One point of a bundle problem.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundlePoint {
    /// Position in the world frame.
    pub position: Vector3<f64>,
    /// Whether the position is known and stays as it is, bit for bit.
    pub fixed: bool,
}

/// A pose sees a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundleObservation {
    /// Index into [`BundleProblem::poses`].
    pub pose: u32,
    /// Index into [`BundleProblem::points`].
    pub point: u32,
    /// Where the point is seen, in pixels.
    pub pixel: Vector2<f64>,
    /// Standard deviation of each pixel coordinate.
    pub noise_px: f64,
}

/// A pose sees a point in a direction that is known without a camera model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundleBearing {
    /// Index into [`BundleProblem::poses`].
    pub pose: u32,
    /// Index into [`BundleProblem::points`].
    pub point: u32,
    /// Unit direction in the camera frame; it may lie outside of what the camera sees.
    pub bearing: Vector3<f64>,
    /// Standard deviation per tangent axis in radians.
    pub sigma: f64,
}

/// A measured camera centre, as of GPS.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionPrior {
    /// Index into [`BundleProblem::poses`].
    pub pose: u32,
    /// Measured centre in the world frame.
    pub position: Vector3<f64>,
    /// Standard deviation of each coordinate, in the world's unit of length.
    pub sigma: f64,
    /// Loss on the whitened distance.
    pub loss: RobustLoss,
}

/// Cameras, poses, points and what ties them together.
///
/// Observations, bearings and priors that cannot be used (indices out of range, values that are not finite, pixels outside the
/// camera's domain) are ignored and counted in the report.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BundleProblem {
    /// Cameras, shared by poses.
    pub cameras: Vec<Camera>,
    /// What is estimated of each camera; cameras beyond the end of this list are fixed.
    pub camera_freedom: Vec<IntrinsicsFreedom>,
    /// Images.
    pub poses: Vec<BundlePose>,
    /// Points.
    pub points: Vec<BundlePoint>,
    /// Observations in any order.
    pub observations: Vec<BundleObservation>,
    /// Observations by direction, in any order.
    pub bearings: Vec<BundleBearing>,
    /// Measured camera centres.
    pub position_priors: Vec<PositionPrior>,
}
