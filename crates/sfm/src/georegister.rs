//! Alignment of a component to measured positions.

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::bundle::{PositionPrior, RobustLoss};
use crate::frame_errors::{FrameErrors, Misfit, turn_and_scale};
use crate::{ImageId, Reconstruction, Similarity};

/// How to align a component to GPS, and how certain that is beside what images show.
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
    /// What the component may be off as a whole; `None` where the measurements are no more than fix it.
    pub errors: Option<FrameErrors>,
}

/// A measured position in local east-north-up metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MeasuredPosition {
    /// East, north, up.
    pub enu: Vector3<f64>,
    /// Whether the height was measured; else it stands for none.
    pub has_height: bool,
}

/// By how much more certain than it is an adjustment takes what its images show of the shape of a whole, by what its residuals show
/// them to be off: errors that many share are in none. Rendered streets of 0.8 and 2 km come out best by this, within a factor of
/// three.
const OVERCONFIDENCE: f64 = 4.5;
/// Scale of the Cauchy loss of measured positions, in standard deviations.
const LOSS_SIGMA: f64 = 2.0;

/// Measured positions as part of an adjustment of a component that lies in their frame.
///
/// What is off by little from each image to the next adds up along a street; positions are off by metres, but each by its own. The
/// frame is free then, but what moves it is taken off the positions: those along a line would turn all about it. It is to be found anew
/// afterwards ([`georegister`]).
#[derive(Debug, Clone)]
pub struct MeasuredPositions {
    /// How certain they are.
    pub params: GeoregisterParams,
    /// By image.
    pub by_image: Vec<Option<MeasuredPosition>>,
}

impl MeasuredPositions {
    /// Those of the images whose poses an adjustment has, in its order, where observations have this [variance over what they
    /// state](crate::bundle::BundleProblem::variance_factor).
    pub(crate) fn priors(
        &self,
        images: impl Iterator<Item = ImageId>,
        variance_factor: f64,
    ) -> Vec<PositionPrior> {
        let weight = OVERCONFIDENCE * variance_factor.sqrt();
        let horizontal = self.params.gps_sigma_m / weight;
        let prior = |(pose, image): (u32, ImageId)| {
            let MeasuredPosition { enu, has_height } = (*self.by_image.get(image.index())?)?;
            let vertical = if has_height { horizontal * self.params.height_factor } else { f64::INFINITY };
            Some(PositionPrior {
                pose,
                position: enu,
                sigma: Vector3::new(horizontal, horizontal, vertical),
                loss: RobustLoss::Cauchy(LOSS_SIGMA * weight),
            })
        };
        (0..).zip(images).filter_map(prior).collect()
    }
}

/// Offsets at some places without what a small shift, turn and change of scale of all of them explains, by least squares with
/// weights by coordinate.
pub(crate) fn without_frame(
    places: &[Vector3<f64>],
    offsets: &[Vector3<f64>],
    weights: &[Vector3<f64>],
) -> Vec<Vector3<f64>> {
    let sum: f64 = weights.iter().map(Vector3::sum).sum();
    let middle =
        places.iter().zip(weights).map(|(place, weight)| place * weight.sum()).sum::<Vector3<f64>>() / sum;
    let spread = places.iter().map(|place| (place - middle).norm_squared()).sum::<f64>();
    let reach = (spread / places.len().max(1) as f64).sqrt();
    if !(sum > 0.0 && reach > 0.0 && reach.is_finite()) {
        return offsets.to_vec();
    }
    // What each coordinate of a place does under a step of the seven, by the mean distance from the middle.
    let moves = |place: &Vector3<f64>| {
        let from_middle = (place - middle) / reach;
        let mut moves = SMatrix::<f64, 3, 7>::zeros();
        moves.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        moves.fixed_view_mut::<3, 4>(0, 3).copy_from(&turn_and_scale(&from_middle));
        moves
    };
    let (mut normal, mut right) = (SMatrix::<f64, 7, 7>::zeros(), SVector::<f64, 7>::zeros());
    for ((place, offset), weight) in places.iter().zip(offsets).zip(weights) {
        let weighted = moves(place).transpose() * Matrix3::from_diagonal(&(weight / sum));
        normal += weighted * moves(place);
        right += weighted * offset;
    }
    // Places along a line tell no turn about it.
    let Ok(inverse) = normal.pseudo_inverse(UNTOLD) else { return offsets.to_vec() };
    let step = inverse * right;
    places.iter().zip(offsets).map(|(place, offset)| offset - moves(place) * step).collect()
}

/// Share of their weight below which places do not tell a movement of all of them.
const UNTOLD: f64 = 1e-9;

/// Finds the similarity that maps camera centres onto measured positions, ignoring wrong measurements.
///
/// A street is often close to a line, and then noise in the measurements would decide the roll about it. So the mean
/// up direction of the `upright` images (panorama rigs stand or hang level) fixes roll and pitch wherever the
/// measurements that agree do not spread sideways by more than their own noise, or lack a height. `None` with fewer than
/// 3 measured images, or 2 where an up direction is known, and where those that agree are at one place as far as they tell.
pub fn georegister(
    params: &GeoregisterParams,
    reconstruction: &Reconstruction,
    measured: &[Option<MeasuredPosition>],
    upright: &[bool],
    seed: u64,
) -> Option<Georegistration> {
    let up_in_world = mean_up(reconstruction, upright);
    let pairs: Vec<Pair> = reconstruction
        .registered()
        .filter_map(|image| {
            let center = reconstruction.images[image.index()].world_from_camera?.translation;
            Some(Pair { image, center, measured: (*measured.get(image.index())?)? })
        })
        .collect();
    let alignment = Alignment { params, pairs: &pairs };
    let free = alignment.robust(3, seed, |pairs| {
        let (source, target): (Vec<_>, Vec<_>) =
            pairs.iter().map(|pair| (pair.center, pair.measured.enu)).unzip();
        Similarity::from_point_pairs(&source, &target)
    });
    let level = up_in_world.and_then(|up| {
        let free = free.filter(|_| pairs.iter().all(|pair| pair.measured.has_height));
        let agreeing = free.map(|free| alignment.agreeing(&free)).unwrap_or_default();
        let agreeing: Vec<Vector3<f64>> = agreeing.iter().map(|&at| pairs[at].measured.enu).collect();
        let on_a_line = sideways_spread(&agreeing) < SPREAD_OF_NOISE * params.gps_sigma_m;
        if on_a_line { alignment.robust(2, seed, |pairs| fit_upright(&up, pairs)) } else { None }
    });
    let tilt_variance = level.map(|level| tilt_variance(&level, reconstruction, upright));
    let best = level.or(free).filter(|best| alignment.is_fixed(best))?;
    let residuals = pairs
        .iter()
        .map(|pair| {
            let agrees = alignment.error(&best, pair) <= params.max_error_sigma;
            (pair.image, pair.offset(&best).norm(), agrees)
        })
        .collect();
    let errors = FrameErrors::of(&alignment.misfits(&best), tilt_variance, params.height_factor);
    Some(Georegistration { enu_from_world: best, residuals, errors })
}

/// An image's centre in the component's frame and where it was measured.
struct Pair {
    image: ImageId,
    center: Vector3<f64>,
    measured: MeasuredPosition,
}

impl Pair {
    /// From the measurement to the centre, as far as was measured.
    fn offset(&self, similarity: &Similarity) -> Vector3<f64> {
        let mut offset = similarity.transform_point(&self.center) - self.measured.enu;
        if !self.measured.has_height {
            offset.z = 0.0;
        }
        offset
    }
}

struct Alignment<'a> {
    params: &'a GeoregisterParams,
    pairs: &'a [Pair],
}

impl Alignment<'_> {
    /// In standard deviations.
    fn error(&self, similarity: &Similarity, pair: &Pair) -> f64 {
        let mut offset = pair.offset(similarity);
        offset.z *= self.params.height_factor.recip();
        offset.norm() / self.params.gps_sigma_m
    }

    fn score(&self, similarity: &Similarity) -> f64 {
        let most = self.params.max_error_sigma.powi(2);
        self.pairs.iter().map(|pair| self.error(similarity, pair).powi(2).min(most)).sum()
    }

    /// Pairs whose measurement agrees, by their places in the list.
    fn agreeing(&self, similarity: &Similarity) -> Vec<usize> {
        let agrees = |&at: &usize| self.error(similarity, &self.pairs[at]) <= self.params.max_error_sigma;
        (0..self.pairs.len()).filter(agrees).collect()
    }

    /// What the measurements that agree miss.
    fn misfits(&self, similarity: &Similarity) -> Vec<Misfit> {
        let misfit = |at: usize| {
            let pair = &self.pairs[at];
            let place = similarity.transform_point(&pair.center);
            Misfit { place, offset: pair.offset(similarity), has_height: pair.measured.has_height }
        };
        self.agreeing(similarity).into_iter().map(misfit).collect()
    }

    /// Whether the measurements that agree tell a scale: they spread by more than they miss the centres by. Those of one place, or
    /// rounded to it, fit with everything in a point.
    fn is_fixed(&self, similarity: &Similarity) -> bool {
        let agreeing: Vec<&Pair> = self.agreeing(similarity).into_iter().map(|at| &self.pairs[at]).collect();
        let count = agreeing.len() as f64;
        let placed: Vec<Vector2<f64>> =
            agreeing.iter().map(|pair| similarity.transform_point(&pair.center).xy()).collect();
        let middle = placed.iter().sum::<Vector2<f64>>() / count;
        let root_mean = |sum: f64| (sum / count).sqrt();
        let spread = root_mean(placed.iter().map(|place| (place - middle).norm_squared()).sum());
        let missed = root_mean(agreeing.iter().map(|pair| pair.offset(similarity).xy().norm_squared()).sum());
        agreeing.len() >= self.pairs.len().min(3)
            && spread > missed
            && spread > LEAST_SPREAD * self.params.gps_sigma_m
    }

    /// The best of fits to samples of at least `least` pairs and to all, refined on what agrees.
    ///
    /// Three noisy neighbours leave the tilt of the whole free, so larger samples and the fit to all compete.
    fn robust(
        &self,
        least: usize,
        seed: u64,
        fit: impl Fn(&[&Pair]) -> Option<Similarity>,
    ) -> Option<Similarity> {
        let count = self.pairs.len();
        if count < least {
            return None;
        }
        let fit = |chosen: &[usize]| fit(&chosen.iter().map(|&at| &self.pairs[at]).collect::<Vec<_>>());
        let all: Vec<usize> = (0..count).collect();
        let mut best = fit(&all)?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for _ in 0..500 {
            let size = rng.random_range(count.min(3)..=count.min(8));
            let sample = rand::seq::index::sample(&mut rng, count, size).into_vec();
            if let Some(candidate) = fit(&sample)
                && self.score(&candidate) < self.score(&best)
            {
                best = candidate;
            }
        }
        for _ in 0..10 {
            match fit(&self.agreeing(&best)) {
                Some(refined) if self.score(&refined) < self.score(&best) => best = refined,
                _ => break,
            }
        }
        Some(best)
    }
}

/// Spread of a component in the measured frame, in standard deviations of one measurement, below which it is a point in it.
const LEAST_SPREAD: f64 = 0.01;
/// Sideways spread of the measurements, in standard deviations of one, below which they do not fix the tilt.
const SPREAD_OF_NOISE: f64 = 5.0;

/// The up directions of upright images: their cameras' −y axes.
fn ups<'r>(
    reconstruction: &'r Reconstruction,
    upright: &'r [bool],
) -> impl Iterator<Item = Vector3<f64>> + 'r {
    let level = reconstruction.images.iter().zip(upright).filter(|&(_, &level)| level);
    level.filter_map(|(image, _)| Some(image.world_from_camera?.rotation * -Vector3::y()))
}

/// The up direction that most upright images agree on: the mean of theirs.
fn mean_up(reconstruction: &Reconstruction, upright: &[bool]) -> Option<Vector3<f64>> {
    let sum: Vector3<f64> = ups(reconstruction, upright).sum();
    (sum.norm() > 0.5).then(|| sum.normalize())
}

/// Variance of the tilt about either axis, in radians squared, of what the mean of the up directions levels, if each is off by its own.
fn tilt_variance(level: &Similarity, reconstruction: &Reconstruction, upright: &[bool]) -> f64 {
    let tilts = ups(reconstruction, upright).map(|up| (level.rotation * up).xy().norm_squared());
    let (count, sum) = tilts.fold((0.0_f64, 0.0), |(count, sum), tilt| (count + 1.0, sum + tilt));
    sum / (2.0 * (count - 1.0).max(1.0) * count.max(1.0))
}

/// Second singular value of the centred points, as a standard deviation.
fn sideways_spread(points: &[Vector3<f64>]) -> f64 {
    let mean = points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64;
    let scatter: Matrix3<f64> = points.iter().map(|point| (point - mean) * (point - mean).transpose()).sum();
    let mut spread: Vec<f64> = scatter.symmetric_eigenvalues().iter().map(|value| value.max(0.0)).collect();
    spread.sort_by(|a, b| b.total_cmp(a));
    (spread[1] / points.len().max(1) as f64).sqrt()
}

/// Least-squares similarity with the up direction given: yaw and scale from horizontal offsets, then translation, its
/// height from what was measured with one.
fn fit_upright(up_in_world: &Vector3<f64>, pairs: &[&Pair]) -> Option<Similarity> {
    let level = UnitQuaternion::rotation_between(up_in_world, &Vector3::z())
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
    let placed: Vec<(Vector3<f64>, MeasuredPosition)> =
        pairs.iter().map(|pair| (level * pair.center, pair.measured)).collect();
    let means = |wanted: &dyn Fn(&MeasuredPosition) -> bool| {
        let (mut source, mut target, mut count) = (Vector3::zeros(), Vector3::zeros(), 0.0);
        for (center, measured) in placed.iter().filter(|(_, measured)| wanted(measured)) {
            source += center;
            target += measured.enu;
            count += 1.0;
        }
        (count > 0.0).then(|| (source / count, target / count))
    };
    let (source_mean, target_mean) = means(&|_| true)?;
    // As complex numbers: target = (scale · e^{i·yaw}) · source.
    let (mut real, mut imaginary, mut variance) = (0.0, 0.0, 0.0);
    for (center, measured) in &placed {
        let (a, b) = (center - source_mean, measured.enu - target_mean);
        real += a.x * b.x + a.y * b.y;
        imaginary += a.x * b.y - a.y * b.x;
        variance += a.x * a.x + a.y * a.y;
    }
    let scale = real.hypot(imaginary) / variance;
    if !(scale > 0.0 && scale.is_finite()) {
        return None;
    }
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), imaginary.atan2(real));
    let mut translation = target_mean - yaw * source_mean * scale;
    if let Some((source, target)) = means(&|measured| measured.has_height) {
        translation.z = target.z - scale * source.z;
    }
    Some(Similarity { scale, rotation: yaw * level, translation })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraId, ReconstructionImage, Rigid};

    /// A measurement with a height.
    fn at(enu: Vector3<f64>) -> MeasuredPosition {
        MeasuredPosition { enu, has_height: true }
    }

    fn street(n: usize) -> (Reconstruction, Vec<Option<MeasuredPosition>>, Similarity) {
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
            measured.push(Some(at(truth.transform_point(&center) + noise)));
        }
        (reconstruction, measured, truth)
    }

    #[test]
    fn positions_of_one_place_or_that_contradict_each_other_fix_nothing() {
        let (reconstruction, right, _) = street(8);
        let level = [true; 8];
        let place = |measured: &[Option<MeasuredPosition>]| {
            georegister(&GeoregisterParams::default(), &reconstruction, measured, &level, 0)
        };
        assert!(place(&right).is_some());
        let same = vec![Some(at(Vector3::new(3.0, 4.0, 5.0))); 8];
        assert!(place(&same).is_none());
        // Rounded to a grid of 100 m.
        let rounded = |position: &Option<MeasuredPosition>| {
            position.map(|measured| at(measured.enu.map(|value| (value / 100.0).round() * 100.0)))
        };
        assert!(place(&right.iter().map(rounded).collect::<Vec<_>>()).is_none());
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let anywhere: Vec<_> =
            (0..8).map(|_| Some(at(Vector3::from_fn(|_, _| rng.random_range(-5e4..5e4))))).collect();
        assert!(place(&anywhere).is_none());
    }

    #[test]
    fn what_moves_all_places_alike_is_taken_off_their_offsets() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut random = |reach: f64| Vector3::from_fn(|_, _| rng.random_range(-reach..reach));
        let places: Vec<Vector3<f64>> =
            (0..9).map(|_| random(20.0) + Vector3::new(300.0, -40.0, 5.0)).collect();
        let weights: Vec<Vector3<f64>> = (0..9).map(|_| random(0.5).map(|value| value + 0.6)).collect();
        let offsets: Vec<Vector3<f64>> = places.iter().map(|_| random(1.0)).collect();
        let (shift, turn) = (random(3.0), random(0.3));
        let moved: Vec<Vector3<f64>> = (places.iter().zip(&offsets))
            .map(|(place, offset)| offset + shift + turn.cross(place) + place * 0.02)
            .collect();
        let rest = without_frame(&places, &offsets, &weights);
        let size = |of: &[Vector3<f64>]| -> f64 {
            of.iter().zip(&weights).map(|(at, weight)| at.component_mul(at).dot(weight)).sum()
        };
        assert!(size(&rest) < 0.9 * size(&offsets) && size(&rest) > 0.1 * size(&offsets));
        for (same, rest) in without_frame(&places, &moved, &weights).iter().zip(&rest) {
            assert!((same - rest).norm() < 1e-9, "{same} {rest}");
        }
        // Two places keep of what is off between them nothing but what is across them, and one nothing at all.
        let two = without_frame(&places[..2], &offsets[..2], &weights[..2]);
        assert!(size(&two) < 1e-9, "{two:?}");
        assert_eq!(without_frame(&places[..1], &offsets[..1], &weights[..1]), offsets[..1]);
    }

    #[test]
    fn survives_wrong_measurements_and_names_them() {
        let (reconstruction, mut measured, truth) = street(20);
        measured[3] = Some(at(Vector3::new(500.0, 0.0, 0.0)));
        measured[11] = Some(at(Vector3::new(0.0, -300.0, 40.0)));
        let found = georegister(&GeoregisterParams::default(), &reconstruction, &measured, &[], 1).unwrap();
        for (image, distance, agrees) in &found.residuals {
            assert_eq!(*agrees, ![3, 11].contains(&image.0), "{image:?} {distance}");
        }
        assert!((found.enu_from_world.scale / truth.scale - 1.0).abs() < 0.02);
        assert!(found.enu_from_world.rotation.angle_to(&truth.rotation) < 0.1);
    }

    /// Upright cameras in a straight row, where they were measured, and the truth.
    fn straight_row(n: usize) -> (Reconstruction, Vec<Option<MeasuredPosition>>, Similarity) {
        let (mut reconstruction, _, truth) = street(n);
        let up_in_world = truth.rotation.inverse_transform_vector(&Vector3::z());
        let mut measured = Vec::new();
        for (index, image) in reconstruction.images.iter_mut().enumerate() {
            let center =
                truth.rotation.inverse_transform_vector(&Vector3::new(index as f64, 0.3 * index as f64, 0.0));
            let upright = UnitQuaternion::rotation_between(&-Vector3::y(), &up_in_world).unwrap();
            image.world_from_camera = Some(Rigid::new(upright, center));
            measured.push(Some(at(truth.transform_point(&center))));
        }
        (reconstruction, measured, truth)
    }

    #[test]
    fn a_straight_street_takes_its_tilt_from_upright_cameras_only() {
        let (reconstruction, measured, truth) = straight_row(6);
        let params = GeoregisterParams::default();
        assert_eq!(georegister(&params, &reconstruction, &measured, &[], 1), None);
        let found = georegister(&params, &reconstruction, &measured, &[true; 6], 1).unwrap();
        assert!(found.enu_from_world.rotation.angle_to(&truth.rotation) < 1e-9);
        assert!((found.enu_from_world.scale / truth.scale - 1.0).abs() < 1e-9);
    }

    #[test]
    fn one_wrong_measurement_beside_a_straight_street_does_not_tilt_it() {
        let (reconstruction, mut measured, truth) = straight_row(12);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for position in measured.iter_mut().flatten() {
            position.enu += Vector3::from_fn(|_, _| rng.random_range(-2.0..2.0));
        }
        measured[4] = Some(at(Vector3::new(300.0, -250.0, 30.0)));
        let found = georegister(&GeoregisterParams::default(), &reconstruction, &measured, &[true; 12], 1);
        let found = found.unwrap();
        let tilt =
            (found.enu_from_world.rotation * truth.rotation.inverse() * Vector3::z()).angle(&Vector3::z());
        assert!(tilt < 1e-9, "{tilt}");
        let disagreeing: Vec<u32> =
            found.residuals.iter().filter(|(.., agrees)| !agrees).map(|(image, ..)| image.0).collect();
        assert_eq!(disagreeing, [4]);
    }

    #[test]
    fn unknown_heights_neither_tilt_nor_disagree() {
        // A wide scene on a slope: with heights of zero it would be laid flat.
        let (mut reconstruction, _, truth) = street(16);
        let up_in_world = truth.rotation.inverse_transform_vector(&Vector3::z());
        let upright = UnitQuaternion::rotation_between(&-Vector3::y(), &up_in_world).unwrap();
        let mut measured = Vec::new();
        for (index, image) in reconstruction.images.iter_mut().enumerate() {
            let (x, y) = ((index % 4) as f64 * 30.0, (index / 4) as f64 * 30.0);
            let enu = Vector3::new(x, y, 0.3 * x);
            let center = truth.inverse().transform_point(&enu);
            image.world_from_camera = Some(Rigid::new(upright, center));
            let has_height = index % 3 == 0;
            measured.push(Some(MeasuredPosition {
                enu: if has_height { enu } else { Vector3::new(x, y, 0.0) },
                has_height,
            }));
        }
        let found = georegister(&GeoregisterParams::default(), &reconstruction, &measured, &[true; 16], 1);
        let found = found.unwrap();
        assert!(found.residuals.iter().all(|(.., agrees)| *agrees));
        assert!(found.enu_from_world.rotation.angle_to(&truth.rotation) < 1e-9);
    }
}
