//! Files on disk: images, `cameras.json`, `geo.csv`, `truth.json`.

mod cameras;
mod geo;
mod images;
mod truth;

pub use cameras::CameraBook;
pub use geo::{GeoBook, GeoSource};
pub use images::{ImageFolder, SkippedImage, SourceImage, list_images};
pub use truth::{Truth, TruthPose};

use std::collections::BTreeMap;

/// Looks a name up by its path relative to the data set, then by its file name when that is unique.
fn find_by_name<'m, T>(map: &'m BTreeMap<String, T>, name: &str) -> Option<&'m T> {
    map.get(name).or_else(|| {
        let file = |path: &str| path.rsplit('/').next().map(str::to_owned);
        let mut same = map.iter().filter(|(key, _)| file(key) == file(name));
        match (same.next(), same.next()) {
            (Some((_, value)), None) => Some(value),
            _ => None,
        }
    })
}
