//! The angular residual of one observation, and its Jacobians.
//!
//! Symbols: R, t of `world_from_camera`; X the point in the world, x = Rᵀ(X − t) in the camera, d = x/‖x‖; b the
//! observed bearing, B (3×2) an orthonormal basis of its tangent plane; c = b·d.
//!
//! e = 2 Bᵀd / (1 + c), so ‖e‖ = 2 tan(θ/2) with θ the angle between b and d. That grows over the whole sphere up to
//! infinity at the antipode: the sign test b·d > 0 is part of the residual. The paper's chord ‖b − d‖ = 2 sin(θ/2)
//! agrees with it to third order.

use nalgebra::{Matrix3, Vector3};

/// Below this 1 + b·d (within 0.14 mrad of the antipode) the residual is held at [`ANTIPODE_NORM`].
const ANTIPODE_GAP: f64 = 1e-8;
/// ‖e‖ at 1 + b·d = [`ANTIPODE_GAP`].
const ANTIPODE_NORM: f64 = 28284.271247461902;

/// An orthonormal, right-handed basis (u, v) of the plane perpendicular to a unit vector: u × v = b.
///
/// T. Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
#[inline]
pub(super) fn tangent_basis(b: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let sign = 1.0_f64.copysign(b.z);
    let a = -1.0 / (sign + b.z);
    let m = b.x * b.y * a;
    (
        Vector3::new(1.0 + sign * b.x * b.x * a, sign * m, -sign * b.x),
        Vector3::new(m, sign + b.y * b.y * a, -b.y),
    )
}

/// The residual and what its Jacobians are made of.
#[derive(Debug, Clone, Copy)]
pub(super) struct Angular {
    /// e.
    pub residual: [f64; 2],
    /// M = ∂e/∂x, rows of a 2×3 matrix.
    pub wrt_camera_point: [Vector3<f64>; 2],
    /// ∂e/∂d on the tangent plane of d: ‖x‖·M.
    pub wrt_direction: [Vector3<f64>; 2],
    /// d.
    pub direction: Vector3<f64>,
}

/// e and its derivative by the point in the camera frame.
///
/// With ∂e/∂d = (Bᵀ − ½ e bᵀ)·2/(1+c) and ∂d/∂x = (I − ddᵀ)/‖x‖:
/// M = 2/((1+c)‖x‖) · (Bᵀ − ½ e (b + d)ᵀ), 2×3.
#[inline]
pub(super) fn angular(bearing: &Vector3<f64>, x: &Vector3<f64>) -> Angular {
    let inverse_norm = 1.0 / x.norm();
    let d = x * inverse_norm;
    let gap = 1.0 + bearing.dot(&d);
    let (u, v) = tangent_basis(bearing);
    let (eu, ev) = (u.dot(&d), v.dot(&d));
    if !(gap > ANTIPODE_GAP) || !inverse_norm.is_finite() {
        // No usable derivative here; the constant keeps the observation from ever counting as explained.
        let norm = eu.hypot(ev);
        let residual = if norm > 0.0 {
            [ANTIPODE_NORM * eu / norm, ANTIPODE_NORM * ev / norm]
        } else {
            [ANTIPODE_NORM, 0.0]
        };
        let zero = [Vector3::zeros(); 2];
        return Angular { residual, wrt_camera_point: zero, wrt_direction: zero, direction: d };
    }
    let factor = 2.0 / gap;
    let residual = [factor * eu, factor * ev];
    let sum = bearing + d;
    let wrt_direction = [(u - sum * (0.5 * residual[0])) * factor, (v - sum * (0.5 * residual[1])) * factor];
    let wrt_camera_point = [wrt_direction[0] * inverse_norm, wrt_direction[1] * inverse_norm];
    Angular { residual, wrt_camera_point, wrt_direction, direction: d }
}

/// ‖e‖² alone, by the cross product so that small angles keep their digits.
#[inline]
pub(super) fn angular_squared(bearing: &Vector3<f64>, x: &Vector3<f64>) -> f64 {
    let inverse_norm = 1.0 / x.norm();
    let d = x * inverse_norm;
    let gap = 1.0 + bearing.dot(&d);
    if !(gap > ANTIPODE_GAP) || !inverse_norm.is_finite() {
        return ANTIPODE_NORM * ANTIPODE_NORM;
    }
    4.0 * bearing.cross(&d).norm_squared() / (gap * gap)
}

/// Row of the 2×3 Jacobian by the pose's rotation, R ← R·Exp(ω) (right perturbation, ω in the camera frame).
///
/// x(ω) = Exp(−ω)x, so ∂x/∂ω = [x]× and the row is mᵀ[x]× = (m × x)ᵀ.
#[inline]
pub(super) fn rotation_row(m: &Vector3<f64>, x: &Vector3<f64>) -> Vector3<f64> {
    m.cross(x)
}

/// Row of the 2×3 Jacobian by the point in the world: mᵀRᵀ. By the translation (t ← t + δ, world frame): its negative.
#[inline]
pub(super) fn point_row(m: &Vector3<f64>, world_from_camera: &Matrix3<f64>) -> Vector3<f64> {
    world_from_camera * m
}

/// Entry of the 2×k Jacobian by an intrinsic parameter that moves the bearing by `db` (3-vector, tangent to b).
///
/// Moving b and transporting B along is a rotation by b × db; for e it is the inverse rotation of d. So ∂d = d × (b × db).
/// The basis of [`tangent_basis`] at the new bearing is twisted against the transported one, which turns e in its plane:
/// neither ‖e‖² nor JᵀJ nor Jᵀe notice.
#[inline]
pub(super) fn bearing_change(
    bearing: &Vector3<f64>,
    direction: &Vector3<f64>,
    db: &Vector3<f64>,
) -> Vector3<f64> {
    direction.cross(&bearing.cross(db))
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector2};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn random_vector(rng: &mut ChaCha8Rng) -> Vector3<f64> {
        Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0))
    }

    fn residual(
        bearing: &Vector3<f64>,
        r: &UnitQuaternion<f64>,
        t: &Vector3<f64>,
        point: &Vector3<f64>,
    ) -> Vector2<f64> {
        let e = angular(bearing, &r.inverse_transform_vector(&(point - t))).residual;
        Vector2::new(e[0], e[1])
    }

    #[test]
    fn basis_is_orthonormal_everywhere() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut bearings: Vec<_> = (0..1000).map(|_| random_vector(&mut rng).normalize()).collect();
        bearings.extend([Vector3::z(), -Vector3::z(), Vector3::x(), -Vector3::y()]);
        for b in bearings {
            let (u, v) = tangent_basis(&b);
            assert!((u.cross(&v) - b).norm() < 1e-14);
            assert!(u.dot(&b).abs() < 1e-15 && (u.norm() - 1.0).abs() < 1e-14);
        }
    }

    #[test]
    fn norm_is_twice_the_tangent_of_half_the_angle_over_the_whole_sphere() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for _ in 0..1000 {
            let b = random_vector(&mut rng).normalize();
            let axis = b.cross(&random_vector(&mut rng)).normalize();
            let angle = rng.random_range(0.0..3.14);
            let x = UnitQuaternion::from_scaled_axis(axis * angle) * b * rng.random_range(0.1..50.0);
            let e = angular(&b, &x).residual;
            let expected = 2.0 * (angle / 2.0).tan();
            assert!((e[0].hypot(e[1]) - expected).abs() < 1e-9 * (1.0 + expected * expected));
            assert!((angular_squared(&b, &x).sqrt() - expected).abs() < 1e-9 * (1.0 + expected * expected));
        }
    }

    #[test]
    fn antipode_and_camera_centre_are_far_from_explained() {
        let b = Vector3::new(0.3, -0.2, 0.8).normalize();
        for x in [-b, -b * 7.0, Vector3::zeros(), -b + Vector3::new(1e-7, 0.0, 0.0)] {
            let e = angular(&b, &x).residual;
            assert!(e[0].hypot(e[1]) > 1e4 && e[0].is_finite() && e[1].is_finite());
            assert!(angular_squared(&b, &x) > 1e8);
        }
    }

    #[test]
    fn jacobians_match_numeric_twins_on_both_hemispheres() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for _ in 0..300 {
            let b = random_vector(&mut rng).normalize();
            let r = UnitQuaternion::from_scaled_axis(random_vector(&mut rng) * 2.0);
            let (t, point) = (random_vector(&mut rng), random_vector(&mut rng) * 5.0);
            let x = r.inverse_transform_vector(&(point - t));
            if x.norm() < 0.5 || b.dot(&x.normalize()) < -0.8 {
                continue;
            }
            let rotation = *r.to_rotation_matrix().matrix();
            let a = angular(&b, &x);
            let h = 1e-6;
            for k in 0..3 {
                let mut step = Vector3::zeros();
                step[k] = h;
                let turned = |s: f64| r * UnitQuaternion::from_scaled_axis(step * s);
                let numeric = [
                    (residual(&b, &turned(1.0), &t, &point) - residual(&b, &turned(-1.0), &t, &point))
                        / (2.0 * h),
                    (residual(&b, &r, &(t + step), &point) - residual(&b, &r, &(t - step), &point))
                        / (2.0 * h),
                    (residual(&b, &r, &t, &(point + step)) - residual(&b, &r, &t, &(point - step)))
                        / (2.0 * h),
                ];
                for row in 0..2 {
                    let m = a.wrt_camera_point[row];
                    let exact =
                        [rotation_row(&m, &x)[k], -point_row(&m, &rotation)[k], point_row(&m, &rotation)[k]];
                    for (exact, numeric) in exact.iter().zip(&numeric) {
                        assert!((exact - numeric[row]).abs() < 2e-7, "{exact} {numeric}");
                    }
                }
            }
        }
    }

    #[test]
    fn bearing_derivative_gives_the_gradient_of_the_squared_residual() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for _ in 0..300 {
            let (b, x) = (random_vector(&mut rng).normalize(), random_vector(&mut rng));
            if x.norm() < 0.2 || b.dot(&x.normalize()) < -0.7 {
                continue;
            }
            let db = b.cross(&random_vector(&mut rng));
            let a = angular(&b, &x);
            let change = bearing_change(&b, &a.direction, &db);
            let exact: f64 =
                (0..2).map(|row| 2.0 * a.residual[row] * a.wrt_direction[row].dot(&change)).sum();
            let h = 1e-6;
            let at = |s: f64| angular_squared(&(b + db * s).normalize(), &x);
            let numeric = (at(h) - at(-h)) / (2.0 * h);
            assert!((exact - numeric).abs() < 1e-6 * (1.0 + numeric.abs()), "{exact} {numeric}");
        }
    }
}
