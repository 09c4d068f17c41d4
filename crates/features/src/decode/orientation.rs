use nalgebra::Vector2;

use crate::{Camera, CameraModel, ParamRole};

/// Whether this EXIF orientation exchanges width and height.
pub(super) fn swaps_sides(orientation: u8) -> bool {
    (5..=8).contains(&orientation)
}

/// Turns pixels of so many bytes upright by the EXIF orientation (1 to 8; TIFF 6.0 tag 274).
pub(super) fn upright(
    orientation: u8,
    (width, height): (u32, u32),
    values: Vec<u8>,
    per_pixel: usize,
) -> (u32, u32, Vec<u8>) {
    if !(2..=8).contains(&orientation) {
        return (width, height, values);
    }
    let (w, h) = (width as usize, height as usize);
    let (out_w, out_h) = if swaps_sides(orientation) { (h, w) } else { (w, h) };
    let mut turned = Vec::with_capacity(values.len());
    for y in 0..out_h {
        for x in 0..out_w {
            let (column, row) = match orientation {
                2 => (w - 1 - x, y),
                3 => (w - 1 - x, h - 1 - y),
                4 => (x, h - 1 - y),
                5 => (y, x),
                6 => (y, h - 1 - x),
                7 => (w - 1 - y, h - 1 - x),
                _ => (w - 1 - y, x),
            };
            let at = (row * w + column) * per_pixel;
            turned.extend_from_slice(&values[at..at + per_pixel]);
        }
    }
    (out_w as u32, out_h as u32, turned)
}

/// The camera of an image that is turned upright, of that of its stored pixels; `None` where no camera of the model is that.
///
/// Directions turn, or are mirrored, with the pixels: focal lengths change places with the sides, radial terms stay, and
/// tangential ones turn as a vector.
pub fn upright_camera(orientation: u8, stored: &Camera) -> Option<Camera> {
    if !(2..=8).contains(&orientation) {
        return Some(stored.clone());
    }
    let swaps = swaps_sides(orientation);
    if stored.is_panoramic() || (stored.model == CameraModel::PaperRectilinear && swaps) {
        return None;
    }
    let (mirrors_x, mirrors_y) = mirrors(orientation);
    // The stored sides are mirrored before they are exchanged.
    let upright = |vector: Vector2<f64>| if swaps { vector.yx() } else { vector };
    let signs = Vector2::new(if mirrors_x { -1.0 } else { 1.0 }, if mirrors_y { -1.0 } else { 1.0 });
    let mut camera = stored.clone();
    (camera.width, camera.height) =
        if swaps { (stored.height, stored.width) } else { (stored.width, stored.height) };
    let roles = stored.param_roles();
    if let [ParamRole::Focal, ParamRole::Focal, ..] = roles
        && swaps
    {
        camera.params.swap(0, 1);
    }
    let at = roles.iter().position(|role| *role == ParamRole::PrincipalPoint)?;
    let center = Vector2::new(stored.params[at], stored.params[at + 1]);
    let size = Vector2::new(f64::from(stored.width), f64::from(stored.height));
    let far = |mirrored: bool, length: f64| if mirrored { length } else { 0.0 };
    let corner = Vector2::new(far(mirrors_x, size.x), far(mirrors_y, size.y));
    let center = upright(corner + center.component_mul(&signs));
    camera.params[at..at + 2].copy_from_slice(center.as_slice());
    if stored.model == CameraModel::Opencv {
        // p2 is along x, p1 along y.
        let tangential = upright(Vector2::new(stored.params[7], stored.params[6]).component_mul(&signs));
        (camera.params[7], camera.params[6]) = (tangential.x, tangential.y);
    }
    Some(camera)
}

/// Whether columns and rows of the stored pixels are mirrored, before sides are exchanged.
fn mirrors(orientation: u8) -> (bool, bool) {
    (matches!(orientation, 2 | 3 | 7 | 8), matches!(orientation, 3 | 4 | 6 | 7))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stored place, or direction, in the upright image of such a size.
    fn turned(orientation: u8, (x, y): (f64, f64), (w, h): (f64, f64)) -> Vector2<f64> {
        let (x, y) = match orientation {
            2 => (w - x, y),
            3 => (w - x, h - y),
            4 => (x, h - y),
            5 => (y, x),
            6 => (h - y, x),
            7 => (h - y, w - x),
            8 => (y, w - x),
            _ => (x, y),
        };
        Vector2::new(x, y)
    }

    #[test]
    fn cameras_turn_as_the_pixels_do() {
        let of = |model, params: &[f64]| Camera { model, width: 96, height: 64, params: params.to_vec() };
        let cameras = [
            of(CameraModel::SimpleRadial, &[80.0, 50.0, 30.0, -0.1]),
            of(CameraModel::Opencv, &[80.0, 70.0, 50.0, 30.0, -0.1, 0.02, 0.01, -0.02]),
            of(CameraModel::OpencvFisheye, &[80.0, 70.0, 50.0, 30.0, -0.1, 0.02, 0.01, -0.02]),
        ];
        for (camera, orientation) in cameras.iter().flat_map(|camera| (1..=8).map(move |o| (camera, o))) {
            let upright = upright_camera(orientation, camera).unwrap();
            let numbered: Vec<u8> = (0..96 * 64).map(|at| (at % 251) as u8).collect();
            let (width, height, pixels) = super::upright(orientation, (96, 64), numbered.clone(), 1);
            assert_eq!((upright.width, upright.height), (width, height));
            for (column, row) in [(10_usize, 7_usize), (90, 55), (40, 60)] {
                let place = (column as f64 + 0.5, row as f64 + 0.5);
                let pixel = turned(orientation, place, (96.0, 64.0));
                let at = pixel.y as usize * width as usize + pixel.x as usize;
                assert_eq!(pixels[at], numbered[row * 96 + column]);
                let stored = camera.unproject(&Vector2::new(place.0, place.1)).unwrap();
                let ray = turned(orientation, (stored.x, stored.y), (0.0, 0.0));
                let off = upright.unproject(&pixel).unwrap() - ray.push(stored.z);
                assert!(off.norm() < 1e-9, "{:?} {orientation}: {off}", camera.model);
            }
        }
    }

    #[test]
    fn panoramas_on_their_side_have_no_camera() {
        let panorama = Camera::equirectangular(96, 48);
        assert_eq!(upright_camera(1, &panorama), Some(panorama.clone()));
        assert_eq!(upright_camera(6, &panorama), None);
    }
}
