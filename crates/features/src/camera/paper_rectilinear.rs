//! The rectilinear formula of the image-set-localization paper (its equation for rectilinear cameras), for reproduction.
//!
//! p = arctan((u−u_c)/f), t = arctan((v−v_c)/f), ray = (cos t sin p, sin t, cos t cos p). A pinhole has
//! tan t = (v−v_c)/f · cos p instead, so this is a pinhole on the two axes only; at 45° both ways it is 9.7° off.

use nalgebra::{Matrix2x3, Matrix2x4, Matrix3x2, Matrix3x4, Vector2, Vector3};

use super::lens::{Distorted, Undistorted};

pub(super) fn distort(direction: &Vector3<f64>) -> Option<Vector2<f64>> {
    (direction.z > 0.0).then(|| {
        let horizontal = direction.x.hypot(direction.z);
        Vector2::new(direction.x / direction.z, direction.y / horizontal)
    })
}

pub(super) fn distort_with_jacobian(direction: &Vector3<f64>) -> Option<Distorted> {
    let point = distort(direction)?;
    let (x, y, z) = (direction.x, direction.y, direction.z);
    let horizontal = x.hypot(z);
    let cube = horizontal * horizontal * horizontal;
    let d_direction =
        Matrix2x3::new(1.0 / z, 0.0, -x / (z * z), -y * x / cube, 1.0 / horizontal, -y * z / cube);
    Some(Distorted { point, d_direction, d_distortion: Matrix2x4::zeros() })
}

pub(super) fn undistort(point: &Vector2<f64>) -> Vector3<f64> {
    let ((sin_p, cos_p), (sin_t, cos_t)) = (point.x.atan().sin_cos(), point.y.atan().sin_cos());
    Vector3::new(cos_t * sin_p, sin_t, cos_t * cos_p)
}

pub(super) fn undistort_with_jacobian(point: &Vector2<f64>) -> Undistorted {
    let ((sin_p, cos_p), (sin_t, cos_t)) = (point.x.atan().sin_cos(), point.y.atan().sin_cos());
    let (d_p, d_t) = (1.0 / (1.0 + point.x * point.x), 1.0 / (1.0 + point.y * point.y));
    Undistorted {
        bearing: Vector3::new(cos_t * sin_p, sin_t, cos_t * cos_p),
        d_point: Matrix3x2::new(
            cos_t * cos_p * d_p,
            -sin_t * sin_p * d_t,
            0.0,
            cos_t * d_t,
            -cos_t * sin_p * d_p,
            -sin_t * cos_p * d_t,
        ),
        d_distortion: Matrix3x4::zeros(),
    }
}
