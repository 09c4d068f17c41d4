use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::Deserialize;
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

/// One image's true pose in `truth.json`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct TruthPose {
    /// World-from-camera rotation, w first.
    pub q_wxyz: [f64; 4],
    /// Centre in the world.
    pub center: [f64; 3],
}

/// Poses known from elsewhere: east-north-up metres.
#[derive(Debug, Clone, Default, Deserialize)]
pub struct Truth {
    images: BTreeMap<String, TruthPose>,
    /// WGS84 place of the origin.
    #[serde(default)]
    pub geo_origin: Option<Wgs84>,
}

impl Truth {
    /// Reads a `truth.json`.
    ///
    /// # Errors
    /// With file and line.
    pub fn read(path: &Path) -> Result<Self> {
        let text =
            std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        serde_json::from_str(&text).with_context(|| format!("{} is no truth.json", path.display()))
    }

    /// The true `world_from_camera` of an image.
    pub fn pose(&self, name: &str) -> Option<Rigid> {
        self.images.get(name).map(|pose| {
            let [w, x, y, z] = pose.q_wxyz;
            Rigid::new(
                UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
                Vector3::from(pose.center),
            )
        })
    }

    /// Names of images whose pose is known and whose name starts with `prefix`, sorted.
    pub fn names<'t>(&'t self, prefix: &'t str) -> impl Iterator<Item = &'t str> {
        self.images.keys().map(String::as_str).filter(move |name| name.starts_with(prefix))
    }
}
