//! Levenberg–Marquardt on any [`Model`].

use serde::{Deserialize, Serialize};

use super::BundleParams;
use super::normal_equations::{Model, NormalEquations};

/// Damping of the first step.
const INITIAL_LAMBDA: f64 = 1e-4;
/// Least damping: keeps a free gauge, and points seen once, from wandering on round-off.
const MIN_LAMBDA: f64 = 1e-10;
/// Damping at which no useful step is left.
const MAX_LAMBDA: f64 = 1e16;
/// Times its length that a step is stretched by at the most.
const MAX_STRETCH: f64 = 4.0;
/// Share of the cost that a step takes off, below which the next may be stretched; before, it might end in another valley.
const NEAR: f64 = 0.01;

/// Why the iterations ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Termination {
    /// The last step changed the cost, or the parameters, by less than the tolerance, or none was predicted to.
    Converged,
    /// The iteration limit was reached.
    IterationLimit,
    /// No step decreased the cost although one was predicted to.
    NoDecrease,
    /// Nothing that is free is constrained.
    NothingToDo,
    /// The initial state has no finite cost.
    NotFinite,
}

/// Limits of the iterations.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    pub max_iterations: u32,
    pub function_tolerance: f64,
    pub parameter_tolerance: f64,
}

impl From<&BundleParams> for Limits {
    fn from(params: &BundleParams) -> Self {
        Self {
            max_iterations: params.max_iterations,
            function_tolerance: params.function_tolerance,
            parameter_tolerance: params.parameter_tolerance,
        }
    }
}

/// What the iterations did.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outcome {
    pub initial_cost: f64,
    pub final_cost: f64,
    pub iterations: u32,
    pub accepted: u32,
    pub linear_iterations: u64,
    pub truncated_steps: u32,
    pub termination: Termination,
}

impl Outcome {
    /// The outcome of a problem without unknowns.
    pub fn nothing_to_do(cost: f64) -> Self {
        Self::new(cost, Termination::NothingToDo)
    }

    fn new(cost: f64, termination: Termination) -> Self {
        Self {
            initial_cost: cost,
            final_cost: cost,
            iterations: 0,
            accepted: 0,
            linear_iterations: 0,
            truncated_steps: 0,
            termination,
        }
    }
}

/// Minimizes the cost; the best state is the model's and the equations' current one.
///
/// Damping λ·diag(JᵀJ), which makes the steps independent of the units of the unknowns. λ follows the ratio of actual
/// to predicted decrease: H. B. Nielsen, "Damping Parameter in Marquardt's Method", IMM-REP-1999-05.
///
/// Under a robust loss ρ the quadratic model leaves out ρ″ < 0, and with it up to nine tenths of its curvature is too much along
/// what is weakly determined: steps fall short there, and many follow each other along the same line. What a step took off the
/// cost tells the curvature along it; the next is stretched by that, as gradient steps are by J. Barzilai, J. M. Borwein,
/// "Two-Point Step Size Gradient Methods", IMA J. Numer. Anal. 1988. One that raises the cost so is taken as it is.
pub(super) fn minimize<const D: usize, M: Model<D>>(
    model: &mut M,
    equations: &mut NormalEquations<D>,
    limits: &Limits,
) -> Outcome {
    let (mut lambda, mut growth, mut stretch) = (INITIAL_LAMBDA, 2.0, 1.0);
    let mut cost = equations.linearize(model, lambda);
    let mut outcome = Outcome::new(cost, Termination::IterationLimit);
    if !cost.is_finite() {
        outcome.termination = Termination::NotFinite;
        return outcome;
    }
    while outcome.iterations < limits.max_iterations {
        outcome.iterations += 1;
        let mut step = None;
        if equations.factorize(lambda) && equations.solve() {
            step = equations.propose(lambda, stretch, model);
            if stretch > 1.0 && !step.is_some_and(|(_, candidate)| candidate < cost) {
                stretch = 1.0;
                step = equations.propose(lambda, stretch, model);
            }
        }
        if let Some((sums, candidate)) = step {
            // Below this neither the costs' difference nor the decision by it means anything.
            if sums.predicted <= f64::EPSILON * cost {
                outcome.termination = Termination::Converged;
                break;
            }
            let least = limits.parameter_tolerance.powi(2);
            let is_small_step =
                sums.squared_step <= least * model.squared_norm() && sums.largest_point_step <= least;
            if candidate < cost {
                let decrease = cost - candidate;
                let ratio = decrease / sums.predicted;
                let is_near = decrease <= NEAR * cost;
                stretch = if is_near { stretch_after(stretch, ratio) } else { 1.0 };
                model.accept();
                equations.accept();
                outcome.accepted += 1;
                cost = candidate;
                lambda = (lambda * (1.0 - (2.0 * ratio - 1.0).powi(3)).max(1.0 / 3.0)).max(MIN_LAMBDA);
                growth = 2.0;
                if decrease <= limits.function_tolerance * cost || is_small_step {
                    outcome.termination = Termination::Converged;
                    break;
                }
                if outcome.iterations < limits.max_iterations {
                    equations.linearize(model, lambda);
                }
                continue;
            }
            if is_small_step {
                outcome.termination = Termination::Converged;
                break;
            }
        }
        lambda *= growth;
        growth *= 2.0;
        if lambda > MAX_LAMBDA {
            outcome.termination = Termination::NoDecrease;
            break;
        }
    }
    outcome.final_cost = cost;
    if let Some(system) = equations.iterative() {
        outcome.linear_iterations = system.iterations();
        outcome.truncated_steps = system.truncated();
    }
    outcome
}

/// By how much a step is stretched after one stretched by `stretch` that took `ratio` times what was predicted of it unstretched.
///
/// Along a step d of the model's curvature h, a stretch s takes d h d (s − ½ c s²) off, for a true curvature c h, and
/// ½ d h d is what was predicted for s = 1.
fn stretch_after(stretch: f64, ratio: f64) -> f64 {
    let curvature = (2.0 * stretch - ratio) / (stretch * stretch);
    if curvature * MAX_STRETCH > 1.0 { curvature.recip().max(1.0) } else { MAX_STRETCH }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stretched_step_ends_where_a_parabola_does() {
        for curvature in [0.3, 0.5, 0.9] {
            for stretch in [1.0, 1.5, 4.0] {
                let ratio = 2.0 * stretch - curvature * stretch * stretch;
                assert!((stretch_after(stretch, ratio) - 1.0 / curvature).abs() < 1e-12);
            }
        }
        assert_eq!(stretch_after(1.0, 0.5), 1.0, "a step that was too long is not shortened");
        assert_eq!(stretch_after(1.0, 2.5), MAX_STRETCH, "where the cost bends down");
    }
}
