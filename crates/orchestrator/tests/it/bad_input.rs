//! The program on bad input: exit codes and what it says.

use std::ffi::OsStr;
use std::fs::OpenOptions;
use std::os::unix::ffi::OsStrExt as _;

use crate::common::{gave, panoramas, program, said, setloc, town};

fn picture(shade: u8) -> image::RgbImage {
    image::RgbImage::from_fn(256, 128, |x, y| image::Rgb([(x as u8) ^ (y as u8).wrapping_mul(shade); 3]))
}

#[test]
fn an_empty_folder_is_an_error_with_a_hint() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("panoramas")).unwrap();
    let output = setloc(folder.path(), &["build", "panoramas", "-o", "s.setloc"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(
        said(&output).contains("error: no images") && said(&output).contains("hint:"),
        "{}",
        said(&output)
    );
}

#[test]
fn images_that_are_not_read_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let street = panoramas(folder.path(), 2);
    std::fs::create_dir(street.join("north")).unwrap();
    std::fs::copy(street.join("p0.png"), street.join("north/p0.png")).unwrap();
    std::fs::write(street.join("a.gif"), "").unwrap();
    std::fs::create_dir(folder.path().join("all")).unwrap();
    std::fs::rename(&street, folder.path().join("all/panoramas")).unwrap();
    let plan = |images: &str| setloc(folder.path(), &["plan", images]);
    let some = said(&plan("all/panoramas"));
    assert!(some.contains("warning: not read: files of other formats than "), "{some}");
    assert!(some.contains("(all/panoramas/a.gif), subfolders with images"), "{some}");
    let none = plan("all");
    assert_eq!(none.status.code(), Some(2));
    let named = "given itself (all/panoramas; all/panoramas/north)\n";
    assert!(said(&none).contains("error: no images in all\nhint: not read: "), "{}", said(&none));
    assert!(said(&none).ends_with(named), "{}", said(&none));
}

#[test]
fn bad_images_among_good_ones_are_skipped_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let panoramas = town(folder.path()).join("panoramas");
    let good = panoramas.join("pano_000.jpg");
    let whole = std::fs::read(&good).unwrap();
    std::fs::write(panoramas.join("truncated.jpg"), &whole[..whole.len() / 2]).unwrap();
    std::fs::write(panoramas.join("text.jpg"), "this is no picture").unwrap();
    std::fs::write(panoramas.join("nothing.jpg"), "").unwrap();
    std::fs::copy(&good, panoramas.join("again.jpg")).unwrap();
    image::RgbImage::new(256, 128).save(panoramas.join("black.jpg")).unwrap();
    let output = setloc(folder.path(), &["build", "town/panoramas", "-o", "s.setloc"]);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(0), "{text}");
    for line in [
        "skipped panoramas/truncated.jpg: the JPEG image is truncated",
        "skipped panoramas/text.jpg: not a readable image",
        "skipped panoramas/nothing.jpg: the file is empty",
        "3 images skipped",
        "warning: images of equal content: panoramas/again.jpg and panoramas/pano_000.jpg",
    ] {
        assert!(text.contains(line), "{line}: {text}");
    }
    assert_eq!(text.matches("skipped panoramas/").count(), 3, "{text}");
    // What the two equal images share tells nothing of the model.
    assert!(!text.contains("panoramas/again.jpg–panoramas/pano_000.jpg"), "{text}");
    assert!(!text.contains("panoramas/pano_000.jpg–panoramas/again.jpg"), "{text}");
    // An image without texture is kept, and told not to be registered.
    let report = gave(&setloc(folder.path(), &["report", "s.setloc"]));
    assert!(report.contains("panoramas/black.jpg\tnot registered\t0 observations"), "{report}");
    assert!(report.contains("panoramas/pano_003.jpg\tregistered"), "{report}");
    assert!(report.contains("not registered: panoramas/black.jpg;"), "{report}");
    assert!(report.contains("skipped panoramas/truncated.jpg: "), "{report}");
    let equal = "warning: images of equal content: panoramas/again.jpg and panoramas/pano_000.jpg\n";
    assert_eq!(report.matches(equal).count(), 1, "{report}");
}

#[test]
fn options_that_fit_no_image_are_said() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    std::fs::write(folder.path().join("geo.csv"), "name,lat,lon\npano/p0.png,47,8\n").unwrap();
    let plan = |options: &[&str]| setloc(folder.path(), &[&["plan", "panoramas"], options].concat());
    let output = plan(&["--gps", "geo.csv", "--masks", "masks"]);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert!(text.contains("cameras: 2 panoramas by the 2:1 aspect ratio\n"), "{text}");
    assert!(text.contains("warning: geo.csv has the position of no image: it lists `pano/p0.png`"), "{text}");
    assert!(text.contains("warning: masks has the mask of no image"), "{text}");
    let exif = plan(&["--gps", "exif"]);
    assert!(said(&exif).contains("warning: no image has a position in its EXIF"), "{}", said(&exif));
    let nowhere = plan(&["--masks", "mask"]);
    assert_eq!(nowhere.status.code(), Some(2));
    assert!(said(&nowhere).contains("mask is no folder") && said(&nowhere).contains("hint: "));
}

#[test]
fn masks_that_leave_nothing_are_said_each_time() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 3);
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    image::GrayImage::new(256, 128).save(folder.path().join("masks/p1.png")).unwrap();
    for _ in 0..2 {
        let output = setloc(folder.path(), &["build", "panoramas", "--masks", "masks", "-o", "s.setloc"]);
        let text = said(&output);
        assert!(text.contains("\nmasks: 1 of 3 images\n"), "{text}");
        let warning = "warning: masks leave next to nothing of images: panoramas/p1.png (0 keypoints)\n";
        assert!(text.contains(warning), "{text}");
        let report = gave(&setloc(folder.path(), &["report", "s.setloc"]));
        assert!(report.contains(warning), "{report}");
    }
}

#[test]
fn a_folder_without_one_readable_image_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("panoramas")).unwrap();
    std::fs::write(folder.path().join("panoramas/a.jpg"), "no picture").unwrap();
    let output = setloc(folder.path(), &["build", "panoramas"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(said(&output).contains("panoramas/a.jpg"), "{}", said(&output));
}

#[test]
fn a_damaged_scene_is_refused_with_its_name() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("s.setloc"), "SETLOC? no").unwrap();
    picture(3).save(folder.path().join("photo.png")).unwrap();
    let output = setloc(folder.path(), &["locate", "s.setloc", "photo.png"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(said(&output).contains("s.setloc is no usable scene"), "{}", said(&output));
}

#[test]
fn wrong_values_in_cameras_json_are_named_with_their_line() {
    let folder = tempfile::tempdir().unwrap();
    picture(3).save(folder.path().join("a.png")).unwrap();
    let cameras = "{\n \"cameras\": {\"c\": {\"model\": \"PINHOL\", \"width\": 1, \"height\": 1, \"params\": []}},\n \"images\": {}\n}";
    std::fs::write(folder.path().join("cameras.json"), cameras).unwrap();
    let output = setloc(folder.path(), &["build", "a.png", "--cameras", "cameras.json"]);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(2));
    assert!(text.contains("cameras.json") && text.contains("line 2") && text.contains("`PINHOLE`"), "{text}");
}

#[test]
fn outputs_never_replace_what_is_read() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    let run = |arguments: &[&str]| setloc(folder.path(), arguments);
    std::fs::write(folder.path().join("geo.csv"), "p0.png,47,8\n").unwrap();
    assert_eq!(run(&["build", "panoramas", "-o", "s.setloc"]).status.code(), Some(1));
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    image::GrayImage::new(256, 128).save(folder.path().join("masks/p0.png")).unwrap();
    let commands: [&[&str]; 8] = [
        &["build", "panoramas", "-o", "panoramas/p0.png"],
        &["build", "panoramas", "--masks", "masks", "-o", "masks/p0.png"],
        &["build", "panoramas", "--gps", "geo.csv", "-o", "geo.csv"],
        &["export", "s.setloc", "--format", "json", "-o", "s.setloc"],
        &["export", "s.setloc", "--format", "top-view", "-o", "panoramas/../s.setloc"],
        &["report", "s.setloc", "-o", "s.setloc"],
        &["report", "s", "-o", "s/poses.json"],
        &["locate", "s.setloc", "panoramas", "--grow", "panoramas/p1.png"],
    ];
    for command in commands {
        let output = command.last().unwrap();
        let before = std::fs::read(folder.path().join(output)).unwrap();
        let refused = run(command);
        assert_eq!(refused.status.code(), Some(2), "{command:?}");
        assert!(said(&refused).contains("is read, and would be replaced"), "{}", said(&refused));
        assert!(std::fs::read(folder.path().join(output)).unwrap() == before, "{command:?}");
    }
}

#[test]
fn a_scene_that_would_be_a_folder_is_refused_before_anything_runs() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    std::fs::create_dir(folder.path().join("scenes")).unwrap();
    for output in ["scenes", "scenes/", "new/"] {
        let refused = setloc(folder.path(), &["build", "panoramas", "-o", output]);
        let (text, named) = (said(&refused), output.trim_end_matches('/'));
        assert_eq!(refused.status.code(), Some(2), "{text}");
        assert!(text.ends_with(&format!("\nhint: name a file in it: -o {named}/scene.setloc\n")), "{text}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn results_among_the_photos_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    let run = |arguments: &[&str]| setloc(folder.path(), arguments);
    assert_eq!(run(&["build", "panoramas", "-o", "s.setloc"]).status.code(), Some(1));
    for outputs in [&["-o", "panoramas"][..], &["--grow", "panoramas.setloc"]] {
        let refused = run(&[&["locate", "s.setloc", "panoramas"], outputs].concat());
        let text = said(&refused);
        assert_eq!(refused.status.code(), Some(2), "{text}");
        assert!(text.contains("would go into panoramas, among the images\nhint: "), "{text}");
        assert_eq!(std::fs::read_dir(folder.path().join("panoramas")).unwrap().count(), 2);
    }
    let refused = run(&["locate", "s.setloc", "panoramas", "-o", "out", "--grow", "out.setloc"]);
    assert!(said(&refused).contains("out would hold the results of both\nhint: "), "{}", said(&refused));
}

#[test]
fn data_that_cannot_be_written_is_an_error_unless_nobody_reads_on() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    assert_eq!(setloc(folder.path(), &["build", "panoramas", "-o", "s.setloc"]).status.code(), Some(1));
    let commands: [&[&str]; 4] = [
        &["build", "--print-config"],
        &["export", "s.setloc", "--format", "json"],
        &["plan", "panoramas", "-o", "s.setloc", "--format", "json"],
        &["status"],
    ];
    for command in commands {
        let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let output = program(folder.path(), command).stdout(full).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{command:?}");
        let text = said(&output);
        assert!(
            text.contains("error: cannot write to standard output\n") && text.contains("hint: "),
            "{text}"
        );
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = program(folder.path(), command).stdout(writer).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{command:?}: {}", said(&output));
    }
}

#[test]
fn a_scene_is_reported_by_no_results_of_another() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 3);
    let run = |arguments: &[&str]| setloc(folder.path(), arguments);
    assert_eq!(run(&["build", "panoramas", "-o", "s.setloc"]).status.code(), Some(1));
    assert_eq!(run(&["report", "s.setloc"]).status.code(), Some(0));
    std::fs::remove_file(folder.path().join("panoramas/p2.png")).unwrap();
    let other = ["build", "panoramas", "-o", "s.setloc", "--set", "sfm.loss_sigma=1.5", "--export", "other"];
    assert_eq!(run(&other).status.code(), Some(1));
    let refused = run(&["report", "s.setloc"]);
    assert_eq!(refused.status.code(), Some(2), "{}", gave(&refused));
    let text = said(&refused);
    assert!(text.contains("error: s has no results of the scene s.setloc\nhint: "), "{text}");
    assert_eq!(run(&["report", "other"]).status.code(), Some(0));
}

#[test]
fn folders_that_are_no_utf_8_are_said_and_lose_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let name = OsStr::from_bytes(b"gr\xfcn");
    std::fs::rename(panoramas(folder.path(), 2), folder.path().join(name)).unwrap();
    let output = program(folder.path(), &["build", "-o", "s.setloc"]).arg(name).output().unwrap();
    let text = said(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("warning: paths are no UTF-8, so that it cannot be noted where"), "{text}");
    assert!(
        text.contains("wrote s.setloc and s/") && folder.path().join("s/report.json").is_file(),
        "{text}"
    );
}

#[test]
fn names_command_no_terminal() {
    let folder = tempfile::tempdir().unwrap();
    panoramas(folder.path(), 2);
    let text = said(&setloc(folder.path(), &["build", "panoramas", "-o", "s\u{1b}[31m/s.setloc"]));
    assert!(text.contains("wrote s_[31m/s.setloc") && !text.contains('\u{1b}'), "{text}");
}

#[test]
fn an_image_without_end_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("a.jpg");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    if !made.is_ok_and(|status| status.success()) {
        eprintln!("skipped: this system makes no pipes by name");
        return;
    }
    let output = setloc(folder.path(), &["build", "a.jpg", "-o", "s.setloc"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(
        said(&output).contains("error: a.jpg is neither a file nor a folder\nhint: "),
        "{}",
        said(&output)
    );
}
