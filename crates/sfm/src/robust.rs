//! Robust estimators: LO-RANSAC over the minimal solvers, scored on the sphere.
//!
//! Every estimator counts whitened squared angular residuals, truncated at [`RansacParams::max_error_sigma`], so that
//! rays of different cameras and accuracies mix. A ray supports a model only with positive depth. The same seed gives
//! the same bytes.

pub(crate) mod absolute_pose;
mod absolute_pose_focal;
mod generalized_pose;
pub(crate) mod least_squares;
mod pose_from_views;
mod ransac;
mod ray_homography;
mod relative_pose;
mod residual;
mod turned_camera;

pub use absolute_pose::{AbsolutePoseEstimate, estimate_absolute_pose, refine_absolute_pose, rival_poses};
pub use absolute_pose_focal::{AbsolutePoseFocalEstimate, estimate_absolute_pose_focal};
pub use generalized_pose::{
    GeneralizedPoseEstimate, GeneralizedPoseOptions, GeneralizedSolver, Gravity, SetScale,
    estimate_generalized_pose, refine_generalized_pose,
};
pub(crate) use pose_from_views::{KnownView, refine_pose_from_views};
pub use ransac::{InvalidParams, RansacParams};
pub use ray_homography::{RayHomographyEstimate, estimate_ray_homography};
pub use relative_pose::{
    RelativePoseEstimate, RotationEstimate, estimate_relative_pose, estimate_rotation, refine_relative_pose,
};
pub(crate) use relative_pose::{estimate_level_pose, estimate_turned_pose, misfit_of_rotation};
pub use residual::AngularResidual;
pub use turned_camera::{TurnedCamera, estimate_turned_camera};

use nalgebra::Vector3;

/// A ray of a camera set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeneralizedRay {
    /// Centre of its camera in the set frame.
    pub origin: Vector3<f64>,
    /// Unit direction in the set frame.
    pub direction: Vector3<f64>,
    /// Standard deviation of the direction per tangent axis, in radians.
    pub sigma: f64,
    /// Which camera of the set it belongs to; rays of one camera share their origin.
    pub camera: u32,
}

/// The upper middle of the finite values.
pub(crate) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.retain(|value| value.is_finite());
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
