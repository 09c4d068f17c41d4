//! Sparse bundle adjustment on the sphere.
//!
//! Minimizes ½ Σ ρ(‖e‖²/σ²) over poses, points and intrinsics. e compares the observed bearing κ(u) with the direction
//! to the point: ‖e‖ = 2 tan(θ/2) over the whole sphere, θ the angle between them, so that panoramas and photos live in
//! one problem, nothing happens at a seam, and a point behind the ray is far from explained (the paper's chord
//! ‖κ(u) − PX/‖PX‖‖ = 2 sin(θ/2) agrees to third order). σ is the angle that the observation's pixel noise spans at
//! its place of the image.
//!
//! Levenberg–Marquardt with analytic Jacobians; points are eliminated (Schur complement) and the reduced camera system
//! is factorized by Cholesky, dense or sparse, or, when that takes too long, solved by conjugate gradients without being
//! formed ([`LinearSolver`]). Robust losses act by first-order reweighting (ρ′ on residual and
//! Jacobian; the second-order term of Triggs' correction is left out, as it makes the model indefinite).
//!
//! Tangents: a pose is perturbed as R ← R·Exp(ω), t ← t + δ with (R, t) = `world_from_camera`: ω in the camera frame,
//! δ in the world frame, order (ω, δ). Points and intrinsics are perturbed by addition.
//!
//! Gauge: what is fixed, and position priors, hold the frame. When they do not (nothing fixed), the damping does: the
//! steps are the shortest, the frame stays near where it was, and no observation is weakened by an arbitrary anchor.
//!
//! Work runs on the current rayon pool; results are the same bytes for any number of threads.

pub mod bal;
mod camera_system;
mod elimination;
mod iterative;
mod length;
mod levenberg_marquardt;
mod loss;
mod normal_equations;
mod pattern;
mod problem;
mod residual;
mod response;
mod spherical;
mod split;

use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

use camera_system::Budget;
use levenberg_marquardt::{Limits, Outcome, minimize};
use normal_equations::NormalEquations;
use spherical::{Layout, POSE_DIM, Spherical};

pub use length::LengthRatio;
pub use levenberg_marquardt::Termination;
pub use loss::RobustLoss;
pub use problem::{
    BundleBearing, BundleObservation, BundlePoint, BundlePose, BundleProblem, CameraPrior, IntrinsicsFreedom,
    ParameterEstimate, PositionPrior,
};
pub use response::step;

/// S counts as singular when it has an eigenvalue below this, relative to the diagonal of JᵀJ.
const SINGULAR_SHARE: f64 = 1e-13;

/// How the reduced camera system S of each step is solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinearSolver {
    /// By Cholesky while S and its factor take at most 2 GiB and no longer than what else there is to a step, else by conjugate
    /// gradients. Up to 300 free poses that is always Cholesky.
    #[default]
    Auto,
    /// By Cholesky of S, dense or sparse, unless that takes more than 32 GiB.
    Direct,
    /// By conjugate gradients to a relative residual of 0.01, preconditioned by what S is where points are split; S is never formed.
    Iterative,
}

/// How to minimize.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BundleParams {
    /// Loss on whitened residuals.
    pub loss: RobustLoss,
    /// Most steps tried.
    pub max_iterations: u32,
    /// Ends when a step decreases the cost by less than this share.
    pub function_tolerance: f64,
    /// Ends when a step is shorter than this share of the norm of the camera side's parameters, and that of each point than this share
    /// of its distance from the origin.
    pub parameter_tolerance: f64,
    /// How the reduced camera system of each step is solved.
    pub linear_solver: LinearSolver,
}

impl Default for BundleParams {
    fn default() -> Self {
        Self {
            loss: RobustLoss::Trivial,
            max_iterations: 50,
            function_tolerance: 1e-6,
            parameter_tolerance: 1e-10,
            linear_solver: LinearSolver::Auto,
        }
    }
}

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BundleReport {
    /// ½ Σ ρ before, over what was used.
    pub initial_cost: f64,
    /// ½ Σ ρ after.
    pub final_cost: f64,
    /// Steps tried.
    pub iterations: u32,
    /// Steps that decreased the cost.
    pub accepted_steps: u32,
    /// Iterations of conjugate gradients over all steps; none with a factorization.
    pub linear_iterations: u64,
    /// Steps whose conjugate gradients met their limit before the accuracy sought. When the last ones did, what bends a
    /// long chain of cameras may be left unsolved: it hardly shows in the cost.
    pub truncated_steps: u32,
    /// Why it ended.
    pub termination: Termination,
    /// Observations used.
    pub observations: usize,
    /// Observations and priors that could not be used.
    pub ignored: usize,
    /// Scalar residuals (two per observation, three per measured position, one per parameter known beforehand) minus scalar unknowns; a free gauge is not subtracted.
    pub degrees_of_freedom: i64,
}

impl BundleReport {
    fn new(outcome: &Outcome, observations: usize, ignored: usize, degrees_of_freedom: i64) -> Self {
        Self {
            initial_cost: outcome.initial_cost,
            final_cost: outcome.final_cost,
            iterations: outcome.iterations,
            accepted_steps: outcome.accepted,
            linear_iterations: outcome.linear_iterations,
            truncated_steps: outcome.truncated_steps,
            termination: outcome.termination,
            observations,
            ignored,
            degrees_of_freedom,
        }
    }
}

/// Minimizes the cost of a problem in place.
///
/// What is fixed stays bit-identical, as does everything when no step decreases the cost. Never fails: a problem
/// without anything to do, or without a finite cost, is said in the report.
pub fn solve(params: &BundleParams, problem: &mut BundleProblem) -> BundleReport {
    let loss = if params.loss.is_valid() { params.loss } else { RobustLoss::Trivial };
    let (mut model, layout) = Spherical::new(problem, loss);
    let Layout { structure, point_of_index, ignored, prior_residuals } = layout;
    let observations = structure.links.len();
    let budget = Budget::new(params.linear_solver, observations);
    let mut equations = NormalEquations::<POSE_DIM>::new(structure, &budget);
    let unknowns = equations.unknowns();
    let degrees_of_freedom = (2 * observations + prior_residuals) as i64 - unknowns as i64;
    let outcome = if unknowns == 0 {
        Outcome::nothing_to_do(equations.linearize(&model, 0.0))
    } else {
        minimize(&mut model, &mut equations, &Limits::from(params))
    };
    if outcome.accepted > 0 {
        store(&model, &equations, &point_of_index, problem);
    }
    BundleReport::new(&outcome, observations, ignored, degrees_of_freedom)
}

/// Writes the current state of everything that is free.
fn store(
    model: &Spherical,
    equations: &NormalEquations<POSE_DIM>,
    point_of_index: &[u32],
    problem: &mut BundleProblem,
) {
    model.store(problem);
    for (&index, position) in point_of_index.iter().zip(equations.points()) {
        let point = &mut problem.points[index as usize];
        if !point.fixed {
            point.position = *position;
        }
    }
}

/// Marginal covariances of poses, 6×6 each, in the order asked for.
///
/// Blocks of the inverse of the reduced camera system at the problem's current state, so points and intrinsics are
/// marginalized; tangent order and sides as in the module's documentation (rotation in the camera frame in rad²,
/// translation in the world frame in its unit squared). A fixed pose has covariance zero. With a robust loss,
/// observations count by their weight ρ′.
///
/// `None` when a pose asked for does not exist or has no observation, when the problem leaves the gauge or anything else
/// on the camera side undetermined, or when S and its factor take more than 2 GiB: conjugate gradients could give a
/// block, but not tell that it exists.
pub fn covariance(problem: &BundleProblem, loss: RobustLoss, poses: &[u32]) -> Option<Vec<Matrix6<f64>>> {
    let (model, layout) = Spherical::new(problem, loss);
    let blocks = poses
        .iter()
        .map(|&pose| match model.block_of_pose(pose) {
            Some(block) => Some(Some(block)),
            None => problem.poses.get(pose as usize).filter(|pose| pose.fixed).map(|_| None),
        })
        .collect::<Option<Vec<_>>>()?;
    if blocks.iter().all(Option::is_none) {
        return Some(vec![Matrix6::zeros(); poses.len()]);
    }
    let mut equations = NormalEquations::<POSE_DIM>::new(layout.structure, &Budget::MEMORY);
    let cost = equations.linearize(&model, 0.0);
    if !cost.is_finite() || !equations.is_definite_by(SINGULAR_SHARE) || !equations.factorize(0.0) {
        return None;
    }
    let mut column = vec![0.0; equations.step().len()];
    let mut inverse_block = |block: usize| {
        let mut result = Matrix6::zeros();
        for k in 0..POSE_DIM {
            column.fill(0.0);
            column[block * POSE_DIM + k] = 1.0;
            if !equations.solve_camera_side(&mut column) {
                return None;
            }
            for row in 0..POSE_DIM {
                result[(row, k)] = column[block * POSE_DIM + row];
            }
        }
        let symmetric = (result + result.transpose()) * 0.5;
        symmetric.iter().all(|value| value.is_finite()).then_some(symmetric)
    };
    blocks.into_iter().map(|block| block.map_or(Some(Matrix6::zeros()), &mut inverse_block)).collect()
}

#[cfg(test)]
mod tests;
