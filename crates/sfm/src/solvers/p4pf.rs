use nalgebra::{Matrix3, Vector2, Vector3};

use super::Solutions;
use super::null_space::null_space;
use super::quadrics::{Quadric, evaluate_quadric, intersect_quadrics};
use crate::Rigid;

/// A pinhole camera found by [`p4pf`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PoseWithFocal {
    /// The pose.
    pub world_from_camera: Rigid,
    /// Focal length in pixels.
    pub focal: f64,
}

/// Mixes the fourth quadric into the other three, so that none of their special common points remain.
const MIX: [f64; 3] = [0.61, -0.37, 0.83];

/// Finds pose and focal length of a pinhole camera from four pixels and the points they see.
///
/// Equation: μᵢ·(uᵢ, vᵢ, 1) = diag(f, f, 1)·(R·Xᵢ + t) with μᵢ > 0 and f > 0 for i = 1 … 4; (u, v) are pixels relative
/// to the principal point (x right, y down, z forward, square pixels, no distortion), Xᵢ points in the world, (R, t)
/// camera_from_world. Being pixels of a pinhole camera, they exist in front of it only: here μ > 0 is z > 0.
///
/// Eight equations linear in the 3×4 camera matrix leave a null space of four dimensions (B. Triggs, "Camera Pose and
/// Calibration from 4 or 5 Known 3D Points", ICCV 1999); rows p₁, p₂, p₃ of its left block obey p₁·p₂ = p₁·p₃ = p₂·p₃ =
/// 0 and ‖p₁‖ = ‖p₂‖: four quadrics in three unknowns, of which three combinations are intersected as by Z. Kukelova,
/// J. Heller, A. Fitzgibbon, CVPR 2016, and the fourth orders the solutions. At most 8. Degenerate when three points
/// are collinear, and for planes parallel to the image (focal length and distance are then one unknown).
pub fn p4pf(pixels: &[Vector2<f64>; 4], points_in_world: &[Vector3<f64>; 4]) -> Solutions<PoseWithFocal, 8> {
    let mean = points_in_world.iter().sum::<Vector3<f64>>() / 4.0;
    let unit = points_in_world.iter().map(|x| (x - mean).norm()).fold(0.0, f64::max);
    let reach = pixels.iter().map(nalgebra::Matrix::norm).fold(0.0, f64::max);
    if !(unit > 0.0) || !(reach > 0.0) {
        return Solutions::default();
    }
    let points = points_in_world.map(|x| (x - mean) / unit);
    let mut columns = [[0.0; 12]; 8];
    for i in 0..4 {
        let (pixel, x) = (pixels[i] / reach, points[i]);
        let homogeneous = [x.x, x.y, x.z, 1.0];
        for k in 0..4 {
            columns[2 * i][k] = homogeneous[k];
            columns[2 * i][8 + k] = -pixel.x * homogeneous[k];
            columns[2 * i + 1][4 + k] = homogeneous[k];
            columns[2 * i + 1][8 + k] = -pixel.y * homogeneous[k];
        }
    }
    let basis: [_; 4] = null_space(columns);
    let row = |n: usize, r: usize| Vector3::new(basis[n][4 * r], basis[n][4 * r + 1], basis[n][4 * r + 2]);
    let orthogonal = |r: usize, s: usize| quadric(|m, n| row(m, r).dot(&row(n, s)));
    let norms = quadric(|m, n| row(m, 0).dot(&row(n, 0)) - row(m, 1).dot(&row(n, 1)));
    let plain = [orthogonal(0, 1), orthogonal(0, 2), orthogonal(1, 2)];
    let mixed = [0, 1, 2].map(|k| std::array::from_fn(|m| plain[k][m] + MIX[k] * norms[m]));
    let mut solutions = Solutions::<(f64, PoseWithFocal), 8>::default();
    for weights in &intersect_quadrics(&mixed) {
        let size = (1.0 + weights.norm_squared()).sqrt();
        let residual = evaluate_quadric(&norms, weights).0.abs() / (size * size);
        let camera = (basis[0] * weights.x + basis[1] * weights.y + basis[2] * weights.z + basis[3]) / size;
        let left = Matrix3::new(
            camera[0], camera[1], camera[2], camera[4], camera[5], camera[6], camera[8], camera[9],
            camera[10],
        );
        let sign = left.determinant().signum();
        let (n0, n1, n2) =
            (left.row(0).norm_squared(), left.row(1).norm_squared(), left.row(2).norm_squared());
        let focal = (0.5 * (n0 + n1) / n2).sqrt();
        let scale = sign / n2.sqrt();
        if !focal.is_finite() || !(focal > 0.0) || !scale.is_finite() {
            continue;
        }
        let inverse = Vector3::new(scale / focal, scale / focal, scale);
        // With noise the rows are not quite orthogonal: the nearest rotation replaces them.
        let svd = (Matrix3::from_diagonal(&inverse) * left).svd(true, true);
        let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
            continue;
        };
        let rotation = u * v_t;
        let translation = inverse.component_mul(&Vector3::new(camera[3], camera[7], camera[11]));
        if !points.iter().all(|x| (rotation * x + translation).z > 0.0) {
            continue;
        }
        let camera_from_world = Rigid::from_matrix(&rotation, translation * unit - rotation * mean);
        let world_from_camera = camera_from_world.inverse();
        solutions.push((residual, PoseWithFocal { world_from_camera, focal: focal * reach }));
    }
    solutions.by_residual()
}

/// The quadric of the symmetric part of a form over the four basis vectors, the last of weight 1.
fn quadric(form: impl Fn(usize, usize) -> f64) -> Quadric {
    let cross = |m, n| form(m, n) + form(n, m);
    [
        form(0, 0),
        cross(0, 1),
        cross(0, 2),
        form(1, 1),
        cross(1, 2),
        form(2, 2),
        cross(0, 3),
        cross(1, 3),
        cross(2, 3),
        form(3, 3),
    ]
}

#[cfg(test)]
mod tests {
    use super::p4pf;
    use crate::synthetic::{FocalProblem, rotation_angle, seeded};

    #[test]
    fn finds_the_truth_of_exact_data() {
        let mut rng = seeded("p4pf");
        let mut missed = 0;
        for _ in 0..2000 {
            let problem = FocalProblem::exact(&mut rng, 4);
            let pixels = std::array::from_fn(|i| problem.pixels[i]);
            let points = std::array::from_fn(|i| problem.points[i]);
            let truth = problem.world_from_camera;
            missed += u32::from(!p4pf(&pixels, &points).iter().any(|found| {
                (found.focal / problem.focal).ln().abs() < 1e-5
                    && rotation_angle(&found.world_from_camera.rotation, &truth.rotation) < 1e-5
                    && (found.world_from_camera.translation - truth.translation).norm() < 1e-4
            }));
        }
        assert!(missed <= 4, "{missed}");
    }

    #[test]
    fn repeated_points_have_no_answer_that_is_not_finite() {
        let mut problem = FocalProblem::exact(&mut seeded("p4pf repeated"), 4);
        problem.points[3] = problem.points[0];
        problem.pixels[3] = problem.pixels[0];
        let pixels = std::array::from_fn(|i| problem.pixels[i]);
        let points = std::array::from_fn(|i| problem.points[i]);
        for found in &p4pf(&pixels, &points) {
            assert!(
                found.focal.is_finite() && found.world_from_camera.translation.iter().all(|v| v.is_finite())
            );
        }
    }
}
