//! Minimal and linear solvers, one per file: algebra only, no sampling and no scoring.
//!
//! All rays are unit vectors on the full sphere. A point lies on a ray only with a positive depth λ, wherever the
//! ray points: there is no image plane and no "in front of the camera" other than the sign of λ.

mod dlt;
mod five_point;
mod gp3p;
mod gp4ps;
mod gp4ps_at_one_point;
mod null_space;
mod p3p;
mod p4pf;
mod polynomial;
mod quadrics;
mod ray_homography;
mod rotation_quadric;
mod solutions;
mod turn_with_focal;
mod ugp3ps;
mod upright_three_point;

pub mod essential;
pub mod triangulation;

pub use dlt::dlt;
pub use five_point::five_point;
pub use gp3p::gp3p;
pub use gp4ps::gp4ps;
pub use p3p::p3p;
pub use p4pf::{PoseWithFocal, p4pf};
pub use polynomial::real_roots;
pub use ray_homography::ray_homography;
pub use solutions::Solutions;
pub use turn_with_focal::{TurnWithFocal, turn_with_focal};
pub use ugp3ps::ugp3ps;
pub use upright_three_point::upright_three_point;

use nalgebra::Vector3;

/// The largest distance of the others from the first: the unit of length in which a solver works.
#[inline]
fn reach(points: &[Vector3<f64>]) -> f64 {
    points[1..].iter().map(|point| (point - points[0]).norm()).fold(0.0, f64::max)
}

/// Two unit vectors that complete a unit vector to an orthonormal basis.
///
/// T. Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017: no branch, no singular direction.
#[inline]
pub fn tangent_basis(direction: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let sign = 1.0_f64.copysign(direction.z);
    let a = -1.0 / (sign + direction.z);
    let b = direction.x * direction.y * a;
    (
        Vector3::new(1.0 + sign * direction.x * direction.x * a, sign * b, -sign * direction.x),
        Vector3::new(b, sign + direction.y * direction.y * a, -direction.y),
    )
}
