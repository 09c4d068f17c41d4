//! Which kind of lens a camera of unknown intrinsics has, by the finished model.
//!
//! Two radial terms follow a fisheye's curve to some 50° off the axis. Photos of one then fit each other in a model that
//! is bent, and no residual stands out; but the fisheye explains all of them together clearly better.

use super::{
    MapperParams,
    adjust::{tells_camera, try_camera},
    model::Model,
};

/// The share of the cost that a fisheye has to spare: it has two more terms, and comes second.
const MAX_COST: f64 = 0.95;
/// Observations that tell.
const MIN_OBSERVATIONS: usize = 200;

/// Takes cameras for fisheyes where that explains the model clearly better; whether there was one.
pub(super) fn choose_lenses(model: &mut Model<'_>, params: &MapperParams) -> bool {
    let mut changed = false;
    for camera in 0..model.cameras.len() {
        let lens = &model.cameras[camera];
        let is_open = !model.input.is_fixed(camera) && lens.may_be_fisheye();
        if !is_open || !tells_camera(model, &model.registered_with(camera)) {
            continue;
        }
        let Some(fisheye) = lens.as_fisheye() else { continue };
        changed |= try_camera(model, (camera, fisheye), &params.bundle(20), |trial| {
            trial.own.observations >= MIN_OBSERVATIONS && trial.spares(MAX_COST)
        });
    }
    changed
}
