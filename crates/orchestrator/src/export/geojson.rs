use anyhow::Result;
use serde_json::{Value, json};
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use super::geographic::{Standpoint, standpoints};

/// Camera positions as GeoJSON points, with the heading of the optical axis in degrees from north; without altitudes where none were
/// measured.
///
/// # Errors
/// When the scene has no WGS84 origin.
pub fn geojson(poses: &[(String, Rigid)], origin: Option<Wgs84>) -> Result<Value> {
    let feature = |Standpoint { name, lat, lon, alt, heading_deg }| {
        let coordinates: Vec<f64> = [lon, lat].into_iter().chain(alt).collect();
        json!({
            "type": "Feature", "geometry": { "type": "Point", "coordinates": coordinates },
            "properties": { "name": name, "heading_deg": heading_deg },
        })
    };
    let features: Vec<Value> = standpoints(poses, origin, "GeoJSON")?.into_iter().map(feature).collect();
    Ok(json!({ "type": "FeatureCollection", "features": features }))
}
