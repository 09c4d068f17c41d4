//! What the scene knows of its points, as bearings from fixed cameras.
//!
//! Scene points are not exact: those at the rim were seen from a few panoramas in a row, and their depths can be off by percents,
//! the same way for a whole façade. Taken as fixed they bend the scale of the set to themselves, and the covariance does not
//! show it.
//!
//! A covariance holds where it was evaluated. The deviation of a depth d grows as d², so of equal points those that came out too
//! near state the smaller one, and a mean weighted by that is too near by four variances of ln d: sets came out too small, by
//! 0.04 % in simulated streets. What is normal is the parallax, not the depth. So a point that is known worst in depth is held by
//! two bearings from about where the scene saw it, which carry the covariance and the way it changes with depth.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use setloc_features::Camera;
use setloc_index::SceneIndex;
use setloc_sfm::{PointId, Rigid};

/// Width in pixels of the images of cameras that see all around.
const SPHERE_WIDTH: u32 = 4096;
/// Distance of cameras that stand far from their point, in its largest standard deviations.
const FAR: f64 = 1e3;
/// Largest sine of the angle between each of two bearings and the depth. What is known better needs no parallax.
const MAX_SINE: f64 = 0.5;
/// Least cosine between the axis along which a point is known worst and the direction in which it was seen.
const MIN_ALONG: f64 = 0.9;

/// A camera that sees all around; its pixels only express angles.
pub(crate) fn sphere() -> Camera {
    Camera::equirectangular(SPHERE_WIDTH, SPHERE_WIDTH / 2)
}

/// A fixed camera that sees a point in the middle of its image.
pub(super) struct PriorBearing {
    pub world_from_camera: Rigid,
    /// In the image of a [`sphere`], as the noise.
    pub pixel: Vector2<f64>,
    pub noise_px: f64,
}

impl PriorBearing {
    /// Of a camera that stands `away` from the point and tells this information along each axis across.
    fn new(position: &Vector3<f64>, away: &Vector3<f64>, information: f64) -> Self {
        let pixel_angle = std::f64::consts::TAU / f64::from(SPHERE_WIDTH);
        let rotation = UnitQuaternion::rotation_between(&Vector3::z(), &-away)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
        Self {
            world_from_camera: Rigid::new(rotation, position + away),
            pixel: Vector2::new(f64::from(SPHERE_WIDTH) / 2.0, f64::from(SPHERE_WIDTH) / 4.0),
            noise_px: 1.0 / (information.sqrt() * away.norm() * pixel_angle),
        }
    }
}

/// Middle of the images that see a scene point.
pub(super) fn seen_from(index: &SceneIndex, point: PointId) -> Option<Vector3<f64>> {
    let center = |&row: &u32| index.center(index.row(row).image);
    let centers: Vec<Vector3<f64>> = index.rows_of(point).iter().filter_map(center).collect();
    (!centers.is_empty()).then(|| centers.iter().sum::<Vector3<f64>>() / centers.len() as f64)
}

/// Bearings that hold a point as its covariance does, no axis better.
///
/// From about where it was seen, if that is told and the depth from there is what is known worst; else from far off. A covariance
/// of zero (an exact point) or without bound has none.
pub(super) fn prior_bearings(
    position: &Vector3<f64>,
    covariance: &Matrix3<f64>,
    seen_from: Option<&Vector3<f64>>,
) -> Vec<PriorBearing> {
    let eigen = covariance.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    if !(largest > 0.0) || !largest.is_finite() {
        return Vec::new();
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let known = Known {
        information: order.map(|axis| 1.0 / eigen.eigenvalues[axis].max(1e-6 * largest)),
        axes: order.map(|axis| eigen.eigenvectors.column(axis).into_owned()),
    };
    seen_from
        .and_then(|seen_from| known.by_parallax(position, seen_from))
        .unwrap_or_else(|| known.by_far(position, FAR * largest.sqrt()))
}

/// What is known of a point along three axes, the one that is known worst first.
struct Known {
    information: [f64; 3],
    axes: [Vector3<f64>; 3],
}

impl Known {
    /// Two bearings from the distance of `seen_from`.
    ///
    /// Bearings of weight w/2 each that meet at ± φ about the depth tell it w·sin²φ, across in their plane w·cos²φ and across it w.
    fn by_parallax(&self, position: &Vector3<f64>, seen_from: &Vector3<f64>) -> Option<Vec<PriorBearing>> {
        let [in_depth, across, best] = self.information;
        let weight = best.min(across + in_depth);
        let sine = (in_depth / weight).sqrt();
        let offset = seen_from - position;
        let distance = self.axes[0].dot(&offset);
        if sine > MAX_SINE || !(distance.abs() > MIN_ALONG * offset.norm()) {
            return None;
        }
        let back = self.axes[0] * distance * (1.0 - sine * sine).sqrt();
        let aside = self.axes[1] * distance * sine;
        let bearing = |away: Vector3<f64>| PriorBearing::new(position, &away, weight / 2.0);
        Some(vec![bearing(back + aside), bearing(back - aside)])
    }

    /// Three bearings along the axes.
    ///
    /// From far off, one along axis k with weight w_k tells the place across that axis only; together they tell the information
    /// i_k where w_k = (Σ_j i_j)/2 − i_k. An axis that is known better than the other two together counts as they do, since no
    /// weight is negative.
    fn by_far(&self, position: &Vector3<f64>, distance: f64) -> Vec<PriorBearing> {
        let all: f64 = self.information.iter().sum();
        let information = self.information.map(|along| along.min(all - along));
        let half: f64 = information.iter().sum::<f64>() / 2.0;
        let along = |(axis, information): (&Vector3<f64>, f64)| {
            let weight = half - information;
            (weight > 0.0).then(|| PriorBearing::new(position, &(axis * distance), weight))
        };
        self.axes.iter().zip(information).filter_map(along).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const POSITION: Vector3<f64> = Vector3::new(3.0, -1.0, 12.0);

    fn axes() -> Matrix3<f64> {
        UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2).to_rotation_matrix().into_inner()
    }

    /// Of these variances along those axes.
    fn covariance(variances: [f64; 3]) -> Matrix3<f64> {
        axes() * Matrix3::from_diagonal(&variances.into()) * axes().transpose()
    }

    /// What bearings tell of a point together, at the point.
    fn information(bearings: &[PriorBearing]) -> Matrix3<f64> {
        let of = |prior: &PriorBearing| {
            let seen = sphere().unproject(&prior.pixel).unwrap();
            let offset = POSITION - prior.world_from_camera.translation;
            let direction = offset.normalize();
            assert!((prior.world_from_camera.rotation * seen - direction).norm() < 1e-9);
            let sigma = prior.noise_px * sphere().pixel_angle(&prior.pixel).unwrap() * offset.norm();
            (Matrix3::identity() - direction * direction.transpose()) / (sigma * sigma)
        };
        bearings.iter().map(of).sum()
    }

    #[test]
    fn bearings_carry_the_information_of_the_covariance() {
        let depth = axes().column(2).into_owned();
        // As two rays of one noise leave a point, nearly as many do, and as rays from all sides do.
        for (variances, seen_from, count) in [
            ([1e-4, 1.125e-4, 9e-4], Some(POSITION - depth * 10.0), 2),
            ([1e-4, 1.125e-4, 9e-4], Some(POSITION + depth * 10.0), 2),
            ([1e-4, 1.125e-4, 9e-4], None, 2),
            ([1e-4, 1.05e-4, 9e-4], None, 3),
            ([1e-4, 1.2e-4, 1.6e-4], Some(POSITION - depth * 10.0), 3),
            ([1e-4, 1.05e-4, 9e-4], Some(POSITION - axes().column(0) * 10.0), 3),
        ] {
            let covariance = covariance(variances);
            let bearings = prior_bearings(&POSITION, &covariance, seen_from.as_ref());
            assert_eq!(bearings.len(), count, "{variances:?}");
            let expected = covariance.try_inverse().unwrap();
            let difference = (information(&bearings) - expected).norm() / expected.norm();
            assert!(difference < 1e-6, "{variances:?} {difference}");
        }
    }

    #[test]
    fn no_axis_is_told_better_than_it_is_known() {
        let seen_from = POSITION - axes().column(2) * 10.0;
        for variances in [[1e-4, 1e-4, 9e-4], [1e-4, 1.05e-4, 5e-4], [1e-4, 3e-4, 9e-2], [1e-5, 3e-4, 4e-3]] {
            let covariance = covariance(variances);
            for seen_from in [Some(&seen_from), None] {
                let told = information(&prior_bearings(&POSITION, &covariance, seen_from));
                let excess = covariance.try_inverse().unwrap() - told;
                assert!(excess.symmetric_eigenvalues().min() > -1e-6 * told.norm(), "{variances:?} {excess}");
            }
        }
    }

    #[test]
    fn a_point_that_is_exact_or_unknown_has_no_bearings() {
        for covariance in [Matrix3::zeros(), Matrix3::repeat(f64::NAN), Matrix3::identity() * f64::INFINITY] {
            assert!(prior_bearings(&Vector3::zeros(), &covariance, None).is_empty());
        }
    }
}
