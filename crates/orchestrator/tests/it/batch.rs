//! Many scenes and sets from one manifest.

use std::path::Path;

use crate::common::{gave, logged, panoramas, said, setloc, town};

/// Lines of the summary: name and outcome.
fn summary(text: &str) -> Vec<(String, String)> {
    let line = |line: &str| {
        let mut fields = line.split('\t');
        let mut field = || fields.next().unwrap_or_default().to_owned();
        (field(), field())
    };
    text.lines().map(line).collect()
}

fn write(folder: &Path, manifest: &str) {
    std::fs::write(folder.join("batch.toml"), manifest).unwrap();
}

#[test]
fn a_failing_scene_does_not_stop_the_others() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    town(folder.path());
    std::fs::create_dir(folder.path().join("broken")).unwrap();
    std::fs::write(folder.path().join("broken/a.jpg"), "no picture").unwrap();
    write(
        folder.path(),
        r#"
        [[scene]]
        name = "broken"
        panoramas = ["broken"]
          [[scene.sets]]
          name = "never"
          photos = ["town/queries/lane"]
        [[scene]]
        name = "town"
        panoramas = ["town/panoramas"]
        cameras = "town/cameras.json"
          [[scene.sets]]
          name = "gone"
          photos = ["nowhere"]
          [[scene.sets]]
          name = "lane"
          photos = ["town/queries/lane"]
          cameras = "town/cameras.json"
        [[scene]]
        name = "apart"
        panoramas = ["panoramas"]
          [[scene.sets]]
          name = "nowhere"
          photos = ["town/queries/lane"]
        "#,
    );
    let output = setloc(folder.path(), &["batch", "batch.toml", "-o", "out"]);
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    let lines = summary(&gave(&output));
    let names: Vec<&str> = lines.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["broken", "broken/never", "town", "town/gone", "town/lane", "apart", "apart/nowhere"]);
    assert!(lines[0].1.starts_with("failed: ") && lines[0].1.contains("broken/a.jpg"), "{lines:?}");
    assert_eq!((lines[1].1.as_str(), lines[2].1.as_str()), ("skipped", "done"));
    assert!(lines[3].1.starts_with("failed: ") && lines[3].1.contains("nowhere"), "{lines:?}");
    assert!(["done", "negative"].contains(&lines[4].1.as_str()), "{lines:?}");
    // Pictures of nothing in common are no scene, which is an answer.
    assert_eq!((lines[5].1.as_str(), lines[6].1.as_str()), ("negative", "skipped"));
    assert!(folder.path().join("out/town/lane/poses.json").is_file());
    let written = std::fs::read_to_string(folder.path().join("out/summary.json")).unwrap();
    let written: serde_json::Value = serde_json::from_str(&written).unwrap();
    assert_eq!(written.as_array().unwrap().len(), 7);
    let [town, gone, lane, apart] = [2, 3, 4, 5].map(|at| &written[at]);
    assert_eq!((&town["outcome"], &town["scene"]), (&"done".into(), &"out/town/scene.setloc".into()));
    let figures = |part: &serde_json::Value, keys: [&str; 4]| keys.map(|key| part[key].as_u64());
    let of_scene = ["images", "registered", "in_largest", "components"];
    assert_eq!(figures(town, of_scene), [4, 4, 4, 1].map(Some));
    assert_eq!(figures(apart, of_scene), [2, 0, 0, 0].map(Some));
    assert_eq!(figures(gone, of_scene), [None; 4]);
    let [photos, localized, uncertain, lost] =
        figures(lane, ["photos", "localized", "uncertain", "not_localized"]);
    assert!(
        photos == Some(4) && [localized, uncertain, lost].into_iter().flatten().sum::<u64>() == 4,
        "{lane}"
    );
    assert_eq!(
        (&lane["results"], &lane["target"]["name"]),
        (&"out/town/lane".into(), &"lane/img_03.jpg".into())
    );
    assert!(lane["target"]["verdict"].is_string() && lane["target"]["sigma"].is_object(), "{lane}");
}

#[test]
fn a_sweep_repeats_only_what_depends_on_the_swept_parameter() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    write(
        folder.path(),
        r#"
        [[scene]]
        name = "town"
        panoramas = ["town/panoramas"]
        cameras = "town/cameras.json"
          [[scene.sets]]
          name = "lane"
          photos = ["town/queries/lane"]
          cameras = "town/cameras.json"
        [sweep]
        "camset.ratio" = [0.6, 0.7, 0.75]
        "#,
    );
    let output = setloc(folder.path(), &["batch", "batch.toml", "-o", "out"]);
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", said(&output));
    assert_eq!(summary(&gave(&output)).len(), 6);
    let ran = |variant: &str, part: &str| {
        let part = folder.path().join(format!("out/town-camset.ratio={variant}/{part}"));
        logged(&part.join("run.jsonl"), "finished")
    };
    assert!(!ran("0.6", "scene").is_empty() && !ran("0.6", "lane").is_empty());
    for variant in ["0.7", "0.75"] {
        assert_eq!(ran(variant, "scene"), [""; 0]);
        assert_eq!(ran(variant, "lane"), ["camset lane/img_03.jpg"]);
    }
    // The results of every variant are in use: nothing of them is garbage.
    let collected = setloc(folder.path(), &["cache", "gc", "--min-age", "0", "--cache", "out/.setloc-cache"]);
    assert_eq!(gave(&collected), "removed 0 files, 0.0 MiB\n");
}

#[test]
fn a_wrong_manifest_is_refused_before_anything_runs() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |manifest: &str, words: &[&str]| {
        write(folder.path(), manifest);
        let output = setloc(folder.path(), &["batch", "batch.toml", "-o", "out"]);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(words.iter().all(|word| text.contains(word)) && text.contains("hint: "), "{text}");
        assert!(!folder.path().join("out").exists());
    };
    let scene = "[[scene]]\nname = \"a\"\npanoramas = [\"p\"]\n";
    refused(&format!("{scene}panorama = 1\n"), &["batch.toml", "line 4", "panorama"]);
    refused(&format!("{scene}{scene}"), &["batch.toml", "`a` is taken"]);
    refused(
        &format!("{scene}[sweep]\n\"camset.rato\" = [1]\n"),
        &["batch.toml", "camset.rato=1", "unknown field"],
    );
    refused("", &["batch.toml", "names no scene"]);
}
