use std::fmt::Write;
use std::path::Path;

use anyhow::Result;
use rayon::prelude::*;
use setloc_features::ImageFeatures;
use setloc_sfm::{Reconstruction, ReconstructionImage, ReconstructionPoint};

use crate::store::write_pieces_atomically;

/// Points whose lines are made, and written, at once.
const POINTS_OF_PIECE: usize = 2048;
/// About what the lines of a point and of a keypoint take; more is made room for.
const BYTES_OF_POINT: usize = 128;
const BYTES_OF_KEYPOINT: usize = 26;

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
    let mut points_of_image: Vec<Vec<(u32, usize)>> = vec![Vec::new(); model.images.len()];
    for (at, point) in model.points.iter().enumerate() {
        for observation in &point.track {
            points_of_image[observation.image.index()].push((observation.feature, at + 1));
        }
    }
    points_of_image.par_iter_mut().for_each(|points| {
        points.sort_unstable();
        points.dedup_by_key(|(feature, _)| *feature);
    });
    let points = |(piece, points): (usize, &[ReconstructionPoint])| -> Result<String, std::fmt::Error> {
        let mut lines = String::with_capacity(points.len() * BYTES_OF_POINT);
        for (at, point) in points.iter().enumerate() {
            let (p, [r, g, b]) = (point.position, point.color);
            let id = piece * POINTS_OF_PIECE + at + 1;
            write!(lines, "{id} {} {} {} {r} {g} {b} {:.4}", p.x, p.y, p.z, point.error_sigma)?;
            for observation in &point.track {
                write!(lines, " {} {}", observation.image.0 + 1, observation.feature)?;
            }
            lines.push('\n');
        }
        Ok(lines)
    };
    let image = |(at, image): (usize, &ReconstructionImage)| -> Result<String, std::fmt::Error> {
        let keypoints = features.get(at).copied().flatten().map_or(&[][..], |features| &features.keypoints);
        let mut lines = String::with_capacity(512 + keypoints.len() * BYTES_OF_KEYPOINT);
        let Some(pose) = image.world_from_camera else { return Ok(lines) };
        let camera_from_world = pose.inverse();
        let (q, t) = (camera_from_world.rotation.quaternion(), camera_from_world.translation);
        let ids = format!("{} {}", image.camera.0 + 1, image.name);
        writeln!(lines, "{} {} {} {} {} {} {} {} {ids}", at + 1, q.w, q.i, q.j, q.k, t.x, t.y, t.z)?;
        // Nearly all of the export: millions of numbers.
        let mut number = zmij::Buffer::new();
        let mut points = points_of_image[at].iter().peekable();
        for (index, keypoint) in keypoints.iter().enumerate() {
            for coordinate in [keypoint.x, keypoint.y] {
                lines.push_str(number.format(coordinate));
                lines.push(' ');
            }
            match points.next_if(|(feature, _)| *feature as usize == index) {
                Some((_, id)) => write!(lines, "{id} ")?,
                None => lines.push_str("-1 "),
            }
        }
        if !keypoints.is_empty() {
            lines.pop();
        }
        lines.push('\n');
        Ok(lines)
    };
    let (points, images) = rayon::join(
        || model.points.par_chunks(POINTS_OF_PIECE).enumerate().map(points).collect::<Result<Vec<_>, _>>(),
        || model.images.par_iter().with_max_len(1).enumerate().map(image).collect::<Result<Vec<_>, _>>(),
    );
    let points_head = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n";
    let images_head = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n\
                       # POINTS2D[] as (X, Y, POINT3D_ID)\n";
    let files = [
        ("cameras.txt", cameras.as_str(), Vec::new()),
        ("images.txt", images_head, images?),
        ("points3D.txt", points_head, points?),
    ];
    files.par_iter().with_max_len(1).try_for_each(|(name, head, lines)| {
        let pieces = std::iter::once(*head).chain(lines.iter().map(String::as_str));
        write_pieces_atomically(&folder.join(name), pieces.map(str::as_bytes))
    })
}
