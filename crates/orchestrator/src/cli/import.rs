use anyhow::Result;
use setloc_sfm::{MOST_NAMED, listed};

use super::Answer;
use super::args::ImportArgs;
use super::build::readable_json;
use super::outputs::refuse_other_content;
use crate::error::Hinted;
use crate::import::ImportedModel;
use crate::print;
use crate::store::write_atomically;

/// `setloc import`
pub fn run(args: &ImportArgs) -> Result<Answer> {
    let model = ImportedModel::read_colmap(&args.model)?;
    if model.images.is_empty() {
        let message = format!("{} has no image with a pose", args.model.display());
        return Err(Hinted::error(message, "name a model of which COLMAP has registered images"));
    }
    let files = [
        (args.output.join("cameras.json"), readable_json(&model.to_cameras_json(&args.prefix))?),
        (args.output.join("truth.json"), readable_json(&model.to_truth_json(&args.prefix))?),
    ];
    files.iter().try_for_each(|(file, text)| refuse_other_content(file, text.as_bytes()))?;
    files.iter().try_for_each(|(file, text)| write_atomically(file, text.as_bytes()))?;
    let (cameras, images) = (model.cameras.len(), model.images.len());
    print::note(&format!("wrote {cameras} cameras and {images} poses to {}/", args.output.display()));
    if let Some(warning) = foreign_cameras(&model) {
        print::note(&format!("warning: {warning}"));
    }
    Ok(Answer::Done)
}

/// Says which cameras `cameras.json` lacks, and what to do about it.
fn foreign_cameras(model: &ImportedModel) -> Option<String> {
    let cameras: Vec<String> =
        model.foreign.iter().map(|(number, name)| format!("{number} ({name})")).collect();
    let cameras: Vec<&str> = cameras.iter().map(String::as_str).collect();
    let images: Vec<&str> = model.without_camera().collect();
    (!cameras.is_empty()).then(|| {
        format!(
            "cameras.json lacks cameras whose models are not known here: {}, of {}; COLMAP's `image_undistorter` makes images of a \
             known one",
            listed(&cameras, MOST_NAMED),
            listed(&images, MOST_NAMED)
        )
    })
}
