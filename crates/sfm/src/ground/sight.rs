//! Patches of one photo, and how another shows them on a plane.

use std::sync::Arc;

use nalgebra::{Matrix2, Vector2, Vector3};
use setloc_features::{Camera, ImagePyramid, Patch, PatchFrame, Template};

use super::{PATCH, floor::Ground};
use crate::{
    Rigid,
    alignment::{STENCIL, second_order},
};

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
    pub stencil: Stencil,
    pub template: Template,
}

/// Bearings of a patch at the places of [`STENCIL`], where the camera has them: taken once for all planes that the patch is laid on.
pub(crate) struct Stencil([Option<Vector3<f64>>; STENCIL.len()]);
/// Steps from the middle of a patch to the places of its stencil.
const REACH: f64 = 0.5 * PATCH.radius as f64;

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
            Some(Piece { pixel, bearing, stencil: self.stencil(&pixel), template })
        };
        places.filter_map(piece).collect()
    }

    /// The bearings that tell where a patch about a pixel lies elsewhere.
    pub fn stencil(&self, pixel: &Vector2<f64>) -> Stencil {
        let step = self.step_px();
        Stencil(STENCIL.map(|place| self.camera.unproject(&(pixel + Vector2::from(place) * REACH * step))))
    }

    /// Where this view shows what another one shows on a plane at a bearing; `None` where it cannot.
    pub fn shows(
        &self,
        self_from_other: &Rigid,
        ground: &Ground,
        bearing: &Vector3<f64>,
    ) -> Option<Vector2<f64>> {
        self.camera.project(&self_from_other.transform_point(&ground.meets(bearing)?))
    }

    /// The frame in which this view shows a patch of another one that lies on a plane.
    pub fn frame_of(
        &self,
        self_from_other: &Rigid,
        ground: &Ground,
        Stencil(bearings): &Stencil,
    ) -> Option<PatchFrame> {
        let place = |number: usize| self.shows(self_from_other, ground, bearings[number].as_ref()?);
        second_order(place, REACH, self.camera.full_turn_px())
    }
}
