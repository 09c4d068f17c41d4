//! Focal lengths by photos that were taken on one spot, in place of guesses.
//!
//! A photographer who turns on the spot shows every angle between two points twice, at different places of the picture, which
//! tells the focal length and needs no other photo (R. Hartley, "Self-calibration from multiple views with a rotating camera",
//! ECCV 1994). Models learn nothing from such pairs, which give no depths, and a guess that is a third too long stays with them.

use anyhow::Result;
use setloc_features::{Calibration, Camera, CameraSource, fallback_camera};
use setloc_sfm::robust::TurnedCamera;

use crate::artifacts::TurnedPair;
use crate::config::Config;
use crate::dataset::{CameraOrigin, SourceImage};
use crate::graph::{JobGraph, JobId, RunResult};
use crate::jobs::{Looks, PairSource, add_turned, choose_pairs};
use crate::session::Session;
use crate::stages::FeatureParams;
use crate::text::some_of;

/// The jobs that show focal lengths by turns on the spot.
pub struct TurnedJobs<'g> {
    /// Features, matches and turns.
    pub graph: JobGraph<'g>,
    /// Images that share a guess that rests on nothing.
    groups: Vec<Vec<usize>>,
    /// Pairs of them, and their jobs.
    pairs: Vec<((usize, usize), JobId)>,
}

impl TurnedJobs<'_> {
    /// Of images, `None` where no two share a guess that rests on nothing.
    pub fn of(
        images: &[SourceImage],
        alike: &[(usize, usize)],
        (features, config): (&FeatureParams, &Config),
        seed: u64,
    ) -> Option<Self> {
        let groups = groups_of(images);
        let group_of = |at: usize| groups.iter().position(|group| group.contains(&at));
        let mut pairs = choose_pairs(&config.pairs, &vec![None; images.len()], alike);
        pairs.retain(|&(a, b)| group_of(a).is_some_and(|group| group_of(b) == Some(group)));
        if pairs.is_empty() {
            return None;
        }
        let mut graph = JobGraph::default();
        let looks = Looks::once(&mut graph, images, features);
        let add = |pair: (usize, usize)| {
            let job = add_turned(&mut graph, PairSource { images, config, seed }, &looks, pair);
            graph.want(job);
            (pair, job)
        };
        let pairs = pairs.into_iter().map(add).collect();
        Some(Self { graph, groups, pairs })
    }

    fn group_of(&self, image: usize) -> Option<usize> {
        self.groups.iter().position(|group| group.contains(&image))
    }
}

/// Puts the focal lengths that turns on the spot show in place of guesses that rest on nothing; they stay guesses.
///
/// # Errors
/// When the run was stopped or the store cannot be written.
pub fn guess_by_turns(
    session: &Session,
    name: &str,
    images: &mut [SourceImage],
    alike: &[(usize, usize)],
    params: (&FeatureParams, &Config),
    seed: u64,
) -> Result<RunResult> {
    let Some(jobs) = TurnedJobs::of(images, alike, params, seed) else { return Ok(RunResult::default()) };
    session.run(name, &jobs.graph, |executor, run| {
        let mut shown: Vec<Vec<TurnedCamera>> = vec![Vec::new(); jobs.groups.len()];
        for &((first, _), job) in &jobs.pairs {
            let made = executor.load_made::<TurnedPair>(job)?;
            if let (Some(group), Some(turned)) = (jobs.group_of(first), made.and_then(|pair| pair.0)) {
                shown[group].push(turned);
            }
        }
        for (group, turned) in jobs.groups.iter().zip(&shown) {
            if let Some(focal) = TurnedCamera::agreed_focal(turned) {
                let names: Vec<String> = group.iter().map(|&at| images[at].name.clone()).collect();
                session.note(format!(
                    "focal length sought from {focal:.0} px on, as photos show it that seem to be taken on one spot: {}",
                    some_of(&names, "photos")
                ));
                for &at in group {
                    let Camera { width, height, .. } = images[at].camera;
                    images[at].camera = Camera::from_focal_guess(width, height, focal);
                }
            }
        }
        Ok(run.clone())
    })
}

/// Images that share a guess that rests on nothing, two at least.
fn groups_of(images: &[SourceImage]) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for (at, image) in images.iter().enumerate() {
        let is_open = image.calibration == Calibration::Guessed
            && image.camera_origin == CameraOrigin::Guessed(CameraSource::Fallback)
            && image.camera == fallback_camera(image.camera.width, image.camera.height);
        if !is_open {
            continue;
        }
        match groups.iter_mut().find(|group| images[group[0]].camera == image.camera) {
            Some(group) => group.push(at),
            None => groups.push(vec![at]),
        }
    }
    groups.retain(|group| group.len() > 1);
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_guesses_that_rest_on_nothing_are_grouped() {
        let image = |width: u32, source| SourceImage {
            camera_origin: CameraOrigin::Guessed(source),
            ..SourceImage::guessed("a", fallback_camera(width, 1200))
        };
        let fallback = |width| image(width, CameraSource::Fallback);
        let known = SourceImage { calibration: Calibration::Known, ..fallback(1600) };
        let mut improved = fallback(1600);
        improved.camera = Camera::from_focal_guess(1600, 1200, 1250.0);
        let images = [
            fallback(1600),
            known,
            fallback(1280),
            image(1600, CameraSource::ExifFocal35mm),
            fallback(1600),
            improved,
        ];
        assert_eq!(groups_of(&images), [vec![0, 4]]);
    }
}
