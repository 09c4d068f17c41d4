use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;

use super::absolute_pose::{cauchy_scale, turned};
use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, Consented, RansacParams, distinct, lo_ransac, lo_ransac_from, robust_cost};
use super::{median, residual::AngularResidual};
use crate::Rigid;
use crate::solvers::essential::{is_in_front, rotations_of_essential};
use crate::solvers::{five_point, tangent_basis, upright_three_point};

/// The relative pose of two views and who supports it.
#[derive(Debug, Clone, PartialEq)]
pub struct RelativePoseEstimate {
    /// The pose, its translation of unit length.
    pub second_from_first: Rigid,
    /// Indices of the supporting pairs, ascending.
    pub inliers: Vec<u32>,
    /// Sum over all pairs of min(r²/bound², 1).
    pub score: f64,
    /// Samples drawn.
    pub iterations: u32,
}

/// A rotation that maps bearings of one view onto another's, and who supports it.
#[derive(Debug, Clone, PartialEq)]
pub struct RotationEstimate {
    /// x₂ = R·x₁.
    pub second_from_first: UnitQuaternion<f64>,
    /// Indices of the supporting pairs, ascending.
    pub inliers: Vec<u32>,
    /// Sum over all pairs of min(r²/bound², 1).
    pub score: f64,
    /// Samples drawn.
    pub iterations: u32,
}

/// Estimates second_from_first from pairs of unit bearings.
///
/// Five-point in LO-RANSAC on the whitened tangent-plane Sampson error; depths of supporting pairs are positive unless
/// the rays are parallel within their noise. Levenberg–Marquardt over rotation and direction of the translation
/// finishes. Sigmas are standard deviations per tangent axis in radians. `None` when the lists differ in length or
/// fewer than [`RansacParams::min_inliers`] pairs agree. A pure rotation leaves the translation arbitrary: see
/// [`estimate_rotation`].
pub fn estimate_relative_pose(
    params: &RansacParams,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
    sigmas_first: &[f64],
    sigmas_second: &[f64],
    seed: u64,
) -> Option<RelativePoseEstimate> {
    let matches = RelativeMatches::new(params, first, second, sigmas_first, sigmas_second)?;
    Some(lo_ransac(params, &mut Sampled::<_, 5> { matches: &matches, sampler: Five }, seed)?.into())
}

/// [`estimate_relative_pose`] where the y axes of both views are vertical to a few degrees: `upright` samples of three, scored with
/// a wider bound, before those of five.
///
/// Three are right together far more often than five: of 1000 samples one is, but for 1 in 1000 pairs, where a fifth of the matches
/// is right, and of five where two in five are. Refinement frees all five parameters, and pairs that stand more tilted than the
/// wider bound bears are left to the samples of five.
pub(crate) fn estimate_level_pose(
    params: &RansacParams,
    upright: u32,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
    sigmas_first: &[f64],
    sigmas_second: &[f64],
    seed: u64,
) -> Option<RelativePoseEstimate> {
    let matches = &RelativeMatches::new(params, first, second, sigmas_first, sigmas_second)?;
    let begun = RansacParams { max_iterations: upright, ..params.clone() };
    let start =
        lo_ransac(&begun, &mut Sampled::<_, 3> { matches, sampler: Upright }, seed).map(|found| found.model);
    Some(lo_ransac_from(start, params, &mut Sampled::<_, 5> { matches, sampler: Five }, seed)?.into())
}

/// [`estimate_relative_pose`] where the rotation is known to a few degrees: two-point LO-RANSAC of the direction of the
/// translation. Refinement frees the rotation, too.
pub(crate) fn estimate_turned_pose(
    params: &RansacParams,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
    sigmas_first: &[f64],
    sigmas_second: &[f64],
    second_from_first: &UnitQuaternion<f64>,
    seed: u64,
) -> Option<RelativePoseEstimate> {
    let matches = RelativeMatches::new(params, first, second, sigmas_first, sigmas_second)?;
    let sampler = Turned { rotation: second_from_first.to_rotation_matrix().into_inner() };
    Some(lo_ransac(params, &mut Sampled::<_, 2> { matches: &matches, sampler }, seed)?.into())
}

/// Refines a relative pose by Levenberg–Marquardt with a Cauchy loss on the given pairs (all indices must be valid).
pub fn refine_relative_pose(
    params: &RansacParams,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
    sigmas_first: &[f64],
    sigmas_second: &[f64],
    inliers: &[u32],
    initial: &Rigid,
) -> Rigid {
    let Some(matches) = RelativeMatches::new(params, first, second, sigmas_first, sigmas_second) else {
        return *initial;
    };
    let Some(translation) = initial.translation.try_normalize(0.0) else {
        return *initial;
    };
    let rotation = initial.rotation.to_rotation_matrix().into_inner();
    let refined = matches.refine(&SecondFromFirst { rotation, translation }, inliers, 30);
    Rigid::from_matrix(&refined.rotation, refined.translation)
}

/// Estimates a pure rotation from pairs of unit bearings: two-point LO-RANSAC.
///
/// Compare its support with [`estimate_relative_pose`]'s: where a rotation explains as many pairs there is no parallax.
pub fn estimate_rotation(
    params: &RansacParams,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
    sigmas_first: &[f64],
    sigmas_second: &[f64],
    seed: u64,
) -> Option<RotationEstimate> {
    let mut problem =
        RotationConsensus(RelativeMatches::new(params, first, second, sigmas_first, sigmas_second)?);
    let found = lo_ransac(params, &mut problem, seed)?;
    Some(RotationEstimate {
        second_from_first: Rigid::from_matrix(&found.model, Vector3::zeros()).rotation,
        inliers: found.inliers,
        score: found.score,
        iterations: found.iterations,
    })
}

/// How much farther off a rotation leaves matches than a relative pose that they agree with, too: the ratio of the variances per
/// dimension, told by medians.
///
/// A rotation has errors in two dimensions, an epipolar line in the one across it. Where there is no baseline both are the noise
/// of the keypoints, which may be far below the stated one; where there is one, the rotation's are the parallax, too. `matches`
/// are indices of those that both explain; `None` without any.
pub(crate) fn misfit_of_rotation(
    (first, second): (&[Vector3<f64>], &[Vector3<f64>]),
    (sigmas_first, sigmas_second): (&[f64], &[f64]),
    matches: &[u32],
    second_from_first: &Rigid,
    rotation: &UnitQuaternion<f64>,
) -> Option<f64> {
    let params = RansacParams::default();
    let data = RotationConsensus(RelativeMatches::new(&params, first, second, sigmas_first, sigmas_second)?);
    let pose = SecondFromFirst {
        rotation: second_from_first.rotation.to_rotation_matrix().into_inner(),
        translation: second_from_first.translation.try_normalize(0.0)?,
    };
    let turned = rotation.to_rotation_matrix().into_inner();
    let squared_of_pose = |&index: &u32| {
        let term = data.0.sampson(&pose, index as usize);
        term.error * term.error / term.variance
    };
    let squared_of_turn = |&index: &u32| data.squared_residual(&turned, index as usize, f64::INFINITY);
    let of_pose = median(matches.iter().map(squared_of_pose).collect())?;
    let of_turn = median(matches.iter().map(squared_of_turn).collect())?;
    Some((of_turn / MEDIAN_OF_TWO) / (of_pose / MEDIAN_OF_ONE).max(LEAST_VARIANCE))
}

/// Median of the square of a standard normal variable, and of the sum of two such.
const MEDIAN_OF_ONE: f64 = 0.454_936;
const MEDIAN_OF_TWO: f64 = 2.0 * std::f64::consts::LN_2;

/// Share of the stated variance below which that of keypoints is not told.
const LEAST_VARIANCE: f64 = 0.01;

/// Rays whose normal is below this many standard deviations are parallel: their depth signs mean nothing.
const PARALLEL_SIGMA: f64 = 3.0;

#[derive(Debug, Clone, Copy)]
pub(super) struct SecondFromFirst {
    pub rotation: Matrix3<f64>,
    /// Of unit length.
    pub translation: Vector3<f64>,
}

impl From<Consented<SecondFromFirst>> for RelativePoseEstimate {
    fn from(found: Consented<SecondFromFirst>) -> Self {
        Self {
            second_from_first: Rigid::from_matrix(&found.model.rotation, found.model.translation),
            inliers: found.inliers,
            score: found.score,
            iterations: found.iterations,
        }
    }
}

pub(super) struct RelativeMatches<'a> {
    pub first: &'a [Vector3<f64>],
    pub second: &'a [Vector3<f64>],
    pub variances: Vec<(f64, f64)>,
    pub inverse_scale_squared: f64,
}

impl<'a> RelativeMatches<'a> {
    pub fn new(
        params: &RansacParams,
        first: &'a [Vector3<f64>],
        second: &'a [Vector3<f64>],
        sigmas_first: &[f64],
        sigmas_second: &[f64],
    ) -> Option<Self> {
        let count = first.len();
        if second.len() != count || sigmas_first.len() != count || sigmas_second.len() != count {
            return None;
        }
        Some(Self {
            first,
            second,
            variances: sigmas_first.iter().zip(sigmas_second).map(|(a, b)| (a * a, b * b)).collect(),
            inverse_scale_squared: cauchy_scale(params),
        })
    }

    /// Sampson residual and, on request, its derivative over (δω, δt) with R ← exp(δω)·R, t ← t + δt (3 + 3).
    ///
    /// e = x₂·(t × y) with y = R·x₁; its variance v = σ₁²·‖B₁ᵀEᵀx₂‖² + σ₂²·‖B₂ᵀEx₁‖² simplifies for unit vectors to
    /// σ₁²·(1 − (x₂·t)² − e²) + σ₂²·(1 − (t·y)² − e²).
    #[inline(always)]
    pub fn sampson(&self, model: &SecondFromFirst, index: usize) -> Sampson {
        let (variance_first, variance_second) = self.variances[index];
        let rotated = model.rotation * self.first[index];
        let second = self.second[index];
        let error = second.dot(&model.translation.cross(&rotated));
        let (along_second, along_first) = (second.dot(&model.translation), rotated.dot(&model.translation));
        let square = error * error;
        let variance = variance_first * (1.0 - along_second * along_second - square)
            + variance_second * (1.0 - along_first * along_first - square);
        // At the epipoles both terms vanish; a floor keeps such a pair harmless instead of infinite.
        let variance = variance.max(1e-12 * (variance_first + variance_second));
        Sampson { rotated, error, variance, along_second, along_first }
    }

    /// Cauchy loss of the residual.
    #[inline(always)]
    pub fn loss(&self, model: &SecondFromFirst, index: usize) -> f64 {
        let term = self.sampson(model, index);
        cauchy(term.error * term.error / term.variance, self.inverse_scale_squared).0
    }

    /// [`Consensus::squared_residual`].
    #[inline(always)]
    fn squared_residual(&self, model: &SecondFromFirst, index: usize, bound: f64) -> f64 {
        let term = self.sampson(model, index);
        let squared = term.error * term.error / term.variance;
        if squared < bound {
            let second = &self.second[index];
            if !is_in_front(&term.rotated, &model.translation, second) {
                let (a, b) = self.variances[index];
                let sine_squared = second.cross(&term.rotated).norm_squared();
                let parallel = sine_squared < PARALLEL_SIGMA * PARALLEL_SIGMA * (a + b);
                if !(parallel && second.dot(&term.rotated) > 0.0) {
                    return f64::INFINITY;
                }
            }
        }
        squared
    }

    /// [`Consensus::refine`].
    fn refine(&self, model: &SecondFromFirst, inliers: &[u32], max_steps: usize) -> SecondFromFirst {
        minimize::<5, _>(&RelativeFit { data: self, inliers }, *model, max_steps)
    }
}

pub(super) struct Sampson {
    rotated: Vector3<f64>,
    pub error: f64,
    pub variance: f64,
    along_second: f64,
    along_first: f64,
}

struct RelativeFit<'a> {
    data: &'a RelativeMatches<'a>,
    inliers: &'a [u32],
}

impl LeastSquares<5> for RelativeFit<'_> {
    type Model = SecondFromFirst;

    fn accumulate(&self, model: &SecondFromFirst, normal: &mut Normal<5>) -> f64 {
        let (u, v) = tangent_basis(&model.translation);
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let term = self.data.sampson(model, i);
            let (turn, shift) =
                sampson_derivative(&term, &self.data.second[i], &model.translation, self.data.variances[i]);
            let value = term.error / term.variance.sqrt();
            let (loss, weight) = cauchy(value * value, self.data.inverse_scale_squared);
            cost += loss;
            let row = SVector::<f64, 5>::from([turn.x, turn.y, turn.z, shift.dot(&u), shift.dot(&v)]);
            normal.add(value, &row, weight);
        }
        cost
    }

    fn cost(&self, model: &SecondFromFirst) -> f64 {
        self.inliers.iter().map(|index| self.data.loss(model, *index as usize)).sum()
    }

    fn step(&self, model: &SecondFromFirst, delta: &SVector<f64, 5>) -> SecondFromFirst {
        let (u, v) = tangent_basis(&model.translation);
        SecondFromFirst {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: (model.translation + u * delta[3] + v * delta[4]).normalize(),
        }
    }
}

/// ∂(e/√v) over δω and δt, 1×3 each: R ← exp(δω)·R, t ← t + δt.
#[inline(always)]
pub(super) fn sampson_derivative(
    term: &Sampson,
    second: &Vector3<f64>,
    translation: &Vector3<f64>,
    (variance_first, variance_second): (f64, f64),
) -> (Vector3<f64>, Vector3<f64>) {
    let y = &term.rotated;
    let error_turn = y.cross(&second.cross(translation));
    let error_shift = y.cross(second);
    // ½·∂v.
    let common = -term.error * (variance_first + variance_second);
    let variance_turn = error_turn * common - y.cross(translation) * (variance_second * term.along_first);
    let variance_shift = error_shift * common
        - second * (variance_first * term.along_second)
        - y * (variance_second * term.along_first);
    let inverse = 1.0 / term.variance.sqrt();
    let ratio = term.error / term.variance;
    ((error_turn - variance_turn * ratio) * inverse, (error_shift - variance_shift * ratio) * inverse)
}

/// Relative poses of samples of `N` matches, by a minimal solver.
trait Sampler<const N: usize> {
    /// How many times the bound a match may be off such a pose.
    const SLACK: f64 = 1.0;

    /// Appends the poses of a sample: bearings of the first view, and those of the second that match them.
    fn solve(&self, first: &[Vector3<f64>; N], second: &[Vector3<f64>; N], models: &mut Vec<SecondFromFirst>);
}

/// Relative poses by samples of one kind.
struct Sampled<'m, 'a, S, const N: usize> {
    matches: &'m RelativeMatches<'a>,
    sampler: S,
}

impl<S: Sampler<N>, const N: usize> Consensus for Sampled<'_, '_, S, N> {
    type Model = SecondFromFirst;

    fn len(&self) -> usize {
        self.matches.first.len()
    }

    fn sample_size(&self) -> usize {
        N
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<SecondFromFirst>) {
        let sample = distinct::<N>(rng, self.matches.first.len());
        let first = sample.map(|i| self.matches.first[i]);
        let second = sample.map(|i| self.matches.second[i]);
        self.sampler.solve(&first, &second, models);
    }

    #[inline(always)]
    fn squared_residual(&self, model: &SecondFromFirst, index: usize, bound: f64) -> f64 {
        let slack = const { S::SLACK * S::SLACK };
        self.matches.squared_residual(model, index, bound * slack) / slack
    }

    fn refine(&self, model: &SecondFromFirst, inliers: &[u32], max_steps: usize) -> SecondFromFirst {
        self.matches.refine(model, inliers, max_steps)
    }
}

struct Five;

impl Sampler<5> for Five {
    fn solve(
        &self,
        first: &[Vector3<f64>; 5],
        second: &[Vector3<f64>; 5],
        models: &mut Vec<SecondFromFirst>,
    ) {
        for essential in &five_point(first, second) {
            for (rotation, translation) in &rotations_of_essential(essential) {
                if first.iter().zip(second).all(|(a, b)| is_in_front(&(rotation * a), translation, b)) {
                    models.push(SecondFromFirst { rotation: *rotation, translation: *translation });
                }
            }
        }
    }
}

/// Takes both views for upright.
struct Upright;

impl Sampler<3> for Upright {
    /// Tilted against each other by some degrees, views still have most of their matches within it.
    const SLACK: f64 = 3.0;

    fn solve(
        &self,
        first: &[Vector3<f64>; 3],
        second: &[Vector3<f64>; 3],
        models: &mut Vec<SecondFromFirst>,
    ) {
        let poses = upright_three_point(first, second);
        models.extend(poses.iter().map(|&(rotation, translation)| SecondFromFirst { rotation, translation }));
    }
}

/// Knows the rotation.
struct Turned {
    rotation: Matrix3<f64>,
}

impl Sampler<2> for Turned {
    fn solve(
        &self,
        first: &[Vector3<f64>; 2],
        second: &[Vector3<f64>; 2],
        models: &mut Vec<SecondFromFirst>,
    ) {
        let first = first.map(|ray| self.rotation * ray);
        // The translation lies in the plane of either pair of rays.
        let [a, b] = [0, 1].map(|at| first[at].cross(&second[at]));
        let Some(along) = a.cross(&b).try_normalize(1e-12) else { return };
        for translation in [along, -along] {
            if first.iter().zip(second).all(|(a, b)| is_in_front(a, &translation, b)) {
                models.push(SecondFromFirst { rotation: self.rotation, translation });
            }
        }
    }
}

struct RotationConsensus<'a>(RelativeMatches<'a>);

impl Consensus for RotationConsensus<'_> {
    type Model = Matrix3<f64>;

    fn len(&self) -> usize {
        self.0.first.len()
    }

    fn sample_size(&self) -> usize {
        2
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<Matrix3<f64>>) {
        let sample = distinct::<2>(rng, self.len());
        let frame = |rays: &[Vector3<f64>]| {
            // Symmetric in the two rays: bisector, difference, normal.
            let (a, b) = (rays[sample[0]], rays[sample[1]]);
            let x = (a + b).try_normalize(1e-6)?;
            let y = (a - b).try_normalize(1e-6)?;
            Some(Matrix3::from_columns(&[x, y, x.cross(&y)]))
        };
        if let (Some(first), Some(second)) = (frame(self.0.first), frame(self.0.second)) {
            models.push(second * first.transpose());
        }
    }

    #[inline(always)]
    fn squared_residual(&self, model: &Matrix3<f64>, index: usize, _bound: f64) -> f64 {
        let (a, b) = self.0.variances[index];
        if !(a + b).is_finite() {
            // A keypoint outside of the lens's domain has no ray.
            return f64::INFINITY;
        }
        AngularResidual::squared(&self.0.second[index], &(model * self.0.first[index]), 1.0 / (a + b))
    }

    fn refine(&self, model: &Matrix3<f64>, inliers: &[u32], max_steps: usize) -> Matrix3<f64> {
        minimize::<3, _>(&RotationFit { data: self, inliers }, *model, max_steps)
    }
}

struct RotationFit<'a> {
    data: &'a RotationConsensus<'a>,
    inliers: &'a [u32],
}

impl LeastSquares<3> for RotationFit<'_> {
    type Model = Matrix3<f64>;

    fn accumulate(&self, model: &Matrix3<f64>, normal: &mut Normal<3>) -> f64 {
        let data = &self.data.0;
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let (a, b) = data.variances[i];
            let rotated = model * data.first[i];
            let residual = AngularResidual::new(&data.second[i], &rotated, (a + b).sqrt());
            let (loss, weight) = cauchy(residual.value.norm_squared(), data.inverse_scale_squared);
            cost += loss;
            normal.add(residual.value.x, &rotated.cross(&residual.rows.0), weight);
            normal.add(residual.value.y, &rotated.cross(&residual.rows.1), weight);
        }
        cost
    }

    fn cost(&self, model: &Matrix3<f64>) -> f64 {
        robust_cost(self.data, model, self.inliers, self.data.0.inverse_scale_squared)
    }

    fn step(&self, model: &Matrix3<f64>, delta: &SVector<f64, 3>) -> Matrix3<f64> {
        turned(model, delta)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solvers::triangulation::angle;
    use crate::synthetic::{RelativeProblem, random_rotation, random_unit, rotation_angle, seeded};

    const SIGMA: f64 = 0.5 / 800.0;

    fn estimate(problem: &RelativeProblem, seed: u64) -> Option<RelativePoseEstimate> {
        let sigmas = vec![SIGMA; problem.first.len()];
        let params = RansacParams { min_inliers: 15, ..RansacParams::default() };
        estimate_relative_pose(&params, &problem.first, &problem.second, &sigmas, &sigmas, seed)
    }

    #[test]
    fn finds_every_pose_among_outliers() {
        let mut rng = seeded("relative");
        for seed in 0..50 {
            let mut problem = RelativeProblem::exact(&mut rng, 150);
            problem.disturb(&mut rng, SIGMA, 0.4);
            let found = estimate(&problem, seed).unwrap();
            let truth = problem.second_from_first;
            assert!(rotation_angle(&found.second_from_first.rotation, &truth.rotation).to_degrees() < 0.1);
            assert!(angle(&found.second_from_first.translation, &truth.translation).to_degrees() < 0.5);
            assert!((found.second_from_first.translation.norm() - 1.0).abs() < 1e-12);
            assert!(found.inliers.len() > 80);
        }
    }

    /// Of 20 pairs of level views of which the second is tilted, those whose pose is found.
    fn found_level(name: &str, tilt_deg: f64, outliers: f64) -> usize {
        let mut rng = seeded(name);
        let params = RansacParams { min_inliers: 15, max_iterations: 1000, ..RansacParams::default() };
        let found = |seed: u64| {
            let mut problem = RelativeProblem::upright(&mut rng, 150);
            let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), tilt_deg.to_radians());
            problem.second_from_first.rotation = tilt * problem.second_from_first.rotation;
            problem.second_from_first.translation = tilt * problem.second_from_first.translation;
            problem.second.iter_mut().for_each(|bearing| *bearing = tilt * *bearing);
            problem.disturb(&mut rng, SIGMA, outliers);
            let RelativeProblem { second_from_first: truth, first, second, .. } = &problem;
            let sigmas = vec![SIGMA; first.len()];
            let found = estimate_level_pose(&params, 1000, first, second, &sigmas, &sigmas, seed)?;
            let turned = rotation_angle(&found.second_from_first.rotation, &truth.rotation).to_degrees();
            let aside = angle(&found.second_from_first.translation, &truth.translation).to_degrees();
            (turned < 0.2 && aside < 1.0).then_some(())
        };
        (0..20).filter_map(found).count()
    }

    #[test]
    fn level_views_need_a_fifth_of_right_pairs_and_tilted_ones_more() {
        assert_eq!(found_level("level", 0.0, 0.78), 20);
        assert_eq!(found_level("almost level", 0.1, 0.75), 20);
        assert_eq!(found_level("tilted", 10.0, 0.5), 20);
    }

    #[test]
    fn derivative_agrees_with_differences() {
        let mut rng = seeded("sampson");
        let mut problem = RelativeProblem::exact(&mut rng, 30);
        problem.disturb(&mut rng, 0.05, 0.0);
        let sigmas = [(); 30].map(|()| 0.01);
        let data = RelativeMatches::new(
            &RansacParams::default(),
            &problem.first,
            &problem.second,
            &sigmas,
            &[0.02; 30],
        )
        .unwrap();
        let truth = problem.second_from_first;
        let model = SecondFromFirst {
            rotation: truth.rotation.to_rotation_matrix().into_inner(),
            translation: truth.translation,
        };
        let fit = RelativeFit { data: &data, inliers: &[] };
        for i in 0..30 {
            let term = data.sampson(&model, i);
            let (turn, shift) =
                sampson_derivative(&term, &problem.second[i], &model.translation, data.variances[i]);
            let (u, v) = tangent_basis(&model.translation);
            let row = [turn.x, turn.y, turn.z, shift.dot(&u), shift.dot(&v)];
            for k in 0..5 {
                let value = |step: f64| {
                    let mut delta = SVector::<f64, 5>::zeros();
                    delta[k] = step;
                    let moved = data.sampson(&fit.step(&model, &delta), i);
                    moved.error / moved.variance.sqrt()
                };
                let change = (value(1e-6) - value(-1e-6)) / 2e-6;
                assert!((change - row[k]).abs() < 1e-5 * (1.0 + change.abs()), "{k}: {change} {}", row[k]);
            }
        }
    }

    #[test]
    fn a_rotation_explains_a_pure_rotation_and_nothing_more() {
        let mut rng = seeded("rotation");
        let rotation = random_rotation(&mut rng);
        let first: Vec<_> = (0..80).map(|_| random_unit(&mut rng)).collect();
        let second: Vec<_> = first
            .iter()
            .enumerate()
            .map(|(i, x)| {
                if i < 20 {
                    random_unit(&mut rng)
                } else {
                    crate::synthetic::perturb(&mut rng, &(rotation * x), SIGMA)
                }
            })
            .collect();
        let params = RansacParams::default();
        let sigmas = [SIGMA; 80];
        let found = estimate_rotation(&params, &first, &second, &sigmas, &sigmas, 1).unwrap();
        assert!(rotation_angle(&found.second_from_first, &rotation) < 1e-3);
        assert!(found.inliers.len() >= 59 && found.inliers.len() <= 62);
        let general = RelativeProblem::exact(&mut rng, 80);
        let found = estimate_rotation(&params, &general.first, &general.second, &sigmas, &sigmas, 1);
        assert!(found.is_none_or(|estimate| estimate.inliers.len() < 20));
    }
}
