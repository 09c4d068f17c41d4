use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::quadrics::Quadric;

/// Cayley's parameters of a fixed generic rotation.
///
/// Cayley's parametrization has no half turns, which upright frames that look at each other do have: world points are
/// turned by this first. No product with one of the 24 axis permutations is a half turn.
const GENERIC: [f64; 3] = [0.2, 0.35, 0.6];

/// The generic rotation as a matrix.
pub(super) fn generic_rotation() -> Matrix3<f64> {
    let v = Vector3::from(GENERIC);
    cayley_numerator(&v) / (1.0 + v.norm_squared())
}

/// (1 + ‖v‖²)·R for the rotation with quaternion ∝ (1, v).
#[inline]
pub(super) fn cayley_numerator(v: &Vector3<f64>) -> Matrix3<f64> {
    let (x, y, z) = (v.x, v.y, v.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    Matrix3::new(
        1.0 + xx - yy - zz,
        2.0 * (x * y - z),
        2.0 * (x * z + y),
        2.0 * (x * y + z),
        1.0 - xx + yy - zz,
        2.0 * (y * z - x),
        2.0 * (x * z - y),
        2.0 * (y * z + x),
        1.0 - xx - yy + zz,
    )
}

/// The quadric in v of Σ rows·R + constant = 0, with R's nine entries by rows, times (1 + ‖v‖²).
#[inline(always)]
pub(super) fn rotation_quadric(a: &[f64], constant: f64) -> Quadric {
    [
        a[0] - a[4] - a[8] + constant,
        2.0 * (a[1] + a[3]),
        2.0 * (a[2] + a[6]),
        a[4] - a[0] - a[8] + constant,
        2.0 * (a[5] + a[7]),
        a[8] - a[0] - a[4] + constant,
        2.0 * (a[7] - a[5]),
        2.0 * (a[2] - a[6]),
        2.0 * (a[3] - a[1]),
        a[0] + a[4] + a[8] + constant,
    ]
}

/// Coefficients of nᵀ·Rᵀ·x in the nine entries of Rᵀ by rows.
#[inline(always)]
pub(super) fn rotation_row(n: &Vector3<f64>, x: &Vector3<f64>) -> [f64; 9] {
    [n.x * x.x, n.x * x.y, n.x * x.z, n.y * x.x, n.y * x.y, n.y * x.z, n.z * x.x, n.z * x.y, n.z * x.z]
}

/// World from set of a set_from_world rotation matrix.
#[inline]
pub(super) fn inverse_rotation(set_from_world: &Matrix3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(set_from_world.transpose()))
}

/// Householder elimination of the first `columns` columns of `rows`; the rows from `columns` on are free of them.
///
/// Returns `false` when a column depends on the earlier ones (relative to the matrix's size).
#[inline(always)]
pub(super) fn eliminate_columns<const M: usize, const N: usize>(
    rows: &mut [[f64; N]; M],
    columns: usize,
) -> bool {
    for k in 0..columns {
        let total: f64 = rows.iter().map(|row| row[k] * row[k]).sum();
        let below: f64 = rows[k..].iter().map(|row| row[k] * row[k]).sum();
        if !(below > 1e-20 * total) {
            return false;
        }
        let alpha = -below.sqrt().copysign(rows[k][k]);
        let head = rows[k][k] - alpha;
        let beta = 1.0 / (alpha * head);
        let mut reflector = [0.0; M];
        reflector[k] = head;
        for i in k + 1..M {
            reflector[i] = rows[i][k];
        }
        let mut dots = [0.0; N];
        for i in k..M {
            for j in k + 1..N {
                dots[j] += reflector[i] * rows[i][j];
            }
        }
        for i in k..M {
            let factor = beta * reflector[i];
            for j in k + 1..N {
                rows[i][j] += factor * dots[j];
            }
        }
        rows[k][k] = alpha;
        for row in &mut rows[k + 1..] {
            row[k] = 0.0;
        }
    }
    true
}
