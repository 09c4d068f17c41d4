//! Points split, so that a factorization of what is left preconditions conjugate gradients.
//!
//! S of a town is full long before most of it matters: two cameras that share a single point have a block. Here each point is split
//! into copies, one for each group of its cameras that share much with each other. What that leaves out is only what holds the
//! copies together. So S̃, which S is of the split problem, is positive definite and nowhere stiffer than S; it has few
//! blocks; and what bends a long street, on which a preconditioner of diagonal blocks wastes hundreds of iterations, is all in it.
//!
//! Such preconditioners are of Y.-D. Jian, D. Balcan, F. Dellaert, "Generalized Subgraph Preconditioners for Large-Scale Bundle
//! Adjustment", ICCV 2011. There residuals are left out; copies keep what each of their groups tells.

use super::camera_system::{Budget, CameraSystem};
use super::elimination::{Copies, Couplings, Slot, insert_pairs};
use super::normal_equations::Link;
use super::pattern::{BlockPattern, NONE};

/// Points that two cameras share, as a share of those that each sees (of their geometric mean), below which they count as strangers:
/// at first, and how much more is asked while S̃ is beyond the budget.
const LEAST_SHARED: f64 = 0.01;
const MORE_SHARED: f64 = 2.0;

/// Two poses that see the same points.
#[derive(Debug, Clone, Copy)]
struct Pair {
    /// Share of points in common, up to 1.
    shared: f64,
    row: usize,
    /// Less than the row.
    column: usize,
}

/// Splits the points; gives the pattern of S̃, which begins with that of U, and what factorizes it, unless there is no memory for it.
///
/// The first `poses` blocks are poses'.
pub(super) fn split(
    base: &BlockPattern,
    poses: usize,
    links: &[Link],
    couplings: &mut Couplings,
    budget: &Budget,
) -> (BlockPattern, Option<CameraSystem>) {
    let pairs = ranked(couplings, poses);
    let connects = spanning_forest(&pairs, poses);
    let mut least = LEAST_SHARED;
    loop {
        let mut akin = BlockPattern::new(vec![1; poses]);
        for (pair, _) in
            pairs.iter().zip(&connects).filter(|(pair, connects)| pair.shared >= least || **connects)
        {
            akin.insert(pair.row, pair.column);
        }
        let (slots, copies) = copies(couplings, poses, links, &akin);
        let mut pattern = base.clone();
        for copy in 0..copies.count() {
            insert_pairs(&slots[copies.slots(copy)], &mut pattern);
        }
        // What is left in the end is a forest, the factor of which has few more values than itself.
        let is_last = least > 1.0;
        let budget = if is_last { Budget::MEMORY } else { budget.within_time(links.len()) };
        let fits = budget.may_suffice(&pattern);
        let factorization = if fits { CameraSystem::new(&pattern, &budget) } else { None };
        if factorization.is_some() || is_last {
            couplings.starts = copies.starts.iter().map(|&copy| copies.slot_starts[copy]).collect();
            (couplings.slots, couplings.copies) = (slots, Some(copies));
            return (pattern, factorization);
        }
        least *= MORE_SHARED;
    }
}

/// The copy that an observation is of, if its point is an unknown that anything unknown sees.
pub(super) fn copied(copies: &Copies, slots: &[Slot], link: &Link) -> Option<usize> {
    // What a known pose sees counts for one of them.
    copies.of_point(link.point as usize).find(|&copy| {
        link.block == NONE || slots[copies.slots(copy)].iter().any(|slot| slot.block == link.block)
    })
}

/// Pairs of poses that see the same points, those that share most first.
fn ranked(couplings: &Couplings, poses: usize) -> Vec<Pair> {
    let mut seen = vec![Vec::new(); poses];
    for point in 0..couplings.free.len() {
        for slot in couplings.of_point(point).iter().filter(|slot| (slot.block as usize) < poses) {
            seen[slot.block as usize].push(point);
        }
    }
    let (mut counts, mut partners) = (vec![0_usize; poses], Vec::new());
    let mut pairs = Vec::new();
    for (row, points) in seen.iter().enumerate() {
        for &point in points {
            for slot in couplings.of_point(point).iter().take_while(|slot| (slot.block as usize) < row) {
                let partner = slot.block as usize;
                if counts[partner] == 0 {
                    partners.push(partner);
                }
                counts[partner] += 1;
            }
        }
        for column in partners.drain(..) {
            let count = std::mem::take(&mut counts[column]);
            let all = (points.len() * seen[column].len()) as f64;
            pairs.push(Pair { shared: count as f64 / all.sqrt(), row, column });
        }
    }
    pairs.sort_unstable_by(|a, b| {
        b.shared.total_cmp(&a.shared).then_with(|| (a.row, a.column).cmp(&(b.row, b.column)))
    });
    pairs
}

/// Which pairs connect what no better pair does.
fn spanning_forest(ranked: &[Pair], poses: usize) -> Vec<bool> {
    let mut above: Vec<usize> = (0..poses).collect();
    let mut connects = Vec::with_capacity(ranked.len());
    for pair in ranked {
        let [row, column] = [pair.row, pair.column].map(|mut pose| {
            while above[pose] != pose {
                above[pose] = above[above[pose]];
                pose = above[pose];
            }
            pose
        });
        connects.push(row != column);
        above[row] = column;
    }
    connects
}

/// All slots anew, copy by copy: one for each group of a point's poses that are akin, with those further blocks that these poses' views depend on.
fn copies(couplings: &Couplings, poses: usize, links: &[Link], akin: &BlockPattern) -> (Vec<Slot>, Copies) {
    let mut slots = Vec::with_capacity(couplings.slots.len());
    let mut copies = Copies { starts: vec![0], slot_starts: vec![0] };
    let mut links = links;
    for point in 0..couplings.free.len() {
        let count = links.iter().take_while(|link| link.point as usize == point).count();
        let (of_point, others) = links.split_at(count);
        links = others;
        let seen = couplings.of_point(point);
        for (index, group) in groups(seen, poses, akin).iter().enumerate() {
            let is_of_group = |link: &&Link| match link.block {
                NONE => index == 0,
                block => group.contains(&block),
            };
            let further = of_point.iter().filter(is_of_group).filter(|link| link.extra != NONE);
            let mut blocks = group.clone();
            blocks.extend(further.map(|link| poses as u32 + link.extra));
            blocks.sort_unstable();
            blocks.dedup();
            slots.extend(blocks.into_iter().map(|block| Slot { block, offset: 0 }));
            copies.slot_starts.push(slots.len());
        }
        copies.starts.push(copies.count());
    }
    (slots, copies)
}

/// Parts the poses that see a point so that all of a part are akin: the one with most kin first, each into the first part that takes it.
fn groups(seen: &[Slot], poses: usize, akin: &BlockPattern) -> Vec<Vec<u32>> {
    let are_akin = |a: u32, b: u32| akin.contains(a.max(b) as usize, a.min(b) as usize);
    let seen_by: Vec<u32> =
        seen.iter().map(|slot| slot.block).take_while(|&block| (block as usize) < poses).collect();
    let mut by_kin = seen_by.clone();
    by_kin.sort_by_cached_key(|&pose| {
        std::cmp::Reverse(seen_by.iter().filter(|&&other| are_akin(pose, other)).count())
    });
    let mut groups: Vec<Vec<u32>> = Vec::new();
    for pose in by_kin {
        match groups.iter_mut().find(|group| group.iter().all(|&other| are_akin(pose, other))) {
            Some(group) => group.push(pose),
            None => groups.push(vec![pose]),
        }
    }
    // Further blocks alone: known poses with cameras that are not.
    if groups.is_empty() && !seen.is_empty() {
        groups.push(Vec::new());
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forest_takes_the_best_pairs_that_connect() {
        let pair = |shared: f64, row: usize, column: usize| Pair { shared, row, column };
        let ranked = [
            pair(0.9, 1, 0),
            pair(0.8, 2, 1),
            pair(0.7, 2, 0),
            pair(0.5, 4, 3),
            pair(0.1, 4, 1),
            pair(0.1, 3, 0),
        ];
        assert_eq!(spanning_forest(&ranked, 6), [true, true, false, true, true, false]);
    }

    #[test]
    fn points_are_split_between_poses_that_share_nothing_else() {
        let mut akin = BlockPattern::new(vec![1; 6]);
        for (row, column) in [(1, 0), (2, 1), (2, 0), (4, 3)] {
            akin.insert(row, column);
        }
        let seen = |blocks: &[u32]| blocks.iter().map(|&block| Slot { block, offset: 0 }).collect::<Vec<_>>();
        // Block 6 is no pose's.
        assert_eq!(groups(&seen(&[0, 1, 2, 6]), 6, &akin), [vec![0, 1, 2]]);
        assert_eq!(groups(&seen(&[0, 2, 3, 4, 5]), 6, &akin), [vec![0, 2], vec![3, 4], vec![5]]);
        assert_eq!(groups(&seen(&[6]), 6, &akin), [Vec::<u32>::new()]);
        assert!(groups(&[], 6, &akin).is_empty());
    }

    #[test]
    fn what_a_known_pose_sees_is_of_the_first_copy_and_extra_blocks_are_where_they_are_seen() {
        let link = |point: u32, block: u32, extra: u32| Link { point, block, extra };
        let links = [link(0, 0, 0), link(0, 1, 1), link(0, NONE, 0), link(1, NONE, 1), link(2, NONE, NONE)];
        let slots = [0, 1, 2, 3, 3].map(|block| Slot { block, offset: 0 }).to_vec();
        let couplings = Couplings { starts: vec![0, 4, 5, 5], slots, free: vec![true; 3], copies: None };
        let (slots, copies) = copies(&couplings, 2, &links, &BlockPattern::new(vec![1; 2]));
        let blocks: Vec<Vec<u32>> = (0..copies.count())
            .map(|copy| slots[copies.slots(copy)].iter().map(|slot| slot.block).collect())
            .collect();
        assert_eq!(blocks, [vec![0, 2], vec![1, 3], vec![3]]);
        assert_eq!(copies.starts, [0, 2, 3, 3]);
        let found = links.map(|link| copied(&copies, &slots, &link));
        assert_eq!(found, [Some(0), Some(1), Some(0), Some(2), None]);
    }
}
