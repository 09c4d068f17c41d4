use std::collections::BTreeSet;

use rayon::prelude::*;
use setloc_features::{GuidedParams, Match, match_guided_among};

use crate::{
    ImageId, Observation, PointId, Similarity, mapper::model::Model, solvers::essential::essential_from_pose,
};

/// Two components: `moved` is to be put into the frame of `kept`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sides<'m, 'a> {
    pub kept: &'m Model<'a>,
    pub moved: &'m Model<'a>,
}

/// A match between images of two components, of which at least one keypoint carries a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Crossing {
    pub kept: Observation,
    pub moved: Observation,
    pub kept_point: Option<PointId>,
    pub moved_point: Option<PointId>,
    /// Whether a verified pair holds it.
    pub verified: bool,
}

/// Images of the other component that each is matched with again.
const MAX_ALIKE: usize = 3;
/// Fewest points that two images must see alike for that.
const MIN_ALIKE: usize = 20;

impl<'a> Sides<'_, 'a> {
    /// All matches between the components that say something of the similarity, each once.
    pub fn crossings(&self) -> Vec<Crossing> {
        let input = self.kept.input;
        let mut found = Vec::new();
        for pair in input.pairs {
            self.collect(pair.first, pair.second, &pair.two_view.inliers, true, &mut found);
        }
        for pair in input.putative {
            self.collect(pair.first, pair.second, &pair.matches, false, &mut found);
        }
        once(found)
    }

    /// The kept and the moved one of two images, where they are one of either.
    pub fn ends(&self, first: ImageId, second: ImageId) -> Option<(ImageId, ImageId)> {
        [(first, second), (second, first)]
            .into_iter()
            .find(|(kept, moved)| self.kept.is_registered(*kept) && self.moved.is_registered(*moved))
    }

    fn collect(
        &self,
        first: ImageId,
        second: ImageId,
        matches: &[Match],
        verified: bool,
        found: &mut Vec<Crossing>,
    ) {
        let Some((kept, moved)) = self.ends(first, second) else { return };
        let swapped = kept != first;
        let has_ray = |model: &Model<'_>, seen: Observation| {
            let sigma = model.rays[seen.image.index()].sigmas.get(seen.feature as usize);
            sigma.is_some_and(|sigma| sigma.is_finite())
        };
        for m in matches {
            let m = if swapped { m.swapped() } else { *m };
            let kept = Observation { image: kept, feature: m.first };
            let moved = Observation { image: moved, feature: m.second };
            if !has_ray(self.kept, kept) || !has_ray(self.moved, moved) {
                continue;
            }
            let (kept_point, moved_point) = (self.kept.point_of(kept), self.moved.point_of(moved));
            if kept_point.is_some() || moved_point.is_some() {
                found.push(Crossing { kept, moved, kept_point, moved_point, verified });
            }
        }
    }

    /// Matches along the epipolar circles that a similarity gives the images, of those that see most alike.
    pub fn guided(&self, kept_from_moved: &Similarity, params: &GuidedParams) -> Vec<Crossing> {
        let found: Vec<Vec<Crossing>> = self
            .like_views(kept_from_moved)
            .into_par_iter()
            .with_max_len(1)
            .map(|(kept, moved)| {
                let mut found = Vec::new();
                let (Some(of_kept), Some(of_moved)) =
                    (&self.kept.poses[kept.index()], &self.moved.poses[moved.index()])
                else {
                    return found;
                };
                let kept_from_image = kept_from_moved.transform_pose(&of_moved.world_from_camera);
                let moved_from_kept = kept_from_image.inverse() * of_kept.world_from_camera;
                let features = |model: &Model<'a>, image: ImageId| model.input.images[image.index()].features;
                let needed = [self.kept.carriers(kept), self.moved.carriers(moved)];
                let matches = match_guided_among(
                    params,
                    (features(self.kept, kept), &self.kept.rays[kept.index()]),
                    (features(self.moved, moved), &self.moved.rays[moved.index()]),
                    &essential_from_pose(&moved_from_kept),
                    [&needed[0], &needed[1]],
                );
                self.collect(kept, moved, &matches, false, &mut found);
                found
            })
            .collect();
        found.into_iter().flatten().collect()
    }

    /// Pairs of a kept and a moved image: for each image those few of the other component that see most points much as
    /// it would.
    fn like_views(&self, kept_from_moved: &Similarity) -> Vec<(ImageId, ImageId)> {
        let mut alike: Vec<(ImageId, ImageId)> = Vec::new();
        let sides = [
            (self.kept, self.moved, kept_from_moved.inverse(), false),
            (self.moved, self.kept, *kept_from_moved, true),
        ];
        for (of, others, others_from_of, swapped) in sides {
            for image in of.registered() {
                let Some(pose) = &of.poses[image.index()] else { continue };
                let center = others_from_of.transform_point(pose.center());
                let mut ranked: Vec<(usize, ImageId)> = others
                    .registered_neighbours(image)
                    .into_par_iter()
                    .with_max_len(1)
                    .map(|other| (others.points_seen_alike(other, &center), other))
                    .filter(|(count, _)| *count >= MIN_ALIKE)
                    .collect();
                ranked.sort_by_key(|&(count, other)| (std::cmp::Reverse(count), other));
                let pair = |other| if swapped { (other, image) } else { (image, other) };
                alike.extend(ranked.into_iter().take(MAX_ALIKE).map(|(_, other)| pair(other)));
            }
        }
        alike.sort_unstable();
        alike.dedup();
        alike
    }

    /// Errors of a match under a similarity, in standard deviations: of the moved ray and of the kept one.
    fn errors(&self, crossing: &Crossing, poses: &BothWays) -> [Option<f64>; 2] {
        let point = |model: &Model<'_>, id: Option<PointId>| Some(model.point(id?)?.position);
        let of_moved = point(self.kept, crossing.kept_point).and_then(|position| {
            self.moved.error_sigma(crossing.moved, &poses.moved_from_kept.transform_point(&position))
        });
        let of_kept = point(self.moved, crossing.moved_point).and_then(|position| {
            self.kept.error_sigma(crossing.kept, &poses.kept_from_moved.transform_point(&position))
        });
        [of_moved, of_kept]
    }

    /// Truncated squared errors in units of the squared bound, over all matches.
    pub fn score(&self, crossings: &[Crossing], kept_from_moved: &Similarity, bound: f64) -> f64 {
        let poses = BothWays::new(kept_from_moved);
        let truncated = |error: f64| (error / bound).powi(2).min(1.0);
        crossings
            .iter()
            .flat_map(|crossing| self.errors(crossing, &poses).into_iter().flatten())
            .map(|error| if error.is_nan() { 1.0 } else { truncated(error) })
            .sum()
    }

    /// The matches all of whose rays agree with a similarity.
    pub fn agreeing(
        &self,
        crossings: &[Crossing],
        kept_from_moved: &Similarity,
        bound: f64,
    ) -> Vec<Crossing> {
        let poses = BothWays::new(kept_from_moved);
        let agrees = |crossing: &&Crossing| {
            let errors = self.errors(crossing, &poses);
            errors.iter().flatten().all(|error| *error <= bound) && errors.iter().flatten().count() > 0
        };
        crossings.iter().filter(agrees).copied().collect()
    }
}

struct BothWays {
    kept_from_moved: Similarity,
    moved_from_kept: Similarity,
}

impl BothWays {
    fn new(kept_from_moved: &Similarity) -> Self {
        Self { kept_from_moved: *kept_from_moved, moved_from_kept: kept_from_moved.inverse() }
    }
}

/// Each match once, as a verified one where it is.
pub(super) fn once(mut found: Vec<Crossing>) -> Vec<Crossing> {
    found.sort_by_key(|crossing| (crossing.kept, crossing.moved, !crossing.verified));
    found.dedup_by_key(|crossing| (crossing.kept, crossing.moved));
    found
}

/// How many things in space the matches hold: of all matches between the tracks of two points, one counts.
pub(super) fn distinct(crossings: &[Crossing]) -> usize {
    let key = |id: Option<PointId>, seen: Observation| (id, id.is_none().then_some(seen));
    let (mut kept, mut moved) = (BTreeSet::new(), BTreeSet::new());
    let mut is_new = |crossing: &&Crossing| {
        let of_kept = kept.insert(key(crossing.kept_point, crossing.kept));
        let of_moved = moved.insert(key(crossing.moved_point, crossing.moved));
        of_kept && of_moved
    };
    crossings.iter().filter(|crossing| is_new(crossing)).count()
}
