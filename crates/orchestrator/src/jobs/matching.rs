//! Matches of pairs of images and what verifies them.

use std::collections::BTreeMap;

use anyhow::Result;
use nalgebra::Vector2;
use serde_json::{Value, json};
use setloc_features::ImageFeatures;
use setloc_sfm::robust::{RansacParams, estimate_turned_camera};
use setloc_sfm::verify_pair;

use super::derived_seed;
use super::features::Looks;
use crate::artifacts::{PairMatches, TurnedPair, VerifiedPair};
use crate::config::Config;
use crate::dataset::SourceImage;
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
    let mut matches = add_matches(graph, source, &looks.first, (a, b));
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

/// Adds matching of one pair.
fn add_matches(
    graph: &mut JobGraph<'_>,
    PairSource { images, config, .. }: PairSource<'_>,
    features: &[JobId],
    pair: (usize, usize),
) -> JobId {
    let (a, b) = in_order(images, pair);
    let matching = config.matching.clone();
    let posture = stages::Posture::of([&images[a].camera, &images[b].camera]);
    let params = json!({ "matching": config.matching, "posture": posture });
    let work = move |inputs: &Inputs<'_, '_>| {
        let (first, second) = (inputs.get::<ImageFeatures>("first")?, inputs.get::<ImageFeatures>("second")?);
        Product::new(PairMatches(stages::match_features(&matching, posture, &first, &second)))
    };
    let job = pair_job(images, (a, b), ("matches", stages::MATCHING_VERSION), params, work);
    add_pair_job(graph, job, features, (a, b))
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
    let params = json!({ "matching": config.matching, "posture": posture, "beside": "own" });
    let work = move |inputs: &Inputs<'_, '_>| {
        let features = |role: &str| inputs.get::<ImageFeatures>(role);
        let (first, second) = (features("first")?, features("second")?);
        let had_views =
            !features("first alone")?.simulated.is_empty() || !features("second alone")?.simulated.is_empty();
        Product::new(PairMatches(if had_views {
            // Those of faint images are among what has been matched.
            stages::match_features(&matching, posture, &first, &second)
        } else {
            let own = inputs.get::<PairMatches>("own")?;
            stages::match_simulated_views(&matching, posture, &first, &second, &own.0)
        }))
    };
    let job = pair_job(images, (a, b), ("matches", stages::MATCHING_VERSION), params, work);
    let job = add_pair_job(graph, job, &looks.last, (a, b));
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
    features: &[JobId],
    (a, b): (usize, usize),
) -> JobId {
    let matches = add_matches(graph, source, features, (a, b));
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
    let turned = add_pair_job(graph, job, features, (a, b));
    graph.require(turned, "matches", matches);
    turned
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::atomic::AtomicBool;

    use setloc_features::{Camera, Match};
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

    /// What jobs match of a pair.
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
