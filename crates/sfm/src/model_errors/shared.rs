//! Errors of bearings that neighbouring directions of an image share.
//!
//! A stitched panorama is no central projection: its lenses stand centimetres apart, what is near is displaced where they meet,
//! and what is left of their distortions moves whole regions of the picture. Points of one region are then off together, and
//! the poses with them, so that no number of points averages it out, while each by itself fits its views within the noise of
//! keypoints. How large these errors are, residuals of neighbouring points show: where noise is independent, their products are
//! zero in the mean.

use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::Camera;

use crate::synthetic::normal;
use crate::{ImageId, Reconstruction, ReconstructionPoint};

/// Angles in radians between directions whose residuals are compared: nearer ones share pixels of their patches.
pub(super) const APART: [f64; 2] = [0.026, 0.087];
/// Fewest views of a point. Two leave it one residual, along which nothing is told of the rest.
const MIN_VIEWS: usize = 3;
/// Fewest pairs of neighbours that tell anything.
pub(super) const MIN_PAIRS: usize = 200;
/// Residuals of so many times the median are those of wrong places.
const MAX_RESIDUAL: f64 = 4.0;
/// Most images whose residuals are compared.
pub(super) const MAX_IMAGES: usize = 64;
/// Share of the residuals' variance from which on shared errors matter beside those that are not: up to 0.01 in rendered
/// scenes of twenty panoramas, 0.04 in one of eight, 0.06 and 0.3 in two real ones.
pub(super) const MIN_SHARE: f64 = 0.05;

/// Waves that a field is the sum of.
const WAVES: usize = 24;
/// Angle in radians over which errors go together, as the deviation of a Gaussian: 7°, as in residuals of real panoramas (products
/// at 6° and 11° apart are 0.6 and 0.3 of those at 3°).
const LENGTH_RAD: f64 = 0.12;

/// A smooth random field of bearing errors over the sphere, by random Fourier features (A. Rahimi, B. Recht, "Random
/// features for large-scale kernel machines", NIPS 2007), and what changes of the camera add to it.
#[derive(Debug, Clone, Default)]
pub struct BearingField {
    waves: Vec<Wave>,
    /// What is added to a bearing, linear in it.
    stretch: Matrix3<f64>,
    /// Cameras and what they are in the draw.
    changes: Vec<[Camera; 2]>,
}

#[derive(Debug, Clone)]
struct Wave {
    vector: Vector3<f64>,
    phase: f64,
    amplitude: Vector3<f64>,
}

impl BearingField {
    /// One of errors of this standard deviation per tangent axis.
    pub(super) fn new(sigma_rad: f64, image: ImageId, draw: u32) -> Self {
        if sigma_rad == 0.0 {
            return Self::default();
        }
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(image.0) << 32 | u64::from(draw));
        let scale = sigma_rad * (2.0 / WAVES as f64).sqrt();
        let wave = |_| {
            let vector = Vector3::from_fn(|_, _| normal(&mut rng)) / LENGTH_RAD;
            let amplitude = Vector3::from_fn(|_, _| normal(&mut rng)) * scale;
            Wave { vector, phase: rng.random_range(0.0..std::f64::consts::TAU), amplitude }
        };
        Self { waves: (0..WAVES).map(wave).collect(), ..Self::default() }
    }

    /// The same with what changes of the camera add, from one to another each.
    pub(super) fn with_changes(self, changes: impl IntoIterator<Item = [Camera; 2]>) -> Self {
        Self { changes: changes.into_iter().collect(), ..self }
    }

    /// The same of a picture that is stretched so besides.
    pub(super) fn with_stretch(self, stretch: Matrix3<f64>) -> Self {
        Self { stretch, ..self }
    }

    /// The error of a bearing of unit length in the camera frame, across it.
    pub fn at(&self, bearing: &Vector3<f64>) -> Vector3<f64> {
        let of_wave = |wave: &Wave| wave.amplitude * (wave.vector.dot(bearing) + wave.phase).cos();
        let mut sum: Vector3<f64> = self.waves.iter().map(of_wave).sum();
        let changed = |[own, drawn]: &[Camera; 2]| Some(drawn.unproject(&own.project(bearing)?)? - bearing);
        sum += self.changes.iter().filter_map(changed).sum::<Vector3<f64>>();
        sum += self.stretch * bearing;
        sum - bearing * bearing.dot(&sum)
    }

    /// Where a pixel is moved to.
    pub fn moved(&self, camera: &Camera, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        moved(camera, pixel, |bearing| self.at(bearing))
    }
}

/// Where a pixel is moved to by an error of its bearing.
pub(super) fn moved(
    camera: &Camera,
    pixel: &Vector2<f64>,
    error: impl Fn(&Vector3<f64>) -> Vector3<f64>,
) -> Option<Vector2<f64>> {
    let bearing = camera.unproject(pixel)?;
    camera.project(&(bearing + error(&bearing)))
}

/// Standard deviation of what neighbouring bearings of a model's images share, per tangent axis, in radians; 0 where residuals show
/// none that matter, or are too few to tell.
pub(super) fn shared_sigma_rad(model: &Reconstruction) -> f64 {
    let shown = variances(model).filter(|variances| variances.shared > MIN_SHARE * variances.all);
    shown.map_or(0.0, |variances| variances.shared.sqrt())
}

/// A residual of one point in one image.
pub(super) struct Residual {
    pub bearing: Vector3<f64>,
    /// Seen minus expected, across the bearing, in radians.
    pub error: Vector3<f64>,
    /// How far away the point is.
    pub distance: f64,
    /// Share of an error's variance that the point does not take up.
    left: f64,
}

/// Variances of bearings, per tangent axis, in radians squared.
struct Variances {
    shared: f64,
    all: f64,
}

fn variances(model: &Reconstruction) -> Option<Variances> {
    let mut of_image = residuals_of_images(model);
    let mut sizes: Vec<f64> = of_image.iter().flatten().map(|residual| residual.error.norm()).collect();
    sizes.sort_by(f64::total_cmp);
    let largest = MAX_RESIDUAL * sizes.get(sizes.len() / 2)?;
    for residuals in &mut of_image {
        residuals.retain(|residual| residual.error.norm() <= largest);
    }
    of_image.retain(|residuals| !residuals.is_empty());
    let every = of_image.len().div_ceil(MAX_IMAGES).max(1);
    let (near, far) = (APART[1].cos(), APART[0].cos());
    let (mut shared, mut all) = (Mean::default(), Mean::default());
    for residuals in of_image.iter().step_by(every) {
        for (at, a) in residuals.iter().enumerate() {
            all.add(a.error.norm_squared(), 2.0 * a.left);
            let neighbours =
                residuals[at + 1..].iter().filter(|b| (near..=far).contains(&a.bearing.dot(&b.bearing)));
            for b in neighbours {
                shared.add(a.error.dot(&b.error), 2.0 * (a.left * b.left).sqrt());
            }
        }
    }
    (shared.count >= MIN_PAIRS).then(|| Variances { shared: shared.value(), all: all.value() })
}

/// A weighted mean.
#[derive(Default)]
pub(super) struct Mean {
    pub sum: f64,
    weight: f64,
    pub count: usize,
}

impl Mean {
    pub fn add(&mut self, value: f64, weight: f64) {
        self.sum += value;
        self.weight += weight;
        self.count += 1;
    }

    pub fn join(&mut self, other: &Self) {
        self.sum += other.sum;
        self.weight += other.weight;
        self.count += other.count;
    }

    pub fn value(&self) -> f64 {
        self.sum / self.weight
    }
}

/// What the points of three views and more leave over in each image.
pub(super) fn residuals_of_images(model: &Reconstruction) -> Vec<Vec<Residual>> {
    let mut of_image: Vec<Vec<Residual>> = model.images.iter().map(|_| Vec::new()).collect();
    for point in model.points.iter().filter(|point| point.track.len() >= MIN_VIEWS) {
        for (image, residual) in residuals(model, point) {
            of_image[image.index()].push(residual);
        }
    }
    of_image
}

/// What a point leaves over in the images of its track, where it has aligned places.
fn residuals<'a>(
    model: &'a Reconstruction,
    point: &'a ReconstructionPoint,
) -> impl Iterator<Item = (ImageId, Residual)> + 'a {
    let places = point.aligned.as_ref().map_or(&[][..], |aligned| &aligned.places);
    let views = point.track.len() as f64;
    let left = (2.0 * views - 3.0) / (2.0 * views);
    point.track.iter().zip(places).filter_map(move |(seen, place)| {
        let pose = model.images.get(seen.image.index())?.world_from_camera?;
        let bearing = model.camera_of(seen.image).unproject(&place.pixel)?;
        let expected = pose.inverse().transform_point(&point.position);
        let (distance, expected) = (expected.norm(), expected.try_normalize(f64::EPSILON)?);
        Some((seen.image, Residual { bearing, error: bearing - expected, distance, left }))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_is_smooth_and_as_large_as_stated() {
        let (mut rng, sigma) = (ChaCha8Rng::seed_from_u64(1), 1e-3);
        let (mut alone, mut near, mut far) = (0.0, 0.0, 0.0);
        for image in 0..400 {
            let field = BearingField::new(sigma, ImageId(image), 0);
            let bearing = Vector3::from_fn(|_, _| normal(&mut rng)).normalize();
            let aside = |angle: f64| (bearing + tangent(&bearing) * angle.tan()).normalize();
            let error = field.at(&bearing);
            assert!(error.dot(&bearing).abs() < 1e-12);
            alone += error.norm_squared();
            near += error.dot(&field.at(&aside(0.02)));
            far += error.dot(&field.at(&aside(0.6)));
        }
        let expected = 400.0 * 2.0 * sigma * sigma;
        assert!((0.8..1.2).contains(&(alone / expected)), "{}", alone / expected);
        assert!(near > 0.95 * alone && far.abs() < 0.15 * alone, "{near} {far} {alone}");
    }

    fn tangent(bearing: &Vector3<f64>) -> Vector3<f64> {
        bearing.cross(&Vector3::ith(bearing.iamin(), 1.0)).normalize()
    }
}
