use serde::{Deserialize, Serialize};

/// A putative or verified match: keypoint `first` of one image shows what keypoint `second` of another shows.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    bytemuck::Pod,
    bytemuck::Zeroable,
)]
#[repr(C)]
pub struct Match {
    /// Keypoint index in the first image.
    pub first: u32,
    /// Keypoint index in the second image.
    pub second: u32,
}
