//! Which of the seven degrees of freedom of a set's pose the rays determine, and the least-squares pose itself.

use nalgebra::{SMatrix, SVector, UnitQuaternion, Vector3};
use setloc_sfm::Similarity;

type Matrix7 = SMatrix<f64, 7, 7>;
type Vector7 = SVector<f64, 7>;

/// A ray of the set with the scene point that it sees.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SetRay {
    /// Camera centre in the set's frame.
    pub origin: Vector3<f64>,
    /// Unit direction in the set's frame.
    pub direction: Vector3<f64>,
    /// Angular standard deviation in radians.
    pub sigma: f64,
    /// The scene point in the scene's frame.
    pub point: Vector3<f64>,
}

impl SetRay {
    /// Angle between the ray and its point under a pose, in standard deviations.
    pub(crate) fn error_sigmas(&self, set_from_world: &Similarity) -> f64 {
        let offset = set_from_world.transform_point(&self.point) - self.origin;
        self.direction.cross(&offset).norm().atan2(self.direction.dot(&offset)) / self.sigma
    }
}

/// How well a set's pose is determined, about the mean of its camera centres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Observability {
    /// Standard deviation of the rotation about its worst axis in radians.
    pub rotation_rad: f64,
    /// Standard deviation of the position along its worst axis, as a share of the mean distance to the points.
    pub position: f64,
    /// Standard deviation of the logarithm of the scale.
    pub log_scale: f64,
}

/// A standard deviation (radians, share of the distance, log-scale) from which a direction counts as undetermined.
const UNDETERMINED: f64 = 0.2;

/// Eigenvalues below this share of the largest are rounding errors of zero.
const NULL_EIGENVALUE: f64 = 1e-13;
/// A degree of freedom with more than this share (squared) of its direction in the null space is undetermined.
const NULL_SHARE: f64 = 1e-4;

impl Observability {
    /// Names of the undetermined directions.
    pub(crate) fn undetermined(&self) -> Vec<&'static str> {
        [(self.log_scale, "scale"), (self.position, "position"), (self.rotation_rad, "rotation")]
            .into_iter()
            .filter(|(sigma, _)| !(*sigma < UNDETERMINED))
            .map(|(_, name)| name)
            .collect()
    }
}

/// Normal equations of the whitened residuals κ − d/‖d‖ in the set's frame.
///
/// d = set_from_world · X − origin; the perturbation acts on the left of `set_from_world`, about `pivot`:
/// δd = ω × (X' − pivot) + v + λ (X' − pivot), in the order ω, v, λ.
fn normal_equations(
    set_from_world: &Similarity,
    rays: &[SetRay],
    pivot: &Vector3<f64>,
) -> (Matrix7, Vector7) {
    let (mut hessian, mut gradient) = (Matrix7::zeros(), Vector7::zeros());
    for ray in rays {
        let point_in_set = set_from_world.transform_point(&ray.point);
        let offset = point_in_set - ray.origin;
        let distance = offset.norm();
        if !(distance > 0.0) {
            continue;
        }
        let direction = offset / distance;
        let arm = point_in_set - pivot;
        let mut jacobian = SMatrix::<f64, 3, 7>::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-arm.cross_matrix());
        jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&nalgebra::Matrix3::identity());
        jacobian.fixed_view_mut::<3, 1>(0, 6).copy_from(&arm);
        let projector =
            (nalgebra::Matrix3::identity() - direction * direction.transpose()) / (distance * ray.sigma);
        let jacobian = projector * jacobian;
        let residual = (direction - ray.direction) / ray.sigma;
        hessian += jacobian.transpose() * jacobian;
        gradient += jacobian.transpose() * residual;
    }
    (hessian, gradient)
}

fn mean_origin(rays: &[SetRay]) -> Vector3<f64> {
    rays.iter().map(|ray| ray.origin).sum::<Vector3<f64>>() / rays.len().max(1) as f64
}

fn perturb(set_from_world: &Similarity, step: &Vector7, pivot: &Vector3<f64>) -> Similarity {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
    let (shift, scale) = (Vector3::new(step[3], step[4], step[5]), step[6].exp());
    let translation = pivot + shift - rotation * pivot * scale;
    Similarity { scale, rotation, translation } * *set_from_world
}

fn cost(set_from_world: &Similarity, rays: &[SetRay], truncation: f64) -> f64 {
    rays.iter().map(|ray| ray.error_sigmas(set_from_world).min(truncation).powi(2)).sum()
}

/// Truncated least squares over all rays: Levenberg–Marquardt on the rays within `truncation` standard deviations.
///
/// The paper's T_LM with whitened residuals. Never returns a pose of larger truncated cost than it was given.
pub(crate) fn refine_similarity(world_from_set: &Similarity, rays: &[SetRay], truncation: f64) -> Similarity {
    let mut pose = world_from_set.inverse();
    let pivot = mean_origin(rays);
    let mut damping = 1e-4;
    let mut current = cost(&pose, rays, truncation);
    for _ in 0..30 {
        let inliers: Vec<SetRay> =
            rays.iter().copied().filter(|r| r.error_sigmas(&pose) < truncation).collect();
        if inliers.len() < 4 {
            break;
        }
        let (mut hessian, gradient) = normal_equations(&pose, &inliers, &pivot);
        for i in 0..7 {
            hessian[(i, i)] *= 1.0 + damping;
        }
        let Some(step) = hessian.cholesky().map(|factor| -factor.solve(&gradient)) else { break };
        let candidate = perturb(&pose, &step, &pivot);
        let candidate_cost = cost(&candidate, rays, truncation);
        if candidate_cost < current {
            let gain = (current - candidate_cost) / current.max(f64::MIN_POSITIVE);
            (pose, current, damping) = (candidate, candidate_cost, damping * 0.1);
            if gain < 1e-9 {
                break;
            }
        } else {
            damping *= 10.0;
            if damping > 1e8 {
                break;
            }
        }
    }
    pose.inverse()
}

/// What the (inlier) rays determine of the pose.
pub(crate) fn observability(world_from_set: &Similarity, rays: &[SetRay]) -> Observability {
    let set_from_world = world_from_set.inverse();
    let pivot = mean_origin(rays);
    let (hessian, _) = normal_equations(&set_from_world, rays, &pivot);
    let depth =
        rays.iter().map(|r| (set_from_world.transform_point(&r.point) - r.origin).norm()).sum::<f64>()
            / rays.len().max(1) as f64;
    // Lengths in units of the depth make all seven directions comparable.
    let mut scaling = Vector7::repeat(1.0);
    scaling.fixed_rows_mut::<3>(3).fill(depth);
    let scaled = Matrix7::from_diagonal(&scaling) * hessian * Matrix7::from_diagonal(&scaling);
    let eigen = scaled.symmetric_eigen();
    let floor = eigen.eigenvalues.max().max(0.0) * NULL_EIGENVALUE;
    let mut covariance = Matrix7::zeros();
    let mut in_null_space = Vector7::zeros();
    for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        if *value > floor {
            covariance += vector * vector.transpose() / *value;
        } else {
            in_null_space += vector.component_mul(&vector);
        }
    }
    let sigma = |rows: std::ops::Range<usize>, variance: f64| {
        let lost = rows.map(|row| in_null_space[row]).sum::<f64>() > NULL_SHARE;
        if lost { f64::INFINITY } else { variance.max(0.0).sqrt() }
    };
    let worst =
        |start: usize| covariance.fixed_view::<3, 3>(start, start).into_owned().symmetric_eigenvalues().max();
    Observability {
        rotation_rad: sigma(0..3, worst(0)),
        position: sigma(3..6, worst(3)),
        log_scale: sigma(6..7, covariance[(6, 6)]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn truth() -> Similarity {
        let rotation = UnitQuaternion::from_euler_angles(0.2, -0.7, 1.9);
        Similarity { scale: 3.0, rotation, translation: Vector3::new(5.0, -2.0, 9.0) }
    }

    /// Exact rays from `cameras` centres spread over `baseline` (set units) to points 4 to 12 set units away.
    fn rays(cameras: usize, baseline: f64, seed: u64) -> Vec<SetRay> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut vector = |size: f64| Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0) * size);
        let origins: Vec<Vector3<f64>> = (0..cameras).map(|_| vector(baseline)).collect();
        (0..60)
            .map(|i| {
                let point_in_set = vector(1.0).normalize() * (4.0 + f64::from(i % 9));
                let origin = origins[i as usize % cameras];
                let direction = (point_in_set - origin).normalize();
                SetRay { origin, direction, sigma: 1e-3, point: truth().transform_point(&point_in_set) }
            })
            .collect()
    }

    #[test]
    fn refinement_recovers_the_exact_pose_despite_outliers() {
        let mut rays = rays(5, 1.0, 1);
        for ray in rays.iter_mut().take(6) {
            ray.direction = -ray.direction;
        }
        let start = truth()
            * Similarity {
                scale: 1.02,
                rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.01, 0.01)),
                translation: Vector3::new(0.03, 0.02, -0.03),
            };
        let found = refine_similarity(&start, &rays, 60.0);
        assert!(found.rotation.angle_to(&truth().rotation) < 1e-9);
        assert!((found.translation - truth().translation).norm() < 1e-8);
        assert!((found.scale - 3.0).abs() < 1e-9);
    }

    #[test]
    fn one_centre_determines_no_scale() {
        let one = observability(&truth(), &rays(1, 1.0, 2));
        assert_eq!(one.undetermined(), ["scale"]);
        let near = observability(&truth(), &rays(4, 1e-3, 3));
        assert!(near.undetermined().contains(&"scale"), "{near:?}");
        let wide = observability(&truth(), &rays(4, 1.0, 4));
        assert!(wide.undetermined().is_empty(), "{wide:?}");
        assert!(wide.log_scale < 0.01);
    }

    #[test]
    fn the_gradient_is_that_of_the_cost() {
        let rays = rays(4, 1.0, 5);
        let pivot = mean_origin(&rays);
        let start = perturb(&truth().inverse(), &Vector7::repeat(0.003), &pivot);
        let (_, gradient) = normal_equations(&start, &rays, &pivot);
        let value = |pose: &Similarity| -> f64 {
            rays.iter()
                .map(|ray| {
                    let offset = pose.transform_point(&ray.point) - ray.origin;
                    ((offset.normalize() - ray.direction) / ray.sigma).norm_squared() / 2.0
                })
                .sum()
        };
        for i in 0..7 {
            let mut step = Vector7::zeros();
            step[i] = 1e-6;
            let numeric =
                (value(&perturb(&start, &step, &pivot)) - value(&perturb(&start, &-step, &pivot))) / 2e-6;
            assert!((numeric - gradient[i]).abs() < 1e-4 * gradient.norm(), "{i}: {numeric} {}", gradient[i]);
        }
    }
}
