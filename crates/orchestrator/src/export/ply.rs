use std::fmt::Write;

use nalgebra::Vector3;
use setloc_sfm::Reconstruction;

/// Points of a model and camera centres as an ASCII PLY point cloud; cameras in the given colours.
pub fn ply(model: &Reconstruction, cameras: &[(Vector3<f64>, [u8; 3])]) -> String {
    let count = model.points.len() + cameras.len();
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    );
    let points = model.points.iter().map(|point| (point.position, point.color));
    for (p, [r, g, b]) in points.chain(cameras.iter().copied()) {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{:.6} {:.6} {:.6} {r} {g} {b}", p.x, p.y, p.z);
    }
    text
}
