//! What a component that measured positions place may be off as a whole.

use nalgebra::{Matrix3, Matrix3x4, Matrix4, Vector3};
use serde::{Deserialize, Serialize};

/// Positions from which on their own deviations tell how well they fix a frame.
const MIN_POSITIONS: usize = 3;

/// What a component may be off as a whole: by a shift of its middle, and by a turn and a change of scale about that.
///
/// To first order, and if each measured position is off by its own: what all are off together is in none of it. East, north, up
/// in metres, angles in radians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameErrors {
    /// Mean place of the images whose measured positions agree.
    pub middle: Vector3<f64>,
    /// Standard deviation of one such position, in either horizontal direction.
    pub noise_m: f64,
    /// Variances of the shift; infinite upwards where no height was measured.
    pub shift: Vector3<f64>,
    /// Covariance of the turn and of the logarithm of the scale.
    pub turn_and_scale: Matrix4<f64>,
}

/// A measured position that agrees with the others.
pub(crate) struct Misfit {
    /// The centre of its image.
    pub place: Vector3<f64>,
    /// From the measurement to that, as far as was measured.
    pub offset: Vector3<f64>,
    pub has_height: bool,
}

impl FrameErrors {
    /// Those of a least-squares fit to the positions that agree; with the variance of its tilt where up directions fix that, and so
    /// horizontal offsets the rest but for the height. `height_factor` tells how far off heights are that are too few to tell it.
    ///
    /// At xᵢ from their mean, offsets of covariance S shift it by that of their own mean, S / n, and the rest by
    /// (Σ MᵢᵀMᵢ)⁻¹ (Σ MᵢᵀS Mᵢ) (Σ MᵢᵀMᵢ)⁻¹, with Mᵢ of [`turn_and_scale`]; on a plane, heading and scale by σ² / Σ xᵢ² each.
    pub(crate) fn of(misfits: &[Misfit], tilt_variance: Option<f64>, height_factor: f64) -> Option<Self> {
        let count = misfits.len() as f64;
        if misfits.len() < MIN_POSITIONS {
            return None;
        }
        // Of the two coordinates of each, four go into scale, heading and place.
        let horizontal = sum(misfits, |misfit| misfit.offset.xy().norm_squared()) / (2.0 * count - 4.0);
        let heights = sum(misfits, |misfit| f64::from(u8::from(misfit.has_height)));
        let freedom = heights - if tilt_variance.is_some() { 1.0 } else { 3.0 };
        let vertical = if freedom > 0.0 {
            sum(misfits, |misfit| misfit.offset.z.powi(2)) / freedom
        } else {
            horizontal * height_factor.powi(2)
        };
        let middle = misfits.iter().map(|misfit| misfit.place).sum::<Vector3<f64>>() / count;
        let from_middle = || misfits.iter().map(|misfit| misfit.place - middle);
        let turn_and_scale = if let Some(tilt) = tilt_variance {
            let spread: f64 = from_middle().map(|place| place.xy().norm_squared()).sum();
            let on_plane = horizontal / spread;
            Matrix4::from_diagonal(&[tilt, tilt, on_plane, on_plane].into())
        } else {
            let noise = Matrix3::from_diagonal(&Vector3::new(horizontal, horizontal, vertical));
            let moves = || from_middle().map(|place| turn_and_scale(&place));
            let inverse =
                moves().map(|moves| moves.transpose() * moves).sum::<Matrix4<f64>>().try_inverse()?;
            inverse * moves().map(|moves| moves.transpose() * noise * moves).sum::<Matrix4<f64>>() * inverse
        };
        let shift = Vector3::new(horizontal / count, horizontal / count, vertical / heights);
        Some(Self { middle, noise_m: horizontal.sqrt(), shift, turn_and_scale })
    }

    /// Covariance of what a place in the frame is off by it.
    pub fn covariance(&self, place: &Vector3<f64>) -> Matrix3<f64> {
        let moves = turn_and_scale(&(place - self.middle));
        Matrix3::from_diagonal(&self.shift) + moves * self.turn_and_scale * moves.transpose()
    }

    /// Standard deviation of the middle in either horizontal direction, in metres.
    pub fn place_m(&self) -> f64 {
        self.shift.x.sqrt()
    }

    /// Standard deviation of the heading.
    pub fn heading_rad(&self) -> f64 {
        self.turn_and_scale[(2, 2)].sqrt()
    }

    /// Standard deviation of the turn about all axes together.
    pub fn turn_rad(&self) -> f64 {
        self.turn_and_scale.fixed_view::<3, 3>(0, 0).trace().sqrt()
    }

    /// Standard deviation of the scale, as a share of it.
    pub fn scale(&self) -> f64 {
        self.turn_and_scale[(3, 3)].sqrt()
    }
}

fn sum(misfits: &[Misfit], of: impl Fn(&Misfit) -> f64) -> f64 {
    misfits.iter().map(of).sum()
}

/// How a place moves under a small turn (about x, y, z) and change of log-scale about the origin.
pub(crate) fn turn_and_scale(place: &Vector3<f64>) -> Matrix3x4<f64> {
    let mut moves = Matrix3x4::zeros();
    moves.fixed_view_mut::<3, 3>(0, 0).copy_from(&-place.cross_matrix());
    moves.set_column(3, place);
    moves
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        CameraId, GeoregisterParams, MeasuredPosition, Reconstruction, ReconstructionImage, Rigid,
        georegister,
    };

    /// Standard deviation of a measured position, and how many times that of a height is.
    const NOISE_M: f64 = 1.5;
    const HEIGHT_FACTOR: f64 = 2.0;

    /// Upright cameras in the measured frame, `wide` or in a row.
    fn cameras(wide: bool) -> Reconstruction {
        let image = |at: u32| {
            let (x, y) = (f64::from(at % 4) * 20.0, f64::from(at / 4) * if wide { 25.0 } else { 0.5 });
            let upright = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2);
            ReconstructionImage {
                name: at.to_string(),
                camera: CameraId(0),
                world_from_camera: Some(Rigid::new(upright, Vector3::new(x, y, 3.0))),
            }
        };
        Reconstruction { images: (0..12).map(image).collect(), ..Reconstruction::default() }
    }

    /// Mean squares of what a place far from the cameras is off, east and north, and up, over what is stated of it.
    fn normalized_squares(wide: bool, heights: bool) -> [f64; 2] {
        let place = Vector3::new(110.0, -70.0, 12.0);
        let params = GeoregisterParams { gps_sigma_m: NOISE_M, ..GeoregisterParams::default() };
        let reconstruction = cameras(wide);
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(wide) + 2 * u64::from(heights));
        // Of variance one.
        let mut noise = move || (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>();
        let (mut squares, mut stated) = (Vector3::zeros(), Vector3::zeros());
        for seed in 0..300 {
            let measured = |image: &ReconstructionImage| {
                let off = Vector3::new(noise(), noise(), HEIGHT_FACTOR * noise()) * NOISE_M;
                Some(MeasuredPosition {
                    enu: image.world_from_camera?.translation + off,
                    has_height: heights,
                })
            };
            let measured: Vec<_> = reconstruction.images.iter().map(measured).collect();
            let found = georegister(&params, &reconstruction, &measured, &[true; 12], seed).unwrap();
            let off = found.enu_from_world.transform_point(&place) - place;
            squares += off.component_mul(&off);
            stated += found.errors.unwrap().covariance(&place).diagonal();
        }
        [squares.xy().sum() / stated.xy().sum(), squares.z / stated.z]
    }

    #[test]
    fn what_places_are_off_is_what_is_stated() {
        let is_one = |ratio: f64| (0.8..1.25).contains(&ratio);
        let row = normalized_squares(false, true);
        assert!(row.into_iter().all(is_one), "{row:?}");
        let wide = normalized_squares(true, true);
        assert!(wide.into_iter().all(is_one), "{wide:?}");
        let [without_heights, up] = normalized_squares(true, false);
        assert!(is_one(without_heights) && up == 0.0, "{without_heights} {up}");
    }

    #[test]
    fn no_more_positions_than_fix_a_frame_tell_nothing_of_it() {
        let misfit = |at: u32| Misfit {
            place: Vector3::new(5.0 * f64::from(at), 0.0, 0.0),
            offset: Vector3::new(0.0, 1.0, 0.0),
            has_height: true,
        };
        let of = |count| FrameErrors::of(&(0..count).map(misfit).collect::<Vec<_>>(), Some(0.0), 2.0);
        assert_eq!(of(2), None);
        let errors = of(3).unwrap();
        // Three positions leave two of six coordinates to tell their noise by.
        assert!((errors.noise_m - 1.5_f64.sqrt()).abs() < 1e-12, "{errors:?}");
        assert!((errors.scale() - errors.noise_m / 50.0_f64.sqrt()).abs() < 1e-12, "{errors:?}");
        let [near, far] = [10.0, 100.0].map(|x| errors.covariance(&Vector3::new(x, 0.0, 0.0)));
        assert!(far.trace() > 10.0 * near.trace() && near.trace() > 2.0 * errors.place_m().powi(2));
    }
}
