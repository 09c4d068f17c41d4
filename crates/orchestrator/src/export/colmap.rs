use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::Result;
use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::{ImageFeatures, Keypoint};
use setloc_sfm::{CameraId, ImageId, Observation, Reconstruction, ReconstructionImage, ReconstructionPoint};

use crate::colmap::{BYTES_OF_POINT_2D, ColmapFormat, FURTHER_PARTS, NO_POINT, PARTS};
use crate::error::Hinted;
use crate::store::{remove_files, write_pieces_atomically};

/// Points whose records are made, and written, at once.
const POINTS_OF_PIECE: usize = 2048;
/// About what the record of a point takes; more is made room for.
const BYTES_OF_POINT: usize = 96;
/// COLMAP's error of a point of which none is known.
const NO_ERROR: f64 = -1.0;
/// COLMAP's number of no camera model.
const NO_MODEL: i32 = -1;

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

/// Writes a model as COLMAP's `cameras.bin`, `images.bin` and `points3D.bin`, which hold any name and any number as it is; no other
/// model is left in the folder, since programs read what they find first.
///
/// Ids count from 1. COLMAP wants camera-from-world poses. `features[i]` belongs to image `i`; without it the image has no
/// 2D points, and tracks have no element in that image. A point's error is the mean one of its 2D points in pixels ([`error_px`]); COLMAP's
/// value of an unknown one, -1, where it has none.
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
    let written = written_as(model, &used);
    let cameras = camera_records(model, written.values().copied().collect());
    // Keypoints that are written, and the point that each of them sees.
    let keypoints_of = |(at, image): (usize, &ReconstructionImage)| {
        let features = features.get(at).copied().flatten().filter(|_| image.world_from_camera.is_some());
        features.map_or(&[][..], |features| &features.keypoints)
    };
    let keypoints: Vec<&[Keypoint]> = model.images.iter().enumerate().map(keypoints_of).collect();
    let mut seen: Vec<Vec<u64>> = keypoints.iter().map(|keypoints| vec![NO_POINT; keypoints.len()]).collect();
    for (at, point) in model.points.iter().enumerate() {
        for observation in &point.track {
            if let Some(id @ &mut NO_POINT) =
                seen[observation.image.index()].get_mut(observation.feature as usize)
            {
                *id = at as u64 + 1;
            }
        }
    }
    let points = |(piece, points): (usize, &[ReconstructionPoint])| {
        let mut records = Vec::with_capacity(points.len() * BYTES_OF_POINT);
        for (at, point) in points.iter().enumerate() {
            let id = (piece * POINTS_OF_PIECE + at + 1) as u64;
            let track: Vec<&Observation> =
                point.track.iter().filter(|sees| sees_point(**sees, id, &seen)).collect();
            let error = |sees: &&Observation| {
                let keypoint = keypoints[sees.image.index()].get(sees.feature as usize)?;
                error_px(model, sees.image, keypoint, &point.position)
            };
            add_point(&mut records, id, point, &track, mean(track.iter().filter_map(error)));
        }
        records
    };
    let image = |(at, image): (usize, &ReconstructionImage)| {
        let Some(pose) = image.world_from_camera else { return Vec::new() };
        let mut record = Vec::with_capacity(256 + keypoints[at].len() * BYTES_OF_POINT_2D);
        record.extend((at as u32 + 1).to_le_bytes());
        let camera_from_world = pose.inverse();
        let (q, t) = (camera_from_world.rotation.quaternion(), camera_from_world.translation);
        add_numbers(&mut record, [q.w, q.i, q.j, q.k, t.x, t.y, t.z]);
        record.extend((written[&image.camera].0 + 1).to_le_bytes());
        record.extend(image.name.bytes().chain([0]));
        record.extend((keypoints[at].len() as u64).to_le_bytes());
        let camera = &model.cameras[image.camera.index()];
        let plain = camera.is_stretched().then(|| camera.without_stretch());
        for (keypoint, point) in keypoints[at].iter().zip(&seen[at]) {
            let shown = plain.as_ref().and_then(|plain| plain.project(&camera.unproject(&keypoint.pixel())?));
            let place = shown.unwrap_or_else(|| keypoint.pixel());
            add_numbers(&mut record, [place.x, place.y]);
            record.extend(point.to_le_bytes());
        }
        record
    };
    let (points, images): (Vec<_>, Vec<_>) = rayon::join(
        || model.points.par_chunks(POINTS_OF_PIECE).enumerate().map(points).collect(),
        || model.images.par_iter().with_max_len(1).enumerate().map(image).collect(),
    );
    remove_colmap(folder)?;
    let counts =
        [written.values().collect::<BTreeSet<_>>().len(), model.registered().count(), model.points.len()];
    let files: Vec<_> = PARTS.iter().zip(counts).zip([vec![cameras], images, points]).collect();
    files.par_iter().with_max_len(1).try_for_each(|((part, count), records)| {
        let count = (*count as u64).to_le_bytes();
        let pieces = std::iter::once(&count[..]).chain(records.iter().map(Vec::as_slice));
        write_pieces_atomically(&folder.join(ColmapFormat::Binary.file(part)), pieces)
    })
}

/// The records of `cameras.bin`.
fn camera_records(model: &Reconstruction, cameras: BTreeSet<CameraId>) -> Vec<u8> {
    let mut records = Vec::new();
    for id in cameras {
        let camera = model.cameras[id.index()].without_stretch();
        records.extend((id.0 + 1).to_le_bytes());
        // What COLMAP lacks is refused before.
        records.extend(camera.model.colmap_id().unwrap_or(NO_MODEL).to_le_bytes());
        records.extend([camera.width, camera.height].iter().flat_map(|side| u64::from(*side).to_le_bytes()));
        add_numbers(&mut records, camera.params);
    }
    records
}

/// Whether the keypoint of an observation is written, and sees this point.
fn sees_point(observation: Observation, id: u64, seen: &[Vec<u64>]) -> bool {
    seen[observation.image.index()].get(observation.feature as usize) == Some(&id)
}

/// How far a point is from where a keypoint shows it, in pixels: the angle between them, by that which a pixel spans there; the same
/// at the seam and at the poles of panoramas. `None` where the image has no pose or the pixel no ray.
pub fn error_px(
    model: &Reconstruction,
    image: ImageId,
    keypoint: &Keypoint,
    position: &Vector3<f64>,
) -> Option<f64> {
    let pose = model.images[image.index()].world_from_camera?;
    let (bearing, unit) = model.camera_of(image).ray(&keypoint.pixel())?;
    Some(pose.inverse_transform_point(position).angle(&bearing) / unit)
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.fold((0_usize, 0.0), |(count, sum), value| (count + 1, sum + value));
    (count > 0).then(|| sum / count as f64)
}

/// A point's record of `points3D.bin`, with the observations that are written and their mean error in pixels.
fn add_point(
    records: &mut Vec<u8>,
    id: u64,
    point: &ReconstructionPoint,
    track: &[&Observation],
    error_px: Option<f64>,
) {
    let p = point.position;
    records.extend(id.to_le_bytes());
    add_numbers(records, [p.x, p.y, p.z]);
    records.extend(point.color);
    add_numbers(records, [error_px.unwrap_or(NO_ERROR)]);
    records.extend((track.len() as u64).to_le_bytes());
    for observation in track {
        records.extend((observation.image.0 + 1).to_le_bytes());
        records.extend(observation.feature.to_le_bytes());
    }
}

fn add_numbers(record: &mut Vec<u8>, numbers: impl IntoIterator<Item = f64>) {
    record.extend(numbers.into_iter().flat_map(f64::to_le_bytes));
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

/// Removes the model of an earlier scene or of another program, binary and text, and the folder if nothing else is in it.
///
/// # Errors
/// When a file cannot be removed.
pub fn remove_colmap(folder: &Path) -> Result<()> {
    let parts = || PARTS.iter().chain(&FURTHER_PARTS);
    let formats = [ColmapFormat::Binary, ColmapFormat::Text];
    let files: Vec<String> =
        formats.iter().flat_map(|format| parts().map(|part| format.file(part))).collect();
    remove_files(folder, &files.iter().map(String::as_str).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use setloc_features::{Camera, CameraModel};
    use setloc_sfm::Rigid;

    use super::*;
    use crate::colmap::Bytes;
    use crate::import::ImportedModel;

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

    /// The point of every keypoint by `images.bin`, and the keypoints of every point by `points3D.bin`.
    type Links = (BTreeMap<(usize, usize), usize>, BTreeMap<usize, Vec<(usize, usize)>>);

    fn written(model: &Reconstruction, features: &[Option<&ImageFeatures>]) -> Links {
        let folder = tempfile::tempdir().unwrap();
        write_colmap(folder.path(), model, features).unwrap();
        let mut points_of_keypoints = BTreeMap::new();
        for (image, keypoints) in images_of(folder.path()) {
            let linked = keypoints.into_iter().enumerate().filter(|(_, (_, point))| *point != NO_POINT);
            points_of_keypoints
                .extend(linked.map(|(index, (_, point))| ((image as usize, index), point as usize)));
        }
        (points_of_keypoints, tracks_of(folder.path()))
    }

    fn read_part<T>(
        folder: &Path,
        part: &str,
        mut record: impl FnMut(&mut Bytes<'_>) -> Result<T>,
    ) -> Vec<T> {
        let data = std::fs::read(folder.join(ColmapFormat::Binary.file(part))).unwrap();
        let mut bytes = Bytes { left: &data };
        let count = bytes.u64().unwrap();
        let records = (0..count).map(|_| record(&mut bytes).unwrap()).collect();
        assert!(bytes.left.is_empty(), "{part}: {} bytes too many", bytes.left.len());
        records
    }

    /// The place and point of each keypoint of an image.
    type Keypoints = Vec<([f64; 2], u64)>;

    /// The number of every image, and its keypoints.
    fn images_of(folder: &Path) -> Vec<(u32, Keypoints)> {
        read_part(folder, "images", |bytes| {
            let image = bytes.u32()?;
            bytes.skip(7 * 8 + 4)?;
            bytes.text()?;
            let count = bytes.u64()?;
            let keypoint = |_| Ok(([bytes.f64()?, bytes.f64()?], bytes.u64()?));
            Ok((image, (0..count).map(keypoint).collect::<Result<_>>()?))
        })
    }

    fn tracks_of(folder: &Path) -> BTreeMap<usize, Vec<(usize, usize)>> {
        let point = |bytes: &mut Bytes<'_>| {
            let point = bytes.u64()? as usize;
            bytes.skip(3 * 8 + 3 + 8)?;
            let count = bytes.u64()?;
            let element = |_| Ok((bytes.u32()? as usize, bytes.u32()? as usize));
            Ok((point, (0..count).map(element).collect::<Result<_>>()?))
        };
        read_part(folder, "points3D", point).into_iter().collect()
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
    fn errors_of_points_are_in_pixels() {
        let camera = Camera::equirectangular(200, 100);
        // On the horizon, where pixels are square.
        let position = Vector3::new(1.0, 0.0, 3.0);
        let shown = camera.project(&position).unwrap();
        let keypoint = |off: f64| Keypoint {
            x: shown.x as f32,
            y: (shown.y + off) as f32,
            size: 3.0,
            orientation: 0.0,
            noise_px: 0.5,
        };
        let features =
            ImageFeatures { keypoints: vec![keypoint(0.5), keypoint(1.5)], ..ImageFeatures::default() };
        // The second one is in an image without keypoints.
        let mut model = scene(camera, &[&[(0, 0), (1, 1)], &[(2, 0)]]);
        model.points[0].position = position;
        let folder = tempfile::tempdir().unwrap();
        write_colmap(folder.path(), &model, &[Some(&features), Some(&features), None]).unwrap();
        let error = |bytes: &mut Bytes<'_>| {
            bytes.skip(8 + 3 * 8 + 3)?;
            let error = bytes.f64()?;
            let count = bytes.u64()?;
            bytes.skip(8 * count)?;
            Ok(error)
        };
        let errors = read_part(folder.path(), "points3D", error);
        assert!((errors[0] - 1.0).abs() < 1e-3 && errors[1] == -1.0, "{errors:?}");
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
        let read = ImportedModel::read_colmap(folder.path()).unwrap();
        assert_eq!(read.cameras, BTreeMap::from([(1, Camera::equirectangular(200, 100))]));
        let (numbers, _) = images_of(folder.path())[0].1[0];
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
        std::fs::write(folder.join("project.ini"), "").unwrap();
        assert!(renew_colmap(&folder, &cropped, &[]).unwrap().is_some());
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    }

    #[test]
    fn no_file_of_another_model_stays_beside_the_one_that_is_written() {
        let folder = tempfile::tempdir().unwrap();
        for older in ["images.txt", "cameras.txt", "rigs.bin", "frames.bin", "frames.txt", "mine.txt"] {
            std::fs::write(folder.path().join(older), "older").unwrap();
        }
        write_colmap(folder.path(), &scene(Camera::equirectangular(100, 50), &[]), &[]).unwrap();
        let entries = std::fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        assert_eq!(names, ["cameras.bin", "images.bin", "mine.txt", "points3D.bin"]);
    }
}
