use nalgebra::{Matrix3, Vector3};

use super::null_space::null_space;
use super::tangent_basis;

/// Finds the homography between two views of a plane from four pairs of bearings.
///
/// Equation: μᵢ·x₂ = H·x₁ with μᵢ > 0 for four pairs of unit bearings (first and second camera frame); for the plane
/// n·X = d in the first frame, H ∝ R + t·nᵀ/d. Linear, after R. Hartley, A. Zisserman, "Multiple View Geometry",
/// algorithm 4.1, on rays. Scaled to unit norm and to positive μ. One solution, or `None` when no sign of H makes all
/// four μ positive. Degenerate when three bearings of a view lie on a great circle.
pub fn ray_homography(first: &[Vector3<f64>; 4], second: &[Vector3<f64>; 4]) -> Option<Matrix3<f64>> {
    let mut rows = [[0.0; 9]; 8];
    for (k, (a, b)) in first.iter().zip(second).enumerate() {
        let (u, v) = tangent_basis(b);
        for (row, n) in [(2 * k, u), (2 * k + 1, v)] {
            for i in 0..3 {
                for j in 0..3 {
                    rows[row][3 * i + j] = n[i] * a[j];
                }
            }
        }
    }
    let [solution] = null_space(rows);
    let homography = Matrix3::from_row_slice(solution.as_slice());
    let in_front = |sign: f64| first.iter().zip(second).all(|(a, b)| sign * b.dot(&(homography * a)) > 0.0);
    [1.0, -1.0].into_iter().find(|sign| in_front(*sign)).map(|sign| homography * sign)
}

#[cfg(test)]
mod tests {
    use super::ray_homography;
    use crate::synthetic::{RelativeProblem, random_unit, seeded};

    #[test]
    fn maps_the_other_points_of_the_plane() {
        let mut rng = seeded("homography");
        for _ in 0..200 {
            let pose = RelativeProblem::exact(&mut rng, 1).second_from_first;
            let normal = random_unit(&mut rng);
            let mut pair = || {
                loop {
                    let bearing = random_unit(&mut rng);
                    if bearing.dot(&normal) > 0.1 {
                        let point = bearing * (2.0 / bearing.dot(&normal));
                        return (bearing, pose.transform_point(&point).normalize());
                    }
                }
            };
            let pairs: [_; 6] = std::array::from_fn(|_| pair());
            let of = |k: usize| std::array::from_fn(|i| if k == 0 { pairs[i].0 } else { pairs[i].1 });
            let homography = ray_homography(&of(0), &of(1)).unwrap();
            for (a, b) in pairs {
                assert!(((homography * a).normalize() - b).norm() < 1e-6);
            }
        }
    }
}
