use std::ops::RangeInclusive;

use super::orientation::gradients_of_block;
use super::plane::{Kept, LANES, Plane};
use crate::DESCRIPTOR_LEN;
use crate::{vectorized, vectorized::Level};

/// Spatial cells along each side.
const CELLS: usize = 4;
/// Directions per cell.
const BINS: usize = 8;
/// Side of a cell in deviations of the keypoint.
const CELL_SIGMAS: f32 = 3.0;
/// Largest component as a share of the length, against single strong edges.
const CLIP: f32 = 0.2;
/// Cells along each side with those that catch what lies half outside.
const PADDED: usize = CELLS + 2;
/// From the first of the four cells that share a pixel to each of them.
const NEIGHBOURS: [usize; 4] = [0, 1, PADDED, PADDED + 1];

/// Where and how to describe, in pixels of the octave.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub x: f32,
    pub y: f32,
    pub sigma: f32,
    /// Radians clockwise from image right.
    pub orientation: f32,
}

/// Buffers of [`describe`].
#[derive(Debug, Default)]
pub(super) struct DescriptorRows {
    column_weights: Vec<[f32; LANES]>,
    spots: Vec<Spots>,
}

/// Where pixels of a row lie in the histogram.
#[derive(Debug, Default, Clone, Copy)]
struct Spots {
    /// The first of the four cells that share a pixel.
    cells: [f32; LANES],
    /// How far the pixel lies towards the next cell to the right and downwards, as a share of a cell.
    across: [f32; LANES],
    down: [f32; LANES],
    directions: [f32; LANES],
    weights: [f32; LANES],
}

/// Half the side of the square of cells and of the half cells round it that still count.
const HALF: f32 = (CELLS + 1) as f32 / 2.0;

impl Frame {
    /// Columns and rows of the pixels that are looked at; `None` where there are none.
    fn pixels(&self, plane: &Plane<Kept>) -> Option<[RangeInclusive<usize>; 2]> {
        let (sine, cosine) = self.orientation.sin_cos();
        let reach = CELL_SIGMAS * self.sigma * HALF * (sine.abs() + cosine.abs());
        let within = |at: f32, len: usize| {
            let first = (at - reach).ceil().max(1.0) as usize;
            let last = ((at + reach).floor() as isize).min(len as isize - 2);
            (last >= first as isize).then_some(first..=last as usize)
        };
        Some([within(self.x, plane.width)?, within(self.y, plane.height)?])
    }
}

/// Asks for the pixels that [`describe`] will read, which are seldom in a cache otherwise.
pub(super) fn prefetch(plane: &Plane<Kept>, frame: &Frame) {
    if let Some([columns, rows]) = frame.pixels(plane) {
        for y in rows {
            plane.prefetch(y, *columns.start()..*columns.end() + 1);
        }
    }
}

/// The histogram of gradient directions in 4 × 4 cells about a point, clipped; not normalized.
///
/// D. G. Lowe, IJCV 2004, section 6.
pub(super) fn describe(
    level: Level,
    plane: &Plane<Kept>,
    frame: &Frame,
    rows: &mut DescriptorRows,
) -> [f32; DESCRIPTOR_LEN] {
    let mut histogram = [[0.0; BINS]; PADDED * PADDED];
    accumulate(level, plane, frame, rows, &mut histogram);
    let mut descriptor = [0.0; DESCRIPTOR_LEN];
    for (cell, target) in descriptor.chunks_exact_mut(BINS).enumerate() {
        target.copy_from_slice(&histogram[(cell / CELLS + 1) * PADDED + cell % CELLS + 1]);
    }
    let limit = CLIP * descriptor.iter().map(|value| value * value).sum::<f32>().sqrt();
    descriptor.map(|value| value.min(limit))
}

vectorized! {
    /// Adds the gradients of all pixels within the cells.
    pub(super) fn accumulate(
        plane: &Plane<Kept>,
        frame: &Frame,
        rows: &mut DescriptorRows,
        histogram: &mut [[f32; BINS]; PADDED * PADDED],
    ) {
        let cell = CELL_SIGMAS * frame.sigma;
        let Some([columns, lines]) = frame.pixels(plane) else {
            return;
        };
        let (left, right) = columns.into_inner();
        let (sine, cosine) = frame.orientation.sin_cos();
        let (per_x, per_y) = (cosine / cell, sine / cell);
        let turned = frame.orientation * (BINS as f32 / std::f32::consts::TAU);
        // The window's deviation is half the square of cells.
        let falloff = -2.0 / ((CELLS * CELLS) as f32 * cell * cell);
        // Blocks begin at the first column of each row, so weights are laid out for one more.
        let blocks = (right + 1 - left).div_ceil(LANES) + 1;
        rows.column_weights.clear();
        rows.column_weights.extend((0..blocks).map(|block| {
            std::array::from_fn(|lane| {
                let dx = (left + block * LANES + lane) as f32 - frame.x;
                (dx * dx * falloff).exp()
            })
        }));
        rows.spots.resize(blocks, Spots::default());
        for y in lines {
            let dy = y as f32 - frame.y;
            // The columns where both |u| and |v| are below half, with u = dx·per_x + dy·per_y, v = dy·per_x − dx·per_y.
            let (a_low, a_high) = columns_within(per_x, dy * per_y, HALF);
            let (b_low, b_high) = columns_within(-per_y, dy * per_x, HALF);
            let begin = ((frame.x + a_low.max(b_low)).ceil().max(left as f32)) as usize;
            let end = (frame.x + a_high.min(b_high)).floor().min(right as f32);
            if end < begin as f32 {
                continue;
            }
            let len = end as usize - begin + 1;
            let row_weight = (dy * dy * falloff).exp();
            for (block, spots) in rows.spots[..len.div_ceil(LANES)].iter_mut().enumerate() {
                let first = begin + block * LANES;
                let weights = &rows.column_weights.as_flattened()[first - left..][..LANES];
                let (magnitudes, directions) = gradients_of_block(plane, y, first, BINS as f32);
                for lane in 0..LANES {
                    let dx = (first + lane) as f32 - frame.x;
                    let column = dx * per_x + dy * per_y + HALF;
                    let row = dy * per_x - dx * per_y + HALF;
                    // Rounding may put a border pixel a hair outside.
                    let (column, row) = (column.clamp(0.0, 4.9999), row.clamp(0.0, 4.9999));
                    let (cell_column, cell_row) = (whole_cells(column), whole_cells(row));
                    spots.cells[lane] = cell_row * PADDED as f32 + cell_column;
                    (spots.across[lane], spots.down[lane]) = (column - cell_column, row - cell_row);
                    spots.weights[lane] = row_weight * weights[lane] * magnitudes[lane];
                    let direction = turned - directions[lane];
                    spots.directions[lane] = if direction < 0.0 { direction + BINS as f32 } else { direction };
                }
            }
            // Neighbours mostly share the same four cells: these are summed in registers as long as they do.
            let mut cell = rows.spots[0].cells[0];
            let mut sums = NEIGHBOURS.map(|offset| histogram[cell as usize + offset]);
            for at in 0..len {
                let (spots, lane) = (&rows.spots[at / LANES], at % LANES);
                if spots.cells[lane] != cell {
                    for (offset, sums) in NEIGHBOURS.into_iter().zip(sums) {
                        histogram[cell as usize + offset] = sums;
                    }
                    cell = spots.cells[lane];
                    sums = NEIGHBOURS.map(|offset| histogram[cell as usize + offset]);
                }
                let (direction, weight) = (spots.directions[lane], spots.weights[lane]);
                let mut spread = [0.0f32; BINS];
                for bin in 0..BINS {
                    let apart = (direction - bin as f32).abs();
                    let apart = if BINS as f32 - apart < apart { BINS as f32 - apart } else { apart };
                    let near = 1.0 - apart;
                    spread[bin] = if near > 0.0 { near * weight } else { 0.0 };
                }
                let (column, row) = (spots.across[lane], spots.down[lane]);
                let shares =
                    [(1.0 - row) * (1.0 - column), (1.0 - row) * column, row * (1.0 - column), row * column];
                for (sums, share) in sums.iter_mut().zip(shares) {
                    for bin in 0..BINS {
                        sums[bin] += spread[bin] * share;
                    }
                }
            }
            for (offset, sums) in NEIGHBOURS.into_iter().zip(sums) {
                histogram[cell as usize + offset] = sums;
            }
        }
    }
}

/// The whole part of a number within [0, 5), of a whole number itself or one less.
///
/// Conversions to integers have to bear any number, and compilers leave them to be done one by one.
#[inline(always)]
fn whole_cells(cells: f32) -> f32 {
    // In floats of this size the last bit is worth 1.
    const ROUNDING: f32 = 12_582_912.0;
    (cells - 0.5) + ROUNDING - ROUNDING
}

/// The `x` for which |x·slope + offset| < half.
#[inline(always)]
fn columns_within(slope: f32, offset: f32, half: f32) -> (f32, f32) {
    let (a, b) = ((-half - offset) / slope, (half - offset) / slope);
    if slope.abs() < 1e-9 {
        if offset.abs() < half { (f32::MIN, f32::MAX) } else { (f32::MAX, f32::MIN) }
    } else if a < b {
        (a, b)
    } else {
        (b, a)
    }
}
