//! Models of other programs.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use setloc_features::Camera;
use setloc_sfm::Rigid;

use crate::error::Hinted;
use crate::export::pose_json;

/// Cameras and poses of a model.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImportedModel {
    /// Cameras by their number in the model.
    pub cameras: BTreeMap<u32, Camera>,
    /// Camera number and pose (`world_from_camera`) by image name.
    pub images: BTreeMap<String, (u32, Rigid)>,
}

impl ImportedModel {
    /// Reads `cameras.txt` and `images.txt` of COLMAP's text model.
    ///
    /// # Errors
    /// With file and line.
    pub fn read_colmap(folder: &Path) -> Result<Self> {
        let read = |name: &str| {
            let path = folder.join(name);
            std::fs::read_to_string(&path).map_err(|error| {
                let error = anyhow::Error::new(error).context(format!("cannot read {}", path.display()));
                let hint =
                    "name a text model; `colmap model_converter --output_type TXT` makes one of a binary";
                Hinted::wrap(error, hint)
            })
        };
        let mut model = Self::default();
        for (at, line) in read("cameras.txt")?.lines().enumerate() {
            if is_content(line) {
                let place = || format!("{}, line {}", folder.join("cameras.txt").display(), at + 1);
                let (number, camera) = parse_camera(line).with_context(place)?;
                model.cameras.insert(number, camera);
            }
        }
        let text = read("images.txt")?;
        let mut lines = text.lines().enumerate();
        while let Some((at, line)) = lines.next() {
            if !is_content(line) {
                continue;
            }
            // Each image has a second line of points, which may be empty.
            lines.next();
            let place = || format!("{}, line {}", folder.join("images.txt").display(), at + 1);
            let (name, number, pose) = parse_image(line).with_context(place)?;
            let known = model.cameras.contains_key(&number);
            anyhow::ensure!(known, "{}: cameras.txt has no camera {number}", place());
            model.images.insert(name, (number, pose));
        }
        Ok(model)
    }

    /// As `cameras.json`; `prefix` is put before the images' names.
    pub fn to_cameras_json(&self, prefix: &str) -> Value {
        let images: BTreeMap<String, String> = self
            .images
            .iter()
            .map(|(name, (number, _))| (format!("{prefix}{name}"), number.to_string()))
            .collect();
        json!({ "cameras": self.cameras, "images": images })
    }

    /// As `truth.json`; `prefix` is put before the images' names.
    pub fn to_truth_json(&self, prefix: &str) -> Value {
        let images: BTreeMap<String, Value> = self
            .images
            .iter()
            .map(|(name, (_, pose))| (format!("{prefix}{name}"), pose_json(pose)))
            .collect();
        json!({ "images": images })
    }
}

fn is_content(line: &str) -> bool {
    !line.trim().is_empty() && !line.trim_start().starts_with('#')
}

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMS…`
fn parse_camera(line: &str) -> Result<(u32, Camera)> {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let [number, model, width, height, params @ ..] = &fields[..] else {
        anyhow::bail!("a camera has number, model, width, height and parameters");
    };
    let params = params.iter().map(|text| finite(text)).collect::<Result<Vec<f64>>>()?;
    let (width, height): (u32, u32) = (width.parse()?, height.parse()?);
    let camera: Camera = serde_json::from_value(
        json!({ "model": model, "width": width, "height": height, "params": params }),
    )?;
    camera.validate()?;
    Ok((number.parse()?, camera))
}

/// `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, the pose camera-from-world.
fn parse_image(line: &str) -> Result<(String, u32, Rigid)> {
    // The name may hold blanks.
    let mut name = line.trim();
    let mut fields = Vec::new();
    while let Some((field, rest)) = name.split_once(char::is_whitespace).filter(|_| fields.len() < 9) {
        fields.push(field);
        name = rest.trim_start();
    }
    let [_, numbers @ .., camera] = &fields[..] else {
        anyhow::bail!("an image has number, rotation, translation, camera and name");
    };
    let numbers = numbers.iter().map(|text| finite(text)).collect::<Result<Vec<f64>>>()?;
    let [w, x, y, z, tx, ty, tz] = numbers[..] else {
        anyhow::bail!("an image has 4 numbers of rotation and 3 of translation");
    };
    let rotation =
        UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).context("the rotation is zero")?;
    let camera_from_world = Rigid::new(rotation, Vector3::new(tx, ty, tz));
    Ok((name.to_owned(), camera.parse()?, camera_from_world.inverse()))
}

fn finite(text: &str) -> Result<f64> {
    let value: f64 = text.parse().with_context(|| format!("`{text}` is no number"))?;
    anyhow::ensure!(value.is_finite(), "`{text}` is no finite number");
    Ok(value)
}

#[cfg(test)]
mod tests {
    use setloc_sfm::{CameraId, Reconstruction, ReconstructionImage};

    use super::*;
    use crate::export::write_colmap;

    #[test]
    fn gives_back_what_was_exported() {
        let camera: Camera = serde_json::from_value(json!({
            "model": "OPENCV", "width": 640, "height": 480,
            "params": [500.0, 501.0, 320.0, 240.0, 0.01, -0.02, 0.001, 0.0]
        }))
        .unwrap();
        let pose =
            Rigid::new(UnitQuaternion::from_euler_angles(0.3, -1.0, 2.0), Vector3::new(1.0, -2.0, 30.0));
        let image = |name: &str, world_from_camera| ReconstructionImage {
            name: name.to_owned(),
            camera: CameraId(0),
            world_from_camera,
        };
        let model = Reconstruction {
            cameras: vec![camera.clone()],
            images: vec![image("a b.jpg", Some(pose)), image("lost.jpg", None)],
            ..Reconstruction::default()
        };
        let folder = tempfile::tempdir().unwrap();
        write_colmap(folder.path(), &model, &[]).unwrap();
        let read = ImportedModel::read_colmap(folder.path()).unwrap();
        assert_eq!(read.cameras, BTreeMap::from([(1, camera)]));
        assert_eq!(read.images.keys().collect::<Vec<_>>(), ["a b.jpg"]);
        let (number, found) = &read.images["a b.jpg"];
        assert_eq!(*number, 1);
        assert!(found.rotation.angle_to(&pose.rotation) < 1e-12);
        assert!((found.translation - pose.translation).norm() < 1e-12);
        assert!(read.to_truth_json("panoramas/")["images"]["panoramas/a b.jpg"]["center"].is_array());
    }

    #[test]
    fn fields_are_parted_by_any_white_space() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("cameras.txt", "  # a comment\n1\tSIMPLE_PINHOLE  640 480\t500 320 240\r\n");
        write("images.txt", " 1  1 0\t0 0  4 5   6\t1  a  b.jpg \r\n\r\n2 1 0 0 0 0 0 0 1 c.jpg\n");
        let read = ImportedModel::read_colmap(folder.path()).unwrap();
        assert_eq!(read.images.keys().collect::<Vec<_>>(), ["a  b.jpg", "c.jpg"]);
        assert_eq!(read.images["a  b.jpg"].1.translation, Vector3::new(-4.0, -5.0, -6.0));
    }

    #[test]
    fn wrong_lines_are_named() {
        let error_of = |cameras: &str, images: &str| {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join("cameras.txt"), cameras).unwrap();
            std::fs::write(folder.path().join("images.txt"), images).unwrap();
            format!("{:#}", ImportedModel::read_colmap(folder.path()).unwrap_err())
        };
        let good = "# a comment\n1 SIMPLE_PINHOLE 640 480 500 320 240\n";
        assert!(error_of("1 PINHOL 640 480 1 1 1 1\n", "").contains("cameras.txt, line 1"));
        assert!(error_of("1 SIMPLE_PINHOLE 640 480 NaN 320 240\n", "").contains("no finite number"));
        assert!(error_of(good, "1 1 0 0 0 0 0 x 1 a.jpg\n").contains("images.txt, line 1"));
        assert!(error_of(good, "1 1 0 0 0 0 0 0 1\n").contains("images.txt, line 1"));
        assert!(error_of(good, "1 0 0 0 0 0 0 0 1 a.jpg\n").contains("rotation is zero"));
        assert!(
            error_of(good, "\n1 1 0 0 0 0 0 0 2 a.jpg\n").contains("line 2: cameras.txt has no camera 2")
        );
    }
}
