use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use setloc_features::{Camera, Rays};

use super::{InputImage, MapperInput, input::PairsByImage};
use crate::{
    BaselineLength, ImageId, Observation, PairGeometry, PointId, Reconstruction, ReconstructionImage,
    ReconstructionPoint, Rigid, Similarity,
    solvers::triangulation::{WorldRay, triangulate},
    visibility::is_same_view,
};

/// A registered camera, with its rotation as a matrix because it is applied to every observation.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    pub world_from_camera: Rigid,
    pub camera_from_world: Matrix3<f64>,
}

impl Pose {
    pub fn new(world_from_camera: Rigid) -> Self {
        let camera_from_world = world_from_camera.rotation.to_rotation_matrix().matrix().transpose();
        Self { world_from_camera, camera_from_world }
    }

    pub fn center(&self) -> &Vector3<f64> {
        &self.world_from_camera.translation
    }
}

#[derive(Debug, Clone)]
pub(super) struct ModelPoint {
    pub position: Vector3<f64>,
    pub track: Vec<Observation>,
}

/// The model under construction: one component.
#[derive(Debug, Clone)]
pub(super) struct Model<'a> {
    pub input: &'a MapperInput<'a>,
    pub cameras: Vec<Camera>,
    /// Rays of every image under the current intrinsics.
    pub rays: Vec<Rays>,
    pub poses: Vec<Option<Pose>>,
    /// Deleted points leave `None`, so that ids stay valid.
    pub points: Vec<Option<ModelPoint>>,
    /// Lengths of baselines that the points do not tell.
    pub lengths: Vec<BaselineLength>,
    /// Empty of images that have no rays.
    point_of_feature: Vec<Vec<u32>>,
    pairs: PairsByImage<'a>,
    /// The images that each was matched with, ascending; `None` where nothing is said of them.
    matched: Option<Vec<Vec<ImageId>>>,
}

const NO_POINT: u32 = u32::MAX;

impl<'a> Model<'a> {
    #[cfg(test)]
    pub fn new(input: &'a MapperInput<'a>) -> Self {
        Self::with_cameras(input, input.cameras.clone(), |_| true)
    }

    /// An empty model that these images never join; they have no rays.
    pub fn without(input: &'a MapperInput<'a>, taken: &[bool]) -> Self {
        Self::with_cameras(input, input.cameras.clone(), |image| !taken[image])
    }

    /// The model of a finished component; the places of its points are their ids. Images outside have no rays.
    pub fn of_component(input: &'a MapperInput<'a>, component: &Reconstruction) -> Self {
        let is_inside = |image: usize| component.images[image].world_from_camera.is_some();
        let mut model = Self::with_cameras(input, component.cameras.clone(), is_inside);
        model.take_in(component, &Similarity::identity());
        model
    }

    /// The model of a component that images may join but those that are taken, which have no rays.
    pub fn open(input: &'a MapperInput<'a>, component: &Reconstruction, taken: &[bool]) -> Self {
        let mut model = Self::with_cameras(input, component.cameras.clone(), |image| !taken[image]);
        model.take_in(component, &Similarity::identity());
        model
    }

    /// The model of two components, the points of `moved` after those of `kept`, that images may join as one may
    /// [`Model::open`].
    ///
    /// Intrinsics that were found in both are those of `kept`.
    pub fn of_components(
        input: &'a MapperInput<'a>,
        kept: &Reconstruction,
        moved: &Reconstruction,
        kept_from_moved: &Similarity,
        taken: &[bool],
    ) -> Self {
        let mut cameras = moved.cameras.clone();
        for image in kept.registered() {
            let camera = input.camera_index(image);
            cameras[camera] = kept.cameras[camera].clone();
        }
        let mut model = Self::with_cameras(input, cameras, |image| !taken[image]);
        model.take_in(kept, &Similarity::identity());
        model.take_in(moved, kept_from_moved);
        model
    }

    fn take_in(&mut self, component: &Reconstruction, world_from_component: &Similarity) {
        for (index, image) in component.images.iter().enumerate() {
            if let Some(pose) = &image.world_from_camera {
                self.set_pose(ImageId(index as u32), Some(world_from_component.transform_pose(pose)));
            }
        }
        for point in &component.points {
            self.add_point(world_from_component.transform_point(&point.position), point.track.clone());
        }
        self.lengths.extend(&component.lengths);
    }

    fn with_cameras(
        input: &'a MapperInput<'a>,
        cameras: Vec<Camera>,
        has_rays: impl Fn(usize) -> bool + Sync,
    ) -> Self {
        let rays_of = |(index, image): (usize, &InputImage<'_>)| {
            let camera = &cameras[image.camera.index()];
            if has_rays(index) { image.features.rays(camera) } else { Rays::default() }
        };
        let rays = input.images.par_iter().with_max_len(1).enumerate().map(rays_of).collect();
        let no_points = |(index, image): (usize, &InputImage<'_>)| {
            if has_rays(index) { vec![NO_POINT; image.features.len()] } else { Vec::new() }
        };
        Self {
            input,
            cameras,
            rays,
            poses: vec![None; input.images.len()],
            points: Vec::new(),
            lengths: Vec::new(),
            point_of_feature: input.images.iter().enumerate().map(no_points).collect(),
            pairs: PairsByImage::of(input),
            matched: (!input.putative.is_empty()).then(|| {
                let mut matched = vec![Vec::new(); input.images.len()];
                for pair in input.putative {
                    matched[pair.first.index()].push(pair.second);
                    matched[pair.second.index()].push(pair.first);
                }
                for others in &mut matched {
                    others.sort_unstable();
                    others.dedup();
                }
                matched
            }),
        }
    }

    /// The registered images that an image was matched with: of a large scene only neighbours are. Never itself.
    pub fn registered_neighbours(&self, image: ImageId) -> Vec<ImageId> {
        match &self.matched {
            Some(matched) => {
                let others = matched[image.index()].iter().copied();
                others.filter(|&other| other != image && self.is_registered(other)).collect()
            }
            None => self.registered().filter(|&other| other != image).collect(),
        }
    }

    /// The verified pairs of an image.
    pub fn pairs_of(&self, image: ImageId) -> impl Iterator<Item = &'a PairGeometry> + '_ {
        self.pairs.of_image(image)
    }

    pub fn is_registered(&self, image: ImageId) -> bool {
        self.poses[image.index()].is_some()
    }

    pub fn registered(&self) -> impl Iterator<Item = ImageId> + '_ {
        (0..self.poses.len() as u32).map(ImageId).filter(|&image| self.is_registered(image))
    }

    /// The registered images of a camera, by its index.
    pub fn registered_with(&self, camera: usize) -> Vec<ImageId> {
        self.registered().filter(|image| self.input.camera_index(*image) == camera).collect()
    }

    pub fn registered_count(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    pub fn point_of(&self, observation: Observation) -> Option<PointId> {
        let of_image = &self.point_of_feature[observation.image.index()];
        let id = of_image.get(observation.feature as usize).copied().unwrap_or(NO_POINT);
        (id != NO_POINT).then_some(PointId(id))
    }

    /// Which keypoints of an image carry a point.
    pub fn carriers(&self, image: ImageId) -> Vec<bool> {
        self.point_of_feature[image.index()].iter().map(|id| *id != NO_POINT).collect()
    }

    pub fn point(&self, id: PointId) -> Option<&ModelPoint> {
        self.points[id.index()].as_ref()
    }

    pub fn live_points(&self) -> impl Iterator<Item = (PointId, &ModelPoint)> + '_ {
        self.points
            .iter()
            .enumerate()
            .filter_map(|(index, point)| Some((PointId(index as u32), point.as_ref()?)))
    }

    /// Observations of all points.
    pub fn observation_count(&self) -> usize {
        self.live_points().map(|(_, point)| point.track.len()).sum()
    }

    pub fn live_ids(&self) -> Vec<PointId> {
        self.live_points().map(|(id, _)| id).collect()
    }

    /// Chord between the observed ray and the direction to a point, in standard deviations of the ray.
    ///
    /// The chord of the sphere (the paper's residual) is monotonic in the angle up to 180°, so a point behind a ray
    /// has the largest error of all. `None` when the image is not registered, and of a keypoint that its camera has no
    /// ray for.
    pub fn error_sigma(&self, observation: Observation, position: &Vector3<f64>) -> Option<f64> {
        let pose = self.poses[observation.image.index()].as_ref()?;
        let rays = &self.rays[observation.image.index()];
        let index = observation.feature as usize;
        let direction = pose.camera_from_world * (position - pose.center());
        let norm = direction.norm();
        (norm > 0.0 && rays.sigmas[index].is_finite())
            .then(|| (rays.bearings[index] - direction / norm).norm() / rays.sigmas[index])
    }

    pub fn world_ray(&self, observation: Observation) -> Option<WorldRay> {
        let pose = self.poses[observation.image.index()].as_ref()?;
        let rays = &self.rays[observation.image.index()];
        let index = observation.feature as usize;
        rays.sigmas[index].is_finite().then(|| WorldRay {
            origin: *pose.center(),
            direction: pose.camera_from_world.tr_mul(&rays.bearings[index]),
            sigma: rays.sigmas[index],
        })
    }

    /// Least-squares point of all registered observations, with the largest error in standard deviations and the
    /// largest triangulation angle.
    pub fn triangulate(&self, track: &[Observation]) -> Option<Triangulated> {
        let rays: Vec<WorldRay> =
            track.iter().filter_map(|&observation| self.world_ray(observation)).collect();
        if rays.len() < 2 {
            return None;
        }
        let position = triangulate(&rays)?;
        let max_error_sigma = track
            .iter()
            .filter_map(|&observation| self.error_sigma(observation, &position))
            .fold(0.0_f64, |worst, error| if error.is_nan() { f64::INFINITY } else { worst.max(error) });
        Some(Triangulated { position, max_error_sigma, max_angle_rad: self.max_angle(&position, track) })
    }

    /// The largest angle under which two observing centres are seen from a point.
    pub fn max_angle(&self, position: &Vector3<f64>, track: &[Observation]) -> f64 {
        // One arc cosine for the narrowest cosine instead of one a pair: this runs for every point after every adjustment.
        let mut narrowest_cosine = 1.0_f64;
        let direction = |seen: &Observation| {
            self.poses[seen.image.index()]
                .as_ref()
                .and_then(|pose| (pose.center() - position).try_normalize(0.0))
        };
        for (index, a) in track.iter().enumerate() {
            let Some(to_a) = direction(a) else { continue };
            for b in &track[index + 1..] {
                if let Some(to_b) = direction(b) {
                    narrowest_cosine = narrowest_cosine.min(to_a.dot(&to_b));
                }
            }
        }
        narrowest_cosine.clamp(-1.0, 1.0).acos()
    }

    pub fn add_point(&mut self, position: Vector3<f64>, track: Vec<Observation>) -> PointId {
        let id = PointId(self.points.len() as u32);
        for observation in &track {
            self.point_of_feature[observation.image.index()][observation.feature as usize] = id.0;
        }
        self.points.push(Some(ModelPoint { position, track }));
        id
    }

    pub fn remove_point(&mut self, id: PointId) {
        if let Some(point) = self.points[id.index()].take() {
            for observation in point.track {
                self.point_of_feature[observation.image.index()][observation.feature as usize] = NO_POINT;
            }
        }
    }

    pub fn add_observation(&mut self, id: PointId, observation: Observation) {
        if let Some(point) = &mut self.points[id.index()] {
            point.track.push(observation);
            self.point_of_feature[observation.image.index()][observation.feature as usize] = id.0;
        }
    }

    pub fn remove_observation(&mut self, id: PointId, observation: Observation) {
        if let Some(point) = &mut self.points[id.index()] {
            point.track.retain(|kept| *kept != observation);
            self.point_of_feature[observation.image.index()][observation.feature as usize] = NO_POINT;
        }
    }

    /// Moves the observations of `from` to `into`, which gets a new position.
    pub fn merge_points(&mut self, into: PointId, from: PointId, position: Vector3<f64>) {
        let Some(moved) = self.points[from.index()].take() else { return };
        for &observation in &moved.track {
            self.add_observation(into, observation);
        }
        if let Some(point) = &mut self.points[into.index()] {
            point.position = position;
        }
    }

    pub fn set_pose(&mut self, image: ImageId, pose: Option<Rigid>) {
        self.poses[image.index()] = pose.map(Pose::new);
    }

    /// Takes an image out of the model, with its observations; points left with one observer go too.
    pub fn unregister(&mut self, image: ImageId) {
        for feature in 0..self.point_of_feature[image.index()].len() as u32 {
            let observation = Observation { image, feature };
            if let Some(id) = self.point_of(observation) {
                self.remove_observation(id, observation);
                if self.point(id).is_some_and(|point| point.track.len() < 2) {
                    self.remove_point(id);
                }
            }
        }
        self.lengths.retain(|length| !length.involves(image));
        self.set_pose(image, None);
    }

    /// The triangulated keypoints of an image.
    pub fn observations_of(&self, image: ImageId) -> Vec<(u32, PointId)> {
        let ids = self.point_of_feature[image.index()].iter().enumerate();
        ids.filter(|&(_, &id)| id != NO_POINT).map(|(feature, &id)| (feature as u32, PointId(id))).collect()
    }

    /// The observations of points that two further images see, so that they have a place without this one.
    pub fn placed_by_others(&self, image: ImageId) -> Vec<(u32, PointId)> {
        let mut observations = self.observations_of(image);
        observations.retain(|(_, id)| self.point(*id).is_some_and(|point| point.track.len() > 2));
        observations
    }

    /// Number of points that an image sees much as a camera with its centre elsewhere would.
    pub fn points_seen_alike(&self, image: ImageId, center: &Vector3<f64>) -> usize {
        let Some(pose) = &self.poses[image.index()] else { return 0 };
        let points = self.observations_of(image).into_iter().filter_map(|(_, id)| self.point(id));
        points.filter(|point| is_same_view(&point.position, pose.center(), center)).count()
    }

    /// The points that any of these images sees, ascending.
    pub fn seen_by(&self, images: &[ImageId]) -> Vec<PointId> {
        let seen = images.iter().flat_map(|image| &self.point_of_feature[image.index()]);
        let mut ids: Vec<PointId> = seen.filter(|&&id| id != NO_POINT).map(|&id| PointId(id)).collect();
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// Number of triangulated keypoints of an image.
    pub fn observed_points(&self, image: ImageId) -> usize {
        self.point_of_feature[image.index()].iter().filter(|&&id| id != NO_POINT).count()
    }

    /// Whether the intrinsics of a camera are estimated: they are not told, or its panoramas were found to be stretched.
    pub fn is_open(&self, camera: usize) -> bool {
        !self.input.is_fixed(camera) || self.cameras[camera].model != self.input.cameras[camera].model
    }

    /// Recomputes the rays of every image that uses `camera` after its intrinsics have changed; images without any get none.
    pub fn refresh_rays(&mut self, camera: usize) {
        let camera_now = &self.cameras[camera];
        self.rays.par_iter_mut().with_max_len(1).zip(&self.input.images).for_each(|(rays, image)| {
            if image.camera.index() == camera && !rays.bearings.is_empty() {
                *rays = image.features.rays(camera_now);
            }
        });
    }

    /// The finished component: points in creation order, tracks sorted, colours averaged.
    pub fn into_reconstruction(self) -> Reconstruction {
        let images = self
            .input
            .images
            .iter()
            .zip(&self.poses)
            .map(|(image, pose)| ReconstructionImage {
                name: image.name.to_owned(),
                camera: image.camera,
                world_from_camera: pose.map(|pose| pose.world_from_camera),
            })
            .collect();
        let finished = |point: &ModelPoint| {
            let mut track = point.track.clone();
            track.sort_unstable();
            let (mut color_sum, mut squared_error) = ([0_u32; 3], 0.0);
            for &observation in &track {
                let color = self.input.images[observation.image.index()].features.colors
                    [observation.feature as usize];
                for channel in 0..3 {
                    color_sum[channel] += u32::from(color[channel]);
                }
                squared_error += self.error_sigma(observation, &point.position).unwrap_or(0.0).powi(2);
            }
            let n = track.len().max(1);
            ReconstructionPoint {
                position: point.position,
                color: color_sum.map(|sum| (sum / n as u32) as u8),
                error_sigma: (squared_error / n as f64).sqrt(),
                covariance: None,
                aligned: None,
                track,
            }
        };
        let points = self.points.par_iter().flatten().map(finished).collect();
        Reconstruction { cameras: self.cameras, images, points, lengths: self.lengths }
    }
}

/// A point hypothesis with what decides whether it is kept.
#[derive(Debug, Clone, Copy)]
pub(super) struct Triangulated {
    pub position: Vector3<f64>,
    pub max_error_sigma: f64,
    pub max_angle_rad: f64,
}

#[cfg(test)]
mod tests {
    use super::super::test_street::{POINTS, Street, first_two};
    use super::*;

    #[test]
    fn images_outside_of_a_component_carry_no_points() {
        let street = Street::new("outside", 60, POINTS);
        let input = street.input();
        let component = first_two(&street, &input).into_reconstruction();
        let model = Model::of_component(&input, &component);
        assert_eq!(model.observed_points(ImageId(0)), component.points.len());
        let outside = ImageId(2);
        assert!(model.carriers(outside).is_empty() && model.observations_of(outside).is_empty());
        assert!(model.point_of(Observation { image: outside, feature: 0 }).is_none());
    }
}
