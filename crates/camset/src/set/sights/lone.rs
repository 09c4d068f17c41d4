//! Keypoints of photos and of scene images that show one spot of which no point is known: pairs of rays that meet.

use nalgebra::Vector3;
use setloc_sfm::robust::GeneralizedRay;
use setloc_sfm::{Observation, Place, Rigid, Similarity};

use crate::evidence::PhotoRays;

/// Squared sine of the least angle between two rays that meet: half a degree.
const MIN_PARALLAX_SQUARED: f64 = 7.6e-5;

/// A keypoint of a scene image that shows what a photo shows at no local point.
#[derive(Debug, Clone)]
pub(crate) struct LoneSight {
    /// The photo's slot and feature.
    pub slot: usize,
    pub feature: u32,
    /// The scene image and its keypoint.
    pub seen: Observation,
    pub place: Place,
    /// From the scene image's centre, in the scene's frame.
    pub(super) ray: GeneralizedRay,
    /// From the photo's centre, in the set's frame.
    pub(super) own: GeneralizedRay,
}

impl LoneSight {
    /// How far the two rays are from meeting, in standard deviations of both (the tangent Sampson error); infinite
    /// where they meet behind either.
    pub(super) fn error_sigmas(&self, world_from_set: &Similarity) -> f64 {
        meeting(&self.placed(world_from_set), &self.ray).map_or(f64::INFINITY, |(_, error)| error)
    }

    /// Distance from the scene image to where the rays meet.
    pub(super) fn distance(&self, world_from_set: &Similarity) -> Option<f64> {
        meeting(&self.placed(world_from_set), &self.ray).map(|(point, _)| (point - self.ray.origin).norm())
    }

    /// The photo's ray in the scene.
    fn placed(&self, world_from_set: &Similarity) -> GeneralizedRay {
        GeneralizedRay {
            origin: world_from_set.transform_point(&self.own.origin),
            direction: world_from_set.rotation * self.own.direction,
            ..self.own
        }
    }

    /// Where the rays meet when the photo's is from this pose, if within some standard deviations.
    pub(crate) fn meeting_point(
        &self,
        photo: &PhotoRays<'_>,
        world_from_camera: &Rigid,
        max_error_sigmas: f64,
    ) -> Option<Vector3<f64>> {
        let own = GeneralizedRay {
            origin: world_from_camera.translation,
            direction: world_from_camera.rotation * photo.rays.bearings[self.feature as usize],
            ..self.own
        };
        meeting(&own, &self.ray).filter(|(_, error)| *error < max_error_sigmas).map(|(point, _)| point)
    }
}

/// Where two rays are nearest to each other, and by how many standard deviations they miss each other's epipolar plane;
/// `None` where that is behind either or they are parallel.
fn meeting(a: &GeneralizedRay, b: &GeneralizedRay) -> Option<(Vector3<f64>, f64)> {
    let baseline = b.origin - a.origin;
    let direction = baseline.try_normalize(0.0)?;
    let across = a.direction.cross(&b.direction);
    let squared = across.norm_squared();
    let along = |other: &Vector3<f64>| baseline.cross(other).dot(&across) / squared;
    let (of_a, of_b) = (along(&b.direction), along(&a.direction));
    if !(of_a > 0.0 && of_b > 0.0) || squared < MIN_PARALLAX_SQUARED {
        return None;
    }
    let residual = direction.dot(&across);
    let by_a = b.direction.cross(&direction);
    let by_b = direction.cross(&a.direction);
    let tangent =
        |gradient: &Vector3<f64>, ray: &Vector3<f64>| gradient.norm_squared() - gradient.dot(ray).powi(2);
    let variance =
        a.sigma.powi(2) * tangent(&by_a, &a.direction) + b.sigma.powi(2) * tangent(&by_b, &b.direction);
    let middle = (a.origin + a.direction * of_a + b.origin + b.direction * of_b) / 2.0;
    let error = residual.abs() / variance.sqrt();
    error.is_finite().then_some((middle, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: Vector3<f64>, direction: Vector3<f64>) -> GeneralizedRay {
        GeneralizedRay { origin, direction: direction.normalize(), sigma: 0.001, camera: 0 }
    }

    #[test]
    fn rays_meet_where_they_do_and_only_in_front_of_both() {
        let point = Vector3::new(1.0, -2.0, 8.0);
        let (a, b) = (Vector3::zeros(), Vector3::new(3.0, 0.5, 0.0));
        let (found, error) = meeting(&ray(a, point), &ray(b, point - b)).unwrap();
        assert!((found - point).norm() < 1e-12 && error < 1e-9);
        assert!(meeting(&ray(a, -point), &ray(b, point - b)).is_none());
        assert!(meeting(&ray(a, point), &ray(b, b - point)).is_none());
        assert!(meeting(&ray(a, point), &ray(b, point)).is_none(), "parallel");
        assert!(meeting(&ray(a, point), &ray(a, point - b)).is_none(), "one centre");
    }

    #[test]
    fn the_error_is_that_across_the_epipolar_plane_in_deviations_of_both() {
        let point = Vector3::new(0.0, 0.0, 5.0);
        let b = Vector3::new(4.0, 0.0, 0.0);
        let off = |x: f64, y: f64| ray(Vector3::zeros(), Vector3::new(x, y, 1.0));
        let seen = ray(b, point - b);
        let (_, along) = meeting(&off(0.01, 0.0), &seen).unwrap();
        assert!(along < 1e-9, "{along}");
        let (_, across) = meeting(&off(0.0, 0.004), &seen).unwrap();
        // The plane turns about the baseline by the smaller angle for the ray that runs more along it.
        let sine = seen.direction.z;
        assert!((across - 4.0 * sine / (1.0 + sine * sine).sqrt()).abs() < 0.01, "{across}");
    }
}
