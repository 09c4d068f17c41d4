//! What `locate` wrote of its photos.

use std::path::Path;

use anyhow::{Context, Result};
use serde_json::{Value, json};
use setloc_camset::Verdict;
use setloc_features::Wgs84;
use setloc_sfm::Rigid;

use super::poses::of_value;
use crate::error::Hinted;
use crate::scene::NO_ALTITUDE;

/// The photos in the `poses.json` of a folder that `locate` wrote.
#[derive(Debug, Clone, PartialEq)]
pub struct LocatedPhotos {
    /// WGS84 place of the scene's origin.
    pub origin: Option<Wgs84>,
    /// Names and poses of the photos that are localized in the frame of `origin`; of all localized ones where there is no origin.
    pub poses: Vec<(String, Rigid)>,
    /// Names of the others.
    pub others: Vec<String>,
    /// All of it.
    pub json: Value,
}

impl LocatedPhotos {
    /// Reads a folder of results.
    ///
    /// # Errors
    /// When it has none of `locate`, or they are damaged.
    pub fn read(folder: &Path) -> Result<Self> {
        let file = folder.join("poses.json");
        let shown = file.display();
        let text = std::fs::read_to_string(&file).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("cannot read {shown}"));
            Hinted::wrap(error, "name a scene, or the output folder of `setloc locate`")
        })?;
        let json: Value = serde_json::from_str(&text).with_context(|| format!("{shown} is no JSON"))?;
        if !json["photos"].is_array() {
            let message = format!("{shown} tells of no photos that `setloc locate` sought");
            let scene = folder.with_extension("setloc");
            let hint = if scene.is_file() {
                format!("name the scene: {}", scene.display())
            } else {
                "name a scene, or the output folder of `setloc locate`".to_owned()
            };
            return Err(Hinted::error(message, hint));
        }
        Self::of_json(json).with_context(|| shown.to_string())
    }

    fn of_json(json: Value) -> Result<Self> {
        let origin = &json["geo_origin"];
        let degrees = |name: &str| origin[name].as_f64();
        let origin = degrees("lat").zip(degrees("lon")).map(|(lat, lon)| Wgs84 {
            lat,
            lon,
            alt: degrees("alt").unwrap_or(NO_ALTITUDE),
        });
        let localized = json!(Verdict::Localized);
        let (mut poses, mut others) = (Vec::new(), Vec::new());
        for photo in json["photos"].as_array().into_iter().flatten() {
            let name = photo["name"].as_str().context("a photo without a name")?.to_owned();
            let is_placed = origin.is_none() || !photo["wgs84"].is_null();
            if photo["verdict"] == localized && is_placed {
                let pose = of_value(&photo["world_from_camera"]).with_context(|| name.clone())?;
                poses.push((name, pose));
            } else {
                others.push(name);
            }
        }
        Ok(Self { origin, poses, others, json })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_that_are_uncertain_or_in_a_frame_of_their_own_are_named_apart() {
        let photo = |name: &str, verdict: &str, is_placed: bool| {
            let wgs84 = is_placed.then(|| json!({ "lat": 47.0, "lon": 8.0 }));
            let pose = json!({ "q_wxyz": [1, 0, 0, 0], "center": [1, 2, 3] });
            json!({ "name": name, "verdict": verdict, "wgs84": wgs84, "world_from_camera": pose })
        };
        let photos =
            [photo("a", "localized", true), photo("b", "localized", false), photo("c", "uncertain", true)];
        let folder = tempfile::tempdir().unwrap();
        let read = |json: Value| {
            std::fs::write(folder.path().join("poses.json"), json.to_string()).unwrap();
            LocatedPhotos::read(folder.path())
        };
        let names = |photos: &LocatedPhotos| -> Vec<String> {
            photos.poses.iter().map(|(name, _)| name.clone()).collect()
        };
        let placed = read(json!({ "geo_origin": { "lat": 47.0, "lon": 8.0 }, "photos": photos })).unwrap();
        assert_eq!(
            (names(&placed), &placed.others[..]),
            (vec!["a".to_owned()], &["b".to_owned(), "c".to_owned()][..])
        );
        assert!(!crate::scene::has_altitude(placed.origin.unwrap()));
        let unplaced = read(json!({ "geo_origin": null, "photos": photos })).unwrap();
        assert_eq!((names(&unplaced), unplaced.origin), (vec!["a".to_owned(), "b".to_owned()], None));
        let error = format!("{:#}", read(json!({ "components": [] })).unwrap_err());
        assert!(error.contains("tells of no photos"), "{error}");
    }
}
