use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

use anyhow::Result;
use setloc_features::ImageFeatures;
use setloc_sfm::Reconstruction;

use crate::store::write_atomically;

/// Writes a model as COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`.
///
/// Ids count from 1. COLMAP wants camera-from-world poses. `features[i]` belongs to image `i`; without it the line of
/// 2D points stays empty.
///
/// # Errors
/// When a file cannot be written.
pub fn write_colmap(
    folder: &Path,
    model: &Reconstruction,
    features: &[Option<&ImageFeatures>],
) -> Result<()> {
    let mut cameras = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    for (at, camera) in model.cameras.iter().enumerate() {
        let name = serde_json::to_value(camera.model)?;
        let name = name.as_str().unwrap_or_default();
        let params: Vec<String> = camera.params.iter().map(f64::to_string).collect();
        writeln!(cameras, "{} {name} {} {} {}", at + 1, camera.width, camera.height, params.join(" "))?;
    }
    let mut points_of_image: Vec<BTreeMap<u32, usize>> = vec![BTreeMap::new(); model.images.len()];
    let mut points =
        String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for (at, point) in model.points.iter().enumerate() {
        let (p, [r, g, b]) = (point.position, point.color);
        write!(points, "{} {} {} {} {r} {g} {b} {:.4}", at + 1, p.x, p.y, p.z, point.error_sigma)?;
        for observation in &point.track {
            points_of_image[observation.image.index()].insert(observation.feature, at + 1);
            write!(points, " {} {}", observation.image.0 + 1, observation.feature)?;
        }
        points.push('\n');
    }
    let mut images = String::from(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n",
    );
    for (at, image) in model.images.iter().enumerate() {
        let Some(pose) = image.world_from_camera else { continue };
        let camera_from_world = pose.inverse();
        let (q, t) = (camera_from_world.rotation.quaternion(), camera_from_world.translation);
        let ids = format!("{} {}", image.camera.0 + 1, image.name);
        writeln!(images, "{} {} {} {} {} {} {} {} {ids}", at + 1, q.w, q.i, q.j, q.k, t.x, t.y, t.z)?;
        let keypoints = features.get(at).copied().flatten().map_or(&[][..], |features| &features.keypoints);
        for (index, keypoint) in keypoints.iter().enumerate() {
            let point = points_of_image[at].get(&(index as u32)).map_or("-1".to_owned(), usize::to_string);
            write!(images, "{}{} {} {point}", if index > 0 { " " } else { "" }, keypoint.x, keypoint.y)?;
        }
        images.push('\n');
    }
    write_atomically(&folder.join("cameras.txt"), cameras.as_bytes())?;
    write_atomically(&folder.join("images.txt"), images.as_bytes())?;
    write_atomically(&folder.join("points3D.txt"), points.as_bytes())
}
