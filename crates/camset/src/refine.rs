//! Bundle problems over photos in a scene whose cameras stay fixed.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector2, Vector3};
use setloc_features::Camera;
use setloc_index::SceneIndex;
use setloc_sfm::bundle::{
    self, BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, CameraPrior,
    IntrinsicsFreedom, LengthRatio, RobustLoss,
};
use setloc_sfm::{ImageId, Place, PointId, Rigid, WallSight};

use crate::common::{CommonErrors, PoseError, shift_of_point};
use crate::common_turn::CommonTurn;
use crate::evidence::{PhotoRays, ray_error_sigmas};
use crate::jackknife::honest_covariances;
use crate::scene_errors::HeldByScene;
use crate::stretch::{Freed, PhotoStretch};
use crate::{Scene, SceneMatch};

/// Scale of the robust loss in standard deviations: at one deviation an observation has half its weight, at four (an
/// inlier still) a seventeenth, so leftovers among the matches hardly pull.
const LOSS_SCALE: f64 = 1.0;

/// Cameras from which on photos may have zooms of any focal length, and the photos to each that speak for fewer.
const MANY_CAMERAS: usize = 4;
const MANY_PHOTOS: usize = 3;

/// Photos, their cameras and the local points between them, all in the scene's frame.
#[derive(Debug, Clone)]
pub(crate) struct JointModel {
    pub cameras: Vec<JointCamera>,
    pub photos: Vec<JointPhoto>,
    pub points: Vec<Vector3<f64>>,
    /// Lengths of baselines that the points do not tell, between slots of photos.
    pub lengths: Vec<([usize; 3], LengthRatio)>,
    /// What directions of photos of known intrinsics differ by from these.
    pub stretch: PhotoStretch,
}

/// A camera of a joint model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct JointCamera {
    pub camera: Camera,
    pub known: KnownOfCamera,
}

/// What is known of a camera beside what the adjustment finds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum KnownOfCamera {
    /// Its intrinsics: they stay.
    Intrinsics,
    /// Nothing but what holds for usual photos.
    Usual,
    /// That it differs from this one by little.
    Alike(Camera),
    /// Its intrinsics but for the focal lengths, which are near this one's.
    AllButFocal(Camera),
}

impl JointCamera {
    pub fn new(camera: Camera, is_known: bool) -> Self {
        Self { camera, known: if is_known { KnownOfCamera::Intrinsics } else { KnownOfCamera::Usual } }
    }

    fn is_known(&self) -> bool {
        self.known == KnownOfCamera::Intrinsics
    }

    fn freedom(&self) -> IntrinsicsFreedom {
        match self.known {
            KnownOfCamera::Intrinsics => IntrinsicsFreedom::FIXED,
            KnownOfCamera::Usual | KnownOfCamera::Alike(_) => IntrinsicsFreedom::FREE,
            KnownOfCamera::AllButFocal(_) => IntrinsicsFreedom { focal: true, ..IntrinsicsFreedom::FIXED },
        }
    }

    /// `None` for panoramas, which have nothing to estimate.
    fn prior(&self, index: u32) -> Option<CameraPrior> {
        match &self.known {
            KnownOfCamera::Alike(alike) => CameraPrior::alike(index, alike),
            KnownOfCamera::AllButFocal(near) => Some(CameraPrior::told(index, near)),
            KnownOfCamera::Intrinsics | KnownOfCamera::Usual => {
                CameraPrior::of_usual_photo(index, &self.camera)
            }
        }
    }
}

impl JointModel {
    pub fn camera_of(&self, slot: usize) -> &Camera {
        &self.cameras[self.photos[slot].camera].camera
    }

    /// Gives photos that share a camera which is not known one each, alike the one that they have, where hardly two photos have
    /// one: a zoom has any focal length, and those that are not told apart need not be one.
    pub fn give_own_cameras_where_many(&mut self) {
        let mut photos_of: BTreeMap<usize, usize> = BTreeMap::new();
        for photo in &self.photos {
            if self.cameras[photo.camera].known == KnownOfCamera::Usual {
                *photos_of.entry(photo.camera).or_default() += 1;
            }
        }
        let photos: usize = photos_of.values().sum();
        if photos_of.len() < MANY_CAMERAS || photos >= MANY_PHOTOS * photos_of.len() {
            return;
        }
        photos_of.retain(|_, photos| *photos > 1);
        for photo in self.photos.iter_mut().filter(|photo| photos_of.contains_key(&photo.camera)) {
            let camera = self.cameras[photo.camera].camera.clone();
            photo.camera = self.cameras.len();
            self.cameras.push(JointCamera { known: KnownOfCamera::Alike(camera.clone()), camera });
        }
        // No photo has them any more: nothing to estimate.
        for camera in photos_of.into_keys() {
            self.cameras[camera].known = KnownOfCamera::Intrinsics;
        }
    }
}

/// One photo of a joint model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct JointPhoto {
    /// Index into [`JointModel::cameras`].
    pub camera: usize,
    pub world_from_camera: Rigid,
    /// Slot of the first photo that was taken from the same centre (its own when there is no other).
    ///
    /// Photos of one standpoint keep their turns and move together: what they share tells nothing of their distance.
    pub standpoint: usize,
}

/// A place in a photo where it shows a local point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sighting {
    /// Slot of the photo.
    pub photo: usize,
    /// The keypoint, where one belongs to the point.
    pub feature: Option<u32>,
    /// The place, in pixels, with its standard deviation against the other places of the point.
    pub place: Place,
    /// Standard deviation of a keypoint of the point in this photo, in pixels.
    pub keypoint_noise_px: f64,
}

/// What photos see.
#[derive(Debug, Clone, Default)]
pub(crate) struct JointObservations {
    /// Scene points that each photo sees by a keypoint.
    pub direct: Vec<Vec<SceneMatch>>,
    /// Aligned local points that are scene points. Keypoints that they hold do not count in `direct` again.
    pub tied: Vec<TiedPoint>,
    /// Free local points, by their index, and where they are seen.
    pub tracks: Vec<(usize, Sighting)>,
    /// Free local points, by their index, and where images of the scene show them.
    pub views: Vec<(usize, SceneView)>,
    /// Spots of the scene's walls.
    pub walls: Vec<WallSight>,
}

/// A place in an image of the scene.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SceneView {
    pub image: ImageId,
    pub place: Place,
}

/// A local point that is a scene point.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TiedPoint {
    pub scene: PointId,
    /// Where the photos show it.
    pub seen: Vec<Sighting>,
    /// Covariance of the spot that they show about the scene's, in the scene's frame.
    pub spot: Matrix3<f64>,
}

/// Moves photos and local points (the paper's T_OPT), scene points within what the scene knows of them; returns
/// covariances of the poses if asked.
///
/// Cameras that are not known are estimated, from what holds for usual photos on; where covariances are asked for, photos of known
/// ones are stretched if that spares more than noise would ([`crate::stretch`]). Poses of fewer than three observations stay where
/// they are.
pub(crate) fn refine_jointly(
    model: &mut JointModel,
    scene: &Scene<'_>,
    rays: &[PhotoRays<'_>],
    observed: &JointObservations,
    with_covariance: bool,
) -> Vec<Option<Matrix6<f64>>> {
    let standpoints = Standpoints::new(&model.photos);
    let mut builder = Builder {
        points: model.points.iter().map(|&position| BundlePoint { position, fixed: false }).collect(),
        observations: Vec::new(),
        origins: Vec::new(),
        seen: vec![0; model.photos.len()],
        priors: Vec::new(),
        photos: &model.photos,
        standpoints: &standpoints,
        rays,
    };
    builder.add_all(scene.index, observed);
    let Builder { points, mut observations, mut origins, seen, priors, .. } = builder;
    let camera_freedom = model.cameras.iter().map(JointCamera::freedom).collect();
    let prior = |(at, camera): (usize, &JointCamera)| camera.prior(at as u32);
    let camera_priors = model.cameras.iter().enumerate().filter_map(prior).collect();
    let mut poses: Vec<BundlePose> = model
        .photos
        .iter()
        .zip(&seen)
        .enumerate()
        .map(|(slot, (photo, &seen))| BundlePose {
            camera: if standpoints.shared[slot] { model.cameras.len() } else { photo.camera } as u32,
            world_from_camera: photo.world_from_camera,
            fixed: seen < 3,
        })
        .collect();
    let mut cameras: Vec<Camera> = model.cameras.iter().map(|known| known.camera.clone()).collect();
    cameras.push(sphere());
    let (mut common, mut held) = (CommonErrors::default(), HeldByScene::default());
    for &ScenePrior { point, scene_point, ref covariance } in &priors {
        let shift = scene_point.and_then(|point| shift_of_point(scene, point));
        for prior in prior_bearings(&points[point as usize].position, covariance) {
            let pose = poses.len() as u32;
            let camera = model.cameras.len() as u32;
            common.far.extend(shift.map(|shift| (pose, shift)));
            if let Some(point) = scene_point {
                held.far.entry(point).or_default().push(pose);
            }
            poses.push(BundlePose { camera, world_from_camera: prior.world_from_camera, fixed: true });
            let PriorBearing { pixel, noise_px, .. } = prior;
            observations.push(BundleObservation { pose, point, pixel, noise_px });
            origins.push(Origin::Far);
        }
    }
    let mut pose_of_view: BTreeMap<ImageId, u32> = BTreeMap::new();
    for (point, view) in &observed.views {
        let seen_by = &scene.reconstruction.images[view.image.index()];
        let Some(world_from_camera) = seen_by.world_from_camera else { continue };
        let camera = scene.reconstruction.camera_of(view.image);
        let error = PoseError::of_image(scene, view.image);
        let pose = *pose_of_view.entry(view.image).or_insert_with(|| {
            let pose = poses.len() as u32;
            poses.push(BundlePose { camera: cameras.len() as u32, world_from_camera, fixed: true });
            cameras.push(camera.clone());
            common.views.extend(error.map(|error| (pose, error)));
            pose
        });
        let Place { pixel, mut noise_px } = view.place;
        if let (Some(error), Some(angle)) = (error, camera.pixel_angle(&pixel)) {
            noise_px = noise_px.hypot(error.angular_sigma(&points[*point].position) / angle);
        }
        observations.push(BundleObservation { pose, point: *point as u32, pixel, noise_px });
        origins.push(Origin::Scene);
    }
    held.views = pose_of_view.into_iter().map(|(image, pose)| (pose, image)).collect();
    let mut problem = BundleProblem {
        cameras,
        camera_freedom,
        camera_priors,
        poses,
        points,
        observations,
        ..BundleProblem::default()
    };
    for (slots, length) in &model.lengths {
        problem.hold_length(slots.map(|slot| standpoints.lead[slot] as u32), *length);
    }
    let params = BundleParams { loss: RobustLoss::Cauchy(LOSS_SCALE), ..BundleParams::default() };
    // Poses of standpoints all of whose photos are known.
    let mut slots: Vec<usize> =
        (0..model.photos.len()).filter(|&slot| standpoints.lead[slot] == slot && seen[slot] >= 3).collect();
    for photo in model.photos.iter().filter(|photo| !model.cameras[photo.camera].is_known()) {
        slots.retain(|&slot| slot != photo.standpoint);
    }
    if model.stretch.is_free {
        let freed = Freed::new(&mut problem, &standpoints.sphere, &slots);
        bundle::solve(&params, &mut problem);
        model.stretch.note(&problem, &freed);
    } else {
        let as_told = bundle::solve(&params, &mut problem);
        if with_covariance && !slots.is_empty() {
            let mut stretched = problem.clone();
            let freed = Freed::new(&mut stretched, &standpoints.sphere, &slots);
            let report = bundle::solve(&params, &mut stretched);
            if model.stretch.is_worth(&freed, as_told.final_cost, report.final_cost) {
                problem = stretched;
                model.stretch.note(&problem, &freed);
            }
        }
    }
    let mut of_leads = vec![None; model.photos.len()];
    if with_covariance {
        leave_out_strays(&mut problem, &mut origins);
        state_real_noise(&mut problem, &origins, priors.len());
        bundle::solve(&params, &mut problem);
        let photos = model.photos.len();
        of_leads = honest_covariances(&params, &mut problem, photos, |problem, loss| {
            covariances(problem, photos, loss)
        });
        let considered =
            [common.spread(&params, &problem, photos), held.spread(scene, &params, &problem, photos)];
        for added in considered.into_iter().flatten() {
            for (covariance, added) in of_leads.iter_mut().zip(added) {
                *covariance = covariance.map(|own| own + added);
            }
        }
    }
    for (JointCamera { camera, .. }, refined) in model.cameras.iter_mut().zip(&problem.cameras) {
        camera.clone_from(refined);
    }
    for (slot, photo) in model.photos.iter_mut().enumerate() {
        let lead = problem.poses[photo.standpoint].world_from_camera;
        photo.world_from_camera = Rigid::new(lead.rotation * standpoints.turn[slot], lead.translation);
    }
    for (point, refined) in model.points.iter_mut().zip(&problem.points) {
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

/// What an observation ties a photo to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Origin {
    /// A scene point, by a keypoint.
    Scene,
    /// Other photos of the set.
    Local,
    /// What the scene knows of a point.
    Far,
}

/// A point of a bundle problem that is a scene point, and what the scene knows of it.
struct ScenePrior {
    point: u32,
    /// `None` of a spot of a wall.
    scene_point: Option<PointId>,
    covariance: Matrix3<f64>,
}

/// Collects the points and observations of a bundle problem.
struct Builder<'a> {
    points: Vec<BundlePoint>,
    observations: Vec<BundleObservation>,
    origins: Vec<Origin>,
    /// Observations of each photo's standpoint.
    seen: Vec<usize>,
    priors: Vec<ScenePrior>,
    photos: &'a [JointPhoto],
    standpoints: &'a Standpoints,
    rays: &'a [PhotoRays<'a>],
}

impl Builder<'_> {
    fn add_all(&mut self, index: &SceneIndex, observed: &JointObservations) {
        let mut held = BTreeSet::new();
        for tied in &observed.tied {
            let point = self.add_scene_point(index, tied.scene, &tied.spot);
            for seen in &tied.seen {
                self.observe(seen.photo, &seen.place, point, Origin::Local);
                held.extend(seen.feature.map(|feature| (seen.photo, feature)));
            }
        }
        let mut scene_points: BTreeMap<PointId, u32> = BTreeMap::new();
        for (slot, matches) in observed.direct.iter().enumerate() {
            for found in matches.iter().filter(|found| !held.contains(&(slot, found.feature))) {
                let point = *scene_points
                    .entry(found.point)
                    .or_insert_with(|| self.add_scene_point(index, found.point, &Matrix3::zeros()));
                self.observe(slot, &self.rays[slot].place_of(found.feature), point, Origin::Scene);
            }
        }
        for &WallSight { photo, place, position, covariance } in &observed.walls {
            let point = self.points.len() as u32;
            self.points.push(BundlePoint { position, fixed: false });
            self.priors.push(ScenePrior { point, scene_point: None, covariance });
            self.observe(photo, &place, point, Origin::Scene);
        }
        for (point, seen) in &observed.tracks {
            self.observe(seen.photo, &seen.place, *point as u32, Origin::Local);
        }
    }

    /// `spot` is what else is uncertain of the place that is observed.
    fn add_scene_point(&mut self, index: &SceneIndex, scene_point: PointId, spot: &Matrix3<f64>) -> u32 {
        let (position, covariance) =
            (index.position(scene_point), index.position_covariance(scene_point) + spot);
        let point = self.points.len() as u32;
        // An exact point has no bearings that hold it.
        let fixed = covariance == Matrix3::zeros();
        self.points.push(BundlePoint { position, fixed });
        if !fixed {
            self.priors.push(ScenePrior { point, scene_point: Some(scene_point), covariance });
        }
        point
    }

    fn observe(&mut self, slot: usize, place: &Place, point: u32, origin: Origin) {
        let photo = &self.photos[slot];
        self.seen[photo.standpoint] += 1;
        if let Some(observation) = self.standpoints.observation(self.rays, slot, place, point) {
            self.observations.push(observation);
            self.origins.push(origin);
        }
    }
}

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
fn leave_out_strays(problem: &mut BundleProblem, origins: &mut Vec<Origin>) {
    let is_stray =
        |seen: &BundleObservation| error_sigmas(problem, seen).is_none_or(|error| error > STRAY_SIGMAS);
    let kept: Vec<(BundleObservation, Origin)> = (problem.observations.iter().zip(origins.iter()))
        .filter(|(seen, origin)| **origin == Origin::Far || !is_stray(seen))
        .map(|(seen, origin)| (*seen, *origin))
        .collect();
    (problem.observations, *origins) = kept.into_iter().unzip();
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
/// right ones lose by it. `origins` are those of the observations, `scene_points` the number of points with far
/// bearings.
fn state_real_noise(problem: &mut BundleProblem, origins: &[Origin], scene_points: usize) {
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
    // Three far bearings say as much as three coordinates.
    let coordinates = 3.0 * scene_points as f64;
    let freedom = freedom - 2.0 * count(Origin::Far) + coordinates;
    // The coordinates of scene points that only keypoints see are unknowns too; those of the others are known from the
    // set itself.
    let of_points = |wanted: Origin| {
        let observations = problem.observations.iter().zip(origins);
        observations
            .filter(|(_, origin)| **origin == wanted)
            .map(|(observation, _)| observation.point)
            .collect::<BTreeSet<u32>>()
    };
    let by_keypoints = of_points(Origin::Far).difference(&of_points(Origin::Local)).count() as f64;
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

/// Covariance of a pose whose camera is turned: R·Exp(ω)·T = R·T·Exp(Tᵀω), and the centre is the same.
fn turned(covariance: &Matrix6<f64>, turn: &UnitQuaternion<f64>) -> Matrix6<f64> {
    let mut jacobian = Matrix6::identity();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(turn.inverse().to_rotation_matrix().matrix());
    jacobian * covariance * jacobian.transpose()
}

/// Which photos share a centre, and how they are turned against the first of them.
struct Standpoints {
    /// Slot of each photo's first.
    lead: Vec<usize>,
    /// Turn from each photo's frame into that of its first.
    turn: Vec<UnitQuaternion<f64>>,
    /// Whether a photo shares its centre with another.
    shared: Vec<bool>,
    sphere: Camera,
}

impl Standpoints {
    fn new(photos: &[JointPhoto]) -> Self {
        let lead: Vec<usize> = photos.iter().map(|photo| photo.standpoint).collect();
        let mut members = vec![0_usize; photos.len()];
        for &lead in &lead {
            members[lead] += 1;
        }
        let turn = photos
            .iter()
            .enumerate()
            .map(|(slot, photo)| match photo.standpoint {
                lead if lead == slot => UnitQuaternion::identity(),
                lead => photos[lead].world_from_camera.rotation.inverse() * photo.world_from_camera.rotation,
            })
            .collect();
        let shared = lead.iter().map(|&lead| members[lead] > 1).collect();
        Self { lead, turn, shared, sphere: sphere() }
    }

    /// The observation of a bundle point at a place in a photo, of the standpoint's pose where the centre is shared.
    fn observation(
        &self,
        rays: &[PhotoRays<'_>],
        slot: usize,
        place: &Place,
        point: u32,
    ) -> Option<BundleObservation> {
        let Place { pixel, noise_px } = if self.shared[slot] {
            place_on(&self.sphere, rays[slot].camera, &self.turn[slot], place)?
        } else {
            *place
        };
        Some(BundleObservation { pose: self.lead[slot] as u32, point, pixel, noise_px })
    }
}

/// Where a sphere shows in the same direction, and as exactly, what a camera that is turned against it shows at a place.
pub(crate) fn place_on(
    sphere: &Camera,
    camera: &Camera,
    turn: &UnitQuaternion<f64>,
    place: &Place,
) -> Option<Place> {
    let sigma = place.noise_px * camera.pixel_angle(&place.pixel)?;
    let pixel = sphere.project(&(turn * camera.unproject(&place.pixel)?))?;
    Some(Place { pixel, noise_px: sigma / sphere.pixel_angle(&pixel)? })
}

/// A camera that sees all around; its pixels only express angles.
fn sphere() -> Camera {
    Camera::equirectangular(FAR_WIDTH, FAR_WIDTH / 2)
}

/// Width in pixels of the images of cameras that see all around.
const FAR_WIDTH: u32 = 4096;
/// Distance of the far cameras from their point, in its largest standard deviations.
const FAR: f64 = 1e3;

/// A camera far off that sees a scene point in the middle of its image.
struct PriorBearing {
    world_from_camera: Rigid,
    pixel: Vector2<f64>,
    noise_px: f64,
}

/// What the scene knows of a point, as bearings from far off along the axes of its covariance.
///
/// Scene points are not exact: those at the rim were seen from a few panoramas in a row, and their depths can be off
/// by percents, the same way for a whole façade. Taken as fixed they bend the scale of the set to themselves, and the
/// covariance does not show it. A bearing from far along axis k with weight w_k tells the place across that axis only;
/// three of them sum up to the information Σ⁻¹ when w_k = (Σ_j i_j)/2 − i_k for the information i_j along axis j. An
/// axis that is known better than the other two together counts as they do, since no weight is negative. A covariance
/// of zero (an exact point) or without bound has no bearings.
fn prior_bearings(position: &Vector3<f64>, covariance: &Matrix3<f64>) -> Vec<PriorBearing> {
    let eigen = covariance.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    if !(largest > 0.0) || !largest.is_finite() {
        return Vec::new();
    }
    let information = eigen.eigenvalues.map(|variance| 1.0 / variance.max(1e-6 * largest));
    let all = information.sum();
    let information = information.map(|along| along.min(all - along));
    let distance = FAR * largest.sqrt();
    let pixel_angle = std::f64::consts::TAU / f64::from(FAR_WIDTH);
    (0..3)
        .filter_map(|axis| {
            let weight = information.sum() / 2.0 - information[axis];
            let away = eigen.eigenvectors.column(axis).into_owned();
            let rotation = UnitQuaternion::rotation_between(&Vector3::z(), &-away)
                .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
            (weight > 0.0).then(|| PriorBearing {
                world_from_camera: Rigid::new(rotation, position + away * distance),
                pixel: Vector2::new(f64::from(FAR_WIDTH) / 2.0, f64::from(FAR_WIDTH) / 4.0),
                noise_px: 1.0 / (weight.sqrt() * distance * pixel_angle),
            })
        })
        .collect()
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
        // Only this pose and the far cameras keep observations, so the others drop out.
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
    use super::*;
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
    fn photos_of_many_unknown_cameras_get_focal_lengths_of_their_own() {
        let world = World::chain(1, 0.0, 33);
        let focal_lengths = [700.0, 800.0, 900.0, 1000.0, 1100.0];
        let camera = |focal: f64| world.camera.with_focal_times(focal / world.camera.focal_length());
        let of_photos = |cameras: &[usize]| {
            let photo =
                |&camera: &usize| JointPhoto { camera, world_from_camera: Rigid::identity(), standpoint: 0 };
            let known = |(at, focal)| JointCamera::new(camera(focal), at == 0);
            let mut model = JointModel {
                cameras: focal_lengths.into_iter().enumerate().map(known).collect(),
                photos: cameras.iter().map(photo).collect(),
                points: Vec::new(),
                lengths: Vec::new(),
                stretch: PhotoStretch::default(),
            };
            model.give_own_cameras_where_many();
            (model.photos.iter().map(|photo| photo.camera).collect::<Vec<_>>(), model.cameras)
        };
        let (photos, cameras) = of_photos(&[0, 1, 0, 2, 3, 4, 1]);
        assert_eq!(photos, [0, 5, 0, 2, 3, 4, 6]);
        let known: Vec<KnownOfCamera> = cameras.iter().map(|camera| camera.known.clone()).collect();
        let alike = || KnownOfCamera::Alike(camera(800.0));
        let (intrinsics, usual) = (KnownOfCamera::Intrinsics, KnownOfCamera::Usual);
        let (own, none) = ([alike(), alike()], [intrinsics.clone(), intrinsics]);
        assert_eq!(known, [&none[..], &[usual.clone(), usual.clone(), usual], &own].concat());
        assert_eq!(cameras[6].camera, camera(800.0));
        let (prior, usual) =
            (cameras[6].prior(6).unwrap(), CameraPrior::of_usual_photo(6, &camera(800.0)).unwrap());
        assert_eq!((prior.parameters[0].value, prior.parameters[0].sigma), (800.0, 8.0));
        assert_eq!(prior.parameters[2..], usual.parameters[2..]);
        // Of three cameras, or with three photos to each, they keep them.
        for kept in [&[1, 2, 3, 1][..], &[1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, 4], &[0, 0, 0, 0]] {
            assert_eq!(of_photos(kept).0, kept);
        }
        let two_to_each = [1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3];
        assert_ne!(of_photos(&two_to_each).0, two_to_each);
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

    #[test]
    fn the_covariance_of_a_turned_camera_is_that_of_its_own_axes() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2);
        let factor = Matrix6::from_fn(|row, column| 0.1 * ((3 * row + 5 * column) % 7) as f64);
        let covariance = factor * factor.transpose();
        // A draw x of covariance aaᵀ for each column a of the factor, seen by the turned camera.
        let seen = Matrix6::from_columns(&[0, 1, 2, 3, 4, 5].map(|k| {
            let (spin, shift) = (factor.fixed_view::<3, 1>(0, k), factor.fixed_view::<3, 1>(3, k));
            let spin = turn.inverse() * spin.into_owned();
            nalgebra::Vector6::new(spin.x, spin.y, spin.z, shift[0], shift[1], shift[2])
        }));
        assert!((turned(&covariance, &turn) - seen * seen.transpose()).norm() < 1e-12);
    }

    #[test]
    fn far_bearings_carry_the_information_of_the_covariance() {
        let axes = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2).to_rotation_matrix().into_inner();
        let covariance = axes * Matrix3::from_diagonal(&Vector3::new(1e-4, 1.05e-4, 9e-4)) * axes.transpose();
        let position = Vector3::new(3.0, -1.0, 12.0);
        let camera = Camera::equirectangular(FAR_WIDTH, FAR_WIDTH / 2);
        let mut information = Matrix3::zeros();
        for prior in prior_bearings(&position, &covariance) {
            let seen = camera.unproject(&prior.pixel).unwrap();
            let offset = position - prior.world_from_camera.translation;
            let direction = offset.normalize();
            assert!((prior.world_from_camera.rotation * seen - direction).norm() < 1e-9);
            let sigma = prior.noise_px * camera.pixel_angle(&prior.pixel).unwrap() * offset.norm();
            information += (Matrix3::identity() - direction * direction.transpose()) / (sigma * sigma);
        }
        let expected = covariance.try_inverse().unwrap();
        assert!((information - expected).norm() < 1e-6 * expected.norm(), "{information} {expected}");
    }

    #[test]
    fn a_point_that_is_exact_or_unknown_has_no_bearings() {
        for covariance in [Matrix3::zeros(), Matrix3::repeat(f64::NAN), Matrix3::identity() * f64::INFINITY] {
            assert!(prior_bearings(&Vector3::zeros(), &covariance).is_empty());
        }
    }
}
