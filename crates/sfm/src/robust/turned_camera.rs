use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::absolute_pose::{cauchy_scale, turned};
use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, RansacParams, distinct, lo_ransac, robust_cost};
use crate::solvers::turn_with_focal;

/// The focal length that two images of a camera show which was turned on the spot between them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TurnedCamera {
    /// Takes a ray of the first image to the second.
    pub second_from_first: UnitQuaternion<f64>,
    /// Focal length in pixels.
    pub focal: f64,
    /// Its standard deviation as a share of it.
    pub sigma: f64,
    /// Supporting matches.
    pub inliers: usize,
    /// These as a share of all matches.
    pub share: f64,
}

/// Estimates turn and focal length of a pinhole camera from matches of two images taken on one spot.
///
/// Two-point samples in LO-RANSAC, Levenberg–Marquardt on the inliers. Pixels are relative to the principal point, errors are
/// those of the second image's pixels, with a standard deviation of `noise_px` per axis. Focal lengths outside
/// `focal_range` are not considered. `None` when the lists differ in length or fewer than [`RansacParams::min_inliers`] agree.
pub fn estimate_turned_camera(
    params: &RansacParams,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    noise_px: f64,
    focal_range: (f64, f64),
    seed: u64,
) -> Option<TurnedCamera> {
    if first.len() != second.len() {
        return None;
    }
    let inverse_scale_squared = cauchy_scale(params);
    let mut problem =
        TurnConsensus { first, second, inverse_sigma: 1.0 / noise_px, focal_range, inverse_scale_squared };
    let found = lo_ransac(params, &mut problem, seed)?;
    let mut normal = Normal::zeros();
    TurnFit { data: &problem, inliers: &found.inliers }.accumulate(&found.model, &mut normal);
    let sigma = normal.matrix.cholesky()?.inverse()[(3, 3)].sqrt();
    sigma.is_finite().then(|| TurnedCamera {
        second_from_first: UnitQuaternion::from_matrix(&found.model.rotation),
        focal: found.model.focal,
        sigma,
        inliers: found.inliers.len(),
        share: found.inliers.len() as f64 / first.len() as f64,
    })
}

impl TurnedCamera {
    /// Least turn, in radians, of which a focal length is taken: of less, what the lens bends looks like another focal length.
    const MIN_TURN: f64 = 0.15;
    /// Least share of the matches that agree with a turn on the spot. Real turns show 0.72 to 0.99; where the photographer
    /// walked, up to 0.55 agree with some turn and some focal length.
    const MIN_SHARE: f64 = 0.65;
    /// Largest deviation of a focal length that is taken.
    const MAX_SIGMA: f64 = 0.02;
    /// Share by which focal lengths of one camera may differ, its distortion being unknown.
    const AGREE: f64 = 0.06;
    /// Matches of a single pair that are enough.
    const ENOUGH: usize = 100;

    /// The focal length that pairs of one camera show together; `None` where too little does, or they contradict each other.
    pub fn agreed_focal(pairs: &[Self]) -> Option<f64> {
        let tells = |pair: &&Self| {
            pair.share >= Self::MIN_SHARE
                && pair.sigma <= Self::MAX_SIGMA
                && pair.second_from_first.angle() >= Self::MIN_TURN
        };
        let telling: Vec<&Self> = pairs.iter().filter(tells).collect();
        let weight = |pairs: &[&Self]| pairs.iter().map(|pair| pair.inliers).sum::<usize>();
        let with = |focal: f64| -> Vec<&Self> {
            telling.iter().filter(|pair| (pair.focal / focal).ln().abs() <= Self::AGREE).copied().collect()
        };
        let best = telling.iter().map(|pair| with(pair.focal)).max_by_key(|agreeing| weight(agreeing))?;
        let (agreeing, all) = (weight(&best), weight(&telling));
        let is_told = (best.len() > 1 || agreeing >= Self::ENOUGH) && 3 * agreeing >= 2 * all;
        let logarithms = best.iter().map(|pair| pair.focal.ln() * pair.inliers as f64);
        is_told.then(|| (logarithms.sum::<f64>() / agreeing as f64).exp())
    }
}

/// Second camera from the first, and f.
#[derive(Debug, Clone, Copy)]
struct Turn {
    rotation: Matrix3<f64>,
    focal: f64,
}

struct TurnConsensus<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    inverse_sigma: f64,
    focal_range: (f64, f64),
    inverse_scale_squared: f64,
}

impl Consensus for TurnConsensus<'_> {
    type Model = Turn;

    fn len(&self) -> usize {
        self.first.len()
    }

    fn sample_size(&self) -> usize {
        2
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<Turn>) {
        let sample = distinct::<2>(rng, self.len());
        for found in &turn_with_focal(&sample.map(|i| self.first[i]), &sample.map(|i| self.second[i])) {
            if found.focal >= self.focal_range.0 && found.focal <= self.focal_range.1 {
                let rotation = found.second_from_first.to_rotation_matrix().into_inner();
                models.push(Turn { rotation, focal: found.focal });
            }
        }
    }

    #[inline(always)]
    fn squared_residual(&self, model: &Turn, index: usize, _bound: f64) -> f64 {
        let pixel = self.first[index];
        let y = model.rotation * Vector3::new(pixel.x, pixel.y, model.focal);
        if !(y.z > 0.0) {
            return f64::INFINITY;
        }
        ((y.xy() * (model.focal / y.z) - self.second[index]) * self.inverse_sigma).norm_squared()
    }

    fn refine(&self, model: &Turn, inliers: &[u32], max_steps: usize) -> Turn {
        let refined = minimize::<4, _>(&TurnFit { data: self, inliers }, *model, max_steps);
        let (low, high) = self.focal_range;
        if refined.focal >= low && refined.focal <= high { refined } else { *model }
    }
}

struct TurnFit<'a> {
    data: &'a TurnConsensus<'a>,
    inliers: &'a [u32],
}

impl LeastSquares<4> for TurnFit<'_> {
    type Model = Turn;

    /// Parameters: R ← exp(δω)·R (3), f ← f·exp(δφ) (1).
    fn accumulate(&self, model: &Turn, normal: &mut Normal<4>) -> f64 {
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let pixel = self.data.first[i];
            // In units of the focal length; what a longer one does to the ray is to bring it nearer to the axis.
            let y = model.rotation * Vector3::new(pixel.x / model.focal, pixel.y / model.focal, 1.0);
            if !(y.z > 0.0) {
                return f64::INFINITY;
            }
            let by_focal = -(y - model.rotation.column(2));
            let (scale, [a, b]) = (model.focal * self.data.inverse_sigma, [y.x / y.z, y.y / y.z]);
            let seen = self.data.second[i] * self.data.inverse_sigma;
            let residual = Vector2::new(a, b) * scale - seen;
            let (loss, weight) = cauchy(residual.norm_squared(), self.data.inverse_scale_squared);
            cost += loss;
            let factor = scale / y.z;
            for (value, row, place) in [
                (residual.x, Vector3::new(factor, 0.0, -a * factor), a * scale),
                (residual.y, Vector3::new(0.0, factor, -b * factor), b * scale),
            ] {
                let turn = y.cross(&row);
                let full = SVector::<f64, 4>::from([turn.x, turn.y, turn.z, place + row.dot(&by_focal)]);
                normal.add(value, &full, weight);
            }
        }
        cost
    }

    fn cost(&self, model: &Turn) -> f64 {
        robust_cost(self.data, model, self.inliers, self.data.inverse_scale_squared)
    }

    fn step(&self, model: &Turn, delta: &SVector<f64, 4>) -> Turn {
        Turn {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            focal: model.focal * delta[3].exp(),
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::synthetic::{normal, seeded};

    const FOCAL: f64 = 1250.0;
    const NOISE_PX: f64 = 0.7;

    /// Matches of two photos of 1600 × 1200 pixels with this turn about the vertical between them, three tenths of them wrong, and
    /// a step sideways as a share of the depth.
    fn photos(seed: usize, turn: f64, step: f64) -> (Vec<Vector2<f64>>, Vec<Vector2<f64>>) {
        let mut rng = seeded(&format!("turned {seed}"));
        let truth = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -turn);
        let (mut first, mut second) = (Vec::new(), Vec::new());
        while first.len() < 300 {
            let pixel = Vector2::new(rng.random_range(-800.0..800.0), rng.random_range(-600.0..600.0));
            let depth = rng.random_range(0.3..1.0);
            let ray = Vector3::new(pixel.x, pixel.y, FOCAL) / FOCAL * depth;
            let there = truth * (ray - Vector3::new(step, 0.0, 0.0));
            let seen = there.xy() * (FOCAL / there.z);
            if seen.x.abs() > 800.0 || seen.y.abs() > 600.0 {
                continue;
            }
            let wrong = first.len() % 10 < 3;
            let other = Vector2::new(rng.random_range(-800.0..800.0), rng.random_range(-600.0..600.0));
            let mut noise = || NOISE_PX * Vector2::from_fn(|_, _| normal(&mut rng));
            first.push(pixel + noise());
            second.push(if wrong { other } else { seen + noise() });
        }
        (first, second)
    }

    fn found(seed: usize, turn: f64, step: f64) -> Option<TurnedCamera> {
        let (first, second) = photos(seed, turn, step);
        let params = RansacParams { min_inliers: 30, ..RansacParams::default() };
        estimate_turned_camera(&params, &first, &second, 1.0, (400.0, 5000.0), seed as u64)
    }

    #[test]
    fn the_focal_length_is_found_within_what_is_stated() {
        let mut normalized = 0.0;
        for seed in 0..60 {
            let turned = found(seed, 0.7, 0.0).unwrap();
            assert!((200..=215).contains(&turned.inliers), "{turned:?}");
            assert!((turned.focal / FOCAL - 1.0).abs() < 0.02, "{turned:?}");
            normalized += ((turned.focal / FOCAL).ln() / turned.sigma).powi(2) / 60.0;
        }
        // Both images have the noise, one is told of.
        assert!((0.5..1.6).contains(&normalized), "{normalized}");
    }

    #[test]
    fn a_small_turn_tells_less_and_says_so() {
        let [wide, small] = [0.7, 0.05].map(|turn| found(1, turn, 0.0).unwrap().sigma);
        assert!(small > 3.0 * wide, "{small} {wide}");
    }

    #[test]
    fn a_focal_length_is_taken_that_pairs_agree_on() {
        let pair = |focal: f64, inliers: usize, turn: f64, sigma: f64| {
            let second_from_first = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turn);
            TurnedCamera { second_from_first, focal, sigma, inliers, share: 0.9 }
        };
        let agreed = |pairs: &[TurnedCamera]| TurnedCamera::agreed_focal(pairs).map(f64::round);
        assert_eq!(agreed(&[]), None);
        assert_eq!(agreed(&[pair(1000.0, 99, 0.5, 0.01)]), None);
        assert_eq!(agreed(&[pair(1000.0, 100, 0.5, 0.01)]), Some(1000.0));
        assert_eq!(agreed(&[pair(1000.0, 100, 0.1, 0.01)]), None);
        assert_eq!(agreed(&[pair(1000.0, 100, 0.5, 0.03)]), None);
        let walked = TurnedCamera { share: 0.55, ..pair(1000.0, 100, 0.5, 0.01) };
        assert_eq!(agreed(&[walked]), None);
        let two = [pair(1000.0, 40, 0.5, 0.01), pair(1050.0, 40, 0.5, 0.01)];
        assert_eq!(agreed(&two), Some(1025.0));
        let one_apart = |inliers| [two[0], two[1], pair(2000.0, inliers, 0.5, 0.01)];
        assert_eq!(agreed(&one_apart(40)), Some(1025.0));
        assert_eq!(agreed(&one_apart(41)), None);
    }

    #[test]
    fn few_agree_where_the_camera_moved() {
        let inliers = |step| found(2, 0.7, step).map_or(0, |turned| turned.inliers);
        assert!(inliers(0.2) < inliers(0.0) / 2, "{} {}", inliers(0.2), inliers(0.0));
    }
}
