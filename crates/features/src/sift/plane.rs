use super::vectorized::{Level, vectorized};

/// Pixels that one step of the blur keeps in registers.
const BLOCK: usize = 64;

/// One layer of the pyramid, row-major.
#[derive(Debug, Default)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

impl Plane {
    /// Gives the plane this size; its values are left to be overwritten.
    pub fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.values.resize(width * height, 0.0);
    }

    pub fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    /// The value at column `x` of row `y`.
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.values[y * self.width + x]
    }

    /// The grey values as they are.
    pub fn set(&mut self, width: usize, height: usize, grey: &[u8]) {
        self.resize(width, height);
        for (value, &grey) in self.values.iter_mut().zip(grey) {
            *value = f32::from(grey);
        }
    }

    /// Twice the size by linear interpolation: pixel `x` comes to lie at 2x + ½.
    pub fn set_doubled(&mut self, width: usize, height: usize, grey: &[u8]) {
        self.resize(width * 2, height * 2);
        let stretch = |from: &[f32], into: &mut [f32]| {
            for x in 0..width {
                let (left, here, right) = (from[x.saturating_sub(1)], from[x], from[(x + 1).min(width - 1)]);
                into[2 * x] = 0.25 * left + 0.75 * here;
                into[2 * x + 1] = 0.75 * here + 0.25 * right;
            }
        };
        let mut between = vec![0.0; width];
        for (y, target) in self.values.chunks_exact_mut(width * 2).enumerate() {
            let near = y / 2;
            let far = if y % 2 == 0 { near.saturating_sub(1) } else { (near + 1).min(height - 1) };
            let (near, far) = (&grey[near * width..][..width], &grey[far * width..][..width]);
            for ((value, &near), &far) in between.iter_mut().zip(near).zip(far) {
                *value = 0.75 * f32::from(near) + 0.25 * f32::from(far);
            }
            stretch(&between, target);
        }
    }

    /// Every second pixel of `source`, beginning with the first: pixel `x` is the source's 2x for any size.
    pub fn set_halved(&mut self, source: &Self) {
        self.resize(source.width.div_ceil(2), source.height.div_ceil(2));
        for (y, target) in self.values.chunks_exact_mut(self.width).enumerate() {
            for (value, &from) in target.iter_mut().zip(source.row(2 * y).iter().step_by(2)) {
                *value = from;
            }
        }
    }
}

/// Weights of a Gaussian of this deviation in pixels from the middle outwards, four deviations far.
pub(super) fn gaussian(sigma: f64) -> Vec<f32> {
    let radius = (4.0 * sigma).round().max(1.0) as i32;
    let weight = |x: i32| (-f64::from(x * x) / (2.0 * sigma * sigma)).exp();
    let sum: f64 = (-radius..=radius).map(weight).sum();
    (0..=radius).map(|x| (weight(x) / sum) as f32).collect()
}

/// Blurs by the weights of [`gaussian`], the image being mirrored about its outermost pixels.
pub(super) fn blur(level: Level, weights: &[f32], source: &Plane, target: &mut Plane) {
    target.resize(source.width, source.height);
    let mut row = vec![0.0; source.width + 2 * (weights.len() - 1)];
    blur_rows(level, weights, source, &mut target.values, &mut row);
}

vectorized! {
    fn blur_rows(weights: &[f32], source: &Plane, target: &mut [f32], row: &mut [f32]) {
        let (width, radius) = (source.width, weights.len() - 1);
        let mut pairs = Vec::with_capacity(radius);
        for (y, target) in target.chunks_exact_mut(width).enumerate() {
            // Down the columns into a row with room for the mirrored ends, then along that row.
            let around = |step: isize| source.row(mirror(y as isize + step, source.height));
            pairs.clear();
            pairs.extend((1..=radius as isize).map(|step| [around(-step), around(step)]));
            weigh(weights, source.row(y), &pairs, &mut row[radius..radius + width]);
            for step in 1..=radius {
                row[radius - step] = row[radius + mirror(-(step as isize), width)];
                row[radius + width - 1 + step] = row[radius + mirror((width - 1 + step) as isize, width)];
            }
            let shifted = |by: usize| &row[by..by + width];
            let mut pairs = Vec::with_capacity(radius);
            pairs.extend((1..=radius).map(|step| [shifted(radius - step), shifted(radius + step)]));
            weigh(weights, shifted(radius), &pairs, target);
        }
    }
}

/// The middle row and pairs of rows equally far from it, weighted and summed.
#[inline(always)]
fn weigh(weights: &[f32], middle: &[f32], pairs: &[[&[f32]; 2]], target: &mut [f32]) {
    let mut begin = 0;
    while begin + BLOCK <= target.len() {
        let mut sums = [0.0f32; BLOCK];
        let middle: &[f32; BLOCK] = block(middle, begin);
        for lane in 0..BLOCK {
            sums[lane] = weights[0] * middle[lane];
        }
        for (&weight, [before, after]) in weights[1..].iter().zip(pairs) {
            let (before, after) = (block(before, begin), block(after, begin));
            for lane in 0..BLOCK {
                sums[lane] += weight * (before[lane] + after[lane]);
            }
        }
        target[begin..begin + BLOCK].copy_from_slice(&sums);
        begin += BLOCK;
    }
    for x in begin..target.len() {
        let mut sum = weights[0] * middle[x];
        for (&weight, [before, after]) in weights[1..].iter().zip(pairs) {
            sum += weight * (before[x] + after[x]);
        }
        target[x] = sum;
    }
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
        let value =
            |at: usize| ((at % width) as f32 * 0.37).sin() * 50.0 + ((at / width) as f32 * 0.21).cos();
        Plane { width, height, values: (0..width * height).map(value).collect() }
    }

    #[test]
    fn mirroring_repeats_neither_end() {
        let indices: Vec<usize> = (-4..8).map(|at| mirror(at, 4)).collect();
        assert_eq!(indices, [2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1]);
        assert_eq!((mirror(-3, 1), mirror(5, 1)), (0, 0));
    }

    #[test]
    fn blurring_equals_its_definition_at_all_levels() {
        for (width, height) in [(130, 21), (64, 5), (3, 2), (1, 1)] {
            let (source, weights) = (wavy(width, height), gaussian(1.3));
            let mut target = Plane::default();
            blur(Level::detect(), &weights, &source, &mut target);
            let mut baseline = Plane::default();
            blur(Level::Baseline, &weights, &source, &mut baseline);
            assert_eq!(target.values, baseline.values);
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

    #[test]
    fn doubling_and_halving_keep_a_ramp() {
        let grey: Vec<u8> = (0..15).map(|at| 10 + 20 * (at % 5)).collect();
        let mut doubled = Plane::default();
        doubled.set_doubled(5, 3, &grey);
        assert_eq!(doubled.row(3)[1..9], [15.0, 25.0, 35.0, 45.0, 55.0, 65.0, 75.0, 85.0]);
        let mut halved = Plane::default();
        halved.set_halved(&doubled);
        assert_eq!((halved.width, halved.height), (5, 3));
        assert_eq!(halved.row(1), [10.0, 25.0, 45.0, 65.0, 85.0]);
    }
}
