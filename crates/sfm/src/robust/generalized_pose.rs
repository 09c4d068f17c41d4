use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::GeneralizedRay;
use super::absolute_pose::{cauchy_scale, turned};
use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, RansacParams, distinct, lo_ransac, robust_cost};
use super::residual::AngularResidual;
use crate::solvers::{dlt, gp3p, gp4ps, p3p, ugp3ps};
use crate::{Rigid, Similarity};

/// What is known of the scale of a camera set.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub enum SetScale {
    /// It is estimated.
    #[default]
    Unknown,
    /// World units per unit of the set; must be positive.
    Known(f64),
}

/// Which way is up, in both frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gravity {
    /// Unit vector in the set frame.
    pub up_in_set: Vector3<f64>,
    /// Unit vector in the world.
    pub up_in_world: Vector3<f64>,
}

/// How samples become models.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum GeneralizedSolver {
    /// Minimal samples: gp4ps, gp3p, ugp3ps or P3P, as scale, gravity and sample ask for.
    #[default]
    Minimal,
    /// Six rays and the linear solver with RQ projection, as in the image-set localization paper; needs unknown scale.
    Dlt,
}

/// Options of [`estimate_generalized_pose`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GeneralizedPoseOptions {
    /// What is known of the scale.
    pub scale: SetScale,
    /// The vertical, when known: samples then need three rays. The refinement does not enforce it. Unused when the
    /// scale is known.
    pub gravity: Option<Gravity>,
    /// How samples become models.
    pub solver: GeneralizedSolver,
}

/// The pose and scale of a camera set and who supports it.
#[derive(Debug, Clone, PartialEq)]
pub struct GeneralizedPoseEstimate {
    /// Xᵢ = s·R·(pᵢ + λᵢ·xᵢ) + t.
    pub world_from_set: Similarity,
    /// Whether the supporting rays come from different centres. Otherwise the scale is 1 (or the known one) by
    /// convention, and only the pose of the one supporting centre means something.
    pub scale_observable: bool,
    /// Indices of the supporting rays, ascending.
    pub inliers: Vec<u32>,
    /// Sum over all rays of min(r²/bound², 1).
    pub score: f64,
    /// Samples drawn.
    pub iterations: u32,
}

/// Origins closer than this part of the largest distance between origins coincide.
const SAME_CENTRE: f64 = 1e-9;
/// One sample in this many is drawn without regard to cameras, so that a set in which one camera has nearly all the
/// support is solved too.
const FREE_SAMPLES: u32 = 4;

/// Estimates world_from_set from rays of a camera set and the points they see.
///
/// LO-RANSAC with [`gp4ps`] (unknown scale), [`gp3p`] (known scale), [`ugp3ps`] (gravity) or [`dlt`], [`p3p`] when all
/// rays of a sample meet in one centre; Levenberg–Marquardt on the angular residuals of the inliers. Samples prefer
/// different cameras. `None` when the lists differ in length, a known scale is not positive, or fewer than
/// [`RansacParams::min_inliers`] rays agree.
pub fn estimate_generalized_pose(
    params: &RansacParams,
    rays_in_set: &[GeneralizedRay],
    points_in_world: &[Vector3<f64>],
    options: &GeneralizedPoseOptions,
    seed: u64,
) -> Option<GeneralizedPoseEstimate> {
    let mut problem = GeneralizedConsensus::new(params, rays_in_set, points_in_world, options)?;
    let found = lo_ransac(params, &mut problem, seed)?;
    let supporting_centre = problem.common_origin(&found.inliers);
    let mut world_from_set = found.model.similarity();
    if let (Some(centre), SetScale::Unknown) = (supporting_centre, options.scale) {
        // Any scale about the one centre fits equally well: take 1.
        let centre_in_world = world_from_set.transform_point(&centre);
        world_from_set.scale = 1.0;
        world_from_set.translation = centre_in_world - world_from_set.rotation * centre;
    }
    Some(GeneralizedPoseEstimate {
        world_from_set,
        scale_observable: supporting_centre.is_none(),
        inliers: found.inliers,
        score: found.score,
        iterations: found.iterations,
    })
}

/// Refines pose and scale by Levenberg–Marquardt with a Cauchy loss on the given rays (all indices must be valid).
pub fn refine_generalized_pose(
    params: &RansacParams,
    rays_in_set: &[GeneralizedRay],
    points_in_world: &[Vector3<f64>],
    options: &GeneralizedPoseOptions,
    inliers: &[u32],
    initial: &Similarity,
) -> Similarity {
    match GeneralizedConsensus::new(params, rays_in_set, points_in_world, options) {
        Some(problem) => problem.refine(&SetFromWorld::new(initial), inliers, 30).similarity(),
        None => *initial,
    }
}

/// s·(p + λ·x) = R·X + t: the inverse similarity times its scale, so that the scale stays on the side of the set.
#[derive(Debug, Clone, Copy)]
struct SetFromWorld {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    scale: f64,
}

impl SetFromWorld {
    fn new(world_from_set: &Similarity) -> Self {
        let inverse = Rigid::new(world_from_set.rotation, world_from_set.translation).inverse();
        Self {
            rotation: inverse.rotation.to_rotation_matrix().into_inner(),
            translation: inverse.translation,
            scale: world_from_set.scale,
        }
    }

    fn similarity(&self) -> Similarity {
        let inverse = Rigid::from_matrix(&self.rotation, self.translation).inverse();
        Similarity { scale: self.scale, rotation: inverse.rotation, translation: inverse.translation }
    }
}

struct GeneralizedConsensus<'a> {
    rays: &'a [GeneralizedRay],
    points: &'a [Vector3<f64>],
    options: GeneralizedPoseOptions,
    inverse_variances: Vec<f64>,
    inverse_scale_squared: f64,
    same_centre_squared: f64,
    /// Rotations that bring up to +z: of the set frame and of the world.
    upright: Option<(UnitQuaternion<f64>, UnitQuaternion<f64>)>,
    draws: u32,
}

impl<'a> GeneralizedConsensus<'a> {
    fn new(
        params: &RansacParams,
        rays: &'a [GeneralizedRay],
        points: &'a [Vector3<f64>],
        options: &GeneralizedPoseOptions,
    ) -> Option<Self> {
        if rays.len() != points.len() || rays.is_empty() {
            return None;
        }
        if let SetScale::Known(scale) = options.scale
            && (!(scale > 0.0) || !scale.is_finite())
        {
            return None;
        }
        let upright = match options.gravity {
            Some(gravity) if options.scale == SetScale::Unknown => {
                Some((upright(&gravity.up_in_set)?, upright(&gravity.up_in_world)?))
            }
            _ => None,
        };
        let extent = rays.iter().map(|ray| (ray.origin - rays[0].origin).norm_squared()).fold(0.0, f64::max);
        Some(Self {
            rays,
            points,
            options: *options,
            inverse_variances: rays.iter().map(|ray| 1.0 / (ray.sigma * ray.sigma)).collect(),
            inverse_scale_squared: cauchy_scale(params),
            same_centre_squared: extent * SAME_CENTRE * SAME_CENTRE,
            upright,
            draws: 0,
        })
    }

    /// The origin that the given rays share, if they do.
    fn common_origin(&self, indices: &[u32]) -> Option<Vector3<f64>> {
        let first = self.rays[*indices.first()? as usize].origin;
        let shares =
            |i: &u32| (self.rays[*i as usize].origin - first).norm_squared() <= self.same_centre_squared;
        indices.iter().all(shares).then_some(first)
    }

    /// `N` different rays, of different cameras where a few tries find them.
    fn draw<const N: usize>(&mut self, rng: &mut ChaCha8Rng) -> [usize; N] {
        let count = self.rays.len();
        self.draws += 1;
        let mut sample = distinct::<N>(rng, count);
        if !self.draws.is_multiple_of(FREE_SAMPLES) {
            for k in 1..N {
                for _ in 0..4 {
                    if sample[..k].iter().all(|i| self.rays[*i].camera != self.rays[sample[k]].camera) {
                        break;
                    }
                    let candidate = rng.random_range(0..count);
                    if !sample.contains(&candidate) {
                        sample[k] = candidate;
                    }
                }
            }
        }
        sample
    }

    /// Models from the first three rays of a sample that meet in one centre, with any scale.
    fn push_central(&self, sample: [usize; 3], scale: f64, models: &mut Vec<SetFromWorld>) {
        let centre = self.rays[sample[0]].origin;
        for pose in &p3p(&sample.map(|i| self.rays[i].direction), &sample.map(|i| self.points[i])) {
            let translation = pose.translation - pose.rotation * centre * scale;
            models.push(SetFromWorld::new(&Similarity { scale, rotation: pose.rotation, translation }));
        }
    }

    fn is_central(&self, sample: &[usize]) -> bool {
        let first = self.rays[sample[0]].origin;
        sample.iter().all(|i| (self.rays[*i].origin - first).norm_squared() <= self.same_centre_squared)
    }
}

/// A rotation that maps `up` to +z.
fn upright(up: &Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    let up = up.try_normalize(0.0)?;
    // The half turn about x when `up` is −z, where the shortest rotation is undefined.
    Some(
        UnitQuaternion::rotation_between(&up, &Vector3::z())
            .unwrap_or_else(|| UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI)),
    )
}

impl Consensus for GeneralizedConsensus<'_> {
    type Model = SetFromWorld;

    fn len(&self) -> usize {
        self.rays.len()
    }

    fn sample_size(&self) -> usize {
        match (self.options.solver, self.options.scale) {
            (GeneralizedSolver::Dlt, SetScale::Unknown) => 6,
            (_, SetScale::Known(_)) => 3,
            (GeneralizedSolver::Minimal, SetScale::Unknown) => {
                if self.upright.is_some() {
                    3
                } else {
                    4
                }
            }
        }
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<SetFromWorld>) {
        if let SetScale::Known(scale) = self.options.scale {
            let sample = self.draw::<3>(rng);
            if self.is_central(&sample) {
                self.push_central(sample, scale, models);
                return;
            }
            let origins = sample.map(|i| self.rays[i].origin * scale);
            let poses =
                gp3p(&origins, &sample.map(|i| self.rays[i].direction), &sample.map(|i| self.points[i]));
            models.extend(poses.iter().map(|pose| {
                SetFromWorld::new(&Similarity {
                    scale,
                    rotation: pose.rotation,
                    translation: pose.translation,
                })
            }));
        } else if self.options.solver == GeneralizedSolver::Dlt {
            let sample = self.draw::<6>(rng);
            let origins = sample.map(|i| self.rays[i].origin);
            let directions = sample.map(|i| self.rays[i].direction);
            models.extend(
                dlt(&origins, &directions, &sample.map(|i| self.points[i])).iter().map(SetFromWorld::new),
            );
        } else if let Some((from_set, from_world)) = self.upright {
            let sample = self.draw::<3>(rng);
            if self.is_central(&sample) {
                self.push_central(sample, 1.0, models);
                return;
            }
            let found = ugp3ps(
                &sample.map(|i| from_set * self.rays[i].origin),
                &sample.map(|i| from_set * self.rays[i].direction),
                &sample.map(|i| from_world * self.points[i]),
            );
            models.extend(found.iter().map(|similarity| {
                let rotation = from_world.inverse() * similarity.rotation * from_set;
                let translation = from_world.inverse() * similarity.translation;
                SetFromWorld::new(&Similarity { scale: similarity.scale, rotation, translation })
            }));
        } else {
            let sample = self.draw::<4>(rng);
            if self.is_central(&sample) {
                self.push_central([sample[0], sample[1], sample[2]], 1.0, models);
                return;
            }
            let found = gp4ps(
                &sample.map(|i| self.rays[i].origin),
                &sample.map(|i| self.rays[i].direction),
                &sample.map(|i| self.points[i]),
            );
            models.extend(found.iter().map(SetFromWorld::new));
        }
    }

    #[inline(always)]
    fn squared_residual(&self, model: &SetFromWorld, index: usize, _bound: f64) -> f64 {
        let ray = &self.rays[index];
        let target = model.rotation * self.points[index] + model.translation - ray.origin * model.scale;
        AngularResidual::squared(&ray.direction, &target, self.inverse_variances[index])
    }

    fn refine(&self, model: &SetFromWorld, inliers: &[u32], max_steps: usize) -> SetFromWorld {
        let centre = self.common_origin(inliers);
        let free_scale = self.options.scale == SetScale::Unknown && centre.is_none();
        minimize::<7, _>(&GeneralizedFit { data: self, inliers, free_scale }, *model, max_steps)
    }
}

struct GeneralizedFit<'a> {
    data: &'a GeneralizedConsensus<'a>,
    inliers: &'a [u32],
    free_scale: bool,
}

impl LeastSquares<7> for GeneralizedFit<'_> {
    type Model = SetFromWorld;

    /// Parameters: R ← exp(δω)·R (3), t ← t + δt (3), s ← s·exp(δσ) (1; its column is zero for a fixed scale).
    fn accumulate(&self, model: &SetFromWorld, normal: &mut Normal<7>) -> f64 {
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let ray = &self.data.rays[i];
            let rotated = model.rotation * self.data.points[i];
            let shift = ray.origin * model.scale;
            let residual =
                AngularResidual::new(&ray.direction, &(rotated + model.translation - shift), ray.sigma);
            let (loss, weight) = cauchy(residual.value.norm_squared(), self.data.inverse_scale_squared);
            cost += loss;
            for (value, row) in [(residual.value.x, residual.rows.0), (residual.value.y, residual.rows.1)] {
                let turn = rotated.cross(&row);
                let stretch = if self.free_scale { -row.dot(&shift) } else { 0.0 };
                let full = SVector::<f64, 7>::from([turn.x, turn.y, turn.z, row.x, row.y, row.z, stretch]);
                normal.add(value, &full, weight);
            }
        }
        cost
    }

    fn cost(&self, model: &SetFromWorld) -> f64 {
        robust_cost(self.data, model, self.inliers, self.data.inverse_scale_squared)
    }

    fn step(&self, model: &SetFromWorld, delta: &SVector<f64, 7>) -> SetFromWorld {
        SetFromWorld {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: model.translation + delta.fixed_rows::<3>(3),
            scale: model.scale * delta[6].exp(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{GeneralizedProblem, rotation_angle, same_similarity, seeded};

    const SIGMA: f64 = 0.5 / 800.0;

    fn disturbed(name: &str, cameras: &[u32], upright: bool, outliers: f64) -> GeneralizedProblem {
        let mut rng = seeded(name);
        let mut problem = GeneralizedProblem::exact(&mut rng, cameras, upright);
        problem.disturb(&mut rng, SIGMA, outliers);
        problem
    }

    fn estimate(
        problem: &GeneralizedProblem,
        options: &GeneralizedPoseOptions,
    ) -> Option<GeneralizedPoseEstimate> {
        let params = RansacParams { min_inliers: 10, ..RansacParams::default() };
        estimate_generalized_pose(&params, &problem.rays, &problem.points, options, 5)
    }

    fn spread(count: u32, cameras: u32) -> Vec<u32> {
        (0..count).map(|i| i % cameras).collect()
    }

    #[test]
    fn every_solver_finds_pose_and_scale_among_outliers() {
        let up = Some(Gravity { up_in_set: Vector3::z(), up_in_world: Vector3::z() });
        for seed in 0..20 {
            for (options, outliers) in [
                (GeneralizedPoseOptions::default(), 0.6),
                (GeneralizedPoseOptions { gravity: up, ..Default::default() }, 0.6),
                (GeneralizedPoseOptions { solver: GeneralizedSolver::Dlt, ..Default::default() }, 0.3),
            ] {
                let problem = disturbed(&format!("generalized {seed}"), &spread(200, 4), true, outliers);
                let found = estimate(&problem, &options).unwrap();
                let error = rotation_angle(&found.world_from_set.rotation, &problem.world_from_set.rotation);
                assert!(error.to_degrees() < 0.05, "{options:?} {error}");
                assert!((found.world_from_set.scale / problem.world_from_set.scale).ln().abs() < 0.02);
                assert!(found.scale_observable && found.inliers.len() > 70);
            }
        }
    }

    #[test]
    fn a_known_scale_stays() {
        let problem = disturbed("known", &spread(120, 3), false, 0.5);
        let scale = problem.world_from_set.scale;
        let options = GeneralizedPoseOptions { scale: SetScale::Known(scale), ..Default::default() };
        let found = estimate(&problem, &options).unwrap();
        assert_eq!(found.world_from_set.scale, scale);
        assert!(same_similarity(&found.world_from_set, &problem.world_from_set, 5e-3));
    }

    #[test]
    fn a_tilted_gravity_is_no_obstacle_to_frames() {
        let problem = disturbed("frames", &spread(120, 3), false, 0.5);
        let up_in_set = Vector3::new(0.0, -1.0, 0.0);
        let up_in_world = problem.world_from_set.rotation * up_in_set;
        let gravity = Some(Gravity { up_in_set, up_in_world });
        let found = estimate(&problem, &GeneralizedPoseOptions { gravity, ..Default::default() }).unwrap();
        assert!(same_similarity(&found.world_from_set, &problem.world_from_set, 2e-2));
    }

    #[test]
    fn one_centre_gives_the_pose_and_says_that_scale_is_free() {
        let problem = disturbed("central", &[0; 100], false, 0.5);
        let found = estimate(&problem, &GeneralizedPoseOptions::default()).unwrap();
        assert!(!found.scale_observable && found.world_from_set.scale == 1.0);
        let centre = problem.rays[0].origin;
        let truth = problem.world_from_set.transform_point(&centre);
        assert!(
            (found.world_from_set.transform_point(&centre) - truth).norm()
                < 0.05 * problem.world_from_set.scale
        );
        assert!(rotation_angle(&found.world_from_set.rotation, &problem.world_from_set.rotation) < 2e-3);
    }

    #[test]
    fn support_from_one_of_two_centres_is_not_scale() {
        let mut problem = disturbed("one of two", &spread(160, 2), false, 0.0);
        let mut rng = seeded("one of two");
        for ray in problem.rays.iter_mut().filter(|ray| ray.camera == 1) {
            ray.direction = crate::synthetic::random_unit(&mut rng);
        }
        let found = estimate(&problem, &GeneralizedPoseOptions::default()).unwrap();
        assert!(found.inliers.len() >= 75);
        assert!(rotation_angle(&found.world_from_set.rotation, &problem.world_from_set.rotation) < 2e-3);
    }

    #[test]
    fn refuses_nonsense() {
        let problem = disturbed("nonsense", &spread(60, 3), false, 1.0);
        let params = RansacParams { max_iterations: 500, min_inliers: 12, ..RansacParams::default() };
        let options = GeneralizedPoseOptions::default();
        assert!(estimate_generalized_pose(&params, &problem.rays, &problem.points, &options, 1).is_none());
        assert!(
            estimate_generalized_pose(&params, &problem.rays, &problem.points[1..], &options, 1).is_none()
        );
        let options = GeneralizedPoseOptions { scale: SetScale::Known(-1.0), ..options };
        assert!(estimate_generalized_pose(&params, &problem.rays, &problem.points, &options, 1).is_none());
    }
}
