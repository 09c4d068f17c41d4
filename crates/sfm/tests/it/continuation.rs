//! Lengths of baselines from planes that go on, on synthetic street corners with exact truth.

use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::{Calibration, Camera, DESCRIPTOR_LEN, ImageFeatures, Keypoint, Match, Posture};
use setloc_sfm::{
    BaselineLength, CameraId, ImageId, InputImage, MapperInput, MapperOutput, MapperParams, PairGeometry,
    Rigid, TwoViewParams, reconstruct, synthetic::normal, verify_pair,
};

/// Photos of the model; the last of them alone sees what the target sees.
const MODEL: usize = 4;
/// Where along the street the part begins that only the last photo of the model and the target see.
const CORNER: f64 = 16.0;
const NOISE_PX: f64 = 0.3;

/// What stands along the street.
#[derive(Clone, Copy)]
struct Place {
    /// Distance of the wall on the left before the corner; none makes it a cloud of points.
    wall: Option<f64>,
    /// The same beyond the corner; none leaves it out.
    beyond: Option<f64>,
    /// Whether a wall stands across before the corner, and another beyond it.
    across: bool,
}

struct Corner {
    truth: Vec<Rigid>,
    camera: Camera,
    features: Vec<ImageFeatures>,
    point_of: Vec<Vec<usize>>,
}

impl Corner {
    fn new(place: Place, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let relief = |rng: &mut ChaCha8Rng, distance: f64| -distance * (1.0 + 0.004 * normal(rng));
        // Points, and whether they stand beyond the corner.
        let mut points: Vec<(Vector3<f64>, bool)> = Vec::new();
        for _ in 0..700 {
            let (height, along) = (rng.random_range(-5.0..1.5), rng.random_range(2.0..CORNER));
            let x = match place.wall {
                Some(distance) => relief(&mut rng, distance),
                None => rng.random_range(-9.0..-3.0),
            };
            points.push((Vector3::new(x, height, along), false));
        }
        if let Some(distance) = place.beyond {
            for _ in 0..300 {
                let (height, along) = (rng.random_range(-5.0..1.5), rng.random_range(CORNER..34.0));
                points.push((Vector3::new(relief(&mut rng, distance), height, along), true));
            }
        }
        // Something else that both see, as roofs and trees do: no plane.
        for _ in 0..60 {
            let [x, y, z] = [-3.0..5.0, -9.0..-6.0, CORNER..34.0].map(|range| rng.random_range(range));
            points.push((Vector3::new(x, y, z), true));
        }
        // Things on the way, which the target has passed.
        for _ in 0..200 {
            let [x, y, z] = [-5.0..2.0, -3.0..1.0, 6.0..9.5].map(|range| rng.random_range(range));
            points.push((Vector3::new(x, y, z), false));
        }
        if place.across {
            for _ in 0..200 {
                let [x, y] = [0.2..0.8, -0.9..0.9].map(|range| rng.random_range(range));
                points.push((Vector3::new(x, y, 7.5 + 0.003 * normal(&mut rng)), false));
                let [x, y] = [-4.0..1.0, -5.0..1.5].map(|range| rng.random_range(range));
                points.push((Vector3::new(x, y, 38.0 + 0.05 * normal(&mut rng)), true));
            }
        }
        let looks: Vec<Vec<u8>> =
            points.iter().map(|_| (0..DESCRIPTOR_LEN).map(|_| rng.random_range(0..120)).collect()).collect();
        let truth: Vec<Rigid> = (0..=MODEL)
            .map(|k| {
                let k = k as f64;
                // The target looks along the street, where the wall before the corner is out of view.
                let turned = if k < MODEL as f64 { -0.35 + 0.03 * k } else { 0.02 };
                let yaw = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turned);
                Rigid::new(yaw, Vector3::new(0.2 * k, 0.05 * (k % 2.0), 1.9 * k))
            })
            .collect();
        let camera = Camera::from_focal_guess(1200, 900, 800.0);
        let mut corner = Self { truth, camera, features: Vec::new(), point_of: Vec::new() };
        for image in 0..=MODEL {
            let camera = &corner.camera;
            let mut features =
                ImageFeatures { width: camera.width, height: camera.height, ..ImageFeatures::default() };
            let mut seen = Vec::new();
            for (id, (point, is_beyond)) in points.iter().enumerate() {
                let hidden = if *is_beyond { image + 1 < MODEL } else { image == MODEL };
                let in_camera = corner.truth[image].inverse_transform_point(point);
                let Some(pixel) = camera.project(&in_camera).filter(|pixel| camera.contains(pixel)) else {
                    continue;
                };
                if hidden || in_camera.z < 0.5 || rng.random_bool(0.1) {
                    continue;
                }
                let [x, y] = [pixel.x, pixel.y].map(|at| (at + NOISE_PX * normal(&mut rng)) as f32);
                features.keypoints.push(Keypoint {
                    x,
                    y,
                    size: 4.0,
                    orientation: 0.0,
                    noise_px: NOISE_PX as f32,
                });
                features.colors.push([128; 3]);
                let changed = |&value: &u8| value.saturating_add(rng.random_range(0..8));
                features.descriptors.extend(looks[id].iter().map(changed));
                seen.push(id);
            }
            features.light = features.keypoints.len() as u32;
            corner.features.push(features);
            corner.point_of.push(seen);
        }
        corner
    }

    fn map(&self, params: &MapperParams) -> MapperOutput {
        self.map_target_of(&self.camera, params)
    }

    /// The model where the target is known to be of another camera, whose intrinsics are a guess.
    fn map_target_of(&self, of_target: &Camera, params: &MapperParams) -> MapperOutput {
        let mut rng = ChaCha8Rng::seed_from_u64(99);
        let is_other = of_target != &self.camera;
        let camera_of = |image: usize| if image == MODEL { of_target } else { &self.camera };
        let rays: Vec<_> =
            self.features.iter().enumerate().map(|(image, seen)| seen.rays(camera_of(image))).collect();
        let mut pairs = Vec::new();
        for a in 0..=MODEL {
            for b in a + 1..=MODEL {
                let same = self.point_of[a].iter().enumerate().filter_map(|(first, point)| {
                    let second = self.point_of[b].binary_search(point).ok()?;
                    Some(Match { first: first as u32, second: second as u32 })
                });
                let mut matches: Vec<Match> = same.filter(|_| rng.random_bool(0.7)).collect();
                for _ in 0..matches.len() / 5 {
                    let first = rng.random_range(0..self.point_of[a].len()) as u32;
                    let second = rng.random_range(0..self.point_of[b].len()) as u32;
                    matches.push(Match { first, second });
                }
                let posture = Posture::of([camera_of(a), camera_of(b)]);
                for two_view in
                    verify_pair(&TwoViewParams::default(), posture, &rays[a], &rays[b], &matches, 7)
                {
                    pairs.push(PairGeometry {
                        first: ImageId(a as u32),
                        second: ImageId(b as u32),
                        two_view,
                    });
                }
            }
        }
        let images = self.features.iter().enumerate().map(|(image, features)| {
            InputImage::new("photo", CameraId(u32::from(is_other && image == MODEL)), features)
        });
        let input = MapperInput {
            cameras: vec![self.camera.clone(), of_target.clone()],
            calibrations: vec![Calibration::Known, Calibration::Guessed],
            images: images.collect(),
            pairs: &pairs,
            putative: &[],
            two_view: TwoViewParams::default(),
        };
        reconstruct(params, &input, 5)
    }

    /// The length that was found, the logarithm of the model's own over the true one, and that of what was stated.
    fn found(&self, output: &MapperOutput) -> Option<(BaselineLength, f64, f64)> {
        let model = output.components.first()?;
        let length = *model.lengths.first()?;
        let ratio = |center: &dyn Fn(ImageId) -> Vector3<f64>| {
            let [a, b, c] = length.held().0.map(center);
            (c - b).norm() / (b - a).norm()
        };
        let center = |image: ImageId| {
            model.images[image.index()].world_from_camera.expect("is registered").translation
        };
        let truth = ratio(&|image| self.truth[image.index()].translation);
        Some((length, (ratio(&center) / truth).ln(), (length.ratio / truth).ln()))
    }
}

fn registered(output: &MapperOutput) -> usize {
    output.components[0].registered().count()
}

const STREET: Place = Place { wall: Some(6.0), beyond: Some(6.0), across: false };

#[test]
fn a_wall_that_goes_on_tells_the_length_within_its_deviation() {
    for seed in 1..5 {
        let corner = Corner::new(STREET, seed);
        let output = corner.map(&MapperParams::default());
        assert_eq!(registered(&output), MODEL + 1, "seed {seed}: {:?}", output.report.registrations);
        let (length, in_model, stated) = corner.found(&output).expect("the target's length is recorded");
        assert_eq!((length.from, length.to), (ImageId(MODEL as u32 - 1), ImageId(MODEL as u32)));
        assert!(
            stated.abs() < 2.0 * length.deviation && stated.abs() < 0.04,
            "seed {seed}: {stated} {length:?}"
        );
        assert!((in_model - stated).abs() < 0.02, "seed {seed}: adjustment holds it, {in_model} {stated}");
        assert!(length.votes >= 10);
    }
}

#[test]
fn planes_place_no_photo_whose_focal_length_nobody_told() {
    let corner = Corner::new(STREET, 2);
    // A guess that happens to be nearly right is one nonetheless.
    let guess = Camera::from_focal_guess(1200, 900, 801.0);
    assert!(guess.is_bare_guess());
    let output = corner.map_target_of(&guess, &MapperParams::default());
    assert_eq!(registered(&output), MODEL, "{:?}", output.components[0].lengths);
    let mut told = Camera::from_focal_guess(1200, 900, 800.0);
    told.params[3] = 1e-6;
    let output = corner.map_target_of(&told, &MapperParams::default());
    assert_eq!(registered(&output), MODEL + 1, "{:?}", output.report.registrations);
}

#[test]
fn a_wall_that_steps_back_is_within_the_deviation_or_refused() {
    for seed in 11..15 {
        let corner = Corner::new(Place { beyond: Some(6.6), ..STREET }, seed);
        let output = corner.map(&MapperParams::default());
        if let Some((length, in_model, _)) = corner.found(&output) {
            assert!(in_model.abs() < 2.5 * length.deviation, "seed {seed}: {in_model} {length:?}");
            assert!(length.deviation > 0.04, "seed {seed}: {length:?}");
        } else {
            assert_eq!(registered(&output), MODEL);
        }
    }
}

#[test]
fn a_wall_across_is_no_continuation_of_one_before() {
    // Both walls across are parallel, and all points of the far one agree on a length that is wrong.
    for seed in 21..24 {
        let corner = Corner::new(Place { beyond: None, across: true, ..STREET }, seed);
        let output = corner.map(&MapperParams::default());
        assert_eq!(registered(&output), MODEL, "seed {seed}: {:?}", output.components[0].lengths);
        assert!(output.components[0].lengths.is_empty());
    }
}

#[test]
fn without_planes_the_length_stays_unknown() {
    for seed in 31..34 {
        let corner = Corner::new(Place { wall: None, ..STREET }, seed);
        let output = corner.map(&MapperParams::default());
        assert_eq!(registered(&output), MODEL, "seed {seed}: {:?}", output.components[0].lengths);
    }
}

#[test]
fn it_can_be_switched_off_and_gives_the_same_twice() {
    let corner = Corner::new(STREET, 41);
    let off = corner.map(&MapperParams { continue_planes: false, ..MapperParams::default() });
    assert_eq!(registered(&off), MODEL);
    let [first, second] = [1, 2].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| corner.map(&MapperParams::default()))
    });
    assert_eq!(first, second);
}
