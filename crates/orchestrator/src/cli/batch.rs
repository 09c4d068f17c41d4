use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use serde_json::{Value, json};
use setloc_camset::{PhotoLocalization, Verdict};
use setloc_sfm::{ImageId, Reconstruction};

use super::Answer;
use super::args::{BatchArgs, BuildArgs, LocateArgs, RunArgs, SourceArgs};
use super::build::{BuiltScene, build, write_json};
use super::locate::{LocatedPhotos, locate_photos};
use crate::error::{Interrupted, concerns_the_disk};
use crate::export::localization_json;
use crate::locating::Mode;
use crate::manifest::{Manifest, SceneEntry, SetEntry, Variant};
use crate::print;

/// What became of one scene or set.
#[derive(Debug, Clone, Serialize)]
struct Part {
    name: String,
    outcome: Outcome,
    /// Why it failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    wall_s: f64,
    /// What it came to, where it ran to its end.
    #[serde(flatten)]
    figures: Option<Figures>,
}

/// What a sweep is judged by.
#[derive(Debug, Clone, Serialize)]
#[serde(untagged)]
enum Figures {
    Scene(SceneFigures),
    Set(SetFigures),
}

#[derive(Debug, Clone, Serialize)]
struct SceneFigures {
    /// The scene file, as it is shown.
    scene: String,
    /// Images that were given.
    images: usize,
    /// Those with a pose in any component.
    registered: usize,
    /// Those with a pose in the largest.
    in_largest: usize,
    components: usize,
    /// Points of the largest.
    points: usize,
}

impl SceneFigures {
    fn of(scene: &Path, built: &BuiltScene) -> Self {
        let components = &built.scene.components;
        let registered: BTreeSet<ImageId> = components.iter().flat_map(Reconstruction::registered).collect();
        let main = built.scene.main();
        Self {
            scene: scene.display().to_string(),
            images: built.images,
            registered: registered.len(),
            in_largest: main.map_or(0, |main| main.registered().count()),
            components: components.len(),
            points: main.map_or(0, |main| main.points.len()),
        }
    }
}

#[derive(Debug, Clone, Serialize)]
struct SetFigures {
    /// The folder of its results, as it is shown.
    results: String,
    /// Photos with an answer.
    photos: usize,
    localized: usize,
    uncertain: usize,
    not_localized: usize,
    /// The target, as `poses.json` has it; null where it could not be used.
    target: Value,
}

impl SetFigures {
    fn of(results: &Path, found: &LocatedPhotos) -> Self {
        let answers = found.located.answers();
        let count = |verdict| answers.iter().filter(|(_, photo)| photo.verdict == verdict).count();
        let target = answers.iter().find(|(_, photo)| photo.name == found.target);
        let stated = |(method, photo): &(&str, &PhotoLocalization)| {
            let whole = localization_json(photo, &found.scene);
            let mut stated = json!({ "method": method });
            for key in ["name", "verdict", "inliers", "sigma", "wgs84_sigma"] {
                stated[key] = whole[key].clone();
            }
            stated
        };
        Self {
            results: results.display().to_string(),
            photos: answers.len(),
            localized: count(Verdict::Localized),
            uncertain: count(Verdict::Uncertain),
            not_localized: count(Verdict::NotLocalized),
            target: target.map_or(Value::Null, stated),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Outcome {
    Done,
    /// Not registered, not localized.
    Negative,
    Failed,
    /// Not tried: its scene failed or has no images, or the batch ended before.
    Skipped,
}

/// The parts of a batch as they come to their ends.
struct Progress {
    parts: Vec<Part>,
    total: usize,
    /// Why the rest is not tried.
    end: Option<anyhow::Error>,
}

impl Progress {
    /// Runs one part unless the batch has ended; says whether it gave something to go on with.
    fn part(&mut self, name: String, work: impl FnOnce() -> Result<(Answer, Figures)>) -> bool {
        if self.end.is_some() {
            self.skip(name);
            return false;
        }
        print::note(&format!("== {name} ({} of {})", self.parts.len() + 1, self.total));
        let begun = Instant::now();
        let result = work();
        let wall_s = begun.elapsed().as_secs_f64();
        let (outcome, reason, figures) = match result {
            Ok((Answer::Done, figures)) => (Outcome::Done, None, Some(figures)),
            Ok((Answer::Negative, figures)) => (Outcome::Negative, None, Some(figures)),
            Err(error) if error.is::<Interrupted>() => {
                self.end = Some(error);
                self.skip(name);
                return false;
            }
            Err(error) => {
                super::show(&error);
                let reason = format!("{error:#}");
                if concerns_the_disk(&error) {
                    self.end = Some(error);
                }
                (Outcome::Failed, Some(reason), None)
            }
        };
        self.parts.push(Part { name, outcome, reason, wall_s, figures });
        outcome == Outcome::Done
    }

    fn skip(&mut self, name: String) {
        self.parts.push(Part { name, outcome: Outcome::Skipped, reason: None, wall_s: 0.0, figures: None });
    }

    fn count(&self, outcome: Outcome) -> usize {
        self.parts.iter().filter(|part| part.outcome == outcome).count()
    }
}

/// `setloc batch`
///
/// One failing scene does not stop the others; a full disk and Ctrl-C do. All runs share one store, so a sweep repeats
/// only what depends on the swept parameter.
pub fn run(args: &BatchArgs) -> Result<Answer> {
    let manifest = Manifest::read(&args.manifest)?;
    let base = args.manifest.parent().unwrap_or(Path::new(""));
    let variants = manifest
        .variants(args.run.config.as_deref(), &args.run.settings)
        .with_context(|| format!("{} cannot be run", args.manifest.display()))?;
    let parts: usize = manifest.scene.iter().map(|scene| 1 + scene.sets.len()).sum();
    let mut progress = Progress { parts: Vec::new(), total: parts * variants.len(), end: None };
    let cache = args.run.cache.clone().unwrap_or_else(|| args.output.join(".setloc-cache"));
    for variant in &variants {
        let run = RunArgs {
            cache: Some(cache.clone()),
            settings: [&args.run.settings[..], &variant.settings].concat(),
            ..args.run.clone()
        };
        for entry in &manifest.scene {
            run_scene(&mut progress, entry, variant, &Places { base, output: &args.output, run: &run });
        }
    }
    finish(args, &progress)
}

/// Where the parts of one variant come from and go to.
struct Places<'a> {
    base: &'a Path,
    output: &'a Path,
    run: &'a RunArgs,
}

fn run_scene(progress: &mut Progress, entry: &SceneEntry, variant: &Variant, places: &Places<'_>) {
    let below = |path: &PathBuf| places.base.join(path);
    let name = format!("{}{}", entry.name, variant.suffix);
    let folder = places.output.join(&name);
    let scene = folder.join("scene.setloc");
    let gps = |gps: &String| match gps.as_str() {
        "exif" => gps.clone(),
        table => places.base.join(table).display().to_string(),
    };
    let source = SourceArgs {
        panoramas: entry.panoramas.iter().map(below).collect(),
        output: scene.clone(),
        gps: entry.gps.as_ref().map(gps),
        masks: entry.masks.as_ref().map(below),
        cameras: entry.cameras.as_ref().map(below),
        run: places.run.clone(),
    };
    let to_build = BuildArgs { source, export: None, print_config: false };
    let built = progress.part(name.clone(), || {
        let built = build(&to_build)?;
        Ok((built.answer, Figures::Scene(SceneFigures::of(&scene, &built))))
    });
    for set in &entry.sets {
        let set_name = format!("{name}/{}", set.name);
        if built {
            let locate = locate_args(set, &scene, &folder, places);
            progress.part(set_name, || {
                let found = locate_photos(&locate)?;
                Ok((found.answer, Figures::Set(SetFigures::of(&locate.output, &found))))
            });
        } else {
            progress.skip(set_name);
        }
    }
}

fn locate_args(set: &SetEntry, scene: &Path, folder: &Path, places: &Places<'_>) -> LocateArgs {
    LocateArgs {
        scene: scene.to_owned(),
        photos: set.photos.iter().map(|path| places.base.join(path)).collect(),
        target: set.target.clone(),
        mode: Mode::Auto,
        masks: set.masks.as_ref().map(|path| places.base.join(path)),
        cameras: set.cameras.as_ref().map(|path| places.base.join(path)),
        grow: None,
        output: folder.join(&set.name),
        run: places.run.clone(),
    }
}

/// Prints and writes the summary; the worst part decides the answer.
fn finish(args: &BatchArgs, progress: &Progress) -> Result<Answer> {
    let line = |part: &Part| {
        let word = match (part.outcome, &part.reason) {
            (Outcome::Done, _) => "done".to_owned(),
            (Outcome::Negative, _) => "negative".to_owned(),
            (Outcome::Skipped, _) => "skipped".to_owned(),
            (Outcome::Failed, reason) => format!("failed: {}", reason.as_deref().unwrap_or_default()),
        };
        print::data(&format!("{}\t{word}\t{:.1} s", part.name, part.wall_s))
    };
    let printed = progress.parts.iter().try_for_each(line);
    let [done, negative, failed, skipped] =
        [Outcome::Done, Outcome::Negative, Outcome::Failed, Outcome::Skipped]
            .map(|outcome| progress.count(outcome));
    print::note(&format!("{done} done, {negative} negative, {failed} failed, {skipped} skipped"));
    let written = write_json(&args.output.join("summary.json"), &progress.parts);
    match &progress.end {
        Some(error) if error.is::<Interrupted>() => return Err(Interrupted.into()),
        Some(error) => anyhow::bail!("the batch ended early: {error:#}"),
        None => written.context("cannot write the batch's summary")?,
    }
    printed?;
    anyhow::ensure!(failed == 0, "{failed} of {} parts failed", progress.total);
    Ok(if negative == 0 { Answer::Done } else { Answer::Negative })
}
