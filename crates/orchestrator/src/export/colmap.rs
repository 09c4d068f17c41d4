use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;

use anyhow::Result;
use rayon::prelude::*;
use setloc_features::{ImageFeatures, Keypoint};
use setloc_sfm::{CameraId, Reconstruction, ReconstructionImage, ReconstructionPoint};

use crate::error::Hinted;
use crate::store::{remove_files, write_pieces_atomically};

/// What a model consists of.
const FILES: [&str; 3] = ["cameras.txt", "images.txt", "points3D.txt"];
/// Points whose lines are made, and written, at once.
const POINTS_OF_PIECE: usize = 2048;
/// About what the lines of a point and of a keypoint take; more is made room for.
const BYTES_OF_POINT: usize = 128;
const BYTES_OF_KEYPOINT: usize = 26;

/// What COLMAP's camera models cannot hold of a model's registered images; `None` when they hold all.
pub fn colmap_lacks(model: &Reconstruction) -> Option<String> {
    model.registered().find_map(|id| {
        let (camera, name) = (model.camera_of(id).without_stretch(), &model.images[id.index()].name);
        let kind = camera.model.name();
        if camera.model.colmap_id().is_none() {
            return Some(format!("COLMAP has no camera model {kind}, which {name} has"));
        }
        // Only a panorama may have more, those of its crop.
        let cropped = camera.params.len() > camera.model.num_params();
        cropped.then(|| format!("COLMAP's {kind} is a whole panorama, and {name} is cropped"))
    })
}

/// The camera that each one is written as: panoramas of one size that differ in their stretch have the first one's.
fn written_as(model: &Reconstruction, used: &BTreeSet<CameraId>) -> BTreeMap<CameraId, CameraId> {
    let is_stretched = |id: &CameraId| model.cameras[id.index()].is_stretched();
    let plain = |id: &CameraId| model.cameras[id.index()].without_stretch();
    let first = |id: &CameraId| used.iter().find(|other| is_stretched(other) && plain(other) == plain(id));
    used.iter().map(|id| (*id, *first(id).filter(|_| is_stretched(id)).unwrap_or(id))).collect()
}

/// Writes a model as COLMAP's `cameras.txt`, `images.txt` and `points3D.txt`.
///
/// Ids count from 1. COLMAP wants camera-from-world poses. `features[i]` belongs to image `i`; without it the line of
/// 2D points stays empty, and tracks have no element in that image.
///
/// COLMAP has no stretched panoramas: they are written as plain ones, and their keypoints where such a one shows them. Those of one
/// size then have one camera.
///
/// # Errors
/// When COLMAP lacks a camera's model ([`colmap_lacks`]) or a file cannot be written.
pub fn write_colmap(
    folder: &Path,
    model: &Reconstruction,
    features: &[Option<&ImageFeatures>],
) -> Result<()> {
    if let Some(lack) = colmap_lacks(model) {
        return Err(Hinted::error(lack, "`--format json` has every camera model"));
    }
    let used: BTreeSet<CameraId> = model.registered().map(|id| model.images[id.index()].camera).collect();
    let mut cameras = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    let written = written_as(model, &used);
    for id in written.values().collect::<BTreeSet<_>>() {
        let camera = model.cameras[id.index()].without_stretch();
        let (name, width, height) = (camera.model.name(), camera.width, camera.height);
        let params: Vec<String> = camera.params.iter().map(f64::to_string).collect();
        writeln!(cameras, "{} {name} {width} {height} {}", id.0 + 1, params.join(" "))?;
    }
    // Keypoints that are written, and the point that each of them sees, 0 for none.
    let keypoints_of = |(at, image): (usize, &ReconstructionImage)| {
        let features = features.get(at).copied().flatten().filter(|_| image.world_from_camera.is_some());
        features.map_or(&[][..], |features| &features.keypoints)
    };
    let keypoints: Vec<&[Keypoint]> = model.images.iter().enumerate().map(keypoints_of).collect();
    let mut seen: Vec<Vec<usize>> = keypoints.iter().map(|keypoints| vec![0; keypoints.len()]).collect();
    for (at, point) in model.points.iter().enumerate() {
        for observation in &point.track {
            if let Some(id @ 0) = seen[observation.image.index()].get_mut(observation.feature as usize) {
                *id = at + 1;
            }
        }
    }
    let points = |(piece, points): (usize, &[ReconstructionPoint])| -> Result<String, std::fmt::Error> {
        let mut lines = String::with_capacity(points.len() * BYTES_OF_POINT);
        for (at, point) in points.iter().enumerate() {
            let (p, [r, g, b]) = (point.position, point.color);
            let id = piece * POINTS_OF_PIECE + at + 1;
            write!(lines, "{id} {} {} {} {r} {g} {b} {:.4}", p.x, p.y, p.z, point.error_sigma)?;
            for observation in &point.track {
                if seen[observation.image.index()].get(observation.feature as usize) == Some(&id) {
                    write!(lines, " {} {}", observation.image.0 + 1, observation.feature)?;
                }
            }
            lines.push('\n');
        }
        Ok(lines)
    };
    let image = |(at, image): (usize, &ReconstructionImage)| -> Result<String, std::fmt::Error> {
        let mut lines = String::with_capacity(512 + keypoints[at].len() * BYTES_OF_KEYPOINT);
        let Some(pose) = image.world_from_camera else { return Ok(lines) };
        let camera_from_world = pose.inverse();
        let (q, t) = (camera_from_world.rotation.quaternion(), camera_from_world.translation);
        let ids = format!("{} {}", written[&image.camera].0 + 1, image.name);
        writeln!(lines, "{} {} {} {} {} {} {} {} {ids}", at + 1, q.w, q.i, q.j, q.k, t.x, t.y, t.z)?;
        let camera = &model.cameras[image.camera.index()];
        let plain = camera.is_stretched().then(|| camera.without_stretch());
        let place = |keypoint: &Keypoint| {
            let shown = plain.as_ref().and_then(|plain| plain.project(&camera.unproject(&keypoint.pixel())?));
            shown.map_or([keypoint.x, keypoint.y], |pixel| [pixel.x as f32, pixel.y as f32])
        };
        // Nearly all of the export: millions of numbers.
        let mut number = zmij::Buffer::new();
        for (keypoint, point) in keypoints[at].iter().zip(&seen[at]) {
            for coordinate in place(keypoint) {
                lines.push_str(number.format(coordinate));
                lines.push(' ');
            }
            match point {
                0 => lines.push_str("-1 "),
                id => write!(lines, "{id} ")?,
            }
        }
        if !keypoints[at].is_empty() {
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
    let files = [(cameras.as_str(), Vec::new()), (images_head, images?), (points_head, points?)];
    FILES.par_iter().zip(&files).with_max_len(1).try_for_each(|(name, (head, lines))| {
        let pieces = std::iter::once(*head).chain(lines.iter().map(String::as_str));
        write_pieces_atomically(&folder.join(name), pieces.map(str::as_bytes))
    })
}

/// Writes a model as [`write_colmap`] does; what COLMAP lacks of it, and then no model of an earlier run is left either.
///
/// # Errors
/// When a file cannot be written or removed.
pub fn renew_colmap(
    folder: &Path,
    model: &Reconstruction,
    features: &[Option<&ImageFeatures>],
) -> Result<Option<String>> {
    let Some(lack) = colmap_lacks(model) else {
        write_colmap(folder, model, features)?;
        return Ok(None);
    };
    remove_colmap(folder)?;
    Ok(Some(lack))
}

/// Removes the model of an earlier scene, and the folder if nothing else is in it.
///
/// # Errors
/// When a file cannot be removed.
pub fn remove_colmap(folder: &Path) -> Result<()> {
    remove_files(folder, &FILES)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use nalgebra::Vector3;
    use setloc_features::{Camera, CameraModel};
    use setloc_sfm::{ImageId, Observation, Rigid};

    use super::*;

    fn scene(camera: Camera, tracks: &[&[(u32, u32)]]) -> Reconstruction {
        let image = |at: u32| ReconstructionImage {
            name: format!("{at}.jpg"),
            camera: CameraId(0),
            world_from_camera: (at < 2).then(Rigid::identity),
        };
        let point = |track: &&[(u32, u32)]| ReconstructionPoint {
            position: Vector3::new(1.0, 2.0, 3.0),
            color: [1, 2, 3],
            error_sigma: 1.0,
            covariance: None,
            track: track
                .iter()
                .map(|&(image, feature)| Observation { image: ImageId(image), feature })
                .collect(),
            aligned: None,
        };
        Reconstruction {
            cameras: vec![camera, Camera::equirectangular(8, 4)],
            images: (0..3).map(image).collect(),
            points: tracks.iter().map(point).collect(),
            ..Reconstruction::default()
        }
    }

    /// The point of every keypoint by `images.txt`, and the keypoints of every point by `points3D.txt`.
    type Links = (BTreeMap<(usize, usize), usize>, BTreeMap<usize, Vec<(usize, usize)>>);

    fn written(model: &Reconstruction, features: &[Option<&ImageFeatures>]) -> Links {
        let folder = tempfile::tempdir().unwrap();
        write_colmap(folder.path(), model, features).unwrap();
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        let numbers = |line: &str| -> Vec<f64> {
            line.split_whitespace().map(|field| field.parse().unwrap_or(f64::NAN)).collect()
        };
        let (images, points, cameras) = (read("images.txt"), read("points3D.txt"), read("cameras.txt"));
        assert_eq!(cameras.lines().count(), 2, "a camera without an image: {cameras}");
        let mut points_of_keypoints = BTreeMap::new();
        for pair in images.lines().skip(2).collect::<Vec<_>>().chunks(2) {
            let image = numbers(pair[0])[0] as usize;
            for (index, keypoint) in numbers(pair[1]).chunks(3).enumerate().filter(|(_, k)| k[2] >= 0.0) {
                points_of_keypoints.insert((image, index), keypoint[2] as usize);
            }
        }
        let track = |line: &str| {
            let fields = numbers(line);
            (fields[0] as usize, fields[8..].chunks(2).map(|at| (at[0] as usize, at[1] as usize)).collect())
        };
        (points_of_keypoints, points.lines().skip(1).map(track).collect())
    }

    #[test]
    fn tracks_and_two_dimensional_points_name_each_other() {
        let keypoint = Keypoint { x: 1.0, y: 2.0, size: 3.0, orientation: 0.0, noise_px: 0.5 };
        let features = ImageFeatures { keypoints: vec![keypoint; 3], ..ImageFeatures::default() };
        // The second point claims a keypoint of the first and one in an image without a pose, the third one that the
        // image does not have.
        let tracks: [&[(u32, u32)]; 3] = [&[(0, 1), (1, 2)], &[(0, 2), (1, 2), (2, 0)], &[(0, 0), (1, 7)]];
        let model = scene(Camera::equirectangular(200, 100), &tracks);
        let (points, tracks) = written(&model, &[Some(&features); 3]);
        assert_eq!(points, BTreeMap::from([((1, 1), 1), ((2, 2), 1), ((1, 2), 2), ((1, 0), 3)]));
        let expected = [(1, vec![(1, 1), (2, 2)]), (2, vec![(1, 2)]), (3, vec![(1, 0)])];
        assert_eq!(tracks, BTreeMap::from(expected));
        let (points, tracks) = written(&model, &[]);
        assert!(points.is_empty() && tracks.len() == 3 && tracks.values().all(Vec::is_empty), "{tracks:?}");
    }

    #[test]
    fn stretched_panoramas_are_written_as_plain_ones_that_show_the_same_directions() {
        let mut camera = Camera::equirectangular(200, 100).as_stitched().unwrap();
        camera.params[4] = 0.01;
        let keypoint = Keypoint { x: 130.0, y: 40.0, size: 3.0, orientation: 0.0, noise_px: 0.5 };
        let features = ImageFeatures { keypoints: vec![keypoint], ..ImageFeatures::default() };
        let folder = tempfile::tempdir().unwrap();
        let mut model = scene(camera.clone(), &[]);
        // Another one of the same size that is stretched otherwise.
        let (mut other, at) = (camera.clone(), CameraId(model.cameras.len() as u32));
        other.params[5] = 0.002;
        model.cameras.push(other);
        model.images[1].camera = at;
        write_colmap(folder.path(), &model, &[Some(&features); 3]).unwrap();
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        let cameras = read("cameras.txt");
        assert_eq!(cameras.lines().skip(1).collect::<Vec<_>>(), ["1 EQUIRECTANGULAR 200 100 200 100"]);
        let images = read("images.txt");
        let numbers: Vec<f64> =
            images.lines().nth(3).unwrap().split(' ').map(|number| number.parse().unwrap()).collect();
        let shown = Camera::equirectangular(200, 100).unproject(&[numbers[0], numbers[1]].into()).unwrap();
        let expected = camera.unproject(&keypoint.pixel()).unwrap();
        assert!(shown.angle(&expected) < 1e-6, "{shown} {expected}");
        assert!((numbers[0] - 130.0).abs() > 0.2, "{numbers:?}");
    }

    #[test]
    fn cameras_that_colmap_lacks_are_refused_with_their_image() {
        let refused = |model: CameraModel, params: &[f64]| {
            let camera = Camera { model, width: 100, height: 50, params: params.to_vec() };
            let folder = tempfile::tempdir().unwrap();
            let error = write_colmap(folder.path(), &scene(camera, &[]), &[]).unwrap_err().to_string();
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
            error
        };
        let crop = refused(CameraModel::Equirectangular, &[200.0, 100.0, 50.0, 25.0]);
        assert_eq!(crop, "COLMAP's EQUIRECTANGULAR is a whole panorama, and 0.jpg is cropped");
        let paper = refused(CameraModel::PaperRectilinear, &[100.0, 50.0, 25.0]);
        assert_eq!(paper, "COLMAP has no camera model PAPER_RECTILINEAR, which 0.jpg has");
    }

    #[test]
    fn a_model_that_is_not_written_leaves_none_of_an_earlier_run() {
        let whole = scene(Camera::equirectangular(100, 50), &[]);
        let params = vec![200.0, 100.0, 50.0, 25.0];
        let cropped = scene(Camera { params, ..Camera::equirectangular(100, 50) }, &[]);
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("colmap");
        assert!(renew_colmap(&folder, &cropped, &[]).unwrap().is_some());
        assert_eq!(renew_colmap(&folder, &whole, &[]).unwrap(), None);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 3);
        assert!(renew_colmap(&folder, &cropped, &[]).unwrap().is_some());
        assert!(!folder.exists());
        assert_eq!(renew_colmap(&folder, &whole, &[]).unwrap(), None);
        std::fs::write(folder.join("rigs.txt"), "").unwrap();
        assert!(renew_colmap(&folder, &cropped, &[]).unwrap().is_some());
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    }
}
