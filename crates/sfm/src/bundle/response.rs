//! What an adjusted problem answers, to first order, when what it was adjusted to is changed a little.

use nalgebra::Vector3;

use super::camera_system::Budget;
use super::normal_equations::{Model, NormalEquations};
use super::residual::angular_squared;
use super::spherical::{Layout, POSE_DIM, Spherical, bearing_and_weight};
use super::{BundleObservation, BundleProblem, RobustLoss, store};

/// Damping of the step, and what is tried where that is too little for the system to be definite in spite of rounding: the first is
/// enough to keep a free gauge where it is, and too little for what bends a long chain to notice.
const LAMBDAS: [f64; 3] = [1e-10, 1e-8, 1e-6];

/// Largest factor on a residual: of Cauchy's loss that of three times its scale.
const MAX_PULL: f64 = 10.0;

impl BundleProblem {
    /// The same problem with what the loss makes of each observation and bearing, at the current state, in its noise: ρ′ + sρ″, the
    /// mean of the loss' curvatures along the residual and across it.
    pub fn reweighted(&self, loss: RobustLoss) -> Self {
        let mut weighted = self.clone();
        let camera_point = |pose: u32, point: u32| {
            let point = self.points.get(point as usize)?.position;
            Some(self.poses.get(pose as usize)?.world_from_camera.inverse().transform_point(&point))
        };
        for seen in &mut weighted.observations {
            let whitened = || {
                let camera = self.cameras.get(self.poses.get(seen.pose as usize)?.camera as usize)?;
                let (bearing, inverse_sigma) = bearing_and_weight(camera, &seen.pixel, seen.noise_px)?;
                Some(angular_squared(&bearing, &camera_point(seen.pose, seen.point)?) * inverse_sigma.powi(2))
            };
            if let Some(squared) = whitened() {
                seen.noise_px /= loss.mean_curvature(squared).sqrt();
            }
        }
        for seen in &mut weighted.bearings {
            if let Some(point) = camera_point(seen.pose, seen.point) {
                let squared = angular_squared(&seen.bearing, &point) / seen.sigma.powi(2);
                seen.sigma /= loss.mean_curvature(squared).sqrt();
            }
        }
        weighted
    }

    /// What the observations are off, as errors of their bearings (camera frames, across, in radians) that move the minimum of the
    /// problem [`BundleProblem::reweighted`] as they move that of this one under the loss.
    ///
    /// They are r ρ′ / (ρ′ + sρ″), the residuals by a factor of at most ten: what is farther off hardly pulls.
    pub fn residuals_under(&self, loss: RobustLoss) -> Vec<Vector3<f64>> {
        let residual = |seen: &BundleObservation| {
            let pose = self.poses.get(seen.pose as usize)?;
            let camera = self.cameras.get(pose.camera as usize)?;
            let (bearing, inverse_sigma) = bearing_and_weight(camera, &seen.pixel, seen.noise_px)?;
            let point = self.points.get(seen.point as usize)?.position;
            let expected = pose.world_from_camera.inverse().transform_point(&point);
            let squared = angular_squared(&bearing, &expected) * inverse_sigma.powi(2);
            let pull = loss.evaluate(squared).1 / loss.mean_curvature(squared);
            Some((bearing - expected.try_normalize(f64::MIN_POSITIVE)?) * pull.min(MAX_PULL))
        };
        self.observations.iter().map(|seen| residual(seen).unwrap_or_default()).collect()
    }
}

/// Takes one Gauss–Newton step of the squares, whatever becomes of the cost; false, and nothing is changed, where there is none.
///
/// From the minimum of a problem whose observations, bearings or fixed poses have then been moved a little, this is what their
/// move does to all the rest, to first order, for one factorization in place of the dozens that an adjustment takes along its
/// weakest directions. Where the problem was not at its minimum, take off what the step does without the move.
pub fn step(problem: &mut BundleProblem) -> bool {
    let (mut model, Layout { structure, point_of_index, .. }) = Spherical::new(problem, RobustLoss::Trivial);
    // Conjugate gradients would leave the weakest directions unsolved, which are what a small change moves most.
    let mut equations = NormalEquations::<POSE_DIM>::new(structure, &Budget::MEMORY);
    let cost = equations.linearize(&model, LAMBDAS[0]);
    if equations.unknowns() == 0 || !cost.is_finite() {
        return false;
    }
    let Some(lambda) = LAMBDAS.into_iter().find(|&lambda| equations.factorize(lambda)) else { return false };
    let is_valid = equations.solve(lambda, &mut model).is_some_and(|(_, candidate)| candidate.is_finite());
    if is_valid {
        model.accept();
        equations.accept();
        store(&model, &equations, &point_of_index, problem);
    }
    is_valid
}
