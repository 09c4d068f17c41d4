//! Equirectangular panoramas, full or cropped: params w, h of the full sphere and, if cropped, left, top.
//!
//! φ = 2π ((u + left)/w − ½), θ = π ((v + top)/h − ½), ray = (cos θ sin φ, sin θ, cos θ cos φ): the paper's
//! formula with its one focal length f = w/2π, which a full sphere of 2:1 has in both directions.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix2x3, Matrix3x2, SMatrix, Vector2, Vector3};

use super::{MAX_CAMERA_PARAMS, ProjectJacobian, UnprojectJacobian};

/// Rows this little beyond a pole are rounding, in pixels.
const POLE_TOLERANCE_PX: f64 = 1e-9;

struct Sphere {
    width: f64,
    height: f64,
    left: f64,
    top: f64,
}

impl Sphere {
    fn new(params: &[f64]) -> Self {
        let (left, top) = if let [_, _, left, top] = params { (*left, *top) } else { (0.0, 0.0) };
        Self { width: params[0], height: params[1], left, top }
    }

    /// Longitude and latitude of a pixel, the latitude positive downwards.
    fn angles(&self, pixel: &Vector2<f64>) -> Option<(f64, f64)> {
        let row = pixel.y + self.top;
        if !(-POLE_TOLERANCE_PX..=self.height + POLE_TOLERANCE_PX).contains(&row) {
            return None;
        }
        // Reducing to one turn first keeps the sines exact for pixels many turns away.
        let turns = (pixel.x + self.left) / self.width;
        Some((TAU * (turns - turns.floor() - 0.5), PI * (row / self.height - 0.5)))
    }

    fn pixel(&self, direction: &Vector3<f64>) -> Option<Vector2<f64>> {
        let horizontal = direction.x.hypot(direction.z);
        if horizontal == 0.0 && (direction.y == 0.0 || direction.y.is_nan()) {
            return None;
        }
        let longitude = direction.x.atan2(direction.z);
        let latitude = direction.y.atan2(horizontal);
        let mut x = self.width * (longitude / TAU + 0.5) - self.left;
        // The seam: the representative inside [0, w), so that a crop over the seam is seen in one piece.
        if x < 0.0 {
            x += self.width;
        }
        if x >= self.width {
            x -= self.width;
        }
        let y = self.height * (latitude / PI + 0.5) - self.top;
        Some(Vector2::new(x, y))
    }
}

pub(super) fn unproject(params: &[f64], pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
    let (longitude, latitude) = Sphere::new(params).angles(pixel)?;
    Some(bearing(longitude, latitude))
}

pub(super) fn project(params: &[f64], direction: &Vector3<f64>) -> Option<Vector2<f64>> {
    Sphere::new(params).pixel(direction)
}

pub(super) fn project_with_jacobian(params: &[f64], direction: &Vector3<f64>) -> Option<ProjectJacobian> {
    let sphere = Sphere::new(params);
    let pixel = sphere.pixel(direction)?;
    let (x, y, z) = (direction.x, direction.y, direction.z);
    let horizontal2 = x * x + z * z;
    let horizontal = horizontal2.sqrt();
    let norm2 = horizontal2 + y * y;
    let (along, down) = (sphere.width / TAU, sphere.height / PI);
    let d_direction = Matrix2x3::new(
        along * z / horizontal2,
        0.0,
        -along * x / horizontal2,
        -down * x * y / (horizontal * norm2),
        down * horizontal / norm2,
        -down * z * y / (horizontal * norm2),
    );
    if !d_direction.iter().all(|value| value.is_finite()) {
        return None;
    }
    let mut d_params = SMatrix::<f64, 2, MAX_CAMERA_PARAMS>::zeros();
    d_params[(0, 0)] = (pixel.x + sphere.left) / sphere.width;
    d_params[(1, 1)] = (pixel.y + sphere.top) / sphere.height;
    if params.len() == 4 {
        d_params[(0, 2)] = -1.0;
        d_params[(1, 3)] = -1.0;
    }
    Some(ProjectJacobian { pixel, d_direction, d_params })
}

/// In its caller, which leaves out what it has no use for.
#[inline(always)]
pub(super) fn unproject_with_jacobian(params: &[f64], pixel: &Vector2<f64>) -> Option<UnprojectJacobian> {
    let sphere = Sphere::new(params);
    let (longitude, latitude) = sphere.angles(pixel)?;
    let ((sin_p, cos_p), (sin_t, cos_t)) = (longitude.sin_cos(), latitude.sin_cos());
    let bearing = Vector3::new(cos_t * sin_p, sin_t, cos_t * cos_p);
    if !bearing.iter().all(|value| value.is_finite()) {
        return None;
    }
    let d_longitude = Vector3::new(bearing.z, 0.0, -bearing.x);
    let d_latitude = Vector3::new(-sin_t * sin_p, cos_t, -sin_t * cos_p);
    let d_u = d_longitude * (TAU / sphere.width);
    let d_v = d_latitude * (PI / sphere.height);
    let mut d_params = SMatrix::<f64, 3, MAX_CAMERA_PARAMS>::zeros();
    d_params.set_column(0, &(d_u * (-(pixel.x + sphere.left) / sphere.width)));
    d_params.set_column(1, &(d_v * (-(pixel.y + sphere.top) / sphere.height)));
    if params.len() == 4 {
        d_params.set_column(2, &d_u);
        d_params.set_column(3, &d_v);
    }
    Some(UnprojectJacobian { bearing, d_pixel: Matrix3x2::from_columns(&[d_u, d_v]), d_params })
}

pub(super) fn pixel_angle(params: &[f64], pixel: &Vector2<f64>) -> Option<f64> {
    let sphere = Sphere::new(params);
    let (_, latitude) = sphere.angles(pixel)?;
    let (across, down) = (TAU / sphere.width * latitude.cos(), PI / sphere.height);
    Some((f64::midpoint(across * across, down * down)).sqrt())
}

fn bearing(longitude: f64, latitude: f64) -> Vector3<f64> {
    let ((sin_p, cos_p), (sin_t, cos_t)) = (longitude.sin_cos(), latitude.sin_cos());
    Vector3::new(cos_t * sin_p, sin_t, cos_t * cos_p)
}
