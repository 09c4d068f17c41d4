use nalgebra::Vector3;

use super::quadrics::intersect_quadrics;
use super::rotation_quadric::{
    cayley_numerator, eliminate_columns, generic_rotation, inverse_rotation, rotation_quadric, rotation_row,
};
use super::{Solutions, reach, tangent_basis};
use crate::Rigid;

/// Finds world_from_set of known scale from three rays of a camera set and the points they see.
///
/// Equation: Xᵢ = R·(pᵢ + λᵢ·xᵢ) + t with λᵢ > 0 for i = 1, 2, 3; pᵢ ray origins and xᵢ unit directions in the set
/// frame (in units of the world), Xᵢ points in the world. The components across each ray of Rᵀ·(Xᵢ − t) − pᵢ are
/// linear in Rᵀ and λ₁; eliminating λ₁ leaves three quadrics in Cayley's parameters.
///
/// Z. Kukelova, J. Heller, A. Fitzgibbon, CVPR 2016, section 4 (gP3P). Origins may coincide (it then is P3P, slower).
/// At most 8 solutions. Degenerate for collinear points.
pub fn gp3p(
    origins_in_set: &[Vector3<f64>; 3],
    directions_in_set: &[Vector3<f64>; 3],
    points_in_world: &[Vector3<f64>; 3],
) -> Solutions<Rigid, 8> {
    let mut solutions = Solutions::default();
    let turn = generic_rotation();
    let unit = reach(points_in_world);
    if !(unit > 0.0) {
        return solutions;
    }
    // Unknown λ₁ | Rᵀ by rows, constant; relative to ray 1's origin and point.
    let first = directions_in_set[0];
    let mut rows = [[0.0; 11]; 4];
    for i in 1..3 {
        let (u, v) = tangent_basis(&directions_in_set[i]);
        let x = turn * (points_in_world[i] - points_in_world[0]) / unit;
        let p = (origins_in_set[i] - origins_in_set[0]) / unit;
        for (row, n) in [(2 * i - 2, u), (2 * i - 1, v)] {
            rows[row][0] = n.dot(&first);
            rows[row][1..10].copy_from_slice(&rotation_row(&n, &x));
            rows[row][10] = -n.dot(&p);
        }
    }
    if !eliminate_columns(&mut rows, 1) {
        return solutions;
    }
    let quadrics = [1, 2, 3].map(|k| rotation_quadric(&rows[k][1..10], rows[k][10]));
    for v in &intersect_quadrics(&quadrics) {
        let rotation = cayley_numerator(v) / (1.0 + v.norm_squared());
        let mut sum = rows[0][10];
        for i in 0..3 {
            for j in 0..3 {
                sum += rows[0][1 + 3 * i + j] * rotation[(i, j)];
            }
        }
        let depth = -sum / rows[0][0];
        let valid = depth > 0.0
            && (1..3).all(|i| {
                let x = rotation * (turn * (points_in_world[i] - points_in_world[0])) / unit + first * depth;
                directions_in_set[i].dot(&(x - (origins_in_set[i] - origins_in_set[0]) / unit)) > 0.0
            });
        if valid {
            let rotation = inverse_rotation(&(rotation * turn));
            let in_set = origins_in_set[0] + first * (depth * unit);
            solutions.push(Rigid::new(rotation, points_in_world[0] - rotation * in_set));
        }
    }
    solutions
}

#[cfg(test)]
mod tests {
    use super::gp3p;
    use crate::Similarity;
    use crate::synthetic::{GeneralizedProblem, same_similarity, seeded};

    #[test]
    fn finds_the_truth_for_every_share_of_centres() {
        for (name, cameras) in [("3p 111", [0, 1, 2]), ("3p 21", [0, 0, 1]), ("3p 3", [0, 0, 0])] {
            let mut rng = seeded(name);
            let mut missed = 0;
            for _ in 0..5000 {
                let problem = GeneralizedProblem::exact(&mut rng, &cameras, false);
                let (origins, directions, points) = problem.sample();
                let truth = problem.world_from_set;
                let points = points.map(|x| x / truth.scale);
                let truth = Similarity { scale: 1.0, translation: truth.translation / truth.scale, ..truth };
                let found = gp3p(&origins, &directions, &points);
                missed += u32::from(!found.iter().any(|pose| same_similarity(&(*pose).into(), &truth, 1e-5)));
            }
            assert!(missed <= 5, "{name}: {missed}");
        }
    }
}
