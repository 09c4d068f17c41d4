use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6};
use serde::Serialize;
use serde_json::{Value, json};
use setloc_camset::PhotoLocalization;
use setloc_features::Wgs84;
use setloc_sfm::{ImageId, PoseDeviation, Rigid};

use super::geographic::place_json;
use crate::scene::{SceneFile, has_altitude};

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
                    let sigma = sigmas.get(image.name.as_str());
                    json!({
                        "name": image.name, "world_from_camera": pose.map(pose_json),
                        "wgs84": pose.and_then(|pose| wgs84_json(pose, component, scene)),
                        "wgs84_sigma": pose.zip(sigma).and_then(|(pose, sigma)| MapSigma::of(pose, sigma, component, scene)),
                        "camera": model.camera_of(id), "observations": observations[id.index()],
                        "sigma": sigma.map(Sigma::as_json),
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

/// Where a pose of a component is on the map, if that is placed there.
fn wgs84_json(pose: &Rigid, component: usize, scene: &SceneFile) -> Option<Value> {
    let origin = scene.origin.filter(|_| scene.is_placed(component))?;
    Some(place_json(Wgs84::from_enu(&pose.translation, origin), origin))
}

/// How far a pose may be off relative to its component.
#[derive(Clone, Copy)]
struct Sigma {
    rotation_rad: f64,
    /// Covariance of the centre, in scene units.
    center: Matrix3<f64>,
}

impl Sigma {
    /// That of a covariance: rotation in radians, then centre.
    fn of_covariance(covariance: &Matrix6<f64>) -> Self {
        let rotation_rad = deviation(&covariance.fixed_view::<3, 3>(0, 0).into_owned());
        Self { rotation_rad, center: covariance.fixed_view::<3, 3>(3, 3).into_owned() }
    }

    /// One of which only the size is told, in all directions alike.
    fn of_deviation(sigma: &PoseDeviation) -> Self {
        let center = Matrix3::from_diagonal_element(sigma.center.powi(2) / 3.0);
        Self { rotation_rad: sigma.rotation_rad, center }
    }

    /// Of all directions of the centre together.
    fn position(&self) -> f64 {
        deviation(&self.center)
    }

    fn as_json(&self) -> Value {
        json!({ "rotation_deg": self.rotation_rad.to_degrees(), "position": self.position() })
    }
}

/// One sigma of all directions together.
fn deviation(covariance: &Matrix3<f64>) -> f64 {
    covariance.trace().max(0.0).sqrt()
}

/// How far a pose may be off on the map, by what the measured positions leave open of its component's frame and by what it may be off
/// relative to that: one sigma.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct MapSigma {
    /// Of east and north together.
    horizontal_m: f64,
    /// Of the height, where altitudes were measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    vertical_m: Option<f64>,
    /// Of the rotation against east, north and up.
    rotation_deg: f64,
}

impl MapSigma {
    /// That of a pose of a component; `None` where nothing tells it.
    fn of(pose: &Rigid, sigma: &Sigma, component: usize, scene: &SceneFile) -> Option<Self> {
        let frame = scene.frame_errors_of(component)?;
        let variances = (frame.covariance(&pose.translation) + sigma.center).diagonal();
        let is_told = scene.origin.is_some_and(has_altitude);
        Some(Self {
            horizontal_m: (variances.x + variances.y).sqrt(),
            vertical_m: is_told.then(|| variances.z.sqrt()),
            rotation_deg: frame.turn_rad().hypot(sigma.rotation_rad).to_degrees(),
        })
    }

    /// That of a localized photo.
    fn of_photo(photo: &PhotoLocalization, scene: &SceneFile) -> Option<Self> {
        let sigma = Sigma::of_covariance(photo.covariance.as_ref()?);
        Self::of(photo.world_from_camera.as_ref()?, &sigma, photo.component, scene)
    }
}

/// One sigma of the poses of a component's images, by name: of the panoramas by what they may be off together, of photos that it has
/// grown by as these were localized.
fn sigmas_of(scene: &SceneFile, component: usize) -> BTreeMap<&str, Sigma> {
    let Some(model) = scene.components.get(component) else { return BTreeMap::new() };
    let errors = scene.errors.get(component).and_then(Option::as_ref);
    let drawn = |id| Some(Sigma::of_deviation(&errors?.deviation(model, id)?));
    let grown = scene.grown.iter().filter(|_| component == 0);
    let stated = grown.map(|grown| (grown.image, Sigma::of_covariance(&grown.covariance)));
    let of_panoramas = model.registered().filter_map(|id| Some((id, drawn(id)?)));
    let named = |(id, sigma): (ImageId, Sigma)| Some((model.images.get(id.index())?.name.as_str(), sigma));
    of_panoramas.chain(stated).filter_map(named).collect()
}

/// What is stated of how far a photo may be off, in words; `None` without a pose.
pub fn stated_sigma(photo: &PhotoLocalization, scene: &SceneFile) -> Option<String> {
    let sigma = Sigma::of_covariance(photo.covariance.as_ref()?);
    let (position, rotation_deg) = (sigma.position(), sigma.rotation_rad.to_degrees());
    let unit = if scene.is_placed(photo.component) { "m" } else { "of the scene's units" };
    let digits = decimals(position);
    let on_map = MapSigma::of_photo(photo, scene)
        .map_or_else(String::new, |on_map| format!(" in the scene, {:.2} m on the map", on_map.horizontal_m));
    Some(format!("one sigma {position:.digits$} {unit} and {rotation_deg:.3}°{on_map}"))
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

/// Localized photos, as [`localization_json`] has each.
pub fn localizations_json(photos: &[PhotoLocalization], scene: &SceneFile) -> Value {
    photos.iter().map(|photo| localization_json(photo, scene)).collect()
}

/// A localized photo: component, pose, camera, verdict, evidence; one sigma in degrees and scene units, and on the map.
pub fn localization_json(photo: &PhotoLocalization, scene: &SceneFile) -> Value {
    let pose = photo.world_from_camera.as_ref();
    let covariance = photo
        .covariance
        .map(|c| c.row_iter().map(|row| row.iter().copied().collect::<Vec<f64>>()).collect::<Vec<_>>());
    let sigma = photo.covariance.as_ref().map(Sigma::of_covariance);
    json!({
        "name": photo.name, "verdict": photo.verdict, "reasons": photo.reasons, "inliers": photo.inliers,
        "component": photo.component, "own_frame": !scene.shares_frame(photo.component),
        "world_from_camera": pose.map(pose_json),
        "wgs84": pose.and_then(|pose| wgs84_json(pose, photo.component, scene)),
        "wgs84_sigma": MapSigma::of_photo(photo, scene), "camera": photo.camera,
        "covariance_rotation_rad_then_centre": covariance, "sigma": sigma.map(|sigma| sigma.as_json()),
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix4, UnitQuaternion, Vector3};
    use setloc_sfm::FrameErrors;

    use super::*;
    use crate::scene::NO_ALTITUDE;

    #[test]
    fn on_the_map_poses_are_off_by_their_frame_too() {
        let frame = FrameErrors {
            middle: Vector3::new(10.0, 0.0, 0.0),
            noise_m: 3.0,
            shift: Vector3::new(0.09, 0.16, 0.04),
            turn_and_scale: Matrix4::identity() * 0.01_f64.powi(2),
        };
        let scene = |alt, frame_errors| SceneFile {
            origin: Some(Wgs84 { lat: 47.0, lon: 8.0, alt }),
            placed: vec![true],
            frame_errors: vec![frame_errors],
            ..SceneFile::default()
        };
        let sigma = |x: f64, scene: &SceneFile| {
            let pose = Rigid::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0));
            let own = Sigma { rotation_rad: 0.001, center: Matrix3::from_diagonal_element(0.0001) };
            MapSigma::of(&pose, &own, 0, scene)
        };
        let placed = scene(400.0, Some(frame.clone()));
        let near = sigma(10.0, &placed).unwrap();
        assert!((near.horizontal_m - 0.2502_f64.sqrt()).abs() < 1e-12, "{near:?}");
        assert!((near.vertical_m.unwrap() - 0.0401_f64.sqrt()).abs() < 1e-12, "{near:?}");
        assert!((near.rotation_deg.to_radians() - 0.000_301_f64.sqrt()).abs() < 1e-12, "{near:?}");
        // A hundred metres on, turn, tilt and scale are a metre each.
        let far = sigma(110.0, &placed).unwrap();
        assert!((far.horizontal_m - 2.2502_f64.sqrt()).abs() < 1e-12, "{far:?}");
        assert!((far.vertical_m.unwrap() - 1.0401_f64.sqrt()).abs() < 1e-12, "{far:?}");
        assert_eq!(sigma(10.0, &scene(NO_ALTITUDE, Some(frame.clone()))).unwrap().vertical_m, None);
        assert_eq!(sigma(10.0, &scene(400.0, None)), None);
        assert_eq!(sigma(10.0, &SceneFile { placed: vec![false], ..placed }), None);
    }
}
