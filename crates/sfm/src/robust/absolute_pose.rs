use nalgebra::{Matrix3, Rotation3, SVector, UnitQuaternion, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, RansacParams, distinct, lo_ransac, robust_cost};
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

/// Poses that differ from `current` by more than a small rotation and explain nearly as many of the same points.
///
/// Points on one far plane that fill a small angle allow two poses: the camera may stand on the one side of the plane's
/// normal or on the other (G. Schweighofer, A. Pinz, "Robust pose estimation from a planar target", PAMI 2006). Each is
/// a minimum of its own, which [`refine_absolute_pose`] does not leave. Sought by P3P from random samples and refined;
/// at most four, no two alike, the best first.
pub fn rival_poses(
    params: &RansacParams,
    bearings_in_camera: &[Vector3<f64>],
    sigmas: &[f64],
    points_in_world: &[Vector3<f64>],
    current: &Rigid,
    seed: u64,
) -> Vec<Rigid> {
    let Some(mut problem) = AbsoluteConsensus::new(params, bearings_in_camera, sigmas, points_in_world)
        .filter(|problem| problem.len() >= params.min_inliers.max(problem.sample_size()))
    else {
        return Vec::new();
    };
    let bound = params.max_error_sigma * params.max_error_sigma;
    let inliers = |problem: &AbsoluteConsensus<'_>, model: &CameraFromWorld| -> Vec<u32> {
        let indices = (0..problem.len()).filter(|&at| problem.squared_residual(model, at, bound) <= bound);
        indices.map(|at| at as u32).collect()
    };
    let enough = RIVAL_SHARE * inliers(&problem, &CameraFromWorld::new(current)).len() as f64;
    let differ = |a: &Rigid, b: &Rigid| a.rotation.angle_to(&b.rotation) > RIVAL_ROTATION_RAD;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut models = Vec::new();
    let mut rivals: Vec<(f64, Rigid)> = Vec::new();
    for _ in 0..RIVAL_SAMPLES {
        models.clear();
        problem.hypothesize(&mut rng, &mut models);
        for model in &models {
            let agreeing = inliers(&problem, model);
            if (agreeing.len() as f64) < enough || !differ(&model.world_from_camera(), current) {
                continue;
            }
            let refined = problem.refine(model, &agreeing, 30);
            let pose = refined.world_from_camera();
            if (inliers(&problem, &refined).len() as f64) < enough || !differ(&pose, current) {
                continue;
            }
            let residuals = (0..problem.len()).map(|at| problem.squared_residual(&refined, at, bound));
            rivals.push((residuals.map(|squared| squared.min(bound)).sum(), pose));
        }
    }
    rivals.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut kept: Vec<Rigid> = Vec::new();
    for (_, pose) in rivals {
        if kept.len() < MAX_RIVALS && kept.iter().all(|other| differ(&pose, other)) {
            kept.push(pose);
        }
    }
    kept
}

/// Most rivals of a pose.
const MAX_RIVALS: usize = 4;
/// Samples of three points from which rivals are sought.
const RIVAL_SAMPLES: usize = 64;
/// Least rotation of a rival against the pose and other rivals.
const RIVAL_ROTATION_RAD: f64 = 0.05;
/// Least inliers of a rival, of those of the pose.
const RIVAL_SHARE: f64 = 0.6;

/// y = R·X + t with the rotation as a matrix.
#[derive(Debug, Clone, Copy)]
struct CameraFromWorld {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl CameraFromWorld {
    fn new(world_from_camera: &Rigid) -> Self {
        let inverse = world_from_camera.inverse();
        Self {
            rotation: inverse.rotation.to_rotation_matrix().into_inner(),
            translation: inverse.translation,
        }
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
        robust_cost(self.data, model, self.inliers, self.data.inverse_scale_squared)
    }

    fn step(&self, model: &CameraFromWorld, delta: &SVector<f64, 6>) -> CameraFromWorld {
        CameraFromWorld {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: model.translation + delta.fixed_rows::<3>(3),
        }
    }
}

/// exp(δω)·R, with the rounding of many products removed.
pub(crate) fn turned(rotation: &Matrix3<f64>, delta: &Vector3<f64>) -> Matrix3<f64> {
    let turned = UnitQuaternion::from_scaled_axis(*delta)
        * UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*rotation));
    turned.to_rotation_matrix().into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{AbsoluteProblem, normal, perturb, rotation_angle, seeded};
    use rand::Rng;

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
            let found =
                estimate_absolute_pose(&params, &problem.bearings, &[1e-3; 60], &problem.points, seed);
            assert!(found.is_none());
        }
    }

    /// A wall 12 m off of which a strip of 3 × 3 m is seen, from a place to the right of its normal.
    fn wall(rng: &mut ChaCha8Rng) -> (Rigid, Vec<Vector3<f64>>) {
        let points = (0..60).map(|_| {
            let [x, y] = [0, 1].map(|_| rng.random_range(-1.5..1.5));
            Vector3::new(x, y, 12.0 + 0.02 * normal(rng))
        });
        let points = points.collect();
        let turned = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -0.2);
        (Rigid::new(turned, Vector3::new(2.4, 0.1, 0.3)), points)
    }

    #[test]
    fn a_far_wall_allows_a_second_pose() {
        let mut rng = seeded("far wall");
        let sigma = 1e-3;
        let mut mistaken = 0;
        for seed in 0..20 {
            let (truth, points) = wall(&mut rng);
            let bearings: Vec<Vector3<f64>> = points
                .iter()
                .map(|point| perturb(&mut rng, &truth.inverse_transform_point(point).normalize(), sigma))
                .collect();
            let params = RansacParams { min_inliers: 8, ..RansacParams::default() };
            let rivals =
                |pose: &Rigid| rival_poses(&params, &bearings, &[3.0 * sigma; 60], &points, pose, seed);
            let off = |pose: &Rigid| rotation_angle(&pose.rotation, &truth.rotation);
            // From the mistaken pose the true one is found.
            for mistake in rivals(&truth).iter().filter(|rival| off(rival) > 0.2) {
                mistaken += 1;
                let nearest = rivals(mistake).iter().map(off).fold(f64::INFINITY, f64::min);
                assert!(nearest < 0.1, "seed {seed}: {nearest}");
            }
        }
        assert!(mistaken > 5, "{mistaken}");
    }

    #[test]
    fn points_all_around_allow_one_pose_only() {
        let mut rng = seeded("no rivals");
        for seed in 0..20 {
            let problem = AbsoluteProblem::exact(&mut rng, 60);
            let params = RansacParams { min_inliers: 8, ..RansacParams::default() };
            let rivals = rival_poses(
                &params,
                &problem.bearings,
                &[3e-3; 60],
                &problem.points,
                &problem.world_from_camera,
                seed,
            );
            assert!(rivals.is_empty(), "seed {seed}: {rivals:?}");
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
