//! Photos in a scene of several components: two towns that share nothing.

use std::path::Path;

use crate::common::{first_track_of_colmap, gave, images_of_colmap, said, setloc, small_town};
use serde_json::{Value, json};
use setloc_town::TownParams;

/// A data set `both` of two towns, whose truths have nothing to do with each other: of the second fewer panoramas.
fn two_towns(folder: &Path) {
    let mut files = [json!({}), json!({})];
    let mut places: Vec<String> = Vec::new();
    for (town, params) in [("a", small_town()), ("b", TownParams { seed: 2, panoramas: 3, ..small_town() })] {
        let from = folder.join(town);
        setloc_town::write_dataset(&from, &params, 92).unwrap();
        let renamed = |name: &str| {
            let name = name.replace("panoramas/", &format!("panoramas/{town}_"));
            name.replace("queries/lane/", &format!("queries/{town}/"))
        };
        for (file, whole) in ["cameras.json", "truth.json"].iter().zip(&mut files) {
            let own: Value =
                serde_json::from_str(&std::fs::read_to_string(from.join(file)).unwrap()).unwrap();
            let mut images = whole["images"].as_object().cloned().unwrap_or_default();
            for (name, value) in own["images"].as_object().unwrap() {
                images.insert(renamed(name), value.clone());
                let to = folder.join("both").join(renamed(name));
                std::fs::create_dir_all(to.parent().unwrap()).unwrap();
                std::fs::copy(from.join(name), to).unwrap();
            }
            *whole = own;
            whole["images"] = Value::Object(images);
            std::fs::write(folder.join("both").join(file), whole.to_string()).unwrap();
        }
        let table = std::fs::read_to_string(from.join("geo.csv")).unwrap();
        let table = table.replace("pano_", &format!("{town}_pano_"));
        let skipped = usize::from(!places.is_empty());
        places.extend(table.lines().skip(skipped).map(str::to_owned));
    }
    std::fs::write(folder.join("geo.csv"), places.join("\n")).unwrap();
}

/// Tab-separated fields of the lines that begin with a name.
fn fields<'a>(text: &'a str, name: &str) -> Vec<&'a str> {
    let line = text.lines().find(|line| line.starts_with(name));
    line.map(|line| line.split('\t').collect()).unwrap_or_default()
}

#[test]
fn photos_of_either_town_are_localized_in_its_component_and_say_so() {
    let folder = tempfile::tempdir().unwrap();
    two_towns(folder.path());
    let run = |arguments: &[&str]| setloc(folder.path(), &[arguments, &["--cache", "c"]].concat());
    let cameras = ["--cameras", "both/cameras.json"];

    let bench = run(&["bench", "both", "-o", "bench"]);
    assert_eq!(bench.status.code(), Some(0), "{}", said(&bench));
    let errors = std::fs::read_to_string(folder.path().join("bench/errors.csv")).unwrap();
    for (town, component) in [("a", "0"), ("b", "1")] {
        let name = format!("{town},camset+opt,queries/{town}/img_00.jpg,");
        let row = errors.lines().find(|line| line.starts_with(&name)).unwrap();
        let columns: Vec<&str> = row.split(',').collect();
        assert!(columns[3].parse::<f64>().unwrap() < 0.3, "{row}");
        assert_eq!((columns[5], *columns.last().unwrap()), ("Localized", component), "{row}");
    }
    let poses = folder.path().join("bench/sets/b/camset+opt.poses.json");
    let poses: Value = serde_json::from_str(&std::fs::read_to_string(poses).unwrap()).unwrap();
    assert_eq!(poses["queries/b/img_00.jpg"]["component"], 1);
    let tables = std::fs::read_to_string(folder.path().join("bench/tables.md")).unwrap();
    assert!(tables.contains(" apart) |") && tables.contains("the largest of 2 components"), "{tables}");

    let build = run(&[&["build", "both/panoramas", "-o", "s.setloc"], &cameras[..]].concat());
    assert!(said(&build).contains("in it in a frame of its own: panoramas/b_pano_"), "{}", said(&build));
    assert!(said(&build).contains("the other components are in s/component_2"), "{}", said(&build));
    let images = |model: &str| images_of_colmap(&folder.path().join(model));
    let (first, second) = (images("s/colmap"), images("s/component_2/colmap"));
    assert!(first.contains("panoramas/a_pano_000.jpg") && !first.contains("b_pano_"), "{first}");
    assert!(second.contains("panoramas/b_pano_000.jpg") && !second.contains("a_pano_"), "{second}");
    assert!(first_track_of_colmap(&folder.path().join("s/component_2/colmap")) >= 2);
    assert!(folder.path().join("s/component_2/points.ply").exists());
    let export = |number: &str| {
        let arguments = ["export", "s.setloc", "--format", "colmap", "-o", number, "--component", number];
        setloc(folder.path(), &arguments)
    };
    let exported = export("2");
    assert_eq!(exported.status.code(), Some(0));
    // These results are kept elsewhere.
    assert!(said(&exported).contains("lacks 2D points and tracks of 3 of 3 images"), "{}", said(&exported));
    assert!(images("2").contains("panoramas/b_pano_000.jpg") && !images("2").contains("a_pano_"));
    let beyond = export("3");
    assert_eq!(beyond.status.code(), Some(2));
    assert!(said(&beyond).contains("the scene has no component 3"), "{}", said(&beyond));
    let locate = |scene: &str, more: &[&str]| {
        let arguments = ["locate", scene, "both/queries/a", "both/queries/b", "-o", "out"];
        run(&[&arguments, &cameras[..], more].concat())
    };
    let target = ["--target", "b/img_00.jpg"];
    let found = locate("s.setloc", &[&target[..], &["--grow", "g.setloc"]].concat());
    assert_eq!(found.status.code(), Some(0), "{}", said(&found));
    let note = "in component 2, apart from the largest: its frame is its own";
    let text = gave(&found);
    assert_eq!(fields(&text, "b/img_00.jpg\t").last(), Some(&note), "{text}");
    assert_eq!(fields(&text, "a/img_00.jpg\t").len(), 6, "{text}");
    let skipped = "not added: b/img_00.jpg";
    assert!(said(&found).contains(skipped) && folder.path().join("g.setloc").exists(), "{}", said(&found));
    let report = gave(&setloc(folder.path(), &["report", "out"]));
    assert!(report.contains(note), "{report}");
    let poses = std::fs::read_to_string(folder.path().join("out/poses.json")).unwrap();
    let poses: Value = serde_json::from_str(&poses).unwrap();
    let of = |name: &str| poses["photos"].as_array().unwrap().iter().find(|p| p["name"] == name).unwrap();
    let (first, second) = (of("a/img_00.jpg"), of("b/img_00.jpg"));
    assert!(first["component"] == 0 && first["own_frame"] == false, "{first}");
    assert!(second["component"] == 1 && second["own_frame"] == true, "{second}");
    let of_scene = gave(&setloc(folder.path(), &["report", "s.setloc"]));
    assert!(of_scene.contains("b_pano_000.jpg\tregistered in component 2"), "{of_scene}");

    // Of the second town alone there is nothing for the largest component to grow by.
    let arguments = ["locate", "s.setloc", "both/queries/b", "-o", "out", "--grow", "h.setloc"];
    let refused = run(&[&arguments, &cameras[..]].concat());
    assert_eq!(refused.status.code(), Some(1), "{}", said(&refused));
    assert!(said(&refused).contains("in other components than the largest only"), "{}", said(&refused));

    // Measured positions give both one frame.
    let build = ["build", "both/panoramas", "-o", "p.setloc", "--gps", "geo.csv"];
    let build = run(&[&build, &cameras[..]].concat());
    assert!(said(&build).contains("beside which measured positions alone place it"), "{}", said(&build));
    let map = gave(&setloc(folder.path(), &["export", "p.setloc", "--format", "geojson"]));
    let map: Value = serde_json::from_str(&map).unwrap();
    let on_map: Vec<&str> =
        map["features"].as_array().unwrap().iter().filter_map(|f| f["properties"]["name"].as_str()).collect();
    assert!(on_map.contains(&"panoramas/a_pano_000.jpg") || on_map.contains(&"a_pano_000.jpg"), "{on_map:?}");
    assert!(on_map.iter().any(|name| name.ends_with("b_pano_000.jpg")), "{on_map:?}");
    let found = locate("p.setloc", &target);
    let text = gave(&found);
    assert_eq!(fields(&text, "b/img_00.jpg\t")[1], "localized", "{text}");
    assert!(!text.contains("its frame is its own"), "{text}");
    let map = gave(&setloc(folder.path(), &["export", "out", "--format", "geojson"]));
    assert!(map.contains("\"b/img_00.jpg\"") && !map.contains("pano_"), "{map}");
    let export = setloc(folder.path(), &["export", "p", "--format", "geojson"]);
    assert!(said(&export).contains("hint: name the scene: p.setloc"), "{}", said(&export));

    // A scene of one component has no exports of a second, nor those of the scene before.
    let build = run(&["build", "a/panoramas", "-o", "s.setloc", "--cameras", "a/cameras.json"]);
    assert_eq!(build.status.code(), Some(0), "{}", said(&build));
    assert!(folder.path().join("s/colmap/images.bin").exists());
    assert!(!folder.path().join("s/component_2").exists());
}
