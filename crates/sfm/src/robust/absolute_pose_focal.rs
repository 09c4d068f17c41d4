use nalgebra::{Matrix3, SVector, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;

use super::absolute_pose::{cauchy_scale, turned};
use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::{Consensus, RansacParams, distinct, lo_ransac, robust_cost};
use crate::Rigid;
use crate::solvers::p4pf;

/// The pose and focal length of a pinhole camera and who supports it.
#[derive(Debug, Clone, PartialEq)]
pub struct AbsolutePoseFocalEstimate {
    /// The pose.
    pub world_from_camera: Rigid,
    /// Focal length in pixels.
    pub focal: f64,
    /// Indices of the supporting pixels, ascending.
    pub inliers: Vec<u32>,
    /// Sum over all pixels of min(r²/bound², 1).
    pub score: f64,
    /// Samples drawn.
    pub iterations: u32,
}

/// Estimates pose and focal length of a pinhole camera from pixels and the points they see.
///
/// P4Pf in LO-RANSAC, Levenberg–Marquardt on the inliers. `pixels` are relative to the principal point (x right,
/// y down), `sigmas` their standard deviations per axis in pixels: with the focal length unknown, the noise is known in
/// pixels only, so the residual is one of pixels here; points behind the camera never support. Focal lengths outside
/// `focal_range` (pixels) are not considered. `None` when the lists differ in length or fewer than
/// [`RansacParams::min_inliers`] pixels agree.
pub fn estimate_absolute_pose_focal(
    params: &RansacParams,
    pixels: &[Vector2<f64>],
    sigmas: &[f64],
    points_in_world: &[Vector3<f64>],
    focal_range: (f64, f64),
    seed: u64,
) -> Option<AbsolutePoseFocalEstimate> {
    if pixels.len() != points_in_world.len() || pixels.len() != sigmas.len() {
        return None;
    }
    let mut problem = FocalConsensus {
        pixels,
        points: points_in_world,
        inverse_sigmas: sigmas.iter().map(|sigma| 1.0 / sigma).collect(),
        focal_range,
        inverse_scale_squared: cauchy_scale(params),
    };
    let found = lo_ransac(params, &mut problem, seed)?;
    Some(AbsolutePoseFocalEstimate {
        world_from_camera: Rigid::from_matrix(&found.model.rotation, found.model.translation).inverse(),
        focal: found.model.focal,
        inliers: found.inliers,
        score: found.score,
        iterations: found.iterations,
    })
}

/// Camera from world, and f.
#[derive(Debug, Clone, Copy)]
struct Pinhole {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    focal: f64,
}

struct FocalConsensus<'a> {
    pixels: &'a [Vector2<f64>],
    points: &'a [Vector3<f64>],
    inverse_sigmas: Vec<f64>,
    focal_range: (f64, f64),
    inverse_scale_squared: f64,
}

impl Consensus for FocalConsensus<'_> {
    type Model = Pinhole;

    fn len(&self) -> usize {
        self.pixels.len()
    }

    fn sample_size(&self) -> usize {
        4
    }

    fn hypothesize(&mut self, rng: &mut ChaCha8Rng, models: &mut Vec<Pinhole>) {
        let sample = distinct::<4>(rng, self.len());
        for found in &p4pf(&sample.map(|i| self.pixels[i]), &sample.map(|i| self.points[i])) {
            if found.focal >= self.focal_range.0 && found.focal <= self.focal_range.1 {
                let inverse = found.world_from_camera.inverse();
                models.push(Pinhole {
                    rotation: inverse.rotation.to_rotation_matrix().into_inner(),
                    translation: inverse.translation,
                    focal: found.focal,
                });
            }
        }
    }

    #[inline(always)]
    fn squared_residual(&self, model: &Pinhole, index: usize, _bound: f64) -> f64 {
        let y = model.rotation * self.points[index] + model.translation;
        if !(y.z > 0.0) {
            return f64::INFINITY;
        }
        let projected = y.xy() * (model.focal / y.z);
        ((projected - self.pixels[index]) * self.inverse_sigmas[index]).norm_squared()
    }

    fn refine(&self, model: &Pinhole, inliers: &[u32], max_steps: usize) -> Pinhole {
        let refined = minimize::<7, _>(&FocalFit { data: self, inliers }, *model, max_steps);
        let (low, high) = self.focal_range;
        if refined.focal >= low && refined.focal <= high { refined } else { *model }
    }
}

struct FocalFit<'a> {
    data: &'a FocalConsensus<'a>,
    inliers: &'a [u32],
}

impl LeastSquares<7> for FocalFit<'_> {
    type Model = Pinhole;

    /// Parameters: R ← exp(δω)·R (3), t ← t + δt (3), f ← f·exp(δφ) (1).
    fn accumulate(&self, model: &Pinhole, normal: &mut Normal<7>) -> f64 {
        let mut cost = 0.0;
        for index in self.inliers {
            let i = *index as usize;
            let rotated = model.rotation * self.data.points[i];
            let y = rotated + model.translation;
            if !(y.z > 0.0) {
                return f64::INFINITY;
            }
            let factor = self.data.inverse_sigmas[i] * model.focal / y.z;
            let (a, b) = (y.x / y.z, y.y / y.z);
            let residual = y.xy() * factor - self.data.pixels[i] * self.data.inverse_sigmas[i];
            let (loss, weight) = cauchy(residual.norm_squared(), self.data.inverse_scale_squared);
            cost += loss;
            for (value, row, stretch) in [
                (residual.x, Vector3::new(factor, 0.0, -a * factor), y.x * factor),
                (residual.y, Vector3::new(0.0, factor, -b * factor), y.y * factor),
            ] {
                let turn = rotated.cross(&row);
                let full = SVector::<f64, 7>::from([turn.x, turn.y, turn.z, row.x, row.y, row.z, stretch]);
                normal.add(value, &full, weight);
            }
        }
        cost
    }

    fn cost(&self, model: &Pinhole) -> f64 {
        robust_cost(self.data, model, self.inliers, self.data.inverse_scale_squared)
    }

    fn step(&self, model: &Pinhole, delta: &SVector<f64, 7>) -> Pinhole {
        Pinhole {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: model.translation + delta.fixed_rows::<3>(3),
            focal: model.focal * delta[6].exp(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{FocalProblem, rotation_angle, seeded};

    #[test]
    fn finds_pose_and_focal_length_among_outliers() {
        let mut rng = seeded("focal");
        for seed in 0..40 {
            let mut problem = FocalProblem::exact(&mut rng, 120);
            problem.disturb(&mut rng, 0.5, 0.5);
            let found = estimate_absolute_pose_focal(
                &RansacParams::default(),
                &problem.pixels,
                &[0.5; 120],
                &problem.points,
                (200.0, 5000.0),
                seed,
            )
            .unwrap();
            assert!((found.focal / problem.focal).ln().abs() < 0.02, "{} {}", found.focal, problem.focal);
            let angle =
                rotation_angle(&found.world_from_camera.rotation, &problem.world_from_camera.rotation);
            assert!(angle.to_degrees() < 0.3);
            assert!(found.inliers.len() > 55);
        }
    }

    #[test]
    fn a_focal_length_out_of_range_is_not_considered() {
        let problem = FocalProblem::exact(&mut seeded("range"), 50);
        let range = (2.0 * problem.focal, 3.0 * problem.focal);
        let params = RansacParams { max_iterations: 200, ..RansacParams::default() };
        let found =
            estimate_absolute_pose_focal(&params, &problem.pixels, &[0.5; 50], &problem.points, range, 1);
        assert!(found.is_none());
    }
}
