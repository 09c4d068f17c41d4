use super::blur::{Blur, GROUP};
use super::enlarged::Enlarged;
use super::extrema::REACH;
use super::plane::{Kept, Plane, grey};
use crate::vectorized::Level;

/// What an octave is made of.
#[derive(Debug, Clone, Copy)]
pub(super) enum Source<'a> {
    Photo(&'a Enlarged<'a>),
    /// Every second pixel of a layer of the finer octave, beginning with the first: pixel `x` is the layer's 2x for any size.
    Finer(&'a Plane<Kept>),
}

impl Source<'_> {
    pub fn size(self) -> (usize, usize) {
        match self {
            Self::Photo(image) => (image.columns.len(), image.rows.len()),
            Self::Finer(layer) => (layer.width.div_ceil(2), layer.height.div_ceil(2)),
        }
    }

    fn put_row(self, level: Level, y: usize, between: &mut Vec<f32>, target: &mut [f32]) {
        match self {
            Self::Photo(image) => image.put_row(level, y, between, target),
            Self::Finer(layer) => {
                for (value, &from) in target.iter_mut().zip(layer.row(2 * y).iter().step_by(2)) {
                    *value = grey(from);
                }
            }
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
    use crate::sift::Grey;

    #[test]
    fn rows_being_scanned_are_those_of_whole_layers() {
        let (width, height) = (20, 700);
        let values: Vec<u8> = (0..width * height).map(|at| (at * at % 251) as u8).collect();
        let image = Enlarged::new(Grey { width, height, values: &values }, 1.0);
        let sigmas = Sigmas { first: 1.25, steps: vec![1.23, 1.55, 1.95, 2.45, 3.1] };
        let whole = |from: &Plane, sigma: f64| {
            let (mut target, mut blur) = (Plane::default(), Blur::new(sigma));
            target.resize(width, height);
            while blur.advance(Level::BASELINE, from, height, &mut target) < height {}
            target
        };
        let mut photo = Plane::default();
        photo.resize(width, height);
        for y in 0..height {
            image.put_row(Level::BASELINE, y, &mut Vec::new(), photo.row_mut(y));
        }
        let mut expected = vec![whole(&photo, sigmas.first)];
        for &sigma in &sigmas.steps {
            expected.push(whole(&expected[expected.len() - 1], sigma));
        }
        let (mut octave, mut before) = (Octave::default(), 0);
        octave.build(Level::detect(), Source::Photo(&image), &sigmas, |layers, written| {
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
