use serde_json::{Value, json};
use setloc_camset::PhotoLocalization;
use setloc_features::Wgs84;
use setloc_sfm::{ImageId, Rigid};

use super::geographic::place_json;
use crate::scene::SceneFile;

/// `world_from_camera` as quaternion (w, x, y, z) and centre.
pub fn pose_json(pose: &Rigid) -> Value {
    let (q, c) = (pose.rotation.quaternion(), pose.translation);
    json!({ "q_wxyz": [q.w, q.i, q.j, q.k], "center": [c.x, c.y, c.z] })
}

/// Where the scene's origin is on the map.
pub fn origin_json(scene: &SceneFile) -> Value {
    json!(scene.origin.map(|origin| place_json(origin, origin)))
}

/// All cameras and poses of a scene; `grown` are images that it has grown by.
pub fn scene_json(scene: &SceneFile) -> Value {
    let grown = scene.grown_names();
    let components: Vec<Value> = scene
        .components
        .iter()
        .enumerate()
        .map(|(component, model)| {
            let model = model.by_name();
            let observations = observations_of(&model);
            let images: Vec<Value> = (0..model.images.len() as u32)
                .map(ImageId)
                .map(|id| {
                    let image = &model.images[id.index()];
                    let pose = image.world_from_camera.as_ref();
                    let place = pose
                        .zip(scene.origin)
                        .filter(|_| scene.is_placed(component))
                        .map(|(pose, origin)| place_json(Wgs84::from_enu(&pose.translation, origin), origin));
                    json!({
                        "name": image.name, "world_from_camera": pose.map(pose_json), "wgs84": place,
                        "camera": model.camera_of(id), "observations": observations[id.index()],
                        "grown": grown.contains(image.name.as_str()),
                    })
                })
                .collect();
            json!({
                "points": model.points.len(), "observations": model.observation_count(), "images": images,
                "own_frame": !scene.shares_frame(component),
            })
        })
        .collect();
    json!({
        "convention": "X_world = R(q) X_camera + center; camera x right, y down, z forward; pixel (0.5, 0.5) is the first pixel's centre",
        "geo_origin": origin_json(scene), "components": components, "warnings": scene.warnings,
        "notes": scene.notes,
    })
}

fn observations_of(model: &setloc_sfm::Reconstruction) -> Vec<usize> {
    let mut counts = vec![0; model.images.len()];
    for observation in model.points.iter().flat_map(|point| &point.track) {
        counts[observation.image.index()] += 1;
    }
    counts
}

/// Localized photos: component, pose, camera, verdict, evidence; one sigma in degrees and scene units.
pub fn localizations_json(photos: &[PhotoLocalization], scene: &SceneFile) -> Value {
    let one = |photo: &PhotoLocalization| {
        let pose = photo.world_from_camera.as_ref();
        let origin = scene.origin.filter(|_| scene.is_placed(photo.component));
        let place = pose
            .zip(origin)
            .map(|(pose, origin)| place_json(Wgs84::from_enu(&pose.translation, origin), origin));
        let covariance = photo
            .covariance
            .map(|c| c.row_iter().map(|row| row.iter().copied().collect::<Vec<f64>>()).collect::<Vec<_>>());
        let sigma = photo.covariance.map(|c| {
            let spread = |from: usize| {
                (c[(from, from)] + c[(from + 1, from + 1)] + c[(from + 2, from + 2)]).max(0.0).sqrt()
            };
            json!({ "rotation_deg": spread(0).to_degrees(), "position": spread(3) })
        });
        json!({
            "name": photo.name, "verdict": photo.verdict, "reasons": photo.reasons, "inliers": photo.inliers,
            "component": photo.component, "own_frame": !scene.shares_frame(photo.component),
            "world_from_camera": pose.map(pose_json), "wgs84": place, "camera": photo.camera,
            "covariance_rotation_rad_then_centre": covariance, "sigma": sigma,
        })
    };
    photos.iter().map(one).collect()
}
