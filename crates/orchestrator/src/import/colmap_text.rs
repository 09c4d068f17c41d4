//! COLMAP's text model.

use std::path::Path;

use anyhow::{Context, Result};
use setloc_sfm::Rigid;

use super::Images;
use super::cameras::{Cameras, ColmapCamera, ColmapModel};
use super::poses::{finite, world_from_camera};

/// Reads `cameras.txt`.
pub(super) fn cameras(file: &Path) -> Result<Cameras> {
    let mut cameras = Cameras::new();
    for (at, line) in read(file)?.lines().enumerate() {
        if is_content(line) {
            let place = || format!("{}, line {}", file.display(), at + 1);
            let (number, camera) = parse_camera(line).with_context(place)?;
            cameras.insert(number, camera);
        }
    }
    Ok(cameras)
}

/// Reads `images.txt`; `check` is asked for each image's camera.
pub(super) fn images(file: &Path, check: impl Fn(u32) -> Result<()>) -> Result<Images> {
    let text = read(file)?;
    let mut images = Images::new();
    let mut lines = text.lines().enumerate();
    while let Some((at, line)) = lines.next() {
        if is_content(line) {
            // Each image has a second line of points, which may be empty.
            lines.next();
            let place = || format!("{}, line {}", file.display(), at + 1);
            let (name, number, pose) = parse_image(line).with_context(place)?;
            check(number).with_context(place)?;
            images.insert(name, (number, pose));
        }
    }
    Ok(images)
}

fn read(file: &Path) -> Result<String> {
    std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))
}

/// Whether a line is neither empty nor a comment.
pub(super) fn is_content(line: &str) -> bool {
    !line.trim().is_empty() && !line.trim_start().starts_with('#')
}

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMS…`
fn parse_camera(line: &str) -> Result<(u32, ColmapCamera)> {
    let fields: Vec<&str> = line.split_whitespace().collect();
    let [number, model, width, height, params @ ..] = &fields[..] else {
        anyhow::bail!("a camera has number, model, width, height and parameters");
    };
    let params = params.iter().map(|text| finite(text)).collect::<Result<Vec<f64>>>()?;
    let size = (width.parse()?, height.parse()?);
    Ok((number.parse()?, ColmapModel::of_name(model)?.camera(size, params)?))
}

/// `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, the pose camera-from-world.
fn parse_image(line: &str) -> Result<(String, u32, Rigid)> {
    // The name may hold blanks.
    let mut name = line.trim();
    let mut fields = Vec::new();
    while let Some((field, rest)) = name.split_once(char::is_whitespace).filter(|_| fields.len() < 9) {
        fields.push(field);
        name = rest.trim_start();
    }
    let [_, numbers @ .., camera] = &fields[..] else {
        anyhow::bail!("an image has number, rotation, translation, camera and name");
    };
    let pose = world_from_camera(numbers)?;
    Ok((name.to_owned(), camera.parse()?, pose))
}
