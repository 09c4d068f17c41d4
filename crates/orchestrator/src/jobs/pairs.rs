use std::collections::BTreeSet;

use setloc_sfm::MeasuredPosition;

use crate::config::PairParams;

/// Which pairs to match, as sorted index pairs `(a, b)` with `a < b`; beyond small sets those that look alike are
/// among them.
pub fn choose_pairs(
    params: &PairParams,
    positions: &[Option<MeasuredPosition>],
    alike: &[(usize, usize)],
) -> Vec<(usize, usize)> {
    let count = positions.len();
    let mut pairs = BTreeSet::new();
    if count <= params.exhaustive_up_to {
        pairs.extend((0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))));
        return pairs.into_iter().collect();
    }
    pairs.extend(alike);
    for a in 0..count {
        pairs.extend((a + 1..count.min(a + 1 + params.window)).map(|b| (a, b)));
        let Some(here) = positions[a] else { continue };
        let distance = |b: usize| positions[b].map(|there| (there.enu - here.enu).norm());
        let mut near: Vec<(f64, usize)> =
            (0..count).filter(|&b| b != a).filter_map(|b| Some((distance(b)?, b))).collect();
        near.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        pairs.extend(near.iter().take(params.nearest).map(|&(_, b)| (a.min(b), a.max(b))));
    }
    pairs.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn small_sets_are_matched_exhaustively() {
        assert_eq!(choose_pairs(&PairParams::default(), &[None; 5], &[]).len(), 10);
    }

    #[test]
    fn large_sets_grow_linearly() {
        let params = PairParams { exhaustive_up_to: 10, window: 2, nearest: 3, alike: 0 };
        let at =
            |i: usize| Some(MeasuredPosition { enu: Vector3::new(i as f64, 0.0, 0.0), has_height: true });
        let line = |n: usize| (0..n).map(at).collect::<Vec<_>>();
        let (small, large) =
            (choose_pairs(&params, &line(100), &[]).len(), choose_pairs(&params, &line(200), &[]).len());
        assert!(large <= 2 * small + 10, "{small} {large}");
        assert!(choose_pairs(&params, &line(100), &[]).iter().all(|(a, b)| a < b));
        assert!(choose_pairs(&params, &line(100), &[(3, 77)]).contains(&(3, 77)));
    }
}
