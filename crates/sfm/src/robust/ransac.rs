use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::least_squares::cauchy;

/// How to sample, score and stop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RansacParams {
    /// Inlier bound and truncation of the score, in standard deviations of a ray's direction.
    pub max_error_sigma: f64,
    /// Fewest samples drawn, whatever the support.
    pub min_iterations: u32,
    /// Most samples drawn; more costs time, fewer may miss a model of little support.
    pub max_iterations: u32,
    /// Probability of having drawn one sample without outliers when stopping early.
    pub confidence: f64,
    /// Fewest inliers of an estimate.
    pub min_inliers: usize,
}

impl Default for RansacParams {
    fn default() -> Self {
        Self {
            max_error_sigma: 4.0,
            min_iterations: 50,
            max_iterations: 20_000,
            confidence: 0.9999,
            min_inliers: 6,
        }
    }
}

/// A parameter out of its range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{field}` must be {range}, got {value}")]
pub struct InvalidParams {
    /// Which field.
    pub field: &'static str,
    /// What it may be.
    pub range: &'static str,
    /// What it is.
    pub value: f64,
}

impl RansacParams {
    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// The first field out of its range.
    pub fn validate(&self) -> Result<(), InvalidParams> {
        let check =
            |ok, field, range, value| if ok { Ok(()) } else { Err(InvalidParams { field, range, value }) };
        let max_error = self.max_error_sigma;
        check(max_error > 0.0 && max_error.is_finite(), "max_error_sigma", "positive", max_error)?;
        check(
            self.confidence > 0.0 && self.confidence < 1.0,
            "confidence",
            "within (0, 1)",
            self.confidence,
        )?;
        check(self.max_iterations > 0, "max_iterations", "at least 1", f64::from(self.max_iterations))?;
        check(
            self.min_iterations <= self.max_iterations,
            "min_iterations",
            "at most max_iterations",
            f64::from(self.min_iterations),
        )
    }

    /// The same with no more samples than find what `supporting` of so many data support; at most as many as now. `None` where
    /// there are fewer.
    ///
    /// Twice as many as find one sample without outliers: a noisy one may support less.
    pub(crate) fn enough_for(&self, supporting: f64, count: usize, sample_size: usize) -> Option<Self> {
        let samples = stopping_iteration(self, supporting / count as f64, sample_size);
        let max_iterations = samples.saturating_mul(2).min(self.max_iterations);
        (supporting <= count as f64).then(|| Self { max_iterations, ..self.clone() })
    }
}

/// What LO-RANSAC needs to know of a problem.
pub(super) trait Consensus {
    /// What is estimated, in the form that scores fastest.
    type Model: Copy;

    /// Number of data.
    fn len(&self) -> usize;

    /// Data in a sample, for the stopping rule.
    fn sample_size(&self) -> usize;

    /// Draws a sample and appends its models.
    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<Self::Model>);

    /// Whitened squared residual of a datum; above `bound` (or NaN) its value does not matter. Depth signs included.
    fn squared_residual(&self, model: &Self::Model, index: usize, bound: f64) -> f64;

    /// Nonlinear refinement on the given data.
    fn refine(&self, model: &Self::Model, inliers: &[u32], max_steps: usize) -> Self::Model;
}

/// Cost of some data under Cauchy's loss, as [`least_squares`](super::least_squares) wants it.
pub(super) fn robust_cost<C: Consensus>(
    problem: &C,
    model: &C::Model,
    inliers: &[u32],
    inverse_scale_squared: f64,
) -> f64 {
    let squared = |index: u32| problem.squared_residual(model, index as usize, f64::INFINITY);
    inliers.iter().map(|&index| cauchy(squared(index), inverse_scale_squared).0).sum()
}

/// What came out.
pub(super) struct Consented<M> {
    pub(super) model: M,
    pub(super) inliers: Vec<u32>,
    pub(super) score: f64,
    pub(super) iterations: u32,
}

/// Rounds of inlier selection and refinement after a new best sample.
const LOCAL_ROUNDS: usize = 2;
const LOCAL_STEPS: usize = 6;
/// Rounds and steps for the final model.
const FINAL_ROUNDS: usize = 6;
const FINAL_STEPS: usize = 20;
/// The first local round takes inliers of this many times the bound: minimal samples amplify noise.
const WIDENING: f64 = 3.0;

/// LO-RANSAC (O. Chum, J. Matas, J. Kittler, DAGM 2003) with a truncated quadratic score (P. Torr, A. Zisserman,
/// MLESAC, 2000), non-linear local optimization, and the usual adaptive stop.
///
/// Scores are in units of the squared bound: the sum over the data of min(r²/bound², 1).
pub(super) fn lo_ransac<C: Consensus>(
    params: &RansacParams,
    problem: &mut C,
    seed: u64,
) -> Option<Consented<C::Model>> {
    lo_ransac_from(None, params, problem, seed)
}

/// [`lo_ransac`] that begins with a model, if there is one, in place of the first sample's.
pub(super) fn lo_ransac_from<C: Consensus>(
    start: Option<C::Model>,
    params: &RansacParams,
    problem: &mut C,
    seed: u64,
) -> Option<Consented<C::Model>> {
    let count = problem.len();
    let needed = params.min_inliers.max(problem.sample_size());
    if count < needed {
        return None;
    }
    let bound = params.max_error_sigma * params.max_error_sigma;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Scoring order is shuffled once, so that the bail-out is not fooled by sorted data.
    let mut order: Vec<u32> = (0..count as u32).collect();
    for i in (1..count).rev() {
        order.swap(i, rng.random_range(0..=i));
    }
    let mut models = Vec::from_iter(start);
    let mut best: Option<(C::Model, f64)> = None;
    let mut best_minimal = f64::INFINITY;
    let mut limit = params.max_iterations;
    let mut iterations = 0;
    let mut inliers = Vec::with_capacity(count);
    while iterations < limit {
        if iterations > 0 || models.is_empty() {
            models.clear();
            problem.hypothesize(&mut rng, &mut models);
        }
        iterations += 1;
        let mut improved: Option<C::Model> = None;
        for model in &models {
            let score = score(problem, model, &order, bound, best_minimal);
            if score < best_minimal {
                best_minimal = score;
                improved = Some(*model);
            }
        }
        let Some(minimal) = improved else {
            continue;
        };
        let mut local = minimal;
        let mut local_score = best_minimal;
        for round in 0..LOCAL_ROUNDS {
            let widening = if round == 0 { WIDENING } else { 1.0 };
            collect_inliers(problem, &local, bound * widening * widening, &mut inliers);
            if inliers.len() <= problem.sample_size() {
                break;
            }
            let refined = problem.refine(&local, &inliers, LOCAL_STEPS);
            let refined_score = score(problem, &refined, &order, bound, f64::INFINITY);
            if !(refined_score < local_score) {
                break;
            }
            (local, local_score) = (refined, refined_score);
        }
        if best.as_ref().is_none_or(|(_, score)| local_score < *score) {
            best = Some((local, local_score));
            collect_inliers(problem, &local, bound, &mut inliers);
            limit = stopping_iteration(params, inliers.len() as f64 / count as f64, problem.sample_size());
        }
    }
    let (mut model, mut best_score) = best?;
    for _ in 0..FINAL_ROUNDS {
        collect_inliers(problem, &model, bound, &mut inliers);
        if inliers.len() < problem.sample_size() {
            return None;
        }
        let refined = problem.refine(&model, &inliers, FINAL_STEPS);
        let refined_score = score(problem, &refined, &order, bound, f64::INFINITY);
        if !(refined_score < best_score) {
            break;
        }
        let done = best_score - refined_score < 1e-9 * best_score;
        (model, best_score) = (refined, refined_score);
        if done {
            break;
        }
    }
    collect_inliers(problem, &model, bound, &mut inliers);
    (inliers.len() >= needed).then_some(Consented { model, inliers, score: best_score, iterations })
}

/// Truncated score; stops once it cannot beat `limit`.
fn score<C: Consensus>(problem: &C, model: &C::Model, order: &[u32], bound: f64, limit: f64) -> f64 {
    let inverse = 1.0 / bound;
    let mut sum = 0.0;
    for chunk in order.chunks(8) {
        for index in chunk {
            let squared = problem.squared_residual(model, *index as usize, bound);
            sum += if squared < bound { squared * inverse } else { 1.0 };
        }
        if sum >= limit {
            return f64::INFINITY;
        }
    }
    sum
}

fn collect_inliers<C: Consensus>(problem: &C, model: &C::Model, bound: f64, inliers: &mut Vec<u32>) {
    inliers.clear();
    let supports = |index: &u32| problem.squared_residual(model, *index as usize, bound) < bound;
    inliers.extend((0..problem.len() as u32).filter(supports));
}

fn stopping_iteration(params: &RansacParams, inlier_ratio: f64, sample_size: usize) -> u32 {
    let success = inlier_ratio.powi(sample_size as i32);
    let needed = if success >= 1.0 { 0.0 } else { (1.0 - params.confidence).ln() / (-success).ln_1p() };
    // The cast saturates, also for the infinity of a ratio of zero.
    (needed.ceil() as u32).max(params.min_iterations).min(params.max_iterations)
}

/// `N` different numbers below `count`, which must be at least `N`.
pub(super) fn distinct<const N: usize>(rng: &mut ChaCha8Rng, count: usize) -> [usize; N] {
    let mut sample = [0; N];
    let mut k = 0;
    while k < N {
        let candidate = rng.random_range(0..count);
        if !sample[..k].contains(&candidate) {
            sample[k] = candidate;
            k += 1;
        }
    }
    sample
}

#[cfg(test)]
mod tests {
    use super::RansacParams;

    #[test]
    fn parameters_are_checked() {
        let good = RansacParams::default();
        assert!(good.validate().is_ok());
        assert!(RansacParams { confidence: 1.0, ..good.clone() }.validate().is_err());
        assert!(RansacParams { max_error_sigma: f64::NAN, ..good.clone() }.validate().is_err());
        let error = RansacParams { min_iterations: 9, max_iterations: 3, ..good }.validate().unwrap_err();
        assert_eq!(error.to_string(), "`min_iterations` must be at most max_iterations, got 9");
    }

    #[test]
    fn the_stop_follows_the_inlier_ratio() {
        let params = RansacParams { min_iterations: 1, ..RansacParams::default() };
        assert_eq!(super::stopping_iteration(&params, 1.0, 4), 1);
        assert_eq!(super::stopping_iteration(&params, 0.4, 4), 356);
        assert_eq!(super::stopping_iteration(&params, 0.0, 4), params.max_iterations);
    }

    #[test]
    fn as_many_samples_are_enough_as_find_what_would_be_taken() {
        let params = RansacParams { min_iterations: 1, ..RansacParams::default() };
        assert_eq!(params.enough_for(40.0, 100, 4).unwrap().max_iterations, 712);
        assert_eq!(params.enough_for(0.0, 100, 4), Some(params.clone()));
        assert_eq!(params.enough_for(101.0, 100, 4), None);
        let few = RansacParams { max_iterations: 100, ..params };
        assert_eq!(few.enough_for(40.0, 100, 4), Some(few));
    }
}
