//! Panoramas whose stitching stretches directions: those of the sphere, then xx, xy, xz, yz.
//!
//! ray ∝ (I + Q) e with e the ray of the plain panorama and Q symmetric without trace and without a vertical term:
//!
//! ```text
//!     ⎡ xx  xy   xz ⎤
//! Q = ⎢ xy   0   yz ⎥
//!     ⎣ xz  yz  −xx ⎦
//! ```
//!
//! These are the smoothest fields on the sphere that neither turn nor shift it (gradients of the spherical harmonics of
//! degree 2): a positive xx means that what lies ahead and behind spans more than the plain panorama says and what lies at
//! the sides less, as with two fisheyes whose radial calibration is a little off. The fifth such term stretches the
//! vertical; upright panoramas do not tell it, as a scene stretched like them would look the same.

use nalgebra::{Matrix3, Matrix3x2, SMatrix, Vector2, Vector3};

use super::{MAX_CAMERA_PARAMS, PlainRay, ProjectJacobian, UnprojectJacobian, equirectangular};

/// Parameters of the sphere and its crop.
const OF_SPHERE: usize = 4;
/// What each further parameter stretches.
const TERMS: [Matrix3<f64>; 4] = [
    Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0),
    Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    Matrix3::new(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0),
];

/// I + Q.
fn stretch(params: &[f64]) -> Matrix3<f64> {
    TERMS.iter().zip(&params[OF_SPHERE..]).fold(Matrix3::identity(), |sum, (term, by)| sum + term * *by)
}

/// The direction that a plain panorama would show where this one shows `direction`.
fn unstretched(params: &[f64], direction: &Vector3<f64>) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let inverse = stretch(params).try_inverse()?;
    Some((inverse * direction, inverse))
}

pub(super) fn unproject(params: &[f64], pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
    let plain = equirectangular::unproject(&params[..OF_SPHERE], pixel)?;
    (stretch(params) * plain).try_normalize(0.0)
}

pub(super) fn project(params: &[f64], direction: &Vector3<f64>) -> Option<Vector2<f64>> {
    equirectangular::project(&params[..OF_SPHERE], &unstretched(params, direction)?.0)
}

pub(super) fn project_with_jacobian(params: &[f64], direction: &Vector3<f64>) -> Option<ProjectJacobian> {
    let (plain, inverse) = unstretched(params, direction)?;
    let mut projected = equirectangular::project_with_jacobian(&params[..OF_SPHERE], &plain)?;
    for (at, term) in TERMS.iter().enumerate() {
        // d A⁻¹ = −A⁻¹ dA A⁻¹
        let moved = -(projected.d_direction * (inverse * (term * plain)));
        projected.d_params.set_column(OF_SPHERE + at, &moved);
    }
    projected.d_direction *= inverse;
    Some(projected)
}

pub(super) fn unproject_with_jacobian(params: &[f64], pixel: &Vector2<f64>) -> Option<UnprojectJacobian> {
    let plain = equirectangular::unproject_with_jacobian(&params[..OF_SPHERE], pixel)?;
    let (mut ray, by_plain) = stretched(params, &PlainRay { bearing: plain.bearing, d_pixel: plain.d_pixel });
    for at in 0..OF_SPHERE {
        ray.d_params.set_column(at, &(by_plain * plain.d_params.column(at)));
    }
    Some(ray)
}

#[inline(always)]
pub(super) fn plain_ray(params: &[f64], pixel: &Vector2<f64>) -> Option<PlainRay> {
    let ray = equirectangular::unproject_with_jacobian(&params[..OF_SPHERE], pixel)?;
    Some(PlainRay { bearing: ray.bearing, d_pixel: ray.d_pixel })
}

/// The ray of a pixel and how it moves with it.
pub(super) fn ray(params: &[f64], pixel: &Vector2<f64>) -> Option<(Vector3<f64>, Matrix3x2<f64>)> {
    let ray = stretched(params, &plain_ray(params, pixel)?).0;
    Some((ray.bearing, ray.d_pixel))
}

/// The ray for a plain one, without its derivatives by the parameters of the sphere.
pub(super) fn of_plain(params: &[f64], plain: &PlainRay) -> UnprojectJacobian {
    stretched(params, plain).0
}

/// And ∂ray/∂(plain ray). In its caller, which leaves out what it has no use for.
#[inline(always)]
fn stretched(params: &[f64], plain: &PlainRay) -> (UnprojectJacobian, Matrix3<f64>) {
    let stretch = stretch(params);
    let stretched = stretch * plain.bearing;
    let length = stretched.norm();
    let bearing = stretched / length;
    let tangent = (Matrix3::identity() - bearing * bearing.transpose()) / length;
    let by_plain = tangent * stretch;
    let d_pixel = [0, 1].map(|at| by_plain * plain.d_pixel.column(at));
    let mut d_params = SMatrix::<f64, 3, MAX_CAMERA_PARAMS>::zeros();
    for (at, term) in TERMS.iter().enumerate() {
        d_params.set_column(OF_SPHERE + at, &(tangent * (term * plain.bearing)));
    }
    let ray = UnprojectJacobian { bearing, d_pixel: Matrix3x2::from_columns(&d_pixel), d_params };
    (ray, by_plain)
}
