//! What the program says: help, errors with their hints, reports. `INSTA_UPDATE=always` accepts new texts.

use crate::common::{first_track_of_colmap, gave, images_of_colmap, panoramas, program, said, setloc, town};

#[test]
fn help_says_what_there_is() {
    let folder = tempfile::tempdir().unwrap();
    let commands = [
        "", "demo", "build", "plan", "locate", "bench", "compare", "batch", "report", "status", "export",
        "import", "explain", "cache", "cache gc",
    ];
    for command in commands {
        let arguments: Vec<&str> = command.split_whitespace().chain(["--help"]).collect();
        let output = setloc(folder.path(), &arguments);
        assert_eq!(output.status.code(), Some(0));
        let name = format!("help {command}").trim().replace(' ', "-");
        insta::assert_snapshot!(name, gave(&output));
    }
}

#[test]
fn errors_name_the_file_the_place_and_the_remedy() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    std::fs::create_dir(folder.path().join("empty")).unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("config.toml", "[camset]\nrato = 0.6\n");
    write("geo.csv", "name,lat,lon,alt\np0.png,91,8,0\n");
    write("damaged.setloc", "SETLOC");
    write("a.txt", "a.jpg 1 0 0 0 0 0 0\n");
    write("b.txt", "b.jpg 1 0 0 0 0 0 0\n");
    write("batch.toml", "[[scene]]\nname = \"a\"\n");
    write("range.toml", "[camset]\nratio = 1.5\n");
    write("commas.csv", "name,lat,lon,alt\np0.png,47,25,8,5,400\n");
    let wrong: [&[&str]; 26] = [
        &["build"],
        &["build", "nowhere"],
        &["build", "empty"],
        &["build", "panoramas", "--config", "config.toml"],
        &["build", "panoramas", "--set", "camset.ratio"],
        &["build", "panoramas", "--set", "camset.rato=1"],
        &["build", "panoramas", "--set", "camset.ratio=high"],
        &["build", "panoramas", "--set", "camset.ratio=nan"],
        &["build", "panoramas", "--config", "range.toml"],
        &["build", "panoramas", "--config", "empty"],
        &["build", "panoramas", "--threads", "0"],
        &["build", "/dev/zero"],
        &["build", "panoramas", "--gps", "geo.csv"],
        &["build", "panoramas", "--gps", "commas.csv"],
        &["build", "panoramas", "--memory", "8 apples"],
        &["locate", "missing.setloc", "panoramas"],
        &["locate", "damaged.setloc", "panoramas"],
        &["locate", "empty", "panoramas"],
        &["explain", "features"],
        &["cache", "ls", "--cache", "nowhere"],
        &["report", "empty"],
        &["batch", "batch.toml"],
        &["bench", "empty"],
        &["compare", "geo.csv", "geo.csv"],
        &["compare", "a.txt", "b.txt"],
        &["import", "empty"],
    ];
    let mut texts = String::new();
    for arguments in wrong {
        let output = setloc(folder.path(), arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(output.stdout.is_empty(), "{arguments:?}");
        texts += &["$ setloc ", &arguments.join(" "), "\n", &said(&output), "\n"].concat();
    }
    let here = folder.path().canonicalize().unwrap().display().to_string();
    // The parameters of the stages are those crates' own affair.
    insta::with_settings!({ filters => vec![(r"expected one of `.*", "expected one of […]")] }, {
        insta::assert_snapshot!("errors", texts.replace(&here, "[here]"));
    });
}

#[test]
fn an_empty_variable_is_none() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    for arguments in [&["plan", "panoramas"][..], &["status"], &["cache", "ls"], &["explain", "features"]] {
        let plain = setloc(folder.path(), arguments);
        let empty = program(folder.path(), arguments).env("SETLOC_CACHE", "").output().unwrap();
        assert_eq!((gave(&empty), said(&empty)), (gave(&plain), said(&plain)), "{arguments:?}");
    }
    let typed = program(folder.path(), &["status", "--cache", ""]).output().unwrap();
    assert_eq!(typed.status.code(), Some(2));
}

#[test]
fn report_and_status_tell_what_came_out() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let run = |arguments: &[&str]| setloc(folder.path(), arguments);
    let cameras = ["--cameras", "town/cameras.json"];
    let build = run(&[&["build", "town/panoramas", "-o", "s.setloc"], &cameras[..]].concat());
    assert_eq!(build.status.code(), Some(0), "{}", said(&build));
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    let nothing_left_out = image::GrayImage::from_pixel(4, 3, image::Luma([255]));
    nothing_left_out.save(folder.path().join("masks/img_03.png")).unwrap();
    let photos = ["locate", "s.setloc", "town/queries/lane", "-o", "out", "--masks", "masks"];
    let locate = run(&[&photos, &cameras[..]].concat());
    assert!(matches!(locate.status.code(), Some(0 | 1)), "{}", said(&locate));
    assert!(said(&locate).contains("masks: 1 of 4 images\n"), "{}", said(&locate));

    let of_scene = run(&["report", "s.setloc"]);
    assert_eq!(of_scene.status.code(), Some(0), "{}", said(&of_scene));
    assert!(gave(&of_scene).contains("4 of 4 images registered"), "{}", gave(&of_scene));
    let of_photos = run(&["report", "out", "-o", "page.html"]);
    let text = gave(&of_photos);
    assert!(text.contains("Target lane/img_03.jpg") && text.contains("lane/img_00.jpg\t"), "{text}");
    for page in ["s/report.html", "page.html"] {
        let page = std::fs::read_to_string(folder.path().join(page)).unwrap();
        assert!(page.contains("data:image/png;base64,") && page.contains("<svg") && !page.contains("href="));
    }

    let status = gave(&run(&["status"]));
    assert!(status.contains("build s.setloc: ") && status.contains("locate out: "), "{status}");
    assert!(
        status.contains("jobs ran, 0 were stored, 0 failed") && status.contains("features\t8"),
        "{status}"
    );

    // Photos without cameras.json, one of them twice.
    let photos = folder.path().join("town/queries/lane");
    std::fs::copy(photos.join("img_00.jpg"), photos.join("img_04.jpg")).unwrap();
    let again = ["locate", "s.setloc", "town/queries/lane", "-o", "again", "--mode", "single"];
    let locate_again = run(&again);
    assert!(matches!(locate_again.status.code(), Some(0 | 1)), "{}", said(&locate_again));
    assert!(said(&locate_again).contains("warning: focal length unknown, "), "{}", said(&locate_again));
    let of_again = gave(&run(&["report", "again"]));
    let equal = "warning: images of equal content: lane/img_00.jpg and lane/img_04.jpg\n";
    assert!(of_again.contains(equal), "{of_again}");
    let estimated =
        of_again.lines().filter(|line| line.starts_with("note: focal length estimated with the scene: "));
    let estimated: Vec<&str> = estimated.collect();
    let is_estimated = estimated.iter().any(|line| line.contains("lane/img_00.jpg"));
    let unknown = of_again.lines().find(|line| line.starts_with("warning: focal length unknown, "));
    assert!(is_estimated && !unknown.is_some_and(|line| line.contains("lane/img_00.jpg")), "{of_again}");
    // The page of these results goes with them.
    let page = folder.path().join("again/report.html");
    assert!(page.is_file());
    run(&again);
    assert!(!page.exists());
}

#[test]
fn what_measured_positions_do_not_tell_is_said_and_left_out() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let truth = std::fs::read_to_string(folder.path().join("town/truth.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
    let build = |columns: &str, altitude: &str, count: usize| {
        let mut lines = vec![columns.to_owned()];
        for (image, pose) in truth["images"].as_object().unwrap().iter().take(count) {
            let [east, north] = [0, 1].map(|axis| pose["center"][axis].as_f64().unwrap());
            let (lat, lon) = (47.0 + north / 111_180.0, 8.0 + east / 75_960.0);
            lines.push(format!("{image},{lat},{lon}{altitude}"));
        }
        std::fs::write(folder.path().join("geo.csv"), lines.join("\n")).unwrap();
        let output =
            setloc(folder.path(), &["build", "town/panoramas", "--gps", "geo.csv", "-o", "s.setloc"]);
        assert_eq!(output.status.code(), Some(0), "{}", said(&output));
        said(&output)
    };
    let export = |format: &str| gave(&setloc(folder.path(), &["export", "s.setloc", "--format", format]));
    let note = "note: the measured positions have no altitudes: heights are relative";
    let coordinates = || {
        let map: serde_json::Value = serde_json::from_str(&export("geojson")).unwrap();
        map["features"][0]["geometry"]["coordinates"].as_array().unwrap().len()
    };

    let text = build("name,lat,lon", "", 4);
    assert!(text.contains(note), "{text}");
    let poses = export("json");
    assert!(poses.contains("\"wgs84\": {") && !poses.contains("\"alt\""), "{poses}");
    assert!(poses.contains("\"horizontal_m\": ") && !poses.contains("\"vertical_m\""), "{poses}");
    assert_eq!(coordinates(), 2);
    assert!(!export("kml").contains("ellipsoidal_height_m"));

    let text = build("name,lat,lon,alt", ",0", 4);
    assert!(!text.contains(note), "{text}");
    let poses = export("json");
    assert!(poses.contains("\"alt\"") && poses.contains("\"vertical_m\""), "{poses}");
    let photos = ["locate", "s.setloc", "town/queries/lane", "-o", "out", "--mode", "single"];
    let located = setloc(folder.path(), &photos);
    assert!(
        said(&located).contains("note: of the scene: measured positions place it on the map; if"),
        "{}",
        said(&located)
    );
    let report = gave(&setloc(folder.path(), &["report", "out"]));
    assert!(report.contains(" m on the map") && report.contains("note: of the scene: measured"), "{report}");
    assert_eq!(coordinates(), 3);
    assert!(export("kml").contains("ellipsoidal_height_m"));

    let few = "2 measured positions within ";
    assert!(
        text.contains("note: positions: 4 of 4 images, median deviation 0.0") && !text.contains(few),
        "{text}"
    );
    let text = build("name,lat,lon", "", 2);
    assert!(text.contains("note: positions: 2 of 4 images") && text.contains(few), "{text}");
}

#[test]
fn a_scene_grows_by_localized_photos_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let run = |arguments: &[&str]| setloc(folder.path(), arguments);
    let cameras = ["--cameras", "town/cameras.json"];
    let build = run(&[&["build", "town/panoramas", "-o", "s.setloc"], &cameras[..]].concat());
    assert_eq!(build.status.code(), Some(0), "{}", said(&build));
    panoramas(folder.path(), 2);
    let foreign = run(&["locate", "s.setloc", "panoramas", "--grow", "g.setloc"]);
    assert_eq!(foreign.status.code(), Some(1), "{}", said(&foreign));
    let refusal = "g.setloc is not written: no photo is localized\nhint: ";
    assert!(said(&foreign).contains(refusal), "{}", said(&foreign));
    assert!(!folder.path().join("g.setloc").exists());

    let grow = |from, to| {
        let arguments = ["locate", from, "town/queries/lane", "--target", "img_00.jpg", "--grow", to];
        run(&[&arguments, &cameras[..]].concat())
    };
    let grown = grow("s.setloc", "g.setloc");
    assert_eq!(grown.status.code(), Some(0), "{}", said(&grown));
    assert!(said(&grown).contains("grown-1: grown by "), "{}", said(&grown));
    let file = std::fs::read(folder.path().join("g.setloc")).unwrap();
    let report = gave(&run(&["report", "g.setloc"]));
    for part in [" of them added by growth", "grown-1/lane/img_00.jpg\tadded by growth", "note: grown-1: "] {
        assert!(report.contains(part), "{part}: {report}");
    }
    let poses = std::fs::read_to_string(folder.path().join("g/poses.json")).unwrap();
    assert!(poses.contains("\"grown\": true") && poses.contains("\"grown\": false"), "{poses}");
    assert!(images_of_colmap(&folder.path().join("g/colmap")).contains("grown-1/lane/img_00.jpg"));
    assert!(images_of_colmap(&folder.path().join("out/colmap")).contains("lane/img_00.jpg"));
    for model in ["s/colmap", "g/colmap", "out/colmap"] {
        assert!(first_track_of_colmap(&folder.path().join(model)) >= 2, "{model}");
    }
    let lacks = "lacks 2D points and tracks of";
    assert!(!said(&grown).contains(lacks), "{}", said(&grown));
    let apart = run(&["export", "g.setloc", "--format", "colmap", "-o", "m", "--cache", "elsewhere"]);
    assert!(said(&apart).contains(lacks) && first_track_of_colmap(&folder.path().join("m")) == 0);
    let whole = run(&["export", "g.setloc", "--format", "colmap", "-o", "m"]);
    assert!(!said(&whole).contains(lacks) && first_track_of_colmap(&folder.path().join("m")) >= 2);

    // The same again is the same, and what it has grown by it does not grow by again.
    assert_eq!(grow("s.setloc", "h.setloc").status.code(), Some(0));
    assert_eq!(std::fs::read(folder.path().join("h.setloc")).unwrap(), file);
    let lost = run(&["build", "town/panoramas", "-o", "g.setloc"]);
    assert_eq!(lost.status.code(), Some(2), "{}", said(&lost));
    assert!(
        said(&lost).contains("g.setloc has grown by ") && said(&lost).contains("hint: "),
        "{}",
        said(&lost)
    );
    assert_eq!(std::fs::read(folder.path().join("g.setloc")).unwrap(), file);
    let again = grow("g.setloc", "i.setloc");
    assert_eq!(again.status.code(), Some(1), "{}", said(&again));
    assert!(said(&again).contains("all photos that are localized are in the scene"), "{}", said(&again));
}

#[test]
fn where_nothing_is_registered_a_scene_stays_and_none_is_located_in() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    panoramas(folder.path(), 2);
    let run = |arguments: &[&str]| setloc(folder.path(), arguments);
    let build = run(&["build", "town/panoramas", "-o", "s.setloc"]);
    assert_eq!(build.status.code(), Some(0), "{}", said(&build));
    let files = ["s.setloc", "s.images.json", "s/poses.json", "s/report.json"];
    let contents = || files.map(|name| std::fs::read(folder.path().join(name)).unwrap());
    let before = contents();
    let foreign = run(&["build", "panoramas", "-o", "s.setloc"]);
    assert_eq!(foreign.status.code(), Some(1), "{}", said(&foreign));
    assert!(said(&foreign).contains("s.setloc and s/ stay as they were"), "{}", said(&foreign));
    assert!(contents() == before);

    let empty = run(&["build", "panoramas", "-o", "e.setloc"]);
    assert_eq!(empty.status.code(), Some(1), "{}", said(&empty));
    let located = run(&["locate", "e.setloc", "town/queries/lane"]);
    assert_eq!(located.status.code(), Some(2), "{}", said(&located));
    assert!(said(&located).contains("error: e.setloc has no images"), "{}", said(&located));
}

#[test]
fn plan_and_explain_name_the_parameter_that_changed() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let run = |command: &[&str], settings: &[&str]| {
        let output = setloc(folder.path(), &[command, settings].concat());
        assert_eq!(output.status.code(), Some(0), "{}", said(&output));
        gave(&output)
    };
    let (plan, build) =
        (["plan", "town/panoramas", "-o", "s.setloc"], ["build", "town/panoramas", "-o", "s.setloc"]);
    assert!(run(&plan, &[]).contains("runs     features panoramas/pano_000.jpg: never ran before"));
    assert!(!folder.path().join(".setloc-cache").exists(), "a plan makes nothing");
    run(&build, &[]);
    assert!(run(&plan, &[]).ends_with("0 jobs run, 0 depend on them, 21 are stored\n"));
    let changed = ["--set", "two_view.min_inliers=40"];
    let reason = "parameter two_view.min_inliers changed from ";
    let planned = run(&plan, &changed);
    assert_eq!(
        planned.lines().filter(|line| line.starts_with("runs     verify ") && line.contains(reason)).count(),
        6
    );
    assert!(planned.contains("follows  model scene: uses verify "), "{planned}");
    run(&build, &changed);
    let explained = run(&["explain", "verify panoramas/pano_000.jpg"], &[]);
    assert!(
        explained.lines().count() == 3 && explained.lines().all(|line| line.contains(reason)),
        "{explained}"
    );
    assert!(run(&["explain", "features"], &[]).lines().all(|line| line.ends_with(": nothing changed")));
    let unknown = setloc(folder.path(), &["explain", "nothing"]);
    assert_eq!(unknown.status.code(), Some(2));
    assert!(said(&unknown).contains("hint: name a kind of job (aligned, features, "), "{}", said(&unknown));
    // Another output in the same store is another run.
    run(&["build", "town/panoramas", "-o", "other/s.setloc"], &["--cache", ".setloc-cache"]);
    assert!(run(&["explain", "features"], &[]).contains("build other/s.setloc: features"));
}

#[test]
fn poses_are_compared_with_the_truth() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    let pose = |x: i32, y: i32| format!(r#"{{"q_wxyz": [1, 0, 0, 0], "center": [{x}, {y}, 0]}}"#);
    let [a, b, c, photo] = [pose(0, 0), pose(2, 0), pose(0, 2), pose(2, 2)];
    write(
        "truth.json",
        &format!(r#"{{"images": {{"p/a": {a}, "p/b": {b}, "p/c": {c}, "q/d": {photo}, "q/e": {photo}}}}}"#),
    );
    // Half as large, and the photo is off by a quarter of the truth's unit.
    write("found.txt", "a 1 0 0 0 0 0 0\nb 1 0 0 0 -1 0 0\nc 1 0 0 0 0 -1 0\nd 1 0 0 0 -1.125 -1 0\n");
    let output = setloc(
        folder.path(),
        &["compare", "truth.json", "found.txt", "--align-by", "p/", "-o", "found.json"],
    );
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let row = gave(&output).lines().nth(2).unwrap().to_owned();
    let figures = "| found.txt | 1/2 | 0 | 0.2500, 0.2500, 0.2500 | 0.0000, 0.0000, 0.0000 | 50.0 |";
    assert!(row.starts_with(figures), "{row}");
    let found: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("found.json")).unwrap()).unwrap();
    assert!((found["comparisons"][0]["scale"].as_f64().unwrap() - 2.0).abs() < 1e-9, "{found}");

    // East, north, up of two origins, one a thousandth of a degree north of the other.
    let about = |lat: &str, north: f64| {
        let pose = |x: i32| format!(r#"{{"q_wxyz": [1, 0, 0, 0], "center": [{x}, {north}, 0]}}"#);
        let origin = format!(r#"{{"lat": {lat}, "lon": 8.0, "alt": 400.0}}"#);
        format!(r#"{{"geo_origin": {origin}, "images": {{"a": {}, "b": {}}}}}"#, pose(0), pose(5))
    };
    write("here.json", &about("47.0", 111.18));
    write("there.json", &about("47.001", 0.0));
    let output = setloc(folder.path(), &["compare", "here.json", "there.json", "--no-align"]);
    let row = gave(&output).lines().nth(2).unwrap_or_default().to_owned();
    assert!(row.starts_with("| there.json | 2/2 | 0 | 0.0"), "{row} {}", said(&output));
    assert!(
        said(&output).contains("there.json: brought to the truth's geo_origin, 111.1"),
        "{}",
        said(&output)
    );
}
