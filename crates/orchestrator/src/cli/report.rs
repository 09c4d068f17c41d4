use std::path::PathBuf;

use anyhow::Result;

use super::Answer;
use super::args::ReportArgs;
use super::build::export_folder;
use super::outputs::{PAGE, PICTURE, refuse_folder, refuse_input};
use crate::digest::Digest;
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
    write_atomically(&page, digest.to_html().as_bytes())?;
    print::data(digest.to_text().trim_end())?;
    print::note(&format!("wrote {}", page.display()));
    Ok(Answer::Done)
}
