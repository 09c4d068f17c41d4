use nalgebra::{Matrix3, Vector3};

use super::Solutions;
use crate::Rigid;

/// Discriminants above minus this, relative to their terms, count as a double root.
const DOUBLE_ROOT: f64 = 1e-12;

/// Finds world_from_camera from three points seen by a camera.
///
/// Equation: Xᵢ = R·λᵢ·bᵢ + c with λᵢ > 0 for i = 1, 2, 3; bᵢ are unit bearings in the camera frame, Xᵢ points in the
/// world, c the camera's centre; the depths obey λᵢ² + λⱼ² − 2·(bᵢ·bⱼ)·λᵢ·λⱼ = ‖Xᵢ − Xⱼ‖².
///
/// The two homogeneous quadrics in λ that follow are two conics; a degenerate conic of their pencil, found by a cubic,
/// splits into two lines (M. Persson, K. Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective Three Point
/// (P3P) Solver", ECCV 2018; the split by the adjugate as in Y. Ding et al., "Revisiting the P3P Problem", CVPR 2023).
/// Gauss–Newton on the depths removes the rounding. At most 4 solutions. Degenerate when the points are collinear or
/// the centre lies on the danger cylinder through them (double solutions).
pub fn p3p(bearings: &[Vector3<f64>; 3], points_in_world: &[Vector3<f64>; 3]) -> Solutions<Rigid, 4> {
    let mut poses = Solutions::default();
    let [b1, b2, b3] = bearings;
    let [x1, x2, x3] = points_in_world;
    let (d12, d13, d23) = (x1 - x2, x1 - x3, x2 - x3);
    let distances = Vector3::new(d12.norm_squared(), d13.norm_squared(), d23.norm_squared());
    let normal = d12.cross(&d13);
    if !(normal.norm_squared() > 1e-20 * distances.x * distances.y) || !(distances.z > 0.0) {
        return poses;
    }
    let cosines = Vector3::new(b1.dot(b2), b1.dot(b3), b2.dot(b3));
    let world_frame = Matrix3::from_columns(&[d12, d13, normal]);
    let Some(world_frame_inverse) = world_frame.try_inverse() else {
        return poses;
    };
    for depths in &depths_of_three(&cosines, &distances) {
        let depths = refine_depths(*depths, &cosines, &distances);
        if !(depths.min() > 0.0) {
            continue;
        }
        let (y1, y2, y3) = (b1 * depths.x, b2 * depths.y, b3 * depths.z);
        let (e12, e13) = (y1 - y2, y1 - y3);
        let camera_frame = Matrix3::from_columns(&[e12, e13, e12.cross(&e13)]);
        let world_from_camera = (camera_frame * world_frame_inverse).transpose();
        poses.push(Rigid::from_matrix(&world_from_camera, x1 - world_from_camera * y1));
    }
    poses
}

/// Positive depths (up to rounding) from the cosines and squared distances of the pairs 12, 13, 23.
fn depths_of_three(cosines: &Vector3<f64>, distances: &Vector3<f64>) -> Solutions<Vector3<f64>, 4> {
    let mut solutions = Solutions::default();
    let (c12, c13, c23) = (cosines.x, cosines.y, cosines.z);
    let (a, b) = (distances.x / distances.z, distances.y / distances.z);
    let mut first = Matrix3::new(1.0, -c12, 0.0, -c12, 1.0 - a, a * c23, 0.0, a * c23, -a);
    let mut second = Matrix3::new(1.0, 0.0, -c13, 0.0, -b, b * c23, -c13, b * c23, 1.0 - b);
    let (adjugate_first, adjugate_second) = (symmetric_adjugate(&first), symmetric_adjugate(&second));
    let mut cubic = [
        first.column(0).dot(&adjugate_first.column(0)),
        adjugate_first.component_mul(&second).sum(),
        adjugate_second.component_mul(&first).sum(),
        second.column(0).dot(&adjugate_second.column(0)),
    ];
    if cubic[0].abs() > cubic[3].abs() {
        std::mem::swap(&mut first, &mut second);
        cubic.reverse();
    }
    let gamma = cubic_root(&cubic);
    let degenerate = first + second * gamma;
    let Some(lines) = split_conic(&degenerate) else {
        return solutions;
    };
    // On the lines of D₁ + γ·D₂ = 0 the two conics are proportional: take the one that is larger there.
    let conic = if gamma.abs() > 1.0 { first } else { second };
    for line in &lines {
        intersect(line, &conic, cosines, distances, &mut solutions);
    }
    solutions
}

#[inline]
fn symmetric_adjugate(m: &Matrix3<f64>) -> Matrix3<f64> {
    let (a, b, c, d, e, f) = (m[(0, 0)], m[(0, 1)], m[(0, 2)], m[(1, 1)], m[(1, 2)], m[(2, 2)]);
    let (ab, ac, bc) = (c * e - b * f, b * e - c * d, b * c - a * e);
    Matrix3::new(d * f - e * e, ab, ac, ab, a * f - c * c, bc, ac, bc, a * d - b * b)
}

/// One real root of a cubic (ascending coefficients): the one farthest from the inflection, hence the best separated.
#[inline]
fn cubic_root(f: &[f64; 4]) -> f64 {
    let (b, c, d) = (f[2] / f[3], f[1] / f[3], f[0] / f[3]);
    let shift = b / 3.0;
    let p = c - b * shift;
    let q = (2.0 * shift * shift - c) * shift + d;
    let discriminant = 0.25 * q * q + p * p * p / 27.0;
    let y = if discriminant > 0.0 {
        let u = -q.signum() * (0.5 * q.abs() + discriminant.sqrt()).cbrt();
        u - p / (3.0 * u)
    } else {
        let radius = (-p / 3.0).max(0.0).sqrt();
        let cosine = (0.5 * q.abs() / (radius * radius * radius)).min(1.0);
        let largest = 2.0 * radius * (if cosine.is_finite() { cosine.acos() / 3.0 } else { 0.0 }).cos();
        -q.signum() * largest
    };
    let mut x = y - shift;
    for _ in 0..2 {
        let value = ((x + b) * x + c) * x + d;
        let slope = (3.0 * x + 2.0 * b) * x + c;
        let next = x - value / slope;
        if !next.is_finite() {
            break;
        }
        x = next;
    }
    x
}

/// The two lines of a degenerate conic, or `None` when they are not real.
#[inline]
fn split_conic(conic: &Matrix3<f64>) -> Option<[Vector3<f64>; 2]> {
    // C = l·mᵀ + m·lᵀ has adjugate −p·pᵀ with p = l × m, and C + [p]× = 2·m·lᵀ or its transpose.
    let adjugate = symmetric_adjugate(conic);
    let k = (0..3).max_by(|i, j| adjugate[(*i, *i)].abs().total_cmp(&adjugate[(*j, *j)].abs()))?;
    let diagonal = -adjugate[(k, k)];
    let size = conic.norm_squared();
    if diagonal < -DOUBLE_ROOT * size {
        return None;
    }
    let p = if diagonal > 1e-30 * size {
        -adjugate.column(k) / diagonal.sqrt()
    } else {
        Vector3::zeros()
    };
    let product = conic + p.cross_matrix();
    let mut best = (0, 0);
    for i in 0..3 {
        for j in 0..3 {
            if product[(i, j)].abs() > product[best].abs() {
                best = (i, j);
            }
        }
    }
    Some([product.row(best.0).transpose(), product.column(best.1).into_owned()])
}

/// Depths on a line l·λ = 0 of depth space that obey λᵀ·C·λ = 0, scaled to the distances.
#[inline]
fn intersect(
    line: &Vector3<f64>,
    conic: &Matrix3<f64>,
    cosines: &Vector3<f64>,
    distances: &Vector3<f64>,
    solutions: &mut Solutions<Vector3<f64>, 4>,
) {
    let i = line.iamax();
    let (j, k) = ((i + 1) % 3, (i + 2) % 3);
    // λᵢ = u·λⱼ + v·λₖ.
    let (u, v) = (-line[j] / line[i], -line[k] / line[i]);
    let (cii, cij, cik) = (conic[(i, i)], conic[(i, j)], conic[(i, k)]);
    let a = cii * u * u + 2.0 * cij * u + conic[(j, j)];
    let half_b = cii * u * v + cij * v + cik * u + conic[(j, k)];
    let c = cii * v * v + 2.0 * cik * v + conic[(k, k)];
    let mut discriminant = half_b * half_b - a * c;
    if discriminant < 0.0 {
        if discriminant < -DOUBLE_ROOT * (half_b * half_b + (a * c).abs()) {
            return;
        }
        discriminant = 0.0;
    }
    let q = -(half_b + discriminant.sqrt().copysign(half_b));
    for (lj, lk) in [(q, a), (c, q)] {
        // λⱼ : λₖ = q : a and c : q are the two roots, without cancellation.
        let mut depths = Vector3::zeros();
        depths[j] = lj.abs();
        depths[k] = lk.abs();
        depths[i] = u * depths[j] + v * depths[k];
        if lj * lk <= 0.0 || !(depths[i] > 0.0) {
            continue;
        }
        let form = depths.x * (depths.x - cosines.x * depths.y)
            + depths.y * (depths.y - cosines.z * depths.z)
            + depths.z * (depths.z - cosines.y * depths.x);
        if form > 0.0 {
            solutions.push(depths * (0.5 * distances.sum() / form).sqrt());
        }
    }
}

/// Gauss–Newton on the three distance equations.
#[inline]
fn refine_depths(mut depths: Vector3<f64>, cosines: &Vector3<f64>, distances: &Vector3<f64>) -> Vector3<f64> {
    let tolerance = 1e-15 * distances.max();
    for _ in 0..4 {
        let (l1, l2, l3) = (depths.x, depths.y, depths.z);
        let (c12, c13, c23) = (cosines.x, cosines.y, cosines.z);
        let r12 = l1 * l1 + l2 * l2 - 2.0 * c12 * l1 * l2 - distances.x;
        let r13 = l1 * l1 + l3 * l3 - 2.0 * c13 * l1 * l3 - distances.y;
        let r23 = l2 * l2 + l3 * l3 - 2.0 * c23 * l2 * l3 - distances.z;
        if r12.abs() + r13.abs() + r23.abs() <= tolerance {
            break;
        }
        // Rows: [p, q, 0], [r, 0, s], [0, t, w], halved.
        let (p, q) = (l1 - c12 * l2, l2 - c12 * l1);
        let (r, s) = (l1 - c13 * l3, l3 - c13 * l1);
        let (t, w) = (l2 - c23 * l3, l3 - c23 * l2);
        let determinant = -p * s * t - q * r * w;
        let scale = 0.5 / determinant;
        if !scale.is_finite() {
            break;
        }
        let step = Vector3::new(
            -s * t * r12 - q * w * r13 + q * s * r23,
            -r * w * r12 + p * w * r13 - p * s * r23,
            r * t * r12 - p * t * r13 - q * r * r23,
        ) * scale;
        depths -= step;
    }
    depths
}

#[cfg(test)]
mod tests {
    use super::p3p;
    use crate::synthetic::{AbsoluteProblem, rotation_angle, seeded};
    use nalgebra::Vector3;

    #[test]
    fn finds_the_truth_of_exact_data_over_the_whole_sphere() {
        let mut rng = seeded("p3p");
        let mut missed = 0;
        for _ in 0..10_000 {
            let problem = AbsoluteProblem::exact(&mut rng, 3);
            let bearings = [problem.bearings[0], problem.bearings[1], problem.bearings[2]];
            let points = [problem.points[0], problem.points[1], problem.points[2]];
            let truth = problem.world_from_camera;
            let poses = p3p(&bearings, &points);
            for pose in &poses {
                for (bearing, point) in bearings.iter().zip(&points) {
                    assert!(bearing.dot(&pose.inverse_transform_point(point)) > 0.0);
                }
            }
            missed += u32::from(!poses.iter().any(|pose| {
                rotation_angle(&pose.rotation, &truth.rotation) < 1e-6
                    && (pose.translation - truth.translation).norm() < 1e-5
            }));
        }
        assert!(missed <= 5, "{missed}");
    }

    #[test]
    fn exact_data_give_nine_digits() {
        let bearings = [Vector3::new(0.0, 0.6, -0.8), Vector3::new(1.0, 0.0, 0.0), Vector3::new(-0.6, -0.8, 0.0)];
        let pose = crate::Rigid::new(
            nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -2.0, 1.0)),
            Vector3::new(4.0, 5.0, -6.0),
        );
        let points = [
            pose.transform_point(&(bearings[0] * 3.0)),
            pose.transform_point(&(bearings[1] * 5.0)),
            pose.transform_point(&(bearings[2] * 2.0)),
        ];
        assert!(p3p(&bearings, &points).iter().any(|found| {
            (found.translation - pose.translation).norm() < 1e-9
                && rotation_angle(&found.rotation, &pose.rotation) < 1e-9
        }));
    }

    #[test]
    fn refuses_collinear_and_repeated_points() {
        let bearings = [Vector3::x(), Vector3::y(), Vector3::z()];
        let line = [0.0, 1.0, 2.5].map(|k| Vector3::new(k, 2.0 * k, 3.0));
        assert!(p3p(&bearings, &line).is_empty());
        assert!(p3p(&bearings, &[Vector3::x(); 3]).is_empty());
    }
}
