use std::cmp::Reverse;

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use setloc_features::{Camera, Keypoint};

use crate::{
    Rigid, Similarity,
    bundle::{BundleProblem, LengthRatio},
    mapper::MIN_CALIBRATING_POINTS,
};

macro_rules! id {
    ($name:ident, $doc:literal) => {
        #[doc = $doc]
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub u32);

        impl $name {
            /// As an index into the dense vector it belongs to.
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }
    };
}

id!(CameraId, "Index into [`Reconstruction::cameras`].");
id!(ImageId, "Index into [`Reconstruction::images`].");
id!(PointId, "Index into [`Reconstruction::points`].");

/// Keypoint `feature` of image `image` sees a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Observation {
    /// The seeing image.
    pub image: ImageId,
    /// Keypoint index in that image.
    pub feature: u32,
}

/// One input image with its pose when it is registered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReconstructionImage {
    /// Name as the user knows it.
    pub name: String,
    /// Its camera.
    pub camera: CameraId,
    /// Pose, or `None` when the image is not part of this component.
    pub world_from_camera: Option<Rigid>,
}

/// Images stand about upright where the mean of their vertical axes is as long as this.
const MIN_UPRIGHT: f64 = 0.9;

/// One triangulated point with its track.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReconstructionPoint {
    /// Position in the world frame.
    pub position: Vector3<f64>,
    /// sRGB.
    pub color: [u8; 3],
    /// Root mean square of the angular residuals in units of their standard deviations.
    pub error_sigma: f64,
    /// Covariance of the position where the cameras are exact, in the world's unit squared; `None` where it is what the
    /// noise of the keypoints leaves.
    pub covariance: Option<Matrix3<f32>>,
    /// Who sees it, sorted.
    pub track: Vec<Observation>,
    /// Where the pixels of the views place it; `None` where only keypoints do.
    pub aligned: Option<AlignedTrack>,
}

/// The views of a point, placed by their pixels so that all show one spot; see [`crate::align_tracks`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlignedTrack {
    /// Places in the views of the track, in its order.
    pub places: Vec<Place>,
    /// Places in views without a keypoint of the point.
    pub further: Vec<(ImageId, Place)>,
    /// Covariance of what the views have in common: how far a detector's next keypoint will be from that spot, in the
    /// world's unit squared.
    pub spot: Matrix3<f32>,
}

/// A place in an image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// In pixels.
    pub pixel: Vector2<f64>,
    /// Standard deviation of each coordinate, against the other views of the point.
    pub noise_px: f64,
}

/// The length of a baseline that no common points tell but surfaces that go on; see [`crate::MapperParams`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BaselineLength {
    /// Where the baseline begins that it is compared with.
    pub reference: ImageId,
    /// Where that one ends and this one begins.
    pub from: ImageId,
    /// Where this one ends.
    pub to: ImageId,
    /// Distance of `to` from `from`, divided by that of `from` from `reference`.
    pub ratio: f64,
    /// Standard deviation of its logarithm.
    pub deviation: f64,
    /// Points that agree on it.
    pub votes: usize,
    /// Pose of `to` in the frame of `from`, in lengths of the reference baseline.
    pub pose: Rigid,
    /// Covariance of the pose: rotation about the axes of `to` in radians, then the centre in the same unit.
    pub covariance: Matrix6<f64>,
    /// Where a wall leaves two poses open: either, in the same unit, with what is known of it alone. `covariance` is then of
    /// which is right, too.
    pub either: Option<[StepPose; 2]>,
}

/// The pose of the second camera of a step in the frame of the first.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StepPose {
    /// The pose.
    pub first_from_second: Rigid,
    /// Covariance: rotation about the second's axes in radians, then its centre in the unit of the pose.
    pub covariance: Matrix6<f64>,
}

impl StepPose {
    /// The same where the unit is this many times smaller.
    #[must_use]
    pub(crate) fn scaled(&self, factor: f64) -> Self {
        let Rigid { rotation, translation } = self.first_from_second;
        let mut scale = Matrix6::<f64>::identity();
        scale.fixed_view_mut::<3, 3>(3, 3).scale_mut(factor);
        Self {
            first_from_second: Rigid::new(rotation, translation * factor),
            covariance: scale * self.covariance * scale,
        }
    }

    /// The same in other frames of the two cameras, given their turns into the present ones.
    #[must_use]
    fn turned(&self, first: &UnitQuaternion<f64>, second: &UnitQuaternion<f64>) -> Self {
        let Rigid { rotation, translation } = self.first_from_second;
        let mut jacobian = Matrix6::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(second.inverse().to_rotation_matrix().matrix());
        jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(first.inverse().to_rotation_matrix().matrix());
        Self {
            first_from_second: Rigid::new(first.inverse() * rotation * second, first.inverse() * translation),
            covariance: jacobian * self.covariance * jacobian.transpose(),
        }
    }
}

impl BaselineLength {
    /// The length of the step from `from` to `to`, with their pose in units of the model and the reference baseline's
    /// length; `None` without a step.
    pub(crate) fn of_step(
        [reference, from, to]: [ImageId; 3],
        pose: &StepPose,
        baseline: f64,
        votes: usize,
    ) -> Option<Self> {
        let step = pose.first_from_second.translation;
        let along = step.try_normalize(0.0)?;
        let variance = along.dot(&(pose.covariance.fixed_view::<3, 3>(3, 3) * along));
        let StepPose { first_from_second, covariance } = pose.scaled(baseline.recip());
        Some(Self {
            reference,
            from,
            to,
            ratio: step.norm() / baseline,
            deviation: variance.max(0.0).sqrt() / step.norm(),
            votes,
            pose: first_from_second,
            covariance,
            either: None,
        })
    }

    /// The pose of `to` in the frame of `from`, in lengths of the reference baseline.
    pub(crate) fn step(&self) -> StepPose {
        StepPose { first_from_second: self.pose, covariance: self.covariance }
    }

    /// The three images, and the ratio as bundle adjustment takes it.
    pub fn held(&self) -> ([ImageId; 3], LengthRatio) {
        let length = LengthRatio { ratio: self.ratio, deviation: self.deviation };
        ([self.reference, self.from, self.to], length)
    }

    /// Whether an image is one of the three.
    pub(crate) fn involves(&self, image: ImageId) -> bool {
        [self.reference, self.from, self.to].contains(&image)
    }

    /// Holds it in an adjustment, where all three images take part in it.
    pub(crate) fn hold_in(&self, problem: &mut BundleProblem, pose_of: impl Fn(ImageId) -> Option<u32>) {
        let (images, length) = self.held();
        if let [Some(reference), Some(from), Some(to)] = images.map(pose_of) {
            problem.hold_length([reference, from, to], length);
        }
    }

    /// The same between other images.
    #[must_use]
    pub fn between(self, image: impl Fn(ImageId) -> ImageId) -> Self {
        let [reference, from, to] = [self.reference, self.from, self.to].map(image);
        Self { reference, from, to, ..self }
    }

    /// The same in other frames of the two cameras, given their turns into the present ones.
    #[must_use]
    pub fn turned(self, from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> Self {
        let StepPose { first_from_second, covariance } = self.step().turned(from, to);
        let either = self.either.map(|poses| poses.map(|pose| pose.turned(from, to)));
        Self { pose: first_from_second, covariance, either, ..self }
    }
}

/// One connected component of a scene or of a local model.
///
/// `images` lists *all* input images in input order, so that ids mean the same in every component.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Reconstruction {
    /// Cameras with their (possibly refined) intrinsics.
    pub cameras: Vec<Camera>,
    /// All input images.
    pub images: Vec<ReconstructionImage>,
    /// Triangulated points.
    pub points: Vec<ReconstructionPoint>,
    /// Lengths of baselines that the points do not tell.
    pub lengths: Vec<BaselineLength>,
}

impl From<&Keypoint> for Place {
    fn from(keypoint: &Keypoint) -> Self {
        Self { pixel: keypoint.pixel(), noise_px: f64::from(keypoint.noise_px) }
    }
}

impl Reconstruction {
    /// Ids of the registered images, ascending.
    pub fn registered(&self) -> impl Iterator<Item = ImageId> + '_ {
        (0..self.images.len() as u32)
            .map(ImageId)
            .filter(|id| self.images[id.index()].world_from_camera.is_some())
    }

    /// Leaves components of at least two images, the largest first and of equals in the order that they have.
    pub fn largest_first(components: &mut Vec<Self>) {
        let size = |component: &Self| component.registered().count();
        components.retain(|component| size(component) >= 2);
        components.sort_by_key(|component| Reverse(size(component)));
    }

    /// Takes the poses of images and what they see.
    pub fn leave_out(&mut self, images: &[ImageId]) {
        for image in images {
            self.images[image.index()].world_from_camera = None;
            for point in &mut self.points {
                point.track.retain(|seen| seen.image != *image);
            }
        }
        self.points.retain(|point| point.track.len() >= 2);
    }

    /// The same with images in the order of their names, as people list them.
    pub fn by_name(&self) -> Self {
        let mut order: Vec<usize> = (0..self.images.len()).collect();
        order.sort_by(|&a, &b| self.images[a].name.cmp(&self.images[b].name));
        let mut id_of = vec![ImageId(0); order.len()];
        for (id, &at) in order.iter().enumerate() {
            id_of[at] = ImageId(id as u32);
        }
        let mut points = self.points.clone();
        for point in &mut points {
            for observation in &mut point.track {
                observation.image = id_of[observation.image.index()];
            }
            if let Some(aligned) = &mut point.aligned {
                let mut order: Vec<usize> = (0..aligned.places.len()).collect();
                order.sort_by_key(|&at| point.track.get(at));
                aligned.places = order.iter().map(|&at| aligned.places[at]).collect();
                for (image, _) in &mut aligned.further {
                    *image = id_of[image.index()];
                }
                aligned.further.sort_by_key(|(image, _)| *image);
            }
            point.track.sort_unstable();
        }
        let images = order.iter().map(|&at| self.images[at].clone()).collect();
        let lengths =
            self.lengths.iter().map(|length| length.between(|image| id_of[image.index()])).collect();
        Self { cameras: self.cameras.clone(), images, points, lengths }
    }

    /// The camera of an image.
    pub fn camera_of(&self, image: ImageId) -> &Camera {
        &self.cameras[self.images[image.index()].camera.index()]
    }

    /// Which way is down, a unit vector: that of the images' vertical axes, which stand upright as street-view panoramas do;
    /// `None` where they do not.
    pub fn down(&self) -> Option<Vector3<f64>> {
        let poses = self.images.iter().filter_map(|image| image.world_from_camera);
        let axes: Vec<Vector3<f64>> = poses.map(|pose| pose.rotation * Vector3::y()).collect();
        let mean = axes.iter().sum::<Vector3<f64>>() / axes.len().max(1) as f64;
        (mean.norm() >= MIN_UPRIGHT).then(|| mean.normalize())
    }

    /// Whether images see enough points, each seen by three images at least, to tell their camera though they are few.
    pub fn tells_camera_of(&self, images: &[ImageId]) -> bool {
        let is_held = |point: &&ReconstructionPoint| {
            point.track.len() >= 3 && point.track.iter().any(|seen| images.contains(&seen.image))
        };
        self.points.iter().filter(is_held).count() >= MIN_CALIBRATING_POINTS
    }

    /// Number of observations of all points.
    pub fn observation_count(&self) -> usize {
        self.points.iter().map(|point| point.track.len()).sum()
    }

    /// Moves the whole component into another frame.
    pub fn transform(&mut self, target_from_world: &Similarity) {
        for image in &mut self.images {
            image.world_from_camera =
                image.world_from_camera.map(|pose| target_from_world.transform_pose(&pose));
        }
        for point in &mut self.points {
            point.position = target_from_world.transform_point(&point.position);
            let turned = |covariance: &Matrix3<f32>| {
                target_from_world.transform_covariance(&covariance.cast()).cast::<f32>()
            };
            point.covariance = point.covariance.as_ref().map(turned);
            if let Some(aligned) = &mut point.aligned {
                aligned.spot = turned(&aligned.spot);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_name_every_observation_stays_with_its_image() {
        let image = |name: &str, camera| ReconstructionImage {
            name: name.to_owned(),
            camera: CameraId(camera),
            world_from_camera: None,
        };
        let seen = |image, feature| Observation { image: ImageId(image), feature };
        let point = |track: Vec<Observation>| ReconstructionPoint {
            position: Vector3::zeros(),
            color: [0; 3],
            error_sigma: 1.0,
            covariance: None,
            track,
            aligned: None,
        };
        let model = Reconstruction {
            cameras: Vec::new(),
            images: vec![image("c", 0), image("a", 1), image("b", 2)],
            points: vec![point(vec![seen(0, 7), seen(1, 8)]), point(vec![seen(1, 5), seen(2, 6)])],
            lengths: vec![BaselineLength {
                reference: ImageId(0),
                from: ImageId(1),
                to: ImageId(2),
                ratio: 1.5,
                deviation: 0.1,
                votes: 20,
                pose: Rigid::identity(),
                covariance: Matrix6::identity(),
                either: None,
            }],
        };
        let listed = model.by_name();
        assert_eq!(listed.images, [image("a", 1), image("b", 2), image("c", 0)]);
        assert_eq!(listed.points[0].track, [seen(0, 8), seen(2, 7)]);
        assert_eq!(listed.points[1].track, [seen(0, 5), seen(1, 6)]);
        assert_eq!(listed.lengths[0].held().0, [ImageId(2), ImageId(0), ImageId(1)]);
        assert_eq!(listed.by_name(), listed);
    }
}
