//! Focal lengths that are told and that the photos contradict.
//!
//! A calibration is of another focus or temperature, or of photos that were cut from a stitched panorama, and is off by a
//! percent. Poses and points make up for most of it, so no residual stands out, and what is bent by it fits the scene at no
//! scale; but all residuals together say so. A model of photos on a street tells a focal length to a tenth of a percent.

use super::{
    MapperInput, MapperParams,
    adjust::{Intrinsics, Scope, adjust},
    model::Model,
};
use crate::Reconstruction;

use setloc_features::Calibration;

/// The share of the cost that other focal lengths have to spare. Where they are told rightly that is at most 0.05 % of rendered
/// photos; of real ones it may be more, whatever they are told.
const MAX_COST: f64 = 0.98;
/// What they have to spare at least, of half the sum of the loss of squares.
const MIN_GAIN: f64 = 10.0;
/// The same of a camera that is contradicted already: the first model was bent by what it was told.
const MIN_FURTHER_GAIN: f64 = 2.0;
/// Images that tell.
const MIN_IMAGES: usize = 3;
/// Largest change, as a share: beyond, the model is bent by something else.
const MAX_CHANGE: f64 = 0.03;
const MAX_ITERATIONS: u32 = 20;

/// The input with the focal lengths that a component shows of told cameras, where it contradicts these; `None` where it
/// contradicts none.
pub(super) fn correct_told<'a>(
    params: &MapperParams,
    (told, used): (&MapperInput<'a>, &MapperInput<'a>),
    component: &Reconstruction,
) -> Option<MapperInput<'a>> {
    let mut corrected = used.clone();
    let mut is_contradicted = false;
    for camera in 0..told.cameras.len() {
        let images = component.registered().filter(|image| used.camera_index(*image) == camera);
        let is_told = used.calibrations[camera] == Calibration::Known && !used.cameras[camera].is_panoramic();
        if !is_told || images.count() < MIN_IMAGES {
            continue;
        }
        let fit = |intrinsics: Intrinsics| {
            let mut model = Model::of_component(told, component);
            let scope = Scope { intrinsics, ..Scope::global(&model) };
            let report = adjust(&mut model, &params.bundle(MAX_ITERATIONS), &scope);
            (report, model.cameras.swap_remove(camera))
        };
        let ((own, _), (other, better)) = (fit(Intrinsics::None), fit(Intrinsics::Told(camera)));
        let change = (better.focal_length() / told.cameras[camera].focal_length()).ln().abs();
        let is_contradicted_before = used.cameras[camera] != told.cameras[camera];
        let (share, gain) =
            if is_contradicted_before { (1.0, MIN_FURTHER_GAIN) } else { (MAX_COST, MIN_GAIN) };
        let pays = other.ignored <= own.ignored
            && other.final_cost < share * own.final_cost
            && own.final_cost - other.final_cost > gain;
        if pays && change <= MAX_CHANGE {
            corrected.cameras[camera] = better;
            is_contradicted = true;
        }
    }
    is_contradicted.then_some(corrected)
}
