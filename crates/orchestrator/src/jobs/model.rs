//! Features, matches, verification and mapping of a list of images: for scenes and for local models.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use nalgebra::Vector2;
use serde_json::{Value, json};
use setloc_features::{Calibration, Camera, ImageFeatures, Match};
use setloc_sfm::robust::{RansacParams, estimate_turned_camera};
use setloc_sfm::{
    CameraId, Georegistration, ImageId, InputImage, MapperInput, MapperOutput, MapperParams,
    MeasuredPosition, PairGeometry, PutativePair, QualityParams, Reconstruction, TwoViewParams, assess,
    reconstruct, verify_pair,
};

use super::alignment::{KnownOfModel, add_alignment};
use super::derived_seed;
use super::positions::Measurements;
use crate::artifacts::{PairMatches, TurnedPair, VerifiedPair};
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::stages;

/// What the model is for; the name of its job kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelKind {
    /// A scene.
    Scene,
    /// A set's local model.
    Local,
}

/// The jobs of one model.
#[derive(Debug, Clone)]
pub struct ModelJobs {
    /// One job an image.
    pub features: Vec<JobId>,
    /// The job whose result the model is.
    pub model: JobId,
    /// The positions that place it and that it is adjusted to.
    pub(super) measured: Measurements,
}

/// What a model is made of.
#[derive(Debug, Clone, Copy)]
pub struct ModelSource<'a> {
    /// The image files.
    pub images: &'a [SourceImage],
    /// Measured positions, one an image.
    pub positions: &'a [Option<MeasuredPosition>],
    /// Pairs to match, as indices into `images`.
    pub pairs: &'a [(usize, usize)],
}

/// Adds all jobs from image files to a model.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_model(
    graph: &mut JobGraph<'_>,
    kind: ModelKind,
    name: &str,
    source: ModelSource<'_>,
    config: &Config,
    seed: u64,
) -> Result<ModelJobs> {
    let ModelSource { images, positions, pairs: chosen } = source;
    let looks = match kind {
        ModelKind::Scene => Looks::add(graph, images, config),
        ModelKind::Local => Looks::once(add_features_of(graph, images, &config.photo_features())),
    };
    let mut pairs = Vec::new();
    for &(a, b) in chosen {
        pairs.push((a, b, add_pair(graph, images, &looks, (a, b), config, seed)));
    }
    let features = looks.last;
    let cameras = share_cameras(images);
    let placed: Vec<_> =
        cameras.of_image.iter().zip(positions).map(|(camera, position)| json!([camera, position])).collect();
    let mapper = MapperParams {
        continue_planes: config.sfm.continue_planes && kind == ModelKind::Local,
        correct_told: config.sfm.correct_told && kind == ModelKind::Local,
        ..config.sfm.clone()
    };
    let params = json!({
        "sfm": mapper, "two_view": config.two_view, "quality": config.quality, "georegistration": config.georegistration, "seed": seed, "images": placed, "cameras": cameras.cameras, "calibrations": cameras.calibrations,
    });
    // A plain panorama has nothing to adjust unless the mapper finds it stretched.
    let is_fixed = |(calibration, camera): (&Calibration, &Camera)| {
        calibration.is_settled() && camera.as_stitched().is_none()
    };
    let fixed = cameras.calibrations.iter().zip(&cameras.cameras).map(is_fixed).collect();
    let stage = ModelConfig { mapper, two_view: config.two_view.clone(), quality: config.quality.clone() };
    let measured =
        Measurements { params: config.georegistration.clone(), positions: positions.to_vec(), seed };
    let of_model = measured.clone();
    let pair_list: Vec<(usize, usize, bool)> =
        pairs.iter().map(|&(a, b, _)| (a, b, is_swapped(images, a, b))).collect();
    let work = move |inputs: &Inputs<'_, '_>| {
        let input = ModelInput { cameras: &cameras, measured: &of_model, pairs: &pair_list };
        run_model(inputs, &stage, &input, seed)
    };
    let model = graph.add(Job {
        kind: if kind == ModelKind::Scene { "model" } else { "local_model" },
        version: stages::MAPPER_VERSION,
        name: name.to_owned(),
        params,
        external: BTreeMap::new(),
        memory: 64 << 20,
        work: Box::new(work),
    });
    for (at, used) in features.iter().enumerate() {
        graph.accept(model, features_role(at), *used);
    }
    for (a, b, used) in pairs {
        graph.accept(model, pair_role(a, b), used.verified);
        graph.accept(model, matches_role(a, b), used.matches);
    }
    let model = if config.alignment.enabled {
        let known = KnownOfModel { cameras: fixed, measured: measured.clone() };
        add_alignment(graph, images, (&features, model), known, &config.alignment)
    } else {
        model
    };
    Ok(ModelJobs { features, model, measured })
}

/// The features jobs of some images.
struct Looks {
    /// Without the views that a second look simulates.
    first: Vec<JobId>,
    /// With them, where there is one; else the same.
    last: Vec<JobId>,
}

impl Looks {
    fn once(features: Vec<JobId>) -> Self {
        Self { first: features.clone(), last: features }
    }

    /// Adds decoding and extraction of the images of a scene, and what a second look adds to those that are due one.
    fn add(graph: &mut JobGraph<'_>, images: &[SourceImage], config: &Config) -> Self {
        let second = config.second_features();
        let mut looks = Self::once(add_features_of(graph, images, &config.features));
        for (image, last) in images.iter().zip(&mut looks.last).filter(|(image, _)| image.second_look) {
            // Views that the first look has simulated are not those of the second.
            let beside = (config.features.simulated_tilt <= 1.0).then_some(*last);
            *last = add_features(graph, image, &second, beside);
        }
        looks
    }

    fn is_again(&self, at: usize) -> bool {
        self.first[at] != self.last[at]
    }
}

/// Adds decoding and extraction of each image.
pub fn add_features_of(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    params: &stages::FeatureParams,
) -> Vec<JobId> {
    images.iter().map(|image| add_features(graph, image, params, None)).collect()
}

pub(super) fn features_role(at: usize) -> String {
    format!("features {at:04}")
}

fn pair_role(a: usize, b: usize) -> String {
    format!("pair {a:04} {b:04}")
}

fn matches_role(a: usize, b: usize) -> String {
    format!("matches {a:04} {b:04}")
}

/// Pair jobs go by content, not by order of names, so that renaming an image changes nothing.
fn is_swapped(images: &[SourceImage], a: usize, b: usize) -> bool {
    images[b].hash < images[a].hash
}

/// Adds decoding and extraction of an image, `beside` a job that has extracted all but simulated views.
fn add_features(
    graph: &mut JobGraph<'_>,
    image: &SourceImage,
    features: &stages::FeatureParams,
    beside: Option<JobId>,
) -> JobId {
    let mut external = BTreeMap::from([("image".to_owned(), image.hash)]);
    let mask = image.mask.clone();
    if let Some((_, hash)) = &mask {
        external.insert("mask".to_owned(), *hash);
    }
    // A photo's features do not depend on its intrinsics, which may be estimated later.
    let camera = if image.camera.is_panoramic() {
        image.camera.clone()
    } else {
        Camera::from_focal_guess(image.camera.width, image.camera.height, image.camera.width.into())
    };
    // Decoded pixels and three layers of the enlarged image with their smaller octaves, two bytes a pixel, and what passes through.
    let memory = u64::from(image.camera.width) * u64::from(image.camera.height) * 32;
    let mut params = json!({ "features": features, "camera": camera });
    if beside.is_some() {
        params["beside"] = json!("own");
    }
    let (path, hash, features) = (image.path.clone(), image.hash, features.clone());
    let work = move |inputs: &Inputs<'_, '_>| {
        let own = inputs.find::<ImageFeatures>("own")?;
        if let Some(own) = own.as_deref().filter(|own| !features.adds_views_to(own)) {
            return Product::new(own.clone());
        }
        let bytes = read_unchanged(&path, hash)?;
        let decoded = stages::decode(&bytes, &stages::DecodeLimits::default())?;
        let mask = mask.as_ref().map(|(path, hash)| read_mask(path, *hash)).transpose()?;
        let mask = mask.as_ref();
        Product::new(match own {
            Some(own) => stages::extract_simulated_views(&features, &decoded, &camera, mask, &own)?,
            None => stages::extract(&features, &decoded, &camera, mask)?,
        })
    };
    let (kind, version, name) = ("features", stages::FEATURES_VERSION, image.name.clone());
    let job = graph.add(Job { kind, version, name, params, external, memory, work: Box::new(work) });
    if let Some(own) = beside {
        graph.require(job, "own", own);
    }
    job
}

fn read_mask(path: &Path, hash: ContentHash) -> Result<stages::Mask> {
    let bytes = read_unchanged(path, hash)?;
    stages::Mask::decode(&bytes, &stages::DecodeLimits::default())
        .with_context(|| format!("mask {}", path.display()))
}

/// The bytes that were hashed when the run was planned.
pub(super) fn read_unchanged(path: &Path, hash: ContentHash) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    anyhow::ensure!(ContentHash::of(&bytes) == hash, "{} changed while it was used", path.display());
    Ok(bytes)
}

/// The jobs of one pair.
#[derive(Clone, Copy)]
struct PairJobs {
    matches: JobId,
    verified: JobId,
}

/// Adds matching and verification of one pair.
fn add_pair(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    looks: &Looks,
    (a, b): (usize, usize),
    config: &Config,
    seed: u64,
) -> PairJobs {
    let mut matches = add_matches(graph, images, &looks.first, (a, b), config);
    if looks.is_again(a) || looks.is_again(b) {
        matches = add_matches_of_views(graph, images, looks, (a, b), matches, config);
    }
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
    images: &[SourceImage],
    features: &[JobId],
    pair: (usize, usize),
    config: &Config,
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
    images: &[SourceImage],
    looks: &Looks,
    pair: (usize, usize),
    own: JobId,
    config: &Config,
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
    images: &[SourceImage],
    features: &[JobId],
    (a, b): (usize, usize),
    config: &Config,
    seed: u64,
) -> JobId {
    let matches = add_matches(graph, images, features, (a, b), config);
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

/// Cameras shared by the images that have the same one.
struct SharedCameras {
    cameras: Vec<Camera>,
    calibrations: Vec<Calibration>,
    of_image: Vec<usize>,
}

fn share_cameras(images: &[SourceImage]) -> SharedCameras {
    let mut shared = SharedCameras { cameras: Vec::new(), calibrations: Vec::new(), of_image: Vec::new() };
    for image in images {
        let same =
            |at: &usize| shared.cameras[*at] == image.camera && shared.calibrations[*at] == image.calibration;
        let at = (0..shared.cameras.len()).find(same).unwrap_or_else(|| {
            shared.cameras.push(image.camera.clone());
            shared.calibrations.push(image.calibration);
            shared.cameras.len() - 1
        });
        shared.of_image.push(at);
    }
    shared
}

/// Which images have a guessed camera with others that seem not to have the same, by a model of them all in this order.
pub fn divided_guesses(images: &[SourceImage], model: &MapperOutput) -> Vec<bool> {
    let of_image = share_cameras(images).of_image;
    let mut is_divided: Vec<bool> =
        of_image.iter().map(|&camera| model.report.doubtful.contains(&CameraId(camera as u32))).collect();
    for component in &model.components {
        let given = |id: ImageId| {
            let image = &component.images[id.index()];
            Some((*of_image.get(image_of_place_holder(&image.name)?)?, image.camera))
        };
        let registered: Vec<_> = component.registered().filter_map(given).collect();
        for (camera, is_divided) in of_image.iter().zip(&mut is_divided) {
            let mut alike = registered.iter().filter(|(other, _)| other == camera).map(|(_, used)| used);
            let first = alike.next();
            *is_divided |= alike.any(|used| Some(used) != first);
        }
    }
    is_divided
}

/// Parameters of the mapping job.
struct ModelConfig {
    mapper: MapperParams,
    two_view: TwoViewParams,
    quality: QualityParams,
}

struct ModelInput<'a> {
    cameras: &'a SharedCameras,
    measured: &'a Measurements,
    pairs: &'a [(usize, usize, bool)],
}

fn run_model(
    inputs: &Inputs<'_, '_>,
    config: &ModelConfig,
    input: &ModelInput<'_>,
    seed: u64,
) -> Result<Product> {
    let ModelConfig { mapper: params, two_view, quality } = config;
    let positions = &input.measured.positions;
    let mut features: Vec<(usize, Arc<ImageFeatures>)> = Vec::new();
    let mut id_of = BTreeMap::new();
    for at in 0..positions.len() {
        if let Some(found) = inputs.find::<ImageFeatures>(&features_role(at))? {
            id_of.insert(at, ImageId(features.len() as u32));
            features.push((at, found));
        }
    }
    let (mut pairs, mut putative) = (Vec::new(), Vec::new());
    for &(a, b, swapped) in input.pairs {
        let matches = inputs.find::<PairMatches>(&matches_role(a, b))?;
        if let (Some(matches), Some(&first), Some(&second)) = (matches, id_of.get(&a), id_of.get(&b)) {
            let turned = |m: &Match| if swapped { m.swapped() } else { *m };
            putative.push(PutativePair { first, second, matches: matches.0.iter().map(turned).collect() });
        }
        let verified = inputs.find::<VerifiedPair>(&pair_role(a, b))?;
        if let (Some(verified), Some(&first), Some(&second)) = (verified, id_of.get(&a), id_of.get(&b)) {
            for two_view in &verified.0 {
                let two_view = if swapped { two_view.flipped() } else { two_view.clone() };
                pairs.push(PairGeometry { first, second, two_view });
            }
        }
    }
    let names: Vec<String> = features.iter().map(|(at, _)| place_holder(*at)).collect();
    let images = features.iter().zip(&names).map(|((at, features), name)| InputImage {
        position_prior: positions[*at].map(|measured| measured.enu),
        ..InputImage::new(name, CameraId(input.cameras.of_image[*at] as u32), features)
    });
    let images = images.collect();
    let (cameras, calibrations) = (input.cameras.cameras.clone(), input.cameras.calibrations.clone());
    let input_of_mapper = MapperInput {
        cameras,
        calibrations,
        images,
        pairs: &pairs,
        putative: &putative,
        two_view: two_view.clone(),
    };
    let mut output = reconstruct(params, &input_of_mapper, seed);
    if params.continue_planes {
        output.open_pairs = output.open_among(&pairs);
    }
    // What two copies of an image share tells nothing of where they stand, and few of its matches become points.
    let contents: Vec<ContentHash> =
        features.iter().map(|(at, _)| inputs.hash(&features_role(*at))).collect::<Result<_>>()?;
    pairs.retain(|pair| contents[pair.first.index()] != contents[pair.second.index()]);
    for (at, component) in output.components.iter_mut().enumerate() {
        let report = assess(quality, component, &pairs);
        output.report.warnings.extend(report.sentences(component));
        output.outvoted.push(report.outvoted);
        output.report.georegistrations.push(input.measured.place(component));
        output.report.warnings.extend(apart(at, component, &output.report.georegistrations));
    }
    Product::new(output)
}

/// Says of another component than the largest that it is none with it, and in which frame photos are localized there.
fn apart(
    at: usize,
    component: &Reconstruction,
    georegistrations: &[Option<Georegistration>],
) -> Option<String> {
    let is_placed = |at: usize| georegistrations.get(at).is_some_and(Option::is_some);
    let frame = if is_placed(0) && is_placed(at) {
        "beside which measured positions alone place it"
    } else {
        "and photos are localized in it in a frame of its own"
    };
    let name = |image: ImageId| component.images[image.index()].name.as_str();
    let images: Vec<&str> = component.registered().map(name).collect();
    (at > 0)
        .then(|| format!("component {} is apart from the largest, {frame}: {}", at + 1, images.join(", ")))
}

/// Stands for an image's name inside models, so that a renamed image leaves them as they are.
fn place_holder(at: usize) -> String {
    format!("⟦{at}⟧")
}

/// The image that a place holder stands for.
pub(super) fn image_of_place_holder(text: &str) -> Option<usize> {
    text.strip_prefix('⟦')?.strip_suffix('⟧')?.parse().ok()
}

/// Puts names where place holders stand.
pub(super) fn with_names(text: &str, names: &[String]) -> String {
    let mut parts = text.split('⟦');
    let mut out = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let named =
            part.split_once('⟧').and_then(|(at, rest)| Some((names.get(at.parse::<usize>().ok()?)?, rest)));
        match named {
            Some((name, rest)) => out.extend([name, rest]),
            None => out.extend(["⟦", part]),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_that_do_not_share_a_guess_are_told() {
        let image = |name: &str, width: u32| {
            SourceImage::guessed(name, Camera::from_focal_guess(width, 1200, 1920.0))
        };
        let images = [image("a", 1600), image("b", 1600), image("c", 1280), image("d", 1280)];
        let model = |cameras: [u32; 4], doubtful: Vec<CameraId>| {
            let image = |(at, camera): (usize, u32)| setloc_sfm::ReconstructionImage {
                name: place_holder(at),
                camera: CameraId(camera),
                world_from_camera: Some(setloc_sfm::Rigid::identity()),
            };
            let images = cameras.into_iter().enumerate().map(image).collect();
            let components = vec![Reconstruction { images, ..Reconstruction::default() }];
            let report = setloc_sfm::MapperReport { doubtful, ..setloc_sfm::MapperReport::default() };
            MapperOutput { components, report, ..MapperOutput::default() }
        };
        let divided = |cameras, doubtful| divided_guesses(&images, &model(cameras, doubtful));
        assert_eq!(divided([0, 0, 1, 1], Vec::new()), [false; 4]);
        assert_eq!(divided([0, 2, 1, 1], Vec::new()), [true, true, false, false]);
        assert_eq!(divided([0, 0, 1, 1], vec![CameraId(1)]), [false, false, true, true]);
    }

    #[test]
    fn place_holders_become_names() {
        let names = ["a.jpg".to_owned(), "b.jpg".to_owned()];
        assert_eq!(with_names("⟦1⟧ and ⟦0⟧ but not ⟦7⟧ nor ⟦", &names), "b.jpg and a.jpg but not ⟦7⟧ nor ⟦");
        assert_eq!(image_of_place_holder(&place_holder(12)), Some(12));
    }
}
