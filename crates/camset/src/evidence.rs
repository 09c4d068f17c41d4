//! Matches to the scene as rays with uncertainty, and what they are worth.

use nalgebra::{Matrix2, Matrix2x3, Unit, Vector2, Vector3};
use setloc_features::{Camera, ImageFeatures, Rays};
use setloc_index::SceneIndex;
use setloc_sfm::{Place, Rigid};

use crate::SceneMatch;
use crate::refine::Sighting;

/// A photo with its rays under the camera as it is currently believed.
pub(crate) struct PhotoRays<'a> {
    pub features: &'a ImageFeatures,
    pub camera: &'a Camera,
    pub rays: Rays,
}

impl<'a> PhotoRays<'a> {
    pub(crate) fn new(features: &'a ImageFeatures, camera: &'a Camera) -> Self {
        Self { features, camera, rays: features.rays(camera) }
    }

    /// Error of a match under a pose, in standard deviations of the ray and of the scene point together.
    ///
    /// Infinite when the ray cannot be used or points away from the point.
    pub(crate) fn error_sigmas(
        &self,
        index: &SceneIndex,
        world_from_camera: &Rigid,
        found: SceneMatch,
    ) -> f64 {
        let feature = found.feature as usize;
        let (bearing, sigma) = (self.rays.bearings[feature], self.rays.sigmas[feature]);
        if !sigma.is_finite() {
            return f64::INFINITY;
        }
        let bearing_in_world = world_from_camera.rotation * bearing;
        let offset = index.position(found.point) - world_from_camera.translation;
        ray_error_sigmas(&bearing_in_world, sigma, &offset, &index.position_covariance(found.point))
    }

    /// Where a keypoint is, with its noise.
    pub(crate) fn place_of(&self, feature: u32) -> Place {
        Place::from(&self.features.keypoints[feature as usize])
    }

    /// Error of a place that shows a point, in standard deviations of a keypoint and of the point together.
    pub(crate) fn sighting_error_sigmas(
        &self,
        world_from_camera: &Rigid,
        seen: &Sighting,
        point: &Vector3<f64>,
        point_covariance: &nalgebra::Matrix3<f64>,
    ) -> f64 {
        let Some((bearing, angle)) = self.camera.ray(&seen.place.pixel) else { return f64::INFINITY };
        let offset = point - world_from_camera.translation;
        let bearing = world_from_camera.rotation * bearing;
        ray_error_sigmas(&bearing, seen.keypoint_noise_px * angle, &offset, point_covariance)
    }

    /// Standard deviation of a match in pixels: of the keypoint and of the scene point together.
    pub(crate) fn match_noise_px(
        &self,
        index: &SceneIndex,
        world_from_camera: &Rigid,
        found: SceneMatch,
    ) -> f64 {
        let keypoint = &self.features.keypoints[found.feature as usize];
        let own = f64::from(keypoint.noise_px);
        let offset = index.position(found.point) - world_from_camera.translation;
        let distance2 = offset.norm_squared();
        let angle = self.camera.pixel_angle(&keypoint.pixel()).unwrap_or(0.0);
        if !(distance2 > 0.0) || !(angle > 0.0) {
            return own;
        }
        let covariance = index.position_covariance(found.point);
        let lateral = (covariance.trace() - offset.dot(&(covariance * offset)) / distance2) / 2.0;
        (own * own + lateral.max(0.0) / (distance2 * angle * angle)).sqrt()
    }
}

/// Angular error between a bearing and the offset to a point, whitened by both uncertainties (both in one frame).
pub(crate) fn ray_error_sigmas(
    bearing: &Vector3<f64>,
    sigma: f64,
    offset: &Vector3<f64>,
    point_covariance: &nalgebra::Matrix3<f64>,
) -> f64 {
    let distance = offset.norm();
    if !(distance > 0.0) || bearing.dot(offset) <= 0.0 {
        return f64::INFINITY;
    }
    let basis = tangent_basis(&Unit::new_unchecked(*bearing));
    let direction = offset / distance;
    let residual: Vector2<f64> = basis * direction;
    // The chord in the tangent plane is the sine of the angle; the angle itself keeps large errors apart.
    let sine = residual.norm();
    let angle = sine.atan2(bearing.dot(&direction));
    let residual = if sine > 0.0 { residual * (angle / sine) } else { residual };
    let covariance = basis * point_covariance * basis.transpose() / (distance * distance)
        + Matrix2::identity() * (sigma * sigma);
    covariance
        .try_inverse()
        .map_or(f64::INFINITY, |information| residual.dot(&(information * residual)).max(0.0).sqrt())
}

/// Two orthonormal rows that span the tangent plane of the sphere at a direction.
pub(crate) fn tangent_basis(direction: &Unit<Vector3<f64>>) -> Matrix2x3<f64> {
    let helper = if direction.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let first = direction.cross(&helper).normalize();
    let second = direction.cross(&first);
    Matrix2x3::from_rows(&[first.transpose(), second.transpose()])
}

/// Number of cells, of 8 × 8 over the image, that hold one of the features.
pub(crate) fn occupied_cells(photo: &PhotoRays<'_>, features: impl Iterator<Item = u32>) -> usize {
    cells(photo, features, 8).into_iter().filter(|&occupied| occupied).count()
}

fn cells(photo: &PhotoRays<'_>, features: impl Iterator<Item = u32>, side: usize) -> Vec<bool> {
    let mut occupied = vec![false; side * side];
    let (width, height) = (f64::from(photo.camera.width.max(1)), f64::from(photo.camera.height.max(1)));
    for feature in features {
        let pixel = photo.features.keypoints[feature as usize].pixel();
        let cell = |value: f64, size: f64| ((value / size * side as f64).max(0.0) as usize).min(side - 1);
        occupied[cell(pixel.y, height) * side + cell(pixel.x, width)] = true;
    }
    occupied
}

/// Chance that a random match falls within `max_error_sigmas`, given where this photo has features at all.
pub(crate) fn chance_of_inlier(
    photo: &PhotoRays<'_>,
    index: &SceneIndex,
    world_from_camera: &Rigid,
    matches: &[SceneMatch],
    max_error_sigmas: f64,
) -> f64 {
    let occupied =
        cells(photo, 0..photo.features.len() as u32, 16).into_iter().filter(|&occupied| occupied).count();
    let area = f64::from(photo.camera.width) * f64::from(photo.camera.height) * occupied as f64 / 256.0;
    if matches.is_empty() || !(area > 0.0) {
        return 1.0;
    }
    let total: f64 = matches
        .iter()
        .map(|&found| {
            let radius = photo.match_noise_px(index, world_from_camera, found) * max_error_sigmas;
            (std::f64::consts::PI * radius * radius / area).min(1.0)
        })
        .sum();
    (total / matches.len() as f64).clamp(1e-12, 1.0)
}

/// log₁₀ of the expected number of poses with as many inliers among random matches.
///
/// (n − s) · C(n, k) · C(k, s) · αᵏ⁻ˢ for k inliers of n matches, samples of s and chance α of one inlier
/// (P. Moulon, P. Monasse, R. Marlet, "Adaptive structure from motion with a contrario model estimation", ACCV 2012,
/// eq. 3).
pub(crate) fn log10_false_alarms(matches: usize, inliers: usize, sample: usize, chance: f64) -> f64 {
    if inliers <= sample || matches < inliers {
        return f64::INFINITY;
    }
    ((matches - sample) as f64).log10()
        + log10_binomial(matches, inliers)
        + log10_binomial(inliers, sample)
        + (inliers - sample) as f64 * chance.log10()
}

fn log10_binomial(n: usize, k: usize) -> f64 {
    (1..=k.min(n - k)).map(|i| ((n - k.min(n - k) + i) as f64 / i as f64).log10()).sum()
}

/// log₁₀ of an upper bound of the chance that `count` or more of something are seen where `expected` are to be expected.
///
/// Chernoff's bound of a Poisson distribution's tail, e^(n − μ) (μ/n)ⁿ.
pub(crate) fn log10_chance_of_more(count: usize, expected: f64) -> f64 {
    let count = count as f64;
    if !(count > expected) {
        return 0.0;
    }
    (count - expected + count * (expected / count).ln()) / std::f64::consts::LN_10
}

/// Whether two poses are the same answer: within 5° and within a tenth of the distance to what they see.
pub(crate) fn same_pose(a: &Rigid, b: &Rigid, depth: f64) -> bool {
    a.rotation.angle_to(&b.rotation) < 0.087 && (a.translation - b.translation).norm() < 0.1 * depth
}

/// Median of finite values; `None` when there are none.
pub(crate) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.retain(|value| value.is_finite());
    if values.is_empty() {
        return None;
    }
    values.sort_unstable_by(f64::total_cmp);
    Some(values[values.len() / 2])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;

    #[test]
    fn error_is_the_angle_in_sigmas_and_knows_front_from_back() {
        let error = |offset: Vector3<f64>| ray_error_sigmas(&Vector3::z(), 0.01, &offset, &Matrix3::zeros());
        assert!((error(Vector3::new(0.0, 0.02_f64.tan(), 1.0) * 7.0) - 2.0).abs() < 1e-9);
        assert!(error(Vector3::new(0.0, 0.0, -1.0)).is_infinite());
        assert!(error(Vector3::zeros()).is_infinite());
    }

    #[test]
    fn an_uncertain_point_forgives_along_its_uncertainty_only() {
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.01, 0.0, 0.0));
        let along = ray_error_sigmas(&Vector3::z(), 0.001, &Vector3::new(0.02, 0.0, 1.0), &covariance);
        let across = ray_error_sigmas(&Vector3::z(), 0.001, &Vector3::new(0.0, 0.02, 1.0), &covariance);
        assert!(along < 1.0 && across > 19.0, "{along} {across}");
    }

    #[test]
    fn false_alarms_fall_with_inliers_and_rise_with_matches() {
        let few = log10_false_alarms(300, 12, 3, 1e-4);
        assert!(few < log10_false_alarms(3000, 12, 3, 1e-4));
        assert!(few > log10_false_alarms(300, 20, 3, 1e-4));
        assert!(log10_false_alarms(1000, 4, 3, 1e-4) > 0.0);
        assert!((log10_binomial(10, 3) - 120.0_f64.log10()).abs() < 1e-12);
    }

    #[test]
    fn more_than_expected_is_rare_and_fewer_is_not() {
        // Of a Poisson distribution of mean 5 the tail from 20 on is 8.1e-8.
        let bound = log10_chance_of_more(20, 5.0);
        assert!(bound > -7.1 && bound < -5.0, "{bound}");
        assert_eq!(log10_chance_of_more(4, 5.0), 0.0);
        assert_eq!(log10_chance_of_more(0, 0.0), 0.0);
        assert!(log10_chance_of_more(9, 8.0) > -0.1);
    }
}
