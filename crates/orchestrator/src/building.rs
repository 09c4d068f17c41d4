//! Builds a scene: from a list of images to the scene file.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Result;
use rayon::prelude::*;
use setloc_features::ImageFeatures;

use crate::artifacts::LikelyImages;
use crate::config::Config;
use crate::dataset::{ImageFolder, SkippedImage, SourceImage};
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::graph::{Executor, JobGraph, RunResult};
use crate::jobs::{LikelyJobs, SceneJobs, add_scene};
use crate::scene::SceneFile;
use crate::session::Session;
use crate::stages::FeatureParams;

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
    /// Features by image name.
    pub features: BTreeMap<String, Arc<ImageFeatures>>,
    /// What ran.
    pub run: RunResult,
}

/// What a build came to.
pub enum BuildOutcome {
    /// The result is the one with the expected hash: nothing was read.
    Unchanged(RunResult, Vec<SkippedImage>),
    /// The scene.
    Built(Box<Built>),
}

/// Builds a scene; with the hash that the output already has, an unchanged scene is not read.
///
/// `export` gets the scene while its last results are still being kept.
///
/// # Errors
/// When no image is usable, the run was stopped or the store cannot be written; or as `export` does.
pub fn build_scene(
    session: &Session,
    folder: &ImageFolder,
    config: &Config,
    seed: u64,
    name: &str,
    present: Option<ContentHash>,
    export: impl FnOnce(&Built) -> Result<()>,
) -> Result<BuildOutcome> {
    let (alike, before) = alike_pairs(session, name, &folder.images, &config.features, config)?;
    let mut graph = JobGraph::default();
    let jobs = add_scene(&mut graph, &folder.images, &alike, config, seed)?;
    graph.want(jobs.scene);
    graph.want_file(jobs.scene);
    jobs.features.iter().for_each(|features| graph.want(*features));
    let use_results = |executor: &Executor<'_>, run: &RunResult| {
        let run = &before.clone().and(run.clone());
        let outcome = outcome_of(executor, &graph, &jobs, folder, run, present)?;
        if let BuildOutcome::Built(built) = &outcome {
            export(built)?;
        }
        Ok(outcome)
    };
    let (run, outcome) = session.run_with(name, &graph, use_results)?;
    session.remember(name, &before.and(run))?;
    outcome
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
        let found =
            executor.output(jobs.likely).map(|_| executor.load::<LikelyImages>(jobs.likely)).transpose()?;
        Ok((found.map(|found| jobs.pairs(&found)).unwrap_or_default(), run.clone()))
    })
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
    if present == Some(hash) {
        return Ok(BuildOutcome::Unchanged(run.clone(), skipped));
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
    Ok(BuildOutcome::Built(Box::new(Built { scene, file, hash, skipped, features, run: run.clone() })))
}
