use std::collections::BTreeSet;

use setloc_features::Match;

use crate::{ImageId, Observation, PointId, Similarity, mapper::model::Model};

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

impl Sides<'_, '_> {
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
        found.sort_by_key(|crossing| (crossing.kept, crossing.moved, !crossing.verified));
        found.dedup_by_key(|crossing| (crossing.kept, crossing.moved));
        found
    }

    fn collect(
        &self,
        first: ImageId,
        second: ImageId,
        matches: &[Match],
        verified: bool,
        found: &mut Vec<Crossing>,
    ) {
        let (kept, moved, swapped) = if self.kept.is_registered(first) && self.moved.is_registered(second) {
            (first, second, false)
        } else if self.kept.is_registered(second) && self.moved.is_registered(first) {
            (second, first, true)
        } else {
            return;
        };
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
