use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::GeoPosition;

/// Semi-major axis of WGS84 in metres.
const A: f64 = 6_378_137.0;
/// First eccentricity squared of WGS84.
const E2: f64 = 6.694_379_990_141_316_5e-3;

/// A place on the WGS84 ellipsoid, to local east-north-up metres and back.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wgs84 {
    /// Latitude in degrees, north positive.
    pub lat: f64,
    /// Longitude in degrees, east positive.
    pub lon: f64,
    /// Metres above the ellipsoid.
    pub alt: f64,
}

impl Wgs84 {
    /// Earth-centred coordinates in metres.
    fn to_ecef(self) -> Vector3<f64> {
        let (lat, lon) = (self.lat.to_radians(), self.lon.to_radians());
        let n = A / (1.0 - E2 * lat.sin().powi(2)).sqrt();
        let r = (n + self.alt) * lat.cos();
        Vector3::new(r * lon.cos(), r * lon.sin(), (n * (1.0 - E2) + self.alt) * lat.sin())
    }

    /// Rows east, north, up in earth-centred axes.
    fn enu_from_ecef(self) -> Matrix3<f64> {
        let ((s, c), (sl, cl)) = (self.lat.to_radians().sin_cos(), self.lon.to_radians().sin_cos());
        Matrix3::new(-sl, cl, 0.0, -s * cl, -s * sl, c, c * cl, c * sl, s)
    }

    /// East, north, up in metres about `origin`.
    pub fn to_enu(self, origin: Self) -> Vector3<f64> {
        origin.enu_from_ecef() * (self.to_ecef() - origin.to_ecef())
    }

    /// Rotation and translation that bring east, north, up about another place to those about this one.
    pub fn enu_from_enu_of(self, other: Self) -> (UnitQuaternion<f64>, Vector3<f64>) {
        let rotation = self.enu_from_ecef() * other.enu_from_ecef().transpose();
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        (rotation, other.to_enu(self))
    }

    /// The place of a point given east, north, up in metres about `origin`.
    ///
    /// Bowring's fixed point on the latitude; below 1e-9 m within 10 km of the ellipsoid.
    pub fn from_enu(enu: &Vector3<f64>, origin: Self) -> Self {
        let ecef = origin.enu_from_ecef().transpose() * enu + origin.to_ecef();
        let p = ecef.x.hypot(ecef.y);
        let mut lat = ecef.z.atan2(p * (1.0 - E2));
        for _ in 0..8 {
            let n = A / (1.0 - E2 * lat.sin().powi(2)).sqrt();
            lat = (ecef.z + E2 * n * lat.sin()).atan2(p);
        }
        let n = A / (1.0 - E2 * lat.sin().powi(2)).sqrt();
        let alt = p * lat.cos() + ecef.z * lat.sin() - A * A / n;
        Self { lat: lat.to_degrees(), lon: ecef.y.atan2(ecef.x).to_degrees(), alt }
    }

    /// Whether the numbers can be a place on earth.
    pub fn is_valid(self) -> bool {
        self.lat.abs() <= 90.0 && self.lon.abs() <= 360.0 && self.alt.is_finite()
    }
}

impl GeoPosition {
    /// The place, at a given altitude where none is known.
    pub fn or_at(&self, alt: f64) -> Wgs84 {
        Wgs84 { lat: self.lat_deg, lon: self.lon_deg, alt: self.alt_m.unwrap_or(alt) }
    }

    /// Whether the numbers can be a place on earth.
    pub fn is_valid(&self) -> bool {
        self.or_at(0.0).is_valid()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_is_exact() {
        let origin = Wgs84 { lat: 48.8566, lon: 2.3522, alt: 35.0 };
        for enu in [
            Vector3::new(0.0, 0.0, 0.0),
            Vector3::new(120.0, -340.0, 12.0),
            Vector3::new(-4000.0, 9000.0, -30.0),
        ] {
            let back = Wgs84::from_enu(&enu, origin).to_enu(origin);
            assert!((back - enu).norm() < 1e-6, "{enu} {back}");
        }
    }

    #[test]
    fn round_trip_is_exact_from_pole_to_pole() {
        for lat in [-89.0, -33.0, 0.0, 48.86, 89.9] {
            let place = Wgs84 { lat, lon: -71.3, alt: 35.0 };
            let origin = Wgs84 { lat: lat - 0.01, lon: -71.31, alt: 0.0 };
            let back = Wgs84::from_enu(&place.to_enu(origin), origin);
            assert!((back.lat - lat).abs() < 1e-10 && (back.lon + 71.3).abs() < 1e-10);
            assert!((back.alt - 35.0).abs() < 1e-6);
        }
    }

    #[test]
    fn places_about_one_origin_are_the_same_about_another() {
        let [here, there] =
            [(47.37, 8.54, 400.0), (-33.9, 151.2, 20.0)].map(|(lat, lon, alt)| Wgs84 { lat, lon, alt });
        let place = Wgs84 { lat: 46.9, lon: 7.4, alt: 700.0 };
        let (rotation, translation) = here.enu_from_enu_of(there);
        let moved = rotation * place.to_enu(there) + translation;
        assert!((moved - place.to_enu(here)).norm() < 1e-6, "{moved}");
    }

    #[test]
    fn a_kilometre_north_follows_the_meridian() {
        let origin = Wgs84 { lat: 45.0, lon: 7.0, alt: 100.0 };
        let north = Wgs84::from_enu(&Vector3::new(0.0, 1000.0, 0.0), origin);
        // Meridian radius at 45°: a(1 − e²) / (1 − e²/2)^1.5 = 6 367 381.8 m, plus the altitude.
        assert!((north.lat - 45.0 - (1000.0 / 6_367_481.8_f64).to_degrees()).abs() < 1e-8);
        assert!((north.lon - 7.0).abs() < 1e-12);
        assert!((north.alt - 100.0 - 1000.0 * 1000.0 / 2.0 / 6_367_481.8).abs() < 1e-3);
    }

    #[test]
    fn one_arc_second_north_is_31_metres() {
        let origin = Wgs84 { lat: 48.8566, lon: 2.3522, alt: 35.0 };
        let north = Wgs84 { lat: origin.lat + 1.0 / 3600.0, ..origin }.to_enu(origin);
        assert!((north.y - 30.89).abs() < 0.01 && north.x.abs() < 1e-6, "{north}");
    }
}
