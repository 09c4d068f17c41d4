use std::ops::Range;

/// Columns that are blurred together; rows have room for whole blocks of them.
pub(super) const BLOCK: usize = 32;
/// Pixels that are worked on together, and floats of a cache line. Rows go on for more than as many after their end.
pub(super) const LANES: usize = 16;

/// One layer of the pyramid, whole or the last rows written to it.
#[derive(Debug, Default)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    /// Rows are kept at their number, these bits of it: a layer that is only passed through keeps the last ones.
    kept: usize,
    /// From one row to the next: the width, rounded up to whole blocks, and a line, since rows at multiples of a page
    /// would share the sets of the caches.
    stride: usize,
    /// Where the first row begins, at a cache line.
    start: usize,
    values: Vec<f32>,
}

impl Plane {
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
        let len = self.stride * room.min(height) + LANES;
        if self.values.len() < len {
            // Zeroed by the system as it is touched, not once more here.
            self.values = vec![0.0; len];
        }
        self.start = self.values.as_ptr().align_offset(LANES * size_of::<f32>()).min(LANES);
    }

    pub fn row(&self, y: usize) -> &[f32] {
        &self.padded_row(y)[..self.width]
    }

    pub fn row_mut(&mut self, y: usize) -> &mut [f32] {
        let width = self.width;
        &mut self.padded_row_mut(y)[..width]
    }

    /// The row and what follows it up to the next: any numbers.
    pub fn padded_row(&self, y: usize) -> &[f32] {
        &self.values[self.start + (y & self.kept) * self.stride..][..self.stride]
    }

    pub fn padded_row_mut(&mut self, y: usize) -> &mut [f32] {
        &mut self.values[self.start + (y & self.kept) * self.stride..][..self.stride]
    }

    /// Asks for these columns of a row to be brought into the processor's cache, where it can be asked.
    pub fn prefetch(&self, y: usize, columns: Range<usize>) {
        #[cfg(target_arch = "x86_64")]
        for part in self.row(y)[columns].chunks(LANES) {
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
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.row(y)[x]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_passed_through_keeps_the_last_rows() {
        let mut plane = Plane::default();
        plane.resize_keeping(3, 100, 10);
        for y in 0..100 {
            plane.row_mut(y).fill(y as f32);
            for earlier in y.saturating_sub(9)..=y {
                assert_eq!(plane.row(earlier), [earlier as f32; 3]);
            }
        }
        assert!(plane.values.len() < 20 * plane.stride);
    }
}
