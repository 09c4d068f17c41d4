use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Result;
use serde_json::json;
use setloc_camset::{PhotoLocalization, Verdict};
use setloc_features::Calibration;
use setloc_sfm::{CameraId, MOST_NAMED, Reconstruction, ReconstructionImage, listed};

use super::Answer;
use super::args::LocateArgs;
use super::build::{
    export_folder, remark, scene_markers, warn, warn_skipped, write_json, write_models, write_report,
};
use super::outputs::{PAGE, PICTURE, refuse_folder, refuse_image_folder, refuse_input, refuse_same_folder};
use crate::dataset::{
    CameraBook, CameraOrigin, GeoSource, ImageFolder, SourceImage, list_images, unread_images,
};
use crate::error::Hinted;
use crate::export::{
    Marker, localizations_json, origin_json, ply, renew_colmap, scene_images_json, stated_sigma, top_view_png,
};
use crate::fingerprint::ContentHash;
use crate::jobs::{LocateJobs, how_fixed};
use crate::locating::{Located, Mode, grow, locate};
use crate::pictures::PictureBook;
use crate::print;
use crate::scene::SceneFile;
use crate::session::Session;
use crate::sources::{features_of, missing_features, stored_features};
use crate::store::{remove_files, write_atomically};
use crate::text::apart;

/// Red, for the target.
const TARGET_COLOR: [u8; 3] = [220, 30, 30];
/// Orange, for the other photos.
const PHOTO_COLOR: [u8; 3] = [240, 150, 0];
/// Violet, for photos whose poses are uncertain, the target's too.
const UNCERTAIN_COLOR: [u8; 3] = [150, 60, 200];

/// `setloc locate`
pub fn run(args: &LocateArgs) -> Result<Answer> {
    let LocatedPhotos { scene, located, answer, .. } = locate_photos(args)?;
    for (method, photo) in located.answers() {
        print::data(&line(method, photo, &scene))?;
    }
    Ok(answer)
}

/// What the localization of some photos came to.
pub struct LocatedPhotos {
    /// What they are located in.
    pub scene: Arc<SceneFile>,
    pub located: Located,
    /// Name of the photo that matters.
    pub target: String,
    /// Negative when that is not localized.
    pub answer: Answer,
}

/// Locates the photos and writes the output folder.
pub fn locate_photos(args: &LocateArgs) -> Result<LocatedPhotos> {
    let config = args.run.config()?;
    let (scene, scene_hash) = SceneFile::read_with_hash(&args.scene)?;
    let files = list_images(&args.photos)?;
    refuse_inputs(args, &files)?;
    if scene.main().is_none() {
        let hint = "build it of panoramas that share more, 3 to 10 m apart";
        return Err(Hinted::error(
            format!("{} has no images to locate photos by", args.scene.display()),
            hint,
        ));
    }
    let target = find_target(args.target.as_deref(), &files)?;
    let cameras = args.cameras.as_deref().map(CameraBook::read).transpose()?.unwrap_or_default();
    let masks = args.masks.as_deref();
    let mut photos = ImageFolder::read(&files, &cameras, &GeoSource::None, masks)?;
    photos.warnings.extend(unread_images(&args.photos, masks));
    if let Some(grown) = &args.grow {
        refuse_input(photos.mask_files(), grown)?;
    }
    remark(&photos);
    // Results of photos are kept beside the scene, where those of its images are.
    let session = args.run.session(args.run.kept_beside(&args.scene, &args.output), Some(&args.output))?;
    let book = PictureBook::read(&args.scene)?;
    let pictures = Arc::new(book.at_hand());
    let what = LocateJobs { scene: Arc::new(scene), pictures, config, seed: args.run.seed };
    let name = session.store.name_of("locate", &args.output);
    let mode = match args.mode {
        // The scene grows by all photos, whatever the target is.
        Mode::Auto if args.grow.is_some() => Mode::Both,
        mode => mode,
    };
    let (given, said) = (photos.images.clone(), photos.warnings.len());
    let located = locate(&session, &mut photos, &what, mode, &name, &target)?;
    warn(&photos.warnings[said..]);
    let answered = with_answered_cameras(&given, &located);
    let told = ImageFolder { images: given, ..photos.clone() }.once_told(answered);
    told.estimated_cameras().iter().for_each(|line| print::note(line));
    write_results(&args.output, &located, (&what.scene, scene_hash, &target), &told, &session)?;
    warn_skipped(&located.skipped);
    if let Some(note) = note_of_frame(&what.scene) {
        print::note(&format!("note: {note}"));
    }
    warn_of_scene(&what.scene.warnings);
    for advice in located.set.iter().flat_map(|set| &set.advice) {
        print::note(&format!("advice: {advice}"));
    }
    print::note(&format!("wrote {}/", args.output.display()));
    let answers = located.answers();
    let answer = answers.iter().find(|(_, photo)| photo.name == target);
    let verdict = answer.map_or(Verdict::NotLocalized, |(_, photo)| photo.verdict);
    let found = verdict == Verdict::Localized;
    let unread = located.skipped.iter().find(|skipped| skipped.name == target);
    let why =
        unread.map_or_else(String::new, |skipped| format!(", as it cannot be used: {}", skipped.reason));
    let sigma = answer.and_then(|(_, photo)| stated_sigma(photo, &what.scene));
    let sigma = sigma.map_or_else(String::new, |sigma| format!(", {sigma}"));
    print::note(&format!("target {target}: {}{sigma}{why}", verdict.in_words()));
    let grown = match &args.grow {
        Some(output) => write_grown((output, &book), &session, &photos, &what, (&target, &located))?,
        None => true,
    };
    let answer = if found && grown { Answer::Done } else { Answer::Negative };
    Ok(LocatedPhotos { scene: what.scene, located, target, answer })
}

/// The photos with the cameras of their answers, where these tell what was a guess.
fn with_answered_cameras(given: &[SourceImage], located: &Located) -> Vec<SourceImage> {
    let answers = located.answers();
    let with_camera = |given: &SourceImage| {
        let is_told = |photo: &&PhotoLocalization| {
            let was_guess = given.calibration == Calibration::Guessed && photo.camera != given.camera;
            was_guess && photo.name == given.name && photo.world_from_camera.is_some()
        };
        let told = answers.iter().map(|(_, photo)| *photo).find(is_told);
        told.map_or_else(
            || given.clone(),
            |photo| SourceImage {
                camera: photo.camera.clone(),
                camera_origin: CameraOrigin::Estimated,
                ..given.clone()
            },
        )
    };
    given.iter().map(with_camera).collect()
}

/// How well measured positions fix the frame of a scene: on the map, photos are off by that too.
fn note_of_frame(scene: &SceneFile) -> Option<String> {
    let fixed = how_fixed(scene.frame_errors_of(0)?);
    Some(format!("of the scene: measured positions place it on the map; {fixed}"))
}

/// Results may replace nothing that is read, but for the scene, which may grow in place.
fn refuse_inputs(args: &LocateArgs, files: &[(String, PathBuf)]) -> Result<()> {
    let hint = "name another folder for the results with -o";
    refuse_image_folder(&args.photos, &args.output, hint)?;
    refuse_same_folder(&export_folder(&args.scene), &args.output, hint)?;
    let Some(grown) = &args.grow else { return Ok(()) };
    refuse_folder("--grow", grown, "grown.setloc")?;
    let hint = "name the scene that has grown otherwise: its exports are in the folder of its name";
    refuse_image_folder(&args.photos, &export_folder(grown), hint)?;
    refuse_same_folder(&export_folder(grown), &args.output, hint)?;
    let photos = files.iter().map(|(_, path)| path.as_path());
    let others = [args.cameras.as_deref(), args.run.config.as_deref()];
    refuse_input(photos.chain(others.into_iter().flatten()), grown)
}

/// Writes the scene that has grown, with its exports; false when there is nothing to grow by.
fn write_grown(
    (output, book): (&Path, &PictureBook),
    session: &Session,
    photos: &ImageFolder,
    what: &LocateJobs,
    (target, located): (&str, &Located),
) -> Result<bool> {
    let name = session.store.name_of("grow", output);
    let Some(grown) = grow(session, photos, what, (&name, target), located)? else {
        let is_localized = |component: Option<usize>| {
            let in_it = |photo: &PhotoLocalization| component.is_none_or(|at| photo.component == at);
            let answers = located.answers();
            answers.iter().any(|(_, photo)| photo.verdict == Verdict::Localized && in_it(photo))
        };
        let (reason, hint) = if is_localized(Some(0)) {
            ("all photos that are localized are in the scene", "name photos that it has not grown by yet")
        } else if is_localized(None) {
            (
                "photos are localized in other components than the largest only, which alone grows",
                "build the scene with panoramas between its components",
            )
        } else {
            (
                "no photo is localized",
                "add photos that lead from the panoramas to these: the advice says where",
            )
        };
        print::note(&format!("{} is not written: {reason}", output.display()));
        print::note(&format!("hint: {hint}"));
        return Ok(false);
    };
    let export = export_folder(output);
    write_atomically(output, &grown.file)?;
    let features = stored_features(&session.store, grown.hash)?;
    write_models(&export, &grown.scene, &features)?;
    if let Some(missing) = missing_features(&grown.scene.components, &features) {
        print::note(&format!("note: {}: {missing}", export.display()));
    }
    book.write(output)?;
    write_report(&export, (&grown.scene, grown.hash), &[], &ImageFolder::default(), session)?;
    let apart = located.answers().into_iter().map(|(_, photo)| photo);
    let apart = apart.filter(|photo| photo.verdict == Verdict::Localized && photo.component > 0);
    let apart: Vec<&str> = apart.map(|photo| photo.name.as_str()).collect();
    if !apart.is_empty() {
        let why = "localized in other components than the largest, which alone grows";
        print::note(&format!("not added: {}: {why}", listed(&apart, MOST_NAMED)));
    }
    if let Some(note) = grown.scene.notes.last() {
        print::note(note);
    }
    print::note(&format!("wrote {} and {}/", output.display(), export.display()));
    Ok(true)
}

/// What the build of the scene warned of: a photo's pose is as right as the scene is.
fn warn_of_scene(warnings: &[String]) {
    const SHOWN: usize = 3;
    for warning in warnings.iter().take(SHOWN) {
        print::note(&format!("warning: of the scene: {warning}"));
    }
    if warnings.len() > SHOWN {
        print::note(&format!("warning: of the scene: {} more in poses.json", warnings.len() - SHOWN));
    }
}

/// The only photo of that name, or the last by name.
fn find_target(wanted: Option<&str>, files: &[(String, PathBuf)]) -> Result<String> {
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
    let Some(wanted) = wanted else { return Ok(names.last().copied().unwrap_or_default().to_owned()) };
    if names.contains(&wanted) {
        return Ok(wanted.to_owned());
    }
    let end = format!("/{wanted}");
    let found: Vec<&str> = names.iter().copied().filter(|name| name.ends_with(&end)).collect();
    match found[..] {
        [only] => Ok(only.to_owned()),
        [] => {
            let hint = format!("the photos are {}", names.join(", "));
            Err(Hinted::error(format!("no photo is named {wanted}"), hint))
        }
        _ => {
            let hint = format!("name its folder as well: one of {}", found.join(", "));
            Err(Hinted::error(format!("{} photos are named {wanted}", found.len()), hint))
        }
    }
}

/// Tab-separated: name, verdict, method, inliers, centre, rotation, and the component where the frame is its own.
fn line(method: &str, photo: &PhotoLocalization, scene: &SceneFile) -> String {
    let verdict = photo.verdict.in_words();
    let pose = photo.world_from_camera.as_ref().map_or_else(String::new, |pose| {
        let (c, q) = (pose.translation, pose.rotation.quaternion());
        let frame = if scene.shares_frame(photo.component) {
            String::new()
        } else {
            format!("\t{}", apart(photo.component))
        };
        format!("\t{:.4} {:.4} {:.4}\t{:.6} {:.6} {:.6} {:.6}{frame}", c.x, c.y, c.z, q.w, q.i, q.j, q.k)
    });
    format!("{}\t{verdict}\t{method}\t{}{pose}", photo.name, photo.inliers)
}

/// Poses, point cloud, COLMAP model, picture and report; `told` are the photos with the cameras of their answers.
fn write_results(
    folder: &Path,
    located: &Located,
    (scene, scene_hash, target): (&SceneFile, ContentHash, &str),
    told: &ImageFolder,
    session: &Session,
) -> Result<()> {
    // A page of other results would contradict these.
    remove_files(folder, &[PAGE])?;
    let answers = located.answers();
    let best: Vec<PhotoLocalization> = answers.iter().map(|(_, photo)| (*photo).clone()).collect();
    let set = located.set.as_ref();
    let of_set = |photos: Option<&Vec<PhotoLocalization>>| {
        localizations_json(photos.map_or(&[], Vec::as_slice), scene)
    };
    let mut photos = localizations_json(&best, scene);
    for (photo, (method, _)) in photos.as_array_mut().into_iter().flatten().zip(&answers) {
        photo["method"] = json!(method);
    }
    write_json(
        &folder.join("poses.json"),
        &json!({
            "convention": "X_world = R(q) X_camera + center; camera x right, y down, z forward; component: index in the scene's components, 0 the largest",
            "target": target, "geo_origin": origin_json(scene), "photos": photos,
            "methods": {
                "single": localizations_json(&located.single, scene),
                "camset": of_set(set.map(|set| &set.rigid)), "camset+opt": of_set(set.map(|set| &set.refined)),
            },
            "local_models": located.local_models, "advice": set.map(|set| &set.advice), "skipped": located.skipped,
            "scene_images": scene_images_json(scene), "scene_warnings": scene.warnings,
        }),
    )?;
    let empty = Reconstruction::default();
    let model = scene.main().unwrap_or(&empty);
    let mut markers = scene_markers(model, &scene.grown_names());
    // What has a frame of its own is in `poses.json` only.
    let in_frame: Vec<&PhotoLocalization> =
        best.iter().filter(|photo| scene.shares_frame(photo.component)).collect();
    markers.extend(in_frame.iter().filter_map(|photo| marker(photo, target)));
    let centres: Vec<_> =
        markers.iter().map(|marker| (marker.world_from_camera.translation, marker.color)).collect();
    write_atomically(&folder.join("points.ply"), ply(model, &centres).as_bytes())?;
    write_colmap_model(&folder.join("colmap"), (model, scene_hash), &in_frame, session)?;
    write_atomically(&folder.join(PICTURE), &top_view_png(model, &markers)?)?;
    let mut report = session.report.to_json();
    report["warnings"] = json!(told.warnings);
    let of_frame = note_of_frame(scene).into_iter();
    report["notes"] = json!(of_frame.chain(told.estimated_cameras()).collect::<Vec<_>>());
    write_json(&folder.join("report.json"), &report)
}

/// How a photo is shown in the point cloud and from above.
fn marker(photo: &PhotoLocalization, target: &str) -> Option<Marker> {
    let color = match photo.verdict {
        Verdict::Localized if photo.name == target => TARGET_COLOR,
        Verdict::Localized => PHOTO_COLOR,
        _ => UNCERTAIN_COLOR,
    };
    photo.world_from_camera.map(|world_from_camera| Marker { world_from_camera, color, directed: true })
}

/// The COLMAP model of a scene, its images with their keypoints where these are stored, and of the photos that are localized in it;
/// says what it lacks.
fn write_colmap_model(
    folder: &Path,
    (scene, scene_hash): (&Reconstruction, ContentHash),
    photos: &[&PhotoLocalization],
    session: &Session,
) -> Result<()> {
    let merged = with_photos(scene, photos);
    let features = stored_features(&session.store, scene_hash)?;
    if let Some(lack) = renew_colmap(folder, &merged, &features_of(&merged, &features))? {
        print::note(&format!("warning: no COLMAP model is written: {lack}"));
        return Ok(());
    }
    let uncertain = photos.iter().filter(|photo| photo.verdict == Verdict::Uncertain);
    let uncertain: Vec<&str> = uncertain.map(|photo| photo.name.as_str()).collect();
    if !uncertain.is_empty() {
        print::note(&format!("uncertain, and not in the COLMAP model: {}", listed(&uncertain, MOST_NAMED)));
    }
    if let Some(missing) = missing_features([scene], &features) {
        print::note(&format!("note: {missing}"));
    }
    Ok(())
}

/// A scene with the photos that are localized in it; photos of one camera share it.
fn with_photos(scene: &Reconstruction, photos: &[&PhotoLocalization]) -> Reconstruction {
    let mut merged = scene.clone();
    for photo in photos.iter().filter(|photo| photo.verdict == Verdict::Localized) {
        let known = merged.cameras.iter().position(|camera| *camera == photo.camera);
        let camera = known.unwrap_or_else(|| {
            merged.cameras.push(photo.camera.clone());
            merged.cameras.len() - 1
        });
        let camera = CameraId(camera as u32);
        // COLMAP knows images by their names.
        let is_taken = |name: &String| merged.images.iter().any(|image| image.name == *name);
        let mut free = std::iter::successors(Some(photo.name.clone()), |name| Some(format!("photos/{name}")));
        let name = free.find(|name| !is_taken(name)).unwrap_or_default();
        merged.images.push(ReconstructionImage { name, camera, world_from_camera: photo.world_from_camera });
    }
    merged
}

#[cfg(test)]
mod tests {
    use setloc_camset::SetLocalization;
    use setloc_features::Camera;
    use setloc_sfm::Rigid;

    use super::*;

    #[test]
    fn the_cameras_that_are_said_to_be_estimated_are_those_of_the_answers() {
        let camera = |focal| Camera::from_focal_guess(40, 30, focal);
        let image = |name: &str, calibration| SourceImage {
            calibration,
            camera_origin: CameraOrigin::Listed,
            ..SourceImage::guessed(name, camera(48.0))
        };
        let photo = |name: &str, verdict, focal| PhotoLocalization {
            name: name.to_owned(),
            camera: camera(focal),
            component: 0,
            world_from_camera: (verdict != Verdict::NotLocalized).then(Rigid::identity),
            covariance: None,
            inliers: 0,
            verdict,
            reasons: Vec::new(),
        };
        let [a, b, c, e] = ["a", "b", "c", "e"].map(|name| image(name, Calibration::Guessed));
        let given = [a, b, c, image("d", Calibration::Known), e];
        let single = vec![
            photo("a", Verdict::Localized, 31.0),
            photo("b", Verdict::NotLocalized, 32.0),
            photo("c", Verdict::Uncertain, 33.0),
            photo("d", Verdict::Localized, 34.0),
            photo("e", Verdict::Localized, 48.0),
        ];
        let set = SetLocalization {
            rigid: vec![photo("c", Verdict::Localized, 35.0)],
            refined: vec![photo("c", Verdict::Localized, 36.0)],
            ..SetLocalization::default()
        };
        let located = Located { single, set: Some(set), ..Located::default() };
        let told = ImageFolder { images: with_answered_cameras(&given, &located), ..ImageFolder::default() };
        let line =
            |focal: &str, photo: &str| format!("focal length estimated with the scene: {focal} px: {photo}");
        assert_eq!(told.estimated_cameras(), [line("31.0", "a"), line("36.0", "c")]);
    }

    #[test]
    fn a_model_has_the_photos_that_are_localized_and_each_camera_once() {
        let camera = |focal| Camera::from_focal_guess(40, 30, focal);
        let photo = |name: &str, verdict, focal| PhotoLocalization {
            name: name.to_owned(),
            camera: camera(focal),
            component: 0,
            world_from_camera: Some(Rigid::identity()),
            covariance: None,
            inliers: 0,
            verdict,
            reasons: Vec::new(),
        };
        let image = ReconstructionImage {
            name: "a".to_owned(),
            camera: CameraId(0),
            world_from_camera: Some(Rigid::identity()),
        };
        let scene =
            Reconstruction { cameras: vec![camera(31.0)], images: vec![image], ..Reconstruction::default() };
        let photos = [
            photo("a", Verdict::Localized, 32.0),
            photo("b", Verdict::Localized, 32.0),
            photo("c", Verdict::Uncertain, 33.0),
            photo("d", Verdict::Localized, 31.0),
        ];
        let merged = with_photos(&scene, &photos.iter().collect::<Vec<_>>());
        assert_eq!(merged.cameras, [camera(31.0), camera(32.0)]);
        let images: Vec<(&str, u32)> =
            merged.images.iter().map(|image| (image.name.as_str(), image.camera.0)).collect();
        assert_eq!(images, [("a", 0), ("photos/a", 1), ("b", 1), ("d", 0)]);
        let colors = photos.map(|photo| marker(&photo, "b").map(|marker| marker.color));
        assert_eq!(colors, [PHOTO_COLOR, TARGET_COLOR, UNCERTAIN_COLOR, PHOTO_COLOR].map(Some));
    }

    #[test]
    fn a_target_s_name_has_to_fit_one_photo() {
        let names = ["east/0.jpg", "west/0.jpg", "west/1.jpg"];
        let files = names.map(|name| (name.to_owned(), PathBuf::from(name)));
        let find = |wanted| find_target(wanted, &files);
        assert_eq!(find(None).unwrap(), "west/1.jpg");
        assert_eq!(find(Some("1.jpg")).unwrap(), "west/1.jpg");
        assert_eq!(find(Some("west/0.jpg")).unwrap(), "west/0.jpg");
        let error = find(Some("0.jpg")).unwrap_err();
        let hint = error.downcast_ref::<Hinted>().unwrap().hint();
        assert!(error.to_string().contains("2 photos are named 0.jpg"), "{error}");
        assert!(hint.ends_with("east/0.jpg, west/0.jpg"), "{hint}");
        assert!(find(Some("t/1.jpg")).unwrap_err().to_string().contains("no photo is named t/1.jpg"));
    }
}
