//! Bundle problems over photos in a scene whose cameras stay fixed.

use nalgebra::Matrix6;
use setloc_sfm::Rigid;
use setloc_sfm::bundle::{
    self, BundleObservation, BundleParams, BundleProblem, IntrinsicsFreedom, RobustLoss,
};

use crate::Scene;
use crate::common_turn::CommonTurn;
use crate::evidence::PhotoRays;
use crate::jackknife::honest_covariances;
use crate::stretch::{Costs, Freed};

mod model;
mod noise;
mod prior;
mod problem;
mod standpoints;

pub(crate) use model::{
    JointCamera, JointModel, JointObservations, JointPhoto, KnownOfCamera, SceneView, Sighting, TiedPoint,
};
use problem::{JointProblem, Origin};
pub(crate) use standpoints::place_on;
use standpoints::{Standpoints, turned};

/// Scale of the robust loss in standard deviations: at one deviation an observation has half its weight, at four (an
/// inlier still) a seventeenth, so leftovers among the matches hardly pull.
const LOSS_SCALE: f64 = 1.0;

/// Moves photos and local points (the paper's T_OPT), scene points within what the scene knows of them; returns
/// covariances of the poses if asked.
///
/// Cameras that are not known are estimated, from what holds for usual photos on; where covariances are asked for, photos of known
/// ones get another focal length or are stretched if that spares more than noise would ([`crate::stretch`]). Poses of fewer than
/// three observations stay where they are.
pub(crate) fn refine_jointly(
    model: &mut JointModel,
    scene: &Scene<'_>,
    rays: &[PhotoRays<'_>],
    observed: &JointObservations,
    with_covariance: bool,
) -> Vec<Option<Matrix6<f64>>> {
    let standpoints = Standpoints::new(&model.photos);
    let mut joint = JointProblem::assemble(model, scene, rays, observed, &standpoints);
    let params = BundleParams { loss: RobustLoss::Cauchy(LOSS_SCALE), ..BundleParams::default() };
    adjust(&params, model, &mut joint, &standpoints, with_covariance);
    let photos = model.photos.len();
    let of_leads =
        if with_covariance { joint.covariances(&params, scene, photos) } else { vec![None; photos] };
    let BundleProblem { cameras, poses, points, .. } = &joint.problem;
    for (JointCamera { camera, .. }, refined) in model.cameras.iter_mut().zip(cameras) {
        camera.clone_from(refined);
    }
    for (slot, photo) in model.photos.iter_mut().enumerate() {
        let lead = poses[photo.standpoint].world_from_camera;
        photo.world_from_camera = Rigid::new(lead.rotation * standpoints.turn[slot], lead.translation);
    }
    for (point, refined) in model.points.iter_mut().zip(points) {
        *point = refined.position;
    }
    let turn =
        if with_covariance { CommonTurn::of(scene, rays, &model.photos, &observed.direct) } else { None };
    let of_photo = |(slot, photo): (usize, &JointPhoto)| {
        let own = turned(of_leads[photo.standpoint].as_ref()?, &standpoints.turn[slot]);
        Some(turn.map_or(own, |turn| own + turn.covariance(&photo.world_from_camera)))
    };
    model.photos.iter().enumerate().map(of_photo).collect()
}

/// Solves the problem; with photos of known intrinsics stretched where they are known to be, or where, if it may be asked, that
/// is worth it, or with another focal length than they are told where that is.
fn adjust(
    params: &BundleParams,
    model: &mut JointModel,
    joint: &mut JointProblem,
    standpoints: &Standpoints,
    may_stretch: bool,
) {
    // Poses of standpoints all of whose photos are known.
    let mut slots: Vec<usize> = (0..model.photos.len())
        .filter(|&slot| standpoints.lead[slot] == slot && !joint.problem.poses[slot].fixed)
        .collect();
    for photo in model.photos.iter().filter(|photo| !model.cameras[photo.camera].is_known()) {
        slots.retain(|&slot| slot != photo.standpoint);
    }
    let problem = &mut joint.problem;
    if model.stretch.is_free {
        let freed = Freed::new(problem, &standpoints.sphere, &slots, model.stretch.twist_sigma);
        bundle::solve(params, problem);
        model.stretch.note(problem, &freed);
        return;
    }
    let as_told = bundle::solve(params, problem);
    if !may_stretch || slots.is_empty() {
        return;
    }
    let mut stretched = problem.clone();
    let freed = Freed::new(&mut stretched, &standpoints.sphere, &slots, model.stretch.twist_sigma);
    let report = bundle::solve(params, &mut stretched);
    let by_stretch = as_told.final_cost - report.final_cost;
    if slots.len() >= MIN_STANDPOINTS_FOR_FOCAL {
        let (mut refocused, cameras) = refocused(model, problem);
        let by_focal = as_told.final_cost - bundle::solve(params, &mut refocused).final_cost;
        if by_focal > (LEAST_SPARED_BY_FOCAL * as_told.final_cost).max(SHARE_OF_STRETCH * by_stretch) {
            *problem = refocused;
            for at in cameras {
                model.cameras[at].known = KnownOfCamera::AllButFocal(problem.cameras[at].clone());
            }
            return;
        }
    }
    let costs = |problem: &BundleProblem, total: f64| {
        let by_pose = noise::costs(problem, params.loss);
        Costs { total, by_pose: slots.iter().map(|&slot| by_pose[slot]).collect() }
    };
    let [told, freely] = [costs(problem, as_told.final_cost), costs(&stretched, report.final_cost)];
    if model.stretch.is_worth(&freed, &told, &freely) {
        *problem = stretched;
        model.stretch.note(problem, &freed);
    }
}

/// Standpoints from which on photos are asked for their focal length though it is told: few find one for their noise.
const MIN_STANDPOINTS_FOR_FOCAL: usize = 3;
/// Share of the cost that another focal length must spare to be used in place of the one that is told: of four rendered sets the
/// true one spares 0.01–0.09 %, where it is told 0.5 % wrong 1.5–3.7 %, where 3 % 8–32 %.
const LEAST_SPARED_BY_FOCAL: f64 = 0.01;
/// And of what stretches spare, which stand for it as far as they may: 0.9 or more where it is the focal length.
const SHARE_OF_STRETCH: f64 = 0.7;

/// The problem with the focal lengths that photos are told free, and their cameras.
fn refocused(model: &JointModel, problem: &BundleProblem) -> (BundleProblem, Vec<usize>) {
    let mut refocused = problem.clone();
    refocused.camera_freedom.resize(refocused.cameras.len(), IntrinsicsFreedom::FIXED);
    let is_used = |at: &usize| model.photos.iter().any(|photo| photo.camera == *at);
    let has_told = |at: &usize| {
        let camera = &model.cameras[*at];
        camera.is_known() && !camera.camera.is_panoramic() && is_used(at)
    };
    let cameras: Vec<usize> = (0..model.cameras.len()).filter(has_told).collect();
    for &at in &cameras {
        let camera = model.cameras[at].camera.clone();
        let free = JointCamera { known: KnownOfCamera::AllButFocal(camera.clone()), camera };
        refocused.camera_freedom[at] = free.freedom();
        refocused.camera_priors.extend(free.prior(at as u32));
    }
    (refocused, cameras)
}

impl JointProblem {
    /// Covariances of the photos' poses, by what residuals show and by what is known of the scene's own errors.
    fn covariances(
        &mut self,
        params: &BundleParams,
        scene: &Scene<'_>,
        photos: usize,
    ) -> Vec<Option<Matrix6<f64>>> {
        noise::leave_out_strays(&mut self.problem, &mut self.origins);
        noise::state_real_noise(&mut self.problem, &self.origins, self.scene_points);
        bundle::solve(params, &mut self.problem);
        let mut found = honest_covariances(params, &mut self.problem, photos, |problem, loss| {
            covariances(problem, photos, loss)
        });
        let problem = &self.problem;
        let considered =
            [self.common.spread(params, problem, photos), self.held.spread(scene, params, problem, photos)];
        for added in considered.into_iter().flatten() {
            for (covariance, added) in found.iter_mut().zip(added) {
                *covariance = covariance.map(|own| own + added);
            }
        }
        found
    }
}

/// Covariances of the photos' poses; where the whole is undetermined, of those that scene points determine alone.
fn covariances(problem: &BundleProblem, photos: usize, loss: RobustLoss) -> Vec<Option<Matrix6<f64>>> {
    let wanted: Vec<u32> = (0..photos as u32).filter(|&pose| !problem.poses[pose as usize].fixed).collect();
    let mut found = vec![None; photos];
    if let Some(covariances) = bundle::covariance(problem, loss, &wanted) {
        for (&pose, covariance) in wanted.iter().zip(covariances) {
            found[pose as usize] = Some(covariance);
        }
        return found;
    }
    let mut of_scene: Vec<bool> = problem.points.iter().map(|point| point.fixed).collect();
    for prior in problem.observations.iter().filter(|o| o.pose as usize >= photos) {
        of_scene[prior.point as usize] = true;
    }
    for &pose in &wanted {
        let ties = |o: &&BundleObservation| {
            of_scene[o.point as usize] && (o.pose == pose || o.pose as usize >= photos)
        };
        // Only this pose and what is fixed keep observations, so the others drop out.
        let alone = BundleProblem {
            observations: problem.observations.iter().filter(ties).copied().collect(),
            bearings: Vec::new(),
            ..problem.clone()
        };
        let covariance = bundle::covariance(&alone, loss, &[pose]);
        found[pose as usize] = covariance.and_then(|covariances| covariances.first().copied());
    }
    found
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::stretch::PhotoStretch;
    use crate::synthetic::World;

    #[test]
    fn exact_scene_points_hold_a_photo_and_tell_its_covariance() {
        let mut world = World::chain(1, 0.0, 31);
        world.make_scene_exact();
        let (view, matches) = (&world.photos[0], world.scene_matches(0));
        assert!(matches.len() > 100);
        let mut off = view.pose;
        off.translation += Vector3::new(0.3, -0.1, 0.2);
        let mut model = JointModel {
            cameras: vec![JointCamera::new(world.camera.clone(), true)],
            photos: vec![JointPhoto { camera: 0, world_from_camera: off, standpoint: 0 }],
            points: Vec::new(),
            lengths: Vec::new(),
            stretch: PhotoStretch::default(),
        };
        let rays = [PhotoRays::new(&view.features, &world.camera)];
        let seen = JointObservations { direct: vec![matches], ..JointObservations::default() };
        let covariances = refine_jointly(&mut model, &world.scene(), &rays, &seen, true);
        let (center, rotation) = world.errors(0, &model.photos[0].world_from_camera);
        assert!(center < 0.03 && rotation < 0.1, "{center} {rotation}");
        let covariance = covariances[0].expect("fixed points leave nothing undetermined");
        assert!(covariance.trace() > 0.0 && covariance.trace() < 1e-3, "{covariance}");
    }

    /// A photo of an exact scene whose directions are stretched by these shares of xx and xz: the refined model, errors of centre and
    /// rotation in degrees, and the centre's standard deviation along its worst axis.
    fn refined_of_stretched(seed: u64, xx: f64, xz: f64, is_known: bool) -> (JointModel, [f64; 2], f64) {
        let mut world = World::chain(1, 0.0, seed);
        world.make_scene_exact();
        let matches = world.scene_matches(0);
        let stretch = Matrix3::new(1.0 + xx, 0.0, xz, 0.0, 1.0, 0.0, xz, 0.0, 1.0 - xx);
        let camera = world.camera.clone();
        for keypoint in &mut world.photos[0].features.keypoints {
            let plain = stretch.try_inverse().unwrap() * camera.unproject(&keypoint.pixel()).unwrap();
            let pixel = camera.project(&plain).unwrap();
            (keypoint.x, keypoint.y) = (pixel.x as f32, pixel.y as f32);
        }
        let view = &world.photos[0];
        let mut model = JointModel {
            cameras: vec![JointCamera::new(camera.clone(), is_known)],
            photos: vec![JointPhoto { camera: 0, world_from_camera: view.pose, standpoint: 0 }],
            points: Vec::new(),
            lengths: Vec::new(),
            stretch: PhotoStretch::default(),
        };
        let rays = [PhotoRays::new(&view.features, &camera)];
        let seen = JointObservations { direct: vec![matches], ..JointObservations::default() };
        let covariance = refine_jointly(&mut model, &world.scene(), &rays, &seen, true)[0].unwrap();
        let errors = world.errors(0, &model.photos[0].world_from_camera);
        (model, errors.into(), crate::verdict::standard_deviations(&covariance).1)
    }

    #[test]
    fn a_stretched_photo_is_told_by_its_residuals_and_a_plain_one_keeps_its_intrinsics() {
        for (xx, xz) in [(0.0, 0.0), (0.006, 0.0), (0.0, -0.006)] {
            let mut normalized = 0.0;
            for seed in 40..46 {
                let (model, [center, rotation], sigma) = refined_of_stretched(seed, xx, xz, true);
                assert_eq!(model.stretch.is_free, (xx, xz) != (0.0, 0.0), "{seed} {xx} {xz}");
                let shown = if model.stretch.is_free { 0.0045..0.0075 } else { 0.0..1e-9 };
                assert!(shown.contains(&model.stretch.largest), "{seed} {xx} {xz} {}", model.stretch.largest);
                assert!(rotation < 0.1, "{seed} {xx} {xz} {rotation}");
                normalized += (center / sigma).powi(2) / 6.0;
            }
            // By the worst axis at most one, and by three alike three.
            assert!(normalized < 4.0, "{xx} {xz} {normalized}");
        }
    }

    #[test]
    fn photos_whose_intrinsics_are_estimated_are_not_stretched() {
        assert!(!refined_of_stretched(34, 0.006, 0.0, false).0.stretch.is_free);
    }

    #[test]
    fn one_match_far_astray_does_not_stand_for_the_noise_of_all() {
        let trace = |off_px: f32| {
            let mut world = World::chain(1, 0.0, 32);
            world.make_scene_exact();
            let matches = world.scene_matches(0);
            world.photos[0].features.keypoints[matches[3].feature as usize].x += off_px;
            let view = &world.photos[0];
            let mut model = JointModel {
                cameras: vec![JointCamera::new(world.camera.clone(), true)],
                photos: vec![JointPhoto { camera: 0, world_from_camera: view.pose, standpoint: 0 }],
                points: Vec::new(),
                lengths: Vec::new(),
                stretch: PhotoStretch::default(),
            };
            let rays = [PhotoRays::new(&view.features, &world.camera)];
            let seen = JointObservations { direct: vec![matches], ..JointObservations::default() };
            refine_jointly(&mut model, &world.scene(), &rays, &seen, true)[0].expect("is determined").trace()
        };
        let ratio = trace(300.0) / trace(0.0);
        assert!((0.8..1.25).contains(&ratio), "{ratio}");
    }

    /// A chain of photos that see points of the scene, and others with one another: its length, and its refined model with a focal
    /// length that is told so many times too long.
    fn refined_chain(seed: u64, too_long: f64, with_covariance: bool) -> (f64, JointModel) {
        let world = World::chain(6, 0.0, seed);
        let told = world.camera.with_focal_times(too_long);
        let rays: Vec<PhotoRays<'_>> =
            world.photos.iter().map(|photo| PhotoRays::new(&photo.features, &told)).collect();
        let mut seen: BTreeMap<usize, Vec<(usize, u32)>> = BTreeMap::new();
        for (photo, view) in world.photos.iter().enumerate() {
            for (feature, shown) in (0..).zip(&view.shows) {
                if let Some(point) = shown.filter(|&point| !world.knows(point)) {
                    seen.entry(point).or_default().push((photo, feature));
                }
            }
        }
        seen.retain(|_, track| track.len() > 1);
        let sighting = |&(photo, feature): &(usize, u32)| {
            let place = rays[photo].place_of(feature);
            Sighting { photo, feature: Some(feature), place, keypoint_noise_px: place.noise_px }
        };
        let track =
            |(at, track): (usize, &Vec<_>)| track.iter().map(|seen| (at, sighting(seen))).collect::<Vec<_>>();
        let observed = JointObservations {
            direct: (0..world.photos.len()).map(|photo| world.scene_matches(photo)).collect(),
            tracks: seen.values().enumerate().flat_map(track).collect(),
            ..JointObservations::default()
        };
        let photo = |(slot, view): (usize, &crate::synthetic::View)| JointPhoto {
            camera: 0,
            world_from_camera: view.pose,
            standpoint: slot,
        };
        let mut model = JointModel {
            cameras: vec![JointCamera::new(told.clone(), true)],
            photos: world.photos.iter().enumerate().map(photo).collect(),
            points: seen.keys().map(|&point| world.position(point)).collect(),
            lengths: Vec::new(),
            stretch: PhotoStretch::default(),
        };
        let truth = length_of(&model);
        refine_jointly(&mut model, &world.scene(), &rays, &observed, with_covariance);
        (truth, model)
    }

    fn length_of(chain: &JointModel) -> f64 {
        let center = |slot: usize| chain.photos[slot].world_from_camera.translation;
        (center(5) - center(0)).norm()
    }

    #[test]
    fn a_focal_length_that_is_told_wrong_is_found_and_a_right_one_stays() {
        let found = |seed, too_long| {
            let (_, model) = refined_chain(seed, too_long, true);
            let JointCamera { camera, known } = &model.cameras[0];
            let kept = *known == KnownOfCamera::Intrinsics;
            assert_eq!(kept, !matches!(known, KnownOfCamera::AllButFocal(_)));
            assert!(!model.stretch.is_free, "{seed} {too_long}");
            (kept, camera.focal_length() / World::chain(1, 0.0, seed).camera.focal_length())
        };
        for seed in 600..606 {
            assert_eq!(found(seed, 1.0), (true, 1.0), "{seed}");
            for too_long in [0.97, 1.02] {
                let (kept, focal) = found(seed, too_long);
                assert!(!kept && (focal - 1.0).abs() < 0.004, "{seed} {too_long} {focal}");
            }
        }
    }

    /// Of all points whose depth is uncertain those that came out too near state the smaller deviation.
    #[test]
    fn points_of_uncertain_depth_do_not_shrink_a_set() {
        let log_length = |seed| {
            let (truth, model) = refined_chain(seed, 1.0, false);
            (length_of(&model) / truth).ln()
        };
        let found: Vec<f64> = (500..580).map(log_length).collect();
        let count = found.len() as f64;
        let mean = found.iter().sum::<f64>() / count;
        let variance = found.iter().map(|log| (log - mean).powi(2)).sum::<f64>() / (count - 1.0);
        assert!(variance.sqrt() < 0.0012, "{variance}");
        assert!(mean.abs() < 2.5 * (variance / count).sqrt(), "{mean} {variance}");
    }
}
