//! Matches of keypoints whose place in the other image is expected.

use nalgebra::Vector3;
use setloc_features::{ImageFeatures, Match, Rays, squared_distance};

/// The keypoints of an image, by their place.
pub(super) struct Nearby<'a> {
    features: &'a ImageFeatures,
    rays: &'a Rays,
    /// Keypoints with a ray, by the first coordinate of their bearings.
    order: Vec<u32>,
}

impl<'a> Nearby<'a> {
    pub fn new(features: &'a ImageFeatures, rays: &'a Rays) -> Self {
        let mut order: Vec<u32> = (0..features.len() as u32)
            .filter(|&at| {
                rays.sigmas[at as usize].is_finite() && rays.bearings[at as usize] != Vector3::zeros()
            })
            .collect();
        order.sort_by(|&a, &b| {
            rays.bearings[a as usize].x.total_cmp(&rays.bearings[b as usize].x).then(a.cmp(&b))
        });
        Self { features, rays, order }
    }

    /// The keypoint within `radius_rad` of a direction (any length) that resembles the descriptor most, with its squared
    /// distance, where that is at most `most`.
    fn best(
        &self,
        direction: &Vector3<f64>,
        radius_rad: f64,
        descriptor: &[u8],
        most: u32,
    ) -> Option<(u32, u32)> {
        let direction = direction.try_normalize(0.0)?;
        let bearing = |at: u32| &self.rays.bearings[at as usize];
        let from = self.order.partition_point(|&at| bearing(at).x < direction.x - radius_rad);
        let near = self.order[from..].iter().take_while(|&&at| bearing(at).x <= direction.x + radius_rad);
        near.filter(|&&at| (bearing(at) - direction).norm_squared() <= radius_rad * radius_rad)
            .map(|&at| (squared_distance(descriptor, self.features.descriptor(at as usize)), at))
            .filter(|&(distance, _)| distance <= most)
            .min()
            .map(|(distance, at)| (at, distance))
    }

    /// Matches of keypoints of another image that are expected in these directions; each keypoint of both once.
    pub fn matches(
        &self,
        first: &ImageFeatures,
        expected: &[(u32, Vector3<f64>)],
        radius_rad: f64,
        most: u32,
    ) -> Vec<Match> {
        let mut found: Vec<(u32, u32, u32)> = expected
            .iter()
            .filter_map(|(at, direction)| {
                let (second, distance) =
                    self.best(direction, radius_rad, first.descriptor(*at as usize), most)?;
                Some((second, distance, *at))
            })
            .collect();
        found.sort_unstable();
        found.dedup_by_key(|(second, ..)| *second);
        let mut matches: Vec<Match> =
            found.iter().map(|&(second, _, first)| Match { first, second }).collect();
        matches.sort_unstable();
        matches
    }
}
