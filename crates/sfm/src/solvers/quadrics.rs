use nalgebra::{Matrix3, Vector3};

use super::{Solutions, real_roots};

/// Coefficients of one quadric: x², xy, xz, y², yz, z², x, y, z, 1.
pub(super) type Quadric = [f64; 10];

/// For each hidden variable: monomials to eliminate (two squares and their product), and those that stay.
struct Hidden {
    /// Squares and product: u², uv, v².
    eliminated: [usize; 3],
    /// Coefficient of u (times hidden, times 1), of v, and of 1 (hidden², hidden, 1).
    u: [usize; 2],
    v: [usize; 2],
    one: [usize; 3],
    /// Positions of hidden, u, v in (x, y, z).
    order: [usize; 3],
}

const HIDDEN: [Hidden; 3] = [
    Hidden { eliminated: [3, 4, 5], u: [1, 7], v: [2, 8], one: [0, 6, 9], order: [0, 1, 2] },
    Hidden { eliminated: [0, 2, 5], u: [1, 6], v: [4, 8], one: [3, 7, 9], order: [1, 0, 2] },
    Hidden { eliminated: [0, 1, 3], u: [2, 6], v: [4, 7], one: [5, 8, 9], order: [2, 0, 1] },
];

/// Finds the common real points of three quadrics in (x, y, z).
///
/// Z. Kukelova, J. Heller, A. Fitzgibbon, "Efficient Intersection of Three Quadrics and Applications in Computer
/// Vision", CVPR 2016: with one variable hidden, u², uv and v² follow linearly from u, v and 1; the identities
/// u²·v = u·uv, uv·v = u·v² and u²·v² = (uv)² then are three linear equations in (u, v, 1) whose determinant has
/// degree 8. The variable whose elimination is best conditioned is hidden. Newton's method on the quadrics removes the
/// rounding. At most 8 points; none when every elimination is singular.
pub(super) fn intersect_quadrics(quadrics: &[Quadric; 3]) -> Solutions<Vector3<f64>, 8> {
    let mut points = Solutions::default();
    let mut best: Option<(f64, &Hidden, Matrix3<f64>)> = None;
    for hidden in &HIDDEN {
        let matrix = Matrix3::from_fn(|row, column| quadrics[row][hidden.eliminated[column]]);
        let size: f64 = (0..3).map(|row| matrix.row(row).norm()).product();
        let condition = matrix.determinant().abs() / size.max(f64::MIN_POSITIVE);
        if best.as_ref().is_none_or(|(most, _, _)| condition > *most) {
            best = Some((condition, hidden, matrix));
        }
    }
    let Some((_, hidden, matrix)) = best else {
        return points;
    };
    let Some(inverse) = matrix.try_inverse() else {
        return points;
    };
    let inverse = -inverse;
    let coefficient = |row: usize, monomial: usize| -> f64 {
        inverse[(row, 0)] * quadrics[0][monomial]
            + inverse[(row, 1)] * quadrics[1][monomial]
            + inverse[(row, 2)] * quadrics[2][monomial]
    };
    // Rows a, b, c: u² = a₁u + a₂v + a₃ and so on, ascending in the hidden variable.
    let row = |k: usize| {
        (
            [coefficient(k, hidden.u[1]), coefficient(k, hidden.u[0])],
            [coefficient(k, hidden.v[1]), coefficient(k, hidden.v[0])],
            [coefficient(k, hidden.one[2]), coefficient(k, hidden.one[1]), coefficient(k, hidden.one[0])],
        )
    };
    let ((a1, a2, a3), (b1, b2, b3), (c1, c2, c3)) = (row(0), row(1), row(2));
    // v·u² − u·uv.
    let difference = sub(&a1, &b2);
    let m11 = sub(&sub(&mul::<2, 2, 3>(&a2, &c1), &mul(&b1, &b2)), &b3);
    let m12 = add(&add(&sub(&mul::<2, 2, 3>(&difference, &b2), &mul(&b1, &a2)), &mul(&a2, &c2)), &a3);
    let m13 = add(&sub(&mul::<2, 3, 4>(&difference, &b3), &mul(&b1, &a3)), &mul(&a2, &c3));
    // v·uv − u·v².
    let difference = sub(&b1, &c2);
    let m21 = sub(&add(&sub(&mul::<2, 2, 3>(&difference, &b1), &mul(&c1, &a1)), &mul(&b2, &c1)), &c3);
    let m22 = add(&sub(&mul::<2, 2, 3>(&b1, &b2), &mul(&c1, &a2)), &b3);
    let m23 = add(&sub(&mul::<2, 3, 4>(&difference, &b3), &mul(&c1, &a3)), &mul(&b2, &c3));
    // u²·v² − (uv)².
    let uu = sub(&mul::<2, 2, 3>(&a1, &c1), &mul(&b1, &b1));
    let vv = sub(&mul::<2, 2, 3>(&a2, &c2), &mul(&b2, &b2));
    let uv = sub(&add(&mul::<2, 2, 3>(&a1, &c2), &mul(&a2, &c1)), &scale(&mul(&b1, &b2), 2.0));
    let u = sub(&add(&mul::<2, 3, 4>(&a1, &c3), &mul(&c1, &a3)), &scale(&mul(&b1, &b3), 2.0));
    let v = sub(&add(&mul::<2, 3, 4>(&a2, &c3), &mul(&c2, &a3)), &scale(&mul(&b2, &b3), 2.0));
    let one = sub(&mul::<3, 3, 5>(&a3, &c3), &mul(&b3, &b3));
    let m31 = add(&add(&add(&mul::<3, 2, 4>(&uu, &a1), &mul(&uv, &b1)), &mul(&vv, &c1)), &u);
    let m32 = add(&add(&add(&mul::<3, 2, 4>(&uu, &a2), &mul(&uv, &b2)), &mul(&vv, &c2)), &v);
    let m33 = add(&add(&add(&mul::<3, 3, 5>(&uu, &a3), &mul(&uv, &b3)), &mul(&vv, &c3)), &one);
    let minor1: [f64; 6] = sub(&mul::<3, 4, 6>(&m12, &m23), &mul(&m13, &m22));
    let minor2: [f64; 6] = sub(&mul::<4, 3, 6>(&m13, &m21), &mul(&m11, &m23));
    let minor3: [f64; 5] = sub(&mul::<3, 3, 5>(&m11, &m22), &mul(&m12, &m21));
    let polynomial: [f64; 9] =
        add(&add(&mul::<4, 6, 9>(&m31, &minor1), &mul(&m32, &minor2)), &mul(&m33, &minor3));
    for root in &real_roots(&polynomial) {
        let (r1, r2) = (
            Vector3::new(eval(&m11, *root), eval(&m12, *root), eval(&m13, *root)),
            Vector3::new(eval(&m21, *root), eval(&m22, *root), eval(&m23, *root)),
        );
        let r3 = Vector3::new(eval(&m31, *root), eval(&m32, *root), eval(&m33, *root));
        // The kernel is the cross product of the two rows that span most.
        let candidates = [r1.cross(&r2), r1.cross(&r3), r2.cross(&r3)];
        let relative = [
            candidates[0].norm_squared() / (r1.norm_squared() * r2.norm_squared()),
            candidates[1].norm_squared() / (r1.norm_squared() * r3.norm_squared()),
            candidates[2].norm_squared() / (r2.norm_squared() * r3.norm_squared()),
        ];
        let mut chosen = 0;
        for k in 1..3 {
            if relative[k] > relative[chosen] {
                chosen = k;
            }
        }
        let kernel = candidates[chosen];
        let mut point = Vector3::zeros();
        point[hidden.order[0]] = *root;
        point[hidden.order[1]] = kernel.x / kernel.z;
        point[hidden.order[2]] = kernel.y / kernel.z;
        if point.iter().all(|value| value.is_finite()) {
            points.push(newton(quadrics, point));
        }
    }
    points
}

/// Value and gradient of a quadric.
#[inline(always)]
pub(super) fn evaluate_quadric(q: &Quadric, p: &Vector3<f64>) -> (f64, Vector3<f64>) {
    let (x, y, z) = (p.x, p.y, p.z);
    (
        (q[0] * x + q[1] * y + q[2] * z + q[6]) * x + (q[3] * y + q[4] * z + q[7]) * y + (q[5] * z + q[8]) * z + q[9],
        Vector3::new(
            2.0 * q[0] * x + q[1] * y + q[2] * z + q[6],
            q[1] * x + 2.0 * q[3] * y + q[4] * z + q[7],
            q[2] * x + q[4] * y + 2.0 * q[5] * z + q[8],
        ),
    )
}

/// A few Newton steps, each kept only when it lowers the residual.
fn newton(quadrics: &[Quadric; 3], mut point: Vector3<f64>) -> Vector3<f64> {
    let mut last = f64::INFINITY;
    let mut kept = point;
    for _ in 0..5 {
        let [(f0, g0), (f1, g1), (f2, g2)] = [0, 1, 2].map(|k| evaluate_quadric(&quadrics[k], &point));
        let size = f0.abs() + f1.abs() + f2.abs();
        if !(size < last) {
            break;
        }
        kept = point;
        last = size;
        let (c0, c1, c2) = (g1.cross(&g2), g2.cross(&g0), g0.cross(&g1));
        point -= (c0 * f0 + c1 * f1 + c2 * f2) / g0.dot(&c0);
        if size < 1e-15 * (1.0 + point.norm_squared()) {
            break;
        }
    }
    kept
}

#[inline(always)]
fn mul<const A: usize, const B: usize, const C: usize>(a: &[f64; A], b: &[f64; B]) -> [f64; C] {
    let mut out = [0.0; C];
    for i in 0..A {
        for j in 0..B {
            out[i + j] += a[i] * b[j];
        }
    }
    out
}

#[inline(always)]
fn add<const A: usize>(a: &[f64; A], b: &[f64; A]) -> [f64; A] {
    std::array::from_fn(|i| a[i] + b[i])
}

#[inline(always)]
fn sub<const A: usize>(a: &[f64; A], b: &[f64; A]) -> [f64; A] {
    std::array::from_fn(|i| a[i] - b[i])
}

#[inline(always)]
fn scale<const A: usize>(a: &[f64; A], factor: f64) -> [f64; A] {
    a.map(|value| value * factor)
}

#[inline(always)]
fn eval<const A: usize>(a: &[f64; A], x: f64) -> f64 {
    a.iter().rev().fold(0.0, |value, coefficient| value * x + coefficient)
}
