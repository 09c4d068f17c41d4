//! The scale of a set whose pose at one place is known.

use nalgebra::{UnitQuaternion, Vector3};
use setloc_sfm::solvers::triangulation::length_along;
use setloc_sfm::{Rigid, Similarity};

use crate::observability::SetRay;

/// Scales within this factor of each other agree.
const SAME_SCALE: f64 = 1.03;
/// Fewest votes for a scale.
const MIN_VOTES: usize = 3;

/// The set's pose but for its scale: a place that both frames know.
#[derive(Debug, Clone, Copy)]
pub(crate) struct About {
    pub rotation: UnitQuaternion<f64>,
    pub in_set: Vector3<f64>,
    pub in_scene: Vector3<f64>,
}

impl About {
    /// A photo's centre, whose place in the scene and the set's axes there are given.
    pub(crate) fn photo(axes_at_photo: &Rigid, in_set: Vector3<f64>) -> Self {
        Self { rotation: axes_at_photo.rotation, in_set, in_scene: axes_at_photo.translation }
    }

    /// The pose at this scale.
    pub(crate) fn scaled(&self, scale: f64) -> Similarity {
        let translation = self.in_scene - self.rotation * self.in_set * scale;
        Similarity { scale, rotation: self.rotation, translation }
    }

    /// The way from the place to another of the set, at scale one in the scene.
    pub(crate) fn step(&self, to: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * (to - self.in_set)
    }

    /// The scales at which rays of the set meet their scene points, where they do.
    pub(crate) fn scales_of_rays<'r>(
        &'r self,
        rays: &'r [SetRay],
        max_error_sigmas: f64,
    ) -> impl Iterator<Item = f64> + 'r {
        rays.iter().filter_map(move |ray| {
            let direction = self.rotation * ray.direction;
            let scale = length_along(&self.step(&ray.origin), &(ray.point - self.in_scene), &direction)?;
            (ray.error_sigmas(&self.scaled(scale).inverse()) < max_error_sigmas).then_some(scale)
        })
    }
}

/// Up to so many scales that most others are near to, best first.
pub(crate) fn most_voted(mut scales: Vec<f64>, most: usize) -> Vec<f64> {
    scales.sort_by(f64::total_cmp);
    let mut best = Vec::new();
    while best.len() < most {
        let near = |scale: f64| {
            let (low, high) = (scale / SAME_SCALE, scale * SAME_SCALE);
            scales.partition_point(|&other| other < low)..scales.partition_point(|&other| other <= high)
        };
        let winner = (0..scales.len()).max_by_key(|&at| near(scales[at]).len());
        let Some(winner) = winner.filter(|&at| near(scales[at]).len() >= MIN_VOTES) else { break };
        best.push(scales[winner]);
        let gone = near(scales[winner]);
        scales.drain(gone);
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scales_that_most_agree_on_come_first() {
        let votes = vec![5.0, 1.0, 1.01, 0.4, 1.02, 2.0, 2.01, 1.99, 2.02, 9.0];
        let best = most_voted(votes.clone(), 3);
        assert_eq!(best.len(), 2, "two do not make a scale: {best:?}");
        assert!((best[0] - 2.0).abs() < 0.03 && (best[1] - 1.01).abs() < 0.02, "{best:?}");
        assert_eq!(most_voted(votes, 1).len(), 1);
        assert!(most_voted(vec![1.0, 2.0, 3.0], 1).is_empty());
    }
}
