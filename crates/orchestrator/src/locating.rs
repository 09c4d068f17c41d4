//! Locates photos in a scene: alone, as a set, or as a set when alone fails; and lets the scene grow by them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use anyhow::Result;
use setloc_camset::{AnywhereLocalization, PhotoLocalization, SetLocalization, Verdict};
use setloc_features::{Calibration, Camera};
use setloc_sfm::{CorrectedCamera, MOST_NAMED, MapperOutput, listed};

use crate::building::{alike_pairs, estimate_cameras, has_guessed_cameras};
use crate::config::Config;
use crate::dataset::{CameraOrigin, ImageFolder, SkippedImage, SourceImage, with_told_cameras};
use crate::fingerprint::ContentHash;
use crate::graph::{JobGraph, RunResult};
use crate::jobs::{
    LocateJobs, LocatedJobs, SceneInputs, add_features_of, add_grown, add_set, add_singles, divided_guesses,
    said_of_carried,
};
use crate::scene::SceneFile;
use crate::session::Session;
use crate::turning::guess_by_turns;

/// Which methods are tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Mode {
    /// Each photo alone; the set when the target is not localized so.
    #[default]
    Auto,
    /// Each photo alone.
    Single,
    /// The set only.
    Set,
    /// Both, whatever comes out.
    #[value(skip)]
    Both,
}

/// What came out.
#[derive(Debug, Clone, Default)]
pub struct Located {
    /// Each photo alone; empty when not tried.
    pub single: Vec<PhotoLocalization>,
    /// The set, when it was tried.
    pub set: Option<SetLocalization>,
    /// Size of the set's local models: registered photos of each component.
    pub local_models: Vec<usize>,
    /// Photos that could not be used, and why.
    pub skipped: Vec<SkippedImage>,
    /// What is odd about the photos.
    pub warnings: Vec<String>,
    /// Which photos were given one camera with others that, by the local model, seem not to have the same.
    pub divided: Vec<bool>,
    /// What was found to move with the cameras of the set's photos.
    pub carried: Option<String>,
}

impl Located {
    /// The best answer for each photo with the method that gave it: camset+opt, else camset, else alone.
    ///
    /// A photo whose own answer the set contradicts has the set's, which says so.
    pub fn answers(&self) -> Vec<(&'static str, &PhotoLocalization)> {
        best_answers(&self.single, self.set.as_ref())
    }

    /// Whether photos of the set show that they were cut from larger pictures, so that those of one size have no camera in common.
    fn is_cut(&self) -> bool {
        self.set.as_ref().is_some_and(|set| !set.cut.is_empty())
    }

    /// How many photos the set localizes, and how many have a pose that is uncertain.
    fn verdicts(&self) -> (usize, usize) {
        let photos = || self.set.iter().flat_map(|set| &set.refined);
        let count = |wanted: Verdict| photos().filter(|photo| photo.verdict == wanted).count();
        (count(Verdict::Localized), count(Verdict::Uncertain))
    }
}

/// The same of photos alone and of their set.
pub fn best_answers<'a>(
    single: &'a [PhotoLocalization],
    set: Option<&'a SetLocalization>,
) -> Vec<(&'static str, &'a PhotoLocalization)> {
    let refined = set.into_iter().flat_map(|set| set.refined.iter().map(|p| ("camset+opt", p)));
    let rigid = set.into_iter().flat_map(|set| set.rigid.iter().map(|p| ("camset", p)));
    let contradicted =
        |photo: &&PhotoLocalization| set.is_some_and(|set| set.contradicted.contains(&photo.name));
    let single = single.iter().filter(|photo| !contradicted(photo)).map(|p| ("single", p));
    let mut best: BTreeMap<&str, (&'static str, &PhotoLocalization)> = BTreeMap::new();
    for (method, photo) in single.chain(rigid).chain(refined) {
        let better = |old: &PhotoLocalization| photo.verdict.rank() >= old.verdict.rank();
        if best.get(photo.name.as_str()).is_none_or(|(_, old)| better(old)) {
            best.insert(&photo.name, (method, photo));
        }
    }
    best.into_values().collect()
}

/// Locates photos; `target` is the photo that decides in [`Mode::Auto`].
///
/// Photos of a camera whose told intrinsics the scene's own photos contradict have those that these show, which the last of the
/// warnings of `folder` says then.
///
/// Where intrinsics of a set are a guess, the set is located twice: the second time with the cameras that the scene told the
/// first time, which `folder` has afterwards. Before that, photos taken on one spot tell theirs, and guesses that do not hold are
/// improved by a model of the photos.
/// Photos alone keep the guess in [`Mode::Both`], which compares methods.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn locate(
    session: &Session,
    folder: &mut ImageFolder,
    what: &LocateJobs,
    mode: Mode,
    name: &str,
    target: &str,
) -> Result<Located> {
    if what.config.sfm.calibrate_photos {
        let corrected = correct_told(&mut folder.images, &what.scene.corrected);
        folder.warnings.extend(said_of_corrected(&corrected));
    }
    let (skipped, warnings) = (folder.skipped.clone(), folder.warnings.clone());
    let mut located = Located { skipped, warnings, ..Located::default() };
    let mut whole = RunResult::default();
    if mode != Mode::Set {
        whole.absorb(run(session, folder, what, (name, target), (true, false), &mut located)?);
        if let Some(shown) = shown_otherwise(&folder.images, &located.single) {
            let own = std::mem::take(&mut located.single);
            shown.use_in(folder, &mut located);
            whole.absorb(run(session, folder, what, (name, target), (true, false), &mut located)?);
            keep_own(&mut located.single, own, &shown);
        }
    }
    let found =
        located.single.iter().any(|photo| photo.name == target && photo.verdict == Verdict::Localized);
    let wanted = matches!(mode, Mode::Set | Mode::Both) || (mode == Mode::Auto && !found);
    if wanted {
        if has_guessed_cameras(&folder.images) {
            let photos = what.config.photo_features();
            let (alike, before) = alike_pairs(session, name, &folder.images, &photos, &what.config)?;
            whole.absorb(before);
            let (mut guessed, params) = (folder.images.clone(), (&photos, &what.config));
            whole.absorb(guess_by_turns(session, name, &mut guessed, &alike, params, what.seed)?);
            folder.images = guessed;
        }
        let lone: Vec<bool> =
            folder.images.iter().map(|image| is_lone_guess(&folder.images, image)).collect();
        if lone.contains(&true) {
            if located.single.is_empty() {
                whole.absorb(run(session, folder, what, (name, target), (true, false), &mut located)?);
            }
            improve_guesses(&mut folder.images, &lone, &located.single);
            whole.absorb(improve_by_model(session, &mut folder.images, &lone, what, name)?);
            if mode == Mode::Set {
                located.single.clear();
            }
        }
        whole.absorb(run(session, folder, what, (name, target), (false, true), &mut located)?);
        let of_set = located.set.iter().flat_map(|set| &set.refined);
        let shown = shown_otherwise(&folder.images, of_set.clone());
        if let Some(shown) =
            shown.filter(|_| !of_set.clone().all(|photo| photo.verdict == Verdict::Localized))
        {
            let mut corrected = folder.clone();
            let mut again = Located { single: Vec::new(), ..located.clone() };
            shown.use_in(&mut corrected, &mut again);
            let alone = mode != Mode::Set;
            whole.absorb(run(session, &corrected, what, (name, target), (alone, true), &mut again)?);
            if again.verdicts() >= located.verdicts() {
                (located, *folder) = (again, corrected);
            }
        }
        let doubtful = doubtful_guesses(&folder.images, &located, target);
        if doubtful.contains(&true) && !located.is_cut() {
            let mut improved = folder.clone();
            whole.absorb(improve_by_model(session, &mut improved.images, &doubtful, what, name)?);
            let mut again = located.clone();
            whole.absorb(run(session, &improved, what, (name, target), (false, true), &mut again)?);
            let is_better = located.divided.contains(&true) || again.verdicts() >= located.verdicts();
            if is_better || again.is_cut() {
                (located, *folder) = (again, improved);
            }
        }
        let images = with_estimated_cameras(&folder.images, &located.divided, located.set.as_ref());
        if let Some(images) = images.filter(|_| !located.is_cut()) {
            let calibrated = ImageFolder { images, ..folder.clone() };
            let mut again = Located { set: None, local_models: Vec::new(), ..located.clone() };
            let alone = mode == Mode::Auto;
            if alone {
                again.single.clear();
            }
            whole.absorb(run(session, &calibrated, what, (name, target), (alone, true), &mut again)?);
            if again.is_cut() {
                // Alone photos were sought with a camera that is not theirs.
                again.single.clone_from(&located.single);
            }
            if again.is_cut() || again.verdicts() >= located.verdicts() {
                (located, *folder) = (again, calibrated);
            }
        }
    }
    folder.warnings.extend(located.carried.clone());
    located.warnings.extend(located.carried.clone());
    session.remember(name, &whole);
    Ok(located)
}

/// Gives photos of cameras whose told intrinsics a scene contradicts those that it shows; their names.
fn correct_told(images: &mut [SourceImage], corrections: &[CorrectedCamera]) -> Vec<String> {
    let mut corrected = Vec::new();
    for image in images.iter_mut().filter(|image| image.calibration == Calibration::Known) {
        if let Some(correction) = corrections.iter().find(|correction| correction.told == image.camera) {
            image.camera.clone_from(&correction.used);
            corrected.push(image.name.clone());
        }
    }
    corrected
}

/// Focal lengths that photos show in place of those that they are told.
struct ShownCameras {
    /// All photos, those that are told such with what is shown.
    images: Vec<SourceImage>,
    /// The photos that show them.
    witnesses: BTreeSet<String>,
    /// One sentence for each camera.
    said: Vec<String>,
}

impl ShownCameras {
    fn use_in(&self, folder: &mut ImageFolder, located: &mut Located) {
        folder.images.clone_from(&self.images);
        folder.warnings.extend_from_slice(&self.said);
        located.warnings.extend_from_slice(&self.said);
    }
}

/// Matches of the photos that show another focal length than they are told, from which on it is used for others, too.
const TELLING_MATCHES: usize = 100;

/// The focal lengths that localized photos show otherwise than they are told, where these have more than half of the matches of all that
/// are localized of their camera. `None` where there are none.
///
/// A photo that looks at one wall fits any focal length, at another distance; what others of its camera show holds for it, too. Of
/// several the one of the middle focal length is used, each weighted by its matches.
fn shown_otherwise<'a>(
    images: &[SourceImage],
    answers: impl IntoIterator<Item = &'a PhotoLocalization>,
) -> Option<ShownCameras> {
    let answers: BTreeMap<&str, &PhotoLocalization> =
        answers.into_iter().map(|photo| (&*photo.name, photo)).collect();
    let mut shown = ShownCameras { images: images.to_vec(), witnesses: BTreeSet::new(), said: Vec::new() };
    let known = || images.iter().filter(|image| image.calibration == Calibration::Known);
    let mut asked: Vec<&Camera> = Vec::new();
    for told in known().map(|image| &image.camera) {
        if asked.contains(&told) {
            continue;
        }
        asked.push(told);
        let photos: Vec<&SourceImage> = known().filter(|image| image.camera == *told).collect();
        let answers = photos.iter().filter_map(|image| answers.get(&*image.name).copied());
        let placed: Vec<&PhotoLocalization> =
            answers.filter(|photo| photo.verdict == Verdict::Localized).collect();
        let witnesses: Vec<&PhotoLocalization> =
            placed.iter().copied().filter(|photo| photo.camera != *told).collect();
        let Some(middle) = middle_of(&witnesses) else { continue };
        let matches = |photos: &[&PhotoLocalization]| photos.iter().map(|photo| photo.inliers).sum::<usize>();
        if matches(&witnesses) < TELLING_MATCHES || 2 * matches(&witnesses) <= matches(&placed) {
            continue;
        }
        let names: Vec<&str> = photos.iter().map(|image| image.name.as_str()).collect();
        shown.said.push(said_of_shown(told, &middle.camera, &names, &witnesses));
        shown.witnesses.extend(witnesses.iter().map(|photo| photo.name.clone()));
        for image in &mut shown.images {
            if image.calibration == Calibration::Known && image.camera == *told {
                image.camera.clone_from(&middle.camera);
            }
        }
    }
    (!shown.said.is_empty()).then_some(shown)
}

/// The photo of the middle focal length, each weighted by its matches.
fn middle_of<'a>(photos: &[&'a PhotoLocalization]) -> Option<&'a PhotoLocalization> {
    let mut sorted = photos.to_vec();
    sorted.sort_by(|a, b| a.camera.focal_length().total_cmp(&b.camera.focal_length()));
    let half = sorted.iter().map(|photo| photo.inliers).sum::<usize>() / 2;
    let mut seen = 0;
    sorted.into_iter().find(|photo| {
        seen += photo.inliers;
        seen > half
    })
}

fn said_of_shown(told: &Camera, shown: &Camera, names: &[&str], witnesses: &[&PhotoLocalization]) -> String {
    let [told_px, shown_px] = [told, shown].map(Camera::focal_length);
    let change = format!("{shown_px:.1} px ({:+.1} %)", 100.0 * (shown_px / told_px - 1.0));
    let names = listed(names, MOST_NAMED);
    let verb = if witnesses.len() == 1 { "shows" } else { "show" };
    let witnesses: Vec<&str> = witnesses.iter().map(|photo| photo.name.as_str()).collect();
    let witnesses = listed(&witnesses, MOST_NAMED);
    format!(
        "the focal length that is told for {names} is {told_px:.1} px; {witnesses} {verb} {change}, which is used"
    )
}

/// Photos that showed their focal length keep their own answers, which state how well they show it.
fn keep_own(answers: &mut [PhotoLocalization], own: Vec<PhotoLocalization>, shown: &ShownCameras) {
    let mut own: BTreeMap<String, PhotoLocalization> =
        own.into_iter().map(|photo| (photo.name.clone(), photo)).collect();
    for answer in answers.iter_mut().filter(|answer| shown.witnesses.contains(&answer.name)) {
        if let Some(own) = own.remove(&answer.name) {
            *answer = own;
        }
    }
}

fn said_of_corrected(names: &[String]) -> Option<String> {
    (!names.is_empty()).then(|| {
        format!(
            "{}: told the intrinsics that the scene's photos contradict, and given those that these show \
             (sfm.calibrate_photos = false keeps what is told)",
            listed(names, MOST_NAMED)
        )
    })
}

/// Whether an image's camera is a guess that fewer than [`MIN_PHOTOS`] images share.
fn is_lone_guess(images: &[SourceImage], image: &SourceImage) -> bool {
    let alike = images.iter().filter(|other| other.is_guess(&image.camera)).count();
    image.calibration == Calibration::Guessed && alike < MIN_PHOTOS
}

/// Guesses that a first model of the photos is to improve: those that photos do not share, else, where the set does not
/// localize its target, all that nothing has improved yet.
///
/// Local models are made of pairs that were verified with the guess, and where hardly anything of the scene is seen a model
/// that is bent by a guess a tenth off agrees with nothing of it.
fn doubtful_guesses(images: &[SourceImage], located: &Located, target: &str) -> Vec<bool> {
    let photos = located.set.iter().flat_map(|set| &set.refined);
    let is_found =
        photos.into_iter().any(|photo| photo.name == target && photo.verdict == Verdict::Localized);
    if is_found || located.divided.contains(&true) {
        return located.divided.clone();
    }
    let is_open =
        |image: &SourceImage| image.calibration == Calibration::Guessed && image.camera.is_bare_guess();
    images.iter().map(is_open).collect()
}

/// Puts what photos that are localized alone tell of their cameras in place of guesses; meant for those that few photos
/// share.
///
/// Such a camera has but what its own photos show to be estimated from, and along a street photos among themselves tell
/// focal lengths poorly: a longer one and a step ahead look much the same.
fn improve_guesses(images: &mut [SourceImage], which: &[bool], alone: &[PhotoLocalization]) {
    for (image, _) in images.iter_mut().zip(which).filter(|(_, is_meant)| **is_meant) {
        let tells =
            |photo: &&PhotoLocalization| photo.verdict == Verdict::Localized && photo.name == image.name;
        if let Some(photo) = alone.iter().find(tells) {
            image.camera.clone_from(&photo.camera);
        }
    }
}

/// Puts the cameras of a first model of the photos, as scenes have one, in place of guesses; meant for those that few photos
/// share, or photos of several cameras.
///
/// A guess is a third too long or more, and pairs that are verified with it lose what lies off one wall.
fn improve_by_model(
    session: &Session,
    images: &mut [SourceImage],
    which: &[bool],
    what: &LocateJobs,
    name: &str,
) -> Result<RunResult> {
    let config = Config { features: what.config.photo_features(), ..what.config.clone() };
    let (alike, before) = alike_pairs(session, name, images, &config.features, &config)?;
    let inputs = SceneInputs { images, alike: &alike, config: &config, seed: what.seed };
    let (told, run) = estimate_cameras(session, name, inputs)?;
    let told = told.into_iter().flatten();
    for ((image, told), _) in images.iter_mut().zip(told).zip(which).filter(|(_, is_meant)| **is_meant) {
        image.camera = told.camera;
    }
    Ok(before.and(run))
}

/// The images with the cameras that a set's localization tells in place of guessed ones; `None` when it tells none.
///
/// Photos of one guess have one camera: that of the component in which most scene points place localized photos of
/// theirs, else photos whose pose is uncertain. One that few photos tell replaces the guess and is a guess itself: what
/// the local model shows of it counts as well. So is that of a wide lens, which may turn out to be a fisheye.
///
/// Photos that the local model divides have the one that they show themselves.
fn with_estimated_cameras(
    images: &[SourceImage],
    divided: &[bool],
    set: Option<&SetLocalization>,
) -> Option<Vec<SourceImage>> {
    let placed: BTreeMap<&str, &PhotoLocalization> = set?.refined.iter().map(|p| (&*p.name, p)).collect();
    let told = |at: usize| {
        let guess = &images[at].camera;
        let mut support: Vec<(&Camera, [usize; 2], usize)> = Vec::new();
        let alone = (divided.get(at) == Some(&true)).then_some(at);
        let alike = images.iter().enumerate().filter(|(other, _)| alone.is_none_or(|at| at == *other));
        let alike = alike.map(|(_, image)| image).filter(|image| image.is_guess(guess));
        for photo in alike.filter_map(|image| placed.get(&*image.name)) {
            let [localized, uncertain] = match photo.verdict {
                Verdict::Localized => [photo.inliers, 0],
                Verdict::Uncertain => [0, photo.inliers],
                Verdict::NotLocalized => continue,
            };
            let known = support.iter().position(|(camera, ..)| **camera == photo.camera);
            let at = known.unwrap_or(support.len());
            if known.is_none() {
                support.push((&photo.camera, [0; 2], 0));
            }
            support[at].1[0] += localized;
            support[at].1[1] += uncertain;
            support[at].2 += 1;
        }
        let (camera, _, photos) = support.into_iter().max_by_key(|(_, points, _)| *points)?;
        let is_open = photos < MIN_PHOTOS || camera.may_be_fisheye();
        let calibration = if is_open { Calibration::Guessed } else { Calibration::Estimated };
        Some((camera.clone().with_tangential_distortion(), calibration))
    };
    with_told_cameras(images, told)
}

/// Photos that tell a camera well enough for models of photos to take it as it is.
const MIN_PHOTOS: usize = 3;

/// Whether the scene has still to tell what cameras these are.
fn are_untold(images: &[SourceImage]) -> bool {
    let is_told = |image: &SourceImage| image.camera_origin == CameraOrigin::Estimated;
    !images.iter().all(|image| image.calibration.is_settled()) && !images.iter().any(is_told)
}

/// Runs one graph: each photo alone, the set, or both.
fn run(
    session: &Session,
    folder: &ImageFolder,
    what: &LocateJobs,
    (name, target): (&str, &str),
    (alone, as_set): (bool, bool),
    located: &mut Located,
) -> Result<RunResult> {
    let LocateGraph { graph, jobs: LocatedJobs { features, single, set }, before } =
        LocateGraph::new(session, folder, what, (name, target), as_set)?;
    session.run(name, &graph, |executor, result| {
        for (photo, job) in folder.images.iter().zip(&features) {
            let known = located.skipped.iter().any(|skipped| skipped.name == photo.name);
            if let (Some(reason), false) = (result.failed.get(&graph.job(*job).label()), known) {
                located.skipped.push(SkippedImage { name: photo.name.clone(), reason: reason.clone() });
            }
        }
        for jobs in single.iter().filter(|_| alone) {
            let made = executor.load_made::<AnywhereLocalization>(jobs.single)?;
            located.single.extend(made.map(|found| found.photo.clone()));
        }
        if let Some(set) = set.filter(|set| executor.output(set.set).is_some()) {
            located.set = Some((*executor.load::<SetLocalization>(set.set)?).clone());
            let model = executor.load::<MapperOutput>(set.model.model)?;
            located.local_models = model.components.iter().map(|c| c.registered().count()).collect();
            located.divided = divided_guesses(&folder.images, &model);
            located.carried = said_of_carried(executor, &set.model.carried, &folder.images)?;
        }
        Ok(before.and(result.clone()))
    })
}

/// The jobs that locate photos, and what finding their pairs took.
struct LocateGraph<'a> {
    graph: JobGraph<'a>,
    jobs: LocatedJobs,
    before: RunResult,
}

impl LocateGraph<'_> {
    fn new(
        session: &Session,
        folder: &ImageFolder,
        what: &LocateJobs,
        (name, target): (&str, &str),
        as_set: bool,
    ) -> Result<Self> {
        let photos = what.config.photo_features();
        let (alike, before) = if as_set {
            alike_pairs(session, name, &folder.images, &photos, &what.config)?
        } else {
            (Vec::new(), RunResult::default())
        };
        let mut graph = JobGraph::default();
        let jobs = if as_set {
            let mut what = what.clone();
            if are_untold(&folder.images) {
                // What this tells of the cameras is for locating it again; what needs them well is left for then.
                what.config.alignment.enabled = false;
                what.config.sfm.continue_planes = false;
            }
            let set = add_set(&mut graph, target, &folder.images, &alike, &what)?;
            LocatedJobs { features: set.model.features.clone(), single: set.single.clone(), set: Some(set) }
        } else {
            let features = add_features_of(&mut graph, &folder.images, &photos);
            let single = add_singles(&mut graph, &folder.images, &features, what);
            LocatedJobs { features, single, set: None }
        };
        Ok(Self { graph, jobs, before })
    }
}

/// A scene that has grown.
pub struct Grown {
    /// The scene.
    pub scene: Arc<SceneFile>,
    /// The bytes of its file.
    pub file: Arc<Vec<u8>>,
    /// Their content hash.
    pub hash: ContentHash,
}

/// Adds those photos to the scene that are localized in its largest component and not in it yet; `None` when there are
/// none.
///
/// The photos are those just located, under another name of a run.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn grow(
    session: &Session,
    folder: &ImageFolder,
    what: &LocateJobs,
    (name, target): (&str, &str),
    located: &Located,
) -> Result<Option<Grown>> {
    let is_new = |name: &str| {
        let photo = folder.images.iter().find(|photo| photo.name == name);
        photo.is_some_and(|photo| !what.scene.grown_from.contains(&photo.hash))
    };
    let adds = |photo: &PhotoLocalization| {
        photo.verdict == Verdict::Localized && photo.component == 0 && is_new(&photo.name)
    };
    if !located.answers().iter().any(|(_, photo)| adds(photo)) {
        return Ok(None);
    }
    let LocateGraph { mut graph, jobs, before } =
        LocateGraph::new(session, folder, what, (name, target), located.set.is_some())?;
    let grown = add_grown(&mut graph, target, &folder.images, &jobs, !located.single.is_empty(), what)?;
    graph.want(grown);
    graph.want_file(grown);
    session.run(name, &graph, |executor, run| {
        session.remember(name, &before.and(run.clone()));
        let Some(hash) = executor.output(grown) else {
            let reasons: Vec<String> =
                run.failed.iter().map(|(job, reason)| format!("{job}: {reason}")).collect();
            anyhow::bail!("the scene could not grow: {}", reasons.join("; "));
        };
        Ok(Some(Grown { scene: executor.load(grown)?, file: executor.file::<SceneFile>(grown)?, hash }))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An answer of a photo with this focal length and so many matches.
    fn answer(name: &str, focal: f64, inliers: usize, verdict: Verdict) -> PhotoLocalization {
        PhotoLocalization {
            name: name.to_owned(),
            camera: Camera::from_focal_guess(1600, 1200, focal),
            component: 0,
            world_from_camera: None,
            covariance: None,
            inliers,
            verdict,
            reasons: Vec::new(),
        }
    }

    #[test]
    fn focal_lengths_that_most_matches_show_otherwise_hold_for_all_photos_of_the_camera() {
        let told = Camera::from_focal_guess(1600, 1200, 1000.0);
        let other = Camera::from_focal_guess(1600, 1200, 1111.0);
        let image = |name: &str, camera: &Camera| SourceImage {
            calibration: Calibration::Known,
            ..SourceImage::guessed(name, camera.clone())
        };
        let images =
            [image("a", &told), image("b", &told), image("c", &told), image("d", &told), image("k", &other)];
        let answers = |of_b: usize| {
            [
                answer("a", 1030.0, 200, Verdict::Localized),
                answer("b", 1000.0, of_b, Verdict::Localized),
                answer("c", 1040.0, 50, Verdict::Localized),
                answer("d", 700.0, 900, Verdict::Uncertain),
                answer("k", 1111.0, 100, Verdict::Localized),
            ]
        };
        let shown = shown_otherwise(&images, &answers(240)).expect("most matches show another one");
        let focals = shown.images.iter().map(|image| image.camera.focal_length()).collect::<Vec<f64>>();
        assert_eq!(focals, [1030.0, 1030.0, 1030.0, 1030.0, 1111.0]);
        assert_eq!(shown.witnesses.iter().collect::<Vec<_>>(), ["a", "c"]);
        let said = "the focal length that is told for a, b, c, d is 1000.0 px; a, c show 1030.0 px (+3.0 %), which is used";
        assert_eq!(shown.said, [said]);
        assert!(shown_otherwise(&images, &answers(260)).is_none());
        let mut again = answers(240).to_vec();
        keep_own(&mut again, vec![answer("a", 1031.0, 1, Verdict::Localized)], &shown);
        assert_eq!(again[0].camera.focal_length(), 1031.0);
        assert_eq!(again[2].camera.focal_length(), 1040.0);
    }

    #[test]
    fn guessed_cameras_become_those_that_most_of_the_scene_tells() {
        use Verdict::{Localized, NotLocalized, Uncertain};

        let guess = Camera::from_focal_guess(1600, 1200, 1920.0);
        let known = Camera::from_focal_guess(1600, 1200, 1111.0);
        let image = |name: &str, camera: &Camera, calibration| SourceImage {
            calibration,
            ..SourceImage::guessed(name, camera.clone())
        };
        let guessed = |name: &str| image(name, &guess, Calibration::Guessed);
        let images =
            [guessed("a"), guessed("b"), guessed("c"), guessed("d"), image("k", &known, Calibration::Known)];
        let told = |refined: Vec<PhotoLocalization>| {
            let set = SetLocalization { refined, ..SetLocalization::default() };
            let images = with_estimated_cameras(&images, &[], Some(&set))?;
            assert_eq!((&images[4].camera, images[4].calibration), (&known, Calibration::Known));
            let same = |image: &SourceImage| {
                (&image.camera, image.calibration) == (&images[0].camera, images[0].calibration)
            };
            assert!(images[..4].iter().all(same));
            Some((images[0].camera.focal_length(), images[0].calibration))
        };
        let by_two = vec![
            answer("a", 1500.0, 60, Localized),
            answer("b", 1200.0, 50, Localized),
            answer("c", 1200.0, 20, Localized),
            answer("d", 900.0, 500, Uncertain),
        ];
        let by_three: Vec<_> =
            by_two.iter().cloned().chain([answer("a", 1200.0, 9, Localized)]).skip(1).collect();
        assert_eq!(told(by_three), Some((1200.0, Calibration::Estimated)));
        // What few photos tell is a guess still.
        assert_eq!(told(by_two), Some((1200.0, Calibration::Guessed)));
        let uncertain = vec![answer("a", 1500.0, 9, Uncertain), answer("b", 1920.0, 0, NotLocalized)];
        assert_eq!(told(uncertain), Some((1500.0, Calibration::Guessed)));
        assert_eq!(told(vec![answer("a", 1500.0, 0, NotLocalized)]), None);
        assert_eq!(told(vec![answer("k", 1111.0, 99, Localized)]), None);
        assert!(with_estimated_cameras(&images, &[], None).is_none());
        // Photos that do not share the guess have what each shows.
        let refined = vec![
            answer("a", 1500.0, 60, Localized),
            answer("b", 1200.0, 50, Localized),
            answer("c", 1200.0, 20, Localized),
        ];
        let set = SetLocalization { refined, ..SetLocalization::default() };
        let told = with_estimated_cameras(&images, &[true; 5], Some(&set)).expect("three are told");
        let focal: Vec<f64> = told.iter().map(|image| image.camera.focal_length()).collect();
        assert_eq!(focal, [1500.0, 1200.0, 1200.0, 1920.0, 1111.0]);
        assert!(told[..3].iter().all(|image| image.calibration == Calibration::Guessed));
    }

    #[test]
    fn photos_of_a_camera_that_the_scene_contradicts_have_what_it_shows() {
        let [told, used, other] = [1000.0, 1010.0, 1200.0].map(|f| Camera::from_focal_guess(1600, 1200, f));
        let image = |name: &str, camera: &Camera, calibration| SourceImage {
            calibration,
            ..SourceImage::guessed(name, camera.clone())
        };
        let mut images = [
            image("a", &told, Calibration::Known),
            image("b", &other, Calibration::Known),
            image("c", &told, Calibration::Guessed),
        ];
        let corrections = [CorrectedCamera { told: told.clone(), used: used.clone() }];
        assert_eq!(correct_told(&mut images, &corrections), ["a"]);
        assert_eq!(images.each_ref().map(|image| &image.camera), [&used, &other, &told]);
        assert_eq!(images[0].calibration, Calibration::Known);
        // What they have now is no longer what they were told.
        assert!(correct_told(&mut images, &corrections).is_empty());
        assert_eq!(said_of_corrected(&[]), None);
        assert!(said_of_corrected(&["a".to_owned()]).expect("one").starts_with("a: told the intrinsics"));
    }

    #[test]
    fn what_a_photo_alone_tells_of_its_camera_replaces_a_guess_that_few_share() {
        let image = |name: &str, width: u32| {
            SourceImage::guessed(name, Camera::from_focal_guess(width, 1200, 1.2 * f64::from(width)))
        };
        let photo = |name: &str, width: u32, verdict| PhotoLocalization {
            name: name.to_owned(),
            camera: Camera::from_focal_guess(width, 1200, 1000.0),
            component: 0,
            world_from_camera: None,
            covariance: None,
            inliers: 40,
            verdict,
            reasons: Vec::new(),
        };
        let mut images: Vec<SourceImage> = [("a", 1600), ("b", 1600), ("c", 1600), ("d", 1280), ("e", 1920)]
            .map(|(n, w)| image(n, w))
            .into();
        let alone = [
            photo("a", 1600, Verdict::Localized),
            photo("d", 1280, Verdict::Localized),
            photo("e", 1920, Verdict::Uncertain),
        ];
        let lone: Vec<bool> = images.iter().map(|image| is_lone_guess(&images, image)).collect();
        assert_eq!(lone, [false, false, false, true, true]);
        improve_guesses(&mut images, &lone, &alone);
        let focal: Vec<f64> = images.iter().map(|image| image.camera.focal_length()).collect();
        assert_eq!(focal, [1920.0, 1920.0, 1920.0, 1000.0, 2304.0]);
        assert!(are_untold(&images));
    }

    #[test]
    fn a_photo_that_its_set_places_elsewhere_is_no_longer_localized() {
        let photo = |name: &str, verdict| PhotoLocalization {
            name: name.to_owned(),
            camera: Camera::equirectangular(20, 10),
            component: 0,
            world_from_camera: None,
            covariance: None,
            inliers: 0,
            verdict,
            reasons: Vec::new(),
        };
        let set = |contradicted: &[&str]| SetLocalization {
            refined: vec![photo("a", Verdict::Uncertain), photo("b", Verdict::Uncertain)],
            contradicted: contradicted.iter().map(|name| (*name).to_owned()).collect(),
            ..SetLocalization::default()
        };
        let located = |contradicted: &[&str]| Located {
            single: vec![photo("a", Verdict::Localized), photo("b", Verdict::Localized)],
            set: Some(set(contradicted)),
            ..Located::default()
        };
        let verdicts =
            |located: &Located| located.answers().iter().map(|(_, photo)| photo.verdict).collect::<Vec<_>>();
        assert_eq!(verdicts(&located(&[])), [Verdict::Localized, Verdict::Localized]);
        assert_eq!(verdicts(&located(&["b"])), [Verdict::Localized, Verdict::Uncertain]);
    }
}
