//! Panoramas whose stitching moves directions: parameters of the sphere, then a stretch xx, xy, xz, yz, then a twist txx, txy, txz, tyz, tyy.
//!
//! ray ∝ (I + Q) e + e × T e with e the ray of the plain panorama, and Q and T symmetric and without trace:
//!
//! ```text
//!     ⎡ xx  xy   xz ⎤      ⎡ txx − tyy  txy         txz ⎤
//! Q = ⎢ xy   0   yz ⎥  T = ⎢ txy        2 tyy       tyz ⎥
//!     ⎣ xz  yz  −xx ⎦      ⎣ txz        tyz  −txx − tyy ⎦
//! ```
//!
//! These are the smoothest fields on the sphere that neither turn nor shift it: the gradients ∇Y of the spherical harmonics of
//! degree 2, and e × ∇Y. A positive xx means that what lies ahead and behind spans more than the plain panorama says and what lies at
//! the sides less, as with two fisheyes whose radial calibration is a little off. Two fisheyes that are turned against each
//! other about their axis (txx), up and down (txz) or aside (tyz) twist it; so does one that is turned on the spot and rolled (tyy:
//! meridians lean). Q's vertical term is left out: upright panoramas do not tell it, as a scene stretched like them would look the
//! same.

use nalgebra::{Matrix3, Matrix3x2, SMatrix, Vector2, Vector3};

use super::{MAX_CAMERA_PARAMS, PlainRay, ProjectJacobian, UnprojectJacobian, equirectangular};

/// Parameters of the sphere and its crop.
const OF_SPHERE: usize = 4;
const STRETCHES: usize = 4;
const TWISTS: usize = 5;
/// Steps by which the plain ray of a direction is sought. Each leaves a share of the error as large as the twist: five are enough
/// for any stitching.
const MAX_STEPS: u32 = 100;

/// The terms of the twist.
pub(super) fn twist(params: &[f64]) -> &[f64] {
    params.get(OF_SPHERE + STRETCHES..).unwrap_or_default()
}

/// How rays of a panorama are those of a plain one.
struct Field {
    /// I + Q.
    stretch: Matrix3<f64>,
    /// T.
    twist: Matrix3<f64>,
}

impl Field {
    #[inline(always)]
    fn of(params: &[f64]) -> Self {
        let &[xx, xy, xz, yz, txx, txy, txz, tyz, tyy] =
            params[OF_SPHERE..].first_chunk().unwrap_or(&[0.0; 9]);
        let stretch = Matrix3::new(1.0 + xx, xy, xz, xy, 1.0, yz, xz, yz, 1.0 - xx);
        let twist = Matrix3::new(txx - tyy, txy, txz, txy, 2.0 * tyy, tyz, txz, tyz, -txx - tyy);
        Self { stretch, twist }
    }

    /// Where a plain ray of unit length is seen, of any length.
    #[inline(always)]
    fn of_plain(&self, plain: &Vector3<f64>) -> Vector3<f64> {
        self.stretch * plain + plain.cross(&(self.twist * plain))
    }

    /// Its derivative by a plain ray that keeps its length.
    #[inline(always)]
    fn by_plain(&self, plain: &Vector3<f64>) -> Matrix3<f64> {
        self.stretch + plain.cross_matrix() * self.twist - (self.twist * plain).cross_matrix()
    }

    /// That derivative along one direction, which costs less than the whole where few are asked for.
    #[inline(always)]
    fn along(&self, plain: &Vector3<f64>, by: &Vector3<f64>) -> Vector3<f64> {
        self.stretch * by + by.cross(&(self.twist * plain)) + plain.cross(&(self.twist * by))
    }

    /// Its derivatives by the parameters, in their order.
    #[inline(always)]
    fn by_params(plain: &Vector3<f64>) -> [Vector3<f64>; STRETCHES + TWISTS] {
        let &[x, y, z] = plain.as_ref();
        let xx = Vector3::new(x, 0.0, -z);
        let xy = Vector3::new(y, x, 0.0);
        let xz = Vector3::new(z, 0.0, x);
        let yz = Vector3::new(0.0, z, y);
        // e × T e is 3y (e × ŷ) for the last.
        let tyy = Vector3::new(-z, 0.0, x) * (3.0 * y);
        [xx, xy, xz, yz, plain.cross(&xx), plain.cross(&xy), plain.cross(&xz), plain.cross(&yz), tyy]
    }

    /// The plain ray, of unit length, that is seen in a direction.
    fn plain_of(&self, direction: &Vector3<f64>) -> Option<Vector3<f64>> {
        let inverse = self.stretch.try_inverse()?;
        let direction = direction.try_normalize(0.0)?;
        // Of a ray of another length the field is that much longer.
        let mut plain = inverse * direction;
        for _ in 0..MAX_STEPS {
            let next = inverse * (direction - plain.cross(&(self.twist * plain)) / plain.norm());
            let moved = (next - plain).norm_squared();
            plain = next;
            if moved < 1e-30 {
                return plain.try_normalize(0.0);
            }
        }
        None
    }
}

pub(super) fn unproject(params: &[f64], pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
    let plain = equirectangular::unproject(&params[..OF_SPHERE], pixel)?;
    Field::of(params).of_plain(&plain).try_normalize(0.0)
}

pub(super) fn project(params: &[f64], direction: &Vector3<f64>) -> Option<Vector2<f64>> {
    equirectangular::project(&params[..OF_SPHERE], &Field::of(params).plain_of(direction)?)
}

pub(super) fn project_with_jacobian(params: &[f64], direction: &Vector3<f64>) -> Option<ProjectJacobian> {
    let field = Field::of(params);
    let plain = field.plain_of(direction)?;
    let mut projected = equirectangular::project_with_jacobian(&params[..OF_SPHERE], &plain)?;
    // f(e) + |e| g(e) with e of any length, of which only the direction is projected.
    let twisted = plain.cross(&(field.twist * plain));
    let inverse = (field.by_plain(&plain) - twisted * plain.transpose()).try_inverse()?;
    let by_ray = projected.d_direction * inverse;
    for (at, moved) in Field::by_params(&plain).iter().enumerate() {
        projected.d_params.set_column(OF_SPHERE + at, &-(by_ray * moved));
    }
    // `plain` has unit length where what is seen has that of its field.
    projected.d_direction = by_ray * (field.of_plain(&plain).norm() / direction.norm());
    Some(projected)
}

pub(super) fn unproject_with_jacobian(params: &[f64], pixel: &Vector2<f64>) -> Option<UnprojectJacobian> {
    let plain = equirectangular::unproject_with_jacobian(&params[..OF_SPHERE], pixel)?;
    let (mut ray, by_plain) = seen(params, &PlainRay { bearing: plain.bearing, d_pixel: plain.d_pixel });
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
    Some(ray_of_plain(params, &plain_ray(params, pixel)?))
}

/// The same for a plain ray.
#[inline(always)]
pub(super) fn ray_of_plain(params: &[f64], plain: &PlainRay) -> (Vector3<f64>, Matrix3x2<f64>) {
    let field = Field::of(params);
    let ray = field.of_plain(&plain.bearing);
    let length = ray.norm();
    let bearing = ray / length;
    let d_pixel = [0, 1].map(|at: usize| {
        let moved = field.along(&plain.bearing, &plain.d_pixel.column(at).into_owned());
        (moved - bearing * bearing.dot(&moved)) / length
    });
    (bearing, Matrix3x2::from_columns(&d_pixel))
}

/// The ray for a plain one, without its derivatives by the parameters of the sphere.
pub(super) fn of_plain(params: &[f64], plain: &PlainRay) -> UnprojectJacobian {
    seen(params, plain).0
}

/// And ∂ray/∂(plain ray). In its caller, which leaves out what it has no use for.
#[inline(always)]
fn seen(params: &[f64], plain: &PlainRay) -> (UnprojectJacobian, Matrix3<f64>) {
    let field = Field::of(params);
    let ray = field.of_plain(&plain.bearing);
    let length = ray.norm();
    let bearing = ray / length;
    let tangent = (Matrix3::identity() - bearing * bearing.transpose()) / length;
    let by_plain = tangent * field.by_plain(&plain.bearing);
    let d_pixel = [0, 1].map(|at| by_plain * plain.d_pixel.column(at));
    let mut d_params = SMatrix::<f64, 3, MAX_CAMERA_PARAMS>::zeros();
    for (at, moved) in Field::by_params(&plain.bearing).iter().enumerate() {
        d_params.set_column(OF_SPHERE + at, &((moved - bearing * bearing.dot(moved)) / length));
    }
    let ray = UnprojectJacobian { bearing, d_pixel: Matrix3x2::from_columns(&d_pixel), d_params };
    (ray, by_plain)
}
