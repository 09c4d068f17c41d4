use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Semi-major axis of the WGS84 ellipsoid in metres.
const SEMI_MAJOR_M: f64 = 6_378_137.0;
/// Flattening of the WGS84 ellipsoid.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// A place on the WGS84 ellipsoid that carries a local east-north-up frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeoOrigin {
    /// Latitude in degrees, north positive.
    pub lat: f64,
    /// Longitude in degrees, east positive.
    pub lon: f64,
    /// Height above the ellipsoid in metres.
    pub alt: f64,
}

impl GeoOrigin {
    /// Latitude and longitude in degrees and height in metres of a point in this origin's east-north-up frame (metres).
    pub fn geodetic_from_enu(&self, point_in_enu: &Vector3<f64>) -> Self {
        let (sin_lat, cos_lat) = self.lat.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.lon.to_radians().sin_cos();
        let (e, n, u) = (point_in_enu.x, point_in_enu.y, point_in_enu.z);
        let offset = Vector3::new(
            -sin_lon * e - sin_lat * cos_lon * n + cos_lat * cos_lon * u,
            cos_lon * e - sin_lat * sin_lon * n + cos_lat * sin_lon * u,
            cos_lat * n + sin_lat * u,
        );
        Self::from_earth_centred(&(self.earth_centred() + offset))
    }

    /// Earth-centred earth-fixed coordinates in metres.
    fn earth_centred(&self) -> Vector3<f64> {
        let (sin_lat, cos_lat) = self.lat.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.lon.to_radians().sin_cos();
        let normal_radius = prime_vertical_radius(sin_lat);
        Vector3::new(
            (normal_radius + self.alt) * cos_lat * cos_lon,
            (normal_radius + self.alt) * cos_lat * sin_lon,
            (normal_radius * (1.0 - ECCENTRICITY_SQUARED) + self.alt) * sin_lat,
        )
    }

    /// Fixed-point iteration on the latitude; near the surface each round gains more than two digits.
    fn from_earth_centred(point: &Vector3<f64>) -> Self {
        let axis_distance = point.x.hypot(point.y);
        let mut lat = point.z.atan2(axis_distance * (1.0 - ECCENTRICITY_SQUARED));
        for _ in 0..8 {
            let sin_lat = lat.sin();
            lat = (point.z + ECCENTRICITY_SQUARED * prime_vertical_radius(sin_lat) * sin_lat)
                .atan2(axis_distance);
        }
        let (sin_lat, cos_lat) = lat.sin_cos();
        // Valid at every latitude, unlike p / cos(lat) − N.
        let alt = axis_distance * cos_lat + point.z * sin_lat
            - prime_vertical_radius(sin_lat) * (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat);
        Self { lat: lat.to_degrees(), lon: point.y.atan2(point.x).to_degrees(), alt }
    }
}

/// Radius of curvature in the prime vertical in metres.
fn prime_vertical_radius(sin_lat: f64) -> f64 {
    SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_arc_second_of_latitude_is_thirty_metres() {
        let origin = GeoOrigin { lat: 45.0, lon: 7.0, alt: 100.0 };
        let north = origin.geodetic_from_enu(&Vector3::new(0.0, 1000.0, 0.0));
        // Meridian radius at 45°: a(1 − e²) / (1 − e²/2)^1.5 = 6 367 381.8 m, plus the altitude.
        assert!((north.lat - 45.0 - (1000.0 / 6_367_481.8_f64).to_degrees()).abs() < 1e-8);
        assert!((north.lon - 7.0).abs() < 1e-12);
        assert!((north.alt - 100.0 - 1000.0 * 1000.0 / 2.0 / 6_367_481.8).abs() < 1e-3);
    }

    #[test]
    fn earth_centred_round_trip_is_exact() {
        for lat in [-89.0, -33.0, 0.0, 48.86, 89.9] {
            let place = GeoOrigin { lat, lon: -71.3, alt: 35.0 };
            let back = GeoOrigin::from_earth_centred(&place.earth_centred());
            assert!((back.lat - lat).abs() < 1e-10 && (back.lon + 71.3).abs() < 1e-10);
            assert!((back.alt - 35.0).abs() < 1e-6);
        }
    }
}
