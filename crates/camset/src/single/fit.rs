//! Camera and pose of one photo by its matches, the focal length known or not.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use setloc_features::{Calibration, Camera, CameraModel, ImageFeatures};
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

/// Least that intrinsics which were not told spare of the cost, in squared standard deviations by two, and as a share, to be used. With
/// the true focal length told others spare up to 8, in rendered scenes, with one that is 3 % wrong 30 to 800 where the photo shows it at all.
const LEAST_SPARED: f64 = 10.0;
const LEAST_SPARED_SHARE: f64 = 0.05;

/// Share of the cost that other intrinsics spare from which on nobody knows the camera.
const CONTRADICTED_SHARE: f64 = 0.25;
/// How many times too long or short a focal length has to be told for another one to be used where panoramas are stitched: photos among
/// these are stretched by up to a percent.
const STRETCHED_CHANGE: f64 = 1.02;
/// Factors on one that is told.
const TOLD_FACTORS: [f64; 3] = [1.0, 0.84, 1.19];
/// How many times too long or short a focal length may be told for another one to be used.
const MAX_TOLD_ERROR: f64 = 1.35;

/// How many times better a fisheye has to explain the matches than a lens without: it has two more terms, and a
/// few matches more or less agree with any.
const FISHEYE_GAIN: f64 = 1.1;

/// How often the noise of keypoints is halved until it is their own: from some hundred pixels on, as a principal point may be off.
const BLUR_HALVINGS: [i32; 2] = [7, 5];
/// How much more a picture that was cut has to explain than one that was not, in matches that agree exactly.
const CUT_GAIN: f64 = 1.0;
/// Fewest matches by which a photo of a set shows that it was cut.
const MIN_SHOWN_CUT: usize = 20;
/// How much more it has to explain than as its set has it, in matches that agree exactly, and as a share.
const CUT_LEAD: f64 = 3.0;
const CUT_LEAD_SHARE: f64 = 0.03;
/// Share of the longer side from which on no lens has its principal point so far from the middle.
const OFF_CENTRE: f64 = 0.02;

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
    /// Whether another camera than the one that is told explains clearly more.
    pub is_contradicted: bool,
    /// Whether a picture cut from the side of a larger one would explain as much.
    pub may_be_cut: bool,
    score: f64,
}

impl Sought<'_> {
    /// Camera and pose by the matches, at the focal length that guided matching agrees with most where it is not known.
    pub fn fit(&self, nearest: &[NearestPoints]) -> Option<Fit> {
        if self.photo.calibration.is_settled() {
            let camera = std::slice::from_ref(self.photo.camera);
            let only = self.hypotheses(camera, self.seed).into_iter().next()?;
            return Some(self.as_told(nearest, self.fitted(only, KnownOfCamera::Intrinsics)));
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
        // Few matches fit with distortion that no lens has, at a wrong distance, if that is free before the pose is about right.
        let without = self.of_free_focal(&FOCAL_FACTORS)?;
        let with = self.fitted(without.hypothesis(), KnownOfCamera::Usual);
        let mut best = if with.score > without.score { with } else { without };
        best.model.cameras[0].known = KnownOfCamera::Usual;
        Some(self.unless_cut(best))
    }

    /// The fit, or the one of a picture that was cut from a larger one where that explains clearly more.
    fn unless_cut(&self, mut usual: Fit) -> Fit {
        let Some(cut) = self.of_cut_picture(&usual) else { return usual };
        let gain = cut.score - usual.score;
        let least_gain = if off_centre(usual.model.camera_of(0)).is_some() { -CUT_GAIN } else { CUT_GAIN };
        if gain > least_gain {
            return cut;
        }
        usual.may_be_cut = gain > 0.0 && off_centre(cut.model.camera_of(0)).is_some();
        usual
    }

    /// The fit with the principal point wherever the matches have it.
    ///
    /// A picture that was cut from the side of a larger one is fitted by a turn in its place, and by matches of its own that agree with that, so
    /// no small step leads from there. So keypoints are taken for so many times as noisy as they are that all matches tell, and for less
    /// and less so. (A. Blake, A. Zisserman, "Visual Reconstruction", MIT Press 1987: graduated non-convexity.)
    fn of_cut_picture(&self, from: &Fit) -> Option<Fit> {
        best_of(BLUR_HALVINGS.into_iter().map(|halvings| self.annealed(from, halvings)))
    }

    /// The same from this much of a blur on.
    fn annealed(&self, from: &Fit, halvings: i32) -> Fit {
        let Self { params, scene, photo, matches, .. } = *self;
        let mut model = from.model.clone();
        model.cameras[0].known = KnownOfCamera::CutDistortion;
        let mut blurred =
            ImageFeatures { keypoints: photo.features.keypoints.clone(), ..ImageFeatures::default() };
        for halvings in (1..=halvings).rev() {
            let blur = 2.0_f32.powi(halvings);
            for (keypoint, own) in blurred.keypoints.iter_mut().zip(&photo.features.keypoints) {
                keypoint.noise_px = own.noise_px * blur;
            }
            let photo = QueryPhoto { features: &blurred, ..*photo };
            refine(&mut model, scene, &photo, matches, params.max_error_sigmas, false);
        }
        let (camera, pose) = (model.camera_of(0).clone(), model.photos[0].world_from_camera);
        self.fitted(Hypothesis { camera, pose, score: 0.0 }, KnownOfCamera::Cut)
    }

    /// Camera and pose where of the intrinsics the focal length is free, in turn so many times what is told or guessed.
    fn of_free_focal(&self, factors: &[f64]) -> Option<Fit> {
        let likely: Vec<Camera> =
            factors.iter().map(|&factor| self.photo.camera.with_focal_times(factor)).collect();
        let mut likely = self.hypotheses(&likely, self.seed);
        likely.truncate(MOST_FITTED);
        likely.extend(self.by_focal_length(self.seed ^ 0xf0ca));
        best_of(likely.into_iter().map(|found| self.fitted(found, KnownOfCamera::Distortion)))
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
                return Fit {
                    agreeing,
                    is_contradicted: false,
                    may_be_cut: false,
                    score: self.score(&rays, &pose),
                    model,
                };
            }
            most = agreeing.len();
        }
    }

    /// The fit with the camera that is told, or with another focal length where that explains clearly more.
    ///
    /// At a wrong focal length the pose is as far off as it makes the scene nearer or farther, with matches of its own that agree
    /// with it: no small step leads out of it, so the focal length is sought as if nothing were known of it. Of what agrees with any
    /// fit all poses are refined on all, and what these leave is compared. Where other distortion and another principal point explain
    /// clearly more again, or a focal length far from what is told, nobody knows the camera.
    fn as_told(&self, nearest: &[NearestPoints], told: Fit) -> Fit {
        let is_asked = self.params.check_intrinsics
            && self.photo.calibration == Calibration::Known
            && !self.photo.camera.is_panoramic();
        let is_telling = |fit: &Fit| fit.agreeing.len() >= self.params.verdict.min_inliers;
        if !is_asked || !is_telling(&told) {
            return told;
        }
        let Some(of_focal) = self.of_free_focal(&TOLD_FACTORS).map(|fit| self.at_best_focal(nearest, fit))
        else {
            return told;
        };
        let of_usual = self.fitted(of_focal.hypothesis(), KnownOfCamera::Usual);
        let of_unusual =
            self.of_cut_picture(&of_usual).filter(|cut| cut.score > of_usual.score).unwrap_or(of_usual);
        let fits = [&told, &of_focal, &of_unusual];
        let shown = fits.map(|fit| self.shown_by(nearest, fit));
        let seen = union(&union(&shown[0], &shown[1]), &shown[2]);
        let [by_told, by_focal, by_unusual] = fits.map(|fit| self.cost_on(fit, &seen));
        let is_clear = |than: f64, cost: f64| than - cost > LEAST_SPARED.max(LEAST_SPARED_SHARE * than);
        let ratio = of_focal.model.camera_of(0).focal_length() / self.photo.camera.focal_length();
        let is_stretched = told.model.stretch.is_likely;
        let least_change = if is_stretched { STRETCHED_CHANGE } else { 1.0 };
        let is_of_lens = (least_change.ln()..=MAX_TOLD_ERROR.ln()).contains(&ratio.ln().abs());
        let is_other = is_telling(&of_focal) && is_of_lens && is_clear(by_told, by_focal);
        let (least, mut best) = if is_other { (by_focal, of_focal) } else { (by_told, told) };
        best.is_contradicted = !is_stretched && least - by_focal.min(by_unusual) > CONTRADICTED_SHARE * least;
        best
    }

    /// What agrees with a fit, guided matches among it.
    fn shown_by(&self, nearest: &[NearestPoints], fit: &Fit) -> Vec<SceneMatch> {
        let Self { params, scene, photo, .. } = *self;
        let (pose, rays) = (fit.pose(), PhotoRays::new(photo.features, fit.model.camera_of(0)));
        let guided = guided_matches(&params.guided, scene.index, &rays, nearest, &pose);
        inliers(&rays, scene.index, &pose, &union(&fit.agreeing, &guided), params.max_error_sigmas)
    }

    /// Σ min(e, T)² / 2 over matches that a fit is refined on.
    fn cost_on(&self, fit: &Fit, matches: &[SceneMatch]) -> f64 {
        let Self { params, scene, photo, .. } = *self;
        let mut model = fit.model.clone();
        refine(&mut model, scene, photo, matches, params.max_error_sigmas, false);
        let rays = PhotoRays::new(photo.features, model.camera_of(0));
        let pose = model.photos[0].world_from_camera;
        let error = |&m: &SceneMatch| rays.error_sigmas(scene.index, &pose, m).min(params.max_error_sigmas);
        matches.iter().map(|m| error(m).powi(2) / 2.0).sum()
    }

    /// The fit at the focal length nearby at which guided matching shows most of the scene.
    ///
    /// What is far or flat fits a longer focal length and a step back about as well, and a few matches may agree better with
    /// those; but then fewer are found beside them.
    fn at_best_focal(&self, nearest: &[NearestPoints], first: Fit) -> Fit {
        let shown = |fit: &Fit| self.shown_by(nearest, fit).len();
        let JointCamera { camera, known } = first.model.cameras[0].clone();
        let may_be_cut = first.may_be_cut;
        let (mut most, mut best) = (shown(&first), first);
        if most >= TELLING {
            return best;
        }
        for step in [1.0 / FOCAL_STEP, FOCAL_STEP] {
            let mut factor = step;
            for _ in 0..MAX_FOCAL_STEPS {
                let Some(found) = self.hypotheses(&[camera.with_focal_times(factor)], self.seed).pop() else {
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
        best.may_be_cut = may_be_cut;
        best
    }

    /// For each camera the pose of greatest score, best first: from all matches, and of one whose intrinsics are known from
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

/// Where the principal point is ([`off_centre`]), where matches of a photo of unknown camera, placed so, show clearly that it was cut from the side
/// of a larger picture.
///
/// The photo is fitted from there as one alone is, with the principal point wherever its matches have it, and in the middle: where a
/// local model is bent, a photo alone explains more than as its set has it, whatever its camera is.
pub(crate) fn shows_cut(
    max_error_sigmas: f64,
    (scene, ground): (&Scene<'_>, &Ground),
    photo: &QueryPhoto<'_>,
    matches: &[SceneMatch],
    (camera, pose): (&Camera, &Rigid),
) -> Option<Vector2<f64>> {
    let params = SingleParams { max_error_sigmas, ..SingleParams::default() };
    let sought = Sought { params: &params, scene, ground, photo, matches, seed: 0 };
    let placed = sought.score(&PhotoRays::new(photo.features, camera), pose);
    let from = Hypothesis { camera: camera.clone(), pose: *pose, score: placed };
    let usual = sought.fitted(from, KnownOfCamera::Usual);
    let cut = sought.of_cut_picture(&usual)?;
    let centred = Hypothesis { camera: camera.centred(), ..usual.hypothesis() };
    let otherwise = placed.max(sought.fitted(centred, KnownOfCamera::Distortion).score);
    let is_clear = cut.agreeing.len() >= MIN_SHOWN_CUT
        && cut.score - otherwise > CUT_LEAD.max(CUT_LEAD_SHARE * otherwise);
    off_centre(cut.model.camera_of(0)).filter(|_| is_clear)
}

/// How far the principal point is from the middle, in longer sides, where that is farther than lenses have it.
pub(crate) fn off_centre(camera: &Camera) -> Option<Vector2<f64>> {
    let size = Vector2::new(f64::from(camera.width), f64::from(camera.height));
    let aside = (camera.principal_point()? - size / 2.0) / size.max();
    (aside.amax() > OFF_CENTRE).then_some(aside)
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
