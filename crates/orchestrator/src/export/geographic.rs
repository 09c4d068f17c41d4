use anyhow::{Context, Result};
use nalgebra::Vector3;
use serde_json::{Value, json};
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use crate::error::Hinted;
use crate::scene::has_altitude;

/// A place of a scene with this origin as JSON; without an altitude where none was measured.
pub fn place_json(place: Wgs84, origin: Wgs84) -> Value {
    if has_altitude(origin) { json!(place) } else { json!({ "lat": place.lat, "lon": place.lon }) }
}

/// A camera on the map.
pub struct Standpoint<'p> {
    /// The image's name.
    pub name: &'p str,
    /// Latitude in degrees.
    pub lat: f64,
    /// Longitude in degrees.
    pub lon: f64,
    /// Metres above the ellipsoid, where altitudes were measured.
    pub alt: Option<f64>,
    /// Heading of the optical axis in degrees from north, clockwise.
    pub heading_deg: f64,
}

/// Where cameras of a scene stand on the map; `format` is what cannot be written without a WGS84 origin.
pub fn standpoints<'p>(
    poses: &'p [(String, Rigid)],
    origin: Option<Wgs84>,
    format: &str,
) -> Result<Vec<Standpoint<'p>>> {
    let missing =
        || Hinted::error("the scene has no geographic origin", "build it with --gps geo.csv or --gps exif");
    let origin = origin.ok_or_else(missing).with_context(|| format!("cannot write {format}"))?;
    let standpoint = |(name, pose): &'p (String, Rigid)| {
        let forward = pose.rotation * Vector3::z();
        let heading_deg = forward.x.atan2(forward.y).to_degrees().rem_euclid(360.0);
        let Wgs84 { lat, lon, alt } = Wgs84::from_enu(&pose.translation, origin);
        Standpoint { name, lat, lon, alt: Some(alt).filter(|_| has_altitude(origin)), heading_deg }
    };
    Ok(poses.iter().map(standpoint).collect())
}
