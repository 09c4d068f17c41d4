//! Façades: where their openings are and what their walls look like.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::light::Rgb;
use crate::noise::{filtered_band, filtered_step, hash, octaves, resolved, spots, uniform, value_noise};

/// What fills an opening.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OpeningKind {
    Window,
    Door,
    Shop,
}

/// A rectangular recess in a façade, in metres along it and above the ground.
#[derive(Debug, Clone, Copy)]
pub struct Opening {
    pub left: f32,
    pub right: f32,
    pub bottom: f32,
    pub top: f32,
    pub depth: f32,
    pub kind: OpeningKind,
    /// Seed of what is seen in it.
    pub seed: u32,
}

/// What a wall is built of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Masonry {
    Brick,
    Ashlar,
    Plaster,
    Rubble,
}

/// One side of a building.
#[derive(Debug, Clone)]
pub struct Facade {
    pub seed: u32,
    pub masonry: Masonry,
    pub base: Rgb,
    pub trim: Rgb,
    pub width: f32,
    /// Height of the wall in metres above the ground.
    pub top: f32,
    /// Windows per floor; 0 for a party wall.
    pub bays: u32,
    pub floors: u32,
    pub ground_floor: f32,
    pub floor_height: f32,
    pub window_width: f32,
    pub window_height: f32,
    pub recess: f32,
}

const PALETTE: [[f32; 3]; 8] = [
    [0.66, 0.58, 0.45],
    [0.58, 0.33, 0.25],
    [0.71, 0.66, 0.58],
    [0.48, 0.28, 0.22],
    [0.62, 0.50, 0.36],
    [0.50, 0.55, 0.52],
    [0.70, 0.52, 0.42],
    [0.55, 0.53, 0.50],
];

impl Facade {
    /// Draws a façade of this width with so many storeys above the ground floor; a party wall has no openings.
    pub fn draw(rng: &mut ChaCha8Rng, width: f32, storeys: u32, has_openings: bool) -> Self {
        let masonry =
            [Masonry::Brick, Masonry::Ashlar, Masonry::Plaster, Masonry::Rubble][rng.random_range(0..4)];
        let tone = rng.random_range(0.85..1.15);
        let ground_floor = rng.random_range(3.6..4.3);
        let floor_height = rng.random_range(2.9..3.3);
        // One in four follows one of two stock designs, so that streets repeat window modules as real ones do.
        let stock = rng.random_range(0..8u32);
        let (window_width, window_height, recess) = match stock {
            0 => (1.2, 1.8, 0.22),
            1 => (1.0, 1.6, 0.28),
            _ => (rng.random_range(0.9..1.4), rng.random_range(1.4..1.9), rng.random_range(0.16..0.32)),
        };
        let pitch = window_width + rng.random_range(0.9..1.5);
        Self {
            seed: rng.random(),
            masonry,
            base: Rgb::from(PALETTE[rng.random_range(0..PALETTE.len())]) * tone,
            trim: Rgb::new(0.74, 0.71, 0.64) * rng.random_range(0.75..1.1),
            width,
            top: ground_floor + floor_height * storeys as f32 + 0.8,
            bays: if has_openings { ((width - 0.8) / pitch).floor().max(1.0) as u32 } else { 0 },
            floors: storeys,
            ground_floor,
            floor_height,
            window_width,
            window_height,
            recess,
        }
    }

    /// The opening of a floor (0 is the ground floor) and bay.
    pub fn opening_of(&self, floor: u32, bay: u32) -> Option<Opening> {
        if floor > self.floors || bay >= self.bays {
            return None;
        }
        let pitch = (self.width - 0.8) / self.bays as f32;
        let center = 0.4 + pitch * (bay as f32 + 0.5);
        let seed = hash(self.seed ^ 0x51, floor as i32, bay as i32);
        let choice = uniform(seed, 1, 2);
        let (kind, width, bottom, top, depth) = if floor > 0 {
            if choice < 0.06 {
                return None;
            }
            let bottom = self.ground_floor + self.floor_height * (floor - 1) as f32 + 0.75;
            (OpeningKind::Window, self.window_width, bottom, bottom + self.window_height, self.recess)
        } else if choice < 0.22 {
            (OpeningKind::Door, 1.15, 0.13, 2.5, self.recess + 0.1)
        } else if choice < 0.55 {
            (OpeningKind::Shop, pitch - 0.45, 0.6, 2.75, 0.35)
        } else if choice < 0.8 {
            (OpeningKind::Window, self.window_width, 1.15, 2.75, self.recess)
        } else {
            return None;
        };
        let half = 0.5 * width.min(pitch - 0.3);
        Some(Opening { left: center - half, right: center + half, bottom, top, depth, kind, seed })
    }

    /// Floor and bay of a place; also beyond the last ones.
    fn cell(&self, u: f32, v: f32) -> (u32, u32) {
        let floor =
            if v < self.ground_floor { 0 } else { ((v - self.ground_floor) / self.floor_height) as u32 + 1 };
        let bay = (((u - 0.4) / (self.width - 0.8) * self.bays as f32).max(0.0)) as u32;
        (floor, bay)
    }

    /// The opening at a place of the façade.
    pub fn opening(&self, u: f32, v: f32) -> Option<Opening> {
        if self.bays == 0 {
            return None;
        }
        let (floor, bay) = self.cell(u, v);
        self.opening_of(floor, bay).filter(|o| u > o.left && u < o.right && v > o.bottom && v < o.top)
    }

    /// Colour of the wall at a place; `footprint` is the size of a pixel there in metres.
    pub fn wall_albedo(&self, u: f32, v: f32, footprint: f32) -> Rgb {
        let seed = self.seed;
        let mut color = self.masonry_albedo(self.masonry, u, v, footprint);
        // Patches where plaster fell off or was repaired: blobs with sharp borders, unlike anywhere else.
        let patch = octaves(seed ^ 0xa1, u, v, footprint, 1.7, 4, 0.55);
        let other = if self.masonry == Masonry::Plaster { Masonry::Brick } else { Masonry::Plaster };
        let cover = filtered_step(0.42, patch, 0.04 + footprint);
        if cover > 0.0 {
            let patched = self.masonry_albedo(other, u, v, footprint) * 0.8;
            color += (patched - color) * cover;
        }
        // Stains from four metres down to centimetres.
        let stain = octaves(seed ^ 0xb2, u, v, footprint, 3.7, 7, 0.86);
        color *= (1.0 + 0.2 * stain).max(0.22);
        let streak = value_noise(seed ^ 0xc3, u * 5.0, v * 0.35) * resolved(0.2, footprint);
        color *= 1.0 - 0.22 * streak.max(0.0);
        // Soot and lime: sharp, dense blots that a panorama resolves across the street.
        let soot = octaves(seed ^ 0xd4, u, v, footprint, 0.62, 3, 0.6);
        color *= 1.0 - 0.5 * filtered_step(0.5, soot, 0.05 + footprint);
        color += (Rgb::new(0.80, 0.78, 0.72) - color) * (0.5 * filtered_step(0.55, -soot, 0.05 + footprint));
        let chips =
            spots(seed ^ 0x1d, u, v, footprint, 0.62) + 0.8 * spots(seed ^ 0x1e, u, v, footprint, 0.27);
        color *= (1.0 + 0.38 * chips).max(0.25);
        if self.bays > 0 {
            color = self.with_trim(color, u, v, footprint);
        }
        self.with_posters(color, u, v, footprint)
    }

    fn masonry_albedo(&self, masonry: Masonry, u: f32, v: f32, footprint: f32) -> Rgb {
        let (length, height, joint, tint_range) = match masonry {
            Masonry::Brick => (0.32, 0.115, 0.016, 0.5),
            Masonry::Ashlar => (0.72, 0.36, 0.02, 0.28),
            Masonry::Rubble => (0.42, 0.26, 0.045, 0.6),
            Masonry::Plaster => {
                let grain = octaves(self.seed ^ 0x77, u, v, footprint, 0.5, 6, 0.85);
                return self.base * (1.05 + 0.1 * grain).max(0.3);
            }
        };
        let (mut x, mut y) = (u, v);
        if masonry == Masonry::Rubble {
            x += 0.09 * value_noise(self.seed ^ 0x31, u * 3.1, v * 3.1);
            y += 0.07 * value_noise(self.seed ^ 0x32, u * 2.7, v * 2.7);
        }
        let row = (y / height).floor();
        let shifted = x / length + 0.5 * (row as i32 & 1) as f32;
        let column = shifted.floor();
        let tint = uniform(self.seed ^ 0x33, column as i32, row as i32) - 0.5;
        let hue = uniform(self.seed ^ 0x34, column as i32, row as i32) - 0.5;
        let (fx, fy) = ((shifted - column) * length, y - row * height);
        let gap = joint / 2.0;
        let inside =
            filtered_band(gap, length - gap, fx, footprint) * filtered_band(gap, height - gap, fy, footprint);
        let visible = resolved(height, footprint);
        let reddish = if masonry == Masonry::Brick {
            Rgb::new(0.52, 0.27, 0.19) * 0.6 + self.base * 0.4
        } else {
            self.base
        };
        let shade = 1.0 + visible * tint_range * tint;
        let stone =
            reddish.component_mul(&Rgb::new(1.0 + 0.2 * hue * visible, 1.0, 1.0 - 0.2 * hue * visible))
                * shade;
        let mortar = Rgb::new(0.52, 0.49, 0.44);
        let mean_cover = (1.0 - joint / length) * (1.0 - joint / height);
        let cover = visible * inside + (1.0 - visible) * mean_cover;
        let grain = octaves(self.seed ^ 0x35, u, v, footprint, 0.14, 3, 0.8);
        (mortar + (stone - mortar) * cover) * (1.0 + 0.1 * grain)
    }

    /// Frames round the openings, the plinth and the string course.
    fn with_trim(&self, color: Rgb, u: f32, v: f32, footprint: f32) -> Rgb {
        let (floor, bay) = self.cell(u, v);
        let mut cover = 0.0_f32;
        if let Some(o) = self.opening_of(floor, bay) {
            let frame = 0.13;
            cover = filtered_band(o.left - frame, o.right + frame, u, footprint)
                * filtered_band(o.bottom - frame, o.top + frame, v, footprint);
        }
        cover = cover.max(1.0 - filtered_step(0.45, v, footprint));
        let edge = u.min(self.width - u);
        let quoin = if (v / 0.42) as i32 & 1 == 0 { 0.55 } else { 0.35 };
        cover = cover.max(1.0 - filtered_step(quoin, edge, footprint));
        if cover == 0.0 {
            return color;
        }
        let wear = octaves(self.seed ^ 0xe5, u, v, footprint, 0.6, 5, 0.8);
        let block = uniform(self.seed ^ 0xe6, (u / 0.6) as i32, (v / 0.42) as i32) - 0.5;
        let trim = self.trim * (1.0 + 0.13 * wear + 0.16 * block * resolved(0.42, footprint)).max(0.3);
        color + (trim - color) * cover
    }

    /// Bills and scrawls on the lower wall, each unlike the others.
    fn with_posters(&self, color: Rgb, u: f32, v: f32, footprint: f32) -> Rgb {
        if !(0.5..3.2).contains(&v) {
            return color;
        }
        let (column, row) = ((u / 1.35).floor(), ((v - 0.5) / 1.35).floor());
        let seed = hash(self.seed ^ 0xf6, column as i32, row as i32);
        let chance = uniform(seed, 0, 0);
        if chance > 0.55 {
            return color;
        }
        let (x, y) = (u - column * 1.35, v - 0.5 - row * 1.35);
        let (width, height) = (0.45 + 0.6 * uniform(seed, 1, 0), 0.5 + 0.6 * uniform(seed, 2, 0));
        let (left, bottom) = ((1.3 - width) * uniform(seed, 3, 0), (1.3 - height) * uniform(seed, 4, 0));
        if chance < 0.2 {
            let swirl = octaves(seed, x + 0.1 * y, y, footprint, 0.4, 3, 0.6).abs();
            let inside =
                filtered_band(left, left + width, x, 0.05) * filtered_band(bottom, bottom + height, y, 0.05);
            let ink = inside * (1.0 - filtered_step(0.13, swirl, 0.06 + footprint));
            return color + (vivid(seed ^ 9) - color) * ink;
        }
        let cover = filtered_band(left, left + width, x, footprint)
            * filtered_band(bottom, bottom + height, y, footprint);
        if cover == 0.0 {
            return color;
        }
        color + (bill(seed, x - left, y - bottom, footprint) - color) * cover
    }

    /// Colour at the back of a recess; `u`, `v` on the façade.
    pub fn pane_albedo(&self, opening: &Opening, u: f32, v: f32, footprint: f32) -> Rgb {
        let (x, y) = (u - opening.left, v - opening.bottom);
        let (width, height) = (opening.right - opening.left, opening.top - opening.bottom);
        let seed = opening.seed;
        match opening.kind {
            OpeningKind::Door => {
                let panel = filtered_band(0.15, width - 0.15, x, footprint)
                    * (filtered_band(0.2, 1.0, y, footprint) + filtered_band(1.15, 2.0, y, footprint));
                let wood = vivid(seed)
                    * 0.45
                    * (1.0 + 0.2 * octaves(seed, x * 6.0, y, footprint * 3.0, 0.8, 5, 0.8));
                wood * (1.0 - 0.3 * panel)
            }
            OpeningKind::Shop => {
                let frame = 1.0
                    - filtered_band(0.08, width - 0.08, x, footprint)
                        * filtered_band(0.08, height - 0.08, y, footprint);
                let shelf = (y / 0.42).floor();
                let place = (x / 0.27).floor();
                let good = hash(seed, place as i32, shelf as i32);
                let (gx, gy) = (x - place * 0.27, y - shelf * 0.42);
                let tall = 0.12 + 0.25 * uniform(good, 0, 1);
                let cover =
                    filtered_band(0.03, 0.24, gx, footprint) * filtered_band(0.02, tall, gy, footprint);
                let back =
                    Rgb::new(0.09, 0.085, 0.08) * (1.0 + 0.5 * octaves(seed, x, y, footprint, 0.7, 4, 0.7));
                let shown = bill(good, gx, gy, footprint) * 0.7;
                let inside = back + (shown - back) * cover;
                inside + (vivid(self.seed) * 0.5 - inside) * frame
            }
            OpeningKind::Window => {
                let frame = 1.0
                    - filtered_band(0.07, width - 0.07, x, footprint)
                        * filtered_band(0.07, height - 0.07, y, footprint);
                let bars = filtered_band(width / 2.0 - 0.03, width / 2.0 + 0.03, x, footprint)
                    .max(filtered_band(height * 0.66 - 0.025, height * 0.66 + 0.025, y, footprint));
                let drawn = 0.12 + 0.36 * uniform(seed, 3, 3);
                let side = if x < width / 2.0 { x } else { width - x } / width;
                let folds = value_noise(seed, x * 14.0, y * 0.8) * resolved(0.07, footprint);
                let curtain_color = vivid(seed ^ 5) * 0.3 + Rgb::repeat(0.3);
                let curtain = curtain_color
                    * (0.8 + 0.3 * folds + 0.2 * octaves(seed ^ 6, x, y, footprint, 0.5, 4, 0.7));
                let room = Rgb::new(0.07, 0.075, 0.085)
                    * (1.0 + 0.6 * octaves(seed ^ 7, x, y, footprint, 0.6, 4, 0.7));
                let inside = room + (curtain - room) * (1.0 - filtered_step(drawn, side, footprint / width));
                let wood = self.trim * 0.95;
                inside + (wood - inside) * frame.max(bars)
            }
        }
    }
}

/// A saturated colour from a seed.
pub fn vivid(seed: u32) -> Rgb {
    let hue = uniform(seed, 7, 7) * 6.0;
    let channel = |offset: f32| {
        let t = (hue + offset) % 6.0;
        0.15 + 0.55 * ((t - 3.0).abs() - 1.0).clamp(0.0, 1.0)
    };
    Rgb::new(channel(0.0), channel(2.0), channel(4.0))
}

/// A printed bill: two-colour ground, blobs and lines of letters; coordinates in metres from its lower left.
pub fn bill(seed: u32, x: f32, y: f32, footprint: f32) -> Rgb {
    let blob = octaves(seed ^ 1, x, y, footprint, 0.35, 4, 0.6);
    let ground = vivid(seed ^ 2) * 0.5 + Rgb::repeat(0.4);
    let mut color = ground + (vivid(seed ^ 3) - ground) * filtered_step(0.12, blob, 0.05 + footprint);
    let (size_x, size_y) = (0.05, 0.075);
    let (i, j) = ((x / size_x).floor(), (y / size_y).floor());
    if hash(seed ^ 4, 0, j as i32).is_multiple_of(3) {
        let ink = glyph(hash(seed ^ 8, i as i32, j as i32), x / size_x - i, y / size_y - j);
        let visible = resolved(size_x, footprint);
        color *= 1.0 - 0.8 * (visible * f32::from(u8::from(ink)) + (1.0 - visible) * 0.3);
    }
    color
}

/// Whether a made-up letter has ink at a place of its unit square.
pub fn glyph(letter: u32, x: f32, y: f32) -> bool {
    let (column, row) = ((x * 4.0) as u32, (y * 6.0) as u32);
    column < 3 && (1..6).contains(&row) && (letter >> (column + 3 * (row - 1))) & 1 == 1
}
