//! Mapping of a list of images, from their files: for scenes and for local models.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Result;
use serde_json::json;
use setloc_features::{Calibration, Camera, ImageFeatures, Match};
use setloc_sfm::{
    CameraId, Georegistration, ImageId, InputImage, MOST_NAMED, MapperInput, MapperOutput, MapperParams,
    MeasuredPosition, PairGeometry, PutativePair, QualityParams, QualityReport, Reconstruction,
    TwoViewParams, assess, listed, pairs_underfoot, reconstruct,
};

use super::alignment::{KnownOfModel, add_alignment};
use super::features::{Looks, accept_features, features_role};
use super::matching::{PairJobs, PairSource, add_pair, is_swapped};
use super::positions::Measurements;
use crate::artifacts::{PairMatches, VerifiedPair};
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
    /// What tells what moves with the cameras of photos.
    pub carried: Vec<JobId>,
    /// The job whose result the model is before it is aligned.
    pub mapped: JobId,
    /// The job whose result the model is.
    pub model: JobId,
    /// The positions that place it and that it is adjusted to.
    pub(super) measured: Measurements,
    /// Its pairs.
    pub(super) pairs: Vec<ModelPair>,
}

/// A pair of a model's images, which are places in the list of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModelPair {
    first: usize,
    second: usize,
    /// Whether its jobs list the second image first.
    is_swapped: bool,
    jobs: PairJobs,
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
        ModelKind::Local => Looks::once(graph, images, &config.photo_features()),
    };
    let mut pairs = Vec::new();
    for &(first, second) in chosen {
        let jobs = add_pair(graph, PairSource { images, config, seed }, &looks, (first, second));
        pairs.push(ModelPair { first, second, is_swapped: is_swapped(images, first, second), jobs });
    }
    let carried = looks.all_carried();
    let features = looks.last;
    let cameras = share_cameras(images);
    let placed: Vec<_> =
        cameras.of_image.iter().zip(positions).map(|(camera, position)| json!([camera, position])).collect();
    let mapper = MapperParams {
        continue_planes: config.sfm.continue_planes && kind == ModelKind::Local,
        correct_told: config.sfm.correct_told && kind == ModelKind::Local,
        calibrate_photos: config.sfm.calibrate_photos && kind == ModelKind::Scene,
        ..config.sfm.clone()
    };
    let quality = QualityParams {
        leave_out_misplaced: config.quality.leave_out_misplaced && kind == ModelKind::Scene,
        ..config.quality.clone()
    };
    let params = json!({
        "sfm": mapper, "two_view": config.two_view, "quality": quality, "georegistration": config.georegistration, "seed": seed, "images": placed, "cameras": cameras.cameras, "calibrations": cameras.calibrations,
    });
    // A plain panorama has nothing to adjust unless the mapper finds it stretched.
    let is_fixed = |(calibration, camera): (&Calibration, &Camera)| {
        calibration.is_settled() && camera.as_stitched().is_none()
    };
    let fixed = cameras.calibrations.iter().zip(&cameras.cameras).map(is_fixed).collect();
    let stage = ModelConfig { mapper, two_view: config.two_view.clone(), quality };
    let measured =
        Measurements { params: config.georegistration.clone(), positions: positions.to_vec(), seed };
    let of_model = measured.clone();
    let of_model_pairs = pairs.clone();
    let work = move |inputs: &Inputs<'_, '_>| {
        let input = ModelInput { cameras: &cameras, measured: &of_model, pairs: &of_model_pairs };
        run_model(inputs, &stage, &input, seed)
    };
    let mapped = graph.add(Job {
        kind: if kind == ModelKind::Scene { "model" } else { "local_model" },
        version: stages::MAPPER_VERSION,
        name: name.to_owned(),
        params,
        external: BTreeMap::new(),
        memory: 64 << 20,
        work: Box::new(work),
    });
    accept_features(graph, mapped, &features);
    accept_verified(graph, mapped, &pairs);
    for pair in &pairs {
        graph.accept(mapped, matches_role(pair), pair.jobs.matches);
    }
    let model = if config.alignment.enabled {
        let known = KnownOfModel { cameras: fixed, measured: measured.clone() };
        add_alignment(graph, images, (&features, mapped), known, &config.alignment)
    } else {
        mapped
    };
    Ok(ModelJobs { features, carried, mapped, model, measured, pairs })
}

fn pair_role(pair: &ModelPair) -> String {
    format!("pair {:04} {:04}", pair.first, pair.second)
}

fn matches_role(pair: &ModelPair) -> String {
    format!("matches {:04} {:04}", pair.first, pair.second)
}

/// Lets a job read the geometries of pairs.
pub(super) fn accept_verified(graph: &mut JobGraph<'_>, job: JobId, pairs: &[ModelPair]) {
    for pair in pairs {
        graph.accept(job, pair_role(pair), pair.jobs.verified);
    }
}

/// The geometries of pairs, whose images have these numbers in the model.
pub(super) fn verified_of(
    inputs: &Inputs<'_, '_>,
    pairs: &[ModelPair],
    id_of: &BTreeMap<usize, ImageId>,
) -> Result<Vec<PairGeometry>> {
    let mut geometries = Vec::new();
    for pair in pairs {
        let verified = inputs.find::<VerifiedPair>(&pair_role(pair))?;
        let ids = (id_of.get(&pair.first), id_of.get(&pair.second));
        let (Some(verified), (Some(&first), Some(&second))) = (verified, ids) else { continue };
        for two_view in &verified.0 {
            let two_view = if pair.is_swapped { two_view.flipped() } else { two_view.clone() };
            geometries.push(PairGeometry { first, second, two_view });
        }
    }
    Ok(geometries)
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
    pairs: &'a [ModelPair],
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
    let pairs = verified_of(inputs, input.pairs, &id_of)?;
    let mut putative = Vec::new();
    for pair in input.pairs {
        let matches = inputs.find::<PairMatches>(&matches_role(pair))?;
        let ids = (id_of.get(&pair.first), id_of.get(&pair.second));
        let (Some(matches), (Some(&first), Some(&second))) = (matches, ids) else { continue };
        let turned = |m: &Match| if pair.is_swapped { m.swapped() } else { *m };
        putative.push(PutativePair { first, second, matches: matches.0.iter().map(turned).collect() });
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
    let underfoot = pairs_underfoot(&input_of_mapper);
    // What two copies of an image share tells nothing of where they stand, and few of its matches become points.
    let contents: Vec<ContentHash> =
        features.iter().map(|(at, _)| inputs.hash(&features_role(*at))).collect::<Result<_>>()?;
    let are_copies = |pair: &PairGeometry| contents[pair.first.index()] == contents[pair.second.index()];
    let (pairs, underfoot): (Vec<PairGeometry>, Vec<bool>) =
        pairs.into_iter().zip(underfoot).filter(|(pair, _)| !are_copies(pair)).unzip();
    let assessed = |components: &[Reconstruction]| -> Vec<QualityReport> {
        let report = |at: usize| assess(quality, &components[at], &components[..at], &pairs, &underfoot);
        (0..components.len()).map(report).collect()
    };
    let mut reports = assessed(&output.components);
    if quality.leave_out_misplaced {
        let left_out = leave_out_misplaced(&mut output.components, &reports);
        if !left_out.is_empty() {
            reports = assessed(&output.components);
        }
        output.report.warnings.extend(left_out);
    }
    for (at, report) in reports.into_iter().enumerate() {
        let component = &mut output.components[at];
        output.report.warnings.extend(report.sentences(component));
        output.outvoted.push(report.outvoted);
        output.suspicious.push(report.suspicious);
        output.report.georegistrations.push(input.measured.place(component));
        output.report.warnings.extend(apart(at, component, &output.report.georegistrations));
    }
    Product::new(output)
}

/// Takes out of each component what its report says is misplaced, and says so.
fn leave_out_misplaced(components: &mut Vec<Reconstruction>, reports: &[QualityReport]) -> Vec<String> {
    let mut said = Vec::new();
    for (component, report) in components.iter_mut().zip(reports) {
        let misplaced = report.misplaced(component);
        let name = |image: ImageId| component.images[image.index()].name.as_str();
        said.extend(misplaced.iter().map(|(image, pair)| {
            format!(
                "{} is left out: the {} matches of {} and {} contradict its place, which {} points hold",
                name(*image),
                pair.matches,
                name(pair.first),
                name(pair.second),
                pair.held_by
            )
        }));
        let images: Vec<ImageId> = misplaced.into_keys().collect();
        component.leave_out(&images);
    }
    Reconstruction::largest_first(components);
    said
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
    let images = listed(&images, MOST_NAMED);
    (at > 0).then(|| format!("component {} is apart from the largest, {frame}: {images}", at + 1))
}

/// Stands for an image's name inside models, so that a renamed image leaves them as they are.
fn place_holder(at: usize) -> String {
    format!("⟦{at}⟧")
}

/// The image that a place holder stands for.
pub(super) fn image_of_place_holder(text: &str) -> Option<usize> {
    text.strip_prefix('⟦')?.strip_suffix('⟧')?.parse().ok()
}

/// Which images the numbers of a model's images stand for, as places in the list of images; all its components list the same.
pub(super) fn places_of_images(model: &MapperOutput) -> Vec<usize> {
    let images = model.components.first().map_or(&[][..], |component| &component.images);
    images.iter().map(|image| image_of_place_holder(&image.name).unwrap_or_default()).collect()
}

/// The features of images at these places.
pub(super) fn features_at(inputs: &Inputs<'_, '_>, places: &[usize]) -> Result<Vec<Arc<ImageFeatures>>> {
    places.iter().map(|at| inputs.get(&features_role(*at))).collect()
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
