//! Builds a scene: from a list of images to the scene file.

mod nothing;

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Result;
use rayon::prelude::*;
use setloc_features::{Calibration, Camera, ImageFeatures};
use setloc_sfm::{ImageId, MapperOutput, Reconstruction};

use crate::artifacts::{LeftApart, LikelyImages};
use crate::config::Config;
use crate::dataset::{ImageFolder, SkippedImage, SourceImage, with_told_cameras};
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::graph::{Executor, JobGraph, RunResult};
use crate::jobs::{
    ApartJob, LikelyJobs, SceneInputs, SceneJobs, SceneModelJobs, add_first_model, add_scene, said_of_carried,
};
use crate::scene::SceneFile;
use crate::session::Session;
use crate::stages::FeatureParams;
use crate::text::some_of;
use crate::turning::guess_by_turns;

/// A scene that was built, or found built.
pub struct Built {
    /// The scene.
    pub scene: Arc<SceneFile>,
    /// The bytes of its file.
    pub file: Arc<Vec<u8>>,
    /// Its content hash.
    pub hash: ContentHash,
    /// Images that are not in it, and why.
    pub skipped: Vec<SkippedImage>,
    /// What is odd about what was found in the images.
    pub warnings: Vec<String>,
    /// Features by image name.
    pub features: BTreeMap<String, Arc<ImageFeatures>>,
    /// What ran.
    pub run: RunResult,
}

/// What a build came to.
pub enum BuildOutcome {
    /// The result is the one with the expected hash, and not read: what ran, and images and warnings as in [`Built`].
    Unchanged(RunResult, Vec<SkippedImage>, Vec<String>),
    /// The scene.
    Built(Box<Built>),
}

/// What a scene is built from, and how.
#[derive(Clone, Copy)]
pub struct SceneSource<'a> {
    /// The images.
    pub folder: &'a ImageFolder,
    /// All parameters.
    pub config: &'a Config,
    /// Seed of what is drawn.
    pub seed: u64,
    /// What the run is remembered by.
    pub name: &'a str,
    /// The hash of the scene that the output already has, which is not read if it is the result.
    pub present: Option<ContentHash>,
}

/// Builds a scene; with the hash that the output already has, an unchanged scene is not read.
///
/// Where intrinsics are a guess, the images are mapped twice: the second time their pairs are verified, and the model is
/// begun, with the cameras that the first model told.
///
/// Where the model is torn, which tells less than half of the images' relative poses, those that it leaves out of its largest
/// component are looked at once more ([`Config::second_features`]), and the scene is mapped again. Of the two models that
/// stays which tells more, the first if both tell as much.
///
/// `export` gets the scene while its last results are still being kept.
///
/// # Errors
/// When no image is usable, the run was stopped or the store cannot be written; or as `export` does.
pub fn build_scene(
    session: &Session,
    source: SceneSource<'_>,
    export: impl FnMut(&Built) -> Result<()>,
) -> Result<BuildOutcome> {
    let SceneSource { folder, config, seed, name, .. } = source;
    let (alike, before) = alike_pairs(session, name, &folder.images, &config.features, config)?;
    let given = SceneInputs { images: &folder.images, alike: &alike, config, seed };
    let (calibrated, first) = estimate_cameras(session, name, given)?;
    let images = calibrated.as_deref().unwrap_or(&folder.images);
    let mut passes = Passes { session, source, alike: &alike, run: before.and(first), export };
    let outcome =
        by_passes(config, images, |text| session.note(text), |images, stays| passes.pass(images, stays))?;
    session.remember(name, &passes.run);
    outcome
}

/// Whether a pass stays, by what its model leaves apart.
type Stays<'a> = dyn Fn(&LeftApart) -> bool + Send + Sync + 'a;

/// What a pass over the images of a scene came to.
pub enum Pass<T> {
    /// It stays, with this.
    Stays(T),
    /// What its model leaves apart, which rules it out, and the images for another pass.
    Leaves(LeftApart, Vec<SourceImage>),
}

/// What the pass that stays comes to: the first; where its model is torn that with a second look, if it tells more.
///
/// # Errors
/// As `pass` does.
pub fn by_passes<T>(
    config: &Config,
    images: &[SourceImage],
    note: impl Fn(String),
    mut pass: impl FnMut(&[SourceImage], &Stays<'_>) -> Result<Pass<T>>,
) -> Result<T> {
    let (first, again) = match pass(images, &|left| !config.looks_again(left))? {
        Pass::Stays(made) => return Ok(made),
        Pass::Leaves(first, again) => (first, again),
    };
    note(format!(
        "{} of {} images are apart from the largest component and looked at once more (second_look)",
        first.images.len(),
        images.len()
    ));
    if let Pass::Stays(made) = pass(&again, &|second| second.tells_more_than(&first))? {
        return Ok(made);
    }
    note("no more images came together by that, and the first model stays".to_owned());
    // All of it is stored.
    match pass(images, &|_| true)? {
        Pass::Stays(made) => Ok(made),
        Pass::Leaves(..) => anyhow::bail!("the last pass did not stay: this is a bug"),
    }
}

/// The passes that a scene is built in.
struct Passes<'a, Export> {
    session: &'a Session,
    source: SceneSource<'a>,
    alike: &'a [(usize, usize)],
    /// What ran so far.
    run: RunResult,
    /// Called with the scene that stays.
    export: Export,
}

impl<Export: FnMut(&Built) -> Result<()>> Passes<'_, Export> {
    /// Builds a scene of these images, which stays if what its model leaves apart is such.
    fn pass(&mut self, images: &[SourceImage], stays: &Stays<'_>) -> Result<Pass<Result<BuildOutcome>>> {
        let SceneSource { folder, config, seed, name, present } = self.source;
        let mut graph = JobGraph::default();
        let inputs = SceneInputs { images, alike: self.alike, config, seed };
        let jobs = add_scene(&mut graph, inputs)?;
        graph.want(jobs.scene);
        graph.want_file(jobs.scene);
        graph.want(jobs.apart.job);
        // It tells why nothing is registered.
        graph.want(jobs.model);
        jobs.finish_only_where(&mut graph, stays);
        jobs.features.iter().for_each(|features| graph.want(*features));
        let (before, export) = (&self.run, &mut self.export);
        let use_results = |executor: &Executor<'_>, run: &RunResult| -> Result<Pass<Result<BuildOutcome>>> {
            let left = executor.load_made::<LeftApart>(jobs.apart.job)?;
            if let Some(left) = left.filter(|left| !stays(left)) {
                let again = jobs.apart.looked_at_again(images, &left);
                return Ok(Pass::Leaves((*left).clone(), again));
            }
            let run = &before.clone().and(run.clone());
            let outcome = outcome_of(executor, &graph, &jobs, folder, run, present)?;
            if let BuildOutcome::Built(built) = &outcome {
                export(built)?;
            }
            Ok(Pass::Stays(Ok(outcome)))
        };
        let (run, pass) = self.session.run_with(name, &graph, use_results)?;
        self.run.absorb(run);
        Ok(pass.unwrap_or_else(|error| Pass::Stays(Err(error))))
    }
}

/// What the model of a scene leaves apart, and the images for another pass; what that takes is read where it is stored.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn left_apart(
    session: &Session,
    name: &str,
    (graph, apart): (&JobGraph<'_>, &ApartJob),
    images: &[SourceImage],
) -> Result<Option<(LeftApart, Vec<SourceImage>)>> {
    session.run(name, graph, |executor, _| {
        let left = executor.load_made::<LeftApart>(apart.job)?;
        Ok(left.map(|left| ((*left).clone(), apart.looked_at_again(images, &left))))
    })
}

/// Pairs of images that look alike, where pairs cannot be chosen without, and what finding them took.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn alike_pairs(
    session: &Session,
    name: &str,
    images: &[SourceImage],
    features: &FeatureParams,
    config: &Config,
) -> Result<(Vec<(usize, usize)>, RunResult)> {
    let mut graph = JobGraph::default();
    let Some(jobs) = LikelyJobs::add(&mut graph, "all", images, features, config)? else {
        return Ok((Vec::new(), RunResult::default()));
    };
    session.run(name, &graph, |executor, run| {
        let found = executor.load_made::<LikelyImages>(jobs.likely)?;
        Ok((found.map(|found| jobs.pairs(&found)).unwrap_or_default(), run.clone()))
    })
}

/// Whether a scene of these images is mapped twice.
pub fn has_guessed_cameras(images: &[SourceImage]) -> bool {
    images.iter().any(|image| image.calibration == Calibration::Guessed)
}

/// The images with the cameras that a first model tells in place of guessed ones, `None` when it tells none, and what that
/// model took.
///
/// Where images seem not to share a guess, a second model with what the first tells shows whether they do.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn estimate_cameras(
    session: &Session,
    name: &str,
    inputs: SceneInputs<'_>,
) -> Result<(Option<Vec<SourceImage>>, RunResult)> {
    if !has_guessed_cameras(inputs.images) {
        return Ok((None, RunResult::default()));
    }
    let mut images = inputs.images.to_vec();
    let by_turns = if asks_turns(&images) {
        let SceneInputs { alike, config, seed, .. } = inputs;
        guess_by_turns(session, name, &mut images, alike, (&config.features, config), seed)?
    } else {
        RunResult::default()
    };
    let first = tell_cameras(session, name, SceneInputs { images: &images, ..inputs })?;
    let run = by_turns.and(first.run);
    let told = match first.told {
        Some(told) if first.is_doubtful => told,
        told => return Ok((told, run)),
    };
    let second = tell_cameras(session, name, SceneInputs { images: &told, ..inputs })?;
    Ok((Some(second.told.unwrap_or(told)), run.and(second.run)))
}

/// Whether turns on the spot are asked for focal lengths: where pairs are chosen by place, others need not be matched.
pub fn asks_turns(images: &[SourceImage]) -> bool {
    images.iter().all(|image| image.position.is_none())
}

/// What a first model tells of cameras.
#[derive(Debug)]
pub struct ToldCameras {
    /// The images with its cameras in place of guessed ones; `None` where it tells none.
    pub told: Option<Vec<SourceImage>>,
    /// Whether images seem not to share a guess, which a second model with these cameras shows.
    pub is_doubtful: bool,
    /// What it took.
    pub run: RunResult,
}

/// Maps images with the cameras that they have to tell those that are guessed.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn tell_cameras(session: &Session, name: &str, inputs: SceneInputs<'_>) -> Result<ToldCameras> {
    let mut graph = JobGraph::default();
    let jobs = add_first_model(&mut graph, inputs)?;
    session.run(name, &graph, |executor, run| {
        let model = executor.load_made::<MapperOutput>(jobs.model)?;
        let is_doubtful = model.as_ref().is_some_and(|model| !model.report.doubtful.is_empty());
        let told = model.and_then(|model| with_estimated_cameras(inputs.images, &jobs, &model));
        Ok(ToldCameras { told, is_doubtful, run: run.clone() })
    })
}

/// Images of a camera that tell it well enough to replace a guess.
const MIN_IMAGES: usize = 3;

/// The images with the cameras of a model in place of guessed ones; `None` when it tells none.
///
/// Images of one guess have one camera: that of the component that has registered most of them. Where they have several
/// there, each registered image has its own, and the others keep the guess.
fn with_estimated_cameras(
    images: &[SourceImage],
    jobs: &SceneModelJobs,
    model: &MapperOutput,
) -> Option<Vec<SourceImage>> {
    let registered = |component: &Reconstruction, guess: &Camera| -> Vec<(usize, ImageId)> {
        let given = |id: ImageId| Some((jobs.image_given(&component.images[id.index()])?, id));
        let is_of_guess = |(at, _): &(usize, ImageId)| images.get(*at).is_some_and(|i| i.is_guess(guess));
        component.registered().filter_map(given).filter(is_of_guess).collect()
    };
    let told = |at: usize| {
        let guess = &images[at].camera;
        // Of equal numbers the last counts most: that of the larger component.
        let found = model.components.iter().rev().map(|component| (component, registered(component, guess)));
        let (component, alike) = found.max_by_key(|(_, alike)| alike.len())?;
        let camera_of = |id: ImageId| component.images[id.index()].camera;
        let &(_, first) = alike.first()?;
        let have_one = alike.iter().all(|(_, id)| camera_of(*id) == camera_of(first));
        let shown_by =
            if have_one { first } else { alike.iter().find(|(given, _)| *given == at).map(|(_, id)| *id)? };
        let sharing: Vec<ImageId> =
            alike.iter().map(|(_, id)| *id).filter(|id| camera_of(*id) == camera_of(shown_by)).collect();
        let is_told = sharing.len() >= MIN_IMAGES || component.tells_camera_of(&sharing);
        is_told.then(|| (component.camera_of(shown_by).clone(), Calibration::Guessed))
    };
    with_told_cameras(images, told)
}

/// What the jobs came to; the scene is read unless it is `present`.
fn outcome_of(
    executor: &Executor<'_>,
    graph: &JobGraph<'_>,
    jobs: &SceneJobs,
    folder: &ImageFolder,
    run: &RunResult,
    present: Option<ContentHash>,
) -> Result<BuildOutcome> {
    let mut skipped = folder.skipped.clone();
    for (image, job) in folder.images.iter().zip(&jobs.features) {
        if let Some(reason) = run.failed.get(&graph.job(*job).label()) {
            skipped.push(SkippedImage { name: image.name.clone(), reason: reason.clone() });
        }
    }
    if skipped.len() == folder.skipped.len() + folder.images.len() {
        let reasons: Vec<String> = skipped.iter().map(|s| format!("{}: {}", s.name, s.reason)).collect();
        let message = format!("no usable image: {}", reasons.join("; "));
        return Err(Hinted::error(message, "check the files with an image viewer"));
    }
    let Some(hash) = executor.output(jobs.scene) else {
        let reasons: Vec<String> =
            run.failed.iter().map(|(job, reason)| format!("{job}: {reason}")).collect();
        anyhow::bail!("the scene could not be made: {}", reasons.join("; "));
    };
    let carried = said_of_carried(executor, &jobs.carried, &folder.images)?;
    let nothing = nothing::why_nothing(executor, jobs, &folder.images)?;
    let masked = masked_out(executor, folder, jobs)?;
    let warnings: Vec<String> = nothing.into_iter().chain(masked).chain(carried).collect();
    if present == Some(hash) {
        return Ok(BuildOutcome::Unchanged(run.clone(), skipped, warnings));
    }
    let load_features = || {
        let made = folder.images.par_iter().with_max_len(1).zip(&jobs.features);
        let made = made.filter(|(_, job)| executor.output(**job).is_some());
        made.map(|(image, job)| Ok((image.name.clone(), executor.load::<ImageFeatures>(*job)?))).collect()
    };
    let load_scene =
        || Ok((executor.load::<SceneFile>(jobs.scene)?, executor.file::<SceneFile>(jobs.scene)?));
    let (scene, features): (Result<_>, Result<BTreeMap<_, _>>) = rayon::join(load_scene, load_features);
    let ((scene, file), features) = (scene?, features?);
    Ok(BuildOutcome::Built(Box::new(Built {
        scene,
        file,
        hash,
        skipped,
        warnings,
        features,
        run: run.clone(),
    })))
}

/// Keypoints below which an image can hardly be matched.
const MIN_KEYPOINTS: usize = 50;

/// Says which masks leave next to nothing of their images.
fn masked_out(executor: &Executor<'_>, folder: &ImageFolder, jobs: &SceneJobs) -> Result<Option<String>> {
    let mut images = Vec::new();
    let masked = folder.images.iter().zip(&jobs.features).filter(|(image, _)| image.mask.is_some());
    for (image, job) in masked {
        let found = executor.load_made::<ImageFeatures>(*job)?.map(|features| features.len());
        if let Some(found) = found.filter(|found| *found < MIN_KEYPOINTS) {
            images.push(format!("{} ({found} keypoints)", image.name));
        }
    }
    let text = format!("masks leave next to nothing of images: {}", some_of(&images, "images"));
    Ok(Some(text).filter(|_| !images.is_empty()))
}
