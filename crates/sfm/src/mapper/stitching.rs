//! By how much panoramas of one camera are stretched, by the finished model.
//!
//! Stitched panoramas of one camera are off alike: two fisheyes whose radial calibration is 0.3 % off squeeze what lies
//! ahead and spread what lies at the sides by twice that, so everything in sight lies 1 % too deep or too near, and a
//! street that turns is bent. No residual of a straight drive shows that, as its points give way; where headings
//! differ, all residuals together do.

use super::{MapperParams, adjust::try_camera, model::Model};

/// The share of the cost that a stretch has to spare. In right models of panoramas that are not stretched it spares
/// 0.00–0.11 %, in models of stretched ones 3–17 %.
const MAX_COST: f64 = 0.98;
/// What it has to spare at least, of half the sum of the loss of squares: nine terms of noise spare 4.5.
const MIN_GAIN: f64 = 10.0;
/// Steps that show whether a stretch pays; what follows finds the rest.
const MAX_ITERATIONS: u32 = 6;
/// Images that tell.
const MIN_IMAGES: usize = 3;

/// Estimates the stretch of panoramas where it explains the model clearly better; whether there was one.
pub(super) fn measure_stitching(model: &mut Model<'_>, params: &MapperParams) -> bool {
    let mut changed = false;
    for camera in 0..model.cameras.len() {
        let Some(stitched) = model.cameras[camera].as_stitched() else { continue };
        if model.registered_with(camera).len() < MIN_IMAGES {
            continue;
        }
        changed |= try_camera(model, (camera, stitched), &params.bundle(MAX_ITERATIONS), |trial| {
            trial.own.final_cost - trial.other.final_cost > MIN_GAIN && trial.spares(MAX_COST)
        });
    }
    changed
}
