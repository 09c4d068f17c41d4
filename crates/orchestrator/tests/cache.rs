//! What runs again after which change, asserted by job lists.

#![allow(clippy::unwrap_used, reason = "the helpers of tests, too, may fail by panicking")]

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use setloc_orchestrator::building::{BuildOutcome, Built, build_scene};
use setloc_orchestrator::config::Config;
use setloc_orchestrator::dataset::{CameraBook, GeoSource, ImageFolder, list_images};
use setloc_orchestrator::session::{Limits, Session};

/// A picture of its own for each seed: blocks of grey.
fn write_picture(path: &Path, seed: u32) {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12345);
    let mut shades = Vec::new();
    for _ in 0..64 * 32 {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        shades.push((state >> 24) as u8);
    }
    let picture =
        image::RgbImage::from_fn(256, 128, |x, y| image::Rgb([shades[((y / 4) * 64 + x / 4) as usize]; 3]));
    picture.save(path).unwrap();
}

fn panoramas(folder: &Path, count: u32) -> PathBuf {
    let panoramas = folder.join("panoramas");
    std::fs::create_dir_all(&panoramas).unwrap();
    (0..count).for_each(|i| write_picture(&panoramas.join(format!("p{i}.png")), i));
    panoramas
}

fn build(store: &Path, panoramas: &Path, config: &Config) -> Box<Built> {
    let limits = Limits { threads: 2, memory: 1 << 30 };
    let session = Session::open(store, None, limits, Arc::new(AtomicBool::new(false))).unwrap();
    let files = list_images(&[panoramas.to_owned()]).unwrap();
    let folder = ImageFolder::read(&files, &CameraBook::default(), &GeoSource::None, None).unwrap();
    match build_scene(&session, &folder, config, 7, "test", None).unwrap() {
        BuildOutcome::Built(built) => built,
        BuildOutcome::Unchanged(..) => panic!("no present hash was given"),
    }
}

fn ran<'b>(built: &'b Built, kind: &str) -> Vec<&'b str> {
    built.run.ran.iter().filter_map(|job| job.strip_prefix(kind)?.strip_prefix(' ')).collect()
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { files.extend(files_below(&path)) } else { files.push(path) }
    }
    files.sort();
    files
}

#[test]
fn second_run_does_no_work_and_gives_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let images = panoramas(folder.path(), 4);
    let first = build(&folder.path().join("store"), &images, &Config::default());
    let second = build(&folder.path().join("store"), &images, &Config::default());
    assert_eq!(ran(&first, "features").len(), 4);
    assert!(second.run.ran.is_empty(), "{:?}", second.run.ran);
    assert_eq!(first.hash, second.hash);
}

#[test]
fn a_changed_parameter_runs_only_what_depends_on_it() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 3), folder.path().join("store"));
    build(&store, &images, &Config::default());
    let mut config = Config::default();
    config.two_view.min_inliers += 5;
    let built = build(&store, &images, &config);
    assert!(ran(&built, "features").is_empty() && ran(&built, "matches").is_empty(), "{:?}", built.run.ran);
    assert_eq!(ran(&built, "verify").len(), 3);
    // The scene file names its configuration; nothing else may follow from verifications that came out the same.
    assert_eq!(ran(&built, "scene").len(), 1);
}

#[test]
fn a_replaced_panorama_redoes_its_own_features_and_pairs_only() {
    let folder = tempfile::tempdir().unwrap();
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    build(&store, &images, &Config::default());
    write_picture(&images.join("p2.png"), 99);
    let built = build(&store, &images, &Config::default());
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
    std::fs::rename(images.join("p3.png"), images.join("q.png")).unwrap();
    let built = build(&store, &images, &Config::default());
    assert_eq!(built.run.ran, ["scene scene"]);
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
    let (images, store) = (panoramas(folder.path(), 3), folder.path().join("store"));
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
    let (images, store) = (panoramas(folder.path(), 4), folder.path().join("store"));
    let hashes = std::thread::scope(|scope| {
        let runs: Vec<_> =
            (0..2).map(|_| scope.spawn(|| build(&store, &images, &Config::default()).hash)).collect();
        runs.into_iter().map(|run| run.join().unwrap()).collect::<Vec<_>>()
    });
    assert_eq!(hashes[0], hashes[1]);
    assert!(build(&store, &images, &Config::default()).run.ran.is_empty());
}
