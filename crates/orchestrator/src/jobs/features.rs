//! Features of images: of scenes, which may look at some of them twice, and of photos.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::json;
use setloc_features::{Camera, ImageFeatures};

use super::carried::add_carried;
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::stages;

/// The features jobs of some images.
pub struct Looks {
    /// Without the views that a second look simulates.
    pub first: Vec<JobId>,
    /// With them, where there is one; else the same.
    pub last: Vec<JobId>,
    /// What tells of each photo what moves with its camera.
    carried: Vec<Option<JobId>>,
}

impl Looks {
    /// Adds decoding and extraction of each image.
    pub fn once(graph: &mut JobGraph<'_>, images: &[SourceImage], params: &stages::FeatureParams) -> Self {
        let features = add_features_of(graph, images, params);
        let carried = add_carried(graph, images, &features);
        Self { first: features.clone(), last: features, carried }
    }

    /// Adds decoding and extraction of the images of a scene, and what a second look adds to those that are due one.
    pub(super) fn add(graph: &mut JobGraph<'_>, images: &[SourceImage], config: &Config) -> Self {
        let second = config.second_features();
        let mut looks = Self::once(graph, images, &config.features);
        for (image, last) in images.iter().zip(&mut looks.last).filter(|(image, _)| image.second_look) {
            // Views that the first look has simulated are not those of the second.
            let beside = (config.features.simulated_tilt <= 1.0).then_some(*last);
            *last = add_features(graph, image, &second, beside);
        }
        looks
    }

    pub(super) fn is_again(&self, at: usize) -> bool {
        self.first[at] != self.last[at]
    }

    /// The jobs that tell what moves with the cameras of photos.
    pub(super) fn all_carried(&self) -> Vec<JobId> {
        let jobs: BTreeSet<JobId> = self.carried.iter().copied().flatten().collect();
        jobs.into_iter().collect()
    }

    /// The job that tells what moves with the cameras of two photos of a size.
    pub(super) fn carried_by(&self, (a, b): (usize, usize)) -> Option<JobId> {
        self.carried[a].filter(|_| self.carried[a] == self.carried[b])
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

/// What the features of the image at this place of the list are to a job.
pub fn features_role(at: usize) -> String {
    format!("features {at:04}")
}

/// Lets a job use the features of images, of those that have any.
pub(super) fn accept_features(graph: &mut JobGraph<'_>, job: JobId, features: &[JobId]) {
    for (at, used) in features.iter().enumerate() {
        graph.accept(job, features_role(at), *used);
    }
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

/// The bytes that were hashed when the run was planned, or when the scene was built that an image is of.
pub(super) fn read_unchanged(path: &Path, hash: ContentHash) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let is_same = ContentHash::of(&bytes) == hash;
    anyhow::ensure!(is_same, "{} has changed since it was first read", path.display());
    Ok(bytes)
}
