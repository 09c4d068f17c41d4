//! What an adjusted problem answers, to first order, when what it was adjusted to is changed a little.

use nalgebra::Vector3;

use super::camera_system::Budget;
use super::normal_equations::{Model, NormalEquations};
use super::residual::angular_squared;
use super::spherical::{Layout, POSE_DIM, Spherical, bearing_and_weight};
use super::{BundleObservation, BundleProblem, PositionPrior, RobustLoss, store};
use crate::georegister::without_frame;

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
        for seen in &mut weighted.observations {
            if let Some(sight) = self.sight(seen) {
                seen.noise_px /= loss.mean_curvature(sight.squared).sqrt();
            }
        }
        for seen in &mut weighted.bearings {
            if let Some(point) = self.in_camera(seen.pose, seen.point) {
                let squared = angular_squared(&seen.bearing, &point) / seen.sigma.powi(2);
                seen.sigma /= loss.mean_curvature(squared).sqrt();
            }
        }
        for (prior, offset) in weighted.position_priors.iter_mut().zip(self.position_offsets()) {
            prior.sigma /= prior.loss.mean_curvature(prior.squared(&offset)).sqrt();
            prior.loss = RobustLoss::Trivial;
        }
        weighted
    }

    /// The variance of the observations over what they state: that of what the loss makes of the residuals, with what the points
    /// took up of them, by its curvature.
    ///
    /// The loss' scale and their own both cancel: twice the stated noise is a quarter.
    pub fn variance_factor(&self, loss: RobustLoss) -> f64 {
        let (mut pulls, mut curvature, mut count) = (0.0, 0.0, 0_usize);
        let mut is_seen = vec![false; self.points.len()];
        for seen in &self.observations {
            let Some(Sight { squared, .. }) = self.sight(seen) else { continue };
            pulls += loss.evaluate(squared).1.powi(2) * squared;
            curvature += loss.mean_curvature(squared);
            count += 1;
            is_seen[seen.point as usize] = true;
        }
        let unknowns = 3 * is_seen.iter().filter(|is_seen| **is_seen).count();
        let freedom = (2 * count).saturating_sub(unknowns).max(1) as f64;
        (pulls / freedom) / (curvature / count.max(1) as f64)
    }

    /// What the measured positions are off, each by its own loss, as errors that move the minimum of the problem
    /// [`BundleProblem::reweighted`] as [`BundleProblem::residuals_under`] do.
    pub fn position_residuals(&self) -> Vec<Vector3<f64>> {
        let priors = self.position_priors.iter().zip(self.position_offsets());
        priors.map(|(prior, offset)| offset * pull(prior.loss, prior.squared(&offset))).collect()
    }

    /// From the poses' centres to where they were measured; nothing where there is no such pose.
    pub(crate) fn position_offsets(&self) -> Vec<Vector3<f64>> {
        let offset = |prior: &PositionPrior| {
            Some(prior.position - self.poses.get(prior.pose as usize)?.world_from_camera.translation)
        };
        self.position_priors.iter().map(|prior| offset(prior).unwrap_or_default()).collect()
    }

    /// Such offsets without what moves the frame, each as far as its own measured position counts.
    pub(crate) fn without_frame(&self, offsets: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
        let priors = self.position_priors.iter().zip(self.position_offsets());
        let (places, weights): (Vec<_>, Vec<_>) = priors
            .map(|(prior, offset)| {
                let weight = prior.loss.evaluate(prior.squared(&offset)).1;
                (prior.position - offset, prior.sigma.map(|sigma| weight / (sigma * sigma)))
            })
            .unzip();
        without_frame(&places, offsets, &weights)
    }

    /// What the observations are off, as errors of their bearings (camera frames, across, in radians) that move the minimum of the
    /// problem [`BundleProblem::reweighted`] as they move that of this one under the loss.
    ///
    /// They are r ρ′ / (ρ′ + sρ″), the residuals by a factor of at most ten: what is farther off hardly pulls.
    pub fn residuals_under(&self, loss: RobustLoss) -> Vec<Vector3<f64>> {
        let residual = |seen: &BundleObservation| {
            let Sight { bearing, expected, squared } = self.sight(seen)?;
            Some((bearing - expected.try_normalize(f64::MIN_POSITIVE)?) * pull(loss, squared))
        };
        self.observations.iter().map(|seen| residual(seen).unwrap_or_default()).collect()
    }

    /// An observation at the current state; `None` where it cannot be used.
    fn sight(&self, seen: &BundleObservation) -> Option<Sight> {
        let camera = self.cameras.get(self.poses.get(seen.pose as usize)?.camera as usize)?;
        let (bearing, inverse_sigma) = bearing_and_weight(camera, &seen.pixel, seen.noise_px)?;
        let expected = self.in_camera(seen.pose, seen.point)?;
        let squared = angular_squared(&bearing, &expected) * inverse_sigma.powi(2);
        Some(Sight { bearing, expected, squared })
    }

    /// A point in the frame of a pose's camera.
    fn in_camera(&self, pose: u32, point: u32) -> Option<Vector3<f64>> {
        let point = self.points.get(point as usize)?.position;
        Some(self.poses.get(pose as usize)?.world_from_camera.inverse().transform_point(&point))
    }
}

/// The factor that makes a residual an error to a quadratic cost of the loss' own curvature.
fn pull(loss: RobustLoss, squared: f64) -> f64 {
    (loss.evaluate(squared).1 / loss.mean_curvature(squared)).min(MAX_PULL)
}

/// What an observation shows beside what it ought to, in the camera's frame.
struct Sight {
    /// As seen, of unit length.
    bearing: Vector3<f64>,
    /// The point.
    expected: Vector3<f64>,
    /// Squared angle between them, in standard deviations.
    squared: f64,
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
    let is_valid = equations.solve()
        && equations.propose(lambda, 1.0, &mut model).is_some_and(|(_, candidate)| candidate.is_finite());
    if is_valid {
        model.accept();
        equations.accept();
        store(&model, &equations, &point_of_index, problem);
    }
    is_valid
}
