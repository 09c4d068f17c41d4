use std::collections::BTreeMap;

use anyhow::Result;
use serde_json::json;
use setloc_features::{GeoPosition, ImageFeatures, Wgs84};
use setloc_index::SceneIndex;
use setloc_sfm::{MapperOutput, MeasuredPosition, ReconstructionImage};

use super::choose_pairs;
use super::features::accept_features;
use super::model::{
    ModelJobs, ModelKind, ModelSource, accept_verified, add_model, features_at, image_of_place_holder,
    places_of_images,
};
use super::scene_file::SceneRecipe;
use crate::artifacts::{LeftApart, SceneIndices};
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::stages;

/// What a scene is mapped from, and how.
#[derive(Debug, Clone, Copy)]
pub struct SceneInputs<'a> {
    /// The images.
    pub images: &'a [SourceImage],
    /// Pairs of images that look alike, as places in `images`.
    pub alike: &'a [(usize, usize)],
    /// All parameters.
    pub config: &'a Config,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// The jobs of a scene.
#[derive(Debug, Clone)]
pub struct SceneJobs {
    /// One job an image, in the order of the images given.
    pub features: Vec<JobId>,
    /// What tells what moves with the cameras of photos.
    pub carried: Vec<JobId>,
    /// The job whose result the model is.
    pub model: JobId,
    /// What the model leaves apart.
    pub apart: ApartJob,
    /// The scene file.
    pub scene: JobId,
    /// The first job after the model is mapped.
    finishing: JobId,
}

impl SceneJobs {
    /// Leaves the model as it is mapped, without alignment and scene, unless what it leaves apart is such.
    pub fn finish_only_where<'a>(
        &self,
        graph: &mut JobGraph<'a>,
        stays: impl Fn(&LeftApart) -> bool + Send + Sync + 'a,
    ) {
        graph.run_only_where(self.finishing, self.apart.job, stays);
    }
}

/// The job that says which images a model leaves out of its largest component.
#[derive(Debug, Clone)]
pub struct ApartJob {
    /// The job.
    pub job: JobId,
    /// The model's images, in its order, as places in the list of the images given.
    order: Vec<usize>,
}

impl ApartJob {
    /// The images given, those to be looked at once more that the model leaves apart.
    pub fn looked_at_again(&self, images: &[SourceImage], left: &LeftApart) -> Vec<SourceImage> {
        let mut images = images.to_vec();
        for at in left.images.iter().filter_map(|&at| self.order.get(at as usize)) {
            images[*at].second_look = true;
        }
        images
    }
}

/// The jobs of a scene's model alone.
#[derive(Debug, Clone)]
pub struct SceneModelJobs {
    /// The job whose result the model is.
    pub model: JobId,
    /// The model's images, in its order, as places in the list of the images given.
    order: Vec<usize>,
}

impl SceneModelJobs {
    /// Which of the images given an image of the model is.
    pub fn image_given(&self, image: &ReconstructionImage) -> Option<usize> {
        self.order.get(image_of_place_holder(&image.name)?).copied()
    }
}

/// A model whose images are in the order of their content.
struct OrderedModel {
    jobs: ModelJobs,
    images: Vec<SourceImage>,
    /// Where these are in the list of the images given.
    order: Vec<usize>,
    origin: Option<Wgs84>,
}

fn add_ordered_model(graph: &mut JobGraph<'_>, inputs: SceneInputs<'_>) -> Result<OrderedModel> {
    let SceneInputs { images, alike, config, seed } = inputs;
    let origin = origin_of(images);
    let position = |image: &SourceImage| {
        let (place, origin) = (image.position?, origin?);
        let enu = place.or_at(origin.alt).to_enu(origin);
        Some(MeasuredPosition { enu, has_height: place.alt_m.is_some() })
    };
    let listed: Vec<Option<MeasuredPosition>> = images.iter().map(position).collect();
    let (order, pairs) = by_content(images, &choose_pairs(&config.pairs, &listed, alike));
    let images: Vec<SourceImage> = order.iter().map(|&at| images[at].clone()).collect();
    let positions: Vec<Option<MeasuredPosition>> = order.iter().map(|&at| listed[at]).collect();
    let source = ModelSource { images: &images, positions: &positions, pairs: &pairs };
    let jobs = add_model(graph, ModelKind::Scene, "scene", source, config, seed)?;
    Ok(OrderedModel { jobs, images, order, origin })
}

/// Adds all jobs from image files to the model that tells guessed cameras.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_first_model(graph: &mut JobGraph<'_>, inputs: SceneInputs<'_>) -> Result<SceneModelJobs> {
    // Cameras need no better points than those of the keypoints.
    let model = add_mapped_model(graph, inputs)?;
    graph.want(model.model);
    Ok(model)
}

/// Adds all jobs from image files to a model that is not aligned.
fn add_mapped_model(graph: &mut JobGraph<'_>, inputs: SceneInputs<'_>) -> Result<SceneModelJobs> {
    let mut config = inputs.config.clone();
    config.alignment.enabled = false;
    let inputs = SceneInputs { config: &config, ..inputs };
    let OrderedModel { jobs, order, .. } = add_ordered_model(graph, inputs)?;
    Ok(SceneModelJobs { model: jobs.mapped, order })
}

/// Adds all jobs from image files to what the model of a scene leaves apart.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_model_apart(graph: &mut JobGraph<'_>, inputs: SceneInputs<'_>) -> Result<ApartJob> {
    let SceneModelJobs { model, order } = add_mapped_model(graph, inputs)?;
    Ok(add_left_apart(graph, model, order))
}

/// Adds the job that says which images a model leaves apart: before it is aligned, which joins no parts.
fn add_left_apart(graph: &mut JobGraph<'_>, model: JobId, order: Vec<usize>) -> ApartJob {
    let num_images = order.len();
    let work = move |inputs: &Inputs<'_, '_>| {
        let model = inputs.get::<MapperOutput>("model")?;
        Product::new(left_apart(&model, num_images))
    };
    let left_apart = graph.add(Job {
        kind: "left_apart",
        version: stages::LEFT_APART_VERSION,
        name: "scene".to_owned(),
        params: json!({ "images": num_images }),
        external: BTreeMap::new(),
        memory: 1 << 20,
        work: Box::new(work),
    });
    graph.require(left_apart, "model", model);
    ApartJob { job: left_apart, order }
}

/// What a model of so many images leaves apart; of a model without components that is everything.
fn left_apart(model: &MapperOutput, num_images: usize) -> LeftApart {
    let pairs_of = |images: usize| (images * images.saturating_sub(1) / 2) as u64;
    let known_pairs = model.components.iter().map(|component| pairs_of(component.registered().count())).sum();
    let Some(largest) = model.components.first() else {
        let pairs = pairs_of(num_images);
        return LeftApart { images: (0..num_images as u32).collect(), known_pairs, pairs };
    };
    // All components list the same images, those that have features: others cannot come together with any.
    let pairs = pairs_of(largest.images.len());
    let apart = largest.images.iter().filter(|image| image.world_from_camera.is_none());
    let place = |image: &ReconstructionImage| Some(image_of_place_holder(&image.name)? as u32);
    LeftApart { images: apart.filter_map(place).collect(), known_pairs, pairs }
}

/// Adds all jobs from image files to a scene file.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_scene(graph: &mut JobGraph<'_>, inputs: SceneInputs<'_>) -> Result<SceneJobs> {
    let OrderedModel { jobs, images, order, origin } = add_ordered_model(graph, inputs)?;
    let apart = add_left_apart(graph, jobs.mapped, order);
    let index = add_index(graph, inputs.config, &jobs)?;
    let recipe = SceneRecipe {
        names: images.into_iter().map(|image| image.name).collect(),
        origin,
        measured: jobs.measured.clone(),
        pairs: jobs.pairs.clone(),
        config: inputs.config.scene_toml()?,
    };
    let scene = add_scene_file(graph, recipe, &jobs, index);
    let mut features = jobs.features.clone();
    for (&at, &job) in apart.order.iter().zip(&jobs.features) {
        features[at] = job;
    }
    let finishing = if jobs.model == jobs.mapped { index } else { jobs.model };
    Ok(SceneJobs { features, carried: jobs.carried, model: jobs.model, apart, scene, finishing })
}

/// Adds the job that indexes the components of a model.
fn add_index(graph: &mut JobGraph<'_>, config: &Config, jobs: &ModelJobs) -> Result<JobId> {
    let params = config.index.clone();
    let work = move |inputs: &Inputs<'_, '_>| {
        let output = inputs.get::<MapperOutput>("model")?;
        let features = features_at(inputs, &places_of_images(&output))?;
        let features: Vec<&ImageFeatures> = features.iter().map(|features| &**features).collect();
        let index = |model| SceneIndex::build(&params, model, &features);
        Product::new(SceneIndices(output.components.iter().map(index).collect()))
    };
    let index = graph.add(Job {
        kind: "index",
        version: stages::INDEX_VERSION,
        name: "scene".to_owned(),
        params: serde_json::to_value(&config.index)?,
        external: BTreeMap::new(),
        memory: 64 << 20,
        work: Box::new(work),
    });
    graph.require(index, "model", jobs.model);
    accept_features(graph, index, &jobs.features);
    Ok(index)
}

/// Adds the job that makes the scene file of a model and its index.
/// Kind of the job that makes a scene's file.
pub const SCENE_KIND: &str = "scene";

fn add_scene_file(graph: &mut JobGraph<'_>, recipe: SceneRecipe, jobs: &ModelJobs, index: JobId) -> JobId {
    let params = recipe.params();
    let scene = graph.add(Job {
        kind: SCENE_KIND,
        version: stages::SCENE_VERSION,
        name: "scene".to_owned(),
        params,
        external: BTreeMap::new(),
        memory: 64 << 20,
        work: Box::new(move |inputs: &Inputs<'_, '_>| Product::new(recipe.make(inputs)?)),
    });
    graph.require(scene, "model", jobs.model);
    graph.require(scene, "index", index);
    accept_features(graph, scene, &jobs.features);
    accept_verified(graph, scene, &jobs.pairs);
    scene
}

/// The images in the order of their content (their numbers in it), and the pairs as places in that order.
///
/// Whatever an image is called, the model gets the same input.
fn by_content(images: &[SourceImage], pairs: &[(usize, usize)]) -> (Vec<usize>, Vec<(usize, usize)>) {
    let mut order: Vec<usize> = (0..images.len()).collect();
    order.sort_by_key(|&at| (images[at].hash, at));
    let mut place = vec![0; images.len()];
    for (rank, &at) in order.iter().enumerate() {
        place[at] = rank;
    }
    let mut pairs: Vec<(usize, usize)> =
        pairs.iter().map(|&(a, b)| (place[a].min(place[b]), place[a].max(place[b]))).collect();
    pairs.sort_unstable();
    (order, pairs)
}

/// The middle of the measured positions, coordinate by coordinate: a wrong one hardly moves it.
fn origin_of(images: &[SourceImage]) -> Option<Wgs84> {
    let places: Vec<GeoPosition> = images.iter().filter_map(|image| image.position).collect();
    let first = places.first()?.lon_deg;
    // About the first, across the date line too.
    let from_first = |place: &GeoPosition| about_zero(place.lon_deg - first);
    Some(Wgs84 {
        lat: middle(places.iter().map(|place| place.lat_deg))?,
        lon: about_zero(middle(places.iter().map(from_first))? + first),
        alt: middle(places.iter().filter_map(|place| place.alt_m)).unwrap_or(0.0),
    })
}

/// The same angle within 180 degrees of zero.
fn about_zero(degrees: f64) -> f64 {
    (degrees + 180.0).rem_euclid(360.0) - 180.0
}

/// The lower median.
fn middle(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let at = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(at, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use setloc_features::{Calibration, Camera};

    use super::*;
    use crate::dataset::CameraOrigin;
    use crate::fingerprint::ContentHash;

    #[test]
    fn a_wrong_position_hardly_moves_the_origin_nor_does_the_date_line() {
        let image = |(lat_deg, lon_deg, alt_m): (f64, f64, Option<f64>)| SourceImage {
            name: String::new(),
            path: PathBuf::new(),
            hash: ContentHash::of(b""),
            camera: Camera::equirectangular(20, 10),
            calibration: Calibration::Known,
            camera_origin: CameraOrigin::Listed,
            other_projection: None,
            position: Some(GeoPosition { lat_deg, lon_deg, alt_m }),
            mask: None,
            second_look: false,
        };
        let places = [
            (-17.0, 179.999, Some(12.0)),
            (-17.001, -179.999, None),
            (0.0, 0.0, Some(0.0)),
            (-17.002, 179.9995, Some(13.0)),
            (-17.001, 180.0005, None),
        ];
        let origin = origin_of(&places.map(image)).unwrap();
        assert!((origin.lat + 17.001).abs() < 1e-9 && origin.alt == 12.0, "{origin:?}");
        assert!(about_zero(origin.lon - 180.0).abs() < 0.0011, "{origin:?}");
        assert_eq!(origin_of(&[]), None);
    }
}
