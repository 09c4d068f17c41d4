//! What the rendered sample promises to those who build on it.

// Helpers of tests are tests: a failure in them is the test failing.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;

use nalgebra::{Vector2, Vector3};
use setloc_features::Camera;
use setloc_town::{PHOTO_SET, Town, TownParams, VERSION, View, write_dataset};

const GOLDEN_MEANS: [f64; 8] = [178.8, 167.1, 158.6, 153.6, 121.5, 131.5, 109.8, 112.2];

fn tiny() -> TownParams {
    TownParams { panorama_width: 64, photo_width: 64, ..TownParams::default() }
}

fn render_with(threads: usize, index: usize) -> Vec<u8> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| Town::new(&tiny()).unwrap().render(index).unwrap().rgb)
}

/// Points of the surfaces that a view sees, on a regular grid of its pixels.
fn seen_points(town: &Town, view: &View) -> Vec<Vector3<f64>> {
    let (width, height) = (f64::from(view.camera.width), f64::from(view.camera.height));
    let mut points = Vec::new();
    for row in 0..24 {
        for column in 0..32 {
            let pixel =
                Vector2::new((column as f64 + 0.5) / 32.0 * width, (row as f64 + 0.5) / 24.0 * height);
            let direction = view.rotation_world_from_camera * view.camera.unproject(&pixel).unwrap();
            if let Some(distance) = town.hit(&view.center_in_world, &direction) {
                points.push(view.center_in_world + direction * distance);
            }
        }
    }
    points
}

/// Share of the surface points of `view` that `other` sees too.
fn shared(town: &Town, view: &View, other: &View) -> f64 {
    let points = seen_points(town, view);
    let is_shared = |point: &&Vector3<f64>| {
        let direction = other.rotation_world_from_camera.inverse() * (**point - other.center_in_world);
        let is_in_image = other.camera.project(&direction).is_some_and(|pixel| {
            (0.0..f64::from(other.camera.width)).contains(&pixel.x)
                && (0.0..f64::from(other.camera.height)).contains(&pixel.y)
        });
        is_in_image && town.visible(point, &other.center_in_world)
    };
    points.iter().filter(is_shared).count() as f64 / points.len() as f64
}

#[test]
fn bytes_do_not_depend_on_the_thread_count() {
    for index in [0, 9] {
        let alone = render_with(1, index);
        assert_eq!(alone, render_with(2, index));
        assert_ne!(alone.iter().max(), alone.iter().min());
    }
}

#[test]
fn another_seed_is_another_town() {
    let other = Town::new(&TownParams { seed: 2, ..tiny() }).unwrap();
    assert_ne!(other.render(0).unwrap().rgb, render_with(2, 0));
}

#[test]
fn a_longer_route_keeps_the_first_views() {
    let short = Town::new(&tiny()).unwrap();
    let long = Town::new(&TownParams { panoramas: 40, ..tiny() }).unwrap();
    assert_eq!(short.views()[3].center_in_world, long.views()[3].center_in_world);
    assert_eq!(short.views()[15].rotation_world_from_camera, long.views()[47].rotation_world_from_camera);
}

#[test]
fn the_target_shares_hardly_any_surface_with_the_panoramas() {
    let town = Town::new(&tiny()).unwrap();
    let (panoramas, photos) = town.views().split_at(8);
    let best = |photo| panoramas.iter().map(|pano| shared(&town, photo, pano)).fold(0.0, f64::max);
    let (first, target) = (best(&photos[0]), best(&photos[7]));
    assert!(first > 0.7, "the first photo shares {first:.3}");
    assert!(target < 0.1, "the target shares {target:.3}");
    for pair in photos.windows(2) {
        let overlap = shared(&town, &pair[1], &pair[0]);
        assert!(overlap > 0.4, "{} shares {overlap:.3} with the photo before", pair[1].name);
    }
}

#[test]
fn neighbouring_panoramas_share_most_of_their_surface() {
    let town = Town::new(&tiny()).unwrap();
    for pair in town.views()[..8].windows(2) {
        let baseline = (pair[0].center_in_world - pair[1].center_in_world).norm();
        assert!((3.5..6.5).contains(&baseline), "{baseline}");
        assert!(shared(&town, &pair[0], &pair[1]) > 0.5);
    }
}

#[test]
fn poses_are_level_and_unit() {
    for view in Town::new(&tiny()).unwrap().views() {
        let rotation = view.rotation_world_from_camera.to_rotation_matrix();
        assert!((rotation.matrix().determinant() - 1.0).abs() < 1e-12);
        assert!((view.rotation_world_from_camera.norm() - 1.0).abs() < 1e-12);
        // The image's y axis points down, within the small pitch and roll.
        assert!((rotation * Vector3::y()).z < -0.99);
        assert!((1.5..2.6).contains(&view.center_in_world.z));
    }
}

#[test]
fn a_town_of_two_hundred_panoramas_has_room_for_its_cameras() {
    let town = Town::new(&TownParams { panoramas: 200, ..tiny() }).unwrap();
    assert_eq!(town.views().len(), 208);
    for view in town.views() {
        for k in 0..16 {
            let angle = f64::from(k) * std::f64::consts::TAU / 16.0;
            let free = town.hit(&view.center_in_world, &Vector3::new(angle.cos(), angle.sin(), 0.0));
            assert!(
                free.is_none_or(|distance| distance > 0.8),
                "{} stands {free:?} m from something",
                view.name
            );
        }
        let down = town.hit(&view.center_in_world, &-Vector3::z()).unwrap();
        assert!((down - view.center_in_world.z).abs() < 0.2);
    }
}

#[test]
fn what_is_hit_is_visible_and_what_lies_behind_is_not() {
    let town = Town::new(&tiny()).unwrap();
    let view = &town.views()[0];
    for point in seen_points(&town, view) {
        assert!(town.visible(&point, &view.center_in_world));
        let behind = point + (point - view.center_in_world).normalize() * 0.5;
        assert!(!town.visible(&behind, &view.center_in_world));
    }
}

#[test]
fn a_written_data_set_reads_back_as_the_town() {
    let dir = tempfile::tempdir().unwrap();
    let params = TownParams { panoramas: 2, photos: 2, gps_noise_m: 0.0, ..tiny() };
    write_dataset(dir.path(), &params, 92).unwrap();
    let town = Town::new(&params).unwrap();
    let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
    let cameras: serde_json::Value = serde_json::from_str(&read("cameras.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&read("truth.json")).unwrap();
    let by_name: BTreeMap<String, Camera> = serde_json::from_value(cameras["cameras"].clone()).unwrap();
    assert_eq!(truth["images"].as_object().unwrap().len(), 4);
    for (index, view) in town.views().iter().enumerate() {
        assert_eq!(by_name[cameras["images"][&view.name].as_str().unwrap()], view.camera);
        let center: [f64; 3] = serde_json::from_value(truth["images"][&view.name]["center"].clone()).unwrap();
        assert_eq!(Vector3::from(center), view.center_in_world);
        let decoded = image::open(dir.path().join(&view.name)).unwrap().to_rgb8();
        assert_eq!((decoded.width(), decoded.height()), (view.camera.width, view.camera.height));
        let rendered = town.render(index).unwrap().rgb;
        let difference: u64 = decoded.iter().zip(&rendered).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        assert!(difference / (rendered.len() as u64) < 12, "{} is another picture", view.name);
    }
    assert_eq!(town.views()[3].name, format!("queries/{PHOTO_SET}/img_01.jpg"));
    let table = read("geo.csv");
    let fields: Vec<&str> = table.lines().nth(1).unwrap().split(',').collect();
    assert_eq!((fields[0], table.lines().count()), ("panoramas/pano_000.jpg", 3));
    let lat: f64 = fields[1].parse().unwrap();
    let origin: f64 = truth["geo_origin"]["lat"].as_f64().unwrap();
    // 111.2 km per degree of latitude there; the panorama stands 35 m north of the origin.
    assert!(((lat - origin) * 111_200.0 - town.views()[0].center_in_world.y).abs() < 0.1);
}

/// Fails when the picture changes: then raise `VERSION`, so that caches of rendered towns expire, and renew the numbers.
#[test]
fn version_names_this_picture() {
    let view = Town::new(&tiny()).unwrap().render(0).unwrap();
    // Means over 16 × 16 pixel tiles, not bytes: mathematical libraries differ in the last digit.
    let mut means = [0.0; 8];
    for (k, pixel) in view.rgb.chunks_exact(3).enumerate() {
        let (x, y) = (k % 64, k / 64);
        means[x / 16 + 4 * (y / 16)] += pixel.iter().map(|&c| f64::from(c)).sum::<f64>() / (3.0 * 256.0);
    }
    assert_eq!(VERSION, 1);
    for (mean, expected) in means.iter().zip(GOLDEN_MEANS) {
        assert!((mean - expected).abs() < 0.5, "{means:.1?}");
    }
}
