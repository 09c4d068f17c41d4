use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use super::DecodeLimits;
use crate::FeatureError;

/// The largest side a JPEG header can state.
const FORMAT_MAX_SIDE: usize = 65_535;

/// Width, height and RGB of a complete JPEG.
pub(super) fn decode(bytes: &[u8], limits: &DecodeLimits) -> Result<(u32, u32, Vec<u8>), FeatureError> {
    decode_as(ColorSpace::RGB, checked_size(bytes, limits)?, bytes)
}

/// Width, height and luma of a complete JPEG; `None` where the luma is not stored apart.
pub(super) fn decode_luma(
    bytes: &[u8],
    limits: &DecodeLimits,
) -> Result<Option<(u32, u32, Vec<u8>)>, FeatureError> {
    let size = checked_size(bytes, limits)?;
    let mut headers = decoder(bytes, ColorSpace::Luma);
    headers.decode_headers().map_err(|error| damaged(&format!("{error:?}")))?;
    let is_apart = matches!(headers.input_colorspace(), Some(ColorSpace::YCbCr | ColorSpace::Luma));
    is_apart.then(|| decode_as(ColorSpace::Luma, size, bytes)).transpose()
}

/// Width and height of a JPEG that is complete and within the limits.
fn checked_size(bytes: &[u8], limits: &DecodeLimits) -> Result<(u32, u32), FeatureError> {
    let (width, height) = size(bytes)?;
    limits.check(width.into(), height.into())?;
    // A lenient decoder fills what is missing with grey, so the end marker is looked for first.
    if !is_complete(bytes) {
        return Err(FeatureError::Truncated { format: "JPEG" });
    }
    Ok((width, height))
}

fn decode_as(
    colors: ColorSpace,
    (width, height): (u32, u32),
    bytes: &[u8],
) -> Result<(u32, u32, Vec<u8>), FeatureError> {
    let values = decoder(bytes, colors).decode().map_err(|error| damaged(&format!("{error:?}")))?;
    if values.len() != width as usize * height as usize * colors.num_components() {
        return Err(damaged("unexpected number of colour channels"));
    }
    Ok((width, height, values))
}

/// Width and height as the frame header says.
pub(super) fn size(bytes: &[u8]) -> Result<(u32, u32), FeatureError> {
    match scan(bytes) {
        Scan { size: Some(size), .. } => Ok(size),
        Scan { ended: true, .. } => Err(FeatureError::Truncated { format: "JPEG" }),
        Scan { .. } => Err(damaged("no frame header")),
    }
}

/// The payloads of all APP1 segments (EXIF and XMP).
pub(super) fn app1_segments(bytes: &[u8]) -> Vec<&[u8]> {
    scan(bytes).app1
}

fn decoder(bytes: &[u8], colors: ColorSpace) -> JpegDecoder<ZCursor<&[u8]>> {
    let options = DecoderOptions::default()
        .jpeg_set_out_colorspace(colors)
        .set_max_width(FORMAT_MAX_SIDE)
        .set_max_height(FORMAT_MAX_SIDE)
        .set_strict_mode(true);
    JpegDecoder::new_with_options(ZCursor::new(bytes), options)
}

fn damaged(reason: &str) -> FeatureError {
    FeatureError::Damaged { format: "JPEG", reason: reason.to_owned() }
}

struct Scan<'a> {
    size: Option<(u32, u32)>,
    app1: Vec<&'a [u8]>,
    /// Where the first scan's entropy-coded data begin.
    data: Option<usize>,
    /// Whether the bytes ended before the first scan.
    ended: bool,
}

/// Walks the marker segments up to the first scan (ITU T.81, annex B).
fn scan(bytes: &[u8]) -> Scan<'_> {
    let mut found = Scan { size: None, app1: Vec::new(), data: None, ended: false };
    let mut at = 2;
    while let Some((marker, payload)) = next_marker(bytes, at) {
        // Markers without a segment.
        if matches!(marker, 0x01 | 0xD0..=0xD8) {
            at = payload;
            continue;
        }
        if marker == 0xD9 {
            return found;
        }
        let Some(segment) = segment(bytes, payload) else { break };
        match marker {
            0xC0..=0xCF if !matches!(marker, 0xC4 | 0xC8 | 0xCC) && segment.len() >= 5 => {
                let side = |at: usize| u32::from(u16::from_be_bytes([segment[at], segment[at + 1]]));
                found.size = Some((side(3), side(1)));
            }
            0xE1 => found.app1.push(segment),
            0xDA => {
                found.data = Some(payload + 2 + segment.len());
                return found;
            }
            _ => {}
        }
        at = payload + 2 + segment.len();
    }
    found.ended = true;
    found
}

/// The next marker at or after `at` and the position behind it.
fn next_marker(bytes: &[u8], at: usize) -> Option<(u8, usize)> {
    let mut at = at + bytes.get(at..)?.iter().position(|&byte| byte == 0xFF)?;
    while *bytes.get(at)? == 0xFF {
        at += 1;
    }
    Some((bytes[at], at + 1))
}

fn segment(bytes: &[u8], at: usize) -> Option<&[u8]> {
    let length = usize::from(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]));
    bytes.get(at + 2..at + length.max(2))
}

/// Whether the end-of-image marker follows the scans.
fn is_complete(bytes: &[u8]) -> bool {
    let Some(mut at) = scan(bytes).data else { return false };
    while let Some((marker, payload)) = next_marker(bytes, at) {
        match marker {
            0xD9 => return true,
            // A stuffed byte or a restart inside the data.
            0x00 | 0x01 | 0xD0..=0xD7 => at = payload,
            _ => match segment(bytes, payload) {
                Some(segment) => at = payload + 2 + segment.len(),
                None => return false,
            },
        }
    }
    false
}
