use crate::GreyImage;
use crate::{vectorized, vectorized::Level};

/// Most halvings; patches of larger keypoints are not aligned any finer for being taken coarser.
const MAX_LEVELS: usize = 6;
/// Shortest side that is still halved.
const MIN_SIDE: usize = 64;

/// A grey image with ever smaller copies of it, to sample patches of any scale from.
#[derive(Debug, Clone, PartialEq)]
pub struct ImagePyramid {
    levels: Vec<GreyImage>,
    wraps_around: bool,
}

impl ImagePyramid {
    /// The image and its halvings; `wraps_around` when its left and right ends meet, as a full panorama's do.
    pub fn new(image: GreyImage, wraps_around: bool) -> Self {
        let mut levels = vec![image];
        while let Some(last) = levels.last() {
            // An odd width would move the seam.
            let closes = !wraps_around || last.width.is_multiple_of(2);
            if levels.len() > MAX_LEVELS || last.width.min(last.height) < 2 * MIN_SIDE || !closes {
                break;
            }
            let half = last.halved(wraps_around);
            levels.push(half);
        }
        Self { levels, wraps_around }
    }

    /// Bytes held.
    pub fn byte_size(&self) -> usize {
        self.levels.iter().map(|level| level.values.len()).sum()
    }

    /// The level whose pixels are nearest to `spacing` pixels of the image in size, rather finer than coarser.
    pub(super) fn level_for(&self, spacing: f64) -> usize {
        // Half a halving on the logarithmic scale would be the nearest; a quarter keeps detail.
        let level = (spacing.max(1.0).log2() + 0.25).floor() as usize;
        level.min(self.levels.len() - 1)
    }

    /// Samples one level bilinearly at the pixels of a grid, for whole numbers up to `radius`, row by row; false when one
    /// lies outside.
    pub(super) fn sample(&self, level: usize, grid: &Grid, radius: usize, samples: &mut Samples) -> bool {
        let scale = 1.0 / f64::from(1_u32 << level);
        let level = &self.levels[level];
        let Samples { places: [columns, rows], offsets, corners, values } = samples;
        // Places are taken from a pixel so near that single precision tells a hundred-thousandth of a pixel apart, and
        // so far to the upper left that all are positive.
        if !grid.0.iter().all(Quadratic::is_sane) {
            return false;
        }
        let origin = grid.0.each_ref().map(|axis| (axis.constant * scale - 0.5).floor() - REACH);
        let (left, right) = grid.0[0].places(scale, origin[0], radius, columns);
        let (top, bottom) = grid.0[1].places(scale, origin[1], radius, rows);
        let positive = left >= 0.0 && top >= 0.0 && right < 2.0 * REACH as f32 && bottom < 2.0 * REACH as f32;
        let origin = origin.map(|origin| origin as isize);
        let lowest = [left, top].map(|place| place as isize);
        let highest = [right, bottom].map(|place| place as isize);
        let (width, height) = (level.width as isize, level.height as isize);
        if !positive || origin[1] + lowest[1] < 0 || origin[1] + highest[1] + 1 >= height {
            return false;
        }
        let inside = origin[0] + lowest[0] >= 0 && origin[0] + highest[0] + 1 < width;
        if !inside && !self.wraps_around {
            return false;
        }
        corners.clear();
        if !inside {
            corners.extend(columns.iter().zip(rows.iter()).map(|(&x, &y)| {
                let start = (origin[1] + y as isize) * width;
                let at = |column: isize| (start + (origin[0] + column).rem_euclid(width)) as usize;
                level.corners([at(x as isize), at(x as isize + 1)])
            }));
        }
        offsets.resize(columns.len(), 0);
        split(Level::detect(), columns, rows, width as i32, offsets);
        if inside {
            let first = origin[1] * width + origin[0];
            corners.extend(offsets.iter().map(|&offset| {
                let at = (first + offset as isize) as usize;
                level.corners([at, at + 1])
            }));
        }
        values.resize(corners.len(), 0.0);
        interpolate(Level::detect(), corners, columns, rows, values);
        true
    }
}

/// Farthest that a sample may be from the middle of its patch, in pixels of the level.
const REACH: f64 = 512.0;

/// Two functions of the steps (x, y) of a patch: the column and the row of the pixel there.
#[derive(Debug, Clone)]
pub(super) struct Grid(pub [Quadratic; 2]);

/// constant + linear·(x, y) + square·(x², y²) + mixed·x·y.
#[derive(Debug, Clone)]
pub(super) struct Quadratic {
    pub constant: f64,
    pub linear: [f64; 2],
    pub square: [f64; 2],
    pub mixed: f64,
}

impl Quadratic {
    /// Whether all is finite and of the size of images, so that no place overflows.
    fn is_sane(&self) -> bool {
        let Self { constant, linear, square, mixed } = self;
        linear.iter().chain(square).chain([constant, mixed]).all(|value| value.abs() < 1e9)
    }

    /// The places on a level, from the pixel `origin` of it on; returns the lowest and the highest.
    fn places(&self, scale: f64, origin: f64, radius: usize, places: &mut Vec<f32>) -> (f32, f32) {
        let across = 2 * radius + 1;
        places.resize(across * across, 0.0);
        fill(Level::detect(), self, scale, origin, across, places);
        ends(Level::detect(), places)
    }
}

/// The samples of a patch, and memory to find them.
#[derive(Debug, Default)]
pub(super) struct Samples {
    /// Columns and rows, then how far each lies from its pixel to the next.
    places: [Vec<f32>; 2],
    offsets: Vec<i32>,
    corners: Vec<[u8; 4]>,
    pub values: Vec<f32>,
}

impl GreyImage {
    /// Two pixels of a row, by their places among all, and those below them.
    #[inline]
    fn corners(&self, [left, right]: [usize; 2]) -> [u8; 4] {
        let values = &self.values;
        [values[left], values[right], values[left + self.width], values[right + self.width]]
    }

    /// Half the size, each pixel from 4 × 4 by the weights (1, 3, 3, 1)/8: its centre is that of the 2 × 2 it stands for.
    fn halved(&self, wraps_around: bool) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut values = vec![0; width * height];
        // With the columns before the first and after the last.
        let mut sums = vec![0_u16; self.width + 2];
        for (y, target) in values.chunks_exact_mut(width.max(1)).enumerate() {
            let row = |step: isize| {
                let y = (2 * y as isize + step).clamp(0, self.height as isize - 1) as usize;
                &self.values[y * self.width..(y + 1) * self.width]
            };
            let inner = &mut sums[1..=self.width];
            add_rows(Level::detect(), [row(-1), row(0), row(1), row(2)], inner);
            let ends = [inner[0], inner[self.width - 1]];
            let [before, after] = if wraps_around { [ends[1], ends[0]] } else { ends };
            (sums[0], sums[self.width + 1]) = (before, after);
            halve_row(Level::detect(), &sums, target);
        }
        Self { width, height, values }
    }
}

vectorized! {
    /// The places that a function has on a level, row by row of a patch, from the pixel `origin` on.
    fn fill(axis: &Quadratic, scale: f64, origin: f64, across: usize, places: &mut [f32]) {
        let radius = across as i32 / 2;
        let square = (scale * axis.square[0]) as f32;
        for (y, row) in places.chunks_exact_mut(across).enumerate() {
            let y = f64::from(y as i32 - radius);
            let constant = axis.constant + y * (axis.linear[1] + y * axis.square[1]);
            let constant = (scale * constant - 0.5 - origin) as f32;
            let linear = (scale * (axis.linear[0] + y * axis.mixed)) as f32;
            for (x, place) in (-radius..).zip(row) {
                let x = x as f32;
                *place = constant + x * (linear + x * square);
            }
        }
    }
}

vectorized! {
    /// The lowest and the highest of some finite places.
    fn ends(places: &[f32]) -> (f32, f32) {
        const LANES: usize = 16;
        let (mut lowest, mut highest) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
        let (blocks, rest) = places.as_chunks::<LANES>();
        for block in blocks {
            for lane in 0..LANES {
                lowest[lane] = if block[lane] < lowest[lane] { block[lane] } else { lowest[lane] };
                highest[lane] = if block[lane] > highest[lane] { block[lane] } else { highest[lane] };
            }
        }
        let mut of_all = (f32::INFINITY, f32::NEG_INFINITY);
        for &place in lowest.iter().chain(rest) {
            of_all.0 = if place < of_all.0 { place } else { of_all.0 };
        }
        for &place in highest.iter().chain(rest) {
            of_all.1 = if place > of_all.1 { place } else { of_all.1 };
        }
        of_all
    }
}

vectorized! {
    /// Turns places within [0, 2·[`REACH`]) into how far they lie from the pixels to their upper left, and says where in rows of this
    /// width these are.
    fn split(columns: &mut [f32], rows: &mut [f32], width: i32, offsets: &mut [i32]) {
        const MOST: f32 = 2.0 * REACH as f32;
        for ((x, y), offset) in columns.iter_mut().zip(rows).zip(offsets) {
            #[allow(clippy::manual_clamp, reason = "not a number must become 0")]
            let [x_within, y_within] = [*x, *y].map(|place| place.max(0.0).min(MOST));
            // SAFETY: numbers that an integer holds. (Conversions that bear any number are done one by one.)
            let (column, row) = unsafe { (x_within.to_int_unchecked::<i32>(), y_within.to_int_unchecked::<i32>()) };
            *offset = row * width + column;
            *x -= column as f32;
            *y -= row as f32;
        }
    }
}

vectorized! {
    /// Between four pixels, by the shares of the right and the lower ones.
    fn interpolate(corners: &[[u8; 4]], right: &[f32], lower: &[f32], values: &mut [f32]) {
        for (((corners, &right), &lower), value) in corners.iter().zip(right).zip(lower).zip(values) {
            let [a, b, c, d] = corners.map(f32::from);
            let (above, below) = (a + right * (b - a), c + right * (d - c));
            *value = above + lower * (below - above);
        }
    }
}

vectorized! {
    /// Four rows by the weights (1, 3, 3, 1).
    fn add_rows(rows: [&[u8]; 4], sums: &mut [u16]) {
        let [a, b, c, d] = rows.map(|row| &row[..sums.len()]);
        for (x, sum) in sums.iter_mut().enumerate() {
            *sum = u16::from(a[x]) + 3 * (u16::from(b[x]) + u16::from(c[x])) + u16::from(d[x]);
        }
    }
}

vectorized! {
    /// Every second column by the weights (1, 3, 3, 1)/64, the first in the middle of the first four sums.
    fn halve_row(sums: &[u16], target: &mut [u8]) {
        let (pairs, next) = (sums.as_chunks::<2>().0, sums[2..].as_chunks::<2>().0);
        for ((target, &[a, b]), &[c, d]) in target.iter_mut().zip(pairs).zip(next) {
            *target = ((a + d + 3 * (b + c) + 32) >> 6) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> GreyImage {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        GreyImage::from_values(width, height, pixels.map(|(x, y)| value(x, y)).collect()).unwrap()
    }

    fn value(pyramid: &ImagePyramid, level: usize, x: f32, y: f32) -> Option<f32> {
        let mut samples = Samples::default();
        let still = |constant: f32| Quadratic {
            constant: constant.into(),
            linear: [0.0; 2],
            square: [0.0; 2],
            mixed: 0.0,
        };
        pyramid.sample(level, &Grid([still(x), still(y)]), 0, &mut samples).then(|| samples.values[0])
    }

    #[test]
    fn every_level_has_a_ramp_where_the_image_has_it() {
        let pyramid = ImagePyramid::new(image(512, 512, |x, y| (x / 4 + y / 8) as u8), false);
        for level in 0..3 {
            let (x, y) = (200.0, 304.0);
            let expected = (x - 2.0) / 4.0 + (y - 4.0) / 8.0;
            assert!((value(&pyramid, level, x, y).unwrap() - expected).abs() < 0.8, "level {level}");
        }
        assert!(value(&pyramid, 0, -1.0, 5.0).is_none() && value(&pyramid, 0, 5.0, 511.9).is_none());
    }

    #[test]
    fn a_panorama_goes_on_beyond_its_seam() {
        let wave = |x: u32| ((f64::from(x) + 0.5) / 256.0 * std::f64::consts::TAU).cos() * 100.0 + 120.0;
        let pyramid = ImagePyramid::new(image(256, 128, |x, _| wave(x).round() as u8), true);
        assert_eq!(pyramid.levels.len(), 2);
        for level in 0..2 {
            for x in [-3.0_f32, -0.2, 0.0, 0.3, 255.9, 259.0] {
                let expected = (f64::from(x) / 256.0 * std::f64::consts::TAU).cos() * 100.0 + 120.0;
                let sampled = f64::from(value(&pyramid, level, x, 60.0).unwrap());
                assert!((sampled - expected).abs() < 1.0, "{x}: {sampled} {expected}");
            }
        }
    }
}
