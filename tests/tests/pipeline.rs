//! The whole path on data with truth.

#![allow(clippy::unwrap_used, reason = "the helpers of tests, too, may fail by panicking")]

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

use setloc_camset::{PhotoLocalization, Verdict};
use setloc_features::Calibration;
use setloc_orchestrator::bench::{BenchGps, BenchOptions, DatasetFigures, bench_dataset};
use setloc_orchestrator::building::{BuildOutcome, Built, SceneSource, build_scene};
use setloc_orchestrator::config::Config;
use setloc_orchestrator::dataset::{CameraBook, GeoSource, ImageFolder, list_images};
use setloc_orchestrator::jobs::LocateJobs;
use setloc_orchestrator::locating::{Mode, grow, locate};
use setloc_orchestrator::session::{Limits, Session};
use setloc_orchestrator::stages;
use setloc_orchestrator::turning::guess_by_turns;
use setloc_town::{TownParams, write_dataset};
use tempfile::TempDir;

fn bench(dataset: &Path) -> DatasetFigures {
    bench_with(dataset, Config::default())
}

fn bench_with(dataset: &Path, config: Config) -> DatasetFigures {
    bench_in(tempfile::tempdir().unwrap().path(), dataset, &BenchOptions { config, ..bench_options() })
}

fn bench_in(store: &Path, dataset: &Path, options: &BenchOptions) -> DatasetFigures {
    bench_dataset(&session(store), dataset, options).unwrap()
}

fn bench_options() -> BenchOptions {
    BenchOptions { config: Config::default(), seed: 0, gps: BenchGps::None, joint_reference: false }
}

fn session(store: &Path) -> Session {
    let limits = Limits { threads: 2, memory: 4 << 30 };
    Session::open(store, None, limits, Arc::new(AtomicBool::new(false))).unwrap()
}

fn built(session: &Session, panoramas: &ImageFolder, config: &Config) -> Box<Built> {
    let source = SceneSource { folder: panoramas, config, seed: 0, name: "scene", present: None };
    match build_scene(session, source, |_| Ok(())).unwrap() {
        BuildOutcome::Built(built) => built,
        BuildOutcome::Unchanged(..) => panic!("no present hash was given"),
    }
}

/// Scene whole and right; the target fails alone and is found by its set.
fn assert_main_job(figures: &DatasetFigures) {
    let scene = &figures.scene;
    assert_eq!((scene.registered, scene.components), (scene.images, 1), "{scene:?}");
    // The panoramas of a street stand nearly on a line, about which centres alone leave the roll of the alignment to
    // their noise; the rotations aligned by themselves have no such freedom.
    let (position, rotation) = (scene.position_m.unwrap(), scene.rotation_own_deg.unwrap());
    assert!(position.median < 0.05 && rotation.median < 0.1, "{position:?} {rotation:?}");
    for set in &figures.sets {
        let (single, refined) = (&set.methods["single"], &set.methods["camset+opt"]);
        assert!(
            refined.registered * 10 >= set.images * 9,
            "{}: {} of {}",
            set.name,
            refined.registered,
            set.images
        );
        assert!(single.registered < refined.registered, "{}", set.name);
        let (position, rotation) = (refined.position_m.unwrap(), refined.rotation_deg.unwrap());
        assert!(position.median < 0.3 && rotation.median < 0.5, "{}: {position:?} {rotation:?}", set.name);
        assert!(refined.target_registered && !single.target_registered, "{}", set.name);
    }
}

/// The sample town, rendered once for all tests, which only read it.
fn sample() -> &'static Path {
    static SAMPLE: OnceLock<PathBuf> = OnceLock::new();
    SAMPLE.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("sample");
        if folder.exists() {
            std::fs::remove_dir_all(&folder).unwrap();
        }
        stages::write_sample(&folder).unwrap();
        folder
    })
}

/// A store of one's own that holds the sample's scene and where its sets are, which are made once for all tests.
fn store_of_sample() -> TempDir {
    static STORE: OnceLock<PathBuf> = OnceLock::new();
    let built = STORE.get_or_init(|| {
        let store = Path::new(env!("CARGO_TARGET_TMPDIR")).join("store");
        if store.exists() {
            std::fs::remove_dir_all(&store).unwrap();
        }
        bench_in(&store, sample(), &bench_options());
        store
    });
    let store = tempfile::tempdir().unwrap();
    copy_files(built, store.path());
    store
}

/// Images of the sample, whose cameras are told or not.
fn sample_images(part: &str, told: bool) -> ImageFolder {
    let cameras =
        if told { CameraBook::read(&sample().join("cameras.json")).unwrap() } else { CameraBook::default() };
    let files = list_images(&[sample().join(part)]).unwrap();
    ImageFolder::read(&files, &cameras, &GeoSource::None, None).unwrap()
}

#[test]
fn the_town_is_mapped_and_its_set_located() {
    let figures = bench_in(store_of_sample().path(), sample(), &bench_options());
    assert!(!figures.sets.is_empty());
    assert_main_job(&figures);
}

#[test]
fn a_set_without_truth_is_compared_with_a_reconstruction_of_scene_and_photos_together() {
    let folder = tempfile::tempdir().unwrap();
    copy_files(sample(), folder.path());
    std::fs::remove_file(folder.path().join("truth.json")).unwrap();
    let options = BenchOptions { joint_reference: true, ..bench_options() };
    let figures = bench_in(store_of_sample().path(), folder.path(), &options);
    let joint = figures.joint_reference.as_ref().unwrap();
    let photos: usize = figures.sets.iter().map(|set| set.images).sum();
    assert_eq!((joint.scene_images, joint.photos), (figures.scene.images, photos));
    for set in &figures.sets {
        let refined = &set.methods["camset+opt"];
        let (position, rotation) = (refined.position_m.unwrap(), refined.rotation_deg.unwrap());
        let share = position.median / joint.extent;
        assert!(share < 0.005 && rotation.median < 0.2, "{}: {share} {rotation:?}", set.name);
    }
}

#[test]
fn a_set_of_unknown_intrinsics_is_located_and_tells_them() {
    let store = store_of_sample();
    let session = session(store.path());
    let config = Config::default();
    let built = built(&session, &sample_images("panoramas", true), &config);
    let what = LocateJobs { scene: Arc::clone(&built.scene), pictures: Arc::default(), config, seed: 0 };
    let mut by_cameras = [true, false].map(|told| sample_images("queries/lane", told));
    let truth = by_cameras[0].images[0].camera.clone();
    let guess = by_cameras[1].images[0].camera.clone();
    assert!((guess.focal_length() / truth.focal_length() - 1.0).abs() > 0.2, "{guess:?} {truth:?}");
    let name = by_cameras[0].images.last().unwrap().name.clone();
    let [by_known, by_guess] = by_cameras.each_mut().map(|photos| {
        let set = locate(&session, photos, &what, Mode::Set, "set", &name).unwrap().set.unwrap();
        let target = set.refined.iter().find(|photo| photo.name == name).unwrap();
        assert_eq!(target.verdict, Verdict::Localized, "{:?}", target.reasons);
        target.clone()
    });
    let pose = |photo: &PhotoLocalization| photo.world_from_camera.unwrap();
    let apart = (pose(&by_known).translation - pose(&by_guess).translation).norm();
    let images = &built.scene.main().unwrap().images;
    let extent = (pose(&by_known).translation - images[0].world_from_camera.unwrap().translation).norm();
    assert!(apart < 0.02 * extent, "{apart} of {extent}");
    let estimated = &by_guess.camera;
    assert!((estimated.focal_length() / truth.focal_length() - 1.0).abs() < 0.01, "{estimated:?} {truth:?}");
    // What scenes grow by, and who asks later, has these cameras.
    assert!(by_cameras[1].images.iter().all(|photo| photo.calibration == Calibration::Estimated));
    assert!(by_cameras[0].images.iter().all(|photo| photo.calibration == Calibration::Known));
}

#[test]
fn photos_localized_earlier_localize_one_that_the_panoramas_do_not() {
    let store = store_of_sample();
    let session = session(store.path());
    let config = Config::default();
    let built = built(&session, &sample_images("panoramas", true), &config);
    let mut bridging = sample_images("queries/lane", true);
    // The last one stands too far on for those before it, too.
    bridging.images.pop();
    let mut target =
        ImageFolder { images: bridging.images.pop().into_iter().collect(), ..ImageFolder::default() };
    let (name, last_one) = (target.images[0].name.clone(), target.images.clone());
    let mut alone = |scene| {
        let what = LocateJobs { scene, pictures: Arc::default(), config: config.clone(), seed: 0 };
        locate(&session, &mut target, &what, Mode::Single, "alone", &name).unwrap().single[0].clone()
    };
    assert_ne!(alone(Arc::clone(&built.scene)).verdict, Verdict::Localized);

    let what = LocateJobs {
        scene: Arc::clone(&built.scene),
        pictures: Arc::default(),
        config: config.clone(),
        seed: 0,
    };
    let last = bridging.images.last().unwrap().name.clone();
    let located = locate(&session, &mut bridging, &what, Mode::Both, "set", &last).unwrap();
    let grown = grow(&session, &bridging, &what, ("grow", &last), &located).unwrap().unwrap();
    assert_eq!(grown.scene.grown.len(), bridging.images.len());
    assert_ne!(grown.scene.content, built.scene.content);
    let found = alone(Arc::clone(&grown.scene));
    assert_eq!(found.verdict, Verdict::Localized, "{:?}", found.reasons);

    // With its set, in the scene as it was, it stands at the same place.
    bridging.images.extend(last_one);
    let by_set = locate(&session, &mut bridging, &what, Mode::Set, "whole", &name).unwrap().set.unwrap();
    let by_set = by_set.refined.iter().find(|photo| photo.name == name).unwrap();
    let pose = |photo: &PhotoLocalization| photo.world_from_camera.unwrap();
    let apart = (pose(&found).translation - pose(by_set).translation).norm();
    let baseline = (pose(&found).translation
        - grown.scene.main().unwrap().images[0].world_from_camera.unwrap().translation)
        .norm();
    assert!(apart < 0.01 * baseline, "{apart} of {baseline}");
}

/// A data set that is not ours, beside the project; says that a test is skipped where it is not there.
#[allow(clippy::print_stdout, reason = "tests may print, and so may their helpers")]
fn shared(name: &str) -> Option<PathBuf> {
    let dataset = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
    let is_there = dataset.join("cameras.json").is_file();
    if !is_there {
        println!("skipped: {} is not present", dataset.display());
    }
    is_there.then_some(dataset)
}

#[test]
fn the_small_rendered_street_is_mapped_and_its_set_located() {
    let Some(dataset) = shared("small") else { return };
    assert_main_job(&bench(&dataset));
}

/// Of these photos along a wall one sees the scene by keypoints; two of its neighbours show a slice of a façade across the street.
///
/// They were cut from panoramas of the scene's camera, ahead and behind, and told the focal length of plain ones. The scene
/// finds its panoramas stretched by 0.35 %, so 1250 px are 1258.7 across and 1254.4 down.
#[test]
fn a_real_set_of_which_one_standpoint_sees_the_scene_gets_its_scale_from_a_facade() {
    let Some(dataset) = shared("lzr") else { return };
    let folder = tempfile::tempdir().unwrap();
    for images in ["panoramas", "queries"] {
        copy_files(&dataset.join(images), &folder.path().join(images));
    }
    let cameras = std::fs::read_to_string(dataset.join("cameras.json")).unwrap();
    let mut cameras: serde_json::Value = serde_json::from_str(&cameras).unwrap();
    cameras["cameras"]["back"]["params"] = serde_json::json!([1258.7, 1254.4, 800.0, 600.0]);
    std::fs::write(folder.path().join("cameras.json"), cameras.to_string()).unwrap();
    let store = tempfile::tempdir().unwrap();
    let session = session(store.path());
    // How well each photo's centre is known, in units of which the panoramas span six.
    let deviations = |scale_by_walls: bool| -> Vec<f64> {
        let mut config = Config::default();
        config.camset.scale_by_walls = scale_by_walls;
        let options = BenchOptions { config, ..bench_options() };
        let figures = bench_dataset(&session, folder.path(), &options).unwrap();
        let deviation = |photo: &PhotoLocalization| {
            let variance = photo.covariance.map(|covariance| covariance.fixed_view::<3, 3>(3, 3).trace());
            photo.world_from_camera.and(variance).map_or(f64::INFINITY, f64::sqrt)
        };
        figures.sets[0].methods["camset+opt"].answers.iter().map(deviation).collect()
    };
    let (by_keypoints, by_walls) = (deviations(false), deviations(true));
    // The first standpoint sees the scene itself; from the fifth on distances rest on planes that go on.
    for (photo, (keypoints, walls)) in by_keypoints.iter().zip(&by_walls).enumerate().take(8).skip(2) {
        assert!(
            *walls < 0.05 && *walls < 0.75 * keypoints,
            "{photo}: {walls} with walls, {keypoints} without"
        );
    }
}

/// Two photos of each standpoint, of which panoramas and each other tell little.
#[test]
fn real_photos_turned_on_one_spot_tell_their_focal_length() {
    let Some(dataset) = shared("lzr") else { return };
    let store = tempfile::tempdir().unwrap();
    let files = list_images(&[dataset.join("queries/back")]).unwrap();
    let read = ImageFolder::read(&files, &CameraBook::default(), &GeoSource::None, None).unwrap();
    let (mut photos, config) = (read.images, Config::default());
    let params = (&config.photo_features(), &config);
    guess_by_turns(&session(store.path()), "back", &mut photos, &[], params, 0).unwrap();
    for photo in &photos {
        let focal = photo.camera.focal_length();
        assert!((focal / 1250.0 - 1.0).abs() < 0.005, "{}: {focal}", photo.name);
        assert_eq!(photo.calibration, Calibration::Guessed);
    }
}

fn copy_files(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy_files(&entry.path(), &to);
        } else {
            std::fs::copy(entry.path(), &to).unwrap();
        }
    }
}

#[test]
fn photos_between_panoramas_that_share_little_are_placed_by_what_each_shows() {
    let folder = tempfile::tempdir().unwrap();
    let params = TownParams {
        seed: 8305,
        panoramas: 3,
        panorama_step_m: 9.0,
        panorama_width: 1024,
        photos: 3,
        photo_width: 1024,
        sensor_noise: 6.0,
        ..TownParams::default()
    };
    write_dataset(folder.path(), &params, 90).unwrap();
    let refined = |max_images: usize| {
        let mut config = Config::default();
        config.camset.views.max_images = max_images;
        // With these points are enough.
        config.second_look.enabled = false;
        config.camset.scale_by_walls = false;
        let mut figures = bench_with(folder.path(), config);
        figures.sets[0].methods.remove("camset+opt").unwrap()
    };
    let by_points = refined(0);
    assert!(!by_points.target_registered && by_points.registered <= 1, "the points alone do: {by_points:?}");
    let by_views = refined(48);
    assert!(by_views.registered >= 2, "{by_views:?}");
    let (position, rotation) = (by_views.position_m.unwrap(), by_views.rotation_deg.unwrap());
    assert!(position.max < 0.1 && rotation.max < 0.5, "{position:?} {rotation:?}");
}

#[test]
fn a_street_is_mapped_round_a_corner_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let params =
        TownParams { seed: 108, panoramas: 14, panorama_step_m: 10.0, photos: 0, ..TownParams::default() };
    write_dataset(folder.path(), &params, 90).unwrap();
    // The last three stand in a lane, and see of the eleven before the corner what the lane's mouth leaves.
    let scene = bench(folder.path()).scene;
    assert_eq!((scene.registered, scene.components), (14, 1), "{scene:?}");
    let (position, rotation) = (scene.position_m.unwrap(), scene.rotation_own_deg.unwrap());
    assert!(position.max < 0.2 && rotation.max < 0.3, "{position:?} {rotation:?}");
}
