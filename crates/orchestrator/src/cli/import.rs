use anyhow::Result;

use super::Answer;
use super::args::ImportArgs;
use super::build::write_json;
use crate::error::Hinted;
use crate::import::ImportedModel;
use crate::print;

/// `setloc import`
pub fn run(args: &ImportArgs) -> Result<Answer> {
    let model = ImportedModel::read_colmap(&args.model)?;
    if model.images.is_empty() {
        let message = format!("{} has no image with a pose", args.model.display());
        return Err(Hinted::error(message, "check images.txt"));
    }
    write_json(&args.output.join("cameras.json"), &model.to_cameras_json(&args.prefix))?;
    write_json(&args.output.join("truth.json"), &model.to_truth_json(&args.prefix))?;
    let (cameras, images) = (model.cameras.len(), model.images.len());
    print::note(&format!("wrote {cameras} cameras and {images} poses to {}/", args.output.display()));
    Ok(Answer::Done)
}
