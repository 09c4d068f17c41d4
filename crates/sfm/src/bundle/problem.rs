use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};
use setloc_features::{Camera, ParamRole};

use super::RobustLoss;
use crate::Rigid;

/// Which intrinsic parameters of a camera are estimated.
///
/// A role that the camera's model does not have (distortion of a pinhole, anything of a plain panorama) has no effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntrinsicsFreedom {
    /// Focal length or lengths.
    pub focal: bool,
    /// Principal point.
    pub principal_point: bool,
    /// Distortion coefficients; a stitched panorama's stretch.
    pub distortion: bool,
}

impl IntrinsicsFreedom {
    /// All intrinsics are known.
    pub const FIXED: Self = Self { focal: false, principal_point: false, distortion: false };
    /// All intrinsics are estimated.
    pub const FREE: Self = Self { focal: true, principal_point: true, distortion: true };
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
    /// Standard deviation of each coordinate, in the world's unit of length; infinite where nothing was measured.
    pub sigma: Vector3<f64>,
    /// Loss on the whitened distance.
    pub loss: RobustLoss,
}

impl PositionPrior {
    /// An offset from the measured centre, squared in standard deviations.
    pub(super) fn squared(&self, offset: &Vector3<f64>) -> f64 {
        offset.component_div(&self.sigma).norm_squared()
    }
}

/// A value and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterEstimate {
    /// The value.
    pub value: f64,
    /// Its standard deviation; infinite where nothing is known.
    pub sigma: f64,
}

/// What is known of a camera's intrinsics before anything is seen; parameters that are not estimated have no effect.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPrior {
    /// Index into [`BundleProblem::cameras`].
    pub camera: u32,
    /// One a parameter of the camera, in its order.
    pub parameters: Vec<ParameterEstimate>,
    /// Standard deviation of the ratio of a camera's two focal lengths from 1.
    pub aspect_sigma: f64,
    /// Loss on each of these, in standard deviations.
    pub loss: RobustLoss,
}

/// Scale of the loss on what holds for the usual photo, in standard deviations.
const UNUSUAL: f64 = 2.0;

/// Deviation of focal lengths that are not told apart, as a share.
const ALIKE_FOCAL: f64 = 0.01;
/// Share of the longer side by which the principal point of a picture that was cut lies off its centre: a third cut off on one side is a
/// sixth of what was there, and a quarter of what is left.
const CUT: f64 = 0.2;
/// Share by which a term of distortion that is told may move the corners of an image otherwise.
const AT_CORNER: f64 = 0.005;

impl CameraPrior {
    /// What holds for the usual photo, as standard deviations: the principal point lies within 0.5 % of the longer side of
    /// the image's centre, the first radial coefficient is within 0.2, further ones within 0.05, tangential ones within
    /// 0.001, and pixels are square to 0.1 %; nothing is known of the focal length. Stitched panoramas are stretched
    /// ahead against the sides by 0.3 %, otherwise by 0.1 %, and twisted by 0.1 to 0.15 %, and no loss lets go of that. `None` for plain panoramas,
    /// which have nothing to estimate.
    ///
    /// Calibrations of phones, action and system cameras put the principal point 0.1–1 % off the centre. Photos that were
    /// cropped have it anywhere, so the loss lets go of what is many deviations off.
    pub fn of_usual_photo(index: u32, camera: &Camera) -> Option<Self> {
        if camera.is_panoramic() && !camera.is_stretched() {
            return None;
        }
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let known = |(role, name): (&ParamRole, &&str)| {
            let (value, sigma) = match (role, *name) {
                (ParamRole::PrincipalPoint, "cx") => (width / 2.0, 0.005 * width.max(height)),
                (ParamRole::PrincipalPoint, _) => (height / 2.0, 0.005 * width.max(height)),
                (ParamRole::Distortion, "k" | "k1") => (0.0, 0.2),
                (ParamRole::Distortion, "p1" | "p2") | (ParamRole::Stretch, "xy" | "xz" | "yz") => {
                    (0.0, 0.001)
                }
                (ParamRole::Distortion, _) => (0.0, 0.05),
                (ParamRole::Stretch, "xx") => (0.0, 0.003),
                (ParamRole::Stretch, "txy" | "txz" | "tyz") => (0.0, 0.0015),
                (ParamRole::Stretch, _) => (0.0, 0.001),
                _ => (0.0, f64::INFINITY),
            };
            ParameterEstimate { value, sigma }
        };
        let parameters = camera.param_roles().iter().zip(camera.model.param_names()).map(known).collect();
        let loss = if camera.is_stretched() { RobustLoss::Trivial } else { RobustLoss::Cauchy(UNUSUAL) };
        Some(Self { camera: index, parameters, aspect_sigma: 0.001, loss })
    }

    /// What holds for a picture that may have been cut from the side of a larger one: the principal point lies within 20 % of the longer
    /// side of the image's centre. Everything else is as for the usual photo, but no loss lets go of it.
    pub fn of_cut_photo(index: u32, camera: &Camera) -> Option<Self> {
        let mut prior = Self::of_usual_photo(index, camera)?;
        let longer = f64::from(camera.width.max(camera.height));
        let of_role = prior.parameters.iter_mut().zip(camera.param_roles());
        for (known, _) in of_role.filter(|(_, role)| **role == ParamRole::PrincipalPoint) {
            known.sigma = CUT * longer;
        }
        prior.loss = RobustLoss::Trivial;
        Some(prior)
    }

    /// What holds for the usual photo, and that the focal length is within 1 % of this camera's.
    pub fn alike(index: u32, camera: &Camera) -> Option<Self> {
        let mut prior = Self::of_usual_photo(index, camera)?;
        let focal = camera.param_roles().iter().zip(&camera.params);
        for (known, (_, &value)) in
            prior.parameters.iter_mut().zip(focal).filter(|(_, (role, _))| **role == ParamRole::Focal)
        {
            *known = ParameterEstimate { value, sigma: ALIKE_FOCAL * value };
        }
        Some(prior)
    }

    /// That the focal lengths are within 1 % of this camera's, as a calibration tells them, and their ratio within 0.1 %; that no radial
    /// term moves the corners by more than 0.5 % otherwise than it tells, and tangential terms are within 0.001.
    ///
    /// A calibration is made at one focus and one temperature. Pixels of another ratio than 1 are looser by what they differ.
    pub fn told(index: u32, camera: &Camera) -> Self {
        let corner = f64::from(camera.width).hypot(f64::from(camera.height)) / 2.0 / camera.focal_length();
        let known = |((role, name), &value): ((&ParamRole, &&str), &f64)| {
            let sigma = match (role, *name) {
                (ParamRole::Focal, _) => ALIKE_FOCAL * value,
                (ParamRole::Distortion, "p1" | "p2") => 0.001,
                (ParamRole::Distortion, "k" | "k1") => AT_CORNER / corner.powi(2),
                (ParamRole::Distortion, "k2") => AT_CORNER / corner.powi(4),
                (ParamRole::Distortion, "k3") => AT_CORNER / corner.powi(6),
                (ParamRole::Distortion, _) => AT_CORNER / corner.powi(8),
                _ => f64::INFINITY,
            };
            ParameterEstimate { value, sigma }
        };
        let roles = camera.param_roles();
        let named = roles.iter().zip(camera.model.param_names());
        let parameters = named.zip(&camera.params).map(known).collect();
        let focal = roles.iter().zip(&camera.params).filter(|(role, _)| **role == ParamRole::Focal);
        let [shortest, longest] = focal
            .map(|(_, focal)| *focal)
            .fold([f64::INFINITY, 0.0], |[low, high], focal| [focal.min(low), focal.max(high)]);
        let aspect_sigma = 0.001_f64.hypot(longest / shortest - 1.0);
        Self { camera: index, parameters, aspect_sigma, loss: RobustLoss::Trivial }
    }

    /// Holds the terms of a camera's stretch where they are, to this deviation.
    pub fn hold_stretch(&mut self, camera: &Camera, sigma: f64) {
        let terms = camera.param_roles().iter().zip(&camera.params).zip(&mut self.parameters);
        for ((_, &value), known) in terms.filter(|((role, _), _)| **role == ParamRole::Stretch) {
            *known = ParameterEstimate { value, sigma };
        }
    }

    /// Whether it is one of this camera, in numbers that can be weighed.
    pub(super) fn fits(&self, camera: Option<&Camera>) -> bool {
        camera.is_some_and(|camera| camera.params.len() == self.parameters.len())
            && self.parameters.iter().all(|known| known.value.is_finite() && known.sigma > 0.0)
            && self.aspect_sigma > 0.0
            && self.loss.is_valid()
    }
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
    /// What is known of cameras beforehand; at most one a camera.
    pub camera_priors: Vec<CameraPrior>,
}
