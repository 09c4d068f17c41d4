//! The bundle problem of a joint refinement.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Matrix3;
use setloc_features::Camera;
use setloc_index::SceneIndex;
use setloc_sfm::bundle::{BundleObservation, BundlePoint, BundlePose, BundleProblem};
use setloc_sfm::{ImageId, Place, PointId, WallSight};

use super::model::{JointCamera, JointModel, JointObservations, JointPhoto};
use super::prior::{PriorBearing, prior_bearings, seen_from, sphere};
use super::standpoints::Standpoints;
use crate::Scene;
use crate::common::{CommonErrors, PoseError, shift_of_point};
use crate::evidence::PhotoRays;
use crate::scene_errors::HeldByScene;

/// A bundle problem of which the first poses are the photos', and what its parts are.
pub(super) struct JointProblem {
    pub problem: BundleProblem,
    /// Of each observation.
    pub origins: Vec<Origin>,
    /// Points that are held by what the scene knows of them.
    pub scene_points: usize,
    /// What of it errors of grown images move.
    pub common: CommonErrors,
    /// What of it errors of the scene move.
    pub held: HeldByScene,
}

impl JointProblem {
    pub fn assemble(
        model: &JointModel,
        scene: &Scene<'_>,
        rays: &[PhotoRays<'_>],
        observed: &JointObservations,
        standpoints: &Standpoints,
    ) -> Self {
        let mut builder = Builder {
            points: model.points.iter().map(|&position| BundlePoint { position, fixed: false }).collect(),
            observations: Vec::new(),
            origins: Vec::new(),
            seen: vec![0; model.photos.len()],
            priors: Vec::new(),
            photos: &model.photos,
            standpoints,
            rays,
        };
        builder.add_all(scene.index, observed);
        let Builder { points, observations, origins, seen, priors, .. } = builder;
        let around = model.cameras.len() as u32;
        let pose = |(slot, photo): (usize, &JointPhoto)| BundlePose {
            camera: if standpoints.shared[slot] { around } else { photo.camera as u32 },
            world_from_camera: photo.world_from_camera,
            fixed: seen[slot] < 3,
        };
        let mut cameras: Vec<Camera> = model.cameras.iter().map(|known| known.camera.clone()).collect();
        cameras.push(sphere());
        let prior = |(at, camera): (usize, &JointCamera)| camera.prior(at as u32);
        let problem = BundleProblem {
            cameras,
            camera_freedom: model.cameras.iter().map(JointCamera::freedom).collect(),
            camera_priors: model.cameras.iter().enumerate().filter_map(prior).collect(),
            poses: model.photos.iter().enumerate().map(pose).collect(),
            points,
            observations,
            ..BundleProblem::default()
        };
        let (common, held) = (CommonErrors::default(), HeldByScene::default());
        let mut joint = Self { problem, origins, scene_points: priors.len(), common, held };
        for prior in &priors {
            joint.hold(scene, prior, around);
        }
        joint.add_views(scene, observed);
        for (slots, length) in &model.lengths {
            joint.problem.hold_length(slots.map(|slot| standpoints.lead[slot] as u32), *length);
        }
        joint
    }

    /// Holds a point by what the scene knows of it; `around` is the camera that sees all around.
    fn hold(&mut self, scene: &Scene<'_>, prior: &ScenePrior, around: u32) {
        let &ScenePrior { point, scene_point, ref covariance } = prior;
        let shift = scene_point.and_then(|point| shift_of_point(scene, point));
        let seen_from = scene_point.and_then(|point| seen_from(scene.index, point));
        let position = self.problem.points[point as usize].position;
        for bearing in prior_bearings(&position, covariance, seen_from.as_ref()) {
            let PriorBearing { world_from_camera, pixel, noise_px } = bearing;
            let pose = self.problem.poses.len() as u32;
            self.common.points.extend(shift.map(|shift| (pose, shift)));
            if let Some(point) = scene_point {
                self.held.points.entry(point).or_default().push(pose);
            }
            self.problem.poses.push(BundlePose { camera: around, world_from_camera, fixed: true });
            self.observe(BundleObservation { pose, point, pixel, noise_px }, Origin::Prior);
        }
    }

    /// Adds the places where images of the scene show local points.
    fn add_views(&mut self, scene: &Scene<'_>, observed: &JointObservations) {
        let mut pose_of_view: BTreeMap<ImageId, u32> = BTreeMap::new();
        for (point, view) in &observed.views {
            let seen_by = &scene.reconstruction.images[view.image.index()];
            let Some(world_from_camera) = seen_by.world_from_camera else { continue };
            let camera = scene.reconstruction.camera_of(view.image);
            let error = PoseError::of_image(scene, view.image);
            let BundleProblem { poses, cameras, .. } = &mut self.problem;
            let pose = *pose_of_view.entry(view.image).or_insert_with(|| {
                let pose = poses.len() as u32;
                poses.push(BundlePose { camera: cameras.len() as u32, world_from_camera, fixed: true });
                cameras.push(camera.clone());
                self.common.views.extend(error.map(|error| (pose, error)));
                pose
            });
            let Place { pixel, mut noise_px } = view.place;
            if let (Some(error), Some(angle)) = (error, camera.pixel_angle(&pixel)) {
                let sigma = error.angular_sigma(&self.problem.points[*point].position);
                noise_px = noise_px.hypot(sigma / angle);
            }
            self.observe(BundleObservation { pose, point: *point as u32, pixel, noise_px }, Origin::Scene);
        }
        self.held.views = pose_of_view.into_iter().map(|(image, pose)| (pose, image)).collect();
    }

    fn observe(&mut self, observation: BundleObservation, origin: Origin) {
        self.problem.observations.push(observation);
        self.origins.push(origin);
    }
}

/// What an observation ties a photo to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    /// A scene point, by a keypoint.
    Scene,
    /// Other photos of the set.
    Local,
    /// What the scene knows of a point.
    Prior,
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
