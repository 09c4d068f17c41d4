//! The benchmark harness: registry, repeats, baseline, page.

use std::path::Path;

use crate::common::{gave, said, setloc, town};
use serde_json::{Value, json};

const REGISTRY: &str = r#"
[[dataset]]
name = "lane"
path = "town"
truth = "exact"
licence = "MIT"
[[dataset]]
name = "elsewhere"
path = "not/here"
truth = "none"
licence = "secret"
[[parameters]]
name = "default"
[[parameters]]
name = "dlt"
settings = ["camset.method=dlt"]
"#;

fn json_of(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn the_registry_is_run_compared_with_its_baseline_and_shown() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    std::fs::create_dir(folder.path().join("benchmarks")).unwrap();
    std::fs::write(folder.path().join("benchmarks/datasets.toml"), REGISTRY).unwrap();
    let bench = |more: &[&str]| {
        setloc(folder.path(), &[&["bench", "--data", ".", "--cache", "store", "-o", "out"], more].concat())
    };
    let first = bench(&["--repeats", "2", "--update-baseline"]);
    assert_eq!(first.status.code(), Some(0), "{}", said(&first));
    assert!(gave(&first).contains("Skipped elsewhere: ./not/here is not present"), "{}", gave(&first));

    let results = json_of(&folder.path().join("out/results.json"));
    assert_eq!(results["seeds"], json!([0, 1]));
    let names: Vec<&Value> = results["runs"].as_array().unwrap().iter().map(|run| &run["run"]).collect();
    assert_eq!(names, ["lane/default", "lane/dlt"]);
    let registered = &results["runs"][0]["metrics"]["scene/registered"];
    assert_eq!(*registered, json!({ "mean": 4.0, "deviation": 0.0, "repeats": 2 }));
    let page = std::fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(page.contains("<svg") && !page.contains("src=") && !page.contains("href="));
    assert!(page.contains("Photos within a position error") && page.contains("CPU time by stage"));

    // The same again: nothing runs, nothing has changed.
    let again = bench(&["--repeats", "2"]);
    assert_eq!(again.status.code(), Some(0), "{}", gave(&again));
    assert!(gave(&again).contains("0 regressions, 0 improvements"), "{}", gave(&again));
    assert_eq!(json_of(&folder.path().join("out/lane/default/results.json"))["stages"][0]["ran"], 0);

    // A baseline that had been better by more than the noise.
    let file = folder.path().join("benchmarks/baseline.json");
    let mut baseline = json_of(&file);
    baseline["runs"]["lane/default"]["scene/registered"]["mean"] = json!(5.0);
    std::fs::write(&file, baseline.to_string()).unwrap();
    let worse = bench(&["--repeats", "2"]);
    assert_eq!(worse.status.code(), Some(1), "{}", gave(&worse));
    assert!(gave(&worse).contains("1 regressions") && gave(&worse).contains("scene/registered"));
}

#[test]
fn a_data_set_by_path_keeps_its_results_schema() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let output = setloc(folder.path(), &["bench", "town", "-o", "out", "--repeats", "2"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let results = json_of(&folder.path().join("out/results.json"));
    let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    let top = [
        "cpu_s",
        "dataset",
        "gps",
        "peak_rss_mb",
        "scene",
        "sets",
        "skipped",
        "skipped_sets",
        "stages",
        "wall_s",
        "warnings",
    ];
    assert_eq!(keys(&results), top);
    let scene = [
        "auc",
        "components",
        "images",
        "mean_angular_error_px",
        "misplaced",
        "observations",
        "points",
        "position_m",
        "position_sigma_m",
        "registered",
        "rotation_deg",
        "rotation_own_deg",
        "rotation_sigma_deg",
    ];
    assert_eq!(keys(&results["scene"]), scene);
    let set = &results["sets"][0];
    assert_eq!(keys(set), ["advice", "images", "local_models", "methods", "name", "target"]);
    assert_eq!(keys(&set["methods"]), ["camset", "camset+opt", "single"]);
    let method =
        ["apart", "calibration", "position_m", "registered", "rotation_deg", "target", "target_registered"];
    assert_eq!(keys(&set["methods"]["single"]), method);
    let refined = &set["methods"]["camset+opt"];
    assert_eq!(keys(&refined["calibration"]), ["mean", "photos", "within_95"]);
    assert_eq!(refined["calibration"]["photos"], refined["registered"]);
    assert!(folder.path().join("out/seed-1/results.json").is_file());
    assert_eq!(json_of(&folder.path().join("out/repeats.json"))["scene/registered"]["repeats"], 2);
}

#[test]
fn a_set_without_a_readable_photo_is_skipped_and_said() {
    let folder = tempfile::tempdir().unwrap();
    let queries = town(folder.path()).join("queries");
    let photo = std::fs::read(queries.join("lane/img_00.jpg")).unwrap();
    for set in ["empty", "text", "truncated"] {
        std::fs::create_dir(queries.join(set)).unwrap();
    }
    std::fs::write(queries.join("text/a.jpg"), "this is no picture").unwrap();
    let truth = folder.path().join("town/truth.json");
    let named =
        std::fs::read_to_string(&truth).unwrap().replace("panoramas/", "panos/").replace("queries/", "q/");
    std::fs::write(&truth, named).unwrap();
    std::fs::write(queries.join("truncated/a.jpg"), &photo[..photo.len() / 2]).unwrap();
    let output = setloc(folder.path(), &["bench", "town", "-o", "out", "--no-joint-reference"]);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(0), "{text}");
    let results = json_of(&folder.path().join("out/results.json"));
    let warnings = results["warnings"].to_string();
    assert!(warnings.contains("truth.json has the pose of no image: it lists `panos/"), "{warnings}");
    let names: Vec<&Value> = results["sets"].as_array().unwrap().iter().map(|set| &set["name"]).collect();
    assert_eq!(names, ["lane"]);
    let reasons = [("empty", "no images in "), ("text", "queries/text/a.jpg"), ("truncated", "truncated")];
    for (set, reason) in reasons {
        let told = results["skipped_sets"][set].as_str().unwrap();
        assert!(told.contains(reason), "{told}");
        assert!(text.contains(&format!("skipped set {set}: {told}")), "{text}");
        assert!(gave(&output).contains(&format!("Skipped set {set}: {told}")), "{}", gave(&output));
    }
}

#[test]
fn nothing_to_run_is_an_error_with_a_hint() {
    let folder = tempfile::tempdir().unwrap();
    let output = setloc(folder.path(), &["bench"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(said(&output).contains("benchmarks/datasets.toml") && said(&output).contains("hint: "));
    std::fs::write(folder.path().join("r.toml"), REGISTRY).unwrap();
    let output = setloc(folder.path(), &["bench", "--registry", "r.toml"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(said(&output).contains("none of the registered") && said(&output).contains("SETLOC_DATA"));
    let output = setloc(folder.path(), &["bench", "--registry", "r.toml", "--only", "lanes"]);
    assert!(
        said(&output).contains("`lanes`") && said(&output).contains("lane, elsewhere"),
        "{}",
        said(&output)
    );
}
