//! A street with truth, for tests and benches: panoramas at its beginning, a chain of photos that leads away from them.

// What it takes apart it has made itself.
#![allow(clippy::unwrap_used, clippy::missing_panics_doc)]

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::{
    Calibration, Camera, CameraModel, DESCRIPTOR_LEN, ImageFeatures, Keypoint, MatchParams,
};
use setloc_index::{IndexParams, SceneIndex};
use setloc_sfm::solvers::triangulation::{WorldRay, triangulate};
use setloc_sfm::synthetic::normal;
use setloc_sfm::{
    AlignedTrack, BaselineLength, CameraId, ImageId, Observation, PointId, Reconstruction,
    ReconstructionImage, ReconstructionPoint, Rigid, Similarity, TwoViewParams,
};

use crate::{QueryPhoto, Scene, SceneMatch, ViewParams, Views, match_views};

const NOISE_PX: f64 = 0.5;
const VISIBLE: f64 = 35.0;
const EXTENT: f64 = 0.3;

/// Points with their descriptors.
pub struct Place {
    positions: Vec<Vector3<f64>>,
    descriptors: Vec<Vec<u8>>,
}

/// What a camera sees: features, and which point each shows (`None` is clutter).
pub struct View {
    /// Its features.
    pub features: ImageFeatures,
    /// The place's point of each feature.
    pub shows: Vec<Option<usize>>,
    /// Where it was taken (`world_from_camera`).
    pub pose: Rigid,
}

fn random_descriptor(rng: &mut ChaCha8Rng) -> Vec<u8> {
    (0..DESCRIPTOR_LEN).map(|_| rng.random_range(0..120)).collect()
}

impl Place {
    /// Two walls 16 units apart along a street of 130 units, y down.
    pub fn street(points: usize, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let positions = (0..points)
            .map(|_| {
                let side = if rng.random() { 1.0 } else { -1.0 };
                let relief = rng.random_range(-1.0..1.0);
                Vector3::new(side * 8.0 + relief, rng.random_range(-7.0..2.0), rng.random_range(-10.0..120.0))
            })
            .collect();
        let descriptors = (0..points).map(|_| random_descriptor(&mut rng)).collect();
        Self { positions, descriptors }
    }

    /// The same place with flat walls so far from its middle.
    pub fn flat(mut self, distance: f64) -> Self {
        for position in &mut self.positions {
            position.x = distance.copysign(position.x);
        }
        self
    }

    /// The same place as paving: all points on the ground between the walls, but those of this share.
    pub fn paved(mut self, standing: f64, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for position in &mut self.positions {
            if !rng.random_bool(standing) {
                position.y = rng.random_range(0.0..0.03);
                position.x = rng.random_range(-7.0..7.0);
            }
        }
        self
    }

    /// Another place of the same details: every point looks like some point of this place, at random.
    pub fn shuffled(mut self, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for i in (1..self.descriptors.len()).rev() {
            self.descriptors.swap(i, rng.random_range(0..=i));
        }
        self
    }

    /// Renders one view: `outliers` is the share of features that look like other points, `change` the illumination's
    /// effect on descriptors.
    pub fn view(&self, camera: &Camera, pose: Rigid, outliers: f64, change: i16, seed: u64) -> View {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut features = ImageFeatures { width: camera.width, height: camera.height, ..Default::default() };
        let mut shows = Vec::new();
        for (i, position) in self.positions.iter().enumerate() {
            let in_camera = pose.inverse_transform_point(position);
            let distance = in_camera.norm();
            let Some(pixel) = camera.project(&in_camera).filter(|_| distance < VISIBLE && distance > 2.0)
            else {
                continue;
            };
            let noise = Vector2::new(normal(&mut rng), normal(&mut rng)) * NOISE_PX;
            let seen = pixel + noise;
            let (width, height) = (f64::from(camera.width), f64::from(camera.height));
            let inside = seen.x > 0.0 && seen.y > 0.0 && seen.x < width && seen.y < height;
            if !inside || rng.random_bool(0.15) {
                continue;
            }
            let angle = camera.pixel_angle(&seen).unwrap();
            let wrong = rng.random_bool(outliers);
            let source = if wrong { rng.random_range(0..self.positions.len()) } else { i };
            features.keypoints.push(Keypoint {
                x: seen.x as f32,
                y: seen.y as f32,
                size: (EXTENT / distance / angle) as f32,
                orientation: 0.0,
                noise_px: NOISE_PX as f32,
            });
            features.colors.push([128; 3]);
            let changed =
                |&value: &u8| (i16::from(value) + rng.random_range(-change..=change)).clamp(0, 255) as u8;
            features.descriptors.extend(self.descriptors[source].iter().map(changed));
            shows.push((!wrong).then_some(i));
        }
        View { features, shows, pose }
    }
}

/// Model of views: a point for each place point that two views show (second: which), positions and poses true.
fn model_of(place: &Place, views: &[View], camera: &Camera) -> (Reconstruction, Vec<usize>) {
    let mut tracks: Vec<Vec<Observation>> = vec![Vec::new(); place.positions.len()];
    for (image, view) in views.iter().enumerate() {
        for (feature, shown) in view.shows.iter().enumerate() {
            if let Some(point) = shown {
                tracks[*point].push(Observation { image: ImageId(image as u32), feature: feature as u32 });
            }
        }
    }
    let image = |(i, view): (usize, &View)| ReconstructionImage {
        name: format!("{i}"),
        camera: CameraId(0),
        world_from_camera: Some(view.pose),
    };
    let point = |(i, track): (usize, Vec<Observation>)| ReconstructionPoint {
        position: place.positions[i],
        color: [128; 3],
        error_sigma: 1.0,
        covariance: None,
        aligned: None,
        track,
    };
    let shown: Vec<usize> = (0..tracks.len()).filter(|&i| tracks[i].len() >= 2).collect();
    let model = Reconstruction {
        cameras: vec![camera.clone()],
        images: views.iter().enumerate().map(image).collect(),
        points: tracks.into_iter().enumerate().filter(|(_, track)| track.len() >= 2).map(point).collect(),
        lengths: Vec::new(),
    };
    (model, shown)
}

/// Puts the points of a model where the rays to their keypoints meet.
fn place_points(model: &mut Reconstruction, features: &[&ImageFeatures]) {
    let Reconstruction { cameras, images, points, .. } = model;
    for point in points {
        let ray = |seen: &Observation| {
            let (image, keypoint) =
                (&images[seen.image.index()], &features[seen.image.index()].keypoints[seen.feature as usize]);
            let (bearing, angle) = cameras[image.camera.index()].ray(&keypoint.pixel()).unwrap();
            let sigma = angle * f64::from(keypoint.noise_px);
            WorldRay::new(&image.world_from_camera.unwrap(), &bearing, sigma)
        };
        let rays: Vec<WorldRay> = point.track.iter().map(ray).collect();
        point.position = triangulate(&rays).unwrap_or(point.position);
    }
}

/// Panoramas, their model and index; a chain of photos and their local model.
pub struct World {
    /// Positions of the place's points.
    positions: Vec<Vector3<f64>>,
    /// Which point of the place each scene point is.
    scene_points: Vec<usize>,
    panoramas: Vec<View>,
    /// Poses of the panoramas and the points that two of them show.
    pub scene_model: Reconstruction,
    /// Of those points.
    pub index: SceneIndex,
    /// Of all photos.
    pub camera: Camera,
    /// In the order in which they were taken.
    pub photos: Vec<View>,
    /// Of the photos.
    pub names: Vec<String>,
    /// Local model in its own frame.
    pub local: Reconstruction,
}

/// A photo camera of 1200 × 900 pixels and 74° width.
pub fn pinhole() -> Camera {
    Camera { model: CameraModel::Pinhole, width: 1200, height: 900, params: vec![800.0, 800.0, 600.0, 450.0] }
}

/// A pose at `center` that looks along the street, turned by `yaw` about the vertical.
pub fn along_street(center: Vector3<f64>, yaw: f64) -> Rigid {
    Rigid::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw), center)
}

impl World {
    /// The usual world: eight panoramas, then photos every six units from z = 20 on.
    pub fn chain(photos: usize, outliers: f64, seed: u64) -> Self {
        Self::chain_in(&Place::street(3500, seed), photos, outliers, seed)
    }

    /// The usual panoramas and photos in another place.
    pub fn chain_in(place: &Place, photos: usize, outliers: f64, seed: u64) -> Self {
        let poses: Vec<Rigid> = (0..photos)
            .map(|i| {
                along_street(
                    Vector3::new(0.7 * (i % 3) as f64, -1.5, 20.0 + 6.0 * i as f64),
                    0.05 * (i % 2) as f64,
                )
            })
            .collect();
        Self::new(place, &poses, outliers, seed)
    }

    /// The usual panoramas and photos of these poses.
    pub fn new(place: &Place, poses: &[Rigid], outliers: f64, seed: u64) -> Self {
        let panorama = Camera::equirectangular(3000, 1500);
        let panoramas: Vec<View> = (0..8)
            .map(|i| {
                let pose = along_street(Vector3::new(0.3, -2.0, 4.0 * f64::from(i)), 0.8 * f64::from(i));
                place.view(&panorama, pose, 0.0, 8, seed * 1000 + i as u64)
            })
            .collect();
        let (mut scene_model, scene_points) = model_of(place, &panoramas, &panorama);
        let features: Vec<&ImageFeatures> = panoramas.iter().map(|view| &view.features).collect();
        // Scene points are as wrong as the panoramas' pixel noise leaves them.
        place_points(&mut scene_model, &features);
        let index = SceneIndex::build(&IndexParams::default(), &scene_model, &features);
        let camera = pinhole();
        let photos: Vec<View> = poses
            .iter()
            .enumerate()
            .map(|(i, &pose)| place.view(&camera, pose, outliers, 20, seed * 1000 + 100 + i as u64))
            .collect();
        let world_from_set = Similarity {
            scale: 2.5,
            rotation: UnitQuaternion::from_euler_angles(0.4, 1.1, -0.3),
            translation: Vector3::new(4.0, -3.0, 25.0),
        };
        let (mut local, _) = model_of(place, &photos, &camera);
        local.transform(&world_from_set.inverse());
        let names = (0..photos.len()).map(|i| format!("photo_{i:02}")).collect();
        let positions = place.positions.clone();
        Self { positions, scene_points, panoramas, scene_model, index, camera, photos, names, local }
    }

    /// Bends the local model: each photo, with the points it is the first to see, is turned by `angle` and stretched
    /// by `stretch` against the one before.
    pub fn bend(&mut self, angle: f64, stretch: f64) {
        let poses: Vec<Rigid> =
            self.local.images.iter().map(|image| image.world_from_camera.unwrap()).collect();
        let mut drift = vec![Similarity::identity()];
        for i in 1..poses.len() {
            let at = poses[i - 1].translation;
            let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle);
            let scale = 1.0 + stretch;
            let here = Similarity { scale, rotation: turn, translation: at - turn * at * scale };
            drift.push(drift[i - 1] * here);
        }
        for (image, drift) in self.local.images.iter_mut().zip(&drift) {
            image.world_from_camera = image.world_from_camera.map(|pose| drift.transform_pose(&pose));
        }
        for point in &mut self.local.points {
            point.position = drift[point.track[0].image.index()].transform_point(&point.position);
        }
    }

    /// Leaves the last photo nothing in common with any but the one before, in points that only these two see, and
    /// records the length of its baseline as planes would tell it: `error` and `deviation` are of its logarithm.
    pub fn cut_last(&mut self, error: f64, deviation: f64) {
        let last = self.photos.len() as u32 - 1;
        self.local.points.retain_mut(|point| {
            let is_tie = point.track.iter().any(|seen| seen.image.0 == last);
            if is_tie {
                point.track.retain(|seen| seen.image.0 + 1 >= last);
            }
            point.track.len() >= 2
        });
        let center = |image: u32| self.local.images[image as usize].world_from_camera.unwrap().translation;
        let [a, b, c] = [last - 2, last - 1, last].map(center);
        let [from, to] =
            [last - 1, last].map(|image| self.local.images[image as usize].world_from_camera.unwrap());
        let exact = from.inverse() * to;
        let mut pose = exact;
        pose.translation *= error.exp() / (b - a).norm();
        let along = pose.translation * deviation;
        let mut covariance = Matrix6::identity() * 1e-6;
        let mut of_center = covariance.fixed_view_mut::<3, 3>(3, 3);
        of_center += along * along.transpose();
        self.local.lengths.push(BaselineLength {
            reference: ImageId(last - 2),
            from: ImageId(last - 1),
            to: ImageId(last),
            ratio: (c - b).norm() / (b - a).norm() * error.exp(),
            deviation,
            votes: 20,
            pose,
            covariance,
            either: None,
        });
    }

    /// Aligns the local points: each view shows them to `noise_px`.
    pub fn align(&mut self, noise_px: f64, seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for point in &mut self.local.points {
            let place = |seen: &Observation| {
                let pose = self.local.images[seen.image.index()].world_from_camera.unwrap();
                let pixel = self.camera.project(&pose.inverse_transform_point(&point.position)).unwrap();
                setloc_sfm::Place {
                    pixel: pixel + noise_px * Vector2::from_fn(|_, _| normal(&mut rng)),
                    noise_px,
                }
            };
            let places = point.track.iter().map(place).collect();
            let spot = Matrix3::identity() * 1e-6;
            point.aligned = Some(AlignedTrack { places, further: Vec::new(), spot });
        }
    }

    /// Lets the keypoints of photo `i` err alike: away from the middle by the share `i · share`.
    pub fn stretch_keypoints(&mut self, share: f64) {
        let middle = self.camera.width as f32 / 2.0;
        for (i, view) in self.photos.iter_mut().enumerate() {
            for keypoint in &mut view.features.keypoints {
                keypoint.x += (keypoint.x - middle) * (share * i as f64) as f32;
            }
        }
    }

    /// Makes a scene whose points, by turns, stand where they are and `offset` away: two equal halves of evidence.
    ///
    /// Every second scene point is moved to its twin's place, so that the photos' matches support both places alike.
    pub fn split_scene(&mut self, offset: Vector3<f64>) {
        for point in self.scene_model.points.iter_mut().step_by(2) {
            point.position += offset;
        }
        let features: Vec<&ImageFeatures> = self.panoramas.iter().map(|view| &view.features).collect();
        self.index = SceneIndex::build(&IndexParams::default(), &self.scene_model, &features);
    }

    /// Leaves the scene none of the points that a photo shows, as where panoramas stand too far apart to share them.
    pub fn forget_seen_points(&mut self) {
        let seen: BTreeSet<usize> =
            self.photos.iter().flat_map(|photo| photo.shows.iter().flatten().copied()).collect();
        let keep: Vec<bool> = self.scene_points.iter().map(|point| !seen.contains(point)).collect();
        let mut kept = keep.iter();
        self.scene_points.retain(|_| *kept.next().unwrap());
        let mut kept = keep.iter();
        self.scene_model.points.retain(|_| *kept.next().unwrap());
        let features: Vec<&ImageFeatures> = self.panoramas.iter().map(|view| &view.features).collect();
        self.index = SceneIndex::build(&IndexParams::default(), &self.scene_model, &features);
    }

    /// What the photos share with some of the panoramas.
    pub fn views(&self, panoramas: &[u32]) -> Views {
        let features = (0..)
            .zip(&self.panoramas)
            .map(|(image, view)| panoramas.contains(&image).then(|| view.features.clone()));
        let likely: Vec<ImageId> = panoramas.iter().copied().map(ImageId).collect();
        let params = (&MatchParams::default(), &TwoViewParams::default());
        match_views(
            &ViewParams::default(),
            params,
            &self.scene(),
            features.collect(),
            &likely,
            &self.queries(),
            5,
        )
    }

    /// Makes the scene's points exact: without noise in the panoramas, the index gives them no covariance.
    pub fn make_scene_exact(&mut self) {
        for keypoint in self.panoramas.iter_mut().flat_map(|view| &mut view.features.keypoints) {
            keypoint.noise_px = 0.0;
        }
        let features: Vec<&ImageFeatures> = self.panoramas.iter().map(|view| &view.features).collect();
        self.index = SceneIndex::build(&IndexParams::default(), &self.scene_model, &features);
    }

    /// The true matches of a photo to the scene.
    pub fn scene_matches(&self, photo: usize) -> Vec<SceneMatch> {
        let scene_point = |shown: &Option<usize>| self.scene_points.binary_search(shown.as_ref()?).ok();
        (0..)
            .zip(&self.photos[photo].shows)
            .filter_map(|(feature, shown)| {
                Some(SceneMatch { feature, point: PointId(scene_point(shown)? as u32) })
            })
            .collect()
    }

    /// The panoramas' model and its index.
    pub fn scene(&self) -> Scene<'_> {
        let (reconstruction, index) = (&self.scene_model, &self.index);
        Scene {
            component: 0,
            is_placed: false,
            reconstruction,
            index,
            grown: &[],
            doubtful: &[],
            errors: None,
        }
    }

    /// The photos, intrinsics known.
    pub fn queries(&self) -> Vec<QueryPhoto<'_>> {
        self.photos
            .iter()
            .zip(&self.names)
            .map(|(view, name)| QueryPhoto {
                name,
                camera: &self.camera,
                calibration: Calibration::Known,
                features: &view.features,
            })
            .collect()
    }

    /// Centre error in scene units and rotation error in degrees.
    pub fn errors(&self, photo: usize, pose: &Rigid) -> (f64, f64) {
        let truth = &self.photos[photo].pose;
        ((pose.translation - truth.translation).norm(), pose.rotation.angle_to(&truth.rotation).to_degrees())
    }

    /// How many features of a photo show a point of the scene.
    pub fn shared_with_scene(&self, photo: usize) -> usize {
        self.photos[photo].shows.iter().flatten().filter(|point| self.knows(**point)).count()
    }

    /// Whether a point of the place is one of the scene.
    pub fn knows(&self, point: usize) -> bool {
        self.scene_points.binary_search(&point).is_ok()
    }

    /// Where a point of the place is.
    pub fn position(&self, point: usize) -> Vector3<f64> {
        self.positions[point]
    }
}
