//! Intrinsics of a camera that no registered image has, from the first points that one of its images sees.
//!
//! A guessed focal length may be half or twice the true one. An adjustment that already holds the image mends that; but
//! resection under such a guess finds a wrong pose or none. So pose and focal length are sought together from the
//! image's matches to points of the model, then distortion with them on what agrees.

use nalgebra::{Vector2, Vector3};
use setloc_features::{Camera, CameraModel, Keypoint};

use super::{
    correspondence::CorrespondenceGraph,
    model::Model,
    register::{hypothesize, scene_matches},
};
use crate::{
    ImageId, Rigid,
    bundle::{
        self, BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, CameraPrior,
        IntrinsicsFreedom, RobustLoss,
    },
    robust::{RansacParams, estimate_absolute_pose, estimate_absolute_pose_focal},
};

/// Fewest matches that agree with an estimated camera: its nine or so unknowns fit a few of them whatever they are.
const MIN_AGREEING: usize = 30;
/// How many times more matches have to agree with the estimate than with the guess.
const GAIN: f64 = 1.2;
/// How many times more have to agree with a fisheye than with another lens: where the model is poor, its further terms fit
/// that.
const FISHEYE_GAIN: f64 = 1.5;
/// Focal lengths that are looked at, in longer sides of the image: views of 120° to 10°.
const FOCAL_RANGE: (f64, f64) = (0.29, 6.0);
/// Times that pose and intrinsics are adjusted on what agrees by then.
const ROUNDS: usize = 3;

/// The image's matches to the model.
struct Seen<'a> {
    keypoints: Vec<&'a Keypoint>,
    points: Vec<Vector3<f64>>,
    max_error_sigma: f64,
}

/// The camera of an image, where its matches tell one that explains clearly more of them than its guess does.
pub(super) fn calibrate(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    image: ImageId,
    params: &RansacParams,
    seed: u64,
) -> Option<Camera> {
    let source = &model.input.images[image.index()];
    let guess = &model.cameras[source.camera.index()];
    if guess.model != CameraModel::Radial {
        return None;
    }
    let matches = scene_matches(model, graph, image);
    let found = matches.iter().filter_map(|&(feature, id)| {
        Some((source.features.keypoints.get(feature as usize)?, model.point(id)?.position))
    });
    let (keypoints, points): (Vec<&Keypoint>, Vec<Vector3<f64>>) = found.unzip();
    let by_guess = hypothesize(model, graph, image, params, 1, seed);
    let by_guess = by_guess.first().map_or(0, |hypothesis| hypothesis.inliers.len());
    let least = (GAIN * by_guess as f64).max(MIN_AGREEING as f64);
    let seen = Seen { keypoints, points, max_error_sigma: params.max_error_sigma };
    let params = params.enough_for(least, seen.points.len(), 4)?;
    let (camera, agreeing) = seen.calibrated(guess, &params, seed)?;
    (agreeing as f64 >= least).then_some(camera)
}

impl Seen<'_> {
    /// The camera and how many matches agree with it: a fisheye, where that explains clearly more.
    fn calibrated(&self, guess: &Camera, params: &RansacParams, seed: u64) -> Option<(Camera, usize)> {
        let usual = self.rectilinear(guess, params, seed);
        let least = FISHEYE_GAIN * usual.as_ref().map_or(0, |(_, agreeing)| *agreeing) as f64;
        let fisheye = (params.enough_for(least, self.points.len(), 3))
            .and_then(|params| self.fisheye(guess, &params, seed))
            .filter(|(_, agreeing)| *agreeing as f64 > least);
        fisheye.or(usual)
    }

    /// A camera by focal length and pose in one.
    fn rectilinear(&self, guess: &Camera, params: &RansacParams, seed: u64) -> Option<(Camera, usize)> {
        let center = Vector2::new(guess.params[1], guess.params[2]);
        let pixels: Vec<Vector2<f64>> = self.keypoints.iter().map(|seen| seen.pixel() - center).collect();
        let sigmas: Vec<f64> = self.keypoints.iter().map(|seen| f64::from(seen.noise_px)).collect();
        let side = f64::from(guess.width.max(guess.height));
        let range = (FOCAL_RANGE.0 * side, FOCAL_RANGE.1 * side);
        let found = estimate_absolute_pose_focal(params, &pixels, &sigmas, &self.points, range, seed)?;
        let camera = guess.with_focal_times(found.focal / guess.focal_length());
        let (camera, agreeing) = self.improved(camera, found.world_from_camera, found.inliers)?;
        let focal = camera.focal_length();
        (focal >= range.0 && focal <= range.1).then_some((camera, agreeing))
    }

    /// The fisheye that most matches agree with.
    fn fisheye(&self, guess: &Camera, params: &RansacParams, seed: u64) -> Option<(Camera, usize)> {
        let with_pose = |camera: Camera| {
            let rays = self.keypoints.iter().map(|seen| {
                let (bearing, angle) = camera.ray(&seen.pixel())?;
                Some((bearing, angle * f64::from(seen.noise_px)))
            });
            let (bearings, sigmas): (Vec<_>, Vec<_>) = rays.collect::<Option<Vec<_>>>()?.into_iter().unzip();
            let found = estimate_absolute_pose(params, &bearings, &sigmas, &self.points, seed)?;
            Some((camera, found.world_from_camera, found.inliers))
        };
        let guesses = Camera::fisheye_guesses(guess.width, guess.height).filter_map(with_pose);
        let (camera, pose, agreeing) = guesses.max_by_key(|(.., agreeing)| agreeing.len())?;
        self.improved(camera, pose, agreeing).filter(|(camera, _)| camera.is_wide())
    }

    /// Camera and pose, adjusted to what agrees until that is all that does, and how much it is.
    fn improved(&self, mut camera: Camera, mut pose: Rigid, agreeing: Vec<u32>) -> Option<(Camera, usize)> {
        let mut agreeing: Vec<usize> = agreeing.into_iter().map(|at| at as usize).collect();
        for _ in 0..ROUNDS {
            (camera, pose) = self.adjusted(&camera, &pose, &agreeing)?;
            agreeing = self.agreeing(&camera, &pose);
        }
        Some((camera, agreeing.len()))
    }

    /// Camera and pose adjusted to these matches, the points held.
    fn adjusted(&self, camera: &Camera, pose: &Rigid, agreeing: &[usize]) -> Option<(Camera, Rigid)> {
        let observation = |(point, &at): (usize, &usize)| {
            let seen = self.keypoints[at];
            let noise_px = f64::from(seen.noise_px);
            BundleObservation { pose: 0, point: point as u32, pixel: seen.pixel(), noise_px }
        };
        let point = |&at: &usize| BundlePoint { position: self.points[at], fixed: true };
        let mut problem = BundleProblem {
            cameras: vec![camera.clone()],
            camera_freedom: vec![IntrinsicsFreedom::FREE],
            camera_priors: CameraPrior::of_usual_photo(0, camera).into_iter().collect(),
            poses: vec![BundlePose { camera: 0, world_from_camera: *pose, fixed: false }],
            points: agreeing.iter().map(point).collect(),
            observations: agreeing.iter().enumerate().map(observation).collect(),
            ..BundleProblem::default()
        };
        let params = BundleParams { loss: RobustLoss::Cauchy(1.0), ..BundleParams::default() };
        bundle::solve(&params, &mut problem);
        let camera = problem.cameras.pop().filter(|camera| camera.validate().is_ok())?;
        Some((camera, problem.poses.first()?.world_from_camera))
    }

    fn agreeing(&self, camera: &Camera, pose: &Rigid) -> Vec<usize> {
        let agrees = |&at: &usize| {
            let Some((bearing, angle)) = camera.ray(&self.keypoints[at].pixel()) else { return false };
            let direction = pose.inverse_transform_point(&self.points[at]).normalize();
            let sigma = angle * f64::from(self.keypoints[at].noise_px);
            (direction - bearing).norm() <= self.max_error_sigma * sigma
        };
        (0..self.points.len()).filter(agrees).collect()
    }
}
