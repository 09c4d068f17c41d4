mod brown;
mod equirectangular;
mod fisheye;
mod lens;
mod model;
mod newton;
mod paper_rectilinear;
mod plausible;
mod stitched;
#[cfg(test)]
mod tests;

use nalgebra::{Matrix2, Matrix2x3, Matrix3x2, SMatrix, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::FeatureError;
use lens::{Intrinsics, Lens};
pub use model::{CameraModel, ParamRole};

/// The most intrinsic parameters any model has.
pub const MAX_CAMERA_PARAMS: usize = 13;

/// Focal lengths of [`Camera::fisheye_guesses`] in units of the longer side.
const FISHEYE_FOCALS: [f64; 7] = [0.2, 0.24, 0.29, 0.35, 0.42, 0.5, 0.6];

/// Focal length in half diagonals of the image below which [`Camera::is_wide`].
const WIDE: f64 = 1.0;

/// Largest parameter by which a panorama's directions may be stretched; stitching is off by a tenth of that at most.
const MAX_STRETCH: f64 = 0.1;

/// Places along a lens's curve that [`Camera::as_fisheye`] compares.
const CURVE_SAMPLES: usize = 64;

/// A camera: model, image size and intrinsic parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// The projection model.
    pub model: CameraModel,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Intrinsic parameters in COLMAP's order.
    pub params: Vec<f64>,
}

/// How well the intrinsics of a camera are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Calibration {
    /// They are known and stay as they are.
    Known,
    /// They were estimated from photos of this camera in a scene: good enough for a model of these photos, and still
    /// estimated wherever a scene shows more.
    Estimated,
    /// They are a guess: the focal length may be half or twice as long.
    Guessed,
}

impl Calibration {
    /// Whether models of photos among themselves take them as they are.
    pub fn is_settled(self) -> bool {
        self != Self::Guessed
    }
}

/// A pixel and how it moves with the direction and the intrinsic parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectJacobian {
    /// The projected pixel.
    pub pixel: Vector2<f64>,
    /// ∂pixel / ∂direction, 2 × 3, for the direction as given (not normalized).
    pub d_direction: Matrix2x3<f64>,
    /// ∂pixel / ∂params, 2 × 13, columns in COLMAP's parameter order; unused columns are zero.
    pub d_params: SMatrix<f64, 2, MAX_CAMERA_PARAMS>,
}

/// A unit ray and how it moves with the pixel and the intrinsic parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnprojectJacobian {
    /// The unit ray in the camera frame.
    pub bearing: Vector3<f64>,
    /// ∂bearing / ∂pixel, 3 × 2; its columns are tangent to the sphere.
    pub d_pixel: Matrix3x2<f64>,
    /// ∂bearing / ∂params, 3 × 13, columns in COLMAP's parameter order; unused columns are zero.
    pub d_params: SMatrix<f64, 3, MAX_CAMERA_PARAMS>,
}

impl UnprojectJacobian {
    /// The angle in radians that one pixel spans, the root mean square over the two axes.
    pub fn pixel_angle(&self) -> f64 {
        pixel_angle(&self.d_pixel)
    }
}

/// The angle that one pixel spans, by ∂bearing / ∂pixel.
fn pixel_angle(d_pixel: &Matrix3x2<f64>) -> f64 {
    (d_pixel.norm_squared() / 2.0).sqrt()
}

/// A unit ray of a panorama before it is stretched, and how it moves with the pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlainRay {
    bearing: Vector3<f64>,
    /// 3 × 2.
    d_pixel: Matrix3x2<f64>,
}

impl Camera {
    /// A full panorama of `width` × `height` pixels.
    pub fn equirectangular(width: u32, height: u32) -> Self {
        let params = vec![f64::from(width), f64::from(height)];
        Self { model: CameraModel::Equirectangular, width, height, params }
    }

    /// A photo of which only a guess of the focal length is known: `RADIAL`, centred, no distortion yet.
    ///
    /// A guessed camera is going to be refined, and real lenses distort; two radial terms take nearly all of the
    /// distortion of phones and action cameras.
    pub fn from_focal_guess(width: u32, height: u32, focal_px: f64) -> Self {
        let params = vec![focal_px, f64::from(width) / 2.0, f64::from(height) / 2.0, 0.0, 0.0];
        Self { model: CameraModel::Radial, width, height, params }
    }

    /// Whether this is such a guess still, which nothing has improved.
    pub fn is_bare_guess(&self) -> bool {
        *self == Self::from_focal_guess(self.width, self.height, self.focal_length())
    }

    /// Whether the image's diagonal shows more than some 90°, where fisheyes and other lenses differ by more than two
    /// radial terms take up.
    pub fn is_wide(&self) -> bool {
        let half_diagonal = f64::from(self.width).hypot(f64::from(self.height)) / 2.0;
        self.focal_length() < WIDE * half_diagonal
    }

    /// Whether this is a wide camera of which photos may yet show that it is a fisheye.
    pub fn may_be_fisheye(&self) -> bool {
        matches!(self.model, CameraModel::Radial | CameraModel::Opencv) && self.is_wide()
    }

    /// The fisheye, as `OPENCV_FISHEYE` with one distortion term, whose rays come next to this lens's where most of the
    /// image is, up to 0.7 of the half diagonal; `None` of panoramas.
    ///
    /// Farther out few photos tell two radial terms, and there the two lenses differ.
    pub fn as_fisheye(&self) -> Option<Self> {
        let (_, k) = self.lens()?;
        let farthest = 0.35 * f64::from(self.width).hypot(f64::from(self.height));
        // r = a₀θ + a₁θ³
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for radius in (1..=CURVE_SAMPLES).map(|step| farthest * step as f64 / CURVE_SAMPLES as f64) {
            let Some(ray) = self.unproject(&(k.center + Vector2::new(radius, 0.0))) else { break };
            let theta = ray.x.hypot(ray.y).atan2(ray.z);
            let powers = Vector2::new(theta, theta.powi(3));
            normal += powers * powers.transpose();
            right += powers * radius;
        }
        let curve = normal.cholesky()?.solve(&right);
        let params = vec![curve[0], curve[0], k.center.x, k.center.y, curve[1] / curve[0], 0.0, 0.0, 0.0];
        let fisheye = Self { model: CameraModel::OpencvFisheye, params, ..*self };
        fisheye.validate().is_ok().then_some(fisheye)
    }

    /// The same camera with its focal length (or lengths) multiplied.
    #[must_use]
    pub fn with_focal_times(&self, factor: f64) -> Self {
        let mut scaled = self.clone();
        for (value, role) in scaled.params.iter_mut().zip(self.param_roles()) {
            if *role == ParamRole::Focal {
                *value *= factor;
            }
        }
        scaled
    }

    /// What a fisheye photo may have been taken with: centred equidistant cameras as `OPENCV_FISHEYE`, each a fifth longer
    /// than the one before, so that the longer side shows 287° to 96° (a circular image may be smaller than that).
    pub fn fisheye_guesses(width: u32, height: u32) -> impl Iterator<Item = Self> {
        let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        FISHEYE_FOCALS.into_iter().map(move |focal| {
            let focal = focal * f64::from(width.max(height));
            let params = vec![focal, focal, cx, cy, 0.0, 0.0, 0.0, 0.0];
            Self { model: CameraModel::OpencvFisheye, width, height, params }
        })
    }

    /// The same camera as `OPENCV`, with two focal lengths and tangential distortion; only of radial models.
    #[must_use]
    pub fn with_tangential_distortion(self) -> Self {
        let Some((Lens::Brown, k)) = self.lens() else { return self };
        let mut params = vec![k.focal.x, k.focal.y, k.center.x, k.center.y];
        params.extend(k.distortion);
        Self { model: CameraModel::Opencv, params, ..self }
    }

    /// Checks parameter count, finiteness and ranges.
    ///
    /// # Errors
    /// [`FeatureError::InvalidCamera`] with the value at fault.
    pub fn validate(&self) -> Result<(), FeatureError> {
        let invalid = |reason: String| Err(FeatureError::InvalidCamera { model: self.model.name(), reason });
        if self.width == 0 || self.height == 0 {
            return invalid(format!("image size {} × {}", self.width, self.height));
        }
        if !self.model.accepts_num_params(self.params.len()) {
            return invalid(format!(
                "expected {} parameters ({}), got {}",
                self.model.num_params(),
                self.model.param_names().join(", "),
                self.params.len()
            ));
        }
        for (&value, (&name, &role)) in
            self.params.iter().zip(self.model.param_names().iter().zip(self.model.param_roles()))
        {
            if !value.is_finite() {
                return invalid(format!("{name} is {value}"));
            }
            if value <= 0.0 && matches!(role, ParamRole::Focal | ParamRole::SphereSize) {
                return invalid(format!("{name} must be positive, got {value}"));
            }
            if value.abs() > MAX_STRETCH && role == ParamRole::Stretch {
                return invalid(format!("{name} must be within ±{MAX_STRETCH}, got {value}"));
            }
        }
        Ok(())
    }

    /// κ: the unit ray in the camera frame through a pixel, or `None` outside the model's domain.
    ///
    /// The pixel may lie outside the image; panoramas are periodic in x.
    pub fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        match self.lens() {
            Some((lens, k)) => lens.undistort(&k.normalize(pixel), &k.distortion),
            None => (self.sphere().unproject)(&self.params, pixel),
        }
        .filter(|bearing| bearing.iter().all(|value| value.is_finite()))
    }

    /// κ⁻¹: the pixel of a direction in the camera frame (any length), or `None` where the camera cannot see it.
    ///
    /// "Cannot see" is the model's domain, not the image border: the pixel may lie outside the image.
    pub fn project(&self, direction: &Vector3<f64>) -> Option<Vector2<f64>> {
        match self.lens() {
            Some((lens, k)) => lens.distort(direction, &k.distortion).map(|point| k.denormalize(&point)),
            None => (self.sphere().project)(&self.params, direction),
        }
        .filter(|pixel| pixel.iter().all(|value| value.is_finite()))
    }

    /// κ⁻¹ with its derivatives; `None` where [`Camera::project`] is, and exactly at a panorama's poles.
    pub fn project_with_jacobian(&self, direction: &Vector3<f64>) -> Option<ProjectJacobian> {
        let Some((lens, k)) = self.lens() else {
            return (self.sphere().project_with_jacobian)(&self.params, direction);
        };
        let distorted = lens.distort_with_jacobian(direction, &k.distortion)?;
        let pixel = k.denormalize(&distorted.point);
        if !pixel.iter().all(|value| value.is_finite()) {
            return None;
        }
        let focal = Matrix2::from_diagonal(&k.focal);
        let mut canonical = SMatrix::<f64, 2, MAX_CAMERA_PARAMS>::zeros();
        canonical[(0, 0)] = distorted.point.x;
        canonical[(1, 1)] = distorted.point.y;
        canonical[(0, 2)] = 1.0;
        canonical[(1, 3)] = 1.0;
        canonical.fixed_columns_mut::<4>(4).copy_from(&(focal * distorted.d_distortion));
        let d_params = self.model.fold_columns(&canonical);
        Some(ProjectJacobian { pixel, d_direction: focal * distorted.d_direction, d_params })
    }

    /// κ with its derivatives; `None` where [`Camera::unproject`] is.
    pub fn unproject_with_jacobian(&self, pixel: &Vector2<f64>) -> Option<UnprojectJacobian> {
        let Some((lens, k)) = self.lens() else {
            return (self.sphere().unproject_with_jacobian)(&self.params, pixel);
        };
        let point = k.normalize(pixel);
        let undistorted = lens.undistort_with_jacobian(&point, &k.distortion)?;
        if !undistorted.bearing.iter().all(|value| value.is_finite()) {
            return None;
        }
        let d_x = undistorted.d_point.column(0) / k.focal.x;
        let d_y = undistorted.d_point.column(1) / k.focal.y;
        let mut canonical = SMatrix::<f64, 3, MAX_CAMERA_PARAMS>::zeros();
        canonical.set_column(0, &(d_x * -point.x));
        canonical.set_column(1, &(d_y * -point.y));
        canonical.set_column(2, &-d_x);
        canonical.set_column(3, &-d_y);
        canonical.fixed_columns_mut::<4>(4).copy_from(&undistorted.d_distortion);
        let d_params = self.model.fold_columns(&canonical);
        let d_pixel = Matrix3x2::from_columns(&[d_x, d_y]);
        Some(UnprojectJacobian { bearing: undistorted.bearing, d_pixel, d_params })
    }

    /// What [`Camera::unproject_plain`] needs of a pixel of a stretched panorama, whatever the stretch; `None` for all other
    /// cameras, and where there is no ray.
    pub fn plain_ray(&self, pixel: &Vector2<f64>) -> Option<PlainRay> {
        self.is_stretched().then(|| stitched::plain_ray(&self.params, pixel)).flatten()
    }

    /// [`Camera::unproject_with_jacobian`] of a stretched panorama, its sphere being known, without what takes time.
    pub fn unproject_plain(&self, plain: &PlainRay) -> UnprojectJacobian {
        debug_assert!(self.is_stretched());
        stitched::of_plain(&self.params, plain)
    }

    /// [`Camera::ray`] of a stretched panorama, its sphere being known.
    pub fn ray_of_plain(&self, plain: &PlainRay) -> (Vector3<f64>, f64) {
        debug_assert!(self.is_stretched());
        let (bearing, d_pixel) = stitched::ray_of_plain(&self.params, plain);
        (bearing, pixel_angle(&d_pixel))
    }

    /// [`Camera::unproject`] and [`Camera::pixel_angle`] of a pixel in one, which spares inverting the distortion twice.
    pub fn ray(&self, pixel: &Vector2<f64>) -> Option<(Vector3<f64>, f64)> {
        if let Some((lens, k)) = self.lens() {
            let ray = lens.undistort_with_jacobian(&k.normalize(pixel), &k.distortion)?;
            let [d_x, d_y] = [0, 1].map(|axis| ray.d_point.column(axis) / k.focal[axis]);
            let is_finite = ray.bearing.iter().all(|value| value.is_finite());
            return is_finite.then(|| (ray.bearing, pixel_angle(&Matrix3x2::from_columns(&[d_x, d_y]))));
        }
        if !self.is_stretched() {
            return self.unproject(pixel).zip(self.pixel_angle(pixel));
        }
        let (bearing, d_pixel) = stitched::ray(&self.params, pixel)?;
        Some((bearing, pixel_angle(&d_pixel)))
    }

    /// The angle in radians that one pixel spans at this place of the image.
    ///
    /// The root mean square over the two pixel axes, so an isotropic pixel error of σ pixels has the angular
    /// variance `(σ · pixel_angle)²` per tangent axis on average. Near a panorama's poles this falls to 1/√2 of the
    /// equator's.
    pub fn pixel_angle(&self, pixel: &Vector2<f64>) -> Option<f64> {
        if self.model == CameraModel::Equirectangular {
            return equirectangular::pixel_angle(&self.params, pixel);
        }
        if self.is_stretched() {
            return self.ray(pixel).map(|(_, angle)| angle);
        }
        self.unproject_with_jacobian(pixel).map(|ray| ray.pixel_angle())
    }

    /// [`Camera::pixel_angle`] where a direction in the camera frame (of unit length) is seen, which inverts no
    /// distortion.
    pub fn pixel_angle_towards(&self, direction: &Vector3<f64>) -> Option<f64> {
        let Some((lens, k)) = self.lens() else { return self.pixel_angle(&self.project(direction)?) };
        let by_direction = lens.d_direction(direction, &k.distortion)?;
        let (x, y) = (by_direction.row(0) * k.focal.x, by_direction.row(1) * k.focal.y);
        // Its pseudo-inverse P⁺ is ∂bearing/∂pixel, and ‖P⁺‖² the trace of (P Pᵀ)⁻¹.
        let (xx, xy, yy) = (x.dot(&x), x.dot(&y), y.dot(&y));
        let squared = (xx + yy) / (2.0 * (xx * yy - xy * xy));
        (squared > 0.0 && squared.is_finite()).then(|| squared.sqrt())
    }

    /// Whether a pixel lies in the image.
    pub fn contains(&self, pixel: &Vector2<f64>) -> bool {
        pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < f64::from(self.width)
            && pixel.y < f64::from(self.height)
    }

    /// Whether the camera sees the whole sphere (or is a crop of a picture that does).
    pub fn is_panoramic(&self) -> bool {
        matches!(self.model, CameraModel::Equirectangular | CameraModel::StitchedEquirectangular)
    }

    /// Whether this is a panorama whose stitching is known to stretch directions.
    pub fn is_stretched(&self) -> bool {
        self.model == CameraModel::StitchedEquirectangular
    }

    /// A plain panorama as one whose stretch can be estimated, none as yet; `None` of other cameras.
    pub fn as_stitched(&self) -> Option<Self> {
        let mut params = self.params.clone();
        params.resize(CameraModel::StitchedEquirectangular.num_params(), 0.0);
        let is_plain = self.model == CameraModel::Equirectangular;
        is_plain.then_some(Self { model: CameraModel::StitchedEquirectangular, params, ..*self })
    }

    /// The plain panorama of a stretched one, other cameras as they are: what shows a direction here shows it there at
    /// another pixel.
    #[must_use]
    pub fn without_stretch(&self) -> Self {
        let mut plain = self.clone();
        if let &[width, height, left, top, ..] = &*self.params
            && self.is_stretched()
        {
            plain.model = CameraModel::Equirectangular;
            plain.params =
                if (left, top) == (0.0, 0.0) { vec![width, height] } else { vec![width, height, left, top] };
        }
        plain
    }

    /// The largest share by which directions are stretched against each other; 0 of cameras that stretch none.
    pub fn largest_stretch(&self) -> f64 {
        let of_stretch =
            |(value, role): (&f64, &ParamRole)| (*role == ParamRole::Stretch).then_some(value.abs());
        self.params.iter().zip(self.param_roles()).filter_map(of_stretch).fold(0.0, f64::max)
    }

    /// The terms by which directions are twisted (see [`CameraModel::StitchedEquirectangular`]); none of other cameras.
    pub fn twist(&self) -> &[f64] {
        if self.is_stretched() { stitched::twist(&self.params) } else { &[] }
    }

    /// Whether the left and the right border of the image are neighbours on the sphere.
    pub fn wraps_around(&self) -> bool {
        self.full_turn_px() == Some(f64::from(self.width))
    }

    /// Whether every direction is in the image: a panorama that is no crop.
    pub fn covers_the_sphere(&self) -> bool {
        self.wraps_around() && self.half_turn_px() == Some((f64::from(self.height), 0.0))
    }

    /// Width in pixels of the whole turn of a panorama, of which the image may be a crop; `None` for photos.
    pub fn full_turn_px(&self) -> Option<f64> {
        self.params.first().copied().filter(|_| self.is_panoramic())
    }

    /// Height in pixels of a panorama from pole to pole, and how much of it a crop leaves out above; `None` for photos.
    pub fn half_turn_px(&self) -> Option<(f64, f64)> {
        let top = self.params.get(3).copied().unwrap_or(0.0);
        self.params.get(1).filter(|_| self.is_panoramic()).map(|&height| (height, top))
    }

    /// The mean focal length in pixels; for panoramas the pixels per radian at the horizon.
    pub fn focal_length(&self) -> f64 {
        match self.lens() {
            Some((_, k)) => f64::midpoint(k.focal.x, k.focal.y),
            None => self.params[0] / std::f64::consts::TAU,
        }
    }

    /// What each parameter is, in the order of [`Camera::params`].
    pub fn param_roles(&self) -> &'static [ParamRole] {
        &self.model.param_roles()[..self.params.len()]
    }

    /// What a panorama, stretched or not, is computed by.
    fn sphere(&self) -> &'static Sphere {
        if self.is_stretched() { &STITCHED } else { &PLAIN }
    }

    fn lens(&self) -> Option<(Lens, Intrinsics)> {
        let p = self.params.as_slice();
        Some(match self.model {
            CameraModel::SimplePinhole => (Lens::Brown, Intrinsics::new(p[0], p[0], p[1], p[2], [0.0; 4])),
            CameraModel::Pinhole => (Lens::Brown, Intrinsics::new(p[0], p[1], p[2], p[3], [0.0; 4])),
            CameraModel::SimpleRadial => {
                (Lens::Brown, Intrinsics::new(p[0], p[0], p[1], p[2], [p[3], 0.0, 0.0, 0.0]))
            }
            CameraModel::Radial => {
                (Lens::Brown, Intrinsics::new(p[0], p[0], p[1], p[2], [p[3], p[4], 0.0, 0.0]))
            }
            CameraModel::Opencv => {
                (Lens::Brown, Intrinsics::new(p[0], p[1], p[2], p[3], [p[4], p[5], p[6], p[7]]))
            }
            CameraModel::SimpleFisheye => (Lens::Fisheye, Intrinsics::new(p[0], p[0], p[1], p[2], [0.0; 4])),
            CameraModel::OpencvFisheye => {
                (Lens::Fisheye, Intrinsics::new(p[0], p[1], p[2], p[3], [p[4], p[5], p[6], p[7]]))
            }
            CameraModel::PaperRectilinear => {
                (Lens::PaperRectilinear, Intrinsics::new(p[0], p[0], p[1], p[2], [0.0; 4]))
            }
            CameraModel::Equirectangular | CameraModel::StitchedEquirectangular => return None,
        })
    }
}

/// κ and its inverse on the whole sphere, by a panorama's parameters.
struct Sphere {
    unproject: fn(&[f64], &Vector2<f64>) -> Option<Vector3<f64>>,
    project: fn(&[f64], &Vector3<f64>) -> Option<Vector2<f64>>,
    unproject_with_jacobian: fn(&[f64], &Vector2<f64>) -> Option<UnprojectJacobian>,
    project_with_jacobian: fn(&[f64], &Vector3<f64>) -> Option<ProjectJacobian>,
}

const PLAIN: Sphere = Sphere {
    unproject: equirectangular::unproject,
    project: equirectangular::project,
    unproject_with_jacobian: equirectangular::unproject_with_jacobian,
    project_with_jacobian: equirectangular::project_with_jacobian,
};

const STITCHED: Sphere = Sphere {
    unproject: stitched::unproject,
    project: stitched::project,
    unproject_with_jacobian: stitched::unproject_with_jacobian,
    project_with_jacobian: stitched::project_with_jacobian,
};
