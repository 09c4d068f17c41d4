//! Patches of one photo, and how another shows them on a plane.

use std::sync::Arc;

use nalgebra::{Matrix2, Vector2, Vector3};
use setloc_features::{Camera, ImagePyramid, Patch, PatchFrame, Template};

use super::{PATCH, floor::Ground};
use crate::{Rigid, alignment::second_order};

/// Pixels of an image this wide that a step of a patch spans; wider ones in proportion.
const REFERENCE_WIDTH: f64 = 800.0;
/// Steps between the middles of neighbouring patches, across and down, where many are at hand and where few are.
pub(super) const SPARSE: [f64; 2] = [10.0, 7.0];
pub(super) const DENSE: [f64; 2] = [6.0, 3.0];

/// A photo with its pixels.
pub(crate) struct View<'a> {
    pub camera: &'a Camera,
    pub world_from_camera: Rigid,
    pub pyramid: Arc<ImagePyramid>,
}

/// A patch of a photo.
pub(crate) struct Piece {
    pub pixel: Vector2<f64>,
    pub bearing: Vector3<f64>,
    pub template: Template,
}

/// Pixels of a patch's step in images of a camera.
pub(crate) fn step_px(camera: &Camera) -> f64 {
    (f64::from(camera.width) / REFERENCE_WIDTH).max(1.0)
}

impl View<'_> {
    /// Pixels of a patch's step.
    pub fn step_px(&self) -> f64 {
        step_px(self.camera)
    }

    /// Patches with texture at bearings that `wanted` takes, row by row.
    pub fn pieces(
        &self,
        spacing: [f64; 2],
        wanted: impl Fn(&Vector3<f64>, &Vector2<f64>) -> bool,
    ) -> Vec<Piece> {
        let step = self.step_px();
        let count = |side: u32, spacing: f64| (f64::from(side) / (spacing * step)) as usize;
        let [across, down] = [count(self.camera.width, spacing[0]), count(self.camera.height, spacing[1])];
        let places = (0..across * down).map(|at| {
            let place = |number: usize, spacing: f64| (number as f64 + 0.5) * spacing * step;
            Vector2::new(place(at % across, spacing[0]), place(at / across, spacing[1]))
        });
        let piece = |pixel: Vector2<f64>| {
            let bearing = self.camera.unproject(&pixel)?;
            if !wanted(&bearing, &pixel) {
                return None;
            }
            let frame = PatchFrame {
                center: pixel,
                pixel_from_patch: Matrix2::identity() * step,
                curvature: [Matrix2::zeros(); 2],
            };
            let template = Template::new(&PATCH, Patch::cut(&PATCH, &self.pyramid, &frame)?)?;
            Some(Piece { pixel, bearing, template })
        };
        places.filter_map(piece).collect()
    }

    /// Where `other` shows on a plane what this view shows at a pixel; `None` where it cannot.
    pub fn seen_by(
        &self,
        other: &View<'_>,
        other_from_self: &Rigid,
        ground: &Ground,
        pixel: &Vector2<f64>,
    ) -> Option<Vector2<f64>> {
        other.camera.project(&other_from_self.transform_point(&ground.meets(&self.camera.unproject(pixel)?)?))
    }

    /// The frame in which `other` shows a patch of this view that lies on a plane.
    pub fn frame_in(
        &self,
        other: &View<'_>,
        other_from_self: &Rigid,
        ground: &Ground,
        pixel: &Vector2<f64>,
    ) -> Option<PatchFrame> {
        let step = self.step_px();
        let place = |x: f64, y: f64| {
            self.seen_by(other, other_from_self, ground, &(pixel + Vector2::new(x, y) * step))
        };
        second_order(place, 0.5 * PATCH.radius as f64, other.camera.full_turn_px())
    }
}
