use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::Answer;
use super::args::{DemoArgs, RunArgs};
use super::bench::write_figures;
use crate::bench::{BenchGps, BenchOptions, bench_dataset, markdown_tables};
use crate::print;
use crate::stages;

/// `setloc demo`
pub fn run(args: &DemoArgs) -> Result<Answer> {
    let town = render_town(&args.output)?;
    let cache = args.run.cache.clone().unwrap_or_else(|| args.output.join(".setloc-cache"));
    let run = RunArgs { cache: Some(cache), ..args.run.clone() };
    let session = run.session(&args.output, Some(&args.output))?;
    let options =
        BenchOptions { config: run.config()?, seed: run.seed, gps: BenchGps::None, joint_reference: false };
    let figures = bench_dataset(&session, &town, &options)?;
    write_figures(&args.output, &figures)?;
    print::data(markdown_tables(&figures).trim_end())?;
    let mut good = figures.scene.registered == figures.scene.images;
    for set in &figures.sets {
        let found = |method: &str| set.methods.get(method).is_some_and(|figures| figures.target_registered);
        let say = |found: bool| if found { "localized" } else { "not localized" };
        let (alone, as_set) = (say(found("single")), say(found("camset+opt")));
        print::note(&format!("target {}: alone {alone}, by its set {as_set}", set.target));
        good &= found("camset+opt");
    }
    print::note(&format!("look at {}/top_view.png, tables.md, errors.csv and sets/", args.output.display()));
    Ok(if good { Answer::Done } else { Answer::Negative })
}

/// The sample town below a folder, rendered unless it is there.
pub fn render_town(output: &Path) -> Result<PathBuf> {
    let town = output.join("town");
    if !town.join("truth.json").is_file() {
        print::note(&format!("rendering the sample town into {}/", town.display()));
        // Under its final name only when whole.
        let unfinished = output.join(".town-unfinished");
        if unfinished.exists() {
            std::fs::remove_dir_all(&unfinished)?;
        }
        std::fs::create_dir_all(&unfinished)
            .with_context(|| format!("cannot write {}", unfinished.display()))?;
        stages::write_sample(&unfinished).context("cannot render the sample town")?;
        if town.exists() {
            std::fs::remove_dir_all(&town)?;
        }
        std::fs::rename(&unfinished, &town)?;
    }
    Ok(town.canonicalize()?)
}
