use std::collections::BTreeMap;

use setloc_sfm::Rigid;

use super::figures::extent;

/// Thresholds in degrees at which the area under the recall curve is given.
pub const AUC_THRESHOLDS_DEG: [f64; 5] = [0.1, 0.5, 1.0, 5.0, 10.0];

/// Area under the recall curve of relative pose errors up to each threshold, in percent.
///
/// Over all pairs of the true images the larger of the relative rotation error and the angle between the relative
/// translation directions; pairs with an unregistered image count as failed. Needs no alignment. Of a pair at one place, which has no
/// direction, the rotation alone counts. `None` where the truth has no pair.
pub fn auc_percent(estimated: &BTreeMap<String, Rigid>, truth: &BTreeMap<String, Rigid>) -> Option<[f64; 5]> {
    let names: Vec<&String> = truth.keys().collect();
    let extent = extent(truth.values());
    let mut errors = Vec::new();
    for (at, first) in names.iter().enumerate() {
        for second in &names[at + 1..] {
            let pair = estimated.get(*first).zip(estimated.get(*second));
            errors.push(pair.map_or(f64::INFINITY, |(a, b)| {
                let (true_a, true_b) = (&truth[*first], &truth[*second]);
                let rotation = rotation_error(a, b, true_a, true_b);
                let apart = (true_a.translation - true_b.translation).norm();
                let have_direction = apart > ONE_PLACE * extent;
                let direction = if have_direction { direction_error(a, b, true_a, true_b) } else { 0.0 };
                rotation.max(direction).to_degrees()
            }));
        }
    }
    errors.sort_by(f64::total_cmp);
    (!errors.is_empty()).then(|| AUC_THRESHOLDS_DEG.map(|threshold| area(&errors, threshold)))
}

/// Trapezoids below the recall curve of sorted errors up to `threshold`, as a share of the whole in percent.
fn area(errors: &[f64], threshold: f64) -> f64 {
    let (mut sum, mut x, mut y) = (0.0, 0.0, 0.0);
    for (at, &error) in errors.iter().enumerate().take_while(|(_, error)| **error < threshold) {
        let recall = (at + 1) as f64 / errors.len() as f64;
        sum += (error - x) * (recall + y) / 2.0;
        (x, y) = (error, recall);
    }
    100.0 * (sum + (threshold - x) * y) / threshold
}

/// Share of the true extent up to which two images are at one place.
const ONE_PLACE: f64 = 1e-6;

/// Angle between the relative rotations.
fn rotation_error(a: &Rigid, b: &Rigid, true_a: &Rigid, true_b: &Rigid) -> f64 {
    let relative = |a: &Rigid, b: &Rigid| b.rotation.inverse() * a.rotation;
    (relative(a, b).inverse() * relative(true_a, true_b)).angle()
}

/// Angle between the directions from the first camera to the second, in the first one's frame.
fn direction_error(a: &Rigid, b: &Rigid, true_a: &Rigid, true_b: &Rigid) -> f64 {
    let direction = |a: &Rigid, b: &Rigid| a.rotation.inverse() * (b.translation - a.translation);
    let (u, v) = (direction(a, b), direction(true_a, true_b));
    if u.norm() > 0.0 { u.cross(&v).norm().atan2(u.dot(&v)) } else { std::f64::consts::PI }
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
        assert!(auc_percent(&moved, &poses()).unwrap().iter().all(|area| *area > 99.999));
    }

    #[test]
    fn unregistered_images_count_as_failed() {
        let mut estimated = poses();
        estimated.remove("0");
        assert!((auc_percent(&estimated, &poses()).unwrap()[4] - 50.0).abs() < 1e-3);
    }

    #[test]
    fn two_views_of_one_place_are_judged_by_their_rotation() {
        let turned = |poses: BTreeMap<String, Rigid>, angle: f64| {
            let view = |(name, pose): (String, Rigid)| {
                let turn = UnitQuaternion::from_euler_angles(0.0, angle, 0.0);
                [(name.clone(), pose), (name + "b", Rigid::new(pose.rotation * turn, pose.translation))]
            };
            poses.into_iter().flat_map(view).collect::<BTreeMap<_, _>>()
        };
        let truth = turned(poses(), 0.5);
        assert!(auc_percent(&truth, &truth).unwrap().iter().all(|area| *area > 99.999));
        // Of 28 pairs only those four whose views have other angles between them, and the 12 of one such and one other view.
        let off = auc_percent(&turned(poses(), 0.6), &truth).unwrap()[3];
        assert!(off < 60.0, "{off}");
        // Two places that are one in the estimate have no direction, and fail.
        let mut joined = truth.clone();
        joined.insert("1".to_owned(), truth["0"]);
        assert!(auc_percent(&joined, &truth).unwrap()[4] < 90.0);
    }

    #[test]
    fn one_image_has_no_area() {
        let mut one = poses();
        one.retain(|name, _| name == "0");
        assert_eq!(auc_percent(&poses(), &one), None);
        assert!(auc_percent(&one, &poses()).is_some());
    }

    #[test]
    fn area_is_that_of_the_definition() {
        // Recall 1/2 from 1° and 1 from 3°, up to 5°: 0.25 + 1.5 + 2 of 5.
        assert!((area(&[1.0, 3.0], 5.0) - 75.0).abs() < 1e-12);
    }
}
