//! A rendered town as a data set: images, `cameras.json`, `truth.json`, `geo.csv`.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Map, Value, json};
use setloc_features::Wgs84;

use crate::error::TownError;
use crate::params::TownParams;
use crate::render::RenderedView;
use crate::town::Town;

/// Name of the set of photos.
pub const PHOTO_SET: &str = "lane";

/// Where the town's frame is anchored.
const ORIGIN: Wgs84 = Wgs84 { lat: 47.3769, lon: 8.5417, alt: 408.0 };

/// Renders a town and writes it as a data set: `panoramas/`, `queries/`, `cameras.json`, `truth.json`, `geo.csv`.
///
/// `quality` is the JPEG quality, 1 to 100. Existing files of these names are replaced, others are left.
///
/// # Errors
/// [`TownError`] when a parameter is out of range or a file cannot be written.
pub fn write_dataset(dir: &Path, params: &TownParams, quality: u8) -> Result<(), TownError> {
    if !(1..=100).contains(&quality) {
        return Err(TownError::InvalidParameter {
            name: "quality",
            value: quality.to_string(),
            allowed: "1 to 100",
        });
    }
    let town = Town::new(params)?;
    write(&dir.join("cameras.json"), pretty(&cameras(&town)).as_bytes())?;
    write(&dir.join("truth.json"), pretty(&truth(&town)).as_bytes())?;
    write(&dir.join("geo.csv"), positions(&town).as_bytes())?;
    for index in 0..town.views().len() {
        let view = town.render(index)?;
        write(&dir.join(&view.name), &encode(&view, quality)?)?;
    }
    Ok(())
}

fn encode(view: &RenderedView, quality: u8) -> Result<Vec<u8>, TownError> {
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality)
        .encode(&view.rgb, view.width, view.height, image::ExtendedColorType::Rgb8)
        .map_err(|source| TownError::Encode { name: view.name.clone(), source })?;
    Ok(bytes)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), TownError> {
    let fail = |source| TownError::Write { path: path.to_owned(), source };
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(fail)?;
    }
    fs::write(path, bytes).map_err(fail)
}

fn pretty(value: &Value) -> String {
    format!("{value:#}\n")
}

fn cameras(town: &Town) -> Value {
    let (mut cameras, mut images) = (Map::new(), Map::new());
    for view in town.views() {
        let name = if view.camera.is_panoramic() { "pano" } else { PHOTO_SET };
        cameras.entry(name).or_insert_with(|| json!(view.camera));
        images.insert(view.name.clone(), json!(name));
    }
    json!({
        "convention": "pixel coordinates: centre of the top-left pixel is (0.5,0.5); camera frame x right, y down, z forward",
        "cameras": cameras,
        "images": images,
    })
}

fn truth(town: &Town) -> Value {
    let mut images = Map::new();
    for view in town.views() {
        let q = &view.rotation_world_from_camera;
        let center = &view.center_in_world;
        let pose = json!({ "q_wxyz": [q.w, q.i, q.j, q.k], "center": [center.x, center.y, center.z] });
        images.insert(view.name.clone(), pose);
    }
    json!({
        "convention": "q_wxyz: world-from-camera rotation (X_world = R(q) X_cam + center), world is ENU metres (x east, y north, z up)",
        "geo_origin": ORIGIN,
        "images": images,
    })
}

/// The panoramas' positions as a receiver would record them.
fn positions(town: &Town) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(town.params.seed);
    rng.set_stream(1 << 60);
    let mut table = String::from("name,lat,lon,alt\n");
    for view in town.views().iter().filter(|view| view.camera.is_panoramic()) {
        let noise = Vector3::from_fn(|_, _| gaussian(&mut rng)) * town.params.gps_noise_m;
        let place = Wgs84::from_enu(&(view.center_in_world + noise), ORIGIN);
        // Writing to a String cannot fail.
        let _ = writeln!(table, "{},{:.8},{:.8},{:.3}", view.name, place.lat, place.lon, place.alt);
    }
    table
}

/// A standard normal number (Box and Muller).
fn gaussian(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}
