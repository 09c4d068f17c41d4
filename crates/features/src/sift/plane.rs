use std::ops::Range;

use crate::{vectorized, vectorized::Level};

/// Columns that are blurred together; rows have room for whole blocks of them.
pub(super) const BLOCK: usize = 32;
/// Pixels that are worked on together. Rows go on for more than as many after their end.
pub(super) const LANES: usize = 16;
/// Bytes of a cache line.
const LINE: usize = 64;
/// Steps of a [`Kept`] value that make a grey value.
const STEPS: f32 = 256.0;

/// A pixel of a layer that is kept whole: its grey value in steps of 1/256.
///
/// A tenth of the noise that an 8-bit photo blurred by a pixel and a half still has, in half the memory of a float: pages that are
/// touched first were a seventh of the time that a build of twelve panoramas takes.
pub(super) type Kept = u16;

/// One layer of the pyramid, whole or the last rows written to it.
#[derive(Debug, Default)]
pub(super) struct Plane<T = f32> {
    pub width: usize,
    pub height: usize,
    /// Rows are kept at their number, these bits of it: a layer that is only passed through keeps the last ones.
    kept: usize,
    /// From one row to the next: the width, rounded up to whole blocks, and a line, since rows at multiples of a page
    /// would share the sets of the caches.
    stride: usize,
    /// Where the first row begins, at a cache line.
    start: usize,
    values: Vec<T>,
}

impl<T: Copy + Default> Plane<T> {
    /// Gives the plane this size; its values are left to be overwritten.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.resize_keeping(width, height, height);
    }

    /// The same, with room for that many successive rows at least; rows are lost when later ones are written.
    pub fn resize_keeping(&mut self, width: usize, height: usize, rows: usize) {
        (self.width, self.height) = (width, height);
        let room = if rows < height { rows.next_power_of_two() } else { usize::MAX };
        self.kept = if room < height { room - 1 } else { usize::MAX };
        self.stride = width.next_multiple_of(BLOCK) + LANES;
        let line = LINE / size_of::<T>();
        let len = self.stride * room.min(height) + line;
        if self.values.len() < len {
            // Zeroed by the system as it is touched, not once more here.
            self.values = vec![T::default(); len];
        }
        self.start = self.values.as_ptr().align_offset(LINE).min(line);
    }

    pub fn row(&self, y: usize) -> &[T] {
        &self.padded_row(y)[..self.width]
    }

    pub fn row_mut(&mut self, y: usize) -> &mut [T] {
        let width = self.width;
        &mut self.padded_row_mut(y)[..width]
    }

    /// The row and what follows it up to the next: any numbers.
    pub fn padded_row(&self, y: usize) -> &[T] {
        &self.values[self.start + (y & self.kept) * self.stride..][..self.stride]
    }

    pub fn padded_row_mut(&mut self, y: usize) -> &mut [T] {
        &mut self.values[self.start + (y & self.kept) * self.stride..][..self.stride]
    }

    /// Asks for these columns of a row to be brought into the processor's cache, where it can be asked.
    pub fn prefetch(&self, y: usize, columns: Range<usize>) {
        #[cfg(target_arch = "x86_64")]
        for part in self.row(y)[columns].chunks(LINE / size_of::<T>()) {
            use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            // SAFETY: every processor of this architecture has the instruction, and no address makes it fail.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(part.as_ptr().cast()) };
        }
        #[cfg(not(target_arch = "x86_64"))]
        let _ = (y, columns);
    }

    /// The width, rounded up to whole blocks.
    pub fn padded_width(&self) -> usize {
        self.stride - LANES
    }

    /// The value at column `x` of row `y`.
    pub fn at(&self, x: usize, y: usize) -> T {
        self.row(y)[x]
    }
}

impl Plane<Kept> {
    /// Row `y` of a layer of this size, made of its grey values.
    pub fn keep(&mut self, level: Level, y: usize, row: &[f32]) {
        keep(level, row, self.row_mut(y));
    }
}

/// The grey value of a kept pixel.
#[inline(always)]
pub(super) fn grey(kept: Kept) -> f32 {
    f32::from(kept) * (1.0 / STEPS)
}

vectorized! {
    fn keep(row: &[f32], target: &mut [Kept]) {
        // In floats of this size the last bit is worth 1; compilers turn conversions that must bear any number into single ones.
        const ROUNDING: f32 = 8_388_608.0;
        // Beside steep edges enlarged images go below black and above white.
        const WHITEST: f32 = Kept::MAX as f32 / STEPS;
        for (target, &value) in target.iter_mut().zip(row) {
            let value = if value > 0.0 { value } else { 0.0 };
            let value = if value < WHITEST { value } else { WHITEST };
            *target = (value * STEPS + ROUNDING).to_bits() as Kept;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_below_black_or_above_white_is_kept_as_these() {
        let row = [-0.09, -0.001, 0.0, 0.5, 254.99, 255.0, 255.99, 256.0, 256.6];
        let mut kept = [0; 9];
        keep(Level::detect(), &row, &mut kept);
        let kept = kept.map(grey);
        assert_eq!(kept[..4], [0.0, 0.0, 0.0, 0.5]);
        for (kept, value) in kept.iter().zip(row).skip(4) {
            assert!((kept - value.min(256.0)).abs() <= 1.0 / STEPS, "{kept} {value}");
        }
    }

    #[test]
    fn a_plane_passed_through_keeps_the_last_rows() {
        let mut plane: Plane = Plane::default();
        plane.resize_keeping(3, 100, 10);
        for y in 0..100 {
            plane.row_mut(y).fill(y as f32);
            for earlier in y.saturating_sub(9)..=y {
                assert_eq!(plane.row(earlier), [earlier as f32; 3]);
            }
        }
        assert!(plane.values.len() < 20 * plane.stride);
    }

    #[test]
    fn kept_values_are_grey_values_to_half_a_step() {
        let row: Vec<f32> = (0..5000).map(|at| at as f32 * 0.051).collect();
        for level in [Level::detect(), Level::BASELINE] {
            let mut plane: Plane<Kept> = Plane::default();
            plane.resize(row.len(), 2);
            plane.keep(level, 1, &row);
            for (&value, &kept) in row.iter().zip(plane.row(1)) {
                assert!((grey(kept) - value).abs() <= 0.5 / STEPS, "{value}: {kept}");
            }
        }
    }
}
