use nalgebra::Vector2;

use crate::DecodedImage;
use crate::extract::luma;

/// Most halvings; patches of larger keypoints are not aligned any finer for being taken coarser.
const MAX_LEVELS: usize = 6;
/// Shortest side that is still halved.
const MIN_SIDE: usize = 64;

/// A grey image with ever smaller copies of it, to sample patches of any scale from.
#[derive(Debug, Clone, PartialEq)]
pub struct ImagePyramid {
    levels: Vec<Level>,
    wraps_around: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct Level {
    width: usize,
    height: usize,
    values: Vec<u8>,
}

impl ImagePyramid {
    /// The image and its halvings; `wraps_around` when its left and right ends meet, as a full panorama's do.
    pub fn new(image: &DecodedImage, wraps_around: bool) -> Self {
        let values = image.rgb.chunks_exact(3).map(luma).collect();
        let mut levels = vec![Level { width: image.width as usize, height: image.height as usize, values }];
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

    /// Samples one level bilinearly at image pixels; false when one lies outside.
    pub(super) fn sample(
        &self,
        level: usize,
        pixels: impl Iterator<Item = Vector2<f32>>,
        values: &mut Vec<f32>,
    ) -> bool {
        let scale = (1.0 / f64::from(1_u32 << level)) as f32;
        let level = &self.levels[level];
        let (width, height) = (level.width as f32, level.height as f32);
        values.clear();
        for pixel in pixels {
            let (mut x, y) = (pixel.x * scale - 0.5, pixel.y * scale - 0.5);
            if self.wraps_around {
                x -= (x / width).floor() * width;
                // Rounding may lead to the end itself.
                x = if x < width { x } else { 0.0 };
            }
            let right = if self.wraps_around { width } else { width - 1.0 };
            if !(x >= 0.0 && x < right && y >= 0.0 && y < height - 1.0) {
                return false;
            }
            values.push(level.bilinear(x, y));
        }
        true
    }
}

impl Level {
    /// The value at a place in columns and rows from the centre of the first pixel.
    #[inline]
    fn bilinear(&self, x: f32, y: f32) -> f32 {
        let (column, row) = (x as usize, y as usize);
        let (a, b) = (x - column as f32, y - row as f32);
        let next = if column + 1 == self.width { 0 } else { column + 1 };
        let (upper, lower) =
            (&self.values[row * self.width..], &self.values[(row + 1) * self.width..(row + 2) * self.width]);
        let value = |values: &[u8], at: usize| f32::from(values[at]);
        let above = value(upper, column) + a * (value(upper, next) - value(upper, column));
        let below = value(lower, column) + a * (value(lower, next) - value(lower, column));
        above + b * (below - above)
    }

    /// Half the size, each pixel from 4 × 4 by the weights (1, 3, 3, 1)/8: its centre is that of the 2 × 2 it stands for.
    fn halved(&self, wraps_around: bool) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let column = |x: isize| {
            if wraps_around {
                x.rem_euclid(self.width as isize) as usize
            } else {
                x.clamp(0, self.width as isize - 1) as usize
            }
        };
        let mut values = Vec::with_capacity(width * height);
        let mut sums = vec![0_u16; self.width];
        for y in 0..height {
            let row = |step: isize| {
                let y = (2 * y as isize + step).clamp(0, self.height as isize - 1) as usize;
                &self.values[y * self.width..(y + 1) * self.width]
            };
            let (a, b, c, d) = (row(-1), row(0), row(1), row(2));
            for (x, sum) in sums.iter_mut().enumerate() {
                *sum = u16::from(a[x]) + 3 * (u16::from(b[x]) + u16::from(c[x])) + u16::from(d[x]);
            }
            let halve = |outer: u16, inner: u16| ((outer + 3 * inner + 32) >> 6) as u8;
            values.extend((0..width).map(|x| {
                let x = 2 * x;
                let (left, right) = (column(x as isize - 1), column(x as isize + 2));
                halve(sums[left] + sums[right], sums[x] + sums[x + 1])
            }));
        }
        Self { width, height, values }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> DecodedImage {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        DecodedImage::from_rgb(width, height, pixels.flat_map(|(x, y)| [value(x, y); 3]).collect()).unwrap()
    }

    fn value(pyramid: &ImagePyramid, level: usize, x: f32, y: f32) -> Option<f32> {
        let mut values = Vec::new();
        pyramid.sample(level, [Vector2::new(x, y)].into_iter(), &mut values).then(|| values[0])
    }

    #[test]
    fn every_level_has_a_ramp_where_the_image_has_it() {
        let pyramid = ImagePyramid::new(&image(512, 512, |x, y| (x / 4 + y / 8) as u8), false);
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
        let pyramid = ImagePyramid::new(&image(256, 128, |x, _| wave(x).round() as u8), true);
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
