//! Whether told intrinsics can be those of an image.
//!
//! What cannot be is told apart from what is unusual: fisheyes have corners without rays, crops a principal point aside, and long
//! lenses large distortion terms that move nothing. So it is asked what the parameters do in the image, not how large they are.

use nalgebra::Vector2;

use super::{Camera, CameraModel, Intrinsics, Lens, ParamRole};
use crate::FeatureError;

/// Focal lengths in units of the longer side: from a circular fisheye in a wide frame to a crop of a 1200 mm lens.
const FOCALS: std::ops::RangeInclusive<f64> = 0.05..=100.0;
/// Tangent of the angle off the axis beyond which no rectilinear lens has a picture (76°; the widest show 130° across).
const MAX_TANGENT: f64 = 4.0;
/// Least share of the image that has rays: a circle that two sides of a panoramic frame touch fills less than half of it.
const LEAST_WITH_RAYS: f64 = 0.3;
/// Least share of its radius that distortion leaves of the farthest corner's ray; pincushions leave nine tenths.
const LEAST_RADIUS: f64 = 0.5;
/// Pixels by which sizes of panoramas are rounded, and by how much of its width a whole one may be off 2:1.
const ROUNDING_PX: f64 = 2.0;
const ROUNDING: f64 = 0.005;
/// Places a side at which an image is looked at.
const SAMPLES: u32 = 33;

impl Camera {
    /// Checks that valid intrinsics can be those of such an image: focal length, principal point, distortion, and a panorama's
    /// shape.
    ///
    /// # Errors
    /// [`FeatureError::InvalidCamera`] with the value at fault.
    pub fn check_plausible(&self) -> Result<(), FeatureError> {
        self.implausible()
            .map_or(Ok(()), |reason| Err(FeatureError::InvalidCamera { model: self.model.name(), reason }))
    }

    /// Where the optical axis meets the image, in pixels from its upper left corner; panoramas have none.
    pub fn principal_point(&self) -> Option<Vector2<f64>> {
        self.lens().map(|(_, k)| k.center)
    }

    /// The same camera with its principal point in the middle of the image.
    #[must_use]
    pub fn centred(&self) -> Self {
        let mut centred = self.clone();
        let mut middle = [self.width, self.height].into_iter().map(|side| f64::from(side) / 2.0);
        for (value, role) in centred.params.iter_mut().zip(self.param_roles()) {
            if *role == ParamRole::PrincipalPoint {
                *value = middle.next().unwrap_or(*value);
            }
        }
        centred
    }

    /// The principal point, where it is not in the image, as only crops have it.
    pub fn principal_point_aside(&self) -> Option<Vector2<f64>> {
        self.principal_point().filter(|center| !self.contains(center))
    }

    /// The share of the image's pixels that have a ray.
    pub fn share_with_rays(&self) -> f64 {
        let side = |at: u32, length: u32| f64::from(length) * (f64::from(at) + 0.5) / f64::from(SAMPLES);
        let place = |at: u32| Vector2::new(side(at % SAMPLES, self.width), side(at / SAMPLES, self.height));
        let seen = (0..SAMPLES * SAMPLES).filter(|&at| self.unproject(&place(at)).is_some()).count();
        seen as f64 / f64::from(SAMPLES * SAMPLES)
    }

    fn implausible(&self) -> Option<String> {
        if self.is_panoramic() {
            return self.wrong_sphere();
        }
        let longer = f64::from(self.width.max(self.height));
        let (lens, k) = self.lens()?;
        if let Some(focal) = k.focal.iter().find(|&focal| !FOCALS.contains(&(focal / longer))) {
            let (least, most) = (FOCALS.start() * longer, FOCALS.end() * longer);
            return Some(format!("a focal length of {focal} px, expected {least:.0} to {most:.0}"));
        }
        let beside = |at: f64, length: u32| at - at.clamp(0.0, f64::from(length));
        let nearest = Vector2::new(beside(k.center.x, self.width), beside(k.center.y, self.height));
        if !matches!(lens, Lens::Fisheye) && nearest.component_div(&k.focal).norm() > MAX_TANGENT {
            let (x, y) = (k.center.x, k.center.y);
            return Some(format!("the principal point ({x}, {y}) is too far outside the image for any lens"));
        }
        let share = self.share_with_rays();
        if share < LEAST_WITH_RAYS {
            let without = 100.0 * (1.0 - share);
            return Some(format!("its distortion leaves {without:.0} % of the image without rays"));
        }
        let corner = k.normalize(&self.farthest_corner(&k.center));
        let left = radius_left(lens, &k, &corner).filter(|left| *left < LEAST_RADIUS)?;
        Some(format!(
            "its distortion leaves {left:.2} of the radius of the farthest corner's ray, expected at least {LEAST_RADIUS}"
        ))
    }

    fn farthest_corner(&self, center: &Vector2<f64>) -> Vector2<f64> {
        let far = |at: f64, length: u32| if at < f64::from(length) / 2.0 { f64::from(length) } else { 0.0 };
        Vector2::new(far(center.x, self.width), far(center.y, self.height))
    }

    fn wrong_sphere(&self) -> Option<String> {
        let &[width, height, ref crop @ ..] = &*self.params else { return None };
        let off = (width - 2.0 * height).abs();
        if self.model == CameraModel::Equirectangular
            && crop.is_empty()
            && off > ROUNDING_PX.max(ROUNDING * width)
        {
            let crop =
                "of a panorama that is cut w and h are those of the whole sphere, and left and top follow";
            return Some(format!("a whole sphere is twice as wide as high, not {width} × {height}: {crop}"));
        }
        let (left, top) = if let [left, top, ..] = crop { (*left, *top) } else { (0.0, 0.0) };
        let (columns, rows) = (f64::from(self.width), f64::from(self.height));
        let is_inside =
            columns <= width + ROUNDING_PX && top >= -ROUNDING_PX && top + rows <= height + ROUNDING_PX;
        (!is_inside || left.abs() > width).then(|| {
            format!("{columns} × {rows} pixels from ({left}, {top}) on are not within a sphere of {width} × {height}")
        })
    }
}

/// The radius of the ray through a place on the focal plane, in units of the place's own; `None` of fisheyes, and without a ray.
fn radius_left(lens: Lens, k: &Intrinsics, place: &Vector2<f64>) -> Option<f64> {
    let ray = lens.undistort(place, &k.distortion).filter(|_| matches!(lens, Lens::Brown))?;
    Some(ray.x.hypot(ray.y) / ray.z / place.norm())
}

#[cfg(test)]
mod tests {
    use CameraModel::{
        Equirectangular, Opencv, OpencvFisheye, Pinhole, Radial, SimpleFisheye, SimplePinhole, SimpleRadial,
    };

    use super::*;

    fn said(model: CameraModel, (width, height): (u32, u32), params: &[f64]) -> String {
        let camera = Camera { model, width, height, params: params.to_vec() };
        camera.validate().unwrap();
        camera.check_plausible().map_or_else(|error| error.to_string(), |()| String::new())
    }

    #[test]
    fn real_cameras_are_plausible() {
        let size = (1024, 768);
        let cameras: [(CameraModel, (u32, u32), &[f64]); 13] = [
            (Pinhole, size, &[760.0, 761.0, 512.0, 384.0]),
            // A 600 mm lens with large terms that move corners by 2 %, and a crop of a corner of a wide photo.
            (Radial, size, &[17_000.0, 512.0, 384.0, 12.0, -900.0]),
            (Opencv, (200, 200), &[800.0, 800.0, 1700.0, -900.0, -0.05, 0.01, 0.0, 0.0]),
            // An action camera, whose corners are beyond the fold.
            (Opencv, (1920, 1080), &[880.0, 880.0, 960.0, 540.0, -0.25, 0.05, 0.001, 0.0]),
            (SimpleRadial, size, &[600.0, 512.0, 384.0, -0.3]),
            (SimplePinhole, (1000, 1000), &[134.0, 500.0, 500.0]),
            // Circular fisheyes of 190° and 280° in a frame of 16:9, and one that shows rows of its middle.
            (OpencvFisheye, (1920, 1080), &[320.0, 320.0, 960.0, 540.0, 0.02, -0.01, 0.002, -0.0003]),
            (SimpleFisheye, (1920, 1080), &[220.0, 960.0, 540.0]),
            (SimpleFisheye, (3000, 300), &[900.0, 1500.0, 900.0]),
            (Equirectangular, (1536, 768), &[1536.0, 768.0]),
            (Equirectangular, (1540, 768), &[1540.0, 768.0]),
            (Equirectangular, (1536, 468), &[1536.0, 768.0, 0.0, 100.0]),
            // Over the seam.
            (Equirectangular, (600, 468), &[1536.0, 768.0, 1300.0, 300.0]),
        ];
        for (model, size, params) in cameras {
            assert_eq!(said(model, size, params), "", "{model:?} {params:?}");
        }
        assert!(Camera::fisheye_guesses(900, 1200).all(|camera| camera.check_plausible().is_ok()));
        let stitched = Camera::equirectangular(2048, 1024).as_stitched().unwrap();
        assert!(stitched.check_plausible().is_ok());
    }

    #[test]
    fn what_no_camera_has_is_named_with_its_value() {
        let size = (1024, 768);
        let cases: [(CameraModel, &[f64], &str); 8] = [
            // In millimetres, and in units of the width.
            (SimplePinhole, &[26.0, 512.0, 384.0], "a focal length of 26 px, expected 51 to 102400"),
            (Pinhole, &[760.0, 0.74, 512.0, 384.0], "a focal length of 0.74 px"),
            (Pinhole, &[760.0, 760.0, 5120.0, 3840.0], "the principal point (5120, 3840)"),
            (Opencv, &[760.0, 760.0, 512.0, 384.0, 5.0, 50.0, 0.0, 0.0], "leaves 0.42 of the radius"),
            (Opencv, &[760.0, 760.0, 512.0, 384.0, -5.0, 0.0, 0.0, 0.0], "% of the image without rays"),
            (
                OpencvFisheye,
                &[760.0, 760.0, 512.0, 384.0, -50.0, 0.0, 0.0, 0.0],
                "% of the image without rays",
            ),
            (Equirectangular, &[1024.0, 768.0], "not 1024 × 768: of a panorama that is cut"),
            (
                Equirectangular,
                &[2048.0, 1024.0, 0.0, 400.0],
                "from (0, 400) on are not within a sphere of 2048 × 1024",
            ),
        ];
        for (model, params, expected) in cases {
            let said = said(model, size, params);
            assert!(said.contains(expected), "{model:?} {params:?}: {said}");
        }
    }

    #[test]
    fn a_principal_point_outside_the_image_and_missing_rays_are_told() {
        let crop = |cx: f64| Camera {
            params: vec![900.0, cx, 100.0, 0.0, 0.0],
            ..Camera::from_focal_guess(300, 200, 900.0)
        };
        assert_eq!(crop(299.0).principal_point_aside(), None);
        assert_eq!(crop(299.0).principal_point(), Some(Vector2::new(299.0, 100.0)));
        assert_eq!(crop(-40.0).principal_point_aside(), Some(Vector2::new(-40.0, 100.0)));
        assert_eq!(Camera::equirectangular(200, 100).principal_point(), None);
        assert_eq!(crop(150.0).share_with_rays(), 1.0);
        let fisheye = Camera {
            model: SimpleFisheye,
            width: 1000,
            height: 1000,
            params: vec![500.0 / std::f64::consts::PI, 500.0, 500.0],
        };
        assert!((fisheye.share_with_rays() - std::f64::consts::FRAC_PI_4).abs() < 0.01);
    }
}
