use anyhow::Result;
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use super::geographic::{Standpoint, standpoints};
use crate::plot::escape;
use crate::text::add;

/// Camera positions as KML placemarks, with the heading of the optical axis in degrees from north.
///
/// KML counts altitudes from the sea's level, a scene from the ellipsoid, tens of metres off. So placemarks are clamped to
/// the ground, and the altitude is told as data where it was measured.
///
/// # Errors
/// When the scene has no WGS84 origin.
pub fn kml(poses: &[(String, Rigid)], origin: Option<Wgs84>) -> Result<String> {
    let mut text = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\">\n<Document>\n",
    );
    for Standpoint { name, lat, lon, alt, heading_deg } in standpoints(poses, origin, "KML")? {
        add(&mut text, format_args!("<Placemark>\n<name>{}</name>\n<ExtendedData>\n", escape(name)));
        for (key, value) in [("heading_deg", Some(heading_deg)), ("ellipsoidal_height_m", alt)] {
            let Some(value) = value else { continue };
            add(&mut text, format_args!("<Data name=\"{key}\"><value>{value}</value></Data>\n"));
        }
        let point = "<altitudeMode>clampToGround</altitudeMode>";
        add(&mut text, format_args!("</ExtendedData>\n<Point>{point}<coordinates>{lon},{lat}</coordinates>"));
        text += "</Point>\n</Placemark>\n";
    }
    Ok(text + "</Document>\n</kml>\n")
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn cameras_are_placemarks_with_their_names() {
        // East-north-up axes; the camera looks east.
        let looks_east = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::FRAC_PI_2);
        let poses = [("a & b/0.jpg".to_owned(), Rigid::new(looks_east, Vector3::new(0.0, 111.0, 5.0)))];
        let origin = Wgs84 { lat: 47.0, lon: 8.0, alt: 400.0 };
        let text = kml(&poses, Some(origin)).unwrap();
        assert!(text.contains("<name>a &amp; b/0.jpg</name>"), "{text}");
        let value = |from: &str, to: &str| text.split(from).nth(1).unwrap().split(to).next().unwrap();
        let heading: f64 = value("\"heading_deg\"><value>", "<").parse().unwrap();
        assert!((heading - 90.0).abs() < 1e-9, "{heading}");
        let (lon, lat) = value("<coordinates>", "<").split_once(',').unwrap();
        let (lon, lat): (f64, f64) = (lon.parse().unwrap(), lat.parse().unwrap());
        assert!((lon - 8.0).abs() < 1e-9 && (lat - 47.000_998).abs() < 1e-5, "{lon} {lat}");
        assert!(text.contains("ellipsoidal_height_m"), "{text}");
        let relative = Wgs84 { alt: crate::scene::NO_ALTITUDE, ..origin };
        assert!(!kml(&poses, Some(relative)).unwrap().contains("ellipsoidal_height_m"));
        let error = format!("{:#}", kml(&poses, None).unwrap_err());
        assert_eq!(error, "cannot write KML: the scene has no geographic origin");
    }
}
