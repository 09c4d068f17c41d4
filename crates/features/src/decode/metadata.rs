use std::borrow::Cow;
use std::io::Cursor;

use exif::{Exif, In, Tag, Value};
use serde::{Deserialize, Serialize};

use super::jpeg;

/// So many characters of a stated projection are kept.
const LONGEST_PROJECTION: usize = 40;

/// A position on the WGS84 ellipsoid.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GeoPosition {
    /// Latitude in degrees, north positive.
    pub lat_deg: f64,
    /// Longitude in degrees, east positive.
    pub lon_deg: f64,
    /// Altitude in metres, as the camera says (above sea level or the ellipsoid).
    pub alt_m: Option<f64>,
}

/// Google's Photo Sphere metadata (namespace `http://ns.google.com/photos/1.0/panorama/`).
///
/// Lengths are in pixels of the original; the file may have been scaled since.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct GPano {
    /// Width of the full sphere.
    pub full_width: Option<f64>,
    /// Height of the full sphere.
    pub full_height: Option<f64>,
    /// Width of the part that the image shows.
    pub cropped_width: Option<f64>,
    /// Height of the part that the image shows.
    pub cropped_height: Option<f64>,
    /// First column of the full sphere that the image shows.
    pub crop_left: Option<f64>,
    /// First row of the full sphere that the image shows.
    pub crop_top: Option<f64>,
    /// Compass heading of the image centre in degrees, clockwise from north.
    pub heading_deg: Option<f64>,
    /// Pitch in degrees.
    pub pitch_deg: Option<f64>,
    /// Roll in degrees.
    pub roll_deg: Option<f64>,
}

/// What an image file says about how it was taken.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ImageMetadata {
    /// EXIF orientation, 1 (upright) to 8. Decoded images are already turned.
    pub orientation: u8,
    /// Focal length in millimetres as on 35 mm film.
    pub focal_35mm: Option<f64>,
    /// Focal length in millimetres.
    pub focal_mm: Option<f64>,
    /// Pixels per millimetre of the sensor along its width, for the original size.
    pub pixels_per_mm: Option<f64>,
    /// Longer side in pixels of the original, which `pixels_per_mm` refers to.
    pub original_longer: Option<f64>,
    /// Camera maker.
    pub make: Option<String>,
    /// Camera model.
    pub model: Option<String>,
    /// Where the image was taken.
    pub gps: Option<GeoPosition>,
    /// Photo Sphere metadata, if the image says that it is an equirectangular panorama.
    pub gpano: Option<GPano>,
    /// The projection that Photo Sphere metadata state, if it is another than the equirectangular one.
    pub other_projection: Option<String>,
}

impl Default for ImageMetadata {
    fn default() -> Self {
        Self {
            orientation: 1,
            focal_35mm: None,
            focal_mm: None,
            pixels_per_mm: None,
            original_longer: None,
            make: None,
            model: None,
            gps: None,
            gpano: None,
            other_projection: None,
        }
    }
}

impl ImageMetadata {
    /// Reads EXIF and XMP from an image file's bytes without decoding pixels.
    ///
    /// Tolerant: what is missing, damaged or senseless (a focal length of 0, a latitude of 200°) is left out.
    pub fn read(bytes: &[u8]) -> Self {
        let mut metadata = Self::default();
        if let Some(packet) = gpano_packet(bytes) {
            metadata.other_projection = other_projection(&packet);
            metadata.gpano = metadata.other_projection.is_none().then(|| read_gpano(&packet));
        }
        let mut reader = exif::Reader::new();
        reader.continue_on_error(true);
        let exif = reader
            .read_from_container(&mut Cursor::new(bytes))
            .or_else(|error| error.distill_partial_result(|_| {}));
        let Ok(exif) = exif else { return metadata };
        let positive = |tag| number(&exif, tag).filter(|value| *value > 0.0);
        if let Some(orientation) = number(&exif, Tag::Orientation).filter(|value| (1.0..=8.0).contains(value))
        {
            metadata.orientation = orientation as u8;
        }
        metadata.focal_35mm = positive(Tag::FocalLengthIn35mmFilm);
        metadata.focal_mm = positive(Tag::FocalLength);
        // Resolution unit: 2 inch (the default), 3 centimetre, 4 millimetre, 5 micrometre.
        let unit_mm = match number(&exif, Tag::FocalPlaneResolutionUnit).map(|unit| unit as u32) {
            Some(3) => 10.0,
            Some(4) => 1.0,
            Some(5) => 1e-3,
            _ => 25.4,
        };
        metadata.pixels_per_mm = positive(Tag::FocalPlaneXResolution).map(|value| value / unit_mm);
        let sides = [Tag::PixelXDimension, Tag::PixelYDimension].map(positive);
        metadata.original_longer = sides.into_iter().flatten().reduce(f64::max);
        metadata.make = text(&exif, Tag::Make);
        metadata.model = text(&exif, Tag::Model);
        metadata.gps = read_gps(&exif);
        metadata
    }
}

fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) => values.first().map(exif::Rational::to_f64),
        Value::SRational(values) => values.first().map(exif::SRational::to_f64),
        value => value.get_uint(0).map(f64::from),
    }
    .filter(|value| value.is_finite())
}

fn text(exif: &Exif, tag: Tag) -> Option<String> {
    let Value::Ascii(lines) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
    let text = String::from_utf8_lossy(lines.first()?).trim_matches(['\0', ' ']).to_owned();
    (!text.is_empty()).then_some(text)
}

fn read_gps(exif: &Exif) -> Option<GeoPosition> {
    let degrees = |tag, reference, negative: char| {
        let Value::Rational(parts) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
        let part = |index: usize| parts.get(index).map_or(0.0, exif::Rational::to_f64);
        let value = part(0) + part(1) / 60.0 + part(2) / 3600.0;
        let sign =
            if text(exif, reference).is_some_and(|text| text.starts_with(negative)) { -1.0 } else { 1.0 };
        (!parts.is_empty() && value.is_finite()).then_some(sign * value)
    };
    let lat_deg = degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, 'S')?;
    let lon_deg = degrees(Tag::GPSLongitude, Tag::GPSLongitudeRef, 'W')?;
    let below = number(exif, Tag::GPSAltitudeRef) == Some(1.0);
    let alt_m = number(exif, Tag::GPSAltitude).map(|value| if below { -value } else { value });
    // (0, 0) is what receivers without a fix write.
    let plausible = lat_deg.abs() <= 90.0 && lon_deg.abs() <= 180.0 && (lat_deg, lon_deg) != (0.0, 0.0);
    plausible.then_some(GeoPosition { lat_deg, lon_deg, alt_m })
}

/// The XMP packet that has GPano properties.
fn gpano_packet(bytes: &[u8]) -> Option<Cow<'_, str>> {
    let packets: Vec<&[u8]> = if bytes.starts_with(&[0xFF, 0xD8]) {
        jpeg::app1_segments(bytes)
            .into_iter()
            .filter_map(|segment| segment.strip_prefix(b"http://ns.adobe.com/xap/1.0/\0"))
            .collect()
    } else {
        let begin = find(bytes, b"<x:xmpmeta")?;
        let end = find(&bytes[begin..], b"</x:xmpmeta>")?;
        vec![&bytes[begin..begin + end]]
    };
    let packet = packets.into_iter().find(|packet| find(packet, b"GPano:").is_some())?;
    Some(String::from_utf8_lossy(packet))
}

fn other_projection(packet: &str) -> Option<String> {
    let stated = property(packet, "ProjectionType")?;
    // It is shown on a terminal.
    let shown = || stated.chars().filter(|c| !c.is_control()).take(LONGEST_PROJECTION).collect();
    (!stated.eq_ignore_ascii_case("equirectangular")).then(shown)
}

/// Reads GPano properties, written as attributes or as elements.
fn read_gpano(packet: &str) -> GPano {
    let value = |name| property(packet, name)?.parse().ok().filter(|value: &f64| value.is_finite());
    let length = |name| value(name).filter(|value| *value > 0.0);
    GPano {
        full_width: length("FullPanoWidthPixels"),
        full_height: length("FullPanoHeightPixels"),
        cropped_width: length("CroppedAreaImageWidthPixels"),
        cropped_height: length("CroppedAreaImageHeightPixels"),
        crop_left: value("CroppedAreaLeftPixels"),
        crop_top: value("CroppedAreaTopPixels"),
        heading_deg: value("PoseHeadingDegrees"),
        pitch_deg: value("PosePitchDegrees"),
        roll_deg: value("PoseRollDegrees"),
    }
}

/// `GPano:Name="value"`, `GPano:Name='value'` or `<GPano:Name>value</GPano:Name>`.
fn property<'a>(packet: &'a str, name: &str) -> Option<&'a str> {
    let key = format!("GPano:{name}");
    packet.match_indices(&key).find_map(|(at, _)| {
        let rest = packet[at + key.len()..].trim_start();
        let value = if let Some(element) = rest.strip_prefix('>') {
            element.split('<').next()?
        } else {
            let quoted = rest.strip_prefix('=')?.trim_start();
            let quote = quoted.chars().next().filter(|quote| ['"', '\''].contains(quote))?;
            quoted[1..].split(quote).next()?
        };
        Some(value.trim()).filter(|value| !value.is_empty())
    })
}

fn find(bytes: &[u8], pattern: &[u8]) -> Option<usize> {
    bytes.windows(pattern.len()).position(|window| window == pattern)
}
