//! Bundle Adjustment in the Large: the field's benchmark problems, on the same linear algebra.
//!
//! S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle Adjustment in the Large", ECCV 2010. Here the residual is the
//! benchmark's own, in pixels of a plane: P = RX + t, p = −P/P_z, r = f(1 + k₁‖p‖² + k₂‖p‖⁴)p − u, so that costs compare
//! with other solvers'. Setloc itself never uses it.

use std::str::FromStr;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::camera_system::Budget;
use super::levenberg_marquardt::{Limits, minimize};
use super::normal_equations::{BlockTerm, Linearized, Link, Model, NormalEquations, Structure};
use super::{BundleParams, BundleReport, RobustLoss};

/// Scalars of a camera: rotation (left perturbation), translation, f, k₁, k₂.
const CAMERA_DIM: usize = 9;

/// A camera of the benchmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BalCamera {
    /// R of `camera_from_world`; the camera looks along −z.
    pub rotation: Matrix3<f64>,
    /// t of `camera_from_world`.
    pub translation: Vector3<f64>,
    /// Focal length in pixels.
    pub focal: f64,
    /// k₁ and k₂.
    pub distortion: [f64; 2],
}

/// An observation of the benchmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BalObservation {
    /// Index into [`BalProblem::cameras`].
    pub camera: u32,
    /// Index into [`BalProblem::points`].
    pub point: u32,
    /// Offset from the image centre in pixels, y up.
    pub pixel: [f64; 2],
}

/// A problem of the benchmark.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BalProblem {
    /// All cameras.
    pub cameras: Vec<BalCamera>,
    /// All points, world frame.
    pub points: Vec<Vector3<f64>>,
    /// All observations.
    pub observations: Vec<BalObservation>,
}

/// Why a text is no benchmark problem.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BalError {
    /// The text ends early.
    #[error("the text ends after {0} numbers")]
    Truncated(usize),
    /// Something is no number, or no finite one.
    #[error("number {position} is {text:?}")]
    NotANumber {
        /// How many numbers came before.
        position: usize,
        /// What stands there.
        text: String,
    },
    /// An observation names a camera or point that does not exist.
    #[error("observation {0} is of a camera or point that does not exist")]
    OutOfRange(usize),
}

struct Numbers<'a> {
    tokens: std::str::SplitAsciiWhitespace<'a>,
    read: usize,
}

impl Numbers<'_> {
    fn next<T: FromStr>(&mut self) -> Result<T, BalError> {
        let text = self.tokens.next().ok_or(BalError::Truncated(self.read))?;
        let value =
            text.parse().map_err(|_| BalError::NotANumber { position: self.read, text: text.to_owned() })?;
        self.read += 1;
        Ok(value)
    }

    fn vector(&mut self) -> Result<Vector3<f64>, BalError> {
        Ok(Vector3::new(self.next()?, self.next()?, self.next()?))
    }
}

impl FromStr for BalProblem {
    type Err = BalError;

    /// Reads the benchmark's text format.
    fn from_str(text: &str) -> Result<Self, BalError> {
        let mut numbers = Numbers { tokens: text.split_ascii_whitespace(), read: 0 };
        let (cameras, points, observations): (usize, usize, usize) =
            (numbers.next()?, numbers.next()?, numbers.next()?);
        let mut problem = Self::default();
        for index in 0..observations {
            let (camera, point): (u32, u32) = (numbers.next()?, numbers.next()?);
            if camera as usize >= cameras || point as usize >= points {
                return Err(BalError::OutOfRange(index));
            }
            let pixel = [numbers.next()?, numbers.next()?];
            problem.observations.push(BalObservation { camera, point, pixel });
        }
        for _ in 0..cameras {
            problem.cameras.push(BalCamera {
                rotation: *Rotation3::from_scaled_axis(numbers.vector()?).matrix(),
                translation: numbers.vector()?,
                focal: numbers.next()?,
                distortion: [numbers.next()?, numbers.next()?],
            });
        }
        for _ in 0..points {
            problem.points.push(numbers.vector()?);
        }
        Ok(problem)
    }
}

struct BalModel {
    loss: RobustLoss,
    cameras: Vec<BalCamera>,
    candidates: Vec<BalCamera>,
    observations: Vec<BalObservation>,
}

impl BalCamera {
    /// p and 1/P_z of a point in the camera frame.
    #[inline]
    fn plane(in_camera: &Vector3<f64>) -> ([f64; 2], f64) {
        let inverse = 1.0 / in_camera.z;
        ([-in_camera.x * inverse, -in_camera.y * inverse], inverse)
    }

    #[inline]
    fn distort(&self, squared_radius: f64) -> f64 {
        1.0 + squared_radius * (self.distortion[0] + squared_radius * self.distortion[1])
    }
}

impl Model<CAMERA_DIM> for BalModel {
    fn loss(&self) -> RobustLoss {
        self.loss
    }

    #[inline]
    fn linearize(
        &self,
        observation: usize,
        _: &Link,
        point: &Vector3<f64>,
        out: &mut Linearized<CAMERA_DIM>,
    ) {
        let BalObservation { camera, pixel, .. } = &self.observations[observation];
        let camera = &self.cameras[*camera as usize];
        let turned = camera.rotation * point;
        let (p, inverse) = BalCamera::plane(&(turned + camera.translation));
        let n = p[0] * p[0] + p[1] * p[1];
        let distortion = camera.distort(n);
        let scale = camera.focal * distortion;
        // ∂(f·d(n)·p)/∂p = f (d I + 2 d′ p pᵀ), and ∂p/∂P = −(I | p)/P_z, 2×3.
        let slope = 2.0 * camera.focal * (camera.distortion[0] + 2.0 * camera.distortion[1] * n);
        let by_plane = [
            [scale + slope * p[0] * p[0], slope * p[0] * p[1]],
            [slope * p[0] * p[1], scale + slope * p[1] * p[1]],
        ];
        for row in 0..2 {
            out.residual[row] = scale * p[row] - pixel[row];
            let [a, b] = by_plane[row];
            let by_camera_point = Vector3::new(a, b, a * p[0] + b * p[1]) * -inverse;
            out.point[row] = camera.rotation.tr_mul(&by_camera_point).into();
            // Exp(ω)RX ≈ RX + ω × RX: mᵀ(ω × y) = ωᵀ(y × m).
            let by_rotation = turned.cross(&by_camera_point);
            out.block[row] = [
                by_rotation.x,
                by_rotation.y,
                by_rotation.z,
                by_camera_point.x,
                by_camera_point.y,
                by_camera_point.z,
                distortion * p[row],
                camera.focal * n * p[row],
                camera.focal * n * n * p[row],
            ];
        }
    }

    #[inline]
    fn squared_residual(&self, observation: usize, point: &Vector3<f64>) -> f64 {
        let BalObservation { camera, pixel, .. } = &self.observations[observation];
        let camera = &self.candidates[*camera as usize];
        let (p, _) = BalCamera::plane(&(camera.rotation * point + camera.translation));
        let scale = camera.focal * camera.distort(p[0] * p[0] + p[1] * p[1]);
        let (x, y) = (scale * p[0] - pixel[0], scale * p[1] - pixel[1]);
        x * x + y * y
    }

    fn linearize_block_terms(&self, _: BlockTerm<'_, CAMERA_DIM>) -> f64 {
        0.0
    }

    fn prior_cost(&self) -> f64 {
        0.0
    }

    fn propose(&mut self, step: &[f64]) -> bool {
        for ((current, candidate), step) in
            self.cameras.iter().zip(&mut self.candidates).zip(step.as_chunks::<CAMERA_DIM>().0)
        {
            let turn = Rotation3::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
            candidate.rotation = turn.matrix() * current.rotation;
            candidate.translation = current.translation + Vector3::new(step[3], step[4], step[5]);
            candidate.focal = current.focal + step[6];
            candidate.distortion = [current.distortion[0] + step[7], current.distortion[1] + step[8]];
        }
        true
    }

    fn accept(&mut self) {
        self.cameras.copy_from_slice(&self.candidates);
    }

    fn squared_norm(&self) -> f64 {
        let of_camera = |camera: &BalCamera| {
            1.0 + camera.translation.norm_squared()
                + camera.focal * camera.focal
                + camera.distortion[0] * camera.distortion[0]
                + camera.distortion[1] * camera.distortion[1]
        };
        self.cameras.iter().map(of_camera).sum()
    }
}

impl BalProblem {
    /// Minimizes ½ Σ ρ(‖r‖²), residuals in pixels, in place; no gauge is fixed, as is the benchmark's custom.
    pub fn solve(&mut self, params: &BundleParams) -> BundleReport {
        let mut observations = self.observations.clone();
        observations.sort_by_key(|observation| observation.point);
        let (mut links, mut points, mut point_of_index) =
            (Vec::with_capacity(observations.len()), Vec::new(), Vec::new());
        for observation in &observations {
            if point_of_index.last() != Some(&observation.point) {
                point_of_index.push(observation.point);
                points.push(self.points[observation.point as usize]);
            }
            links.push(Link { point: points.len() as u32 - 1, block: observation.camera, extra: u32::MAX });
        }
        let count = links.len();
        let loss = if params.loss.is_valid() { params.loss } else { RobustLoss::Trivial };
        let mut model =
            BalModel { loss, cameras: self.cameras.clone(), candidates: self.cameras.clone(), observations };
        let (free, block_count) = (vec![true; points.len()], self.cameras.len());
        let structure = Structure { links, points, free, block_count, extra_dims: Vec::new() };
        let mut equations =
            NormalEquations::<CAMERA_DIM>::new(structure, &Budget::new(params.linear_solver, count));
        let limits = Limits::from(params);
        let outcome = minimize(&mut model, &mut equations, &limits);
        self.cameras = model.cameras;
        for (&index, position) in point_of_index.iter().zip(equations.points()) {
            self.points[index as usize] = *position;
        }
        BundleReport::new(&outcome, count, 0, 2 * count as i64 - equations.unknowns() as i64)
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::bundle::pattern::NONE;

    /// Cameras on an arc that look at a cloud, in the benchmark's text format.
    fn example(noise: f64) -> String {
        use std::fmt::Write;
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let (cameras, points) = (6, 80);
        let (mut observations, mut tail) = (String::new(), String::new());
        let cloud: Vec<_> = (0..points)
            .map(|_| {
                Vector3::new(
                    rng.random_range(-2.0..2.0),
                    rng.random_range(-2.0..2.0),
                    rng.random_range(-2.0..2.0),
                )
            })
            .collect();
        for camera in 0..cameras {
            let axis = Vector3::new(0.05 * f64::from(camera), 0.2 * f64::from(camera) - 0.5, 0.1);
            let (rotation, translation) = (Rotation3::from_scaled_axis(axis), Vector3::new(0.1, -0.2, -9.0));
            let of_camera = BalCamera {
                rotation: *rotation.matrix(),
                translation,
                focal: 500.0,
                distortion: [-0.1, 0.02],
            };
            for (point, position) in cloud.iter().enumerate() {
                let (p, _) = BalCamera::plane(&(rotation * position + translation));
                let scale = of_camera.focal * of_camera.distort(p[0] * p[0] + p[1] * p[1]);
                writeln!(observations, "{camera} {point} {} {}", scale * p[0], scale * p[1]).unwrap();
            }
            for value in axis.iter().chain(translation.iter()).chain(&[500.0, -0.1, 0.02]) {
                writeln!(tail, "{}", value * (1.0 + noise * rng.random_range(-1.0..1.0))).unwrap();
            }
        }
        for position in &cloud {
            for value in position.iter() {
                writeln!(tail, "{}", value + noise * rng.random_range(-1.0..1.0)).unwrap();
            }
        }
        format!("{cameras} {points} {}\n{observations}{tail}", cameras as usize * points)
    }

    #[test]
    fn exact_problem_is_solved_to_nothing() {
        let mut problem: BalProblem = example(0.02).parse().unwrap();
        let params =
            BundleParams { function_tolerance: 0.0, parameter_tolerance: 0.0, ..BundleParams::default() };
        let report = problem.solve(&params);
        assert!(report.initial_cost > 100.0 && report.final_cost < 1e-12, "{report:?}");
    }

    #[test]
    fn jacobians_match_numeric_twins() {
        let problem: BalProblem = example(0.05).parse().unwrap();
        let mut model = BalModel {
            loss: RobustLoss::Trivial,
            cameras: problem.cameras.clone(),
            candidates: problem.cameras.clone(),
            observations: problem.observations.clone(),
        };
        let empty = Linearized {
            residual: [0.0; 2],
            point: [[0.0; 3]; 2],
            block: [[0.0; 9]; 2],
            extra: [[0.0; setloc_features::MAX_CAMERA_PARAMS]; 2],
        };
        let link = Link { point: 0, block: 0, extra: NONE };
        let mut at = |observation: usize, step: &[f64; 9], shift: Vector3<f64>| {
            let mut all = vec![0.0; 9 * problem.cameras.len()];
            let camera = problem.observations[observation].camera as usize;
            all[9 * camera..9 * camera + 9].copy_from_slice(step);
            model.cameras.clone_from(&problem.cameras);
            model.propose(&all);
            model.accept();
            let mut out = empty;
            let point = problem.points[problem.observations[observation].point as usize] + shift;
            model.linearize(observation, &link, &point, &mut out);
            let squared = out.residual[0].powi(2) + out.residual[1].powi(2);
            assert!((model.squared_residual(observation, &point) - squared).abs() < 1e-9 * (1.0 + squared));
            out
        };
        for observation in (0..problem.observations.len()).step_by(37) {
            let exact = at(observation, &[0.0; 9], Vector3::zeros());
            let h = 1e-6;
            for k in 0..12 {
                let (mut step, mut shift) = ([0.0; 9], Vector3::zeros());
                if k < 9 {
                    step[k] = h;
                } else {
                    shift[k - 9] = h;
                }
                let (after, before) =
                    (at(observation, &step, shift), at(observation, &step.map(|s| -s), -shift));
                for row in 0..2 {
                    let numeric = (after.residual[row] - before.residual[row]) / (2.0 * h);
                    let exact = if k < 9 { exact.block[row][k] } else { exact.point[row][k - 9] };
                    assert!((exact - numeric).abs() < 1e-5 * (1.0 + numeric.abs()), "{k}: {exact} {numeric}");
                }
            }
        }
    }

    #[test]
    fn broken_texts_are_refused_with_the_place() {
        assert_eq!("1 1".parse::<BalProblem>(), Err(BalError::Truncated(2)));
        assert_eq!("1 1 1 0 7 0 0".parse::<BalProblem>(), Err(BalError::OutOfRange(0)));
        let error = "1 1 1 0 0 x 0".parse::<BalProblem>();
        assert_eq!(error, Err(BalError::NotANumber { position: 5, text: "x".to_owned() }));
    }
}
