//! Intrinsics that are told and that the photos contradict.
//!
//! A calibration is of another focus or temperature, or of photos that were cut from a stitched panorama, and is off by a
//! percent; what is left of a lens's distortion in photos that are called free of it moves their corners by pixels. Poses and points
//! make up for most of it, so no residual stands out, and what is bent by it fits the scene at no scale; but all residuals together
//! say so. A model of photos on a street tells a focal length to a tenth of a percent.

use std::collections::BTreeMap;

use setloc_features::{Calibration, Camera};

use super::{
    MapperInput, MapperParams,
    adjust::{CameraTrial, Intrinsics, Scope, adjust},
    model::Model,
    output::CorrectedCamera,
};
use crate::{CameraId, Reconstruction};

/// What photos are asked for, and when their answer counts.
struct Question {
    /// Whether distortion is asked for beside the focal lengths.
    distortion: bool,
    /// Images that tell.
    min_images: usize,
    /// The share of the cost that other intrinsics have to spare.
    max_cost: f64,
    /// The same of a camera that is contradicted already: the first model was bent by what it was told.
    max_further_cost: f64,
}

/// Local models. Where focal lengths are told rightly others spare at most 0.05 % of rendered photos; of real ones it may be more,
/// whatever they are told.
const OF_SET: Question = Question { distortion: false, min_images: 3, max_cost: 0.98, max_further_cost: 1.0 };
/// Scenes. Of rendered photos other intrinsics spare 0.2 % at most, of two real sets whose models are as right with what they are told
/// 0.6 %. Of those of which they spare 4–12 % most models are righter with them, by up to 15 times, and none is much less so.
const OF_SCENE: Question =
    Question { distortion: true, min_images: 6, max_cost: 0.97, max_further_cost: 0.99 };
/// What other intrinsics have to spare at least, of half the sum of the loss of squares.
const MIN_GAIN: f64 = 10.0;
/// The same of a camera that is contradicted already.
const MIN_FURTHER_GAIN: f64 = 2.0;
/// Largest change of a focal length, as a share: beyond, the model is bent by something else.
const MAX_CHANGE: f64 = 0.03;
const MAX_ITERATIONS: u32 = 20;

impl Question {
    /// What is asked; `None` where what is told is believed.
    fn asked(params: &MapperParams) -> Option<&'static Self> {
        if params.calibrate_photos {
            return Some(&OF_SCENE);
        }
        params.correct_told.then_some(&OF_SET)
    }
}

/// The input with the intrinsics that a component shows of told cameras, where it contradicts these; `None` where it contradicts
/// none.
pub(super) fn correct_told<'a>(
    params: &MapperParams,
    (told, used): (&MapperInput<'a>, &MapperInput<'a>),
    component: &Reconstruction,
) -> Option<MapperInput<'a>> {
    let question = Question::asked(params)?;
    let mut corrected = used.clone();
    let mut is_contradicted = false;
    for camera in 0..told.cameras.len() {
        let images = component.registered().filter(|image| used.camera_index(*image) == camera);
        let is_told = used.calibrations[camera] == Calibration::Known && !used.cameras[camera].is_panoramic();
        if !is_told || images.count() < question.min_images {
            continue;
        }
        let fit = |intrinsics: Intrinsics| {
            let mut model = Model::of_component(told, component);
            if question.distortion {
                model.cameras[camera] = model.cameras[camera].clone().with_tangential_distortion();
            }
            let scope = Scope { intrinsics, ..Scope::global(&model) };
            let report = adjust(&mut model, &params.bundle(MAX_ITERATIONS), &scope);
            (report, model.cameras.swap_remove(camera))
        };
        let other = Intrinsics::Told { camera, distortion: question.distortion };
        let ((own, _), (other, better)) = (fit(Intrinsics::None), fit(other));
        let trial = CameraTrial { own, other };
        let change = (better.focal_length() / told.cameras[camera].focal_length()).ln().abs();
        let (share, gain) = if used.cameras[camera] == told.cameras[camera] {
            (question.max_cost, MIN_GAIN)
        } else {
            (question.max_further_cost, MIN_FURTHER_GAIN)
        };
        if trial.spares(share) && trial.own.final_cost - trial.other.final_cost > gain && change <= MAX_CHANGE
        {
            corrected.cameras[camera] = better;
            is_contradicted = true;
        }
    }
    is_contradicted.then_some(corrected)
}

/// Cameras that are not used as they are told.
pub(super) fn corrections(told: &MapperInput<'_>, used: &[Camera]) -> BTreeMap<CameraId, CorrectedCamera> {
    let is_corrected = |(camera, (own, other)): &(usize, (&Camera, &Camera))| {
        told.calibrations[*camera] == Calibration::Known && !own.is_panoramic() && own != other
    };
    let corrected = told.cameras.iter().zip(used).enumerate().filter(is_corrected);
    corrected
        .map(|(camera, (told, used))| {
            (CameraId(camera as u32), CorrectedCamera { told: told.clone(), used: used.clone() })
        })
        .collect()
}

/// What is to be said of cameras of a scene that are not used as they are told.
pub(super) fn said_of_corrections(
    input: &MapperInput<'_>,
    corrections: &BTreeMap<CameraId, CorrectedCamera>,
) -> Vec<String> {
    corrections
        .iter()
        .filter_map(|(camera, CorrectedCamera { told, used })| {
            let mut images = input.images.iter().filter(|image| image.camera == *camera);
            let first = images.next()?.name;
            let others = images.count();
            Some(format!(
                "{first} and {others} more photos contradict the intrinsics that they are told: a focal length of {:.1} px in place of \
                 {:.1}, and distortion that moves the corners by {:.1} px otherwise, explain them better and are used \
                 (sfm.calibrate_photos = false keeps what is told)",
                used.focal_length(),
                told.focal_length(),
                moved_at_corner(told, used)
            ))
        })
        .collect()
}

/// By how many pixels a camera of other distortion shows what the first shows at a corner, beyond what its focal length does.
fn moved_at_corner(own: &Camera, other: &Camera) -> f64 {
    let corner = nalgebra::Vector2::new(f64::from(own.width), f64::from(own.height));
    let alike = own.with_focal_times(other.focal_length() / own.focal_length());
    let shown = alike.unproject(&corner).and_then(|ray| other.project(&ray));
    shown.map_or(f64::NAN, |shown| (shown - corner).norm())
}
