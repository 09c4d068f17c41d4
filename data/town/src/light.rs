//! Sun, sky and exposure.

use nalgebra::Vector3;

use crate::noise::octaves;

/// Linear RGB.
pub type Rgb = Vector3<f32>;

/// The light a view is taken under.
#[derive(Debug, Clone, Copy)]
pub struct Light {
    /// Unit direction towards the sun.
    pub sun_direction: Vector3<f64>,
    /// Radiance of the sun on a surface that faces it.
    pub sun: Rgb,
    /// Irradiance from the sky on a surface that faces up.
    pub sky: Rgb,
    /// Irradiance from the ground on a surface that faces down.
    pub bounce: Rgb,
    /// Factor from radiance to the sensor.
    pub exposure: f32,
    cloud_seed: u32,
}

impl Light {
    /// A clear afternoon, the sun high in the south-west: the panoramas.
    pub fn afternoon() -> Self {
        Self {
            sun_direction: Vector3::new(-0.55, -0.30, 0.95).normalize(),
            sun: Rgb::new(1.02, 0.98, 0.90),
            sky: Rgb::new(0.52, 0.58, 0.68),
            bounce: Rgb::new(0.30, 0.28, 0.26),
            exposure: 1.0,
            cloud_seed: 11,
        }
    }

    /// A hazy morning, the sun low in the east, warm and less exposed: the photos.
    pub fn morning() -> Self {
        Self {
            sun_direction: Vector3::new(0.62, 0.28, 0.62).normalize(),
            sun: Rgb::new(0.86, 0.70, 0.50),
            sky: Rgb::new(0.62, 0.60, 0.60),
            bounce: Rgb::new(0.32, 0.29, 0.25),
            exposure: 0.88,
            cloud_seed: 29,
        }
    }

    /// Light from sky and ground on a surface with this normal.
    pub fn ambient(&self, normal: &Vector3<f64>) -> Rgb {
        let up = (0.5 + 0.5 * normal.z) as f32;
        // A little more from the sun's side keeps shaded faces of a corner apart.
        let side = 1.0 + 0.15 * normal.dot(&self.sun_direction) as f32;
        (self.sky * up + self.bounce * (1.0 - up)) * side
    }

    /// The sky seen in a direction: gradient, thin clouds, and hills at the horizon.
    pub fn sky_radiance(&self, direction: &Vector3<f64>) -> Rgb {
        let elevation = direction.z.max(0.0) as f32;
        let azimuth = direction.x.atan2(direction.y) as f32;
        let haze = Rgb::new(0.86, 0.87, 0.88).component_mul(&self.sky.map(|c| 0.55 + 0.6 * c));
        let zenith = Rgb::new(0.26, 0.46, 0.80).component_mul(&self.sky.map(|c| 0.7 + 0.5 * c));
        let mut sky = haze + (zenith - haze) * elevation.powf(0.55).min(1.0);
        let flat = 1.0 / (elevation + 0.18);
        let (x, y) = (direction.x as f32 * flat, direction.y as f32 * flat);
        let cloud = (octaves(self.cloud_seed, x, y, 0.08, 1.3, 4, 0.55) - 0.1).clamp(0.0, 0.9)
            * (elevation * 4.0).min(1.0);
        sky += (Rgb::repeat(0.92) - sky) * cloud * 0.7;
        let hill = 0.035 + 0.02 * octaves(5, azimuth * 4.0, 0.0, 0.02, 2.0, 4, 0.5);
        if (direction.z as f32) < hill {
            sky = Rgb::new(0.42, 0.48, 0.47).component_mul(&self.sky.map(|c| 0.5 + 0.7 * c));
        }
        sky
    }
}
