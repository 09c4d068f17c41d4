//! Kannala–Brandt and equidistant fisheye.
//!
//! J. Kannala, S. Brandt, "A generic camera model and calibration method…", PAMI 2006. With θ the angle from the
//! optical axis and s = θ²: `point = θ (1 + k1 s + k2 s² + k3 s³ + k4 s⁴) (x, y) / ‖(x, y)‖`. Directions behind the
//! camera are inside as long as the curve still grows; only θ = π, where the azimuth is lost, is not.

use std::f64::consts::PI;

use nalgebra::{Matrix2x3, Matrix2x4, Matrix3x2, Matrix3x4, Vector2, Vector3};

use super::lens::{Distorted, MIN_SLOPE, Undistorted};
use super::newton::invert_growing;

/// Steps of the search for the first angle at which the curve stops growing.
const DOMAIN_STEPS: usize = 128;

pub(super) fn distort(direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Vector2<f64>> {
    let rho = direction.x.hypot(direction.y);
    let theta = visible_angle(rho, direction.z, terms)?;
    Some(if rho > 0.0 { direction.xy() * (curve(theta, terms) / rho) } else { Vector2::zeros() })
}

pub(super) fn distort_with_jacobian(direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Distorted> {
    let (x, y, z) = (direction.x, direction.y, direction.z);
    let rho = x.hypot(y);
    let theta = visible_angle(rho, z, terms)?;
    if rho == 0.0 {
        let d_direction = Matrix2x3::new(1.0 / z, 0.0, 0.0, 0.0, 1.0 / z, 0.0);
        return Some(Distorted { point: Vector2::zeros(), d_direction, d_distortion: Matrix2x4::zeros() });
    }
    let (norm2, slope) = (rho * rho + z * z, slope(theta, terms));
    let (cos_azimuth, sin_azimuth) = (x / rho, y / rho);
    // point = scale · (x, y); dθ/dρ = z/‖d‖², dθ/dz = −ρ/‖d‖².
    let scale = curve(theta, terms) / rho;
    let radial = slope * z / norm2 - scale;
    let axial = -slope / norm2;
    let d_direction = Matrix2x3::new(
        scale + radial * cos_azimuth * cos_azimuth,
        radial * cos_azimuth * sin_azimuth,
        axial * x,
        radial * cos_azimuth * sin_azimuth,
        scale + radial * sin_azimuth * sin_azimuth,
        axial * y,
    );
    let powers = odd_powers(theta);
    let d_distortion =
        Matrix2x4::from_fn(|row, term| powers[term] * if row == 0 { cos_azimuth } else { sin_azimuth });
    Some(Distorted { point: direction.xy() * scale, d_direction, d_distortion })
}

pub(super) fn undistort(point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Vector3<f64>> {
    let radius = point.norm();
    if radius == 0.0 {
        return Some(Vector3::z());
    }
    let (sin, cos) = invert(radius, terms)?.sin_cos();
    Some(Vector3::new(sin * point.x / radius, sin * point.y / radius, cos))
}

pub(super) fn undistort_with_jacobian(point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Undistorted> {
    let radius = point.norm();
    if radius == 0.0 {
        let d_point = Matrix3x2::new(1.0, 0.0, 0.0, 1.0, 0.0, 0.0);
        return Some(Undistorted { bearing: Vector3::z(), d_point, d_distortion: Matrix3x4::zeros() });
    }
    let theta = invert(radius, terms)?;
    let (sin, cos) = theta.sin_cos();
    let azimuth = point / radius;
    let slope = slope(theta, terms);
    let across = sin / radius;
    let along = cos / slope - across;
    let d_point = Matrix3x2::new(
        across + along * azimuth.x * azimuth.x,
        along * azimuth.x * azimuth.y,
        along * azimuth.x * azimuth.y,
        across + along * azimuth.y * azimuth.y,
        -sin / slope * azimuth.x,
        -sin / slope * azimuth.y,
    );
    // The radius stays, so slope · dθ = −θ^(2i+1) dkᵢ.
    let d_theta = Vector3::new(cos * azimuth.x, cos * azimuth.y, -sin);
    let powers = odd_powers(theta);
    let d_distortion = Matrix3x4::from_fn(|row, term| -d_theta[row] * powers[term] / slope);
    let bearing = Vector3::new(sin * azimuth.x, sin * azimuth.y, cos);
    Some(Undistorted { bearing, d_point, d_distortion })
}

fn visible_angle(rho: f64, z: f64, terms: &[f64; 4]) -> Option<f64> {
    let theta = rho.atan2(z);
    // The length test drops the zero vector, whose angle would be that of the optical axis.
    (rho.max(z.abs()) > 0.0 && theta < PI && theta <= domain_end(theta, terms)).then_some(theta)
}

fn curve(theta: f64, &[k1, k2, k3, k4]: &[f64; 4]) -> f64 {
    let s = theta * theta;
    theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
}

fn slope(theta: f64, &[k1, k2, k3, k4]: &[f64; 4]) -> f64 {
    let s = theta * theta;
    1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
}

fn odd_powers(theta: f64) -> [f64; 4] {
    let s = theta * theta;
    let cube = theta * s;
    [cube, cube * s, cube * s * s, cube * s * s * s]
}

/// The first angle at which the curve's slope falls to `MIN_SLOPE`, or π; exact only if it is below `needed`.
fn domain_end(needed: f64, terms: &[f64; 4]) -> f64 {
    // The slope made of the falling terms alone bounds the slope from below and falls steadily itself.
    if slope(needed, &terms.map(|term| term.min(0.0))) > MIN_SLOPE {
        return PI;
    }
    let mut low = 0.0;
    for step in 1..=DOMAIN_STEPS {
        let mut high = PI * step as f64 / DOMAIN_STEPS as f64;
        if slope(high, terms) <= MIN_SLOPE {
            for _ in 0..52 {
                let middle = f64::midpoint(low, high);
                if slope(middle, terms) > MIN_SLOPE {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            return low;
        }
        low = high;
    }
    PI
}

/// The angle whose curve value is `radius`.
fn invert(radius: f64, terms: &[f64; 4]) -> Option<f64> {
    let high = domain_end(PI, terms);
    let border = curve(high, terms);
    let is_inside = radius < border || (radius == border && high < PI);
    if !is_inside {
        return None;
    }
    let (curve, slope) = (|theta| curve(theta, terms), |theta| slope(theta, terms));
    Some(invert_growing(radius, curve, slope, [0.0, high], radius.min(high)))
}
