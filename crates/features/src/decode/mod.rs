mod guess;
mod jpeg;
mod metadata;
mod orientation;
#[cfg(test)]
mod tests;

use std::io::Cursor;

use image::{ImageDecoder, ImageFormat, ImageReader, Limits};
use serde::{Deserialize, Serialize};

use crate::{FeatureError, GreyImage};
pub use guess::{CameraSource, fallback_camera, guess_camera};
pub use metadata::{GPano, GeoPosition, ImageMetadata};
pub use orientation::upright_camera;

/// Limits on images, checked on the header before any pixel is allocated.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DecodeLimits {
    /// Most pixels a side.
    pub max_side: u32,
    /// Most pixels in all.
    pub max_pixels: u64,
}

impl Default for DecodeLimits {
    /// 32,768 a side, 2²⁸ in all: a 23k × 11.5k panorama, 768 MiB of RGB.
    fn default() -> Self {
        Self { max_side: 32_768, max_pixels: 1 << 28 }
    }
}

impl DecodeLimits {
    fn check(&self, width: u64, height: u64) -> Result<(), FeatureError> {
        if width == 0 || height == 0 {
            return Err(FeatureError::NoPixels { width, height });
        }
        let max_side = u64::from(self.max_side);
        if width > max_side || height > max_side || width * height > self.max_pixels {
            let (max_side, max_pixels) = (self.max_side, self.max_pixels);
            return Err(FeatureError::TooLarge { width, height, max_side, max_pixels });
        }
        Ok(())
    }
}

/// An upright image with what its file says about it.
#[derive(Debug, Clone, PartialEq)]
pub struct DecodedImage {
    /// Width in pixels, after EXIF orientation.
    pub width: u32,
    /// Height in pixels, after EXIF orientation.
    pub height: u32,
    /// Row-major sRGB, 3 bytes a pixel.
    pub rgb: Vec<u8>,
    /// What the file says.
    pub metadata: ImageMetadata,
}

impl DecodedImage {
    /// An image from pixels that come from elsewhere, a renderer for instance.
    ///
    /// # Errors
    /// [`FeatureError::NoPixels`] for an empty image and [`FeatureError::SizeMismatch`] if `rgb` is not
    /// `width × height × 3` bytes.
    pub fn from_rgb(width: u32, height: u32, rgb: Vec<u8>) -> Result<Self, FeatureError> {
        check_buffer(width, height, rgb.len(), 3)?;
        Ok(Self { width, height, rgb, metadata: ImageMetadata::default() })
    }
}

/// Checks that there are so many bytes a pixel.
pub(crate) fn check_buffer(
    width: u32,
    height: u32,
    bytes: usize,
    per_pixel: u64,
) -> Result<(), FeatureError> {
    if width == 0 || height == 0 {
        return Err(FeatureError::NoPixels { width: width.into(), height: height.into() });
    }
    let row = u64::from(width) * per_pixel;
    if bytes as u64 != row * u64::from(height) {
        return Err(FeatureError::SizeMismatch {
            what: "pixel buffer",
            expected_width: width,
            expected_height: height,
            width,
            height: u32::try_from(bytes as u64 / row).unwrap_or(u32::MAX),
        });
    }
    Ok(())
}

/// Size and metadata of an image, from its header alone.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageInfo {
    /// Width in pixels, after EXIF orientation.
    pub width: u32,
    /// Height in pixels, after EXIF orientation.
    pub height: u32,
    /// What the file says.
    pub metadata: ImageMetadata,
}

/// Decodes a JPEG, PNG, TIFF, WebP or BMP and turns it upright.
///
/// # Errors
/// [`FeatureError::EmptyFile`], [`FeatureError::UnknownFormat`], [`FeatureError::NoPixels`],
/// [`FeatureError::TooLarge`] (before pixels are allocated), [`FeatureError::Truncated`] and
/// [`FeatureError::Damaged`]: a broken image is never filled with grey.
pub fn decode(bytes: &[u8], limits: &DecodeLimits) -> Result<DecodedImage, FeatureError> {
    let format = format_of(bytes)?;
    let (width, height, rgb) = if format == ImageFormat::Jpeg {
        jpeg::decode(bytes, limits)?
    } else {
        decode_other(bytes, format, limits)?
    };
    let metadata = ImageMetadata::read(bytes);
    let (width, height, rgb) = orientation::upright(metadata.orientation, (width, height), rgb, 3);
    Ok(DecodedImage { width, height, rgb, metadata })
}

/// The same without its colours: of a JPEG only the luma is decoded, where it is stored apart.
///
/// # Errors
/// As [`decode`].
pub fn decode_grey(bytes: &[u8], limits: &DecodeLimits) -> Result<GreyImage, FeatureError> {
    if format_of(bytes)? == ImageFormat::Jpeg
        && let Some((width, height, values)) = jpeg::decode_luma(bytes, limits)?
    {
        let orientation = ImageMetadata::read(bytes).orientation;
        let (width, height, values) = orientation::upright(orientation, (width, height), values, 1);
        return GreyImage::from_values(width, height, values);
    }
    Ok(GreyImage::from(&decode(bytes, limits)?))
}

/// Reads the upright size and the metadata without decoding pixels.
///
/// # Errors
/// As [`decode`], as far as the header shows it; a truncated body goes unnoticed.
pub fn probe(bytes: &[u8], limits: &DecodeLimits) -> Result<ImageInfo, FeatureError> {
    let format = format_of(bytes)?;
    let (width, height) = if format == ImageFormat::Jpeg {
        jpeg::size(bytes)?
    } else {
        let decoder = reader(bytes, format, limits).into_decoder().map_err(|error| damage(format, &error))?;
        decoder.dimensions()
    };
    limits.check(width.into(), height.into())?;
    let metadata = ImageMetadata::read(bytes);
    let (width, height) =
        if orientation::swaps_sides(metadata.orientation) { (height, width) } else { (width, height) };
    Ok(ImageInfo { width, height, metadata })
}

fn format_of(bytes: &[u8]) -> Result<ImageFormat, FeatureError> {
    if bytes.is_empty() {
        return Err(FeatureError::EmptyFile);
    }
    let format = image::guess_format(bytes).map_err(|_| FeatureError::UnknownFormat)?;
    let supported =
        [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP, ImageFormat::Bmp];
    if supported.contains(&format) { Ok(format) } else { Err(FeatureError::UnknownFormat) }
}

/// Bytes a pixel, at most, of what decoders hold beside each other.
const MOST_BYTES_A_PIXEL: u64 = 16;
/// Most bytes of what a PNG has beside its pixels, as a colour profile, which is deflated: a megabyte of it may be a gigabyte.
const MOST_BYTES_BESIDE: u64 = 64 << 20;

fn reader<'b>(bytes: &'b [u8], format: ImageFormat, limits: &DecodeLimits) -> ImageReader<Cursor<&'b [u8]>> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    // Our own limits are checked on the decoder's size before it decodes.
    let mut of_decoder = Limits::no_limits();
    of_decoder.max_alloc = Some(match format {
        // Pixels are decoded into a buffer of our own, a row at a time.
        ImageFormat::Png => MOST_BYTES_BESIDE,
        _ => MOST_BYTES_A_PIXEL.saturating_mul(limits.max_pixels),
    });
    reader.limits(of_decoder);
    reader
}

fn decode_other(
    bytes: &[u8],
    format: ImageFormat,
    limits: &DecodeLimits,
) -> Result<(u32, u32, Vec<u8>), FeatureError> {
    let decoder = reader(bytes, format, limits).into_decoder().map_err(|error| damage(format, &error))?;
    let (width, height) = decoder.dimensions();
    limits.check(width.into(), height.into())?;
    let image = image::DynamicImage::from_decoder(decoder).map_err(|error| damage(format, &error))?;
    Ok((width, height, image.into_rgb8().into_raw()))
}

fn damage(format: ImageFormat, error: &image::ImageError) -> FeatureError {
    let format = format_name(format);
    match error {
        image::ImageError::IoError(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
            FeatureError::Truncated { format }
        }
        _ => FeatureError::Damaged { format, reason: error.to_string() },
    }
}

fn format_name(format: ImageFormat) -> &'static str {
    match format {
        ImageFormat::Jpeg => "JPEG",
        ImageFormat::Png => "PNG",
        ImageFormat::Tiff => "TIFF",
        ImageFormat::WebP => "WebP",
        _ => "BMP",
    }
}
