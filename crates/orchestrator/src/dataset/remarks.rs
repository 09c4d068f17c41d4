use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use setloc_features::{Camera, CameraModel, CameraSource};

use super::{CameraBook, CameraOrigin, GeoBook, GeoSource, ImageFolder, SourceImage, Truth, shared};
use crate::fingerprint::ContentHash;
use crate::stages;
use crate::text::some_of;

const FALLBACK: CameraOrigin = CameraOrigin::Guessed(CameraSource::Fallback);

impl ImageFolder {
    /// How many cameras come from where; those of unknown focal length are a warning's affair.
    pub fn camera_summary(&self) -> Option<String> {
        let mut counts: Vec<(CameraOrigin, usize)> = Vec::new();
        for image in self.images.iter().filter(|image| image.camera_origin != FALLBACK) {
            match counts.iter_mut().find(|(origin, _)| *origin == image.camera_origin) {
                Some((_, count)) => *count += 1,
                None => counts.push((image.camera_origin, 1)),
            }
        }
        let parts: Vec<String> = counts.into_iter().map(|(origin, count)| in_words(origin, count)).collect();
        (!parts.is_empty()).then(|| format!("cameras: {}", parts.join(", ")))
    }

    /// The files of the images' masks.
    pub fn mask_files(&self) -> impl Iterator<Item = &Path> {
        self.images.iter().filter_map(|image| Some(image.mask.as_ref()?.0.as_path()))
    }

    /// How many images have masks, where some have.
    pub fn mask_summary(&self) -> Option<String> {
        let masked = self.mask_files().count();
        (masked > 0).then(|| format!("masks: {masked} of {} images", self.images.len()))
    }

    /// The same with these images, of which cameras are told that were a guess: that is nothing to warn of any more.
    #[must_use]
    pub fn once_told(&self, images: Vec<SourceImage>) -> Self {
        let [guessed, still_guessed] = [&self.images, &images].map(|images| guessed_cameras(images));
        let warning = |warning: &String| {
            if guessed.as_ref() == Some(warning) { still_guessed.clone() } else { Some(warning.clone()) }
        };
        let warnings = self.warnings.iter().filter_map(warning).collect();
        Self { images, warnings, skipped: self.skipped.clone() }
    }

    /// What the set has told of cameras that were a guess, a line each.
    pub fn estimated_cameras(&self) -> Vec<String> {
        let mut cameras: Vec<(&Camera, Vec<String>)> = Vec::new();
        for image in self.images.iter().filter(|image| image.camera_origin == CameraOrigin::Estimated) {
            match cameras.iter_mut().find(|(camera, _)| **camera == image.camera) {
                Some((_, photos)) => photos.push(image.name.clone()),
                None => cameras.push((&image.camera, vec![image.name.clone()])),
            }
        }
        let line = |(camera, photos): (&Camera, Vec<String>)| {
            let focal = camera.focal_length();
            format!("focal length estimated with the scene: {focal:.1} px: {}", some_of(&photos, "photos"))
        };
        cameras.into_iter().map(line).collect()
    }
}

fn in_words(origin: CameraOrigin, count: usize) -> String {
    let counted = |noun: &str| if count == 1 { format!("1 {noun}") } else { format!("{count} {noun}s") };
    match origin {
        CameraOrigin::Listed => format!("{} by cameras.json", counted("image")),
        CameraOrigin::Guessed(CameraSource::GPano) => format!("{} by GPano metadata", counted("panorama")),
        CameraOrigin::Guessed(CameraSource::AspectRatio) => {
            format!("{} by the 2:1 aspect ratio", counted("panorama"))
        }
        CameraOrigin::Guessed(CameraSource::ExifFocal35mm) => {
            format!("{} by EXIF's 35 mm focal length", counted("photo"))
        }
        CameraOrigin::Guessed(CameraSource::ExifFocalPlane) => {
            format!("{} by EXIF's focal length and sensor resolution", counted("photo"))
        }
        CameraOrigin::Estimated => format!("{} by the scene", counted("photo")),
        CameraOrigin::Guessed(source) => format!("{}: {source}", counted("image")),
    }
}

/// What images were given with.
pub(super) struct Given<'g> {
    pub cameras: &'g CameraBook,
    pub geo: &'g GeoSource,
    pub table: &'g GeoBook,
    pub masks: Option<&'g Path>,
}

/// What is worth a warning: options that fit no image, cameras that contradict theirs or are guessed, equal images.
pub(super) fn warnings_of(images: &[SourceImage], given: &Given<'_>) -> Vec<String> {
    let warnings = [
        cameras_without_image(images, given.cameras),
        contradicted_cameras(images, given.cameras),
        shared_cameras(images, given.cameras),
        principal_points_aside(images),
        images_without_rays(images),
        guessed_cameras(images),
        other_projections(images),
        wide_photos(images),
        positions_without_image(images, given.geo, given.table),
        masks_without_image(images, given.masks),
        masks_of_another_shape(images),
        shared_masks(images),
        equal_images(images),
        illegible_paths(images),
    ];
    warnings.into_iter().flatten().collect()
}

/// Panoramas need no cameras: a file of those of photos beside it is no mistake.
fn cameras_without_image(images: &[SourceImage], cameras: &CameraBook) -> Option<String> {
    let file = cameras.file.as_deref()?;
    let is_of_others = |name: &str| file.parent().is_some_and(|folder| folder.join(name).is_file());
    let are_panoramas = images.iter().all(|image| image.camera.is_panoramic());
    if are_panoramas && cameras.first_name().is_some_and(is_of_others) {
        return None;
    }
    let found = images.iter().any(|image| cameras.find(&image.name, &image.path).is_some());
    (!found).then(|| fits_none(file, "the camera", cameras.first_name(), first_name(images)))
}

fn positions_without_image(images: &[SourceImage], geo: &GeoSource, table: &GeoBook) -> Option<String> {
    if images.iter().any(|image| image.position.is_some()) {
        return None;
    }
    match geo {
        GeoSource::None => None,
        GeoSource::Exif => Some("no image has a position in its EXIF".to_owned()),
        GeoSource::Table(file) => {
            Some(fits_none(file, "the position", table.first_name(), first_name(images)))
        }
    }
}

/// What a truth tells of no image, of those that are called so: all of it, or some poses.
pub fn truth_without_image(file: &Path, truth: &Truth, images: &BTreeSet<&str>) -> Option<String> {
    let lost: Vec<String> = truth.names().filter(|name| !images.contains(name)).map(str::to_owned).collect();
    if lost.len() == truth.names().count() {
        return Some(fits_none(file, "the pose", truth.names().next(), images.first().copied()));
    }
    let message = format!("{} has poses of no image", file.display());
    (!lost.is_empty()).then(|| format!("{message}: {}", some_of(&lost, "poses")))
}

/// One listed name and one image's, so that the difference shows.
fn fits_none(file: &Path, what: &str, listed: Option<&str>, image: Option<&str>) -> String {
    let listed = listed.map_or_else(|| "it lists none".to_owned(), |name| format!("it lists `{name}`"));
    let called = image.unwrap_or_default();
    format!("{} has {what} of no image: {listed}, an image is called `{called}`", file.display())
}

fn first_name(images: &[SourceImage]) -> Option<&str> {
    images.first().map(|image| image.name.as_str())
}

fn contradicted_cameras(images: &[SourceImage], cameras: &CameraBook) -> Option<String> {
    let file = cameras.file.as_deref()?;
    let contradicted: Vec<String> = images
        .iter()
        .filter(|image| image.camera_origin != CameraOrigin::Listed)
        .filter_map(|image| {
            let (given, actual) = (cameras.find(&image.name, &image.path)?, &image.camera);
            let [given, actual] = [given, actual].map(|camera| format!("{}×{}", camera.width, camera.height));
            Some(format!("{} is {actual}, its camera {given}", image.name))
        })
        .collect();
    let not_used = format!("{}: cameras of another size than their images are not used", file.display());
    (!contradicted.is_empty()).then(|| format!("{not_used}: {}", some_of(&contradicted, "images")))
}

/// One name that several images have is meant so where they are of one camera, and a mistake where they are not.
fn shared_cameras(images: &[SourceImage], cameras: &CameraBook) -> Option<String> {
    let file = cameras.file.as_deref()?;
    let shared = shared(images, |image| cameras.listed_name(&image.name, &image.path));
    let line = |(name, images): &(&str, Vec<String>)| {
        let (count, some) = (images.len(), some_of(images, "images"));
        format!("`{name}` names {count} images, which are told the same camera: {some}")
    };
    let lines: Vec<String> = shared.iter().map(line).collect();
    (!lines.is_empty()).then(|| format!("{}: {}", file.display(), some_of(&lines, "names")))
}

fn shared_masks(images: &[SourceImage]) -> Option<String> {
    let shared = shared(images, |image| image.mask.as_ref().map(|(path, _)| path.as_path()));
    let line = |(mask, images): &(&Path, Vec<String>)| {
        format!("{} is that of {} images: {}", mask.display(), images.len(), some_of(images, "images"))
    };
    let lines: Vec<String> = shared.iter().map(line).collect();
    (!lines.is_empty()).then(|| format!("masks of several images: {}", some_of(&lines, "masks")))
}

/// Images whose cameras `cameras.json` tells.
fn listed_cameras(images: &[SourceImage]) -> impl Iterator<Item = &SourceImage> {
    images.iter().filter(|image| image.camera_origin == CameraOrigin::Listed)
}

fn principal_points_aside(images: &[SourceImage]) -> Option<String> {
    let aside = |image: &SourceImage| {
        let center = image.camera.principal_point_aside()?;
        let (width, height) = (image.camera.width, image.camera.height);
        Some(format!("{}, {width}×{height}, has ({}, {})", image.name, center.x, center.y))
    };
    let aside: Vec<String> = listed_cameras(images).filter_map(aside).collect();
    let message = "principal points outside of their images, as only crops have them";
    (!aside.is_empty()).then(|| format!("{message}: {}", some_of(&aside, "images")))
}

/// The share of an image without rays that goes unsaid.
const WITHOUT_RAYS: f64 = 0.01;

/// Fisheyes show nothing in corners that have no rays; other lenses do.
fn images_without_rays(images: &[SourceImage]) -> Option<String> {
    let without = |image: &SourceImage| {
        let is_fisheye =
            matches!(image.camera.model, CameraModel::SimpleFisheye | CameraModel::OpencvFisheye);
        let share = 1.0 - image.camera.share_with_rays();
        (!is_fisheye && share > WITHOUT_RAYS).then(|| format!("{} {:.0} %", image.name, 100.0 * share))
    };
    let without: Vec<String> = listed_cameras(images).filter_map(without).collect();
    let message = "told distortion leaves parts of images without rays, where nothing is used";
    (!without.is_empty()).then(|| format!("{message}: {}", some_of(&without, "images")))
}

fn guessed_cameras(images: &[SourceImage]) -> Option<String> {
    let guessed = images.iter().filter(|image| image.camera_origin == FALLBACK);
    let guessed: Vec<String> = guessed.map(|image| image.name.clone()).collect();
    let message = "focal length unknown, 1.2 times the longer side assumed (--cameras gives known ones)";
    (!guessed.is_empty()).then(|| format!("{message}: {}", some_of(&guessed, "photos")))
}

/// Images whose cameras nobody told and that are not taken for panoramas.
fn guessed_photos(images: &[SourceImage]) -> impl Iterator<Item = &SourceImage> {
    let is_guess = |image: &&SourceImage| matches!(image.camera_origin, CameraOrigin::Guessed(_));
    images.iter().filter(is_guess).filter(|image| !image.camera.is_panoramic())
}

fn other_projections(images: &[SourceImage]) -> Option<String> {
    let stated =
        |image: &SourceImage| Some(format!("{} is {}", image.name, image.other_projection.as_ref()?));
    let stated: Vec<String> = guessed_photos(images).filter_map(stated).collect();
    let message = "GPano states other projections than the equirectangular one, and the images are taken as photos, wrong \
                   if they are none (make equirectangular panoramas of them, or leave them out)";
    (!stated.is_empty()).then(|| format!("{message}: {}", some_of(&stated, "images")))
}

/// Ratio of sides above which hardly any image is a photo.
const WIDEST_PHOTO: f64 = 2.2;

/// Panoramas cut above and below, of which nothing shows how much is missing where.
fn wide_photos(images: &[SourceImage]) -> Option<String> {
    let is_wide = |image: &&SourceImage| {
        f64::from(image.camera.width) > WIDEST_PHOTO * f64::from(image.camera.height)
            && image.other_projection.is_none()
    };
    let wide: Vec<&SourceImage> = guessed_photos(images).filter(is_wide).collect();
    let Camera { width, height, .. } = wide.first()?.camera;
    let names: Vec<String> = wide.iter().map(|image| image.name.clone()).collect();
    let (sphere, cut) = (width / 2, (width / 2).saturating_sub(height) / 2);
    Some(format!(
        "wider than {WIDEST_PHOTO}:1 and taken as photos: {} (of panoramas that are cut, --cameras has to tell what is \
         missing: {{\"model\": \"EQUIRECTANGULAR\", \"width\": {width}, \"height\": {height}, \"params\": [w, h, left, top]}}, \
         size of the whole sphere, and its first column and row that are there; all round, with the horizon in the middle, \
         [{width}, {sphere}, 0, {cut}])",
        some_of(&names, "images")
    ))
}

fn masks_without_image(images: &[SourceImage], masks: Option<&Path>) -> Option<String> {
    let (folder, image) = (masks?, images.first()?);
    let found = images.iter().any(|image| image.mask.is_some());
    let file = image.path.file_name().unwrap_or_default().display();
    let stem = image.path.file_stem().unwrap_or_default().display();
    let folder = folder.display();
    (!found).then(|| {
        format!("{folder} has the mask of no image: that of {} is {file}.png or {stem}.png", image.name)
    })
}

/// By how much the ratio of a mask's sides may differ from that of its image, for rounding.
const SAME_SHAPE: f64 = 0.01;

fn masks_of_another_shape(images: &[SourceImage]) -> Option<String> {
    let of_another_shape = |image: &SourceImage| {
        let bytes = std::fs::read(&image.mask.as_ref()?.0).ok()?;
        let mask = stages::probe(&bytes, &stages::DecodeLimits::default()).ok()?;
        let ratio = |width: u32, height: u32| f64::from(width) / f64::from(height);
        let (width, height) = (image.camera.width, image.camera.height);
        let differs = (ratio(mask.width, mask.height) / ratio(width, height) - 1.0).abs() > SAME_SHAPE;
        differs
            .then(|| format!("{} is {width}×{height}, its mask {}×{}", image.name, mask.width, mask.height))
    };
    let stretched: Vec<String> = images.iter().filter_map(of_another_shape).collect();
    let message = "masks of another aspect ratio are stretched to their images";
    (!stretched.is_empty()).then(|| format!("{message}: {}", some_of(&stretched, "images")))
}

fn equal_images(images: &[SourceImage]) -> Option<String> {
    let mut first_of: BTreeMap<ContentHash, &str> = BTreeMap::new();
    let mut pairs = Vec::new();
    for image in images {
        match first_of.get(&image.hash) {
            Some(first) => pairs.push(format!("{first} and {}", image.name)),
            None => drop(first_of.insert(image.hash, &image.name)),
        }
    }
    (!pairs.is_empty()).then(|| format!("images of equal content: {}", some_of(&pairs, "pairs")))
}

/// Where a scene's images are is noted beside it, as text.
fn illegible_paths(images: &[SourceImage]) -> Option<String> {
    let is_illegible =
        |image: &&SourceImage| std::path::absolute(&image.path).is_ok_and(|path| path.to_str().is_none());
    let illegible: Vec<String> = images.iter().filter(is_illegible).map(|image| image.name.clone()).collect();
    let message =
        "paths are no UTF-8, so that it cannot be noted where these images are (rename their folders)";
    (!illegible.is_empty()).then(|| format!("{message}: {}", some_of(&illegible, "images")))
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::dataset::list_images;

    struct Folder(tempfile::TempDir);

    impl Folder {
        /// Images of one shade each, by name, width and height.
        fn of(images: &[(&str, u32, u32)]) -> Self {
            let root = tempfile::tempdir().unwrap();
            std::fs::create_dir(root.path().join("p")).unwrap();
            for (shade, (name, width, height)) in images.iter().enumerate() {
                let image = image::GrayImage::from_pixel(*width, *height, image::Luma([shade as u8]));
                image.save(root.path().join("p").join(name)).unwrap();
            }
            Self(root)
        }

        fn write(&self, name: &str, text: &str) -> PathBuf {
            let path = self.0.path().join(name);
            std::fs::write(&path, text).unwrap();
            path
        }

        fn read(&self, cameras: &CameraBook, geo: &GeoSource, masks: Option<&Path>) -> ImageFolder {
            let files = list_images(&[self.0.path().join("p")]).unwrap();
            ImageFolder::read(&files, cameras, geo, masks).unwrap()
        }

        fn read_alone(&self) -> ImageFolder {
            self.read(&CameraBook::default(), &GeoSource::None, None)
        }
    }

    fn cameras(width: u32, height: u32, images: &str) -> String {
        let (w, h) = (f64::from(width), f64::from(height));
        let lens = serde_json::json!({
            "model": "SIMPLE_PINHOLE", "width": width, "height": height, "params": [w, w / 2.0, h / 2.0]
        });
        format!("{{\"cameras\": {{\"c\": {lens}}}, \"images\": {{{images}}}}}")
    }

    #[test]
    fn it_is_said_where_cameras_come_from() {
        let folder =
            Folder::of(&[("a.png", 64, 32), ("b.png", 32, 16), ("c.png", 40, 30), ("d.png", 50, 30)]);
        let book = folder.write("cameras.json", &cameras(40, 30, "\"p/c.png\": \"c\""));
        let read = folder.read(&CameraBook::read(&book).unwrap(), &GeoSource::None, None);
        assert_eq!(
            read.camera_summary().unwrap(),
            "cameras: 2 panoramas by the 2:1 aspect ratio, 1 image by cameras.json"
        );
        assert_eq!(read.warnings.len(), 1, "{:?}", read.warnings);
        assert!(read.warnings[0].ends_with("(--cameras gives known ones): p/d.png"), "{:?}", read.warnings);
    }

    #[test]
    fn panoramas_that_are_cut_are_said_to_need_a_camera() {
        let folder = Folder::of(&[("a.png", 440, 200), ("b.png", 460, 140), ("c.png", 460, 141)]);
        let said = |read: &ImageFolder| {
            let wide = read.warnings.iter().filter(|warning| warning.starts_with("wider than 2.2:1"));
            wide.cloned().collect::<Vec<String>>()
        };
        let alone = said(&folder.read_alone());
        assert!(alone[0].contains("taken as photos: p/b.png; p/c.png (") && alone.len() == 1, "{alone:?}");
        let remedy = "\"EQUIRECTANGULAR\", \"width\": 460, \"height\": 140, \"params\": [w, h, left, top]}";
        assert!(alone[0].contains(remedy) && alone[0].ends_with("[460, 230, 0, 45])"), "{alone:?}");
        let told = r#"{"cameras": {
            "b": {"model": "EQUIRECTANGULAR", "width": 460, "height": 140, "params": [460, 230, 0, 45]},
            "c": {"model": "SIMPLE_PINHOLE", "width": 460, "height": 141, "params": [400, 230, 70]}},
            "images": {"b.png": "b", "c.png": "c"}}"#;
        let book = CameraBook::read(&folder.write("cameras.json", told)).unwrap();
        assert!(said(&folder.read(&book, &GeoSource::None, None)).is_empty());
    }

    #[test]
    fn told_cameras_that_are_odd_are_said() {
        let image = |name: &str, params: &[f64]| SourceImage {
            camera_origin: CameraOrigin::Listed,
            ..SourceImage::guessed(
                name,
                Camera { params: params.to_vec(), ..Camera::from_focal_guess(300, 200, 1.0) },
            )
        };
        let usual = image("a", &[300.0, 150.0, 100.0, -0.1, 0.0]);
        let crop = image("b", &[900.0, -40.5, 100.0, 0.0, 0.0]);
        let folded = image("c", &[300.0, 150.0, 100.0, -0.5, 0.0]);
        let images = [usual, crop, folded];
        assert!(principal_points_aside(&images).unwrap().ends_with(": b, 300×200, has (-40.5, 100)"));
        assert!(images_without_rays(&images).unwrap().contains("where nothing is used: c "));
        assert_eq!((principal_points_aside(&images[..1]), images_without_rays(&images[..1])), (None, None));
    }

    #[test]
    fn other_projections_are_named() {
        let camera = Camera::from_focal_guess(64, 32, 77.0);
        let image = |name: &str, other: Option<&str>, camera_origin| SourceImage {
            camera_origin,
            other_projection: other.map(str::to_owned),
            ..SourceImage::guessed(name, camera.clone())
        };
        let images = [
            image("a", Some("cylindrical"), FALLBACK),
            image("b", None, FALLBACK),
            image("c", Some("cylindrical"), CameraOrigin::Listed),
        ];
        assert!(other_projections(&images).unwrap().ends_with(": a is cylindrical"));
        assert_eq!(other_projections(&images[1..]), None);
    }

    #[test]
    fn cameras_that_are_told_since_are_no_guess_to_warn_of() {
        let read = Folder::of(&[("a.png", 40, 30), ("b.png", 50, 30), ("c.png", 45, 30)]).read_alone();
        assert!(read.warnings[0].ends_with(": p/a.png; p/b.png; p/c.png"), "{:?}", read.warnings);
        let with_told = |names: &[&str]| {
            let mut images = read.images.clone();
            for image in images.iter_mut().filter(|image| names.contains(&image.name.as_str())) {
                image.camera_origin = CameraOrigin::Estimated;
            }
            read.once_told(images).warnings
        };
        let one = with_told(&["p/a.png", "p/c.png"]);
        assert!(one.len() == 1 && one[0].ends_with("(--cameras gives known ones): p/b.png"), "{one:?}");
        assert_eq!(with_told(&["p/a.png", "p/b.png", "p/c.png"]), [""; 0]);
    }

    #[test]
    fn cameras_that_fit_no_image_or_not_its_size_are_said() {
        let folder = Folder::of(&[("a.png", 64, 32)]);
        let warnings = |cameras: &str| {
            let book = CameraBook::read(&folder.write("cameras.json", cameras)).unwrap();
            folder.read(&book, &GeoSource::None, None).warnings
        };
        let other = warnings(&cameras(40, 30, "\"q/a.png\": \"c\""));
        assert!(other.len() == 1 && other[0].contains("it lists `q/a.png`, an image is called `p/a.png`"));
        let smaller = warnings(&cameras(32, 16, "\"p/a.png\": \"c\""));
        assert!(
            smaller.len() == 1 && smaller[0].contains("p/a.png is 64×32, its camera 32×16"),
            "{smaller:?}"
        );
        assert!(warnings(&cameras(64, 32, "\"p/a.png\": \"c\"")).is_empty());
        assert!(warnings(&cameras(64, 32, ""))[0].contains("it lists none"));
        std::fs::create_dir(folder.0.path().join("q")).unwrap();
        folder.write("q/a.png", "a photo");
        assert!(warnings(&cameras(40, 30, "\"q/a.png\": \"c\"")).is_empty());
    }

    #[test]
    fn positions_and_masks_that_fit_no_image_are_said() {
        let folder = Folder::of(&[("a.png", 64, 32)]);
        let none = CameraBook::default();
        let table = |text: &str| {
            let table = folder.write("geo.csv", text);
            folder.read(&none, &GeoSource::Table(table), None).warnings
        };
        let other = table("name,lat,lon\npanos/a.png,47,8\n");
        assert!(other[0].contains("it lists `panos/a.png`, an image is called `p/a.png`"), "{other:?}");
        assert!(table("a.png,47,8\n").is_empty());
        let exif = folder.read(&none, &GeoSource::Exif, None).warnings;
        assert_eq!(exif, ["no image has a position in its EXIF"]);
        let masks = folder.0.path().join("masks");
        std::fs::create_dir(&masks).unwrap();
        let lost = folder.read(&none, &GeoSource::None, Some(&masks)).warnings;
        assert!(lost[0].ends_with("that of p/a.png is a.png.png or a.png"), "{lost:?}");
        image::GrayImage::new(64, 32).save(masks.join("a.png")).unwrap();
        assert!(folder.read(&none, &GeoSource::None, Some(&masks)).warnings.is_empty());
        image::GrayImage::from_pixel(64, 32, image::Luma([9])).save(folder.0.path().join("p/a.bmp")).unwrap();
        let shared = folder.read(&none, &GeoSource::None, Some(&masks)).warnings;
        assert!(shared[0].ends_with("masks/a.png is that of 2 images: p/a.bmp; p/a.png"), "{shared:?}");
    }

    #[test]
    fn it_is_said_how_many_masks_there_are_and_which_have_another_shape() {
        let folder =
            Folder::of(&[("a.png", 64, 32), ("b.png", 64, 32), ("c.png", 64, 32), ("d.png", 333, 100)]);
        let masks = folder.0.path().join("masks");
        std::fs::create_dir(&masks).unwrap();
        for (name, width, height) in [("a.png", 32, 16), ("b.png", 32, 32), ("d.png", 33, 10)] {
            image::GrayImage::new(width, height).save(masks.join(name)).unwrap();
        }
        let read = folder.read(&CameraBook::default(), &GeoSource::None, Some(&masks));
        assert_eq!(read.mask_summary().unwrap(), "masks: 3 of 4 images");
        let of_masks: Vec<&String> =
            read.warnings.iter().filter(|warning| warning.contains("mask")).collect();
        let stretched =
            "masks of another aspect ratio are stretched to their images: p/b.png is 64×32, its mask 32×32";
        assert_eq!(of_masks, [stretched]);
        assert_eq!(folder.read_alone().mask_summary(), None);
    }

    #[test]
    fn a_truth_of_no_image_is_said_and_so_are_single_poses() {
        let folder = Folder::of(&[]);
        let pose = r#"{"q_wxyz": [1, 0, 0, 0], "center": [0, 0, 0]}"#;
        let said = |images: &str| {
            let file =
                folder.write("truth.json", &format!(r#"{{"images": {{{}}}}}"#, images.replace('@', pose)));
            let names = BTreeSet::from(["p/a.png", "p/b.png"]);
            truth_without_image(Path::new("truth.json"), &Truth::read(&file).unwrap(), &names)
        };
        assert_eq!(said(r#""p/a.png": @"#), None);
        let some = "truth.json has poses of no image: q/c.png";
        assert_eq!(said(r#""p/a.png": @, "q/c.png": @"#).unwrap(), some);
        let none = "truth.json has the pose of no image: it lists `a.png`, an image is called `p/a.png`";
        assert_eq!(said(r#""a.png": @"#).unwrap(), none);
        assert!(said("").unwrap().contains("it lists none"));
    }

    #[test]
    fn a_folder_of_masks_has_to_exist() {
        let folder = Folder::of(&[("a.png", 64, 32)]);
        let files = list_images(&[folder.0.path().join("p")]).unwrap();
        let masks = folder.0.path().join("masks");
        let error = ImageFolder::read(&files, &CameraBook::default(), &GeoSource::None, Some(&masks));
        assert!(error.unwrap_err().to_string().contains("masks is no folder"));
    }

    #[test]
    fn equal_images_are_said_in_pairs() {
        let names = ["a.png", "b.png", "c.png", "d.png", "e.png", "f.png"];
        let folder = Folder::of(&names.map(|name| (name, 64, 32)));
        assert!(folder.read_alone().warnings.is_empty());
        let path = |name: &str| folder.0.path().join("p").join(name);
        std::fs::copy(path("a.png"), path("c.png")).unwrap();
        let warnings = folder.read_alone().warnings;
        assert_eq!(warnings, ["images of equal content: p/a.png and p/c.png"]);
        for name in &names[1..] {
            std::fs::copy(path("a.png"), path(name)).unwrap();
        }
        let warnings = folder.read_alone().warnings;
        assert!(warnings[0].ends_with("; p/a.png and p/d.png; 2 more pairs"), "{warnings:?}");
    }
}
