//! Photos that share a centre.

use nalgebra::{Matrix6, UnitQuaternion};
use setloc_features::Camera;
use setloc_sfm::Place;
use setloc_sfm::bundle::BundleObservation;

use super::JointPhoto;
use super::prior::sphere;
use crate::evidence::PhotoRays;

/// Which photos share a centre, and how they are turned against the first of them.
pub(super) struct Standpoints {
    /// Slot of each photo's first.
    pub lead: Vec<usize>,
    /// Turn from each photo's frame into that of its first.
    pub turn: Vec<UnitQuaternion<f64>>,
    /// Whether a photo shares its centre with another.
    pub shared: Vec<bool>,
    pub sphere: Camera,
}

impl Standpoints {
    pub fn new(photos: &[JointPhoto]) -> Self {
        let lead: Vec<usize> = photos.iter().map(|photo| photo.standpoint).collect();
        let mut members = vec![0_usize; photos.len()];
        for &lead in &lead {
            members[lead] += 1;
        }
        let turn = photos
            .iter()
            .enumerate()
            .map(|(slot, photo)| match photo.standpoint {
                lead if lead == slot => UnitQuaternion::identity(),
                lead => photos[lead].world_from_camera.rotation.inverse() * photo.world_from_camera.rotation,
            })
            .collect();
        let shared = lead.iter().map(|&lead| members[lead] > 1).collect();
        Self { lead, turn, shared, sphere: sphere() }
    }

    /// The observation of a bundle point at a place in a photo, of the standpoint's pose where the centre is shared.
    pub fn observation(
        &self,
        rays: &[PhotoRays<'_>],
        slot: usize,
        place: &Place,
        point: u32,
    ) -> Option<BundleObservation> {
        let Place { pixel, noise_px } = if self.shared[slot] {
            place_on(&self.sphere, rays[slot].camera, &self.turn[slot], place)?
        } else {
            *place
        };
        Some(BundleObservation { pose: self.lead[slot] as u32, point, pixel, noise_px })
    }
}

/// Where a sphere shows in the same direction, and as exactly, what a camera that is turned against it shows at a place.
pub(crate) fn place_on(
    sphere: &Camera,
    camera: &Camera,
    turn: &UnitQuaternion<f64>,
    place: &Place,
) -> Option<Place> {
    let sigma = place.noise_px * camera.pixel_angle(&place.pixel)?;
    let pixel = sphere.project(&(turn * camera.unproject(&place.pixel)?))?;
    Some(Place { pixel, noise_px: sigma / sphere.pixel_angle(&pixel)? })
}

/// Covariance of a pose whose camera is turned: R·Exp(ω)·T = R·T·Exp(Tᵀω), and the centre is the same.
pub(super) fn turned(covariance: &Matrix6<f64>, turn: &UnitQuaternion<f64>) -> Matrix6<f64> {
    let mut jacobian = Matrix6::identity();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(turn.inverse().to_rotation_matrix().matrix());
    jacobian * covariance * jacobian.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_covariance_of_a_turned_camera_is_that_of_its_own_axes() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2);
        let factor = Matrix6::from_fn(|row, column| 0.1 * ((3 * row + 5 * column) % 7) as f64);
        let covariance = factor * factor.transpose();
        // A draw x of covariance aaᵀ for each column a of the factor, seen by the turned camera.
        let seen = Matrix6::from_columns(&[0, 1, 2, 3, 4, 5].map(|k| {
            let (spin, shift) = (factor.fixed_view::<3, 1>(0, k), factor.fixed_view::<3, 1>(3, k));
            let spin = turn.inverse() * spin.into_owned();
            nalgebra::Vector6::new(spin.x, spin.y, spin.z, shift[0], shift[1], shift[2])
        }));
        assert!((turned(&covariance, &turn) - seen * seen.transpose()).norm() < 1e-12);
    }
}
