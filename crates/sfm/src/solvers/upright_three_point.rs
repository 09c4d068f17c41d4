use nalgebra::{Matrix3, Vector3};

use super::polynomial::real_roots;
use super::{Solutions, essential::is_in_front};

/// Poses `second_from_first` from three pairs of bearings, where both cameras stand upright: their y axes are
/// vertical, so that `second_from_first` turns about y alone.
///
/// F. Fraundorfer, P. Tanskanen, M. Pollefeys, "A minimal case solution to the calibrated relative pose problem for the case of two
/// known orientation angles", ECCV 2010. Each pair asks t ⊥ (R·x₁) × x₂, so three normals lie in a plane: with q = tan(θ/2) a
/// sextic that 1 + q² divides. Returns rotations and unit translations, all rays in front; bearings need not be of unit length.
pub fn upright_three_point(
    first: &[Vector3<f64>; 3],
    second: &[Vector3<f64>; 3],
) -> Solutions<(Matrix3<f64>, Vector3<f64>), 4> {
    // (1 + q²)·normal = constant + linear·q + quadratic·q².
    let normals: [[Vector3<f64>; 3]; 3] = std::array::from_fn(|i| {
        let (a, b) = (&first[i], &second[i]);
        let cosine = Vector3::new(-a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y);
        let sine = Vector3::new(a.x * b.y, -a.x * b.x - a.z * b.z, a.z * b.y);
        let fixed = Vector3::new(a.y * b.z, 0.0, -a.y * b.x);
        [fixed + cosine, sine * 2.0, fixed - cosine]
    });
    let mut crossed = [Vector3::zeros(); 5];
    for (i, a) in normals[1].iter().enumerate() {
        for (j, b) in normals[2].iter().enumerate() {
            crossed[i + j] += a.cross(b);
        }
    }
    let mut sextic = [0.0; 7];
    for (i, a) in normals[0].iter().enumerate() {
        for (j, b) in crossed.iter().enumerate() {
            sextic[i + j] += a.dot(b);
        }
    }
    let [_, _, _, c3, c4, c5, c6] = sextic;
    let (r4, r3) = (c6, c5);
    let (r2, r1) = (c4 - r4, c3 - r3);
    let r0 = sextic[2] - r2;
    let mut poses = Solutions::default();
    for &q in &real_roots(&[r0, r1, r2, r3, r4]) {
        let normal = |i: usize| normals[i][0] + normals[i][1] * q + normals[i][2] * (q * q);
        let planes = [normal(0), normal(1), normal(2)];
        let crossings =
            [planes[0].cross(&planes[1]), planes[1].cross(&planes[2]), planes[2].cross(&planes[0])];
        let longest = crossings.iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
        let Some(along) = longest.and_then(|along| along.try_normalize(0.0)) else { continue };
        let scale = 1.0 / (1.0 + q * q);
        let (cosine, sine) = ((1.0 - q * q) * scale, 2.0 * q * scale);
        let rotation = Matrix3::new(cosine, 0.0, sine, 0.0, 1.0, 0.0, -sine, 0.0, cosine);
        for translation in [along, -along] {
            if first.iter().zip(second).all(|(a, b)| is_in_front(&(rotation * a), &translation, b)) {
                poses.push((rotation, translation));
            }
        }
    }
    poses
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{RelativeProblem, seeded};

    #[test]
    fn finds_the_truth() {
        let mut rng = seeded("upright three-point");
        let mut missed = 0;
        for _ in 0..100_000 {
            let problem = RelativeProblem::upright(&mut rng, 3);
            let (first, second) = problem.sample::<3>();
            let truth = problem.second_from_first;
            let rotation = truth.rotation.to_rotation_matrix().into_inner();
            let found = upright_three_point(&first, &second);
            missed += u32::from(
                !found
                    .iter()
                    .any(|(r, t)| (r - rotation).norm() < 1e-5 && (t - truth.translation).norm() < 1e-5),
            );
        }
        assert!(missed <= 10, "{missed}");
    }
}
