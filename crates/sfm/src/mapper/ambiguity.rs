use std::collections::BTreeSet;

use nalgebra::Vector3;

use super::{
    MapperParams,
    adjust::{Scope, adjust, is_adjustable},
    correspondence::CorrespondenceGraph,
    model::Model,
    register::{PoseHypothesis, Visibility, register},
    structure::{filter, triangulate_image},
};
use crate::{
    ImageId, Observation, Rigid,
    robust::{RansacParams, rival_poses},
};

/// Points of an image among which rivals are sought.
const MOST_POINTS: usize = 200;
/// Length of the mean of unit bearings below which they point so far apart that one pose only fits: that of a cone with 66° to
/// its rim.
const MIN_MEAN_BEARING: f64 = 0.7;
/// Points were adjusted along with the pose that is doubted, so another may miss them by so many times more.
const WIDER: f64 = 3.0;

/// Of the poses that an image's points leave open, takes the one that explains all its matches best.
///
/// Points on one far wall that fills a small angle allow two poses: the camera may stand left of the wall's normal and
/// look right, or the other way round (G. Schweighofer, A. Pinz, "Robust pose estimation from a planar target",
/// PAMI 2006). Which of them a resection finds is left to chance, as the depths of the points are poor. Both are adjusted here
/// with all matches, also those that only one other image has and that no depth is known for: they tell the two
/// apart.
pub(super) fn settle_pose(
    model: &mut Model<'_>,
    graph: &CorrespondenceGraph,
    params: &MapperParams,
    image: ImageId,
    seed: u64,
) {
    if !is_adjustable(model, image) || model.lengths.iter().any(|length| length.involves(image)) {
        return;
    }
    let Some(current) = model.poses[image.index()].map(|pose| pose.world_from_camera) else { return };
    let rivals = rivals(model, params, image, &current, seed);
    if rivals.is_empty() {
        return;
    }
    let poses = std::iter::once(&current).chain(&rivals);
    let trials: Vec<Model<'_>> = poses.map(|pose| moved_to(model, graph, params, image, pose)).collect();
    let seen: BTreeSet<u32> =
        trials.iter().flat_map(|trial| trial.observations_of(image)).map(|(feature, _)| feature).collect();
    let costs: Vec<f64> = trials.iter().map(|trial| cost(trial, params, image, &seen)).collect();
    let best = (1..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b]));
    if let Some(best) = best.filter(|&best| costs[best] < costs[0])
        && let Some(better) = trials.into_iter().nth(best)
    {
        *model = better;
    }
}

/// Other poses that explain nearly as many of the points that the image does not place alone.
fn rivals(
    model: &Model<'_>,
    params: &MapperParams,
    image: ImageId,
    current: &Rigid,
    seed: u64,
) -> Vec<Rigid> {
    let rays = &model.rays[image.index()];
    let (mut bearings, mut sigmas, mut points) = (Vec::new(), Vec::new(), Vec::new());
    let known = model.placed_by_others(image);
    for (feature, id) in known.iter().step_by(known.len().div_ceil(MOST_POINTS).max(1)).copied() {
        if let Some(point) = model.point(id)
            && rays.sigmas[feature as usize].is_finite()
        {
            bearings.push(rays.bearings[feature as usize]);
            sigmas.push(WIDER * rays.sigmas[feature as usize]);
            points.push(point.position);
        }
    }
    let mean = bearings.iter().sum::<Vector3<f64>>() / bearings.len().max(1) as f64;
    if mean.norm() < MIN_MEAN_BEARING {
        return Vec::new();
    }
    let params = RansacParams { min_inliers: params.min_confirmed_inliers, ..params.ransac() };
    rival_poses(&params, &bearings, &sigmas, &points, current, seed ^ (u64::from(image.0) << 32))
}

/// The model with an image at this pose, adjusted with all that it sees from there.
fn moved_to<'a>(
    model: &Model<'a>,
    graph: &CorrespondenceGraph,
    params: &MapperParams,
    image: ImageId,
    pose: &Rigid,
) -> Model<'a> {
    let mut trial = model.clone();
    let inliers = model.placed_by_others(image);
    trial.unregister(image);
    let candidates = inliers.len();
    let visibility = Visibility::default();
    register(
        &mut trial,
        image,
        &PoseHypothesis { world_from_camera: *pose, inliers, candidates, visibility, length: None },
    );
    for _ in 0..2 {
        // The other images hold still: a wrong pose would drag them along.
        let scope = Scope::local(&trial, image, 0);
        adjust(&mut trial, &params.bundle(20), &scope);
        let points = trial.seen_by(&[image]);
        filter(&mut trial, params.limits(), &points);
        triangulate_image(&mut trial, graph, params.limits(), image);
    }
    trial
}

/// Robust cost of these keypoints of an image and of what other images see of the same points; who sees nothing costs as
/// much as one at the limit.
fn cost(model: &Model<'_>, params: &MapperParams, image: ImageId, features: &BTreeSet<u32>) -> f64 {
    let loss = |error: f64| (error / params.loss_sigma).powi(2).ln_1p();
    let of_feature = |&feature: &u32| {
        let point = model.point_of(Observation { image, feature }).and_then(|id| model.point(id));
        point.map_or(loss(params.max_error_sigma), |point| {
            let errors = point.track.iter().filter_map(|&seen| model.error_sigma(seen, &point.position));
            errors.map(loss).sum()
        })
    };
    features.iter().map(of_feature).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix6, UnitQuaternion, Vector3};
    use rand::Rng;
    use setloc_features::{Camera, DESCRIPTOR_LEN, ImageFeatures, Keypoint};

    use super::*;
    use crate::{
        BaselineLength, MapperInput, PairGeometry, TwoView,
        synthetic::{normal, rotation_angle, seeded},
    };

    const NOISE_PX: f64 = 0.4;

    /// Three photos that pass a wall at 12 m, and a fourth from its other side that shares a strip of it with them.
    fn poses() -> Vec<Rigid> {
        let looking = |x: f64, z: f64, yaw: f64| {
            Rigid::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw), Vector3::new(x, 0.0, z))
        };
        vec![
            looking(-3.0, 0.0, 0.2),
            looking(-2.2, 0.1, 0.15),
            looking(-1.5, 0.0, 0.1),
            looking(3.0, 1.0, -0.25),
        ]
    }

    fn photos(camera: &Camera, seed: &str) -> Vec<ImageFeatures> {
        let mut rng = seeded(seed);
        let points: Vec<Vector3<f64>> = (0..80)
            .map(|_| {
                let [x, y] = [0, 1].map(|_| rng.random_range(-1.5..1.5));
                Vector3::new(x, y, 12.0 + 0.02 * normal(&mut rng))
            })
            .collect();
        let features_of = |pose: &Rigid| {
            let mut features =
                ImageFeatures { width: camera.width, height: camera.height, ..ImageFeatures::default() };
            for point in &points {
                let pixel = camera.project(&pose.inverse_transform_point(point)).unwrap();
                let [x, y] = [pixel.x, pixel.y].map(|at| (at + NOISE_PX * normal(&mut rng)) as f32);
                let noise_px = NOISE_PX as f32;
                features.keypoints.push(Keypoint { x, y, size: 4.0, orientation: 0.0, noise_px });
                features.colors.push([128; 3]);
                features.descriptors.extend([0; DESCRIPTOR_LEN]);
            }
            features
        };
        poses().iter().map(features_of).collect()
    }

    fn pairs() -> Vec<PairGeometry> {
        let poses = poses();
        let pair = |first: usize, second: usize| PairGeometry {
            first: ImageId(first as u32),
            second: ImageId(second as u32),
            two_view: TwoView::of_equal_features(
                poses[second].inverse() * poses[first],
                // The last photo shares half of its matches with one other photo only.
                (0..80).filter(|at| second < 3 || *at % 2 == 0 || first == (*at / 2 % 3) as usize),
            ),
        };
        [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)].map(|(a, b)| pair(a, b)).to_vec()
    }

    fn length_of([reference, from, to]: [ImageId; 3]) -> BaselineLength {
        let (pose, covariance) = (Rigid::default(), Matrix6::identity());
        BaselineLength {
            reference,
            from,
            to,
            ratio: 1.0,
            deviation: 0.1,
            votes: 10,
            pose,
            covariance,
            either: None,
        }
    }

    #[test]
    fn a_mistaken_pose_before_a_far_wall_is_put_right_unless_a_length_rests_on_it() {
        let (camera, params, truth) =
            (Camera::from_focal_guess(1200, 900, 900.0), MapperParams::default(), poses());
        let (mut mistaken, mut put_right) = (0, 0);
        for number in 0..100 {
            let photos = photos(&camera, &format!("s{number}"));
            let (pairs, image) = (pairs(), ImageId(3));
            let input = MapperInput::of_one_camera(&camera, &photos, &pairs);
            let graph = CorrespondenceGraph::build(&[80; 4], &pairs, &[true; 6]);
            let mut model = Model::new(&input);
            for (index, pose) in truth.iter().enumerate().take(3) {
                model.set_pose(ImageId(index as u32), Some(*pose));
            }
            triangulate_image(&mut model, &graph, params.limits(), ImageId(0));
            model.set_pose(image, Some(truth[3]));
            triangulate_image(&mut model, &graph, params.limits(), image);
            for rival in rivals(&model, &params, image, &truth[3], 0) {
                let mut wrong = moved_to(&model, &graph, &params, image, &rival);
                let off = |model: &Model<'_>| {
                    let pose = model.poses[image.index()].expect("is registered").world_from_camera;
                    rotation_angle(&pose.rotation, &truth[3].rotation)
                };
                if off(&wrong) > 0.2 {
                    mistaken += 1;
                    for images in [[3, 0, 1], [0, 3, 1], [0, 1, 3]] {
                        let mut held = wrong.clone();
                        let length = length_of(images.map(ImageId));
                        held.lengths.push(length);
                        settle_pose(&mut held, &graph, &params, image, 1);
                        assert_eq!((off(&held), held.lengths), (off(&wrong), vec![length]));
                    }
                    settle_pose(&mut wrong, &graph, &params, image, 1);
                    put_right += usize::from(off(&wrong) < 0.05);
                }
            }
            settle_pose(&mut model, &graph, &params, image, 1);
            let pose = model.poses[image.index()].expect("is registered").world_from_camera;
            assert!(rotation_angle(&pose.rotation, &truth[3].rotation) < 0.05);
        }
        assert!(mistaken >= 20 && 10 * put_right >= 9 * mistaken, "{put_right} of {mistaken}");
    }
}
