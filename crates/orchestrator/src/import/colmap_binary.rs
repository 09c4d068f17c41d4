//! COLMAP's binary model: little-endian numbers one after the other.

use std::path::Path;

use anyhow::{Context, Result};

use super::Images;
use super::cameras::{Cameras, ColmapModel};
use super::poses::rigid;
use crate::colmap::{BYTES_OF_POINT_2D, Bytes};

/// Reads `cameras.bin`.
pub(super) fn cameras(file: &Path) -> Result<Cameras> {
    read(file, |bytes| {
        let mut cameras = Cameras::new();
        for _ in 0..bytes.u64()? {
            let (number, model) = (bytes.u32()?, bytes.i32()?);
            let place = || format!("camera {number}");
            let model = ColmapModel::of_id(model).with_context(place)?;
            let size = |pixels: u64| u32::try_from(pixels).context("more than 2³² pixels a side");
            let size = (size(bytes.u64()?)?, size(bytes.u64()?)?);
            let params = (0..model.num_params()).map(|_| bytes.f64()).collect::<Result<_>>()?;
            cameras.insert(number, model.camera(size, params).with_context(place)?);
        }
        Ok(cameras)
    })
}

/// Reads `images.bin`; `check` is asked for each image's camera.
pub(super) fn images(file: &Path, check: impl Fn(u32) -> Result<()>) -> Result<Images> {
    read(file, |bytes| {
        let mut images = Images::new();
        for _ in 0..bytes.u64()? {
            let number = bytes.u32()?;
            let mut pose = [0.0; 7];
            for value in &mut pose {
                *value = bytes.f64()?;
            }
            let (camera, name) = (bytes.u32()?, bytes.text()?);
            let points = bytes.u64()?;
            bytes.skip(points.saturating_mul(BYTES_OF_POINT_2D as u64))?;
            let place = || format!("image {number}, {name}");
            let camera_from_world = rigid(pose).with_context(place)?;
            check(camera).with_context(place)?;
            images.insert(name, (camera, camera_from_world.inverse()));
        }
        Ok(images)
    })
}

fn read<T>(file: &Path, parse: impl FnOnce(&mut Bytes<'_>) -> Result<T>) -> Result<T> {
    let data = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    let mut bytes = Bytes { left: &data };
    let parsed = parse(&mut bytes);
    parsed.with_context(|| format!("{}, byte {}", file.display(), data.len() - bytes.left.len()))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use setloc_features::CameraModel;

    use super::super::cameras::ColmapCamera;
    use super::*;

    fn written(name: &str, bytes: &[u8]) -> (tempfile::TempDir, std::path::PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        (folder, file)
    }

    fn camera_bytes(model: i32, params: &[f64]) -> Vec<u8> {
        let mut bytes = [1_u64.to_le_bytes().as_slice(), &7_u32.to_le_bytes(), &model.to_le_bytes()].concat();
        bytes.extend([640_u64, 480].iter().flat_map(|side| side.to_le_bytes()));
        bytes.extend(params.iter().flat_map(|param| param.to_le_bytes()));
        bytes
    }

    /// Of one image with two points.
    fn image_bytes(quaternion: [f64; 4]) -> Vec<u8> {
        let mut bytes = [1_u64.to_le_bytes().as_slice(), &3_u32.to_le_bytes()].concat();
        bytes.extend(quaternion.iter().chain(&[4.0, 5.0, 6.0]).flat_map(|value| value.to_le_bytes()));
        bytes.extend(7_u32.to_le_bytes());
        bytes.extend(b"a b.jpg\0");
        bytes.extend(2_u64.to_le_bytes());
        bytes.extend([0; 48]);
        bytes
    }

    #[test]
    fn cameras_and_poses_are_read() {
        let (_folder, file) = written("cameras.bin", &camera_bytes(0, &[500.0, 320.0, 240.0]));
        let cameras = cameras(&file).unwrap();
        let ColmapCamera::Known(camera) = &cameras[&7] else { panic!("{cameras:?}") };
        assert_eq!((camera.model, camera.width, camera.height), (CameraModel::SimplePinhole, 640, 480));
        assert_eq!(camera.params, [500.0, 320.0, 240.0]);
        let (_folder, file) = written("images.bin", &image_bytes([1.0, 0.0, 0.0, 0.0]));
        let images = images(&file, |_| Ok(())).unwrap();
        assert_eq!(images.keys().collect::<Vec<_>>(), ["a b.jpg"]);
        let (camera, pose) = images["a b.jpg"];
        assert_eq!((camera, pose.translation), (7, Vector3::new(-4.0, -5.0, -6.0)));
    }

    #[test]
    fn what_is_cut_off_or_makes_no_sense_is_named_with_its_place() {
        let error_of_cameras = |bytes: &[u8]| {
            let (_folder, file) = written("cameras.bin", bytes);
            format!("{:#}", cameras(&file).unwrap_err())
        };
        let whole = camera_bytes(0, &[500.0, 320.0, 240.0]);
        for length in 0..whole.len() {
            assert!(error_of_cameras(&whole[..length]).contains("cut off"), "{length}");
        }
        let unknown = error_of_cameras(&camera_bytes(99, &[1.0; 12]));
        assert!(
            unknown.contains("cameras.bin, byte 16: camera 7: camera model 99 is none of COLMAP"),
            "{unknown}"
        );
        assert!(error_of_cameras(&camera_bytes(0, &[f64::NAN, 1.0, 1.0])).contains("camera 7"));

        let error_of_images = |bytes: &[u8]| {
            let (_folder, file) = written("images.bin", bytes);
            format!("{:#}", images(&file, |_| Ok(())).unwrap_err())
        };
        let whole = image_bytes([1.0, 0.0, 0.0, 0.0]);
        for length in 0..whole.len() {
            let error = error_of_images(&whole[..length]);
            assert!(
                error.contains("cut off") || error.contains("a name without an end"),
                "{length}: {error}"
            );
        }
        assert!(error_of_images(&image_bytes([0.0; 4])).contains("image 3, a b.jpg"));
        // As many points as no file has.
        let mut many = whole;
        many[84..92].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(error_of_images(&many).contains("cut off"));
    }
}
