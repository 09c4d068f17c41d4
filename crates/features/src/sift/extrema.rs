use nalgebra::{Matrix3, Vector3};

use super::plane::Plane;
use super::{GREY_RANGE, SiftParams};
use crate::{vectorized, vectorized::Level};

/// Pixels along the border without keypoints.
const BORDER: usize = 3;
/// Pixels, and layers, from a pixel to the extremum that is told from it. Halfway between two, each may tell that it is nearer to the
/// other one.
const MAX_OFFSET: f32 = 0.6;
/// Most moves of the interpolation to another pixel.
const MAX_MOVES: usize = 5;
/// Pixels that the interpolation may end from where it began.
const MAX_WAY: usize = 5;
/// Rows above and below that are read about a row that is scanned.
pub(super) const REACH: usize = MAX_WAY + 1;
/// Neighbours of a pixel in place and scale that come before it.
const NEIGHBOURS_BEFORE: usize = 13;
/// Flags that are looked at together.
const CHUNK: usize = size_of::<u64>();

/// An extremum of the difference of Gaussians, in pixels of its octave.
#[derive(Debug, Clone, Copy)]
pub(super) struct Extremum {
    /// Layer whose difference it is of, from 1 to the number of scales per octave.
    pub layer: usize,
    /// Its pixel.
    pub column: usize,
    pub row: usize,
    /// Its place to a fraction of a pixel; the centre of the first pixel is 0.
    pub x: f32,
    pub y: f32,
    /// Deviation of the Gaussian at its scale.
    pub sigma: f32,
    /// Contrast in [-1, 1]; positive for spots darker than their surround.
    pub contrast: f32,
}

/// Where a scan has come to, with rows of the differences.
#[derive(Debug, Default)]
pub(super) struct Scan {
    /// The row to be scanned next.
    row: usize,
    /// Three successive rows of each difference, row `y` in slot `y % 3`.
    differences: Vec<[Vec<f32>; 3]>,
    /// 1 for candidates of the row, in whole chunks.
    flags: Vec<u8>,
}

impl Scan {
    /// Begins anew, for an octave of this width with so many blurred layers.
    pub fn begin(&mut self, width: usize, layers: usize) {
        self.row = BORDER;
        let num_differences = layers - 1;
        self.differences.resize_with(num_differences, Default::default);
        for row in self.differences.iter_mut().flatten() {
            row.resize(width, 0.0);
        }
        self.flags.clear();
        self.flags.resize(width.next_multiple_of(CHUNK), 0);
    }

    /// Finds and refines the extrema of one octave in the rows that the first `written` ones of its blurred layers allow.
    ///
    /// D. G. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, sections 3.1 and 4.
    pub fn advance(
        &mut self,
        level: Level,
        params: &SiftParams,
        layers: &[Plane],
        written: usize,
        found: &mut Vec<Extremum>,
    ) {
        let (width, height) = (layers[0].width, layers[0].height);
        if width.min(height) <= 2 * BORDER {
            return;
        }
        let ready = if written == height { height - BORDER } else { written.saturating_sub(REACH) };
        // Half the contrast asked for, since interpolation raises it.
        let threshold = (0.5 * params.contrast_threshold / params.octave_layers as f64) as f32 * GREY_RANGE;
        if self.row == BORDER && self.row < ready {
            for y in BORDER - 1..=BORDER {
                subtract_row(level, layers, y, self);
            }
        }
        for y in self.row..ready {
            subtract_row(level, layers, y + 1, self);
            for layer in 1..self.differences.len() - 1 {
                flag_candidates(level, self, layer, y, threshold);
                for (chunk, flags) in self.flags.as_chunks::<CHUNK>().0.iter().enumerate() {
                    let mut flagged = u64::from_le_bytes(*flags);
                    while flagged != 0 {
                        let x = chunk * CHUNK + (flagged.trailing_zeros() / u8::BITS) as usize;
                        flagged &= flagged - 1;
                        if (BORDER..width - BORDER).contains(&x) && self.is_extremum(layer, x, y) {
                            found.extend(refine(params, layers, layer, x, y));
                        }
                    }
                }
            }
        }
        self.row = self.row.max(ready);
    }

    /// Whether a pixel exceeds its neighbours in place and scale; of equal ones the first does.
    fn is_extremum(&self, layer: usize, x: usize, y: usize) -> bool {
        let value = self.differences[layer][y % 3][x];
        let rows = self.differences[layer - 1..=layer + 1]
            .iter()
            .flat_map(|rows| slots(y).map(|slot| &rows[slot][x - 1..=x + 1]));
        let sign = value.signum();
        rows.flatten().enumerate().all(|(at, &neighbour)| {
            let excess = sign * (value - neighbour);
            if at < NEIGHBOURS_BEFORE { excess > 0.0 } else { excess >= 0.0 }
        })
    }
}

vectorized! {
    /// Puts row `y` of all differences into its slot.
    fn subtract_row(layers: &[Plane], y: usize, rows: &mut Scan) {
        for (index, slots) in rows.differences.iter_mut().enumerate() {
            let (finer, coarser) = (layers[index].row(y), layers[index + 1].row(y));
            for ((target, &finer), &coarser) in slots[y % 3].iter_mut().zip(finer).zip(coarser) {
                *target = coarser - finer;
            }
        }
    }
}

vectorized! {
    /// Marks the pixels of a row beyond the threshold that neither the next one in the row nor that in the column exceeds.
    ///
    /// Of four neighbours in place of all, since these leave one pixel in ten and only pixels beyond the threshold count.
    fn flag_candidates(rows: &mut Scan, layer: usize, y: usize, threshold: f32) {
        let [above, row, below] = slots(y).map(|slot| &rows.differences[layer][slot][..]);
        let inner = row.len() - 2;
        let (left, here, right) = (&row[..inner], &row[1..][..inner], &row[2..][..inner]);
        let (above, below) = (&above[1..][..inner], &below[1..][..inner]);
        let flags = &mut rows.flags[1..][..inner];
        for x in 0..inner {
            let value = here[x];
            let is_peak = u8::from(value > threshold)
                & u8::from(value >= left[x])
                & u8::from(value >= right[x])
                & u8::from(value >= above[x])
                & u8::from(value >= below[x]);
            let is_pit = u8::from(value < -threshold)
                & u8::from(value <= left[x])
                & u8::from(value <= right[x])
                & u8::from(value <= above[x])
                & u8::from(value <= below[x]);
            flags[x] = is_peak | is_pit;
        }
    }
}

/// Where [`Scan::differences`] keep the row above, the row and the one below.
fn slots(y: usize) -> [usize; 3] {
    [y - 1, y, y + 1].map(|y| y % 3)
}

/// Fits a quadratic to the 3 × 3 × 3 neighbours and moves to its extremum; `None` for what moves out, lacks contrast
/// or lies on an edge.
fn refine(
    params: &SiftParams,
    layers: &[Plane],
    layer: usize,
    begin_x: usize,
    begin_y: usize,
) -> Option<Extremum> {
    let (mut layer, mut x, mut y) = (layer, begin_x, begin_y);
    let (width, height) = (layers[0].width, layers[0].height);
    for _ in 0..MAX_MOVES {
        let value = |dx: isize, dy: isize, ds: isize| {
            let (x, y, layer) =
                (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy), layer.wrapping_add_signed(ds));
            layers[layer + 1].at(x, y) - layers[layer].at(x, y)
        };
        let here = value(0, 0, 0);
        let slope = |a: f32, b: f32| (b - a) * 0.5;
        let gradient = Vector3::new(
            slope(value(-1, 0, 0), value(1, 0, 0)),
            slope(value(0, -1, 0), value(0, 1, 0)),
            slope(value(0, 0, -1), value(0, 0, 1)),
        );
        let bend = |a: f32, b: f32| a + b - 2.0 * here;
        let (xx, yy, ss) = (
            bend(value(-1, 0, 0), value(1, 0, 0)),
            bend(value(0, -1, 0), value(0, 1, 0)),
            bend(value(0, 0, -1), value(0, 0, 1)),
        );
        let xy = (value(1, 1, 0) - value(-1, 1, 0) - value(1, -1, 0) + value(-1, -1, 0)) * 0.25;
        let xs = (value(1, 0, 1) - value(-1, 0, 1) - value(1, 0, -1) + value(-1, 0, -1)) * 0.25;
        let ys = (value(0, 1, 1) - value(0, -1, 1) - value(0, 1, -1) + value(0, -1, -1)) * 0.25;
        let offset = -(Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss).try_inverse()? * gradient);
        if !offset.iter().all(|offset| offset.abs() < 1e6) {
            return None;
        }
        if offset.iter().all(|offset| offset.abs() < MAX_OFFSET) {
            let contrast = (here + 0.5 * gradient.dot(&offset)) / GREY_RANGE;
            if f64::from(contrast.abs()) * (params.octave_layers as f64) < params.contrast_threshold {
                return None;
            }
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let edge = params.edge_threshold as f32;
            if determinant <= 0.0 || trace * trace * edge >= (edge + 1.0) * (edge + 1.0) * determinant {
                return None;
            }
            let scale = (layer as f32 + offset.z) / params.octave_layers as f32;
            return Some(Extremum {
                layer,
                column: x,
                row: y,
                x: x as f32 + offset.x,
                y: y as f32 + offset.y,
                sigma: params.sigma_px as f32 * scale.exp2(),
                contrast,
            });
        }
        let moved = |at: usize, by: f32| at as isize + by.round() as isize;
        let (new_x, new_y, new_layer) = (moved(x, offset.x), moved(y, offset.y), moved(layer, offset.z));
        let within = |at: isize, low: usize, high: usize| (low as isize..high as isize).contains(&at);
        if !within(new_layer, 1, params.octave_layers + 1)
            || !within(new_x, BORDER, width - BORDER)
            || !within(new_y, BORDER, height - BORDER)
            || new_x.abs_diff(begin_x as isize).max(new_y.abs_diff(begin_y as isize)) > MAX_WAY
        {
            return None;
        }
        (x, y, layer) = (new_x as usize, new_y as usize, new_layer as usize);
    }
    None
}
