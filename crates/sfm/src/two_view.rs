use serde::{Deserialize, Serialize};
use setloc_features::{Match, Rays};

use crate::{ImageId, Rigid};

/// How to verify a pair.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TwoViewParams {
    /// Fewest inliers of a verified pair.
    pub min_inliers: usize,
}

impl Default for TwoViewParams {
    fn default() -> Self {
        Self { min_inliers: 20 }
    }
}

/// What relates the two views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TwoViewKind {
    /// An essential matrix with parallax.
    General,
    /// A rotation explains the matches: no parallax, not for initialization.
    PureRotation,
    /// A plane explains nearly all matches: the pose is right but weaker.
    Planar,
}

/// The verified geometry of two images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TwoView {
    /// Kind of geometry.
    pub kind: TwoViewKind,
    /// Pose of the first camera in the second's frame, translation of unit length (zero for pure rotation).
    pub second_from_first: Rigid,
    /// The matches that agree, sorted by `first`.
    pub inliers: Vec<Match>,
    /// Median parallax angle of the inliers in radians.
    pub median_parallax_rad: f64,
}

/// A verified pair of images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairGeometry {
    /// First image.
    pub first: ImageId,
    /// Second image, `first < second`.
    pub second: ImageId,
    /// Its geometry.
    pub two_view: TwoView,
}

/// Verifies putative matches on the sphere; `None` when no geometry is supported.
pub fn verify_pair(_params: &TwoViewParams, _first: &Rays, _second: &Rays, _matches: &[Match], _seed: u64) -> Option<TwoView> {
    None
}
