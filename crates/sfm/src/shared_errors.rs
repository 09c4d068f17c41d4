//! Errors of bearings that neighbouring directions of an image share.
//!
//! A stitched panorama is no central projection: its lenses stand centimetres apart, what is near is displaced where they meet,
//! and what is left of their distortions moves whole regions of the picture. Points of one region are then off together, and
//! the poses with them, so that no number of points averages it out, while each by itself fits its views within the noise of
//! keypoints. How large these errors are, residuals of neighbouring points show: where noise is independent, their products are
//! zero in the mean. What they do, draws of such errors show, which move the model's places and, to first order, the model with them.

use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::Camera;

use crate::alignment::{adjustable_poses, shares_standpoints};
use crate::bundle::{
    self, BundleObservation, BundlePoint, BundleProblem, CameraPrior, IntrinsicsFreedom, RobustLoss,
};
use crate::synthetic::normal;
use crate::{ImageId, Place, Reconstruction, ReconstructionPoint, Rigid, Similarity, nearest_rotation};

/// Angles in radians between directions whose residuals are compared: nearer ones share pixels of their patches.
const APART: [f64; 2] = [0.026, 0.087];
/// Fewest views of a point. Two leave it one residual, along which nothing is told of the rest.
const MIN_VIEWS: usize = 3;
/// Fewest pairs of neighbours that tell anything.
const MIN_PAIRS: usize = 200;
/// Residuals of so many times the median are those of wrong places.
const MAX_RESIDUAL: f64 = 4.0;
/// Most images whose residuals are compared.
const MAX_IMAGES: usize = 64;
/// Share of the residuals' variance from which on shared errors matter beside those that are not: up to 0.01 in rendered
/// scenes of twenty panoramas, 0.04 in one of eight, 0.06 and 0.3 in two real ones.
const MIN_SHARE: f64 = 0.05;

/// Draws of the errors.
const DRAWS: u32 = 16;
/// Loss of the places that a model was adjusted to.
const LOSS: RobustLoss = RobustLoss::Cauchy(1.0);
/// Waves that a field is the sum of.
const WAVES: usize = 24;
/// Angle in radians over which errors go together, as the deviation of a Gaussian: 7°, as in residuals of real panoramas (products
/// at 6° and 11° apart are 0.6 and 0.3 of those at 3°).
const LENGTH_RAD: f64 = 0.12;

/// Errors that directions of a model's images share, as draws of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SharedErrors {
    sigma_rad: f64,
    /// Poses by draw, then by image.
    poses: Vec<Vec<Option<Rigid>>>,
    /// The model's cameras by draw; none where no draw changes any.
    cameras: Vec<Vec<Camera>>,
}

impl SharedErrors {
    /// The errors of a model that has aligned places ([`crate::AlignedTrack`]); `None` where residuals show none that matter, or
    /// are too few to tell.
    ///
    /// Intrinsics stay as they are, but for how panoramas are stretched: that was told by the same bearings. What whole
    /// hemispheres share besides is not in it, as the poses take it up.
    pub fn of_model(model: &Reconstruction) -> Option<Self> {
        let images: Vec<ImageId> = model.registered().collect();
        if shares_standpoints(model, &images) {
            return None;
        }
        let Variances { shared, all } = variances(model)?;
        if !(shared > MIN_SHARE * all) {
            return None;
        }
        let sigma_rad = shared.sqrt();
        let problem = problem_of(model).reweighted(LOSS);
        let mut unmoved = problem.clone();
        if !bundle::step(&mut unmoved) {
            return None;
        }
        let of_draw = |draw: u32| {
            let mut moved = problem.clone();
            let fields: Vec<BearingField> =
                images.iter().map(|&image| BearingField::new(sigma_rad, image, draw)).collect();
            for seen in &mut moved.observations {
                let camera = &problem.cameras[problem.poses[seen.pose as usize].camera as usize];
                let field = &fields[seen.pose as usize];
                seen.pixel = field.moved(camera, &seen.pixel).unwrap_or(seen.pixel);
            }
            // What has no answer to one draw has none to the unmoved places either.
            if !bundle::step(&mut moved) {
                moved.clone_from(&unmoved);
            }
            let pairs = unmoved.poses.iter().zip(&moved.poses);
            let pairs: Vec<(Rigid, Rigid)> =
                pairs.map(|(to, from)| (to.world_from_camera, from.world_from_camera)).collect();
            let frame = common_frame(&pairs);
            let cameras = model.cameras.iter().zip(unmoved.cameras.iter().zip(&moved.cameras));
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
        Some(Self { sigma_rad, poses, cameras })
    }

    /// Errors of this standard deviation about given poses, by draw and image.
    pub fn new(sigma_rad: f64, poses: Vec<Vec<Option<Rigid>>>) -> Self {
        Self { sigma_rad, poses, cameras: Vec::new() }
    }

    /// Standard deviation of a bearing, per tangent axis, in radians.
    pub fn sigma_rad(&self) -> f64 {
        self.sigma_rad
    }

    /// How many draws there are.
    pub fn draws(&self) -> u32 {
        self.poses.len() as u32
    }

    /// The pose of an image in a draw, in the frame that keeps all of them nearest to where they are.
    pub fn pose(&self, image: ImageId, draw: u32) -> Option<Rigid> {
        *self.poses.get(draw as usize)?.get(image.index())?
    }

    /// The errors of the bearings of an image of `model` in a draw.
    pub fn field(&self, model: &Reconstruction, image: ImageId, draw: u32) -> BearingField {
        let camera = model.images.get(image.index()).map(|image| image.camera.index());
        let changed = camera.and_then(|camera| {
            let drawn = self.cameras.get(draw as usize)?.get(camera)?;
            let own = model.cameras.get(camera)?;
            (drawn != own).then(|| [own.clone(), drawn.clone()])
        });
        BearingField { changed, ..BearingField::new(self.sigma_rad, image, draw) }
    }
}

/// A smooth random field of bearing errors over the sphere, by random Fourier features (A. Rahimi, B. Recht, "Random
/// features for large-scale kernel machines", NIPS 2007), and what a change of the camera adds to it.
#[derive(Debug, Clone)]
pub struct BearingField {
    waves: Vec<Wave>,
    /// The camera and what it is in the draw.
    changed: Option<[Camera; 2]>,
}

#[derive(Debug, Clone)]
struct Wave {
    vector: Vector3<f64>,
    phase: f64,
    amplitude: Vector3<f64>,
}

impl BearingField {
    fn new(sigma_rad: f64, image: ImageId, draw: u32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(image.0) << 32 | u64::from(draw));
        let scale = sigma_rad * (2.0 / WAVES as f64).sqrt();
        let wave = |_| {
            let vector = Vector3::from_fn(|_, _| normal(&mut rng)) / LENGTH_RAD;
            let amplitude = Vector3::from_fn(|_, _| normal(&mut rng)) * scale;
            Wave { vector, phase: rng.random_range(0.0..std::f64::consts::TAU), amplitude }
        };
        Self { waves: (0..WAVES).map(wave).collect(), changed: None }
    }

    /// The error of a bearing of unit length in the camera frame, across it.
    pub fn at(&self, bearing: &Vector3<f64>) -> Vector3<f64> {
        let of_wave = |wave: &Wave| wave.amplitude * (wave.vector.dot(bearing) + wave.phase).cos();
        let mut sum: Vector3<f64> = self.waves.iter().map(of_wave).sum();
        if let Some([own, drawn]) = &self.changed
            && let Some(seen) = own.project(bearing).and_then(|pixel| drawn.unproject(&pixel))
        {
            sum += seen - bearing;
        }
        sum - bearing * bearing.dot(&sum)
    }

    /// Where a pixel is moved to.
    pub fn moved(&self, camera: &Camera, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let bearing = camera.unproject(pixel)?;
        camera.project(&(bearing + self.at(&bearing)))
    }
}

/// A residual of one point in one image.
struct Residual {
    bearing: Vector3<f64>,
    /// Seen minus expected, across the bearing, in radians.
    error: Vector3<f64>,
    /// Share of an error's variance that the point does not take up.
    left: f64,
}

/// Variances of bearings, per tangent axis, in radians squared.
struct Variances {
    shared: f64,
    all: f64,
}

fn variances(model: &Reconstruction) -> Option<Variances> {
    let mut of_image: Vec<Vec<Residual>> = model.images.iter().map(|_| Vec::new()).collect();
    for point in model.points.iter().filter(|point| point.track.len() >= MIN_VIEWS) {
        for (image, residual) in residuals(model, point) {
            of_image[image.index()].push(residual);
        }
    }
    let mut sizes: Vec<f64> = of_image.iter().flatten().map(|residual| residual.error.norm()).collect();
    sizes.sort_by(f64::total_cmp);
    let largest = MAX_RESIDUAL * sizes.get(sizes.len() / 2)?;
    for residuals in &mut of_image {
        residuals.retain(|residual| residual.error.norm() <= largest);
    }
    of_image.retain(|residuals| !residuals.is_empty());
    let every = of_image.len().div_ceil(MAX_IMAGES).max(1);
    let (near, far) = (APART[1].cos(), APART[0].cos());
    let (mut shared, mut all) = (Mean::default(), Mean::default());
    for residuals in of_image.iter().step_by(every) {
        for (at, a) in residuals.iter().enumerate() {
            all.add(a.error.norm_squared(), 2.0 * a.left);
            let neighbours =
                residuals[at + 1..].iter().filter(|b| (near..=far).contains(&a.bearing.dot(&b.bearing)));
            for b in neighbours {
                shared.add(a.error.dot(&b.error), 2.0 * (a.left * b.left).sqrt());
            }
        }
    }
    (shared.count >= MIN_PAIRS).then(|| Variances { shared: shared.value(), all: all.value() })
}

#[derive(Default)]
struct Mean {
    sum: f64,
    weight: f64,
    count: usize,
}

impl Mean {
    fn add(&mut self, value: f64, weight: f64) {
        self.sum += value;
        self.weight += weight;
        self.count += 1;
    }

    fn value(&self) -> f64 {
        self.sum / self.weight
    }
}

/// What a point leaves over in the images of its track, where it has aligned places.
fn residuals<'a>(
    model: &'a Reconstruction,
    point: &'a ReconstructionPoint,
) -> impl Iterator<Item = (ImageId, Residual)> + 'a {
    let places = point.aligned.as_ref().map_or(&[][..], |aligned| &aligned.places);
    let views = point.track.len() as f64;
    let left = (2.0 * views - 3.0) / (2.0 * views);
    point.track.iter().zip(places).filter_map(move |(seen, place)| {
        let pose = model.images.get(seen.image.index())?.world_from_camera?;
        let bearing = model.camera_of(seen.image).unproject(&place.pixel)?;
        let expected = pose.inverse().transform_point(&point.position).try_normalize(f64::EPSILON)?;
        Some((seen.image, Residual { bearing, error: bearing - expected, left }))
    })
}

/// The model by its aligned places.
fn problem_of(model: &Reconstruction) -> BundleProblem {
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
    let stretched = model.cameras.iter().enumerate().filter(|(_, camera)| camera.is_stretched());
    let mut problem = BundleProblem {
        cameras: model.cameras.clone(),
        camera_freedom: model.cameras.iter().map(freedom).collect(),
        camera_priors: stretched
            .filter_map(|(at, camera)| CameraPrior::of_usual_photo(at as u32, camera))
            .collect(),
        poses,
        points: model.points.iter().map(free).collect(),
        observations: sightings.into_iter().filter_map(observation).collect(),
        ..BundleProblem::default()
    };
    for length in &model.lengths {
        length.hold_in(&mut problem, |image| pose_of_image[image.index()]);
    }
    problem
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
fn moved_alike(pose: &Rigid, before: &Rigid, after: &Rigid) -> Rigid {
    let turn = after.rotation * before.rotation.inverse();
    Rigid::new(turn * pose.rotation, pose.translation + after.translation - before.translation)
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
    use nalgebra::UnitQuaternion;

    use crate::{AlignedTrack, CameraId, Observation, ReconstructionImage};

    /// Panoramas along a street between façades, whose places have noise of their own and shared errors, adjusted.
    fn street(noise_px: f64, shared_rad: f64, seed: u64) -> (Reconstruction, Vec<Rigid>) {
        street_of(&Camera::equirectangular(4096, 2048), noise_px, shared_rad, seed)
    }

    fn street_of(camera: &Camera, noise_px: f64, shared_rad: f64, seed: u64) -> (Reconstruction, Vec<Rigid>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let truth: Vec<Rigid> = (0..6)
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
        let fields: Vec<BearingField> =
            (0..6).map(|image| BearingField::new(shared_rad, ImageId(image), 1000 + seed as u32)).collect();
        let mut model = Reconstruction {
            cameras: vec![camera.clone()],
            images: truth.iter().enumerate().map(image).collect(),
            ..Reconstruction::default()
        };
        for feature in 0..1500 {
            let side = if rng.random_bool(0.5) { 6.0 } else { -6.0 };
            let position = Vector3::new(
                side + rng.random_range(-0.5..0.5),
                rng.random_range(-6.0..1.5),
                rng.random_range(-6.0..21.0),
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
        let mut problem = problem_of(&model);
        bundle::solve(&bundle::BundleParams::default(), &mut problem);
        for (image, pose) in model.images.iter_mut().zip(&problem.poses) {
            image.world_from_camera = Some(pose.world_from_camera);
        }
        for (point, refined) in model.points.iter_mut().zip(&problem.points) {
            point.position = refined.position;
        }
        model.cameras = problem.cameras;
        (model, truth)
    }

    #[test]
    fn independent_noise_shows_no_shared_errors() {
        for seed in 0..4 {
            assert_eq!(SharedErrors::of_model(&street(0.3, 0.0, seed).0), None, "{seed}");
        }
        assert_eq!(SharedErrors::of_model(&Reconstruction::default()), None);
    }

    #[test]
    fn shared_errors_are_measured_and_what_they_do_to_poses_is_told() {
        let sigma = 4e-4;
        let (mut squared, mut expected) = ([0.0; 2], [0.0; 2]);
        for seed in 0..4 {
            let (model, truth) = street(0.2, sigma, seed);
            let errors = SharedErrors::of_model(&model).expect("are shown");
            assert!((0.7..1.3).contains(&(errors.sigma_rad() / sigma)), "{seed}: {}", errors.sigma_rad());
            let estimated: Vec<Rigid> = model.images.iter().map(|i| i.world_from_camera.unwrap()).collect();
            let pairs: Vec<(Rigid, Rigid)> = estimated.iter().copied().zip(truth.iter().copied()).collect();
            let frame = common_frame(&pairs);
            for (image, (pose, truth)) in pairs.iter().enumerate() {
                let differences = |other: &Rigid| {
                    let turn = pose.rotation.angle_to(&other.rotation).powi(2);
                    [(pose.translation - other.translation).norm_squared(), turn]
                };
                let actual = differences(&frame.transform_pose(truth));
                for draw in 0..errors.draws() {
                    let drawn = differences(&errors.pose(ImageId(image as u32), draw).unwrap());
                    for kind in 0..2 {
                        expected[kind] += drawn[kind] / f64::from(errors.draws());
                    }
                }
                for kind in 0..2 {
                    squared[kind] += actual[kind];
                }
            }
        }
        for (squared, expected) in squared.iter().zip(&expected) {
            assert!((0.4..2.5).contains(&(squared / expected)), "{}", squared / expected);
        }
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
            let errors = SharedErrors::of_model(&model).expect("are shown");
            squared += apart(&model.cameras[0], &camera);
            for draw in 0..errors.draws() {
                let drawn = &errors.cameras[draw as usize][0];
                expected += apart(drawn, &model.cameras[0]) / f64::from(errors.draws());
                // Seen by the drawn camera, a bearing is where the field says.
                let bearing = Vector3::new(0.6, -0.2, 0.7).normalize();
                let waves = BearingField::new(errors.sigma_rad(), ImageId(1), draw).at(&bearing);
                let seen = drawn.unproject(&model.cameras[0].project(&bearing).unwrap()).unwrap();
                let change = errors.field(&model, ImageId(1), draw).at(&bearing) - waves;
                assert!((change - (seen - bearing)).norm() < 1e-6, "{change}");
            }
        }
        assert!((0.3..3.0).contains(&(squared / expected)), "{squared} {expected}");
    }

    #[test]
    fn a_field_is_smooth_and_as_large_as_stated() {
        let (mut rng, sigma) = (ChaCha8Rng::seed_from_u64(1), 1e-3);
        let (mut alone, mut near, mut far) = (0.0, 0.0, 0.0);
        for image in 0..400 {
            let field = BearingField::new(sigma, ImageId(image), 0);
            let bearing = Vector3::from_fn(|_, _| normal(&mut rng)).normalize();
            let aside = |angle: f64| (bearing + tangent(&bearing) * angle.tan()).normalize();
            let error = field.at(&bearing);
            assert!(error.dot(&bearing).abs() < 1e-12);
            alone += error.norm_squared();
            near += error.dot(&field.at(&aside(0.02)));
            far += error.dot(&field.at(&aside(0.6)));
        }
        let expected = 400.0 * 2.0 * sigma * sigma;
        assert!((0.8..1.2).contains(&(alone / expected)), "{}", alone / expected);
        assert!(near > 0.95 * alone && far.abs() < 0.15 * alone, "{near} {far} {alone}");
    }

    fn tangent(bearing: &Vector3<f64>) -> Vector3<f64> {
        bearing.cross(&Vector3::ith(bearing.iamin(), 1.0)).normalize()
    }
}
