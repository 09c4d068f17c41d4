use nalgebra::{Matrix3, Rotation3, SVector, UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;

use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, RansacParams, distinct, lo_ransac};
use super::residual::AngularResidual;
use crate::Rigid;
use crate::solvers::p3p;

/// The pose of a camera and who supports it.
#[derive(Debug, Clone, PartialEq)]
pub struct AbsolutePoseEstimate {
    /// The pose.
    pub world_from_camera: Rigid,
    /// Indices of the supporting bearings, ascending.
    pub inliers: Vec<u32>,
    /// Sum over all bearings of min(r²/bound², 1): lower is better, at most the number of bearings.
    pub score: f64,
    /// Samples drawn.
    pub iterations: u32,
}

/// Estimates world_from_camera from unit bearings and the points they see.
///
/// P3P in LO-RANSAC, Levenberg–Marquardt on the angular residuals of the inliers. `sigmas` are the standard deviations
/// of the bearings per tangent axis in radians. `None` when the lists differ in length or fewer than
/// [`RansacParams::min_inliers`] bearings agree.
pub fn estimate_absolute_pose(
    params: &RansacParams,
    bearings_in_camera: &[Vector3<f64>],
    sigmas: &[f64],
    points_in_world: &[Vector3<f64>],
    seed: u64,
) -> Option<AbsolutePoseEstimate> {
    let mut problem = AbsoluteConsensus::new(params, bearings_in_camera, sigmas, points_in_world)?;
    let found = lo_ransac(params, &mut problem, seed)?;
    Some(AbsolutePoseEstimate {
        world_from_camera: found.model.world_from_camera(),
        inliers: found.inliers,
        score: found.score,
        iterations: found.iterations,
    })
}

/// Refines a pose by Levenberg–Marquardt with a Cauchy loss on the given bearings (all indices must be valid).
pub fn refine_absolute_pose(
    params: &RansacParams,
    bearings_in_camera: &[Vector3<f64>],
    sigmas: &[f64],
    points_in_world: &[Vector3<f64>],
    inliers: &[u32],
    initial: &Rigid,
) -> Rigid {
    match AbsoluteConsensus::new(params, bearings_in_camera, sigmas, points_in_world) {
        Some(problem) => problem.refine(&CameraFromWorld::new(initial), inliers, 30).world_from_camera(),
        None => *initial,
    }
}

/// y = R·X + t with the rotation as a matrix.
#[derive(Debug, Clone, Copy)]
struct CameraFromWorld {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl CameraFromWorld {
    fn new(world_from_camera: &Rigid) -> Self {
        let inverse = world_from_camera.inverse();
        Self { rotation: inverse.rotation.to_rotation_matrix().into_inner(), translation: inverse.translation }
    }

    fn world_from_camera(&self) -> Rigid {
        Rigid::from_matrix(&self.rotation, self.translation).inverse()
    }
}

struct AbsoluteConsensus<'a> {
    bearings: &'a [Vector3<f64>],
    sigmas: &'a [f64],
    points: &'a [Vector3<f64>],
    inverse_variances: Vec<f64>,
    inverse_scale_squared: f64,
}

impl<'a> AbsoluteConsensus<'a> {
    fn new(
        params: &RansacParams,
        bearings: &'a [Vector3<f64>],
        sigmas: &'a [f64],
        points: &'a [Vector3<f64>],
    ) -> Option<Self> {
        if bearings.len() != points.len() || bearings.len() != sigmas.len() {
            return None;
        }
        Some(Self {
            bearings,
            sigmas,
            points,
            inverse_variances: sigmas.iter().map(|sigma| 1.0 / (sigma * sigma)).collect(),
            inverse_scale_squared: cauchy_scale(params),
        })
    }
}

/// 1/c² of the Cauchy loss: half the inlier bound.
pub(super) fn cauchy_scale(params: &RansacParams) -> f64 {
    4.0 / (params.max_error_sigma * params.max_error_sigma)
}

impl Consensus for AbsoluteConsensus<'_> {
    type Model = CameraFromWorld;

    fn len(&self) -> usize {
        self.bearings.len()
    }

    fn sample_size(&self) -> usize {
        3
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<CameraFromWorld>) {
        let sample = distinct::<3>(rng, self.len());
        let poses = p3p(&sample.map(|i| self.bearings[i]), &sample.map(|i| self.points[i]));
        models.extend(poses.iter().map(CameraFromWorld::new));
    }

    #[inline(always)]
    fn squared_residual(&self, model: &CameraFromWorld, index: usize, _bound: f64) -> f64 {
        let target = model.rotation * self.points[index] + model.translation;
        AngularResidual::squared(&self.bearings[index], &target, self.inverse_variances[index])
    }

    fn refine(&self, model: &CameraFromWorld, inliers: &[u32], max_steps: usize) -> CameraFromWorld {
        minimize::<6, _>(&AbsoluteFit { data: self, inliers }, *model, max_steps)
    }
}

struct AbsoluteFit<'a> {
    data: &'a AbsoluteConsensus<'a>,
    inliers: &'a [u32],
}

impl LeastSquares<6> for AbsoluteFit<'_> {
    type Model = CameraFromWorld;

    fn accumulate(&self, model: &CameraFromWorld, normal: &mut Normal<6>) -> f64 {
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let rotated = model.rotation * self.data.points[i];
            let target = rotated + model.translation;
            let residual = AngularResidual::new(&self.data.bearings[i], &target, self.data.sigmas[i]);
            let (loss, weight) = cauchy(residual.value.norm_squared(), self.data.inverse_scale_squared);
            cost += loss;
            // δy = δω × R·X + δt for R ← exp(δω)·R: row · (δω × v) = δω · (v × row).
            for (value, row) in [(residual.value.x, residual.rows.0), (residual.value.y, residual.rows.1)] {
                let turn = rotated.cross(&row);
                let full = SVector::<f64, 6>::from([turn.x, turn.y, turn.z, row.x, row.y, row.z]);
                normal.add(value, &full, weight);
            }
        }
        cost
    }

    fn cost(&self, model: &CameraFromWorld) -> f64 {
        let mut cost = 0.0;
        for index in self.inliers {
            let squared = self.data.squared_residual(model, *index as usize, f64::INFINITY);
            cost += cauchy(squared, self.data.inverse_scale_squared).0;
        }
        cost
    }

    fn step(&self, model: &CameraFromWorld, delta: &SVector<f64, 6>) -> CameraFromWorld {
        CameraFromWorld {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: model.translation + delta.fixed_rows::<3>(3),
        }
    }
}

/// exp(δω)·R, with the rounding of many products removed.
pub(super) fn turned(rotation: &Matrix3<f64>, delta: &Vector3<f64>) -> Matrix3<f64> {
    let turned = UnitQuaternion::from_scaled_axis(*delta)
        * UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*rotation));
    turned.to_rotation_matrix().into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{AbsoluteProblem, rotation_angle, seeded};

    #[test]
    fn finds_every_pose_among_outliers() {
        let mut rng = seeded("absolute");
        let sigma = 0.5 / 800.0;
        let mut rotations = Vec::new();
        for seed in 0..200 {
            let mut problem = AbsoluteProblem::exact(&mut rng, 100);
            problem.disturb(&mut rng, sigma, 0.5);
            let found = estimate_absolute_pose(
                &RansacParams::default(),
                &problem.bearings,
                &vec![sigma; 100],
                &problem.points,
                seed,
            )
            .unwrap();
            let truth = problem.world_from_camera;
            rotations.push(rotation_angle(&found.world_from_camera.rotation, &truth.rotation).to_degrees());
            assert!((found.world_from_camera.translation - truth.translation).norm() < 0.02);
            assert!(found.inliers.iter().filter(|i| problem.outlier[**i as usize]).count() <= 1);
            assert!(found.inliers.len() >= 46);
        }
        rotations.sort_by(f64::total_cmp);
        assert!(rotations[100] < 0.013 && rotations[199] < 0.05, "{} {}", rotations[100], rotations[199]);
    }

    #[test]
    fn refuses_pure_outliers() {
        let mut rng = seeded("absolute outliers");
        for seed in 0..3 {
            let mut problem = AbsoluteProblem::exact(&mut rng, 60);
            problem.disturb(&mut rng, 1e-3, 1.0);
            let params = RansacParams { max_iterations: 1000, min_inliers: 8, ..RansacParams::default() };
            let found = estimate_absolute_pose(&params, &problem.bearings, &[1e-3; 60], &problem.points, seed);
            assert!(found.is_none());
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes() {
        let mut rng = seeded("absolute seed");
        let mut problem = AbsoluteProblem::exact(&mut rng, 50);
        problem.disturb(&mut rng, 1e-3, 0.3);
        let run = || {
            let params = RansacParams::default();
            estimate_absolute_pose(&params, &problem.bearings, &[1e-3; 50], &problem.points, 7)
        };
        assert_eq!(run(), run());
    }
}
