//! The length of one baseline relative to another, as bearings of a point that nobody sees.

use super::{BundleBearing, BundlePoint, BundleProblem};

/// What is known of the lengths of two baselines a and b that meet in one centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LengthRatio {
    /// ‖b‖/‖a‖.
    pub ratio: f64,
    /// Standard deviation of its logarithm.
    pub deviation: f64,
}

impl BundleProblem {
    /// Holds the length of the baseline from pose `from` to pose `to`, relative to that from `reference` to `from`.
    ///
    /// A point V at a distance h from the middle centre, across both baselines, is seen from the outer centres at the
    /// angles α and β with tan α = h/‖a‖ and tan β = h/‖b‖; so three bearings to V say that ‖b‖/‖a‖ = tan α/tan β. With
    /// h² = ‖a‖·‖b‖ and errors of standard deviation σ in each of them, ln(‖b‖/‖a‖) has the variance
    /// σ²·((2/sin 2α)² + (2/sin 2β)² + ‖tan α·â + tan β·b̂‖²). Of the directions of the baselines they say as little as
    /// of their length, which is nothing beside what shared points say. They are made for the present rotations and
    /// directions, and are right in any frame and scale.
    ///
    /// Returns whether that could be done: the three poses exist, their centres differ, and the numbers are positive.
    pub fn hold_length(&mut self, [reference, from, to]: [u32; 3], length: LengthRatio) -> bool {
        let center = |pose: u32| Some(self.poses.get(pose as usize)?.world_from_camera.translation);
        let (Some(first), Some(middle), Some(last)) = (center(reference), center(from), center(to)) else {
            return false;
        };
        let LengthRatio { ratio, deviation } = length;
        let (a, b) = (middle - first, last - middle);
        let (Some(along_a), Some(along_b)) = (a.try_normalize(0.0), b.try_normalize(0.0)) else {
            return false;
        };
        if !(ratio > 0.0 && ratio.is_finite() && deviation > 0.0 && deviation.is_finite()) {
            return false;
        }
        // Baselines in one line have all directions across them.
        let across = along_a.cross(&along_b).try_normalize(1e-6).unwrap_or_else(|| {
            let axis = nalgebra::Vector3::ith(along_a.iamin(), 1.0);
            along_a.cross(&axis).normalize()
        });
        let (tan_a, tan_b) = (ratio.sqrt(), 1.0 / ratio.sqrt());
        // 2/sin 2α = tan α + 1/tan α.
        let (gain_a, gain_b) = (tan_a + 1.0 / tan_a, tan_b + 1.0 / tan_b);
        let gain_middle = along_a * tan_a + along_b * tan_b;
        let gain = (gain_a.powi(2) + gain_b.powi(2) + gain_middle.norm_squared()).sqrt();
        let position = middle + across * (a.norm() * tan_a);
        let centers = [first, middle, middle + along_b * (a.norm() * ratio)];
        let point = self.points.len() as u32;
        self.points.push(BundlePoint { position, fixed: false });
        for (pose, center) in [reference, from, to].into_iter().zip(centers) {
            let rotation = self.poses[pose as usize].world_from_camera.rotation;
            let bearing = rotation.inverse_transform_vector(&(position - center)).normalize();
            self.bearings.push(BundleBearing { pose, point, bearing, sigma: deviation / gain });
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use setloc_features::Camera;

    use super::super::{
        BundleObservation, BundleParams, BundlePose, IntrinsicsFreedom, RobustLoss, covariance, solve,
    };
    use super::*;
    use crate::Rigid;
    use crate::synthetic::{normal_vector, seeded};

    /// Two known photos and a third that shares points with the second only.
    fn chain(last: Vector3<f64>, name: &str) -> BundleProblem {
        let camera = Camera::from_focal_guess(1200, 900, 900.0);
        let mut rng = seeded(name);
        let mut problem = BundleProblem { cameras: vec![camera.clone()], ..BundleProblem::default() };
        let middle = Vector3::new(0.3, 0.1, 2.0);
        for (center, yaw, fixed) in
            [(Vector3::zeros(), 0.0, true), (middle, 0.2, true), (middle + last, 0.3, false)]
        {
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw);
            problem.poses.push(BundlePose {
                camera: 0,
                world_from_camera: Rigid::new(rotation, center),
                fixed,
            });
        }
        while problem.points.len() < 80 {
            let position = Vector3::new(1.5, 0.0, 14.0) + normal_vector(&mut rng) * 2.0;
            let point = problem.points.len() as u32;
            problem.points.push(BundlePoint { position, fixed: false });
            for pose in [1, 2] {
                let in_camera =
                    problem.poses[pose as usize].world_from_camera.inverse_transform_point(&position);
                let pixel = camera.project(&in_camera).unwrap();
                problem.observations.push(BundleObservation { pose, point, pixel, noise_px: 0.3 });
            }
        }
        problem
    }

    fn ratio(problem: &BundleProblem) -> f64 {
        let [a, b, c] = [0, 1, 2].map(|pose: usize| problem.poses[pose].world_from_camera.translation);
        (c - b).norm() / (b - a).norm()
    }

    #[test]
    fn the_length_alone_is_held_with_its_deviation() {
        for (number, last) in
            [Vector3::new(0.6, 0.2, 4.0), Vector3::new(2.0, 0.0, 0.3), Vector3::new(0.05, 0.02, 0.34)]
                .into_iter()
                .enumerate()
        {
            let mut problem = chain(last, &format!("held {number}"));
            let (length, deviation) = (ratio(&problem), 0.03);
            assert!(
                covariance(&problem, RobustLoss::Trivial, &[2]).is_none(),
                "the length is not in the points"
            );
            assert!(problem.hold_length([0, 1, 2], LengthRatio { ratio: length, deviation }));
            let stated = covariance(&problem, RobustLoss::Trivial, &[2]).expect("the length is held")[0];
            let along = last.normalize();
            let of_center = stated.fixed_view::<3, 3>(3, 3).into_owned();
            let sigma = along.dot(&(of_center * along)).sqrt() / last.norm();
            assert!((sigma / deviation - 1.0).abs() < 0.05, "{number}: {sigma}");
            let across = of_center.trace() - along.dot(&(of_center * along));
            assert!(across.sqrt() < 0.6 * sigma * last.norm(), "{number}: {}", across.sqrt());
        }
    }

    #[test]
    fn adjustment_brings_a_baseline_back_to_the_length_that_is_held() {
        let mut problem = chain(Vector3::new(0.6, 0.2, 4.0), "back");
        // Free intrinsics of the same camera do not touch the bearings.
        problem.camera_freedom = vec![IntrinsicsFreedom::FIXED];
        let truth = ratio(&problem);
        assert!(problem.hold_length([0, 1, 2], LengthRatio { ratio: truth, deviation: 0.02 }));
        let middle = problem.poses[1].world_from_camera.translation;
        let step = problem.poses[2].world_from_camera.translation - middle;
        problem.poses[2].world_from_camera.translation = middle + step * 1.2;
        for point in &mut problem.points {
            point.position = middle + (point.position - middle) * 1.2;
        }
        solve(&BundleParams { max_iterations: 100, ..BundleParams::default() }, &mut problem);
        assert!((ratio(&problem) / truth - 1.0).abs() < 1e-4, "{} {truth}", ratio(&problem));
    }

    #[test]
    fn what_has_no_length_is_not_held() {
        let mut problem = chain(Vector3::new(0.6, 0.2, 4.0), "refused");
        let before = problem.clone();
        let good = LengthRatio { ratio: 1.0, deviation: 0.1 };
        assert!(!problem.hold_length([0, 1, 3], good));
        assert!(!problem.hold_length([0, 0, 2], good));
        for bad in [LengthRatio { ratio: 0.0, ..good }, LengthRatio { deviation: f64::NAN, ..good }] {
            assert!(!problem.hold_length([0, 1, 2], bad));
        }
        assert_eq!(problem, before);
    }
}
