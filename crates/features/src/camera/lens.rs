use nalgebra::{Matrix2x3, Matrix2x4, Matrix3x2, Matrix3x4, Vector2, Vector3};

use super::{brown, fisheye, paper_rectilinear};

/// The smallest slope of a distortion curve that still counts as inside its domain.
///
/// Where the slope reaches zero the lens model folds over and a pixel no longer has one ray; just before that point
/// rays are so ill-conditioned that double precision cannot bring them back within 1e-9 rad.
pub(super) const MIN_SLOPE: f64 = 1e-3;

/// Focal lengths, principal point and distortion terms that all single-centre lens models share.
pub(super) struct Intrinsics {
    pub focal: Vector2<f64>,
    pub center: Vector2<f64>,
    pub distortion: [f64; 4],
}

impl Intrinsics {
    pub fn new(fx: f64, fy: f64, cx: f64, cy: f64, distortion: [f64; 4]) -> Self {
        Self { focal: Vector2::new(fx, fy), center: Vector2::new(cx, cy), distortion }
    }

    /// Pixel to distorted point on the focal plane at unit distance.
    pub fn normalize(&self, pixel: &Vector2<f64>) -> Vector2<f64> {
        (pixel - self.center).component_div(&self.focal)
    }

    pub fn denormalize(&self, point: &Vector2<f64>) -> Vector2<f64> {
        point.component_mul(&self.focal) + self.center
    }
}

/// How a direction becomes a distorted point on the focal plane at unit distance.
#[derive(Debug, Clone, Copy)]
pub(super) enum Lens {
    Brown,
    Fisheye,
    PaperRectilinear,
}

pub(super) struct Distorted {
    pub point: Vector2<f64>,
    /// ∂point / ∂direction.
    pub d_direction: Matrix2x3<f64>,
    /// ∂point / ∂distortion terms.
    pub d_distortion: Matrix2x4<f64>,
}

pub(super) struct Undistorted {
    pub bearing: Vector3<f64>,
    /// ∂bearing / ∂point.
    pub d_point: Matrix3x2<f64>,
    /// ∂bearing / ∂distortion terms.
    pub d_distortion: Matrix3x4<f64>,
}

impl Lens {
    pub fn distort(self, direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Vector2<f64>> {
        match self {
            Self::Brown => brown::distort(direction, terms),
            Self::Fisheye => fisheye::distort(direction, terms),
            Self::PaperRectilinear => paper_rectilinear::distort(direction),
        }
    }

    pub fn undistort(self, point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Vector3<f64>> {
        match self {
            Self::Brown => brown::undistort(point, terms),
            Self::Fisheye => fisheye::undistort(point, terms),
            Self::PaperRectilinear => Some(paper_rectilinear::undistort(point)),
        }
    }

    pub fn distort_with_jacobian(self, direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Distorted> {
        match self {
            Self::Brown => brown::distort_with_jacobian(direction, terms),
            Self::Fisheye => fisheye::distort_with_jacobian(direction, terms),
            Self::PaperRectilinear => paper_rectilinear::distort_with_jacobian(direction),
        }
    }

    /// ∂point / ∂direction alone.
    pub fn d_direction(self, direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Matrix2x3<f64>> {
        match self {
            Self::Brown => brown::d_direction(direction, terms),
            _ => self.distort_with_jacobian(direction, terms).map(|distorted| distorted.d_direction),
        }
    }

    pub fn undistort_with_jacobian(self, point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Undistorted> {
        match self {
            Self::Brown => brown::undistort_with_jacobian(point, terms),
            Self::Fisheye => fisheye::undistort_with_jacobian(point, terms),
            Self::PaperRectilinear => Some(paper_rectilinear::undistort_with_jacobian(point)),
        }
    }
}
