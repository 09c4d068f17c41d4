use anyhow::{Context, Result};
use setloc_sfm::{Reconstruction, ReconstructionImage};

use super::Answer;
use super::args::{ExportArgs, ExportFormat};
use super::build::scene_markers;
use crate::error::Hinted;
use crate::export::{geojson, kml, nerfstudio, ply, scene_json, top_view_png, write_colmap};
use crate::print;
use crate::scene::SceneFile;
use crate::store::write_atomically;

/// `setloc export`
pub fn run(args: &ExportArgs) -> Result<Answer> {
    let scene = SceneFile::read(&args.scene)?;
    let model = &scene.main().map_or_else(Reconstruction::default, Reconstruction::by_name);
    let needs_output =
        || Hinted::error("this format is not written to standard output", "name a file or folder with -o");
    let markers = scene_markers(model, &scene.grown_names());
    let posed = |image: &ReconstructionImage| Some((image.name.clone(), image.world_from_camera?));
    let poses = || model.images.iter().filter_map(posed).collect::<Vec<_>>();
    let text = match args.format {
        ExportFormat::Colmap => {
            let folder = args.output.as_deref().ok_or_else(needs_output)?;
            write_colmap(folder, model, &[]).context("cannot write the COLMAP model")?;
            print::note(&format!("wrote {}/", folder.display()));
            print::note(
                "note: without 2D points and tracks, since a scene file lacks their keypoints; the model that `setloc build` writes has them",
            );
            return Ok(Answer::Done);
        }
        ExportFormat::TopView => {
            let file = args.output.as_deref().ok_or_else(needs_output)?;
            write_atomically(file, &top_view_png(model, &markers)?)?;
            print::note(&format!("wrote {}", file.display()));
            return Ok(Answer::Done);
        }
        ExportFormat::Ply => {
            let centres: Vec<_> =
                markers.iter().map(|m| (m.world_from_camera.translation, m.color)).collect();
            ply(model, &centres)
        }
        ExportFormat::Nerfstudio => serde_json::to_string_pretty(&nerfstudio(model)?)?,
        ExportFormat::Json => serde_json::to_string_pretty(&scene_json(&scene))?,
        ExportFormat::Geojson => serde_json::to_string_pretty(&geojson(&poses(), scene.origin)?)?,
        ExportFormat::Kml => kml(&poses(), scene.origin)?,
    };
    match &args.output {
        Some(file) => {
            write_atomically(file, text.as_bytes())?;
            print::note(&format!("wrote {}", file.display()));
        }
        None => print::data(text.trim_end()),
    }
    Ok(Answer::Done)
}
