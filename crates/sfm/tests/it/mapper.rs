//! The mapper on synthetic streets with exact truth.

use std::collections::HashMap;

use nalgebra::{UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::{
    Calibration, Camera, CameraModel, DESCRIPTOR_LEN, ImageFeatures, Keypoint, Match, Posture, Rays,
};
use setloc_sfm::{
    CameraId, ImageId, InputImage, MapperInput, MapperOutput, MapperParams, MergeVerdict, PairGeometry,
    PutativePair, Recognition, Rigid, Similarity, TwoView, TwoViewParams, reconstruct, verify_pair,
};

/// A street of points seen by cameras, with matches between all images that see a point.
struct Street {
    truth: Vec<Rigid>,
    cameras: Vec<Camera>,
    names: Vec<String>,
    features: Vec<ImageFeatures>,
    /// `point_of[image][feature]`; points with the same `look` cannot be told apart.
    point_of: Vec<Vec<usize>>,
    look: Vec<usize>,
}

/// The geometries of two images by these matches.
fn verified(cameras: &[Camera], rays: &[Rays], [a, b]: [usize; 2], matches: &[Match]) -> Vec<TwoView> {
    let posture = Posture::of([&cameras[a], &cameras[b]]);
    let seed = (a * 100 + b) as u64;
    verify_pair(&TwoViewParams::default(), posture, &rays[a], &rays[b], matches, seed)
}

impl Street {
    const LENGTH: f64 = 60.0;

    fn new(cameras: Vec<(Camera, Rigid)>, noise_px: f64, module_points: usize, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut points: Vec<Vector3<f64>> = (0..2400)
            .map(|_| {
                let side = if rng.random_bool(0.5) { 8.0 } else { -8.0 };
                Vector3::new(
                    side + rng.random_range(-0.8..0.8),
                    rng.random_range(-9.0..1.5),
                    rng.random_range(-10.0..Self::LENGTH + 10.0),
                )
            })
            .collect();
        let mut look: Vec<usize> = (0..points.len()).collect();
        // One façade module stands at both ends of the street.
        for _ in 0..module_points {
            let at = Vector3::new(
                8.0 + rng.random_range(-0.8..0.8),
                rng.random_range(-9.0..1.5),
                rng.random_range(0.0..8.0),
            );
            look.push(points.len());
            points.push(at);
            look.push(points.len() - 1);
            points.push(at + Vector3::new(0.0, 0.0, 45.0));
        }
        let mut street =
            Self { truth: vec![], cameras: vec![], names: vec![], features: vec![], point_of: vec![], look };
        for (index, (camera, world_from_camera)) in cameras.into_iter().enumerate() {
            let mut features =
                ImageFeatures { width: camera.width, height: camera.height, ..ImageFeatures::default() };
            let mut seen = Vec::new();
            for (id, point) in points.iter().enumerate() {
                let in_camera = world_from_camera.inverse_transform_point(point);
                let Some(pixel) = camera.project(&in_camera) else { continue };
                let x = pixel.x + rng.random_range(-1.7..1.7) * noise_px;
                let y = pixel.y + rng.random_range(-1.7..1.7) * noise_px;
                let inside =
                    x >= 0.0 && y >= 0.0 && x < f64::from(camera.width) && y < f64::from(camera.height);
                if inside && in_camera.norm() < 22.0 && rng.random_bool(0.8) {
                    features.keypoints.push(Keypoint {
                        x: x as f32,
                        y: y as f32,
                        size: 5.0,
                        orientation: 0.0,
                        noise_px: 1.0,
                    });
                    features.colors.push([128; 3]);
                    seen.push(id);
                }
            }
            street.truth.push(world_from_camera);
            street.cameras.push(camera);
            street.names.push(format!("image_{index:02}"));
            street.features.push(features);
            street.point_of.push(seen);
        }
        street
    }

    /// Panoramas every 5 m along the street, each turned its own way.
    fn of_panoramas(count: usize, noise_px: f64, module_points: usize, seed: u64) -> Self {
        Self::of_panoramas_with(&Camera::equirectangular(3072, 1536), count, noise_px, module_points, seed)
    }

    fn of_panoramas_with(
        camera: &Camera,
        count: usize,
        noise_px: f64,
        module_points: usize,
        seed: u64,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed);
        let views = (0..count).map(|k| {
            let center =
                Vector3::new(rng.random_range(-1.5..1.5), rng.random_range(-0.2..0.2), k as f64 * 5.0);
            let turn = UnitQuaternion::from_euler_angles(
                rng.random_range(-0.05..0.05),
                rng.random_range(-3.1..3.1),
                rng.random_range(-0.05..0.05),
            );
            (camera.clone(), Rigid::new(turn, center))
        });
        Self::new(views.collect(), noise_px, module_points, seed)
    }

    fn matches(&self, a: usize, b: usize, rng: &mut ChaCha8Rng) -> Vec<Match> {
        let mut found = Vec::new();
        // The first of each stays.
        let seen = || self.point_of[b].iter().enumerate().rev();
        let places: HashMap<usize, usize> = seen().map(|(at, &q)| (q, at)).collect();
        let looks: HashMap<usize, usize> = seen().map(|(at, &q)| (self.look[q], at)).collect();
        for (first, p) in self.point_of[a].iter().enumerate() {
            // A look-alike is taken for the point only where the point itself is not in sight.
            if let Some(&second) = places.get(p).or_else(|| looks.get(&self.look[*p]))
                && rng.random_bool(0.7)
            {
                found.push(Match { first: first as u32, second: second as u32 });
            }
        }
        let outliers = found.len() / 4;
        for _ in 0..outliers {
            let (n, m) = (self.point_of[a].len(), self.point_of[b].len());
            found.push(Match { first: rng.random_range(0..n) as u32, second: rng.random_range(0..m) as u32 });
        }
        found
    }

    fn map(&self, cameras: &[Camera], calibration: Calibration) -> MapperOutput {
        self.map_pairs(&MapperParams::default(), cameras, calibration, &self.verified_pairs(cameras))
    }

    fn verified_pairs(&self, cameras: &[Camera]) -> Vec<PairGeometry> {
        let mut rng = ChaCha8Rng::seed_from_u64(99);
        let rays: Vec<_> =
            self.features.iter().zip(cameras).map(|(features, camera)| features.rays(camera)).collect();
        let mut pairs = Vec::new();
        for a in 0..self.features.len() {
            for b in a + 1..self.features.len() {
                let matches = self.matches(a, b, &mut rng);
                for two_view in verified(cameras, &rays, [a, b], &matches) {
                    pairs.push(PairGeometry {
                        first: ImageId(a as u32),
                        second: ImageId(b as u32),
                        two_view,
                    });
                }
            }
        }
        pairs
    }

    fn map_pairs(
        &self,
        params: &MapperParams,
        cameras: &[Camera],
        calibration: Calibration,
        pairs: &[PairGeometry],
    ) -> MapperOutput {
        // Photos share one camera, panoramas have one each: both are allowed.
        let shared = cameras.iter().all(|camera| camera == &cameras[0]);
        let images = (0..self.features.len()).map(|index| {
            let camera = CameraId(if shared { 0 } else { index as u32 });
            InputImage::new(&self.names[index], camera, &self.features[index])
        });
        let cameras = if shared { vec![cameras[0].clone()] } else { cameras.to_vec() };
        let input = MapperInput {
            calibrations: vec![calibration; cameras.len()],
            cameras,
            images: images.collect(),
            pairs,
            putative: &[],
            two_view: TwoViewParams::default(),
        };
        reconstruct(params, &input, 5)
    }

    /// Largest centre error in metres and rotation error in degrees after alignment of the first component.
    fn errors(&self, output: &MapperOutput) -> (usize, f64, f64) {
        let component = &output.components[0];
        let registered: Vec<ImageId> = component.registered().collect();
        let pose =
            |image: &ImageId| component.images[image.index()].world_from_camera.expect("is registered");
        let source: Vec<_> = registered.iter().map(|image| pose(image).translation).collect();
        let target: Vec<_> = registered.iter().map(|image| self.truth[image.index()].translation).collect();
        let truth_from_world =
            Similarity::from_point_pairs(&source, &target).expect("centres are not collinear");
        let (mut worst_m, mut worst_deg) = (0.0_f64, 0.0_f64);
        for image in &registered {
            let aligned = truth_from_world.transform_pose(&pose(image));
            let truth = &self.truth[image.index()];
            worst_m = worst_m.max((aligned.translation - truth.translation).norm());
            worst_deg = worst_deg.max(aligned.rotation.angle_to(&truth.rotation).to_degrees());
        }
        (registered.len(), worst_m, worst_deg)
    }

    /// The largest error in degrees of an image's rotation against the first registered one's: whatever frame it is in.
    fn relative_rotation_error_deg(&self, output: &MapperOutput) -> f64 {
        let component = &output.components[0];
        let rotations: Vec<_> = component
            .registered()
            .filter_map(|image| {
                let found = component.images[image.index()].world_from_camera?;
                Some((found.rotation, self.truth[image.index()].rotation))
            })
            .collect();
        let (first, first_truth) = rotations[0];
        let error = |(found, truth): &(UnitQuaternion<f64>, UnitQuaternion<f64>)| {
            (first.inverse() * found).angle_to(&(first_truth.inverse() * truth)).to_degrees()
        };
        rotations.iter().map(error).fold(0.0, f64::max)
    }
}

#[test]
fn a_street_of_panoramas_is_mapped_to_millimetres() {
    let street = Street::of_panoramas(10, 0.3, 0, 1);
    let output = street.map(&street.cameras, Calibration::Known);
    let (registered, worst_m, worst_deg) = street.errors(&output);
    assert_eq!((registered, output.components.len()), (10, 1));
    assert!(worst_m < 0.01 && worst_deg < 0.02, "{worst_m} m {worst_deg} deg");
}

#[test]
fn stretched_panoramas_are_found_to_be_and_others_are_not() {
    let plain = Camera::equirectangular(3072, 1536);
    let mut stitched = plain.as_stitched().expect("is plain");
    let truth = [-0.0035, 0.0004, 0.001, -0.0006, -0.0002, 0.0005, 0.0015, -0.0012, 0.0008];
    stitched.params[4..].copy_from_slice(&truth);
    let street = Street::of_panoramas_with(&stitched, 10, 0.3, 0, 11);
    let cameras = vec![plain.clone(); 10];
    let pairs = street.verified_pairs(&cameras);
    let map = |calibrate_panoramas: bool| {
        let params = MapperParams { calibrate_panoramas, ..MapperParams::default() };
        street.map_pairs(&params, &cameras, Calibration::Known, &pairs)
    };
    let (found, without) = (map(true), map(false));
    let camera = &found.components[0].cameras[0];
    assert!(camera.is_stretched(), "{camera:?}");
    for (value, expected) in camera.params[4..].iter().zip(&truth) {
        assert!((value - expected).abs() < 2e-4, "{camera:?}");
    }
    let (registered, worst_m, worst_deg) = street.errors(&found);
    assert_eq!(registered, 10);
    assert!(worst_m < 0.015 && worst_deg < 0.03, "{worst_m} m {worst_deg} deg");
    assert_eq!(without.components[0].cameras[0], plain);
    let (_, worst_without_m, _) = street.errors(&without);
    assert!(worst_without_m > 2.0 * worst_m, "{worst_without_m} m without, {worst_m} m with");

    // Cameras that are told to be stretched stay as they are told, and panoramas that are not stay plain.
    let told = street.map(&vec![stitched.clone(); 10], Calibration::Known);
    assert_eq!(told.components[0].cameras, [stitched]);
    let street = Street::of_panoramas(10, 0.3, 0, 12);
    let output = street.map(&street.cameras, Calibration::Known);
    assert_eq!(output.components[0].cameras, [plain]);
}

#[test]
fn a_facade_that_stands_twice_does_not_fold_the_street() {
    for seed in 2..5 {
        let street = Street::of_panoramas(12, 0.3, 350, seed);
        let output = street.map(&street.cameras, Calibration::Known);
        let (registered, worst_m, worst_deg) = street.errors(&output);
        assert_eq!(registered, 12, "seed {seed}");
        assert!(worst_m < 0.02 && worst_deg < 0.05, "seed {seed}: {worst_m} m {worst_deg} deg");
    }
}

fn radial(width: u32, height: u32, focal: f64, k: [f64; 2]) -> Camera {
    let params = vec![focal, f64::from(width) / 2.0, f64::from(height) / 2.0, k[0], k[1]];
    Camera { model: CameraModel::Radial, width, height, params }
}

fn fisheye(width: u32, height: u32, focal: f64, k: [f64; 2]) -> Camera {
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    let params = vec![focal, focal, cx, cy, k[0], k[1], 0.0, 0.0];
    Camera { model: CameraModel::OpencvFisheye, width, height, params }
}

/// Photos of one phone whose intrinsics are known, and the last by a surveillance camera 5 m up of which nothing is known.
/// Gives what is found of the latter.
fn found_of_last(other: &Camera) -> Camera {
    let phone = radial(1600, 1200, 1250.0, [0.0, 0.0]);
    let views = (0..9).map(|k| {
        let last = k == 8;
        let tilt = if last { -0.3 } else { 0.0 };
        let turn = UnitQuaternion::from_euler_angles(tilt, -0.7 + 0.09 * f64::from(k), 0.0);
        let center = Vector3::new(1.0, if last { -3.0 } else { 0.0 }, 10.0 + 1.5 * f64::from(k));
        (if last { other.clone() } else { phone.clone() }, Rigid::new(turn, center))
    });
    let street = Street::new(views.collect(), 0.3, 0, 8);
    let mut guesses = street.cameras.clone();
    guesses[8] = Camera::from_focal_guess(other.width, other.height, 1.2 * f64::from(other.width));
    let images = street.features.iter().zip(&street.names).enumerate();
    let images =
        images.map(|(at, (features, name))| InputImage::new(name, CameraId(u32::from(at == 8)), features));
    let pairs = street.verified_pairs(&guesses);
    let input = MapperInput {
        cameras: vec![guesses[0].clone(), guesses[8].clone()],
        calibrations: vec![Calibration::Known, Calibration::Guessed],
        images: images.collect(),
        pairs: &pairs,
        putative: &[],
        two_view: TwoViewParams::default(),
    };
    let output = reconstruct(&MapperParams::default(), &input, 5);
    let (registered, worst_m, _) = street.errors(&output);
    // All centres but one lie on a line. The principal point, known to 6 px, turns this camera by 0.5°.
    let worst_deg = street.relative_rotation_error_deg(&output);
    assert_eq!(registered, 9, "{:?}", output.report.registrations);
    assert!(worst_m < 0.05 && worst_deg < 0.6, "{worst_m} m {worst_deg} deg");
    output.components[0].cameras[1].clone()
}

#[test]
fn a_camera_that_one_photo_has_is_found() {
    let found = found_of_last(&radial(1280, 720, 700.0, [-0.25, 0.06]));
    assert_eq!(found.model, CameraModel::Radial);
    assert!((found.focal_length() / 700.0 - 1.0).abs() < 0.01, "{found:?}");
    assert!((found.params[3] + 0.25).abs() < 0.03, "{found:?}");
}

#[test]
fn a_fisheye_that_one_photo_has_is_found() {
    let found = found_of_last(&fisheye(1280, 960, 420.0, [-0.01, 0.004]));
    assert_eq!(found.model, CameraModel::OpencvFisheye);
    assert!((found.focal_length() / 420.0 - 1.0).abs() < 0.01, "{found:?}");
}

/// What is found of the camera of nine photos, and how far the worst of them is off in metres.
fn found_of_all(truth: &Camera, guess: &Camera) -> (Camera, f64) {
    let views = (0..9).map(|k| {
        let turn = UnitQuaternion::from_euler_angles(0.0, -0.7 + 0.09 * f64::from(k), 0.0);
        let center = Vector3::new(3.0 - 0.7 * f64::from(k), 0.1 * f64::from(k % 3), f64::from(k));
        (truth.clone(), Rigid::new(turn, center))
    });
    let street = Street::new(views.collect(), 0.3, 0, 3);
    let output = street.map(&vec![guess.clone(); 9], Calibration::Guessed);
    let (registered, worst_m, _) = street.errors(&output);
    assert_eq!(registered, 9);
    (output.components[0].cameras[0].clone(), worst_m)
}

/// Nine photos given one camera, the last of them with another focal length: the photos that share each camera in what is
/// found, by places, the doubtful guesses, the focal lengths, and the worst error in metres.
fn found_of_one_given(last: f64, given: &Camera) -> (Vec<Vec<usize>>, usize, Vec<f64>, f64) {
    let views = (0..9).map(|k| {
        let turn = UnitQuaternion::from_euler_angles(0.0, -0.7 + 0.09 * f64::from(k), 0.0);
        let center = Vector3::new(3.0 - 0.7 * f64::from(k), 0.1 * f64::from(k % 3), f64::from(k));
        let focal = if k == 8 { last } else { 1250.0 };
        (radial(1600, 1200, focal, [-0.05, 0.0]), Rigid::new(turn, center))
    });
    let street = Street::new(views.collect(), 0.3, 0, 3);
    let output = street.map(&vec![given.clone(); 9], Calibration::Guessed);
    let (registered, worst_m, _) = street.errors(&output);
    assert_eq!(registered, 9);
    let model = &output.components[0];
    let mut groups: Vec<(CameraId, Vec<usize>)> = Vec::new();
    for (at, image) in model.images.iter().enumerate() {
        match groups.iter_mut().find(|(camera, _)| *camera == image.camera) {
            Some((_, group)) => group.push(at),
            None => groups.push((image.camera, vec![at])),
        }
    }
    let focal = groups.iter().map(|(camera, _)| model.cameras[camera.index()].focal_length()).collect();
    let groups = groups.into_iter().map(|(_, group)| group).collect();
    (groups, output.report.doubtful.len(), focal, worst_m)
}

#[test]
fn a_photo_that_does_not_share_the_camera_that_it_was_given_gets_its_own() {
    let given = radial(1600, 1200, 1240.0, [-0.04, 0.0]);
    let (groups, doubtful, focal, worst_m) = found_of_one_given(1600.0, &given);
    assert_eq!((groups, doubtful), (vec![(0..8).collect(), vec![8]], 0));
    assert!((focal[0] / 1250.0 - 1.0).abs() < 0.01 && (focal[1] / 1600.0 - 1.0).abs() < 0.01, "{focal:?}");
    assert!(worst_m < 0.05, "{worst_m} m");
    let (groups, doubtful, ..) = found_of_one_given(1250.0, &given);
    assert_eq!((groups, doubtful), (vec![(0..9).collect::<Vec<_>>()], 0));
}

#[test]
fn a_bare_guess_that_photos_do_not_share_is_doubtful_and_stays_one() {
    let guess = Camera::from_focal_guess(1600, 1200, 1500.0);
    let (groups, doubtful, ..) = found_of_one_given(1400.0, &guess);
    assert_eq!((groups, doubtful), (vec![(0..9).collect::<Vec<_>>()], 1));
    assert_eq!(found_of_one_given(1250.0, &guess).1, 0);
}

#[test]
fn photos_of_a_fisheye_that_was_taken_for_another_lens_show_it() {
    let truth = fisheye(1600, 1200, 700.0, [0.03, -0.01]);
    // What two radial terms make of it.
    let (found, worst_m) = found_of_all(&truth, &radial(1600, 1200, 742.6, [-0.26, 0.06]));
    assert_eq!(found.model, CameraModel::OpencvFisheye);
    assert!((found.focal_length() / 700.0 - 1.0).abs() < 0.01, "{found:?}");
    assert!(worst_m < 0.05, "{worst_m} m");
    // As wide a lens that is none stays what it is.
    let truth = radial(1600, 1200, 700.0, [-0.25, 0.06]);
    let (found, worst_m) = found_of_all(&truth, &radial(1600, 1200, 900.0, [0.0, 0.0]));
    assert_eq!(found.model, CameraModel::Radial);
    assert!(worst_m < 0.05, "{worst_m} m");
}

#[test]
fn the_unknown_focal_length_and_distortion_of_photos_are_found() {
    let simple = |focal: f64, k: f64| Camera {
        model: CameraModel::SimpleRadial,
        width: 1600,
        height: 1200,
        params: vec![focal, 800.0, 600.0, k],
    };
    let (found, worst_m) = found_of_all(&simple(1250.0, -0.05), &simple(1920.0, 0.0));
    assert!((found.params[0] / 1250.0 - 1.0).abs() < 0.01, "{found:?}");
    assert!((found.params[3] + 0.05).abs() < 0.01, "{found:?}");
    assert!(worst_m < 0.05, "{worst_m} m");
}

/// Thirty photos of this camera on the way along a street, looking to one side.
fn photos_of_a_street(camera: &Camera) -> Street {
    let views = (0..30).map(|k| {
        let yaw = 1.0 + 0.35 * (0.9 * f64::from(k)).sin();
        let center = Vector3::new(1.5 * f64::from(k).sin(), 0.1 * f64::from(k % 3), 1.5 * f64::from(k));
        (camera.clone(), Rigid::new(UnitQuaternion::from_euler_angles(0.0, yaw, 0.0), center))
    });
    // The noise that the keypoints state.
    Street::new(views.collect(), 1.0, 0, 3)
}

/// The camera that a street's photos show where they are told this one, the largest error in metres, and what is said of it.
fn found_of_told(street: &Street, told: &Camera, params: &MapperParams) -> (Camera, f64, Vec<String>) {
    let told = vec![told.clone(); street.features.len()];
    let output = street.map_pairs(params, &told, Calibration::Known, &street.verified_pairs(&told));
    let (registered, worst_m, _) = street.errors(&output);
    assert_eq!(registered, told.len());
    (output.components[0].cameras[0].clone(), worst_m, output.report.warnings)
}

#[test]
fn focal_lengths_that_are_told_two_percent_wrong_are_corrected_and_right_ones_kept() {
    let camera = |focal: f64| radial(1600, 1200, focal, [-0.05, 0.01]);
    let truth = camera(1250.0);
    let street = photos_of_a_street(&truth);
    let of_a_set = MapperParams { calibrate_photos: false, ..MapperParams::default() };
    let found = |told: &Camera| found_of_told(&street, told, &of_a_set);
    let (corrected, worst_m, _) = found(&camera(1275.0));
    assert!((corrected.focal_length() / 1250.0 - 1.0).abs() < 1e-3, "{corrected:?}");
    assert_eq!(corrected.params[1..], truth.params[1..]);
    let (kept, at_best_m, _) = found(&truth);
    assert_eq!(kept, truth);
    assert!(worst_m < 1.5 * at_best_m, "{worst_m} m, {at_best_m} m where it is told rightly");
    // What is a tenth off is no matter of calibration.
    assert_eq!(found(&camera(1375.0)).0, camera(1375.0));
}

#[test]
fn photos_of_a_scene_that_are_told_free_of_distortion_and_are_not_are_calibrated() {
    let truth = radial(1600, 1200, 1250.0, [-0.02, 0.0]);
    let street = photos_of_a_street(&truth);
    let found = |told: &Camera| found_of_told(&street, told, &MapperParams::default());
    let pinhole = |focal: f64| Camera {
        model: CameraModel::Pinhole,
        width: 1600,
        height: 1200,
        params: vec![focal, focal, 800.0, 600.0],
    };
    let (calibrated, worst_m, said) = found(&pinhole(1257.0));
    assert_eq!(calibrated.model, CameraModel::Opencv);
    let off_at_corner = |camera: &Camera| {
        let ray = |camera: &Camera| camera.unproject(&Vector2::new(1600.0, 1200.0)).unwrap();
        ray(camera).angle(&ray(&truth))
    };
    let (now, before) = (off_at_corner(&calibrated), off_at_corner(&pinhole(1257.0)));
    assert!(now < before / 3.0, "{now} rad, {before} rad as told");
    assert!(said.iter().any(|line| line.contains("29 more photos contradict the intrinsics")), "{said:?}");
    let (kept, at_best_m, said) = found(&truth);
    assert_eq!((&kept, said.len()), (&truth, 0));
    assert!(worst_m < 1.5 * at_best_m, "{worst_m} m, {at_best_m} m where it is told rightly");
    let as_told = MapperParams { calibrate_photos: false, correct_told: false, ..MapperParams::default() };
    let (kept, bent_m, _) = found_of_told(&street, &pinhole(1257.0), &as_told);
    assert_eq!(kept, pinhole(1257.0));
    assert!(bent_m > 2.0 * worst_m, "{bent_m} m as told, {worst_m} m");
}

#[test]
fn photos_turned_on_the_spot_are_mapped_as_one_standpoint() {
    // Looking at one side of the street only, every other photo turned back by 20°: those share most of what they
    // see, without parallax.
    let camera = Camera::from_focal_guess(1600, 1200, 1250.0);
    let views = (0..12).map(|k| {
        let turn = if k % 2 == 0 { 0.0 } else { -20.0_f64.to_radians() };
        let center =
            Vector3::new(-2.0 + f64::from(k / 2 % 2), 0.1 * f64::from(k / 4), f64::from(k / 2) * 4.0);
        // Towards +x, y down: the camera's z is the world's x.
        let yaw = std::f64::consts::FRAC_PI_2 + turn;
        (camera.clone(), Rigid::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw), center))
    });
    let street = Street::new(views.collect(), 0.3, 0, 11);
    let output = street.map(&street.cameras, Calibration::Known);
    let (registered, center, _) = street.errors(&output);
    // The centres lie within a metre of a line, so a frame aligned by them turns about it by 0.2° for 4 mm.
    let rotation = street.relative_rotation_error_deg(&output);
    assert_eq!(registered, 12, "{:?}", output.report.registrations);
    assert!(center < 0.05 && rotation < 0.1, "{center} m, {rotation}°");
    let poses: Vec<Rigid> =
        output.components[0].images.iter().filter_map(|image| image.world_from_camera).collect();
    for pair in poses.chunks(2) {
        assert_eq!(pair[0].translation, pair[1].translation, "one standpoint has one centre");
    }
}

#[test]
fn photos_that_show_the_same_from_one_standpoint_have_points_in_common() {
    // Along one side of the street, each view twice, the second turned by a fifth of a degree.
    let camera = Camera::from_focal_guess(1600, 1200, 800.0);
    let views = (0..12).map(|k| {
        let yaw = std::f64::consts::FRAC_PI_2 + 0.2_f64.to_radians() * f64::from(k % 2);
        let center =
            Vector3::new(-2.0 + f64::from(k / 2 % 2), 0.1 * f64::from(k / 4), f64::from(k / 2) * 4.0);
        (camera.clone(), Rigid::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw), center))
    });
    let street = Street::new(views.collect(), 0.3, 0, 11);
    let output = street.map(&street.cameras, Calibration::Known);
    let (registered, worst_m, _) = street.errors(&output);
    assert_eq!(registered, 12, "{:?}", output.report.registrations);
    assert!(worst_m < 0.05, "{worst_m} m");
    let (mut seen, mut by_both) = (0, 0);
    for point in &output.components[0].points {
        for of in &point.track {
            seen += 1;
            by_both +=
                usize::from(point.track.iter().any(|other| other.image.index() == of.image.index() ^ 1));
        }
    }
    assert!(by_both * 4 > seen * 3, "{by_both} of {seen}");
}

#[test]
fn two_streets_without_a_common_view_are_two_components() {
    let mut street = Street::of_panoramas(10, 0.3, 0, 6);
    for image in 5..10 {
        for point in &mut street.point_of[image] {
            *point += 100_000;
        }
    }
    street.look = (0..200_000).collect();
    let output = street.map(&street.cameras, Calibration::Known);
    let sizes: Vec<usize> =
        output.components.iter().map(|component| component.registered().count()).collect();
    assert_eq!(sizes, [5, 5]);
}

#[test]
fn pairs_that_promise_much_and_give_nothing_keep_no_other_street_from_being_mapped() {
    let mut street = Street::of_panoramas(10, 0.3, 0, 6);
    for image in 5..10 {
        for point in &mut street.point_of[image] {
            *point += 100_000;
        }
    }
    street.look = (0..200_000).collect();
    let mut pairs = street.verified_pairs(&street.cameras);
    for PairGeometry { first, second, two_view } in &mut pairs {
        if first.index() >= 5 {
            two_view.inliers.truncate(two_view.inliers.len() / 2);
            continue;
        }
        // Each image shows other points than its matches say, the same ones in all of them.
        let other = |image: &ImageId, feature: u32| {
            (feature + 31 * image.0) % street.features[image.index()].len() as u32
        };
        for m in &mut two_view.inliers {
            *m = Match { first: other(first, m.first), second: other(second, m.second) };
        }
    }
    let params = MapperParams { max_initial_pairs: 4, ..MapperParams::default() };
    let output = street.map_pairs(&params, &street.cameras, Calibration::Known, &pairs);
    let registered: Vec<Vec<u32>> = output
        .components
        .iter()
        .map(|component| component.registered().map(|image| image.0).collect())
        .collect();
    assert_eq!(registered, [[5, 6, 7, 8, 9]]);
}

/// What of a street's matches crosses from its first images to the others.
#[derive(Clone, Copy)]
enum Across {
    /// So few of each pair that none can be verified.
    Few(usize),
    /// As few, all wrong.
    Wrong(usize),
    /// All.
    All,
}

impl Street {
    /// Gives keypoints that look alike equal descriptors.
    fn describe(&mut self) {
        for (features, points) in self.features.iter_mut().zip(&self.point_of) {
            for &point in points {
                let mut rng = ChaCha8Rng::seed_from_u64(self.look[point] as u64);
                features.descriptors.extend((0..DESCRIPTOR_LEN).map(|_| rng.random_range(0..=78_u8)));
            }
        }
    }

    /// Maps the street with `split` as the first image of the second half; `jump_m` is added to where the second half
    /// was measured along the street.
    fn map_halves(&self, split: usize, across: Across, jump_m: Option<f64>) -> MapperOutput {
        let mut rng = ChaCha8Rng::seed_from_u64(17);
        let rays: Vec<_> =
            self.features.iter().zip(&self.cameras).map(|(features, camera)| features.rays(camera)).collect();
        let (mut pairs, mut putative) = (Vec::new(), Vec::new());
        for a in 0..self.features.len() {
            for b in a + 1..self.features.len() {
                let mut matches = self.matches(a, b, &mut rng);
                if (a < split) != (b < split) {
                    let count = match across {
                        Across::Few(count) | Across::Wrong(count) => count,
                        Across::All => matches.len(),
                    };
                    let step = matches.len().div_ceil(count.max(1)).max(1);
                    matches = matches.into_iter().step_by(step).collect();
                    if matches!(across, Across::Wrong(_)) {
                        for m in &mut matches {
                            m.second = rng.random_range(0..self.point_of[b].len()) as u32;
                        }
                    }
                }
                let (first, second) = (ImageId(a as u32), ImageId(b as u32));
                for two_view in verified(&self.cameras, &rays, [a, b], &matches) {
                    pairs.push(PairGeometry { first, second, two_view });
                }
                putative.push(PutativePair { first, second, matches });
            }
        }
        let measured = |index: usize| {
            let jump = if index < split { 0.0 } else { jump_m? };
            Some(self.truth[index].translation + Vector3::new(0.0, 0.0, jump + 3.0 * (index % 2) as f64))
        };
        let images = (0..self.features.len()).map(|index| InputImage {
            position_prior: jump_m.and_then(|_| measured(index)),
            ..InputImage::new(&self.names[index], CameraId(index as u32), &self.features[index])
        });
        let input = MapperInput {
            calibrations: vec![Calibration::Known; self.cameras.len()],
            cameras: self.cameras.clone(),
            images: images.collect(),
            pairs: &pairs,
            putative: &putative,
            two_view: TwoViewParams::default(),
        };
        reconstruct(&MapperParams::default(), &input, 5)
    }
}

fn sizes(output: &MapperOutput) -> Vec<usize> {
    output.components.iter().map(|component| component.registered().count()).collect()
}

fn verdicts(output: &MapperOutput) -> Vec<MergeVerdict> {
    output.report.merges.iter().map(|record| record.verdict).collect()
}

#[test]
fn two_halves_that_only_few_matches_tie_become_one() {
    let mut street = Street::of_panoramas(10, 0.3, 0, 21);
    street.describe();
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| street.map_halves(5, Across::Few(12), None))
    };
    let output = on(2);
    assert_eq!(verdicts(&output), [MergeVerdict::Joined], "{:?}", output.report.merges);
    assert_eq!(sizes(&output), [10]);
    let (_, worst_m, worst_deg) = street.errors(&output);
    assert!(worst_m < 0.02 && worst_deg < 0.02, "{worst_m} m {worst_deg} deg");
    assert_eq!(output, on(1));
}

/// Panoramas along a corridor (x across, y down, z along), one in a door of it, and some in the room behind; walls and the floor
/// have points. Where one pair alone joins them, it is that of the door and the first in the room, and its matches are of what no
/// panorama of the corridor sees.
fn map_house(in_room: &[[f64; 3]], by_one_pair: bool) -> (Street, MapperOutput) {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut points: Vec<Vector3<f64>> = (0..1600)
        .map(|_| {
            let side = if rng.random_bool(0.5) { 1.2 } else { -1.2 };
            Vector3::new(side, rng.random_range(-1.3..1.2), rng.random_range(-3.0..40.0))
        })
        .collect();
    points.extend((0..500).map(|_| {
        let (along, across) = (rng.random_range(16.0..20.0), rng.random_range(1.6..6.0));
        let [x, z] = [[across, 16.0], [across, 20.0], [6.0, along]][rng.random_range(0..3)];
        Vector3::new(x, rng.random_range(-1.3..1.2), z)
    }));
    let floor = |rng: &mut ChaCha8Rng, across: [f64; 2], along: [f64; 2]| {
        Vector3::new(rng.random_range(across[0]..across[1]), 1.4, rng.random_range(along[0]..along[1]))
    };
    points.extend((0..300).map(|_| floor(&mut rng, [-1.2, 1.2], [-3.0, 40.0])));
    points.extend((0..150).map(|_| floor(&mut rng, [1.6, 6.0], [16.0, 20.0])));
    // Nothing is seen through the wall but through the door.
    let wall = 1.4;
    let sees = |from: &Vector3<f64>, point: &Vector3<f64>| {
        let share = (wall - from.x) / (point.x - from.x);
        let at = from.z + share * (point.z - from.z);
        !(0.0..=1.0).contains(&share) || (17.5..18.5).contains(&at)
    };
    let mut centers: Vec<Vector3<f64>> =
        (0..10).map(|k| Vector3::new(rng.random_range(-0.3..0.3), 0.0, 4.0 * f64::from(k))).collect();
    centers.push(Vector3::new(wall + 0.1, 0.05, 18.0));
    centers.extend(in_room.iter().map(|at| Vector3::from(*at)));
    let camera = Camera::equirectangular(3072, 1536);
    let mut house = Street {
        truth: vec![],
        cameras: vec![],
        names: vec![],
        features: vec![],
        point_of: vec![],
        look: (0..points.len()).collect(),
    };
    for (index, center) in centers.into_iter().enumerate() {
        let pose = Rigid::new(UnitQuaternion::from_euler_angles(0.01, 0.7 * index as f64, 0.02), center);
        let mut features = ImageFeatures { width: 3072, height: 1536, ..ImageFeatures::default() };
        let mut seen = Vec::new();
        for (id, point) in points.iter().enumerate().filter(|(_, point)| sees(&center, point)) {
            let pixel = camera.project(&pose.inverse_transform_point(point)).expect("sees all around");
            let [x, y] = [pixel.x, pixel.y].map(|at| (at + rng.random_range(-0.5..0.5)) as f32);
            features.keypoints.push(Keypoint { x, y, size: 5.0, orientation: 0.0, noise_px: 0.3 });
            features.colors.push([128; 3]);
            seen.push(id);
        }
        house.truth.push(pose);
        house.cameras.push(camera.clone());
        house.names.push(format!("image_{index:02}"));
        house.features.push(features);
        house.point_of.push(seen);
    }
    let mut pairs = house.verified_pairs(&house.cameras);
    if by_one_pair {
        let [door, first_in_room] = [ImageId(10), ImageId(11)];
        let crosses = |pair: &PairGeometry| pair.first < first_in_room && pair.second >= first_in_room;
        pairs.retain(|pair| !crosses(pair) || [pair.first, pair.second] == [door, first_in_room]);
        let is_seen_beyond = |point: &usize| house.point_of[..10].iter().any(|seen| seen.contains(point));
        for pair in pairs.iter_mut().filter(|pair| crosses(pair)) {
            let point = |m: &Match| house.point_of[door.index()][m.first as usize];
            pair.two_view.inliers.retain(|m| !is_seen_beyond(&point(m)));
        }
    }
    let putative: Vec<PutativePair> = pairs
        .iter()
        .map(|pair| PutativePair {
            first: pair.first,
            second: pair.second,
            matches: pair.two_view.inliers.clone(),
        })
        .collect();
    let input = MapperInput {
        calibrations: vec![Calibration::Known],
        cameras: vec![camera],
        images: (0..house.features.len())
            .map(|index| InputImage::new(&house.names[index], CameraId(0), &house.features[index]))
            .collect(),
        pairs: &pairs,
        putative: &putative,
        two_view: TwoViewParams::default(),
    };
    let output = reconstruct(&MapperParams::default(), &input, 5);
    (house, output)
}

/// The room sees next to nothing that two others see as it does; all far down the corridor would be in its plain view but for the
/// wall.
#[test]
fn a_room_behind_a_door_belongs_to_its_corridor() {
    let (house, output) = map_house(&[[3.3, 0.0, 18.3]], false);
    let (registered, worst_m, worst_deg) = house.errors(&output);
    assert_eq!(registered, 12, "{:?}", output.report.registrations);
    assert!(worst_m < 0.02 && worst_deg < 0.1, "{worst_m} m, {worst_deg}°");
    assert!(output.components[0].lengths.is_empty());
}

/// Nothing that the room shows is seen by any but the panorama in the door, so that only what lies beside tells how far it is.
#[test]
fn a_room_that_one_pair_joins_has_the_distance_that_what_lies_beside_tells() {
    let (house, output) = map_house(&[[3.3, 0.0, 18.3]], true);
    let (registered, worst_m, worst_deg) = house.errors(&output);
    assert_eq!(registered, 12, "{:?}", output.report.registrations);
    assert!(worst_m < 0.1 && worst_deg < 0.1, "{worst_m} m, {worst_deg}°");
    let [length] = output.components[0].lengths[..] else { panic!("{:?}", output.components[0].lengths) };
    assert_eq!([length.from, length.to], [ImageId(10), ImageId(11)]);
    assert!((0.005..0.1).contains(&length.deviation), "{}", length.deviation);
}

/// The same of a room of four panoramas, which are a part of their own.
#[test]
fn rooms_that_one_pair_joins_become_one_part() {
    let in_room = [[2.6, 0.0, 17.0], [3.3, 0.02, 18.3], [4.6, -0.02, 17.4], [4.1, 0.0, 19.2]];
    let (house, output) = map_house(&in_room, true);
    assert_eq!(verdicts(&output).last(), Some(&MergeVerdict::Hung), "{:?}", output.report.merges);
    let (registered, worst_m, worst_deg) = house.errors(&output);
    assert_eq!(registered, 15, "{:?}", output.report.registrations);
    assert!(worst_m < 0.1 && worst_deg < 0.1, "{worst_m} m, {worst_deg}°");
}

#[test]
fn wrong_matches_join_nothing() {
    let mut street = Street::of_panoramas(10, 0.3, 0, 22);
    street.describe();
    let output = street.map_halves(5, Across::Wrong(18), None);
    assert_eq!(verdicts(&output), [MergeVerdict::Unsupported]);
    assert_eq!(sizes(&output), [5, 5]);
}

#[test]
fn measured_positions_may_forbid_to_join() {
    let mut street = Street::of_panoramas(10, 0.3, 0, 23);
    street.describe();
    let right = street.map_halves(5, Across::Few(12), Some(0.0));
    assert_eq!((verdicts(&right), sizes(&right)), (vec![MergeVerdict::Joined], vec![10]));
    let wrong = street.map_halves(5, Across::Few(12), Some(60.0));
    assert_eq!((verdicts(&wrong), sizes(&wrong)), (vec![MergeVerdict::PositionsDisagree], vec![5, 5]));
}

/// Two halves of a street of which walls let only one in so many points be seen from both; the matched pairs are too few to map
/// them as one.
fn map_beside_walls(one_in: usize) -> (Street, MapperOutput) {
    let mut street = Street::of_panoramas(10, 0.3, 0, 25);
    let points = street.look.len();
    street.look.extend(points..2 * points);
    for image in 5..10 {
        for point in street.point_of[image].iter_mut().filter(|point| **point % one_in != 0) {
            *point += points;
        }
    }
    street.describe();
    let output = street.map_halves(5, Across::Few(12), None);
    (street, output)
}

#[test]
fn halves_that_share_little_beside_walls_are_joined_where_many_matches_agree() {
    let (street, output) = map_beside_walls(5);
    let [merge] = &output.report.merges[..] else { panic!("{:?}", output.report.merges) };
    assert_eq!((merge.verdict, merge.recognition), (MergeVerdict::Joined, Some(Recognition::Strength)));
    let sentence = merge.sentence().unwrap();
    assert!(sentence.contains("that is many for the 789 views of points"), "{sentence}");
    let (registered, worst_m, worst_deg) = street.errors(&output);
    assert!(registered == 10 && worst_m < 0.02 && worst_deg < 0.02, "{worst_m} m {worst_deg} deg");
}

#[test]
fn halves_that_share_next_to_nothing_beside_walls_stay_apart() {
    let (_, output) = map_beside_walls(16);
    let [merge] = &output.report.merges[..] else { panic!("{:?}", output.report.merges) };
    assert_eq!((merge.verdict, merge.recognition), (MergeVerdict::NotRecognized, None));
    assert_eq!((sizes(&output), merge.sentence()), (vec![5, 5], None));
}

#[test]
fn a_facade_that_stands_in_two_streets_does_not_join_them() {
    // Panoramas at 0–20 m and 45–65 m of one street, of which the second half sees everything but the façade anew.
    let mut street = Street::of_panoramas(14, 0.3, 60, 24);
    let modules = street.look.iter().enumerate().filter(|(at, look)| **look != *at).map(|(at, _)| at);
    let modules: Vec<usize> = modules.flat_map(|at| [street.look[at], at]).collect();
    let points = street.look.len();
    street.look.extend(points..2 * points);
    for image in 9..14 {
        for point in street.point_of[image].iter_mut().filter(|point| !modules.contains(point)) {
            *point += points;
        }
    }
    for image in 5..9 {
        street.point_of[image].clear();
        street.features[image].keypoints.clear();
        street.features[image].colors.clear();
    }
    street.describe();
    let output = street.map_halves(9, Across::All, None);
    assert_eq!(sizes(&output), [5, 5], "{:?}", output.report.registrations);
    assert_eq!(verdicts(&output), [MergeVerdict::NotRecognized], "{:?}", output.report.merges);
}

#[test]
fn same_input_same_seed_same_model_whatever_the_threads() {
    let street = Street::of_panoramas(6, 0.3, 0, 8);
    let on = |threads: usize| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
            .install(|| street.map(&street.cameras, Calibration::Known))
    };
    assert_eq!(on(1), on(2));
}
