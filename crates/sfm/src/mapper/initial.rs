use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::Match;

use super::{MapperParams, correspondence::CorrespondenceGraph, model::Model};
use crate::{PairGeometry, TwoViewKind, direction};

/// Verified pairs worth starting from, best first, as indices into the input's pairs.
///
/// The score is the number of matches that a third image confirms, times how much of the sphere they cover, times how
/// much of the wanted parallax they have. A repeated façade can give a far pair more inliers than any pair of
/// neighbours has, but no third image between the two places confirms them.
pub(super) fn ranked_pairs(
    params: &MapperParams,
    model: &Model<'_>,
    graph: &CorrespondenceGraph,
    enabled: &[bool],
) -> Vec<usize> {
    let wanted = params.min_initial_parallax_deg.to_radians();
    let mut ranked: Vec<(f64, usize)> = model
        .input
        .pairs
        .par_iter()
        .enumerate()
        .filter(|&(index, pair)| {
            enabled[index]
                && pair.two_view.kind != TwoViewKind::PureRotation
                && pair.two_view.inliers.len() >= params.min_initial_points
        })
        .map(|(index, pair)| {
            let bearings = &model.rays[pair.first.index()].bearings;
            let cells =
                covered_cells(pair.two_view.inliers.iter().filter_map(|m| bearings.get(m.first as usize)));
            let parallax = (pair.two_view.median_parallax_rad / wanted).min(1.0);
            let confirmed = pair.two_view.inliers.iter().filter(|m| is_confirmed(graph, pair, **m)).count();
            // Two images alone have no third, so matches that nobody confirms still count a little.
            let support = confirmed as f64 + 0.1 * pair.two_view.inliers.len() as f64;
            (support * cells as f64 * parallax * parallax, index)
        })
        .collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ranked.into_iter().take(params.max_initial_pairs).map(|(_, index)| index).collect()
}

/// Whether one keypoint of a third image matches both keypoints of a match.
fn is_confirmed(graph: &CorrespondenceGraph, pair: &PairGeometry, m: Match) -> bool {
    let theirs = graph.partners(pair.second, m.second);
    graph
        .partners(pair.first, m.first)
        .iter()
        .any(|third| third.image != pair.second && theirs.contains(third))
}

/// Number of directions that hold at least one bearing.
fn covered_cells<'b>(bearings: impl Iterator<Item = &'b Vector3<f64>>) -> usize {
    let mut occupied = [false; direction::CELLS];
    for cell in bearings.filter_map(direction::cell) {
        occupied[cell] = true;
    }
    occupied.iter().filter(|&&cell| cell).count()
}
