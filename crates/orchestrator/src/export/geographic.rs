use anyhow::{Context, Result};
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use crate::error::Hinted;

/// A camera on the map.
pub struct Standpoint<'p> {
    /// The image's name.
    pub name: &'p str,
    /// Where it was taken.
    pub place: Wgs84,
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
        let forward = pose.rotation * nalgebra::Vector3::z();
        let heading_deg = forward.x.atan2(forward.y).to_degrees().rem_euclid(360.0);
        Standpoint { name, place: Wgs84::from_enu(&pose.translation, origin), heading_deg }
    };
    Ok(poses.iter().map(standpoint).collect())
}
