//! Matches of keypoints whose place in the other image is expected.

use nalgebra::Vector3;
use setloc_features::{ImageFeatures, Match, NearbyKeypoints, Rays, squared_distance};

/// The keypoints of an image, by their place.
pub(super) struct Nearby<'a> {
    features: &'a ImageFeatures,
    keypoints: NearbyKeypoints,
}

impl<'a> Nearby<'a> {
    pub fn new(features: &'a ImageFeatures, rays: &Rays) -> Self {
        Self { features, keypoints: NearbyKeypoints::new(rays, |_| true) }
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
        let near = self.keypoints.within(direction, radius_rad).into_iter();
        near.map(|at| (squared_distance(descriptor, self.features.descriptor(at as usize)), at))
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
