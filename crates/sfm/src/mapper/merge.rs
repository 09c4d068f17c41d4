//! Components that are parts of one place, joined.
//!
//! Images that none of the others could be resected to one by one start a component of their own. Together they know
//! more: the rays of all of them to the other component's points, and the points of both, determine rotation,
//! translation and scale between the two as those of a camera set to a scene (a generalized camera; J. Ventura,
//! C. Arth, G. Reitmayr, D. Schmalstieg, "A minimal solution to the generalized pose-and-scale problem", CVPR 2014).
//! Two places that share a façade are joined by perfect matches, too, and a folded model is worse than two halves, so
//! what stands against single images in the wrong place is asked of the whole component, before and after everything
//! has been adjusted together.

mod crossing;
mod hung;
mod likeness;
mod local;
mod similarity;

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet},
    sync::OnceLock,
};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::GuidedParams;

use self::{
    crossing::{Crossing, Sides, distinct, once},
    hung::Outcome,
    likeness::{Likeness, OwnRates, likeness},
    similarity::Sights,
};
use super::{
    Mapper, MapperInput, MapperParams, MapperReport,
    adjust::{MIN_ADJUSTABLE_POINTS, Scope},
    depths::is_indoors,
    latecomers::belongs_elsewhere,
    model::{Model, ModelPoint},
    neighbours::{Neighbours, are_strangers, neighbours, share_as_neighbours},
    parts::{Part, Parts},
    register::{Visibility, visibility, visibility_beside},
    structure::{complete_and_merge, connect},
    support::Support,
};
use crate::{
    ImageId, PointId, Rigid, Similarity,
    robust::{RansacParams, median},
};

/// What became of two components that matches cross.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum MergeVerdict {
    /// They are one now.
    Joined,
    /// They are one now, by a pair whose length depths tell.
    Hung,
    /// Too few matches agree on a similarity.
    Unsupported,
    /// The matches that agree leave the scale open.
    ScaleOpen,
    /// Too little was matched of what either ought to see of the other.
    NotRecognized,
    /// The rotations of verified pairs disagree.
    PairsDisagree,
    /// Images that come to stand next to each other share next to nothing.
    Strangers,
    /// The measured positions disagree.
    PositionsDisagree,
    /// Two different similarities are as good.
    Ambiguous,
    /// The adjustment of both together contradicts it.
    Contradicted,
}

/// What two components that were joined by matches were told to be of one place by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Recognition {
    /// Most of what either ought to see of the other was matched.
    Likeness,
    /// So many matches agree that walls are what hides the rest.
    Strength,
    /// Images that stand next to each other share what neighbours do.
    Neighbours,
}

/// An attempt to join two components.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MergeRecord {
    /// The first image of each component, the larger one first.
    pub first_images: [ImageId; 2],
    /// Images of each.
    pub images: [usize; 2],
    /// What became of it.
    pub verdict: MergeVerdict,
    /// What told that they are of one place, where they were [joined](MergeVerdict::Joined).
    pub recognition: Option<Recognition>,
    /// Matches between them, of which at least one keypoint carries a point; those of one point with one other count
    /// once.
    pub candidates: usize,
    /// Those that agree with the best similarity.
    pub inliers: usize,
    /// Points of the larger component in plain view of the smaller one's images, and of the smaller in that of the
    /// larger one's.
    pub expected: [usize; 2],
    /// Those of them that were matched.
    pub matched: [usize; 2],
    /// Directions with points in plain view, over all images.
    pub expected_cells: [usize; 2],
    /// Directions among them in which any was matched.
    pub matched_cells: [usize; 2],
    /// Matches that there would be if the images matched the other component as they match their own.
    pub expected_matches: f64,
    /// Those that there are, of all that could be found.
    pub found_matches: f64,
}

impl MergeRecord {
    /// What was joined and why, in words; `None` when nothing was.
    pub fn sentence(&self) -> Option<String> {
        let [larger, smaller] = self.images;
        if self.verdict == MergeVerdict::Hung {
            return Some(format!(
                "parts of {larger} and {smaller} images were joined by {} matches of pairs that no third image sees, \
                 as far apart as what lies beside them says",
                self.inliers
            ));
        }
        let (found, expected) = (self.found_matches, self.expected_matches);
        let shared = match self.recognition? {
            Recognition::Likeness => {
                format!("they share {found:.0} of the {expected:.0} views of points that they ought to")
            }
            Recognition::Strength => format!(
                "that is many for the {expected:.0} views of points that there would be with nothing between, of which \
                 they share {found:.0}"
            ),
            Recognition::Neighbours => format!(
                "panoramas that stand next to each other share what neighbours do (of the {expected:.0} views of points \
                 that there would be with nothing between, {found:.0})"
            ),
        };
        Some(format!(
            "parts of {larger} and {smaller} images were joined: {} matches between them agree on one place, and {shared}",
            self.inliers
        ))
    }
}

/// How many times as many matches as when they were tried in vain make two parts worth another try at once.
const MIN_GROWTH: f64 = 1.1;
/// Fewest matches of a similarity that more are sought for.
const MIN_SEED: usize = 6;
/// Half widths of the bands about the epipolar circles in which they are sought, one after the other.
const GUIDED_BANDS_RAD: [f64; 3] = [0.02, 0.008, 0.004];
/// Matches of an image that make it count for the scale between two components: one more than its pose needs.
const IMAGE_MATCHES: usize = 4;
/// Largest standard deviation of the logarithm of the scale between two components.
const MAX_LOG_SCALE_SIGMA: f64 = 0.05;
/// Fewest matches that likeness must expect to judge by it.
const MIN_EXPECTED_MATCHES: f64 = 10.0;
/// Smallest share of the matches expected by likeness.
const MIN_LIKENESS: f64 = 0.3;
/// Images of a part of which only those at the seam are adjusted before a join is judged.
const LARGE_PART: usize = 100;
/// Share from which two parts are of one place whatever images that come to stand next to each other share.
const CLEAR_LIKENESS: f64 = 0.5;
/// The same where most pairs across have the rotation that the similarity gives them.
const MIN_LIKENESS_OF_PAIRS: f64 = 0.2;
/// Share of the verified matches across that are of such pairs where these are most.
const CLEAR_AGREEMENT: f64 = 0.6;
/// Matches that agree, as a share of those expected by likeness, from which two are of one place though walls hide most of what
/// is expected: of hypotheses for parts of rendered streets right ones have 0.11 or more, wrong ones at the most 0.06; of a real
/// one a wrong one has 0.14.
const MIN_STRENGTH: f64 = 0.2;
/// The same where most pairs across have the rotation that the similarity gives them.
const MIN_STRENGTH_OF_PAIRS: f64 = 0.1;
/// Fewest matches that must agree for that, whatever is expected.
const MIN_STRONG: usize = 60;
/// What is asked of two parts is out of reach where after the widest band less than this share of it agrees: the narrower ones
/// show half as much again. Right hypotheses have 0.11 or more there.
const MIN_HOPE: f64 = 0.05;
/// How many times more matches must agree when too little is in plain view to be judged by.
const UNJUDGED_SUPPORT: usize = 2;
/// Two similarities that differ by less than this share of the distance to what is seen are one.
const SAME_PLACE: f64 = 0.2;
/// Error of measured positions that proves nothing, in metres.
const MAX_POSITION_ERROR_M: f64 = 15.0;
/// The same as a share of the measured distance.
const MAX_POSITION_ERROR_SHARE: f64 = 0.3;
/// One in so many images of a component may not fit the whole: it may have come in wrongly, at the component's end say.
const UNFIT_ONE_IN: usize = 8;
/// Smallest share of each component's own observations that the adjustment of both together must keep.
const MIN_KEPT_OBSERVATIONS: f64 = 0.9;

impl<'a> Parts<'a> {
    /// Joins parts as long as a similarity between two of them is supported.
    ///
    /// A whole is finished when nothing more joins it: that takes far longer than all else about a join.
    pub fn join_supported(&mut self) {
        let (mut tried, mut models) = (Tried::default(), ModelsOfParts::new());
        let mut joined_images = BTreeSet::new();
        loop {
            self.sort();
            let found = self.first_joined(Evidence::Matches, &mut tried, &mut models);
            let Some((kept, moved, Outcome::Joined(joined))) = found else { break };
            joined_images.extend(joined.component.registered());
            self.all[kept] = joined;
            self.all.remove(moved);
        }
        drop(models);
        for at in 0..self.all.len() {
            if self.all[at].component.registered().any(|image| joined_images.contains(&image)) {
                self.rework(at, Mapper::finish);
            }
        }
        self.sort();
    }

    /// Joins parts of panoramas by single pairs whose length depths tell, largest first; whether any were joined.
    pub fn join_hung(&mut self) -> bool {
        let (mut tried, mut models) = (Tried::default(), ModelsOfParts::new());
        let mut has_joined = false;
        loop {
            self.sort();
            let found = self.first_joined(Evidence::Depths, &mut tried, &mut models);
            let Some((kept, moved, outcome)) = found else { break };
            match outcome {
                Outcome::Joined(joined) => {
                    self.all[kept] = joined;
                    self.all.remove(moved);
                    has_joined = true;
                }
                Outcome::Strangers(strangers) => {
                    let mut apart = self.all[moved].clone();
                    let others: Vec<ImageId> =
                        apart.component.registered().filter(|image| !strangers.contains(image)).collect();
                    apart.component.leave_out(&others);
                    self.all[moved].component.leave_out(&strangers);
                    self.all.push(apart);
                    self.all.retain(|part| part.size() >= 2);
                }
            }
        }
        has_joined
    }

    /// What comes of the first two parts that something comes of, and which these are; their models are then forgotten, as they
    /// change.
    ///
    /// Two that were tried in vain come last, unless one of them has since grown by much that the other matches.
    fn first_joined(
        &mut self,
        by: Evidence,
        tried: &mut Tried,
        models: &mut ModelsOfParts<'a>,
    ) -> Option<(usize, usize, Outcome)> {
        for part in &self.all {
            models.entry(part.first()).or_default();
        }
        let mut put_off = Vec::new();
        for parts in self.two_by_two(by) {
            let [larger, smaller] = parts.map(|part| &self.all[part]);
            let is_outdoors = || !is_indoors(models[&larger.first()].model(self.input, larger));
            let is_tried = tried.states.contains(&[larger.state(), smaller.state()]);
            if is_tried || matches!(by, Evidence::Depths) && is_outdoors() {
                continue;
            }
            let (matches, growth) = match by {
                Evidence::Matches => {
                    let matches = self.attempt(parts, models).sides.crossings().len();
                    (matches, tried.growth([larger, smaller], matches))
                }
                Evidence::Depths => (0, f64::INFINITY),
            };
            if growth < MIN_GROWTH {
                put_off.push((growth, parts, matches));
            } else if let Some(outcome) = self.outcome(by, (parts, matches), tried, models) {
                return Some(self.forgetting(models, parts, outcome));
            }
        }
        put_off.sort_by(|one, other| other.0.total_cmp(&one.0));
        for (_, parts, matches) in put_off {
            if let Some(outcome) = self.outcome(by, (parts, matches), tried, models) {
                return Some(self.forgetting(models, parts, outcome));
            }
        }
        None
    }

    /// All parts two by two, the larger of each first.
    ///
    /// Those that one verified pair has most matches between come first, and of others the larger: where a wrong place and the
    /// right one both pass, the whole that the right one makes leaves no room for the wrong.
    fn two_by_two(&self, by: Evidence) -> Vec<[usize; 2]> {
        let count = self.all.len();
        let mut two: Vec<[usize; 2]> =
            (0..count).flat_map(|kept| (kept + 1..count).map(move |moved| [kept, moved])).collect();
        if matches!(by, Evidence::Matches) {
            let mut part_of = vec![None; self.input.images.len()];
            for (at, part) in self.all.iter().enumerate() {
                part.component.registered().for_each(|image| part_of[image.index()] = Some(at));
            }
            let mut strongest = BTreeMap::new();
            for pair in self.input.pairs {
                let [Some(one), Some(other)] = [pair.first, pair.second].map(|image| part_of[image.index()])
                else {
                    continue;
                };
                let most: &mut usize = strongest.entry([one.min(other), one.max(other)]).or_default();
                *most = pair.two_view.inliers.len().max(*most);
            }
            two.sort_by_key(|parts| Reverse(strongest.get(parts).copied().unwrap_or(0)));
        }
        two
    }

    fn attempt<'p>(&'p self, parts: [usize; 2], models: &'p ModelsOfParts<'a>) -> Attempt<'p, 'p, 'a> {
        let [kept, moved] = parts.map(|part| &self.all[part]);
        let known = [kept, moved].map(|part| (&models[&part.first()], part));
        let [of_kept, of_moved] = known.map(|(known, part)| known.model(self.input, part));
        Attempt {
            params: self.params,
            kept,
            moved,
            sides: Sides { kept: of_kept, moved: of_moved },
            rates: known.map(|(known, _)| &known.rates),
            seed: self.seed,
        }
    }

    /// What comes of two parts that so many matches cross, which are noted as tried.
    fn outcome(
        &mut self,
        by: Evidence,
        (parts, matches): ([usize; 2], usize),
        tried: &mut Tried,
        models: &ModelsOfParts<'a>,
    ) -> Option<Outcome> {
        tried.states.insert(parts.map(|part| self.all[part].state()));
        let taken = self.taken_by_all_but(&parts);
        let mut report = std::mem::take(&mut self.report);
        let attempt = self.attempt(parts, models);
        let outcome = match by {
            Evidence::Matches => attempt.run(&taken, &mut report).map(Outcome::Joined),
            Evidence::Depths => attempt.run_hung(taken, &mut report.merges),
        };
        self.report = report;
        if outcome.is_none() {
            tried.fail(parts.map(|part| &self.all[part]), matches);
        }
        outcome
    }

    /// An outcome and its parts, whose models are forgotten.
    fn forgetting(
        &self,
        models: &mut ModelsOfParts<'a>,
        [kept, moved]: [usize; 2],
        outcome: Outcome,
    ) -> (usize, usize, Outcome) {
        for changed in [kept, moved] {
            models.remove(&self.all[changed].first());
        }
        (kept, moved, outcome)
    }
}

/// Which parts were tried.
#[derive(Default)]
struct Tried {
    /// As they were then.
    states: BTreeSet<[PartState; 2]>,
    /// First images of two in vain, and the matches between them then.
    in_vain: Vec<([ImageId; 2], usize)>,
}

impl Tried {
    /// How many times as many matches there are between two parts as when any two of which they were made were tried in vain.
    fn growth(&self, parts: [&Part; 2], matches: usize) -> f64 {
        let has = |part: usize, image: ImageId| {
            parts[part].component.images[image.index()].world_from_camera.is_some()
        };
        let are_of =
            |[one, other]: [ImageId; 2]| has(0, one) && has(1, other) || has(0, other) && has(1, one);
        let before =
            self.in_vain.iter().filter(|(images, _)| are_of(*images)).map(|(_, matches)| *matches).max();
        before.map_or(f64::INFINITY, |before| matches as f64 / before.max(1) as f64)
    }

    fn fail(&mut self, parts: [&Part; 2], matches: usize) {
        if let [Some(one), Some(other)] = parts.map(Part::first) {
            self.in_vain.push(([one, other], matches));
        }
    }
}

/// What tells a part from all others and from itself before it grew: its first image and its size.
pub(super) type PartState = (Option<ImageId>, usize);

/// What was made of parts, by their first images: to make it takes long, and most parts stay as they are when two become one.
type ModelsOfParts<'a> = BTreeMap<Option<ImageId>, ModelOfPart<'a>>;

/// The model of a part and what its images see of its points, once something asks for it.
#[derive(Default)]
struct ModelOfPart<'a> {
    model: OnceLock<Model<'a>>,
    rates: OnceLock<OwnRates>,
}

impl<'a> ModelOfPart<'a> {
    fn model(&self, input: &'a MapperInput<'a>, part: &Part) -> &Model<'a> {
        self.model.get_or_init(|| Model::of_component(input, &part.component))
    }
}

/// What parts are joined by.
#[derive(Debug, Clone, Copy)]
enum Evidence {
    /// A similarity that many matches between them support.
    Matches,
    /// A pair, and depths beside what it sees.
    Depths,
}

impl Part {
    pub(super) fn state(&self) -> PartState {
        (self.first(), self.size())
    }

    /// Its first image; of two parts it is never the same.
    fn first(&self) -> Option<ImageId> {
        self.component.registered().next()
    }
}

/// A similarity between two components with the evidence for it.
struct Hypothesis {
    kept_from_moved: Similarity,
    agreeing: Vec<Crossing>,
    support: usize,
    /// What the moved images see of the kept points, and the kept images of the moved points.
    seen: [Visibility; 2],
    /// What either matches of the other, measured by what each matches of itself; further matches included.
    likeness: Likeness,
}

struct Attempt<'p, 'm, 'a> {
    params: &'a MapperParams,
    kept: &'p Part,
    moved: &'p Part,
    sides: Sides<'m, 'a>,
    /// Of the kept and the moved part.
    rates: [&'m OnceLock<OwnRates>; 2],
    seed: u64,
}

impl<'a> Attempt<'_, '_, 'a> {
    fn run(&self, taken: &[bool], report: &mut MapperReport) -> Option<Part> {
        let crossings = self.sides.crossings();
        let candidates = distinct(&crossings);
        if candidates < self.params.min_registration_inliers {
            return None;
        }
        let mut hypotheses = self.hypotheses(&crossings);
        let mut local =
            self.local_similarities(&crossings).into_iter().map(|local| self.hypothesis(&crossings, local));
        // About the strongest pair in any case.
        hypotheses.splice(0..0, local.next());
        let mut judged: Vec<Result<Recognition, MergeVerdict>> =
            hypotheses.iter().map(|hypothesis| self.judge(&crossings, hypothesis)).collect();
        if !judged.iter().any(Result::is_ok)
            && let Some(local) = local.next()
        {
            judged.push(self.judge(&crossings, &local));
            hypotheses.push(local);
        }
        let mut fit: Vec<usize> = (0..judged.len()).filter(|at| judged[*at].is_ok()).collect();
        let has_rival = |fit: &[usize]| {
            let others = fit.iter().skip(1);
            others.copied().any(|other| self.differ(&hypotheses[fit[0]], &hypotheses[other]))
        };
        if has_rival(&fit) {
            let brings_together = |hypothesis: &Hypothesis| {
                self.share_as_neighbours(|image| self.pose_in_kept(image, &hypothesis.kept_from_moved))
            };
            let together: Vec<usize> =
                fit.iter().copied().filter(|at| brings_together(&hypotheses[*at])).collect();
            if !together.is_empty() {
                fit = together;
            }
        }
        let rival = has_rival(&fit);
        let first = fit.first().copied();
        let mut joined = None;
        let best = first.unwrap_or(0);
        if first.is_some() {
            joined = if rival { None } else { self.join(&hypotheses[best], taken) };
            if joined.is_none() {
                judged[best] = Err(if rival { MergeVerdict::Ambiguous } else { MergeVerdict::Contradicted });
            }
        }
        let best_found = hypotheses.get(best);
        let seen = best_found.map(|hypothesis| hypothesis.seen).unwrap_or_default();
        let likeness = best_found.map(|hypothesis| hypothesis.likeness).unwrap_or_default();
        let judged = judged.get(best).copied().unwrap_or(Err(MergeVerdict::Unsupported));
        report.merges.push(MergeRecord {
            recognition: judged.ok(),
            candidates,
            inliers: best_found.map_or(0, |hypothesis| hypothesis.support),
            expected: seen.map(|seen| seen.expected),
            matched: seen.map(|seen| seen.matched),
            expected_cells: seen.map(|seen| seen.expected_cells),
            matched_cells: seen.map(|seen| seen.matched_cells),
            expected_matches: likeness.expected,
            found_matches: likeness.matched,
            ..self.record(judged.err().unwrap_or(MergeVerdict::Joined))
        });
        let mut mapper = joined?;
        report.registrations.append(&mut mapper.records);
        Some(mapper.into_part())
    }

    /// What became of the two, with nothing said of why.
    fn record(&self, verdict: MergeVerdict) -> MergeRecord {
        let first_of = |part: &Part| part.first().unwrap_or(ImageId(0));
        MergeRecord {
            first_images: [first_of(self.kept), first_of(self.moved)],
            images: [self.kept.size(), self.moved.size()],
            verdict,
            recognition: None,
            candidates: 0,
            inliers: 0,
            expected: [0; 2],
            matched: [0; 2],
            expected_cells: [0; 2],
            matched_cells: [0; 2],
            expected_matches: 0.0,
            found_matches: 0.0,
        }
    }

    fn ransac(&self) -> RansacParams {
        RansacParams { min_inliers: self.params.min_confirmed_inliers, ..self.params.ransac() }
    }

    /// Up to as many similarities as poses of one image, best first: each is sought among what the ones before leave.
    fn hypotheses(&self, crossings: &[Crossing]) -> Vec<Hypothesis> {
        let ransac = self.ransac();
        let mut rest = crossings.to_vec();
        let mut found = Vec::new();
        for round in 0..self.params.max_pose_hypotheses as u64 {
            let seed = self.seed.wrapping_add(round);
            let verified = rest.iter().filter(|crossing| crossing.verified);
            let mut candidates = Sights::collect(&self.sides, verified).estimate(&ransac, seed);
            if rest.iter().any(|crossing| !crossing.verified) {
                candidates.extend(Sights::collect(&self.sides, rest.iter()).estimate(&ransac, seed));
            }
            let Some((_, best)) = self.best_of(&rest, candidates) else { break };
            let hypothesis = self.hypothesis(&rest, best);
            let gone: BTreeSet<_> =
                hypothesis.agreeing.iter().map(|crossing| (crossing.kept, crossing.moved)).collect();
            rest.retain(|crossing| !gone.contains(&(crossing.kept, crossing.moved)));
            found.push(hypothesis);
        }
        found
    }

    /// The candidate that explains the matches best, refined, with its score.
    fn best_of(&self, crossings: &[Crossing], candidates: Vec<Similarity>) -> Option<(f64, Similarity)> {
        candidates
            .into_iter()
            .map(|candidate| self.refined(crossings, candidate))
            .map(|refined| (self.sides.score(crossings, &refined, self.params.max_error_sigma), refined))
            .min_by(|a, b| a.0.total_cmp(&b.0))
    }

    /// The similarity with further matches that it shows, and what it is judged by.
    fn hypothesis(&self, crossings: &[Crossing], mut kept_from_moved: Similarity) -> Hypothesis {
        let bound = self.params.max_error_sigma;
        let mut agreeing = self.sides.agreeing(crossings, &kept_from_moved, bound);
        let seen = self.seen(&kept_from_moved, &agreeing);
        let mut likeness = self.likeness(&kept_from_moved, &agreeing);
        if distinct(&agreeing) >= MIN_SEED {
            for max_angle_rad in GUIDED_BANDS_RAD {
                let guide = GuidedParams { max_angle_rad, ..GuidedParams::default() };
                let mut all = self.sides.guided(&kept_from_moved, &guide);
                all.extend_from_slice(crossings);
                let all = once(all);
                kept_from_moved = self.refined(&all, kept_from_moved);
                agreeing = self.sides.agreeing(&all, &kept_from_moved, bound);
                likeness = self.likeness(&kept_from_moved, &agreeing);
                if (distinct(&agreeing) as f64).max(likeness.matched) < MIN_HOPE * likeness.expected {
                    break;
                }
            }
        }
        let support = distinct(&agreeing);
        Hypothesis { kept_from_moved, agreeing, support, seen, likeness }
    }

    /// A similarity fitted to what agrees with it, if that makes more agree.
    fn refined(&self, crossings: &[Crossing], initial: Similarity) -> Similarity {
        let bound = self.params.max_error_sigma;
        let mut best = (self.sides.score(crossings, &initial, bound), initial);
        for widening in [6.0, 3.0, 1.0, 1.0] {
            let near = self.sides.agreeing(crossings, &best.1, widening * bound);
            let sights = Sights::collect(&self.sides, near.iter());
            let fitted = sights.refine(&best.1, self.params.loss_sigma);
            let score = self.sides.score(crossings, &fitted, bound);
            if score < best.0 {
                best = (score, fitted);
            }
        }
        best.1
    }

    /// What the images of either component see of the other's points, over all of them.
    fn seen(&self, kept_from_moved: &Similarity, agreeing: &[Crossing]) -> [Visibility; 2] {
        let moved_from_kept = kept_from_moved.inverse();
        let sum =
            |of: &Model<'_>, at: &Model<'_>, at_from_of: &Similarity, matched: &[(ImageId, u32, PointId)]| {
                let images: Vec<ImageId> = of.registered().collect();
                let seen: Vec<Visibility> = images
                    .into_par_iter()
                    .with_max_len(1)
                    .filter_map(|image| {
                        let pose = at_from_of.transform_pose(&of.poses[image.index()]?.world_from_camera);
                        let inliers: Vec<(u32, PointId)> = matched
                            .iter()
                            .filter(|(seen_in, ..)| *seen_in == image)
                            .map(|&(_, feature, id)| (feature, id))
                            .collect();
                        Some(visibility(at, image, &pose, &inliers))
                    })
                    .collect();
                seen.into_iter().sum()
            };
        let by_moved: Vec<_> =
            agreeing.iter().filter_map(|c| Some((c.moved.image, c.moved.feature, c.kept_point?))).collect();
        let by_kept: Vec<_> =
            agreeing.iter().filter_map(|c| Some((c.kept.image, c.kept.feature, c.moved_point?))).collect();
        let Sides { kept, moved } = self.sides;
        [sum(moved, kept, kept_from_moved, &by_moved), sum(kept, moved, &moved_from_kept, &by_kept)]
    }

    fn likeness(&self, kept_from_moved: &Similarity, agreeing: &[Crossing]) -> Likeness {
        let Sides { kept, moved } = self.sides;
        let by_moved: Vec<_> = agreeing.iter().filter_map(|c| Some((c.moved.image, c.kept_point?))).collect();
        let by_kept: Vec<_> = agreeing.iter().filter_map(|c| Some((c.kept.image, c.moved_point?))).collect();
        let [of_kept, of_moved] = self.rates;
        let kept_rated = (kept, of_kept.get_or_init(|| OwnRates::of(kept)));
        let moved_rated = (moved, of_moved.get_or_init(|| OwnRates::of(moved)));
        likeness(moved, kept_rated, kept_from_moved, &by_moved)
            + likeness(kept, moved_rated, &kept_from_moved.inverse(), &by_kept)
    }

    /// What tells that the two are of one place, or why they are not joined.
    fn judge(&self, crossings: &[Crossing], hypothesis: &Hypothesis) -> Result<Recognition, MergeVerdict> {
        let params = self.params;
        let Hypothesis { kept_from_moved, agreeing, support, likeness, .. } = hypothesis;
        if *support < params.min_registration_inliers {
            return Err(MergeVerdict::Unsupported);
        }
        let sights = Sights::collect(&self.sides, agreeing.iter());
        let sigma = sights.log_scale_sigma(kept_from_moved, params.loss_sigma);
        if !(self.is_spread(agreeing) && sigma <= MAX_LOG_SCALE_SIGMA) {
            return Err(MergeVerdict::ScaleOpen);
        }
        let recognition = self.recognition(crossings, hypothesis).ok_or(MergeVerdict::NotRecognized)?;
        if self.pair_agreement(kept_from_moved) < params.min_pair_agreement {
            return Err(MergeVerdict::PairsDisagree);
        }
        let is_faint = match recognition {
            Recognition::Likeness => likeness.matched < CLEAR_LIKENESS * likeness.expected,
            Recognition::Strength => !outweighs_walls(*support, likeness.expected, MIN_STRENGTH),
            Recognition::Neighbours => false,
        };
        if is_faint && self.are_strangers(kept_from_moved) {
            return Err(MergeVerdict::Strangers);
        }
        if self.positions_disagree(kept_from_moved) {
            return Err(MergeVerdict::PositionsDisagree);
        }
        Ok(recognition)
    }

    /// What tells that the two are of one place, if anything does.
    fn recognition(&self, crossings: &[Crossing], hypothesis: &Hypothesis) -> Option<Recognition> {
        let params = self.params;
        let Hypothesis { kept_from_moved, agreeing, support, seen, likeness } = hypothesis;
        let is_judged = |seen: &Visibility| seen.expected >= params.min_visible_points;
        let is_alike = if likeness.expected >= MIN_EXPECTED_MATCHES {
            let is_clear = self.pair_agreement(kept_from_moved) >= CLEAR_AGREEMENT;
            let least = if is_clear { MIN_LIKENESS_OF_PAIRS } else { MIN_LIKENESS };
            likeness.matched >= least * likeness.expected
        } else if seen.iter().any(is_judged) {
            seen.iter().all(|seen| !is_judged(seen) || params.is_recognized(seen))
        } else {
            let verified = |of: &[Crossing]| of.iter().filter(|crossing| crossing.verified).count() as f64;
            let confirmed = verified(agreeing) >= params.min_confirmed_share * verified(crossings);
            confirmed && *support >= UNJUDGED_SUPPORT * params.min_registration_inliers
        };
        if is_alike {
            return Some(Recognition::Likeness);
        }
        if self.is_strong(*support, hypothesis) {
            return Some(Recognition::Strength);
        }
        self.share_as_neighbours(|image| self.pose_in_kept(image, kept_from_moved))
            .then_some(Recognition::Neighbours)
    }

    /// Whether so many matches agree that two parts are of one place, though either sees little of what the other does.
    ///
    /// What is expected grows with all that stands behind walls, and what is matched of it leaves out what is seen from
    /// elsewhere. In a wrong place much is expected, since images stand where others do, and little agrees. Of photos, which see
    /// less of what surrounds them, that is not known.
    fn is_strong(&self, agreeing: usize, hypothesis: &Hypothesis) -> bool {
        let Sides { kept, moved } = self.sides;
        if !kept.registered().chain(moved.registered()).all(|image| kept.input.is_panoramic(image)) {
            return false;
        }
        let is_clear = self.pair_agreement(&hypothesis.kept_from_moved) >= CLEAR_AGREEMENT;
        let least = if is_clear { MIN_STRENGTH_OF_PAIRS } else { MIN_STRENGTH };
        outweighs_walls(agreeing, hypothesis.likeness.expected, least)
    }

    /// Whether images of the two that stand as near as neighbours, by these poses, share what neighbours within either do.
    fn share_as_neighbours(&self, pose: impl Fn(ImageId) -> Option<Rigid> + Sync) -> bool {
        let [known, asked] = self.neighbours(pose);
        share_as_neighbours(&known, &asked)
    }

    /// Whether images of the two stand as near as neighbours, in the open, and share next to nothing.
    fn are_strangers(&self, kept_from_moved: &Similarity) -> bool {
        let Sides { kept, moved } = self.sides;
        let [known, asked] = self.neighbours(|image| self.pose_in_kept(image, kept_from_moved));
        are_strangers(&known, &asked) && !is_indoors(kept) && !is_indoors(moved)
    }

    /// The pairs of images within either of the two, and those across, at these poses.
    fn neighbours(&self, pose: impl Fn(ImageId) -> Option<Rigid> + Sync) -> [Vec<Neighbours>; 2] {
        let Sides { kept, moved } = self.sides;
        let placed = |image: ImageId| {
            let side = if kept.is_registered(image) { kept } else { moved };
            pose(image).filter(|_| side.is_registered(image)).map(|pose| (pose, &side.rays[image.index()]))
        };
        let pairs = neighbours(kept.input, placed, |_, _| true, self.params.max_error_sigma);
        let is_within = |pair: &Neighbours| {
            let [first, second] = pair.images.map(|image| kept.is_registered(image));
            first == second
        };
        pairs.into_iter().partition::<Vec<_>, _>(is_within).into()
    }

    /// The pose of an image of either in the frame of the larger.
    fn pose_in_kept(&self, image: ImageId, kept_from_moved: &Similarity) -> Option<Rigid> {
        let of = |model: &Model<'_>| model.poses[image.index()].map(|pose| pose.world_from_camera);
        of(self.sides.kept).or_else(|| Some(kept_from_moved.transform_pose(&of(self.sides.moved)?)))
    }

    /// Whether the scale rests on more than one image: on two of either component, or on points that both have.
    fn is_spread(&self, agreeing: &[Crossing]) -> bool {
        let shared: Vec<Crossing> = agreeing
            .iter()
            .filter(|crossing| crossing.kept_point.is_some() && crossing.moved_point.is_some())
            .copied()
            .collect();
        if distinct(&shared) >= self.params.min_registration_inliers {
            return true;
        }
        let spread = |images: Vec<ImageId>| {
            let mut counts = vec![0_usize; self.sides.kept.poses.len()];
            for image in images {
                counts[image.index()] += 1;
            }
            counts.iter().filter(|&&count| count >= IMAGE_MATCHES).count() >= 2
        };
        let of_moved = agreeing.iter().filter(|c| c.kept_point.is_some()).map(|c| c.moved.image);
        let of_kept = agreeing.iter().filter(|c| c.moved_point.is_some()).map(|c| c.kept.image);
        spread(of_moved.collect()) || spread(of_kept.collect())
    }

    /// Share of the verified matches between the components that belong to pairs whose rotation agrees.
    fn pair_agreement(&self, kept_from_moved: &Similarity) -> f64 {
        let Sides { kept, moved } = self.sides;
        let (mut agreeing, mut all) = (0, 0);
        for pair in kept.input.pairs {
            let rotation = |image: ImageId| {
                let of_kept = kept.poses[image.index()].map(|pose| pose.world_from_camera.rotation);
                let of_moved = moved.poses[image.index()]
                    .map(|pose| kept_from_moved.rotation * pose.world_from_camera.rotation);
                of_kept.or(of_moved)
            };
            let crosses = kept.is_registered(pair.first) != kept.is_registered(pair.second);
            let (Some(first), Some(second), true) = (rotation(pair.first), rotation(pair.second), crosses)
            else {
                continue;
            };
            all += pair.two_view.inliers.len();
            let deviation = (second.inverse() * first).angle_to(&pair.two_view.second_from_first.rotation);
            if deviation.to_degrees() <= self.params.max_pair_rotation_deg {
                agreeing += pair.two_view.inliers.len();
            }
        }
        if all == 0 { 1.0 } else { agreeing as f64 / all as f64 }
    }

    /// Whether most measured distances between the images of the two components are far from those of the model.
    ///
    /// Distances need no common frame; the median over all of them forgives some wrong positions. Where the measured
    /// positions of the larger component lie within their own error, they say nothing.
    fn positions_disagree(&self, kept_from_moved: &Similarity) -> bool {
        let Sides { kept, moved } = self.sides;
        let measured = |model: &Model<'_>, kept_from_model: &Similarity| -> Vec<_> {
            let place = |image: ImageId| {
                let center = kept_from_model.transform_point(model.poses[image.index()]?.center());
                Some((center, model.input.images[image.index()].position_prior?))
            };
            model.registered().filter_map(place).collect()
        };
        let of_kept = measured(kept, &Similarity::identity());
        let of_moved = measured(moved, kept_from_moved);
        let mut metres: Vec<f64> = Vec::new();
        for (at, a) in of_kept.iter().enumerate() {
            for b in &of_kept[at + 1..] {
                let distance = (a.1 - b.1).norm();
                if distance > MAX_POSITION_ERROR_M {
                    metres.push(distance / (a.0 - b.0).norm());
                }
            }
        }
        let Some(metres) = median(metres) else { return false };
        let crossing = of_kept.iter().flat_map(|a| of_moved.iter().map(move |b| (a, b)));
        let excess = crossing.map(|(a, b)| {
            let distance = (a.1 - b.1).norm();
            let error = (metres * (a.0 - b.0).norm() - distance).abs();
            error - MAX_POSITION_ERROR_M - MAX_POSITION_ERROR_SHARE * distance
        });
        median(excess.collect()).is_some_and(|excess| excess > 0.0)
    }

    /// Whether two hypotheses put the moved component at different places.
    fn differ(&self, a: &Hypothesis, b: &Hypothesis) -> bool {
        let turn = a.kept_from_moved.rotation.angle_to(&b.kept_from_moved.rotation);
        if turn.to_degrees() > self.params.max_pair_rotation_deg {
            return true;
        }
        let moved = |crossing: &Crossing| {
            let id = crossing.moved_point?;
            let point = self.sides.moved.point(id)?.position;
            let center = *self.sides.moved.poses[crossing.moved.image.index()]?.center();
            let by = |similarity: &Similarity, x| similarity.transform_point(x);
            let step = (by(&a.kept_from_moved, &center) - by(&b.kept_from_moved, &center)).norm();
            Some(step / ((point - center).norm() * a.kept_from_moved.scale))
        };
        let steps = a.agreeing.iter().chain(&b.agreeing).filter_map(moved).collect();
        median(steps).is_none_or(|step| step > SAME_PLACE)
    }

    /// The joined component, unless the adjustment of both together contradicts the similarity.
    ///
    /// Of a large component that meets a small one only what is about the seam is adjusted, if that contradicts nothing.
    fn join(&self, hypothesis: &Hypothesis, taken: &[bool]) -> Option<Mapper<'a>> {
        let about_seam = |model: &Model<'a>| Scope::about(model, &self.at_seam(model));
        let (mapper, is_partial) = self.adjusted(hypothesis, taken, about_seam);
        let mut mapper = if self.holds(&mapper, hypothesis) {
            mapper
        } else if is_partial {
            let (whole, _) = self.adjusted(hypothesis, taken, Scope::global);
            Some(whole).filter(|whole| self.holds(whole, hypothesis))?
        } else {
            return None;
        };
        let before = mapper.model.registered_count();
        mapper.grow();
        if mapper.model.registered_count() > before {
            mapper.refine_by(about_seam, self.params.limits(), 2, 20);
        }
        mapper.replace_misplaced();
        // Where a part ends an image may have come in askew by a few points, which the other part has hundreds of matches with.
        let may_leave = |part: &Part, image| belongs_elsewhere(mapper.model.pairs_of(image), part, image);
        let num_lost = |of: &Part| {
            let images = of.component.registered();
            images.filter(|image| !mapper.model.is_registered(*image) && !may_leave(of, *image)).count()
        };
        self.fit_but_few(&mapper.model, [self.kept, self.moved].map(num_lost)).then_some(mapper)
    }

    /// Both at a similarity, adjusted together within a scope, and whether anything was beyond that.
    fn adjusted(
        &self,
        hypothesis: &Hypothesis,
        taken: &[bool],
        scope: impl Fn(&Model<'a>) -> Scope,
    ) -> (Mapper<'a>, bool) {
        let mut mapper = self.mapper_over(&hypothesis.kept_from_moved, taken.to_vec());
        let limits = self.params.limits();
        let mut is_partial = false;
        for _ in 0..2 {
            for crossing in &hypothesis.agreeing {
                connect(&mut mapper.model, limits, crossing.kept, crossing.moved);
            }
            complete_and_merge(&mut mapper.model, &mapper.graph, limits);
            is_partial |= scope(&mapper.model).free_images.len() < mapper.model.registered_count();
            mapper.refine_by(&scope, limits, 2, 20);
        }
        (mapper, is_partial)
    }

    /// The images that a join moves most: those of the part that is moved, or, where that is large, those of either part that see
    /// what holds them together.
    fn at_seam(&self, model: &Model<'_>) -> Vec<ImageId> {
        if self.moved.size() < LARGE_PART {
            return self.moved.component.registered().collect();
        }
        let mut ties = vec![0; model.poses.len()];
        for (_, point) in model.live_points().filter(|(_, point)| self.is_tie(point)) {
            point.track.iter().for_each(|seen| ties[seen.image.index()] += 1);
        }
        model.registered().filter(|image| ties[image.index()] >= MIN_ADJUSTABLE_POINTS).collect()
    }

    /// Whether images of both parts see a point.
    fn is_tie(&self, point: &ModelPoint) -> bool {
        let Sides { kept, moved } = self.sides;
        [kept, moved].iter().all(|side| point.track.iter().any(|seen| side.is_registered(seen.image)))
    }

    /// The model of both, that images may join but those that are taken.
    fn joint(&self, kept_from_moved: &Similarity, taken: &[bool]) -> Model<'a> {
        let components = [&self.kept.component, &self.moved.component];
        Model::of_components(self.sides.kept.input, components[0], components[1], kept_from_moved, taken)
    }

    fn mapper_over(&self, kept_from_moved: &Similarity, taken: Vec<bool>) -> Mapper<'a> {
        let model = self.joint(kept_from_moved, &taken);
        let mut mapper = Mapper::over(self.params, model, taken, self.seed);
        let anchors = self.kept.anchors.iter().zip(&self.moved.anchors);
        mapper.anchors = anchors.map(|(of_kept, of_moved)| of_kept.or(*of_moved)).collect();
        mapper
    }

    /// Whether so few images of the kept and the moved part do not fit the whole that it says nothing against it.
    fn fit_but_few(&self, model: &Model<'_>, num_unfit: [usize; 2]) -> bool {
        let parts = || [self.kept, self.moved].into_iter().zip(num_unfit);
        let are_few = |is_beyond_doubt| {
            parts().all(|(part, num_unfit)| may_be_unfit(num_unfit, part.size(), is_beyond_doubt))
        };
        are_few(false) || are_few(true) && self.is_beyond_doubt(model)
    }

    /// Whether the pairs of panoramas across bear out the adjusted whole, one of them all round, and none speaks against it.
    fn is_beyond_doubt(&self, model: &Model<'_>) -> bool {
        let support = self.support_across(model);
        support.is_clear() && support.against == 0 && support.is_strong()
    }

    /// Whether all images of both are in the whole.
    fn keeps_images(&self, mapper: &Mapper<'_>) -> bool {
        let mut images = [self.kept, self.moved].into_iter().flat_map(|part| part.component.registered());
        images.all(|image| mapper.model.is_registered(image))
    }

    /// Whether the adjusted whole keeps what either component saw.
    fn keeps_points(&self, model: &Model<'_>) -> bool {
        [self.sides.kept, self.sides.moved].into_iter().all(|side| {
            let count =
                |of: &Model<'_>| side.registered().map(|image| of.observed_points(image)).sum::<usize>();
            count(model) as f64 >= MIN_KEPT_OBSERVATIONS * count(side) as f64
        })
    }

    /// Whether the adjusted whole keeps what either component knew and what holds them together.
    fn holds(&self, mapper: &Mapper<'_>, hypothesis: &Hypothesis) -> bool {
        let model = &mapper.model;
        let sides = [self.sides.kept, self.sides.moved];
        let ties = model.live_points().filter(|(_, point)| self.is_tie(point)).count();
        let recognizes = |of: &Model<'_>, at: &Model<'_>| {
            let seen: Visibility = of
                .registered()
                .filter_map(|image| {
                    let pose = model.poses[image.index()]?.world_from_camera;
                    let mut others = model.registered_neighbours(image);
                    others.retain(|&other| at.is_registered(other));
                    Some(visibility_beside(model, image, &pose, &model.observations_of(image), &others))
                })
                .sum();
            seen.expected < self.params.min_visible_points || self.params.is_recognized(&seen)
        };
        let pose = |image: ImageId| model.poses[image.index()].map(|pose| pose.world_from_camera);
        let recognized =
            || recognizes(self.sides.moved, self.sides.kept) && recognizes(self.sides.kept, self.sides.moved);
        self.keeps_points(model)
            && ties >= self.params.min_registration_inliers
            && !self.is_contradicted(model)
            && self.fit_but_few(model, sides.map(|side| mapper.misplaced_count(side.registered())))
            && (recognized() || self.is_strong(ties, hypothesis) || self.share_as_neighbours(pose))
    }

    /// Whether a verified pair of panoramas across speaks against the adjusted whole by far more than speaks for it.
    fn is_contradicted(&self, model: &Model<'_>) -> bool {
        model.registered().all(|image| model.input.is_panoramic(image))
            && self.support_across(model).is_untenable()
    }

    /// What the verified pairs between the two say of the whole.
    fn support_across(&self, model: &Model<'_>) -> Support {
        Support::across(model, |image| self.sides.moved.is_registered(image), self.params.max_error_sigma)
    }
}

/// Whether so many images of a part may not fit the whole: each may have come in wrongly, or what the other part's images see may be
/// hidden from it (an upper floor's see the rooms below), which half of them may be where pairs leave no doubt about the place.
fn may_be_unfit(num_unfit: usize, of: usize, is_beyond_doubt: bool) -> bool {
    num_unfit * UNFIT_ONE_IN <= of || is_beyond_doubt && 2 * num_unfit < of
}

/// Whether so many matches agree, of those expected by likeness, that what is missing is hidden.
fn outweighs_walls(agreeing: usize, expected: f64, least: f64) -> bool {
    agreeing >= MIN_STRONG && expected >= MIN_EXPECTED_MATCHES && agreeing as f64 >= least * expected
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraId, Reconstruction, ReconstructionImage};

    /// One of four images of a house stands on the upper floor.
    #[test]
    fn more_images_may_be_unfit_where_pairs_leave_no_doubt() {
        assert!(may_be_unfit(0, 2, false) && may_be_unfit(1, 8, false) && !may_be_unfit(1, 4, false));
        assert!(may_be_unfit(1, 4, true) && !may_be_unfit(2, 4, true) && !may_be_unfit(1, 2, true));
    }

    #[test]
    fn parts_that_were_tried_in_vain_are_worth_another_try_when_they_have_grown_by_matches() {
        let part = |images: &[u32]| {
            let image = |number: u32| ReconstructionImage {
                name: number.to_string(),
                camera: CameraId(0),
                world_from_camera: images.contains(&number).then(Rigid::identity),
            };
            let component =
                Reconstruction { images: (0..8).map(image).collect(), ..Reconstruction::default() };
            Part { component, anchors: vec![None; 8] }
        };
        let (large, small) = (part(&[2, 3, 4]), part(&[6, 7]));
        let mut tried = Tried::default();
        assert_eq!(tried.growth([&large, &small], 100), f64::INFINITY);
        tried.fail([&large, &small], 100);
        // The large one is known as another's part, whose first image is not its own, and on either side.
        let grown = part(&[0, 1, 2, 3, 4]);
        assert_eq!(tried.growth([&grown, &small], 109), 1.09);
        assert_eq!(tried.growth([&small, &grown], 150), 1.5);
        assert_eq!(tried.growth([&part(&[0, 1]), &small], 10), f64::INFINITY);
        tried.fail([&grown, &small], 140);
        assert_eq!(tried.growth([&grown, &small], 140), 1.0);
    }

    /// Figures of parts of a church, a street and rendered streets, in their places and in wrong ones.
    #[test]
    fn what_walls_hide_is_told_from_a_wrong_place() {
        let of_pairs = |agreeing, expected| outweighs_walls(agreeing, expected, MIN_STRENGTH_OF_PAIRS);
        assert!(of_pairs(421, 3359.0) && of_pairs(66, 312.0));
        assert!(!of_pairs(122, 2296.0) && !of_pairs(75, 8248.0));
        let alone = |agreeing, expected| outweighs_walls(agreeing, expected, MIN_STRENGTH);
        assert!(alone(106, 473.0) && alone(195, 346.0));
        assert!(!alone(62, 428.0) && !alone(60, 1321.0) && !alone(30, 50.0));
        assert!(!alone(100, 0.0), "nothing is expected, so nothing is known");
        // Of a town of equal façades, 7.5 steps aside: strong by its pairs, so that strangers have to be asked for.
        assert!(of_pairs(226, 2220.0) && !alone(226, 2220.0));
    }
}
