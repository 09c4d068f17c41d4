//! The pose of the rigid camera set, and whether another pose would do as well.

use setloc_sfm::robust::{
    GeneralizedPoseOptions, GeneralizedRay, GeneralizedSolver, RansacParams, estimate_absolute_pose,
    estimate_generalized_pose,
};
use setloc_sfm::{ImageId, Reconstruction, ReconstructionPoint, Rigid, Similarity};

use super::correspondences::{SetCorrespondence, SetRays};
use super::scale::{About, most_voted};
use super::sights::Sights;
use crate::evidence::{median, same_pose};
use crate::observability::{Observability, observability, refine_similarity};
use crate::{CamsetMethod, CamsetParams, PhotoEvidence, Verdict};

/// The rigid pose with its support.
pub(crate) struct RigidPose {
    pub world_from_set: Similarity,
    /// Agreeing correspondences, ascending.
    pub agreeing: Vec<usize>,
    /// Agreeing sights, ascending.
    pub sights: Vec<usize>,
    /// Agreeing lone sights, ascending.
    pub lone: Vec<usize>,
    /// Correspondences, or local points that the scene's images see, that agree with the best other pose.
    pub runner_up: usize,
    /// What these are worth: the ground counts for less.
    pub runner_up_worth: f64,
    pub observability: Observability,
}

impl RigidPose {
    /// Takes another pose, and what agrees with it.
    pub(crate) fn move_to(
        &mut self,
        world_from_set: Similarity,
        (rays, count): (&SetRays, usize),
        sights: &Sights,
        bound: f64,
    ) {
        [self.agreeing, self.sights, self.lone] =
            agreeing_with(&world_from_set, (rays, count), sights, bound);
        self.world_from_set = world_from_set;
    }
}

/// Correspondences, sights and lone sights that agree with a pose.
fn agreeing_with(
    world_from_set: &Similarity,
    (rays, count): (&SetRays, usize),
    sights: &Sights,
    bound: f64,
) -> [Vec<usize>; 3] {
    [
        rays.agreeing(world_from_set, bound, count),
        sights.agreeing(world_from_set, bound),
        sights.agreeing_lone(world_from_set, bound),
    ]
}

/// The photos of a local model: poses in the set's frame, indices among all photos, and what all photos know alone.
pub(crate) struct SetPhotos<'a> {
    pub set_from_camera: &'a [Rigid],
    pub members: &'a [usize],
    pub evidence: &'a [PhotoEvidence<'a>],
}

/// Finds the pose of greatest truncated score among that of the solver and, unless `params` leave them out, others.
///
/// `worth` is what each correspondence counts. Where too few agree with any pose for a verdict, that of the best is taken for
/// which `shown` finds most, if it finds enough for one.
pub(crate) fn rigid_pose(
    params: &CamsetParams,
    (correspondences, worth): (&[SetCorrespondence], &[f64]),
    model: &Reconstruction,
    (rays, sights): (&SetRays, &Sights),
    photos: &SetPhotos<'_>,
    shown: impl Fn(&Similarity) -> usize,
    seed: u64,
) -> Option<RigidPose> {
    let set_from_camera = photos.set_from_camera;
    let count = correspondences.len();
    let mut candidates: Vec<Similarity> = estimate(params, rays, seed).into_iter().collect();
    if params.other_hypotheses {
        candidates.extend(other_hypotheses(params, correspondences, model, (rays, sights), photos, seed));
        // Where the ground repeats itself, what agrees best is a pose aside.
        let stands: Vec<bool> = worth.iter().map(|worth| *worth >= 1.0).collect();
        if stands.contains(&false) {
            let standing = rays.subset(&stands);
            let seed = seed ^ 0x57a2d;
            candidates.extend(estimate(params, &standing, seed));
            candidates.extend(by_single_photos(params, correspondences, model, &standing, photos, seed));
        }
    }
    let bound = params.max_error_sigmas;
    let score = |pose: &Similarity| rays.score(pose, bound, worth) + sights.score(pose, bound);
    let mut scored: Vec<(Similarity, f64)> =
        candidates.into_iter().map(|candidate| (candidate, score(&candidate))).collect();
    scored.retain(|(_, score)| score.is_finite());
    scored.sort_by(|one, other| other.1.total_cmp(&one.1));
    let (mut initial, mut initial_score) = *scored.first()?;
    let lone = Sights::worth_of_lone(sights.agreeing_lone(&initial, bound).len());
    let support = rays.agreeing(&initial, bound, count).len() + sights.agreeing(&initial, bound).len() + lone;
    if params.other_hypotheses && support < params.verdict.min_inliers {
        let mut most = params.verdict.min_inliers.saturating_sub(1);
        for (pose, score) in scored.into_iter().take(WEAK_POSES) {
            let shown = shown(&pose);
            if shown > most {
                (most, initial, initial_score) = (shown, pose, score);
            }
        }
    }
    let refined = refine_similarity(&initial, &rays.rays, params.max_error_sigmas);
    let world_from_set = if score(&refined) >= initial_score { refined } else { initial };
    let [agreeing, agreeing_sights, lone] = agreeing_with(&world_from_set, (rays, count), sights, bound);
    let mut keep = vec![true; count];
    let mut inlier = vec![false; count];
    for &correspondence in &agreeing {
        keep[correspondence] = false;
        inlier[correspondence] = true;
    }
    let by_rays = runner_up(params, &rays.subset(&keep), &world_from_set, set_from_camera, count, seed);
    let by_sights =
        rival_of_sights(params, sights, (&agreeing_sights, &lone), &world_from_set, set_from_camera, seed);
    let observability = observability(&world_from_set, &rays.subset(&inlier).rays);
    Some(RigidPose {
        world_from_set,
        agreeing,
        sights: agreeing_sights,
        lone,
        runner_up: by_rays.len().max(by_sights),
        runner_up_worth: by_rays.iter().map(|&rival| worth[rival]).sum::<f64>().max(by_sights as f64),
        observability,
    })
}

/// Poses by photos localized alone, by what the scene's images show, and those that single photos suggest.
fn other_hypotheses(
    params: &CamsetParams,
    correspondences: &[SetCorrespondence],
    model: &Reconstruction,
    (rays, sights): (&SetRays, &Sights),
    photos: &SetPhotos<'_>,
    seed: u64,
) -> Vec<Similarity> {
    let mut found = alignments(photos.set_from_camera, photos.members, photos.evidence);
    found.extend(sights.estimate(params, &[], &rays.rays, seed));
    found.extend(by_single_photos(params, correspondences, model, rays, photos, seed));
    found
}

/// Poses that single photos suggest together with the depths of their local points, or with the other photos' rays.
fn by_single_photos(
    params: &CamsetParams,
    correspondences: &[SetCorrespondence],
    model: &Reconstruction,
    rays: &SetRays,
    photos: &SetPhotos<'_>,
    seed: u64,
) -> Vec<Similarity> {
    let SetPhotos { set_from_camera, members, evidence } = *photos;
    let mut found = Vec::new();
    for (slot, &photo) in members.iter().enumerate() {
        let in_set = &set_from_camera[slot];
        let alone = evidence[photo]
            .photo
            .world_from_camera
            .map(|in_world| Rigid::new(in_world.rotation * in_set.rotation.inverse(), in_world.translation));
        let view = rays.of_slot(slot);
        let sampled = view.absolute_pose(params, seed.wrapping_add(slot as u64));
        for axes_at_photo in alone.into_iter().chain(sampled) {
            found.extend(view.with_local_depths(
                params,
                &axes_at_photo,
                correspondences,
                model,
                ImageId(photo as u32),
            ));
            let about = About::photo(&axes_at_photo, in_set.translation);
            found.extend(rays.with_baselines(params, &about));
        }
    }
    found
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
    let options = solver_options(params);
    estimate_generalized_pose(&ransac, &generalized, &points, &options, seed)
        .map(|found| found.world_from_set)
}

/// How minimal samples of a set's rays become poses.
pub(crate) fn solver_options(params: &CamsetParams) -> GeneralizedPoseOptions {
    let solver = match params.method {
        CamsetMethod::Gp4ps => GeneralizedSolver::Minimal,
        CamsetMethod::Dlt => GeneralizedSolver::Dlt,
    };
    GeneralizedPoseOptions { solver, ..GeneralizedPoseOptions::default() }
}

/// How many poses are looked at more closely where too few correspondences agree with any.
const WEAK_POSES: usize = 16;
/// Samples that a single photo's pose may cost.
const PHOTO_SAMPLES: u32 = 3000;
/// Fewest agreeing rays that make a single photo's pose worth a hypothesis; all rays of the set judge it afterwards.
const PHOTO_INLIERS: usize = 5;
/// Quantiles of the depth ratios that are tried as scale.
const SCALE_QUANTILES: [f64; 3] = [0.5, 0.25, 0.75];

impl SetRays {
    fn of_slot(&self, slot: usize) -> Self {
        let kept: Vec<usize> = (0..self.rays.len()).filter(|&ray| self.slot[ray] == slot).collect();
        Self {
            rays: kept.iter().map(|&ray| self.rays[ray]).collect(),
            correspondence: kept.iter().map(|&ray| self.correspondence[ray]).collect(),
            slot: vec![slot; kept.len()],
        }
    }

    /// Pose of one photo's centre with the set's axes, from its own rays.
    ///
    /// Where only the first photos of a long set see the scene, hardly any of the set's matches are right, and samples
    /// of four from all of them are hopeless; among one photo's own the share is far better.
    fn absolute_pose(&self, params: &CamsetParams, seed: u64) -> Option<Rigid> {
        let bearings: Vec<_> = self.rays.iter().map(|ray| ray.direction).collect();
        let sigmas: Vec<f64> = self.rays.iter().map(|ray| ray.sigma).collect();
        let points: Vec<_> = self.rays.iter().map(|ray| ray.point).collect();
        let ransac = RansacParams {
            max_error_sigma: params.max_error_sigmas,
            max_iterations: PHOTO_SAMPLES,
            min_inliers: PHOTO_INLIERS,
            ..RansacParams::default()
        };
        estimate_absolute_pose(&ransac, &bearings, &sigmas, &points, seed)
            .map(|found| found.world_from_camera)
    }

    /// The set's poses when this photo's is given: only scale is left, and each 3D-to-3D match whose ray agrees gives
    /// it as the ratio of the point's distances in scene and local model.
    ///
    /// Where there are none, what the photo sees of either is taken to be as far away, so that at least its own pose
    /// is not lost.
    fn with_local_depths(
        &self,
        params: &CamsetParams,
        axes_at_photo: &Rigid,
        correspondences: &[SetCorrespondence],
        model: &Reconstruction,
        photo: ImageId,
    ) -> Vec<Similarity> {
        let mut ratios: Vec<f64> = Vec::new();
        let mut depths: Vec<f64> = Vec::new();
        for (ray, &correspondence) in self.rays.iter().zip(&self.correspondence) {
            let to_point =
                axes_at_photo.rotation.inverse_transform_vector(&(ray.point - axes_at_photo.translation));
            let error = (to_point.normalize() - ray.direction).norm() / ray.sigma;
            if !(error < params.max_error_sigmas) {
                continue;
            }
            depths.push(to_point.norm());
            let local = correspondences[correspondence].local.and_then(|local| model.points.get(local));
            let ratio = local.map(|local| to_point.norm() / (local.position - ray.origin).norm());
            ratios.extend(ratio.filter(|ratio| ratio.is_finite() && *ratio > 0.0));
        }
        let Some(origin) = self.rays.first().map(|ray| ray.origin) else { return Vec::new() };
        let about = About::photo(axes_at_photo, origin);
        if ratios.len() < 3 {
            let sees = |point: &&ReconstructionPoint| point.track.iter().any(|seen| seen.image == photo);
            let local =
                model.points.iter().filter(sees).map(|point| (point.position - origin).norm()).collect();
            let scale = median(depths).zip(median(local)).map(|(scene, local)| scene / local);
            return scale
                .filter(|scale| scale.is_finite() && *scale > 0.0)
                .map(|scale| about.scaled(scale))
                .into_iter()
                .collect();
        }
        ratios.sort_by(f64::total_cmp);
        SCALE_QUANTILES
            .iter()
            .map(|quantile| {
                let scale = ratios[(quantile * (ratios.len() - 1) as f64).round() as usize];
                about.scaled(scale)
            })
            .collect()
    }

    /// The same from the other photos' rays: each asks for the scale at which it meets its scene point.
    ///
    /// Where the photo that sees the scene shares no local point with it, a few rays of the next photos still agree on
    /// how far these are away, and wrong matches do not agree on anything.
    fn with_baselines(&self, params: &CamsetParams, about: &About) -> Vec<Similarity> {
        let scales = about.scales_of_rays(&self.rays, params.max_error_sigmas).collect();
        most_voted(scales, 1).into_iter().map(|scale| about.scaled(scale)).collect()
    }
}

/// What agrees with the best pose that the remaining rays give, when it puts the set elsewhere.
fn runner_up(
    params: &CamsetParams,
    rest: &SetRays,
    best: &Similarity,
    set_from_camera: &[Rigid],
    correspondences: usize,
    seed: u64,
) -> Vec<usize> {
    let Some(pose) = estimate(params, rest, seed ^ 0x5eed) else { return Vec::new() };
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
    if moved { rest.agreeing(&pose, params.max_error_sigmas, correspondences) } else { Vec::new() }
}

/// Sights, as of points, that agree with the best pose that the remaining ones give, when it puts the set elsewhere.
fn rival_of_sights(
    params: &CamsetParams,
    sights: &Sights,
    (agreeing, lone): (&[usize], &[usize]),
    best: &Similarity,
    set_from_camera: &[Rigid],
    seed: u64,
) -> usize {
    let Some(depth) = sights.depth(best) else { return 0 };
    let rivals = sights.estimate(params, agreeing, &[], seed ^ 0x5eed).into_iter().filter(|pose| {
        let moved = |camera| !same_pose(&pose.transform_pose(camera), &best.transform_pose(camera), depth);
        set_from_camera.iter().any(moved)
    });
    let support = |pose: Similarity| {
        let others = |found: Vec<usize>, best: &[usize]| -> Vec<usize> {
            found.into_iter().filter(|at| best.binary_search(at).is_err()).collect()
        };
        let bound = params.max_error_sigmas;
        let points = sights.points(&others(sights.agreeing(&pose, bound), agreeing)).len();
        points + Sights::worth_of_lone(others(sights.agreeing_lone(&pose, bound), lone).len())
    };
    rivals.map(support).max().unwrap_or(0)
}

/// Photos localized alone that give each of them a scale.
const SCALING_PARTNERS: usize = 16;

/// Poses of the set from photos that are localized alone: each gives the rotation, and with it those farthest from it in the set,
/// which tell the scale best, give that.
fn alignments(
    set_from_camera: &[Rigid],
    members: &[usize],
    evidence: &[PhotoEvidence<'_>],
) -> Vec<Similarity> {
    let alone: Vec<(Rigid, Rigid)> = members
        .iter()
        .zip(set_from_camera)
        .filter(|(photo, _)| evidence[**photo].photo.verdict == Verdict::Localized)
        .filter_map(|(&photo, &in_set)| Some((in_set, evidence[photo].photo.world_from_camera?)))
        .collect();
    let mut found = Vec::new();
    for (first_in_set, first_in_world) in &alone {
        let baseline = |(in_set, _): &(Rigid, Rigid)| (in_set.translation - first_in_set.translation).norm();
        let mut partners: Vec<usize> = (0..alone.len()).collect();
        partners.sort_by(|&a, &b| baseline(&alone[b]).total_cmp(&baseline(&alone[a])));
        partners.truncate(SCALING_PARTNERS);
        partners.sort_unstable();
        for partner in partners {
            let (_, second_in_world) = alone[partner];
            let baseline = baseline(&alone[partner]);
            let scale = (second_in_world.translation - first_in_world.translation).norm() / baseline;
            if !(scale > 0.0) || !scale.is_finite() {
                continue;
            }
            let rotation = first_in_world.rotation * first_in_set.rotation.inverse();
            let translation = first_in_world.translation - rotation * first_in_set.translation * scale;
            found.push(Similarity { scale, rotation, translation });
        }
    }
    found
}
