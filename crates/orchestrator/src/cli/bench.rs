use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use setloc_sfm::Rigid;

use super::Answer;
use super::args::{BenchArgs, RunArgs};
use super::build::{scene_markers, warn_skipped, write_json};
use crate::bench::{BenchOptions, DatasetFigures, bench_dataset, errors_csv, markdown_tables};
use crate::export::{Marker, top_view_png};
use crate::print;
use crate::session::stop_on_signal;
use crate::store::write_atomically;

/// `setloc bench`
pub fn run(args: &BenchArgs) -> Result<Answer> {
    let options = BenchOptions { config: args.run.config()?, seed: args.run.seed, gps: args.gps };
    let stop = stop_on_signal();
    for root in &args.datasets {
        let root = root.canonicalize().with_context(|| format!("cannot open {}", root.display()))?;
        let output = match args.datasets.len() {
            1 => args.output.clone(),
            _ => args.output.join(root.file_name().unwrap_or_default()),
        };
        std::fs::create_dir_all(&output).with_context(|| format!("cannot write {}", output.display()))?;
        // Without a given store nothing is reused, so the times are those of the whole work.
        let fresh = tempfile::Builder::new().prefix(".bench-cache-").tempdir_in(&output)?;
        let cache = args.run.cache.clone().unwrap_or_else(|| fresh.path().to_owned());
        let run = RunArgs { cache: Some(cache), ..args.run.clone() };
        let session = run.session_with(&output, Some(&output), &stop)?;
        let figures = bench_dataset(&session, &root, &options)?;
        write_figures(&output, &figures)?;
        warn_skipped(&figures.skipped);
        print::data(markdown_tables(&figures).trim_end());
        print::note(&format!("wrote {}/", output.display()));
    }
    Ok(Answer::Done)
}

/// `results.json`, tables, errors, poses and pictures.
pub fn write_figures(folder: &Path, figures: &DatasetFigures) -> Result<()> {
    write_json(&folder.join("results.json"), figures)?;
    write_atomically(&folder.join("tables.md"), markdown_tables(figures).as_bytes())?;
    write_atomically(&folder.join("errors.csv"), errors_csv(figures).as_bytes())?;
    let scene =
        figures.model.images.iter().filter_map(|image| Some((image.name.clone(), image.world_from_camera?)));
    write_json(&folder.join("poses.json"), &peers_poses(&scene.collect()))?;
    write_atomically(
        &folder.join("top_view.png"),
        &top_view_png(&figures.model, &scene_markers(&figures.model))?,
    )?;
    for set in &figures.sets {
        for (method, of_method) in &set.methods {
            let answers = of_method.answers.iter();
            let poses: BTreeMap<String, Rigid> =
                answers.filter_map(|photo| Some((photo.name.clone(), photo.world_from_camera?))).collect();
            let file = |name: &str| -> PathBuf {
                folder.join("sets").join(&set.name).join(format!("{method}.{name}"))
            };
            write_json(&file("poses.json"), &peers_poses(&poses))?;
            let mut markers = scene_markers(&figures.model);
            for (name, world_from_camera) in &poses {
                let color = if *name == set.target { [220, 30, 30] } else { [240, 150, 0] };
                markers.push(Marker { world_from_camera: *world_from_camera, color, directed: true });
            }
            write_atomically(&file("top_view.png"), &top_view_png(&figures.model, &markers)?)?;
        }
    }
    Ok(())
}

/// `{name: {"R": camera-from-world rows, "C": centre}}`.
fn peers_poses(poses: &BTreeMap<String, Rigid>) -> Value {
    let one = |(name, pose): (&String, &Rigid)| {
        let rotation = pose.rotation.inverse().to_rotation_matrix();
        let rows: Vec<Vec<f64>> =
            rotation.matrix().row_iter().map(|row| row.iter().copied().collect()).collect();
        (
            name.clone(),
            json!({ "R": rows, "C": [pose.translation.x, pose.translation.y, pose.translation.z] }),
        )
    };
    Value::Object(poses.iter().map(one).collect())
}
