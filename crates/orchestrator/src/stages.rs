//! The features stage as the jobs call it: one place that knows how the crate's functions are named.

use setloc_features::{Camera, CameraModel, ImageFeatures, Match};

/// Version of decoding and extraction; part of the fingerprint of `features` jobs.
pub const FEATURES_VERSION: u32 = 1;
/// Version of matching.
pub const MATCHING_VERSION: u32 = 1;
/// Version of two-view verification.
pub const VERIFY_VERSION: u32 = 1;
/// Version of mapping.
pub const MAPPER_VERSION: u32 = 1;
/// Version of indexing.
pub const INDEX_VERSION: u32 = 1;
/// Version of single-photo localization.
pub const SINGLE_VERSION: u32 = 1;
/// Version of set localization.
pub const CAMSET_VERSION: u32 = 1;

pub use shim::*;

mod shim {
    use super::{Camera, CameraModel, ImageFeatures, Match};
    use serde::{Deserialize, Serialize};

    /// How to extract features.
    #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct FeatureParams {}

    /// How to match.
    #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct MatchParams {}

    /// Largest image that is read.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub struct DecodeLimits {}

    /// Measured place.
    #[derive(Debug, Clone, Copy, PartialEq)]
    pub struct GpsPosition {
        /// Degrees.
        pub lat_deg: f64,
        /// Degrees.
        pub lon_deg: f64,
        /// Metres.
        pub alt_m: Option<f64>,
    }

    /// What the file says besides pixels.
    #[derive(Debug, Clone, Default, PartialEq)]
    pub struct Metadata {
        /// Place.
        pub gps: Option<GpsPosition>,
    }

    /// Size and metadata.
    #[derive(Debug, Clone, Default, PartialEq)]
    pub struct ImageInfo {
        /// Pixels.
        pub width: u32,
        /// Pixels.
        pub height: u32,
        /// The rest.
        pub metadata: Metadata,
    }

    /// Pixels.
    pub struct DecodedImage {
        /// Pixels.
        pub width: u32,
        /// Pixels.
        pub height: u32,
        /// Row-major sRGB.
        pub rgb: Vec<u8>,
    }

    /// Where a camera comes from.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum CameraSource {
        /// Nothing was known.
        Guess,
    }

    /// Image mask.
    pub struct Mask;

    /// Reads a mask image.
    ///
    /// # Errors
    /// When the bytes are no image.
    pub fn read_mask(bytes: &[u8]) -> Result<Mask, image::ImageError> {
        image::load_from_memory(bytes).map(|_| Mask)
    }

    /// Decodes an image.
    ///
    /// # Errors
    /// When the bytes are no image.
    pub fn decode(bytes: &[u8], _limits: &DecodeLimits) -> Result<DecodedImage, image::ImageError> {
        let image = image::load_from_memory(bytes)?.to_rgb8();
        Ok(DecodedImage { width: image.width(), height: image.height(), rgb: image.into_raw() })
    }

    /// Reads size and metadata.
    ///
    /// # Errors
    /// When the bytes are no image.
    pub fn probe(bytes: &[u8]) -> Result<ImageInfo, image::ImageError> {
        let reader = image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format()?;
        let (width, height) = reader.into_dimensions()?;
        Ok(ImageInfo { width, height, metadata: Metadata::default() })
    }

    /// A camera from what the file says.
    pub fn guess_camera(info: &ImageInfo) -> (Camera, CameraSource) {
        if info.width == 2 * info.height {
            return (Camera::equirectangular(info.width, info.height), CameraSource::Guess);
        }
        let (w, h) = (f64::from(info.width), f64::from(info.height));
        let params = vec![1.2 * w.max(h), w / 2.0, h / 2.0, 0.0];
        (
            Camera { model: CameraModel::SimpleRadial, width: info.width, height: info.height, params },
            CameraSource::Guess,
        )
    }

    /// Detects and describes.
    ///
    /// # Errors
    /// Never here.
    pub fn extract(
        _params: &FeatureParams,
        image: &DecodedImage,
        _camera: &Camera,
        _mask: Option<&Mask>,
    ) -> Result<ImageFeatures, setloc_features::FeatureError> {
        Ok(ImageFeatures { width: image.width, height: image.height, ..ImageFeatures::default() })
    }

    /// Renders the sample town as a data set.
    ///
    /// # Errors
    /// Always, until the town is there.
    pub fn write_sample(_folder: &std::path::Path) -> anyhow::Result<()> {
        anyhow::bail!("the sample town is not part of this build")
    }

    /// Matches two images.
    pub fn match_features(
        _params: &MatchParams,
        _first: &ImageFeatures,
        _second: &ImageFeatures,
    ) -> Vec<Match> {
        Vec::new()
    }
}
