//! From views to pixels.
//!
//! One sample per pixel where the surface is smooth (its texture is filtered to the pixel already), four more where the
//! neighbours show another surface or another state of shadow.

use nalgebra::{Vector2, Vector3};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::error::TownError;
use crate::geometry::{Hit, Part, Ray, Shape, facade_place, leave_recess};
use crate::layout::street_at;
use crate::light::Rgb;
use crate::material::street;
use crate::town::{GROUND, Town, View};

/// Offsets of the extra samples from the pixel's centre.
const EXTRA_SAMPLES: [[f64; 2]; 4] = [[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]];
/// Distance in metres over which the air hides 63 % of a surface.
const AIR_M: f64 = 700.0;
/// Key of the sky; surfaces have others.
const SKY: u64 = u64::MAX;

/// A rendered view: 8-bit RGB, row by row from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RenderedView {
    /// Path in the data set.
    pub name: String,
    /// `3 * width * height` bytes.
    pub rgb: Vec<u8>,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

#[derive(Clone, Copy)]
struct Sample {
    color: Rgb,
    /// Equal for samples of one surface in one state of shadow.
    key: u64,
}

impl Town {
    /// Renders a view, by its index in [`Town::views`]; rows run in parallel, the bytes never depend on that.
    ///
    /// # Errors
    /// [`TownError::NoSuchView`] when the index is too large.
    pub fn render(&self, index: usize) -> Result<RenderedView, TownError> {
        let count = self.views().len();
        let view = self.views().get(index).ok_or(TownError::NoSuchView { index, count })?;
        let (width, height) = (view.camera.width as usize, view.camera.height as usize);
        let mut samples = vec![Sample { color: Rgb::zeros(), key: SKY }; width * height];
        samples.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, sample) in row.iter_mut().enumerate() {
                *sample = self.sample(view, x as f64 + 0.5, y as f64 + 0.5);
            }
        });
        let mut rgb = vec![0; 3 * width * height];
        rgb.par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
            let mut rng = ChaCha8Rng::seed_from_u64(self.params.seed);
            rng.set_stream((index as u64) << 32 | y as u64);
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let center = samples[y * width + x];
                let is_edge = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)]
                    .into_iter()
                    .any(|(i, j)| i < width && j < height && samples[j * width + i].key != center.key);
                let mut color = tone(&center.color, view.light.exposure);
                if is_edge {
                    for [dx, dy] in EXTRA_SAMPLES {
                        let extra = self.sample(view, x as f64 + 0.5 + dx, y as f64 + 0.5 + dy);
                        color += tone(&extra.color, view.light.exposure);
                    }
                    color /= (EXTRA_SAMPLES.len() + 1) as f32;
                }
                for (channel, value) in pixel.iter_mut().zip(color.iter()) {
                    let noise = self.params.sensor_noise as f32 * near_gaussian(rng.next_u32());
                    *channel = (255.0 * value.powf(1.0 / 2.2) + noise + 0.5).clamp(0.0, 255.0) as u8;
                }
            }
        });
        Ok(RenderedView {
            name: view.name.clone(),
            rgb,
            width: view.camera.width,
            height: view.camera.height,
        })
    }

    /// Light that arrives at a place of the image (pixels).
    fn sample(&self, view: &View, x: f64, y: f64) -> Sample {
        let Some(bearing) = view.camera.unproject(&Vector2::new(x, y)) else {
            return Sample { color: Rgb::zeros(), key: SKY };
        };
        let direction = view.rotation_world_from_camera * bearing;
        let ray = Ray::new(view.center_in_world, direction);
        let pixel_angle = if view.camera.is_panoramic() {
            std::f64::consts::TAU / f64::from(view.camera.width)
        } else {
            1.0 / view.camera.params[0]
        };
        match self.first_hit(&ray) {
            Some(hit) => self.shade(view, &ray, &hit, pixel_angle),
            None => Sample { color: view.light.sky_radiance(&direction), key: SKY },
        }
    }

    fn shade(&self, view: &View, ray: &Ray, hit: &Hit, pixel_angle: f64) -> Sample {
        let point = ray.at(hit.distance);
        let facing = -hit.normal.dot(&ray.direction);
        // Between the footprint's short and long side: sharper than isotropic filtering, with little aliasing.
        let footprint = (hit.distance * pixel_angle / facing.max(0.03).powf(0.7)) as f32;
        let (albedo, occlusion, part_key) = self.surface(hit, &point, footprint);
        let lit = self.is_sunlit(view, hit, &point);
        let light = &view.light;
        let mut irradiance = light.ambient(&hit.normal) * occlusion;
        if lit {
            irradiance += light.sun * hit.normal.dot(&light.sun_direction) as f32;
        }
        let mut color = albedo.component_mul(&irradiance);
        if let Part::Pane(..) = hit.part {
            let mirrored = ray.direction - hit.normal * (2.0 * ray.direction.dot(&hit.normal));
            let fresnel = 0.03 + 0.5 * (1.0 - facing as f32).powi(4);
            color += light.sky_radiance(&mirrored) * fresnel * 0.6;
        }
        let air = 1.0 - (-hit.distance / AIR_M).exp() as f32;
        color += (light.sky * 0.8 - color) * air;
        Sample { color, key: u64::from(hit.solid) << 24 | part_key << 1 | u64::from(lit) }
    }

    /// Colour, share of the sky that reaches it, and a key of the part.
    fn surface(&self, hit: &Hit, point: &Vector3<f64>, footprint: f32) -> (Rgb, f32, u64) {
        let (x, y, z) = (point.x as f32, point.y as f32, point.z as f32);
        if hit.solid == GROUND {
            let (is_lane, across) = street_at(point.x);
            return (
                street(self.params.seed as u32, x, y, is_lane, across as f32, footprint),
                0.85,
                u64::from(is_lane),
            );
        }
        let solid = self.hierarchy.solid(hit.solid);
        if let Shape::Building(bounds, facades) = &solid.shape {
            return match hit.part {
                Part::Face(face @ 0..4) => {
                    let (u, v) = facade_place(bounds, face, point);
                    let low = 0.7 + 0.3 * (v / 2.5).min(1.0);
                    (facades[usize::from(face)].wall_albedo(u, v, footprint), low, u64::from(face))
                }
                Part::Face(_) => (Rgb::repeat(0.35), 1.0, 7),
                Part::Reveal(face, opening) => {
                    (facades[usize::from(face)].trim * 0.9, 0.6, 8 | u64::from(opening.seed & 0xffff) << 4)
                }
                Part::Pane(face, opening) => {
                    let (u, v) = facade_place(bounds, face, point);
                    let albedo = facades[usize::from(face)].pane_albedo(&opening, u, v, footprint);
                    (albedo, 0.7, 9 | u64::from(opening.seed & 0xffff) << 4)
                }
            };
        }
        let (u, v) = match &solid.shape {
            Shape::Cylinder { base, radius, .. } => {
                (((point.y - base.y).atan2(point.x - base.x) * radius) as f32, z)
            }
            Shape::Panel { origin, along, up, .. } => {
                let place = point - origin;
                ((place.dot(along) / along.norm()) as f32, (place.dot(up) / up.norm()) as f32)
            }
            Shape::Gable { ridge_along_x, .. } => (if *ridge_along_x { x } else { y }, z * 1.6),
            _ => match hit.normal.abs().imax() {
                0 => (y, z),
                1 => (x, z),
                _ => (x, y),
            },
        };
        let face = match hit.part {
            Part::Face(face) => u64::from(face),
            Part::Reveal(..) | Part::Pane(..) => 0,
        };
        (solid.material.albedo(u, v, footprint), 0.85, face)
    }

    fn is_sunlit(&self, view: &View, hit: &Hit, point: &Vector3<f64>) -> bool {
        let sun = view.light.sun_direction;
        if hit.normal.dot(&sun) <= 0.0 {
            return false;
        }
        let start = point + hit.normal * 1e-4;
        let origin = match (hit.part, (hit.solid != GROUND).then(|| &self.hierarchy.solid(hit.solid).shape)) {
            (Part::Reveal(face, opening) | Part::Pane(face, opening), Some(Shape::Building(bounds, _))) => {
                match leave_recess(bounds, &Ray::new(start, sun), face, &opening) {
                    Some(exit) => exit,
                    None => return false,
                }
            }
            _ => start,
        };
        self.hierarchy.intersect(&Ray::new(origin, sun), f64::INFINITY, true).is_none()
    }
}

/// Radiance to the sensor's linear range, highlights rolled off.
fn tone(color: &Rgb, exposure: f32) -> Rgb {
    color.map(|c| {
        let x = c.max(0.0) * exposure;
        if x < 0.7 { x } else { 0.7 + 0.3 * (1.0 - (-(x - 0.7) / 0.3).exp()) }
    })
}

/// A number of variance one from the sum of four random bytes.
fn near_gaussian(bits: u32) -> f32 {
    let sum: u32 = bits.to_le_bytes().into_iter().map(u32::from).sum();
    (sum as f32 - 510.0) / 147.8
}
