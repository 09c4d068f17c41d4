//! Alignment of tracks in a rendered room of exact truth.

use std::convert::Infallible;
use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use setloc_features::{Camera, GreyImage, ImageFeatures, ImagePyramid, Keypoint};
use setloc_sfm::synthetic::{normal, normal_vector, random_rotation, random_unit, seeded};
use setloc_sfm::{
    AlignmentParams, AlignmentReport, CameraId, ImageId, KnownOfComponent, Observation, Reconstruction,
    ReconstructionImage, ReconstructionPoint, Rigid, Similarity, align_tracks,
};

/// Half of the room's extents in metres.
const ROOM: [f64; 3] = [5.0, 3.0, 4.0];
/// Standard deviation of the keypoints in pixels.
const NOISE_PX: f64 = 0.4;

/// The room's one camera is known.
const ALL_CAMERAS: KnownOfComponent<'static> = KnownOfComponent { cameras: &[true], positions: None };

/// A room, panoramas of it turned any way, and what a mapper would have made of noisy keypoints.
struct Room {
    truth: Vec<Rigid>,
    features: Vec<ImageFeatures>,
    pyramids: Vec<Arc<ImagePyramid>>,
    model: Reconstruction,
}

/// Where a ray from inside meets the walls.
fn wall(origin: &Vector3<f64>, direction: &Vector3<f64>) -> Vector3<f64> {
    let reach = |axis: usize| (ROOM[axis] * direction[axis].signum() - origin[axis]) / direction[axis];
    let distance = (0..3).map(reach).filter(|reach| reach.is_finite()).fold(f64::INFINITY, f64::min);
    origin + direction * distance
}

/// What is painted on the walls.
fn paint(place: &Vector3<f64>) -> f64 {
    let waves = [(7.1, 2.3, -4.2), (-3.3, 6.4, 5.1), (4.7, -5.9, 6.8), (-8.3, -1.7, 3.9), (1.9, 8.8, -7.3)];
    120.0 + 20.0 * waves.iter().map(|(a, b, c)| (a * place.x + b * place.y + c * place.z).sin()).sum::<f64>()
}

impl Room {
    fn new(name: &str) -> Self {
        let camera = Camera::equirectangular(640, 320);
        Self::seen_by(name, &[(); 4].map(|()| camera.clone()), camera)
    }

    /// Seen by these cameras, of which the model has one.
    fn seen_by(name: &str, cameras: &[Camera; 4], camera: Camera) -> Self {
        let mut rng = seeded(name);
        let truth: Vec<Rigid> = (0..4)
            .map(|k| {
                let center = Vector3::new(f64::from(k) - 1.5, 0.2 * normal(&mut rng), 0.5 * normal(&mut rng));
                Rigid::new(random_rotation(&mut rng), center)
            })
            .collect();
        let pyramids = truth
            .iter()
            .zip(cameras)
            .map(|(pose, lens)| {
                let pixels = (0..320).flat_map(|y| (0..640).map(move |x| (x, y)));
                let values = pixels
                    .map(|(x, y)| {
                        let pixel = Vector2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                        let ray = pose.rotation * lens.unproject(&pixel).expect("a panorama sees everywhere");
                        paint(&wall(&pose.translation, &ray)).round() as u8
                    })
                    .collect();
                let image = GreyImage::from_values(640, 320, values).expect("as many values as pixels");
                Arc::new(ImagePyramid::new(image, camera.wraps_around()))
            })
            .collect();
        let mut features = vec![ImageFeatures { width: 640, height: 320, ..ImageFeatures::default() }; 4];
        let mut points = Vec::new();
        for _ in 0..400 {
            let position = wall(&Vector3::zeros(), &random_unit(&mut rng));
            let mut track = Vec::new();
            for (image, (pose, features)) in truth.iter().zip(&mut features).enumerate() {
                if rng.random_bool(0.3) {
                    continue;
                }
                let pixel = cameras[image]
                    .project(&pose.inverse_transform_point(&position))
                    .expect("a panorama sees everywhere");
                let noisy = pixel + Vector2::new(normal(&mut rng), normal(&mut rng)) * NOISE_PX;
                track.push(Observation { image: ImageId(image as u32), feature: features.len() as u32 });
                features.keypoints.push(Keypoint {
                    x: noisy.x as f32,
                    y: noisy.y as f32,
                    size: 3.0,
                    orientation: 0.0,
                    noise_px: 2.0 * NOISE_PX as f32,
                });
            }
            if track.len() >= 2 {
                let position = position + normal_vector(&mut rng) * 0.02;
                points.push(ReconstructionPoint {
                    position,
                    color: [0; 3],
                    error_sigma: 0.0,
                    covariance: None,
                    aligned: None,
                    track,
                });
            }
        }
        let images = truth
            .iter()
            .enumerate()
            .map(|(index, pose)| {
                let turn = UnitQuaternion::from_scaled_axis(normal_vector(&mut rng) * 1e-3);
                let moved = pose.translation + normal_vector(&mut rng) * 5e-3;
                ReconstructionImage {
                    name: index.to_string(),
                    camera: CameraId(0),
                    world_from_camera: Some(Rigid::new(pose.rotation * turn, moved)),
                }
            })
            .collect();
        let model = Reconstruction { cameras: vec![camera], images, points, lengths: Vec::new() };
        Self { truth, features, pyramids, model }
    }

    fn align(&self, params: &AlignmentParams) -> (Reconstruction, AlignmentReport) {
        self.align_knowing(&[true], params)
    }

    fn align_knowing(&self, cameras: &[bool], params: &AlignmentParams) -> (Reconstruction, AlignmentReport) {
        let (mut model, features) = (self.model.clone(), self.features.iter().collect::<Vec<_>>());
        let load = |image: ImageId| Ok::<_, Infallible>(Arc::clone(&self.pyramids[image.index()]));
        let known = KnownOfComponent { cameras, positions: None };
        let report = align_tracks(params, &mut model, &features, known, load).unwrap();
        (model, report)
    }

    /// Mean distance of the centres from the truth after the best similarity, in metres.
    fn error(&self, model: &Reconstruction) -> f64 {
        let centers =
            |poses: &mut dyn Iterator<Item = Rigid>| poses.map(|p| p.translation).collect::<Vec<_>>();
        let found =
            centers(&mut model.images.iter().map(|image| image.world_from_camera.expect("registered")));
        let truth = centers(&mut self.truth.iter().copied());
        let aligned = Similarity::from_point_pairs(&found, &truth).expect("four centres apart");
        let distance =
            |(found, truth): (&Vector3<f64>, &Vector3<f64>)| (aligned.transform_point(found) - truth).norm();
        found.iter().zip(&truth).map(distance).sum::<f64>() / truth.len() as f64
    }
}

#[test]
fn pixels_place_the_cameras_better_than_keypoints() {
    let room = Room::new("pixels_place_the_cameras_better_than_keypoints");
    // With no shift allowed every keypoint stays where it was detected.
    let by_keypoints = AlignmentParams { max_shift_sigma: 0.0, ..AlignmentParams::default() };
    let (keypoints, none) = room.align(&by_keypoints);
    let (pixels, report) = room.align(&AlignmentParams::default());
    assert_eq!(none.aligned, 0);
    assert!(report.aligned * 2 > report.sought, "{report:?}");
    let (before, after) = (room.error(&keypoints), room.error(&pixels));
    assert!(after < before / 3.0, "{before} {after}");
    assert_eq!(pixels.points[0].track, room.model.points[0].track);
    // The places of a point agree on it better than the keypoints did.
    let pixels = &pixels;
    let mean_error = |place: &dyn Fn(usize, usize) -> Option<Vector2<f64>>| {
        let seen = pixels.points.iter().enumerate().flat_map(|(index, point)| {
            point.track.iter().enumerate().filter_map(move |(at, seen)| {
                let pose = pixels.images[seen.image.index()].world_from_camera?;
                let in_camera = pose.inverse_transform_point(&point.position);
                let projected = pixels.cameras[0].project(&in_camera)?;
                Some((projected - place(index, at)?).norm()).filter(|error| *error < 10.0)
            })
        });
        let errors: Vec<f64> = seen.collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    };
    let by_pixels = mean_error(&|index, at| Some(pixels.points[index].aligned.as_ref()?.places[at].pixel));
    let by_keypoints = mean_error(&|index, at| {
        let seen = pixels.points[index].track[at];
        Some(room.features[seen.image.index()].keypoints[seen.feature as usize].pixel())
    });
    assert!(by_pixels < 0.5 * by_keypoints, "{by_pixels} {by_keypoints}");
}

#[test]
fn the_result_has_the_same_bytes_with_any_number_of_threads() {
    let room = Room::new("the_result_has_the_same_bytes_with_any_number_of_threads");
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| room.align(&AlignmentParams::default()).0)
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn keypoints_without_their_surroundings_stay() {
    let mut room = Room::new("keypoints_without_their_surroundings_stay");
    let grey = GreyImage::from_values(640, 320, vec![90; 640 * 320]).unwrap();
    let grey = Arc::new(ImagePyramid::new(grey, true));
    room.pyramids.fill(grey);
    let (model, report) = room.align(&AlignmentParams::default());
    let by_keypoints = AlignmentParams { max_shift_sigma: 0.0, ..AlignmentParams::default() };
    assert_eq!(report.aligned, 0);
    assert_eq!(model, room.align(&by_keypoints).0);
}

#[test]
fn unreadable_images_leave_the_model_alone() {
    let room = Room::new("unreadable_images_leave_the_model_alone");
    let features: Vec<&ImageFeatures> = room.features.iter().collect();
    let mut model = room.model.clone();
    let load = |image: ImageId| if image.0 == 2 { Err("gone") } else { Ok(Arc::clone(&room.pyramids[0])) };
    let failed = align_tracks(&AlignmentParams::default(), &mut model, &features, ALL_CAMERAS, load);
    assert_eq!((failed, &model), (Err("gone"), &room.model));
}

#[test]
fn photos_of_one_standpoint_stay_and_their_points_get_places() {
    let mut room = Room::new("photos_of_one_standpoint_stay_and_their_points_get_places");
    let center = room.model.images[0].world_from_camera.unwrap().translation;
    room.model.images[3].world_from_camera.as_mut().unwrap().translation = center;
    let (mut model, report) = room.align(&AlignmentParams::default());
    assert!(report.points > 0 && report.further == 0, "{report:?}");
    let aligned: Vec<_> = model.points.iter_mut().map(|point| point.aligned.take()).collect();
    assert_eq!(model, room.model);
    assert_eq!(aligned.iter().flatten().count(), report.points);
    for (point, aligned) in model.points.iter().zip(&aligned) {
        assert!(aligned.as_ref().is_none_or(|aligned| aligned.places.len() == point.track.len()));
    }
}

#[test]
fn an_image_turned_on_the_spot_that_sees_little_keeps_no_other_from_being_aligned() {
    let mut room =
        Room::new("an_image_turned_on_the_spot_that_sees_little_keeps_no_other_from_being_aligned");
    let (alone, _) = room.align(&AlignmentParams::default());
    // The second panorama again, in which nine points are known.
    let (again, turned) = (ImageId(1), ImageId(4));
    let mut image = room.model.images[again.index()].clone();
    image.name = "turned".to_owned();
    room.model.images.push(image);
    room.features.push(room.features[again.index()].clone());
    room.pyramids.push(Arc::clone(&room.pyramids[again.index()]));
    let seen_there =
        |point: &ReconstructionPoint| point.track.iter().find(|seen| seen.image == again).copied();
    let shared: Vec<(usize, Observation)> = (room.model.points.iter().enumerate())
        .filter_map(|(at, point)| Some((at, seen_there(point)?)))
        .collect();
    for &(at, seen) in shared.iter().take(9) {
        room.model.points[at].track.push(Observation { image: turned, ..seen });
    }
    let (model, report) = room.align(&AlignmentParams::default());
    assert!(report.further > 0, "{report:?}");
    let pose =
        |model: &Reconstruction, image: ImageId| model.images[image.index()].world_from_camera.unwrap();
    assert_eq!(pose(&model, turned).translation, pose(&model, again).translation);
    assert!(pose(&model, turned).rotation.angle_to(&pose(&model, again).rotation) < 1e-9);
    let centers = |of: &Reconstruction| [0, 1, 2, 3].map(|image| pose(of, ImageId(image)).translation);
    let apart = centers(&model).into_iter().zip(centers(&alone)).map(|(a, b)| (a - b).norm());
    let apart = apart.fold(0.0, f64::max);
    let moved = (pose(&model, ImageId(1)).translation - pose(&room.model, ImageId(1)).translation).norm();
    assert!(apart < 0.2 * moved, "{apart} {moved}");
}

#[test]
fn panoramas_that_are_each_stitched_a_little_otherwise_get_cameras_of_their_own() {
    let mut rng = seeded("panoramas_that_are_each_stitched_a_little_otherwise_get_cameras_of_their_own");
    let mut shared = Camera::equirectangular(640, 320).as_stitched().unwrap();
    shared.params[4..].copy_from_slice(&[-0.003, 0.0, 0.001, 0.0, 0.0, -0.001, 0.002, 0.0, 0.0]);
    let cameras = [(); 4].map(|()| {
        let mut own = shared.clone();
        own.params[4..].iter_mut().for_each(|term| *term += 0.001 * normal(&mut rng));
        own
    });
    let room = Room::seen_by("each stitched otherwise", &cameras, shared.clone());
    let (own, _) = room.align_knowing(&[false], &AlignmentParams::default());
    assert_eq!(own.cameras.len(), 5);
    let found: Vec<&Camera> = own.registered().map(|image| own.camera_of(image)).collect();
    let off =
        |found: &[&Camera]| -> f64 { found.iter().zip(&cameras).map(|(a, b)| squared_terms(a, b)).sum() };
    let (after, before) = (off(&found), off(&[&shared; 4]));
    assert!(after < 0.25 * before, "{after} {before}");
    // Told to be as they are, all keep the one.
    let (told, _) = room.align_knowing(&[true], &AlignmentParams::default());
    assert_eq!(told.cameras, [shared]);
    let (with, without) = (room.error(&own), room.error(&told));
    assert!(with < 0.5 * without, "{with} {without}");
}

/// Sum of the squares of what the stitching of two panoramas differs by.
fn squared_terms(a: &Camera, b: &Camera) -> f64 {
    a.params[4..].iter().zip(&b.params[4..]).map(|(a, b)| (a - b).powi(2)).sum()
}
