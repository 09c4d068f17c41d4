//! The scale of photos by the walls that they show, and whether they show them, on rendered ones.

#![allow(clippy::unwrap_used, reason = "the helpers of tests, too, may fail by panicking")]

use std::sync::Arc;

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use setloc_features::{Camera, CameraModel, GreyImage, ImagePyramid};
use setloc_sfm::{
    CameraId, DistantPhoto, ImageId, Likeness, Observation, PlacedPhoto, Reconstruction, ReconstructionImage,
    ReconstructionPoint, Rigid, ScaleByWalls, likeness_of, places_on_surfaces, scale_by_walls,
};

/// A wall ten units ahead, with a niche that stands back.
struct Street {
    seed: u32,
}

impl Street {
    fn hit(from: &Vector3<f64>, direction: &Vector3<f64>) -> Option<Vector3<f64>> {
        let at = |z: f64| {
            let depth = (z - from.z) / direction.z;
            (depth > 0.0).then(|| from + direction * depth)
        };
        let in_niche = |spot: &Vector3<f64>| (spot.x - 3.0).abs() < 1.5 && spot.y.abs() < 2.0;
        at(10.4)
            .filter(in_niche)
            .or_else(|| at(10.0))
            .filter(|spot| spot.x.abs() < 14.0 && spot.y.abs() < 4.0)
    }

    fn hash(&self, x: i64, y: i64, octave: u32) -> f64 {
        let mut h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77);
        h ^= octave.wrapping_mul(0xc2b2_ae3d) ^ self.seed.wrapping_mul(0x27d4_eb2f);
        h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
        f64::from(h ^ (h >> 15)) / f64::from(u32::MAX)
    }

    fn grey(&self, spot: &Vector3<f64>) -> f64 {
        let octave = |octave: u32| {
            let size = 0.9 / f64::from(1_u32 << octave);
            let (x, y) = (spot.x / size, spot.y / size);
            let (column, row, u, v) = (x.floor() as i64, y.floor() as i64, x - x.floor(), y - y.floor());
            let at = |dx, dy| self.hash(column + dx, row + dy, octave);
            (at(0, 0) * (1.0 - u) + at(1, 0) * u) * (1.0 - v) + (at(0, 1) * (1.0 - u) + at(1, 1) * u) * v
        };
        20.0 + 70.0 * (0..3).map(octave).sum::<f64>()
    }

    fn picture(&self, camera: &Camera, pose: &Rigid) -> Arc<ImagePyramid> {
        let pixel = |at: u32| {
            let place = Vector2::new(f64::from(at % camera.width) + 0.5, f64::from(at / camera.width) + 0.5);
            let spot = Self::hit(&pose.translation, &(pose.rotation * camera.unproject(&place)?));
            spot.map(|spot| self.grey(&spot) as u8)
        };
        let values = (0..camera.width * camera.height).map(|at| pixel(at).unwrap_or(128)).collect();
        let image = GreyImage::from_values(camera.width, camera.height, values).unwrap();
        Arc::new(ImagePyramid::new(image, camera.wraps_around()))
    }
}

const CENTERS: [[f64; 3]; 3] = [[-2.0, 0.0, 0.0], [0.0, 0.1, 0.4], [2.0, 0.0, 0.0]];

fn at(center: [f64; 3], turn: f64) -> Rigid {
    Rigid::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turn), Vector3::from(center))
}

/// The scene of three panoramas that see a lattice of points of the wall, sixteen in a row, that many units apart.
fn scene(spacing: f64) -> Reconstruction {
    let images = CENTERS.iter().enumerate().map(|(number, &center)| ReconstructionImage {
        name: number.to_string(),
        camera: CameraId(0),
        world_from_camera: Some(at(center, 0.0)),
    });
    let point = |number: u32| ReconstructionPoint {
        position: Vector3::new(
            (f64::from(number % 16) - 7.5) * spacing,
            (f64::from(number / 16) - 2.5) * spacing / 1.6,
            10.0,
        ),
        track: (0..3).map(|image| Observation { image: ImageId(image), feature: number }).collect(),
        color: [0; 3],
        error_sigma: 1.0,
        covariance: None,
        aligned: None,
    };
    Reconstruction {
        cameras: vec![Camera::equirectangular(1536, 768)],
        images: images.collect(),
        points: (0..96).map(point).collect(),
        ..Reconstruction::default()
    }
}

fn pinhole(focal: f64) -> Camera {
    let params = vec![focal, focal, 320.0, 240.0];
    Camera { model: CameraModel::Pinhole, width: 640, height: 480, params }
}

/// What photos of one street tell in the scene of another, and the true scale.
fn sought(seeds: [u32; 2]) -> (ScaleByWalls, f64) {
    let (scene, scale) = (scene(1.6), 2.5);
    let [of_scene, of_photos] = seeds.map(|seed| Street { seed });
    let camera = pinhole(500.0);
    let place = Vector3::new(0.5, 0.0, -1.0);
    let photo = |step: [f64; 3], turn: f64| {
        let pose = at((place + Vector3::from(step) * scale).into(), turn);
        let pyramid = of_photos.picture(&camera, &pose);
        DistantPhoto { camera: &camera, rotation: pose.rotation, step: Vector3::from(step), pyramid }
    };
    let photos = [photo([-0.3, 0.0, -0.9], 0.1), photo([-0.9, 0.05, -1.6], 0.3)];
    let images = [0, 1, 2].map(ImageId);
    let pose_of = |image: ImageId| scene.images[image.index()].world_from_camera.unwrap();
    let load = |image: ImageId| Some(of_scene.picture(scene.camera_of(image), &pose_of(image)));
    let found = scale_by_walls(&scene, &images, |_| Matrix3::identity() * 1e-6, load, &place, &photos);
    (found.expect("a wall is in sight"), scale)
}

#[test]
fn photos_show_most_of_a_wall_at_the_right_scale() {
    let (found, scale) = sought([1, 1]);
    assert!((found.scale / scale - 1.0).abs() < 0.01, "{found:?}");
    assert!(found.found > 100 && found.found > 4 * found.by_chance, "{} {}", found.found, found.by_chance);
    assert!(
        found.sights.len() > 100
            && [0, 1].iter().all(|photo| found.sights.iter().any(|sight| sight.photo == *photo))
    );
    // What stands back is where the rays meet, not on the plane.
    let niche: Vec<f64> = (found.sights.iter().map(|sight| sight.position))
        .filter(|spot| (spot.x - 3.0).abs() < 1.0 && spot.y.abs() < 1.4)
        .map(|spot| spot.z)
        .collect();
    let mean = niche.iter().sum::<f64>() / niche.len() as f64;
    assert!(niche.len() >= 3 && (mean - 10.4).abs() < 0.1, "{niche:?}");
}

#[test]
fn no_scale_stands_out_before_another_wall() {
    let (found, _) = sought([1, 2]);
    assert!(found.found < found.by_chance.max(5) * 3 / 2, "{} {}", found.found, found.by_chance);
}

#[test]
fn without_pixels_or_walls_there_is_none() {
    let scene = scene(1.6);
    let none = |scene: &Reconstruction, images: &[ImageId]| {
        let pixels = |_| None;
        scale_by_walls(scene, images, |_| Matrix3::identity(), pixels, &Vector3::zeros(), &[]).is_none()
    };
    assert!(
        none(&scene, &[ImageId(0)]) && none(&scene, &[]) && none(&Reconstruction::default(), &[ImageId(3)])
    );
}

/// How much of what a photo of one wall shows at such points looks as in the images of another.
fn likeness(seeds: [u32; 2], is_shown: impl Fn(&Vector3<f64>) -> bool) -> Likeness {
    let scene = scene(0.25);
    let [of_scene, of_photo] = seeds.map(|seed| Street { seed });
    let camera = pinhole(300.0);
    // A tenth of a degree off, as poses are.
    let (pose, taken_from) = (at([0.5, 0.0, 2.0], 0.1017), at([0.5, 0.0, 2.0], 0.1));
    let photo = PlacedPhoto { camera: &camera, world_from_camera: pose };
    let shown: Vec<Vector3<f64>> = (0..200)
        .map(|number| {
            Vector3::new(f64::from(number % 20) * 0.19 - 1.9, f64::from(number / 20) * 0.13 - 0.6, 10.1)
        })
        .chain((0..50).map(|number| Vector3::new(f64::from(number) * 0.04 - 1.0, 0.0, 6.0)))
        .filter(is_shown)
        .collect();
    let places = places_on_surfaces(&scene, &photo, &shown);
    let pose_of = |image: ImageId| scene.images[image.index()].world_from_camera.unwrap();
    let load = |image: ImageId| Some(of_scene.picture(scene.camera_of(image), &pose_of(image)));
    likeness_of(&scene, (&photo, &of_photo.picture(&camera, &taken_from)), &places, load)
}

#[test]
fn a_photo_of_a_wall_looks_as_the_scene_s_images_and_one_of_another_wall_does_not() {
    let right = likeness([1, 1], |_| true);
    assert!(right.compared > 150 && right.share() > 0.9, "{right:?}");
    // What is in front of the wall is on no surface of the scene.
    assert!(right.compared <= 200, "{right:?}");
    let wrong = likeness([1, 2], |_| true);
    assert!(wrong.compared > 150 && wrong.share() < 0.2, "{wrong:?}");
    assert_eq!(likeness([1, 1], |_| false), Likeness::default());
    assert_eq!(likeness([1, 1], |spot| spot.z < 10.0), Likeness::default());
}
