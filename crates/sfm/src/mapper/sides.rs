//! Whether what two panoramas share lies on all sides, or on one only.

use std::sync::LazyLock;

use nalgebra::{UnitQuaternion, Vector3};
use setloc_features::{Match, Rays};

use crate::direction;

/// The cells of the half of the sphere about each cell.
static HALVES: LazyLock<Vec<Vec<usize>>> = LazyLock::new(|| {
    let centres: Vec<Vector3<f64>> = (0..direction::CELLS).map(direction::centre).collect();
    let about = |pole: &Vector3<f64>| {
        let near = centres.iter().enumerate().filter(|(_, centre)| centre.dot(pole) > 0.0);
        near.map(|(cell, _)| cell).collect()
    };
    centres.iter().map(about).collect()
});

/// Counts by direction.
pub(super) type Counts = Vec<usize>;

/// Counts bearings by direction.
pub(super) fn count<'b>(bearings: impl Iterator<Item = &'b Vector3<f64>>) -> Counts {
    let mut counts = vec![0; direction::CELLS];
    for cell in bearings.filter_map(direction::cell) {
        counts[cell] += 1;
    }
    counts
}

/// Sums over the half of the sphere about each cell.
fn halves(counts: &[usize]) -> impl Iterator<Item = usize> + '_ {
    HALVES.iter().map(|half| half.iter().map(|&cell| counts[cell]).sum())
}

/// How much is explained on the best and on the worst side.
///
/// A right pose explains something on every side. One that takes a repeated floor or façade for itself, one module
/// further, explains that floor or façade alone, however many matches it has, and so does one that holds what moves
/// with the camera for the scene. Sides are halves of the sphere, as anything smaller may be hidden or bare; those with
/// fewer than `min_there` count for nothing. One more is taken for explained than is: where few are expected, none may
/// be chance. Infinite where no side can be judged.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sides {
    /// Share that is explained on the best side.
    pub best: f64,
    /// Share that is explained on the worst side, relative to the best.
    pub worst: f64,
}

/// Compares how much of what there is on each side is explained.
pub(super) fn compare(there: &[usize], explained: &[usize], min_there: usize) -> Sides {
    let judged: Vec<(f64, f64)> = (halves(there).zip(halves(explained)))
        .filter(|&(there, _)| there >= min_there.max(1))
        .map(|(there, explained)| (there as f64, explained as f64))
        .collect();
    let best = judged.iter().map(|(there, explained)| explained / there).fold(0.0, f64::max);
    let relative = |(there, explained): &(f64, f64)| (explained + 1.0) / (there * best);
    Sides { best, worst: judged.iter().map(relative).fold(f64::INFINITY, f64::min) }
}

/// Whether an image has keypoints on all sides, as panoramas have and photos have not.
pub(super) fn sees_all_around(rays: &Rays) -> bool {
    halves(&count(rays.bearings.iter())).all(|half| half > 0)
}

/// Counts matches by the direction in which the first image sees them.
pub(super) fn count_matches(first: &Rays, matches: &[Match]) -> Counts {
    count(matches.iter().filter_map(|m| first.bearings.get(m.first as usize)))
}

/// Counts the keypoints that two images could share after a turn, in the frame of the first.
pub(super) fn count_shareable(
    first: &Rays,
    second: &Rays,
    second_from_first: &UnitQuaternion<f64>,
) -> Counts {
    let first_from_second = second_from_first.inverse();
    let turned: Vec<Vector3<f64>> = second.bearings.iter().map(|b| first_from_second * b).collect();
    let (mut shareable, others) = (count(first.bearings.iter()), count(turned.iter()));
    for (count, other) in shareable.iter_mut().zip(others) {
        *count = (*count).min(other);
    }
    shareable
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_side_left_out_is_told_from_few_everywhere() {
        let there = vec![10; direction::CELLS];
        let everywhere = vec![1; direction::CELLS];
        assert!(compare(&there, &everywhere, 30).worst > 1.0);
        let floor: Counts =
            (0..direction::CELLS).map(|cell| if direction::centre(cell).y > 0.0 { 8 } else { 0 }).collect();
        // No half about a cell's middle is free of the floor.
        assert!(compare(&there, &floor, 30).worst < 0.3);
        assert_eq!(compare(&there, &floor, 1000).worst, f64::INFINITY);
    }

    #[test]
    fn sides_with_nothing_to_explain_are_not_judged() {
        let below: Counts =
            (0..direction::CELLS).map(|cell| if direction::centre(cell).y > 0.5 { 10 } else { 0 }).collect();
        assert!(compare(&below, &below, 30).worst >= 1.0);
    }
}
