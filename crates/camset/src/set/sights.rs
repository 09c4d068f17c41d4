//! Local points as the scene's images show them: the set placed from the scene's side.

mod lone;

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix3, Vector3};
use setloc_features::Camera;
use setloc_sfm::robust::{GeneralizedRay, RansacParams, estimate_generalized_pose};
use setloc_sfm::solvers::triangulation::length_along;
use setloc_sfm::{ImageId, Observation, Place, Rigid, Similarity};

use self::lone::LoneSight;
use super::rigid::solver_options;
use super::scale::{About, most_voted};
use crate::common::PoseError;
use crate::evidence::{PhotoRays, log10_false_alarms, median, ray_error_sigmas};
use crate::observability::SetRay;
use crate::{CamsetParams, Scene, ViewGeometry, Views};

/// A keypoint of a scene image that shows a local point.
#[derive(Debug, Clone)]
pub(crate) struct Sight {
    /// Index of the local point.
    pub local: usize,
    /// The scene image and its keypoint.
    pub seen: Observation,
    pub place: Place,
    /// The photos that were matched there, by slot, with their features.
    pub photos: Vec<(usize, u32)>,
    /// From the scene image's centre, in the scene's frame.
    ray: GeneralizedRay,
    /// What the photos leave open of the local point, in the set's frame.
    covariance: Matrix3<f64>,
}

/// Photos of a set as it is in its own frame.
pub(crate) struct SetView<'a> {
    pub set_from_camera: &'a [Rigid],
    pub rays: &'a [PhotoRays<'a>],
    /// Tracks of the local points: slots and features.
    pub tracks: &'a [Vec<(usize, u32)>],
    pub positions: &'a [Vector3<f64>],
}

impl Sight {
    /// Angle between the ray and a place in the scene, in standard deviations of the ray.
    pub(crate) fn error_sigmas_of(&self, position: &Vector3<f64>) -> f64 {
        ray_error_sigmas(
            &self.ray.direction,
            self.ray.sigma,
            &(position - self.ray.origin),
            &Matrix3::zeros(),
        )
    }
}

/// What a set shares with images of the scene beside the scene's points.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sights {
    /// Of local points.
    pub all: Vec<Sight>,
    /// Of what is none.
    pub lone: Vec<LoneSight>,
    /// Local points, in the set's frame.
    positions: Vec<Vector3<f64>>,
    /// The set's poses but for its scale that single pairs of a photo and a scene image tell.
    of_pairs: Vec<About>,
    /// Ratio-tested matches with the scene's images.
    putative: usize,
}

/// Standard deviation of a direction for the pose of the scene image that sees it, at the distance of most that it sees; in
/// radians, and 0 where the pose is taken as exact.
fn pose_sigma(scene: &Scene<'_>, image: ImageId, direction: &Vector3<f64>) -> f64 {
    let grown = scene.grown.binary_search_by_key(&image, |grown| grown.image).ok().map(|at| &scene.grown[at]);
    let center = scene.reconstruction.images[image.index()].world_from_camera.map(|pose| pose.translation);
    let (Some(grown), Some(center)) = (grown, center) else { return 0.0 };
    let error = PoseError::of_image(scene, image);
    error.map_or(0.0, |error| error.angular_sigma(&(center + direction * grown.depth)))
}

/// Largest standard deviation of a local point, as a share of its distance, that counts as a point.
const MAX_POINT_SIGMA: f64 = 0.1;
/// Samples that the pose from the scene's side may cost.
const MAX_SAMPLES: u32 = 5000;
/// Most scales that are tried about one place.
const MAX_SCALES: usize = 3;
/// Fewest sights of a second scene image, or more, that give the set a scale.
const MIN_ELSEWHERE: usize = 3;
/// What a lone sight, which is told by one coordinate, counts in the score beside one of a local point.
const LONE_WEIGHT: f64 = 0.5;
/// Lone sights that fix a photo's pose.
const LONE_SAMPLE: usize = 6;
/// Share of a scene image in which a set's local points may lie, for the chance of a wrong one to fit.
const SEEN_SHARE: f64 = 0.1;

impl Sights {
    /// What `views` say of a set, by the slots of its photos.
    pub(crate) fn new(
        params: &CamsetParams,
        scene: &Scene<'_>,
        views: &Views,
        set: &SetView<'_>,
        slot_of: impl Fn(usize) -> Option<usize>,
    ) -> Self {
        // One photo does not drift against itself.
        let drift_px = if set.rays.len() > 1 { params.drift_px } else { 0.0 };
        let mut local_of: Vec<BTreeMap<u32, usize>> = vec![BTreeMap::new(); set.rays.len()];
        for (local, track) in set.tracks.iter().enumerate() {
            for &(slot, feature) in track {
                local_of[slot].insert(feature, local);
            }
        }
        let mut seen: BTreeMap<(usize, Observation), BTreeSet<(usize, u32)>> = BTreeMap::new();
        let mut lone: Vec<(usize, u32, Observation)> = Vec::new();
        for found in &views.matches {
            let Some(slot) = slot_of(found.photo) else { continue };
            match local_of[slot].get(&found.feature) {
                Some(&local) => {
                    seen.entry((local, found.seen)).or_default().insert((slot, found.feature));
                }
                None => lone.push((slot, found.feature, found.seen)),
            }
        }
        let known: BTreeMap<usize, Option<Known>> =
            seen.keys().map(|(local, _)| (*local, known(set, *local, drift_px))).collect();
        let scene_ray = |seen: Observation| {
            let pose = scene.reconstruction.images.get(seen.image.index())?.world_from_camera?;
            let camera: &Camera = scene.reconstruction.camera_of(seen.image);
            let features = views.features.get(seen.image.index())?.as_ref()?;
            let keypoint = features.keypoints.get(seen.feature as usize)?;
            let (bearing, angle) = camera.ray(&keypoint.pixel())?;
            let direction = pose.rotation * bearing;
            let ray = GeneralizedRay {
                origin: pose.translation,
                direction,
                sigma: pose_sigma(scene, seen.image, &direction).hypot(angle * f64::from(keypoint.noise_px)),
                camera: seen.image.0,
            };
            Some((ray, Place::from(keypoint)))
        };
        let sight = |((local, seen), photos): ((usize, Observation), BTreeSet<(usize, u32)>)| {
            let Known { covariance, spread } = *known.get(&local)?.as_ref()?;
            let (mut ray, place) = scene_ray(seen)?;
            ray.sigma = ray.sigma.hypot(spread / params.max_error_sigmas);
            Some(Sight { local, seen, place, photos: photos.into_iter().collect(), ray, covariance })
        };
        let lone = lone.into_iter().filter_map(|(slot, feature, seen)| {
            let (ray, place) = scene_ray(seen)?;
            let (photo, pose) = (&set.rays[slot], &set.set_from_camera[slot]);
            let pixel = photo.features.keypoints[feature as usize].pixel();
            let drift = drift_px * photo.camera.pixel_angle(&pixel)? / params.max_error_sigmas;
            let own = GeneralizedRay {
                origin: pose.translation,
                direction: pose.rotation * photo.rays.bearings[feature as usize],
                sigma: photo.rays.sigmas[feature as usize].hypot(drift),
                camera: slot as u32,
            };
            Some(LoneSight { slot, feature, seen, place, ray, own })
        });
        let of_pair = |found: &ViewGeometry| {
            let in_set = &set.set_from_camera[slot_of(found.photo)?];
            let image = scene.reconstruction.images.get(found.image.index())?.world_from_camera?;
            let direction = image.rotation * found.image_from_photo.translation;
            let rotation = image.rotation * found.image_from_photo.rotation * in_set.rotation.inverse();
            // At every scale the photo stands in this direction.
            let in_set = in_set.translation - rotation.inverse() * direction;
            Some(About { rotation, in_set, in_scene: image.translation })
        };
        Self {
            lone: lone.collect(),
            all: seen.into_iter().filter_map(sight).collect(),
            positions: set.positions.to_vec(),
            of_pairs: views.geometries.iter().filter_map(of_pair).collect(),
            putative: (0..)
                .zip(&views.putative)
                .filter(|(at, _)| slot_of(*at).is_some())
                .map(|(_, n)| n)
                .sum(),
        }
    }

    /// The set's poses by LO-RANSAC over the scene's rays, and those that single pairs of a photo and a scene image tell.
    ///
    /// One scene image leaves the scale open. Then it is what most of the rest agrees on: `others`, the set's rays to
    /// scene points, rays of other scene images to local points, and lone pairs of rays that have to meet. `without` are
    /// sights that are left out of the first.
    pub(crate) fn estimate(
        &self,
        params: &CamsetParams,
        without: &[usize],
        others: &[SetRay],
        seed: u64,
    ) -> Vec<Similarity> {
        let (mut found, by_samples) = match self.by_samples(params, without, seed) {
            Some(Sampled::Pose(pose)) => (vec![pose], None),
            Some(Sampled::About(about)) => (Vec::new(), Some(about)),
            None => (Vec::new(), None),
        };
        for about in by_samples.iter().chain(&self.of_pairs) {
            found.extend(self.scales(params, about, others).into_iter().map(|scale| about.scaled(scale)));
        }
        found
    }

    fn by_samples(&self, params: &CamsetParams, without: &[usize], seed: u64) -> Option<Sampled> {
        let left = |at: &usize| without.binary_search(at).is_err();
        let used: Vec<&Sight> = (0..self.all.len()).filter(left).map(|at| &self.all[at]).collect();
        let rays: Vec<GeneralizedRay> = used.iter().map(|sight| sight.ray).collect();
        let points: Vec<Vector3<f64>> = used.iter().map(|sight| self.positions[sight.local]).collect();
        let ransac = RansacParams {
            max_error_sigma: params.max_error_sigmas,
            max_iterations: MAX_SAMPLES,
            ..RansacParams::default()
        };
        let options = solver_options(params);
        let found = estimate_generalized_pose(&ransac, &rays, &points, &options, seed)?;
        if found.scale_observable {
            return Some(Sampled::Pose(found.world_from_set.inverse()));
        }
        let at = rays[*found.inliers.first()? as usize].origin;
        Some(Sampled::About(About {
            rotation: found.world_from_set.rotation.inverse(),
            in_set: found.world_from_set.transform_point(&at),
            in_scene: at,
        }))
    }

    /// The scales that most votes are near to, best first.
    fn scales(&self, params: &CamsetParams, about: &About, others: &[SetRay]) -> Vec<f64> {
        let bound = params.max_error_sigmas;
        let by_points = about.scales_of_rays(others, bound);
        let by_sights = self.all.iter().filter_map(|sight| {
            let to = sight.ray.origin - about.in_scene;
            let step = about.step(&self.positions[sight.local]);
            let scale = length_along(&step, &to, &-sight.ray.direction)?;
            (to.norm() > 0.0 && self.error_sigmas(sight, &about.scaled(scale)) < bound).then_some(scale)
        });
        let by_pairs = self.lone.iter().filter_map(|lone| {
            let normal = (about.rotation * lone.own.direction).cross(&lone.ray.direction);
            let to = lone.ray.origin - about.in_scene;
            let scale = to.dot(&normal) / about.step(&lone.own.origin).dot(&normal);
            (to.norm() > 0.0 && lone.error_sigmas(&about.scaled(scale)) < bound).then_some(scale)
        });
        let votes = by_points.chain(by_sights).chain(by_pairs);
        most_voted(votes.filter(|scale| scale.is_finite() && *scale > 0.0).collect(), MAX_SCALES)
    }

    /// From a scene image to the local point that it shows, under a pose.
    fn offset(&self, sight: &Sight, world_from_set: &Similarity) -> Vector3<f64> {
        world_from_set.transform_point(&self.positions[sight.local]) - sight.ray.origin
    }

    /// Error in standard deviations of the ray and of the local point together.
    fn error_sigmas(&self, sight: &Sight, world_from_set: &Similarity) -> f64 {
        let offset = self.offset(sight, world_from_set);
        let covariance = world_from_set.transform_covariance(&sight.covariance);
        ray_error_sigmas(&sight.ray.direction, sight.ray.sigma, &offset, &covariance)
    }

    /// The sights that agree with a pose, ascending.
    pub(crate) fn agreeing(&self, world_from_set: &Similarity, max_error_sigmas: f64) -> Vec<usize> {
        let agrees = |at: &usize| self.error_sigmas(&self.all[*at], world_from_set) < max_error_sigmas;
        (0..self.all.len()).filter(agrees).collect()
    }

    /// Truncated score: Σ over local points of the mean of 1 − min(1, (e/T)²) over their sights.
    pub(crate) fn score(&self, world_from_set: &Similarity, max_error_sigmas: f64) -> f64 {
        let mut of_point: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        for sight in &self.all {
            let error = self.error_sigmas(sight, world_from_set) / max_error_sigmas;
            let (gain, count) = of_point.entry(sight.local).or_default();
            *gain += 1.0 - error.min(1.0).powi(2);
            *count += 1.0;
        }
        let of_points: f64 = of_point.values().map(|(gain, count)| gain / count).sum();
        let of_lone = self.lone.iter().map(|lone| {
            let error = lone.error_sigmas(world_from_set) / max_error_sigmas;
            LONE_WEIGHT * (1.0 - error.min(1.0).powi(2))
        });
        of_points + of_lone.sum::<f64>()
    }

    /// The lone sights whose rays meet under a pose, ascending.
    pub(crate) fn agreeing_lone(&self, world_from_set: &Similarity, max_error_sigmas: f64) -> Vec<usize> {
        let agrees = |at: &usize| self.lone[*at].error_sigmas(world_from_set) < max_error_sigmas;
        (0..self.lone.len()).filter(agrees).collect()
    }

    /// Median distance of what the scene's images see: local points, and where lone rays meet.
    pub(crate) fn depth(&self, world_from_set: &Similarity) -> Option<f64> {
        let of_points = self.all.iter().map(|sight| self.offset(sight, world_from_set).norm());
        let of_lone = self.lone.iter().filter_map(|lone| lone.distance(world_from_set));
        median(of_points.chain(of_lone).collect())
    }

    /// Local points of some sights, each once.
    pub(crate) fn points(&self, sights: &[usize]) -> BTreeSet<usize> {
        sights.iter().map(|&at| self.all[at].local).collect()
    }

    /// The local point of a sight, in the set's frame.
    pub(crate) fn position(&self, sight: usize) -> Vector3<f64> {
        self.positions[self.all[sight].local]
    }

    /// Local points that have any.
    pub(crate) fn all_points(&self) -> BTreeSet<usize> {
        self.all.iter().map(|sight| sight.local).collect()
    }

    /// How many of some sights, lone ones too, are of other scene images than the one with most; none when these are too
    /// few to tell a scale.
    pub(crate) fn seen_from_elsewhere(&self, sights: &[usize], lone: &[usize]) -> usize {
        let mut counts: BTreeMap<ImageId, usize> = BTreeMap::new();
        let of_points = sights.iter().map(|&at| self.all[at].seen.image);
        for image in of_points.chain(lone.iter().map(|&at| self.lone[at].seen.image)) {
            *counts.entry(image).or_default() += 1;
        }
        let most = counts.values().max().copied().unwrap_or(0);
        let elsewhere = sights.len() + lone.len() - most;
        if elsewhere < MIN_ELSEWHERE { 0 } else { elsewhere }
    }

    /// How many a pose's lone sights count as observations of points: each is told by one coordinate.
    pub(crate) fn worth_of_lone(lone: usize) -> usize {
        lone / 2
    }

    /// log₁₀ of the expected number of poses under which as many lone rays meet by chance; each photo's may bend to the
    /// six of its pose.
    pub(crate) fn lone_log10_false_alarms(&self, agreeing: &[usize], max_error_sigmas: f64) -> f64 {
        let slots: BTreeSet<usize> = agreeing.iter().map(|&at| self.lone[at].slot).collect();
        let sample = LONE_SAMPLE * slots.len();
        // A band of the epipolar plane's width across the seen part of the sphere.
        let chance = |&at: &usize| {
            let lone = &self.lone[at];
            (2.0 * max_error_sigmas * lone.ray.sigma.hypot(lone.own.sigma) / SEEN_SHARE.sqrt()).min(1.0)
        };
        let mean = agreeing.iter().map(chance).sum::<f64>() / agreeing.len().max(1) as f64;
        log10_false_alarms(self.putative.max(agreeing.len()), agreeing.len(), sample, mean.clamp(1e-12, 1.0))
    }

    /// log₁₀ of the expected number of poses that as many points of these agree with by chance.
    pub(crate) fn log10_false_alarms(
        &self,
        agreeing: &[usize],
        world_from_set: &Similarity,
        max_error_sigmas: f64,
        sample: usize,
    ) -> f64 {
        let chance = |&at: &usize| {
            let sight = &self.all[at];
            let offset = self.offset(sight, world_from_set);
            let covariance = world_from_set.transform_covariance(&sight.covariance);
            let across = (covariance.trace() / 3.0).max(0.0) / offset.norm_squared().max(f64::MIN_POSITIVE);
            // Share of the seen part of the sphere, 4π in all, within the bound.
            let bound = max_error_sigmas * (sight.ray.sigma.powi(2) + across).sqrt();
            (bound * bound / (4.0 * SEEN_SHARE)).min(1.0)
        };
        let mean = agreeing.iter().map(chance).sum::<f64>() / agreeing.len().max(1) as f64;
        let matches = self.all_points().len();
        log10_false_alarms(matches, self.points(agreeing).len(), sample, mean.clamp(1e-12, 1.0))
    }
}

/// What samples of sights tell.
enum Sampled {
    Pose(Similarity),
    /// All sights of one scene image: not the scale.
    About(About),
}

/// A local point that sights may be of.
struct Known {
    covariance: Matrix3<f64>,
    /// Angle by which drift of the local model may move it.
    spread: f64,
}

/// What the keypoints of a local point leave open, and its drift; `None` where it is hardly a point.
fn known(set: &SetView<'_>, local: usize, drift_px: f64) -> Option<Known> {
    let mut information = Matrix3::zeros();
    let (mut nearest, mut spread) = (f64::INFINITY, 0.0_f64);
    for &(slot, feature) in &set.tracks[local] {
        let photo = &set.rays[slot];
        let sigma = photo.rays.sigmas[feature as usize];
        let offset = set.positions[local] - set.set_from_camera[slot].translation;
        let direction = offset.try_normalize(0.0)?;
        if sigma.is_finite() && sigma > 0.0 {
            let pixel = photo.features.keypoints[feature as usize].pixel();
            spread = spread.max(drift_px * photo.camera.pixel_angle(&pixel).unwrap_or(0.0));
            information +=
                (Matrix3::identity() - direction * direction.transpose()) / (sigma * offset.norm()).powi(2);
            nearest = nearest.min(offset.norm());
        }
    }
    let covariance = information.try_inverse()?;
    let sigma = covariance.symmetric_eigenvalues().max().max(0.0).sqrt();
    (sigma < MAX_POINT_SIGMA * nearest).then_some(Known { covariance, spread })
}
