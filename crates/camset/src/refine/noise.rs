//! What residuals say of the noise that keypoints state.

use std::collections::BTreeSet;

use nalgebra::Matrix3;
use setloc_sfm::bundle::{self, BundleObservation, BundleParams, BundlePose, BundleProblem, RobustLoss};

use super::Origin;
use crate::evidence::ray_error_sigmas;

/// Degrees of freedom that stand behind the keypoints' stated noise before any residual is seen.
const STATED_FREEDOM: f64 = 20.0;
/// Least variance, relative to what keypoints state.
const LEAST_VARIANCE: f64 = 0.25;

/// Where a match with the scene is taken for wrong, in the standard deviations that the matches show.
const WRONG_SIGMAS: f64 = 5.0;
/// Steps of the estimate of what the matches with the scene show.
const VARIANCE_STEPS: usize = 30;

/// Error in standard deviations of an observation that no pose explains. Lower bounds leave out what shows the noise:
/// at 10 the stated deviations on one rendered plaza were two thirds of what they are.
const STRAY_SIGMAS: f64 = 400.0;

/// Leaves out observations of photos that the adjustment could not bring near its points.
///
/// A keypoint may agree with a scene point of large uncertainty and lie hundreds of its own deviations off the point's
/// mean. The robust loss then hardly pulls, and what is left would stand for the noise of all.
pub(super) fn leave_out_strays(problem: &mut BundleProblem, origins: &mut Vec<Origin>) {
    let is_stray =
        |seen: &BundleObservation| error_sigmas(problem, seen).is_none_or(|error| error > STRAY_SIGMAS);
    let kept: Vec<(BundleObservation, Origin)> = (problem.observations.iter().zip(origins.iter()))
        .filter(|(seen, origin)| **origin == Origin::Prior || !is_stray(seen))
        .map(|(seen, origin)| (*seen, *origin))
        .collect();
    (problem.observations, *origins) = kept.into_iter().unzip();
}

/// What the observations of each pose cost.
pub(super) fn costs(problem: &BundleProblem, loss: RobustLoss) -> Vec<f64> {
    let mut costs = vec![0.0; problem.poses.len()];
    for seen in &problem.observations {
        if let Some(error) = error_sigmas(problem, seen) {
            costs[seen.pose as usize] += loss.evaluate(error * error).0 / 2.0;
        }
    }
    costs
}

/// How far the point of an observation is from where it is seen, in standard deviations of the place; `None` where the
/// camera does not see there.
fn error_sigmas(problem: &BundleProblem, seen: &BundleObservation) -> Option<f64> {
    let BundlePose { camera, world_from_camera, .. } = &problem.poses[seen.pose as usize];
    let (bearing, angle) = problem.cameras[*camera as usize].ray(&seen.pixel)?;
    let offset = problem.points[seen.point as usize].position - world_from_camera.translation;
    let bearing = world_from_camera.rotation * bearing;
    Some(ray_error_sigmas(&bearing, angle * seen.noise_px, &offset, &Matrix3::zeros()))
}

/// Scales the noise of what ties the set to the scene and of what ties its photos by what their residuals show, each by
/// itself.
///
/// Keypoints state the noise between photos of one light. A photo of another light, of other optics or far nearer to a
/// surface than the panoramas agrees less with the scene, and its set agrees better with itself: on rendered sets under
/// another light residuals had 1.5–2.9 and 0.5–1.1 times the stated variance. Estimated as variance components
/// (F. R. Helmert; K.-R. Koch, "Parameter estimation and hypothesis testing in linear models", 1999, § 3.6), shrunk
/// towards what was stated. Matches with the scene are wrong in part, so what is beyond [`WRONG_SIGMAS`] of the estimate
/// itself counts as that (Winsorized; P. J. Huber, "Robust statistics", 1981, § 1.7), and the estimate is freed of what
/// right ones lose by it. `origins` are those of the observations, `scene_points` the number of points with
/// bearings of the scene.
pub(super) fn state_real_noise(problem: &mut BundleProblem, origins: &[Origin], scene_points: usize) {
    let nothing = BundleParams { max_iterations: 0, ..BundleParams::default() };
    let squared = |kept: &dyn Fn(Origin) -> bool| {
        let observations = problem.observations.iter().zip(origins);
        let mut part = BundleProblem {
            observations: observations.filter(|(_, origin)| kept(**origin)).map(|(o, _)| *o).collect(),
            bearings: Vec::new(),
            ..problem.clone()
        };
        let report = bundle::solve(&nothing, &mut part);
        (2.0 * report.initial_cost, report.degrees_of_freedom as f64)
    };
    let count = |wanted: Origin| origins.iter().filter(|origin| **origin == wanted).count() as f64;
    let (of_all, freedom) = squared(&|_| true);
    let (of_local, _) = squared(&|origin| origin == Origin::Local);
    // The bearings of a scene point say as much as three coordinates.
    let coordinates = 3.0 * scene_points as f64;
    let freedom = freedom - 2.0 * count(Origin::Prior) + coordinates;
    // The coordinates of scene points that only keypoints see are unknowns too; those of the others are known from the
    // set itself.
    let of_points = |wanted: Origin| {
        let observations = problem.observations.iter().zip(origins);
        observations
            .filter(|(_, origin)| **origin == wanted)
            .map(|(observation, _)| observation.point)
            .collect::<BTreeSet<u32>>()
    };
    let by_keypoints = of_points(Origin::Prior).difference(&of_points(Origin::Local)).count() as f64;
    // The scene places the photos as a whole: six parameters, and the scale.
    let scene_freedom = 2.0 * count(Origin::Scene) + coordinates - 3.0 * by_keypoints - 7.0;
    let scene_freedom = scene_freedom.clamp(0.0, freedom.max(0.0));
    let component =
        |squared: f64, freedom: f64| (squared + STATED_FREEDOM) / (freedom.max(0.0) + STATED_FREEDOM);
    let deviation =
        |variance: f64| if variance.is_finite() { variance.max(LEAST_VARIANCE).sqrt() } else { 1.0 };
    let local = deviation(component(of_local, freedom - scene_freedom));
    let of_scene = of_all - of_local;
    let errors: Vec<f64> = (problem.observations.iter().zip(origins))
        .filter(|(_, origin)| **origin == Origin::Scene)
        .filter_map(|(seen, _)| error_sigmas(problem, seen).map(|error| error * error))
        .collect();
    // What two coordinates of standard deviation one lose by the limit, in the mean.
    let lost = 2.0 * (-0.5 * WRONG_SIGMAS.powi(2)).exp() * errors.len() as f64;
    let mut variance = component(of_scene, scene_freedom);
    for _ in 0..VARIANCE_STEPS {
        let limit = WRONG_SIGMAS.powi(2) * variance;
        let beyond: f64 = errors.iter().map(|squared| (squared - limit).max(0.0)).sum();
        variance = component(of_scene - beyond, scene_freedom - lost);
    }
    let scene = deviation(variance);
    for (observation, origin) in problem.observations.iter_mut().zip(origins) {
        observation.noise_px *= if *origin == Origin::Local { local } else { scene };
    }
}
