use anyhow::{Context, Result};
use setloc_sfm::Reconstruction;

use super::Answer;
use super::args::{ExportArgs, ExportFormat};
use super::build::scene_markers;
use super::outputs::refuse_input;
use crate::error::Hinted;
use crate::export::{geojson, kml, nerfstudio, ply, scene_json, top_view_png, write_colmap};
use crate::print;
use crate::scene::SceneFile;
use crate::store::write_atomically;

/// `setloc export`
pub fn run(args: &ExportArgs) -> Result<Answer> {
    if let Some(output) = &args.output {
        refuse_input([args.scene.as_path()], output)?;
    }
    let scene = SceneFile::read(&args.scene)?;
    let component = component(&scene, args.component)?;
    let model = &component.map_or_else(Reconstruction::default, Reconstruction::by_name);
    let needs_output =
        || Hinted::error("this format is not written to standard output", "name a file or folder with -o");
    let markers = scene_markers(model, &scene.grown_names());
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
        ExportFormat::Geojson => {
            serde_json::to_string_pretty(&geojson(&scene.placed_poses(), scene.origin)?)?
        }
        ExportFormat::Kml => kml(&scene.placed_poses(), scene.origin)?,
    };
    match &args.output {
        Some(file) => {
            write_atomically(file, text.as_bytes())?;
            print::note(&format!("wrote {}", file.display()));
        }
        None => print::data(text.trim_end())?,
    }
    Ok(Answer::Done)
}

/// A component of the scene by its number, from 1 on; `None` for the first of a scene without any.
fn component(scene: &SceneFile, number: usize) -> Result<Option<&Reconstruction>> {
    match number.checked_sub(1).and_then(|at| scene.components.get(at)) {
        None if number != 1 => Err(Hinted::error(
            format!("the scene has no component {number}"),
            format!("it has {}, counted from 1, the largest", scene.components.len()),
        )),
        component => Ok(component),
    }
}
