//! What runs again after which change, asserted by job lists.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use setloc_features::FeatureParams;
use setloc_orchestrator::building::{BuildOutcome, Built, SceneSource, build_scene};
use setloc_orchestrator::config::{Config, PairParams, SecondLookParams};
use setloc_orchestrator::dataset::{CameraBook, GeoSource, ImageFolder, list_images};
use setloc_orchestrator::jobs::LocateJobs;
use setloc_orchestrator::locating::{Mode, locate};
use setloc_orchestrator::session::{Limits, Session};
use setloc_town::TownParams;

use crate::common::{
    files_below, gave, logged, panoramas, program, said, setloc, small_town, town, write_picture,
};

fn build(store: &Path, panoramas: &Path, config: &Config) -> Box<Built> {
    let limits = Limits { threads: 2, memory: 1 << 30 };
    let session = Session::open(store, None, limits, Arc::new(AtomicBool::new(false))).unwrap();
    let files = list_images(&[panoramas.to_owned()]).unwrap();
    let folder = ImageFolder::read(&files, &CameraBook::default(), &GeoSource::None, None).unwrap();
    let source = SceneSource { folder: &folder, config, seed: 7, name: "test", present: None };
    match build_scene(&session, source, |_| Ok(())).unwrap() {
        BuildOutcome::Built(built) => built,
        BuildOutcome::Unchanged(..) => panic!("no present hash was given"),
    }
}

fn ran<'b>(built: &'b Built, kind: &str) -> Vec<&'b str> {
    built.run.ran.iter().filter_map(|job| job.strip_prefix(kind)?.strip_prefix(' ')).collect()
}

/// Pictures that show nothing in common would be looked at twice.
fn one_pass() -> Config {
    let second_look = SecondLookParams { enabled: false, ..SecondLookParams::default() };
    Config { second_look, ..Config::default() }
}

#[test]
fn second_run_does_no_work_and_gives_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let images = panoramas(folder.path(), 4);
    let first = build(&folder.path().join("store"), &images, &one_pass());
    let second = build(&folder.path().join("store"), &images, &one_pass());
    assert_eq!(ran(&first, "features").len(), 4);
    assert!(second.run.ran.is_empty(), "{:?}", second.run.ran);
    assert_eq!(first.hash, second.hash);
}

#[test]
fn a_changed_parameter_runs_only_what_depends_on_it() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 3), folder.path().join("store"));
    build(&store, &images, &one_pass());
    let mut config = one_pass();
    config.two_view.min_inliers += 5;
    let built = build(&store, &images, &config);
    assert!(ran(&built, "features").is_empty() && ran(&built, "matches").is_empty(), "{:?}", built.run.ran);
    assert_eq!(ran(&built, "verify").len(), 3);
    // The scene file names its configuration; nothing else may follow from verifications that came out the same.
    assert_eq!(ran(&built, "scene").len(), 1);
}

#[test]
fn images_that_look_alike_are_matched_whatever_they_are_called() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    let pairs = PairParams { exhaustive_up_to: 2, window: 0, nearest: 0, alike: 3 };
    let mut config = Config { pairs, ..one_pass() };
    let first = build(&store, &images, &config);
    assert_eq!((ran(&first, "features").len(), ran(&first, "likely").len()), (4, 1), "{:?}", first.run.ran);
    assert_eq!((ran(&first, "matches").len(), first.run.hits), (6, 0), "{:?}", first.run.ran);
    assert!(build(&store, &images, &config).run.ran.is_empty());
    // The other way round, by name.
    let mut names: Vec<_> = std::fs::read_dir(&images).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    for (at, path) in names.iter().enumerate() {
        let ending = path.extension().unwrap().to_str().unwrap();
        std::fs::rename(path, images.join(format!("z{}.{ending}", 9 - at))).unwrap();
    }
    let renamed = build(&store, &images, &config);
    let kinds: BTreeSet<&str> = renamed.run.ran.iter().filter_map(|label| label.split(' ').next()).collect();
    assert_eq!(kinds, BTreeSet::from(["scene"]), "{:?}", renamed.run.ran);
    config.pairs.alike = 0;
    let without = build(&store, &images, &config);
    assert!(ran(&without, "matches").is_empty() && without.scene.main().is_none());
}

#[test]
fn a_torn_scene_is_looked_at_once_more() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let street = TownParams { panoramas: 5, panorama_step_m: 7.0, seed: 2, ..small_town() };
    setloc_town::write_dataset(&folder.path().join("town"), &street, 92).unwrap();
    let panoramas = folder.path().join("town/panoramas");
    let few = FeatureParams { max_features: 400, min_features: 0, ..FeatureParams::default() };
    let once = build(&store, &panoramas, &Config { features: few.clone(), ..one_pass() });
    let registered = |built: &Built| built.scene.main().map_or(0, |model| model.registered().count());
    assert!(registered(&once) < 3, "the scene must be torn for this test to say anything");
    let config = Config { features: few, ..Config::default() };
    let store = folder.path().join("another store");
    let twice = build(&store, &panoramas, &config);
    assert!(registered(&twice) >= 3, "{}", registered(&twice));
    // The model that does not stay is not finished.
    assert_eq!((ran(&twice, "model").len(), ran(&twice, "aligned").len()), (2, 1), "{:?}", twice.run.ran);
    assert!(build(&store, &panoramas, &config).run.ran.is_empty());
}

#[test]
fn the_first_model_stays_where_a_second_look_tells_no_more() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    let first = build(&store, &images, &Config::default());
    assert_eq!(ran(&first, "features").len(), 8, "{:?}", first.run.ran);
    let again = build(&store, &images, &Config::default());
    assert!(again.run.ran.is_empty() && again.hash == first.hash, "{:?}", again.run.ran);
    let once = build(&store, &images, &one_pass());
    let kinds: BTreeSet<&str> = once.run.ran.iter().filter_map(|label| label.split(' ').next()).collect();
    // The scene file names its configuration.
    assert_eq!(kinds, BTreeSet::from(["scene"]), "{:?}", once.run.ran);
}

/// Builds the town's scene and locates its set in it; the labels of the jobs that ran.
fn build_and_locate(folder: &Path, config: &Config) -> Vec<String> {
    let (town, log) = (folder.join("town"), folder.join("run.jsonl"));
    let limits = Limits { threads: 2, memory: 1 << 30 };
    let stop = Arc::new(AtomicBool::new(false));
    let session = Session::open(&folder.join("store"), Some(&log), limits, stop).unwrap();
    let cameras = CameraBook::read(&town.join("cameras.json")).unwrap();
    let read = |part: &str| {
        let files = list_images(&[town.join(part)]).unwrap();
        ImageFolder::read(&files, &cameras, &GeoSource::None, None).unwrap()
    };
    let folder = read("panoramas");
    let source = SceneSource { folder: &folder, config, seed: 7, name: "scene", present: None };
    let built = match build_scene(&session, source, |_| Ok(())).unwrap() {
        BuildOutcome::Built(built) => built,
        BuildOutcome::Unchanged(..) => panic!("no present hash was given"),
    };
    assert!(built.scene.main().is_some(), "the small town must be mapped for this test to say anything");
    let what = LocateJobs { scene: built.scene, pictures: Arc::default(), config: config.clone(), seed: 7 };
    let mut photos = read("queries/lane");
    let target = photos.images.last().unwrap().name.clone();
    locate(&session, &mut photos, &what, Mode::Both, "lane", &target).unwrap();
    logged(&log, "finished")
}

/// The kinds among labels, each once.
fn kinds(labels: &[String]) -> BTreeSet<&str> {
    labels.iter().filter_map(|label| label.split(' ').next()).collect()
}

#[test]
fn each_stage_s_parameter_runs_exactly_what_depends_on_it() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let first = build_and_locate(folder.path(), &Config::default());
    let all = [
        "aligned",
        "camset",
        "carried",
        "features",
        "index",
        "left_apart",
        "local_model",
        "matches",
        "model",
        "nearest",
        "scene",
        "single",
        "verify",
    ];
    assert_eq!(kinds(&first), BTreeSet::from(all));
    assert_eq!(build_and_locate(folder.path(), &Config::default()), [""; 0]);
    let after = |settings: &[&str]| {
        let settings: Vec<String> = settings.iter().map(|&setting| setting.to_owned()).collect();
        build_and_locate(folder.path(), &Config::resolve(None, &settings).unwrap())
    };
    assert_eq!(after(&["camset.ratio=0.65"]), ["camset lane/img_03.jpg"]);
    assert_eq!(kinds(&after(&["single.ratio=0.65"])), BTreeSet::from(["single", "camset"]));
    let bundle = after(&["sfm.loss_sigma=1.5"]);
    assert_eq!(
        kinds(&bundle),
        BTreeSet::from([
            "model",
            "aligned",
            "left_apart",
            "local_model",
            "index",
            "scene",
            "nearest",
            "single",
            "camset"
        ])
    );
    let features = after(&["features.max_features=300"]);
    assert_eq!(kinds(&features), BTreeSet::from(all));
    assert_eq!(features.len(), first.len());
}

#[test]
fn a_replaced_panorama_redoes_its_own_features_and_pairs_only() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    build(&store, &images, &one_pass());
    write_picture(&images.join("p2.png"), 99);
    let built = build(&store, &images, &one_pass());
    assert_eq!(ran(&built, "features"), ["panoramas/p2.png"]);
    let foreign = |job: &&str| !job.contains("panoramas/p2.png");
    assert!(!ran(&built, "matches").iter().any(foreign), "{:?}", built.run.ran);
    assert!(!ran(&built, "verify").iter().any(foreign), "{:?}", built.run.ran);
}

#[test]
fn a_removed_or_added_panorama_keeps_the_others_work() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    build(&store, &images, &Config::default());
    std::fs::rename(images.join("p1.png"), folder.path().join("aside.png")).unwrap();
    let removed = build(&store, &images, &Config::default());
    assert!(
        ran(&removed, "features").is_empty() && ran(&removed, "verify").is_empty(),
        "{:?}",
        removed.run.ran
    );
    std::fs::rename(folder.path().join("aside.png"), images.join("p1.png")).unwrap();
    let back = build(&store, &images, &Config::default());
    assert!(back.run.ran.is_empty(), "{:?}", back.run.ran);
}

#[test]
fn a_renamed_panorama_redoes_only_the_names() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    build(&store, &images, &Config::default());
    for (from, to) in [("p3.png", "q.png"), ("p0.png", "z.png")] {
        std::fs::rename(images.join(from), images.join(to)).unwrap();
        let built = build(&store, &images, &Config::default());
        assert_eq!(built.run.ran, ["scene scene"], "{from} to {to}");
    }
}

#[test]
fn a_changed_folder_of_panoramas_runs_exactly_what_follows() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (town(folder.path()).join("panoramas"), folder.path().join("store"));
    let files: Vec<String> = files_below(&images)
        .iter()
        .map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
        .collect();
    let [first, .., last] = &files[..] else { panic!("a town has panoramas") };
    let mut job_lists = Vec::new();
    let mut step = |change: &dyn Fn()| {
        change();
        job_lists.push(build(&store, &images, &one_pass()).run.ran);
    };
    let (aside, path) = (folder.path().join("aside.jpg"), |name: &str| images.join(name));
    step(&|| std::fs::rename(path(last), &aside).unwrap());
    step(&|| std::fs::rename(&aside, path(last)).unwrap());
    step(&|| {
        let pixels = image::open(path(last)).unwrap().to_rgb8();
        image::imageops::flip_horizontal(&pixels).save(path(last)).unwrap();
    });
    step(&|| std::fs::rename(path(last), path("renamed.jpg")).unwrap());
    step(&|| std::fs::remove_file(path(first)).unwrap());
    let [_, added, replaced, renamed, removed] = &job_lists[..] else { panic!("five steps were made") };
    let pairs_of = |new: &str, others: &[String]| {
        let pair = |kind: &str, other: &String| format!("{kind} panoramas/{other} panoramas/{new}");
        let mut jobs = vec![format!("features panoramas/{new}")];
        jobs.extend(others.iter().flat_map(|other| [pair("matches", other), pair("verify", other)]));
        jobs.extend(
            ["model scene", "aligned scene", "index scene", "left_apart scene", "scene scene"]
                .map(str::to_owned),
        );
        jobs.sort();
        jobs
    };
    let others = &files[..files.len() - 1];
    assert_eq!(*added, pairs_of(last, others));
    assert_eq!(*replaced, pairs_of(last, others));
    assert_eq!(*renamed, ["scene scene"]);
    assert_eq!(*removed, ["aligned scene", "index scene", "left_apart scene", "model scene", "scene scene"]);
}

#[test]
fn a_moved_store_is_as_good_as_before() {
    let folder = tempfile::tempdir().unwrap();
    let images = panoramas(folder.path(), 3);
    build(&folder.path().join("store"), &images, &Config::default());
    let elsewhere = folder.path().join("elsewhere");
    std::fs::create_dir_all(&elsewhere).unwrap();
    std::fs::rename(folder.path().join("store"), elsewhere.join("store")).unwrap();
    std::fs::rename(&images, elsewhere.join("panoramas")).unwrap();
    let built = build(&elsewhere.join("store"), &elsewhere.join("panoramas"), &Config::default());
    assert!(built.run.ran.is_empty(), "{:?}", built.run.ran);
}

#[test]
fn every_damaged_file_of_the_store_is_made_again() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (town(folder.path()).join("panoramas"), folder.path().join("store"));
    let first = build(&store, &images, &Config::default());
    for path in files_below(&store.join("objects")).into_iter().chain(files_below(&store.join("keys"))) {
        let whole = std::fs::read(&path).unwrap();
        let mut flipped = whole.clone();
        flipped[whole.len() / 2] ^= 4;
        for damaged in [flipped, whole[..whole.len() / 2].to_vec(), Vec::new()] {
            std::fs::write(&path, damaged).unwrap();
            let built = build(&store, &images, &Config::default());
            assert_eq!(built.hash, first.hash, "{}", path.display());
            assert_eq!(built.scene, first.scene, "{}", path.display());
        }
    }
}

#[test]
fn two_builds_at_once_on_one_store_are_both_right() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let build = |output: &str| {
        let arguments = ["build", "town/panoramas", "--cache", "store", "-o", output];
        let mut command = program(folder.path(), &arguments);
        command.stderr(std::process::Stdio::null()).spawn().unwrap()
    };
    for mut run in ["a.setloc", "b.setloc"].map(build) {
        assert_eq!(run.wait().unwrap().code(), Some(0));
    }
    let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    assert!(read("a.setloc") == read("b.setloc"));
    let verified = setloc(folder.path(), &["cache", "verify", "--cache", "store"]);
    assert_eq!(verified.status.code(), Some(0));
    let again = setloc(folder.path(), &["build", "town/panoramas", "--cache", "store", "-o", "c.setloc"]);
    assert!(
        said(&again).contains("\n0 jobs ran") && read("c.setloc") == read("a.setloc"),
        "{}",
        said(&again)
    );
}

#[test]
fn a_build_that_finds_its_scene_made_says_the_same_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let first = panoramas(folder.path(), 3);
    std::fs::write(first.join("text.jpg"), "this is no picture").unwrap();
    let build = |images: &str| {
        let output = setloc(folder.path(), &["build", images, "-o", "s.setloc"]);
        assert_eq!(output.status.code(), Some(1), "{}", said(&output));
        said(&output)
    };
    let (made, again) = (build("panoramas"), build("panoramas"));
    for text in [&made, &again] {
        assert!(text.contains("scene: 0/4 images could be registered"), "{text}");
        assert!(text.contains("skipped panoramas/text.jpg: "), "{text}");
        assert!(text.contains("warning: no image is registered: no two images share enough"), "{text}");
        assert!(!text.contains("is made again"), "{text}");
    }
    assert!(made.contains("wrote s.setloc and s/") && !made.contains("up to date"), "{made}");
    assert!(again.contains("s.setloc is up to date: nothing changed") && !again.contains("wrote"), "{again}");
    // Of other images nothing is registered either, but something ran.
    std::fs::write(first.join("p0.png"), std::fs::read(first.join("p1.png")).unwrap()).unwrap();
    let other = build("panoramas");
    assert!(!other.contains("up to date"), "{other}");
    let report = std::fs::read_to_string(folder.path().join("s/report.json")).unwrap();
    assert!(report.contains("images of equal content") && report.contains("text.jpg"), "{report}");
    let report = gave(&setloc(folder.path(), &["report", "s.setloc"]));
    assert!(report.contains("warning: no image is registered: ") && !report.contains("advice: "), "{report}");
}
