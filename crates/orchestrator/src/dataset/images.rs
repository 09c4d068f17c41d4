use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use anyhow::{Context, Result};
use rayon::prelude::*;
use setloc_features::{Calibration, Camera, CameraSource, GeoPosition};

use super::remarks::{Given, warnings_of};
use super::{CameraBook, GeoBook, GeoSource, unread_images};
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::stages;

/// Endings of files that are taken as images, lower case.
pub(super) const ENDINGS: [&str; 8] = ["jpg", "jpeg", "png", "tif", "tiff", "webp", "bmp", "jpe"];

/// An image to work on.
#[derive(Debug, Clone)]
pub struct SourceImage {
    /// Folder and file name, with more folders where needed: how people and result files call it.
    pub name: String,
    /// Where it is.
    pub path: PathBuf,
    /// Hash of the file.
    pub hash: ContentHash,
    /// Its camera.
    pub camera: Camera,
    /// How well the camera's intrinsics are known.
    pub calibration: Calibration,
    /// Where the camera comes from.
    pub camera_origin: CameraOrigin,
    /// The projection that the image says to have, if no camera model is of it.
    pub other_projection: Option<String>,
    /// Measured position.
    pub position: Option<GeoPosition>,
    /// Mask image.
    pub mask: Option<(PathBuf, ContentHash)>,
    /// Whether a first model of the scene left it apart, so that more features are sought in it.
    pub second_look: bool,
}

#[cfg(test)]
impl SourceImage {
    /// An image of a guessed camera that is in no file.
    pub fn guessed(name: &str, camera: Camera) -> Self {
        Self {
            name: name.to_owned(),
            path: PathBuf::new(),
            hash: ContentHash::of(name.as_bytes()),
            camera,
            calibration: Calibration::Guessed,
            camera_origin: CameraOrigin::Listed,
            other_projection: None,
            position: None,
            mask: None,
            second_look: false,
        }
    }
}

impl SourceImage {
    /// Whether this camera was guessed of the image.
    pub fn is_guess(&self, camera: &Camera) -> bool {
        self.calibration == Calibration::Guessed && self.camera == *camera
    }
}

/// The images with the cameras that are told, by their places, in place of guessed ones, known as well as is told; `None`
/// when none is told.
pub fn with_told_cameras(
    images: &[SourceImage],
    told: impl Fn(usize) -> Option<(Camera, Calibration)>,
) -> Option<Vec<SourceImage>> {
    let told_of = |(at, image): (usize, &SourceImage)| {
        (image.calibration == Calibration::Guessed).then(|| told(at)).flatten()
    };
    let told: Vec<_> = images.iter().enumerate().map(told_of).collect();
    let is_any_told = told.iter().any(Option::is_some);
    let with_camera = |(image, told): (&SourceImage, Option<(Camera, Calibration)>)| match told {
        Some((camera, calibration)) => {
            SourceImage { camera, calibration, camera_origin: CameraOrigin::Estimated, ..image.clone() }
        }
        None => image.clone(),
    };
    is_any_told.then(|| images.iter().zip(told).map(with_camera).collect())
}

/// Where an image's camera comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CameraOrigin {
    /// From `cameras.json`.
    Listed,
    /// From the image itself, or from nothing.
    Guessed(CameraSource),
    /// From a set's localization, or from a first model.
    Estimated,
}

/// An image that cannot be used, and why.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct SkippedImage {
    /// How people call it.
    pub name: String,
    /// Why it is not used.
    pub reason: String,
}

/// The readable images of a folder or list, and the others.
#[derive(Debug, Clone, Default)]
pub struct ImageFolder {
    /// Usable images, sorted by name.
    pub images: Vec<SourceImage>,
    /// Images that cannot be used.
    pub skipped: Vec<SkippedImage>,
    /// What is worth saying of the usable ones and of what was given with them.
    pub warnings: Vec<String>,
}

/// Image files of folders (not their subfolders) and single files: unique names and paths, sorted by name.
///
/// # Errors
/// When a path does not exist or is a device, or no image is there.
pub fn list_images(paths: &[PathBuf]) -> Result<Vec<(String, PathBuf)>> {
    let mut files = Vec::new();
    for path in paths {
        let metadata = std::fs::metadata(path).with_context(|| format!("cannot open {}", path.display()))?;
        if metadata.is_dir() {
            for entry in std::fs::read_dir(path).with_context(|| format!("cannot list {}", path.display()))? {
                let entry = entry?.path();
                let ending =
                    entry.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
                if ENDINGS.contains(&ending.as_str()) && entry.is_file() {
                    files.push(entry);
                }
            }
        } else if metadata.is_file() {
            files.push(path.clone());
        } else {
            // A device or a pipe may have no end.
            return Err(Hinted::error(
                format!("{} is neither a file nor a folder", path.display()),
                "name image files, or folders with images",
            ));
        }
    }
    // One file is one image, however its folder is written.
    let mut seen = BTreeSet::new();
    files.retain(|path| seen.insert(real_path(path)));
    if files.is_empty() {
        let shown: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
        let give = || format!("give a folder with images ({}) or image files", ENDINGS.join(", "));
        let hint = unread_images(paths, None).unwrap_or_else(give);
        return Err(Hinted::error(format!("no images in {}", shown.join(", ")), hint));
    }
    let mut named: Vec<(String, PathBuf)> = names_of(&files).into_iter().zip(files).collect();
    named.sort();
    Ok(named)
}

/// Folder and file name; where those of two folders are the same, as many folders more as tell them apart, for all
/// files of these folders.
fn names_of(files: &[PathBuf]) -> Vec<String> {
    let whole: Vec<PathBuf> = files.iter().map(|path| whole_path(path)).collect();
    let folder_of = |at: usize| whole[at].parent().unwrap_or(Path::new(""));
    let parts: Vec<Vec<String>> = whole.iter().map(|path| parts_of(path)).collect();
    let mut lengths: BTreeMap<&Path, usize> = (0..files.len()).map(|at| (folder_of(at), 2)).collect();
    loop {
        let name = |at: usize| {
            let length = lengths[folder_of(at)];
            parts[at][parts[at].len().saturating_sub(length)..].join("/")
        };
        let mut names: Vec<String> = (0..files.len()).map(name).collect();
        let mut by_name: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (at, name) in names.iter().enumerate() {
            by_name.entry(name).or_default().push(at);
        }
        let alike = by_name.values().filter(|files| files.len() > 1).flatten();
        let longer: BTreeSet<&Path> =
            alike.filter(|&&at| lengths[folder_of(at)] < parts[at].len()).map(|&at| folder_of(at)).collect();
        if longer.is_empty() {
            number_alike(&mut names);
            return names;
        }
        for folder in longer {
            *lengths.entry(folder).or_default() += 1;
        }
    }
}

/// Numbers names that are still the same: of files whose names differ in what is no text.
fn number_alike(names: &mut [String]) {
    let mut taken = BTreeSet::new();
    for name in names {
        let numbered = (2..).map(|number| format!("{name} ({number})"));
        let free = std::iter::once(name.clone()).chain(numbered).find(|name| !taken.contains(name));
        *name = free.unwrap_or_default();
        taken.insert(name.clone());
    }
}

fn parts_of(path: &Path) -> Vec<String> {
    let normal = |part| match part {
        // Names go into tables and lists of lines.
        Component::Normal(text) => Some(text.to_string_lossy().replace(char::is_control, "_")),
        _ => None,
    };
    path.components().filter_map(normal).collect()
}

/// The path from the root without `..`; links keep their names.
pub(super) fn whole_path(path: &Path) -> PathBuf {
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let parts: Vec<Component<'_>> = whole.components().collect();
    let Some(last) = parts.iter().rposition(|part| *part == Component::ParentDir) else { return whole };
    let (climbed, below) = parts.split_at(last + 1);
    let folder = climbed.iter().collect::<PathBuf>().canonicalize();
    folder.map_or_else(|_| whole.clone(), |folder| folder.join(below.iter().collect::<PathBuf>()))
}

/// The path from the root without links in its folders.
fn real_path(path: &Path) -> PathBuf {
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let (folder, file) = (whole.parent(), whole.file_name());
    let folder = folder.and_then(|folder| folder.canonicalize().ok());
    folder.zip(file).map_or(whole.clone(), |(folder, file)| folder.join(file))
}

impl ImageFolder {
    /// Reads hash, size, camera and position of the named files; what is no image is skipped with its reason.
    ///
    /// # Errors
    /// When not a single file is readable, or there is no folder of masks.
    pub fn read(
        files: &[(String, PathBuf)],
        cameras: &CameraBook,
        geo: &GeoSource,
        masks: Option<&Path>,
    ) -> Result<Self> {
        if let Some(folder) = masks.filter(|folder| !folder.is_dir()) {
            let message = format!("{} is no folder", folder.display());
            return Err(Hinted::error(
                message,
                "--masks names a folder of mask images, as `masks/a.jpg.png`",
            ));
        }
        let table = match geo {
            GeoSource::Table(path) => GeoBook::read(path)?,
            GeoSource::None | GeoSource::Exif => GeoBook::default(),
        };
        let read: Vec<Result<SourceImage, SkippedImage>> = files
            .par_iter()
            .with_max_len(1)
            .map(|(name, path)| {
                let skip =
                    |error: anyhow::Error| SkippedImage { name: name.clone(), reason: format!("{error:#}") };
                let mut image = read_image(name, path, cameras, geo).map_err(skip)?;
                image.position = image.position.or_else(|| table.find(name, path));
                image.mask = masks.map(|folder| find_mask(folder, path)).transpose().map_err(skip)?.flatten();
                Ok(image)
            })
            .collect();
        let mut folder = Self::default();
        for outcome in read {
            match outcome {
                Ok(image) => folder.images.push(image),
                Err(skipped) => folder.skipped.push(skipped),
            }
        }
        if folder.images.is_empty() {
            let reasons: Vec<String> =
                folder.skipped.iter().map(|s| format!("{}: {}", s.name, s.reason)).collect();
            let message =
                format!("none of {} files is a readable image ({})", files.len(), reasons.join("; "));
            return Err(Hinted::error(message, "check the files with an image viewer"));
        }
        table.check_one_image_each(&folder.images)?;
        folder.warnings = warnings_of(&folder.images, &Given { cameras, geo, table: &table, masks });
        Ok(folder)
    }
}

fn read_image(name: &str, path: &Path, cameras: &CameraBook, geo: &GeoSource) -> Result<SourceImage> {
    let bytes = std::fs::read(path)?;
    anyhow::ensure!(!bytes.is_empty(), "the file is empty");
    let info = stages::probe(&bytes, &stages::DecodeLimits::default()).context("not a readable image")?;
    let known = cameras.find(name, path).and_then(|camera| camera_of(&info, camera));
    let (camera, calibration, camera_origin) = if let Some(camera) = known {
        (camera, Calibration::Known, CameraOrigin::Listed)
    } else {
        let (camera, source) = stages::guess_camera(&info);
        let calibration = if camera.is_panoramic() { Calibration::Known } else { Calibration::Guessed };
        (camera, calibration, CameraOrigin::Guessed(source))
    };
    let exif = (*geo == GeoSource::Exif).then_some(info.metadata.gps).flatten();
    let position = exif.filter(GeoPosition::is_valid);
    let hash = ContentHash::of(&bytes);
    Ok(SourceImage {
        name: name.to_owned(),
        path: path.to_owned(),
        hash,
        camera,
        calibration,
        camera_origin,
        other_projection: info.metadata.other_projection,
        position,
        mask: None,
        second_look: false,
    })
}

/// The told camera of an image; one of the pixels as they are stored, as COLMAP's are, is turned upright with them. `None` when
/// it is of another size.
///
/// Where both have the same size, a camera is of the upright image.
fn camera_of(info: &stages::ImageInfo, told: &Camera) -> Option<Camera> {
    let fits = |camera: &Camera| (camera.width, camera.height) == (info.width, info.height);
    if fits(told) {
        return Some(told.clone());
    }
    stages::upright_camera(info.metadata.orientation, told).filter(fits)
}

/// `<folder>/<file>.png`, as COLMAP names masks, or `<folder>/<stem>.png`.
///
/// Where the folder has the image's own folders, the longest end of its path decides, so that files of one name in
/// several folders have masks of their own: `<folder>/north/<file>.png` comes before `<folder>/<file>.png`.
fn find_mask(folder: &Path, image: &Path) -> Result<Option<(PathBuf, ContentHash)>> {
    let whole = whole_path(image);
    let file = image.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let stem = image.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let names = [format!("{file}.png"), format!("{stem}.png")];
    let parent = whole.parent().unwrap_or(Path::new(""));
    let ends: Vec<&Path> = parent.ancestors().filter_map(|above| parent.strip_prefix(above).ok()).collect();
    let mut places =
        ends.iter().rev().flat_map(|end| names.iter().map(move |name| folder.join(end).join(name)));
    // Where masks lie beside the images, an image is not its own.
    let path = places.find(|place| place.is_file() && whole_path(place) != whole);
    path.map(|path| {
        let bytes = std::fs::read(&path).with_context(|| format!("cannot read mask {}", path.display()))?;
        Ok((path, ContentHash::of(&bytes)))
    })
    .transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Makes files and lists folders; the names.
    fn names(files: &[&str], folders: &[&str]) -> Vec<String> {
        let root = tempfile::tempdir().unwrap();
        for file in files {
            let path = root.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
        let folders: Vec<PathBuf> = folders.iter().map(|folder| root.path().join(folder)).collect();
        list_images(&folders).unwrap().into_iter().map(|(name, _)| name).collect()
    }

    #[test]
    fn folders_of_one_name_are_told_apart_by_those_above() {
        let days = ["day1/panoramas", "day2/panoramas", "day3/panoramas", "night"];
        let files = ["day1/panoramas/0.png", "day2/panoramas/0.png", "day3/panoramas/0.png", "night/0.png"];
        assert_eq!(names(&files, &days), files);
        // All files of a folder are called alike, so that they stay side by side.
        let more = ["day1/panoramas/0.png", "day1/panoramas/1.png", "day2/panoramas/0.png"];
        assert_eq!(names(&more, &days[..2]), more);
        assert_eq!(names(&more, &days[..1]), ["panoramas/0.png", "panoramas/1.png"]);
        // Some need more folders than others.
        let deep = ["a/x/p/0.png", "b/x/p/0.png", "b/y/p/0.png"];
        assert_eq!(names(&deep, &["a/x/p", "b/x/p", "b/y/p"]), ["a/x/p/0.png", "b/x/p/0.png", "y/p/0.png"]);
    }

    #[test]
    fn images_with_longer_names_are_found_by_short_and_long_ones() {
        let root = tempfile::tempdir().unwrap();
        let days = ["day1", "day2", "day3"].map(|day| root.path().join(day).join("panoramas"));
        for (shade, day) in days.iter().enumerate() {
            std::fs::create_dir_all(day).unwrap();
            let image = image::GrayImage::from_pixel(40, 30, image::Luma([shade as u8]));
            image.save(day.join("0.png")).unwrap();
        }
        let (table, cameras) = (root.path().join("geo.csv"), root.path().join("cameras.json"));
        let positions = "day1/panoramas/0.png,1,8\nday2/panoramas/0.png,2,8\npanoramas/0.png,3,8\n";
        std::fs::write(&table, positions).unwrap();
        let camera = Camera::from_focal_guess(40, 30, 77.0);
        let listed = serde_json::json!({ "cameras": { "c": camera }, "images": { "panoramas/0.png": "c" } });
        std::fs::write(&cameras, listed.to_string()).unwrap();
        let book = CameraBook::read(&cameras).unwrap();
        let read =
            ImageFolder::read(&list_images(&days).unwrap(), &book, &GeoSource::Table(table), None).unwrap();
        let latitudes: Vec<f64> = read.images.iter().map(|image| image.position.unwrap().lat_deg).collect();
        assert_eq!(latitudes, [1.0, 2.0, 3.0]);
        assert!(
            read.images.iter().all(|image| image.camera == camera && image.calibration == Calibration::Known)
        );
        let shared =
            "`panoramas/0.png` names 3 images, which are told the same camera: day1/panoramas/0.png; ";
        assert!(read.warnings.len() == 1 && read.warnings[0].contains(shared), "{:?}", read.warnings);
        // What names a folder that two of them have places neither.
        std::fs::write(root.path().join("geo.csv"), "panoramas/0.png,1,8\n").unwrap();
        let table = GeoSource::Table(root.path().join("geo.csv"));
        let error = ImageFolder::read(&list_images(&days).unwrap(), &book, &table, None).unwrap_err();
        let said =
            "geo.csv: `panoramas/0.png` names 3 images, which cannot be in one place: day1/panoramas/0.png; ";
        assert!(error.to_string().contains(said), "{error}");
    }

    #[test]
    fn told_cameras_are_of_the_upright_image_or_of_the_stored_pixels() {
        let camera = |width, height, cx: f64, cy: f64| {
            let params = vec![700.0, cx, cy, -0.1, 0.0];
            Camera { params, ..Camera::from_focal_guess(width, height, 1.0) }
        };
        let info = |orientation| {
            let metadata = setloc_features::ImageMetadata { orientation, ..Default::default() };
            stages::ImageInfo { width: 300, height: 400, metadata }
        };
        let (upright, stored) = (camera(300, 400, 140.0, 210.0), camera(400, 300, 210.0, 160.0));
        assert_eq!(camera_of(&info(6), &upright), Some(upright.clone()));
        assert_eq!(camera_of(&info(6), &stored), Some(upright.clone()));
        assert_eq!(camera_of(&info(8), &stored), Some(camera(300, 400, 160.0, 190.0)));
        assert_eq!(camera_of(&info(3), &upright), Some(upright));
        assert_eq!(camera_of(&info(1), &stored), None);
        assert_eq!(camera_of(&info(6), &camera(800, 600, 400.0, 300.0)), None);
    }

    #[test]
    fn what_is_neither_file_nor_folder_is_refused() {
        let error = list_images(&[PathBuf::from("/dev/zero")]).unwrap_err();
        assert_eq!(error.to_string(), "/dev/zero is neither a file nor a folder");
    }

    #[test]
    fn one_file_is_listed_once_however_it_is_written() {
        let given = ["p", "p/0.png", "p/../p", "./p/0.png"];
        assert_eq!(names(&["p/0.png", "p/1.png"], &given), ["p/0.png", "p/1.png"]);
        assert_eq!(names(&["p/0.png", "q/1.png"], &["q/../p"]), ["p/0.png"]);
    }

    #[test]
    fn names_that_are_still_the_same_are_numbered() {
        let mut names = ["a", "a", "a (2)", "a"].map(str::to_owned);
        number_alike(&mut names);
        assert_eq!(names, ["a", "a (2)", "a (2) (2)", "a (3)"]);
    }

    #[test]
    fn masks_are_found_by_the_longest_end_of_the_images_path() {
        let root = tempfile::tempdir().unwrap();
        let root = root.path();
        for mask in ["0.png", "north/0.jpg.png", "day1/north/0.png", "images/south/1.png"] {
            let path = root.join("masks").join(mask);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, mask).unwrap();
        }
        let find = |folder: &str, image: &str| {
            let found = find_mask(&root.join(folder), &root.join(image)).unwrap();
            found.map(|(path, _)| path.strip_prefix(root).unwrap().display().to_string())
        };
        assert_eq!(find("masks", "day1/north/0.jpg").unwrap(), "masks/day1/north/0.png");
        assert_eq!(find("masks", "day2/north/0.jpg").unwrap(), "masks/north/0.jpg.png");
        assert_eq!(find("masks", "day2/south/0.jpg").unwrap(), "masks/0.png");
        assert_eq!(find("masks", "images/south/1.jpg").unwrap(), "masks/images/south/1.png");
        assert_eq!(find("masks", "day1/south/1.jpg"), None);
        assert_eq!(find("masks", "masks/0.png"), None);
    }
}
