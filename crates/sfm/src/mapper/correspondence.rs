use setloc_features::Match;

use crate::{ImageId, Observation, PairGeometry};

/// All verified matches, searchable from any keypoint (compressed rows, one row a keypoint).
///
/// Tracks are not precomputed: with repeated façades a transitive closure glues different places together, while
/// single correspondences can be accepted or refused one by one against the model.
#[derive(Debug)]
pub(super) struct CorrespondenceGraph {
    first_row: Vec<usize>,
    row_start: Vec<u32>,
    partners: Vec<Observation>,
}

impl CorrespondenceGraph {
    /// Builds the graph of the pairs for which `enabled` holds.
    pub fn build(feature_counts: &[usize], pairs: &[PairGeometry], enabled: &[bool]) -> Self {
        let mut first_row = Vec::with_capacity(feature_counts.len() + 1);
        let mut rows = 0;
        for &count in feature_counts {
            first_row.push(rows);
            rows += count;
        }
        first_row.push(rows);
        let in_range = |image: ImageId, feature: u32| (feature as usize) < feature_counts[image.index()];
        let usable =
            |pair: &PairGeometry, m: &Match| in_range(pair.first, m.first) && in_range(pair.second, m.second);
        let active = || pairs.iter().zip(enabled).filter(|&(_, &on)| on).map(|(pair, _)| pair);

        let mut row_start = vec![0_u32; rows + 1];
        for pair in active() {
            for m in pair.two_view.inliers.iter().filter(|m| usable(pair, m)) {
                row_start[first_row[pair.first.index()] + m.first as usize + 1] += 1;
                row_start[first_row[pair.second.index()] + m.second as usize + 1] += 1;
            }
        }
        for row in 0..rows {
            row_start[row + 1] += row_start[row];
        }
        let mut cursor = row_start.clone();
        let mut partners = vec![Observation { image: ImageId(0), feature: 0 }; row_start[rows] as usize];
        for pair in active() {
            for m in pair.two_view.inliers.iter().filter(|m| usable(pair, m)) {
                let (a, b) = (
                    first_row[pair.first.index()] + m.first as usize,
                    first_row[pair.second.index()] + m.second as usize,
                );
                partners[cursor[a] as usize] = Observation { image: pair.second, feature: m.second };
                partners[cursor[b] as usize] = Observation { image: pair.first, feature: m.first };
                cursor[a] += 1;
                cursor[b] += 1;
            }
        }
        Self { first_row, row_start, partners }
    }

    /// Keypoints of other images that match any of `image`.
    pub fn partners_of(&self, image: ImageId) -> &[Observation] {
        let rows = self.first_row[image.index()]..=self.first_row[image.index() + 1];
        &self.partners[self.row_start[*rows.start()] as usize..self.row_start[*rows.end()] as usize]
    }

    /// Keypoints of other images that match keypoint `feature` of `image`.
    pub fn partners(&self, image: ImageId, feature: u32) -> &[Observation] {
        let row = self.first_row[image.index()] + feature as usize;
        &self.partners[self.row_start[row] as usize..self.row_start[row + 1] as usize]
    }
}
