//! Poses of images, however they are written.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use setloc_camset::Verdict;
use setloc_features::GeoPosition;
use setloc_sfm::Rigid;

use super::colmap_text::is_content;
use crate::colmap::ColmapFormat;
use crate::dataset::rigid_of;
use crate::error::Hinted;
use crate::text::read_text;

/// Poses of images by name.
#[derive(Debug, Clone, Default)]
pub struct NamedPoses {
    /// `world_from_camera`.
    pub poses: BTreeMap<String, Rigid>,
    /// Where the world's origin is on the map, its axes east, north, up there; where that is told.
    pub origin: Option<GeoPosition>,
}

impl NamedPoses {
    /// The same in the frame of other poses, and how far their origins are apart; `None` where either origin is not told. Where one has
    /// no altitude both are at one.
    pub fn in_frame_of(&self, other: &Self) -> Option<(Self, f64)> {
        let (own, wanted) = (self.origin?, other.origin?);
        let altitude = own.alt_m.or(wanted.alt_m).unwrap_or(0.0);
        let (rotation, translation) = wanted.or_at(altitude).enu_from_enu_of(own.or_at(altitude));
        let enu_from_enu = Rigid::new(rotation, translation);
        let poses = self.poses.iter().map(|(name, pose)| (name.clone(), enu_from_enu * *pose)).collect();
        Some((Self { poses, origin: other.origin }, translation.norm()))
    }
}

/// Reads `world_from_camera` of images by name.
///
/// Of a folder: its `truth.json`, else its `poses.json`, else the COLMAP model in it. Of a JSON file: a `truth.json`; the `poses.json` of `build` (what is in
/// the frame of the largest component), of `locate` (the scene's images, and what is *localized* in that frame) or of `bench`. Of any other file: lines of
/// a name and the camera-from-world pose, as `images.txt` begins, and as hloc and the benchmarks of visuallocalization.net have them.
///
/// # Errors
/// With file and place.
pub fn read_poses(path: &Path) -> Result<NamedPoses> {
    let mut origin = None;
    let poses = if path.is_dir() {
        let listed = ["truth.json", "poses.json"].map(|name| path.join(name));
        if let Some(file) = listed.iter().find(|file| file.is_file()) {
            return read_poses(file);
        }
        let images = ColmapFormat::of(path)?.images(path, |_| Ok(()))?;
        images.into_iter().map(|(name, (_, pose))| (name, pose)).collect()
    } else {
        let text = read_text(path)?;
        if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json")) {
            let json: Value =
                serde_json::from_str(&text).with_context(|| format!("{} is no JSON", path.display()))?;
            origin = origin_of(&json["geo_origin"]).with_context(|| path.display().to_string())?;
            of_json(&json).with_context(|| path.display().to_string())?
        } else {
            of_lines(path, &text)?
        }
    };
    if poses.is_empty() {
        let message = format!("{} has no pose", path.display());
        return Err(Hinted::error(
            message,
            "name a truth.json, a poses.json, a COLMAP model or lines of poses",
        ));
    }
    Ok(NamedPoses { poses, origin })
}

/// `{"lat", "lon", "alt"}`, without an altitude where none was measured; `None` of null.
fn origin_of(value: &Value) -> Result<Option<GeoPosition>> {
    if value.is_null() {
        return Ok(None);
    }
    let number = |key: &str| value[key].as_f64();
    let place = number("lat").zip(number("lon")).map(|(lat_deg, lon_deg)| GeoPosition {
        lat_deg,
        lon_deg,
        alt_m: number("alt"),
    });
    let place = place.filter(GeoPosition::is_valid);
    Ok(Some(
        place.context("`geo_origin` is no place: it has `lat` and `lon` in degrees, and `alt` in metres")?,
    ))
}

/// `NAME QW QX QY QZ TX TY TZ`, the pose camera-from-world.
fn of_lines(path: &Path, text: &str) -> Result<BTreeMap<String, Rigid>> {
    let mut poses = BTreeMap::new();
    for (at, line) in text.lines().enumerate().filter(|(_, line)| is_content(line)) {
        let place = || format!("{}, line {}", path.display(), at + 1);
        // The name may hold blanks.
        let mut name = line.trim();
        let mut numbers = [""; 7];
        for number in numbers.iter_mut().rev() {
            let parted = name.rsplit_once(char::is_whitespace);
            (name, *number) = parted.context("a line has a name and 7 numbers").with_context(place)?;
            name = name.trim_end();
        }
        let is_new =
            poses.insert(name.to_owned(), world_from_camera(&numbers).with_context(place)?).is_none();
        anyhow::ensure!(is_new, "{}: {name} has a pose in an earlier line", place());
    }
    Ok(poses)
}

/// A pose camera-from-world of 4 numbers of rotation (w first) and 3 of translation, turned about.
pub(super) fn world_from_camera(numbers: &[&str]) -> Result<Rigid> {
    let numbers = numbers.iter().map(|text| finite(text)).collect::<Result<Vec<f64>>>()?;
    let numbers: [f64; 7] = numbers
        .try_into()
        .map_err(|_| anyhow::anyhow!("an image has 4 numbers of rotation and 3 of translation"))?;
    Ok(rigid(numbers)?.inverse())
}

/// The transform of 4 numbers of rotation (w first) and 3 of translation.
pub(super) fn rigid([w, x, y, z, tx, ty, tz]: [f64; 7]) -> Result<Rigid> {
    anyhow::ensure!([w, x, y, z, tx, ty, tz].iter().all(|value| value.is_finite()), "a number is not finite");
    rigid_of([w, x, y, z], [tx, ty, tz]).context("the rotation is zero")
}

pub(super) fn finite(text: &str) -> Result<f64> {
    let value: f64 = text.parse().with_context(|| format!("`{text}` is no number"))?;
    anyhow::ensure!(value.is_finite(), "`{text}` is no finite number");
    Ok(value)
}

fn of_json(json: &Value) -> Result<BTreeMap<String, Rigid>> {
    let listed = |list: &Value| -> Result<BTreeMap<String, Rigid>> {
        let is_apart = |image: &Value| image["own_frame"] == true;
        let localized = json!(Verdict::Localized);
        let is_unsure = |image: &Value| image.get("verdict").is_some_and(|verdict| *verdict != localized);
        let images =
            list.as_array().into_iter().flatten().filter(|image| !is_apart(image) && !is_unsure(image));
        let placed = images.filter(|image| !image["world_from_camera"].is_null());
        placed
            .map(|image| {
                let name = image["name"].as_str().context("an image without a name")?;
                let pose = of_value(&image["world_from_camera"]).with_context(|| name.to_owned())?;
                Ok((name.to_owned(), pose))
            })
            .collect()
    };
    if let Some(components) = json["components"].as_array() {
        let mut poses = BTreeMap::new();
        for component in components.iter().filter(|component| component["own_frame"] != true) {
            poses.extend(listed(&component["images"])?);
        }
        return Ok(poses);
    }
    if json["photos"].is_array() {
        let mut poses = listed(&json["scene_images"])?;
        poses.extend(listed(&json["photos"])?);
        return Ok(poses);
    }
    let named = json.get("images").unwrap_or(json).as_object();
    let named = named.context("neither images by name nor what `setloc` writes")?;
    let one =
        |(name, value): (&String, &Value)| Ok((name.clone(), of_value(value).with_context(|| name.clone())?));
    named.iter().map(one).collect()
}

/// `{"q_wxyz", "center"}`, both of the camera in the world, or `{"R", "C"}`, of which R turns from the world into the camera.
pub(super) fn of_value(value: &Value) -> Result<Rigid> {
    let center = numbers::<3>(value.get("center").unwrap_or(&value["C"]));
    let [x, y, z] = center.context("`center` is not 3 numbers")?;
    if let Some(rows) = value["R"].as_array() {
        let rows: Vec<[f64; 3]> = rows.iter().filter_map(numbers).collect();
        let [a, b, c] = rows[..] else { anyhow::bail!("`R` is not 3 rows of 3 numbers") };
        let matrix = Matrix3::from_rows(&[a.into(), b.into(), c.into()]);
        let off = (matrix * matrix.transpose() - Matrix3::identity()).norm();
        anyhow::ensure!(off < 1e-3 && matrix.determinant() > 0.0, "`R` is no rotation");
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
        return Ok(Rigid::new(rotation.inverse(), Vector3::new(x, y, z)));
    }
    let [w, i, j, k] = numbers::<4>(&value["q_wxyz"]).context("`q_wxyz` is not 4 numbers")?;
    rigid([w, i, j, k, x, y, z])
}

fn numbers<const N: usize>(value: &Value) -> Option<[f64; N]> {
    let numbers: Option<Vec<f64>> = value.as_array()?.iter().map(Value::as_f64).collect();
    numbers?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use setloc_features::Wgs84;

    use super::*;

    fn read(name: &str, text: &str) -> Result<NamedPoses> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(name), text).unwrap();
        read_poses(&folder.path().join(name))
    }

    /// Half a turn about y at (1, 2, 3), in all notations.
    #[test]
    fn all_notations_tell_the_same_pose() {
        let pose = r#"{"q_wxyz": [0, 0, 1, 0], "center": [1, 2, 3]}"#;
        let texts = [
            ("a.txt", "# a comment\na b.jpg 0 0 1 0  1 -2 3\n".to_owned()),
            ("truth.json", format!(r#"{{"images": {{"a b.jpg": {pose}}}}}"#)),
            (
                "scene.json",
                format!(
                    r#"{{"components": [{{"images": [{{"name": "a b.jpg", "world_from_camera": {pose}}}, {{"name": "b", "world_from_camera": null}}], "own_frame": false}}, {{"images": [{{"name": "c", "world_from_camera": {pose}}}], "own_frame": true}}]}}"#
                ),
            ),
            (
                "photos.json",
                format!(
                    r#"{{"photos": [{{"name": "a b.jpg", "verdict": "localized", "own_frame": false, "world_from_camera": {pose}}}, {{"name": "b", "verdict": "uncertain", "own_frame": false, "world_from_camera": {pose}}}], "scene_images": []}}"#
                ),
            ),
            ("bench.json", r#"{"a b.jpg": {"R": [[-1,0,0],[0,1,0],[0,0,-1]], "C": [1,2,3]}}"#.to_owned()),
        ];
        for (name, text) in texts {
            let poses = read(name, &text).unwrap().poses;
            assert_eq!(poses.keys().collect::<Vec<_>>(), ["a b.jpg"], "{name}");
            let pose = poses["a b.jpg"];
            assert!((pose.translation - Vector3::new(1.0, 2.0, 3.0)).norm() < 1e-12, "{name}: {pose:?}");
            let turned = pose.rotation * Vector3::new(1.0, 1.0, 1.0);
            assert!((turned - Vector3::new(-1.0, 1.0, -1.0)).norm() < 1e-12, "{name}: {pose:?}");
        }
    }

    #[test]
    fn poses_about_another_origin_come_into_the_frame_of_the_others() {
        let (zurich, bern) = ((47.37, 8.54), (46.95, 7.45));
        let place = |lat: f64, lon: f64, alt: f64| Wgs84 { lat, lon, alt };
        let seen = place(47.0, 8.0, 500.0);
        let written = |(lat, lon): (f64, f64), with_altitude: bool| {
            let center = seen.to_enu(place(lat, lon, 400.0));
            let alt = if with_altitude { ", \"alt\": 400.0" } else { "" };
            let text = format!(
                r#"{{"geo_origin": {{"lat": {lat}, "lon": {lon}{alt}}}, "images": {{"a": {{"q_wxyz": [1, 0, 0, 0], "center": [{}, {}, {}]}}}}}}"#,
                center.x, center.y, center.z
            );
            read("truth.json", &text).unwrap()
        };
        let truth = written(zurich, true);
        for found in [written(bern, true), written(bern, false)] {
            let (moved, distance_m) = found.in_frame_of(&truth).unwrap();
            let off = moved.poses["a"].translation - truth.poses["a"].translation;
            assert!(off.norm() < 1e-6 && (9e4..1e5).contains(&distance_m), "{off} {distance_m}");
            // Meridians turn between the two.
            let turned = moved.poses["a"].rotation.angle_to(&truth.poses["a"].rotation).to_degrees();
            assert!((0.7..1.2).contains(&turned), "{turned}");
        }
        let without = NamedPoses { origin: None, ..truth.clone() };
        assert!(without.in_frame_of(&truth).is_none() && truth.in_frame_of(&without).is_none());
        let error = read("a.json", r#"{"geo_origin": {"lat": 91, "lon": 8}, "images": {}}"#).unwrap_err();
        assert!(format!("{error:#}").contains("a.json: `geo_origin` is no place"), "{error:#}");
    }

    #[test]
    fn of_a_folder_the_truth_counts_before_results_and_these_before_a_model() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        let first = || read_poses(folder.path()).unwrap().poses.into_keys().next().unwrap();
        write("images.txt", "1 1 0 0 0 0 0 0 1 of a model.jpg\n\n");
        assert_eq!(first(), "of a model.jpg");
        let pose = r#"{"q_wxyz": [1, 0, 0, 0], "center": [1, 2, 3]}"#;
        write("poses.json", &format!(r#"{{"of results.jpg": {pose}}}"#));
        assert_eq!(first(), "of results.jpg");
        write("truth.json", &format!(r#"{{"images": {{"true.jpg": {pose}}}}}"#));
        assert_eq!(first(), "true.jpg");
    }

    #[test]
    fn what_is_no_pose_is_named_with_its_place() {
        let error = |name: &str, text: &str| format!("{:#}", read(name, text).unwrap_err());
        assert!(error("a.txt", "a 1 0 0 0 1 2\n").contains("a.txt, line 1: a line has a name and 7 numbers"));
        assert!(error("a.txt", "a 1 0 0 0 1 2 x\n").contains("`x` is no number"));
        assert!(error("a.txt", "a 0 0 0 0 1 2 3\n").contains("the rotation is zero"));
        let twice = error("a.txt", "a 1 0 0 0 1 2 3\na 1 0 0 0 1 2 4\n");
        assert!(twice.contains("line 2: a has a pose in an earlier line"), "{twice}");
        assert!(error("a.txt", "\n").contains("has no pose"));
        assert!(error("a.json", "[1]").contains("a.json: neither images by name"));
        assert!(error("a.json", "{").contains("is no JSON"));
        assert!(
            error("a.json", r#"{"b": {"q_wxyz": [1, 0, 0], "center": [1, 2, 3]}}"#).contains("b: `q_wxyz`")
        );
        assert!(
            error("a.json", r#"{"b": {"R": [[1,0,0],[0,1,0],[0,0,2]], "C": [1, 2, 3]}}"#)
                .contains("no rotation")
        );
    }
}
