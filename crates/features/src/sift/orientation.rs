use super::Extremum;
use super::plane::{Kept, LANES, Plane, grey};
use crate::{vectorized, vectorized::Level};

/// Directions of the histogram.
const BINS: usize = 36;
/// Deviation of the window, in deviations of the keypoint.
const WINDOW: f32 = 1.5;
/// Least height of a further direction, as a share of the highest.
const PEAK_SHARE: f32 = 0.8;

/// Buffers of [`orientations`].
#[derive(Debug, Default)]
pub(super) struct OrientationRows {
    weights: Vec<f32>,
    magnitudes: Vec<[f32; LANES]>,
    bins: Vec<[f32; LANES]>,
}

/// The main directions of the gradients about a point, in radians clockwise from image right.
///
/// D. G. Lowe, IJCV 2004, section 5.
pub(super) fn orientations(
    level: Level,
    plane: &Plane<Kept>,
    extremum: &Extremum,
    rows: &mut OrientationRows,
    mut found: impl FnMut(f32),
) {
    let sigma = WINDOW * extremum.sigma;
    let radius = (3.0 * sigma).round() as usize;
    rows.weights.clear();
    rows.weights.extend((0..=radius).map(|at| (-((at * at) as f32) / (2.0 * sigma * sigma)).exp()));
    let mut histogram = [0.0; BINS];
    let left = extremum.column.saturating_sub(radius).max(1);
    let right = (extremum.column + radius).min(plane.width - 2);
    let top = extremum.row.saturating_sub(radius).max(1);
    let bottom = (extremum.row + radius).min(plane.height - 2);
    let len = right + 1 - left;
    rows.magnitudes.resize(len.div_ceil(LANES), [0.0; LANES]);
    rows.bins.resize(len.div_ceil(LANES), [0.0; LANES]);
    for y in top..=bottom {
        gradients(level, plane, y, left, &mut rows.magnitudes, &mut rows.bins);
        let (magnitudes, bins) = (rows.magnitudes.as_flattened(), rows.bins.as_flattened());
        let row_weight = rows.weights[y.abs_diff(extremum.row)];
        for (at, (&magnitude, &bin)) in magnitudes[..len].iter().zip(bins).enumerate() {
            let weight = row_weight * rows.weights[(left + at).abs_diff(extremum.column)];
            // A bin's centre lies at its number.
            let bin = (bin + 0.5) as usize;
            histogram[if bin >= BINS { bin - BINS } else { bin }] += weight * magnitude;
        }
    }
    let at = |bin: usize, offset: usize| histogram[(bin + BINS + offset - 2) % BINS];
    let smooth: [f32; BINS] = std::array::from_fn(|bin| {
        (at(bin, 0) + at(bin, 4)) / 16.0 + (at(bin, 1) + at(bin, 3)) / 4.0 + at(bin, 2) * 0.375
    });
    let highest = smooth.iter().copied().fold(0.0, f32::max);
    for bin in 0..BINS {
        let (before, here, after) = (smooth[(bin + BINS - 1) % BINS], smooth[bin], smooth[(bin + 1) % BINS]);
        if here > before && here > after && here >= PEAK_SHARE * highest {
            let peak = bin as f32 + 0.5 * (before - after) / (before - 2.0 * here + after);
            found((peak * (std::f32::consts::TAU / BINS as f32)).rem_euclid(std::f32::consts::TAU));
        }
    }
}

vectorized! {
    pub(super) fn gradients(plane: &Plane<Kept>, y: usize, left: usize, magnitudes: &mut [[f32; LANES]], bins: &mut [[f32; LANES]]) {
        for (block, (magnitudes, bins)) in magnitudes.iter_mut().zip(bins).enumerate() {
            (*magnitudes, *bins) = gradients_of_block(plane, y, left + block * LANES, BINS as f32);
        }
    }
}

/// Magnitudes of the gradients of [`LANES`] pixels from column `left` on, and their directions, clockwise from image right, in
/// `turn`ths of a turn within [0, turn]. Beyond the row's end, any numbers.
#[inline(always)]
pub(super) fn gradients_of_block(
    plane: &Plane<Kept>,
    y: usize,
    left: usize,
    turn: f32,
) -> ([f32; LANES], [f32; LANES]) {
    let at = |y: usize, x: usize| -> &[Kept; LANES] {
        plane.padded_row(y)[x..x + LANES].try_into().expect("a slice of this length")
    };
    let (before, after) = (at(y, left - 1), at(y, left + 1));
    let (above, below) = (at(y - 1, left), at(y + 1, left));
    let (mut magnitudes, mut directions) = ([0.0; LANES], [0.0; LANES]);
    for lane in 0..LANES {
        let dx = grey(after[lane]) - grey(before[lane]);
        let dy = grey(below[lane]) - grey(above[lane]);
        magnitudes[lane] = (dx * dx + dy * dy).sqrt();
        directions[lane] = turns(dx, dy) * turn;
    }
    (magnitudes, directions)
}

/// The angle of (x, y) in turns within [0, 1], to 2e-6: M. Abramowitz, I. A. Stegun, "Handbook of Mathematical
/// Functions", 1964, equation 4.4.49.
#[inline(always)]
fn turns(x: f32, y: f32) -> f32 {
    let (across, along) = (y.abs(), x.abs());
    let steep = across > along;
    // Chosen one by one: a choice of the pair makes compilers do everything twice.
    let small = if steep { along } else { across };
    let large = if steep { across } else { along };
    let ratio = small / (large + f32::MIN_POSITIVE);
    let square = ratio * ratio;
    let angle = ratio
        * (0.999866
            + square * (-0.3302995 + square * (0.180141 + square * (-0.085133 + square * 0.0208351))))
        * (1.0 / std::f32::consts::TAU);
    let angle = if steep { 0.25 - angle } else { angle };
    let angle = if x < 0.0 { 0.5 - angle } else { angle };
    if y < 0.0 { 1.0 - angle } else { angle }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_right_in_all_quadrants() {
        for step in 0..1000 {
            let angle = step as f32 / 1000.0 * std::f32::consts::TAU;
            let (sine, cosine) = angle.sin_cos();
            let found = turns(cosine * 3.0, sine * 3.0);
            let difference = (found - step as f32 / 1000.0).abs();
            assert!(difference.min(1.0 - difference) < 4e-6, "{step}: {found}");
        }
        assert_eq!(turns(0.0, 0.0), 0.0);
    }
}
