use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector3;

use crate::Rays;

/// Keypoints of one image, found by the direction in which they are seen.
///
/// A kd-tree over unit bearings: the chord between two of them stands for their angle, so poles and seam are places like
/// any other.
#[derive(Debug)]
pub struct NearbyKeypoints {
    keypoints: Vec<u32>,
    /// `None` without keypoints.
    tree: Option<ImmutableKdTree<f64, 3>>,
}

impl NearbyKeypoints {
    /// Of an image's keypoints those that have a ray and are `wanted`.
    pub fn new(rays: &Rays, wanted: impl Fn(u32) -> bool) -> Self {
        let has_ray = |at: &u32| {
            let bearing = &rays.bearings[*at as usize];
            rays.sigmas[*at as usize].is_finite() && bearing.norm_squared() > 0.0
        };
        let all = 0..rays.bearings.len().min(rays.sigmas.len()) as u32;
        let keypoints: Vec<u32> = all.filter(|at| has_ray(at) && wanted(*at)).collect();
        let bearings: Vec<[f64; 3]> = keypoints.iter().map(|&at| rays.bearings[at as usize].into()).collect();
        let tree = (!bearings.is_empty()).then(|| ImmutableKdTree::new_from_slice(&bearings).ok()).flatten();
        Self { keypoints, tree }
    }

    /// The keypoints, ascending.
    pub fn keypoints(&self) -> &[u32] {
        &self.keypoints
    }

    /// The keypoints within so many radians (as a chord) of a direction of any length, ascending; none for a direction
    /// without length.
    pub fn within(&self, direction: &Vector3<f64>, radius_rad: f64) -> Vec<u32> {
        let (Some(tree), Some(direction)) = (&self.tree, direction.try_normalize(0.0)) else {
            return Vec::new();
        };
        let squared = radius_rad * radius_rad;
        let found = tree.query(&direction.into()).within::<SquaredEuclidean<f64>>(squared).execute();
        let mut near: Vec<u32> = found.into_iter().map(|item| self.keypoints[item.item as usize]).collect();
        near.sort_unstable();
        near
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keypoints_with_a_ray_are_found_near_a_direction_of_any_length() {
        let mut rays = Rays::default();
        for at in 0..400_u32 {
            let (lon, z) = (f64::from(at) * 2.4, (f64::from(at) - 199.5) / 200.0);
            let (sin, cos) = lon.sin_cos();
            let level = (1.0 - z * z).sqrt();
            rays.bearings.push(Vector3::new(level * cos, level * sin, z));
            rays.sigmas.push(if at % 10 == 7 { f64::INFINITY } else { 1e-3 });
        }
        rays.bearings[4] = Vector3::zeros();
        let nearby = NearbyKeypoints::new(&rays, |at| at != 5);
        assert!(nearby.keypoints().iter().all(|at| at % 10 != 7 && *at != 4 && *at != 5));
        for direction in [Vector3::z() * 7.0, -Vector3::z(), Vector3::new(0.2, -3.0, 0.1)] {
            let unit = direction.normalize();
            let near = |at: &&u32| (rays.bearings[**at as usize] - unit).norm() <= 0.3;
            let expected: Vec<u32> = nearby.keypoints().iter().filter(near).copied().collect();
            assert!(expected.len() > 3);
            assert_eq!(nearby.within(&direction, 0.3), expected);
        }
        assert!(nearby.within(&Vector3::zeros(), 0.3).is_empty());
        assert!(nearby.within(&Vector3::repeat(f64::NAN), 0.3).is_empty());
        assert!(NearbyKeypoints::new(&rays, |_| false).within(&Vector3::z(), 0.3).is_empty());
    }
}
