//! A model that is bent where one image ought to hold it straight.
//!
//! Parts that share little are joined a degree or two askew, and what agrees with that keeps them so. An image that sees both then
//! fits one of them, and the pairs with all images of the other speak against it: not for another place, but for nearly the same.
//! Taken out, it would leave the model bent. So the model is opened to what these pairs matched, under a loss as wide, and kept if
//! the image's pairs agree afterwards.

use std::collections::BTreeMap;

use super::{
    Mapper,
    structure::{complete_and_merge, triangulate_image},
};
use crate::{
    ImageId,
    bundle::{BundleParams, RobustLoss},
};

/// How many times farther off observations may be, from round to round: 1.5° is five times what a panorama's may be.
const OPENED: [f64; 3] = [12.0, 6.0, 2.0];
/// Largest difference between the model and a pair, in rotation and in direction, that is a bend.
const MAX_BEND_RAD: f64 = 0.07;
const MAX_TURNED_DIRECTION_RAD: f64 = 0.3;
/// Share of the matches of an image's pairs that must be for its place or nearly that.
const MIN_NEAR: f64 = 0.75;

impl Mapper<'_> {
    /// Bends the model so that the pairs agree which speak against this image's place by little; whether that was so.
    pub(super) fn straighten(&mut self, image: ImageId) -> bool {
        if std::mem::replace(&mut self.straightened[image.index()], true) || !self.is_at_a_bend(image) {
            return false;
        }
        let bent = self.model.clone();
        for factor in OPENED {
            let limits = self.params.limits().widened(factor);
            triangulate_image(&mut self.model, &self.graph, limits, image);
            complete_and_merge(&mut self.model, &self.graph, limits);
            let loss = RobustLoss::Cauchy(factor * self.params.loss_sigma);
            self.adjust_all_by(&BundleParams { loss, ..self.params.bundle(20) });
            self.filter_all(limits);
        }
        self.refine(2, 20);
        let pose = self.model.poses[image.index()].as_ref();
        let is_straight = pose.is_some_and(|pose| self.support(image, &pose.world_from_camera).is_clear());
        let is_kept = is_straight && self.model.observation_count() >= bent.observation_count();
        if !is_kept {
            self.model = bent;
        }
        is_kept
    }

    /// Whether most that speaks against an image's place speaks for one that is hardly another, and something speaks for it.
    fn is_at_a_bend(&self, image: ImageId) -> bool {
        let Some(pose) = &self.model.poses[image.index()] else { return false };
        let world_from_image = pose.world_from_camera;
        if self.support(image, &world_from_image).matches < self.params.min_initial_points {
            return false;
        }
        // Of the geometries of one pair one can be right: by partner, the matches of the strongest that is near, and of any.
        let mut of_partners = BTreeMap::<ImageId, [usize; 2]>::new();
        for pair in self.model.input.pairs {
            let Some((partner, image_from_partner)) = pair.seen_from(image) else { continue };
            let Some(pose) = &self.model.poses[partner.index()] else { continue };
            let modelled = world_from_image.inverse() * pose.world_from_camera;
            let turned = modelled.rotation.angle_to(&image_from_partner.rotation);
            let aside = modelled.translation.angle(&image_from_partner.translation);
            let is_near = turned <= MAX_BEND_RAD && aside <= MAX_TURNED_DIRECTION_RAD;
            let matches = pair.two_view.inliers.len();
            let [near, any] = of_partners.entry(partner).or_default();
            *near = (*near).max(if is_near { matches } else { 0 });
            *any = (*any).max(matches);
        }
        let sum = |at: usize| of_partners.values().map(|matches| matches[at]).sum::<usize>() as f64;
        sum(0) >= MIN_NEAR * sum(1)
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use nalgebra::{UnitQuaternion, Vector3};
    use rand::Rng;
    use setloc_features::{Camera, ImageFeatures, Keypoint};

    use super::super::{MapperInput, MapperParams, model::Model};
    use super::*;
    use crate::{
        PairGeometry, Rigid, TwoView,
        synthetic::{normal, seeded},
    };

    const NOISE_PX: f64 = 0.3;
    /// Points that the first two images and the last share, and those that the other two and the last share.
    const OF_FIRST: Range<u32> = 0..60;
    const OF_OTHERS: Range<u32> = 60..220;
    const LAST: ImageId = ImageId(4);

    fn features(camera: &Camera, poses: &[Rigid]) -> Vec<ImageFeatures> {
        let mut rng = seeded("bend");
        let mut point = || {
            let [azimuth, height] =
                [rng.random_range(0.0..std::f64::consts::TAU), rng.random_range(-2.0..2.0)];
            let away = rng.random_range(4.0..9.0);
            Vector3::new(away * azimuth.sin(), height, away * azimuth.cos())
        };
        let points: Vec<Vector3<f64>> = (0..OF_OTHERS.end).map(|_| point()).collect();
        let of_image = |pose: &Rigid| {
            let pixels =
                points.iter().filter_map(|point| camera.project(&pose.inverse_transform_point(point)));
            let noisy =
                pixels.map(|pixel| [pixel.x, pixel.y].map(|at| (at + NOISE_PX * normal(&mut rng)) as f32));
            let noise_px = NOISE_PX as f32;
            let keypoint = |[x, y]: [f32; 2]| Keypoint { x, y, size: 5.0, orientation: 0.0, noise_px };
            let keypoints: Vec<Keypoint> = noisy.map(keypoint).collect();
            let colors = vec![[128; 3]; keypoints.len()];
            ImageFeatures { width: 2048, height: 1024, keypoints, colors, ..ImageFeatures::default() }
        };
        poses.iter().map(of_image).collect()
    }

    /// Whether the model is straightened in which two of five images are turned about the last by so much, and how far they are
    /// turned then.
    fn straightened(degrees: f64) -> (bool, f64) {
        let camera = Camera::equirectangular(2048, 1024);
        let at = |x: f64, z: f64, yaw: f64| {
            Rigid::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw), Vector3::new(x, 0.0, z))
        };
        let poses = [
            at(0.0, -2.0, 0.1),
            at(0.4, -1.0, -0.3),
            at(0.2, 1.1, 0.6),
            at(-0.3, 2.0, 1.1),
            at(0.0, 0.0, 0.0),
        ];
        let features = features(&camera, &poses);
        let shared = [
            (0, 1, OF_FIRST),
            (0, 4, OF_FIRST),
            (1, 4, OF_FIRST),
            (2, 3, OF_OTHERS),
            (2, 4, OF_OTHERS),
            (3, 4, OF_OTHERS),
        ];
        let pairs: Vec<PairGeometry> = shared
            .into_iter()
            .map(|(first, second, features)| PairGeometry {
                first: ImageId(first),
                second: ImageId(second),
                two_view: TwoView::of_equal_features(
                    poses[second as usize].inverse() * poses[first as usize],
                    features,
                ),
            })
            .collect();
        let input = MapperInput::of_one_camera(&camera, &features, &pairs);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), degrees.to_radians());
        let turned = Rigid::new(turn, Vector3::zeros());
        let mut model = Model::new(&input);
        for (image, pose) in poses.iter().enumerate() {
            let pose = if [2, 3].contains(&image) { turned * *pose } else { *pose };
            model.set_pose(ImageId(image as u32), Some(pose));
        }
        let params = MapperParams::default();
        let mut mapper = Mapper::over(&params, model, vec![false; poses.len()], 0);
        for image in 0..poses.len() as u32 {
            triangulate_image(&mut mapper.model, &mapper.graph, params.limits(), ImageId(image));
        }
        let is_straight = mapper.straighten(LAST);
        assert!(!mapper.straighten(LAST), "tried once");
        let rotation = |image: usize| {
            mapper.model.poses[image].as_ref().expect("is registered").world_from_camera.rotation
        };
        let off = (rotation(0).inverse() * rotation(3))
            .angle_to(&(poses[0].rotation.inverse() * poses[3].rotation));
        (is_straight, off.to_degrees())
    }

    #[test]
    fn a_bend_is_mended_and_another_place_is_left_to_others() {
        let (is_straight, off) = straightened(1.5);
        assert!(is_straight && off < 0.1, "{off}°");
        let (is_straight, off) = straightened(20.0);
        assert!(!is_straight && (off - 20.0).abs() < 0.1, "{off}°");
    }
}
