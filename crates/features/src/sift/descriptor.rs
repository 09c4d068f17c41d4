use super::orientation::gradient_row;
use super::plane::Plane;
use super::vectorized::{Level, vectorized};
use crate::DESCRIPTOR_LEN;

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
    magnitudes: Vec<f32>,
    directions: Vec<f32>,
    column_weights: Vec<f32>,
}

/// The histogram of gradient directions in 4 × 4 cells about a point, clipped; not normalized.
///
/// D. G. Lowe, IJCV 2004, section 6.
pub(super) fn describe(
    level: Level,
    plane: &Plane,
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
    fn accumulate(
        plane: &Plane,
        frame: &Frame,
        rows: &mut DescriptorRows,
        histogram: &mut [[f32; BINS]; PADDED * PADDED],
    ) {
        let cell = CELL_SIGMAS * frame.sigma;
        // Half the side of the square of cells and of the half cells round it that still count.
        let half = (CELLS + 1) as f32 / 2.0;
        let (sine, cosine) = frame.orientation.sin_cos();
        let reach = cell * half * (sine.abs() + cosine.abs());
        let (per_x, per_y) = (cosine / cell, sine / cell);
        let turned = frame.orientation * (BINS as f32 / std::f32::consts::TAU);
        // The window's deviation is half the square of cells.
        let falloff = -2.0 / ((CELLS * CELLS) as f32 * cell * cell);
        let first = |at: f32| (at - reach).ceil().max(1.0) as usize;
        let last = |at: f32, len: usize| ((at + reach).floor() as isize).min(len as isize - 2);
        let (left, right) = (first(frame.x), last(frame.x, plane.width));
        let (top, bottom) = (first(frame.y), last(frame.y, plane.height));
        if right < left as isize || bottom < top as isize {
            return;
        }
        rows.column_weights.clear();
        rows.column_weights.extend((left..=right as usize).map(|x| {
            let dx = x as f32 - frame.x;
            (dx * dx * falloff).exp()
        }));
        rows.magnitudes.resize(rows.column_weights.len(), 0.0);
        rows.directions.resize(rows.column_weights.len(), 0.0);
        for y in top..=bottom as usize {
            let dy = y as f32 - frame.y;
            // The columns where both |u| and |v| are below half, with u = dx·per_x + dy·per_y, v = dy·per_x − dx·per_y.
            let (a_low, a_high) = columns_within(per_x, dy * per_y, half);
            let (b_low, b_high) = columns_within(-per_y, dy * per_x, half);
            let begin = ((frame.x + a_low.max(b_low)).ceil().max(left as f32)) as usize;
            let end = (frame.x + a_high.min(b_high)).floor().min(right as f32);
            if end < begin as f32 {
                continue;
            }
            let len = end as usize - begin + 1;
            let (magnitudes, directions) = (&mut rows.magnitudes[..len], &mut rows.directions[..len]);
            gradient_row(plane, y, begin, BINS as f32, magnitudes, directions);
            let row_weight = (dy * dy * falloff).exp();
            let weights = &rows.column_weights[begin - left..][..len];
            for at in 0..len {
                let dx = (begin + at) as f32 - frame.x;
                let column = dx * per_x + dy * per_y + half;
                let row = dy * per_x - dx * per_y + half;
                // Rounding may put a border pixel a hair outside.
                let (column, row) = (column.clamp(0.0, 4.9999), row.clamp(0.0, 4.9999));
                let (cell_column, cell_row) = (column as usize, row as usize);
                let (column, row) = (column - cell_column as f32, row - cell_row as f32);
                let mut direction = turned - directions[at];
                direction = if direction < 0.0 { direction + BINS as f32 } else { direction };
                let weight = row_weight * weights[at] * magnitudes[at];
                let mut spread = [0.0f32; BINS];
                for bin in 0..BINS {
                    let apart = (direction - bin as f32).abs();
                    let apart = if BINS as f32 - apart < apart { BINS as f32 - apart } else { apart };
                    let near = 1.0 - apart;
                    spread[bin] = if near > 0.0 { near * weight } else { 0.0 };
                }
                let base = cell_row * PADDED + cell_column;
                let shares = [
                    (0, (1.0 - row) * (1.0 - column)),
                    (1, (1.0 - row) * column),
                    (PADDED, row * (1.0 - column)),
                    (PADDED + 1, row * column),
                ];
                for (offset, share) in shares {
                    let target = &mut histogram[base + offset];
                    for bin in 0..BINS {
                        target[bin] += spread[bin] * share;
                    }
                }
            }
        }
    }
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
