//! The program on bad input: exit codes and what it says.

#![allow(clippy::unwrap_used, reason = "the helpers of tests, too, may fail by panicking")]

mod common;

use common::{said, setloc};

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
fn bad_images_among_good_ones_are_skipped_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let panoramas = folder.path().join("panoramas");
    std::fs::create_dir(&panoramas).unwrap();
    picture(3).save(panoramas.join("a.jpg")).unwrap();
    picture(5).save(panoramas.join("b.jpg")).unwrap();
    let whole = std::fs::read(panoramas.join("a.jpg")).unwrap();
    std::fs::write(panoramas.join("truncated.jpg"), &whole[..whole.len() / 2]).unwrap();
    std::fs::write(panoramas.join("text.jpg"), "this is no picture").unwrap();
    std::fs::write(panoramas.join("nothing.jpg"), "").unwrap();
    image::RgbImage::new(256, 128).save(panoramas.join("black.jpg")).unwrap();
    let output = setloc(folder.path(), &["build", "panoramas", "-o", "s.setloc"]);
    let text = said(&output);
    assert!(matches!(output.status.code(), Some(0 | 1)), "{text}");
    assert!(
        text.contains("skipped panoramas/text.jpg") && text.contains("skipped panoramas/nothing.jpg"),
        "{text}"
    );
    assert!(!text.contains("skipped panoramas/a.jpg"), "{text}");
    assert!(folder.path().join("s.setloc").is_file());
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
