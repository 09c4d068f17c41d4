use std::cmp::Reverse;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::{correspondence::CorrespondenceGraph, model::Model};
use crate::{ImageId, Observation, PointId};

/// What a point must satisfy to be kept.
#[derive(Debug, Clone, Copy)]
pub(super) struct PointLimits {
    pub max_error_sigma: f64,
    pub min_angle_rad: f64,
}

impl PointLimits {
    /// The same for observations that are `factor` times farther off.
    pub fn widened(self, factor: f64) -> Self {
        Self { max_error_sigma: self.max_error_sigma * factor, ..self }
    }
}

/// Points that are worth handing to another thread.
pub(super) const POINTS_PER_TASK: usize = 256;

/// What becomes of a free keypoint.
enum Step {
    /// It is another observation of a point.
    Continue(PointId),
    /// It makes a new point, with these others.
    Create(Vector3<f64>, Vec<Observation>),
}

/// Continues existing points into `image` and creates new ones from its unexplained matches.
///
/// One keypoint after the other; but as few stand in each other's way, what becomes of them is found for all at once,
/// and found again where an earlier one has changed what it depends on.
pub(super) fn triangulate_image(
    model: &mut Model<'_>,
    graph: &CorrespondenceGraph,
    limits: PointLimits,
    image: ImageId,
) {
    let step_of = |model: &Model<'_>, seed: Observation| -> Option<Step> {
        if model.point_of(seed).is_some() {
            return None;
        }
        continuation(model, graph, limits, seed)
            .map(Step::Continue)
            .or_else(|| new_point(model, graph, limits, seed))
    };
    let features = 0..model.input.images[image.index()].features.len() as u32;
    let steps: Vec<Option<Step>> = features
        .into_par_iter()
        .with_min_len(POINTS_PER_TASK)
        .map(|feature| step_of(model, Observation { image, feature }))
        .collect();
    let first_new = model.points.len();
    for (feature, mut step) in steps.into_iter().enumerate() {
        let seed = Observation { image, feature: feature as u32 };
        if model.point_of(seed).is_some() {
            continue;
        }
        let is_new =
            |partner: &Observation| model.point_of(*partner).is_some_and(|id| id.index() >= first_new);
        let taken = match &step {
            Some(Step::Continue(id)) => model.point(*id).is_none_or(|point| sees(&point.track, image)),
            _ => false,
        };
        if taken || graph.partners(image, seed.feature).iter().any(is_new) {
            step = step_of(model, seed);
        }
        match step {
            Some(Step::Continue(id)) => model.add_observation(id, seed),
            Some(Step::Create(position, track)) => drop(model.add_point(position, track)),
            None => {}
        }
    }
}

fn sees(track: &[Observation], image: ImageId) -> bool {
    track.iter().any(|seen| seen.image == image)
}

/// The partner's point that `seed` agrees with best.
fn continuation(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    limits: PointLimits,
    seed: Observation,
) -> Option<PointId> {
    let mut best: Option<(f64, PointId)> = None;
    for &partner in graph.partners(seed.image, seed.feature) {
        let Some(id) = model.point_of(partner) else { continue };
        let Some(point) = model.point(id) else { continue };
        let Some(error) = model.error_sigma(seed, &point.position) else { continue };
        if error <= limits.max_error_sigma
            && best.is_none_or(|(lowest, _)| error < lowest)
            && !sees(&point.track, seed.image)
        {
            best = Some((error, id));
        }
    }
    best.map(|(_, id)| id)
}

/// Triangulates `seed` with each free partner and keeps the hypothesis that most of the others support.
fn new_point(
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    limits: PointLimits,
    seed: Observation,
) -> Option<Step> {
    let mut candidates = vec![seed];
    for &partner in graph.partners(seed.image, seed.feature) {
        if model.is_registered(partner.image)
            && model.point_of(partner).is_none()
            && !sees(&candidates, partner.image)
        {
            candidates.push(partner);
        }
    }
    let mut best: Option<(usize, f64, Vec<Observation>)> = None;
    for &partner in &candidates[1..] {
        let Some(hypothesis) = model.triangulate(&[seed, partner]) else { continue };
        if hypothesis.max_error_sigma > limits.max_error_sigma
            || hypothesis.max_angle_rad < limits.min_angle_rad
        {
            continue;
        }
        let support: Vec<Observation> = candidates
            .iter()
            .copied()
            .filter(|&seen| {
                model
                    .error_sigma(seen, &hypothesis.position)
                    .is_some_and(|error| error <= limits.max_error_sigma)
            })
            .collect();
        if support.len() >= 2
            && best
                .as_ref()
                .is_none_or(|(count, angle, _)| (support.len(), hypothesis.max_angle_rad) > (*count, *angle))
        {
            best = Some((support.len(), hypothesis.max_angle_rad, support));
        }
    }
    let (_, _, support) = best?;
    let refined = model.triangulate(&support)?;
    let keeps =
        refined.max_error_sigma <= limits.max_error_sigma && refined.max_angle_rad >= limits.min_angle_rad;
    keeps.then_some(Step::Create(refined.position, support))
}

/// Extends every point along its matches and merges points that turn out to be one. Returns the changes made.
pub(super) fn complete_and_merge(
    model: &mut Model<'_>,
    graph: &CorrespondenceGraph,
    limits: PointLimits,
) -> usize {
    let mut changes = 0;
    // Whose partners are all its own has nothing to take in, and nobody takes it in.
    let is_open = |seen: &Observation, id: PointId| {
        let mut partners = graph.partners(seen.image, seen.feature).iter();
        partners.any(|partner| model.is_registered(partner.image) && model.point_of(*partner) != Some(id))
    };
    let open: Vec<PointId> = (model.live_ids().into_par_iter().with_min_len(POINTS_PER_TASK))
        .filter(|&id| model.point(id).is_some_and(|point| point.track.iter().any(|seen| is_open(seen, id))))
        .collect();
    for id in open {
        let mut next = 0;
        // The track grows while it is walked, so what was just added is followed too.
        while let Some(point) = model.point(id) {
            let Some(&observation) = point.track.get(next) else { break };
            next += 1;
            for &partner in graph.partners(observation.image, observation.feature) {
                if model.is_registered(partner.image) {
                    changes += usize::from(match model.point_of(partner) {
                        None => complete(model, limits, id, partner),
                        Some(other) => other != id && merge(model, limits, id, other),
                    });
                }
            }
        }
    }
    changes
}

/// Makes matched keypoints observations of one point, where one of them is and the limits allow it.
pub(super) fn connect(model: &mut Model<'_>, limits: PointLimits, a: Observation, b: Observation) -> bool {
    match (model.point_of(a), model.point_of(b)) {
        (Some(of_a), Some(of_b)) => of_a != of_b && merge(model, limits, of_a, of_b),
        (Some(id), None) => complete(model, limits, id, b),
        (None, Some(id)) => complete(model, limits, id, a),
        (None, None) => false,
    }
}

/// Makes matched keypoints observations of one point, a new one where neither has any.
pub(super) fn triangulate_match(model: &mut Model<'_>, limits: PointLimits, a: Observation, b: Observation) {
    if model.point_of(a).is_some() || model.point_of(b).is_some() {
        connect(model, limits, a, b);
    } else if let Some(found) = model.triangulate(&[a, b])
        && found.max_error_sigma <= limits.max_error_sigma
        && found.max_angle_rad >= limits.min_angle_rad
    {
        model.add_point(found.position, vec![a, b]);
    }
}

fn complete(model: &mut Model<'_>, limits: PointLimits, id: PointId, partner: Observation) -> bool {
    let Some(point) = model.point(id) else { return false };
    let agrees = !sees(&point.track, partner.image)
        && model.error_sigma(partner, &point.position).is_some_and(|error| error <= limits.max_error_sigma);
    if agrees {
        model.add_observation(id, partner);
    }
    agrees
}

fn merge(model: &mut Model<'_>, limits: PointLimits, id: PointId, other: PointId) -> bool {
    let (Some(a), Some(b)) = (model.point(id), model.point(other)) else { return false };
    if a.track.iter().any(|seen| b.track.iter().any(|theirs| theirs.image == seen.image)) {
        return false;
    }
    // Cheap refusal first: each centre of gravity must be near the rays of both.
    let weight = a.track.len() as f64 / (a.track.len() + b.track.len()) as f64;
    let middle = a.position * weight + b.position * (1.0 - weight);
    let near = |seen: &Observation| {
        model.error_sigma(*seen, &middle).is_some_and(|error| error <= 3.0 * limits.max_error_sigma)
    };
    if !a.track.iter().chain(&b.track).all(near) {
        return false;
    }
    let joint: Vec<Observation> = a.track.iter().chain(&b.track).copied().collect();
    match model.triangulate(&joint) {
        Some(merged) if merged.max_error_sigma <= limits.max_error_sigma => {
            model.merge_points(id, other, merged.position);
            true
        }
        _ => false,
    }
}

/// Drops what violates the limits among these points and their observations. Returns the observations dropped.
pub(super) fn filter(model: &mut Model<'_>, limits: PointLimits, points: &[PointId]) -> usize {
    let judge = |&id: &PointId| {
        let point = model.point(id)?;
        let agrees = |seen: &Observation| {
            model.error_sigma(*seen, &point.position).is_some_and(|error| error <= limits.max_error_sigma)
        };
        let (kept, bad): (Vec<Observation>, Vec<Observation>) =
            point.track.iter().partition(|seen| agrees(seen));
        let stays = kept.len() >= 2 && model.max_angle(&point.position, &kept) >= limits.min_angle_rad;
        (!stays || !bad.is_empty()).then_some((id, stays, bad))
    };
    let judged: Vec<_> = points.par_iter().with_min_len(POINTS_PER_TASK).filter_map(judge).collect();
    drop_observations(model, judged)
}

/// Drops these observations of each point, or the point where it does not stay. Returns the observations dropped.
fn drop_observations(model: &mut Model<'_>, judged: Vec<(PointId, bool, Vec<Observation>)>) -> usize {
    let mut dropped = 0;
    for (id, stays, bad) in judged {
        let Some(point) = model.point(id) else { continue };
        if stays {
            dropped += bad.len();
            for observation in bad {
                model.remove_observation(id, observation);
            }
        } else {
            dropped += point.track.len();
            model.remove_point(id);
        }
    }
    dropped
}

/// Drops the views of points that only matches of `left_out` tie to the rest, which is what matches of `graph` tie together most of.
/// Returns the observations dropped.
///
/// What no match of either ties, as what was found by a pose is, stays.
pub(super) fn separate(
    model: &mut Model<'_>,
    graph: &CorrespondenceGraph,
    left_out: &CorrespondenceGraph,
) -> usize {
    let judge = |&id: &PointId| {
        let track = &model.point(id)?.track;
        let gone = tied_by(left_out, graph, track);
        (!gone.is_empty()).then_some((id, track.len() - gone.len() >= 2, gone))
    };
    let ids = model.live_ids();
    let judged: Vec<_> = ids.par_iter().with_min_len(POINTS_PER_TASK).filter_map(judge).collect();
    drop_observations(model, judged)
}

/// The views of a track that `left_out` ties to it and `graph` does not.
fn tied_by(
    left_out: &CorrespondenceGraph,
    graph: &CorrespondenceGraph,
    track: &[Observation],
) -> Vec<Observation> {
    let is_tied = |seen: &Observation| {
        left_out.partners(seen.image, seen.feature).iter().any(|partner| track.contains(partner))
    };
    if !track.iter().any(is_tied) {
        return Vec::new();
    }
    let mut groups = groups(track, graph);
    groups.sort_by_key(|group| Reverse(group.len()));
    groups.into_iter().skip(1).filter(|group| group.iter().any(is_tied)).flatten().collect()
}

/// A track by what matches of `graph` tie together.
fn groups(track: &[Observation], graph: &CorrespondenceGraph) -> Vec<Vec<Observation>> {
    let (mut groups, mut open) = (Vec::new(), track.to_vec());
    while let Some(&first) = open.first() {
        open.swap_remove(0);
        let (mut group, mut next) = (vec![first], 0);
        while let Some(seen) = group.get(next) {
            let tied = graph.partners(seen.image, seen.feature);
            group.extend(open.extract_if(.., |other| tied.contains(other)));
            next += 1;
        }
        groups.push(group);
    }
    groups
}
