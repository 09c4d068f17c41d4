use anyhow::Result;
use serde_json::{Value, json};
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use super::geographic::{Standpoint, standpoints};

/// Camera positions as GeoJSON points, with the heading of the optical axis in degrees from north.
///
/// # Errors
/// When the scene has no WGS84 origin.
pub fn geojson(poses: &[(String, Rigid)], origin: Option<Wgs84>) -> Result<Value> {
    let feature = |Standpoint { name, place, heading_deg }| {
        json!({
            "type": "Feature", "geometry": { "type": "Point", "coordinates": [place.lon, place.lat, place.alt] },
            "properties": { "name": name, "heading_deg": heading_deg },
        })
    };
    let features: Vec<Value> = standpoints(poses, origin, "GeoJSON")?.into_iter().map(feature).collect();
    Ok(json!({ "type": "FeatureCollection", "features": features }))
}
