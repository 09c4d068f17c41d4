use super::Grey;
use super::blur::{Blur, GROUP};
use super::extrema::REACH;
use super::plane::{Kept, Plane, grey};
use crate::vectorized::{Level, vectorized};

/// What an octave is made of.
#[derive(Debug, Clone, Copy)]
pub(super) enum Source<'a> {
    Photo(Grey<'a>),
    /// The photo at twice its size, by linear interpolation: pixel `x` comes to lie at 2x + ½.
    Doubled(Grey<'a>),
    /// Every second pixel of a layer of the finer octave, beginning with the first: pixel `x` is the layer's 2x for any size.
    Finer(&'a Plane<Kept>),
}

impl Source<'_> {
    pub fn size(self) -> (usize, usize) {
        match self {
            Self::Photo(image) => (image.width, image.height),
            Self::Doubled(image) => (2 * image.width, 2 * image.height),
            Self::Finer(layer) => (layer.width.div_ceil(2), layer.height.div_ceil(2)),
        }
    }

    fn put_row(self, level: Level, y: usize, between: &mut Vec<f32>, target: &mut [f32]) {
        match self {
            Self::Photo(image) => {
                for (value, &grey) in target.iter_mut().zip(&image.values[y * image.width..]) {
                    *value = f32::from(grey);
                }
            }
            Self::Doubled(image) => put_doubled_row(level, rows_about(image, y), between, target),
            Self::Finer(layer) => {
                for (value, &from) in target.iter_mut().zip(layer.row(2 * y).iter().step_by(2)) {
                    *value = grey(from);
                }
            }
        }
    }
}

/// The two rows of a photo that a row of the doubled one lies between, the nearer one first.
fn rows_about(image: Grey<'_>, y: usize) -> [&[u8]; 2] {
    let Grey { width, height, values } = image;
    let near = y / 2;
    let far = if y.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(height - 1) };
    [near, far].map(|row| &values[row * width..][..width])
}

vectorized! {
    fn put_doubled_row(rows: [&[u8]; 2], between: &mut Vec<f32>, target: &mut [f32]) {
        let [near, far] = rows;
        between.clear();
        let along = near.iter().zip(far);
        between.extend(along.map(|(&near, &far)| 0.75 * f32::from(near) + 0.25 * f32::from(far)));
        let inner = between.windows(3).zip(target[2..].chunks_exact_mut(2));
        for (from, to) in inner {
            to[0] = 0.25 * from[0] + 0.75 * from[1];
            to[1] = 0.75 * from[1] + 0.25 * from[2];
        }
        let last = between.len() - 1;
        for x in [0, last] {
            let (left, here, right) = (between[x.saturating_sub(1)], between[x], between[(x + 1).min(last)]);
            target[2 * x] = 0.25 * left + 0.75 * here;
            target[2 * x + 1] = 0.75 * here + 0.25 * right;
        }
    }
}

/// How much the layers of an octave are blurred.
#[derive(Debug)]
pub(super) struct Sigmas {
    /// From the photo to the first layer.
    pub first: f64,
    /// From each layer to the next.
    pub steps: Vec<f64>,
}

/// The blurred layers of one octave.
#[derive(Debug, Default)]
pub(super) struct Octave {
    /// What the first layer of a photo's first octave is blurred from.
    input: Plane,
    /// All layers, of which each keeps the rows that are being scanned.
    layers: Vec<Plane>,
    /// Those that points are described on, from layer 1 on.
    kept: Vec<Plane<Kept>>,
    between: Vec<f32>,
}

impl Octave {
    /// The layer of this number, of those that points are described on: from 1 on.
    pub fn layer(&self, number: usize) -> &Plane<Kept> {
        &self.kept[number - 1]
    }

    /// Blurs all layers, a few rows at a time so that each finds those it is made of in the processor's caches.
    ///
    /// Hands the layers on with the number of rows that all have, time after time. The last `2·REACH` of these are in all layers.
    pub fn build(
        &mut self,
        level: Level,
        source: Source<'_>,
        sigmas: &Sigmas,
        mut scan: impl FnMut(&[Plane], usize),
    ) {
        let (width, height) = source.size();
        let mut first = (!matches!(source, Source::Finer(_))).then(|| Blur::new(sigmas.first));
        let mut blurs: Vec<Blur> = sigmas.steps.iter().copied().map(Blur::new).collect();
        if let Some(first) = &first {
            self.input.resize_keeping(width, height, GROUP + 2 * first.radius() + 1);
        }
        self.layers.resize_with(blurs.len() + 1, Plane::default);
        for (index, layer) in self.layers.iter_mut().enumerate() {
            let blurred = blurs.get(index).map_or(0, |next| 2 * next.radius());
            let scanned = blurs[index..].iter().map(Blur::radius).sum::<usize>() + 2 * REACH;
            layer.resize_keeping(width, height, GROUP + blurred.max(scanned) + 1);
        }
        self.kept.resize_with(blurs.len() - 2, Plane::default);
        for layer in &mut self.kept {
            layer.resize(width, height);
        }
        let (mut put, mut written) = (0, 0);
        while written < height {
            let rows = put..(put + GROUP).min(height);
            put = rows.end;
            let input = if first.is_some() { &mut self.input } else { &mut self.layers[0] };
            for y in rows {
                source.put_row(level, y, &mut self.between, input.row_mut(y));
            }
            written = match &mut first {
                Some(blur) => blur.advance(level, &self.input, put, &mut self.layers[0]),
                None => put,
            };
            for (index, blur) in blurs.iter_mut().enumerate() {
                let (finer, coarser) = self.layers.split_at_mut(index + 1);
                let before = blur.done();
                written = blur.advance(level, &finer[index], written, &mut coarser[0]);
                if let Some(kept) = self.kept.get_mut(index) {
                    for y in before..written {
                        kept.keep(level, y, coarser[0].row(y));
                    }
                }
            }
            scan(&self.layers, written);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn doubling_keeps_a_ramp() {
        let values: Vec<u8> = (0..15).map(|at| 10 + 20 * (at % 5)).collect();
        let source = Source::Doubled(Grey { width: 5, height: 3, values: &values });
        for level in [Level::Baseline, Level::detect()] {
            let mut row = [0.0; 10];
            source.put_row(level, 3, &mut Vec::new(), &mut row);
            assert_eq!(row, [10.0, 15.0, 25.0, 35.0, 45.0, 55.0, 65.0, 75.0, 85.0, 90.0]);
        }
        let mut row = [0.0; 2];
        Source::Doubled(Grey { width: 1, height: 2, values: &[4, 8] }).put_row(
            Level::detect(),
            1,
            &mut Vec::new(),
            &mut row,
        );
        assert_eq!(row, [5.0; 2]);
    }

    #[test]
    fn rows_being_scanned_are_those_of_whole_layers() {
        let (width, height) = (20, 700);
        let values: Vec<u8> = (0..width * height).map(|at| (at * at % 251) as u8).collect();
        let image = Grey { width, height, values: &values };
        let sigmas = Sigmas { first: 1.25, steps: vec![1.23, 1.55, 1.95, 2.45, 3.1] };
        let whole = |from: &Plane, sigma: f64| {
            let (mut target, mut blur) = (Plane::default(), Blur::new(sigma));
            target.resize(width, height);
            while blur.advance(Level::Baseline, from, height, &mut target) < height {}
            target
        };
        let mut photo = Plane::default();
        photo.resize(width, height);
        for y in 0..height {
            Source::Photo(image).put_row(Level::Baseline, y, &mut Vec::new(), photo.row_mut(y));
        }
        let mut expected = vec![whole(&photo, sigmas.first)];
        for &sigma in &sigmas.steps {
            expected.push(whole(&expected[expected.len() - 1], sigma));
        }
        let (mut octave, mut before) = (Octave::default(), 0);
        octave.build(Level::detect(), Source::Photo(image), &sigmas, |layers, written| {
            assert!(layers.len() == 6 && written >= before);
            for y in before.saturating_sub(2 * REACH)..written {
                for (layer, expected) in layers.iter().zip(&expected) {
                    assert_eq!(layer.row(y), expected.row(y), "{y} of {written}");
                }
            }
            before = written;
        });
        assert_eq!(before, height);
        for index in 1..=3 {
            let near = |(&kept, &value): (&Kept, &f32)| (grey(kept) - value).abs() < 0.002;
            assert!(
                (0..height).all(|y| octave.layer(index).row(y).iter().zip(expected[index].row(y)).all(near))
            );
        }
    }
}
