use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::images::ENDINGS;
use crate::text::some_of;

/// Endings of image files that cannot be read, lower case.
const OTHER_ENDINGS: [&str; 20] = [
    "arw", "avif", "cr2", "cr3", "dng", "exr", "gif", "hdr", "heic", "heif", "insp", "jp2", "jxl", "nef",
    "orf", "pgm", "ppm", "raf", "rw2", "tga",
];

/// How deep images are looked for below a folder that is given.
const DEPTH: usize = 3;

/// Images that lie in given folders or below and are not read.
#[derive(Default)]
struct Unread {
    formats: Vec<String>,
    links: Vec<String>,
    folders: Vec<String>,
}

/// Says which images in given folders and below are not read; nothing of what is given itself, nor of the folder of
/// `masks`.
pub fn unread_images(given: &[PathBuf], masks: Option<&Path>) -> Option<String> {
    let known: BTreeSet<PathBuf> =
        given.iter().map(PathBuf::as_path).chain(masks).filter_map(|path| path.canonicalize().ok()).collect();
    let mut unread = Unread::default();
    for folder in given.iter().filter(|path| path.is_dir()) {
        for path in visible_entries(folder) {
            if path.is_dir() {
                unread.add_folders(&path, &known, DEPTH);
            } else if has_ending(&path, &OTHER_ENDINGS) {
                unread.formats.push(path.display().to_string());
            } else if has_ending(&path, &ENDINGS) && !path.exists() {
                unread.links.push(path.display().to_string());
            }
        }
    }
    unread.in_words()
}

impl Unread {
    /// Adds a folder, and those below, that have images.
    fn add_folders(&mut self, folder: &Path, known: &BTreeSet<PathBuf>, depth: usize) {
        if depth == 0 || folder.canonicalize().is_ok_and(|folder| known.contains(&folder)) {
            return;
        }
        let entries = visible_entries(folder);
        if entries.iter().any(|path| is_image(path)) {
            self.folders.push(folder.display().to_string());
        }
        for below in entries.iter().filter(|path| path.is_dir()) {
            self.add_folders(below, known, depth - 1);
        }
    }

    fn in_words(&self) -> Option<String> {
        let readable = format!("files of other formats than {}", ENDINGS.join(", "));
        let kinds = [
            (&self.formats, readable.as_str(), "files"),
            (&self.links, "links to nothing", "links"),
            (&self.folders, "subfolders with images, each of which has to be given itself", "folders"),
        ];
        let kinds = kinds.iter().filter(|(paths, ..)| !paths.is_empty());
        let kinds: Vec<String> =
            kinds.map(|(paths, what, nouns)| format!("{what} ({})", some_of(paths, nouns))).collect();
        (!kinds.is_empty()).then(|| format!("not read: {}", kinds.join(", ")))
    }
}

/// Sorted; what is hidden, as stores of results are, is none of the user's images.
fn visible_entries(folder: &Path) -> Vec<PathBuf> {
    let entries =
        std::fs::read_dir(folder).into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
    let is_visible =
        |path: &PathBuf| path.file_name().is_some_and(|name| !name.to_string_lossy().starts_with('.'));
    let mut entries: Vec<PathBuf> = entries.filter(is_visible).collect();
    entries.sort();
    entries
}

/// Whether a path is an image that somebody else made than this program.
fn is_image(path: &Path) -> bool {
    let is_ours = path.file_name().is_some_and(|name| name.to_string_lossy().ends_with("top_view.png"));
    !is_ours && has_ending(path, &ENDINGS) && path.is_file()
}

fn has_ending(path: &Path, endings: &[&str]) -> bool {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
    endings.contains(&ending.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_that_are_not_read_are_named_by_their_kind() {
        let root = tempfile::tempdir().unwrap();
        let given = root.path().join("p");
        let said = |masks: Option<&Path>| unread_images(std::slice::from_ref(&given), masks);
        let write = |name: &str| {
            let path = given.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        };
        ["a.jpg", "notes.txt", ".hidden/a.jpg", "exports/top_view.png", "masks/a.png"]
            .into_iter()
            .for_each(&write);
        assert!(said(None).unwrap().ends_with("p/masks)"));
        let masks = given.join("../p/masks");
        assert_eq!(said(Some(&masks)), None);
        ["b.GIF", "north/a.jpg", "2024/day/b.png"].into_iter().for_each(&write);
        std::os::unix::fs::symlink(given.join("nowhere"), given.join("c.jpg")).unwrap();
        let text = said(Some(&masks)).unwrap().replace(&format!("{}/", given.display()), "");
        assert_eq!(
            text,
            "not read: files of other formats than jpg, jpeg, png, tif, tiff, webp, bmp, jpe (b.GIF), links to \
             nothing (c.jpg), subfolders with images, each of which has to be given itself (2024/day; north)"
        );
        let all = [given.clone(), given.join("north"), given.join("2024/day"), masks];
        assert!(!unread_images(&all, None).unwrap().contains("subfolders"));
    }
}
