//! Locates photos in a scene: alone, as a set, or as a set when alone fails.

use std::collections::BTreeMap;

use anyhow::Result;
use setloc_camset::{PhotoLocalization, SetLocalization, SingleLocalization, Verdict};
use setloc_sfm::MapperOutput;

use crate::building::alike_pairs;
use crate::dataset::{ImageFolder, SkippedImage};
use crate::graph::{JobGraph, JobId, RunResult};
use crate::jobs::{LocateJobs, add_features_of, add_set, add_singles};
use crate::session::Session;

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
}

impl Located {
    /// The best answer for each photo with the method that gave it: camset+opt, else camset, else alone.
    ///
    /// A photo whose own answer the set contradicts has the set's, which says so.
    pub fn answers(&self) -> Vec<(&'static str, &PhotoLocalization)> {
        let refined = self.set.iter().flat_map(|set| set.refined.iter().map(|p| ("camset+opt", p)));
        let rigid = self.set.iter().flat_map(|set| set.rigid.iter().map(|p| ("camset", p)));
        let contradicted = |photo: &&PhotoLocalization| {
            self.set.as_ref().is_some_and(|set| set.contradicted.contains(&photo.name))
        };
        let single = self.single.iter().filter(|photo| !contradicted(photo)).map(|p| ("single", p));
        let mut best: BTreeMap<&str, (&'static str, &PhotoLocalization)> = BTreeMap::new();
        for (method, photo) in single.chain(rigid).chain(refined) {
            let better = |old: &PhotoLocalization| photo.verdict.rank() >= old.verdict.rank();
            if best.get(photo.name.as_str()).is_none_or(|(_, old)| better(old)) {
                best.insert(&photo.name, (method, photo));
            }
        }
        best.into_values().collect()
    }
}

/// Locates photos; `target` is the photo that decides in [`Mode::Auto`].
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn locate(
    session: &Session,
    folder: &ImageFolder,
    what: &LocateJobs,
    mode: Mode,
    name: &str,
    target: &str,
) -> Result<Located> {
    let (skipped, warnings) = (folder.skipped.clone(), folder.warnings.clone());
    let mut located = Located { skipped, warnings, ..Located::default() };
    let mut whole = RunResult::default();
    if matches!(mode, Mode::Auto | Mode::Single) {
        whole.absorb(run(session, folder, what, (name, target), (true, false), &mut located)?);
    }
    let found =
        located.single.iter().any(|photo| photo.name == target && photo.verdict == Verdict::Localized);
    let wanted = matches!(mode, Mode::Set | Mode::Both) || (mode == Mode::Auto && !found);
    if wanted {
        whole.absorb(run(session, folder, what, (name, target), (mode == Mode::Both, true), &mut located)?);
    }
    session.remember(name, &whole)?;
    Ok(located)
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
    let (alike, before) = if as_set {
        alike_pairs(session, name, &folder.images, &what.config.photo_features(), &what.config)?
    } else {
        (Vec::new(), RunResult::default())
    };
    let mut graph = JobGraph::default();
    let set = as_set.then(|| add_set(&mut graph, target, &folder.images, &alike, what)).transpose()?;
    let features = match &set {
        Some(set) => set.model.features.clone(),
        None => add_features_of(&mut graph, &folder.images, &what.config.photo_features()),
    };
    let single: Vec<JobId> = match &set {
        Some(set) => set.single.clone(),
        None => add_singles(&mut graph, &folder.images, &features, what),
    };
    session.run(name, &graph, |executor, result| {
        for (photo, job) in folder.images.iter().zip(&features) {
            let known = located.skipped.iter().any(|skipped| skipped.name == photo.name);
            if let (Some(reason), false) = (result.failed.get(&graph.job(*job).label()), known) {
                located.skipped.push(SkippedImage { name: photo.name.clone(), reason: reason.clone() });
            }
        }
        for job in single.iter().filter(|_| alone) {
            if executor.output(*job).is_some() {
                located.single.push(executor.load::<SingleLocalization>(*job)?.photo.clone());
            }
        }
        if let Some(set) = set.filter(|set| executor.output(set.set).is_some()) {
            located.set = Some((*executor.load::<SetLocalization>(set.set)?).clone());
            let model = executor.load::<MapperOutput>(set.model.model)?;
            located.local_models = model.components.iter().map(|c| c.registered().count()).collect();
        }
        Ok(before.and(result.clone()))
    })
}

#[cfg(test)]
mod tests {
    use setloc_features::Camera;

    use super::*;

    #[test]
    fn a_photo_that_its_set_places_elsewhere_is_no_longer_localized() {
        let photo = |name: &str, verdict| PhotoLocalization {
            name: name.to_owned(),
            camera: Camera::equirectangular(20, 10),
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
