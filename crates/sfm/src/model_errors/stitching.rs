//! How far off it may be how panoramas are stitched.
//!
//! What the panoramas of a camera share is told by all of them, and what is a panorama's own by that one alone, which is held near to
//! the others ([`crate::align_tracks`]). A draw goes the same way: each panorama has a field of its own beside what all share, what is
//! shared is told anew, and each is held near to that.

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use setloc_features::{Camera, ParamRole};

use super::shared::moved;
use crate::bundle::{self, BundleProblem, CameraPrior, IntrinsicsFreedom};
use crate::synthetic::normal;
use crate::{ImageId, Reconstruction};

/// The cameras of a model that are one panorama's each, and what those of one kind share.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct OwnCameras {
    /// Their mean by kind.
    means: Vec<Camera>,
    /// The kind of each of the model's cameras.
    kinds: Vec<Option<usize>>,
}

impl OwnCameras {
    pub fn of(model: &Reconstruction) -> Self {
        let mut users = vec![0; model.cameras.len()];
        model.registered().for_each(|image| users[model.images[image.index()].camera.index()] += 1);
        let mut spheres: Vec<(Camera, Vec<&Camera>)> = Vec::new();
        let mut own = Self::default();
        for (camera, users) in model.cameras.iter().zip(users) {
            let kind = (camera.is_stretched() && users == 1).then(|| {
                let plain = camera.without_stretch();
                spheres.iter().position(|(sphere, _)| *sphere == plain).unwrap_or_else(|| {
                    spheres.push((plain, Vec::new()));
                    spheres.len() - 1
                })
            });
            if let Some(kind) = kind {
                spheres[kind].1.push(camera);
            }
            own.kinds.push(kind);
        }
        let mean = |(_, members): &(Camera, Vec<&Camera>)| {
            let mut mean = members[0].clone();
            for (value, at) in terms(&mut mean) {
                *value = members.iter().map(|member| member.params[at]).sum::<f64>() / members.len() as f64;
            }
            mean
        };
        own.means.extend(spheres.iter().map(mean));
        // One alone may be what all others would share.
        for kind in &mut own.kinds {
            *kind = kind.filter(|kind| spheres[*kind].1.len() >= 2);
        }
        own
    }

    /// The kind of a camera that is one panorama's own.
    pub fn kind(&self, camera: usize) -> Option<usize> {
        *self.kinds.get(camera)?
    }

    /// How the panorama of an image is stitched, and how in a draw: as much the other way from the mean, or as it is.
    pub fn drawn(&self, model: &Reconstruction, image: ImageId, draw: u32) -> Option<[Camera; 2]> {
        let at = model.images.get(image.index())?.camera.index();
        let (camera, mean) = (model.cameras.get(at)?, self.means.get(self.kind(at)?)?);
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(image.0) << 32 | u64::from(draw));
        rng.set_stream(1);
        let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let mut drawn = camera.clone();
        for (value, at) in terms(&mut drawn) {
            *value += sign * (camera.params[at] - mean.params.get(at)?);
        }
        Some([camera.clone(), drawn])
    }
}

/// The terms of a camera's stitching, and where they are among its parameters.
fn terms(camera: &mut Camera) -> impl Iterator<Item = (&mut f64, usize)> {
    let roles = camera.param_roles();
    let terms = camera.params.iter_mut().zip(roles).enumerate();
    terms.filter(|(_, (_, role))| **role == ParamRole::Stretch).map(|(at, (value, _))| (value, at))
}

/// Moves the places of a problem by errors of their bearings.
pub(super) fn move_places(problem: &mut BundleProblem, errors: &[Option<Vector3<f64>>]) {
    let (cameras, poses) = (&problem.cameras, &problem.poses);
    for (seen, error) in problem.observations.iter_mut().zip(errors) {
        let camera = &cameras[poses[seen.pose as usize].camera as usize];
        let place = error.and_then(|error| moved(camera, &seen.pixel, |_| error));
        seen.pixel = place.unwrap_or(seen.pixel);
    }
}

/// What the panoramas of each camera share, as a problem of its own.
pub(super) struct SharedStitching {
    own: OwnCameras,
    /// In which one camera of each kind, behind all others, stands for the panoramas' own.
    problem: BundleProblem,
    /// Its answer without errors.
    unmoved: BundleProblem,
}

impl SharedStitching {
    /// Of a model's problem; `None` where no camera is one panorama's own, or all of them tell nothing.
    pub fn of(problem: &BundleProblem, own: &OwnCameras) -> Option<Self> {
        let (mut of_shared, count) = (problem.clone(), problem.cameras.len());
        of_shared.camera_priors.retain(|prior| own.kind(prior.camera as usize).is_none());
        of_shared.camera_freedom.resize(count, IntrinsicsFreedom::FIXED);
        for (kind, mean) in own.means.iter().enumerate() {
            of_shared.camera_priors.extend(CameraPrior::of_usual_photo((count + kind) as u32, mean));
            of_shared.camera_freedom.push(IntrinsicsFreedom::FREE);
            of_shared.cameras.push(mean.clone());
        }
        for seen in &mut of_shared.observations {
            let camera = problem.poses[seen.pose as usize].camera as usize;
            let there = own
                .kind(camera)
                .and_then(|kind| own.means[kind].project(&problem.cameras[camera].unproject(&seen.pixel)?));
            seen.pixel = there.unwrap_or(seen.pixel);
        }
        for pose in &mut of_shared.poses {
            let kind = own.kind(pose.camera as usize);
            pose.camera = kind.map_or(pose.camera, |kind| (count + kind) as u32);
        }
        let mut unmoved = of_shared.clone();
        let is_told = own.kinds.iter().any(Option::is_some) && bundle::step(&mut unmoved);
        is_told.then(|| Self { own: own.clone(), problem: of_shared, unmoved })
    }

    /// Holds the cameras of a draw near to what its panoramas share, which its errors tell.
    pub fn hold(&self, drawn: &mut BundleProblem, rng: &mut ChaCha8Rng, errors: &[Option<Vector3<f64>>]) {
        let mut told = self.problem.clone();
        move_places(&mut told, errors);
        draw_priors(&mut told, rng);
        // What has no answer moves nothing.
        if !bundle::step(&mut told) {
            return;
        }
        for prior in &mut drawn.camera_priors {
            let Some(kind) = self.own.kind(prior.camera as usize) else { continue };
            let at = drawn.cameras.len() + kind;
            let (before, after) = (&self.unmoved.cameras[at], &told.cameras[at]);
            for ((known, before), after) in prior.parameters.iter_mut().zip(&before.params).zip(&after.params)
            {
                known.value += after - before;
            }
        }
    }
}

/// Lets what is known of stitching beforehand be as far off as it says.
pub(super) fn draw_priors(problem: &mut BundleProblem, rng: &mut ChaCha8Rng) {
    for prior in &mut problem.camera_priors {
        for known in prior.parameters.iter_mut().filter(|known| known.sigma.is_finite()) {
            known.value += known.sigma * normal(rng);
        }
    }
}
