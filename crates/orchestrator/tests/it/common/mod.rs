//! What the tests of the program share: pictures to work on, and ways to run it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use setloc_town::TownParams;

/// A picture of its own for each seed: blocks of grey.
pub fn write_picture(path: &Path, seed: u32) {
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

/// A folder `panoramas` with that many pictures.
pub fn panoramas(folder: &Path, count: u32) -> PathBuf {
    let panoramas = folder.join("panoramas");
    std::fs::create_dir_all(&panoramas).unwrap();
    (0..count).for_each(|i| write_picture(&panoramas.join(format!("p{i}.png")), i));
    panoramas
}

/// A small town that can be mapped and located in.
pub fn small_town() -> TownParams {
    TownParams {
        panoramas: 4,
        panorama_step_m: 3.0,
        panorama_width: 768,
        photos: 4,
        photo_width: 480,
        ..TownParams::default()
    }
}

/// It: `town/panoramas`, `town/queries/lane`.
pub fn town(folder: &Path) -> PathBuf {
    let town = folder.join("town");
    setloc_town::write_dataset(&town, &small_town(), 92).unwrap();
    town
}

/// The program, to be run in a folder.
pub fn program(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_setloc"));
    command.current_dir(folder).env_remove("SETLOC_CACHE").env_remove("SETLOC_DATA").args(arguments);
    command
}

/// Runs the program to its end.
pub fn setloc(folder: &Path, arguments: &[&str]) -> Output {
    program(folder, arguments).output().unwrap()
}

/// What it said to people.
pub fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// What it gave as data.
pub fn gave(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Labels of the events of one type in a log, in their order.
pub fn logged(log: &Path, event: &str) -> Vec<String> {
    let text = std::fs::read_to_string(log).unwrap_or_default();
    let events = text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    events
        .filter(|value| value["event"] == event)
        .map(|value| format!("{} {}", value["kind"].as_str().unwrap(), value["job"].as_str().unwrap()))
        .collect()
}

/// What the images of a COLMAP model are called, among other bytes.
pub fn images_of_colmap(folder: &Path) -> String {
    String::from_utf8_lossy(&std::fs::read(folder.join("images.bin")).unwrap()).into_owned()
}

/// How many images see the first point of a COLMAP model.
pub fn first_track_of_colmap(folder: &Path) -> u64 {
    let points = std::fs::read(folder.join("points3D.bin")).unwrap();
    // After the count of points: its number, place, colour and error.
    u64::from_le_bytes(points[8 + 8 + 24 + 3 + 8..][..8].try_into().unwrap())
}

/// All files in a folder and below, sorted.
pub fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { files.extend(files_below(&path)) } else { files.push(path) }
    }
    files.sort();
    files
}
