//! Files on disk: images, `cameras.json`, `geo.csv`, `truth.json`.

mod cameras;
mod geo;
mod images;
mod remarks;
mod truth;
mod unread;

pub use cameras::CameraBook;
pub use geo::{GeoBook, GeoSource};
pub use images::{CameraOrigin, ImageFolder, SkippedImage, SourceImage, list_images, with_told_cameras};
pub use remarks::truth_without_image;
pub use truth::{Truth, rigid_of};
pub use unread::unread_images;

use std::collections::BTreeMap;
use std::path::Path;

/// Looks an image up: by the longest end of its path that is listed, by its name, or as the only listed one whose
/// path ends in its name. What it is listed as, and what is told of it.
///
/// So `south/img_00.jpg` and a file given by itself find `queries/south/img_00.jpg`, and nothing is found in another
/// folder.
fn find_by_name<'m, T>(map: &'m BTreeMap<String, T>, name: &str, path: &Path) -> Option<(&'m String, &'m T)> {
    let whole = images::whole_path(path).to_string_lossy().replace('\\', "/");
    let ends = std::iter::successors(Some(whole.as_str()), |end| Some(end.split_once('/')?.1));
    let by_end = ends.filter(|end| !end.is_empty()).find_map(|end| map.get_key_value(end));
    by_end.or_else(|| map.get_key_value(name)).or_else(|| {
        let end = format!("/{name}");
        let mut longer = map.iter().filter(|(key, _)| key.ends_with(&end));
        match (longer.next(), longer.next()) {
            (Some(only), None) => Some(only),
            _ => None,
        }
    })
}

/// What several images have in common, by the key that each has, and the names of these images.
fn shared<'i, K: Ord>(
    images: &'i [SourceImage],
    key_of: impl Fn(&'i SourceImage) -> Option<K>,
) -> Vec<(K, Vec<String>)> {
    let mut by_key: BTreeMap<K, Vec<String>> = BTreeMap::new();
    for image in images {
        if let Some(key) = key_of(image) {
            by_key.entry(key).or_default().push(image.name.clone());
        }
    }
    by_key.into_iter().filter(|(_, images)| images.len() > 1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(names: &[&str]) -> BTreeMap<String, usize> {
        names.iter().enumerate().map(|(at, name)| ((*name).to_owned(), at)).collect()
    }

    #[test]
    fn names_are_found_by_whole_folders_and_never_in_another_one() {
        let map = map(&["queries/north/0.jpg", "queries/south/0.jpg", "queries/south/1.jpg", "2.jpg"]);
        let find =
            |name: &str| find_by_name(&map, name, &Path::new("/somewhere").join(name)).map(|(_, at)| at);
        assert_eq!(find("queries/north/0.jpg"), Some(&0));
        assert_eq!(find("south/0.jpg"), Some(&1));
        assert_eq!(find("1.jpg"), Some(&2));
        assert_eq!(find("west/2.jpg"), Some(&3));
        assert_eq!(find("0.jpg"), None);
        assert_eq!(find("west/1.jpg"), None);
        assert_eq!(find("th/1.jpg"), None);
    }

    #[test]
    fn the_longest_end_of_the_path_decides() {
        let map = map(&["panoramas/0.jpg", "day1/panoramas/0.jpg", "/data/day2/panoramas/0.jpg"]);
        let find = |day: &str, name: &str| {
            find_by_name(&map, name, Path::new(day).join(name).as_path()).map(|(_, at)| at)
        };
        assert_eq!(find("/data/day1", "panoramas/0.jpg"), Some(&1));
        assert_eq!(find("/data/day2", "panoramas/0.jpg"), Some(&2));
        assert_eq!(find("/data/", "day3/panoramas/0.jpg"), Some(&0));
    }
}
