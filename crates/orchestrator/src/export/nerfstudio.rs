use anyhow::Result;
use nalgebra::{Matrix4, Vector4};
use serde_json::{Value, json};
use setloc_features::{Camera, CameraModel};
use setloc_sfm::{ImageId, Reconstruction};

use crate::error::Hinted;

/// A model as nerfstudio's `transforms.json`.
///
/// nerfstudio's camera frame is x right, y up, z backward; its world is ours. Its `nerfstudio_dataparser.py` reads one
/// `camera_model` for all frames from the top level, and `w`, `h`, `fl_x`, `fl_y`, `cx`, `cy` from each frame, without
/// which it stops. Its `cameras.py` takes `OPENCV` for every perspective camera, absent distortion being 0, and gives an
/// `EQUIRECTANGULAR` pixel the longitude π·(x − cx)/fl_x and the latitude −π·(y − cy)/fl_y: `fl_x` is half the whole
/// panorama's width, `fl_y` its height, and a crop moves the centre.
///
/// # Errors
/// When images have cameras of more than one of nerfstudio's models, or of none.
pub fn nerfstudio(model: &Reconstruction) -> Result<Value> {
    let mut frames = Vec::new();
    let mut first: Option<(ImageId, &str)> = None;
    for id in model.registered() {
        let (camera, name) = (model.camera_of(id), &model.images[id.index()].name);
        let Some((kind, intrinsics)) = intrinsics(camera) else {
            let message = format!("nerfstudio has no camera model {}, which {name} has", camera.model.name());
            return Err(Hinted::error(message, "`--format json` has every camera model"));
        };
        let (first, first_kind) = *first.get_or_insert((id, kind));
        if kind != first_kind {
            let first = &model.images[first.index()].name;
            let message = format!(
                "nerfstudio takes one camera model for all images: {first} has {first_kind}, {name} {kind}"
            );
            return Err(Hinted::error(message, "build a scene of panoramas or of photos only"));
        }
        frames.extend(frame(model, id, intrinsics));
    }
    let mut scene = json!({ "orientation_override": "none", "frames": frames });
    if let Some((_, kind)) = first {
        scene["camera_model"] = json!(kind);
    }
    Ok(scene)
}

fn frame(model: &Reconstruction, id: ImageId, intrinsics: Value) -> Option<Value> {
    let pose = model.images[id.index()].world_from_camera?;
    let mut matrix = Matrix4::identity();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(pose.rotation.to_rotation_matrix().matrix());
    matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&pose.translation);
    let matrix = matrix * Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, -1.0, 1.0));
    let rows: Vec<Vec<f64>> = matrix.row_iter().map(|row| row.iter().copied().collect()).collect();
    let mut frame = json!({ "file_path": model.images[id.index()].name, "transform_matrix": rows });
    if let (Value::Object(frame), Value::Object(intrinsics)) = (&mut frame, intrinsics) {
        frame.extend(intrinsics);
    }
    Some(frame)
}

/// nerfstudio's model and its parameters of a camera.
fn intrinsics(camera: &Camera) -> Option<(&'static str, Value)> {
    let p = &camera.params;
    let lens = |fx: f64, fy: f64, cx: f64, cy: f64| json!({ "w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy });
    let with = |mut lens: Value, names: &[&str], values: &[f64]| {
        for (name, value) in names.iter().zip(values) {
            lens[*name] = json!(value);
        }
        lens
    };
    let known = match camera.model {
        // Off by the stretch, which nerfstudio's model does not have.
        CameraModel::Equirectangular | CameraModel::StitchedEquirectangular => {
            let (left, top) = p.get(2).zip(p.get(3)).unwrap_or((&0.0, &0.0));
            ("EQUIRECTANGULAR", lens(p[0] / 2.0, p[1], p[0] / 2.0 - left, p[1] / 2.0 - top))
        }
        CameraModel::SimplePinhole => ("OPENCV", lens(p[0], p[0], p[1], p[2])),
        CameraModel::Pinhole => ("OPENCV", lens(p[0], p[1], p[2], p[3])),
        CameraModel::SimpleRadial | CameraModel::Radial => {
            ("OPENCV", with(lens(p[0], p[0], p[1], p[2]), &["k1", "k2"], &p[3..]))
        }
        CameraModel::Opencv => {
            ("OPENCV", with(lens(p[0], p[1], p[2], p[3]), &["k1", "k2", "p1", "p2"], &p[4..]))
        }
        CameraModel::SimpleFisheye => ("OPENCV_FISHEYE", lens(p[0], p[0], p[1], p[2])),
        CameraModel::OpencvFisheye => {
            ("OPENCV_FISHEYE", with(lens(p[0], p[1], p[2], p[3]), &["k1", "k2", "k3", "k4"], &p[4..]))
        }
        _ => return None,
    };
    Some(known)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{UnitQuaternion, Vector2, Vector3};
    use setloc_sfm::{CameraId, ReconstructionImage, Rigid};

    use super::*;

    fn camera(model: CameraModel, width: u32, height: u32, params: &[f64]) -> Camera {
        Camera { model, width, height, params: params.to_vec() }
    }

    /// An image of each camera, registered, and one that is not.
    fn scene(cameras: Vec<Camera>) -> Reconstruction {
        let pose = Rigid::new(UnitQuaternion::identity(), Vector3::new(1.0, 2.0, 3.0));
        let image = |at: usize, world_from_camera| ReconstructionImage {
            name: format!("{at}.jpg"),
            camera: CameraId(at as u32),
            world_from_camera,
        };
        let mut images: Vec<_> = (0..cameras.len()).map(|at| image(at, Some(pose))).collect();
        images.push(image(0, None));
        Reconstruction { cameras, images, ..Reconstruction::default() }
    }

    #[test]
    fn every_frame_has_what_nerfstudio_asserts_and_the_model_stands_above() {
        let cameras = vec![
            camera(CameraModel::SimplePinhole, 640, 480, &[500.0, 320.0, 240.0]),
            camera(CameraModel::Opencv, 640, 480, &[500.0, 501.0, 320.0, 240.0, 0.1, 0.2, 0.3, 0.4]),
        ];
        let written = nerfstudio(&scene(cameras)).unwrap();
        assert_eq!(written["camera_model"], "OPENCV");
        let frames = written["frames"].as_array().unwrap();
        assert_eq!(frames.len(), 2);
        for key in ["w", "h", "fl_x", "fl_y", "cx", "cy"] {
            assert!(frames.iter().all(|frame| frame[key].is_number()), "{key}: {frames:?}");
        }
        assert_eq!(frames[1]["p2"], 0.4);
        assert_eq!(frames[0]["transform_matrix"][2], json!([0.0, 0.0, -1.0, 3.0]));
    }

    #[test]
    fn nerfstudio_s_rays_of_a_panorama_are_ours() {
        let full = Camera::equirectangular(1000, 500);
        let crop = camera(CameraModel::Equirectangular, 300, 200, &[1000.0, 500.0, 250.0, 100.0]);
        for camera in [full, crop] {
            let written = nerfstudio(&scene(vec![camera.clone()])).unwrap();
            assert_eq!(written["camera_model"], "EQUIRECTANGULAR");
            let number = |key: &str| written["frames"][0][key].as_f64().unwrap();
            for pixel in [Vector2::new(0.5, 0.5), Vector2::new(150.0, 190.0), Vector2::new(299.5, 20.0)] {
                // As its `Cameras._generate_rays_from_coords` has it.
                let theta = -PI * (pixel.x - number("cx")) / number("fl_x");
                let phi = PI * (0.5 + (pixel.y - number("cy")) / number("fl_y"));
                let theirs = Vector3::new(-theta.sin() * phi.sin(), phi.cos(), -theta.cos() * phi.sin());
                let (ray, _) = camera.ray(&pixel).unwrap();
                assert!(
                    (theirs - Vector3::new(ray.x, -ray.y, -ray.z)).norm() < 1e-12,
                    "{pixel} {theirs} {ray}"
                );
            }
        }
    }

    #[test]
    fn mixed_and_unknown_camera_models_are_named() {
        let photo = camera(CameraModel::SimplePinhole, 640, 480, &[500.0, 320.0, 240.0]);
        let mixed = nerfstudio(&scene(vec![Camera::equirectangular(64, 32), photo])).unwrap_err().to_string();
        assert!(mixed.contains("0.jpg has EQUIRECTANGULAR, 1.jpg OPENCV"), "{mixed}");
        let paper = camera(CameraModel::PaperRectilinear, 640, 480, &[500.0, 320.0, 240.0]);
        let unknown = nerfstudio(&scene(vec![paper])).unwrap_err().to_string();
        assert!(unknown.contains("PAPER_RECTILINEAR, which 0.jpg has"), "{unknown}");
        assert_eq!(nerfstudio(&scene(Vec::new())).unwrap()["frames"], json!([]));
    }
}
