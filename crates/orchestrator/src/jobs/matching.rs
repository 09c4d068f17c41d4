//! Matches of pairs of images and what verifies them.

use std::collections::BTreeMap;

use anyhow::Result;
use nalgebra::Vector2;
use serde_json::{Value, json};
use setloc_features::{ImageFeatures, Match, without_carried_cells};
use setloc_sfm::robust::{RansacParams, estimate_turned_camera};
use setloc_sfm::verify_pair;

use super::derived_seed;
use super::features::Looks;
use crate::artifacts::{CarriedParts, PairMatches, TurnedPair, VerifiedPair};
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::stages;

/// Images of which pairs are matched, and how.
#[derive(Clone, Copy)]
pub struct PairSource<'a> {
    /// Pairs are indices into these.
    pub images: &'a [SourceImage],
    /// Parameters of all stages.
    pub config: &'a Config,
    /// Of all that is random.
    pub seed: u64,
}

/// Pair jobs go by content, not by order of names, so that renaming an image changes nothing.
pub(super) fn is_swapped(images: &[SourceImage], a: usize, b: usize) -> bool {
    images[b].hash < images[a].hash
}

/// The jobs of one pair.
#[derive(Debug, Clone, Copy)]
pub(super) struct PairJobs {
    pub matches: JobId,
    pub verified: JobId,
}

/// Adds matching and verification of one pair.
pub(super) fn add_pair(
    graph: &mut JobGraph<'_>,
    source: PairSource<'_>,
    looks: &Looks,
    (a, b): (usize, usize),
) -> PairJobs {
    let mut matches = add_matches(graph, source, looks, (a, b));
    if looks.is_again(a) || looks.is_again(b) {
        matches = add_matches_of_views(graph, source, looks, (a, b), matches);
    }
    let PairSource { images, config, seed } = source;
    let (a, b) = in_order(images, (a, b));
    let posture = stages::Posture::of([&images[a].camera, &images[b].camera]);
    let seed = pair_seed(images, (a, b), seed);
    let (two_view, cameras) = (config.two_view.clone(), [images[a].camera.clone(), images[b].camera.clone()]);
    let params = json!({ "two_view": two_view, "cameras": cameras, "seed": seed });
    let work = move |inputs: &Inputs<'_, '_>| {
        let (first, second) = (inputs.get::<ImageFeatures>("first")?, inputs.get::<ImageFeatures>("second")?);
        let matches = inputs.get::<PairMatches>("matches")?;
        // Far fewer are matched than found, and a ray takes longer than what verification does with it.
        let first = first.rays_of(&cameras[0], matches.0.iter().map(|m| m.first));
        let second = second.rays_of(&cameras[1], matches.0.iter().map(|m| m.second));
        Product::new(VerifiedPair(verify_pair(&two_view, posture, &first, &second, &matches.0, seed)))
    };
    let job = pair_job(images, (a, b), ("verify", stages::VERIFY_VERSION), params, work);
    let verified = add_pair_job(graph, job, &looks.last, (a, b));
    graph.require(verified, "matches", matches);
    PairJobs { matches, verified }
}

/// Two images in the order of their jobs' matches.
fn in_order(images: &[SourceImage], (a, b): (usize, usize)) -> (usize, usize) {
    if is_swapped(images, a, b) { (b, a) } else { (a, b) }
}

fn pair_seed(images: &[SourceImage], (a, b): (usize, usize), seed: u64) -> u64 {
    derived_seed(seed, &[&images[a].hash.to_string(), &images[b].hash.to_string()])
}

/// A job about two images.
fn pair_job<'a>(
    images: &[SourceImage],
    (a, b): (usize, usize),
    (kind, version): (&'static str, u32),
    params: Value,
    work: impl Fn(&Inputs<'_, '_>) -> Result<Product> + Send + Sync + 'a,
) -> Job<'a> {
    let name = [&images[a].name, &images[b].name];
    let name = format!("{} {}", name[0].min(name[1]), name[0].max(name[1]));
    Job { kind, version, name, params, external: BTreeMap::new(), memory: 8 << 20, work: Box::new(work) }
}

/// Adds a job that uses the features of two images.
fn add_pair_job<'a>(
    graph: &mut JobGraph<'a>,
    job: Job<'a>,
    features: &[JobId],
    (a, b): (usize, usize),
) -> JobId {
    let job = graph.add(job);
    graph.require(job, "first", features[a]);
    graph.require(job, "second", features[b]);
    job
}

/// What tells of two photos what moves with their cameras, to a job that matches them.
const CARRIED: &str = "carried";

/// The matches of two images, which have these hashes, without those of what moves with their cameras, as far as it is told.
fn without_told_carried(
    inputs: &Inputs<'_, '_>,
    hashes: [ContentHash; 2],
    matches: Vec<Match>,
    [first, second]: [&ImageFeatures; 2],
) -> Result<Vec<Match>> {
    let Some(told) = inputs.find::<CarriedParts>(CARRIED)? else { return Ok(matches) };
    let [Some(of_first), Some(of_second)] = hashes.map(|hash| told.0.get(&hash)) else { return Ok(matches) };
    Ok(without_carried_cells(matches, [of_first, of_second], first, second))
}

/// Adds a job that matches two images, which have these hashes, by these features, and may read what moves with their cameras.
fn add_matching_job<'a>(
    graph: &mut JobGraph<'a>,
    mut job: Job<'a>,
    hashes: [ContentHash; 2],
    (looks, features): (&Looks, &[JobId]),
    pair: (usize, usize),
) -> JobId {
    let carried = looks.carried_by(pair);
    if carried.is_some() {
        // Which images they are decides what of them is carried.
        job.params["images"] = json!(hashes);
    }
    let job = add_pair_job(graph, job, features, pair);
    if let Some(carried) = carried {
        graph.require(job, CARRIED, carried);
    }
    job
}

/// Adds matching of one pair.
fn add_matches(
    graph: &mut JobGraph<'_>,
    PairSource { images, config, .. }: PairSource<'_>,
    looks: &Looks,
    pair: (usize, usize),
) -> JobId {
    let (a, b) = in_order(images, pair);
    let matching = config.matching.clone();
    let posture = stages::Posture::of([&images[a].camera, &images[b].camera]);
    let hashes = [images[a].hash, images[b].hash];
    let params = json!({ "matching": config.matching, "posture": posture });
    let work = move |inputs: &Inputs<'_, '_>| {
        let (first, second) = (inputs.get::<ImageFeatures>("first")?, inputs.get::<ImageFeatures>("second")?);
        let found = stages::match_features(&matching, posture, &first, &second);
        Product::new(PairMatches(without_told_carried(inputs, hashes, found, [&first, &second])?))
    };
    let job = pair_job(images, (a, b), ("matches", stages::MATCHING_VERSION), params, work);
    add_matching_job(graph, job, hashes, (looks, &looks.first), (a, b))
}

/// Adds to the matches of one pair those of the views that a second look simulates of either.
fn add_matches_of_views(
    graph: &mut JobGraph<'_>,
    PairSource { images, config, .. }: PairSource<'_>,
    looks: &Looks,
    pair: (usize, usize),
    own: JobId,
) -> JobId {
    let (a, b) = in_order(images, pair);
    let matching = config.matching.clone();
    let posture = stages::Posture::of([&images[a].camera, &images[b].camera]);
    let hashes = [images[a].hash, images[b].hash];
    let params = json!({ "matching": config.matching, "posture": posture, "beside": "own" });
    let work = move |inputs: &Inputs<'_, '_>| {
        let features = |role: &str| inputs.get::<ImageFeatures>(role);
        let (first, second) = (features("first")?, features("second")?);
        let had_views =
            !features("first alone")?.simulated.is_empty() || !features("second alone")?.simulated.is_empty();
        let found = if had_views {
            // Those of faint images are among what has been matched.
            stages::match_features(&matching, posture, &first, &second)
        } else {
            let own = inputs.get::<PairMatches>("own")?;
            stages::match_simulated_views(&matching, posture, &first, &second, &own.0)
        };
        Product::new(PairMatches(without_told_carried(inputs, hashes, found, [&first, &second])?))
    };
    let job = pair_job(images, (a, b), ("matches", stages::MATCHING_VERSION), params, work);
    let job = add_matching_job(graph, job, hashes, (looks, &looks.last), (a, b));
    graph.require(job, "own", own);
    graph.require(job, "first alone", looks.first[a]);
    graph.require(job, "second alone", looks.first[b]);
    job
}

/// Pixels of a pair that are compared to tell a focal length by a turn, as shares of the longer side: deviation, and the range of
/// focal lengths.
const TURN_NOISE: f64 = 0.001;
const TURN_FOCAL: (f64, f64) = (0.3, 5.0);
/// Fewest matches that tell a focal length by a turn.
const MIN_TURNED: usize = 30;

/// Adds the jobs that tell the focal length of the camera of two images by its turn on the spot.
pub fn add_turned(
    graph: &mut JobGraph<'_>,
    source: PairSource<'_>,
    looks: &Looks,
    (a, b): (usize, usize),
) -> JobId {
    let matches = add_matches(graph, source, looks, (a, b));
    let PairSource { images, seed, .. } = source;
    let (a, b) = in_order(images, (a, b));
    let seed = pair_seed(images, (a, b), seed);
    let [width, height] = [images[a].camera.width, images[a].camera.height].map(f64::from);
    let params = json!({ "size": [width, height], "seed": seed });
    let work = move |inputs: &Inputs<'_, '_>| {
        let (first, second) = (inputs.get::<ImageFeatures>("first")?, inputs.get::<ImageFeatures>("second")?);
        let matches = inputs.get::<PairMatches>("matches")?;
        let middle = Vector2::new(width, height) / 2.0;
        let pixel = |of: &ImageFeatures, at: u32| Some(of.keypoints.get(at as usize)?.pixel() - middle);
        let pixels =
            matches.0.iter().filter_map(|m| Some((pixel(&first, m.first)?, pixel(&second, m.second)?)));
        let (first, second): (Vec<_>, Vec<_>) = pixels.unzip();
        let params =
            RansacParams { max_iterations: 1000, min_inliers: MIN_TURNED, ..RansacParams::default() };
        let side = width.max(height);
        let range = (TURN_FOCAL.0 * side, TURN_FOCAL.1 * side);
        let turned = estimate_turned_camera(&params, &first, &second, TURN_NOISE * side, range, seed);
        Product::new(TurnedPair(turned))
    };
    let job = pair_job(images, (a, b), ("turned", stages::TURNED_VERSION), params, work);
    let turned = add_pair_job(graph, job, &looks.first, (a, b));
    graph.require(turned, "matches", matches);
    turned
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::atomic::AtomicBool;

    use setloc_features::Camera;
    use setloc_town::TownParams;

    use super::*;
    use crate::fingerprint::ContentHash;
    use crate::graph::{Broadcast, Executor, RunOptions};
    use crate::store::Store;

    /// Two panoramas of a rendered street.
    fn panoramas(folder: &std::path::Path) -> [SourceImage; 2] {
        let town = TownParams { panoramas: 2, panorama_width: 768, photos: 0, ..TownParams::default() };
        setloc_town::write_dataset(folder, &town, 92).unwrap();
        ["pano_000.jpg", "pano_001.jpg"].map(|name| {
            let path = folder.join("panoramas").join(name);
            let hash = ContentHash::of(&std::fs::read(&path).unwrap());
            SourceImage { path, hash, ..SourceImage::guessed(name, Camera::equirectangular(768, 384)) }
        })
    }

    /// What jobs match of the first two of some images.
    fn by_jobs(images: &[SourceImage], config: &Config) -> Vec<Match> {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let found = Mutex::new(Vec::new());
        let mut graph = JobGraph::default();
        let looks = Looks::add(&mut graph, images, config);
        let pair = add_pair(&mut graph, PairSource { images, config, seed: 0 }, &looks, (0, 1));
        let work = |inputs: &Inputs<'_, '_>| {
            let matches = inputs.get::<PairMatches>("matches")?;
            found.lock().unwrap().extend_from_slice(&matches.0);
            Product::new(PairMatches(Vec::new()))
        };
        let (kind, name, params) = ("probe", String::new(), Value::Null);
        let job = Job {
            kind,
            version: 1,
            name,
            params,
            external: BTreeMap::new(),
            memory: 0,
            work: Box::new(work),
        };
        let probe = graph.add(job);
        graph.require(probe, "matches", pair.matches);
        let (observer, stop) = (Broadcast::default(), AtomicBool::new(false));
        let options = RunOptions {
            store: &store,
            observer: &observer,
            threads: 2,
            memory: 1 << 30,
            stop: &stop,
            noted_as: None,
        };
        let result = Executor::new(&graph, &options).run().unwrap();
        assert_eq!(result.failed, BTreeMap::new());
        drop(graph);
        found.into_inner().unwrap()
    }

    /// The same without jobs, each image's features sought at once.
    fn from_scratch(images: &[SourceImage], config: &Config) -> Vec<Match> {
        let [first, second] = if is_swapped(images, 0, 1) { [1, 0] } else { [0, 1] }.map(|at| {
            let image: &SourceImage = &images[at];
            let bytes = std::fs::read(&image.path).unwrap();
            let decoded = stages::decode(&bytes, &stages::DecodeLimits::default()).unwrap();
            let params = if image.second_look { config.second_features() } else { config.features.clone() };
            stages::extract(&params, &decoded, &image.camera, None).unwrap()
        });
        let posture = stages::Posture::of([&images[0].camera, &images[1].camera]);
        stages::match_features(&config.matching, posture, &first, &second)
    }

    /// Photos of a rendered street, at the bottom of which the same is painted.
    fn photos_over_a_bonnet(folder: &std::path::Path) -> Vec<SourceImage> {
        let town = TownParams { panoramas: 1, panorama_width: 256, photos: 5, ..TownParams::default() };
        setloc_town::write_dataset(folder, &town, 92).unwrap();
        let photos = folder.join("queries").join("lane");
        let mut names: Vec<_> =
            std::fs::read_dir(&photos).unwrap().map(|file| file.unwrap().file_name()).collect();
        names.sort();
        let paint = |name: &std::ffi::OsString| {
            let path = photos.join(name).with_extension("jpg");
            let mut photo = image::open(&path).unwrap().to_rgb8();
            let (width, height) = photo.dimensions();
            for (x, y, pixel) in photo.enumerate_pixels_mut().filter(|(_, y, _)| *y > height - height / 5) {
                // Patches of many greys.
                let patch = (x / 9).wrapping_mul(2_654_435_761) ^ (y / 7).wrapping_mul(2_246_822_519);
                *pixel = image::Rgb([(patch >> 13) as u8 / 2 + 60; 3]);
            }
            let path = path.with_extension("png");
            photo.save(&path).unwrap();
            let hash = ContentHash::of(&std::fs::read(&path).unwrap());
            let camera = Camera::from_focal_guess(width, height, width.into());
            SourceImage { path, hash, ..SourceImage::guessed(&name.to_string_lossy(), camera) }
        };
        names.iter().map(paint).collect()
    }

    #[test]
    fn what_all_photos_of_a_camera_show_at_the_same_place_is_not_matched() {
        let folder = tempfile::tempdir().unwrap();
        let images = photos_over_a_bonnet(folder.path());
        let (config, height) = (Config::default(), images[0].camera.height as f32);
        let [first, second] = if is_swapped(&images, 0, 1) { [1, 0] } else { [0, 1] }.map(|at| {
            let bytes = std::fs::read(&images[at].path).unwrap();
            let decoded = stages::decode(&bytes, &stages::DecodeLimits::default()).unwrap();
            stages::extract(&config.features, &decoded, &images[at].camera, None).unwrap()
        });
        let is_of_bonnet = |m: &&Match| {
            let ends = [&first.keypoints[m.first as usize], &second.keypoints[m.second as usize]];
            ends.iter().all(|keypoint| keypoint.y > 0.8 * height)
        };
        let count = |found: &[Match]| {
            let carried = found.iter().filter(is_of_bonnet).count();
            [carried, found.len() - carried]
        };
        let all = count(&stages::match_features(&config.matching, stages::Posture::Any, &first, &second));
        let found = count(&by_jobs(&images, &config));
        assert!(all[0] >= 50 && found[0] <= all[0] / 50, "{found:?} of {all:?} on the bonnet and elsewhere");
        assert!(10 * found[1] >= 9 * all[1], "{found:?} of {all:?} on the bonnet and elsewhere");
        // Of two photos nothing tells.
        assert_eq!(count(&by_jobs(&images[..2], &config)), all);
    }

    #[test]
    fn a_second_look_finds_what_would_have_been_found_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let mut images = panoramas(folder.path());
        // Panoramas that are faint, whose views are simulated from the first, and such as are not.
        for min_features in [1, Config::default().features.min_features] {
            let mut config = Config::default();
            config.features.min_features = min_features;
            // However many they have of their own, their views are matched.
            config.matching.simulate_below = 1 << 20;
            let [once, one, both] = [[false; 2], [true, false], [true; 2]].map(|again| {
                (images[0].second_look, images[1].second_look) = (again[0], again[1]);
                let found = by_jobs(&images, &config);
                assert!(found == from_scratch(&images, &config), "{min_features} {again:?}");
                found
            });
            assert!(once.len() > 50, "{}", once.len());
            let adds = min_features == 1;
            assert_eq!([&one, &both].map(|found| *found != once), [adds; 2], "{min_features}");
        }
    }
}
