use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use super::{Solutions, real_roots};
use crate::nearest_rotation;

/// A turn of a camera on the spot and its focal length.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TurnWithFocal {
    /// Takes a ray of the first image to the second.
    pub second_from_first: UnitQuaternion<f64>,
    /// Focal length in pixels.
    pub focal: f64,
}

/// Turn and focal length of a pinhole camera that took two images on one spot, by two points of each (up to three solutions).
///
/// Pixels are relative to the principal point. The angle between the rays of the two points is the same in both images, which
/// is a cubic in f²: M. Brown, R. Hartley, D. Nistér, "Minimal Solutions for Panoramic Stitching", CVPR 2007.
pub fn turn_with_focal(first: &[Vector2<f64>; 2], second: &[Vector2<f64>; 2]) -> Solutions<TurnWithFocal, 3> {
    let mut solutions = Solutions::default();
    // In units of the farthest pixel the coefficients are of one size.
    let unit = first.iter().chain(second).map(Vector2::norm_squared).fold(0.0, f64::max);
    let squared = |of: &[Vector2<f64>; 2]| {
        [of[0].norm_squared() / unit, of[1].norm_squared() / unit, of[0].dot(&of[1]) / unit]
    };
    let ([a1, a2, a12], [b1, b2, b12]) = (squared(first), squared(second));
    // (a12 + w)² (b1 + w)(b2 + w) − (b12 + w)² (a1 + w)(a2 + w), by powers of w = f²: those of w⁴ cancel.
    let quartic = |d: f64, p: f64, q: f64| {
        let (sum, product) = (p + q, p * q);
        [d * d * product, d * d * sum + 2.0 * d * product, d * d + 2.0 * d * sum + product, 2.0 * d + sum]
    };
    let (of_first, of_second) = (quartic(a12, b1, b2), quartic(b12, a1, a2));
    let cubic: [f64; 4] = std::array::from_fn(|power| of_first[power] - of_second[power]);
    for &root in &real_roots(&cubic) {
        if !(root > 0.0 && root.is_finite()) {
            continue;
        }
        let focal = (root * unit).sqrt();
        let rays = |of: &[Vector2<f64>; 2]| of.map(|pixel| Vector3::new(pixel.x, pixel.y, focal).normalize());
        let ([p, q], [r, s]) = (rays(first), rays(second));
        // The roots of the squared equation have angles of either sign.
        if (p.dot(&q) - r.dot(&s)).abs() > 1e-6 {
            continue;
        }
        let sum: Matrix3<f64> = r * p.transpose() + s * q.transpose() + r.cross(&s) * p.cross(&q).transpose();
        if let Some(second_from_first) = nearest_rotation(sum) {
            solutions.push(TurnWithFocal { second_from_first, focal });
        }
    }
    solutions
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::synthetic::seeded;

    #[test]
    fn finds_the_truth() {
        let mut rng = seeded("turn with focal");
        for _ in 0..2000 {
            let focal = rng.random_range(500.0..3000.0);
            let turn = UnitQuaternion::from_euler_angles(
                rng.random_range(-0.3..0.3),
                rng.random_range(-0.5..0.5),
                rng.random_range(-1.0..1.0),
            );
            let mut pairs = Vec::new();
            while pairs.len() < 2 {
                let pixel = Vector2::from_fn(|_, _| rng.random_range(-800.0..800.0));
                let there = turn * Vector3::new(pixel.x, pixel.y, focal);
                if there.z > 100.0 {
                    pairs.push((pixel, there.xy() * (focal / there.z)));
                }
            }
            let found = turn_with_focal(&[pairs[0].0, pairs[1].0], &[pairs[0].1, pairs[1].1]);
            let is_truth = |found: &TurnWithFocal| {
                (found.focal / focal - 1.0).abs() < 1e-5 && found.second_from_first.angle_to(&turn) < 1e-5
            };
            assert!(found.iter().any(is_truth), "{focal} {turn}: {found:?}");
        }
    }

    #[test]
    fn points_that_coincide_or_stand_still_have_no_solution_or_a_finite_one() {
        let (p, q) = (Vector2::new(100.0, 50.0), Vector2::new(-30.0, 70.0));
        for (first, second) in [([p, q], [p, q]), ([p, p], [q, q]), ([p, q], [p, p])] {
            assert!(turn_with_focal(&first, &second).iter().all(|found| found.focal.is_finite()));
        }
        let zero = [Vector2::zeros(); 2];
        assert!(turn_with_focal(&zero, &zero).is_empty());
    }
}
