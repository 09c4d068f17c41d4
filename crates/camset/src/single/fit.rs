//! Camera and pose of one photo by its matches, the focal length known or not.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use setloc_features::{Camera, CameraModel};
use setloc_index::{NearestPoints, SceneIndex};
use setloc_sfm::robust::{RansacParams, estimate_absolute_pose_focal};
use setloc_sfm::{ImageId, Rigid};

use super::{SAMPLE, estimate, inliers, ransac, refine, score, union};
use crate::evidence::PhotoRays;
use crate::guided::guided_matches;
use crate::refine::{JointCamera, JointModel, JointPhoto, KnownOfCamera};
use crate::stretch::PhotoStretch;
use crate::underfoot::Ground;
use crate::{QueryPhoto, Scene, SceneMatch, SingleParams};

/// Factors on a guessed focal length, tried in turn where the intrinsics are not known.
const FOCAL_FACTORS: [f64; 7] = [1.0, 0.84, 1.19, 0.71, 1.41, 0.56, 1.78];
/// How many of them are fitted, best first.
const MOST_FITTED: usize = 3;
/// By which factors a focal length that is found is changed to see whether others show more, and how often.
const FOCAL_STEP: f64 = 1.02;
const MAX_FOCAL_STEPS: usize = 5;
/// Matches that tell a focal length by themselves.
const TELLING: usize = 200;
/// Most samples of P4Pf: enough where every fifth match is right.
const MAX_FOCAL_SAMPLES: u32 = 2000;
/// Least and largest factor on it that P4Pf may find.
const FOCAL_RANGE: (f64, f64) = (0.4, 2.5);

/// How many times better a fisheye has to explain the matches than a lens without: it has two more terms, and a
/// few matches more or less agree with any.
const FISHEYE_GAIN: f64 = 1.1;

/// What camera and pose are sought by.
#[derive(Clone, Copy)]
pub(super) struct Sought<'a> {
    pub params: &'a SingleParams,
    pub scene: &'a Scene<'a>,
    pub ground: &'a Ground,
    pub photo: &'a QueryPhoto<'a>,
    pub matches: &'a [SceneMatch],
    pub seed: u64,
}

/// A camera and a pose, and their truncated score over all matches.
struct Hypothesis {
    camera: Camera,
    pose: Rigid,
    score: f64,
}

/// Camera and pose of one photo by its matches.
pub(super) struct Fit {
    pub model: JointModel,
    /// The matches that agree.
    pub agreeing: Vec<SceneMatch>,
    score: f64,
}

impl Sought<'_> {
    /// Camera and pose by the matches, at the focal length that guided matching agrees with most where it is not known.
    pub fn fit(&self, nearest: &[NearestPoints]) -> Option<Fit> {
        if self.photo.calibration.is_settled() {
            let camera = std::slice::from_ref(self.photo.camera);
            let only = self.hypotheses(camera, self.seed).into_iter().next()?;
            return Some(self.fitted(only, KnownOfCamera::Intrinsics));
        }
        Some(self.at_best_focal(nearest, self.of_any_lens()?))
    }

    /// Camera and pose where the intrinsics are not known: a wide lens is taken for a fisheye if that explains clearly more.
    fn of_any_lens(&self) -> Option<Fit> {
        let camera = self.photo.camera;
        let usual = self.of_usual_lens();
        if camera.model != CameraModel::Radial {
            return usual;
        }
        let guesses: Vec<Camera> = Camera::fisheye_guesses(camera.width, camera.height).collect();
        let guessed = self.hypotheses(&guesses, self.seed ^ 0xf15e).into_iter().next();
        let bent = usual.as_ref().and_then(|usual| {
            Some(Hypothesis { camera: usual.model.camera_of(0).as_fisheye()?, ..usual.hypothesis() })
        });
        let fisheyes = guessed.into_iter().chain(bent).map(|found| self.fitted(found, KnownOfCamera::Usual));
        let fisheye = best_of(fisheyes.filter(|fit| fit.model.camera_of(0).is_wide()));
        let least = FISHEYE_GAIN * usual.as_ref().map_or(0.0, |usual| usual.score);
        fisheye.filter(|fisheye| fisheye.score > least).or(usual)
    }

    /// The same without fisheyes.
    fn of_usual_lens(&self) -> Option<Fit> {
        let likely = FOCAL_FACTORS.map(|factor| self.photo.camera.with_focal_times(factor));
        let mut likely = self.hypotheses(&likely, self.seed);
        likely.truncate(MOST_FITTED);
        likely.extend(self.by_focal_length(self.seed ^ 0xf0ca));
        // Few matches fit with distortion that no lens has, at a wrong distance, if that is free before the pose is about right.
        let without = likely.into_iter().map(|found| self.fitted(found, KnownOfCamera::Distortion));
        let without = best_of(without)?;
        let with = self.fitted(without.hypothesis(), KnownOfCamera::Usual);
        let mut best = if with.score > without.score { with } else { without };
        best.model.cameras[0].known = KnownOfCamera::Usual;
        Some(best)
    }

    /// The pose, and of the camera what is not known, fitted to the matches that agree until no more do.
    fn fitted(&self, found: Hypothesis, known: KnownOfCamera) -> Fit {
        let Self { params, scene, photo, matches, .. } = *self;
        let mut model = JointModel {
            cameras: vec![JointCamera { camera: found.camera, known }],
            photos: vec![JointPhoto { camera: 0, world_from_camera: found.pose, standpoint: 0 }],
            points: Vec::new(),
            lengths: Vec::new(),
            stretch: PhotoStretch::of_one(scene),
        };
        let mut most = 0;
        // With intrinsics free each refinement brings matches within the bound that the one before left just outside.
        loop {
            refine(&mut model, scene, photo, matches, params.max_error_sigmas, false);
            let rays = PhotoRays::new(photo.features, model.camera_of(0));
            let pose = model.photos[0].world_from_camera;
            let agreeing = inliers(&rays, scene.index, &pose, matches, params.max_error_sigmas);
            if model.cameras[0].is_known() || agreeing.len() <= most {
                return Fit { agreeing, score: self.score(&rays, &pose), model };
            }
            most = agreeing.len();
        }
    }

    /// The fit at the focal length nearby at which guided matching shows most of the scene.
    ///
    /// What is far or flat fits a longer focal length and a step back about as well, and a few matches may agree better with
    /// those; but then fewer are found beside them.
    fn at_best_focal(&self, nearest: &[NearestPoints], first: Fit) -> Fit {
        let Self { params, scene, photo, seed, .. } = *self;
        let shown = |fit: &Fit| {
            let (pose, rays) = (fit.pose(), PhotoRays::new(photo.features, fit.model.camera_of(0)));
            let guided = guided_matches(&params.guided, scene.index, &rays, nearest, &pose);
            inliers(&rays, scene.index, &pose, &union(&fit.agreeing, &guided), params.max_error_sigmas).len()
        };
        let JointCamera { camera, known } = first.model.cameras[0].clone();
        let (mut most, mut best) = (shown(&first), first);
        if most >= TELLING {
            return best;
        }
        for step in [1.0 / FOCAL_STEP, FOCAL_STEP] {
            let mut factor = step;
            for _ in 0..MAX_FOCAL_STEPS {
                let Some(found) = self.hypotheses(&[camera.with_focal_times(factor)], seed).pop() else {
                    break;
                };
                let other = self.fitted(found, KnownOfCamera::Intrinsics);
                let shown = shown(&other);
                if shown <= most {
                    break;
                }
                (most, best) = (shown, other);
                factor *= step;
            }
        }
        best.model.cameras[0].known = known;
        best
    }

    /// For each camera the pose of greatest score, best first: from all matches, and where the intrinsics are known from
    /// covisible parts of them, too.
    fn hypotheses(&self, cameras: &[Camera], seed: u64) -> Vec<Hypothesis> {
        let Self { params, scene, ground, photo, matches, .. } = *self;
        let mut subsets = vec![matches.to_vec()];
        if photo.calibration.is_settled() {
            subsets.extend(covisible_subsets(scene.index, matches, params.covisible_images));
        }
        // Where the ground repeats itself, what agrees best in a part is a pose aside.
        let standing = subsets.iter().map(|subset| {
            subset.iter().copied().filter(|m| !ground.holds(m.point)).collect::<Vec<SceneMatch>>()
        });
        let standing: Vec<_> =
            standing.zip(&subsets).filter(|(s, all)| s.len() < all.len()).map(|(s, _)| s).collect();
        subsets.extend(standing);
        let mut found = Vec::new();
        for (number, camera) in cameras.iter().enumerate() {
            let rays = PhotoRays::new(photo.features, camera);
            let poses = subsets.iter().enumerate().filter_map(|(part, subset)| {
                let seed = seed.wrapping_add((number * 64 + part) as u64);
                let pose = estimate(params, scene.index, &rays, subset, seed)?;
                Some(Hypothesis { camera: camera.clone(), pose, score: self.score(&rays, &pose) })
            });
            // Of equals the first.
            found.extend(poses.reduce(|best, other| if other.score > best.score { other } else { best }));
        }
        found.sort_by(|one, other| other.score.total_cmp(&one.score));
        found
    }

    /// Pose and focal length in one, from all matches.
    fn by_focal_length(&self, seed: u64) -> Option<Hypothesis> {
        let Self { params, scene, photo, matches, .. } = *self;
        let rays = PhotoRays::new(photo.features, photo.camera);
        let focal = photo.camera.focal_length();
        let (mut pixels, mut sigmas, mut points) = (Vec::new(), Vec::new(), Vec::new());
        for found in matches {
            let feature = found.feature as usize;
            let (bearing, sigma) = (rays.rays.bearings[feature], rays.rays.sigmas[feature]);
            if bearing.z > 0.0 && sigma.is_finite() {
                pixels.push(Vector2::new(bearing.x, bearing.y) * (focal / bearing.z));
                // A pixel off the axis spans less of an angle, of its two sides cos^1.5 in the mean.
                sigmas.push(sigma * focal / bearing.z.powf(1.5));
                points.push(scene.index.position(found.point));
            }
        }
        let range = (FOCAL_RANGE.0 * focal, FOCAL_RANGE.1 * focal);
        let all = ransac(params);
        let few = RansacParams { max_iterations: all.max_iterations.min(MAX_FOCAL_SAMPLES), ..all };
        let found = estimate_absolute_pose_focal(&few, &pixels, &sigmas, &points, range, seed)?;
        let (camera, pose) = (photo.camera.with_focal_times(found.focal / focal), found.world_from_camera);
        let score = self.score(&PhotoRays::new(photo.features, &camera), &pose);
        Some(Hypothesis { camera, pose, score })
    }

    fn score(&self, rays: &PhotoRays<'_>, pose: &Rigid) -> f64 {
        score(self.params, (self.scene.index, self.ground), rays, pose, self.matches)
    }
}

impl Fit {
    fn pose(&self) -> Rigid {
        self.model.photos[0].world_from_camera
    }

    fn hypothesis(&self) -> Hypothesis {
        Hypothesis { camera: self.model.camera_of(0).clone(), pose: self.pose(), score: self.score }
    }
}

/// The one of greatest score; of equals the last.
fn best_of(fits: impl IntoIterator<Item = Fit>) -> Option<Fit> {
    fits.into_iter().max_by(|one, other| one.score.total_cmp(&other.score))
}

/// Matches to points that the `count` best-supported scene images see, one list an image.
fn covisible_subsets(index: &SceneIndex, matches: &[SceneMatch], count: usize) -> Vec<Vec<SceneMatch>> {
    let mut by_image: BTreeMap<ImageId, Vec<SceneMatch>> = BTreeMap::new();
    for &found in matches {
        for &row in index.rows_of(found.point) {
            by_image.entry(index.row(row).image).or_default().push(found);
        }
    }
    let mut subsets: Vec<Vec<SceneMatch>> =
        by_image.into_values().filter(|subset| subset.len() > SAMPLE).collect();
    for subset in &mut subsets {
        subset.dedup();
    }
    subsets.sort_by_key(|subset| std::cmp::Reverse(subset.len()));
    subsets.truncate(count);
    subsets
}
