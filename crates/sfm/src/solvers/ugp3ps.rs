use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::rotation_quadric::eliminate_columns;
use super::{Solutions, reach, tangent_basis};
use crate::Similarity;

/// Finds world_from_set = (s, R, t) with a known vertical from three rays of a camera set and their points.
///
/// Equation: Xᵢ = s·R·(pᵢ + λᵢ·xᵢ) + t with λᵢ > 0, s > 0 for i = 1, 2, 3, where R turns about +z only: rotate both
/// frames beforehand so that up is +z. pᵢ are ray origins and xᵢ unit directions in the set frame, Xᵢ points in the
/// world. The components across each ray are linear in s, s·λ₁, cos θ and sin θ; eliminating the former two leaves two
/// equations in (cos θ, sin θ), one more than unknowns.
///
/// The problem of gP4P+s (C. Sweeney et al., "gDLS: A Scalable Solution to the Generalized Pose and Scale Problem",
/// ECCV 2014) with a known vertical. The combination of the two equations that constrains the angle most is met exactly
/// (two angles), Gauss–Newton steps on the angle weigh in the other. At most 2 solutions, the better one first.
/// Degenerate when all rays meet in one point, and when the points lie on one vertical.
pub fn ugp3ps(
    origins_in_set: &[Vector3<f64>; 3],
    directions_in_set: &[Vector3<f64>; 3],
    points_in_world: &[Vector3<f64>; 3],
) -> Solutions<Similarity, 2> {
    let mut solutions = Solutions::<(f64, Similarity), 2>::default();
    let (unit, reach) = (reach(points_in_world), reach(origins_in_set));
    if !(unit > 0.0) || !(reach > 0.0) {
        return Solutions::default();
    }
    // Unknowns s·λ₁, s | cos, sin, 1, relative to ray 1's origin and point: Rᵀ·x = (c·x + s·y, c·y − s·x, z).
    let first = directions_in_set[0];
    let mut rows = [[0.0; 5]; 4];
    for i in 1..3 {
        let (u, v) = tangent_basis(&directions_in_set[i]);
        let x = (points_in_world[i] - points_in_world[0]) / unit;
        let p = (origins_in_set[i] - origins_in_set[0]) / reach;
        for (row, n) in [(2 * i - 2, u), (2 * i - 1, v)] {
            rows[row] = [n.dot(&first), -n.dot(&p), n.x * x.x + n.y * x.y, n.x * x.y - n.y * x.x, n.z * x.z];
        }
    }
    if !eliminate_columns(&mut rows, 2) {
        return Solutions::default();
    }
    let ([_, _, a0, b0, d0], [_, _, a1, b1, d1]) = (rows[2], rows[3]);
    // Jacobi rotation of the two rows: the first then has the largest possible (a, b).
    let angle = 0.5 * (2.0 * (a0 * a1 + b0 * b1)).atan2(a0 * a0 + b0 * b0 - a1 * a1 - b1 * b1);
    let (turn_sin, turn_cos) = angle.sin_cos();
    let strong = Vector3::new(a0, b0, d0) * turn_cos + Vector3::new(a1, b1, d1) * turn_sin;
    let size = strong.x.hypot(strong.y);
    if !(size > 0.0) {
        return Solutions::default();
    }
    let middle = strong.y.atan2(strong.x);
    // Noise may push the cosine just beyond 1: the nearest angle is then the double one.
    let ratio = -strong.z / size;
    if !(ratio.abs() < 1.5) {
        return Solutions::default();
    }
    let spread = ratio.clamp(-1.0, 1.0).acos();
    for start in [middle + spread, middle - spread] {
        let mut theta = start;
        for _ in 0..3 {
            let (sin, cos) = theta.sin_cos();
            let value = Vector2::new(a0 * cos + b0 * sin + d0, a1 * cos + b1 * sin + d1);
            let slope = Vector2::new(b0 * cos - a0 * sin, b1 * cos - a1 * sin);
            let square = slope.norm_squared();
            if !(square > 1e-24 * size * size) {
                break;
            }
            // Bounded, so that it cannot jump to the other solution.
            let step = (slope.dot(&value) / square).clamp(-0.2, 0.2);
            theta -= step;
            if step.abs() < 1e-12 {
                break;
            }
        }
        let (sin, cos) = theta.sin_cos();
        let residual = (a0 * cos + b0 * sin + d0).hypot(a1 * cos + b1 * sin + d1);
        let combine = |row: &[f64; 5]| row[2] * cos + row[3] * sin + row[4];
        let scale = -combine(&rows[1]) / rows[1][1];
        let depth = -(combine(&rows[0]) + rows[0][1] * scale) / rows[0][0];
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::z() * theta);
        let valid = scale > 0.0
            && depth > 0.0
            && (1..3).all(|i| {
                let x = (points_in_world[i] - points_in_world[0]) / unit;
                let turned = Vector3::new(cos * x.x + sin * x.y, cos * x.y - sin * x.x, x.z) + first * depth;
                directions_in_set[i]
                    .dot(&(turned - (origins_in_set[i] - origins_in_set[0]) * (scale / reach)))
                    > 0.0
            });
        if valid {
            let scale = scale * unit / reach;
            let in_set = origins_in_set[0] * scale + first * (depth * unit);
            let translation = points_in_world[0] - rotation * in_set;
            solutions.push((residual, Similarity { scale, rotation, translation }));
        }
    }
    solutions.by_residual()
}

#[cfg(test)]
mod tests {
    use super::ugp3ps;
    use crate::synthetic::{GeneralizedProblem, same_similarity, seeded};

    #[test]
    fn finds_the_truth_for_two_or_three_centres() {
        for (name, cameras) in [("u111", [0, 1, 2]), ("u21", [0, 0, 1]), ("u12", [0, 1, 1])] {
            let mut rng = seeded(name);
            let mut missed = 0;
            for _ in 0..10_000 {
                let problem = GeneralizedProblem::exact(&mut rng, &cameras, true);
                let (origins, directions, points) = problem.sample();
                let found = ugp3ps(&origins, &directions, &points);
                missed += u32::from(!found.iter().any(|s| same_similarity(s, &problem.world_from_set, 1e-6)));
            }
            assert!(missed <= 10, "{name}: {missed}");
        }
    }

    #[test]
    fn one_centre_leaves_the_scale_free() {
        let (origins, directions, points) =
            GeneralizedProblem::exact(&mut seeded("u3"), &[0; 3], true).sample();
        assert!(ugp3ps(&origins, &directions, &points).is_empty());
    }
}
