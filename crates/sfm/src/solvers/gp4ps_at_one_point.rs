use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::{Solutions, polynomial::real_roots};
use crate::Similarity;

/// Finds world_from_set = (s, R, t) from two rays of a camera set that see one point and two that see another each; the
/// first two entries of `points_in_world` are equal.
///
/// The first two rays meet in P, which is where the set has X₁ = X₂. With uᵢ = pᵢ + λᵢ·xᵢ − P and dᵢ = Xᵢ − X₁,
/// |u₃|²·(d₃·d₄) = (u₃·u₄)·|d₃|² and |u₃|²·|d₄|² = |u₄|²·|d₃|²; the first gives λ₄ as a fraction in λ₃, and the second
/// is a quartic then. At most 4 solutions, in no order. Degenerate when the points lie on a line.
///
/// F. Camposeco, T. Sattler, M. Pollefeys, "Minimal Solvers for Generalized Pose and Scale Estimation from Two Rays and
/// One Point", ECCV 2016, whose point is triangulated by rays of the set, too.
pub(super) fn gp4ps_at_one_point(
    origins_in_set: &[Vector3<f64>; 4],
    directions_in_set: &[Vector3<f64>; 4],
    points_in_world: &[Vector3<f64>; 4],
) -> Solutions<Similarity, 8> {
    let mut solutions = Solutions::default();
    let Some(meeting) = meeting(origins_in_set, directions_in_set) else { return solutions };
    let [x, y] = [directions_in_set[2], directions_in_set[3]];
    let [d3, d4] = [2, 3].map(|i| points_in_world[i] - points_in_world[0]);
    let [a, b] = [2, 3].map(|i| origins_in_set[i] - meeting);
    if !(d3.norm_squared() > 0.0 && d4.norm_squared() > 0.0) {
        return solutions;
    }
    // λ₄ = numerator / denominator, |u₃|², all by powers of λ₃.
    let share = d3.dot(&d4) / d3.norm_squared();
    let squared = [a.norm_squared(), 2.0 * a.dot(&x), 1.0];
    let numerator = [share * squared[0] - a.dot(&b), share * squared[1] - x.dot(&b), share];
    let denominator = [a.dot(&y), x.dot(&y)];
    let denominator_squared = [
        denominator[0] * denominator[0],
        2.0 * denominator[0] * denominator[1],
        denominator[1] * denominator[1],
    ];
    let ratio = d4.norm_squared() / d3.norm_squared();
    let mut quartic = [0.0; 5];
    for i in 0..3 {
        for j in 0..3 {
            quartic[i + j] += numerator[i] * numerator[j] - ratio * squared[i] * denominator_squared[j];
        }
        for j in 0..2 {
            quartic[i + j] += 2.0 * b.dot(&y) * numerator[i] * denominator[j];
        }
        quartic[i] += b.norm_squared() * denominator_squared[i];
    }
    let Some(in_world) = frame(&d3, &d4) else { return solutions };
    for &depth in &real_roots(&quartic) {
        let other = (numerator[0] + depth * (numerator[1] + depth * numerator[2]))
            / (denominator[0] + depth * denominator[1]);
        if !(depth > 0.0 && other > 0.0 && other.is_finite()) {
            continue;
        }
        let (u3, u4) = (a + x * depth, b + y * other);
        let scale = d3.norm() / u3.norm();
        let Some(in_set) = frame(&u3, &u4).filter(|_| scale.is_finite()) else { continue };
        let turn = Rotation3::from_matrix_unchecked(in_world * in_set.transpose());
        let rotation = UnitQuaternion::from_rotation_matrix(&turn);
        let translation = points_in_world[0] - rotation * meeting * scale;
        solutions.push(Similarity { scale, rotation, translation });
    }
    solutions
}

/// Where the first two rays are nearest to each other, between them; `None` unless that is ahead on both.
fn meeting(origins: &[Vector3<f64>; 4], directions: &[Vector3<f64>; 4]) -> Option<Vector3<f64>> {
    let baseline = origins[1] - origins[0];
    let cosine = directions[0].dot(&directions[1]);
    let along = [directions[0].dot(&baseline), directions[1].dot(&baseline)];
    let sine_squared = 1.0 - cosine * cosine;
    let first = (along[0] - cosine * along[1]) / sine_squared;
    let second = (cosine * along[0] - along[1]) / sine_squared;
    let ahead = first > 0.0 && second > 0.0 && first.is_finite() && second.is_finite();
    ahead.then(|| (origins[0] + directions[0] * first + origins[1] + directions[1] * second) / 2.0)
}

/// The orthonormal frame of two vectors, as columns; `None` when they are parallel.
fn frame(first: &Vector3<f64>, second: &Vector3<f64>) -> Option<Matrix3<f64>> {
    let x = first.try_normalize(0.0)?;
    let z = x.cross(second).try_normalize(1e-12 * second.norm())?;
    Some(Matrix3::from_columns(&[x, z.cross(&x), z]))
}

#[cfg(test)]
mod tests {
    use crate::solvers::gp4ps;
    use crate::synthetic::{GeneralizedProblem, same_similarity, seeded};

    #[test]
    fn finds_the_truth_when_two_rays_see_one_point() {
        for cameras in [[0, 1, 2, 3], [0, 1, 0, 2], [0, 1, 0, 1]] {
            for [first, second] in [[0, 1], [1, 2], [3, 0]] {
                let mut rng = seeded("one point");
                let missed: u32 = (0..3_000)
                    .map(|_| {
                        let mut problem = GeneralizedProblem::exact(&mut rng, &cameras, false);
                        problem.see_one_point(first, second);
                        let (origins, directions, points) = problem.sample();
                        let found = gp4ps(&origins, &directions, &points);
                        u32::from(!found.iter().any(|s| same_similarity(s, &problem.world_from_set, 1e-5)))
                    })
                    .sum();
                assert!(missed <= 3, "{cameras:?} {first} {second}: {missed}");
            }
        }
    }

    #[test]
    fn two_points_in_all_leave_a_turn_free() {
        let mut problem = GeneralizedProblem::exact(&mut seeded("two points"), &[0, 1, 2, 3], false);
        problem.see_one_point(0, 1);
        problem.see_one_point(2, 3);
        let (origins, directions, points) = problem.sample();
        assert!(gp4ps(&origins, &directions, &points).is_empty());
    }
}
