//! The alignment of a scene's tracks by its images.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result};
use serde_json::json;
use setloc_features::ImageFeatures;
use setloc_sfm::{
    AlignmentParams, ImageId, KnownOfComponent, MapperOutput, align_tracks, register_by_ground,
    sharpen_lengths,
};

use super::features::{accept_features, read_unchanged};
use super::model::{features_at, image_of_place_holder};
use super::positions::Measurements;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::stages;

/// Bytes of grey images that are kept while patches are cut and found; what does not fit is decoded each time it is asked for.
const KEPT_BYTES: usize = 1 << 30;
/// Bytes a pixel of an image in work: decoded, grey and reduced.
const WORKING_BYTES: u64 = 8;

/// What is known of a model beside its images.
pub(super) struct KnownOfModel {
    /// Whose intrinsics are, by the model's cameras.
    pub cameras: Vec<bool>,
    pub measured: Measurements,
}

/// Adds the alignment of a model.
pub(super) fn add_alignment(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    (features, model): (&[JobId], JobId),
    known: KnownOfModel,
    params: &AlignmentParams,
) -> JobId {
    let external =
        images.iter().enumerate().map(|(at, image)| (format!("image {at:04}"), image.hash)).collect();
    let pixels = images.iter().map(|image| u64::from(image.camera.width) * u64::from(image.camera.height));
    let largest = pixels.clone().max().unwrap_or(0);
    let memory = pixels.sum::<u64>().min(KEPT_BYTES as u64) + 2 * WORKING_BYTES * largest;
    let sources: Vec<(PathBuf, ContentHash)> =
        images.iter().map(|image| (image.path.clone(), image.hash)).collect();
    let mut job_params = json!({ "alignment": params, "camera_fixed": known.cameras });
    if !known.measured.is_empty() {
        let Measurements { params, positions, seed } = &known.measured;
        job_params["measured"] = json!([params, positions, seed]);
    }
    let params = params.clone();
    let work = move |inputs: &Inputs<'_, '_>| run_alignment(inputs, &params, &known, &sources);
    let aligned = graph.add(Job {
        kind: "aligned",
        version: stages::ALIGNMENT_VERSION,
        name: graph.job(model).name.clone(),
        params: job_params,
        external,
        memory,
        work: Box::new(work),
    });
    graph.require(aligned, "model", model);
    accept_features(graph, aligned, features);
    aligned
}

fn run_alignment(
    inputs: &Inputs<'_, '_>,
    params: &AlignmentParams,
    known: &KnownOfModel,
    sources: &[(PathBuf, ContentHash)],
) -> Result<Product> {
    params.patch.validate()?;
    let mut output = (*inputs.get::<MapperOutput>("model")?).clone();
    let Some(first) = output.components.first() else { return Product::new(output) };
    // All components list the same images.
    let mut image_at = Vec::new();
    for image in &first.images {
        let at = image_of_place_holder(&image.name).filter(|at| *at < sources.len());
        image_at.push(at.with_context(|| format!("the model names an unknown image {}", image.name))?);
    }
    let features = features_at(inputs, &image_at)?;
    let features: Vec<&ImageFeatures> = features.iter().map(|features| &**features).collect();
    let mut waiting = output.waiting_among(&output.open_pairs);
    for (component, placed) in output.components.iter_mut().zip(&mut output.report.georegistrations) {
        let wraps: Vec<bool> = component
            .images
            .iter()
            .map(|image| component.cameras[image.camera.index()].wraps_around())
            .collect();
        let pyramids = Pyramids::default();
        let load = |image: ImageId| {
            let (path, hash) = &sources[image_at[image.index()]];
            pyramids.get((path, *hash), wraps[image.index()])
        };
        let positions = known.measured.for_adjustment(component, placed.as_ref());
        let known_here = KnownOfComponent { cameras: &known.cameras, positions: positions.as_ref() };
        let report = align_tracks(params, component, &features, known_here, load)?;
        sharpen_lengths(component, load)?;
        let registered = register_by_ground(component, &waiting, &features, load)?;
        if placed.is_some() {
            *placed = known.measured.place(component).or(placed.take());
        }
        waiting.retain(|pair| ![pair.first, pair.second].iter().any(|image| registered.contains(image)));
        if report.aligned * 5 < report.sought {
            output.report.warnings.push(format!(
                "the pixels round only {} of {} matched keypoints agree",
                report.aligned, report.sought
            ));
        }
    }
    output.open_pairs = output.open_among(&output.open_pairs);
    Product::new(output)
}

/// Grey images in memory, as many as fit.
#[derive(Default)]
pub(super) struct Pyramids {
    kept: Mutex<(usize, BTreeMap<PathBuf, Arc<stages::ImagePyramid>>)>,
}

impl Pyramids {
    pub fn get(&self, (path, hash): (&Path, ContentHash), wraps: bool) -> Result<Arc<stages::ImagePyramid>> {
        if let Some(found) = self.kept.lock().unwrap_or_else(PoisonError::into_inner).1.get(path) {
            return Ok(Arc::clone(found));
        }
        let bytes = read_unchanged(path, hash)?;
        let grey = stages::decode_grey(&bytes, &stages::DecodeLimits::default())?;
        let pyramid = Arc::new(stages::ImagePyramid::new(grey, wraps));
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.0 + pyramid.byte_size() <= KEPT_BYTES {
            kept.0 += pyramid.byte_size();
            kept.1.insert(path.to_owned(), Arc::clone(&pyramid));
        }
        Ok(pyramid)
    }
}
