use anyhow::{Context, Result};
use serde_json::{Value, json};
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use crate::error::Hinted;

/// Camera positions as GeoJSON points, with the heading of the optical axis in degrees from north.
///
/// # Errors
/// When the scene has no WGS84 origin.
pub fn geojson(poses: &[(String, Rigid)], origin: Option<Wgs84>) -> Result<Value> {
    let missing =
        || Hinted::error("the scene has no geographic origin", "build it with --gps geo.csv or --gps exif");
    let origin = origin.ok_or_else(missing).context("cannot write GeoJSON")?;
    let feature = |(name, pose): &(String, Rigid)| {
        let place = Wgs84::from_enu(&pose.translation, origin);
        let forward = pose.rotation * nalgebra::Vector3::z();
        json!({
            "type": "Feature", "geometry": { "type": "Point", "coordinates": [place.lon, place.lat, place.alt] },
            "properties": { "name": name, "heading_deg": forward.x.atan2(forward.y).to_degrees().rem_euclid(360.0) },
        })
    };
    Ok(json!({ "type": "FeatureCollection", "features": poses.iter().map(feature).collect::<Vec<_>>() }))
}
