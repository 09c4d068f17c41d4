//! How panoramas are stretched from window to window.
//!
//! One camera stretches and twists the whole sphere ([`setloc_features::CameraModel::StitchedEquirectangular`]); what is left of a stitched
//! panorama's distortions moves regions of it, and over the field of view of a photo that is above all another focal length, aspect
//! and skew. A panorama's pose averages them over all directions, that of a photo cut from one is off by them: a window whose focal
//! length is 0.2 % off stands some 0.2 % of its viewing distance ahead. Residuals show little of it, as such a window's points fit another
//! pose as well. So each window is resected by itself, and what its focal length, aspect and skew come out as, beyond what noise
//! explains, is told.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::Camera;

use super::shared::{Residual, residuals_of_images};
use crate::{ImageId, Reconstruction, robust::median};

/// Directions of windows about the vertical, and their half width and height as tangents: a usual photo's.
const WINDOWS: usize = 8;
const HALF: [f64; 2] = [0.7, 0.52];
/// Fewest points of a window, and windows of a model.
const MIN_POINTS: usize = 60;
const MIN_WINDOWS: usize = 12;
/// Beforehand the stretch of a window may be so large.
const PRIOR: f64 = 0.01;
/// Rounds of weights, and the residual of half weight in deviations.
const ROUNDS: usize = 12;
const HALF_WEIGHT: f64 = 2.0;
/// The median of normally distributed values squared over their variance, and of their norms in the plane over their deviation.
const MEDIAN_SQUARED: f64 = 0.455;
const MEDIAN_NORM: f64 = 1.177;
/// Windows that tell their stretch worse than this many times the median are left out.
const MAX_SIGMA: f64 = 1.5;

/// Rotation, centre, focal length, aspect, skew.
const UNKNOWNS: usize = 9;
const STRETCHES: usize = 3;

/// Standard deviations of what windows of panoramas are stretched by.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct LocalStretch {
    /// Of the focal length, as a share.
    focal: f64,
    /// Of aspect and skew.
    shear: f64,
}

/// What a window's stretch comes out as, and the deviations that noise explains.
struct Window {
    stretch: [f64; STRETCHES],
    sigma: [f64; STRETCHES],
}

/// A point seen in a window, in its axes: z ahead, y down.
struct Sight {
    expected: Vector3<f64>,
    error: Vector3<f64>,
    distance: f64,
}

impl LocalStretch {
    /// That of a model's stretched panoramas; none where it has none, or too few windows that tell.
    pub fn of(model: &Reconstruction) -> Self {
        if !model.cameras.iter().any(Camera::is_stretched) {
            return Self::default();
        }
        let of_image = residuals_of_images(model);
        let stretched = model.registered().filter(|image| model.camera_of(*image).is_stretched());
        let stretched: Vec<ImageId> = stretched.collect();
        let windows: Vec<Window> =
            stretched.par_iter().flat_map_iter(|image| windows_of(&of_image[image.index()])).collect();
        let excess = |parameter: usize| {
            let limit = MAX_SIGMA * median(windows.iter().map(|window| window.sigma[parameter]).collect())?;
            let told = || windows.iter().filter(move |window| window.sigma[parameter] <= limit);
            let shown =
                median(told().map(|window| window.stretch[parameter].powi(2)).collect())? / MEDIAN_SQUARED;
            let by_noise = median(told().map(|window| window.sigma[parameter].powi(2)).collect())?;
            Some((shown - by_noise).max(0.0))
        };
        match [0, 1, 2].map(excess) {
            [Some(focal), Some(aspect), Some(skew)] if windows.len() >= MIN_WINDOWS => {
                Self { focal: focal.sqrt(), shear: (0.5 * (aspect + skew)).sqrt() }
            }
            _ => Self::default(),
        }
    }

    /// A stretch of this size by three normal deviates: what it adds to bearings of a camera that looks along z.
    pub fn drawn(&self, [focal, aspect, skew]: [f64; STRETCHES]) -> Matrix3<f64> {
        stretch([self.focal * focal, self.shear * aspect, self.shear * skew])
    }
}

fn stretch([focal, aspect, skew]: [f64; STRETCHES]) -> Matrix3<f64> {
    Matrix3::new(focal + aspect, skew, 0.0, skew, focal - aspect, 0.0, 0.0, 0.0, 0.0)
}

/// The windows of a panorama that tell something, by what its points leave over.
fn windows_of(residuals: &[Residual]) -> Vec<Window> {
    let window = |number: usize| {
        let (sin, cos) = (std::f64::consts::TAU * number as f64 / WINDOWS as f64).sin_cos();
        let axes = Matrix3::new(cos, 0.0, -sin, 0.0, 1.0, 0.0, sin, 0.0, cos);
        let sight = |residual: &Residual| {
            let (bearing, error) = (axes * residual.bearing, axes * residual.error);
            let is_inside = bearing.z > 0.0
                && bearing.x.abs() < HALF[0] * bearing.z
                && bearing.y.abs() < HALF[1] * bearing.z;
            is_inside.then(|| Sight { expected: bearing - error, error, distance: residual.distance })
        };
        let sights: Vec<Sight> = residuals.iter().filter_map(sight).collect();
        (sights.len() >= MIN_POINTS).then(|| resected(&sights)).flatten()
    };
    (0..WINDOWS).filter_map(window).collect()
}

/// The stretch with which a window's own pose fits best, the points where they are.
fn resected(sights: &[Sight]) -> Option<Window> {
    let jacobian = |sight: &Sight| {
        let Sight { expected, distance, .. } = sight;
        let across = Matrix3::identity() - expected * expected.transpose();
        let mut jacobian = SMatrix::<f64, 3, UNKNOWNS>::zeros();
        jacobian.fixed_columns_mut::<3>(0).copy_from(&-expected.cross_matrix());
        jacobian.fixed_columns_mut::<3>(3).copy_from(&(across / -*distance));
        for at in 0..STRETCHES {
            let mut unit = [0.0; STRETCHES];
            unit[at] = 1.0;
            jacobian.set_column(6 + at, &(across * (stretch(unit) * expected)));
        }
        jacobian
    };
    let jacobians: Vec<SMatrix<f64, 3, UNKNOWNS>> = sights.iter().map(jacobian).collect();
    // Far points say as much of a centre as their distance allows: its steps are in median distances.
    let unit = median(sights.iter().map(|sight| sight.distance).collect())?;
    let mut solution = SVector::<f64, UNKNOWNS>::zeros();
    let mut sigma = [f64::INFINITY; STRETCHES];
    for _ in 0..ROUNDS {
        let left =
            |(sight, jacobian): (&Sight, &SMatrix<f64, 3, UNKNOWNS>)| sight.error - jacobian * solution;
        let residuals: Vec<Vector3<f64>> = sights.iter().zip(&jacobians).map(left).collect();
        let noise = median(residuals.iter().map(Vector3::norm).collect())? / MEDIAN_NORM;
        if !(noise > 0.0) {
            return None;
        }
        let (mut square, mut pull) = (SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros(), SVector::zeros());
        for ((sight, jacobian), residual) in sights.iter().zip(&jacobians).zip(&residuals) {
            let weight = 1.0 / (1.0 + (residual.norm() / (HALF_WEIGHT * noise)).powi(2));
            square += jacobian.transpose() * jacobian * weight;
            pull += jacobian.transpose() * sight.error * weight;
        }
        for at in 6..UNKNOWNS {
            square[(at, at)] += (noise / PRIOR).powi(2);
        }
        let scale = SVector::<f64, UNKNOWNS>::from_fn(|at, _| if (3..6).contains(&at) { unit } else { 1.0 });
        let scaled = SMatrix::from_diagonal(&scale) * square * SMatrix::from_diagonal(&scale);
        let factor = scaled.cholesky()?;
        solution = factor.solve(&pull.component_mul(&scale)).component_mul(&scale);
        let covariance = factor.inverse();
        sigma = [0, 1, 2].map(|at| covariance[(6 + at, 6 + at)].sqrt() * noise);
    }
    let stretch = [0, 1, 2].map(|at| solution[6 + at]);
    stretch.iter().chain(&sigma).all(|value| value.is_finite()).then_some(Window { stretch, sigma })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::normal;
    use crate::{
        AlignedTrack, CameraId, Observation, Place, ReconstructionImage, ReconstructionPoint, Rigid,
    };
    use nalgebra::{UnitQuaternion, Vector2};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Panoramas at one place that see points ahead, behind and to both sides, each such direction stretched by itself.
    fn stretched(camera: &Camera, sigma: LocalStretch) -> Reconstruction {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let poses: Vec<Rigid> = (0..6)
            .map(|at| Rigid::new(UnitQuaternion::identity(), Vector3::new(0.1 * f64::from(at), 0.0, 0.0)))
            .collect();
        let image = |(at, pose): (usize, &Rigid)| ReconstructionImage {
            name: format!("{at}"),
            camera: CameraId(0),
            world_from_camera: Some(*pose),
        };
        let mut points = Vec::new();
        for number in 0..4 {
            let axes =
                UnitQuaternion::from_euler_angles(0.0, f64::from(number) * std::f64::consts::FRAC_PI_2, 0.0);
            let stretches: Vec<Matrix3<f64>> =
                poses.iter().map(|_| sigma.drawn([(); 3].map(|()| normal(&mut rng)))).collect();
            for feature in 0..150 {
                let (x, y): (f64, f64) = (rng.random_range(-0.3..0.3), rng.random_range(-0.4..0.4));
                let position = axes * Vector3::new(x, y, 1.0) * rng.random_range(4.0..12.0);
                let place = |(pose, stretch): (&Rigid, &Matrix3<f64>)| {
                    let bearing = axes.inverse() * pose.inverse().transform_point(&position).normalize();
                    let off = Vector2::from_fn(|_, _| normal(&mut rng)) * 0.3;
                    let pixel = camera.project(&(axes * (bearing + stretch * bearing))).unwrap() + off;
                    Place { pixel, noise_px: 0.3 }
                };
                let places: Vec<Place> = poses.iter().zip(&stretches).map(place).collect();
                points.push(ReconstructionPoint {
                    position,
                    color: [0; 3],
                    error_sigma: 0.0,
                    track: (0..6).map(|image| Observation { image: ImageId(image), feature }).collect(),
                    covariance: None,
                    aligned: Some(AlignedTrack { places, further: Vec::new(), spot: Matrix3::zeros() }),
                });
            }
        }
        Reconstruction {
            cameras: vec![camera.clone()],
            images: poses.iter().enumerate().map(image).collect(),
            points,
            ..Reconstruction::default()
        }
    }

    #[test]
    fn windows_that_are_stretched_by_themselves_are_told_from_noise() {
        let camera = Camera::equirectangular(4096, 2048).as_stitched().unwrap();
        let sigma = LocalStretch { focal: 3e-3, shear: 1e-3 };
        let found = LocalStretch::of(&stretched(&camera, sigma));
        assert!((0.6..1.6).contains(&(found.focal / sigma.focal)), "{found:?}");
        assert!((0.6..1.6).contains(&(found.shear / sigma.shear)), "{found:?}");
        let none = LocalStretch::of(&stretched(&camera, LocalStretch::default()));
        assert!(none.focal < 5e-4 && none.shear < 3e-4, "{none:?}");
        // Panoramas that no lens has stretched are not asked.
        let rendered = Camera::equirectangular(4096, 2048);
        assert_eq!(LocalStretch::of(&stretched(&rendered, sigma)), LocalStretch::default());
    }
}
