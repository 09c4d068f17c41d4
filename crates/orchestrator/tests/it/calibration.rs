//! Scenes of photos whose intrinsics nobody knows.

use crate::common::{said, setloc};
use serde_json::Value;
use setloc_town::TownParams;

/// What the cameras of `poses.json` have as focal length, and how many images are registered.
fn focal_lengths(poses: &Value) -> Vec<f64> {
    let images = poses["components"][0]["images"].as_array().unwrap();
    let registered = images.iter().filter(|image| !image["world_from_camera"].is_null());
    registered.map(|image| image["camera"]["params"][0].as_f64().unwrap()).collect()
}

#[test]
fn photos_of_unknown_intrinsics_are_mapped_again_with_the_cameras_that_they_tell() {
    let folder = tempfile::tempdir().unwrap();
    let params = TownParams {
        panoramas: 3,
        panorama_width: 256,
        photos: 6,
        photo_width: 640,
        ..TownParams::default()
    };
    setloc_town::write_dataset(&folder.path().join("town"), &params, 92).unwrap();
    let read = |file: &str| -> Value {
        serde_json::from_str(&std::fs::read_to_string(folder.path().join(file)).unwrap()).unwrap()
    };
    let cameras = read("town/cameras.json");
    let truth = &cameras["cameras"][cameras["images"]["queries/lane/img_00.jpg"].as_str().unwrap()];
    let truth = truth["params"][0].as_f64().unwrap();
    let build = |command: &'static str| {
        setloc(folder.path(), &[command, "town/queries/lane", "-o", "s.setloc", "--cache", "c"])
    };

    let planned = build("plan");
    assert!(said(&planned).contains("focal lengths are sought by photos of one spot"), "{}", said(&planned));
    let built = build("build");
    assert_eq!(built.status.code(), Some(0), "{}", said(&built));
    assert!(said(&built).contains("focal length estimated with the scene"), "{}", said(&built));
    let found = focal_lengths(&read("s/poses.json"));
    assert!(found.len() >= 5, "{}", said(&built));
    assert!(found.iter().all(|focal| (focal / truth - 1.0).abs() < 0.03), "{found:?} instead of {truth}");
    // Two models: with the guess, and with what it told.
    let log = std::fs::read_to_string(folder.path().join("s/run.jsonl")).unwrap();
    let models =
        log.lines().filter(|line| line.contains("\"finished\"") && line.contains("\"kind\":\"model\""));
    assert_eq!(models.count(), 2, "{log}");

    let again = build("build");
    assert!(said(&again).contains("nothing changed"), "{}", said(&again));
    let planned = build("plan");
    assert!(!said(&planned).contains("not listed"), "{}", said(&planned));
}
