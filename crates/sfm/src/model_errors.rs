//! What a model may be off, as draws of it.
//!
//! *Noise of its points.* The covariance of an adjustment takes each observation's noise as stated, and independent. Neither holds: most
//! places are better than stated and some far worse, and what is wrong with a point is so in several of its views. Of 28
//! rendered scenes (8–33 panoramas) the true centres were off by three times what such covariances say. What each point is off by in
//! its views shows it, though: the model's errors are as if the residuals of each point, all of one sign, had as well come out with
//! the other (the wild bootstrap by clusters: C. F. J. Wu, "Jackknife, bootstrap and other resampling methods in regression
//! analysis", Ann. Statist. 1986; A. C. Cameron, J. B. Gelbach, D. L. Miller, "Bootstrap-based improvements for inference with clustered
//! errors", Rev. Econ. Stat. 2008). Draws of signs move the places of the same 28 scenes' points so that centres
//! move by 0.85 times what they are truly off, in the geometric mean.
//!
//! *Errors that neighbouring bearings share.* Where residuals show such, each image of a draw has a smooth field of them
//! ([`BearingField`]), which no number of points averages out.
//!
//! Either moves the places that the model was adjusted to, and, to first order, the model with them.

use nalgebra::{Matrix3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::Camera;

mod local;
mod matched;
mod shared;
mod stitching;

use self::local::LocalStretch;
pub use self::matched::shared_sigma_of_matches;
pub use self::shared::BearingField;
use self::shared::shared_sigma_rad;
use self::stitching::{OwnCameras, SharedStitching, draw_priors, move_places};
use crate::alignment::{
    STITCHING_OF_EACH, adjustable_poses, follow, hold_by_positions, leave_out_turned, shares_standpoints,
};
use crate::bundle::{
    self, BundleObservation, BundlePoint, BundleProblem, CameraPrior, IntrinsicsFreedom, RobustLoss,
};
use crate::synthetic::normal;
use crate::{
    BaselineLength, ImageId, MeasuredPositions, Place, Reconstruction, ReconstructionPoint, Rigid,
    Similarity, nearest_rotation,
};

/// Draws of the errors.
const DRAWS: u32 = 16;
/// Loss of the places that a model was adjusted to.
const LOSS: RobustLoss = RobustLoss::Cauchy(1.0);

/// What a model may be off, as draws of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelErrors {
    shared_sigma_rad: f64,
    local_stretch: LocalStretch,
    /// Poses by draw, then by image.
    poses: Vec<Vec<Option<Rigid>>>,
    /// The model's cameras by draw; none where no draw changes any.
    cameras: Vec<Vec<Camera>>,
    /// The cameras that are one panorama's each.
    own: OwnCameras,
}

/// One standard deviation of a pose, of all directions together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseDeviation {
    /// Of its rotation, in radians.
    pub rotation_rad: f64,
    /// Of its centre, in units of the model.
    pub center: f64,
}

impl ModelErrors {
    /// The errors of a model that has aligned places ([`crate::AlignedTrack`]); `None` where it has none, or images of one
    /// standpoint that see enough to be adjusted, of which what ties them together is not known.
    ///
    /// Intrinsics stay as they are, but for how panoramas are stretched: that was told by the same bearings. What whole
    /// hemispheres share besides is not in it, as the poses take it up; nor is a fold.
    ///
    /// `positions` are those that it was adjusted to, too; what *all* of them are off is in no draw. `by_matches` is what its verified
    /// matches show of errors that neighbouring bearings share ([`shared_sigma_of_matches`]), in radians.
    pub fn of_model(
        model: &Reconstruction,
        positions: Option<&MeasuredPositions>,
        by_matches: f64,
    ) -> Option<Self> {
        let images: Vec<ImageId> = model.registered().collect();
        let (mut places, pose_of_image) = problem_of(model);
        if shares_standpoints(&places) {
            return None;
        }
        leave_out_turned(&mut places);
        if let Some(positions) = positions {
            hold_by_positions(&mut places, model, positions, LOSS);
        }
        let problem = places.reweighted(LOSS);
        let (residuals, position_residuals) = (places.residuals_under(LOSS), places.position_residuals());
        let mut unmoved = problem.clone();
        hold_lengths(&mut unmoved, model, &pose_of_image, |_| 1.0);
        if problem.observations.is_empty() || !bundle::step(&mut unmoved) {
            return None;
        }
        follow(&mut unmoved, &problem.poses);
        let shared_sigma_rad = shared_sigma_rad(model).max(by_matches);
        let own = OwnCameras::of(model);
        let shared_stitching = SharedStitching::of(&problem, &own);
        let of_draw = |draw: u32| {
            let field = |&image: &ImageId| {
                BearingField::new(shared_sigma_rad, image, draw).with_changes(own.drawn(model, image, draw))
            };
            let fields: Vec<BearingField> = images.iter().map(field).collect();
            let mut rng = ChaCha8Rng::seed_from_u64(!u64::from(draw));
            let mut sign = |_| if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            let signs: Vec<f64> = (0..model.points.len()).map(&mut sign).collect();
            let mut drawn = problem.clone();
            let error = |(seen, residual): (&BundleObservation, &Vector3<f64>)| {
                let camera = &problem.cameras[problem.poses[seen.pose as usize].camera as usize];
                let bearing = camera.unproject(&seen.pixel)?;
                Some(residual * signs[seen.point as usize] + fields[seen.pose as usize].at(&bearing))
            };
            let errors: Vec<_> = problem.observations.iter().zip(&residuals).map(error).collect();
            move_places(&mut drawn, &errors);
            let mut of_stitching = ChaCha8Rng::seed_from_u64(u64::from(draw));
            match &shared_stitching {
                Some(shared) => shared.hold(&mut drawn, &mut of_stitching, &errors),
                None => draw_priors(&mut drawn, &mut of_stitching),
            }
            let off = |deviation: f64| (deviation * normal(&mut rng)).exp();
            hold_lengths(&mut drawn, model, &pose_of_image, off);
            let mut signed =
                |residual: &Vector3<f64>| residual * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            let moved: Vec<Vector3<f64>> = position_residuals.iter().map(&mut signed).collect();
            let moved = problem.without_frame(&moved);
            drawn.position_priors.iter_mut().zip(moved).for_each(|(prior, moved)| prior.position += moved);
            // What has no answer to one draw has none to the unmoved places either.
            if bundle::step(&mut drawn) {
                follow(&mut drawn, &problem.poses);
            } else {
                drawn.clone_from(&unmoved);
            }
            let pairs = unmoved.poses.iter().zip(&drawn.poses);
            let pairs: Vec<(Rigid, Rigid)> =
                pairs.map(|(to, from)| (to.world_from_camera, from.world_from_camera)).collect();
            let frame = common_frame(&pairs);
            let cameras = model.cameras.iter().zip(unmoved.cameras.iter().zip(&drawn.cameras));
            let cameras: Vec<Camera> = cameras.map(|(own, change)| changed_alike(own, change)).collect();
            let mut poses = vec![None; model.images.len()];
            for (&image, (before, after)) in images.iter().zip(&pairs) {
                // The draw is told by what it moves; where the model itself is may be a little off its aligned places.
                let stated = model.images[image.index()].world_from_camera.unwrap_or(*before);
                poses[image.index()] = Some(moved_alike(&stated, before, &frame.transform_pose(after)));
            }
            (poses, cameras)
        };
        let draws: Vec<u32> = (0..DRAWS).collect();
        let (poses, mut cameras): (Vec<_>, Vec<_>) =
            draws.par_iter().with_max_len(1).map(|&draw| of_draw(draw)).unzip();
        if !model.cameras.iter().any(Camera::is_stretched) {
            cameras.clear();
        }
        Some(Self { shared_sigma_rad, local_stretch: LocalStretch::of(model), poses, cameras, own })
    }

    /// Draws of poses, by draw and image, whose bearings share errors of this standard deviation.
    pub fn new(shared_sigma_rad: f64, poses: Vec<Vec<Option<Rigid>>>) -> Self {
        let (local_stretch, own) = (LocalStretch::default(), OwnCameras::default());
        Self { shared_sigma_rad, local_stretch, poses, cameras: Vec::new(), own }
    }

    /// Standard deviation of what neighbouring bearings share, per tangent axis, in radians; 0 where residuals show none.
    pub fn shared_sigma_rad(&self) -> f64 {
        self.shared_sigma_rad
    }

    /// How many draws there are.
    pub fn draws(&self) -> u32 {
        self.poses.len() as u32
    }

    /// The pose of an image in a draw, in the frame that keeps all of them nearest to where they are.
    pub fn pose(&self, image: ImageId, draw: u32) -> Option<Rigid> {
        *self.poses.get(draw as usize)?.get(image.index())?
    }

    /// What sums of products of what draws move by are divided by, to be covariances.
    ///
    /// Fewer than there are draws: the inverse of a covariance that few draws tell is too large in the mean, by which errors of
    /// three coordinates would come out as larger than stated (J. Hartlap, P. Simon, P. Schneider, "Why your model parameter
    /// confidences might be too optimistic", A&A 2007).
    pub fn degrees_of_freedom(&self) -> f64 {
        (f64::from(self.draws()) - 4.0).max(1.0)
    }

    /// What the pose of an image of `model` may be off; `None` for one that is in no draw.
    pub fn deviation(&self, model: &Reconstruction, image: ImageId) -> Option<PoseDeviation> {
        let pose = model.images.get(image.index())?.world_from_camera?;
        let (mut rotation, mut center) = (0.0, 0.0);
        for draw in 0..self.draws() {
            let drawn = self.pose(image, draw)?;
            rotation += pose.rotation.angle_to(&drawn.rotation).powi(2);
            center += (drawn.translation - pose.translation).norm_squared();
        }
        let deviation = |squares: f64| (squares / self.degrees_of_freedom()).sqrt();
        let stated = PoseDeviation { rotation_rad: deviation(rotation), center: deviation(center) };
        (self.draws() > 0).then_some(stated)
    }

    /// The errors of the bearings of an image of `model` in a draw.
    pub fn field(&self, model: &Reconstruction, image: ImageId, draw: u32) -> BearingField {
        let camera = model.images.get(image.index()).map(|image| image.camera.index());
        let changed = camera.and_then(|camera| {
            let drawn = self.cameras.get(draw as usize)?.get(camera)?;
            let own = model.cameras.get(camera)?;
            (drawn != own).then(|| [own.clone(), drawn.clone()])
        });
        let changes = changed.into_iter().chain(self.own.drawn(model, image, draw));
        BearingField::new(self.shared_sigma_rad, image, draw).with_changes(changes)
    }

    /// The errors of the bearings of a picture along z that is none of the model's images, but was cut from one taken as they were; by its
    /// number.
    pub fn field_of_another(&self, number: u32, draw: u32) -> BearingField {
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(number) << 32 | u64::from(draw) | 1 << 31);
        let stretch = self.local_stretch.drawn([(); 3].map(|()| normal(&mut rng)));
        BearingField::new(self.shared_sigma_rad, ImageId(u32::MAX - number), draw).with_stretch(stretch)
    }
}

/// The model by its aligned places but for the lengths that it holds, and each image's pose in it.
fn problem_of(model: &Reconstruction) -> (BundleProblem, Vec<Option<u32>>) {
    let mut sightings: Vec<(usize, ImageId, &Place)> = Vec::new();
    for (at, point) in model.points.iter().enumerate() {
        let Some(aligned) = &point.aligned else { continue };
        sightings
            .extend(point.track.iter().zip(&aligned.places).map(|(seen, place)| (at, seen.image, place)));
        sightings.extend(aligned.further.iter().map(|(image, place)| (at, *image, place)));
    }
    let mut seen = vec![0_usize; model.images.len()];
    for (_, image, _) in &sightings {
        seen[image.index()] += 1;
    }
    let (poses, pose_of_image) = adjustable_poses(model, |image| seen[image.index()]);
    let observation = |(point, image, place): (usize, ImageId, &Place)| {
        let &Place { pixel, noise_px } = place;
        Some(BundleObservation { pose: pose_of_image[image.index()]?, point: point as u32, pixel, noise_px })
    };
    let free = |point: &ReconstructionPoint| BundlePoint { position: point.position, fixed: false };
    let freedom = |camera: &Camera| {
        if camera.is_stretched() { IntrinsicsFreedom::FREE } else { IntrinsicsFreedom::FIXED }
    };
    let own = OwnCameras::of(model);
    let stretched = model.cameras.iter().enumerate().filter(|(_, camera)| camera.is_stretched());
    let problem = BundleProblem {
        cameras: model.cameras.clone(),
        camera_freedom: model.cameras.iter().map(freedom).collect(),
        camera_priors: stretched
            .filter_map(|(at, camera)| {
                let mut prior = CameraPrior::of_usual_photo(at as u32, camera)?;
                if own.kind(at).is_some() {
                    prior.hold_stretch(camera, STITCHING_OF_EACH);
                }
                Some(prior)
            })
            .collect(),
        poses,
        points: model.points.iter().map(free).collect(),
        observations: sightings.into_iter().filter_map(observation).collect(),
        ..BundleProblem::default()
    };
    (problem, pose_of_image)
}

/// Holds the model's lengths, each times what a function of the deviation of its logarithm gives.
fn hold_lengths(
    problem: &mut BundleProblem,
    model: &Reconstruction,
    pose_of_image: &[Option<u32>],
    mut factor: impl FnMut(f64) -> f64,
) {
    for length in &model.lengths {
        let drawn = BaselineLength { ratio: length.ratio * factor(length.deviation), ..*length };
        drawn.hold_in(problem, |image| pose_of_image[image.index()]);
    }
}

/// The frame that brings the second poses nearest to the first: by their turns, then by their centres.
///
/// By centres alone the turn about a straight street would be in no pose.
fn common_frame(pairs: &[(Rigid, Rigid)]) -> Similarity {
    let turns: Matrix3<f64> = pairs
        .iter()
        .map(|(to, from)| (to.rotation * from.rotation.inverse()).to_rotation_matrix().into_inner())
        .sum();
    let rotation = nearest_rotation(turns).unwrap_or_default();
    let count = pairs.len().max(1) as f64;
    let to = pairs.iter().map(|(to, _)| to.translation).sum::<Vector3<f64>>() / count;
    let from = pairs.iter().map(|(_, from)| from.translation).sum::<Vector3<f64>>() / count;
    let (mut along, mut length) = (0.0, 0.0);
    for (target, source) in pairs {
        let turned = rotation * (source.translation - from);
        along += turned.dot(&(target.translation - to));
        length += turned.norm_squared();
    }
    let scale = if along > 0.0 && length > 0.0 { along / length } else { 1.0 };
    Similarity { scale, rotation, translation: to - rotation * from * scale }
}

/// A pose moved as another one is from before to after.
pub(crate) fn moved_alike(pose: &Rigid, before: &Rigid, after: &Rigid) -> Rigid {
    let turn = after.rotation * before.rotation.inverse();
    // In this order what stood at one place still does, to the last digit.
    Rigid::new(turn * pose.rotation, pose.translation - before.translation + after.translation)
}

/// A camera with its parameters changed as those of another one are from before to after.
fn changed_alike(camera: &Camera, (before, after): (&Camera, &Camera)) -> Camera {
    let mut changed = camera.clone();
    for (value, (before, after)) in changed.params.iter_mut().zip(before.params.iter().zip(&after.params)) {
        *value += after - before;
    }
    changed
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector2};

    use crate::{
        AlignedTrack, CameraId, GeoregisterParams, MeasuredPosition, Observation, ReconstructionImage,
    };

    /// Panoramas along a street between façades, whose places have noise of their own and shared errors, adjusted.
    fn street(noise_px: f64, shared_rad: f64, seed: u64) -> (Reconstruction, Vec<Rigid>) {
        street_of(&Camera::equirectangular(4096, 2048), noise_px, shared_rad, seed)
    }

    fn street_of(camera: &Camera, noise_px: f64, shared_rad: f64, seed: u64) -> (Reconstruction, Vec<Rigid>) {
        let (mut model, truth) = seen_street(6, camera, noise_px, shared_rad, seed);
        adjust(&mut model);
        (model, truth)
    }

    /// Adjusts a model to its places.
    pub(super) fn adjust(model: &mut Reconstruction) {
        let (mut problem, _) = problem_of(model);
        bundle::solve(&bundle::BundleParams::default(), &mut problem);
        take(model, &problem);
    }

    fn take(model: &mut Reconstruction, problem: &BundleProblem) {
        for (image, adjusted) in model.images.iter_mut().zip(&problem.poses) {
            image.world_from_camera = Some(adjusted.world_from_camera);
        }
        for (point, adjusted) in model.points.iter_mut().zip(&problem.points) {
            point.position = adjusted.position;
        }
        model.cameras.clone_from(&problem.cameras);
    }

    /// The same of so many panoramas, as it truly is.
    pub(super) fn seen_street(
        count: u32,
        camera: &Camera,
        noise_px: f64,
        shared_rad: f64,
        seed: u64,
    ) -> (Reconstruction, Vec<Rigid>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let truth: Vec<Rigid> = (0..count)
            .map(|at| {
                let turn = UnitQuaternion::from_euler_angles(0.0, 0.4 * f64::from(at), 0.0);
                Rigid::new(turn, Vector3::new(0.1 * f64::from(at % 2), 0.0, 3.0 * f64::from(at)))
            })
            .collect();
        let image = |(at, pose): (usize, &Rigid)| ReconstructionImage {
            name: format!("{at}"),
            camera: CameraId(0),
            world_from_camera: Some(*pose),
        };
        let fields: Vec<BearingField> = (0..count)
            .map(|image| BearingField::new(shared_rad, ImageId(image), 1000 + seed as u32))
            .collect();
        let mut model = Reconstruction {
            cameras: vec![camera.clone()],
            images: truth.iter().enumerate().map(image).collect(),
            ..Reconstruction::default()
        };
        for feature in 0..250 * count {
            let side = if rng.random_bool(0.5) { 6.0 } else { -6.0 };
            let position = Vector3::new(
                side + rng.random_range(-0.5..0.5),
                rng.random_range(-6.0..1.5),
                rng.random_range(-6.0..3.0 * f64::from(count) + 3.0),
            );
            let mut point = ReconstructionPoint {
                position,
                color: [0; 3],
                error_sigma: 0.0,
                track: Vec::new(),
                covariance: None,
                aligned: None,
            };
            let mut places = Vec::new();
            for (image, pose) in truth.iter().enumerate() {
                if (position.z - pose.translation.z).abs() > 6.0 {
                    continue;
                }
                let bearing = pose.inverse().transform_point(&position).normalize();
                let off = Vector2::from_fn(|_, _| normal(&mut rng)) * noise_px;
                let pixel = camera.project(&(bearing + fields[image].at(&bearing))).unwrap() + off;
                point.track.push(Observation { image: ImageId(image as u32), feature });
                places.push(Place { pixel, noise_px: 0.3 });
            }
            point.aligned = Some(AlignedTrack { places, further: Vec::new(), spot: Matrix3::zeros() });
            if point.track.len() >= 2 {
                model.points.push(point);
            }
        }
        (model, truth)
    }

    /// A seventh panorama that few points see, or none, where the third stands.
    #[test]
    fn an_image_turned_on_the_spot_is_off_as_the_one_that_it_was_turned_from() {
        let (mut model, _) = street(0.15, 0.0, 3);
        let mut turned = model.images[2].clone();
        turned.name = "turned".to_owned();
        model.images.push(turned);
        let deviations = |model: &Reconstruction| {
            let errors = ModelErrors::of_model(model, None, 0.0).expect("it has places");
            [2, 6].map(|image| errors.deviation(model, ImageId(image)).expect("is registered"))
        };
        let [anchor, turned] = deviations(&model);
        assert!((turned.center - anchor.center).abs() <= 1e-9 * anchor.center, "{turned:?} {anchor:?}");
        assert!((turned.rotation_rad - anchor.rotation_rad).abs() <= 1e-6 * anchor.rotation_rad);
        let see = |model: &mut Reconstruction, count: usize| {
            let seen_by_third = |point: &&mut ReconstructionPoint| {
                let images = || point.track.iter().map(|seen| seen.image);
                images().any(|image| image == ImageId(2)) && images().all(|image| image != ImageId(6))
            };
            for point in model.points.iter_mut().filter(seen_by_third).take(count) {
                let at = point.track.iter().position(|seen| seen.image == ImageId(2)).unwrap();
                point.track.push(Observation { image: ImageId(6), ..point.track[at] });
                let places = &mut point.aligned.as_mut().unwrap().places;
                places.push(places[at]);
            }
        };
        see(&mut model, 8);
        let [with_few, turned] = deviations(&model);
        assert!((turned.center - with_few.center).abs() <= 1e-9 * with_few.center, "{turned:?} {with_few:?}");
        assert!((with_few.center / anchor.center - 1.0).abs() < 1e-9, "{with_few:?} {anchor:?}");
        see(&mut model, 20);
        assert_eq!(ModelErrors::of_model(&model, None, 0.0), None);
    }

    #[test]
    fn what_has_no_places_has_no_errors() {
        assert_eq!(ModelErrors::of_model(&Reconstruction::default(), None, 0.0), None);
    }

    #[test]
    fn independent_noise_shows_no_shared_errors_and_what_it_does_to_poses_is_told() {
        // The places state 0.3 px, whatever their noise is.
        for noise_px in [0.05, 0.15, 0.3] {
            let ratios =
                actual_over_stated(noise_px, 0.0, |errors| assert_eq!(errors.shared_sigma_rad(), 0.0));
            assert!(ratios.iter().all(|ratio| (0.4..2.5).contains(ratio)), "{noise_px}: {ratios:?}");
        }
    }

    #[test]
    fn shared_errors_are_measured_and_what_they_do_to_poses_is_told() {
        let sigma = 4e-4;
        let ratios = actual_over_stated(0.2, sigma, |errors| {
            let measured = errors.shared_sigma_rad() / sigma;
            assert!((0.7..1.3).contains(&measured), "{measured}");
        });
        assert!(ratios.iter().all(|ratio| (0.4..2.5).contains(ratio)), "{ratios:?}");
    }

    /// Squared errors of centres and of rotations over those stated, of four streets.
    fn actual_over_stated(noise_px: f64, shared_rad: f64, check: impl Fn(&ModelErrors)) -> [f64; 2] {
        ratios((0..4).map(|seed| street(noise_px, shared_rad, seed)), check)
    }

    /// The same of any models and their true poses.
    fn ratios(
        models: impl Iterator<Item = (Reconstruction, Vec<Rigid>)>,
        check: impl Fn(&ModelErrors),
    ) -> [f64; 2] {
        let (mut squared, mut expected) = ([0.0; 2], [0.0; 2]);
        for (model, truth) in models {
            let errors = ModelErrors::of_model(&model, None, 0.0).expect("has places");
            check(&errors);
            let estimated = model.images.iter().map(|image| image.world_from_camera.unwrap());
            let pairs: Vec<(Rigid, Rigid)> = estimated.zip(truth).collect();
            let frame = common_frame(&pairs);
            for (image, (pose, truth)) in pairs.iter().enumerate() {
                let truth = frame.transform_pose(truth);
                let stated = errors.deviation(&model, ImageId(image as u32)).expect("is registered");
                squared[0] += (pose.translation - truth.translation).norm_squared();
                squared[1] += pose.rotation.angle_to(&truth.rotation).powi(2);
                expected[0] += stated.center.powi(2);
                expected[1] += stated.rotation_rad.powi(2);
            }
        }
        [squared[0] / expected[0], squared[1] / expected[1]]
    }

    /// Bearings that are off together bend a long street, which positions that are off by more, each by its own, do not let it.
    #[test]
    fn measured_positions_hold_a_long_street() {
        let params = GeoregisterParams { gps_sigma_m: 0.1, ..GeoregisterParams::default() };
        let camera = Camera::equirectangular(4096, 2048);
        let (mut apart, mut held, mut ratio) = (0.0, 0.0, 0.0);
        for seed in 0..3 {
            let (seen, truth) = seen_street(60, &camera, 0.2, 1e-3, seed);
            let mut rng = ChaCha8Rng::seed_from_u64(100 + seed);
            let mut off = || params.gps_sigma_m * normal(&mut rng);
            let measured: Vec<Option<MeasuredPosition>> = (truth.iter().enumerate())
                .map(|(at, pose)| {
                    // One of them is wrong, and two have no height.
                    let wrong = if at == 17 { 30.0 } else { 0.0 };
                    let enu = pose.translation + Vector3::new(off() + wrong, off(), off());
                    Some(MeasuredPosition { enu, has_height: at % 20 != 3 })
                })
                .collect();
            let positions = MeasuredPositions { params: params.clone(), by_image: measured };
            let adjustment = bundle::BundleParams {
                loss: LOSS,
                max_iterations: 200,
                function_tolerance: 1e-7,
                ..bundle::BundleParams::default()
            };
            let adjusted = |positions: Option<&MeasuredPositions>| {
                let (mut model, mut problem) = (seen.clone(), problem_of(&seen).0);
                if let Some(positions) = positions {
                    hold_by_positions(&mut problem, &seen, positions, adjustment.loss);
                }
                bundle::solve(&adjustment, &mut problem);
                take(&mut model, &problem);
                let found = problem.poses.iter().map(|pose| pose.world_from_camera);
                let pairs: Vec<(Rigid, Rigid)> = found.zip(truth.iter().copied()).collect();
                let frame = common_frame(&pairs);
                let off = |(found, truth): &(Rigid, Rigid)| {
                    (found.translation - frame.transform_pose(truth).translation).norm_squared()
                };
                (model, pairs.iter().map(off).sum::<f64>() / pairs.len() as f64)
            };
            apart += adjusted(None).1;
            let (model, squared) = adjusted(Some(&positions));
            held += squared;
            let errors = ModelErrors::of_model(&model, Some(&positions), 0.0).expect("has places");
            let stated =
                |image| errors.deviation(&model, ImageId(image)).expect("is registered").center.powi(2);
            ratio += squared / ((0..60).map(stated).sum::<f64>() / 60.0) / 3.0;
        }
        assert!(held < 0.5 * apart, "{held} {apart}");
        assert!((0.3..3.0).contains(&ratio), "{ratio}");
    }

    /// Fifteen metres of street with positions that are off by two say nothing of its shape, and would turn it about itself.
    #[test]
    fn measured_positions_say_nothing_of_a_short_street() {
        let params = GeoregisterParams::default();
        let (model, truth) = street(0.2, 0.0, 1);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let measured: Vec<Option<MeasuredPosition>> = (truth.iter())
            .map(|pose| {
                let off = Vector3::from_fn(|_, _| 2.0 * normal(&mut rng));
                Some(MeasuredPosition { enu: pose.translation + off, has_height: true })
            })
            .collect();
        let positions = MeasuredPositions { params: params.clone(), by_image: measured };
        let [with, without] = [Some(&positions), None].map(|positions| {
            let errors = ModelErrors::of_model(&model, positions, 0.0).expect("has places");
            let stated = |image| errors.deviation(&model, ImageId(image)).expect("is registered");
            let stated: Vec<PoseDeviation> = (0..6).map(stated).collect();
            let mean = |of: fn(&PoseDeviation) -> f64| stated.iter().map(of).sum::<f64>() / 6.0;
            [mean(|stated| stated.center), mean(|stated| stated.rotation_rad)]
        });
        for (with, without) in with.into_iter().zip(without) {
            assert!((0.8..1.25).contains(&(with / without)), "{with} {without}");
        }
    }

    /// Each panorama is stitched a little otherwise than the others, and adjusted as it is held near to them.
    #[test]
    fn what_each_panorama_is_stitched_otherwise_is_in_what_is_told_of_poses() {
        let mut shared = Camera::equirectangular(4096, 2048).as_stitched().unwrap();
        shared.params[4] = -0.003;
        let stitched = |seed: u64| {
            let (mut model, truth) = seen_street(6, &shared, 0.2, 0.0, seed);
            let mut rng = ChaCha8Rng::seed_from_u64(50 + seed);
            let own: Vec<Camera> = (0..6)
                .map(|_| {
                    let mut own = shared.clone();
                    own.params[4..].iter_mut().for_each(|term| *term += STITCHING_OF_EACH * normal(&mut rng));
                    own
                })
                .collect();
            // What is seen by the shared camera is where each one's own shows it.
            for point in &mut model.points {
                let places = &mut point.aligned.as_mut().unwrap().places;
                for (seen, place) in point.track.iter().zip(places) {
                    let bearing = shared.unproject(&place.pixel).unwrap();
                    place.pixel = own[seen.image.index()].project(&bearing).unwrap();
                }
            }
            adjust(&mut model);
            for at in 0..6 {
                model.images[at].camera = CameraId(model.cameras.len() as u32);
                model.cameras.push(model.cameras[0].clone());
            }
            adjust(&mut model);
            (model, truth)
        };
        let ratios = ratios((0..4).map(stitched), |errors| assert_eq!(errors.own.kind(1), Some(0)));
        assert!(ratios.iter().all(|ratio| (0.3..3.0).contains(ratio)), "{ratios:?}");
    }

    #[test]
    fn how_far_a_stretch_may_be_off_is_told() {
        let mut camera = Camera::equirectangular(4096, 2048).as_stitched().unwrap();
        camera.params[4] = -0.003;
        let terms = |camera: &Camera| camera.params[4..].to_vec();
        let apart = |a: &Camera, b: &Camera| -> f64 {
            terms(a).iter().zip(terms(b)).map(|(a, b)| (a - b).powi(2)).sum()
        };
        let (mut squared, mut expected) = (0.0, 0.0);
        for seed in 0..6 {
            let (model, _) = street_of(&camera, 0.2, 4e-4, seed);
            let errors = ModelErrors::of_model(&model, None, 0.0).expect("are shown");
            squared += apart(&model.cameras[0], &camera);
            for draw in 0..errors.draws() {
                let drawn = &errors.cameras[draw as usize][0];
                expected += apart(drawn, &model.cameras[0]) / f64::from(errors.draws());
                // Seen by the drawn camera, a bearing is where the field says.
                let bearing = Vector3::new(0.6, -0.2, 0.7).normalize();
                let waves = BearingField::new(errors.shared_sigma_rad(), ImageId(1), draw).at(&bearing);
                let seen = drawn.unproject(&model.cameras[0].project(&bearing).unwrap()).unwrap();
                let change = errors.field(&model, ImageId(1), draw).at(&bearing) - waves;
                let across = seen - bearing * bearing.dot(&seen);
                assert!((change - across).norm() < 1e-9, "{change} {across}");
            }
        }
        assert!((0.3..3.0).contains(&(squared / expected)), "{squared} {expected}");
    }
}
