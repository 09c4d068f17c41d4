//! What photos show that moves with their camera.

use std::collections::BTreeMap;

use anyhow::Result;
use rayon::prelude::*;
use serde_json::json;
use setloc_features::{CarriedCells, ComparedPhoto, ImageFeatures};
use setloc_sfm::{MOST_NAMED, listed};

use super::features::features_role;
use crate::artifacts::CarriedParts;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Executor, Inputs, Job, JobGraph, JobId, Product};
use crate::stages;

/// Adds what tells of each photo what moves with its camera, a job for the photos of a size; `None` of panoramas, of which pairs
/// tell, and of photos of which too few have their size.
pub(super) fn add_carried(
    graph: &mut JobGraph<'_>,
    images: &[SourceImage],
    features: &[JobId],
) -> Vec<Option<JobId>> {
    let mut sizes: BTreeMap<(u32, u32), Vec<usize>> = BTreeMap::new();
    for (at, image) in images.iter().enumerate().filter(|(_, image)| !image.camera.is_panoramic()) {
        sizes.entry((image.camera.width, image.camera.height)).or_default().push(at);
    }
    let mut jobs = vec![None; images.len()];
    for (size, mut photos) in
        sizes.into_iter().filter(|(_, photos)| photos.len() >= CarriedCells::FEWEST_PHOTOS)
    {
        // Whatever a photo is called, the result is the same.
        photos.sort_by_key(|&at| (images[at].hash, at));
        let job = graph.add(job_of(size, photos.iter().map(|&at| images[at].hash).collect()));
        for (place, &at) in photos.iter().enumerate() {
            graph.accept(job, features_role(place), features[at]);
            jobs[at] = Some(job);
        }
    }
    jobs
}

/// What such jobs have found to move with the cameras of images, in a sentence.
///
/// # Errors
/// When what they made cannot be read.
pub fn said_of_carried(
    executor: &Executor<'_>,
    jobs: &[JobId],
    images: &[SourceImage],
) -> Result<Option<String>> {
    let (mut names, mut shares): (Vec<&str>, f64) = (Vec::new(), 0.0);
    for &job in jobs {
        let Some(told) = executor.load_made::<CarriedParts>(job)? else { continue };
        for image in images {
            if let Some(cells) = told.0.get(&image.hash) {
                names.push(&image.name);
                shares += cells.share(image.camera.width, image.camera.height);
            }
        }
    }
    let share = 100.0 * shares / names.len() as f64;
    let names = Some(listed(&names, MOST_NAMED)).filter(|_| !names.is_empty());
    Ok(names.map(|names| {
        format!(
            "{names}: {share:.0} % of the picture shows the same at the same pixels, which moves with the camera, and is not matched"
        )
    }))
}

/// Of photos of a size, which have these hashes.
fn job_of<'a>((width, height): (u32, u32), hashes: Vec<ContentHash>) -> Job<'a> {
    let memory = hashes.len() as u64 * (ComparedPhoto::STRONGEST as u64 * 2 * 160);
    let params = json!({ "images": hashes });
    let work = move |inputs: &Inputs<'_, '_>| {
        let photos = hashes.par_iter().enumerate().with_max_len(1).map(|(place, &hash)| {
            let features = inputs.find::<ImageFeatures>(&features_role(place))?;
            Ok(features.map(|features| (hash, ComparedPhoto::of(&features))))
        });
        let photos: Vec<_> = photos.collect::<Result<_>>()?;
        let (hashes, photos): (Vec<ContentHash>, Vec<ComparedPhoto>) = photos.into_iter().flatten().unzip();
        let cells = hashes.into_iter().zip(CarriedCells::of_each(&photos));
        Product::new(CarriedParts(cells.filter(|(_, cells)| !cells.is_empty()).collect()))
    };
    Job {
        kind: "carried",
        version: stages::CARRIED_VERSION,
        name: format!("{width} × {height}"),
        params,
        external: BTreeMap::new(),
        memory,
        work: Box::new(work),
    }
}
