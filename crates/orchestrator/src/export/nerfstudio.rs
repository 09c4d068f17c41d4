use nalgebra::{Matrix4, Vector4};
use serde_json::{Value, json};
use setloc_features::{Camera, CameraModel};
use setloc_sfm::{ImageId, Reconstruction};

/// A model as nerfstudio's `transforms.json`.
///
/// nerfstudio's camera frame is x right, y up, z backward; its world is ours.
pub fn nerfstudio(model: &Reconstruction) -> Value {
    let frames: Vec<Value> = model.registered().filter_map(|id| frame(model, id)).collect();
    json!({ "orientation_override": "none", "frames": frames })
}

fn frame(model: &Reconstruction, id: ImageId) -> Option<Value> {
    let pose = model.images[id.index()].world_from_camera?;
    let mut matrix = Matrix4::identity();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(pose.rotation.to_rotation_matrix().matrix());
    matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&pose.translation);
    let matrix = matrix * Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, -1.0, 1.0));
    let rows: Vec<Vec<f64>> = matrix.row_iter().map(|row| row.iter().copied().collect()).collect();
    let mut frame = json!({ "file_path": model.images[id.index()].name, "transform_matrix": rows });
    if let (Value::Object(frame), Value::Object(camera)) = (&mut frame, intrinsics(model.camera_of(id))) {
        frame.extend(camera);
    }
    Some(frame)
}

fn intrinsics(camera: &Camera) -> Value {
    let p = &camera.params;
    let (w, h) = (camera.width, camera.height);
    let lens = |name: &str, fx: f64, fy: f64, cx: f64, cy: f64| json!({ "camera_model": name, "w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy });
    let with = |mut lens: Value, names: &[&str], values: &[f64]| {
        for (name, value) in names.iter().zip(values) {
            lens[*name] = json!(value);
        }
        lens
    };
    match camera.model {
        CameraModel::Equirectangular => json!({ "camera_model": "EQUIRECTANGULAR", "w": w, "h": h }),
        CameraModel::Pinhole => lens("PINHOLE", p[0], p[1], p[2], p[3]),
        CameraModel::SimpleRadial | CameraModel::Radial => {
            with(lens("OPENCV", p[0], p[0], p[1], p[2]), &["k1", "k2"], &p[3..])
        }
        CameraModel::Opencv => {
            with(lens("OPENCV", p[0], p[1], p[2], p[3]), &["k1", "k2", "p1", "p2"], &p[4..])
        }
        CameraModel::SimpleFisheye => lens("OPENCV_FISHEYE", p[0], p[0], p[1], p[2]),
        CameraModel::OpencvFisheye => {
            with(lens("OPENCV_FISHEYE", p[0], p[1], p[2], p[3]), &["k1", "k2", "k3", "k4"], &p[4..])
        }
        _ => lens("PINHOLE", p[0], p[0], p[1], p[2]),
    }
}
