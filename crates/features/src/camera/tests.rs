use nalgebra::{Matrix2x3, Matrix3x2, SMatrix, Vector2, Vector3};
use proptest::prelude::*;

use super::{Camera, CameraModel, MAX_CAMERA_PARAMS, ParamRole};

fn camera(model: CameraModel, width: u32, height: u32, params: &[f64]) -> Camera {
    let camera = Camera { model, width, height, params: params.to_vec() };
    camera.validate().unwrap();
    camera
}

/// Every model, plain and strongly distorted, and a panorama crop over the seam.
fn cameras() -> Vec<Camera> {
    use CameraModel::{
        Equirectangular, Opencv, OpencvFisheye, PaperRectilinear, Pinhole, Radial, SimpleFisheye,
        SimplePinhole, SimpleRadial, StitchedEquirectangular,
    };
    vec![
        camera(SimplePinhole, 1600, 1200, &[900.0, 790.0, 610.0]),
        camera(Pinhole, 1600, 1200, &[900.0, 950.0, 790.0, 610.0]),
        camera(SimpleRadial, 1600, 1200, &[900.0, 790.0, 610.0, -0.18]),
        camera(SimpleRadial, 1600, 1200, &[900.0, 790.0, 610.0, 0.4]),
        camera(Radial, 1600, 1200, &[700.0, 790.0, 610.0, -0.28, 0.09]),
        camera(Radial, 1600, 1200, &[700.0, 790.0, 610.0, 0.1, -0.05]),
        camera(Opencv, 1600, 1200, &[1180.0, 1175.0, 803.5, 596.2, -0.06, 0.02, 0.0004, -0.0003]),
        camera(Opencv, 1600, 1200, &[800.0, 820.0, 803.5, 596.2, -0.25, 0.08, 0.004, -0.006]),
        camera(SimpleFisheye, 1200, 1200, &[250.0, 600.0, 590.0]),
        camera(OpencvFisheye, 1200, 1200, &[300.0, 310.0, 600.0, 590.0, -0.02, 0.01, -0.003, 0.0004]),
        camera(OpencvFisheye, 1200, 1200, &[400.0, 390.0, 600.0, 590.0, -0.2, 0.02, -0.01, 0.001]),
        Camera::equirectangular(3072, 1536),
        camera(Equirectangular, 1000, 700, &[3072.0, 1536.0, 2600.0, 500.0]),
        camera(PaperRectilinear, 1600, 1200, &[900.0, 800.0, 600.0]),
        camera(
            StitchedEquirectangular,
            3072,
            1536,
            &[
                3072.0, 1536.0, 0.0, 0.0, -0.0032, 0.0008, 0.0011, -0.0006, 0.0004, -0.0003, 0.0015, -0.0012,
                0.0011,
            ],
        ),
        camera(
            StitchedEquirectangular,
            1000,
            700,
            &[3072.0, 1536.0, 2600.0, 500.0, 0.05, -0.03, 0.02, 0.04, 0.02, -0.04, 0.05, 0.01, -0.03],
        ),
    ]
}

fn angle(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    a.cross(b).norm().atan2(a.dot(b))
}

#[test]
fn round_trips_over_the_whole_image_below_a_nanoradian() {
    for camera in cameras() {
        let mut seen = 0;
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        for row in 0..=40 {
            for column in 0..=40 {
                let pixel = Vector2::new(w * column as f64 / 40.0, h * row as f64 / 40.0);
                let Some(bearing) = camera.unproject(&pixel) else { continue };
                seen += 1;
                assert!((bearing.norm() - 1.0).abs() < 1e-14);
                let again = camera.project(&(bearing * 7.5)).unwrap();
                let back = camera.unproject(&again).unwrap();
                assert!(angle(&bearing, &back) < 1e-9, "{camera:?} at {pixel:?}: {}", angle(&bearing, &back));
            }
        }
        assert!(seen > 400, "{camera:?} sees only {seen} of 1681 grid points");
    }
}

#[test]
fn corner_pixels_of_a_strong_lens_have_rays_that_reproject_there() {
    let camera =
        camera(CameraModel::Opencv, 1600, 1200, &[1100.0, 1100.0, 803.5, 596.2, -0.25, 0.08, 0.004, -0.006]);
    for pixel in [[0.0, 0.0], [1600.0, 0.0], [0.0, 1200.0], [1600.0, 1200.0]].map(Vector2::from) {
        let bearing = camera.unproject(&pixel).unwrap();
        assert!((camera.project(&bearing).unwrap() - pixel).norm() < 1e-9);
    }
}

#[test]
fn refuses_pixels_and_directions_beyond_the_fold_of_a_barrel_lens() {
    // r (1 − 0.3 r²) turns at r = 1.054 with value 0.703.
    let camera = camera(CameraModel::SimpleRadial, 2000, 2000, &[1000.0, 1000.0, 1000.0, -0.3]);
    assert!(camera.unproject(&Vector2::new(1000.0 + 701.0, 1000.0)).is_some());
    assert!(camera.unproject(&Vector2::new(1000.0 + 704.0, 1000.0)).is_none());
    assert!(camera.project(&Vector3::new(1.05, 0.0, 1.0)).is_some());
    assert!(camera.project(&Vector3::new(1.2, 0.0, 1.0)).is_none());
    assert!(camera.project(&Vector3::new(3.0, 0.0, 1.0)).is_none());
    assert!(camera.project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
}

#[test]
fn fisheye_sees_behind_itself_but_not_its_own_back_axis() {
    let camera = camera(CameraModel::SimpleFisheye, 1200, 1200, &[150.0, 600.0, 600.0]);
    let behind = Vector3::new(0.3, -0.2, -1.0);
    let pixel = camera.project(&behind).unwrap();
    assert!(angle(&camera.unproject(&pixel).unwrap(), &behind) < 1e-9);
    assert!(camera.project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
    assert!(camera.unproject(&Vector2::new(600.0 + 150.0 * 3.2, 600.0)).is_none());
}

#[test]
fn panorama_is_periodic_in_x_and_closed_at_the_poles() {
    let camera = Camera::equirectangular(4096, 2048);
    let ray = camera.unproject(&Vector2::new(-3.25, 700.5)).unwrap();
    assert!(angle(&ray, &camera.unproject(&Vector2::new(4092.75, 700.5)).unwrap()) < 1e-12);
    assert!(camera.unproject(&Vector2::new(10.0, -0.1)).is_none());
    assert!(camera.unproject(&Vector2::new(10.0, 2048.1)).is_none());
    for y in [0.0, 2048.0] {
        let pole = camera.unproject(&Vector2::new(123.0, y)).unwrap();
        assert!(angle(&pole, &Vector3::new(0.0, y - 1024.0, 0.0)) < 1e-12);
    }
    assert_eq!(camera.project(&Vector3::y()).unwrap().y, 2048.0);
    let either_side = [1e-12, -1e-12].map(|x| camera.project(&Vector3::new(x, 0.0, -1.0)).unwrap());
    assert!(either_side.iter().all(|pixel| (0.0..4096.0).contains(&pixel.x)));
    assert!(camera.project(&Vector3::zeros()).is_none());
}

#[test]
fn cropped_panorama_sees_what_the_full_one_sees() {
    let full = Camera::equirectangular(3072, 1536);
    let crop = camera(CameraModel::Equirectangular, 1000, 700, &[3072.0, 1536.0, 2600.0, 500.0]);
    assert!(full.wraps_around() && !crop.wraps_around());
    let pixel = Vector2::new(900.0, 20.0);
    let ray = crop.unproject(&pixel).unwrap();
    assert!(angle(&ray, &full.unproject(&Vector2::new(3500.0 - 3072.0, 520.0)).unwrap()) < 1e-12);
    assert!((crop.project(&ray).unwrap() - pixel).norm() < 1e-9);
}

#[test]
fn paper_rectilinear_is_no_pinhole_off_the_axes() {
    let paper = camera(CameraModel::PaperRectilinear, 2000, 2000, &[1000.0, 1000.0, 1000.0]);
    let pinhole = camera(CameraModel::SimplePinhole, 2000, 2000, &[1000.0, 1000.0, 1000.0]);
    let difference = |x: f64, y: f64| {
        let pixel = Vector2::new(x, y);
        angle(&paper.unproject(&pixel).unwrap(), &pinhole.unproject(&pixel).unwrap()).to_degrees()
    };
    assert!(difference(2000.0, 1000.0) < 1e-9 && difference(1000.0, 1700.0) < 1e-9);
    // arctan 1 = 45° of tilt against the pinhole's arctan(cos 45°) = 35.26°.
    assert!((difference(2000.0, 2000.0) - 9.7356).abs() < 1e-3, "{}", difference(2000.0, 2000.0));
}

#[test]
fn tangential_distortion_is_added_to_what_lenses_of_this_kind_have() {
    for camera in cameras() {
        let opencv = camera.clone().with_tangential_distortion();
        if opencv == camera {
            let kept =
                [CameraModel::Opencv, CameraModel::Equirectangular, CameraModel::StitchedEquirectangular];
            let fisheye = camera.model.name().contains("FISHEYE");
            assert!(fisheye || kept.contains(&camera.model) || camera.model == CameraModel::PaperRectilinear);
            continue;
        }
        assert!(opencv.model == CameraModel::Opencv && opencv.validate().is_ok());
        let direction = Vector3::new(0.2, -0.3, 1.0);
        assert!((opencv.project(&direction).unwrap() - camera.project(&direction).unwrap()).norm() < 1e-10);
    }
}

#[test]
fn jacobians_agree_with_their_numeric_twins() {
    for camera in cameras() {
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        for (u, v) in [(0.5, 0.5), (0.31, 0.42), (0.7, 0.83), (0.45, 0.12), (0.502, 0.499)] {
            let pixel = Vector2::new(w * u, h * v);
            let Some(analytic) = camera.unproject_with_jacobian(&pixel) else { continue };
            assert!(angle(&analytic.bearing, &camera.unproject(&pixel).unwrap()) < 1e-13);
            let (bearing, pixel_angle) = camera.ray(&pixel).unwrap();
            assert!(angle(&bearing, &analytic.bearing) < 1e-13);
            assert_eq!(pixel_angle, camera.pixel_angle(&pixel).unwrap());
            let towards = camera.pixel_angle_towards(&bearing).unwrap();
            assert!((towards / pixel_angle - 1.0).abs() < 1e-9, "{camera:?} {towards} {pixel_angle}");
            check_unproject(&camera, &pixel, &analytic.d_pixel, &analytic.d_params);

            let direction = analytic.bearing * 2.5;
            let analytic = camera.project_with_jacobian(&direction).unwrap();
            assert!((analytic.pixel - camera.project(&direction).unwrap()).norm() < 1e-12);
            check_project(&camera, &direction, &analytic.d_direction, &analytic.d_params);
        }
    }
}

fn check_unproject(
    camera: &Camera,
    pixel: &Vector2<f64>,
    d_pixel: &Matrix3x2<f64>,
    d_params: &SMatrix<f64, 3, MAX_CAMERA_PARAMS>,
) {
    let step = 1e-3;
    for axis in 0..2 {
        let offset = Vector2::ith(axis, step);
        let numeric = (camera.unproject(&(pixel + offset)).unwrap()
            - camera.unproject(&(pixel - offset)).unwrap())
            / (2.0 * step);
        let error = (numeric - d_pixel.column(axis)).norm();
        assert!(error < 1e-6 * numeric.norm().max(1e-4), "{camera:?} d_pixel {axis}: {error}");
    }
    for index in 0..MAX_CAMERA_PARAMS {
        if index >= camera.params.len() {
            assert_eq!(d_params.column(index).norm(), 0.0);
            continue;
        }
        let step = param_step(camera, index);
        let [above, below] = [step, -step].map(|step| moved(camera, index, step).unproject(pixel).unwrap());
        let numeric = (above - below) / (2.0 * step);
        let error = (numeric - d_params.column(index)).norm();
        assert!(error < 1e-6 * numeric.norm().max(1e-3), "{camera:?} d_params {index}: {error}");
    }
}

fn check_project(
    camera: &Camera,
    direction: &Vector3<f64>,
    d_direction: &Matrix2x3<f64>,
    d_params: &SMatrix<f64, 2, MAX_CAMERA_PARAMS>,
) {
    let step = 1e-6;
    for axis in 0..3 {
        let offset = Vector3::ith(axis, step);
        let numeric = (camera.project(&(direction + offset)).unwrap()
            - camera.project(&(direction - offset)).unwrap())
            / (2.0 * step);
        let error = (numeric - d_direction.column(axis)).norm();
        assert!(error < 1e-6 * numeric.norm().max(100.0), "{camera:?} d_direction {axis}: {error}");
    }
    for index in 0..MAX_CAMERA_PARAMS {
        if index >= camera.params.len() {
            assert_eq!(d_params.column(index).norm(), 0.0);
            continue;
        }
        let step = param_step(camera, index);
        let [above, below] = [step, -step].map(|step| moved(camera, index, step).project(direction).unwrap());
        let numeric = (above - below) / (2.0 * step);
        let error = (numeric - d_params.column(index)).norm();
        assert!(error < 1e-6 * numeric.norm().max(1.0), "{camera:?} d_params {index}: {error}");
    }
}

fn param_step(camera: &Camera, index: usize) -> f64 {
    match camera.param_roles()[index] {
        ParamRole::Distortion | ParamRole::Stretch => 1e-6,
        _ => 1e-3,
    }
}

fn moved(camera: &Camera, index: usize, step: f64) -> Camera {
    let mut moved = camera.clone();
    moved.params[index] += step;
    moved
}

#[test]
fn a_stretch_spreads_what_lies_ahead_and_squeezes_what_lies_at_the_sides() {
    let plain = Camera::equirectangular(4096, 2048);
    let mut stitched = plain.as_stitched().unwrap();
    assert_eq!((stitched.largest_stretch(), stitched.without_stretch()), (0.0, plain.clone()));
    stitched.params[4] = 0.01;
    assert_eq!((stitched.largest_stretch(), stitched.without_stretch()), (0.01, plain.clone()));
    assert!(stitched.is_panoramic() && stitched.is_stretched() && stitched.wraps_around());
    assert!(stitched.as_stitched().is_none());
    // One pixel to either side of a place on the horizon, by the plain panorama and by this one.
    let spread = |camera: &Camera, x: f64| {
        let [left, right] = [x - 1.0, x + 1.0].map(|x| camera.unproject(&Vector2::new(x, 1024.0)).unwrap());
        angle(&left, &right)
    };
    // Ahead (1 + xx)/(1 − xx), at the sides the inverse of that.
    for (x, expected) in [(2048.0, 1.01 / 0.99), (3072.0, 0.99 / 1.01), (1024.0, 0.99 / 1.01)] {
        let ratio = spread(&stitched, x) / spread(&plain, x);
        assert!((ratio - expected).abs() < 1e-5, "{x}: {ratio}");
    }
    for off in [f64::NAN, 0.2] {
        stitched.params[6] = off;
        assert!(stitched.validate().is_err());
    }
}

#[test]
fn names_ids_and_serialized_forms_agree() {
    for model in CameraModel::ALL {
        assert_eq!(CameraModel::from_name(model.name()), Some(model));
        assert_eq!(serde_json::to_string(&model).unwrap(), format!("\"{}\"", model.name()));
        assert_eq!(model.param_names().len(), model.param_roles().len());
    }
    assert_eq!(CameraModel::Equirectangular.colmap_id(), Some(17));
    assert_eq!(CameraModel::from_name("THIN_PRISM_FISHEYE"), None);
}

#[test]
fn validate_names_the_value_at_fault() {
    let bad = |model, params: &[f64]| {
        Camera { model, width: 100, height: 50, params: params.to_vec() }.validate().unwrap_err().to_string()
    };
    assert!(bad(CameraModel::SimplePinhole, &[0.0, 50.0, 25.0]).contains("f must be positive, got 0"));
    assert!(bad(CameraModel::Pinhole, &[10.0, 50.0, 25.0]).contains("expected 4 parameters"));
    assert!(bad(CameraModel::SimpleRadial, &[10.0, 50.0, 25.0, f64::NAN]).contains("k is NaN"));
    assert!(Camera::equirectangular(0, 10).validate().is_err());
}

#[test]
fn one_pixel_spans_the_expected_angle() {
    let panorama = Camera::equirectangular(3600, 1800);
    let at = |y: f64| panorama.pixel_angle(&Vector2::new(77.0, y)).unwrap().to_degrees();
    assert!((at(900.0) - 0.1).abs() < 1e-12);
    assert!((at(0.0) - 0.1 / 2.0_f64.sqrt()).abs() < 1e-12);
    let photo = Camera::from_focal_guess(1000, 800, 900.0);
    assert!((photo.pixel_angle(&Vector2::new(500.0, 400.0)).unwrap() - 1.0 / 900.0).abs() < 1e-15);
    assert_eq!(photo.focal_length(), 900.0);
}

#[test]
fn a_fisheye_follows_another_lens_where_most_of_the_image_is() {
    let params = vec![722.0, 722.0, 817.0, 590.0, -0.25, 0.05, 0.0, 0.0];
    let lens = Camera { model: CameraModel::Opencv, width: 1600, height: 1200, params };
    let fisheye = lens.as_fisheye().unwrap();
    assert_eq!(fisheye.model, CameraModel::OpencvFisheye);
    for pixel in [(817.0, 590.0), (1200.0, 300.0), (900.0, 1190.0), (300.0, 600.0)] {
        let pixel = Vector2::new(pixel.0, pixel.1);
        let off = angle(&lens.unproject(&pixel).unwrap(), &fisheye.unproject(&pixel).unwrap());
        assert!(off < 0.01, "{pixel:?}: {off} rad");
    }
    assert!(lens.may_be_fisheye() && !fisheye.may_be_fisheye());
    assert!(!Camera::from_focal_guess(1600, 1200, 1165.0).may_be_fisheye());
    assert_eq!(Camera::equirectangular(200, 100).as_fisheye(), None);
}

#[test]
fn one_fisheye_guess_is_within_a_tenth_of_any_focal_length() {
    let focals: Vec<f64> =
        Camera::fisheye_guesses(900, 1200).map(|camera| camera.focal_length() / 1200.0).collect();
    assert!(focals[0] <= 0.2 && focals[6] >= 0.6);
    assert!(focals.windows(2).all(|two| (1.0..1.22).contains(&(two[1] / two[0]))), "{focals:?}");
    assert!(Camera::fisheye_guesses(900, 1200).all(|camera| camera.validate().is_ok()));
}

#[test]
fn directions_far_off_the_axis_survive_a_round_trip() {
    for camera in cameras() {
        for z in [1e-1, 1e-2, 1e-3, 4e-4, 1e-4] {
            let direction = Vector3::new(0.0, 0.9386, z);
            if let Some(pixel) = camera.project(&direction) {
                let back = camera.unproject(&pixel).unwrap();
                assert!(angle(&direction, &back) < 1e-9, "{camera:?} {z}: {}", angle(&direction, &back));
            }
        }
    }
}

proptest! {
    #[test]
    fn any_direction_survives_a_round_trip(
        index in 0usize..16, x in -1.0f64..1.0, y in -1.0f64..1.0, z in -1.0f64..1.0,
    ) {
        let direction = Vector3::new(x, y, z);
        prop_assume!(direction.norm() > 1e-3);
        let camera = &cameras()[index];
        if let Some(pixel) = camera.project(&direction) {
            let back = camera.unproject(&pixel).unwrap();
            prop_assert!(angle(&direction, &back) < 1e-9, "{camera:?} {direction:?}: {}", angle(&direction, &back));
        } else {
            prop_assert!(!camera.is_panoramic());
        }
    }
}

#[test]
fn a_plain_ray_that_is_stretched_is_the_ray() {
    let mut camera = Camera::equirectangular(3072, 1536).as_stitched().unwrap();
    let pixel = Vector2::new(2200.5, 400.25);
    assert_eq!(Camera::equirectangular(3072, 1536).plain_ray(&pixel), None);
    assert_eq!(camera.plain_ray(&Vector2::new(10.0, -5.0)), None);
    let plain = camera.plain_ray(&pixel).unwrap();
    camera.params[4..].copy_from_slice(&[0.05, -0.03, 0.02, 0.04, 0.01, -0.02, 0.05, -0.04, 0.02]);
    let (ray, whole) = (camera.unproject_plain(&plain), camera.unproject_with_jacobian(&pixel).unwrap());
    assert_eq!((ray.bearing, ray.d_pixel), (whole.bearing, whole.d_pixel));
    assert_eq!(ray.d_params.columns(4, 9), whole.d_params.columns(4, 9));
}
