use nalgebra::{Vector2, Vector3};

use crate::solvers::tangent_basis;

/// Whitened angular residual of a ray to a point, with its derivative.
///
/// r = 2·Bᵀ·y / ((‖y‖ + b·y)·σ), where y is the point relative to the ray's origin and B (3×2) an orthonormal basis of
/// the tangent plane at the unit direction b. ‖r‖ = 2·tan(θ/2)/σ grows with the angle θ over the whole sphere: it has
/// no second zero at the antipode and is infinite there.
#[derive(Debug, Clone, Copy)]
pub struct AngularResidual {
    /// r, in standard deviations.
    pub value: Vector2<f64>,
    /// Rows of ∂r/∂y (2×3).
    pub rows: (Vector3<f64>, Vector3<f64>),
}

impl AngularResidual {
    /// Residual of direction `bearing` against `target` (any length), both in the same frame.
    #[inline]
    pub fn new(bearing: &Vector3<f64>, target: &Vector3<f64>, sigma: f64) -> Self {
        let (u, v) = tangent_basis(bearing);
        let norm = target.norm();
        // Bounded away from the antipode so that a hopeless ray is a large number instead of an infinity.
        let denominator = (norm + bearing.dot(target)).max(1e-9 * norm).max(f64::MIN_POSITIVE);
        let factor = 2.0 / (denominator * sigma);
        let value = Vector2::new(u.dot(target), v.dot(target)) * factor;
        let slope = (target / norm.max(f64::MIN_POSITIVE) + bearing) / denominator;
        Self { value, rows: (u * factor - slope * value.x, v * factor - slope * value.y) }
    }

    /// Squared length of [`Self::new`]'s value alone, for scoring.
    #[inline(always)]
    pub fn squared(bearing: &Vector3<f64>, target: &Vector3<f64>, inverse_variance: f64) -> f64 {
        let along = bearing.dot(target);
        let norm = target.norm();
        // 4·(1 − cos θ)/(1 + cos θ); NaN for a zero target, which no comparison accepts.
        4.0 * (norm - along) / (norm + along) * inverse_variance
    }
}

#[cfg(test)]
mod tests {
    use super::AngularResidual;
    use crate::synthetic::{normal_vector, random_unit, seeded};
    use nalgebra::Vector3;

    #[test]
    fn derivative_agrees_with_differences() {
        let mut rng = seeded("residual");
        for _ in 0..200 {
            let (bearing, target) = (random_unit(&mut rng), normal_vector(&mut rng) * 3.0);
            if bearing.dot(&target.normalize()) < -0.9 {
                continue;
            }
            let residual = AngularResidual::new(&bearing, &target, 0.5);
            for k in 0..3 {
                let mut step = Vector3::zeros();
                step[k] = 1e-6;
                let change = (AngularResidual::new(&bearing, &(target + step), 0.5).value
                    - AngularResidual::new(&bearing, &(target - step), 0.5).value)
                    / 2e-6;
                let scale = 1.0 + change.norm();
                assert!((change.x - residual.rows.0[k]).abs() < 1e-6 * scale);
                assert!((change.y - residual.rows.1[k]).abs() < 1e-6 * scale);
            }
            let squared = AngularResidual::squared(&bearing, &target, 4.0);
            assert!((squared - residual.value.norm_squared()).abs() < 1e-9 * (1.0 + squared));
        }
    }

    #[test]
    fn the_antipode_is_the_worst_direction() {
        let bearing = Vector3::new(0.0, 0.6, -0.8);
        assert!(AngularResidual::squared(&bearing, &(bearing * 7.0), 1.0) < 1e-14);
        assert!(AngularResidual::squared(&bearing, &(bearing * -7.0), 1.0) > 1e12);
        assert!(AngularResidual::new(&bearing, &(bearing * -7.0 + Vector3::x() * 1e-3), 1.0).value.norm() > 1e3);
    }
}
