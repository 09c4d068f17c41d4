use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::Deserialize;
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use crate::text::read_text;

/// Poses known from elsewhere: east-north-up metres.
#[derive(Debug, Clone, Default, Deserialize)]
pub struct Truth {
    images: BTreeMap<String, TruthPose>,
    /// WGS84 place of the origin.
    #[serde(default)]
    pub geo_origin: Option<Wgs84>,
}

/// One image's true pose in `truth.json`.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(try_from = "WrittenPose")]
struct TruthPose(Rigid);

/// The same as it is written: rotation and centre of the camera in the world.
#[derive(Deserialize)]
struct WrittenPose {
    q_wxyz: [f64; 4],
    center: [f64; 3],
}

impl TryFrom<WrittenPose> for TruthPose {
    type Error = &'static str;

    fn try_from(written: WrittenPose) -> Result<Self, Self::Error> {
        let pose = rigid_of(written.q_wxyz, written.center);
        pose.map(Self).ok_or("`q_wxyz` is zero, which is no rotation")
    }
}

/// The transform of a quaternion, w first and of any length but 0, and a translation.
pub fn rigid_of([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Option<Rigid> {
    let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6)?;
    Some(Rigid::new(rotation, Vector3::from(translation)))
}

impl Truth {
    /// Reads a `truth.json`.
    ///
    /// # Errors
    /// With file and line.
    pub fn read(path: &Path) -> Result<Self> {
        let text = read_text(path)?;
        serde_json::from_str(&text).with_context(|| format!("{} is no truth.json", path.display()))
    }

    /// The images that it has a pose of, by name.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.images.keys().map(String::as_str)
    }

    /// The true `world_from_camera` of the images whose name starts with `prefix`.
    pub fn poses(&self, prefix: &str) -> BTreeMap<String, Rigid> {
        let named = self.images.iter().filter(|(name, _)| name.starts_with(prefix));
        named.map(|(name, pose)| (name.clone(), pose.0)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_of_zero_is_refused_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("truth.json");
        let write = |q: &str| {
            let pose = format!(r#"{{"q_wxyz": {q}, "center": [1, 2, 3]}}"#);
            std::fs::write(&file, format!("{{\"images\": {{\n\"a/b.jpg\": {pose}}}}}")).unwrap();
            Truth::read(&file)
        };
        let truth = write("[2, 0, 0, 0]").unwrap();
        assert!((truth.poses("a/")["a/b.jpg"].rotation.norm() - 1.0).abs() < 1e-12);
        assert!(truth.poses("b").is_empty());
        let error = format!("{:#}", write("[0, 0, 0, 0]").unwrap_err());
        assert!(error.contains("no rotation") && error.contains("line 2"), "{error}");
    }
}
