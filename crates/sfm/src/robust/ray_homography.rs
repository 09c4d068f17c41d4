use nalgebra::{Matrix3, SVector, Vector3};
use rand_chacha::ChaCha8Rng;

use super::absolute_pose::cauchy_scale;
use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, RansacParams, distinct, lo_ransac, robust_cost};
use super::residual::AngularResidual;
use crate::solvers::ray_homography;

/// A homography between the rays of two views and who supports it.
#[derive(Debug, Clone, PartialEq)]
pub struct RayHomographyEstimate {
    /// x₂ ∝ H·x₁ with a positive factor; ‖H‖ = 1.
    pub second_from_first: Matrix3<f64>,
    /// Indices of the supporting pairs, ascending.
    pub inliers: Vec<u32>,
    /// Sum over all pairs of min(r²/bound², 1).
    pub score: f64,
    /// Samples drawn.
    pub iterations: u32,
}

/// Estimates the homography of a dominant plane from pairs of unit bearings: four-point LO-RANSAC.
///
/// The residual is the angle in the second view against the sum of both variances, which takes H as nearly
/// angle-preserving: it serves to tell whether a plane explains the matches, not to measure it. `None` when the lists
/// differ in length or fewer than [`RansacParams::min_inliers`] pairs agree.
pub fn estimate_ray_homography(
    params: &RansacParams,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
    sigmas_first: &[f64],
    sigmas_second: &[f64],
    seed: u64,
) -> Option<RayHomographyEstimate> {
    let count = first.len();
    if second.len() != count || sigmas_first.len() != count || sigmas_second.len() != count {
        return None;
    }
    let variances = sigmas_first.iter().zip(sigmas_second).map(|(a, b)| a * a + b * b).collect();
    let mut problem =
        HomographyConsensus { first, second, variances, inverse_scale_squared: cauchy_scale(params) };
    let found = lo_ransac(params, &mut problem, seed)?;
    Some(RayHomographyEstimate {
        second_from_first: found.model,
        inliers: found.inliers,
        score: found.score,
        iterations: found.iterations,
    })
}

struct HomographyConsensus<'a> {
    first: &'a [Vector3<f64>],
    second: &'a [Vector3<f64>],
    variances: Vec<f64>,
    inverse_scale_squared: f64,
}

impl Consensus for HomographyConsensus<'_> {
    type Model = Matrix3<f64>;

    fn len(&self) -> usize {
        self.first.len()
    }

    fn sample_size(&self) -> usize {
        4
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<Matrix3<f64>>) {
        let sample = distinct::<4>(rng, self.len());
        models.extend(ray_homography(&sample.map(|i| self.first[i]), &sample.map(|i| self.second[i])));
    }

    #[inline(always)]
    fn squared_residual(&self, model: &Matrix3<f64>, index: usize, _bound: f64) -> f64 {
        let target = model * self.first[index];
        AngularResidual::squared(&self.second[index], &target, 1.0 / self.variances[index])
    }

    fn refine(&self, model: &Matrix3<f64>, inliers: &[u32], max_steps: usize) -> Matrix3<f64> {
        minimize::<9, _>(&HomographyFit { data: self, inliers }, *model, max_steps)
    }
}

struct HomographyFit<'a> {
    data: &'a HomographyConsensus<'a>,
    inliers: &'a [u32],
}

impl LeastSquares<9> for HomographyFit<'_> {
    type Model = Matrix3<f64>;

    /// Parameters: the entries of H by rows (9); the damping holds the free scale.
    fn accumulate(&self, model: &Matrix3<f64>, normal: &mut Normal<9>) -> f64 {
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let a = self.data.first[i];
            let sigma = self.data.variances[i].sqrt();
            let residual = AngularResidual::new(&self.data.second[i], &(model * a), sigma);
            let (loss, weight) = cauchy(residual.value.norm_squared(), self.data.inverse_scale_squared);
            cost += loss;
            for (value, row) in [(residual.value.x, residual.rows.0), (residual.value.y, residual.rows.1)] {
                let full = SVector::<f64, 9>::from_fn(|k, _| row[k / 3] * a[k % 3]);
                normal.add(value, &full, weight);
            }
        }
        cost
    }

    fn cost(&self, model: &Matrix3<f64>) -> f64 {
        robust_cost(self.data, model, self.inliers, self.data.inverse_scale_squared)
    }

    fn step(&self, model: &Matrix3<f64>, delta: &SVector<f64, 9>) -> Matrix3<f64> {
        let moved = model + Matrix3::from_row_slice(delta.as_slice());
        moved / moved.norm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{RelativeProblem, perturb, random_unit, seeded};

    #[test]
    fn a_plane_is_found_and_a_general_scene_is_not() {
        let mut rng = seeded("plane");
        let pose = RelativeProblem::exact(&mut rng, 1).second_from_first;
        let (mut first, mut second) = (Vec::new(), Vec::new());
        while first.len() < 100 {
            let bearing = random_unit(&mut rng);
            if bearing.z > 0.2 {
                let target = pose.transform_point(&(bearing * (3.0 / bearing.z))).normalize();
                let wrong = first.len() < 30;
                second.push(if wrong { random_unit(&mut rng) } else { perturb(&mut rng, &target, 1e-3) });
                first.push(perturb(&mut rng, &bearing, 1e-3));
            }
        }
        let (params, sigmas) = (RansacParams::default(), [1e-3; 100]);
        let found = estimate_ray_homography(&params, &first, &second, &sigmas, &sigmas, 3).unwrap();
        assert!(found.inliers.len() >= 66 && found.inliers.iter().filter(|i| **i < 30).count() <= 1);
        let general = RelativeProblem::exact(&mut rng, 100);
        let found = estimate_ray_homography(
            &RansacParams { max_iterations: 500, ..params },
            &general.first,
            &general.second,
            &sigmas,
            &sigmas,
            3,
        );
        assert!(found.is_none_or(|estimate| estimate.inliers.len() < 20));
    }
}
