use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::{Context, Result};
use serde_json::json;
use setloc_camset::{
    AnywhereLocalization, LocalModels, NearestAnywhere, PhotoEvidence, QueryPhoto, Scene, SetLocalization,
    Views, likely_images, locate_set_anywhere, locate_single_anywhere, match_views, nearest_anywhere,
};
use setloc_features::{Camera, ImageFeatures};
use setloc_index::SceneIndex;
use setloc_sfm::{ImageId, MapperOutput, Reconstruction};

use super::features::{accept_features, features_role};
use super::model::{ModelJobs, ModelKind, ModelSource, add_model};
use super::pixels::PicturesAtHand;
use super::{choose_pairs, derived_seed};
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::pictures::PictureBook;
use crate::scene::SceneFile;
use crate::stages;

/// What photos are located in.
#[derive(Debug, Clone)]
pub struct LocateJobs {
    /// The scene.
    pub scene: Arc<SceneFile>,
    /// Where its images are, as far as they are at hand.
    pub pictures: Arc<PictureBook>,
    /// Parameters.
    pub config: Config,
    /// Seed of everything random.
    pub seed: u64,
}

/// The jobs of one set.
#[derive(Debug, Clone)]
pub struct SetJobs {
    /// Features and local model.
    pub model: ModelJobs,
    /// Each photo alone, in the order of the photos.
    pub single: Vec<SingleJobs>,
    /// The set's localization.
    pub set: JobId,
}

/// The jobs of one photo alone.
#[derive(Debug, Clone, Copy)]
pub struct SingleJobs {
    /// The scene points nearest to its features.
    pub nearest: JobId,
    /// Its localization by them.
    pub single: JobId,
}

/// Adds features, matches, local model, localization of each photo alone and of the set; `name` is what its jobs are
/// called, and `alike` are pairs of photos that look alike.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_set(
    graph: &mut JobGraph<'_>,
    name: &str,
    photos: &[SourceImage],
    alike: &[(usize, usize)],
    what: &LocateJobs,
) -> Result<SetJobs> {
    let positions = vec![None; photos.len()];
    let pairs = choose_pairs(&what.config.pairs, &positions, alike);
    let source = ModelSource { images: photos, positions: &positions, pairs: &pairs };
    let model = add_model(graph, ModelKind::Local, name, source, &what.config, what.seed)?;
    let single = add_singles(graph, photos, &model.features, what);
    let listed: Vec<_> = photos.iter().map(|p| json!([p.name, p.camera, p.calibration])).collect();
    let Config { camset, matching, two_view, .. } = &what.config;
    let params = json!({
        "camset": camset, "matching": matching, "two_view": two_view, "seed": what.seed, "photos": listed,
        "pictures": what.pictures.content(),
    });
    let (owned, what_here) = (photos.to_vec(), what.clone());
    let work = move |inputs: &Inputs<'_, '_>| run_set(inputs, &owned, &what_here);
    let set = graph.add(Job {
        kind: "camset",
        version: stages::CAMSET_VERSION,
        name: name.to_owned(),
        params,
        external: BTreeMap::from([("scene".to_owned(), what.scene.content)]),
        memory: (64 << 20) + memory_of_pictures(what),
        work: Box::new(work),
    });
    graph.require(set, "local_model", model.model);
    accept_features(graph, set, &model.features);
    for (at, single) in single.iter().enumerate() {
        single.accepted_by(graph, set, at);
    }
    Ok(SetJobs { model, single, set })
}

/// Of the largest images of the scene that may be looked at together, and of one that is decoded.
fn memory_of_pictures(what: &LocateJobs) -> u64 {
    const BYTES_A_PIXEL: u64 = 16;
    let pixels = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
    let largest = what.scene.components.iter().flat_map(|model| &model.cameras).map(pixels).max();
    if what.pictures.is_empty() { 0 } else { BYTES_A_PIXEL * largest.unwrap_or(0) }
}

fn run_set(inputs: &Inputs<'_, '_>, photos: &[SourceImage], what: &LocateJobs) -> Result<Product> {
    let model = inputs.get::<MapperOutput>("local_model")?;
    let (mut features, mut alone) = (Vec::new(), Vec::new());
    for (at, photo) in photos.iter().enumerate() {
        // The local model has the same images in the same order: those whose features exist.
        let Some(found) = inputs.find::<ImageFeatures>(&features_role(at))? else { continue };
        features.push((photo, found));
        alone.push(alone_of(inputs, at).with_context(|| format!("{} was not located alone", photo.name))?);
    }
    let alone: Vec<_> = alone.iter().map(|(found, nearest)| (&**found, &**nearest)).collect();
    let queries: Vec<QueryPhoto<'_>> =
        features.iter().map(|(photo, features)| query(photo, features)).collect();
    let photos: Vec<&SourceImage> = features.iter().map(|(photo, _)| *photo).collect();
    let empty = EmptyScene::default();
    let components = components_of(&what.scene, &empty);
    let at_hand = PicturesAtHand::new(&what.pictures, &photos);
    let pictures = at_hand.of(&components);
    let seed = derived_seed(what.seed, &["camset"]);
    let views = |scene: &Scene<'_>, alone: &[PhotoEvidence<'_>]| -> Result<Views> {
        let likely = likely_images(scene, alone, what.config.camset.views.max_images);
        let read = |image: usize| match likely.binary_search(&ImageId(image as u32)) {
            Ok(_) => what.scene.features_of(ImageId(image as u32)),
            Err(_) => Ok(None),
        };
        let features = (0..scene.reconstruction.images.len()).map(read).collect::<Result<Vec<_>>>()?;
        let pairs = (&what.config.matching, &what.config.two_view);
        Ok(match_views(&what.config.camset.views, pairs, scene, features, &likely, &queries, seed))
    };
    let models = LocalModels {
        components: &model.components,
        open: &model.open_pairs,
        outvoted: &model.outvoted,
        pictures: Some(&pictures),
    };
    let params = &what.config.camset;
    let mut located: SetLocalization =
        locate_set_anywhere(params, &components, &queries, &alone, models, views, seed)?;
    let failures = at_hand.failures();
    let is_whole = failures.is_empty();
    located.advice.extend(failures);
    let product = Product::new(located)?;
    // What an image was is in the job's key, not what it is now.
    Ok(if is_whole { product } else { product.for_this_run_only() })
}

/// Adds the localization of each photo alone, from its features.
pub fn add_singles(
    graph: &mut JobGraph<'_>,
    photos: &[SourceImage],
    features: &[JobId],
    what: &LocateJobs,
) -> Vec<SingleJobs> {
    photos.iter().zip(features).map(|(photo, features)| add_single(graph, photo, *features, what)).collect()
}

fn add_single(
    graph: &mut JobGraph<'_>,
    photo: &SourceImage,
    features: JobId,
    what: &LocateJobs,
) -> SingleJobs {
    let scene = BTreeMap::from([("scene".to_owned(), what.scene.content)]);
    let of_scene = Arc::clone(&what.scene);
    let work = move |inputs: &Inputs<'_, '_>| {
        let features = inputs.get::<ImageFeatures>("features")?;
        let empty = EmptyScene::default();
        Product::new(nearest_anywhere(&components_of(&of_scene, &empty), &features))
    };
    let nearest = graph.add(Job {
        kind: "nearest",
        version: stages::NEAREST_VERSION,
        name: photo.name.clone(),
        params: json!({}),
        external: scene.clone(),
        memory: 32 << 20,
        work: Box::new(work),
    });
    graph.require(nearest, "features", features);
    let camera = json!([photo.name, photo.camera, photo.calibration]);
    let params = json!({ "single": what.config.single, "seed": what.seed, "photo": camera });
    let (owned, what_here) = (photo.clone(), what.clone());
    let work = move |inputs: &Inputs<'_, '_>| {
        let features = inputs.get::<ImageFeatures>("features")?;
        let nearest = inputs.get::<NearestAnywhere>("nearest")?;
        let empty = EmptyScene::default();
        let components = components_of(&what_here.scene, &empty);
        let seed = derived_seed(what_here.seed, &["single", &owned.hash.to_string()]);
        let (params, photo) = (&what_here.config.single, query(&owned, &features));
        Product::new(locate_single_anywhere(params, &components, &photo, &nearest, seed))
    };
    let single = graph.add(Job {
        kind: "single",
        version: stages::SINGLE_VERSION,
        name: photo.name.clone(),
        params,
        external: scene,
        memory: 32 << 20,
        work: Box::new(work),
    });
    graph.require(single, "features", features);
    graph.require(single, "nearest", nearest);
    SingleJobs { nearest, single }
}

impl SingleJobs {
    /// Lets a job use what they make of a photo, if they do.
    pub(super) fn accepted_by(self, graph: &mut JobGraph<'_>, job: JobId, photo: usize) {
        graph.accept(job, single_role(photo), self.single);
        graph.accept(job, nearest_role(photo), self.nearest);
    }
}

/// What the jobs of a photo alone made of it.
pub(super) fn alone_of(
    inputs: &Inputs<'_, '_>,
    photo: usize,
) -> Result<(Arc<AnywhereLocalization>, Arc<NearestAnywhere>)> {
    Ok((inputs.get(&single_role(photo))?, inputs.get(&nearest_role(photo))?))
}

fn single_role(photo: usize) -> String {
    format!("single {photo:04}")
}

fn nearest_role(photo: usize) -> String {
    format!("nearest {photo:04}")
}

pub(super) fn query<'a>(photo: &'a SourceImage, features: &'a ImageFeatures) -> QueryPhoto<'a> {
    QueryPhoto { name: &photo.name, camera: &photo.camera, calibration: photo.calibration, features }
}

/// Stands for the largest component where there is none.
pub(super) type EmptyScene = (Reconstruction, SceneIndex);

/// The components of a scene, at least one.
pub(super) fn components_of<'a>(scene: &'a SceneFile, empty: &'a EmptyScene) -> Vec<Scene<'a>> {
    let component = |(component, (reconstruction, index))| Scene {
        component,
        is_placed: scene.is_placed(component),
        reconstruction,
        index,
        // Only the largest grows.
        grown: if component == 0 { &scene.grown } else { &[] },
        doubtful: scene.doubtful.get(component).map_or(&[], Vec::as_slice),
        errors: scene.errors.get(component).and_then(Option::as_ref),
    };
    let mut components: Vec<Scene<'a>> =
        scene.components.iter().zip(&scene.indices).enumerate().map(component).collect();
    if components.is_empty() {
        components.push(component((0, (&empty.0, &empty.1))));
    }
    components
}

/// The largest component of a scene.
pub(super) fn main_of<'a>(scene: &'a SceneFile, empty: &'a EmptyScene) -> Scene<'a> {
    components_of(scene, empty)[0]
}
