//! Where streets, buildings and things in the street stand, and the ways the cameras take.
//!
//! Blocks stand on a grid: main streets run north–south, cobbled lanes east–west. The panoramas start in the main street
//! just south of a lane and go away from it, south and then up and down the streets further west, so that the lane east
//! of the start stays unseen however long the route is. The photos turn into that lane.

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::facade::{Facade, OpeningKind};
use crate::geometry::{Bounds, Shape, Solid, face_normal};
use crate::light::Rgb;
use crate::material::Material;
use crate::params::TownParams;

const STREET_WIDTH: f64 = 14.0;
const LANE_WIDTH: f64 = 7.0;
const BLOCK_EAST: f64 = 46.0;
const BLOCK_NORTH: f64 = 45.0;
const PITCH_EAST: f64 = BLOCK_EAST + STREET_WIDTH;
const PITCH_NORTH: f64 = BLOCK_NORTH + LANE_WIDTH;
/// South edge of the lane that the photos turn into.
const LANE_SOUTH: f64 = 38.0;
/// Middle of the lane one block further south, where the route turns west.
const FIRST_TURN: f64 = LANE_SOUTH + LANE_WIDTH / 2.0 - PITCH_NORTH;
const BUILDING_DEPTH: f64 = 11.0;
/// Nothing but the ground comes nearer to a camera than this.
const CLEARANCE: f64 = 2.2;

/// The photos' way: east, north, heading clockwise from north in degrees.
const PHOTO_WAY: [[f64; 3]; 8] = [
    [-3.2, 29.2, 60.0],
    [-2.4, 31.1, 54.0],
    [-1.4, 33.0, 52.0],
    [-0.1, 34.9, 55.0],
    [1.7, 36.7, 62.0],
    [3.8, 38.3, 75.0],
    [6.2, 39.8, 95.0],
    [9.0, 41.0, 117.0],
];

/// Where a camera stands and looks: metres and radians; heading clockwise from north.
#[derive(Debug, Clone, Copy)]
pub struct Standpoint {
    pub center: Vector3<f64>,
    pub heading: f64,
    pub pitch: f64,
    pub roll: f64,
}

/// Whether a place of the ground is in a lane, and its distance from the middle of its street.
pub fn street_at(x: f64) -> (bool, f64) {
    let across = (x + PITCH_EAST / 2.0).rem_euclid(PITCH_EAST) - PITCH_EAST / 2.0;
    (across.abs() > STREET_WIDTH / 2.0, across)
}

/// Standpoints of all panoramas.
pub fn panorama_way(params: &TownParams) -> Vec<Standpoint> {
    let corners = route(params.panorama_step_m * params.panoramas as f64);
    (0..params.panoramas)
        .map(|k| {
            let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
            rng.set_stream(1_000 + k as u64);
            let (place, direction) =
                along(&corners, params.panorama_step_m * (k as f64 + rng.random_range(-0.08..0.08)));
            let side = Vector3::new(direction.y, -direction.x, 0.0) * rng.random_range(-0.7..0.7);
            Standpoint {
                center: place + side + Vector3::z() * rng.random_range(2.42..2.58),
                heading: direction.x.atan2(direction.y) + rng.random_range(-0.5..0.5),
                pitch: rng.random_range(-0.025..0.025),
                roll: rng.random_range(-0.025..0.025),
            }
        })
        .collect()
}

/// Corners of a route of at least this length: south, then up and down the streets further west.
fn route(length: f64) -> Vec<Vector3<f64>> {
    let rows = (length / 700.0).ceil().clamp(1.0, 8.0);
    let (top, bottom) = (FIRST_TURN, FIRST_TURN - rows * PITCH_NORTH);
    let mut corners = vec![Vector3::new(0.0, 35.0, 0.0), Vector3::new(0.0, bottom, 0.0)];
    let mut covered = 35.0 - bottom;
    let (mut x, mut goes_north) = (0.0, true);
    while covered < length + 2.0 * PITCH_EAST {
        x -= PITCH_EAST;
        let (start, end) = if goes_north { (bottom, top) } else { (top, bottom) };
        corners.push(Vector3::new(x, start, 0.0));
        corners.push(Vector3::new(x, end, 0.0));
        covered += PITCH_EAST + top - bottom;
        goes_north = !goes_north;
    }
    corners
}

/// Place and unit direction at a distance along a polyline.
fn along(corners: &[Vector3<f64>], distance: f64) -> (Vector3<f64>, Vector3<f64>) {
    let mut rest = distance;
    for (k, pair) in corners.windows(2).enumerate() {
        let leg = pair[1] - pair[0];
        let length = leg.norm();
        if rest <= length || k + 2 == corners.len() {
            return (pair[0] + leg * (rest / length), leg / length);
        }
        rest -= length;
    }
    (Vector3::zeros(), Vector3::y())
}

/// Standpoints of the photos; the last one is the target.
pub fn photo_way(params: &TownParams) -> Vec<Standpoint> {
    (0..params.photos)
        .map(|k| {
            let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
            rng.set_stream(100_000 + k as u64);
            let last = (PHOTO_WAY.len() - 1) as f64;
            let s = if params.photos == 1 { last } else { last * k as f64 / (params.photos - 1) as f64 };
            let from = (s.floor() as usize).min(PHOTO_WAY.len() - 2);
            let [x, y, heading]: [f64; 3] = std::array::from_fn(|c| {
                PHOTO_WAY[from][c] + (s - from as f64) * (PHOTO_WAY[from + 1][c] - PHOTO_WAY[from][c])
            });
            Standpoint {
                center: Vector3::new(x, y, rng.random_range(1.55..1.75)),
                heading: heading.to_radians() + rng.random_range(-0.02..0.02),
                pitch: rng.random_range(0.03..0.09),
                roll: rng.random_range(-0.03..0.03),
            }
        })
        .collect()
}

/// All solids of the town.
pub fn solids(params: &TownParams, standpoints: &[Standpoint]) -> Vec<Solid> {
    let (mut west, mut south) = (0.0_f64, 0.0_f64);
    for standpoint in standpoints {
        west = west.min(standpoint.center.x);
        south = south.min(standpoint.center.y);
    }
    let columns = ((west / PITCH_EAST).floor() as i64 - 1)..=1;
    let rows = ((south / PITCH_NORTH).floor() as i64 - 1)..=1;
    let mut builder = Builder { solids: Vec::new(), standpoints };
    for column in columns {
        for row in rows.clone() {
            // A block's look depends on its place only, so a longer route extends the town and changes nothing of it.
            let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
            rng.set_stream(1 << 40 | ((column + 4096) as u64) << 16 | (row + 4096) as u64);
            builder.block(&mut rng, column, row);
        }
    }
    let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
    rng.set_stream(1 << 50);
    // The lane of the photos is a dead end.
    builder.building(
        &mut rng,
        [33.0, LANE_SOUTH],
        [43.0, LANE_SOUTH + LANE_WIDTH],
        [true, true, false, false],
    );
    builder.solids
}

struct Builder<'a> {
    solids: Vec<Solid>,
    standpoints: &'a [Standpoint],
}

impl Builder<'_> {
    fn cuboid(&mut self, min: [f64; 3], max: [f64; 3], material: Material) {
        self.solids.push(Solid { shape: Shape::Cuboid(Bounds::new(min, max)), material });
    }

    fn is_clear(&self, x: f64, y: f64) -> bool {
        self.standpoints.iter().all(|s| (s.center.x - x).hypot(s.center.y - y) > CLEARANCE)
    }

    fn block(&mut self, rng: &mut ChaCha8Rng, column: i64, row: i64) {
        let x0 = STREET_WIDTH / 2.0 + column as f64 * PITCH_EAST;
        let y0 = LANE_SOUTH + LANE_WIDTH + (row - 1) as f64 * PITCH_NORTH;
        let (x1, y1) = (x0 + BLOCK_EAST, y0 + BLOCK_NORTH);
        let kerb = 0.12;
        self.cuboid([x0 - 2.4, y0 - 0.9, -0.1], [x1 + 2.4, y1 + 0.9, kerb], Material::Pavement(rng.random()));
        let lots = cuts(rng, y0, y1);
        for (k, lot) in lots.windows(2).enumerate() {
            let (is_first, is_last) = (k == 0, k + 2 == lots.len());
            self.building(rng, [x0, lot[0]], [x0 + BUILDING_DEPTH, lot[1]], [true, false, is_first, is_last]);
        }
        let lots = cuts(rng, y0, y1);
        for (k, lot) in lots.windows(2).enumerate() {
            let (is_first, is_last) = (k == 0, k + 2 == lots.len());
            self.building(rng, [x1 - BUILDING_DEPTH, lot[0]], [x1, lot[1]], [false, true, is_first, is_last]);
        }
        for is_north in [false, true] {
            let (low, high) = if is_north { (y1 - BUILDING_DEPTH, y1) } else { (y0, y0 + BUILDING_DEPTH) };
            for lot in cuts(rng, x0 + BUILDING_DEPTH, x1 - BUILDING_DEPTH).windows(2) {
                self.building(rng, [lot[0], low], [lot[1], high], [false, false, !is_north, is_north]);
            }
        }
        for (kerb_x, inward) in [(x0 - 2.0, -1.0), (x1 + 2.0, 1.0)] {
            let mut y = y0 + rng.random_range(1.0..4.0);
            while y < y1 - 2.0 {
                self.furniture(rng, kerb_x, y, inward);
                y += rng.random_range(4.5..8.0);
            }
        }
    }

    /// Something that stands at a kerb: tree, lamp, column, car, kiosk or crates; `outward` points to the street.
    fn furniture(&mut self, rng: &mut ChaCha8Rng, x: f64, y: f64, outward: f64) {
        let choice = rng.random_range(0..10);
        let seed: u32 = rng.random();
        let jitter: [f64; 8] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let base = Vector3::new(x, y, 0.1);
        match choice {
            0..=1 if self.is_clear(x, y) => {
                let height = 3.2 + 0.5 * jitter[0];
                let shape = Shape::Cylinder { base, radius: 0.13, height };
                self.solids.push(Solid { shape, material: Material::Bark(seed) });
                for k in 0..7 {
                    let turn = f64::from(k) * 2.4 + jitter[1];
                    let reach = if k == 0 { 0.0 } else { 0.8 };
                    let lift = height + 0.5 + 0.35 * f64::from(k % 3);
                    let center = base + Vector3::new(reach * turn.cos(), reach * turn.sin(), lift);
                    let shape = Shape::Sphere { center, radius: 0.75 + 0.15 * jitter[k as usize] };
                    self.solids.push(Solid { shape, material: Material::Foliage(seed.wrapping_add(k)) });
                }
            }
            2..=3 if self.is_clear(x, y) => {
                let iron = Material::Iron(seed);
                self.solids.push(Solid {
                    shape: Shape::Cylinder { base, radius: 0.12, height: 0.9 },
                    material: iron,
                });
                self.solids.push(Solid {
                    shape: Shape::Cylinder { base, radius: 0.06, height: 4.2 },
                    material: iron,
                });
                let pale = Material::Stone(Rgb::new(0.75, 0.74, 0.66), seed);
                self.cuboid([x - 0.18, y - 0.18, 4.25], [x + 0.18, y + 0.18, 4.7], pale);
                self.cuboid([x - 0.25, y - 0.25, 4.7], [x + 0.25, y + 0.25, 4.78], iron);
            }
            4 if self.is_clear(x, y) => {
                let pillar = Shape::Cylinder { base, radius: 0.55, height: 2.6 };
                self.solids.push(Solid { shape: pillar, material: Material::Bills(seed) });
                let cap = Shape::Cylinder { base: base + Vector3::z() * 2.6, radius: 0.68, height: 0.25 };
                self.solids.push(Solid { shape: cap, material: Material::Iron(seed) });
            }
            5..=7 => {
                let middle = x + outward * 1.5;
                if self.is_clear(middle, y - 1.5) && self.is_clear(middle, y + 1.5) {
                    let (half, long) = (0.85, 2.0 + 0.2 * jitter[0]);
                    let paint = Material::Paint(seed);
                    self.cuboid([middle - half, y - long, 0.28], [middle + half, y + long, 0.85], paint);
                    self.cuboid(
                        [middle - 0.75, y - 1.2, 0.85],
                        [middle + 0.75, y + 1.0, 1.35],
                        Material::Glass(seed),
                    );
                    self.cuboid([middle - 0.78, y - 1.1, 1.35], [middle + 0.78, y + 0.9, 1.43], paint);
                    for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                        let (wx, wy) = (middle + sx * 0.72, y + sy * 1.25);
                        self.cuboid(
                            [wx - 0.14, wy - 0.3, 0.0],
                            [wx + 0.14, wy + 0.3, 0.58],
                            Material::Glass(seed ^ 1),
                        );
                    }
                }
            }
            8 if self.is_clear(x, y) => {
                self.cuboid([x - 0.5, y - 0.8, 0.1], [x + 0.5, y + 0.8, 2.3], Material::Bills(seed));
                self.cuboid([x - 0.7, y - 1.0, 2.3], [x + 0.7, y + 1.0, 2.42], Material::Paint(seed));
            }
            9 if self.is_clear(x, y) => {
                for k in 0..4 {
                    let (cx, cy) = (x + 0.25 * jitter[k], y - 0.9 + 0.6 * k as f64);
                    let top = 0.55 + 0.2 * jitter[k + 4];
                    let wood = Material::Stone(Rgb::new(0.42, 0.31, 0.2), seed.wrapping_add(k as u32));
                    self.cuboid([cx - 0.25, cy - 0.28, 0.1], [cx + 0.25, cy + 0.28, top], wood);
                }
            }
            _ => {}
        }
    }

    /// A building with windows on the sides (−x, +x, −y, +y) that face a street.
    fn building(&mut self, rng: &mut ChaCha8Rng, min: [f64; 2], max: [f64; 2], faces_street: [bool; 4]) {
        let storeys = rng.random_range(2..5);
        let seed: u32 = rng.random();
        let (size_x, size_y) = (max[0] - min[0], max[1] - min[1]);
        let main = Facade::draw(rng, size_y as f32, storeys, faces_street.iter().any(|&faces| faces));
        let facades: [Facade; 4] = std::array::from_fn(|face| {
            let width = if face < 2 { size_y } else { size_x } as f32;
            let mut facade = Facade { seed: rng.random(), width, ..main.clone() };
            let pitch = main.window_width + 1.2;
            facade.bays =
                if faces_street[face] { ((width - 0.8) / pitch).floor().max(1.0) as u32 } else { 0 };
            facade
        });
        let top = f64::from(main.top);
        let bounds = Bounds::new([min[0], min[1], 0.0], [max[0], max[1], top]);
        let trim = Material::Stone(main.trim, seed);
        for face in 0..4_u8 {
            if faces_street[usize::from(face)] {
                self.relief(rng, &bounds, face, &facades[usize::from(face)]);
            }
        }
        self.solids
            .push(Solid { shape: Shape::Building(bounds, Box::new(facades)), material: Material::Facade });
        let (x0, y0, x1, y1) = (min[0] - 0.3, min[1] - 0.3, max[0] + 0.3, max[1] + 0.3);
        if rng.random_bool(0.7) {
            let ridge_along_x = faces_street[2] || faces_street[3];
            let roof = Bounds::new([x0, y0, top], [x1, y1, top + rng.random_range(2.0..3.8)]);
            self.solids.push(Solid {
                shape: Shape::Gable { bounds: roof, ridge_along_x },
                material: Material::Tiles(seed),
            });
        } else {
            self.cuboid([x0, y0, top], [x1, y1, top + 0.25], trim);
        }
        for _ in 0..2 {
            let (cx, cy) =
                (rng.random_range(min[0] + 1.0..max[0] - 1.0), rng.random_range(min[1] + 1.0..max[1] - 1.0));
            let brick = Material::Stone(Rgb::new(0.45, 0.27, 0.2), rng.random());
            self.cuboid([cx - 0.35, cy - 0.45, top - 0.1], [cx + 0.35, cy + 0.45, top + 4.2], brick);
        }
    }

    /// Cornices, sills, balconies, signs and awnings of a façade.
    fn relief(&mut self, rng: &mut ChaCha8Rng, bounds: &Bounds, face: u8, facade: &Facade) {
        let width = f64::from(facade.width);
        let seed: u32 = rng.random();
        let trim = Material::Stone(facade.trim, seed);
        let solids = &mut self.solids;
        let mut ledge = |left: f64, right: f64, bottom: f64, top: f64, out: f64, material: Material| {
            let slab = ledge_bounds(bounds, face, [left, right, bottom, top], out);
            solids.push(Solid { shape: Shape::Cuboid(slab), material });
        };
        let top = f64::from(facade.top);
        ledge(0.0, width, top - 0.42, top - 0.2, 0.22, trim);
        ledge(0.0, width, top - 0.2, top, 0.42, trim);
        let ground = f64::from(facade.ground_floor);
        ledge(0.0, width, ground - 0.12, ground + 0.1, 0.12, trim);
        if rng.random_bool(0.75) {
            let (left, length) = (rng.random_range(0.3..width * 0.35), width * rng.random_range(0.3..0.6));
            ledge(left, left + length, ground - 0.85, ground - 0.3, 0.1, Material::Sign(rng.random()));
        }
        if rng.random_bool(0.6) {
            let place = rng.random_range(0.4..width - 0.5);
            ledge(place, place + 0.1, 2.9, 3.6, 0.85, Material::Bills(rng.random()));
        }
        let (mut balconies, mut awnings) = (Vec::new(), Vec::new());
        for floor in 0..=facade.floors {
            for bay in 0..facade.bays {
                let Some(opening) = facade.opening_of(floor, bay) else { continue };
                let (left, right) = (f64::from(opening.left), f64::from(opening.right));
                let (bottom, upper) = (f64::from(opening.bottom), f64::from(opening.top));
                match opening.kind {
                    OpeningKind::Window if floor > 0 && rng.random_bool(0.22) => {
                        ledge(left - 0.3, right + 0.3, bottom - 0.3, bottom - 0.14, 0.75, trim);
                        balconies.push((left - 0.3, right + 0.3, bottom - 0.14));
                    }
                    OpeningKind::Window => {
                        ledge(left - 0.12, right + 0.12, bottom - 0.09, bottom, 0.14, trim);
                        if floor > 0 {
                            ledge(left - 0.1, right + 0.1, upper + 0.08, upper + 0.2, 0.1, trim);
                        }
                    }
                    OpeningKind::Door => ledge(left - 0.2, right + 0.2, 0.0, 0.13, 0.35, trim),
                    OpeningKind::Shop => {
                        if rng.random_bool(0.45) {
                            awnings.push((left, right, upper + 0.12));
                        }
                    }
                }
            }
        }
        for (left, right, height) in awnings {
            let (origin, along, out) = frame(bounds, face, left, height, right - left);
            let shape = Shape::Panel { origin, along, up: out * 1.1 - Vector3::z() * 0.5, railing: false };
            self.solids.push(Solid { shape, material: Material::Cloth(rng.random()) });
        }
        for (left, right, bottom) in balconies {
            let (origin, along, out) = frame(bounds, face, left, bottom, right - left);
            let up = Vector3::z() * 0.95;
            for (origin, along) in
                [(origin + out * 0.7, along), (origin, out * 0.7), (origin + along, out * 0.7)]
            {
                let shape = Shape::Panel { origin, along, up, railing: true };
                self.solids.push(Solid { shape, material: Material::Iron(seed) });
            }
        }
    }
}

/// A point of a façade at `left`, `height`; the vector of `length` along it; its outward normal.
fn frame(
    bounds: &Bounds,
    face: u8,
    left: f64,
    height: f64,
    length: f64,
) -> (Vector3<f64>, Vector3<f64>, Vector3<f64>) {
    let mut origin = if face.is_multiple_of(2) { bounds.min } else { bounds.max };
    let axis = usize::from(face < 2);
    origin[axis] = bounds.min[axis] + left;
    origin.z = height;
    let mut along = Vector3::zeros();
    along[axis] = length;
    (origin, along, face_normal(face))
}

/// A box standing `out` metres out of a façade; extent is left, right, bottom, top.
fn ledge_bounds(bounds: &Bounds, face: u8, extent: [f64; 4], out: f64) -> Bounds {
    let [left, right, bottom, top] = extent;
    let (origin, along, normal) = frame(bounds, face, left, bottom, right - left);
    let far = origin + along + normal * out + Vector3::z() * (top - bottom);
    // A centimetre into the wall, so that no ray slips between.
    let near = origin - normal * 0.01;
    Bounds { min: near.inf(&far), max: near.sup(&far) }
}

/// Borders of lots of 6.5 to 10 metres that fill an interval.
fn cuts(rng: &mut ChaCha8Rng, low: f64, high: f64) -> Vec<f64> {
    let count = ((high - low) / 8.0).round().max(1.0);
    let step = (high - low) / count;
    let mut borders: Vec<f64> = (0..=count as usize).map(|k| low + step * k as f64).collect();
    for k in 1..borders.len() - 1 {
        borders[k] += rng.random_range(-0.12..0.12) * step;
    }
    borders
}
