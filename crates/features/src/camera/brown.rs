//! Pinhole with Brown's radial and tangential distortion: all of COLMAP's perspective models.
//!
//! With n = (x/z, y/z), s = ‖n‖² and terms k1, k2, p1, p2:
//! `point = n (1 + k1 s + k2 s²) + (2 p1 x y + p2 (s + 2 x²), 2 p2 x y + p1 (s + 2 y²))`.
//! The domain is the disc in which r (1 + k1 r² + k2 r⁴) grows and the whole map keeps its orientation.

use nalgebra::{Matrix2, Matrix2x3, Matrix2x4, Matrix3x2, Vector2, Vector3};

use super::lens::{Distorted, MIN_SLOPE, Undistorted};
use super::newton::invert_growing;

const MAX_ITERATIONS: usize = 100;

pub(super) fn distort(direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Vector2<f64>> {
    let n = focal_plane(direction)?;
    (is_pinhole(terms) || is_inside(&n, terms)).then(|| map(&n, terms))
}

pub(super) fn undistort(point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Vector3<f64>> {
    invert(point, terms).map(|n| Vector3::new(n.x, n.y, 1.0).normalize())
}

pub(super) fn distort_with_jacobian(direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Distorted> {
    let n = focal_plane(direction)?;
    if !is_pinhole(terms) && !is_inside(&n, terms) {
        return None;
    }
    Some(Distorted {
        point: map(&n, terms),
        d_direction: jacobian(&n, terms) * d_plane(direction, &n),
        d_distortion: d_terms(&n),
    })
}

/// [`distort_with_jacobian`] of no more than ∂point / ∂direction.
pub(super) fn d_direction(direction: &Vector3<f64>, terms: &[f64; 4]) -> Option<Matrix2x3<f64>> {
    let n = focal_plane(direction)?;
    let slope = jacobian(&n, terms);
    if !is_pinhole(terms) && !Domain::new(terms).contains(&n, || slope) {
        return None;
    }
    Some(slope * d_plane(direction, &n))
}

/// ∂(x/z, y/z) / ∂direction.
fn d_plane(direction: &Vector3<f64>, n: &Vector2<f64>) -> Matrix2x3<f64> {
    let inv_z = 1.0 / direction.z;
    Matrix2x3::new(inv_z, 0.0, -n.x * inv_z, 0.0, inv_z, -n.y * inv_z)
}

pub(super) fn undistort_with_jacobian(point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Undistorted> {
    let n = invert(point, terms)?;
    let length = (1.0 + n.norm_squared()).sqrt();
    let bearing = Vector3::new(n.x, n.y, 1.0) / length;
    // d(v/‖v‖) = (I − b bᵀ) dv / ‖v‖ for dv in the plane z = 1.
    let d_plane = Matrix3x2::new(
        1.0 - bearing.x * bearing.x,
        -bearing.x * bearing.y,
        -bearing.x * bearing.y,
        1.0 - bearing.y * bearing.y,
        -bearing.x * bearing.z,
        -bearing.y * bearing.z,
    ) / length;
    let d_point = d_plane * jacobian(&n, terms).try_inverse()?;
    // Implicit function: the point stays, so J dn = −∂map/∂terms.
    Some(Undistorted { bearing, d_point, d_distortion: -d_point * d_terms(&n) })
}

fn focal_plane(direction: &Vector3<f64>) -> Option<Vector2<f64>> {
    (direction.z > 0.0).then(|| Vector2::new(direction.x / direction.z, direction.y / direction.z))
}

fn is_pinhole(terms: &[f64; 4]) -> bool {
    *terms == [0.0; 4]
}

fn map(n: &Vector2<f64>, &[k1, k2, p1, p2]: &[f64; 4]) -> Vector2<f64> {
    let s = n.norm_squared();
    let radial = 1.0 + s * (k1 + s * k2);
    let xy2 = 2.0 * n.x * n.y;
    Vector2::new(
        n.x * radial + p1 * xy2 + p2 * (s + 2.0 * n.x * n.x),
        n.y * radial + p2 * xy2 + p1 * (s + 2.0 * n.y * n.y),
    )
}

fn jacobian(n: &Vector2<f64>, &[k1, k2, p1, p2]: &[f64; 4]) -> Matrix2<f64> {
    let s = n.norm_squared();
    let radial = 1.0 + s * (k1 + s * k2);
    let slope = 2.0 * (k1 + 2.0 * k2 * s);
    let off_diagonal = n.x * n.y * slope + 2.0 * (p1 * n.x + p2 * n.y);
    Matrix2::new(
        radial + n.x * n.x * slope + 2.0 * p1 * n.y + 6.0 * p2 * n.x,
        off_diagonal,
        off_diagonal,
        radial + n.y * n.y * slope + 2.0 * p2 * n.x + 6.0 * p1 * n.y,
    )
}

fn d_terms(n: &Vector2<f64>) -> Matrix2x4<f64> {
    let s = n.norm_squared();
    let xy2 = 2.0 * n.x * n.y;
    Matrix2x4::new(
        n.x * s,
        n.x * s * s,
        xy2,
        s + 2.0 * n.x * n.x,
        n.y * s,
        n.y * s * s,
        s + 2.0 * n.y * n.y,
        xy2,
    )
}

fn radial_slope(s: f64, k1: f64, k2: f64) -> f64 {
    1.0 + s * (3.0 * k1 + s * 5.0 * k2)
}

/// The largest squared radius up to which the radial curve grows: smallest root of 1 + 3 k1 s + 5 k2 s² = `MIN_SLOPE`.
fn domain_end(k1: f64, k2: f64) -> f64 {
    let (a, b, c) = (5.0 * k2, 3.0 * k1, 1.0 - MIN_SLOPE);
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return f64::INFINITY;
    }
    // The form 2c / (−b ± √…) stays exact as a → 0; c > 0, so the smallest positive root has the larger denominator.
    let denominator = -b + discriminant.sqrt();
    if denominator > 0.0 { 2.0 * c / denominator } else { f64::INFINITY }
}

fn is_inside(n: &Vector2<f64>, terms: &[f64; 4]) -> bool {
    Domain::new(terms).contains(n, || jacobian(n, terms))
}

/// The disc in which the radial curve grows, and whether tangential terms may turn the map over inside it.
struct Domain {
    end: f64,
    is_tangential: bool,
}

impl Domain {
    fn new(&[k1, k2, p1, p2]: &[f64; 4]) -> Self {
        Self { end: domain_end(k1, k2), is_tangential: p1 != 0.0 || p2 != 0.0 }
    }

    /// Whether a place is inside; `jacobian` is the map's there.
    fn contains(&self, n: &Vector2<f64>, jacobian: impl FnOnce() -> Matrix2<f64>) -> bool {
        n.norm_squared() <= self.end
            && (!self.is_tangential || {
                let j = jacobian();
                j.trace() > 0.0 && j.determinant() > MIN_SLOPE * MIN_SLOPE
            })
    }
}

/// By how much radii are stretched about a squared distorted radius, where that is little: near enough for the first of Newton's
/// steps.
fn mild_share(squared: f64, k1: f64, k2: f64) -> Option<f64> {
    let share = 1.0 + squared * (k1 + squared * k2);
    (0.7..1.3).contains(&share).then_some(share)
}

/// The radius whose distorted radius is `distorted`.
fn invert_radius(distorted: f64, k1: f64, k2: f64) -> Option<f64> {
    let radius_of = |r: f64| r * (1.0 + r * r * (k1 + r * r * k2));
    let mut high = domain_end(k1, k2).sqrt();
    if high.is_finite() {
        if distorted > radius_of(high) {
            return None;
        }
    } else {
        high = distorted.max(1.0);
        while radius_of(high) < distorted {
            high *= 2.0;
        }
    }
    // Far out the highest power is all there is; Newton from the distorted radius would need a step for each fifth.
    let squared = distorted * distorted;
    let far = if let Some(share) = mild_share(squared, k1, k2) {
        distorted / share
    } else if k2 > 0.0 && k2 * squared * squared > 1.0 {
        (distorted / k2).powf(0.2)
    } else if k2 <= 0.0 && k1 * squared > 1.0 {
        (distorted / k1).cbrt()
    } else {
        distorted
    };
    let slope_of = |r: f64| radial_slope(r * r, k1, k2);
    Some(invert_growing(distorted, radius_of, slope_of, [0.0, high], far.min(high)))
}

fn invert(point: &Vector2<f64>, terms: &[f64; 4]) -> Option<Vector2<f64>> {
    if is_pinhole(terms) {
        return Some(*point);
    }
    let &[k1, k2, ..] = terms;
    let distorted = point.norm();
    if !distorted.is_finite() {
        return None;
    }
    if distorted == 0.0 {
        return Some(Vector2::zeros());
    }
    let domain = Domain::new(terms);
    if !domain.is_tangential {
        return invert_radius(distorted, k1, k2).map(|radius| point * (radius / distorted));
    }
    let near = mild_share(distorted * distorted, k1, k2).map(|share| point / share);
    near.and_then(|near| invert_from(&near, point, terms, &domain)).or_else(|| {
        let radial = invert_radius(distorted, k1, k2);
        // Tangential terms move the border of the domain a little: start at the radial border.
        let radius = radial.unwrap_or_else(|| 0.95 * domain.end.sqrt());
        let start = point * (radius / distorted);
        let start = if is_inside(&start, terms) { start } else { start * 0.9 };
        invert_from(&start, point, terms, &domain)
    })
}

/// Newton's steps to the place that is mapped to `point`, each halved until it stays in the domain and reduces the error; `None`
/// where they end elsewhere.
fn invert_from(
    start: &Vector2<f64>,
    point: &Vector2<f64>,
    terms: &[f64; 4],
    domain: &Domain,
) -> Option<Vector2<f64>> {
    let tolerance = 4.0 * f64::EPSILON * (1.0 + point.norm());
    let (mut n, mut slope, mut residual) = (*start, jacobian(start, terms), map(start, terms) - point);
    for _ in 0..MAX_ITERATIONS {
        if residual.norm() <= tolerance {
            break;
        }
        let step = slope.try_inverse()? * residual;
        let mut scale = 1.0;
        let next = loop {
            let candidate = n - step * scale;
            let (there, left) = (jacobian(&candidate, terms), map(&candidate, terms) - point);
            if domain.contains(&candidate, || there) && left.norm() < residual.norm() {
                break Some((candidate, there, left));
            }
            scale *= 0.5;
            if scale < 1e-6 {
                break None;
            }
        };
        let Some(next) = next else { break };
        (n, slope, residual) = next;
    }
    (residual.norm() <= tolerance * 16.0 && domain.contains(&n, || slope)).then_some(n)
}
