//! Poses round corners by the ground, on rendered paving with exact truth.

use std::convert::Infallible;
use std::sync::Arc;

use nalgebra::{Matrix6, UnitQuaternion, Vector2, Vector3};
use setloc_features::{Camera, GreyImage, ImageFeatures, ImagePyramid, Keypoint, Match};
use setloc_sfm::{
    BaselineLength, CameraId, ImageId, Observation, PairGeometry, Reconstruction, ReconstructionImage,
    ReconstructionPoint, Rigid, StepPose, TwoView, TwoViewKind, register_by_ground, sharpen_lengths,
};

/// Height of the cameras over the ground, and steps along the street.
const HEIGHT: f64 = 1.6;
const STEP: f64 = 4.0;
/// What is known of the last pose: standard deviations in radians and metres.
const SIGMAS: [f64; 6] = [0.004, 0.004, 0.002, 0.15, 0.1, 0.12];

/// A number in [0, 1) of a cell of the ground.
fn cell(x: i64, y: i64, salt: u64) -> f64 {
    let mut state =
        (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F);
    state ^= salt.wrapping_mul(0x1656_67B1_9E37_79F9);
    state = (state ^ (state >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    state ^= state >> 32;
    (state >> 11) as f64 / (1_u64 << 53) as f64
}

/// Grey value of square stones with joints between them, of another size for each salt.
fn paving(x: f64, z: f64, salt: u64) -> f64 {
    let size = 0.3 + 0.07 * salt as f64;
    let (u, v) = (x / size, z / size);
    let joint = [u, v].iter().any(|place| place - place.floor() < 0.1);
    let stone = cell(u.floor() as i64, v.floor() as i64, salt);
    if joint { 40.0 } else { 90.0 + 120.0 * stone }
}

/// What a camera sees of the ground y = `HEIGHT`, the sky grey.
fn render(camera: &Camera, world_from_camera: &Rigid, salt: u64) -> Arc<ImagePyramid> {
    let value = |pixel: &Vector2<f64>| {
        let ray = world_from_camera.rotation * camera.unproject(pixel).expect("a pinhole inverts everywhere");
        if ray.y < 0.01 {
            return 128.0;
        }
        let met = world_from_camera.translation + ray * ((HEIGHT - world_from_camera.translation.y) / ray.y);
        paving(met.x, met.z, salt)
    };
    let offsets = [-0.375, -0.125, 0.125, 0.375];
    let pixels = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
    let values = pixels.map(|(x, y)| {
        let middle = Vector2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let samples = offsets.iter().flat_map(|dy| offsets.map(|dx| middle + Vector2::new(dx, *dy)));
        let mean = samples.map(|pixel| value(&pixel)).sum::<f64>() / 16.0;
        mean.round() as u8
    });
    Arc::new(ImagePyramid::new(
        GreyImage::from_values(camera.width, camera.height, values.collect())
            .expect("as many values as pixels"),
        false,
    ))
}

/// Four photos along a street of which the last hangs on a length.
struct Street {
    truth: Vec<Rigid>,
    component: Reconstruction,
    images: Vec<Arc<ImagePyramid>>,
}

impl Street {
    /// The last photo shows other paving where `salts` differ.
    fn new(salts: [u64; 2]) -> Self {
        let camera = Camera::from_focal_guess(640, 480, 420.0);
        let pose = |at: usize| {
            let (along, turn) = (at as f64, if at == 3 { 0.4 } else { 0.05 * at as f64 });
            let rotation = UnitQuaternion::from_euler_angles(-0.02, turn, 0.01 * along);
            Rigid::new(rotation, Vector3::new(0.1 * along, 0.03 * along, STEP * along))
        };
        let truth: Vec<Rigid> = (0..4).map(pose).collect();
        let images =
            truth.iter().enumerate().map(|(at, pose)| render(&camera, pose, salts[at / 3])).collect();
        let shared = |number: u32| ReconstructionPoint {
            position: Vector3::new(-5.0, -1.0, 10.0 + f64::from(number)),
            color: [0; 3],
            error_sigma: 1.0,
            covariance: None,
            track: (0..3).map(|image| Observation { image: ImageId(image), feature: number }).collect(),
            aligned: None,
        };
        let error = [0.7, -0.8, 0.5, -1.0, 0.6, 0.8];
        let shift = Vector3::from([3, 4, 5].map(|axis| error[axis] * SIGMAS[axis]));
        let turn = Vector3::from([0, 1, 2].map(|axis| error[axis] * SIGMAS[axis]));
        let exact = truth[2].inverse() * truth[3];
        let known =
            Rigid::new(exact.rotation * UnitQuaternion::from_scaled_axis(turn), exact.translation + shift);
        let baseline = (truth[2].translation - truth[1].translation).norm();
        let mut covariance = Matrix6::from_diagonal(&SIGMAS.map(|sigma| sigma * sigma).into());
        covariance.fixed_view_mut::<3, 3>(3, 3).scale_mut(baseline.powi(-2));
        let length = BaselineLength {
            reference: ImageId(1),
            from: ImageId(2),
            to: ImageId(3),
            ratio: known.translation.norm() / baseline,
            deviation: 0.03,
            votes: 10,
            pose: Rigid::new(known.rotation, known.translation / baseline),
            covariance,
            either: None,
        };
        let image = |(at, pose): (usize, &Rigid)| ReconstructionImage {
            name: format!("{at}.jpg"),
            camera: CameraId(0),
            world_from_camera: Some(if at == 3 { truth[2] * known } else { *pose }),
        };
        let component = Reconstruction {
            cameras: vec![camera],
            images: truth.iter().enumerate().map(image).collect(),
            points: (0..12).map(shared).collect(),
            lengths: vec![length],
        };
        Self { truth, component, images }
    }

    /// Lets the last pose be this one of two, the other of which is 5° and 2 m off; the first of them is stated.
    fn leave_open(&mut self, right: usize) {
        let length = &mut self.component.lengths[0];
        let known = StepPose { first_from_second: length.pose, covariance: length.covariance };
        let Rigid { rotation, translation } = length.pose;
        let turn = UnitQuaternion::from_euler_angles(0.0, 5_f64.to_radians(), 0.0);
        let aside = UnitQuaternion::from_euler_angles(0.0, -0.5, 0.0);
        let other = StepPose { first_from_second: Rigid::new(rotation * turn, aside * translation), ..known };
        let mut poses = [other; 2];
        poses[right] = known;
        length.pose = poses[0].first_from_second;
        length.either = Some(poses);
    }

    fn sharpen(&mut self) -> usize {
        let images = &self.images;
        let load = |image: ImageId| Ok::<_, Infallible>(Arc::clone(&images[image.index()]));
        sharpen_lengths(&mut self.component, load).unwrap()
    }

    /// Error of the last pose in its frame, in radians and metres, and its square in stated deviations per coordinate.
    fn error(&self) -> (f64, f64, f64) {
        let length = &self.component.lengths[0];
        let [reference, from] =
            [length.reference, length.from].map(|image| self.truth[image.index()].translation);
        let baseline = (from - reference).norm();
        let exact = self.truth[2].inverse() * self.truth[3];
        let turn = (exact.rotation.inverse() * length.pose.rotation).scaled_axis();
        let shift = length.pose.translation - exact.translation / baseline;
        let error = nalgebra::Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z);
        let squared = error.dot(&(length.covariance.try_inverse().expect("a covariance") * error)) / 6.0;
        (turn.norm(), shift.norm() * baseline, squared)
    }
}

#[test]
fn paving_that_both_photos_show_sharpens_the_pose() {
    let mut street = Street::new([0, 0]);
    let before = street.error();
    assert_eq!(street.sharpen(), 1);
    let after = street.error();
    assert!(after.0 < 0.3 * before.0 && after.0 < 0.002, "{before:?} {after:?}");
    assert!(after.1 < 0.5 * before.1 && after.1 < 0.08, "{before:?} {after:?}");
    assert!(after.2 < 3.0, "{after:?}");
    let length = &street.component.lengths[0];
    let baseline = (street.truth[2].translation - street.truth[1].translation).norm();
    assert!((length.ratio - length.pose.translation.norm()).abs() < 1e-9 && length.votes > 10 + 12);
    assert!((length.ratio * baseline - STEP).abs() < 0.1);
}

#[test]
fn other_paving_changes_nothing() {
    let mut street = Street::new([0, 1]);
    let before = street.component.clone();
    assert_eq!(street.sharpen(), 0);
    assert_eq!(street.component, before);
}

#[test]
fn what_cannot_be_loaded_is_said_and_changes_nothing() {
    let mut street = Street::new([0, 0]);
    let before = street.component.clone();
    let failed = sharpen_lengths(&mut street.component, Err::<Arc<ImagePyramid>, _>);
    assert!(failed.is_err());
    assert_eq!(street.component, before);
}

#[test]
fn paving_tells_which_of_two_poses_is_right() {
    for right in 0..2 {
        let mut street = Street::new([0, 0]);
        street.leave_open(right);
        let before = street.error();
        assert_eq!(street.sharpen(), 1, "{right}");
        let after = street.error();
        assert!(after.0 < 0.002 && after.1 < 0.08 && after.2 < 3.0, "{right}: {before:?} {after:?}");
        assert_eq!(street.component.lengths[0].either, None);
    }
}

#[test]
fn other_paving_tells_nothing_of_two_poses() {
    let mut street = Street::new([0, 1]);
    street.leave_open(1);
    let before = street.component.lengths.clone();
    assert_eq!(street.sharpen(), 0);
    assert_eq!(street.component.lengths, before);
}

/// A street whose last photo has no pose, and shares 300 matches on the house across with the one before.
struct Waiting {
    street: Street,
    pair: PairGeometry,
    features: Vec<ImageFeatures>,
}

impl Waiting {
    fn new(salts: [u64; 2]) -> Self {
        let mut street = Street::new(salts);
        street.component.images[3].world_from_camera = None;
        street.component.lengths.clear();
        let camera = &street.component.cameras[0];
        let (width, height) = (camera.width, camera.height);
        let mut features = vec![ImageFeatures { width, height, ..ImageFeatures::default() }; 4];
        let mut inliers = Vec::new();
        for number in 0..3000 {
            let [across, up] = [7, 8].map(|salt| cell(number, 0, salt));
            let point = Vector3::new(-6.0 + 26.0 * across, 1.0 - 9.0 * up, 30.0);
            let seen = [2, 3].map(|image| {
                let in_camera = street.truth[image].inverse_transform_point(&point);
                let noise = Vector2::new(9, 10).map(|salt| cell(number, image as i64, salt) - 0.5);
                Some(camera.project(&in_camera)? + noise).filter(|pixel| camera.contains(pixel))
            });
            let [Some(first), Some(second)] = seen else { continue };
            let feature = inliers.len() as u32;
            if feature == 300 {
                break;
            }
            for (image, pixel) in [(2, first), (3, second)] {
                features[image].keypoints.push(Keypoint {
                    x: pixel.x as f32,
                    y: pixel.y as f32,
                    size: 5.0,
                    orientation: 0.0,
                    noise_px: 0.3,
                });
                features[image].colors.push([128; 3]);
            }
            inliers.push(Match { first: feature, second: feature });
        }
        let second_from_first = street.truth[3].inverse() * street.truth[2];
        let two_view =
            TwoView { kind: TwoViewKind::General, second_from_first, inliers, median_parallax_rad: 0.1 };
        let pair = PairGeometry { first: ImageId(2), second: ImageId(3), two_view };
        Self { street, pair, features }
    }

    fn register(&mut self) -> Vec<ImageId> {
        let images = &self.street.images;
        let load = |image: ImageId| Ok::<_, Infallible>(Arc::clone(&images[image.index()]));
        let features: Vec<&ImageFeatures> = self.features.iter().collect();
        let pairs = std::slice::from_ref(&self.pair);
        let Ok(registered) = register_by_ground(&mut self.street.component, pairs, &features, load);
        registered
    }
}

#[test]
fn paving_tells_the_length_of_a_step_before_one_wall() {
    let mut waiting = Waiting::new([0, 0]);
    assert_eq!(waiting.register(), [ImageId(3)]);
    let component = &waiting.street.component;
    let (turn, shift, _) = waiting.street.error();
    assert!(turn < 0.002 && shift < 0.05, "{turn} {shift}");
    let pose = component.images[3].world_from_camera.expect("is registered");
    assert!((pose.translation - waiting.street.truth[3].translation).norm() < 0.05);
    let by_both = component.points.iter().filter(|point| point.track.len() == 2).count();
    assert!(by_both > 200, "{by_both}");
}

#[test]
fn other_paving_registers_nothing() {
    let mut waiting = Waiting::new([0, 1]);
    let before = waiting.street.component.clone();
    assert_eq!(waiting.register(), []);
    assert_eq!(waiting.street.component, before);
}
