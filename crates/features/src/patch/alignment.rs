use std::cell::RefCell;
use std::sync::OnceLock;

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};
use serde::{Deserialize, Serialize};

use super::ImagePyramid;
use super::pyramid::{Grid, Quadratic, Samples};
use crate::FeatureError;
use crate::error::check;
use crate::{vectorized, vectorized::Level};

/// Largest radius of a patch.
const MAX_RADIUS: usize = 50;

/// How patches are aligned.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PatchParams {
    /// Samples from the middle of a patch to its edge; a patch has twice as many and one across.
    pub radius: usize,
    /// Most Gauss–Newton steps.
    pub max_iterations: u32,
    /// Smallest correlation of two aligned patches.
    pub min_correlation: f64,
    /// Largest entry by which the affine map between two aligned patches may differ from the expected one.
    pub max_distortion: f64,
}

impl Default for PatchParams {
    fn default() -> Self {
        Self { radius: 8, max_iterations: 10, min_correlation: 0.85, max_distortion: 0.7 }
    }
}

impl PatchParams {
    /// Checks the ranges.
    ///
    /// # Errors
    /// [`FeatureError::InvalidParameter`] with the value at fault.
    pub fn validate(&self) -> Result<(), FeatureError> {
        check("radius", self.radius as f64, "2 to 50", (2..=MAX_RADIUS).contains(&self.radius))?;
        check(
            "min_correlation",
            self.min_correlation,
            "in [0, 1]",
            (0.0..=1.0).contains(&self.min_correlation),
        )?;
        let positive = self.max_distortion > 0.0 && self.max_distortion.is_finite();
        check("max_distortion", self.max_distortion, "positive", positive)
    }
}

/// Where a patch lies in an image: `pixel = center + A·q + ½ (qᵀH₁q, qᵀH₂q)` for the sample at q.
///
/// Samples are at whole numbers in both coordinates of q, up to [`PatchParams::radius`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchFrame {
    /// The middle in pixels.
    pub center: Vector2<f64>,
    /// A: pixels for each step of the patch along its two axes.
    pub pixel_from_patch: Matrix2<f64>,
    /// H₁ and H₂: how a slanted surface, and a panorama, bend the patch. Left out, patches of different slant are
    /// placed off by half of their mean, tenths of a pixel for large ones, the same way all along a street.
    pub curvature: [Matrix2<f64>; 2],
}

impl PatchFrame {
    /// The pixel of the sample at q.
    fn pixel(&self, q: &Vector2<f64>) -> Vector2<f64> {
        let bend = self.curvature.map(|curvature| 0.5 * q.dot(&(curvature * q)));
        self.center + self.pixel_from_patch * q + Vector2::from(bend)
    }

    /// The pixels of the samples q after the map q ↦ `shape`·q + `shift`.
    fn grid(&self, shape: &Matrix2<f64>, shift: &Vector2<f64>) -> Grid {
        let center = self.pixel(shift);
        let bend = self.curvature.map(|curvature| shape.transpose() * curvature);
        let linear = self.pixel_from_patch * shape;
        Grid([0, 1].map(|axis| {
            let by_q = linear.row(axis).transpose() + bend[axis] * shift;
            let by_qq = 0.5 * bend[axis] * shape;
            let mixed = by_qq[(0, 1)] + by_qq[(1, 0)];
            Quadratic {
                constant: center[axis],
                linear: by_q.into(),
                square: [by_qq[(0, 0)], by_qq[(1, 1)]],
                mixed,
            }
        }))
    }

    /// Pixels that one step spans: the geometric mean over all directions.
    pub fn spacing(&self) -> f64 {
        self.pixel_from_patch.determinant().abs().sqrt()
    }
}

/// The place in an image that shows what a template shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aligned {
    /// The pixel that corresponds to the template's middle.
    pub pixel: Vector2<f64>,
    /// Standard deviation of each of its coordinates in pixels, from the difference that remains.
    pub noise_px: f64,
    /// Correlation of the two patches.
    pub correlation: f64,
    /// Linear part of the map from the template's samples to those of the frame in which it was found.
    pub shape: Matrix2<f64>,
}

/// Unknowns: shift, 2 × 2 distortion, gain, offset.
const UNKNOWNS: usize = 8;
/// Deviation of the Gaussian that weighs the samples, as a share of the radius.
const WINDOW: f64 = 0.6;
/// Steps shorter than this, in samples of the patch, end the iteration.
const CONVERGED: f64 = 0.005;
/// Farthest that a template is followed, in samples of the patch.
const REACH: f64 = 6.0;
/// Gains outside of this and its inverse are no change of exposure.
const MIN_GAIN: f64 = 0.2;
/// The curvature matrix of a patch without texture in some direction, relative to its trace.
const SINGULAR: f64 = 1e-9;
/// Neighbouring samples share pixels, so there are fewer independent ones.
const CORRELATED_SAMPLES: f64 = 2.0;

/// The pixels of a patch, cut from its image.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    radius: usize,
    /// Row by row, with one more sample on each side for the gradient.
    samples: Vec<f32>,
}

impl Patch {
    /// Samples a patch; `None` when it leaves the image.
    pub fn cut(params: &PatchParams, pyramid: &ImagePyramid, frame: &PatchFrame) -> Option<Self> {
        let grid = frame.grid(&Matrix2::identity(), &Vector2::zeros());
        let mut samples = Samples::default();
        let level = pyramid.level_for(frame.spacing());
        let inside = pyramid.sample(level, &grid, params.radius + 1, &mut samples);
        inside.then_some(Self { radius: params.radius, samples: samples.values })
    }
}

/// A patch of one image, ready to be found in others.
///
/// Alignment is the inverse compositional algorithm (S. Baker, I. Matthews, "Lucas–Kanade 20 years on", IJCV 2004) over
/// an affine map with gain and offset: I(center + A·W(q)) ≈ gain·T(q) + offset, W(q) = B·q + t. In each step
/// θ = (JᵀΩJ)⁻¹JᵀΩ·I gives gain, offset and gain·(δt, δB) at once, with J = (T_x, T_y, T_x·q, T_y·q, T, 1) and a
/// Gaussian window Ω; then W ← W ∘ (q ↦ q + δB·q + δt)⁻¹.
///
/// Kept are the samples only (a kilobyte or two): J and Ω follow from them faster than memory gives them back.
#[derive(Debug, Clone)]
pub struct Template {
    params: PatchParams,
    radius: usize,
    /// T without its mean, with one more sample on each side.
    samples: Vec<f32>,
    /// What was taken off: the mean under Ω.
    mean: f32,
    /// Variance of T under Ω.
    variance: f64,
    /// (JᵀΩJ)⁻¹.
    inverse: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    /// Trace of the covariance of the shift for samples of unit variance.
    shift_variance: f64,
}

/// A least-squares fit of a template to the samples of an image.
struct Fit {
    theta: SVector<f64, UNKNOWNS>,
    /// Mean squared difference that remains, under Ω.
    remaining: f64,
    correlation: f64,
}

impl Template {
    /// Prepares a patch; `None` when it has too little texture to be placed.
    pub fn new(params: &PatchParams, patch: Patch) -> Option<Self> {
        let Patch { radius, mut samples } = patch;
        let (side, window) = (2 * radius + 3, window(radius));
        let mut mean = 0.0;
        for (y, wy) in window.iter().enumerate() {
            let row = &samples[(y + 1) * side + 1..];
            mean += wy * window.iter().zip(row).map(|(wx, value)| wx * value).sum::<f32>();
        }
        for sample in &mut samples {
            *sample -= mean;
        }
        let mut curvature = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        // For the covariance of a weighted fit: JᵀΩ²J.
        let mut spread = curvature;
        for (y, wy) in window.iter().enumerate() {
            let qy = y as f64 - radius as f64;
            for (x, wx) in window.iter().enumerate() {
                let (qx, at) = (x as f64 - radius as f64, (y + 1) * side + x + 1);
                let dx = 0.5 * f64::from(samples[at + 1] - samples[at - 1]);
                let dy = 0.5 * f64::from(samples[at + side] - samples[at - side]);
                let value = f64::from(samples[at]);
                let row = [dx, dy, dx * qx, dx * qy, dy * qx, dy * qy, value, 1.0];
                let weight = f64::from(wx * wy);
                for column in 0..UNKNOWNS {
                    let weighted = weight * row[column];
                    for i in column..UNKNOWNS {
                        let product = row[i] * weighted;
                        curvature[(i, column)] += product;
                        spread[(i, column)] += product * weight;
                    }
                }
            }
        }
        curvature.fill_upper_triangle_with_lower_triangle();
        spread.fill_upper_triangle_with_lower_triangle();
        let texture = curvature.fixed_view::<2, 2>(0, 0).into_owned();
        let flat = texture.symmetric_eigenvalues().min() <= SINGULAR * curvature.trace();
        let inverse = curvature.cholesky().filter(|_| !flat)?.inverse();
        let shift = inverse.fixed_rows::<2>(0);
        let shift_variance = (shift * spread * shift.transpose()).trace();
        let variance = curvature[(6, 6)];
        Some(Self { params: *params, radius, samples, mean, variance, inverse, shift_variance })
    }

    /// How the image at `frame` correlates with the template as it is; `None` where it leaves the image.
    pub fn correlation(&self, pyramid: &ImagePyramid, frame: &PatchFrame) -> Option<f64> {
        let grid = frame.grid(&Matrix2::identity(), &Vector2::zeros());
        SAMPLES.with_borrow_mut(|samples| {
            let inside = pyramid.sample(pyramid.level_for(frame.spacing()), &grid, self.radius, samples);
            inside.then(|| self.fit(window(self.radius), &samples.values).correlation)
        })
    }

    /// Finds the template near the middle of `frame`, which also gives the expected shape; `None` where it is not.
    ///
    /// The shift is not bounded: whether it is plausible depends on how well the place was known. Where the first
    /// look correlates by less than `least_at_first`, nothing is sought; -1 seeks in any case.
    pub fn align(&self, pyramid: &ImagePyramid, frame: &PatchFrame, least_at_first: f64) -> Option<Aligned> {
        let level = pyramid.level_for(frame.spacing());
        let (mut shape, mut shift) = (Matrix2::identity(), Vector2::zeros());
        let fit = |shape: &Matrix2<f64>, shift: &Vector2<f64>| {
            SAMPLES.with_borrow_mut(|samples| {
                let inside = pyramid.sample(level, &frame.grid(shape, shift), self.radius, samples);
                inside.then(|| self.fit(window(self.radius), &samples.values))
            })
        };
        let mut found = fit(&shape, &shift).filter(|first| first.correlation >= least_at_first)?;
        for _ in 0..self.params.max_iterations {
            let gain = found.theta[6];
            if !(MIN_GAIN..=1.0 / MIN_GAIN).contains(&gain) {
                return None;
            }
            let step = found.theta / gain;
            let turned = Matrix2::new(1.0 + step[2], step[3], step[4], 1.0 + step[5]).try_inverse()?;
            shape *= turned;
            let moved = shape * Vector2::new(step[0], step[1]);
            shift -= moved;
            let deformed = (shape - Matrix2::identity()).amax();
            if deformed.is_nan() || deformed > self.params.max_distortion || shift.amax() > REACH {
                return None;
            }
            // So near, the fit would tell nothing new.
            if moved.amax() < CONVERGED {
                break;
            }
            found = fit(&shape, &shift)?;
        }
        if found.correlation.is_nan() || found.correlation < self.params.min_correlation {
            return None;
        }
        let gain = found.theta[6].abs().max(MIN_GAIN);
        let variance = CORRELATED_SAMPLES * found.remaining / (gain * gain);
        let noise_px = (0.5 * variance * self.shift_variance).sqrt() * frame.spacing();
        let pixel = frame.pixel(&shift);
        (noise_px.is_finite() && pixel.iter().all(|value| value.is_finite())).then_some(Aligned {
            pixel,
            noise_px,
            correlation: found.correlation,
            shape,
        })
    }

    /// θ for the samples of an image, row by row.
    fn fit(&self, window: &[f32], values: &[f32]) -> Fit {
        let sums = weighted_sums(Level::detect(), &self.samples, window, values, self.mean);
        let [dx, dy, dx_x, dx_y, dy_x, dy_y, own, one, squared] = sums;
        // The gradient is half of the difference.
        let right =
            SVector::from([0.5 * dx, 0.5 * dy, 0.5 * dx_x, 0.5 * dx_y, 0.5 * dy_x, 0.5 * dy_y, own, one]);
        let theta = self.inverse * right;
        let variance = squared - one * one;
        Fit {
            theta,
            remaining: (squared - theta.dot(&right)).max(0.0),
            correlation: own / (self.variance * variance).sqrt(),
        }
    }
}

vectorized! {
    /// Sums under Ω of 2 T_x, 2 T_y, 2 T_x·q, 2 T_y·q, T and 1 times I, and of I² (`values` less `mean`).
    fn weighted_sums(samples: &[f32], window: &[f32], values: &[f32], mean: f32) -> [f64; UNKNOWNS + 1] {
        const BLOCK: usize = 8;
        let mut sums = [0.0; UNKNOWNS + 1];
        let mut at = 0;
        while at + BLOCK <= window.len() {
            add_columns::<BLOCK>(samples, window, values, mean, at, &mut sums);
            at += BLOCK;
        }
        while at < window.len() {
            add_columns::<1>(samples, window, values, mean, at, &mut sums);
            at += 1;
        }
        sums
    }
}

/// Adds the sums over `N` columns side by side, from column `at` on.
#[inline(always)]
fn add_columns<const N: usize>(
    samples: &[f32],
    window: &[f32],
    values: &[f32],
    mean: f32,
    at: usize,
    sums: &mut [f64; UNKNOWNS + 1],
) {
    let (across, radius) = (window.len(), window.len() / 2);
    let side = across + 2;
    let [mut dx, mut dx_y, mut dy, mut dy_y, mut own, mut one, mut squared] = [[0.0_f32; N]; 7];
    for (y, &weight) in window.iter().enumerate() {
        let qy = y as f32 - radius as f32;
        let (row, value): (_, &[f32; N]) = ((y + 1) * side + at, cut(values, y * across + at));
        let (left, here, right) = (cut(samples, row), cut(samples, row + 1), cut(samples, row + 2));
        let (above, below) = (cut(samples, row + 1 - side), cut(samples, row + 1 + side));
        let [left, here, right, above, below]: [&[f32; N]; 5] = [left, here, right, above, below];
        for x in 0..N {
            let value = value[x] - mean;
            let weighted = weight * value;
            let (by_x, by_y) = ((right[x] - left[x]) * weighted, (below[x] - above[x]) * weighted);
            dx[x] += by_x;
            dx_y[x] += qy * by_x;
            dy[x] += by_y;
            dy_y[x] += qy * by_y;
            own[x] += here[x] * weighted;
            one[x] += weighted;
            squared[x] += value * weighted;
        }
    }
    for x in 0..N {
        let (weight, qx) = (f64::from(window[at + x]), (at + x) as f64 - radius as f64);
        let terms = [dx[x], dy[x], dx[x], dx_y[x], dy[x], dy_y[x], own[x], one[x], squared[x]];
        let factors = [1.0, 1.0, qx, 1.0, qx, 1.0, 1.0, 1.0, 1.0];
        for term in 0..=UNKNOWNS {
            sums[term] += weight * f64::from(terms[term]) * factors[term];
        }
    }
}

/// `N` values from the one `at` on.
#[inline(always)]
fn cut<const N: usize>(values: &[f32], at: usize) -> &[f32; N] {
    values[at..].first_chunk().expect("as many samples as the patch has")
}

/// One factor of Ω, which is the same along both axes, of sum one.
fn window(radius: usize) -> &'static [f32] {
    static WINDOWS: [OnceLock<Vec<f32>>; MAX_RADIUS + 1] = [const { OnceLock::new() }; MAX_RADIUS + 1];
    WINDOWS[radius].get_or_init(|| {
        let falloff = -0.5 / (WINDOW * radius as f64).powi(2);
        let weights = |x: isize| (falloff * (x * x) as f64).exp();
        let radius = radius as isize;
        let sum: f64 = (-radius..=radius).map(weights).sum();
        (-radius..=radius).map(|x| (weights(x) / sum) as f32).collect()
    })
}

thread_local! {
    /// What patches are sampled into: many a millisecond are.
    static SAMPLES: RefCell<Samples> = RefCell::default();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::GreyImage;

    /// A smooth texture without any regularity within a patch.
    fn texture(x: f64, y: f64) -> f64 {
        let waves = [(0.31, 0.12, 0.3), (-0.17, 0.37, 1.1), (0.23, -0.29, 2.0), (0.05, 0.11, 0.7)];
        128.0 + 22.0 * waves.iter().map(|(a, b, phase)| (a * x + b * y + phase).sin()).sum::<f64>()
    }

    fn pyramid(size: [u32; 2], wraps: bool, value: impl Fn(f64, f64) -> f64) -> ImagePyramid {
        let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y)));
        let values = pixels
            .map(|(x, y)| value(f64::from(x) + 0.5, f64::from(y) + 0.5).round().clamp(0.0, 255.0) as u8)
            .collect();
        ImagePyramid::new(GreyImage::from_values(size[0], size[1], values).unwrap(), wraps)
    }

    fn frame(x: f64, y: f64, step: f64) -> PatchFrame {
        PatchFrame {
            center: Vector2::new(x, y),
            pixel_from_patch: Matrix2::identity() * step,
            curvature: [Matrix2::zeros(); 2],
        }
    }

    fn template(pyramid: &ImagePyramid, frame: &PatchFrame) -> Option<Template> {
        let params = PatchParams::default();
        Template::new(&params, Patch::cut(&params, pyramid, frame)?)
    }

    #[test]
    fn finds_a_patch_that_is_shifted_deformed_and_lit_otherwise() {
        let first = pyramid([128, 128], false, texture);
        // The second image shows at p what the first shows at origin + A (p − middle).
        let map = Matrix2::new(1.12, 0.08, -0.1, 0.91);
        let second = pyramid([128, 128], false, |x, y| {
            let q = Vector2::new(64.0, 64.0) + map * Vector2::new(x - 60.7, y - 66.2);
            0.8 * texture(q.x, q.y) + 15.0
        });
        let found =
            template(&first, &frame(64.0, 64.0, 1.0)).unwrap().align(&second, &frame(62.0, 65.0, 1.0), -1.0);
        let found = found.unwrap();
        assert!((found.pixel - Vector2::new(60.7, 66.2)).norm() < 0.05, "{found:?}");
        assert!(found.correlation > 0.99 && found.noise_px < 0.02, "{found:?}");
    }

    #[test]
    fn the_stated_noise_is_that_of_the_place() {
        let first = pyramid([128, 128], false, texture);
        let template = template(&first, &frame(64.0, 64.0, 1.0)).unwrap();
        let (mut squared, mut stated) = (0.0, 0.0);
        for run in 0..40_u64 {
            let noise = |x: f64, y: f64| {
                let bits = (x as u64 + 1000 * y as u64 + 1_000_000 * run).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                let bits = (bits ^ (bits >> 31)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
                ((bits >> 40) as f64 / f64::from(1 << 24) - 0.5) * 40.0
            };
            let second = pyramid([128, 128], false, |x, y| texture(x, y) + noise(x, y));
            let found = template.align(&second, &frame(64.3, 63.8, 1.0), -1.0).unwrap();
            squared += (found.pixel - Vector2::new(64.0, 64.0)).norm_squared() / 2.0;
            stated += found.noise_px * found.noise_px;
        }
        let ratio = (stated / squared).sqrt();
        assert!((0.7..2.0).contains(&ratio), "{ratio}");
    }

    #[test]
    fn a_panorama_has_patches_across_its_seam() {
        let turn = |x: f64| x / 256.0 * std::f64::consts::TAU;
        let wavy = |x: f64, y: f64| {
            120.0
                + 40.0 * (turn(x) * 20.0).sin()
                + 40.0 * (turn(x) * 9.0 + 0.3 * y).cos()
                + 20.0 * (0.4 * y).sin()
        };
        let first = pyramid([256, 128], true, wavy);
        let second = pyramid([256, 128], true, |x, y| wavy(x - 5.4, y));
        let found = template(&first, &frame(253.0, 64.0, 1.0)).unwrap().align(
            &second,
            &frame(258.0, 64.0, 1.0),
            -1.0,
        );
        assert!((found.unwrap().pixel - Vector2::new(258.4, 64.0)).norm() < 0.03, "{found:?}");
    }

    #[test]
    fn refuses_what_has_no_texture_is_something_else_or_lies_outside() {
        let first = pyramid([128, 128], false, texture);
        let flat = pyramid([128, 128], false, |_, _| 90.0);
        let edge = pyramid([128, 128], false, |x, _| if x < 64.0 { 20.0 } else { 200.0 });
        let other = pyramid([128, 128], false, |x, y| texture(1.7 * y + 31.0, 40.0 - 0.6 * x));
        let middle = frame(64.0, 64.0, 1.0);
        assert!(template(&flat, &middle).is_none() && template(&edge, &middle).is_none());
        assert!(template(&first, &frame(5.0, 64.0, 1.0)).is_none());
        let template = template(&first, &middle).unwrap();
        for (pyramid, at) in [(&flat, middle), (&other, middle), (&first, frame(3.0, 64.0, 1.0))] {
            assert!(template.align(pyramid, &at, -1.0).is_none());
        }
    }
}
