//! Seeded problems with known truth, for tests and benches: scenes, cameras and rays, then noise and outliers.
//!
//! Everything is drawn from the whole sphere: directions behind a camera are as frequent as any other.

use nalgebra::{UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::robust::GeneralizedRay;
use crate::{Rigid, Similarity};

/// Origins, directions and points of `N` rays.
pub type RaySample<const N: usize> = ([Vector3<f64>; N], [Vector3<f64>; N], [Vector3<f64>; N]);

/// A generator whose seed is derived from a name, so that tests do not share their draws (FNV-1a).
pub fn seeded(name: &str) -> ChaCha8Rng {
    let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    ChaCha8Rng::seed_from_u64(hash)
}

/// A standard normal number (Box–Muller).
pub fn normal(rng: &mut impl Rng) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// A vector with independent standard normal entries.
pub fn normal_vector(rng: &mut impl Rng) -> Vector3<f64> {
    Vector3::new(normal(rng), normal(rng), normal(rng))
}

/// A direction uniform on the sphere.
pub fn random_unit(rng: &mut impl Rng) -> Vector3<f64> {
    loop {
        if let Some(unit) = normal_vector(rng).try_normalize(1e-6) {
            return unit;
        }
    }
}

/// A uniform rotation.
pub fn random_rotation(rng: &mut impl Rng) -> UnitQuaternion<f64> {
    let axis_free = nalgebra::Quaternion::new(normal(rng), normal(rng), normal(rng), normal(rng));
    UnitQuaternion::new_normalize(axis_free)
}

/// A unit vector turned by normal noise of `sigma` radians per tangent axis.
pub fn perturb(rng: &mut impl Rng, direction: &Vector3<f64>, sigma: f64) -> Vector3<f64> {
    let (u, v) = crate::solvers::tangent_basis(direction);
    (direction + (u * normal(rng) + v * normal(rng)) * sigma).normalize()
}

/// The angle between two rotations in radians.
pub fn rotation_angle(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
    let difference = a.inverse() * b;
    2.0 * difference.imag().norm().atan2(difference.w.abs())
}

/// Two views of points all around.
#[derive(Debug, Clone)]
pub struct RelativeProblem {
    /// Truth, translation of unit length.
    pub second_from_first: Rigid,
    /// Bearings in the first camera frame.
    pub first: Vec<Vector3<f64>>,
    /// Bearings in the second camera frame.
    pub second: Vec<Vector3<f64>>,
    /// Whether a pair is wrong.
    pub outlier: Vec<bool>,
}

impl RelativeProblem {
    /// Noise-free pairs of points at 0.5 to 8 baselines around the first camera.
    pub fn exact(rng: &mut impl Rng, count: usize) -> Self {
        let rotation = random_rotation(rng);
        Self::turned(rng, count, rotation)
    }

    /// The same where both y axes are vertical.
    pub fn upright(rng: &mut impl Rng, count: usize) -> Self {
        let angle = rng.random_range(-std::f64::consts::PI..std::f64::consts::PI);
        Self::turned(rng, count, UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle))
    }

    fn turned(rng: &mut impl Rng, count: usize, rotation: UnitQuaternion<f64>) -> Self {
        let second_from_first = Rigid::new(rotation, random_unit(rng));
        let (mut first, mut second) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for _ in 0..count {
            let bearing = random_unit(rng);
            let point = bearing * rng.random_range(0.5..8.0);
            first.push(bearing);
            second.push(second_from_first.transform_point(&point).normalize());
        }
        Self { second_from_first, first, second, outlier: vec![false; count] }
    }

    /// Adds noise of `sigma` radians per axis and replaces a fraction of the second bearings by random ones.
    pub fn disturb(&mut self, rng: &mut impl Rng, sigma: f64, outlier_fraction: f64) {
        let wrong = (outlier_fraction * self.first.len() as f64).round() as usize;
        for i in 0..self.first.len() {
            self.first[i] = perturb(rng, &self.first[i], sigma);
            self.outlier[i] = i < wrong;
            self.second[i] = if i < wrong { random_unit(rng) } else { perturb(rng, &self.second[i], sigma) };
        }
    }

    /// The first `N` pairs.
    ///
    /// # Panics
    /// When there are fewer.
    pub fn sample<const N: usize>(&self) -> ([Vector3<f64>; N], [Vector3<f64>; N]) {
        (std::array::from_fn(|i| self.first[i]), std::array::from_fn(|i| self.second[i]))
    }
}

/// One camera that sees points all around.
#[derive(Debug, Clone)]
pub struct AbsoluteProblem {
    /// Truth.
    pub world_from_camera: Rigid,
    /// Bearings in the camera frame.
    pub bearings: Vec<Vector3<f64>>,
    /// Points in the world.
    pub points: Vec<Vector3<f64>>,
    /// Whether a bearing is wrong.
    pub outlier: Vec<bool>,
}

impl AbsoluteProblem {
    /// Noise-free bearings of points at distances of 1 to 10.
    pub fn exact(rng: &mut impl Rng, count: usize) -> Self {
        let world_from_camera = Rigid::new(random_rotation(rng), normal_vector(rng) * 5.0);
        let bearings: Vec<_> = (0..count).map(|_| random_unit(rng)).collect();
        let points = bearings
            .iter()
            .map(|bearing| world_from_camera.transform_point(&(bearing * rng.random_range(1.0..10.0))))
            .collect();
        Self { world_from_camera, bearings, points, outlier: vec![false; count] }
    }

    /// Adds noise of `sigma` radians per axis and replaces a fraction of the bearings by random ones.
    pub fn disturb(&mut self, rng: &mut impl Rng, sigma: f64, outlier_fraction: f64) {
        let wrong = (outlier_fraction * self.bearings.len() as f64).round() as usize;
        for i in 0..self.bearings.len() {
            self.outlier[i] = i < wrong;
            self.bearings[i] =
                if i < wrong { random_unit(rng) } else { perturb(rng, &self.bearings[i], sigma) };
        }
    }
}

/// A set of cameras that sees points all around.
#[derive(Debug, Clone)]
pub struct GeneralizedProblem {
    /// Truth.
    pub world_from_set: Similarity,
    /// Rays in the set frame.
    pub rays: Vec<GeneralizedRay>,
    /// Points in the world.
    pub points: Vec<Vector3<f64>>,
    /// Whether a ray is wrong.
    pub outlier: Vec<bool>,
}

impl GeneralizedProblem {
    /// Noise-free rays from cameras around the set's origin; `camera_of_ray` says which camera each ray belongs to.
    ///
    /// In the set frame cameras lie within about 1 and points at 1 to 10 of their camera; the scale is drawn from
    /// 0.2 to 5, the rotation uniformly, or about +z only when `upright`.
    pub fn exact(rng: &mut impl Rng, camera_of_ray: &[u32], upright: bool) -> Self {
        let rotation = if upright {
            UnitQuaternion::from_scaled_axis(
                Vector3::z() * rng.random_range(-1.0..1.0) * std::f64::consts::PI,
            )
        } else {
            random_rotation(rng)
        };
        let world_from_set = Similarity {
            scale: 5.0_f64.powf(rng.random_range(-1.0..1.0)),
            rotation,
            translation: normal_vector(rng) * 5.0,
        };
        let cameras = camera_of_ray.iter().max().map_or(0, |last| *last as usize + 1);
        let centres: Vec<_> = (0..cameras).map(|_| normal_vector(rng)).collect();
        let (mut rays, mut points) = (Vec::new(), Vec::new());
        for camera in camera_of_ray {
            let origin = centres[*camera as usize];
            let direction = random_unit(rng);
            points.push(world_from_set.transform_point(&(origin + direction * rng.random_range(1.0..10.0))));
            rays.push(GeneralizedRay { origin, direction, sigma: 1e-3, camera: *camera });
        }
        let outlier = vec![false; rays.len()];
        Self { world_from_set, rays, points, outlier }
    }

    /// Turns the ray `second` to the point of the ray `first`, which both then see.
    pub fn see_one_point(&mut self, first: usize, second: usize) {
        self.points[second] = self.points[first];
        let in_set = self.world_from_set.inverse().transform_point(&self.points[first]);
        self.rays[second].direction = (in_set - self.rays[second].origin).normalize();
    }

    /// Adds noise of `sigma` radians per axis and replaces a fraction of the directions by random ones.
    ///
    /// The wrong rays are spread over the list, and so over the cameras.
    pub fn disturb(&mut self, rng: &mut impl Rng, sigma: f64, outlier_fraction: f64) {
        let count = self.rays.len();
        let wrong = (outlier_fraction * count as f64).round() as usize;
        for (i, ray) in self.rays.iter_mut().enumerate() {
            self.outlier[i] = (i + 1) * wrong / count > i * wrong / count;
            ray.sigma = sigma;
            ray.direction =
                if self.outlier[i] { random_unit(rng) } else { perturb(rng, &ray.direction, sigma) };
        }
    }

    /// Origins, directions and points of the first `N` rays.
    ///
    /// # Panics
    /// When there are fewer.
    pub fn sample<const N: usize>(&self) -> RaySample<N> {
        (
            std::array::from_fn(|i| self.rays[i].origin),
            std::array::from_fn(|i| self.rays[i].direction),
            std::array::from_fn(|i| self.points[i]),
        )
    }
}

/// Whether two similarities agree: angle and logarithmic scale below `tolerance`, translation relative to its length.
pub fn same_similarity(a: &Similarity, b: &Similarity, tolerance: f64) -> bool {
    rotation_angle(&a.rotation, &b.rotation) < tolerance
        && (a.scale / b.scale).ln().abs() < tolerance
        && (a.translation - b.translation).norm() < tolerance * (1.0 + b.translation.norm())
}

/// A pinhole camera of unknown focal length.
#[derive(Debug, Clone)]
pub struct FocalProblem {
    /// Truth.
    pub world_from_camera: Rigid,
    /// Focal length in pixels, 400 to 2000.
    pub focal: f64,
    /// Pixels relative to the principal point, within ±500.
    pub pixels: Vec<Vector2<f64>>,
    /// Points in the world.
    pub points: Vec<Vector3<f64>>,
    /// Whether a pixel is wrong.
    pub outlier: Vec<bool>,
}

impl FocalProblem {
    /// Noise-free pixels of points at depths of 2 to 10.
    pub fn exact(rng: &mut impl Rng, count: usize) -> Self {
        let world_from_camera = Rigid::new(random_rotation(rng), normal_vector(rng) * 5.0);
        let focal = rng.random_range(400.0..2000.0);
        let (mut pixels, mut points) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for _ in 0..count {
            let pixel = Vector2::new(rng.random_range(-500.0..500.0), rng.random_range(-500.0..500.0));
            let depth = rng.random_range(2.0..10.0);
            let point = Vector3::new(pixel.x / focal, pixel.y / focal, 1.0) * depth;
            pixels.push(pixel);
            points.push(world_from_camera.transform_point(&point));
        }
        Self { world_from_camera, focal, pixels, points, outlier: vec![false; count] }
    }

    /// Adds noise of `sigma` pixels per axis and replaces a fraction of the pixels by random ones.
    pub fn disturb(&mut self, rng: &mut impl Rng, sigma: f64, outlier_fraction: f64) {
        let wrong = (outlier_fraction * self.pixels.len() as f64).round() as usize;
        for i in 0..self.pixels.len() {
            self.outlier[i] = i < wrong;
            self.pixels[i] = if i < wrong {
                Vector2::new(rng.random_range(-500.0..500.0), rng.random_range(-500.0..500.0))
            } else {
                self.pixels[i] + Vector2::new(normal(rng), normal(rng)) * sigma
            };
        }
    }
}
