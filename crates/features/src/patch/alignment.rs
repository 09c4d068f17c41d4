use nalgebra::{Matrix2, SMatrix, SVector, Vector2};
use serde::{Deserialize, Serialize};

use super::ImagePyramid;
use crate::FeatureError;
use crate::error::check;

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
        check("radius", self.radius as f64, "2 to 50", (2..=50).contains(&self.radius))?;
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

    /// Pixels that one step spans: the geometric mean over all directions.
    fn spacing(&self) -> f64 {
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
        let reach = params.radius as isize + 1;
        let pixels = (-reach..=reach).flat_map(|y| {
            (-reach..=reach).map(move |x| frame.pixel(&Vector2::new(x as f64, y as f64)).cast())
        });
        let mut samples = Vec::with_capacity((2 * params.radius + 3).pow(2));
        let inside = pyramid.sample(pyramid.level_for(frame.spacing()), pixels, &mut samples);
        inside.then_some(Self { radius: params.radius, samples })
    }
}

/// A patch of one image, ready to be found in others.
///
/// Alignment is the inverse compositional algorithm (S. Baker, I. Matthews, "Lucas–Kanade 20 years on", IJCV 2004) over
/// an affine map with gain and offset: I(center + A·W(q)) ≈ gain·T(q) + offset, W(q) = B·q + t. In each step
/// θ = (JᵀΩJ)⁻¹JᵀΩ·I gives gain, offset and gain·(δt, δB) at once, with J = (T_x, T_y, T_x·q, T_y·q, T, 1) and a
/// Gaussian window Ω; then W ← W ∘ (q ↦ q + δB·q + δt)⁻¹.
#[derive(Debug, Clone)]
pub struct Template {
    params: PatchParams,
    /// q of every sample.
    offsets: Vec<Vector2<f64>>,
    values: Vec<f32>,
    /// Ω, of sum one.
    weights: Vec<f32>,
    /// J, row by row.
    jacobian: Vec<[f32; UNKNOWNS]>,
    /// Rows of (JᵀΩJ)⁻¹JᵀΩ, one sample after the other.
    solve: Vec<[f32; UNKNOWNS]>,
    /// Covariance of the shift for samples of unit variance.
    shift_covariance: Matrix2<f64>,
}

impl Template {
    /// Prepares a patch; `None` when it has too little texture to be placed.
    pub fn new(params: &PatchParams, patch: &Patch) -> Option<Self> {
        let Patch { radius, samples } = patch;
        let (side, radius) = (2 * radius + 3, *radius as isize);
        let (mut offsets, mut values, mut weights, mut jacobian) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let falloff = -0.5 / (WINDOW * radius as f64).powi(2);
        for y in -radius..=radius {
            for x in -radius..=radius {
                let at = (y + radius + 1) as usize * side + (x + radius + 1) as usize;
                let value = samples[at];
                let (dx, dy) = (
                    0.5 * (samples[at + 1] - samples[at - 1]),
                    0.5 * (samples[at + side] - samples[at - side]),
                );
                let q = Vector2::new(x as f64, y as f64);
                let [qx, qy] = [x as f32, y as f32];
                weights.push((falloff * (x * x + y * y) as f64).exp() as f32);
                jacobian.push([dx, dy, dx * qx, dx * qy, dy * qx, dy * qy, value, 1.0]);
                offsets.push(q);
                values.push(value);
            }
        }
        let sum: f32 = weights.iter().sum();
        for weight in &mut weights {
            *weight /= sum;
        }
        let mut curvature = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        // For the covariance of a weighted fit: JᵀΩ²J.
        let mut spread = curvature;
        for (row, &weight) in jacobian.iter().zip(&weights) {
            let row = SVector::<f64, UNKNOWNS>::from_fn(|i, _| f64::from(row[i]));
            let weight = f64::from(weight);
            let outer = row * (row * weight).transpose();
            curvature += outer;
            spread += outer * weight;
        }
        let texture = curvature.fixed_view::<2, 2>(0, 0).into_owned();
        let flat = texture.symmetric_eigenvalues().min() <= SINGULAR * curvature.trace();
        let inverse = curvature.cholesky().filter(|_| !flat)?.inverse();
        let solve = jacobian
            .iter()
            .zip(&weights)
            .map(|(row, &weight)| {
                let row = SVector::<f64, UNKNOWNS>::from_fn(|i, _| f64::from(row[i]));
                let column = inverse * row * f64::from(weight);
                std::array::from_fn(|i| column[i] as f32)
            })
            .collect();
        let covariance = inverse * spread * inverse;
        let shift_covariance = covariance.fixed_view::<2, 2>(0, 0).into_owned();
        Some(Self { params: *params, offsets, values, weights, jacobian, solve, shift_covariance })
    }

    /// Finds the template near the middle of `frame`, which also gives the expected shape; `None` where it is not.
    ///
    /// The shift is not bounded: whether it is plausible depends on how well the place was known.
    pub fn align(&self, pyramid: &ImagePyramid, frame: &PatchFrame) -> Option<Aligned> {
        let level = pyramid.level_for(frame.spacing());
        let (mut shape, mut shift) = (Matrix2::identity(), Vector2::zeros());
        let mut values = Vec::with_capacity(self.offsets.len());
        for _ in 0..self.params.max_iterations {
            let fitted = self.fit(pyramid, level, frame, &shape, &shift, &mut values)?;
            let gain = fitted[6];
            if !(MIN_GAIN..=1.0 / MIN_GAIN).contains(&gain) {
                return None;
            }
            let step = fitted / gain;
            let turned = Matrix2::new(1.0 + step[2], step[3], step[4], 1.0 + step[5]).try_inverse()?;
            shape *= turned;
            let moved = shape * Vector2::new(step[0], step[1]);
            shift -= moved;
            let deformed = (shape - Matrix2::identity()).amax();
            if deformed.is_nan() || deformed > self.params.max_distortion || shift.amax() > REACH {
                return None;
            }
            if moved.amax() < CONVERGED {
                break;
            }
        }
        let fitted = self.fit(pyramid, level, frame, &shape, &shift, &mut values)?;
        let correlation = self.correlation(&values);
        if correlation.is_nan() || correlation < self.params.min_correlation {
            return None;
        }
        let mut remaining = 0.0;
        for ((row, &value), &weight) in self.jacobian.iter().zip(&values).zip(&self.weights) {
            let explained: f64 = row.iter().zip(&fitted).map(|(j, theta)| f64::from(*j) * theta).sum();
            remaining += f64::from(weight) * (f64::from(value) - explained).powi(2);
        }
        let variance = CORRELATED_SAMPLES * remaining / (fitted[6] * fitted[6]).max(MIN_GAIN * MIN_GAIN);
        let noise_px = (0.5 * variance * self.shift_covariance.trace()).sqrt() * frame.spacing();
        let pixel = frame.pixel(&shift);
        (noise_px.is_finite() && pixel.iter().all(|value| value.is_finite())).then_some(Aligned {
            pixel,
            noise_px,
            correlation,
            shape,
        })
    }

    /// θ for the patch under the present map, and its values.
    fn fit(
        &self,
        pyramid: &ImagePyramid,
        level: usize,
        frame: &PatchFrame,
        shape: &Matrix2<f64>,
        shift: &Vector2<f64>,
        values: &mut Vec<f32>,
    ) -> Option<SVector<f64, UNKNOWNS>> {
        let pixels = self.offsets.iter().map(|q| frame.pixel(&(shape * q + shift)).cast());
        if !pyramid.sample(level, pixels, values) {
            return None;
        }
        let mut theta = [0.0_f32; UNKNOWNS];
        for (row, &value) in self.solve.iter().zip(values.iter()) {
            for (sum, &factor) in theta.iter_mut().zip(row) {
                *sum += factor * value;
            }
        }
        Some(SVector::from_fn(|i, _| f64::from(theta[i])))
    }

    fn correlation(&self, values: &[f32]) -> f64 {
        let weighted = |of: &dyn Fn(usize) -> f64| {
            self.weights.iter().enumerate().map(|(at, &weight)| f64::from(weight) * of(at)).sum::<f64>()
        };
        let here = weighted(&|at| self.values[at].into());
        let there = weighted(&|at| values[at].into());
        let deviations = |at: usize| (f64::from(self.values[at]) - here, f64::from(values[at]) - there);
        let covariance = weighted(&|at| deviations(at).0 * deviations(at).1);
        let variances = weighted(&|at| deviations(at).0.powi(2)) * weighted(&|at| deviations(at).1.powi(2));
        covariance / variances.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DecodedImage;

    /// A smooth texture without any regularity within a patch.
    fn texture(x: f64, y: f64) -> f64 {
        let waves = [(0.31, 0.12, 0.3), (-0.17, 0.37, 1.1), (0.23, -0.29, 2.0), (0.05, 0.11, 0.7)];
        128.0 + 22.0 * waves.iter().map(|(a, b, phase)| (a * x + b * y + phase).sin()).sum::<f64>()
    }

    fn pyramid(size: [u32; 2], wraps: bool, value: impl Fn(f64, f64) -> f64) -> ImagePyramid {
        let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y)));
        let rgb = pixels
            .flat_map(|(x, y)| {
                [value(f64::from(x) + 0.5, f64::from(y) + 0.5).round().clamp(0.0, 255.0) as u8; 3]
            })
            .collect();
        ImagePyramid::new(&DecodedImage::from_rgb(size[0], size[1], rgb).unwrap(), wraps)
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
        Template::new(&params, &Patch::cut(&params, pyramid, frame)?)
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
            template(&first, &frame(64.0, 64.0, 1.0)).unwrap().align(&second, &frame(62.0, 65.0, 1.0));
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
            let found = template.align(&second, &frame(64.3, 63.8, 1.0)).unwrap();
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
        let found =
            template(&first, &frame(253.0, 64.0, 1.0)).unwrap().align(&second, &frame(258.0, 64.0, 1.0));
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
            assert!(template.align(pyramid, &at).is_none());
        }
    }
}
