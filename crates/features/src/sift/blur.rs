//! Separable Gaussian blurring.

use super::plane::{BLOCK, Plane};
use crate::{vectorized, vectorized::Level};

/// Rows that are blurred together; even.
pub(super) const GROUP: usize = 16;

/// Weights of a Gaussian of this deviation in pixels from the middle outwards, four deviations far.
fn gaussian(sigma: f64) -> Vec<f32> {
    let radius = (4.0 * sigma).round().max(1.0) as i32;
    let weight = |x: i32| (-f64::from(x * x) / (2.0 * sigma * sigma)).exp();
    let sum: f64 = (-radius..=radius).map(weight).sum();
    (0..=radius).map(|x| (weight(x) / sum) as f32).collect()
}

/// Blurs by the weights of [`gaussian`], the image being mirrored about its outermost pixels.
#[derive(Debug)]
pub(super) struct Blur {
    weights: Vec<f32>,
    /// Rows that are blurred already.
    done: usize,
    /// Rows blurred downwards, with room for the mirrored ends.
    rows: Plane,
}

impl Blur {
    pub fn new(sigma: f64) -> Self {
        Self { weights: gaussian(sigma), done: 0, rows: Plane::default() }
    }

    pub fn radius(&self) -> usize {
        self.weights.len() - 1
    }

    /// Rows that are blurred already.
    pub fn done(&self) -> usize {
        self.done
    }

    /// Blurs the next rows that the source's first `written` ones allow, a [`GROUP`] at most, and says how many are done.
    pub fn advance(&mut self, level: Level, source: &Plane, written: usize, target: &mut Plane) -> usize {
        let ready = if written == source.height { written } else { written.saturating_sub(self.radius()) };
        self.rows.resize(source.padded_width() + 2 * self.radius(), GROUP);
        let count = GROUP.min(ready.saturating_sub(self.done));
        if count > 0 {
            blur_rows(level, &self.weights, source, target, self.done, count, &mut self.rows);
        }
        self.done += count;
        self.done
    }
}

vectorized! {
    fn blur_rows(
        weights: &[f32],
        source: &Plane,
        target: &mut Plane,
        top: usize,
        count: usize,
        rows: &mut Plane,
    ) {
        let (width, padded, radius) = (source.width, source.padded_width(), weights.len() - 1);
        let mut lines = Vec::with_capacity(GROUP + 2 * radius);
        lines.extend((0..count.next_multiple_of(2) + 2 * radius).map(|line| {
            let y = (top + line) as isize - radius as isize;
            &source.padded_row(mirror(y, source.height))[..padded]
        }));
        for begin in (0..padded).step_by(BLOCK) {
            for row in (0..count).step_by(2) {
                let [upper, lower] = down(weights, &lines[row..=row + 1 + 2 * radius], begin);
                rows.padded_row_mut(row)[radius + begin..][..BLOCK].copy_from_slice(&upper);
                rows.padded_row_mut(row + 1)[radius + begin..][..BLOCK].copy_from_slice(&lower);
            }
        }
        for row in 0..count {
            let line = &mut rows.padded_row_mut(row)[..padded + 2 * radius];
            for step in 1..=radius {
                line[radius - step] = line[radius + mirror(-(step as isize), width)];
                line[radius + width - 1 + step] = line[radius + mirror((width - 1 + step) as isize, width)];
            }
            let target = target.padded_row_mut(top + row);
            for begin in (0..padded).step_by(BLOCK) {
                target[begin..begin + BLOCK].copy_from_slice(&along(weights, line, begin));
            }
        }
    }
}

/// Two successive rows, the first in the middle of all `lines` but the last, weighted downwards from column `begin` on.
///
/// What one reads above and below itself the other reads a step later, so each line is loaded once for both.
#[inline(always)]
fn down(weights: &[f32], lines: &[&[f32]], begin: usize) -> [[f32; BLOCK]; 2] {
    let radius = weights.len() - 1;
    let (mut above, mut below) = (*block(lines[radius], begin), *block(lines[radius + 1], begin));
    let (mut upper, mut lower) = ([0.0; BLOCK], [0.0; BLOCK]);
    for lane in 0..BLOCK {
        upper[lane] = weights[0] * above[lane];
        lower[lane] = weights[0] * below[lane];
    }
    for step in 1..=radius {
        let weight = weights[step];
        let (next_above, next_below) =
            (*block(lines[radius - step], begin), *block(lines[radius + 1 + step], begin));
        for lane in 0..BLOCK {
            upper[lane] += weight * (next_above[lane] + below[lane]);
            lower[lane] += weight * (above[lane] + next_below[lane]);
        }
        (above, below) = (next_above, next_below);
    }
    [upper, lower]
}

/// A block of a row that begins `begin` values into `line`, which has as many more at both ends as there are steps.
#[inline(always)]
fn along(weights: &[f32], line: &[f32], begin: usize) -> [f32; BLOCK] {
    let radius = weights.len() - 1;
    let middle = block(line, begin + radius);
    let mut sums = [0.0; BLOCK];
    for lane in 0..BLOCK {
        sums[lane] = weights[0] * middle[lane];
    }
    for step in 1..=radius {
        let (before, after) = (block(line, begin + radius - step), block(line, begin + radius + step));
        for lane in 0..BLOCK {
            sums[lane] += weights[step] * (before[lane] + after[lane]);
        }
    }
    sums
}

#[inline(always)]
fn block(values: &[f32], begin: usize) -> &[f32; BLOCK] {
    values[begin..begin + BLOCK].try_into().expect("a slice of this length")
}

/// The index within `0..len` that lies at `at` when the range is mirrored about its ends again and again.
fn mirror(at: isize, len: usize) -> usize {
    let period = 2 * (len as isize - 1);
    if period == 0 {
        return 0;
    }
    let within = at.rem_euclid(period);
    within.min(period - within) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wavy(width: usize, height: usize) -> Plane {
        let mut plane = Plane::default();
        plane.resize(width, height);
        for y in 0..height {
            for (x, value) in plane.row_mut(y).iter_mut().enumerate() {
                *value = (x as f32 * 0.37).sin() * 50.0 + (y as f32 * 0.21).cos();
            }
        }
        plane
    }

    fn blurred(level: Level, sigma: f64, source: &Plane) -> Plane {
        let mut target = Plane::default();
        target.resize(source.width, source.height);
        let mut blur = Blur::new(sigma);
        // In parts, as rows come.
        let mut written = 0;
        while blur.advance(level, source, written, &mut target) < source.height {
            written = (written + 7).min(source.height);
        }
        target
    }

    #[test]
    fn mirroring_repeats_neither_end() {
        let indices: Vec<usize> = (-4..8).map(|at| mirror(at, 4)).collect();
        assert_eq!(indices, [2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1]);
        assert_eq!((mirror(-3, 1), mirror(5, 1)), (0, 0));
    }

    #[test]
    fn blurring_equals_its_definition_at_all_levels() {
        for (width, height) in [(130, 21), (64, 35), (64, 5), (3, 2), (1, 1)] {
            let (source, weights) = (wavy(width, height), gaussian(1.3));
            let target = blurred(Level::detect(), 1.3, &source);
            let baseline = blurred(Level::BASELINE, 1.3, &source);
            for y in 0..height {
                assert_eq!(target.row(y), baseline.row(y));
            }
            let weight = |offset: isize| f64::from(weights[offset.unsigned_abs()]);
            let reach = weights.len() as isize - 1;
            for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                let mut sum = 0.0;
                for (dx, dy) in (-reach..=reach).flat_map(|dx| (-reach..=reach).map(move |dy| (dx, dy))) {
                    let (from_x, from_y) = (mirror(x as isize + dx, width), mirror(y as isize + dy, height));
                    sum += weight(dx) * weight(dy) * f64::from(source.at(from_x, from_y));
                }
                assert!((sum - f64::from(target.at(x, y))).abs() < 1e-4);
            }
        }
    }
}
