use std::io::Cursor;

use anyhow::Result;
use image::{ImageFormat, Rgb, RgbImage};
use nalgebra::{Matrix3, Vector2, Vector3};
use setloc_sfm::{Reconstruction, Rigid};

/// Side of the picture in pixels.
const SIDE: u32 = 1200;

/// A camera in the picture.
#[derive(Debug, Clone, Copy)]
pub struct Marker {
    /// Its pose.
    pub world_from_camera: Rigid,
    /// Its colour.
    pub color: [u8; 3],
    /// Whether to draw its viewing direction.
    pub directed: bool,
}

/// A picture of a model from above: points in their colours, cameras as discs.
///
/// "Above" is the direction in which the cameras' centres spread least, oriented by the cameras' own up axes: it needs
/// no georegistration. Shows the central 96 % of the points and every camera.
///
/// # Errors
/// When the picture cannot be encoded.
pub fn top_view_png(model: &Reconstruction, markers: &[Marker]) -> Result<Vec<u8>> {
    let plane_from_world = plane_of(markers);
    let flat = |p: &Vector3<f64>| (plane_from_world * p).xy();
    let points: Vec<(Vector2<f64>, [u8; 3])> =
        model.points.iter().map(|p| (flat(&p.position), p.color)).collect();
    let centres: Vec<Vector2<f64>> =
        markers.iter().map(|marker| flat(&marker.world_from_camera.translation)).collect();
    let (low, high) = bounds(&points, &centres);
    let scale = f64::from(SIDE) * 0.94 / (high - low).max().max(f64::MIN_POSITIVE);
    let middle = (low + high) / 2.0;
    let pixel = |p: &Vector2<f64>| {
        let offset = (p - middle) * scale;
        Vector2::new(f64::from(SIDE) / 2.0 + offset.x, f64::from(SIDE) / 2.0 - offset.y)
    };
    let mut picture = RgbImage::from_pixel(SIDE, SIDE, Rgb([255; 3]));
    for (position, color) in &points {
        disc(&mut picture, pixel(position), 0.8, color.map(|channel| (f32::from(channel) * 0.8) as u8));
    }
    for (marker, centre) in markers.iter().zip(&centres) {
        let at = pixel(centre);
        if marker.directed {
            let forward = (plane_from_world * (marker.world_from_camera.rotation * Vector3::z())).xy();
            for step in 0..48 {
                let along = Vector2::new(forward.x, -forward.y) * f64::from(step) * 0.6;
                disc(&mut picture, at + along, 1.2, marker.color);
            }
        }
        disc(&mut picture, at, 7.0, [255; 3]);
        disc(&mut picture, at, 5.5, marker.color);
    }
    let mut png = Cursor::new(Vec::new());
    picture.write_to(&mut png, ImageFormat::Png)?;
    Ok(png.into_inner())
}

/// Rows: right, up in the picture, towards the viewer.
fn plane_of(markers: &[Marker]) -> Matrix3<f64> {
    let up: Vector3<f64> =
        markers.iter().map(|marker| marker.world_from_camera.rotation * -Vector3::y()).sum();
    let z = up.try_normalize(1e-9).unwrap_or_else(Vector3::z);
    // North stays up where the world is east-north-up.
    let seed = if z.y.abs() < 0.9 { Vector3::y() } else { Vector3::z() };
    let y = (seed - z * z.dot(&seed)).normalize();
    Matrix3::from_rows(&[y.cross(&z).transpose(), y.transpose(), z.transpose()])
}

fn bounds(points: &[(Vector2<f64>, [u8; 3])], centres: &[Vector2<f64>]) -> (Vector2<f64>, Vector2<f64>) {
    let (mut low, mut high) = (Vector2::repeat(f64::INFINITY), Vector2::repeat(f64::NEG_INFINITY));
    for axis in 0..2 {
        let mut values: Vec<f64> =
            points.iter().map(|(p, _)| p[axis]).filter(|value| value.is_finite()).collect();
        values.sort_by(f64::total_cmp);
        let cut = values.len() / 50;
        for value in
            values[cut..values.len() - cut].iter().copied().chain(centres.iter().map(|centre| centre[axis]))
        {
            low[axis] = low[axis].min(value);
            high[axis] = high[axis].max(value);
        }
        if low[axis] > high[axis] {
            (low[axis], high[axis]) = (-1.0, 1.0);
        }
    }
    (low, high)
}

fn disc(picture: &mut RgbImage, at: Vector2<f64>, radius: f64, color: [u8; 3]) {
    let reach = radius.ceil() as i64;
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let (x, y) = (at.x.floor() as i64 + dx, at.y.floor() as i64 + dy);
            let inside = ((dx * dx + dy * dy) as f64) <= radius * radius;
            if inside && (0..i64::from(SIDE)).contains(&x) && (0..i64::from(SIDE)).contains(&y) {
                picture.put_pixel(x as u32, y as u32, Rgb(color));
            }
        }
    }
}
