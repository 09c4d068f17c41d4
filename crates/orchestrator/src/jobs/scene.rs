use std::collections::{BTreeMap, BTreeSet};

use anyhow::Result;
use rayon::prelude::*;
use serde_json::json;
use setloc_features::{GeoPosition, ImageFeatures, Wgs84};
use setloc_index::SceneIndex;
use setloc_sfm::{
    ImageId, MapperOutput, MeasuredPosition, MergeRecord, ModelErrors, Reconstruction, ReconstructionImage,
    doubtful_images,
};

use super::accuracy::{Accuracy, first_of};
use super::choose_pairs;
use super::features::features_role;
use super::model::{ModelJobs, ModelKind, ModelSource, add_model, image_of_place_holder, with_names};
use super::positions::{self, Fix};
use crate::artifacts::{LeftApart, SceneIndices};
use crate::codec::Artifact;
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::scene::{Block, NO_ALTITUDE, SceneFile, has_altitude};
use crate::stages;

/// The jobs of a scene.
#[derive(Debug, Clone)]
pub struct SceneJobs {
    /// One job an image, in the order of the images given.
    pub features: Vec<JobId>,
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

fn add_ordered_model(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    alike: &[(usize, usize)],
    config: &Config,
    seed: u64,
) -> Result<OrderedModel> {
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

/// Adds all jobs from image files to the model that tells guessed cameras; `alike` are pairs of images that look alike.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_first_model(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    alike: &[(usize, usize)],
    config: &Config,
    seed: u64,
) -> Result<SceneModelJobs> {
    // Cameras need no better points than those of the keypoints.
    let model = add_mapped_model(graph, images, alike, config, seed)?;
    graph.want(model.model);
    Ok(model)
}

/// Adds all jobs from image files to a model that is not aligned.
fn add_mapped_model(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    alike: &[(usize, usize)],
    config: &Config,
    seed: u64,
) -> Result<SceneModelJobs> {
    let mut config = config.clone();
    config.alignment.enabled = false;
    let OrderedModel { jobs, order, .. } = add_ordered_model(graph, images, alike, &config, seed)?;
    Ok(SceneModelJobs { model: jobs.mapped, order })
}

/// Adds all jobs from image files to what the model of a scene leaves apart.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_model_apart(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    alike: &[(usize, usize)],
    config: &Config,
    seed: u64,
) -> Result<ApartJob> {
    let SceneModelJobs { model, order } = add_mapped_model(graph, images, alike, config, seed)?;
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
    let pairs = pairs_of(num_images);
    let Some(largest) = model.components.first() else {
        return LeftApart { images: (0..num_images as u32).collect(), known_pairs, pairs };
    };
    // All components list the same images, those that have features.
    let apart = largest.images.iter().filter(|image| image.world_from_camera.is_none());
    let place = |image: &ReconstructionImage| Some(image_of_place_holder(&image.name)? as u32);
    LeftApart { images: apart.filter_map(place).collect(), known_pairs, pairs }
}

/// Adds all jobs from image files to a scene file; `alike` are pairs of images that look alike.
///
/// # Errors
/// When parameters have no JSON form.
pub fn add_scene(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    alike: &[(usize, usize)],
    config: &Config,
    seed: u64,
) -> Result<SceneJobs> {
    let OrderedModel { jobs, images, order, origin } = add_ordered_model(graph, images, alike, config, seed)?;
    let measured = jobs.measured;
    let apart = add_left_apart(graph, jobs.mapped, order);
    let index_params = config.index.clone();
    let index_work = move |inputs: &Inputs<'_, '_>| {
        let output = inputs.get::<MapperOutput>("model")?;
        let mut features = Vec::new();
        // All components list the same images.
        for image in output.components.first().iter().flat_map(|model| &model.images) {
            let at = image_of_place_holder(&image.name).unwrap_or_default();
            features.push(inputs.get::<ImageFeatures>(&features_role(at))?);
        }
        let features: Vec<&ImageFeatures> = features.iter().map(|features| &**features).collect();
        let index = |model| SceneIndex::build(&index_params, model, &features);
        Product::new(SceneIndices(output.components.iter().map(index).collect()))
    };
    let index = graph.add(Job {
        kind: "index",
        version: stages::INDEX_VERSION,
        name: "scene".to_owned(),
        params: serde_json::to_value(&config.index)?,
        external: BTreeMap::new(),
        memory: 64 << 20,
        work: Box::new(index_work),
    });
    graph.require(index, "model", jobs.model);
    for (at, features) in jobs.features.iter().enumerate() {
        graph.accept(index, features_role(at), *features);
    }
    let names: Vec<String> = images.iter().map(|image| image.name.clone()).collect();
    let config = config.scene_toml()?;
    let has_altitudes = measured.positions.iter().flatten().any(|position| position.has_height);
    let mut params = json!({ "names": names, "origin": origin, "config": config });
    if origin.is_some() {
        params["positions"] = json!([measured.positions, measured.params]);
    }
    let scene_work = move |inputs: &Inputs<'_, '_>| {
        let output = inputs.get::<MapperOutput>("model")?;
        let indices = inputs.get::<SceneIndices>("index")?;
        let ((components, copy), features) = rayon::join(
            || {
                (
                    output.components.iter().map(|model| named(model, &names)).collect::<Vec<_>>(),
                    indices.0.clone(),
                )
            },
            || features_of_registered(inputs, &output),
        );
        let features = features?;
        let made_by = ContentHash::of(&stages::SCENE_VERSION.to_le_bytes());
        let mut content = vec![inputs.hash("model")?, inputs.hash("index")?, made_by];
        for image in output.components.iter().take(1).flat_map(|model| &model.images) {
            let at = image_of_place_holder(&image.name).unwrap_or_default();
            content.push(inputs.hash(&features_role(at))?);
        }
        let recall = worst_recall(&indices.0);
        let georegistrations = || output.report.georegistrations.iter().map(Option::is_some);
        let origin = origin.filter(|_| georegistrations().next() == Some(true));
        let origin = origin.map(|at| if has_altitudes { at } else { Wgs84 { alt: NO_ALTITUDE, ..at } });
        let fixes = fixes_of(&output, &measured.positions);
        let contradicted: Vec<String> = (output.components.iter())
            .zip(&output.report.georegistrations)
            .flat_map(|(component, placed)| measured.warnings(component, placed.as_ref()))
            .collect();
        let listed = names.len();
        let relative = origin.filter(|origin| !has_altitude(*origin)).map(|_| {
            "the measured positions have no altitudes: heights are relative, and left out where WGS84 is told".to_owned()
        });
        let doubtful: Vec<Vec<ImageId>> = (output.components.iter().zip(&output.outvoted))
            .map(|(component, outvoted)| doubtful_images(component, outvoted))
            .collect();
        let doubts: Vec<String> = components
            .iter()
            .zip(&doubtful)
            .filter_map(|(component, images)| doubt(component, images))
            .collect();
        let errors: Vec<Option<ModelErrors>> = (output.components.iter())
            .zip(&output.report.georegistrations)
            .map(|(component, placed)| {
                let positions = measured.for_adjustment(component, placed.as_ref());
                ModelErrors::of_model(component, positions.as_ref())
            })
            .collect();
        let is_placed = georegistrations().next() == Some(true) && origin.is_some();
        let unit = if is_placed { " m" } else { "" };
        let accuracies: Vec<Option<Accuracy>> = (output.components.iter().zip(&errors))
            .map(|(model, errors)| Accuracy::of_model(model, errors.as_ref()?))
            .collect();
        let of_largest = accuracies.first().and_then(Option::as_ref);
        let accuracy = of_largest.and_then(|accuracy| accuracy.note(&names, unit));
        let weak: Vec<String> =
            accuracies.iter().flatten().filter_map(|accuracy| accuracy.warning(&names)).collect();
        let notes_of_errors: Vec<String> = errors.iter().enumerate().filter_map(shared_errors_note).collect();
        let stretches: Vec<String> = output.components.iter().enumerate().filter_map(stretch_note).collect();
        let lengths: Vec<String> = (output.components.iter().enumerate())
            .filter_map(|numbered| lengths_note(numbered, &names))
            .collect();
        Product::new(SceneFile {
            components,
            indices: copy,
            doubtful,
            errors,
            placed: georegistrations().map(|is_placed| is_placed && origin.is_some()).collect(),
            features,
            origin,
            warnings: (output.report.warnings.iter().chain(&contradicted))
                .map(|text| with_names(text, &names))
                .chain(doubts)
                .chain(weak)
                .chain(recall.as_ref().filter(|recall| recall.share < MIN_RECALL).map(Recall::warning))
                .chain(fixes.as_deref().and_then(positions::warning))
                .collect(),
            notes: (output.report.merges.iter().filter_map(MergeRecord::sentence))
                .chain(recall.as_ref().map(Recall::note))
                .chain(fixes.as_deref().map(|fixes| positions::note(fixes, listed)))
                .chain(relative)
                .chain(accuracy)
                .chain(lengths)
                .chain(stretches)
                .chain(notes_of_errors)
                .collect(),
            config: config.clone(),
            grown: Vec::new(),
            grown_from: Vec::new(),
            content: ContentHash::of_all(&content),
        })
    };
    let scene = graph.add(Job {
        kind: "scene",
        version: stages::SCENE_VERSION,
        name: "scene".to_owned(),
        params,
        external: BTreeMap::new(),
        memory: 64 << 20,
        work: Box::new(scene_work),
    });
    graph.require(scene, "model", jobs.model);
    graph.require(scene, "index", index);
    for (at, features) in jobs.features.iter().enumerate() {
        graph.accept(scene, features_role(at), *features);
    }
    let mut features = jobs.features.clone();
    for (&at, &job) in apart.order.iter().zip(&jobs.features) {
        features[at] = job;
    }
    let finishing = if jobs.model == jobs.mapped { index } else { jobs.model };
    Ok(SceneJobs { features, model: jobs.model, apart, scene, finishing })
}

/// Which component a note is of, unless it is the largest.
fn of_component(component: usize) -> String {
    if component == 0 { String::new() } else { format!(" in component {}", component + 1) }
}

/// Says by how much panoramas of a component are stretched, if any are.
fn stretch_note((component, model): (usize, &Reconstruction)) -> Option<String> {
    let used = model.registered().map(|image| model.camera_of(image).largest_stretch());
    let percent = 100.0 * used.fold(0.0, f64::max);
    (percent > 0.0).then(|| {
        format!(
            "the panoramas{} stretch or twist directions by up to {percent:.2} % (stitching, lenses), which is taken out \
             (sfm.calibrate_panoramas)",
            of_component(component)
        )
    })
}

/// Says which distances between images of a component no point tells, where there are any.
fn lengths_note((component, model): (usize, &Reconstruction), names: &[String]) -> Option<String> {
    let percents = || model.lengths.iter().map(|length| 100.0 * length.deviation);
    let (least, most) = (percents().reduce(f64::min)?, percents().reduce(f64::max)?);
    let steps: Vec<String> = (model.lengths.iter())
        .map(|length| format!("{} from {}", names[length.to.index()], names[length.from.index()]))
        .collect();
    Some(format!(
        "distances{} rest on what lies beside the points of one pair and on the floor, not on points that a third \
         image sees (± {least:.0} to {most:.0} %): {}",
        of_component(component),
        first_of(steps, MAX_STEPS_NAMED)
    ))
}

/// Steps that are named where a note is of many.
const MAX_STEPS_NAMED: usize = 5;

/// Says what errors the images of a component share, where any are told.
fn shared_errors_note((component, errors): (usize, &Option<ModelErrors>)) -> Option<String> {
    let degrees = errors.as_ref()?.shared_sigma_rad().to_degrees();
    let of_component = of_component(component);
    (degrees > 0.0).then(|| {
        format!(
            "neighbouring bearings of an image{of_component} are off together by {degrees:.3}° (stitching, lenses), which \
             covariances of photos have in them"
        )
    })
}

/// Says what images about which a model may be folded mean for photos.
fn doubt(component: &Reconstruction, images: &[ImageId]) -> Option<String> {
    let names: Vec<&str> = images.iter().map(|image| component.images[image.index()].name.as_str()).collect();
    (!names.is_empty()).then(|| {
        format!("photos of what {} show will be uncertain: the model may be folded there", names.join(", "))
    })
}

/// The measured images of the largest component, where they place it.
fn fixes_of(output: &MapperOutput, measured: &[Option<MeasuredPosition>]) -> Option<Vec<Fix>> {
    let placed = output.report.georegistrations.first()?.as_ref()?;
    Some(positions::fixes(output.components.first()?, placed, measured))
}

/// Keypoints of an image that go into the scene file, of the bright and of the dark; twice as many cost 200
/// panoramas 60 MB more.
pub(super) const KEPT_FEATURES: usize = 1024;

/// The strongest features of the images that a component has registered, as blocks.
fn features_of_registered(inputs: &Inputs<'_, '_>, output: &MapperOutput) -> Result<Vec<Block>> {
    let Some(main) = output.components.first() else { return Ok(Vec::new()) };
    let registered: BTreeSet<ImageId> =
        output.components.iter().flat_map(Reconstruction::registered).collect();
    let block = |id: ImageId| {
        let name = &main.images[id.index()].name;
        let Some(at) = image_of_place_holder(name).filter(|_| registered.contains(&id)) else {
            return Ok(Block::default());
        };
        let features = inputs.get::<ImageFeatures>(&features_role(at))?;
        let mut block = Block::default();
        features.strongest(KEPT_FEATURES).write_payload(&mut block.0)?;
        Ok(block)
    };
    // Tens of megabytes are touched first here: on all cores.
    let images = (0..main.images.len() as u32).into_par_iter().with_max_len(1).map(ImageId);
    let blocks: Vec<Result<Block>> = images.map(block).collect();
    blocks.into_iter().collect()
}

/// Share of the nearest scene points below which an index is said to miss too many.
const MIN_RECALL: f64 = 0.95;

/// The share of the nearest scene points that an index finds.
struct Recall {
    share: f64,
    /// What it is of, in words.
    index: String,
}

/// The poorest recall of some components' indices; `None` where all are exact.
fn worst_recall(indices: &[SceneIndex]) -> Option<Recall> {
    let measured = indices.iter().enumerate().filter_map(|(at, index)| Some((at, index.recall()?)));
    let (at, share) = measured.min_by(|(_, a), (_, b)| a.total_cmp(b))?;
    let index = match indices.len() {
        1 => "the index".to_owned(),
        count => format!("the index of component {}, the poorest of {count},", at + 1),
    };
    Some(Recall { share, index })
}

impl Recall {
    fn note(&self) -> String {
        format!(
            "{} finds {:.1} % of the nearest scene points (asked for the scene's own descriptors)",
            self.index,
            100.0 * self.share
        )
    }

    fn warning(&self) -> String {
        format!(
            "{} misses {:.1} % of the nearest scene points: raise `index.max_candidates` or choose another \
             `index.backend`",
            self.index,
            100.0 * (1.0 - self.share)
        )
    }
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

/// The model with the images' names in place of the place holders.
fn named(model: &Reconstruction, names: &[String]) -> Reconstruction {
    let mut model = model.clone();
    for image in &mut model.images {
        image.name = with_names(&image.name, names);
    }
    // Where pixels show the points has done its part: it placed the points.
    for point in &mut model.points {
        point.aligned = None;
    }
    model
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

    #[test]
    fn a_wrong_position_hardly_moves_the_origin_nor_does_the_date_line() {
        let image = |(lat_deg, lon_deg, alt_m): (f64, f64, Option<f64>)| SourceImage {
            name: String::new(),
            path: PathBuf::new(),
            hash: ContentHash::of(b""),
            camera: Camera::equirectangular(20, 10),
            calibration: Calibration::Known,
            camera_origin: CameraOrigin::Listed,
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
