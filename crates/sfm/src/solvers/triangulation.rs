//! Points from rays: two-view and many-view triangulation with angular errors.

use nalgebra::{Matrix3, Vector3};

use crate::Rigid;

/// Steps of the angular refinement.
const MAX_STEPS: usize = 10;

/// A ray in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldRay {
    /// Centre of the camera.
    pub origin: Vector3<f64>,
    /// Unit direction.
    pub direction: Vector3<f64>,
    /// Standard deviation of the direction per tangent axis, in radians.
    pub sigma: f64,
}

impl WorldRay {
    /// The ray of a bearing in a camera.
    pub fn new(world_from_camera: &Rigid, bearing_in_camera: &Vector3<f64>, sigma: f64) -> Self {
        Self {
            origin: world_from_camera.translation,
            direction: world_from_camera.rotation * bearing_in_camera,
            sigma,
        }
    }

    /// Depth of a point along the ray: negative behind the origin.
    pub fn depth(&self, point_in_world: &Vector3<f64>) -> f64 {
        self.direction.dot(&(point_in_world - self.origin))
    }

    /// Angle between the ray and the direction to a point, in \[0, π\].
    pub fn angular_error(&self, point_in_world: &Vector3<f64>) -> f64 {
        angle(&self.direction, &(point_in_world - self.origin))
    }
}

/// Angle between two vectors in radians, accurate also near 0 and π.
pub fn angle(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    a.cross(b).norm().atan2(a.dot(b))
}

/// The angle under which two centres see a point, in radians.
pub fn triangulation_angle(
    first: &Vector3<f64>,
    second: &Vector3<f64>,
    point_in_world: &Vector3<f64>,
) -> f64 {
    angle(&(first - point_in_world), &(second - point_in_world))
}

/// The largest triangulation angle over all pairs of rays' origins, in radians.
pub fn max_triangulation_angle(rays: &[WorldRay], point_in_world: &Vector3<f64>) -> f64 {
    let mut largest = 0.0_f64;
    for (i, a) in rays.iter().enumerate() {
        for b in &rays[i + 1..] {
            largest = largest.max(triangulation_angle(&a.origin, &b.origin, point_in_world));
        }
    }
    largest
}

/// How many steps a camera has to go for its ray to meet a point.
///
/// Equation: X = C + s·d + λ·r, whose product with r leaves (X − C)×r = s·(d×r), three equations of rank two; s is their
/// least-squares solution. `step` is d, `offset` X − C and `ray` r (unit), all in one frame; λ may have either sign.
/// `None` when s is not positive or the step runs along the ray.
///
/// ```
/// use nalgebra::Vector3;
/// use setloc_sfm::solvers::triangulation::length_along;
///
/// // Three steps along x, and the point lies straight ahead.
/// let length = length_along(&Vector3::x(), &Vector3::new(3.0, 0.0, 7.0), &Vector3::z());
/// assert_eq!(length, Some(3.0));
/// ```
pub fn length_along(step: &Vector3<f64>, offset: &Vector3<f64>, ray: &Vector3<f64>) -> Option<f64> {
    let (wanted, lever) = (offset.cross(ray), step.cross(ray));
    let length = wanted.dot(&lever) / lever.norm_squared();
    (length.is_finite() && length > 0.0).then_some(length)
}

/// Triangulates a point from two bearings; in the second camera's frame.
///
/// One bearing is first turned by the smallest angle that brings both into a common epipolar plane, where the rays
/// meet: S. H. Lee, J. Civera, "Closed-Form Optimal Two-View Triangulation Based on Angular Errors", ICCV 2019, the L1
/// case. `None` when a depth is not positive or the rays are parallel.
pub fn triangulate_two_views(
    second_from_first: &Rigid,
    first: &Vector3<f64>,
    second: &Vector3<f64>,
) -> Option<Vector3<f64>> {
    let t = second_from_first.translation;
    let m0 = second_from_first.rotation * first;
    let m1 = *second;
    let n0 = m0.cross(&t);
    let n1 = m1.cross(&t);
    // The bearing nearer to the epipole turns farther for the same plane: move the one whose sine is larger.
    let (ray0, ray1) = if n0.norm_squared() <= n1.norm_squared() {
        let plane = n1.try_normalize(1e-14)?;
        (m0 - plane * m0.dot(&plane), m1)
    } else {
        let plane = n0.try_normalize(1e-14)?;
        (m0, m1 - plane * m1.dot(&plane))
    };
    let normal = ray1.cross(&ray0);
    let square = normal.norm_squared();
    if !(square > 1e-24) {
        return None;
    }
    // λ₁·ray1 = λ₀·ray0 + t.
    let depth0 = t.cross(&ray1).dot(&normal) / square;
    let depth1 = t.cross(&ray0).dot(&normal) / square;
    (depth0 > 0.0 && depth1 > 0.0).then(|| ray1 * depth1)
}

/// Triangulates a point from two or more rays: linear, then Gauss–Newton on the angular errors.
///
/// Minimizes Σ (2·tan(θ/2)/σ)² over the rays with θ the angle to the point. `None` when the rays are parallel within
/// their accuracy of arithmetic, or a depth along any ray is not positive.
pub fn triangulate(rays: &[WorldRay]) -> Option<Vector3<f64>> {
    let point = refine_point(rays, linear_point(rays)?);
    rays.iter().all(|ray| ray.depth(&point) > 0.0).then_some(point)
}

/// The point nearest to all lines: Σ wᵢ·(I − x·xᵀ)·(X − o) = 0.
fn linear_point(rays: &[WorldRay]) -> Option<Vector3<f64>> {
    let reference = rays.first()?.origin;
    let (mut matrix, mut vector) = (Matrix3::zeros(), Vector3::zeros());
    for ray in rays {
        let projector = Matrix3::identity() - ray.direction * ray.direction.transpose();
        let weight = 1.0 / (ray.sigma * ray.sigma);
        matrix += projector * weight;
        vector += projector * (ray.origin - reference) * weight;
    }
    // The smallest eigenvalue is about the squared parallax: below 1e-12 of the trace nothing but rounding is left.
    if !(matrix.determinant() > 1e-14 * matrix.trace().powi(3)) {
        return None;
    }
    let point = reference + matrix.cholesky()?.solve(&vector);
    point.iter().all(|value| value.is_finite()).then_some(point)
}

/// Improves a point by Gauss–Newton steps that each lower the cost.
pub fn refine_point(rays: &[WorldRay], initial: Vector3<f64>) -> Vector3<f64> {
    let mut point = initial;
    let (mut normal, mut gradient, mut cost) = linearize(rays, &point);
    for _ in 0..MAX_STEPS {
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&gradient)) else {
            break;
        };
        let candidate = point - step;
        let next = linearize(rays, &candidate);
        if !(next.2 < cost) {
            break;
        }
        let done = cost - next.2 < 1e-12 * cost;
        point = candidate;
        (normal, gradient, cost) = next;
        if done {
            break;
        }
    }
    point
}

/// Normal equations of the angular residuals at a point: (JᵀJ, Jᵀr, rᵀr).
fn linearize(rays: &[WorldRay], point: &Vector3<f64>) -> (Matrix3<f64>, Vector3<f64>, f64) {
    let (mut normal, mut gradient, mut cost) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
    for ray in rays {
        let residual = crate::robust::AngularResidual::new(&ray.direction, &(point - ray.origin), ray.sigma);
        for (value, row) in [(residual.value.x, residual.rows.0), (residual.value.y, residual.rows.1)] {
            normal += row * row.transpose();
            gradient += row * value;
            cost += value * value;
        }
    }
    (normal, gradient, cost)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{RelativeProblem, random_unit, seeded};
    use rand::Rng;

    #[test]
    fn two_views_recover_exact_points_all_around() {
        let mut rng = seeded("two_views");
        for _ in 0..300 {
            let problem = RelativeProblem::exact(&mut rng, 1);
            let point =
                triangulate_two_views(&problem.second_from_first, &problem.first[0], &problem.second[0])
                    .unwrap();
            assert!(angle(&point, &problem.second[0]) < 1e-9);
            let in_first = problem.second_from_first.inverse_transform_point(&point);
            assert!(angle(&in_first, &problem.first[0]) < 1e-9);
        }
    }

    #[test]
    fn many_views_recover_exact_points() {
        let mut rng = seeded("many_views");
        for _ in 0..300 {
            let point = random_unit(&mut rng) * rng.random_range(1.0..20.0);
            let rays: Vec<_> = (0..5)
                .map(|_| {
                    let origin = random_unit(&mut rng);
                    WorldRay { origin, direction: (point - origin).normalize(), sigma: 1e-3 }
                })
                .collect();
            let found = triangulate(&rays).unwrap();
            assert!((found - point).norm() < 1e-9 * point.norm());
            assert!(max_triangulation_angle(&rays, &found) > 0.0);
        }
    }

    #[test]
    fn noise_moves_the_point_as_predicted() {
        let mut rng = seeded("noise");
        let (sigma, trials) = (1e-3, 400);
        let mut squared = 0.0;
        let mut expected = 0.0;
        for _ in 0..trials {
            let point = Vector3::new(0.0, 0.0, -4.0);
            let rays: Vec<_> = (0..6)
                .map(|_| {
                    let origin = random_unit(&mut rng);
                    let direction = crate::synthetic::perturb(&mut rng, &(point - origin).normalize(), sigma);
                    WorldRay { origin, direction, sigma }
                })
                .collect();
            squared += (triangulate(&rays).unwrap() - point).norm_squared();
            expected += linearize(&rays, &point).0.try_inverse().unwrap().trace();
        }
        assert!((squared / expected - 1.0).abs() < 0.2, "{}", squared / expected);
    }

    #[test]
    fn the_length_of_a_baseline_is_recovered_all_around() {
        let mut rng = seeded("length_along");
        for _ in 0..300 {
            let (step, ray) = (random_unit(&mut rng), random_unit(&mut rng));
            let length = rng.random_range(0.1..10.0);
            let offset = step * length + ray * rng.random_range(1.0..20.0);
            let found = length_along(&step, &offset, &ray).unwrap();
            let sine = step.cross(&ray).norm();
            assert!((found - length).abs() * sine < 1e-9 * length, "{found} {length}");
            assert_eq!(length_along(&-step, &offset, &ray), None);
        }
        // A step along the ray says nothing of its length.
        assert_eq!(length_along(&Vector3::z(), &Vector3::new(0.0, 0.0, 5.0), &Vector3::z()), None);
    }

    #[test]
    fn refuses_parallel_rays_and_points_behind_a_ray() {
        let ray = |x: f64, direction: Vector3<f64>| WorldRay {
            origin: Vector3::new(x, 0.0, 0.0),
            direction,
            sigma: 1e-3,
        };
        assert!(triangulate(&[ray(0.0, Vector3::z()), ray(1.0, Vector3::z())]).is_none());
        assert!(triangulate(&[ray(0.0, Vector3::z())]).is_none());
        let point = Vector3::new(0.5, 0.0, 3.0);
        let behind = (Vector3::new(1.0, 0.0, 0.0) - point).normalize();
        assert!(triangulate(&[ray(0.0, point.normalize()), ray(1.0, behind)]).is_none());
    }
}
