use nalgebra::Vector3;
use setloc_features::Camera;

/// Largest angle at the point between two views of it that a descriptor surely survives.
pub(crate) const SAME_VIEW_ANGLE_RAD: f64 = 0.35;
/// Largest ratio of distances to the point that a descriptor surely survives.
pub(crate) const SAME_VIEW_DISTANCE_RATIO: f64 = 1.5;

/// How far from an observer a camera can be that sees a point much alike, in distances from the observer to the point: at the largest
/// angle and ratio, by the law of cosines, 0.657.
pub(crate) const FARTHEST_SAME_VIEW: f64 = 0.66;

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
    camera.covers_the_sphere() || camera.project(direction).is_some_and(|pixel| camera.contains(&pixel))
}

#[cfg(test)]
mod tests {
    use setloc_features::CameraModel;

    use super::*;

    #[test]
    fn what_a_crop_of_a_panorama_leaves_out_is_not_in_it() {
        let whole = Camera::equirectangular(4000, 2000);
        let crop = Camera {
            model: CameraModel::Equirectangular,
            width: 1000,
            height: 600,
            params: vec![4000.0, 2000.0, 1500.0, 700.0],
        };
        let behind = -Vector3::z();
        for direction in [Vector3::z(), behind, Vector3::y()] {
            assert!(is_in_image(&whole, &direction));
            assert_eq!(is_in_image(&crop, &direction), direction == Vector3::z(), "{direction}");
        }
    }
}
