use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::Answer;
use super::args::ReportArgs;
use super::build::{export_folder, reported_scene};
use super::outputs::{PAGE, PICTURE, refuse_folder, refuse_input};
use crate::digest::Digest;
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::print;
use crate::store::write_atomically;

/// `setloc report`
pub fn run(args: &ReportArgs) -> Result<Answer> {
    // Of a scene file: what `build` wrote beside it.
    let folder = if args.results.is_file() { export_folder(&args.results) } else { args.results.clone() };
    let page = args.output.clone().unwrap_or_else(|| folder.join(PAGE));
    refuse_folder("-o", &page, PAGE)?;
    let read = ["poses.json", "report.json", PICTURE].map(|name| folder.join(name));
    let scene = folder.with_extension("setloc");
    refuse_input([&args.results, &scene].into_iter().chain(&read).map(PathBuf::as_path), &page)?;
    let digest = Digest::read(&folder)?;
    if args.results.is_file() {
        refuse_other_scene(&args.results, &folder)?;
    }
    write_atomically(&page, digest.to_html().as_bytes())?;
    print::data(digest.to_text().trim_end())?;
    print::note(&format!("wrote {}", page.display()));
    Ok(Answer::Done)
}

/// Refuses results that are not of a scene: another build, with `--export`, has written that since.
fn refuse_other_scene(scene: &Path, folder: &Path) -> Result<()> {
    let file = std::fs::read(scene).with_context(|| format!("cannot read {}", scene.display()))?;
    if reported_scene(folder) == Some(ContentHash::of(&file)) {
        return Ok(());
    }
    Err(Hinted::error(
        format!("{} has no results of the scene {}", folder.display(), scene.display()),
        "name the folder that its build named with --export, or build it again without --export",
    ))
}
