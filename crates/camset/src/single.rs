mod fit;

use nalgebra::{Matrix6, Vector3};
use setloc_features::Camera;
use setloc_index::{NearestPoints, SceneIndex};
use setloc_sfm::Rigid;
use setloc_sfm::robust::{RansacParams, estimate_absolute_pose};

use self::fit::{Fit, Sought};
pub(crate) use self::fit::{off_centre, shows_cut};
use crate::evidence::{PhotoRays, chance_of_inlier, log10_false_alarms, median, occupied_cells, same_pose};
use crate::guided::guided_matches;
use crate::misfit::Misfit;
use crate::refine::{JointModel, JointObservations, refine_jointly};
use crate::types::DOUBTFUL;
use crate::underfoot::{Ground, Underfoot};
use crate::verdict::{Evidence, MIN_OFF_GROUND, judge_precision, judge_support, weaker};
use crate::{
    PhotoLocalization, QueryPhoto, Scene, SceneMatch, SingleAnswer, SingleLocalization, SingleParams, Verdict,
};

/// Points in a minimal sample of P3P.
const SAMPLE: usize = 3;

/// A pose of one photo with everything that speaks for it.
struct SinglePose {
    camera: Camera,
    world_from_camera: Rigid,
    covariance: Option<Matrix6<f64>>,
    /// Inliers after guided matching.
    inliers: Vec<SceneMatch>,
    /// Median distance to the inliers' scene points.
    depth: f64,
    /// What the inliers' residuals have in common, if that is more than noise and scenes' own errors.
    misfit: Option<Misfit>,
    /// Whether it clearly shows another camera than it is told.
    is_contradicted: bool,
    /// Whether it may have been cut from the side of a larger picture.
    may_be_cut: bool,
    evidence: Evidence,
}

/// Localizes one photo alone, in one component.
///
/// 2D-to-3D matches pass a ratio test, LO-RANSAC with P3P finds the pose, scene points are then searched for near
/// their projections and the pose (with the intrinsics, when they are not known) is refined on all inliers.
/// (T. Sattler, B. Leibe, L. Kobbelt, "Fast image-based localization using direct 2D-to-3D matching", ICCV 2011.)
pub fn locate_single(
    params: &SingleParams,
    scene: &Scene<'_>,
    photo: &QueryPhoto<'_>,
    seed: u64,
) -> SingleLocalization {
    let nearest = scene.index.nearest_points(&photo.features.descriptors);
    let answer = locate_with_nearest(params, scene, photo, &nearest, seed);
    SingleLocalization { answer, nearest }
}

/// [`locate_single`] where the nearest scene points of all features are known.
pub(crate) fn locate_with_nearest(
    params: &SingleParams,
    scene: &Scene<'_>,
    photo: &QueryPhoto<'_>,
    nearest: &[NearestPoints],
    seed: u64,
) -> SingleAnswer {
    let refused = |photo| SingleAnswer { photo, inliers: Vec::new() };
    // Simulated views tie photos to each other, and help once a pose is known. Before, they add less to a scene of which
    // each point was seen from several sides than the chance matches of so many more features take away.
    let matches = own_matches(scene.index, photo, nearest, params.ratio);
    if matches.len() < params.verdict.min_inliers {
        let reason = format!(
            "{} of its features resemble a scene point, at least {} must",
            matches.len(),
            params.verdict.min_inliers
        );
        return refused(PhotoLocalization::not_localized(photo, scene.component, reason));
    }
    let ground = Ground::of_scene(scene);
    let Some(found) = solve(params, (scene, &ground), photo, nearest, &matches, seed) else {
        let reason = format!("no pose explains any of its {} matches to the scene", matches.len());
        return refused(PhotoLocalization::not_localized(photo, scene.component, reason));
    };
    let mut reasons = Vec::new();
    let mut verdict = judge_support(&params.verdict, &found.evidence, &mut reasons);
    if verdict == Verdict::NotLocalized {
        let mut answer = PhotoLocalization::not_localized(photo, scene.component, String::new());
        (answer.reasons, answer.inliers) = (reasons, found.evidence.inliers);
        return refused(answer);
    }
    verdict = weaker(
        verdict,
        judge_precision(&params.verdict, found.covariance.as_ref(), found.depth, &mut reasons),
    );
    if found.is_contradicted {
        reasons.push("other intrinsics than it is told explain its matches clearly better".to_owned());
        verdict = weaker(verdict, Verdict::Uncertain);
    }
    if found.may_be_cut {
        reasons.push(
            "it may have been cut from the side of a larger picture: that explains its matches as well"
                .to_owned(),
        );
        verdict = weaker(verdict, Verdict::Uncertain);
    }
    if let Some(misfit) = &found.misfit {
        reasons.push(misfit.to_string());
        verdict = weaker(verdict, Verdict::Uncertain);
    }
    if scene.is_doubtful(found.inliers.iter().map(|seen| seen.point)) {
        reasons.push(DOUBTFUL.to_owned());
        verdict = weaker(verdict, Verdict::Uncertain);
    }
    let answer = PhotoLocalization {
        name: photo.name.to_owned(),
        camera: found.camera,
        component: scene.component,
        world_from_camera: Some(found.world_from_camera),
        covariance: found.covariance,
        inliers: found.inliers.len(),
        verdict,
        reasons,
    };
    SingleAnswer { photo: answer, inliers: found.inliers }
}

/// What a photo's own features, without their simulated views, are matched with by the ratio test.
pub(crate) fn own_matches(
    index: &SceneIndex,
    photo: &QueryPhoto<'_>,
    nearest: &[NearestPoints],
    ratio: f64,
) -> Vec<SceneMatch> {
    let found = index.correspondences(&nearest[..photo.features.own_len()], ratio);
    found.into_iter().map(|c| SceneMatch { feature: c.feature, point: c.point }).collect()
}

fn solve(
    params: &SingleParams,
    (scene, ground): (&Scene<'_>, &Ground),
    photo: &QueryPhoto<'_>,
    nearest: &[NearestPoints],
    matches: &[SceneMatch],
    seed: u64,
) -> Option<SinglePose> {
    let Fit { mut model, agreeing, is_contradicted, may_be_cut, .. } =
        Sought { params, scene, ground, photo, matches, seed }.fit(nearest)?;
    let (camera, pose) = (model.camera_of(0).clone(), model.photos[0].world_from_camera);
    let rays = PhotoRays::new(photo.features, &camera);
    let depth =
        median(agreeing.iter().map(|m| (scene.index.position(m.point) - pose.translation).norm()).collect())?;
    let rest: Vec<SceneMatch> = matches.iter().copied().filter(|m| !agreeing.contains(m)).collect();
    let worth = |matches: &[SceneMatch]| matches.iter().map(|m| ground.worth(m.point)).sum::<f64>();
    let rivals = runner_up(params, scene.index, &rays, &rest, &pose, depth, seed);
    let chance = chance_of_inlier(&rays, scene.index, &pose, &agreeing, params.max_error_sigmas);
    let seen: Vec<(Vector3<f64>, Vector3<f64>)> =
        agreeing.iter().map(|m| (pose.translation, scene.index.position(m.point))).collect();
    let off_ground =
        Underfoot::of_scene(scene).map_or(seen.len(), |underfoot| underfoot.count_elsewhere(&seen));
    let mut evidence = Evidence {
        matches: matches.len(),
        inliers: agreeing.len(),
        sample: SAMPLE,
        log10_false_alarms: log10_false_alarms(matches.len(), agreeing.len(), SAMPLE, chance),
        cells: occupied_cells(&rays, agreeing.iter().map(|m| m.feature)),
        runner_up: rivals.len(),
        runner_up_share: worth(&rivals) / worth(&agreeing),
        off_ground,
        shown: 0,
    };
    if agreeing.len() < params.verdict.min_inliers {
        return Some(SinglePose {
            camera,
            world_from_camera: pose,
            covariance: None,
            inliers: agreeing,
            depth,
            misfit: None,
            is_contradicted,
            may_be_cut,
            evidence,
        });
    }
    let guided = guided_matches(&params.guided, scene.index, &rays, nearest, &pose);
    let candidates = union(&agreeing, &guided);
    // Where nearly all matches lie on one plane, the few that were found beyond it may tell another pose nearby.
    if let Some(other) = estimate(params, scene.index, &rays, &candidates, seed ^ 0x9a1d)
        && score(params, (scene.index, ground), &rays, &other, &candidates)
            > score(params, (scene.index, ground), &rays, &pose, &candidates)
    {
        model.photos[0].world_from_camera = other;
    }
    let covariance = refine(&mut model, scene, photo, &candidates, params.max_error_sigmas, true);
    let (camera, pose) = (model.camera_of(0).clone(), model.photos[0].world_from_camera);
    let rays = PhotoRays::new(photo.features, &camera);
    let inliers = inliers(&rays, scene.index, &pose, &candidates, params.max_error_sigmas);
    if evidence.off_ground < MIN_OFF_GROUND
        && let Some(underfoot) = Underfoot::of_scene(scene)
    {
        let shown = |slide: &Vector3<f64>| {
            let aside = Rigid::new(pose.rotation, pose.translation + slide);
            guided_matches(&params.guided, scene.index, &rays, nearest, &aside)
        };
        let found = ground.count_off(&shown(&Vector3::zeros()));
        if underfoot.log10_chance_elsewhere(ground, depth, found, shown).is_some() {
            evidence.off_ground = evidence.off_ground.max(found);
        }
    }
    let misfit = Misfit::of(&rays, scene.index, &pose, &inliers).filter(Misfit::is_clear);
    Some(SinglePose {
        camera,
        world_from_camera: pose,
        covariance,
        inliers,
        depth,
        misfit,
        is_contradicted,
        may_be_cut,
        evidence,
    })
}

/// Refines the one photo of `model` on the matches that agree with it, twice, so that new inliers join.
fn refine(
    model: &mut JointModel,
    scene: &Scene<'_>,
    photo: &QueryPhoto<'_>,
    matches: &[SceneMatch],
    max_error_sigmas: f64,
    with_covariance: bool,
) -> Option<Matrix6<f64>> {
    let index = scene.index;
    let mut covariance = None;
    for last in [false, true] {
        let camera = model.camera_of(0).clone();
        let rays = PhotoRays::new(photo.features, &camera);
        let agreeing = inliers(&rays, index, &model.photos[0].world_from_camera, matches, max_error_sigmas);
        if agreeing.len() <= SAMPLE {
            return None;
        }
        let seen = JointObservations { direct: vec![agreeing], ..JointObservations::default() };
        let covariances = refine_jointly(model, scene, &[rays], &seen, last && with_covariance);
        covariance = covariances.into_iter().next().flatten();
    }
    covariance
}

pub(crate) fn inliers(
    rays: &PhotoRays<'_>,
    index: &SceneIndex,
    pose: &Rigid,
    matches: &[SceneMatch],
    max_error_sigmas: f64,
) -> Vec<SceneMatch> {
    matches.iter().copied().filter(|&m| rays.error_sigmas(index, pose, m) < max_error_sigmas).collect()
}

/// First list, then those of the second whose feature and point are both new; sorted.
pub(crate) fn union(first: &[SceneMatch], second: &[SceneMatch]) -> Vec<SceneMatch> {
    let mut all = first.to_vec();
    let features: std::collections::BTreeSet<u32> = first.iter().map(|m| m.feature).collect();
    let points: std::collections::BTreeSet<_> = first.iter().map(|m| m.point).collect();
    all.extend(second.iter().filter(|m| !features.contains(&m.feature) && !points.contains(&m.point)));
    all.sort_unstable();
    all
}

fn ransac(params: &SingleParams) -> RansacParams {
    let max_iterations = params.max_samples.max(1);
    RansacParams {
        max_error_sigma: params.max_error_sigmas,
        max_iterations,
        min_iterations: RansacParams::default().min_iterations.min(max_iterations),
        ..RansacParams::default()
    }
}

fn estimate(
    params: &SingleParams,
    index: &SceneIndex,
    rays: &PhotoRays<'_>,
    matches: &[SceneMatch],
    seed: u64,
) -> Option<Rigid> {
    let usable: Vec<SceneMatch> =
        matches.iter().copied().filter(|m| rays.rays.sigmas[m.feature as usize].is_finite()).collect();
    if usable.len() <= SAMPLE {
        return None;
    }
    let bearings: Vec<Vector3<f64>> = usable.iter().map(|m| rays.rays.bearings[m.feature as usize]).collect();
    let sigmas: Vec<f64> = usable.iter().map(|m| rays.rays.sigmas[m.feature as usize]).collect();
    let points: Vec<Vector3<f64>> = usable.iter().map(|m| index.position(m.point)).collect();
    estimate_absolute_pose(&ransac(params), &bearings, &sigmas, &points, seed)
        .map(|found| found.world_from_camera)
}

/// Σ w (1 − min(1, (e/T)²)) over the matches, each as much as it is worth.
fn score(
    params: &SingleParams,
    (index, ground): (&SceneIndex, &Ground),
    rays: &PhotoRays<'_>,
    pose: &Rigid,
    matches: &[SceneMatch],
) -> f64 {
    let gain = |&m: &SceneMatch| {
        let error = (rays.error_sigmas(index, pose, m) / params.max_error_sigmas).min(1.0);
        ground.worth(m.point) * (1.0 - error.powi(2))
    };
    matches.iter().map(gain).sum()
}

/// What supports the best pose that the remaining matches give, when it is another pose.
fn runner_up(
    params: &SingleParams,
    index: &SceneIndex,
    rays: &PhotoRays<'_>,
    rest: &[SceneMatch],
    best: &Rigid,
    depth: f64,
    seed: u64,
) -> Vec<SceneMatch> {
    match estimate(params, index, rays, rest, seed ^ 0x5eed) {
        Some(pose) if !same_pose(&pose, best, depth) => {
            inliers(rays, index, &pose, rest, params.max_error_sigmas)
        }
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector2};
    use setloc_features::{Calibration, CameraModel};

    use crate::synthetic::{World, along_street};

    fn locate(world: &World, photo: usize) -> PhotoLocalization {
        locate_single(&SingleParams::default(), &world.scene(), &world.queries()[photo], 3).answer.photo
    }

    #[test]
    fn a_photo_beside_the_panoramas_is_localized_and_one_far_away_is_refused() {
        let world = World::chain(9, 0.3, 1);
        let near = locate(&world, 0);
        assert_eq!(near.verdict, Verdict::Localized, "{near:#?}");
        let (center, rotation) = world.errors(0, &near.world_from_camera.unwrap());
        assert!(center < 0.03 && rotation < 0.1, "{center} {rotation}");
        assert!(near.inliers > 100);
        let far = locate(&world, 8);
        assert_eq!(far.verdict, Verdict::NotLocalized, "{far:#?}");
        assert!(far.world_from_camera.is_none() && !far.reasons.is_empty());
    }

    #[test]
    fn a_picture_cut_from_a_larger_one_shows_it_where_its_set_has_it_turned_instead() {
        for seed in 1..4 {
            let mut world = World::chain(1, 0.2, seed);
            let matches = world.scene_matches(0);
            let shows = |world: &World, aside_px: f64| {
                let view = &world.photos[0];
                let camera = Camera::from_focal_guess(
                    world.camera.width,
                    world.camera.height,
                    world.camera.focal_length(),
                );
                let turn =
                    UnitQuaternion::from_axis_angle(&Vector3::y_axis(), aside_px / camera.focal_length());
                let pose = Rigid::new(view.pose.rotation * turn.inverse(), view.pose.translation);
                let calibration = Calibration::Guessed;
                let photo = QueryPhoto { name: "", camera: &camera, calibration, features: &view.features };
                let scene = world.scene();
                shows_cut(4.0, (&scene, &Ground::of_scene(&scene)), &photo, &matches, (&camera, &pose))
            };
            assert_eq!(shows(&world, 0.0), None, "{seed}");
            let aside_px = 0.1 * f64::from(world.camera.width);
            for keypoint in &mut world.photos[0].features.keypoints {
                keypoint.x += aside_px as f32;
            }
            let aside = shows(&world, aside_px).unwrap_or_else(|| panic!("{seed}"));
            assert!((aside - Vector2::new(0.1, 0.0)).amax() < 0.03, "{seed}: {aside}");
        }
    }

    #[test]
    fn centre_errors_fit_the_covariance() {
        let (mut squared, mut count) = (0.0, 0);
        for seed in 20..30 {
            let world = World::chain(4, 0.2, seed);
            for photo in 0..2 {
                let found = locate(&world, photo);
                let (pose, covariance) = (found.world_from_camera.unwrap(), found.covariance.unwrap());
                let error = pose.translation - world.photos[photo].pose.translation;
                let information = covariance.fixed_view::<3, 3>(3, 3).into_owned().try_inverse().unwrap();
                squared += error.dot(&(information * error)) / 3.0;
                count += 1;
            }
        }
        let mean = squared / f64::from(count);
        assert!((0.4..1.8).contains(&mean), "{mean}");
    }

    #[test]
    fn an_unknown_focal_length_is_found() {
        let world = World::chain(2, 0.2, 11);
        let mut guess = world.camera.clone();
        guess.params[0] = 640.0;
        guess.params[1] = 640.0;
        let query = QueryPhoto { camera: &guess, calibration: Calibration::Guessed, ..world.queries()[0] };
        let found = locate_single(&SingleParams::default(), &world.scene(), &query, 5).answer.photo;
        assert!((found.camera.params[0] / 800.0 - 1.0).abs() < 0.01, "{:?}", found.camera.params);
        let (center, rotation) = world.errors(0, &found.world_from_camera.unwrap());
        assert!(center < 0.1 && rotation < 0.2, "{center} {rotation}");
    }

    #[test]
    fn a_focal_length_that_is_told_wrong_is_found_and_the_right_one_stays() {
        for (seed, factor) in [(11, 1.0), (11, 0.97), (12, 1.1), (13, 0.9)] {
            let world = World::chain(2, 0.2, seed);
            let told = world.camera.with_focal_times(factor);
            let query = QueryPhoto { camera: &told, calibration: Calibration::Known, ..world.queries()[0] };
            let locate =
                |params: &SingleParams| locate_single(params, &world.scene(), &query, 5).answer.photo;
            let found = locate(&SingleParams::default());
            assert_eq!(found.verdict, Verdict::Localized, "{found:#?}");
            assert_eq!(found.camera == told, factor == 1.0, "{factor} {:?}", found.camera.params);
            assert!((found.camera.params[0] / 800.0 - 1.0).abs() < 0.01, "{:?}", found.camera.params);
            let (center, rotation) = world.errors(0, &found.world_from_camera.unwrap());
            assert!(center < 0.1 && rotation < 0.2, "{factor}: {center} {rotation}");
            let kept = locate(&SingleParams { check_intrinsics: false, ..SingleParams::default() });
            assert!(kept.camera == told, "{kept:#?}");
        }
    }

    #[test]
    fn a_picture_cut_from_a_larger_one_is_known_by_its_matches() {
        for (seed, known) in [(11, false), (12, false), (13, false), (11, true), (12, true)] {
            let mut world = World::chain(2, 0.2, seed);
            // What is left of its picture without three tenths on the left and a quarter below.
            let (left, below) = (0.3 * f64::from(world.camera.width), 0.25 * f64::from(world.camera.height));
            for keypoint in &mut world.photos[0].features.keypoints {
                keypoint.x -= left as f32;
            }
            let width = world.camera.width - left as u32;
            let height = world.camera.height - below as u32;
            let camera = if known {
                let middle = [f64::from(width) / 2.0, f64::from(height) / 2.0];
                let params = vec![800.0, 800.0, middle[0], middle[1]];
                Camera { model: CameraModel::Pinhole, width, height, params }
            } else {
                Camera::from_focal_guess(width, height, 1.2 * f64::from(width))
            };
            let calibration = if known { Calibration::Known } else { Calibration::Guessed };
            let query = QueryPhoto { camera: &camera, calibration, ..world.queries()[0] };
            let found = locate_single(&SingleParams::default(), &world.scene(), &query, 5).answer.photo;
            if known {
                assert_ne!(found.verdict, Verdict::Localized, "{found:#?}");
                continue;
            }
            assert_eq!(found.verdict, Verdict::Localized, "{found:#?}");
            let truth = &world.camera.params;
            let off = (found.camera.params[1] - (truth[2] - left)).hypot(found.camera.params[2] - truth[3]);
            assert!(off < 10.0, "{off} {:?}", found.camera);
            let (center, rotation) = world.errors(0, &found.world_from_camera.unwrap());
            assert!(center < 0.1 && rotation < 0.5, "{center} {rotation}");
        }
    }

    #[test]
    fn an_unknown_fisheye_is_told_from_other_lenses() {
        let place = crate::synthetic::Place::street(3500, 13);
        let world = World::new(&place, &[], 0.2, 13);
        let pose = along_street(Vector3::new(0.7, -1.5, 20.0), 0.05);
        let photo = |camera: &Camera| {
            let view = place.view(camera, pose, 0.2, 20, 13_200);
            let guess = Camera::from_focal_guess(1200, 900, 1440.0);
            let (name, calibration) = ("photo", Calibration::Guessed);
            let query = QueryPhoto { name, camera: &guess, calibration, features: &view.features };
            let found = locate_single(&SingleParams::default(), &world.scene(), &query, 5).answer.photo;
            assert_eq!(found.verdict, Verdict::Localized, "{found:#?}");
            let found_pose = found.world_from_camera.unwrap();
            let off = (found_pose.translation - pose.translation).norm();
            assert!(off < 0.1, "{off}");
            found.camera
        };
        let params = vec![400.0, 400.0, 600.0, 450.0, 0.02, -0.005, 0.0, 0.0];
        let wide = photo(&Camera { model: CameraModel::OpencvFisheye, width: 1200, height: 900, params });
        assert_eq!(wide.model, CameraModel::OpencvFisheye);
        assert!((wide.focal_length() / 400.0 - 1.0).abs() < 0.01, "{wide:?}");
        assert_eq!(photo(&world.camera).model, CameraModel::Radial);
    }

    #[test]
    fn foreign_and_empty_photos_are_refused() {
        let world = World::chain(2, 0.2, 12);
        for seed in 0..10 {
            let elsewhere = World::chain(2, 0.2, 200 + seed);
            let query = &elsewhere.queries()[0];
            let found = locate_single(&SingleParams::default(), &world.scene(), query, seed);
            assert_eq!(found.answer.photo.verdict, Verdict::NotLocalized);
            assert!(found.answer.inliers.is_empty());
        }
        let empty = setloc_features::ImageFeatures::default();
        let query = QueryPhoto { features: &empty, ..world.queries()[0] };
        let found = locate_single(&SingleParams::default(), &world.scene(), &query, 1);
        assert_eq!(found.answer.photo.verdict, Verdict::NotLocalized);
    }
}
