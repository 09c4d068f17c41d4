use super::Extremum;
use super::plane::Plane;
use super::vectorized::{Level, vectorized};

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
    magnitudes: Vec<f32>,
    bins: Vec<f32>,
}

/// The main directions of the gradients about a point, in radians clockwise from image right.
///
/// D. G. Lowe, IJCV 2004, section 5.
pub(super) fn orientations(
    level: Level,
    plane: &Plane,
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
    rows.magnitudes.resize(2 * radius + 1, 0.0);
    rows.bins.resize(2 * radius + 1, 0.0);
    for y in top..=bottom {
        let (magnitudes, bins) = (&mut rows.magnitudes[..=right - left], &mut rows.bins[..=right - left]);
        gradients(level, plane, y, left, BINS as f32, magnitudes, bins);
        let row_weight = rows.weights[y.abs_diff(extremum.row)];
        for (at, (&magnitude, &bin)) in magnitudes.iter().zip(&*bins).enumerate() {
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
    fn gradients(plane: &Plane, y: usize, left: usize, turn: f32, magnitudes: &mut [f32], directions: &mut [f32]) {
        gradient_row(plane, y, left, turn, magnitudes, directions);
    }
}

/// Magnitudes of the gradients of a row from column `left` on, and their directions, clockwise from image right, in
/// `turn`ths of a turn within [0, turn].
#[inline(always)]
pub(super) fn gradient_row(
    plane: &Plane,
    y: usize,
    left: usize,
    turn: f32,
    magnitudes: &mut [f32],
    directions: &mut [f32],
) {
    let len = magnitudes.len();
    let row = &plane.row(y)[left - 1..=left + len];
    let (above, below) = (&plane.row(y - 1)[left..left + len], &plane.row(y + 1)[left..left + len]);
    let directions = &mut directions[..len];
    for x in 0..len {
        let (dx, dy) = (row[x + 2] - row[x], below[x] - above[x]);
        magnitudes[x] = (dx * dx + dy * dy).sqrt();
        directions[x] = turns(dx, dy) * turn;
    }
}

/// The angle of (x, y) in turns within [0, 1], to 2e-6: M. Abramowitz, I. A. Stegun, "Handbook of Mathematical
/// Functions", 1964, equation 4.4.49.
#[inline(always)]
fn turns(x: f32, y: f32) -> f32 {
    let (across, along) = (y.abs(), x.abs());
    let steep = across > along;
    let (small, large) = if steep { (along, across) } else { (across, along) };
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
