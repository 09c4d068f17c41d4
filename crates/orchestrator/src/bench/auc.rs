use std::collections::BTreeMap;

use setloc_sfm::Rigid;

/// Thresholds in degrees at which the area under the recall curve is given.
pub const AUC_THRESHOLDS_DEG: [f64; 5] = [0.1, 0.5, 1.0, 5.0, 10.0];

/// Area under the recall curve of relative pose errors up to each threshold, in percent.
///
/// Over all pairs of the true images the larger of the relative rotation error and the angle between the relative
/// translation directions; pairs with an unregistered image count as failed. Needs no alignment.
pub fn auc_percent(estimated: &BTreeMap<String, Rigid>, truth: &BTreeMap<String, Rigid>) -> [f64; 5] {
    let names: Vec<&String> = truth.keys().collect();
    let mut errors = Vec::new();
    for (at, first) in names.iter().enumerate() {
        for second in &names[at + 1..] {
            let pair = estimated.get(*first).zip(estimated.get(*second));
            errors.push(
                pair.map_or(f64::INFINITY, |(a, b)| pair_error_deg(a, b, &truth[*first], &truth[*second])),
            );
        }
    }
    errors.sort_by(f64::total_cmp);
    AUC_THRESHOLDS_DEG.map(|threshold| area(&errors, threshold))
}

/// Trapezoids below the recall curve of sorted errors up to `threshold`, as a share of the whole in percent.
fn area(errors: &[f64], threshold: f64) -> f64 {
    if errors.is_empty() {
        return 0.0;
    }
    let (mut sum, mut x, mut y) = (0.0, 0.0, 0.0);
    for (at, &error) in errors.iter().enumerate().take_while(|(_, error)| **error < threshold) {
        let recall = (at + 1) as f64 / errors.len() as f64;
        sum += (error - x) * (recall + y) / 2.0;
        (x, y) = (error, recall);
    }
    100.0 * (sum + (threshold - x) * y) / threshold
}

fn pair_error_deg(a: &Rigid, b: &Rigid, true_a: &Rigid, true_b: &Rigid) -> f64 {
    let relative = |a: &Rigid, b: &Rigid| b.rotation.inverse() * a.rotation;
    let rotation = (relative(a, b).inverse() * relative(true_a, true_b)).angle();
    let direction = |a: &Rigid, b: &Rigid| a.rotation.inverse() * (b.translation - a.translation);
    let (u, v) = (direction(a, b), direction(true_a, true_b));
    let translation =
        if u.norm() * v.norm() > 0.0 { u.cross(&v).norm().atan2(u.dot(&v)) } else { std::f64::consts::PI };
    rotation.max(translation).to_degrees()
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    fn poses() -> BTreeMap<String, Rigid> {
        let pose = |i: u32| {
            let x = f64::from(i);
            Rigid::new(UnitQuaternion::from_euler_angles(0.1 * x, 0.0, 0.3), Vector3::new(x, x * x, 0.0))
        };
        (0..4).map(|i| (i.to_string(), pose(i))).collect()
    }

    #[test]
    fn exact_poses_have_full_area_in_any_frame() {
        let similarity = setloc_sfm::Similarity {
            scale: 3.0,
            rotation: UnitQuaternion::from_euler_angles(1.0, 2.0, 3.0),
            translation: Vector3::new(1.0, 2.0, 3.0),
        };
        let moved =
            poses().into_iter().map(|(name, pose)| (name, similarity.transform_pose(&pose))).collect();
        assert!(auc_percent(&moved, &poses()).iter().all(|area| *area > 99.999));
    }

    #[test]
    fn unregistered_images_count_as_failed() {
        let mut estimated = poses();
        estimated.remove("0");
        assert!((auc_percent(&estimated, &poses())[4] - 50.0).abs() < 1e-3);
    }

    #[test]
    fn area_is_that_of_the_definition() {
        // Recall 1/2 from 1° and 1 from 3°, up to 5°: 0.25 + 1.5 + 2 of 5.
        assert!((area(&[1.0, 3.0], 5.0) - 75.0).abs() < 1e-12);
    }
}
