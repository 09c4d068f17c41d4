use serde::{Deserialize, Serialize};

use crate::TownError;

/// Version of the rendered bytes; part of any cache key over them.
///
/// 1: first town.
pub const VERSION: u32 = 1;

/// What town to build and how to photograph it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TownParams {
    /// Seed of everything random: another seed is another town.
    pub seed: u64,
    /// Number of panoramas, 1 to 2000; the streets grow with it.
    pub panoramas: usize,
    /// Distance between neighbouring panoramas along the route in metres, 2 to 10.
    pub panorama_step_m: f64,
    /// Panorama width in pixels, 32 to 8192 and even; the height is half of it.
    pub panorama_width: u32,
    /// Number of photos of the set, 0 to 64; more photos stand closer together on the same path.
    pub photos: usize,
    /// Photo width in pixels, 32 to 8192 and a multiple of 4; the height is three quarters of it.
    pub photo_width: u32,
    /// Standard deviation of the recorded position per axis in metres, 0 to 100.
    pub gps_noise_m: f64,
    /// Standard deviation of the sensor noise in 8-bit grey levels, 0 to 50.
    pub sensor_noise: f64,
}

impl Default for TownParams {
    fn default() -> Self {
        Self {
            seed: 1,
            panoramas: 8,
            panorama_step_m: 5.0,
            panorama_width: 1536,
            photos: 8,
            photo_width: 1024,
            gps_noise_m: 1.5,
            sensor_noise: 1.2,
        }
    }
}

impl TownParams {
    /// Checks every field against its range.
    ///
    /// # Errors
    /// [`TownError::InvalidParameter`] naming the first field at fault, its value and its range.
    pub fn validate(&self) -> Result<(), TownError> {
        let check = |holds: bool, name, value: String, allowed| {
            if holds { Ok(()) } else { Err(TownError::InvalidParameter { name, value, allowed }) }
        };
        let width_is_valid =
            |width: u32, multiple: u32| (32..=8192).contains(&width) && width.is_multiple_of(multiple);
        check((1..=2000).contains(&self.panoramas), "panoramas", self.panoramas.to_string(), "1 to 2000")?;
        check(
            (2.0..=10.0).contains(&self.panorama_step_m),
            "panorama_step_m",
            self.panorama_step_m.to_string(),
            "2 to 10 metres",
        )?;
        check(
            width_is_valid(self.panorama_width, 2),
            "panorama_width",
            self.panorama_width.to_string(),
            "even numbers from 32 to 8192",
        )?;
        check(self.photos <= 64, "photos", self.photos.to_string(), "0 to 64")?;
        check(
            width_is_valid(self.photo_width, 4),
            "photo_width",
            self.photo_width.to_string(),
            "multiples of 4 from 32 to 8192",
        )?;
        check(
            (0.0..=100.0).contains(&self.gps_noise_m),
            "gps_noise_m",
            self.gps_noise_m.to_string(),
            "0 to 100 metres",
        )?;
        check(
            (0.0..=50.0).contains(&self.sensor_noise),
            "sensor_noise",
            self.sensor_noise.to_string(),
            "0 to 50 grey levels",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_the_field_at_fault() {
        let mut params = TownParams { gps_noise_m: f64::NAN, ..TownParams::default() };
        assert!(params.validate().unwrap_err().to_string().starts_with("gps_noise_m = NaN"));
        params = TownParams { panorama_width: 1001, ..TownParams::default() };
        assert!(params.validate().unwrap_err().to_string().starts_with("panorama_width = 1001"));
        params = TownParams { panoramas: 0, ..TownParams::default() };
        assert!(params.validate().is_err());
        assert!(TownParams::default().validate().is_ok());
    }

    #[test]
    fn rejects_unknown_fields_and_fills_missing_ones() {
        assert!(serde_json::from_str::<TownParams>(r#"{"panorama": 3}"#).is_err());
        let params: TownParams = serde_json::from_str(r#"{"panoramas": 3}"#).unwrap();
        assert_eq!(params, TownParams { panoramas: 3, ..TownParams::default() });
    }
}
