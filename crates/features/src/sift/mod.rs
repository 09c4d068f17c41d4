//! SIFT: D. G. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
//!
//! Lowe doubles the image first; here the caller says how much it is enlarged. Of a doubled one OpenCV's `SIFT`, the tests'
//! reference, finds the same points; this one needs a third of its time and a quarter of its memory, because all layers are blurred
//! a few rows at a time, those that no point is described on are kept no longer than they are read, pyramids are reused instead of
//! being returned to the system, and only points that the caller keeps are described. It also says whether a point is bright or
//! dark, which OpenCV's does not, and keeps places exact in octaves of odd size, where OpenCV's drift towards the right and bottom
//! border.

mod blur;
mod descriptor;
mod enlarged;
mod extrema;
mod octave;
mod orientation;
mod plane;

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::vectorized::Level;
use descriptor::{DescriptorRows, Frame, describe, prefetch};
use enlarged::Enlarged;
use extrema::{Extremum, Scan};
use octave::{Octave, Sigmas, Source};
use orientation::{OrientationRows, orientations};
use plane::{Kept, Plane};

use crate::DESCRIPTOR_LEN;

/// Contrasts are relative to this.
const GREY_RANGE: f32 = 255.0;

/// How to detect.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SiftParams {
    pub contrast_threshold: f64,
    /// The threshold where there are fewer than `min_points` with that contrast.
    pub weak_contrast_threshold: f64,
    pub min_points: usize,
    pub edge_threshold: f64,
    pub octave_layers: usize,
    /// Blur of the first scale in pixels of the enlarged image.
    pub sigma_px: f64,
    /// Blur that the enlarged image is taken to have already, in its pixels.
    pub image_sigma_px: f64,
    /// Pixels of the enlarged image per pixel, 1 or more.
    pub enlargement: f64,
}

impl SiftParams {
    /// Width in image pixels of a pixel of this octave.
    fn pixel_of(&self, octave: u32) -> f32 {
        (f64::from(octave).exp2() / self.enlargement) as f32
    }

    /// Where the first pixel of every octave has its centre, in image pixels: decimation keeps it.
    fn first_center(&self) -> f32 {
        0.5 * self.pixel_of(0)
    }
}

/// An image, row-major.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Grey<'a> {
    pub width: usize,
    pub height: usize,
    pub values: &'a [u8],
}

/// A keypoint in pixels of the image; the centre of the first pixel is (0.5, 0.5).
#[derive(Debug, Clone, Copy)]
pub(crate) struct SiftPoint {
    pub x: f32,
    pub y: f32,
    /// Diameter of the region: twice the deviation of the Gaussian at its scale.
    pub size: f32,
    /// Radians clockwise from image right.
    pub orientation: f32,
    /// Contrast in [0, 1].
    pub response: f32,
    /// Whether it is brighter than its surround.
    pub is_light: bool,
    octave: u32,
    layer: u32,
}

/// Detects points, lets `choose` keep some of them by index, and describes those.
///
/// `allows` says for a place (x, y) in pixels whether points may lie there. Returns the chosen points and, row-major,
/// their histograms, which are not normalized.
pub(crate) fn detect_and_describe(
    params: &SiftParams,
    image: Grey<'_>,
    allows: impl Fn(f32, f32) -> bool,
    choose: impl FnOnce(&[SiftPoint]) -> Vec<usize>,
) -> (Vec<SiftPoint>, Vec<[f32; DESCRIPTOR_LEN]>) {
    let level = Level::detect();
    let mut space = idle_workspaces().pop().unwrap_or_default();
    let enlarged = Enlarged::new(image, params.enlargement);
    let mut points = space.detect(level, params, &enlarged, &allows);
    if points.len() < params.min_points {
        let weaker = SiftParams { contrast_threshold: params.weak_contrast_threshold, ..params.clone() };
        points = space.detect(level, &weaker, &enlarged, &allows);
    }
    let chosen: Vec<SiftPoint> = choose(&points).into_iter().map(|index| points[index]).collect();
    let descriptors = space.describe(level, params, &chosen);
    idle_workspaces().push(space);
    (chosen, descriptors)
}

/// Pyramids not in use. There are never more than images were worked on at the same time.
///
/// They are kept because the system zeroes every page it hands out: pyramids allocated anew for each image cost as
/// much time for that as for all blurring.
fn idle_workspaces() -> MutexGuard<'static, Vec<Workspace>> {
    static IDLE: Mutex<Vec<Workspace>> = Mutex::new(Vec::new());
    // Contents are overwritten before they are read, so a panic elsewhere does no harm.
    IDLE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Pyramid and buffers for one image at a time.
#[derive(Debug, Default)]
struct Workspace {
    octaves: Vec<Octave>,
    scan: Scan,
    orientation_rows: OrientationRows,
    descriptor_rows: DescriptorRows,
}

impl Workspace {
    fn describe(
        &mut self,
        level: Level,
        params: &SiftParams,
        chosen: &[SiftPoint],
    ) -> Vec<[f32; DESCRIPTOR_LEN]> {
        // Row by row through each plane, which is far larger than any cache.
        let mut order: Vec<usize> = (0..chosen.len()).collect();
        order.sort_by(|&a, &b| {
            let plane = |at: usize| (chosen[at].octave, chosen[at].layer);
            plane(a).cmp(&plane(b)).then(chosen[a].y.total_cmp(&chosen[b].y))
        });
        let placed = |&at: &usize| {
            let point = &chosen[at];
            let pixel = params.pixel_of(point.octave);
            let place = |at: f32| (at - params.first_center()) / pixel;
            let frame = Frame {
                x: place(point.x),
                y: place(point.y),
                sigma: 0.5 * point.size / pixel,
                orientation: point.orientation,
            };
            (self.octaves[point.octave as usize].layer(point.layer as usize), frame)
        };
        let placed: Vec<(&Plane<Kept>, Frame)> = order.iter().map(placed).collect();
        let mut descriptors = vec![[0.0; DESCRIPTOR_LEN]; chosen.len()];
        for (index, (plane, frame)) in placed.iter().enumerate() {
            if let Some((plane, next)) = placed.get(index + 1) {
                prefetch(plane, next);
            }
            descriptors[order[index]] = describe(level, plane, frame, &mut self.descriptor_rows);
        }
        descriptors
    }

    fn detect(
        &mut self,
        level: Level,
        params: &SiftParams,
        image: &Enlarged<'_>,
        allows: impl Fn(f32, f32) -> bool,
    ) -> Vec<SiftPoint> {
        let layers = params.octave_layers;
        // Layer i has the blur σ·2^(i/layers); each is made from the one before.
        let sigma = |layer: usize| params.sigma_px * (layer as f64 / layers as f64).exp2();
        let step = |layer: usize| (sigma(layer).powi(2) - sigma(layer - 1).powi(2)).sqrt();
        let sigmas = Sigmas {
            first: (params.sigma_px.powi(2) - params.image_sigma_px.powi(2)).max(0.01).sqrt(),
            steps: (1..layers + 3).map(step).collect(),
        };
        let mut points = Vec::new();
        let mut extrema = Vec::new();
        for octave in 0.. {
            if self.octaves.len() <= octave {
                self.octaves.push(Octave::default());
            }
            let (done, current) = self.octaves.split_at_mut(octave);
            let current = &mut current[0];
            let source = match done.last() {
                Some(finer) => Source::Finer(finer.layer(layers)),
                None => Source::Photo(image),
            };
            let (width, height) = source.size();
            if width.min(height) <= MIN_SIDE {
                break;
            }
            extrema.clear();
            self.scan.begin(width, layers + 3);
            current.build(level, source, &sigmas, |planes, written| {
                self.scan.advance(level, params, planes, written, &mut extrema);
            });
            let pixel = params.pixel_of(octave as u32);
            for extremum in &extrema {
                let place = |at: f32| at * pixel + params.first_center();
                let (x, y) = (place(extremum.x), place(extremum.y));
                if !allows(x, y) {
                    continue;
                }
                let plane = current.layer(extremum.layer);
                orientations(level, plane, extremum, &mut self.orientation_rows, |orientation| {
                    points.push(SiftPoint {
                        x,
                        y,
                        size: 2.0 * extremum.sigma * pixel,
                        orientation,
                        response: extremum.contrast.abs(),
                        is_light: extremum.contrast < 0.0,
                        octave: octave as u32,
                        layer: extremum.layer as u32,
                    });
                });
            }
        }
        points
    }
}

/// An octave whose shorter side has no more pixels gives no points.
const MIN_SIDE: usize = 10;

#[cfg(test)]
mod tests;
