//! Planes among the points that one image sees.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::solvers::triangulation::WorldRay;

/// A point as an image sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SeenPoint {
    /// From the image's centre.
    pub position: Vector3<f64>,
    /// What the noise of the rays leaves open.
    pub covariance: Matrix3<f64>,
}

impl SeenPoint {
    /// The point at this position, as far as the rays to it tell; `None` where they leave its place open.
    pub fn new(center: &Vector3<f64>, position: &Vector3<f64>, rays: &[WorldRay]) -> Option<Self> {
        let mut information = Matrix3::zeros();
        for ray in rays {
            let across = Matrix3::identity() - ray.direction * ray.direction.transpose();
            information += across / (ray.sigma * (position - ray.origin).norm()).powi(2);
        }
        Self::known(position - center, information.try_inverse()?)
    }

    /// The point at this offset from the centre, of this covariance; `None` where these are no numbers.
    pub fn known(position: Vector3<f64>, covariance: Matrix3<f64>) -> Option<Self> {
        let sound = position.norm_squared() > 0.0 && covariance.iter().all(|value| value.is_finite());
        sound.then_some(Self { position, covariance })
    }

    /// Standard deviation of its place along a direction.
    pub fn along(&self, direction: &Vector3<f64>) -> f64 {
        direction.dot(&(self.covariance * direction)).max(0.0).sqrt()
    }

    /// Standard deviation of the distance from a plane with this unit normal, its roughness included.
    fn sigma(&self, normal: &Vector3<f64>) -> f64 {
        let rough = ROUGHNESS * self.position.norm();
        (normal.dot(&(self.covariance * normal)).max(0.0) + rough * rough).sqrt()
    }
}

/// A plane and the points that lie on it.
#[derive(Debug, Clone)]
pub(crate) struct Plane {
    /// Unit normal, away from the image's centre.
    pub normal: Vector3<f64>,
    /// Distance from the image's centre.
    pub distance: f64,
    /// Indices of its points, ascending.
    pub members: Vec<usize>,
    centroid: Vector3<f64>,
    /// Covariance of the slopes along `tangents`, and of the height at the centroid, as the points' noise leaves it.
    tangents: [Vector3<f64>; 2],
    slope_variances: [f64; 2],
    height_variance: f64,
}

impl Plane {
    /// The middle of its points.
    pub fn centroid(&self) -> &Vector3<f64> {
        &self.centroid
    }

    /// How far along a direction the plane is; `None` where the direction does not meet it, or at a grazing angle.
    pub fn depth_along(&self, direction: &Vector3<f64>) -> Option<f64> {
        let slant = self.normal.dot(direction);
        (slant > MIN_SLANT).then(|| self.distance / slant)
    }

    /// Standard deviation of the normal in radians, in the direction in which it is known worst.
    pub fn normal_sigma(&self) -> f64 {
        self.slope_variances[0].max(self.slope_variances[1]).sqrt()
    }

    /// Standard deviations of its two slopes, and of its height at the middle of its points.
    pub fn sigmas(&self) -> Vector3<f64> {
        let [first, second] = self.slope_variances;
        Vector3::new(first, second, self.height_variance).map(f64::sqrt)
    }

    /// The same in a frame turned about the image's centre.
    #[must_use]
    pub fn turned(self, rotation: &UnitQuaternion<f64>) -> Self {
        Self {
            normal: rotation * self.normal,
            centroid: rotation * self.centroid,
            tangents: self.tangents.map(|along| rotation * along),
            ..self
        }
    }

    /// Normal and distance of the plane with other slopes about the middle of its points, and raised there.
    pub fn moved(&self, by: &Vector3<f64>) -> (Vector3<f64>, f64) {
        let slope = self.tangents[0] * by.x + self.tangents[1] * by.y;
        let normal = self.normal - slope;
        let distance = self.distance + by.z - slope.dot(&self.centroid);
        (normal / normal.norm(), distance / normal.norm())
    }

    /// Standard deviation of the height at a place on the plane, as a share of the plane's distance.
    pub fn relative_sigma(&self, position: &Vector3<f64>) -> f64 {
        let offset = position - self.centroid;
        let slopes = self.tangents.iter().zip(self.slope_variances);
        let variance: f64 = slopes.map(|(along, variance)| along.dot(&offset).powi(2) * variance).sum();
        (variance + self.height_variance).sqrt() / self.distance
    }
}

/// How rough a plane may be, as a share of a point's distance.
const ROUGHNESS: f64 = 0.002;
/// Largest distance of a point from its plane, in standard deviations.
const MAX_SIGMAS: f64 = 3.0;
/// Least cosine between a normal and a direction that meets its plane.
const MIN_SLANT: f64 = 0.02;
/// Most planes of one image.
const MAX_PLANES: usize = 10;
/// Samples drawn for one plane.
const SAMPLES: usize = 600;
/// Of how many nearest points a sample is made: what is planar is so in one place first.
const NEIGHBOURS: usize = 40;
/// How often a plane is fitted to what is near it.
const FITS: usize = 6;
/// Points of one plane err alike, in patches: as many count as one.
const ALIKE: f64 = 10.0;

/// Planes among points, one after the other, each of at least `min_points` points that none before took.
///
/// Nearness of the points that make a sample is that of their directions: depths may be poor. Distances from a plane are
/// judged by the noise of each point's rays.
pub(crate) fn find_planes(points: &[SeenPoint], min_points: usize, seed: u64) -> Vec<Plane> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let directions: Vec<Vector3<f64>> = points.iter().map(|point| point.position.normalize()).collect();
    let mut left: Vec<usize> = (0..points.len()).collect();
    let mut planes = Vec::new();
    while planes.len() < MAX_PLANES && left.len() >= min_points.max(3) {
        let Some(plane) = best_plane(points, &directions, &left, min_points, &mut rng) else { break };
        left.retain(|index| plane.members.binary_search(index).is_err());
        planes.push(plane);
    }
    planes
}

fn best_plane(
    points: &[SeenPoint],
    directions: &[Vector3<f64>],
    left: &[usize],
    min_points: usize,
    rng: &mut ChaCha8Rng,
) -> Option<Plane> {
    let mut best: Option<(f64, Vector3<f64>, f64)> = None;
    let mut near: Vec<(f64, usize)> = Vec::with_capacity(left.len());
    for sample in 0..SAMPLES {
        // A few samples share their neighbourhood, which costs more to find than they do.
        if sample % 4 == 0 {
            let seed = left[rng.random_range(0..left.len())];
            near.clear();
            near.extend(left.iter().map(|&other| (-directions[seed].dot(&directions[other]), other)));
            let count = NEIGHBOURS.min(near.len());
            near.select_nth_unstable_by(count - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            near.truncate(count);
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        }
        let [a, b, c] = [0; 3].map(|_| near[rng.random_range(0..near.len())].1);
        let [a, b, c] = [a, b, c].map(|index| points[index].position);
        let (to_b, to_c) = (b - a, c - a);
        let Some(mut normal) = to_b.cross(&to_c).try_normalize(1e-9 * to_b.norm() * to_c.norm()) else {
            continue;
        };
        if normal.dot(&a) < 0.0 {
            normal = -normal;
        }
        let distance = normal.dot(&a);
        let score: f64 = left
            .iter()
            .map(|&index| {
                let error = (normal.dot(&points[index].position) - distance)
                    / (MAX_SIGMAS * points[index].sigma(&normal));
                1.0 - (error * error).min(1.0)
            })
            .sum();
        if best.is_none_or(|(highest, ..)| score > highest) {
            best = Some((score, normal, distance));
        }
    }
    let (_, normal, distance) = best?;
    let (mut normal, mut distance) = (normal, distance);
    let mut fitted = None;
    for _ in 0..FITS {
        let on_plane = |&&index: &&usize| {
            let error = normal.dot(&points[index].position) - distance;
            error.abs() <= MAX_SIGMAS * points[index].sigma(&normal)
        };
        let members: Vec<usize> = left.iter().filter(on_plane).copied().collect();
        if members.len() < min_points {
            return None;
        }
        let plane = fit(points, members, &normal)?;
        (normal, distance) = (plane.normal, plane.distance);
        fitted = Some(plane);
    }
    fitted
}

/// The plane of least squares through these points, each weighted by its noise across the plane of `initial` normal.
fn fit(points: &[SeenPoint], members: Vec<usize>, initial: &Vector3<f64>) -> Option<Plane> {
    let weights: Vec<f64> = members.iter().map(|&index| points[index].sigma(initial).powi(-2)).collect();
    let weight: f64 = weights.iter().sum();
    let weighted = |value: &dyn Fn(&Vector3<f64>) -> Matrix3<f64>| -> Matrix3<f64> {
        members.iter().zip(&weights).map(|(&index, &weight)| value(&points[index].position) * weight).sum()
    };
    let sum: Vector3<f64> =
        members.iter().zip(&weights).map(|(&index, &weight)| points[index].position * weight).sum();
    let centroid = sum / weight;
    let scatter = weighted(&|position| (position - centroid) * (position - centroid).transpose());
    let eigen = scatter.symmetric_eigen();
    let across = eigen.eigenvalues.imin();
    let mut normal: Vector3<f64> = eigen.eigenvectors.column(across).into();
    if normal.dot(&centroid) < 0.0 {
        normal = -normal;
    }
    let distance = normal.dot(&centroid);
    let along = [(across + 1) % 3, (across + 2) % 3];
    let tangents = along.map(|axis| eigen.eigenvectors.column(axis).into_owned());
    let slope_variances = along.map(|axis| ALIKE / eigen.eigenvalues[axis]);
    let height_variance = ALIKE / weight;
    let sound = distance > 0.0 && slope_variances.iter().all(|variance| variance.is_finite());
    sound.then_some(Plane { normal, distance, members, centroid, tangents, slope_variances, height_variance })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{normal, seeded};

    /// Points on a wall 8 ahead and on the ground 2 below, and others between, with depths known to 1 %.
    fn walls(noise: f64, clutter: usize, name: &str) -> Vec<SeenPoint> {
        let mut rng = seeded(name);
        let mut points = Vec::new();
        for index in 0..300 + clutter {
            let [a, b]: [f64; 2] = [0; 2].map(|_| rng.random_range(-6.0..6.0));
            let position = match index {
                0..200 => Vector3::new(a, b.min(2.0), 8.0),
                200..300 => Vector3::new(a, 2.0, 3.0 + b.abs()),
                _ => Vector3::new(a, 0.6 * b - 2.2, rng.random_range(2.0..7.5)),
            };
            let sigma = 0.01 * position.norm();
            let direction = position.normalize();
            let along = direction * direction.transpose() * sigma.powi(2);
            let position = position + direction * (noise * sigma * normal(&mut rng));
            points.push(SeenPoint { position, covariance: along + Matrix3::identity() * 1e-8 });
        }
        points
    }

    #[test]
    fn a_wall_and_the_ground_are_found_among_clutter() {
        let planes = find_planes(&walls(1.0, 100, "clutter"), 30, 3);
        assert_eq!(planes.len(), 2, "{planes:?}");
        for (plane, (normal, distance)) in planes.iter().zip([(Vector3::z(), 8.0), (Vector3::y(), 2.0)]) {
            assert!(plane.normal.angle(&normal) < 0.02, "{:?}", plane.normal);
            assert!((plane.distance / distance - 1.0).abs() < 0.02, "{}", plane.distance);
        }
    }

    #[test]
    fn exact_points_give_the_plane_exactly() {
        let planes = find_planes(&walls(0.0, 0, "exact")[..200], 50, 4);
        assert_eq!(planes.len(), 1);
        assert_eq!(planes[0].members, (0..200).collect::<Vec<_>>());
        assert!((planes[0].distance - 8.0).abs() < 1e-9 && planes[0].normal.angle(&Vector3::z()) < 1e-7);
        let depth = planes[0].depth_along(&Vector3::new(0.6, 0.0, 0.8)).unwrap();
        assert!((depth - 10.0).abs() < 1e-7);
        assert!(
            planes[0].depth_along(&Vector3::x()).is_none() && planes[0].depth_along(&-Vector3::z()).is_none()
        );
    }

    #[test]
    fn a_plane_is_known_worse_far_from_its_points() {
        let planes = find_planes(&walls(1.0, 0, "far"), 50, 5);
        let (near, far) = (Vector3::new(0.0, -1.0, 8.0), Vector3::new(60.0, -1.0, 8.0));
        assert!(planes[0].relative_sigma(&far) > 5.0 * planes[0].relative_sigma(&near));
        let error = (planes[0].normal.dot(&far) / planes[0].distance - 1.0).abs();
        assert!(error < 3.0 * planes[0].relative_sigma(&far), "{error}");
    }

    #[test]
    fn a_moved_plane_has_the_slopes_and_the_height_it_is_given() {
        let plane = &find_planes(&walls(0.0, 0, "moved"), 50, 7)[0];
        let (normal, distance) = plane.moved(&Vector3::new(0.02, -0.01, 0.3));
        let height = |position: &Vector3<f64>| normal.dot(position) - distance;
        assert!((normal.norm() - 1.0).abs() < 1e-12);
        let length = (1.0_f64 + 0.02_f64.powi(2) + 0.01_f64.powi(2)).sqrt();
        assert!((height(&plane.centroid) * length + 0.3).abs() < 1e-9);
        let along = height(&(plane.centroid + plane.tangents[0])) - height(&plane.centroid);
        assert!((along * length + 0.02).abs() < 1e-9);
    }

    #[test]
    fn points_all_over_make_no_plane() {
        let mut points = walls(1.0, 400, "cloud");
        points.drain(..300);
        assert!(find_planes(&points, 60, 6).is_empty());
        assert!(find_planes(&[], 10, 6).is_empty());
    }
}
