use rayon::prelude::*;
use setloc_features::Camera;

use super::model::{Model, ModelPoint};
use crate::{
    ImageId, Observation, PointId,
    bundle::{
        self, BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, BundleReport,
        CameraPrior, IntrinsicsFreedom,
    },
};

/// Which unknowns of the model an adjustment moves.
#[derive(Debug)]
pub(super) struct Scope {
    /// Images whose poses move; their points move too.
    pub free_images: Vec<ImageId>,
    /// Points to adjust, with all their observations.
    pub points: Vec<PointId>,
    /// Which intrinsics move.
    pub intrinsics: Intrinsics,
}

/// Which intrinsics an adjustment moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Intrinsics {
    /// None.
    None,
    /// Those that are not known.
    Unknown,
    /// Those of this camera, which are told: its focal lengths, and its distortion where that has to be in the model's camera.
    Told {
        /// The camera.
        camera: usize,
        /// Whether its distortion is asked for, too.
        distortion: bool,
    },
}

impl Scope {
    /// Everything.
    pub fn global(model: &Model<'_>) -> Self {
        Self {
            free_images: model.registered().collect(),
            points: model.live_ids(),
            intrinsics: Intrinsics::Unknown,
        }
    }

    /// Images and those that share enough points with them to be moved by them, the others held; everything where that is most of it.
    ///
    /// What a join at one end of a place does to the other end is for the adjustment of the finished whole.
    pub fn about(model: &Model<'_>, images: &[ImageId]) -> Self {
        let shared = views_of(model, model.seen_by(images));
        let is_near =
            |image: &ImageId| images.contains(image) || shared[image.index()] >= MIN_ADJUSTABLE_POINTS;
        let free_images: Vec<ImageId> = model.registered().filter(is_near).collect();
        if 2 * free_images.len() > model.registered_count() {
            return Self::global(model);
        }
        let points = model.seen_by(&free_images);
        Self { free_images, points, intrinsics: Intrinsics::None }
    }

    /// `image` and the `neighbours` images that share most points with it, with all points that any of them sees: what a
    /// neighbour sees beside the image holds it, too.
    pub fn local(model: &Model<'_>, image: ImageId, neighbours: usize) -> Self {
        let shared = views_of(model, model.observations_of(image).into_iter().map(|(_, id)| id));
        let mut others: Vec<ImageId> =
            model.registered().filter(|&other| other != image && shared[other.index()] > 0).collect();
        others.sort_by_key(|other| (std::cmp::Reverse(shared[other.index()]), *other));
        others.truncate(neighbours);
        others.push(image);
        let points = model.seen_by(&others);
        Self { free_images: others, points, intrinsics: Intrinsics::None }
    }
}

/// How often each image sees some points.
fn views_of(model: &Model<'_>, points: impl IntoIterator<Item = PointId>) -> Vec<usize> {
    let mut views = vec![0; model.poses.len()];
    for seen in points.into_iter().filter_map(|id| model.point(id)).flat_map(|point| &point.track) {
        views[seen.image.index()] += 1;
    }
    views
}

/// Observations that are worth handing to another thread.
const OBSERVATIONS_PER_TASK: usize = 2048;

/// Points that an image must see for its pose to be adjusted.
pub(crate) const MIN_ADJUSTABLE_POINTS: usize = 12;

/// Whether an image sees enough points for its own pose.
pub(super) fn is_adjustable(model: &Model<'_>, image: ImageId) -> bool {
    model.observed_points(image) >= MIN_ADJUSTABLE_POINTS
}

/// Points, each seen by two other images, that make a single image tell the intrinsics of its camera.
pub(crate) const MIN_CALIBRATING_POINTS: usize = 30;

/// Whether the images of a camera tell its intrinsics: several do, and one that sees enough of what others hold.
pub(super) fn tells_camera(model: &Model<'_>, images: &[ImageId]) -> bool {
    let &[image] = images else { return !images.is_empty() };
    model.placed_by_others(image).len() >= MIN_CALIBRATING_POINTS
}

/// Bundle-adjusts `scope` and writes the result back.
///
/// When every registered image is free the first one is held, which fixes six of the seven gauge freedoms; scale is
/// left to the damping.
pub(super) fn adjust(model: &mut Model<'_>, params: &BundleParams, scope: &Scope) -> BundleReport {
    let mut problem = BundleProblem {
        cameras: model.cameras.clone(),
        camera_freedom: vec![IntrinsicsFreedom::FIXED; model.cameras.len()],
        ..BundleProblem::default()
    };
    let is_free = |image: ImageId| scope.free_images.contains(&image);
    let hold_first = model.registered().all(is_free);
    let mut free = vec![false; model.poses.len()];
    for &image in &scope.free_images {
        free[image.index()] = is_adjustable(model, image);
    }
    if hold_first && let Some(first) = model.registered().next() {
        free[first.index()] = false;
    }
    match scope.intrinsics {
        Intrinsics::None => {}
        Intrinsics::Unknown => {
            for camera in 0..model.cameras.len() {
                if model.is_open(camera) && tells_camera(model, &model.registered_with(camera)) {
                    problem.camera_freedom[camera] = IntrinsicsFreedom::FREE;
                    let usual = CameraPrior::of_usual_photo(camera as u32, &model.cameras[camera]);
                    problem.camera_priors.extend(usual);
                }
            }
        }
        Intrinsics::Told { camera, distortion } => {
            problem.camera_freedom[camera] =
                IntrinsicsFreedom { focal: true, distortion, ..IntrinsicsFreedom::FIXED };
            let told = model.input.cameras[camera].clone();
            let told = if distortion { told.with_tangential_distortion() } else { told };
            problem.camera_priors.push(CameraPrior::told(camera as u32, &told));
        }
    }

    let mut pose_of_image: Vec<Option<u32>> = vec![None; model.poses.len()];
    for (index, pose) in model.poses.iter().enumerate() {
        let Some(pose) = pose else { continue };
        pose_of_image[index] = Some(problem.poses.len() as u32);
        problem.poses.push(BundlePose {
            camera: model.input.images[index].camera.0,
            world_from_camera: pose.world_from_camera,
            fixed: !free[index],
        });
    }
    let kept: Vec<(PointId, &ModelPoint)> =
        scope.points.iter().filter_map(|&id| Some((id, model.point(id)?))).collect();
    problem.points =
        kept.iter().map(|(_, point)| BundlePoint { position: point.position, fixed: false }).collect();
    let mut sightings: Vec<(u32, u32, Observation)> = Vec::new();
    for (index, (_, point)) in kept.iter().enumerate() {
        let pose = |seen: &Observation| Some((pose_of_image[seen.image.index()]?, index as u32, *seen));
        sightings.extend(point.track.iter().filter_map(pose));
    }
    let observation = |&(pose, point, seen): &(u32, u32, Observation)| {
        let keypoint = &model.input.images[seen.image.index()].features.keypoints[seen.feature as usize];
        BundleObservation { pose, point, pixel: keypoint.pixel(), noise_px: f64::from(keypoint.noise_px) }
    };
    problem.observations =
        sightings.par_iter().with_min_len(OBSERVATIONS_PER_TASK).map(observation).collect();
    for length in &model.lengths {
        length.hold_in(&mut problem, |image| pose_of_image[image.index()]);
    }
    let kept: Vec<PointId> = kept.into_iter().map(|(id, _)| id).collect();
    let report = bundle::solve(params, &mut problem);

    for (camera, freedom) in problem.camera_freedom.iter().enumerate() {
        if *freedom != IntrinsicsFreedom::FIXED && problem.cameras[camera].validate().is_ok() {
            model.cameras[camera] = problem.cameras[camera].clone();
            model.refresh_rays(camera);
        }
    }
    for (index, pose) in pose_of_image.into_iter().enumerate() {
        if let Some(pose) = pose.filter(|_| free[index]) {
            model.set_pose(ImageId(index as u32), Some(problem.poses[pose as usize].world_from_camera));
        }
    }
    for (id, adjusted) in kept.into_iter().zip(&problem.points) {
        if let Some(point) = &mut model.points[id.index()] {
            point.position = adjusted.position;
        }
    }
    report
}

/// What a global adjustment says of a camera that the model could have in place of its own.
pub(super) struct CameraTrial {
    /// With the model's own camera.
    pub own: BundleReport,
    /// With the other one.
    pub other: BundleReport,
}

impl CameraTrial {
    /// Whether the other camera ignores no more observations and leaves less than this share of the cost.
    pub fn spares(&self, max_share: f64) -> bool {
        self.other.ignored <= self.own.ignored && self.other.final_cost < max_share * self.own.final_cost
    }
}

/// Adjusts the model with its own camera and with another one in its place, which stays where it `pays`; whether it does.
pub(super) fn try_camera(
    model: &mut Model<'_>,
    (camera, other): (usize, Camera),
    params: &BundleParams,
    pays: impl Fn(&CameraTrial) -> bool,
) -> bool {
    let scope = Scope::global(model);
    let mut trial = model.clone();
    trial.cameras[camera] = other;
    trial.refresh_rays(camera);
    let reports =
        CameraTrial { other: adjust(&mut trial, params, &scope), own: adjust(model, params, &scope) };
    let is_taken = pays(&reports);
    if is_taken {
        *model = trial;
    }
    is_taken
}

#[cfg(test)]
mod tests {
    use super::super::{
        MapperParams,
        structure::triangulate_image,
        test_street::{POINTS, Street, first_two},
    };
    use super::*;
    use crate::{Rigid, synthetic::rotation_angle};

    #[test]
    fn about_some_images_those_that_share_points_with_them_are_free_unless_that_is_most() {
        let street = Street::new("about", 60, POINTS);
        let input = street.input();
        let mut model = first_two(&street, &input);
        model.set_pose(ImageId(2), Some(street.poses[2]));
        let about = |model: &Model<'_>, image: u32| Scope::about(model, &[ImageId(image)]);
        let apart = about(&model, 2);
        assert_eq!((&apart.free_images[..], apart.points.len()), (&[ImageId(2)][..], 0), "nothing is shared");
        assert_eq!(apart.intrinsics, Intrinsics::None);
        let of_most = about(&model, 0);
        assert_eq!(of_most.free_images.len(), 3);
        assert_eq!((of_most.points, of_most.intrinsics), (model.live_ids(), Intrinsics::Unknown));
    }

    /// A third image that shares a few far points with the others has no say in how these stand to each other.
    #[test]
    fn what_neighbours_see_without_the_image_holds_them() {
        let street = Street::new("local", 14, 14);
        let (input, params) = (street.input(), MapperParams::default());
        let mut model = first_two(&street, &input);
        let image = ImageId(2);
        let off = nalgebra::Vector3::new(0.3, 0.0, 0.5);
        model.set_pose(image, Some(Rigid::new(street.poses[2].rotation, street.poses[2].translation + off)));
        let wide = params.max_error_sigma * 50.0;
        let limits = super::super::structure::PointLimits { max_error_sigma: wide, ..params.limits() };
        triangulate_image(&mut model, &street.graph(), limits, image);
        let scope = Scope::local(&model, image, 1);
        assert!(scope.points.len() > 100, "{}", scope.points.len());
        adjust(&mut model, &params.bundle(10), &scope);
        for (index, truth) in street.poses.iter().enumerate().take(2) {
            let pose = model.poses[index].expect("is registered").world_from_camera;
            let (rotation, center) = (
                rotation_angle(&pose.rotation, &truth.rotation),
                (pose.translation - truth.translation).norm(),
            );
            assert!(rotation < 3e-3 && center < 0.03, "{index}: {rotation} {center}");
        }
    }
}
