//! An image as it is enlarged for detection.

use super::Grey;
use crate::{vectorized, vectorized::Level};

/// Pixels that a pixel of the enlarged image is interpolated from, along each axis.
const TAPS: usize = 4;
/// The slope that cubic convolution takes at the next pixel: with it quadratics stay what they are.
const SLOPE: f64 = -0.5;

/// An image at some times its size, by cubic convolution, made row by row.
///
/// R. G. Keys, "Cubic convolution interpolation for digital image processing", IEEE Trans. ASSP 1981. The place `x` of the image comes
/// to lie at exactly `x` times the enlargement, so that what repeats itself after whole pixels of both is the same to the bit: the seam
/// of a panorama is as any other place.
#[derive(Debug)]
pub(super) struct Enlarged<'a> {
    image: Grey<'a>,
    pub columns: Vec<Taps>,
    pub rows: Vec<Taps>,
}

/// What one coordinate of the enlarged image is made of.
#[derive(Debug, Clone, Copy)]
pub(super) struct Taps {
    /// The first of the image's pixels, counted from [`MARGIN`] before its first.
    first: usize,
    weights: [f32; TAPS],
}

/// Pixels by which the image is continued beyond each border with what is there.
const MARGIN: usize = 2;

impl<'a> Enlarged<'a> {
    pub fn new(image: Grey<'a>, enlargement: f64) -> Self {
        Self::by(image, enlargement, keys)
    }

    /// The same by other weights of a pixel at some distance, which end at a distance of 2.
    pub fn by(image: Grey<'a>, enlargement: f64, weight: fn(f64) -> f64) -> Self {
        let taps = |side: usize| {
            let count = (side as f64 * enlargement) as usize;
            (0..count).map(|at| Taps::new((at as f64 + 0.5) / enlargement - 0.5, weight)).collect()
        };
        Self { image, columns: taps(image.width), rows: taps(image.height) }
    }

    /// Puts one row of the enlarged image.
    pub fn put_row(&self, level: Level, y: usize, between: &mut Vec<f32>, target: &mut [f32]) {
        let Grey { width, height, values } = self.image;
        let Taps { first, weights } = self.rows[y];
        let row = |tap: usize| {
            let row = (first + tap).saturating_sub(MARGIN).min(height - 1);
            &values[row * width..][..width]
        };
        between.resize(width + 2 * MARGIN, 0.0);
        weigh_rows(level, [row(0), row(1), row(2), row(3)], &weights, &mut between[MARGIN..][..width]);
        for beyond in 0..MARGIN {
            between[beyond] = between[MARGIN];
            between[MARGIN + width + beyond] = between[MARGIN + width - 1];
        }
        weigh_columns(level, between, &self.columns, target);
    }
}

impl Taps {
    /// For a place where 0 is the centre of the first pixel.
    fn new(place: f64, weight: fn(f64) -> f64) -> Self {
        let at = place.floor();
        let weights = [0, 1, 2, 3].map(|tap| weight(at + f64::from(tap) - 1.0 - place) as f32);
        // Places begin at −½, so that this is 0 or more.
        Self { first: (at + (MARGIN - 1) as f64) as usize, weights }
    }
}

/// The weight of a pixel at this distance.
fn keys(distance: f64) -> f64 {
    let x = distance.abs();
    if x < 1.0 {
        ((SLOPE + 2.0) * x - (SLOPE + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        SLOPE * (((x - 5.0) * x + 8.0) * x - 4.0)
    } else {
        0.0
    }
}

vectorized! {
    fn weigh_rows(rows: [&[u8]; TAPS], weights: &[f32; TAPS], target: &mut [f32]) {
        let [first, second, third, fourth] = rows;
        for (((target, &first), (&second, &third)), &fourth) in
            target.iter_mut().zip(first).zip(second.iter().zip(third)).zip(fourth)
        {
            *target = weights[0] * f32::from(first)
                + weights[1] * f32::from(second)
                + weights[2] * f32::from(third)
                + weights[3] * f32::from(fourth);
        }
    }
}

vectorized! {
    fn weigh_columns(row: &[f32], columns: &[Taps], target: &mut [f32]) {
        for (target, Taps { first, weights }) in target.iter_mut().zip(columns) {
            let from = &row[*first..][..TAPS];
            *target = weights[0] * from[0] + weights[1] * from[1] + weights[2] * from[2] + weights[3] * from[3];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(width: usize, height: usize, values: &[u8], enlargement: f64) -> Vec<Vec<f32>> {
        let image = Enlarged::new(Grey { width, height, values }, enlargement);
        let put = |y| {
            let mut row = vec![0.0; image.columns.len()];
            image.put_row(Level::detect(), y, &mut Vec::new(), &mut row);
            row
        };
        (0..image.rows.len()).map(put).collect()
    }

    #[test]
    fn an_image_at_its_own_size_stays_what_it_is() {
        let values: Vec<u8> = (0..35).map(|at| (at * at % 251) as u8).collect();
        let rows = rows(7, 5, &values, 1.0);
        let same: Vec<f32> = values.iter().map(|&value| value.into()).collect();
        assert_eq!(rows.concat(), same);
    }

    #[test]
    fn a_parabola_stays_one() {
        let values: Vec<u8> = (0..12).flat_map(|y| (0..14).map(move |x| x * x + y)).collect();
        let rows = rows(14, 12, &values, 1.25);
        assert_eq!((rows.len(), rows[0].len()), (15, 17));
        let place = |at: usize| (at as f32 + 0.5) / 1.25 - 0.5;
        for (y, row) in rows.iter().enumerate().take(12).skip(3) {
            for (x, value) in row.iter().enumerate().take(14).skip(3) {
                assert!((value - place(x).powi(2) - place(y)).abs() < 1e-4, "{x} {y} {value}");
            }
        }
    }

    #[test]
    fn what_repeats_itself_repeats_to_the_bit() {
        let values: Vec<u8> = (0..2 * 480).map(|at| (at % 480 * 37 % 256) as u8).collect();
        let row = &rows(960, 1, &values, 1.25)[0];
        assert_eq!(row[100..500], row[700..1100]);
    }
}
