use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use setloc_features::{Camera, ImageFeatures};

use crate::{CameraId, PairGeometry, Reconstruction};

/// How to build a model.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapperParams {}

/// One image to map.
#[derive(Debug, Clone, Copy)]
pub struct InputImage<'a> {
    /// Name as the user knows it.
    pub name: &'a str,
    /// Index into [`MapperInput::cameras`].
    pub camera: CameraId,
    /// Its features.
    pub features: &'a ImageFeatures,
    /// Measured centre in local east-north-up metres, when GPS is given.
    pub position_prior: Option<Vector3<f64>>,
}

/// What the mapper works on.
#[derive(Debug, Clone)]
pub struct MapperInput<'a> {
    /// Cameras, shared by images.
    pub cameras: Vec<Camera>,
    /// Whether the intrinsics of each camera are known and stay fixed.
    pub camera_fixed: Vec<bool>,
    /// All images; ids are indices.
    pub images: Vec<InputImage<'a>>,
    /// Verified pairs.
    pub pairs: &'a [PairGeometry],
}

/// What happened, for people.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapperReport {
    /// Things that disagree, in words.
    pub warnings: Vec<String>,
}

/// Components, largest first, and the report.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapperOutput {
    /// Connected components, largest first.
    pub components: Vec<Reconstruction>,
    /// What happened.
    pub report: MapperReport,
}

/// Builds all components from verified pairs.
pub fn reconstruct(_params: &MapperParams, _input: &MapperInput<'_>, _seed: u64) -> MapperOutput {
    MapperOutput::default()
}
