use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use rayon::prelude::*;
use setloc_features::{Camera, Wgs84};

use super::{CameraBook, GeoBook, GeoSource};
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::stages;

/// Endings of files that are taken as images, lower case.
const ENDINGS: [&str; 8] = ["jpg", "jpeg", "png", "tif", "tiff", "webp", "bmp", "jpe"];

/// An image to work on.
#[derive(Debug, Clone)]
pub struct SourceImage {
    /// Folder and file name: how people and result files call it.
    pub name: String,
    /// Where it is.
    pub path: PathBuf,
    /// Hash of the file.
    pub hash: ContentHash,
    /// Its camera, a guess unless `camera_fixed`.
    pub camera: Camera,
    /// Whether the intrinsics are known and stay.
    pub camera_fixed: bool,
    /// Where the camera comes from, for people.
    pub camera_source: String,
    /// Measured position.
    pub position: Option<Wgs84>,
    /// Mask image.
    pub mask: Option<(PathBuf, ContentHash)>,
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
}

/// Image files of folders (not their subfolders) and single files: names and paths, sorted by name.
///
/// # Errors
/// When a path does not exist, or no image is there.
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
        } else {
            files.push(path.clone());
        }
    }
    let mut named: Vec<(String, PathBuf)> = files.into_iter().map(|path| (short_name(&path), path)).collect();
    named.sort();
    named.dedup_by(|a, b| a.1 == b.1);
    if named.is_empty() {
        let shown: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
        let hint = format!("give a folder with images ({}) or image files", ENDINGS.join(", "));
        return Err(Hinted::error(format!("no images in {}", shown.join(", ")), hint));
    }
    for at in 1..named.len() {
        if named[at].0 == named[at - 1].0 {
            named[at].0 += " (2)";
        }
    }
    Ok(named)
}

/// Folder and file name.
fn short_name(path: &Path) -> String {
    let text = |part: Option<&std::ffi::OsStr>| part.map(|part| part.to_string_lossy().into_owned());
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let folder = whole.parent().and_then(|folder| text(folder.file_name()));
    let file = text(whole.file_name()).unwrap_or_default();
    folder.map_or(file.clone(), |folder| format!("{folder}/{file}"))
}

impl ImageFolder {
    /// Reads hash, size, camera and position of the named files; what is no image is skipped with its reason.
    ///
    /// # Errors
    /// When not a single file is readable.
    pub fn read(
        files: &[(String, PathBuf)],
        cameras: &CameraBook,
        geo: &GeoSource,
        masks: Option<&Path>,
    ) -> Result<Self> {
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
                image.position = image.position.or_else(|| table.find(name));
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
        Ok(folder)
    }
}

fn read_image(name: &str, path: &Path, cameras: &CameraBook, geo: &GeoSource) -> Result<SourceImage> {
    let bytes = std::fs::read(path)?;
    anyhow::ensure!(!bytes.is_empty(), "the file is empty");
    let info = stages::probe(&bytes, &stages::DecodeLimits::default()).context("not a readable image")?;
    let known =
        cameras.find(name).filter(|camera| (camera.width, camera.height) == (info.width, info.height));
    let (camera, camera_fixed, camera_source) = if let Some(camera) = known {
        (camera.clone(), true, "cameras.json".to_owned())
    } else {
        let (camera, source) = stages::guess_camera(&info);
        let fixed = camera.is_panoramic();
        (camera, fixed, source.to_string())
    };
    let exif = (*geo == GeoSource::Exif).then_some(info.metadata.gps).flatten();
    let position =
        exif.map(|gps| Wgs84 { lat: gps.lat_deg, lon: gps.lon_deg, alt: gps.alt_m.unwrap_or(0.0) });
    let position = position.filter(|place| place.is_valid());
    let hash = ContentHash::of(&bytes);
    Ok(SourceImage {
        name: name.to_owned(),
        path: path.to_owned(),
        hash,
        camera,
        camera_fixed,
        camera_source,
        position,
        mask: None,
    })
}

/// `<folder>/<file>.png`, as COLMAP names masks, or `<folder>/<stem>.png`.
fn find_mask(folder: &Path, image: &Path) -> Result<Option<(PathBuf, ContentHash)>> {
    let file = image.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let stem = image.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let path = [format!("{file}.png"), format!("{stem}.png")]
        .map(|name| folder.join(name))
        .into_iter()
        .find(|p| p.is_file());
    path.map(|path| {
        let bytes = std::fs::read(&path).with_context(|| format!("cannot read mask {}", path.display()))?;
        Ok((path, ContentHash::of(&bytes)))
    })
    .transpose()
}
