//! Bundle problems over photos whose scene points stay fixed.

use std::collections::BTreeMap;

use nalgebra::{Matrix6, Vector3};
use setloc_features::Camera;
use setloc_index::SceneIndex;
use setloc_sfm::bundle::{
    self, BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, IntrinsicsFreedom,
    RobustLoss,
};
use setloc_sfm::{PointId, Rigid};

use crate::evidence::{PhotoRays, SceneMatch};

/// Scale of the robust loss in standard deviations: inliers (up to four) hardly feel it, leftovers do.
const LOSS_SCALE: f64 = 3.0;
/// Observations that a photo needs before its intrinsics are estimated.
const MIN_FOR_INTRINSICS: usize = 30;

/// Photos, their cameras and the local points between them, all in the scene's frame.
#[derive(Debug, Clone)]
pub(crate) struct JointModel {
    pub cameras: Vec<Camera>,
    /// Whether each camera's intrinsics are known.
    pub camera_fixed: Vec<bool>,
    pub photos: Vec<JointPhoto>,
    pub points: Vec<Vector3<f64>>,
}

/// One photo of a joint model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct JointPhoto {
    /// Index into [`JointModel::cameras`].
    pub camera: usize,
    pub world_from_camera: Rigid,
}

/// Slot `photo` of a joint model sees local point `point` with one of its features.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TrackObservation {
    pub photo: usize,
    pub feature: u32,
    pub point: usize,
}

/// Moves photos and local points (the paper's T_OPT), scene points fixed; returns covariances of the poses if asked.
///
/// `direct[i]` are the scene points that photo `i` sees. A camera is estimated only when it is not known and enough
/// observations support it. Poses without any observation stay where they are.
pub(crate) fn refine_jointly(
    model: &mut JointModel,
    index: &SceneIndex,
    rays: &[PhotoRays<'_>],
    direct: &[Vec<SceneMatch>],
    tracks: &[TrackObservation],
    with_covariance: bool,
) -> Vec<Option<Matrix6<f64>>> {
    let mut points: Vec<BundlePoint> =
        model.points.iter().map(|&position| BundlePoint { position, fixed: false }).collect();
    let mut scene_points: BTreeMap<PointId, u32> = BTreeMap::new();
    let mut observations = Vec::with_capacity(tracks.len() + direct.iter().map(Vec::len).sum::<usize>());
    let mut support = vec![0_usize; model.cameras.len()];
    let mut observed = vec![0_usize; model.photos.len()];
    for (slot, matches) in direct.iter().enumerate() {
        let photo = &model.photos[slot];
        for &found in matches {
            let point = *scene_points.entry(found.point).or_insert_with(|| {
                points.push(BundlePoint { position: index.position(found.point), fixed: true });
                points.len() as u32 - 1
            });
            observations.push(BundleObservation {
                pose: slot as u32,
                point,
                pixel: rays[slot].features.keypoints[found.feature as usize].pixel(),
                noise_px: rays[slot].match_noise_px(index, &photo.world_from_camera, found),
            });
        }
        support[photo.camera] += matches.len();
        observed[slot] += matches.len();
    }
    for track in tracks {
        let keypoint = &rays[track.photo].features.keypoints[track.feature as usize];
        observations.push(BundleObservation {
            pose: track.photo as u32,
            point: track.point as u32,
            pixel: keypoint.pixel(),
            noise_px: f64::from(keypoint.noise_px),
        });
        support[model.photos[track.photo].camera] += 1;
        observed[track.photo] += 1;
    }
    let camera_freedom = support
        .iter()
        .zip(&model.camera_fixed)
        .map(|(&support, &fixed)| {
            if fixed || support < MIN_FOR_INTRINSICS {
                IntrinsicsFreedom::FIXED
            } else {
                IntrinsicsFreedom::LENS
            }
        })
        .collect();
    let poses = model
        .photos
        .iter()
        .zip(&observed)
        .map(|(photo, &observed)| BundlePose {
            camera: photo.camera as u32,
            world_from_camera: photo.world_from_camera,
            fixed: observed < 3,
        })
        .collect();
    let mut problem = BundleProblem {
        cameras: model.cameras.clone(),
        camera_freedom,
        poses,
        points,
        observations,
        position_priors: Vec::new(),
    };
    let params = BundleParams { loss: RobustLoss::Cauchy(LOSS_SCALE), ..BundleParams::default() };
    let _report = bundle::solve(&params, &mut problem);
    model.cameras.clone_from(&problem.cameras);
    for (photo, pose) in model.photos.iter_mut().zip(&problem.poses) {
        photo.world_from_camera = pose.world_from_camera;
    }
    for (point, refined) in model.points.iter_mut().zip(&problem.points) {
        *point = refined.position;
    }
    if !with_covariance {
        return vec![None; model.photos.len()];
    }
    // What is left are inliers: each counts in full.
    covariances(&problem, RobustLoss::Trivial)
}

/// Covariances of all poses; where the whole is undetermined, of those that their fixed points determine alone.
fn covariances(problem: &BundleProblem, loss: RobustLoss) -> Vec<Option<Matrix6<f64>>> {
    let wanted: Vec<u32> =
        (0..problem.poses.len() as u32).filter(|&pose| !problem.poses[pose as usize].fixed).collect();
    let mut found = vec![None; problem.poses.len()];
    if let Some(covariances) = bundle::covariance(problem, loss, &wanted) {
        for (&pose, covariance) in wanted.iter().zip(covariances) {
            found[pose as usize] = Some(covariance);
        }
        return found;
    }
    for &pose in &wanted {
        let ties = |o: &&BundleObservation| o.pose == pose && problem.points[o.point as usize].fixed;
        let observations: Vec<BundleObservation> =
            problem.observations.iter().filter(ties).map(|o| BundleObservation { pose: 0, ..*o }).collect();
        let alone = BundleProblem {
            cameras: problem.cameras.clone(),
            camera_freedom: problem.camera_freedom.clone(),
            poses: vec![problem.poses[pose as usize]],
            points: problem.points.clone(),
            observations,
            position_priors: Vec::new(),
        };
        let covariance = bundle::covariance(&alone, loss, &[0]);
        found[pose as usize] = covariance.and_then(|covariances| covariances.first().copied());
    }
    found
}
