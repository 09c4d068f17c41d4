//! The mapper in a room whose floor repeats itself exactly.

use std::ops::Range;

use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::{Calibration, Camera, CameraModel, ImageFeatures, Keypoint, Match, Posture};
use setloc_sfm::{
    CameraId, ImageId, InputImage, MapperInput, MapperOutput, MapperParams, PairGeometry, PutativePair,
    Rigid, Similarity, TwoViewParams, pairs_underfoot, reconstruct, verify_pair,
};

const TILE_M: f64 = 0.8;
const SPOTS: usize = 16;
const WALL_POINTS: usize = 240;

/// What a keypoint shows.
#[derive(Clone, Copy, PartialEq)]
enum Seen {
    Wall(usize),
    Floor { tile: [i32; 2], spot: usize },
}

/// How much of what two panoramas share matches.
#[derive(Clone, Copy)]
struct Matching {
    /// Each panorama matches the floor as if it stood over the same tile as any other.
    are_tiles_alike: bool,
    wall: f64,
    floor: f64,
    /// A panorama whose walls match nowhere.
    without_walls: Option<usize>,
    /// A panorama of whose walls too little matches to hold it, and whose floor matches where it is.
    dim: Option<usize>,
}

/// Few points of the walls match, and most of the floor.
const MOSTLY_FLOOR: Matching =
    Matching { are_tiles_alike: true, wall: 0.3, floor: 0.7, without_walls: None, dim: None };

struct Room {
    truth: Vec<Rigid>,
    camera: Camera,
    features: Vec<ImageFeatures>,
    seen: Vec<Vec<Seen>>,
}

impl Room {
    /// Seven panoramas 1 m apart along a room of 9 m × 5 m, 1.5 m above a tiled floor.
    fn new() -> Self {
        let wall = |rng: &mut ChaCha8Rng| {
            let (along, height) = (rng.random_range(-1.5..7.5), rng.random_range(-1.0..-0.1));
            let side = if rng.random_bool(0.5) { 2.5 } else { -2.5 };
            Vector3::new(side, height, along)
        };
        Self::seen_from(Camera::equirectangular(2048, 1024), wall, 3.1, (-3..11, 2.4))
    }

    /// Seven photos 1 m apart that look ahead along a tiled street between two walls.
    fn street_of_photos() -> Self {
        let wall = |rng: &mut ChaCha8Rng| {
            let (along, height) = (rng.random_range(6.0..24.0), rng.random_range(-6.0..-0.3));
            let side = if rng.random_bool(0.5) { 4.0 } else { -4.0 };
            Vector3::new(side, height, along)
        };
        let params = vec![1100.0, 1100.0, 800.0, 600.0];
        let camera = Camera { model: CameraModel::Pinhole, width: 1600, height: 1200, params };
        Self::seen_from(camera, wall, 0.05, (-3..20, 9.0))
    }

    /// Points of walls and a floor with rows of tiles, of which each image, turned by up to `turn` radians, sees what is within
    /// reach.
    fn seen_from(
        camera: Camera,
        wall: impl Fn(&mut ChaCha8Rng) -> Vector3<f64>,
        turn: f64,
        (rows, reach): (Range<i32>, f64),
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut points: Vec<(Seen, Vector3<f64>)> =
            (0..WALL_POINTS).map(|at| (Seen::Wall(at), wall(&mut rng))).collect();
        let spots: Vec<[f64; 2]> = (0..SPOTS).map(|_| [rng.random(), rng.random()]).collect();
        for (x, z) in (-4..4).flat_map(|x| rows.clone().map(move |z| (x, z))) {
            for (spot, at) in spots.iter().enumerate() {
                let [x_m, z_m] = [f64::from(x) + at[0], f64::from(z) + at[1]].map(|tiles| tiles * TILE_M);
                points.push((Seen::Floor { tile: [x, z], spot }, Vector3::new(x_m, 1.5, z_m)));
            }
        }
        let (width, height) = (camera.width, camera.height);
        let mut room = Self { truth: vec![], camera, features: vec![], seen: vec![] };
        for k in 0..7 {
            let center =
                Vector3::new(rng.random_range(-0.4..0.4), rng.random_range(-0.05..0.05), f64::from(k));
            let yaw = rng.random_range(-turn..turn);
            let pose = Rigid::new(UnitQuaternion::from_euler_angles(0.0, yaw, 0.0), center);
            let mut features = ImageFeatures { width, height, ..ImageFeatures::default() };
            let mut seen = Vec::new();
            for (what, point) in &points {
                let is_near = matches!(what, Seen::Wall(_)) || (point - pose.translation).norm() < reach;
                let pixel = room.camera.project(&pose.inverse_transform_point(point));
                let Some(pixel) = pixel.filter(|pixel| is_near && room.camera.contains(pixel)) else {
                    continue;
                };
                let [x, y] = [pixel.x, pixel.y].map(|at| (at + rng.random_range(-0.5..0.5)) as f32);
                features.keypoints.push(Keypoint { x, y, size: 5.0, orientation: 0.0, noise_px: 0.5 });
                features.colors.push([128; 3]);
                seen.push(*what);
            }
            room.truth.push(pose);
            room.features.push(features);
            room.seen.push(seen);
        }
        room
    }

    fn matches(&self, a: usize, b: usize, matching: &Matching, rng: &mut ChaCha8Rng) -> Vec<Match> {
        let apart = (self.truth[b].translation - self.truth[a].translation) / TILE_M;
        let is_dim = matching.dim.is_some_and(|dim| dim == a || dim == b);
        let is_alike = matching.are_tiles_alike && !is_dim;
        let shift = if is_alike { [apart.x.round() as i32, apart.z.round() as i32] } else { [0, 0] };
        let is_bare = matching.without_walls.is_some_and(|bare| bare == a || bare == b);
        let [wall, floor] = match () {
            () if is_bare => [0.0, 0.7],
            () if is_dim => [0.06, 0.7],
            () => [matching.wall, matching.floor],
        };
        let mut found = Vec::new();
        for (first, seen) in self.seen[a].iter().enumerate() {
            let (wanted, share) = match *seen {
                Seen::Wall(at) => (Seen::Wall(at), wall),
                Seen::Floor { tile, spot } => {
                    (Seen::Floor { tile: [tile[0] + shift[0], tile[1] + shift[1]], spot }, floor)
                }
            };
            if let Some(second) = self.seen[b].iter().position(|other| *other == wanted)
                && rng.random_bool(share)
            {
                found.push(Match { first: first as u32, second: second as u32 });
            }
        }
        found
    }

    fn map(&self, matching: &Matching) -> MapperOutput {
        self.with_input(matching, |input| reconstruct(&MapperParams::default(), input, 5))
    }

    fn with_input<R>(&self, matching: &Matching, run: impl FnOnce(&MapperInput<'_>) -> R) -> R {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let rays: Vec<_> = self.features.iter().map(|features| features.rays(&self.camera)).collect();
        let names: Vec<String> = (0..rays.len()).map(|at| format!("image_{at}")).collect();
        let (mut pairs, mut putative) = (Vec::new(), Vec::new());
        for (a, b) in (0..rays.len()).flat_map(|a| (a + 1..rays.len()).map(move |b| (a, b))) {
            let (first, second) = (ImageId(a as u32), ImageId(b as u32));
            let matches = self.matches(a, b, matching, &mut rng);
            let posture = Posture::of([&self.camera; 2]);
            let views = verify_pair(&TwoViewParams::default(), posture, &rays[a], &rays[b], &matches, 7);
            pairs.extend(views.into_iter().map(|two_view| PairGeometry { first, second, two_view }));
            putative.push(PutativePair { first, second, matches });
        }
        let images = (self.features.iter().zip(&names))
            .map(|(features, name)| InputImage::new(name, CameraId(0), features));
        let input = MapperInput {
            cameras: vec![self.camera.clone()],
            calibrations: vec![Calibration::Known],
            images: images.collect(),
            pairs: &pairs,
            putative: &putative,
            two_view: TwoViewParams::default(),
        };
        run(&input)
    }

    /// The share of a pair's matches that lie on the floor in both images.
    fn share_of_floor(&self, pair: &PairGeometry) -> f64 {
        let is_floor = |image: ImageId, feature: u32| {
            matches!(self.seen[image.index()][feature as usize], Seen::Floor { .. })
        };
        let matches = &pair.two_view.inliers;
        let on_floor = |m: &&Match| is_floor(pair.first, m.first) && is_floor(pair.second, m.second);
        matches.iter().filter(on_floor).count() as f64 / matches.len() as f64
    }

    /// The images that are not registered, and the largest error of a centre in metres.
    fn judge(&self, output: &MapperOutput) -> (Vec<usize>, f64) {
        let component = &output.components[0];
        let (mut lost, mut found, mut truth) = (Vec::new(), Vec::new(), Vec::new());
        for (at, (image, pose)) in component.images.iter().zip(&self.truth).enumerate() {
            match image.world_from_camera {
                Some(placed) => {
                    found.push(placed.translation);
                    truth.push(pose.translation);
                }
                None => lost.push(at),
            }
        }
        let truth_from_world =
            Similarity::from_point_pairs(&found, &truth).expect("centres are not collinear");
        let error = |(at, truth): (&Vector3<f64>, &Vector3<f64>)| {
            (truth_from_world.transform_point(at) - truth).norm()
        };
        (lost, found.iter().zip(&truth).map(error).fold(0.0, f64::max))
    }
}

fn says_so(output: &MapperOutput, words: &str) -> bool {
    output.report.warnings.iter().any(|line| line.contains(words))
}

#[test]
fn a_floor_of_equal_tiles_does_not_fold_the_room() {
    let room = Room::new();
    let output = room.map(&MOSTLY_FLOOR);
    assert!(says_so(&output, "underfoot only"));
    let (lost, error) = room.judge(&output);
    assert!(lost.is_empty() && error < 0.03, "{lost:?}, {error} m");
}

#[test]
fn paving_of_equal_tiles_does_not_fold_a_set_of_photos() {
    let street = Room::street_of_photos();
    let output = street.map(&MOSTLY_FLOOR);
    assert!(says_so(&output, "underfoot only"), "{:?}", output.report.warnings);
    let (lost, error) = street.judge(&output);
    assert!(lost.is_empty() && error < 0.05, "{lost:?}, {error} m");

    let output = street.map(&Matching { are_tiles_alike: false, ..MOSTLY_FLOOR });
    assert!(!says_so(&output, "underfoot"), "{:?}", output.report.warnings);
    let (lost, error) = street.judge(&output);
    assert!(lost.is_empty() && error < 0.05, "{lost:?}, {error} m");
}

#[test]
fn a_panorama_that_only_equal_tiles_hold_is_left_out() {
    let room = Room::new();
    let matching = Matching { wall: 0.9, floor: 0.15, without_walls: Some(5), ..MOSTLY_FLOOR };
    let output = room.map(&matching);
    assert!(says_so(&output, "nothing else held image_5"), "{:?}", output.report.warnings);
    let (lost, error) = room.judge(&output);
    assert_eq!(lost, [5]);
    assert!(error < 0.03, "{error} m");
}

#[test]
fn a_panorama_whose_floor_agrees_with_what_walls_there_are_comes_back() {
    let room = Room::new();
    let output = room.map(&Matching { dim: Some(3), ..MOSTLY_FLOOR });
    assert!(says_so(&output, "underfoot only"));
    let (lost, error) = room.judge(&output);
    assert!(lost.is_empty() && error < 0.03, "{lost:?}, {error} m");
}

#[test]
fn pairs_that_explain_nothing_but_the_floor_are_told_from_those_that_explain_walls_too() {
    let room = Room::new();
    for (wall, are_tiles_alike) in [(0.3, true), (0.9, true), (0.9, false)] {
        let matching = Matching { are_tiles_alike, wall, ..MOSTLY_FLOOR };
        let (found, walls) = room.with_input(&matching, |input| {
            let judged: Vec<(bool, f64)> = (pairs_underfoot(input).into_iter())
                .zip(input.pairs.iter().map(|pair| room.share_of_floor(pair)))
                .collect();
            assert_eq!(judged.len(), input.pairs.len());
            for (is_underfoot, share) in &judged {
                assert!(!is_underfoot || *share > 0.5, "{share} of the matches of such a pair");
                assert!(*is_underfoot || *share < 0.97, "{share} of the matches of another");
            }
            let found = judged.iter().filter(|(is_underfoot, _)| *is_underfoot).count();
            (found, judged.len() - found)
        });
        assert!(walls >= 6 && (found > 0) == are_tiles_alike, "{wall} {are_tiles_alike}: {found}, {walls}");
    }
}

#[test]
fn a_floor_without_repetition_is_used() {
    let room = Room::new();
    let output = room.map(&Matching { are_tiles_alike: false, ..MOSTLY_FLOOR });
    assert!(!says_so(&output, "floor") && !says_so(&output, "underfoot"));
    let (lost, error) = room.judge(&output);
    assert!(lost.is_empty() && error < 0.02, "{lost:?}, {error} m");
    let below = output.components[0].points.iter().filter(|point| point.track.len() > 2).count();
    assert!(below > 500, "{below} points");
}
