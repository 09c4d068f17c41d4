mod own_stores;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use setloc_camset::PhotoLocalization;
use setloc_sfm::Rigid;

use super::Answer;
use super::args::{BenchArgs, RunArgs};
use super::build::{scene_markers, warn_skipped, write_json};
use super::demo::render_town;
use super::outputs::refuse_image_folder;
use crate::bench::{
    Availability, Baseline, BenchGps, BenchOptions, DatasetEntry, DatasetFigures, Harness, HarnessRun,
    ParameterSet, Registry, about, bench_dataset, errors_csv, figures_section, html_report, markdown_tables,
    metrics_of,
};
use crate::error::{Hinted, Interrupted, concerns_the_disk};
use crate::export::{Marker, top_view_png};
use crate::html::page;
use crate::print;
use crate::store::{create_folder, write_atomically};

use own_stores::OwnStores;

/// `setloc bench`
pub fn run(args: &BenchArgs) -> Result<Answer> {
    let mut stores = OwnStores::default();
    let answer = if args.datasets.is_empty() {
        run_registry(args, &mut stores)
    } else {
        run_datasets(args, &mut stores)
    };
    // Where the run ended before its time, the same command goes on with them.
    if !answer.as_ref().is_err_and(ends_early) {
        stores.remove();
    }
    answer
}

/// Whether an error ends a run that the same command continues.
fn ends_early(error: &anyhow::Error) -> bool {
    error.is::<Interrupted>() || concerns_the_disk(error)
}

/// Runs over the data sets that are named.
fn run_datasets(args: &BenchArgs, stores: &mut OwnStores) -> Result<Answer> {
    refuse_same_names(&args.datasets)?;
    for root in &args.datasets {
        refuse_images_of(root, &args.output)?;
        let root = root.canonicalize().with_context(|| format!("cannot open {}", root.display()))?;
        let output = match args.datasets.len() {
            1 => args.output.clone(),
            _ => args.output.join(root.file_name().unwrap_or_default()),
        };
        let run = with_store(&args.run, &output, stores)?;
        let figures = repeat(args, &run, &root, args.gps, &output)?;
        for of_seed in &figures {
            warn_skipped(&of_seed.skipped);
            print::data(markdown_tables(of_seed).trim_end())?;
        }
        if figures.len() > 1 {
            let metrics = metrics_of(&figures);
            write_json(&output.join("repeats.json"), &metrics)?;
            for (name, value) in &metrics {
                print::data(&format!("{name}\t{:.4} ± {:.4}", value.mean, value.deviation))?;
            }
        }
        print::note(&format!("wrote {}/", output.display()));
    }
    Ok(Answer::Done)
}

/// Refuses results among a data set's images.
fn refuse_images_of(root: &Path, output: &Path) -> Result<()> {
    let queries = root.join("queries");
    let sets = std::fs::read_dir(&queries).into_iter().flatten().flatten().map(|entry| entry.path());
    let folders: Vec<PathBuf> =
        [root.join("panoramas"), root.join("images")].into_iter().chain(sets).collect();
    refuse_image_folder(&folders, output, "name another folder for the results with -o")
}

/// Refuses data sets whose results would replace each other's.
fn refuse_same_names(datasets: &[PathBuf]) -> Result<()> {
    let mut names = BTreeSet::new();
    for root in datasets {
        let name = root.canonicalize().unwrap_or_else(|_| root.clone());
        let name = name.file_name().unwrap_or_default().to_owned();
        if !names.insert(name.clone()) {
            return Err(Hinted::error(
                format!("two data sets are called {}, and so would be their results", name.display()),
                "run each by itself, with an output folder of its own (-o)",
            ));
        }
    }
    Ok(())
}

/// Runs over all that is registered and compares with the baseline.
fn run_registry(args: &BenchArgs, stores: &mut OwnStores) -> Result<Answer> {
    let file = &args.registry.registry;
    let mut registry = Registry::read(file)?;
    registry.keep_only(&args.registry.only)?;
    let beside = file.parent().unwrap_or(Path::new(""));
    let data = args.registry.data.clone().unwrap_or_else(|| beside.to_owned());
    let baseline_file = args.registry.baseline.clone().unwrap_or_else(|| beside.join("baseline.json"));
    let mut baseline = Baseline::read(&baseline_file)?;
    let mut harness = Harness { seeds: seeds(args).collect(), ..Harness::default() };
    for entry in &registry.dataset {
        let root = match entry.find(&data)? {
            Availability::Present(folder) => folder.canonicalize()?,
            Availability::Rendered => render_town(&args.output.join(".sample"))?,
            Availability::Missing(reason) => {
                print::note(&format!("skipped {}: {reason}", entry.name));
                harness.skipped.push((entry.name.clone(), reason));
                continue;
            }
        };
        // One store for all parameter sets and seeds: what does not depend on them is done once.
        let output = args.output.join(&entry.name);
        let run = with_store(&args.run, &output, stores)?;
        let runs = registry.parameters.iter().map(|set| run_entry(args, &run, entry, set, &root)).collect();
        match runs {
            Ok(runs) => harness.runs.extend::<Vec<HarnessRun>>(runs),
            Err(error) if ends_early(&error) => return Err(error),
            Err(error) => {
                print::note(&format!("{} failed:", entry.name));
                super::show(&error);
                harness.skipped.push((entry.name.clone(), format!("failed: {error:#}")));
            }
        }
    }
    let failed = harness.skipped.iter().filter(|(_, reason)| reason.starts_with("failed: ")).count();
    let metrics = harness.metrics();
    harness.deltas = (!baseline.runs.is_empty()).then(|| baseline.compare(&metrics));
    write_json(&args.output.join("results.json"), &harness.to_json())?;
    write_atomically(&args.output.join("summary.md"), harness.to_markdown().as_bytes())?;
    write_atomically(&args.output.join("report.html"), html_report(&harness).as_bytes())?;
    print::data(harness.to_markdown().trim_end())?;
    print::note(&format!("wrote {}/", args.output.display()));
    if args.registry.update_baseline {
        baseline.update(&metrics);
        write_json(&baseline_file, &baseline)?;
        print::note(&format!("wrote {}", baseline_file.display()));
    }
    anyhow::ensure!(failed == 0, "{failed} data sets failed");
    if harness.runs.is_empty() {
        let hint = "name the folder that has them with --data DIR or SETLOC_DATA";
        return Err(Hinted::error("none of the registered data sets is present", hint));
    }
    let regressed = harness.has_regressed() && !args.registry.update_baseline;
    Ok(if regressed { Answer::Negative } else { Answer::Done })
}

/// All repeats of a registered data set with one parameter set.
fn run_entry(
    args: &BenchArgs,
    run: &RunArgs,
    entry: &DatasetEntry,
    set: &ParameterSet,
    root: &Path,
) -> Result<HarnessRun> {
    let name = format!("{}/{}", entry.name, set.name);
    print::note(&format!("== {name}"));
    // What the command line sets holds for every parameter set.
    let run = RunArgs { settings: [&set.settings[..], &run.settings].concat(), ..run.clone() };
    let output = args.output.join(&entry.name).join(&set.name);
    let figures = repeat(args, &run, root, entry.gps, &output)?;
    let metrics = metrics_of(&figures);
    let about = about(entry.truth, !args.no_joint_reference, &entry.licence);
    Ok(HarnessRun { name, about, settings: set.settings.clone(), figures, metrics })
}

fn seeds(args: &BenchArgs) -> impl Iterator<Item = u64> {
    (0..args.repeats).map(|repeat| args.run.seed.wrapping_add(repeat))
}

/// One run for each seed; the results of the first lie in `output`, those of others in folders of their own.
fn repeat(
    args: &BenchArgs,
    run: &RunArgs,
    root: &Path,
    gps: BenchGps,
    output: &Path,
) -> Result<Vec<DatasetFigures>> {
    let one = |seed: u64| {
        let output =
            if seed == args.run.seed { output.to_owned() } else { output.join(format!("seed-{seed}")) };
        let session = run.session(&output, Some(&output))?;
        let joint_reference = !args.no_joint_reference;
        let options = BenchOptions { config: run.config()?, seed, gps, joint_reference };
        let figures = bench_dataset(&session, root, &options)?;
        for (set, reason) in &figures.skipped_sets {
            print::note(&format!("skipped set {set}: {reason}"));
        }
        write_figures(&output, &figures)?;
        Ok(figures)
    };
    seeds(args).map(one).collect()
}

/// The options with the given store, else with one of its own, so that the times are those of the whole work.
fn with_store(run: &RunArgs, output: &Path, stores: &mut OwnStores) -> Result<RunArgs> {
    if run.cache.is_some() {
        return Ok(run.clone());
    }
    create_folder(output)?;
    Ok(RunArgs { cache: Some(stores.add(output)?), ..run.clone() })
}

/// `results.json`, tables, plots, errors, poses and pictures.
pub fn write_figures(folder: &Path, figures: &DatasetFigures) -> Result<()> {
    write_json(&folder.join("results.json"), figures)?;
    write_atomically(&folder.join("tables.md"), markdown_tables(figures).as_bytes())?;
    let html = page(&figures.dataset, &figures_section(figures));
    write_atomically(&folder.join("report.html"), html.as_bytes())?;
    write_atomically(&folder.join("errors.csv"), errors_csv(figures).as_bytes())?;
    let scene = figures.model.images.iter();
    let scene = scene.filter_map(|image| Some((image.name.as_str(), (image.world_from_camera?, 0))));
    write_json(&folder.join("poses.json"), &peers_poses(&scene.collect()))?;
    write_atomically(
        &folder.join("top_view.png"),
        &top_view_png(&figures.model, &scene_markers(&figures.model, &BTreeSet::new()))?,
    )?;
    for set in &figures.sets {
        for (method, of_method) in &set.methods {
            let answers = of_method.answers.iter();
            let pose = |photo: &PhotoLocalization| Some((photo.world_from_camera?, photo.component));
            let poses: BTreeMap<&str, (Rigid, usize)> =
                answers.filter_map(|photo| Some((photo.name.as_str(), pose(photo)?))).collect();
            let file = |name: &str| -> PathBuf {
                folder.join("sets").join(&set.name).join(format!("{method}.{name}"))
            };
            write_json(&file("poses.json"), &peers_poses(&poses))?;
            let mut markers = scene_markers(&figures.model, &BTreeSet::new());
            // The picture is of the largest component.
            for (name, (world_from_camera, _)) in poses.iter().filter(|(_, (_, component))| *component == 0) {
                let color = if *name == set.target { [220, 30, 30] } else { [240, 150, 0] };
                markers.push(Marker { world_from_camera: *world_from_camera, color, directed: true });
            }
            write_atomically(&file("top_view.png"), &top_view_png(&figures.model, &markers)?)?;
        }
    }
    Ok(())
}

/// `{name: {"R": camera-from-world rows, "C": centre, "component": 0 for the largest}}`.
fn peers_poses(poses: &BTreeMap<&str, (Rigid, usize)>) -> Value {
    let one = |(name, (pose, component)): (&&str, &(Rigid, usize))| {
        let rotation = pose.rotation.inverse().to_rotation_matrix();
        let rows: Vec<Vec<f64>> =
            rotation.matrix().row_iter().map(|row| row.iter().copied().collect()).collect();
        (
            (*name).to_owned(),
            json!({
                "R": rows, "C": [pose.translation.x, pose.translation.y, pose.translation.z],
                "component": component,
            }),
        )
    };
    Value::Object(poses.iter().map(one).collect())
}
