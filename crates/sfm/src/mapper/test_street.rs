//! Three panoramas along a street for tests.

use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng;
use setloc_features::{Camera, DESCRIPTOR_LEN, ImageFeatures, Keypoint};

use super::structure::triangulate_image;
use super::{MapperInput, MapperParams, correspondence::CorrespondenceGraph, model::Model};
use crate::{
    ImageId, PairGeometry, Rigid, TwoView,
    synthetic::{normal, seeded},
};

const NOISE_PX: f64 = 0.3;
/// Points that all three see.
pub(super) const POINTS: usize = 160;

pub(super) struct Street {
    camera: Camera,
    points: Vec<Vector3<f64>>,
    features: Vec<ImageFeatures>,
    pairs: Vec<PairGeometry>,
    pub poses: Vec<Rigid>,
}

impl Street {
    /// The first two images match all points; the third matches the first `with_first` of them, which lie ahead, with the
    /// first, and those up to `with_second` with the second.
    pub fn new(seed: &str, with_first: usize, with_second: usize) -> Self {
        let mut rng = seeded(seed);
        let camera = Camera::equirectangular(2048, 1024);
        let pose = |z: f64, yaw: f64| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw);
            Rigid::new(turn, Vector3::new(0.3 * yaw, 0.0, z))
        };
        let poses = vec![pose(0.0, 0.1), pose(8.0, -0.4), pose(17.0, 0.7)];
        let points: Vec<Vector3<f64>> = (0..POINTS)
            .map(|at| {
                let side = if at % 2 == 0 { 9.0 } else { -9.0 };
                let along =
                    if at < with_first { rng.random_range(28.0..34.0) } else { rng.random_range(-4.0..22.0) };
                Vector3::new(side, rng.random_range(-4.0..2.0), along)
            })
            .collect();
        let descriptors: Vec<[u8; DESCRIPTOR_LEN]> =
            points.iter().map(|_| std::array::from_fn(|_| rng.random_range(0..100))).collect();
        let features_of = |pose: &Rigid| {
            let mut features = ImageFeatures { width: 2048, height: 1024, ..ImageFeatures::default() };
            for (point, descriptor) in points.iter().zip(&descriptors) {
                let pixel = camera.project(&pose.inverse_transform_point(point)).expect("sees all around");
                let [x, y] = [pixel.x, pixel.y].map(|at| (at + NOISE_PX * normal(&mut rng)) as f32);
                let noise_px = NOISE_PX as f32;
                features.keypoints.push(Keypoint { x, y, size: 4.0, orientation: 0.0, noise_px });
                features.colors.push([128; 3]);
                features.descriptors.extend(descriptor);
            }
            features
        };
        let features: Vec<ImageFeatures> = poses.iter().map(features_of).collect();
        let pairs =
            vec![pair(&poses, 0, 1, POINTS), pair(&poses, 0, 2, with_first), pair(&poses, 1, 2, with_second)];
        Self { camera, points, features, pairs, poses }
    }

    pub fn input(&self) -> MapperInput<'_> {
        MapperInput::of_one_camera(&self.camera, &self.features, &self.pairs)
    }

    /// Adds a panorama a step from one of the three, with which it shares all points, and with no other any.
    pub fn stand_again(&mut self, image: usize) {
        let pose = self.poses[image];
        let pose = Rigid::new(pose.rotation, pose.translation + Vector3::new(0.5, 0.0, 1.0));
        let mut features = self.features[image].clone();
        for (keypoint, point) in features.keypoints.iter_mut().zip(&self.points) {
            let pixel = self.camera.project(&pose.inverse_transform_point(point)).expect("sees all around");
            [keypoint.x, keypoint.y] = [pixel.x, pixel.y].map(|at| at as f32);
        }
        self.poses.push(pose);
        self.pairs.push(pair(&self.poses, image, self.poses.len() - 1, POINTS));
        self.features.push(features);
    }

    /// Adds a pair of two panoramas each of whose matches is of two points.
    pub fn match_wrongly(&mut self, first: usize, second: usize) {
        let mut wrong = pair(&self.poses, first, second, POINTS);
        for (at, m) in wrong.two_view.inliers.iter_mut().enumerate() {
            (m.first, m.second) = Self::wrong_match(at as u32);
        }
        self.pairs.push(wrong);
    }

    /// The keypoints of one of its matches.
    pub fn wrong_match(at: u32) -> (u32, u32) {
        (at, (at + POINTS as u32 / 2 + 1) % POINTS as u32)
    }

    /// Forgets the pair of two panoramas.
    pub fn unpair(&mut self, first: usize, second: usize) {
        let [first, second] = [first, second].map(|image| ImageId(image as u32));
        self.pairs.retain(|pair| (pair.first, pair.second) != (first, second));
    }

    pub fn graph(&self) -> CorrespondenceGraph {
        CorrespondenceGraph::build(
            &vec![POINTS; self.features.len()],
            &self.pairs,
            &vec![true; self.pairs.len()],
        )
    }

    pub fn features_mut(&mut self, image: usize) -> &mut ImageFeatures {
        &mut self.features[image]
    }
}

/// The right pair of two images that match the first points.
fn pair(poses: &[Rigid], first: usize, second: usize, matches: usize) -> PairGeometry {
    PairGeometry {
        first: ImageId(first as u32),
        second: ImageId(second as u32),
        two_view: TwoView::of_equal_features(poses[second].inverse() * poses[first], 0..matches as u32),
    }
}

/// The model of the first two images at their true poses.
pub(super) fn first_two<'a>(street: &Street, input: &'a MapperInput<'a>) -> Model<'a> {
    let mut model = Model::new(input);
    model.set_pose(ImageId(0), Some(street.poses[0]));
    model.set_pose(ImageId(1), Some(street.poses[1]));
    triangulate_image(&mut model, &street.graph(), MapperParams::default().limits(), ImageId(0));
    model
}
