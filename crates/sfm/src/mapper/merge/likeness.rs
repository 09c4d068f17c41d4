//! How much of what two components ought to share was matched, measured by what each shares with itself.
//!
//! Where components meet across a gap, even right images match few of each other's points: they see them from
//! elsewhere. Where a repeated façade folds one onto the other, the images stand where others of the component do and
//! ought to match as those match each other. So each component tells how often an image of its own sees a point of the
//! rest, by how alike the views are, and that is what images of the other component are measured by.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::{
    ImageId, PointId, Rigid, Similarity,
    mapper::{
        model::{Model, ModelPoint},
        register::is_in_view,
    },
    visibility::{SAME_VIEW_ANGLE_RAD, SAME_VIEW_DISTANCE_RATIO, is_same_view},
};

const ANGLES: usize = 4;
const RATIOS: usize = 3;
const BINS: usize = ANGLES * RATIOS;
/// Points that the mean rate counts as in each bin, so that a few do not decide.
const PRIOR_POINTS: f64 = 20.0;

/// Matches that ought to be there and those that are.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Likeness {
    pub expected: f64,
    pub matched: f64,
}

impl std::ops::Add for Likeness {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { expected: self.expected + other.expected, matched: self.matched + other.matched }
    }
}

/// How alike the views of a point from two places are; smaller is more alike. `None` where they are not.
fn alikeness(point: &Vector3<f64>, observer: &Vector3<f64>, candidate: &Vector3<f64>) -> Option<usize> {
    if !is_same_view(point, observer, candidate) {
        return None;
    }
    let (to_observer, to_candidate) = (observer - point, candidate - point);
    let ratio = (to_observer.norm() / to_candidate.norm()).ln().abs() / SAME_VIEW_DISTANCE_RATIO.ln();
    let angle = to_observer.angle(&to_candidate) / SAME_VIEW_ANGLE_RAD;
    let bin = |share: f64, bins: usize| ((share * bins as f64) as usize).min(bins - 1);
    Some(bin(angle, ANGLES) * RATIOS + bin(ratio, RATIOS))
}

/// The points that a camera at this pose ought to see much as a registered neighbour of the image does, with the bin of
/// the likest view. Only points that the component would have without this image count.
fn familiar(model: &Model<'_>, image: ImageId, world_from_camera: &Rigid) -> Vec<(PointId, usize)> {
    let mut likest: Vec<(PointId, usize)> = Vec::new();
    for other in model.registered_neighbours(image) {
        let Some(pose) = &model.poses[other.index()] else { continue };
        likest.extend(model.observations_of(other).into_iter().filter_map(|(_, id)| {
            let position = model.point(id)?.position;
            Some((id, alikeness(&position, pose.center(), &world_from_camera.translation)?))
        }));
    }
    likest.sort_unstable();
    likest.dedup_by_key(|(id, _)| *id);
    let counts = |id: PointId| {
        model.point(id).is_some_and(|point| {
            point.track.iter().filter(|seen| seen.image != image).count() >= 2
                && is_in_view(model, image, world_from_camera, &point.position)
        })
    };
    likest.retain(|(id, _)| counts(*id));
    likest
}

/// The share of such points that a component's own images see, by bin.
pub(super) struct OwnRates([f64; BINS]);

impl OwnRates {
    pub fn of(model: &Model<'_>) -> Self {
        let images: Vec<ImageId> = model.registered().collect();
        let counts: Vec<([usize; BINS], [usize; BINS])> = images
            .into_par_iter()
            .with_max_len(1)
            .map(|image| {
                let (mut expected, mut seen) = ([0; BINS], [0; BINS]);
                let Some(pose) = &model.poses[image.index()] else { return (expected, seen) };
                for (id, bin) in familiar(model, image, &pose.world_from_camera) {
                    expected[bin] += 1;
                    let sees = |point: &ModelPoint| point.track.iter().any(|seen| seen.image == image);
                    seen[bin] += usize::from(model.point(id).is_some_and(sees));
                }
                (expected, seen)
            })
            .collect();
        let sum = |bin: usize| {
            counts.iter().fold((0, 0), |(expected, seen), (e, s)| (expected + e[bin], seen + s[bin]))
        };
        let all = (0..BINS).map(sum).fold((0, 0), |all, bin| (all.0 + bin.0, all.1 + bin.1));
        let mean = all.1 as f64 / all.0.max(1) as f64;
        Self(std::array::from_fn(|bin| {
            let (expected, seen) = sum(bin);
            (seen as f64 + PRIOR_POINTS * mean) / (expected as f64 + PRIOR_POINTS)
        }))
    }
}

/// What the images of `of` match of the points of `at`, whose own images see them at these rates; `matched` lists image and point.
pub(super) fn likeness(
    of: &Model<'_>,
    (at, rates): (&Model<'_>, &OwnRates),
    at_from_of: &Similarity,
    matched: &[(ImageId, PointId)],
) -> Likeness {
    let images: Vec<ImageId> = of.registered().collect();
    let counts: Vec<Likeness> = images
        .into_par_iter()
        .with_max_len(1)
        .map(|image| {
            let Some(pose) = &of.poses[image.index()] else { return Likeness::default() };
            let matched_here = matched.iter().filter(|(seen_in, _)| *seen_in == image);
            let mut matched_here: Vec<PointId> = matched_here.map(|(_, id)| *id).collect();
            matched_here.sort_unstable();
            let pose = at_from_of.transform_pose(&pose.world_from_camera);
            familiar(at, image, &pose).into_iter().fold(Likeness::default(), |sum, (id, bin)| {
                let matched = f64::from(u8::from(matched_here.binary_search(&id).is_ok()));
                sum + Likeness { expected: rates.0[bin], matched }
            })
        })
        .collect();
    counts.into_iter().fold(Likeness::default(), |sum, one| sum + one)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapper::test_street::{POINTS, Street, first_two};

    #[test]
    fn what_neighbours_see_is_familiar_once_by_the_likest_view() {
        let street = Street::new("familiar", 60, POINTS);
        let input = street.input();
        let model = first_two(&street, &input);
        let found = familiar(&model, ImageId(2), &street.poses[2]);
        assert!(found.len() > 20 && found.is_sorted_by(|a, b| a.0 < b.0), "{found:?}");
        for (id, bin) in found {
            let position = model.point(id).expect("is there").position;
            let alike = |pose: &Rigid| alikeness(&position, &pose.translation, &street.poses[2].translation);
            assert_eq!(street.poses[..2].iter().filter_map(alike).min(), Some(bin));
        }
    }

    #[test]
    fn views_are_the_less_alike_the_farther_apart() {
        let (point, observer) = (Vector3::new(0.0, 0.0, 10.0), Vector3::zeros());
        let sideways = |metres: f64| alikeness(&point, &observer, &Vector3::new(metres, 0.0, 0.0));
        let bins: Vec<_> = [0.0, 1.0, 2.0, 3.0].map(sideways).into_iter().flatten().collect();
        assert!(bins.len() == 4 && bins.is_sorted() && bins[0] == 0 && bins[3] < BINS, "{bins:?}");
        assert!(sideways(5.0).is_none());
        let ahead = |metres: f64| alikeness(&point, &observer, &Vector3::new(0.0, 0.0, metres));
        assert!(ahead(3.0) > ahead(0.0) && ahead(5.0).is_none());
    }
}
