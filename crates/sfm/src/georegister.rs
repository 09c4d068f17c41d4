//! Alignment of a component to measured positions.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{ImageId, Reconstruction, Similarity};

/// How to align a component to GPS.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GeoregisterParams {
    /// Standard deviation of a measured horizontal position in metres.
    pub gps_sigma_m: f64,
    /// Factor by which heights are less certain than positions.
    pub height_factor: f64,
    /// Residual, in standard deviations, above which a measurement counts as wrong.
    pub max_error_sigma: f64,
}

impl Default for GeoregisterParams {
    fn default() -> Self {
        Self { gps_sigma_m: 3.0, height_factor: 2.0, max_error_sigma: 4.0 }
    }
}

/// The alignment and what disagrees with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Georegistration {
    /// East-north-up metres from the component's frame.
    pub enu_from_world: Similarity,
    /// Distance between each used image's centre and its measurement in metres, and whether it agrees.
    pub residuals: Vec<(ImageId, f64, bool)>,
}

/// Finds the similarity that maps camera centres onto measured positions, ignoring wrong measurements.
///
/// A street is often close to a line, and then noise in the measurements would decide the roll about it. So the mean
/// up direction of the `upright` images (panorama rigs stand or hang level) fixes roll and pitch whenever the
/// measurements do not spread sideways by more than their own noise. `None` with fewer than 3 measured images, or 2
/// where an up direction is known.
pub fn georegister(
    params: &GeoregisterParams,
    reconstruction: &Reconstruction,
    measured: &[Option<Vector3<f64>>],
    upright: &[bool],
    seed: u64,
) -> Option<Georegistration> {
    let up_in_world = mean_up(reconstruction, upright);
    let pairs: Vec<(ImageId, Vector3<f64>, Vector3<f64>)> = reconstruction
        .registered()
        .filter_map(|image| {
            let center = reconstruction.images[image.index()].world_from_camera?.translation;
            Some((image, center, (*measured.get(image.index())?)?))
        })
        .collect();
    if pairs.len() < if up_in_world.is_some() { 2 } else { 3 } {
        return None;
    }
    let targets: Vec<Vector3<f64>> = pairs.iter().map(|pair| pair.2).collect();
    let level = up_in_world.filter(|_| sideways_spread(&targets) < SPREAD_OF_NOISE * params.gps_sigma_m);
    let error = |similarity: &Similarity, pair: &(ImageId, Vector3<f64>, Vector3<f64>)| {
        let mut offset = similarity.transform_point(&pair.1) - pair.2;
        offset.z /= params.height_factor;
        offset.norm() / params.gps_sigma_m
    };
    let fit = |chosen: &[usize]| {
        let source: Vec<_> = chosen.iter().map(|&index| pairs[index].1).collect();
        let target: Vec<_> = chosen.iter().map(|&index| pairs[index].2).collect();
        match &level {
            Some(up) => fit_upright(up, &source, &target),
            None => Similarity::from_point_pairs(&source, &target),
        }
    };
    let score = |similarity: &Similarity| -> f64 {
        pairs.iter().map(|pair| error(similarity, pair).powi(2).min(params.max_error_sigma.powi(2))).sum()
    };
    let agreeing = |similarity: &Similarity| -> Vec<usize> {
        (0..pairs.len()).filter(|&index| error(similarity, &pairs[index]) <= params.max_error_sigma).collect()
    };

    // Three noisy neighbours leave the tilt of the whole free, so larger samples and the fit to all compete.
    let all: Vec<usize> = (0..pairs.len()).collect();
    let mut best = fit(&all)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..500 {
        let size = rng.random_range(pairs.len().min(3)..=pairs.len().min(8));
        let sample = rand::seq::index::sample(&mut rng, pairs.len(), size).into_vec();
        if let Some(candidate) = fit(&sample)
            && score(&candidate) < score(&best)
        {
            best = candidate;
        }
    }
    for _ in 0..10 {
        let chosen = agreeing(&best);
        match fit(&chosen) {
            Some(refined) if score(&refined) < score(&best) => best = refined,
            _ => break,
        }
    }
    let residuals = pairs
        .iter()
        .map(|pair| {
            let distance = (best.transform_point(&pair.1) - pair.2).norm();
            (pair.0, distance, error(&best, pair) <= params.max_error_sigma)
        })
        .collect();
    Some(Georegistration { enu_from_world: best, residuals })
}

/// Sideways spread of the measurements, in standard deviations of one, below which they do not fix the tilt.
const SPREAD_OF_NOISE: f64 = 5.0;

/// The up direction that most upright images agree on: their cameras' −y axes, averaged.
fn mean_up(reconstruction: &Reconstruction, upright: &[bool]) -> Option<Vector3<f64>> {
    let sum: Vector3<f64> = reconstruction
        .images
        .iter()
        .zip(upright)
        .filter(|&(_, &level)| level)
        .filter_map(|(image, _)| Some(image.world_from_camera?.rotation * -Vector3::y()))
        .sum();
    (sum.norm() > 0.5).then(|| sum.normalize())
}

/// Second singular value of the centred points, as a standard deviation.
fn sideways_spread(points: &[Vector3<f64>]) -> f64 {
    let mean = points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64;
    let scatter: Matrix3<f64> = points.iter().map(|point| (point - mean) * (point - mean).transpose()).sum();
    let mut spread: Vec<f64> = scatter.symmetric_eigenvalues().iter().map(|value| value.max(0.0)).collect();
    spread.sort_by(|a, b| b.total_cmp(a));
    (spread[1] / points.len().max(1) as f64).sqrt()
}

/// Least-squares similarity with the up direction given: yaw and scale from horizontal offsets, then translation.
fn fit_upright(
    up_in_world: &Vector3<f64>,
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
) -> Option<Similarity> {
    let level = UnitQuaternion::rotation_between(up_in_world, &Vector3::z())
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
    let n = source.len() as f64;
    let source: Vec<Vector3<f64>> = source.iter().map(|point| level * point).collect();
    let source_mean = source.iter().sum::<Vector3<f64>>() / n;
    let target_mean = target.iter().sum::<Vector3<f64>>() / n;
    // As complex numbers: target = (scale · e^{i·yaw}) · source.
    let (mut real, mut imaginary, mut variance) = (0.0, 0.0, 0.0);
    for (a, b) in source.iter().zip(target) {
        let (a, b) = (a - source_mean, b - target_mean);
        real += a.x * b.x + a.y * b.y;
        imaginary += a.x * b.y - a.y * b.x;
        variance += a.x * a.x + a.y * a.y;
    }
    let scale = real.hypot(imaginary) / variance;
    if !(scale > 0.0 && scale.is_finite()) {
        return None;
    }
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), imaginary.atan2(real));
    Some(Similarity { scale, rotation: yaw * level, translation: target_mean - yaw * source_mean * scale })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraId, ReconstructionImage, Rigid};

    fn street(n: usize) -> (Reconstruction, Vec<Option<Vector3<f64>>>, Similarity) {
        let truth = Similarity {
            scale: 2.5,
            rotation: UnitQuaternion::from_euler_angles(0.2, -0.4, 1.9),
            translation: Vector3::new(10.0, -4.0, 2.0),
        };
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut reconstruction = Reconstruction::default();
        let mut measured = Vec::new();
        for index in 0..n {
            let t = index as f64;
            let center = Vector3::new(t * 2.0, (t * 0.7).sin() * 3.0, (t * 1.3).cos() * 0.5);
            let world_from_camera = Some(Rigid::new(UnitQuaternion::identity(), center));
            reconstruction.images.push(ReconstructionImage {
                name: index.to_string(),
                camera: CameraId(0),
                world_from_camera,
            });
            let noise = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0));
            measured.push(Some(truth.transform_point(&center) + noise));
        }
        (reconstruction, measured, truth)
    }

    #[test]
    fn survives_wrong_measurements_and_names_them() {
        let (reconstruction, mut measured, truth) = street(20);
        measured[3] = Some(Vector3::new(500.0, 0.0, 0.0));
        measured[11] = Some(Vector3::new(0.0, -300.0, 40.0));
        let found = georegister(&GeoregisterParams::default(), &reconstruction, &measured, &[], 1).unwrap();
        for (image, distance, agrees) in &found.residuals {
            assert_eq!(*agrees, ![3, 11].contains(&image.0), "{image:?} {distance}");
        }
        assert!((found.enu_from_world.scale / truth.scale - 1.0).abs() < 0.02);
        assert!(found.enu_from_world.rotation.angle_to(&truth.rotation) < 0.1);
    }

    #[test]
    fn a_straight_street_takes_its_tilt_from_upright_cameras_only() {
        let (mut reconstruction, _, truth) = street(6);
        let up_in_world = truth.rotation.inverse_transform_vector(&Vector3::z());
        let mut measured = Vec::new();
        for (index, image) in reconstruction.images.iter_mut().enumerate() {
            let center =
                truth.rotation.inverse_transform_vector(&Vector3::new(index as f64, 0.3 * index as f64, 0.0));
            let upright = UnitQuaternion::rotation_between(&-Vector3::y(), &up_in_world).unwrap();
            image.world_from_camera = Some(Rigid::new(upright, center));
            measured.push(Some(truth.transform_point(&center)));
        }
        let params = GeoregisterParams::default();
        assert_eq!(georegister(&params, &reconstruction, &measured, &[], 1), None);
        let found = georegister(&params, &reconstruction, &measured, &[true; 6], 1).unwrap();
        assert!(found.enu_from_world.rotation.angle_to(&truth.rotation) < 1e-9);
        assert!((found.enu_from_world.scale / truth.scale - 1.0).abs() < 1e-9);
    }
}
