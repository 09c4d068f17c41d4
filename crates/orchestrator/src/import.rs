//! Models and poses of other programs.

mod cameras;
mod colmap_binary;
mod colmap_text;
mod located;
mod poses;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Result;
use serde_json::{Value, json};
use setloc_features::Camera;
use setloc_sfm::Rigid;

pub use self::located::LocatedPhotos;
pub use self::poses::{NamedPoses, read_poses};

use self::cameras::ColmapCamera;
use crate::colmap::ColmapFormat;
use crate::error::Hinted;
use crate::export::pose_json;

/// Camera number and pose (`world_from_camera`) by image name.
type Images = BTreeMap<String, (u32, Rigid)>;

/// Cameras and poses of a model.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImportedModel {
    /// Cameras by their number in the model, of those whose model is known here.
    pub cameras: BTreeMap<u32, Camera>,
    /// Names of the other cameras' models, by the cameras' numbers.
    pub foreign: BTreeMap<u32, &'static str>,
    /// Camera number and pose (`world_from_camera`) by image name.
    pub images: BTreeMap<String, (u32, Rigid)>,
}

impl ImportedModel {
    /// Reads a COLMAP model: `cameras` and `images`, binary where there are such files, as COLMAP itself does, else text.
    ///
    /// # Errors
    /// With file and place.
    pub fn read_colmap(folder: &Path) -> Result<Self> {
        let format = ColmapFormat::of(folder)?;
        let file = format.file("cameras");
        let path = folder.join(&file);
        let cameras = match format {
            ColmapFormat::Binary => colmap_binary::cameras(&path)?,
            ColmapFormat::Text => colmap_text::cameras(&path)?,
        };
        let images = format.images(folder, |camera| {
            anyhow::ensure!(cameras.contains_key(&camera), "{file} has no camera {camera}");
            Ok(())
        })?;
        let mut model = Self { images, ..Self::default() };
        for (number, camera) in cameras {
            match camera {
                ColmapCamera::Known(camera) => {
                    model.cameras.insert(number, camera);
                }
                ColmapCamera::Foreign(name) => {
                    model.foreign.insert(number, name);
                }
            }
        }
        Ok(model)
    }

    /// Names of the images whose cameras are not known here.
    pub fn without_camera(&self) -> impl Iterator<Item = &str> {
        let is_foreign = |(_, (number, _)): &(&String, &(u32, Rigid))| self.foreign.contains_key(number);
        self.images.iter().filter(is_foreign).map(|(name, _)| name.as_str())
    }

    /// As `cameras.json`, without cameras that are not known here and their images; `prefix` is put before the images' names.
    pub fn to_cameras_json(&self, prefix: &str) -> Value {
        let images: BTreeMap<String, String> = self
            .images
            .iter()
            .filter(|(_, (number, _))| self.cameras.contains_key(number))
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

impl ColmapFormat {
    /// That of the model in a folder.
    fn of(folder: &Path) -> Result<Self> {
        let in_folder = |folder: &Path| {
            let is_there = |format: &Self| folder.join(format.file("images")).is_file();
            [Self::Binary, Self::Text].into_iter().find(is_there)
        };
        in_folder(folder).ok_or_else(|| {
            // COLMAP numbers the models of a place.
            let numbered = ["0", "sparse/0", "sparse"].map(|below| folder.join(below));
            let below = numbered.iter().find(|below| in_folder(below).is_some());
            let hint = below.map_or_else(
                || "name the folder of a COLMAP model".to_owned(),
                |below| format!("there is one in {}", below.display()),
            );
            Hinted::error(format!("{} has neither images.bin nor images.txt", folder.display()), hint)
        })
    }

    /// The images of the model in a folder, each of whose cameras is checked.
    fn images(self, folder: &Path, check: impl Fn(u32) -> Result<()>) -> Result<Images> {
        let file = folder.join(self.file("images"));
        match self {
            Self::Binary => colmap_binary::images(&file, check),
            Self::Text => colmap_text::images(&file, check),
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
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

    #[test]
    fn poses_of_cameras_that_are_not_known_are_read_and_their_intrinsics_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("cameras.txt", "1 SIMPLE_PINHOLE 640 480 500 320 240\n2 FOV 640 480 500 500 320 240 0.9\n");
        write("images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 2 b.jpg\n\n");
        let read = ImportedModel::read_colmap(folder.path()).unwrap();
        assert_eq!(read.foreign, BTreeMap::from([(2, "FOV")]));
        assert_eq!(read.without_camera().collect::<Vec<_>>(), ["b.jpg"]);
        let cameras = read.to_cameras_json("");
        assert_eq!(cameras["images"], json!({ "a.jpg": "1" }));
        assert_eq!(cameras["cameras"].as_object().unwrap().keys().collect::<Vec<_>>(), ["1"]);
        assert_eq!(read.to_truth_json("")["images"].as_object().unwrap().len(), 2);
    }

    #[test]
    fn a_folder_without_a_model_is_said_and_where_one_is() {
        let folder = tempfile::tempdir().unwrap();
        let hint = || {
            let error = ImportedModel::read_colmap(folder.path()).unwrap_err();
            error.downcast_ref::<Hinted>().unwrap().hint().to_owned()
        };
        assert_eq!(hint(), "name the folder of a COLMAP model");
        let below = folder.path().join("sparse/0");
        std::fs::create_dir_all(&below).unwrap();
        std::fs::write(below.join("images.bin"), [0; 8]).unwrap();
        assert!(hint().contains("sparse/0"));
    }
}
