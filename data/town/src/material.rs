//! What everything but façades is made of.

use crate::facade::{bill, glyph, vivid};
use crate::light::Rgb;
use crate::noise::{filtered_band, hash, octaves, resolved, spots, uniform, value_noise};

/// The substance of a solid; seeds make each piece unlike the others.
#[derive(Debug, Clone, Copy)]
pub enum Material {
    /// The solid carries façades.
    Facade,
    /// Worked stone or wood of a colour.
    Stone(Rgb, u32),
    /// Roof tiles.
    Tiles(u32),
    /// Painted iron.
    Iron(u32),
    /// A shop sign with letters.
    Sign(u32),
    /// A surface pasted with bills.
    Bills(u32),
    /// Leaves.
    Foliage(u32),
    /// Bark.
    Bark(u32),
    /// Slabs of a pavement.
    Pavement(u32),
    /// Car body; windows are separate solids.
    Paint(u32),
    /// Dark glass.
    Glass(u32),
    /// Striped cloth.
    Cloth(u32),
}

impl Material {
    /// Colour at a place of the surface (metres in two directions); `footprint` is the size of a pixel there.
    pub fn albedo(&self, u: f32, v: f32, footprint: f32) -> Rgb {
        match *self {
            Self::Facade => Rgb::repeat(0.4),
            Self::Stone(color, seed) => {
                color * (1.0 + 0.16 * octaves(seed, u, v, footprint, 0.9, 6, 0.8)).max(0.3)
            }
            Self::Tiles(seed) => {
                let row = (v / 0.28).floor();
                let shifted = u / 0.22 + 0.5 * (row as i32 & 1) as f32;
                let tint = uniform(seed, shifted.floor() as i32, row as i32) - 0.5;
                let visible = resolved(0.22, footprint);
                let edge = filtered_band(0.0, 0.035, v - row * 0.28, footprint) * visible;
                let base =
                    if seed & 1 == 0 { Rgb::new(0.50, 0.25, 0.17) } else { Rgb::new(0.27, 0.29, 0.33) };
                base * (1.0 + 0.5 * tint * visible - 0.5 * edge
                    + 0.14 * octaves(seed ^ 3, u, v, footprint, 2.5, 5, 0.75))
                .max(0.2)
            }
            Self::Iron(seed) => {
                Rgb::new(0.09, 0.11, 0.10) * (1.0 + 0.4 * octaves(seed, u, v, footprint, 0.3, 4, 0.7))
            }
            Self::Sign(seed) => {
                let ground = vivid(seed) * 0.6;
                let (i, y) = ((u / 0.36).floor(), (v / 0.55).fract());
                let ink = glyph(hash(seed ^ 8, i as i32, 0), u / 0.36 - i, y);
                let wear = 1.0 + 0.12 * octaves(seed ^ 2, u, v, footprint, 0.4, 5, 0.8);
                (if ink { Rgb::new(0.82, 0.79, 0.68) } else { ground }) * wear
            }
            Self::Bills(seed) => {
                let (i, j) = ((u / 0.7).floor(), (v / 0.9).floor());
                bill(hash(seed, i as i32, j as i32), u - i * 0.7, v - j * 0.9, footprint)
            }
            Self::Foliage(seed) => {
                let leaf = octaves(seed, u, v, footprint, 0.8, 5, 0.85);
                Rgb::new(0.17, 0.27, 0.09) * (1.0 + 0.45 * leaf).max(0.2)
            }
            Self::Bark(seed) => {
                Rgb::new(0.25, 0.19, 0.14)
                    * (1.0 + 0.35 * octaves(seed, u * 3.0, v, footprint * 2.0, 0.4, 5, 0.8)).max(0.2)
            }
            Self::Pavement(seed) => pavement(seed, u, v, footprint),
            Self::Paint(seed) => vivid(seed) * (0.75 + 0.06 * octaves(seed, u, v, footprint, 0.8, 5, 0.8)),
            Self::Glass(seed) => {
                Rgb::new(0.07, 0.08, 0.09) * (1.0 + 0.4 * octaves(seed, u, v, footprint, 0.5, 4, 0.7))
            }
            Self::Cloth(seed) => {
                let stripe = filtered_band(0.0, 0.18, (u / 0.36).fract() * 0.36, footprint);
                let color = vivid(seed) * 0.8;
                (color + (Rgb::repeat(0.72) - color) * stripe)
                    * (1.0 + 0.12 * octaves(seed, u, v, footprint, 0.7, 5, 0.8))
            }
        }
    }
}

fn pavement(seed: u32, x: f32, y: f32, footprint: f32) -> Rgb {
    let size = 0.55;
    let (i, j) = ((x / size).floor(), (y / size).floor());
    let tint = uniform(seed, i as i32, j as i32) - 0.5;
    let visible = resolved(size, footprint);
    let (fx, fy) = (x - i * size, y - j * size);
    let inside =
        filtered_band(0.012, size - 0.012, fx, footprint) * filtered_band(0.012, size - 0.012, fy, footprint);
    let spots = octaves(seed ^ 5, x, y, footprint, 0.22, 2, 0.5);
    let gum = resolved(0.1, footprint) * (1.0 - 0.5 * ((spots - 0.75) * 12.0).clamp(0.0, 1.0));
    let gum = gum + 1.0 - resolved(0.1, footprint);
    let stain = octaves(seed ^ 6, x, y, footprint, 3.1, 7, 0.75);
    Rgb::new(0.42, 0.41, 0.39)
        * (1.0 + 0.35 * tint * visible + 0.18 * stain).max(0.2)
        * gum
        * (0.6 + 0.4 * (inside * visible + 1.0 - visible))
}

/// Colour of the street at a place; `is_lane` where it is cobbled, `across` the distance from the street's middle.
pub fn street(seed: u32, x: f32, y: f32, is_lane: bool, across: f32, footprint: f32) -> Rgb {
    let stain = octaves(seed ^ 1, x, y, footprint, 4.3, 8, 0.78);
    if is_lane {
        let (a, b) = (
            x + 0.05 * value_noise(seed ^ 2, x * 2.0, y * 2.0),
            y + 0.05 * value_noise(seed ^ 3, x * 2.0, y * 2.0),
        );
        let (length, height) = (0.26, 0.17);
        let row = (b / height).floor();
        let shifted = a / length + 0.5 * (row as i32 & 1) as f32;
        let tint = uniform(seed ^ 4, shifted.floor() as i32, row as i32) - 0.5;
        let (fx, fy) = ((shifted - shifted.floor()) * length, b - row * height);
        let visible = resolved(height, footprint);
        let inside = filtered_band(0.015, length - 0.015, fx, footprint)
            * filtered_band(0.015, height - 0.015, fy, footprint);
        let cover = inside * visible + 0.75 * (1.0 - visible);
        return Rgb::new(0.40, 0.38, 0.36)
            * (1.0 + 0.5 * tint * visible + 0.13 * stain).max(0.2)
            * (0.35 + 0.65 * cover);
    }
    let patch = (octaves(seed ^ 5, x, y, footprint, 3.3, 3, 0.5) - 0.3) / (0.03 + footprint);
    let crack = octaves(seed ^ 6, x, y, footprint, 1.9, 4, 0.6).abs();
    let is_crack = (1.0 - crack / (0.02 + footprint * 0.5)).clamp(0.0, 1.0) * resolved(0.08, footprint);
    let mut color = Rgb::new(0.27, 0.27, 0.28)
        * (1.0 + 0.21 * stain - 0.25 * patch.clamp(0.0, 1.0)).max(0.2)
        * (1.0 - 0.5 * is_crack);
    color *=
        1.0 + 0.3 * spots(seed ^ 7, x, y, footprint, 0.7) + 0.25 * spots(seed ^ 8, x, y, footprint, 0.31);
    let dash = ((y + x) / 4.0).rem_euclid(1.0) * 4.0;
    let marking = filtered_band(-0.07, 0.07, across, footprint) * filtered_band(0.0, 2.2, dash, footprint);
    let worn = marking * (0.75 + 0.35 * stain).clamp(0.0, 1.0);
    color += (Rgb::repeat(0.72) - color) * worn;
    color
}
