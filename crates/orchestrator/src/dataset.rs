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

/// Looks a name up by its path; if it is not there, by as much of the path's end as tells it from all others.
///
/// So `south/img_00.jpg` and a file given by itself find `queries/south/img_00.jpg`.
fn find_by_name<'m, T>(map: &'m BTreeMap<String, T>, name: &str) -> Option<&'m T> {
    map.get(name).or_else(|| {
        let common = |key: &str| {
            key.rsplit('/').zip(name.rsplit('/')).take_while(|(theirs, ours)| theirs == ours).count()
        };
        let most = map.keys().map(|key| common(key)).max().filter(|&most| most > 0)?;
        let mut best = map.iter().filter(|(key, _)| common(key) == most);
        match (best.next(), best.next()) {
            (Some((_, value)), None) => Some(value),
            _ => None,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_found_by_as_much_of_their_end_as_is_unique() {
        let names = ["queries/north/0.jpg", "queries/south/0.jpg", "queries/south/1.jpg"];
        let map: BTreeMap<String, usize> =
            names.iter().enumerate().map(|(at, name)| ((*name).to_owned(), at)).collect();
        assert_eq!(find_by_name(&map, "queries/north/0.jpg"), Some(&0));
        assert_eq!(find_by_name(&map, "south/0.jpg"), Some(&1));
        assert_eq!(find_by_name(&map, "1.jpg"), Some(&2));
        assert_eq!(find_by_name(&map, "0.jpg"), None);
        assert_eq!(find_by_name(&map, "west/2.jpg"), None);
    }
}
