/// What can go wrong between image bytes and features.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FeatureError {
    /// The camera description is not usable.
    #[error("camera {model}: {reason}")]
    InvalidCamera {
        /// COLMAP's name of the model.
        model: &'static str,
        /// What is wrong, with the value.
        reason: String,
    },
    /// A parameter is out of range.
    #[error("{name} is {value}, expected {expected}")]
    InvalidParameter {
        /// Name of the parameter.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The range it must be in.
        expected: &'static str,
    },
    /// The file has no bytes.
    #[error("the file is empty")]
    EmptyFile,
    /// The bytes are no image of a supported format.
    #[error("not an image of a supported format (JPEG, PNG, TIFF, WebP, BMP)")]
    UnknownFormat,
    /// The image ends before its last pixel.
    #[error("the {format} image is truncated")]
    Truncated {
        /// Name of the file format.
        format: &'static str,
    },
    /// The image cannot be decoded.
    #[error("the {format} image is damaged: {reason}")]
    Damaged {
        /// Name of the file format.
        format: &'static str,
        /// The decoder's words.
        reason: String,
    },
    /// The image has no pixels.
    #[error("the image has no pixels ({width} × {height})")]
    NoPixels {
        /// Width in pixels as the header says.
        width: u64,
        /// Height in pixels as the header says.
        height: u64,
    },
    /// The image is larger than allowed.
    #[error("the image has {width} × {height} pixels, allowed are {max_side} a side and {max_pixels} in all")]
    TooLarge {
        /// Width in pixels as the header says.
        width: u64,
        /// Height in pixels as the header says.
        height: u64,
        /// Most pixels a side.
        max_side: u32,
        /// Most pixels in all.
        max_pixels: u64,
    },
    /// Image and camera, or image and pixel buffer, have different sizes.
    #[error("{what}: expected {expected_width} × {expected_height}, got {width} × {height}")]
    SizeMismatch {
        /// What has the wrong size.
        what: &'static str,
        /// Expected width in pixels.
        expected_width: u32,
        /// Expected height in pixels.
        expected_height: u32,
        /// Width in pixels found.
        width: u32,
        /// Height in pixels found.
        height: u32,
    },
    /// The detector failed.
    #[error("feature detection: {reason}")]
    Detector {
        /// OpenCV's words.
        reason: String,
    },
}

/// Names a parameter that is out of range.
pub(crate) fn check(
    name: &'static str,
    value: f64,
    expected: &'static str,
    in_range: bool,
) -> Result<(), FeatureError> {
    if in_range { Ok(()) } else { Err(FeatureError::InvalidParameter { name, value, expected }) }
}
