//! The scale of a set whose pose at one place is known.

use nalgebra::{UnitQuaternion, Vector3};
use setloc_sfm::Similarity;
use setloc_sfm::solvers::triangulation::length_along;

use super::Sights;
use crate::CamsetParams;
use crate::observability::SetRay;

/// Scales within this factor of each other agree.
const SAME_SCALE: f64 = 1.03;
/// Fewest votes for a scale, and most scales that are tried.
const MIN_VOTES: usize = 3;
const MAX_SCALES: usize = 3;

/// The set's pose but for its scale: a place that both frames know.
#[derive(Debug, Clone, Copy)]
pub(super) struct About {
    pub rotation: UnitQuaternion<f64>,
    pub in_set: Vector3<f64>,
    pub in_scene: Vector3<f64>,
}

impl About {
    pub fn scaled(&self, scale: f64) -> Similarity {
        let translation = self.in_scene - self.rotation * self.in_set * scale;
        Similarity { scale, rotation: self.rotation, translation }
    }

    /// The scale at which a ray of the set meets its scene point.
    fn scale_of_ray(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        point: &Vector3<f64>,
    ) -> Option<f64> {
        let step = self.rotation * (origin - self.in_set);
        length_along(&step, &(point - self.in_scene), &(self.rotation * direction))
    }
}

impl Sights {
    /// The scales that most votes are near to, best first.
    pub(super) fn scales(&self, params: &CamsetParams, about: &About, others: &[SetRay]) -> Vec<f64> {
        let bound = params.max_error_sigmas;
        let by_points = others.iter().filter_map(|ray| {
            let scale = about.scale_of_ray(&ray.origin, &ray.direction, &ray.point)?;
            (ray.error_sigmas(&about.scaled(scale).inverse()) < bound).then_some(scale)
        });
        let by_sights = self.all.iter().filter_map(|sight| {
            let step = about.rotation * (self.positions[sight.local] - about.in_set);
            let to = sight.ray.origin - about.in_scene;
            let scale = length_along(&step, &to, &-sight.ray.direction)?;
            (to.norm() > 0.0 && self.error_sigmas(sight, &about.scaled(scale)) < bound).then_some(scale)
        });
        let by_pairs = self.lone.iter().filter_map(|lone| {
            let step = about.rotation * (lone.own.origin - about.in_set);
            let normal = (about.rotation * lone.own.direction).cross(&lone.ray.direction);
            let to = lone.ray.origin - about.in_scene;
            let scale = to.dot(&normal) / step.dot(&normal);
            (to.norm() > 0.0 && lone.error_sigmas(&about.scaled(scale)) < bound).then_some(scale)
        });
        let votes = by_points.chain(by_sights).chain(by_pairs);
        let mut scales: Vec<f64> = votes.filter(|scale| scale.is_finite() && *scale > 0.0).collect();
        scales.sort_by(f64::total_cmp);
        let mut best = Vec::new();
        while best.len() < MAX_SCALES {
            let near = |scale: f64| {
                let (low, high) = (scale / SAME_SCALE, scale * SAME_SCALE);
                scales.partition_point(|&other| other < low)..scales.partition_point(|&other| other <= high)
            };
            let most = (0..scales.len()).max_by_key(|&at| near(scales[at]).len());
            let Some(most) = most.filter(|&at| near(scales[at]).len() >= MIN_VOTES) else { break };
            best.push(scales[most]);
            let gone = near(scales[most]);
            scales.drain(gone);
        }
        best
    }
}
