//! Essential matrices and the relative poses they stand for.

use nalgebra::{Matrix3, Vector3};

use super::Solutions;
use crate::Rigid;

/// The essential matrix E = \[t\]×·R of second_from_first, with x₂ᵀ·E·x₁ = 0 and ‖E‖² = 2 for a unit t.
pub fn essential_from_pose(second_from_first: &Rigid) -> Matrix3<f64> {
    second_from_first.translation.cross_matrix() * second_from_first.rotation.to_rotation_matrix().matrix()
}

/// The four poses second_from_first (unit translation) of an essential matrix; empty when E has no direction.
///
/// B. K. P. Horn, "Recovering Baseline and Orientation from Essential Matrix", 1990: with ‖E‖² = 2 and Eᵀ·t = 0,
/// R = cof(E) ∓ \[t\]×·E. The sign of E is free; each rotation goes with ±t.
pub fn poses_of_essential(essential: &Matrix3<f64>) -> Solutions<Rigid, 4> {
    let mut poses = Solutions::default();
    for (rotation, translation) in &rotations_of_essential(essential) {
        poses.push(Rigid::from_matrix(rotation, *translation));
    }
    poses
}

/// As [`poses_of_essential`] with rotation matrices.
pub fn rotations_of_essential(essential: &Matrix3<f64>) -> Solutions<(Matrix3<f64>, Vector3<f64>), 4> {
    let mut poses = Solutions::default();
    let scale = (2.0 / essential.norm_squared()).sqrt();
    if !scale.is_finite() {
        return poses;
    }
    let e = essential * scale;
    let (c0, c1, c2) = (e.column(0).into_owned(), e.column(1).into_owned(), e.column(2).into_owned());
    let cofactors = Matrix3::from_columns(&[c1.cross(&c2), c2.cross(&c0), c0.cross(&c1)]);
    let longest = (0..3).fold(0, |best, k| {
        if cofactors.column(k).norm_squared() > cofactors.column(best).norm_squared() { k } else { best }
    });
    let Some(translation) = cofactors.column(longest).into_owned().try_normalize(1e-12) else {
        return poses;
    };
    let twist = translation.cross_matrix() * e;
    for rotation in [cofactors - twist, cofactors + twist] {
        poses.push((rotation, translation));
        poses.push((rotation, -translation));
    }
    poses
}

/// Signs of the depths (λ₁, λ₂) in λ₂·x₂ = R·λ₁·x₁ + t; `rotated` is R·x₁.
///
/// Returned are the depths times ‖x₂ × R·x₁‖², which is zero for parallel rays.
#[inline]
pub fn depth_signs(rotated: &Vector3<f64>, translation: &Vector3<f64>, second: &Vector3<f64>) -> (f64, f64) {
    let normal = second.cross(rotated);
    (translation.cross(second).dot(&normal), translation.cross(rotated).dot(&normal))
}

/// Whether both depths of [`depth_signs`] are positive.
#[inline]
pub fn is_in_front(rotated: &Vector3<f64>, translation: &Vector3<f64>, second: &Vector3<f64>) -> bool {
    let (near, far) = depth_signs(rotated, translation, second);
    near > 0.0 && far > 0.0
}

/// The pose of an essential matrix for which most pairs have two positive depths, with their number.
///
/// Ties go to the first in the order of [`poses_of_essential`].
pub fn pose_by_depth_signs(
    essential: &Matrix3<f64>,
    first: &[Vector3<f64>],
    second: &[Vector3<f64>],
) -> Option<(Rigid, usize)> {
    let mut best: Option<(Matrix3<f64>, Vector3<f64>, usize)> = None;
    for (rotation, translation) in &rotations_of_essential(essential) {
        let votes =
            first.iter().zip(second).filter(|(a, b)| is_in_front(&(rotation * **a), translation, b)).count();
        if best.as_ref().is_none_or(|(_, _, most)| votes > *most) {
            best = Some((*rotation, *translation, votes));
        }
    }
    best.map(|(rotation, translation, votes)| (Rigid::from_matrix(&rotation, translation), votes))
}

#[cfg(test)]
mod tests {
    use super::{essential_from_pose, pose_by_depth_signs, poses_of_essential};
    use crate::synthetic::{RelativeProblem, rotation_angle, seeded};

    #[test]
    fn depth_signs_find_the_true_pose_behind_the_camera_too() {
        let mut rng = seeded("essential");
        for _ in 0..200 {
            let problem = RelativeProblem::exact(&mut rng, 12);
            for sign in [1.0, -1.0] {
                let essential = essential_from_pose(&problem.second_from_first) * sign;
                let (pose, votes) = pose_by_depth_signs(&essential, &problem.first, &problem.second).unwrap();
                assert_eq!(votes, 12);
                assert!(rotation_angle(&pose.rotation, &problem.second_from_first.rotation) < 1e-9);
                assert!((pose.translation - problem.second_from_first.translation).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn the_zero_matrix_has_no_pose() {
        assert!(poses_of_essential(&nalgebra::Matrix3::zeros()).is_empty());
    }
}
