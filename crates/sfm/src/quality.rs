//! The quality gate: what in a finished model disagrees with its own evidence.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    ImageId, PairGeometry, Reconstruction, ReconstructionPoint, TwoViewKind, visibility::is_same_view,
};

/// When to speak up.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct QualityParams {
    /// Rotation between a verified pair and the final poses that counts as disagreement, in degrees.
    pub max_rotation_deg: f64,
    /// Share of points in plain view of two cameras that they must both see.
    pub min_shared_view: f64,
    /// Points in plain view below which nothing is concluded.
    pub min_expected_points: usize,
    /// Share of an image's points that must be in plain view of the other for the two to stand together.
    pub min_expected_share: f64,
    /// Fewest points of a well supported image.
    pub min_image_points: usize,
}

impl Default for QualityParams {
    fn default() -> Self {
        Self {
            max_rotation_deg: 3.0,
            min_shared_view: 0.03,
            min_expected_points: 150,
            min_expected_share: 0.6,
            min_image_points: 50,
        }
    }
}

/// A verified pair whose own geometry the final model contradicts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairDisagreement {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Verified matches of the pair.
    pub matches: usize,
    /// Those that became one point of the model.
    pub used: usize,
    /// Angle between the pair's relative rotation and the model's, in degrees.
    pub rotation_deg: f64,
}

/// Two cameras that stand together in the model but hardly share what both ought to see: the sign of a fold.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SuspiciousNeighbours {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Points of the first that the second sees from nearly the same place.
    pub expected: usize,
    /// Those that it does see.
    pub shared: usize,
}

/// What disagrees, counted; [`Self::sentences`] says it in words.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct QualityReport {
    /// Images of this component.
    pub registered: usize,
    /// All input images.
    pub images: usize,
    /// Verified pairs within the component.
    pub pairs: usize,
    /// Pairs that the model contradicts; expected where façades repeat, as long as they are few.
    pub disagreements: Vec<PairDisagreement>,
    /// Signs of a fold.
    pub suspicious: Vec<SuspiciousNeighbours>,
    /// Registered images with few points.
    pub weak_images: Vec<(ImageId, usize)>,
}

/// Tasks that the points are counted in; each needs memory for all pairs of images.
const TASKS: usize = 4;

/// What some of the points count for.
struct Counts {
    /// Points that both of two images see, by pair.
    shared: Vec<u32>,
    /// Points of the first that the second ought to see, by pair.
    expected: Vec<u32>,
    /// By image.
    points_of: Vec<u32>,
}

/// Compares a component with the verified pairs it was built from.
pub fn assess(
    params: &QualityParams,
    reconstruction: &Reconstruction,
    pairs: &[PairGeometry],
) -> QualityReport {
    let n = reconstruction.images.len();
    let mut report = QualityReport {
        registered: reconstruction.registered().count(),
        images: n,
        ..QualityReport::default()
    };
    let center =
        |image: ImageId| reconstruction.images[image.index()].world_from_camera.map(|pose| pose.translation);
    let count = |points: &[ReconstructionPoint]| {
        let mut counts = Counts { shared: vec![0; n * n], expected: vec![0; n * n], points_of: vec![0; n] };
        let mut sees = vec![false; n];
        for point in points {
            for seen in &point.track {
                sees[seen.image.index()] = true;
                counts.points_of[seen.image.index()] += 1;
            }
            for seen in &point.track {
                let Some(observer) = center(seen.image) else { continue };
                for other in reconstruction.registered().filter(|&other| other != seen.image) {
                    let Some(candidate) = center(other) else { continue };
                    let cell = seen.image.index() * n + other.index();
                    let in_view = reconstruction.camera_of(other).is_panoramic();
                    if sees[other.index()] {
                        counts.shared[cell] += 1;
                    }
                    if in_view && is_same_view(&point.position, &observer, &candidate) {
                        counts.expected[cell] += 1;
                    }
                }
            }
            for seen in &point.track {
                sees[seen.image.index()] = false;
            }
        }
        counts
    };
    let share = reconstruction.points.len().div_ceil(TASKS).max(1);
    let parts: Vec<Counts> = reconstruction.points.par_chunks(share).with_max_len(1).map(count).collect();
    let sum = |of: fn(&Counts) -> &[u32], len: usize| {
        let mut sums = vec![0_usize; len];
        for part in &parts {
            sums.iter_mut().zip(of(part)).for_each(|(sum, value)| *sum += *value as usize);
        }
        sums
    };
    let shared = sum(|counts| &counts.shared, n * n);
    let expected = sum(|counts| &counts.expected, n * n);
    let points_of = sum(|counts| &counts.points_of, n);
    for pair in pairs {
        let poses = (
            reconstruction.images[pair.first.index()].world_from_camera,
            reconstruction.images[pair.second.index()].world_from_camera,
        );
        let (Some(first), Some(second)) = poses else { continue };
        report.pairs += 1;
        let used = shared[pair.first.index() * n + pair.second.index()];
        let rotation_deg = (second.inverse() * first)
            .rotation
            .angle_to(&pair.two_view.second_from_first.rotation)
            .to_degrees();
        let unused = used * 5 < pair.two_view.inliers.len();
        if unused || (rotation_deg > params.max_rotation_deg && pair.two_view.kind == TwoViewKind::General) {
            report.disagreements.push(PairDisagreement {
                first: pair.first,
                second: pair.second,
                matches: pair.two_view.inliers.len(),
                used,
                rotation_deg,
            });
        }
    }
    for first in reconstruction.registered() {
        for second in reconstruction.registered().filter(|&second| second > first) {
            let (forth, back) = (first.index() * n + second.index(), second.index() * n + first.index());
            let (wanted, got) = (expected[forth] + expected[back], shared[forth] + shared[back]);
            let together =
                params.min_expected_share * (points_of[first.index()] + points_of[second.index()]) as f64;
            let judged = wanted >= params.min_expected_points && wanted as f64 >= together;
            if judged && (got as f64) < params.min_shared_view * wanted as f64 {
                report.suspicious.push(SuspiciousNeighbours { first, second, expected: wanted, shared: got });
            }
        }
        if points_of[first.index()] < params.min_image_points {
            report.weak_images.push((first, points_of[first.index()]));
        }
    }
    report
}

impl QualityReport {
    /// The report in sentences, worst first; empty when nothing disagrees.
    pub fn sentences(&self, reconstruction: &Reconstruction) -> Vec<String> {
        let name = |image: ImageId| reconstruction.images[image.index()].name.as_str();
        let mut lines = Vec::new();
        for pair in &self.suspicious {
            lines.push(format!(
                "{} and {} stand together in the model but share {} of {} points that both ought to see: the scene may be folded there",
                name(pair.first),
                name(pair.second),
                pair.shared,
                pair.expected
            ));
        }
        for (image, points) in &self.weak_images {
            lines.push(format!("{} is held by {points} points only", name(*image)));
        }
        if !self.disagreements.is_empty() {
            let worst: Vec<String> = self
                .disagreements
                .iter()
                .filter(|pair| pair.used * 5 < pair.matches && pair.matches >= 100)
                .map(|pair| {
                    format!(
                        "{}–{} ({} of {} matches used)",
                        name(pair.first),
                        name(pair.second),
                        pair.used,
                        pair.matches
                    )
                })
                .collect();
            if !worst.is_empty() {
                lines.push(format!(
                    "{} of {} verified pairs contradict the model, as repeated structure does: {}",
                    self.disagreements.len(),
                    self.pairs,
                    worst.join(", ")
                ));
            }
        }
        lines
    }
}
