//! Features and matches of consecutive images of a data set, judged by its exact poses where it has them: by size, and
//! for panoramas by latitude and at the seam.
//!
//! Reads `cameras.json` beside `truth.json`; without truth, cameras are guessed.
//!
//! `cargo run --release -p setloc-features --example measure_matching -- DATASET/panoramas [DATASET/truth.json [CONTRAST]]`

#![allow(clippy::print_stdout, reason = "a report for people")]

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use serde_json::Value;
use setloc_features::{
    Camera, DecodeLimits, FeatureParams, GuidedParams, ImageFeatures, ImageInfo, Match, MatchParams, Posture,
    Rays, decode, extract, guess_camera, match_features, match_guided,
};

/// A match further than this from its epipolar plane is wrong.
const MAX_ANGLE_DEG: f64 = 0.25;
/// Where bands of latitude of panoramas end.
const LATITUDES_DEG: [f64; 5] = [15.0, 30.0, 45.0, 60.0, 90.0];
/// A match with an end nearer to the seam than this is across it, or nearly so.
const SEAM_DEG: f64 = 5.0;

struct Image {
    name: String,
    camera: Camera,
    features: ImageFeatures,
    rays: Rays,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let folder = Path::new(arguments.get(1).ok_or("which folder of images?")?);
    let truth: Option<Value> = match arguments.get(2) {
        Some(path) => Some(serde_json::from_slice(&std::fs::read(path)?)?),
        None => None,
    };
    let cameras: Option<Value> =
        match arguments.get(2).map(|path| Path::new(path).with_file_name("cameras.json")) {
            Some(path) => Some(serde_json::from_slice(&std::fs::read(path)?)?),
            None => None,
        };
    let mut paths: Vec<_> =
        std::fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.path())).collect::<Result<_, _>>()?;
    paths.sort();
    let mut params = FeatureParams::default();
    if let Some(contrast) = arguments.get(3) {
        params.contrast_threshold = contrast.parse()?;
    }
    let mut images = Vec::new();
    for path in paths {
        let set = folder.file_name().unwrap_or_default().to_string_lossy();
        let name = format!("{set}/{}", path.file_name().unwrap_or_default().to_string_lossy());
        let begin = Instant::now();
        let image = match decode(&std::fs::read(&path)?, &DecodeLimits::default()) {
            Ok(image) => image,
            Err(error) => {
                println!("{name}: skipped, {error}");
                continue;
            }
        };
        let decoded = begin.elapsed();
        let info = ImageInfo { width: image.width, height: image.height, metadata: image.metadata.clone() };
        let (guess, source) = guess_camera(&info);
        let camera = cameras.as_ref().and_then(|cameras| known_camera(cameras, &name)).unwrap_or(guess);
        let features = extract(&params, &image, &camera, None)?;
        println!(
            "{name} {}×{} {source}: {} keypoints, decode {decoded:.0?}, extract {:.0?}",
            image.width,
            image.height,
            features.len(),
            begin.elapsed().saturating_sub(decoded)
        );
        let rays = features.rays(&camera);
        images.push(Image { name, camera, features, rays });
    }
    let mut angles_by_size: Vec<(f32, f64, f64)> = Vec::new();
    let mut by_place = ByPlace::default();
    for pair in images.windows(2) {
        let begin = Instant::now();
        let posture = Posture::of([&pair[0].camera, &pair[1].camera]);
        let matches = match_features(&MatchParams::default(), posture, &pair[0].features, &pair[1].features);
        print!("{} – {}: {} matches in {:.1?}", pair[0].name, pair[1].name, matches.len(), begin.elapsed());
        if let Some(essential) =
            truth.as_ref().and_then(|truth| essential(truth, &pair[0].name, &pair[1].name))
        {
            report(&matches, pair, &essential, &mut angles_by_size, &mut by_place);
            let begin = Instant::now();
            let params = GuidedParams::default();
            let guided = match_guided(
                &params,
                (&pair[0].features, &pair[0].rays),
                (&pair[1].features, &pair[1].rays),
                &essential,
            );
            print!("; guided {} in {:.1?}", guided.len(), begin.elapsed());
        }
        println!();
    }
    if truth.is_some() {
        by_place.print(&images);
    }
    angles_by_size.sort_by(|a, b| a.0.total_cmp(&b.0));
    for group in angles_by_size.chunks((angles_by_size.len() / 10).max(1)) {
        let mut normalized: Vec<f64> = group.iter().map(|entry| entry.1 / entry.2).collect();
        let mut degrees: Vec<f64> = group.iter().map(|entry| entry.1.to_degrees()).collect();
        normalized.sort_by(f64::total_cmp);
        degrees.sort_by(f64::total_cmp);
        println!(
            "size {:.1}–{:.1}: median deviation {:.4}°, {:.2} of the expected",
            group[0].0,
            group[group.len() - 1].0,
            degrees[degrees.len() / 2],
            // The median of |N(0, 1)|.
            normalized[normalized.len() / 2] / 0.6745,
        );
    }
    Ok(())
}

fn report(
    matches: &[Match],
    pair: &[Image],
    essential: &Matrix3<f64>,
    sizes: &mut Vec<(f32, f64, f64)>,
    by_place: &mut ByPlace,
) {
    let deviation = |found: &Match| {
        let (a, b) =
            (&pair[0].rays.bearings[found.first as usize], &pair[1].rays.bearings[found.second as usize]);
        // Tangent Sampson error.
        let (plane_b, plane_a) = (essential * a, essential.transpose() * b);
        b.dot(&plane_b).abs() / (plane_b.norm_squared() + plane_a.norm_squared()).sqrt()
    };
    let is_right = |found: &Match| deviation(found) < MAX_ANGLE_DEG.to_radians();
    let right: Vec<&Match> = matches.iter().filter(|found| is_right(found)).collect();
    print!(", {} right", right.len());
    sizes.extend(right.iter().map(|found| {
        let (first, second) = (found.first as usize, found.second as usize);
        let variance = pair[0].rays.sigmas[first].powi(2) + pair[1].rays.sigmas[second].powi(2);
        // Sampson's error of two equal σ has the deviation σ, of σ₁ and σ₂ about their root mean square.
        (pair[0].features.keypoints[first].size, deviation(found), (variance / 2.0).sqrt())
    }));
    for found in matches {
        let ends =
            [&pair[0].rays.bearings[found.first as usize], &pair[1].rays.bearings[found.second as usize]];
        by_place.count(ends, is_right(found));
    }
}

/// Matches by the latitude of their first end, and those at the seam.
#[derive(Default)]
struct ByPlace {
    matches: [usize; LATITUDES_DEG.len()],
    right: [usize; LATITUDES_DEG.len()],
    right_at_seam: usize,
}

impl ByPlace {
    fn count(&mut self, ends: [&Vector3<f64>; 2], is_right: bool) {
        let band = band(ends[0]);
        self.matches[band] += 1;
        if is_right {
            self.right[band] += 1;
            let at_seam = |ray: &&Vector3<f64>| ray.x.atan2(-ray.z).abs() < SEAM_DEG.to_radians();
            self.right_at_seam += usize::from(ends.iter().any(at_seam));
        }
    }

    fn print(&self, images: &[Image]) {
        let mut keypoints = [0; LATITUDES_DEG.len()];
        for ray in images.iter().flat_map(|image| &image.rays.bearings) {
            keypoints[band(ray)] += 1;
        }
        for (band, limit) in LATITUDES_DEG.iter().enumerate() {
            println!(
                "latitudes up to {limit}°: {} keypoints, {} matches, {} right",
                keypoints[band], self.matches[band], self.right[band]
            );
        }
        println!("within {SEAM_DEG}° of the seam: {} right", self.right_at_seam);
    }
}

/// The band of latitudes that a ray lies in.
fn band(ray: &Vector3<f64>) -> usize {
    let latitude = ray.y.abs().clamp(0.0, 1.0).asin().to_degrees();
    LATITUDES_DEG.iter().position(|&limit| latitude < limit).unwrap_or(LATITUDES_DEG.len() - 1)
}

fn essential(truth: &Value, first: &str, second: &str) -> Option<Matrix3<f64>> {
    let pose = |name: &str| {
        let image = &truth["images"][name];
        let number = |key: &str, index: usize| image[key][index].as_f64();
        let [w, x, y, z] = [0, 1, 2, 3].map(|index| number("q_wxyz", index));
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w?, x?, y?, z?));
        Some((rotation, Vector3::new(number("center", 0)?, number("center", 1)?, number("center", 2)?)))
    };
    let ((first_rotation, first_center), (second_rotation, second_center)) = (pose(first)?, pose(second)?);
    let rotation = second_rotation.inverse() * first_rotation;
    let translation = second_rotation.inverse() * (first_center - second_center);
    Some(translation.normalize().cross_matrix() * rotation.to_rotation_matrix().matrix())
}

fn known_camera(cameras: &Value, name: &str) -> Option<Camera> {
    let key = cameras["images"][name].as_str()?;
    serde_json::from_value(cameras["cameras"][key].clone()).ok()
}
