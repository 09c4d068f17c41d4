//! The pose of the rigid camera set, and whether another pose would do as well.

use setloc_sfm::robust::{
    GeneralizedPoseOptions, GeneralizedRay, GeneralizedSolver, RansacParams, estimate_generalized_pose,
};
use setloc_sfm::{Rigid, Similarity};

use super::PhotoEvidence;
use super::correspondences::{SetCorrespondence, SetRays};
use crate::evidence::same_pose;
use crate::observability::{Observability, observability, refine_similarity};
use crate::{CamsetMethod, CamsetParams, Verdict};

/// The rigid pose with its support.
pub(crate) struct RigidPose {
    pub world_from_set: Similarity,
    /// Agreeing correspondences, ascending.
    pub agreeing: Vec<usize>,
    /// Correspondences that agree with the best other pose.
    pub runner_up: usize,
    pub observability: Observability,
}

/// Finds the pose of greatest truncated score among those of the solver and those of photos localized alone.
pub(crate) fn rigid_pose(
    params: &CamsetParams,
    correspondences: &[SetCorrespondence],
    rays: &SetRays,
    set_from_camera: &[Rigid],
    members: &[usize],
    evidence: &[PhotoEvidence],
    seed: u64,
) -> Option<RigidPose> {
    let count = correspondences.len();
    let mut candidates: Vec<Similarity> = estimate(params, rays, seed).into_iter().collect();
    candidates.extend(alignments(set_from_camera, members, evidence));
    let score = |pose: &Similarity| rays.score(pose, params.max_error_sigmas, count);
    let mut best: Option<(Similarity, f64)> = None;
    for candidate in candidates {
        let value = score(&candidate);
        if best.is_none_or(|(_, least)| value > least) {
            best = Some((candidate, value));
        }
    }
    let (initial, initial_score) = best?;
    let refined = refine_similarity(&initial, &rays.rays, params.max_error_sigmas);
    let world_from_set = if score(&refined) >= initial_score { refined } else { initial };
    let agreeing = rays.agreeing(&world_from_set, params.max_error_sigmas, count);
    let mut keep = vec![true; count];
    let mut inlier = vec![false; count];
    for &correspondence in &agreeing {
        keep[correspondence] = false;
        inlier[correspondence] = true;
    }
    let runner_up = runner_up(params, &rays.subset(&keep), &world_from_set, set_from_camera, count, seed);
    let observability = observability(&world_from_set, &rays.subset(&inlier).rays);
    Some(RigidPose { world_from_set, agreeing, runner_up, observability })
}

fn estimate(params: &CamsetParams, rays: &SetRays, seed: u64) -> Option<Similarity> {
    let generalized: Vec<GeneralizedRay> = rays
        .rays
        .iter()
        .zip(&rays.slot)
        .map(|(ray, &slot)| GeneralizedRay {
            origin: ray.origin,
            direction: ray.direction,
            sigma: ray.sigma,
            camera: slot as u32,
        })
        .collect();
    let points: Vec<_> = rays.rays.iter().map(|ray| ray.point).collect();
    let ransac = RansacParams { max_error_sigma: params.max_error_sigmas, ..RansacParams::default() };
    let solver = match params.method {
        CamsetMethod::Gp4ps => GeneralizedSolver::Minimal,
        CamsetMethod::Dlt => GeneralizedSolver::Dlt,
    };
    let options = GeneralizedPoseOptions { solver, ..GeneralizedPoseOptions::default() };
    estimate_generalized_pose(&ransac, &generalized, &points, &options, seed)
        .map(|found| found.world_from_set)
}

/// Support of the best pose that the remaining rays give, when it puts the set elsewhere.
fn runner_up(
    params: &CamsetParams,
    rest: &SetRays,
    best: &Similarity,
    set_from_camera: &[Rigid],
    correspondences: usize,
    seed: u64,
) -> usize {
    let Some(pose) = estimate(params, rest, seed ^ 0x5eed) else { return 0 };
    let set_from_world = best.inverse();
    let depth = rest
        .rays
        .iter()
        .map(|ray| (set_from_world.transform_point(&ray.point) - ray.origin).norm())
        .sum::<f64>()
        / rest.rays.len().max(1) as f64
        * best.scale;
    let moved = set_from_camera
        .iter()
        .any(|camera| !same_pose(&pose.transform_pose(camera), &best.transform_pose(camera), depth));
    if moved { rest.agreeing(&pose, params.max_error_sigmas, correspondences).len() } else { 0 }
}

/// Poses of the set from each ordered pair of photos that are localized alone: one gives the rotation, both the scale.
fn alignments(set_from_camera: &[Rigid], members: &[usize], evidence: &[PhotoEvidence]) -> Vec<Similarity> {
    let alone: Vec<(Rigid, Rigid)> = members
        .iter()
        .zip(set_from_camera)
        .filter(|(photo, _)| evidence[**photo].alone.verdict == Verdict::Localized)
        .filter_map(|(&photo, &in_set)| Some((in_set, evidence[photo].alone.world_from_camera?)))
        .collect();
    let mut found = Vec::new();
    for (i, (first_in_set, first_in_world)) in alone.iter().enumerate() {
        for (j, (second_in_set, second_in_world)) in alone.iter().enumerate() {
            let baseline = (second_in_set.translation - first_in_set.translation).norm();
            let scale = (second_in_world.translation - first_in_world.translation).norm() / baseline;
            if i == j || !(scale > 0.0) || !scale.is_finite() {
                continue;
            }
            let rotation = first_in_world.rotation * first_in_set.rotation.inverse();
            let translation = first_in_world.translation - rotation * first_in_set.translation * scale;
            found.push(Similarity { scale, rotation, translation });
        }
    }
    found
}
