use nalgebra::Vector3;
use setloc_features::Camera;

/// Largest angle at the point between two views of it that a descriptor surely survives.
pub(crate) const SAME_VIEW_ANGLE_RAD: f64 = 0.35;
/// Largest ratio of distances to the point that a descriptor surely survives.
pub(crate) const SAME_VIEW_DISTANCE_RATIO: f64 = 1.5;

/// Whether a camera at `candidate` sees `point` much as a camera at `observer` does.
///
/// Then a keypoint that one of them has ought to be found and matched in the other, unless something hides it.
pub(crate) fn is_same_view(point: &Vector3<f64>, observer: &Vector3<f64>, candidate: &Vector3<f64>) -> bool {
    let (to_observer, to_candidate) = (observer - point, candidate - point);
    let (near, far) = (to_observer.norm(), to_candidate.norm());
    let ratio = near / far;
    ratio < SAME_VIEW_DISTANCE_RATIO
        && ratio > 1.0 / SAME_VIEW_DISTANCE_RATIO
        && to_candidate.dot(&to_observer) > SAME_VIEW_ANGLE_RAD.cos() * near * far
}

/// Whether a direction of the camera's frame falls into its image.
pub(crate) fn is_in_image(camera: &Camera, direction: &Vector3<f64>) -> bool {
    camera.is_panoramic() || camera.project(direction).is_some_and(|pixel| camera.contains(&pixel))
}
