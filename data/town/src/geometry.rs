//! The solids of the town and where a ray first meets them.

use nalgebra::Vector3;

use crate::facade::{Facade, Opening};
use crate::material::Material;

/// A half-line in the world frame; `inverse` is the component-wise reciprocal of the direction.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    pub origin: Vector3<f64>,
    pub direction: Vector3<f64>,
    pub inverse: Vector3<f64>,
}

impl Ray {
    pub fn new(origin: Vector3<f64>, direction: Vector3<f64>) -> Self {
        Self { origin, direction, inverse: direction.map(|component| 1.0 / component) }
    }

    pub fn at(&self, distance: f64) -> Vector3<f64> {
        self.origin + self.direction * distance
    }
}

/// An axis-aligned box.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    pub min: Vector3<f64>,
    pub max: Vector3<f64>,
}

impl Bounds {
    pub fn new(min: [f64; 3], max: [f64; 3]) -> Self {
        Self { min: min.into(), max: max.into() }
    }

    pub fn union(&self, other: &Self) -> Self {
        Self { min: self.min.inf(&other.min), max: self.max.sup(&other.max) }
    }

    pub fn center(&self) -> Vector3<f64> {
        (self.min + self.max) / 2.0
    }

    /// Entry and exit distance of a ray's line, and the axis of the entry plane; `None` when the line misses.
    pub fn slabs(&self, ray: &Ray) -> Option<(f64, f64, usize)> {
        let (mut enter, mut exit, mut axis) = (f64::NEG_INFINITY, f64::INFINITY, 0);
        for k in 0..3 {
            let a = (self.min[k] - ray.origin[k]) * ray.inverse[k];
            let b = (self.max[k] - ray.origin[k]) * ray.inverse[k];
            let (near, far) = if a < b { (a, b) } else { (b, a) };
            if near > enter {
                (enter, axis) = (near, k);
            }
            exit = exit.min(far);
        }
        (enter <= exit && exit > 0.0).then_some((enter, exit, axis))
    }
}

/// Which part of a solid a ray met.
#[derive(Debug, Clone, Copy)]
pub enum Part {
    /// The outside; for boxes the face: 0 to 5 for −x, +x, −y, +y, −z, +z.
    Face(u8),
    /// The side of a recess in a façade.
    Reveal(u8, Opening),
    /// The back of a recess: glass, door leaf or shop window.
    Pane(u8, Opening),
}

/// The first meeting of a ray and a solid.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Distance along the ray in metres (directions are unit vectors).
    pub distance: f64,
    /// Unit normal towards the ray's origin.
    pub normal: Vector3<f64>,
    /// Index of the solid.
    pub solid: u32,
    /// Part of the solid.
    pub part: Part,
}

/// The shapes solids have.
#[derive(Debug, Clone)]
pub enum Shape {
    /// A building: a box with a façade on each of its sides −x, +x, −y, +y.
    Building(Bounds, Box<[Facade; 4]>),
    /// An axis-aligned box.
    Cuboid(Bounds),
    /// A gable roof filling a box, its ridge along x or y at the top.
    Gable { bounds: Bounds, ridge_along_x: bool },
    /// A vertical cylinder.
    Cylinder { base: Vector3<f64>, radius: f64, height: f64 },
    /// A sphere.
    Sphere { center: Vector3<f64>, radius: f64 },
    /// A thin vertical or sloped parallelogram seen from both sides, with bars to look through when `railing`.
    Panel { origin: Vector3<f64>, along: Vector3<f64>, up: Vector3<f64>, railing: bool },
}

/// A shape and what it is made of.
#[derive(Debug, Clone)]
pub struct Solid {
    pub shape: Shape,
    pub material: Material,
}

/// Position on a façade: metres along it and metres above the ground.
pub fn facade_place(bounds: &Bounds, face: u8, point: &Vector3<f64>) -> (f32, f32) {
    let along = if face < 2 { point.y - bounds.min.y } else { point.x - bounds.min.x };
    (along as f32, point.z as f32)
}

/// Outward unit normal of a box face.
pub fn face_normal(face: u8) -> Vector3<f64> {
    let mut normal = Vector3::zeros();
    normal[usize::from(face / 2)] = if face.is_multiple_of(2) { -1.0 } else { 1.0 };
    normal
}

const NEAREST: f64 = 1e-6;

impl Shape {
    pub fn bounds(&self) -> Bounds {
        match self {
            Self::Building(bounds, _) | Self::Cuboid(bounds) | Self::Gable { bounds, .. } => *bounds,
            Self::Cylinder { base, radius, height } => {
                let side = Vector3::new(*radius, *radius, 0.0);
                Bounds { min: base - side, max: base + side + Vector3::z() * *height }
            }
            Self::Sphere { center, radius } => {
                let half = Vector3::repeat(*radius);
                Bounds { min: center - half, max: center + half }
            }
            Self::Panel { origin, along, up, .. } => {
                let corners = [*origin, origin + along, origin + up, origin + along + up];
                let slack = Vector3::repeat(1e-6);
                let (min, max) = corners.iter().fold((*origin, *origin), |(a, b), c| (a.inf(c), b.sup(c)));
                Bounds { min: min - slack, max: max + slack }
            }
        }
    }

    /// Where a ray from outside first meets this shape nearer than `limit`.
    pub fn intersect(&self, ray: &Ray, limit: f64, solid: u32) -> Option<Hit> {
        match self {
            Self::Building(bounds, facades) => {
                let hit = intersect_box(bounds, ray, limit, solid)?;
                let Part::Face(face @ 0..4) = hit.part else { return Some(hit) };
                let (u, v) = facade_place(bounds, face, &ray.at(hit.distance));
                match facades[usize::from(face)].opening(u, v) {
                    Some(opening) => {
                        intersect_recess(bounds, ray, &hit, face, &opening).filter(|h| h.distance < limit)
                    }
                    None => Some(hit),
                }
            }
            Self::Cuboid(bounds) => intersect_box(bounds, ray, limit, solid),
            Self::Gable { bounds, ridge_along_x } => {
                intersect_gable(bounds, *ridge_along_x, ray, limit, solid)
            }
            Self::Cylinder { base, radius, height } => {
                let offset = ray.origin - base;
                let a = ray.direction.x.powi(2) + ray.direction.y.powi(2);
                let b = offset.x * ray.direction.x + offset.y * ray.direction.y;
                let c = offset.x.powi(2) + offset.y.powi(2) - radius * radius;
                let discriminant = b * b - a * c;
                if discriminant < 0.0 || a == 0.0 {
                    return None;
                }
                let distance = (-b - discriminant.sqrt()) / a;
                let z = offset.z + distance * ray.direction.z;
                (distance > NEAREST && distance < limit && (0.0..=*height).contains(&z)).then(|| {
                    let out = offset + ray.direction * distance;
                    Hit {
                        distance,
                        normal: Vector3::new(out.x, out.y, 0.0) / *radius,
                        solid,
                        part: Part::Face(0),
                    }
                })
            }
            Self::Sphere { center, radius } => {
                let offset = ray.origin - center;
                let b = offset.dot(&ray.direction);
                let discriminant = b * b - offset.norm_squared() + radius * radius;
                if discriminant < 0.0 {
                    return None;
                }
                let distance = -b - discriminant.sqrt();
                (distance > NEAREST && distance < limit).then(|| Hit {
                    distance,
                    normal: (offset + ray.direction * distance) / *radius,
                    solid,
                    part: Part::Face(0),
                })
            }
            Self::Panel { origin, along, up, railing } => {
                let normal = along.cross(up).normalize();
                let slope = normal.dot(&ray.direction);
                let distance = normal.dot(&(origin - ray.origin)) / slope;
                if !(distance > NEAREST && distance < limit) {
                    return None;
                }
                let place = ray.at(distance) - origin;
                let (u, v) = (place.dot(along) / along.norm_squared(), place.dot(up) / up.norm_squared());
                let is_inside = (0.0..=1.0).contains(&u) && (0.0..=1.0).contains(&v);
                let is_gap = *railing && {
                    let (x, y) = (u * along.norm(), v * up.norm());
                    (x / 0.13).fract() > 0.28 && y > 0.06 && y < up.norm() - 0.07
                };
                (is_inside && !is_gap).then(|| Hit {
                    distance,
                    normal: if slope > 0.0 { -normal } else { normal },
                    solid,
                    part: Part::Face(0),
                })
            }
        }
    }
}

fn intersect_box(bounds: &Bounds, ray: &Ray, limit: f64, solid: u32) -> Option<Hit> {
    let (enter, _, axis) = bounds.slabs(ray)?;
    (enter > NEAREST && enter < limit).then(|| {
        let face = 2 * axis as u8 + u8::from(ray.direction[axis] < 0.0);
        Hit { distance: enter, normal: face_normal(face), solid, part: Part::Face(face) }
    })
}

/// The box that an opening cuts into its building.
fn recess(bounds: &Bounds, face: u8, opening: &Opening) -> Bounds {
    let (normal_axis, along_axis) = if face < 2 { (0, 1) } else { (1, 0) };
    let mut cut = *bounds;
    cut.min[along_axis] = bounds.min[along_axis] + f64::from(opening.left);
    cut.max[along_axis] = bounds.min[along_axis] + f64::from(opening.right);
    (cut.min.z, cut.max.z) = (f64::from(opening.bottom), f64::from(opening.top));
    if face.is_multiple_of(2) {
        cut.max[normal_axis] = bounds.min[normal_axis] + f64::from(opening.depth);
    } else {
        cut.min[normal_axis] = bounds.max[normal_axis] - f64::from(opening.depth);
    }
    cut
}

/// Follows a ray that entered through an opening to the recess's side or back.
fn intersect_recess(bounds: &Bounds, ray: &Ray, entry: &Hit, face: u8, opening: &Opening) -> Option<Hit> {
    let cut = recess(bounds, face, opening);
    let mut exit = (f64::INFINITY, 0);
    for axis in 0..3 {
        let wall = if ray.direction[axis] > 0.0 { cut.max[axis] } else { cut.min[axis] };
        let distance = (wall - ray.origin[axis]) * ray.inverse[axis];
        if distance < exit.0 {
            exit = (distance, axis);
        }
    }
    let (distance, axis) = exit;
    let is_back = axis == usize::from(face / 2);
    let mut normal = Vector3::zeros();
    normal[axis] = -ray.direction[axis].signum();
    distance.is_finite().then_some(Hit {
        distance: distance.max(entry.distance),
        normal,
        solid: entry.solid,
        part: if is_back { Part::Pane(face, *opening) } else { Part::Reveal(face, *opening) },
    })
}

/// Where a ray from inside a recess leaves the façade plane, or `None` when it meets the recess's sides.
pub fn leave_recess(bounds: &Bounds, ray: &Ray, face: u8, opening: &Opening) -> Option<Vector3<f64>> {
    let axis = usize::from(face / 2);
    let plane = if face.is_multiple_of(2) { bounds.min[axis] } else { bounds.max[axis] };
    let distance = (plane - ray.origin[axis]) * ray.inverse[axis];
    if distance < 0.0 || !distance.is_finite() {
        return None;
    }
    let exit = ray.at(distance);
    let (u, v) = facade_place(bounds, face, &exit);
    let is_open = (opening.left..=opening.right).contains(&u) && (opening.bottom..=opening.top).contains(&v);
    is_open.then_some(exit + face_normal(face) * 1e-4)
}

fn intersect_gable(bounds: &Bounds, ridge_along_x: bool, ray: &Ray, limit: f64, solid: u32) -> Option<Hit> {
    let (ridge, across) = if ridge_along_x { (0, 1) } else { (1, 0) };
    let half = (bounds.max[across] - bounds.min[across]) / 2.0;
    let rise = bounds.max.z - bounds.min.z;
    let slant = half.hypot(rise);
    let mut planes = [(Vector3::zeros(), Vector3::zeros()); 5];
    for (k, side) in [-1.0, 1.0].into_iter().enumerate() {
        let corner =
            if side < 0.0 { bounds.min } else { Vector3::new(bounds.max.x, bounds.max.y, bounds.min.z) };
        let mut slope = Vector3::zeros();
        slope[across] = side * rise / slant;
        slope.z = half / slant;
        planes[k] = (slope, corner);
        let mut end = Vector3::zeros();
        end[ridge] = side;
        planes[2 + k] = (end, corner);
    }
    planes[4] = (-Vector3::z(), bounds.min);
    let (mut enter, mut exit, mut normal) = (f64::NEG_INFINITY, f64::INFINITY, Vector3::zeros());
    for (plane_normal, corner) in planes {
        let slope = plane_normal.dot(&ray.direction);
        let distance = plane_normal.dot(&(corner - ray.origin)) / slope;
        if slope < 0.0 {
            if distance > enter {
                (enter, normal) = (distance, plane_normal);
            }
        } else if slope > 0.0 {
            exit = exit.min(distance);
        } else if plane_normal.dot(&(corner - ray.origin)) < 0.0 {
            return None;
        }
    }
    (enter > NEAREST && enter < limit && enter <= exit).then_some(Hit {
        distance: enter,
        normal,
        solid,
        part: Part::Face(0),
    })
}
