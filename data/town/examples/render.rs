//! Renders a town to a folder: `render OUT [PARAMS.json]`.

use std::path::PathBuf;
use std::process::ExitCode;

use setloc_town::{TownParams, write_dataset};

const JPEG_QUALITY: u8 = 92;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let is_folder = |out: &PathBuf| !out.to_string_lossy().starts_with('-');
    let out = arguments.next().filter(is_folder).ok_or("usage: render OUT [PARAMS.json]")?;
    let params = match arguments.next() {
        Some(path) => serde_json::from_str(&std::fs::read_to_string(path)?)?,
        None => TownParams::default(),
    };
    write_dataset(&out, &params, JPEG_QUALITY)?;
    Ok(())
}
