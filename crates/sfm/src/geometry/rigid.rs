use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// A rigid motion `target_from_source`: x_target = R·x_source + t.
///
/// As `world_from_camera` the translation is the camera's centre in the world.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rigid {
    /// R as a unit quaternion (Hamilton).
    pub rotation: UnitQuaternion<f64>,
    /// t in the target frame.
    pub translation: Vector3<f64>,
}

impl Default for Rigid {
    fn default() -> Self {
        Self::identity()
    }
}

impl Rigid {
    /// A motion from its rotation and translation.
    pub fn new(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// A motion from a rotation matrix (assumed orthonormal) and a translation.
    pub fn from_matrix(rotation: &Matrix3<f64>, translation: Vector3<f64>) -> Self {
        Self {
            rotation: UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*rotation)),
            translation,
        }
    }

    /// The motion that changes nothing.
    pub fn identity() -> Self {
        Self { rotation: UnitQuaternion::identity(), translation: Vector3::zeros() }
    }

    /// `source_from_target`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Maps a point from the source to the target frame.
    pub fn transform_point(&self, point_in_source: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point_in_source + self.translation
    }

    /// Maps a point from the target to the source frame.
    pub fn inverse_transform_point(&self, point_in_target: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.inverse_transform_vector(&(point_in_target - self.translation))
    }
}

impl std::ops::Mul for Rigid {
    type Output = Self;

    /// Composition: `c_from_a = c_from_b * b_from_a`.
    fn mul(self, rhs: Self) -> Self {
        Self {
            rotation: self.rotation * rhs.rotation,
            translation: self.rotation * rhs.translation + self.translation,
        }
    }
}
