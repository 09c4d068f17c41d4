use std::path::Path;

use anyhow::{Context, Result};
use setloc_sfm::{MOST_NAMED, Reconstruction, listed};

use super::Answer;
use super::args::{ExportArgs, ExportFormat};
use super::build::scene_markers;
use super::outputs::{PICTURE, refuse_input};
use crate::error::Hinted;
use crate::export::{geojson, kml, nerfstudio, ply, scene_json, top_view_png, write_colmap};
use crate::import::LocatedPhotos;
use crate::print;
use crate::scene::SceneFile;
use crate::session::cache_folder;
use crate::sources::{features_of, missing_features, stored_features};
use crate::store::{Store, write_atomically};

/// `setloc export`
pub fn run(args: &ExportArgs) -> Result<Answer> {
    if args.scene.is_dir() {
        return export_photos(args);
    }
    if let Some(output) = &args.output {
        refuse_input([args.scene.as_path()], output)?;
    }
    let (scene, hash) = SceneFile::read_with_hash(&args.scene)?;
    let component = component(&scene, args.component)?;
    let model = &component.map_or_else(Reconstruction::default, Reconstruction::by_name);
    let needs_output =
        || Hinted::error("this format is not written to standard output", "name a file or folder with -o");
    let markers = scene_markers(model, &scene.grown_names());
    let text = match args.format {
        ExportFormat::Colmap => {
            let folder = args.output.as_deref().ok_or_else(needs_output)?;
            let store = Store::at(&cache_folder(args.cache.as_deref(), &args.scene));
            let features = stored_features(&store, hash)?;
            write_colmap(folder, model, &features_of(model, &features))
                .context("cannot write the COLMAP model")?;
            print::note(&format!("wrote {}/", folder.display()));
            if let Some(missing) = missing_features([model], &features) {
                print::note(&format!("note: {missing}"));
            }
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
    write_text(args.output.as_deref(), &text)?;
    Ok(Answer::Done)
}

/// To a file, or to standard output.
fn write_text(output: Option<&Path>, text: &str) -> Result<()> {
    let Some(file) = output else { return print::data(text.trim_end()) };
    write_atomically(file, text.as_bytes())?;
    print::note(&format!("wrote {}", file.display()));
    Ok(())
}

/// Photos that `locate` has localized, from its folder.
fn export_photos(args: &ExportArgs) -> Result<Answer> {
    if let Some(output) = &args.output {
        refuse_input([args.scene.join("poses.json").as_path()], output)?;
    }
    let photos = LocatedPhotos::read(&args.scene)?;
    let (poses, origin) = (&photos.poses, photos.origin);
    let text = match args.format {
        ExportFormat::Json => serde_json::to_string_pretty(&photos.json)?,
        ExportFormat::Geojson => serde_json::to_string_pretty(&geojson(poses, origin)?)?,
        ExportFormat::Kml => kml(poses, origin)?,
        ExportFormat::Colmap => return Err(has_its_own(&args.scene, "COLMAP model", "colmap/")),
        ExportFormat::Ply => return Err(has_its_own(&args.scene, "point cloud", "points.ply")),
        ExportFormat::TopView => return Err(has_its_own(&args.scene, "picture from above", PICTURE)),
        ExportFormat::Nerfstudio => {
            let message = "photos are exported as `json`, `geojson` and `kml`, and `nerfstudio` is of scenes";
            return Err(Hinted::error(message, "name a scene"));
        }
    };
    write_text(args.output.as_deref(), &text)?;
    if args.format != ExportFormat::Json && !photos.others.is_empty() {
        let others: Vec<&str> = photos.others.iter().map(String::as_str).collect();
        print::note(&format!("not localized on the map, and left out: {}", listed(&others, MOST_NAMED)));
    }
    Ok(Answer::Done)
}

/// A folder of results has what is asked for.
fn has_its_own(folder: &Path, what: &str, name: &str) -> anyhow::Error {
    Hinted::error(
        format!("{} has a {what} of its photos already", folder.display()),
        format!("it is {}", folder.join(name).display()),
    )
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
