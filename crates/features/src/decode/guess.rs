use serde::{Deserialize, Serialize};

use super::{GPano, ImageInfo};
use crate::{Camera, CameraModel};

/// Diagonal of a 35 mm film frame (36 × 24) in millimetres, to which EXIF's 35 mm focal length refers.
const FILM_DIAGONAL_MM: f64 = 43.266_615_305_567_87;
/// Width of a sensor in millimetres above which `pixels_per_mm` is a typing error.
const MAX_SENSOR_MM: f64 = 100.0;
/// Relative deviation from 2:1 that still counts as a panorama.
const ASPECT_TOLERANCE: f64 = 0.005;
/// 2:1 images with a longer 35 mm focal length are photos of a phone in 18:9, not panoramas.
const MAX_PANORAMA_FOCAL_35MM: f64 = 15.0;
/// Focal length in units of the longer side where nothing is known: a field of view of 45°, between phone and tele.
const FALLBACK_FOCAL: f64 = 1.2;
/// Focal lengths outside this range of the longer side are wrong entries.
const PLAUSIBLE_FOCAL: std::ops::RangeInclusive<f64> = 0.1..=30.0;

/// Where a camera's model and focal length come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum CameraSource {
    /// The file says that it is a panorama (GPano XMP).
    GPano,
    /// The image is twice as wide as high, so it is taken for a full panorama.
    AspectRatio,
    /// EXIF focal length as on 35 mm film.
    ExifFocal35mm,
    /// EXIF focal length and sensor resolution.
    ExifFocalPlane,
    /// Nothing is known: 1.2 times the longer side.
    Fallback,
}

impl std::fmt::Display for CameraSource {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Self::GPano => "panorama by GPano metadata",
            Self::AspectRatio => "panorama by its 2:1 aspect ratio",
            Self::ExifFocal35mm => "focal length by EXIF (35 mm equivalent)",
            Self::ExifFocalPlane => "focal length by EXIF (sensor resolution)",
            Self::Fallback => "focal length unknown, 1.2 times the longer side assumed",
        })
    }
}

/// The most likely camera of an image that nobody described, and why.
///
/// In this order: GPano metadata or a 2:1 image without a photo's focal length, of which GPano states no other projection,
/// give `EQUIRECTANGULAR`; EXIF's 35 mm focal length, then focal length and sensor resolution, then 1.2 times the longer side give `RADIAL`.
/// Senseless entries are passed over, so there is always an answer.
pub fn guess_camera(info: &ImageInfo) -> (Camera, CameraSource) {
    let (width, height) = (f64::from(info.width), f64::from(info.height));
    let metadata = &info.metadata;
    if let Some(gpano) = &metadata.gpano {
        return (panorama(info, gpano), CameraSource::GPano);
    }
    let has_photo_focal = metadata.focal_35mm.is_some_and(|focal| focal > MAX_PANORAMA_FOCAL_35MM);
    let is_other = has_photo_focal || metadata.other_projection.is_some();
    if is_two_to_one(width, height) && !is_other {
        return (Camera::equirectangular(info.width, info.height), CameraSource::AspectRatio);
    }
    let longer = width.max(height);
    let photo = |focal| Camera::from_focal_guess(info.width, info.height, focal);
    let plausible = |focal: &f64| PLAUSIBLE_FOCAL.contains(&(focal / longer));
    let by_film = metadata.focal_35mm.map(|focal| focal / FILM_DIAGONAL_MM * width.hypot(height));
    if let Some(focal) = by_film.filter(plausible) {
        return (photo(focal), CameraSource::ExifFocal35mm);
    }
    let by_sensor = metadata.focal_mm.zip(metadata.pixels_per_mm).and_then(|(focal, density)| {
        let original = metadata.original_longer.unwrap_or(longer);
        (original / density < MAX_SENSOR_MM).then(|| focal * density * longer / original)
    });
    if let Some(focal) = by_sensor.filter(plausible) {
        return (photo(focal), CameraSource::ExifFocalPlane);
    }
    (fallback_camera(info.width, info.height), CameraSource::Fallback)
}

/// The camera of a photo of which nothing is known: `RADIAL` with 1.2 times the longer side.
pub fn fallback_camera(width: u32, height: u32) -> Camera {
    Camera::from_focal_guess(width, height, FALLBACK_FOCAL * f64::from(width.max(height)))
}

fn is_two_to_one(width: f64, height: f64) -> bool {
    (width / (2.0 * height) - 1.0).abs() <= ASPECT_TOLERANCE
}

fn panorama(info: &ImageInfo, gpano: &GPano) -> Camera {
    let (width, height) = (f64::from(info.width), f64::from(info.height));
    let full = Camera::equirectangular(info.width, info.height);
    let crop = |params: [f64; 4]| {
        // Sizes that were scaled do not come back to the last bit.
        let is_full = params.iter().zip([width, height, 0.0, 0.0]).all(|(a, b)| (a - b).abs() < 0.5);
        if is_full {
            return full.clone();
        }
        Camera { model: CameraModel::Equirectangular, params: params.to_vec(), ..full.clone() }
    };
    match (gpano.full_width, gpano.full_height) {
        (Some(full_width), Some(full_height)) => {
            // The file may have been scaled after the metadata were written.
            let scale_x = width / gpano.cropped_width.unwrap_or(full_width);
            let scale_y = height / gpano.cropped_height.unwrap_or(full_height);
            let (left, top) = (gpano.crop_left.unwrap_or(0.0), gpano.crop_top.unwrap_or(0.0));
            crop([full_width * scale_x, full_height * scale_y, left * scale_x, top * scale_y])
        }
        // Without sizes: all round, and as much above as below the horizon, with square pixels.
        _ if height <= width / 2.0 && !is_two_to_one(width, height) => {
            crop([width, width / 2.0, 0.0, (width / 2.0 - height) / 2.0])
        }
        _ => full,
    }
}
