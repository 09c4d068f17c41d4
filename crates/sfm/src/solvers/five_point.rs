use nalgebra::{Matrix3, Vector3};

use super::{Solutions, real_roots};

/// Index of the product of two of (x, y, z, 1) among x², xy, xz, y², yz, z², x, y, z, 1.
const LINEAR_LINEAR: [[usize; 4]; 4] = [[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]];
/// Index of the product of one of those ten and one of (x, y, z, 1) among the twenty cubic monomials in Nistér's order:
/// x³ y³ x²y xy² x²z x² y²z y² xyz xy | xz² xz x yz² yz y z³ z² z 1.
const QUADRATIC_LINEAR: [[usize; 4]; 10] = [
    [0, 2, 4, 5],
    [2, 3, 8, 9],
    [4, 8, 10, 11],
    [3, 1, 6, 7],
    [8, 6, 13, 14],
    [10, 13, 16, 17],
    [5, 9, 11, 12],
    [9, 7, 14, 15],
    [11, 14, 17, 18],
    [12, 15, 18, 19],
];

type Linear = [f64; 4];
type Quadratic = [f64; 10];
type Cubic = [f64; 20];

/// Finds the essential matrices of five pairs of bearings.
///
/// Equation: x₂ᵀ·E·x₁ = 0 for five pairs of unit bearings x₁ (first camera frame), x₂ (second), with
/// 2·E·Eᵀ·E − tr(E·Eᵀ)·E = 0; E = \[t\]×·R for second_from_first = (R, t). Scaled to ‖E‖² = 2.
///
/// D. Nistér, "An Efficient Solution to the Five-Point Relative Pose Problem", PAMI 2004: null space of the epipolar
/// constraints, elimination of the ten cubics, determinant of degree 10 by Sturm's sequence. Solutions whose
/// constraint residual shows rounding are polished by Gauss–Newton on the cubics. At most 10 solutions. Planar scenes
/// are allowed; degenerate for a pure rotation (any t) and for fewer than five independent pairs.
pub fn five_point(first: &[Vector3<f64>; 5], second: &[Vector3<f64>; 5]) -> Solutions<Matrix3<f64>, 10> {
    let mut solutions = Solutions::default();
    let basis = null_space(first, second);
    let constraints = constraint_matrix(&basis);
    let Some(reduced) = eliminate(constraints) else {
        return solutions;
    };
    // Rows e − z·f, g − z·h, i − z·j of Nistér's table: polynomials in z (ascending) times x, y and 1.
    let mut b = [([0.0; 4], [0.0; 4], [0.0; 5]); 3];
    for (row, target) in b.iter_mut().enumerate() {
        let (e, f) = (&reduced[2 * row], &reduced[2 * row + 1]);
        for (column, out) in [(0, &mut target.0), (3, &mut target.1)] {
            *out = [
                e[column + 2],
                e[column + 1] - f[column + 2],
                e[column] - f[column + 1],
                -f[column],
            ];
        }
        target.2 = [e[9], e[8] - f[9], e[7] - f[8], e[6] - f[7], -f[6]];
    }
    let polynomial = determinant(&b);
    for z in &real_roots(&polynomial) {
        let row = |k: usize| {
            let (x, y, one) = &b[k];
            Vector3::new(
                ((x[3] * z + x[2]) * z + x[1]) * z + x[0],
                ((y[3] * z + y[2]) * z + y[1]) * z + y[0],
                (((one[4] * z + one[3]) * z + one[2]) * z + one[1]) * z + one[0],
            )
        };
        let (r0, r1, r2) = (row(0), row(1), row(2));
        let candidates = [r0.cross(&r1), r0.cross(&r2), r1.cross(&r2)];
        let mut kernel = candidates[0];
        for candidate in &candidates[1..] {
            if candidate.z.abs() > kernel.z.abs() {
                kernel = *candidate;
            }
        }
        let mut weights = [kernel.x / kernel.z, kernel.y / kernel.z, *z, 1.0];
        if !weights.iter().all(|w| w.is_finite()) {
            continue;
        }
        let mut essential = combine(&basis, &weights);
        polish(&basis, &mut weights, &mut essential);
        solutions.push(essential);
    }
    solutions
}

/// Orthonormal basis of the matrices with x₂ᵀ·E·x₁ = 0, by Householder reflections.
fn null_space(first: &[Vector3<f64>; 5], second: &[Vector3<f64>; 5]) -> [Matrix3<f64>; 4] {
    let mut columns = [[0.0; 9]; 5];
    for (column, (a, b)) in columns.iter_mut().zip(first.iter().zip(second)) {
        for i in 0..3 {
            for j in 0..3 {
                column[3 * i + j] = b[i] * a[j];
            }
        }
    }
    let mut beta = [0.0; 5];
    for k in 0..5 {
        let norm = columns[k][k..].iter().map(|v| v * v).sum::<f64>().sqrt();
        let alpha = -norm.copysign(columns[k][k]);
        columns[k][k] -= alpha;
        let square = columns[k][k..].iter().map(|v| v * v).sum::<f64>();
        beta[k] = if square > 0.0 { 2.0 / square } else { 0.0 };
        let reflector = columns[k];
        for other in &mut columns[k + 1..] {
            let dot = (k..9).map(|i| reflector[i] * other[i]).sum::<f64>() * beta[k];
            for i in k..9 {
                other[i] -= dot * reflector[i];
            }
        }
    }
    let mut basis = [Matrix3::zeros(); 4];
    for (n, matrix) in basis.iter_mut().enumerate() {
        let mut vector = [0.0; 9];
        vector[5 + n] = 1.0;
        for k in (0..5).rev() {
            let dot = (k..9).map(|i| columns[k][i] * vector[i]).sum::<f64>() * beta[k];
            for i in k..9 {
                vector[i] -= dot * columns[k][i];
            }
        }
        *matrix = Matrix3::from_row_slice(&vector);
    }
    basis
}

#[inline(always)]
fn add_linear_linear(out: &mut Quadratic, a: &Linear, b: &Linear, factor: f64) {
    for i in 0..4 {
        for j in 0..4 {
            out[LINEAR_LINEAR[i][j]] += factor * a[i] * b[j];
        }
    }
}

#[inline(always)]
fn add_quadratic_linear(out: &mut Cubic, a: &Quadratic, b: &Linear) {
    for i in 0..10 {
        for j in 0..4 {
            out[QUADRATIC_LINEAR[i][j]] += a[i] * b[j];
        }
    }
}

/// The ten cubics det E = 0 and (E·Eᵀ − ½·tr(E·Eᵀ))·E = 0 in the weights of the basis.
fn constraint_matrix(basis: &[Matrix3<f64>; 4]) -> [Cubic; 10] {
    let mut e = [[[0.0; 4]; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            e[i][j] = [basis[0][(i, j)], basis[1][(i, j)], basis[2][(i, j)], basis[3][(i, j)]];
        }
    }
    let mut product = [[[0.0; 10]; 3]; 3];
    for i in 0..3 {
        for j in i..3 {
            for k in 0..3 {
                add_linear_linear(&mut product[i][j], &e[i][k], &e[j][k], 1.0);
            }
        }
    }
    for m in 0..10 {
        let half_trace = 0.5 * (product[0][0][m] + product[1][1][m] + product[2][2][m]);
        for i in 0..3 {
            product[i][i][m] -= half_trace;
        }
    }
    let mut rows = [[0.0; 20]; 10];
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                let left = &product[i.min(k)][i.max(k)];
                add_quadratic_linear(&mut rows[3 * i + j], left, &e[k][j]);
            }
        }
    }
    for k in 0..3 {
        let (a, b) = ((k + 1) % 3, (k + 2) % 3);
        let mut minor = [0.0; 10];
        add_linear_linear(&mut minor, &e[1][a], &e[2][b], 1.0);
        add_linear_linear(&mut minor, &e[1][b], &e[2][a], -1.0);
        add_quadratic_linear(&mut rows[9], &minor, &e[0][k]);
    }
    rows
}

/// Rows of x²z, x², y²z, y², xyz, xy in terms of the last ten monomials.
fn eliminate(mut m: [Cubic; 10]) -> Option<[[f64; 10]; 6]> {
    for k in 0..10 {
        let mut pivot = k;
        for i in k + 1..10 {
            if m[i][k].abs() > m[pivot][k].abs() {
                pivot = i;
            }
        }
        m.swap(k, pivot);
        let inverse = 1.0 / m[k][k];
        if !inverse.is_finite() {
            return None;
        }
        for value in &mut m[k][k..] {
            *value *= inverse;
        }
        let row = m[k];
        // The first four rows are not needed later, so nothing is eliminated above them.
        for i in (4..k).chain(k + 1..10) {
            let factor = m[i][k];
            for j in k..20 {
                m[i][j] -= factor * row[j];
            }
        }
    }
    let mut reduced = [[0.0; 10]; 6];
    for (out, row) in reduced.iter_mut().zip(&m[4..]) {
        out.copy_from_slice(&row[10..]);
    }
    Some(reduced)
}

fn multiply<const A: usize, const B: usize, const C: usize>(a: &[f64; A], b: &[f64; B]) -> [f64; C] {
    let mut out = [0.0; C];
    for i in 0..A {
        for j in 0..B {
            out[i + j] += a[i] * b[j];
        }
    }
    out
}

/// Determinant of the 3×3 polynomial matrix, ascending.
fn determinant(b: &[([f64; 4], [f64; 4], [f64; 5]); 3]) -> [f64; 11] {
    let mut out = [0.0; 11];
    for k in 0..3 {
        let (p, q) = (&b[(k + 1) % 3], &b[(k + 2) % 3]);
        let (left, right): ([f64; 7], [f64; 7]) = (multiply(&p.0, &q.1), multiply(&p.1, &q.0));
        let mut minor = [0.0; 7];
        for i in 0..7 {
            minor[i] = left[i] - right[i];
        }
        let term: [f64; 11] = multiply(&minor, &b[k].2);
        for i in 0..11 {
            out[i] += term[i];
        }
    }
    out
}

/// Σ weights·basis, scaled to squared norm 2.
#[inline]
fn combine(basis: &[Matrix3<f64>; 4], weights: &[f64; 4]) -> Matrix3<f64> {
    let square = weights.iter().map(|w| w * w).sum::<f64>();
    let sum = basis[0] * weights[0] + basis[1] * weights[1] + basis[2] * weights[2] + basis[3] * weights[3];
    sum * (2.0 / square).sqrt()
}

#[inline]
fn trace_residual(e: &Matrix3<f64>) -> Matrix3<f64> {
    let product = e * e.transpose();
    (product - Matrix3::from_diagonal_element(0.5 * product.trace())) * e
}

/// Gauss–Newton on the trace constraint over the weights, where rounding left a visible residual.
fn polish(basis: &[Matrix3<f64>; 4], weights: &mut [f64; 4], essential: &mut Matrix3<f64>) {
    for _ in 0..3 {
        let residual = trace_residual(essential);
        if residual.norm_squared() < 1e-26 {
            return;
        }
        // Central differences cost as much as the derivative here; d(P·E) with P = E·Eᵀ − ½·tr:
        let product = *essential * essential.transpose();
        let shifted = product - Matrix3::from_diagonal_element(0.5 * product.trace());
        let (mut normal, mut gradient) = (nalgebra::Matrix4::zeros(), nalgebra::Vector4::zeros());
        let mut derivatives = [Matrix3::zeros(); 4];
        for (derivative, direction) in derivatives.iter_mut().zip(basis) {
            let cross = direction * essential.transpose();
            let symmetric = cross + cross.transpose();
            let change = symmetric - Matrix3::from_diagonal_element(0.5 * symmetric.trace());
            *derivative = change * *essential + shifted * direction;
        }
        let size = (2.0 / weights.iter().map(|w| w * w).sum::<f64>()).sqrt();
        let scaled = nalgebra::Vector4::from(*weights) * size;
        for i in 0..4 {
            gradient[i] = derivatives[i].dot(&residual);
            for j in 0..4 {
                // The gauge ‖weights‖ = const enters as a fifth equation.
                normal[(i, j)] = derivatives[i].dot(&derivatives[j]) + scaled[i] * scaled[j];
            }
        }
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&gradient)) else {
            return;
        };
        let candidate: [f64; 4] = (scaled - step).into();
        let next = combine(basis, &candidate);
        if trace_residual(&next).norm_squared() >= residual.norm_squared() {
            return;
        }
        *weights = candidate;
        *essential = next;
    }
}

#[cfg(test)]
mod tests {
    use super::five_point;
    use crate::solvers::essential::essential_from_pose;
    use crate::synthetic::{RelativeProblem, seeded};

    #[test]
    fn finds_the_truth_of_exact_data_over_the_whole_sphere() {
        let mut rng = seeded("five_point");
        let mut missed = 0;
        for _ in 0..1000 {
            let problem = RelativeProblem::exact(&mut rng, 5);
            let truth = essential_from_pose(&problem.second_from_first);
            let (first, second) = problem.sample();
            let error = five_point(&first, &second)
                .iter()
                .map(|e| (e - truth).norm().min((e + truth).norm()))
                .fold(f64::INFINITY, f64::min);
            missed += u32::from(!(error < 1e-9));
        }
        assert!(missed <= 2, "{missed}");
    }

    #[test]
    fn survives_repeated_pairs() {
        let mut rng = seeded("repeated");
        let (mut first, mut second) = RelativeProblem::exact(&mut rng, 5).sample::<5>();
        first[4] = first[0];
        second[4] = second[0];
        for essential in &five_point(&first, &second) {
            assert!(essential.iter().all(|value| value.is_finite()));
        }
    }
}
