use std::collections::BTreeMap;

use nalgebra::Matrix6;
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
            let sigmas = sigmas_of(scene, component);
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
                        "sigma": sigmas.get(image.name.as_str()),
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

/// Names and poses of a scene's images in the frame of its largest component.
pub fn scene_images_json(scene: &SceneFile) -> Value {
    let in_frame = scene.components.iter().enumerate().filter(|(at, _)| scene.shares_frame(*at));
    let images = in_frame.flat_map(|(_, model)| &model.images);
    let placed = images.filter_map(|image| Some((&image.name, image.world_from_camera.as_ref()?)));
    placed.map(|(name, pose)| json!({ "name": name, "world_from_camera": pose_json(pose) })).collect()
}

/// One sigma of the poses of a component's images, by name: of the panoramas by what they may be off together, of photos that it has
/// grown by as these were localized.
fn sigmas_of(scene: &SceneFile, component: usize) -> BTreeMap<&str, Value> {
    let Some(model) = scene.components.get(component) else { return BTreeMap::new() };
    let errors = scene.errors.get(component).and_then(Option::as_ref);
    let drawn = |id| {
        let deviation = errors?.deviation(model, id)?;
        Some(sigma_json(deviation.rotation_rad, deviation.center))
    };
    let grown = scene.grown.iter().filter(|_| component == 0);
    let stated = grown.map(|grown| (grown.image, covariance_sigma_json(&grown.covariance)));
    let of_panoramas = model.registered().filter_map(|id| Some((id, drawn(id)?)));
    let named = |(id, sigma): (ImageId, Value)| Some((model.images.get(id.index())?.name.as_str(), sigma));
    of_panoramas.chain(stated).filter_map(named).collect()
}

/// One sigma of a pose, of all directions together, in degrees and scene units.
fn sigma_json(rotation_rad: f64, position: f64) -> Value {
    json!({ "rotation_deg": rotation_rad.to_degrees(), "position": position })
}

/// The same of a covariance: rotation in radians, then centre.
fn covariance_sigma_json(covariance: &Matrix6<f64>) -> Value {
    let (rotation_rad, position) = sigma_of(covariance);
    sigma_json(rotation_rad, position)
}

/// One sigma of all directions together: of the rotation in radians and of the centre in scene units.
fn sigma_of(covariance: &Matrix6<f64>) -> (f64, f64) {
    let spread = |from: usize| {
        let variances = (from..from + 3).map(|at| covariance[(at, at)]);
        variances.sum::<f64>().max(0.0).sqrt()
    };
    (spread(0), spread(3))
}

/// What is stated of how far a photo may be off, in words; `None` without a pose.
pub fn stated_sigma(photo: &PhotoLocalization, scene: &SceneFile) -> Option<String> {
    let (rotation_rad, position) = sigma_of(photo.covariance.as_ref()?);
    let unit = if scene.is_placed(photo.component) { "m" } else { "of the scene's units" };
    let (digits, rotation_deg) = (decimals(position), rotation_rad.to_degrees());
    Some(format!("one sigma {position:.digits$} {unit} and {rotation_deg:.3}°"))
}

/// Decimals that show two digits of a small number.
fn decimals(value: f64) -> usize {
    if value > 0.0 && value.is_finite() { (1.0 - value.log10().floor()).clamp(0.0, 9.0) as usize } else { 3 }
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
        let sigma = photo.covariance.as_ref().map(covariance_sigma_json);
        json!({
            "name": photo.name, "verdict": photo.verdict, "reasons": photo.reasons, "inliers": photo.inliers,
            "component": photo.component, "own_frame": !scene.shares_frame(photo.component),
            "world_from_camera": pose.map(pose_json), "wgs84": place, "camera": photo.camera,
            "covariance_rotation_rad_then_centre": covariance, "sigma": sigma,
        })
    };
    photos.iter().map(one).collect()
}
