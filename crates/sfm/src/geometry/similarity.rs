use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::Rigid;

/// A similarity `target_from_source`: x_target = s·R·x_source + t.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    /// s > 0.
    pub scale: f64,
    /// R as a unit quaternion (Hamilton).
    pub rotation: UnitQuaternion<f64>,
    /// t in the target frame.
    pub translation: Vector3<f64>,
}

impl Default for Similarity {
    fn default() -> Self {
        Self::identity()
    }
}

impl From<Rigid> for Similarity {
    fn from(rigid: Rigid) -> Self {
        Self { scale: 1.0, rotation: rigid.rotation, translation: rigid.translation }
    }
}

impl Similarity {
    /// The similarity that changes nothing.
    pub fn identity() -> Self {
        Self { scale: 1.0, rotation: UnitQuaternion::identity(), translation: Vector3::zeros() }
    }

    /// `source_from_target`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        let scale = 1.0 / self.scale;
        Self { scale, rotation, translation: -(rotation * self.translation) * scale }
    }

    /// Maps a point from the source to the target frame.
    pub fn transform_point(&self, point_in_source: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point_in_source * self.scale + self.translation
    }

    /// Maps the covariance of a point from the source to the target frame.
    pub fn transform_covariance(&self, in_source: &Matrix3<f64>) -> Matrix3<f64> {
        let turn = self.rotation.to_rotation_matrix().into_inner() * self.scale;
        turn * in_source * turn.transpose()
    }

    /// Maps a pose given in the source frame: `target_from_camera` of a `source_from_camera`.
    ///
    /// The camera frame keeps its own unit of length, so the result is rigid.
    pub fn transform_pose(&self, source_from_camera: &Rigid) -> Rigid {
        Rigid::new(
            self.rotation * source_from_camera.rotation,
            self.transform_point(&source_from_camera.translation),
        )
    }

    /// Least-squares similarity that maps `source` onto `target`, or `None` when it is not determined.
    ///
    /// S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991,
    /// eqs. 40–42. Needs at least 3 pairs that are not collinear.
    pub fn from_point_pairs(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Option<Self> {
        if source.len() != target.len() || source.len() < 3 {
            return None;
        }
        let n = source.len() as f64;
        let source_mean = source.iter().sum::<Vector3<f64>>() / n;
        let target_mean = target.iter().sum::<Vector3<f64>>() / n;
        let (mut covariance, mut variance) = (Matrix3::zeros(), 0.0);
        for (a, b) in source.iter().zip(target) {
            covariance += (b - target_mean) * (a - source_mean).transpose() / n;
            variance += (a - source_mean).norm_squared() / n;
        }
        let svd = covariance.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        let singular = svd.singular_values;
        if variance <= 0.0 || !(singular[1] > 1e-12 * singular[0]) {
            return None;
        }
        let mut sign = Vector3::new(1.0, 1.0, 1.0);
        if u.determinant() * v_t.determinant() < 0.0 {
            sign.z = -1.0;
        }
        let rotation = u * Matrix3::from_diagonal(&sign) * v_t;
        let scale = singular.dot(&sign) / variance;
        if !(scale > 0.0) || !scale.is_finite() {
            return None;
        }
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        Some(Self { scale, rotation, translation: target_mean - rotation * source_mean * scale })
    }
}

/// The rotation that has the greatest trace with a matrix, the chordal mean of rotations where it is their sum; `None` where it
/// is not finite.
pub fn nearest_rotation(sum: Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let svd = sum.iter().all(|value| value.is_finite()).then(|| sum.svd(true, true))?;
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Some(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * sign * v_t)))
}

impl std::ops::Mul for Similarity {
    type Output = Self;

    /// Composition: `c_from_a = c_from_b * b_from_a`.
    fn mul(self, rhs: Self) -> Self {
        Self {
            scale: self.scale * rhs.scale,
            rotation: self.rotation * rhs.rotation,
            translation: self.transform_point(&rhs.translation),
        }
    }
}
