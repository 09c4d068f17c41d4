use nalgebra::{Matrix3, Matrix3x4, SMatrix, SVector, Vector3};

use crate::{Rigid, Similarity};

/// Finds world_from_set = (s, R, t) linearly from six or more rays of a camera set and their points.
///
/// Equation: \[rᵢ\]×·T·X̃ᵢ = \[rᵢ\]×·Cᵢ, that is (X̃ᵢᵀ ⊗ \[rᵢ\]×)·vec(T) = \[rᵢ\]×·Cᵢ, with ray directions rᵢ and centres
/// Cᵢ in the set frame, homogeneous world points X̃ᵢ and T (3×4) mapping the world into the set frame. The 12 entries
/// are solved by least squares; the RQ decomposition of T's left block gives K and R, and T is projected to
/// s·\[R | t\] with s = trace(K)/3.
///
/// The linear solver of the image-set localization paper this project follows ("Image Set Localization", DLT with the
/// Kronecker product and projection by RQ, after R. Hartley, A. Zisserman, "Multiple View Geometry", section 6.2). One
/// solution, or `None` for fewer than six rays, and where the system is rank-deficient: coplanar points, or rays that
/// all meet in one point. Signs of depths are not imposed; λ > 0 is for the caller to test.
pub fn dlt(
    origins_in_set: &[Vector3<f64>],
    directions_in_set: &[Vector3<f64>],
    points_in_world: &[Vector3<f64>],
) -> Option<Similarity> {
    let count = points_in_world.len();
    if count < 6 || origins_in_set.len() != count || directions_in_set.len() != count {
        return None;
    }
    // Points are centred and scaled first: T·X̃ is invariant, the conditioning is not.
    let mean = points_in_world.iter().sum::<Vector3<f64>>() / count as f64;
    let spread = points_in_world.iter().map(|x| (x - mean).norm()).sum::<f64>() / count as f64;
    let reference = origins_in_set.iter().sum::<Vector3<f64>>() / count as f64;
    let reach = origins_in_set.iter().map(|c| (c - reference).norm()).fold(0.0, f64::max);
    if !(spread > 0.0) || !(reach > 0.0) {
        return None;
    }
    let mut normal = SMatrix::<f64, 12, 12>::zeros();
    let mut right = SVector::<f64, 12>::zeros();
    for i in 0..count {
        let x = (points_in_world[i] - mean) / spread;
        let homogeneous = [x.x, x.y, x.z, 1.0];
        // [r]ᵀ×·[r]× = I − r·rᵀ: the normal equations need the Kronecker product only in this form.
        let r = directions_in_set[i];
        let projector = Matrix3::identity() - r * r.transpose();
        let centre = projector * (origins_in_set[i] - reference) / reach;
        for a in 0..4 {
            for b in 0..4 {
                let weighted = projector * (homogeneous[a] * homogeneous[b]);
                let mut block = normal.fixed_view_mut::<3, 3>(3 * a, 3 * b);
                block += weighted;
            }
            let mut block = right.fixed_rows_mut::<3>(3 * a);
            block += centre * homogeneous[a];
        }
    }
    let eigen = normal.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    if !(eigen.eigenvalues.min() > 1e-13 * largest) {
        return None;
    }
    let scaled = eigen.eigenvectors.transpose() * right;
    let solution = eigen.eigenvectors * scaled.component_div(&eigen.eigenvalues);
    let t = Matrix3x4::from_column_slice(solution.as_slice());
    let left = t.fixed_columns::<3>(0).into_owned();
    let (upper, rotation) = rq(&left)?;
    // Set from world: s·(R·(X − mean)/spread) + t₄, in units of `reach` from `reference`.
    let scale = upper.trace() / 3.0 * reach / spread;
    if !(scale > 0.0) || !scale.is_finite() {
        return None;
    }
    // s·[R | t] with t = K⁻¹·T₄ replaces T = K·[R | t].
    let shift = upper.try_inverse()? * t.column(3) * (upper.trace() / 3.0 * reach);
    let set_from_mean = Rigid::from_matrix(&rotation, shift + reference);
    let set_from_world = Similarity {
        scale,
        rotation: set_from_mean.rotation,
        translation: set_from_mean.translation - set_from_mean.rotation * mean * scale,
    };
    Some(set_from_world.inverse())
}

/// A = K·R with K upper triangular of positive diagonal; `None` when A is singular or reflects.
fn rq(matrix: &Matrix3<f64>) -> Option<(Matrix3<f64>, Matrix3<f64>)> {
    let size = matrix.norm();
    let row = |k: usize| matrix.row(k).transpose();
    let r2 = row(2).try_normalize(1e-12 * size)?;
    let k12 = row(1).dot(&r2);
    let r1 = (row(1) - r2 * k12).try_normalize(1e-12 * size)?;
    let k02 = row(0).dot(&r2);
    let k01 = row(0).dot(&r1);
    let rest = row(0) - r2 * k02 - r1 * k01;
    let r0 = r1.cross(&r2);
    let k00 = rest.dot(&r0);
    if !(k00 > 1e-12 * size) {
        return None;
    }
    let upper = Matrix3::new(k00, k01, k02, 0.0, row(1).dot(&r1), k12, 0.0, 0.0, row(2).dot(&r2));
    Some((upper, Matrix3::from_rows(&[r0.transpose(), r1.transpose(), r2.transpose()])))
}

#[cfg(test)]
mod tests {
    use super::dlt;
    use crate::synthetic::{GeneralizedProblem, same_similarity, seeded};
    use nalgebra::Vector3;

    fn solve(problem: &GeneralizedProblem) -> Option<crate::Similarity> {
        let origins: Vec<_> = problem.rays.iter().map(|ray| ray.origin).collect();
        let directions: Vec<_> = problem.rays.iter().map(|ray| ray.direction).collect();
        dlt(&origins, &directions, &problem.points)
    }

    #[test]
    fn recovers_exact_data() {
        let mut rng = seeded("dlt");
        for count in [8, 20] {
            for _ in 0..200 {
                let cameras: Vec<_> = (0..count).map(|i| i % 4).collect();
                let problem = GeneralizedProblem::exact(&mut rng, &cameras, false);
                let found = solve(&problem).unwrap();
                assert!(same_similarity(&found, &problem.world_from_set, if count == 20 { 1e-9 } else { 1e-5 }));
            }
        }
    }

    #[test]
    fn refuses_planar_points_one_centre_and_five_rays() {
        let mut rng = seeded("dlt degenerate");
        let mut problem = GeneralizedProblem::exact(&mut rng, &[0, 1, 2, 3, 0, 1, 2, 3], false);
        assert!(dlt(&[Vector3::zeros(); 5], &[Vector3::x(); 5], &problem.points[..5]).is_none());
        let from_world = problem.world_from_set.inverse();
        for (ray, point) in problem.rays.iter_mut().zip(&mut problem.points) {
            point.z = 1.0;
            ray.direction = (from_world.transform_point(point) - ray.origin).normalize();
        }
        assert!(solve(&problem).is_none());
        assert!(solve(&GeneralizedProblem::exact(&mut rng, &[0; 8], false)).is_none());
    }
}
