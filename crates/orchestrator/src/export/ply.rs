use std::fmt::Write;

use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_sfm::Reconstruction;

/// Points whose lines are made at once.
const POINTS_OF_PIECE: usize = 4096;

/// Points of a model and camera centres as an ASCII PLY point cloud; cameras in the given colours.
pub fn ply(model: &Reconstruction, cameras: &[(Vector3<f64>, [u8; 3])]) -> String {
    let count = model.points.len() + cameras.len();
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    );
    let line = |lines: &mut String, (p, [r, g, b]): (Vector3<f64>, [u8; 3])| {
        // Writing to a string cannot fail.
        let _ = writeln!(lines, "{:.6} {:.6} {:.6} {r} {g} {b}", p.x, p.y, p.z);
    };
    let pieces = model.points.par_chunks(POINTS_OF_PIECE).map(|points| {
        let mut lines = String::new();
        for point in points {
            line(&mut lines, (point.position, point.color));
        }
        lines
    });
    text.extend(pieces.collect::<Vec<_>>());
    for camera in cameras {
        line(&mut text, *camera);
    }
    text
}
