use opencv::core::{KeyPoint, Mat, Vector, no_array};
use opencv::features2d::SIFT;
use opencv::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

const PARAMS: SiftParams = SiftParams {
    contrast_threshold: 0.04,
    weak_contrast_threshold: 0.01,
    min_points: 0,
    edge_threshold: 10.0,
    octave_layers: 3,
    sigma_px: 1.6,
    image_sigma_px: 1.0,
    enlargement: 2.0,
};

/// Bright and dark Gaussian spots of all sizes on grey.
fn spots(seed: u64, width: usize, height: usize) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut sum = vec![120.0f64; width * height];
    for _ in 0..width * height / 150 {
        let (x, y) = (rng.random_range(0.0..width as f64), rng.random_range(0.0..height as f64));
        let sigma = 1.2 * 2f64.powf(rng.random_range(0.0..4.0f64).powf(1.2) * 0.7);
        let height_of_spot = if rng.random_bool(0.5) { 45.0 } else { -45.0 };
        let reach = (4.0 * sigma) as isize + 1;
        for row in (y as isize - reach).max(0)..(y as isize + reach).min(height as isize) {
            for column in (x as isize - reach).max(0)..(x as isize + reach).min(width as isize) {
                let (dx, dy) = (column as f64 + 0.5 - x, row as f64 + 0.5 - y);
                let value = height_of_spot * (-(dx * dx + dy * dy) / (2.0 * sigma * sigma)).exp();
                sum[row as usize * width + column as usize] += value;
            }
        }
    }
    sum.iter().map(|&value| value.round() as u8).collect()
}

fn all(width: usize, height: usize, values: &[u8]) -> (Vec<SiftPoint>, Vec<[f32; DESCRIPTOR_LEN]>) {
    all_by(&PARAMS, width, height, values)
}

/// Of the image as OpenCV enlarges it: by linear interpolation.
fn all_by(
    params: &SiftParams,
    width: usize,
    height: usize,
    values: &[u8],
) -> (Vec<SiftPoint>, Vec<[f32; DESCRIPTOR_LEN]>) {
    let linear = |distance: f64| (1.0 - distance.abs()).max(0.0);
    let image = Enlarged::by(Grey { width, height, values }, params.enlargement, linear);
    let (level, mut space) = (Level::detect(), Workspace::default());
    let points = space.detect(level, params, &image, |_, _| true);
    let descriptors = space.describe(level, params, &points);
    (points, descriptors)
}

fn opencv(width: usize, height: usize, values: &[u8]) -> (Vec<KeyPoint>, Mat) {
    let image = Mat::new_rows_cols_with_data(height as i32, width as i32, values).unwrap();
    let mut sift = SIFT::create(0, 3, 0.04, 10.0, 1.6).unwrap();
    let (mut keypoints, mut descriptors) = (Vector::new(), Mat::default());
    sift.detect_and_compute(&image, &no_array(), &mut keypoints, &mut descriptors, false).unwrap();
    (keypoints.to_vec(), descriptors)
}

fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}

#[test]
fn finds_and_describes_the_points_that_opencv_does() {
    let (width, height) = (512, 384);
    let image = spots(1, width, height);
    let (points, descriptors) = all(width, height, &image);
    let (reference, reference_descriptors) = opencv(width, height, &image);
    let (mut twins, mut similar) = (0, 0);
    for (at, other) in reference.iter().enumerate() {
        let twin = points.iter().position(|point| {
            // OpenCV counts from the first pixel's centre and is a quarter of a pixel off.
            let (x, y) = (other.pt().x + 0.25, other.pt().y + 0.25);
            let turn = (other.angle().to_radians() - point.orientation).rem_euclid(std::f32::consts::TAU);
            (x - point.x).hypot(y - point.y) < 0.05
                && (other.size() / point.size - 1.0).abs() < 0.02
                && turn.min(std::f32::consts::TAU - turn) < 0.05
        });
        if let Some(twin) = twin {
            twins += 1;
            let descriptor = reference_descriptors.at_row::<f32>(at as i32).unwrap();
            similar += usize::from(cosine(&descriptors[twin], descriptor) > 0.97);
        }
    }
    assert!(reference.len() > 500 && twins * 100 > reference.len() * 93, "{twins} of {}", reference.len());
    assert!(similar * 100 > twins * 95, "{similar} of {twins}");
    // Halfway between two pixels OpenCV's go to and fro and are given up, or end in the other one.
    assert!(points.len() * 10 < reference.len() * 11, "{} in place of {}", points.len(), reference.len());
}

#[test]
fn coarse_points_need_no_doubling() {
    let (width, height) = (512, 384);
    let image = spots(4, width, height);
    let (doubled, doubled_descriptors) = all(width, height, &image);
    let plain = SiftParams { image_sigma_px: 0.5, enlargement: 1.0, ..PARAMS };
    let (points, descriptors) = all_by(&plain, width, height, &image);
    let (mut coarse, mut twins, mut similar) = (0, 0, 0);
    for (point, descriptor) in points.iter().zip(&descriptors).filter(|(point, _)| point.size > 8.0) {
        coarse += 1;
        let twin = doubled.iter().position(|other| {
            (other.x - point.x).hypot(other.y - point.y) < 0.3
                && (other.size / point.size).ln().abs() < 0.1
                && (other.orientation - point.orientation).abs() < 0.1
        });
        if let Some(twin) = twin {
            twins += 1;
            similar += usize::from(cosine(descriptor, &doubled_descriptors[twin]) > 0.98);
        }
    }
    assert!(
        coarse > 200 && twins * 10 > coarse * 8 && similar * 10 > twins * 9,
        "{coarse} {twins} {similar}"
    );
    assert!(points.iter().all(|point| point.size > 2.0 * 1.6));
}

#[test]
fn places_have_no_bias_under_mirroring() {
    // Sizes that are odd in one octave or another.
    for (width, height) in [(300, 222), (301, 223), (279, 201)] {
        let image = spots(2, width, height);
        let mirrored: Vec<u8> = image.iter().rev().copied().collect();
        let (points, _) = all(width, height, &image);
        let (twins, _) = all(width, height, &mirrored);
        let mut sums = Vec::new();
        for point in points.iter().filter(|point| point.size < 60.0) {
            let away = |twin: &SiftPoint| (twin.x + point.x - width as f32, twin.y + point.y - height as f32);
            let near = |twin: &&SiftPoint| {
                let (dx, dy) = away(twin);
                dx.hypot(dy) < 0.2 * point.size && (twin.size / point.size - 1.0).abs() < 0.1
            };
            sums.extend(twins.iter().find(near).map(|twin| (away(twin), point.size)));
        }
        assert!(sums.len() * 10 > points.len() * 8, "{} of {}", sums.len(), points.len());
        for range in [0.0..4.0, 4.0..8.0, 8.0..60.0] {
            let of_size: Vec<_> = sums.iter().filter(|(_, size)| range.contains(size)).collect();
            let count = of_size.len() as f32;
            let mean_x = of_size.iter().map(|((dx, _), _)| dx).sum::<f32>() / count;
            let mean_y = of_size.iter().map(|((_, dy), _)| dy).sum::<f32>() / count;
            assert!(mean_x.abs() < 0.05 && mean_y.abs() < 0.05, "{range:?}: {mean_x} {mean_y} of {count}");
        }
    }
}

#[test]
fn bright_and_dark_are_told_apart() {
    let (width, height) = (300, 200);
    let image = spots(3, width, height);
    let negative: Vec<u8> = image.iter().map(|value| 255 - value).collect();
    let (points, _) = all(width, height, &image);
    let (twins, _) = all(width, height, &negative);
    assert!(points.len() > 100 && points.iter().any(|point| point.is_light));
    let same = |point: &&SiftPoint| {
        twins
            .iter()
            .any(|twin| (twin.x - point.x).hypot(twin.y - point.y) < 0.01 && twin.is_light != point.is_light)
    };
    assert_eq!(points.iter().filter(same).count(), points.len());
}

#[test]
fn all_levels_give_the_same_bits() {
    let (width, height) = (157, 121);
    let image = spots(4, width, height);
    let run = |level| {
        let mut space = Workspace::default();
        let view = Enlarged::new(Grey { width, height, values: &image }, PARAMS.enlargement);
        let points = space.detect(level, &PARAMS, &view, |_, _| true);
        let descriptors = space.describe(level, &PARAMS, &points);
        (format!("{points:?}"), descriptors)
    };
    assert_eq!(run(Level::BASELINE), run(Level::detect()));
}
