use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use serde_json::json;
use setloc_camset::{Growth, GrowthPhoto, PhotoEvidence, PhotoLocalization, SetLocalization, grow};
use setloc_features::ImageFeatures;
use setloc_index::IndexParams;
use setloc_sfm::MapperOutput;

use super::features::{accept_features, features_role};
use super::locate::{EmptyScene, LocateJobs, SetJobs, SingleJobs, alone_of, main_of, query};
use super::scene_file::KEPT_FEATURES;
use crate::codec::{self, Artifact};
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::locating::best_answers;
use crate::scene::{Block, SceneFile};
use crate::stages;

/// Kind of the job that makes the file of a scene that has grown.
pub const GROWN_KIND: &str = "grown";
/// What the file of the scene before is to that job.
pub const SCENE_INPUT: &str = "scene";

/// The jobs that located photos.
#[derive(Debug, Clone)]
pub struct LocatedJobs {
    /// Features, in the order of the photos.
    pub features: Vec<JobId>,
    /// Each photo alone, in the same order.
    pub single: Vec<SingleJobs>,
    /// The set, where it was tried.
    pub set: Option<SetJobs>,
}

/// Adds what localized photos add to the scene, and the scene that has grown; `alone` says whether what is known of
/// photos alone counts beside their set.
///
/// # Errors
/// When the scene or parameters cannot be encoded.
pub fn add_grown(
    graph: &mut JobGraph<'_>,
    name: &str,
    photos: &[SourceImage],
    located: &LocatedJobs,
    alone: bool,
    what: &LocateJobs,
) -> Result<JobId> {
    let Config { camset, growth, .. } = &what.config;
    let listed: Vec<_> = photos.iter().map(|p| json!([p.name, p.hash, p.camera, p.calibration])).collect();
    let known = &what.scene.grown_from;
    let params =
        json!({ "growth": growth, "camset": camset, "alone": alone, "photos": listed, "known": known });
    let (owned, what_here, as_set) = (photos.to_vec(), what.clone(), located.set.is_some());
    let growth = graph.add(Job {
        kind: "growth",
        version: stages::GROW_VERSION,
        name: name.to_owned(),
        params,
        external: BTreeMap::from([("scene".to_owned(), what.scene.content)]),
        memory: 64 << 20,
        work: Box::new(move |inputs| Product::new(growth_of(inputs, &owned, (alone, as_set), &what_here)?)),
    });
    if let Some(set) = &located.set {
        graph.require(growth, "set", set.set);
        graph.require(growth, "local_model", set.model.model);
    }
    let (names, index) = (names_of(photos, &what.scene), index_params(&what.scene)?);
    let params = json!({ "names": names, "index": index });
    // Beside what localization depends on, the file has names, warnings and components of its own.
    let whole = ContentHash::of(&codec::encode(&*what.scene)?);
    let (owned, scene) = (photos.to_vec(), Arc::clone(&what.scene));
    let grown = graph.add(Job {
        kind: GROWN_KIND,
        version: stages::GROWN_VERSION,
        name: name.to_owned(),
        params,
        external: BTreeMap::from([(SCENE_INPUT.to_owned(), whole)]),
        memory: 128 << 20,
        work: Box::new(move |inputs| Product::new(grown_scene(inputs, &owned, &names, &scene, &index)?)),
    });
    graph.require(grown, "growth", growth);
    accept_features(graph, growth, &located.features);
    accept_features(graph, grown, &located.features);
    for (at, single) in located.single.iter().enumerate() {
        single.accepted_by(graph, growth, at);
    }
    Ok(grown)
}

/// Names under which the photos become images of the scene: in a folder that no image of it is in.
fn names_of(photos: &[SourceImage], scene: &SceneFile) -> Vec<String> {
    let images = || scene.components.iter().flat_map(|model| &model.images);
    let is_free = |folder: &String| images().all(|image| !image.name.starts_with(folder));
    // Of one folder more than there are images, one is free.
    let mut folders = (1..=images().count() + 1).map(|number| format!("grown-{number}/"));
    let folder = folders.find(is_free).unwrap_or_default();
    photos.iter().map(|photo| format!("{folder}{}", photo.name)).collect()
}

/// Those that the scene was indexed with.
fn index_params(scene: &SceneFile) -> Result<IndexParams> {
    let config: Config =
        toml::from_str(&scene.config).context("the scene's configuration is not readable")?;
    Ok(config.index)
}

fn growth_of(
    inputs: &Inputs<'_, '_>,
    photos: &[SourceImage],
    (alone, as_set): (bool, bool),
    what: &LocateJobs,
) -> Result<Growth> {
    let (mut features, mut single) = (Vec::new(), Vec::new());
    for (at, photo) in photos.iter().enumerate() {
        // Local models have the same images in the same order: those whose features exist.
        let Some(found) = inputs.find::<ImageFeatures>(&features_role(at))? else { continue };
        features.push((at, photo, found));
        single.push(alone_of(inputs, at)?);
    }
    let queries: Vec<_> = features.iter().map(|(_, photo, features)| query(photo, features)).collect();
    // Only the largest component grows.
    let by_themselves: Vec<PhotoEvidence<'_>> = single
        .iter()
        .map(|(found, nearest)| Some(found.components.first()?.evidence(nearest.components.first()?)))
        .collect::<Option<_>>()
        .context("a photo was sought in no component")?;
    let (set, model) = if as_set {
        (Some(inputs.get::<SetLocalization>("set")?), Some(inputs.get::<MapperOutput>("local_model")?))
    } else {
        (None, None)
    };
    let of_single: Vec<PhotoLocalization> =
        single.iter().filter(|_| alone).map(|(found, _)| found.photo.clone()).collect();
    let best = best_answers(&of_single, set.as_deref());
    let mut contents: BTreeSet<ContentHash> = what.scene.grown_from.iter().copied().collect();
    let answer = |(_, photo, _): &(usize, &SourceImage, Arc<ImageFeatures>)| {
        let is_new = contents.insert(photo.hash);
        let answer = best.iter().find(|(_, answer)| answer.name == photo.name);
        answer.filter(|_| is_new).map(|(_, answer)| *answer)
    };
    let answers: Vec<Option<&PhotoLocalization>> = features.iter().map(answer).collect();
    let empty = EmptyScene::default();
    let scene = main_of(&what.scene, &empty);
    let models = model.as_ref().map_or(&[][..], |model| &model.components);
    let mut growth =
        grow(&what.config.growth, &what.config.camset, &scene, (&queries, &by_themselves), &answers, models);
    for photo in &mut growth.photos {
        photo.photo = features[photo.photo].0;
    }
    Ok(growth)
}

/// The scene with images, observations and points of a growth.
fn grown_scene(
    inputs: &Inputs<'_, '_>,
    photos: &[SourceImage],
    names: &[String],
    scene: &SceneFile,
    index_params: &IndexParams,
) -> Result<SceneFile> {
    let growth = inputs.get::<Growth>("growth")?;
    if scene.components.is_empty() || growth.photos.is_empty() {
        bail!("no photo is known well enough to become an image of the scene")
    }
    let of_photo = |photo: &GrowthPhoto| inputs.get::<ImageFeatures>(&features_role(photo.photo));
    let features = growth.photos.iter().map(of_photo).collect::<Result<Vec<_>>>()?;
    let borrowed: Vec<&ImageFeatures> = features.iter().map(|features| &**features).collect();
    let names: Vec<&str> = growth.photos.iter().map(|photo| names[photo.photo].as_str()).collect();
    let empty = EmptyScene::default();
    let grown = growth.apply(&main_of(scene, &empty), &borrowed, &names, index_params);
    let mut components = scene.components.clone();
    components.iter_mut().skip(1).for_each(|model| growth.list_in(model, &names));
    let of_index = ContentHash::of(&serde_json::to_vec(index_params)?);
    let made_by = ContentHash::of(&stages::GROWN_VERSION.to_le_bytes());
    let mut content = vec![scene.content, inputs.hash("growth")?, of_index, made_by];
    let mut blocks = scene.features.clone();
    blocks.resize_with(components[0].images.len(), Block::default);
    for (photo, features) in growth.photos.iter().zip(&features) {
        let mut block = Block::default();
        features.strongest(KEPT_FEATURES).write_payload(&mut block.0)?;
        blocks.push(block);
        content.push(inputs.hash(&features_role(photo.photo))?);
    }
    components[0] = grown.reconstruction;
    let indices = std::iter::once(grown.index).chain(scene.indices.iter().skip(1).cloned()).collect();
    let from = growth.photos.iter().map(|photo| photos[photo.photo].hash);
    Ok(SceneFile {
        components,
        indices,
        features: blocks,
        notes: scene.notes.iter().cloned().chain([sentence(&growth, &names)]).collect(),
        grown: grown.grown,
        grown_from: scene.grown_from.iter().copied().chain(from).collect(),
        content: ContentHash::of_all(&content),
        ..scene.clone()
    })
}

/// What a scene grew by, in words.
fn sentence(growth: &Growth, names: &[&str]) -> String {
    let observations: usize = growth.photos.iter().map(|photo| photo.seen.len()).sum();
    let folder = names.first().and_then(|name| name.split('/').next()).unwrap_or_default();
    format!(
        "{folder}: grown by {} photos, {} points and {observations} observations of points that it had",
        growth.photos.len(),
        growth.points.len()
    )
}
