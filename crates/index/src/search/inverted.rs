use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{DESCRIPTOR_LEN, DescriptorBlock};
use setloc_sfm::PointId;

use super::nearest_exact;
use crate::{NearestPoints, squared_distances};

/// Training descriptors per list.
const TRAINING_PER_LIST: usize = 40;
/// Rounds of k-means; the assignment hardly changes later.
const ROUNDS: usize = 8;

/// A k-means quantizer with the rows that belong to each of its lists.
///
/// Centroids are rounded to `u8`, so that integer kernels serve assignment, search and ranking. (H. Jégou,
/// M. Douze, C. Schmid, "Product quantization for nearest neighbor search", PAMI 2011, section IV: inverted lists.)
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct InvertedLists {
    #[serde(with = "crate::bytes")]
    centroids: Vec<u8>,
    /// List `l` holds the rows `starts[l] .. starts[l + 1]` of the reordered descriptors.
    starts: Vec<u32>,
    /// Lists visited per query.
    pub(crate) probes: usize,
}

impl InvertedLists {
    /// Trains the quantizer and returns it with the order in which rows have to be stored.
    pub(crate) fn train(descriptors: &[u8], seed: u64) -> (Self, Vec<u32>) {
        let rows = descriptors.len() / DESCRIPTOR_LEN;
        let lists = ((rows as f64).sqrt() * 1.5).ceil().max(1.0) as usize;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut training = index::sample(&mut rng, rows, rows.min(lists * TRAINING_PER_LIST)).into_vec();
        let mut centroids = Vec::with_capacity(lists * DESCRIPTOR_LEN);
        for &row in training.iter().take(lists) {
            centroids.extend_from_slice(descriptor(descriptors, row));
        }
        training.sort_unstable();
        let training = training.iter().map(|&row| descriptor(descriptors, row)).collect::<Vec<_>>().concat();
        for _ in 0..ROUNDS {
            let assigned = nearest_lists(&training, &centroids);
            update_centroids(&mut centroids, &training, &assigned);
        }
        let assigned = nearest_lists(descriptors, &centroids);
        let mut order: Vec<u32> = (0..rows as u32).collect();
        order.par_sort_by_key(|&row| assigned[row as usize]);
        let mut starts = vec![0_u32; centroids.len() / DESCRIPTOR_LEN + 1];
        for &list in &assigned {
            starts[list + 1] += 1;
        }
        for list in 1..starts.len() {
            starts[list] += starts[list - 1];
        }
        (Self { centroids, starts, probes: 1 }, order)
    }

    /// Number of lists.
    pub(crate) fn lists(&self) -> usize {
        self.centroids.len() / DESCRIPTOR_LEN
    }

    /// The lists whose centroids are nearest to the query; ascending.
    fn nearest_to(&self, query: &[u8]) -> Vec<usize> {
        let mut distances = vec![0; self.lists()];
        squared_distances(query, &self.centroids, &mut distances);
        // By distance, then number; as plain integers they are selected several times faster.
        let mut lists: Vec<u64> =
            (0..).zip(&distances).map(|(list, &distance2)| u64::from(distance2) << 32 | list).collect();
        let probes = self.probes.clamp(1, lists.len().max(1));
        if probes < lists.len() {
            lists.select_nth_unstable(probes - 1);
            lists.truncate(probes);
        }
        let mut lists: Vec<usize> = lists.into_iter().map(|key| (key & 0xffff_ffff) as usize).collect();
        lists.sort_unstable();
        lists
    }

    /// The places of a list's rows in the order of storage.
    pub(crate) fn rows_of(&self, list: usize) -> std::ops::Range<usize> {
        self.starts[list] as usize..self.starts[list + 1] as usize
    }

    /// The rows that are compared with a query.
    pub(crate) fn candidates(&self, query: &[u8]) -> impl Iterator<Item = usize> {
        self.nearest_to(query).into_iter().flat_map(|list| self.rows_of(list))
    }

    /// The two nearest points of each query among the rows of the lists nearest to it: each list is compared with all queries that
    /// ask for it at once, as blocks of descriptors are by far faster than one by one.
    pub(crate) fn nearest(
        &self,
        queries: &[u8],
        descriptors: &[u8],
        owner: impl Fn(usize) -> PointId + Sync,
    ) -> Vec<NearestPoints> {
        let count = queries.len() / DESCRIPTOR_LEN;
        let lists_of: Vec<Vec<usize>> =
            queries.par_chunks_exact(DESCRIPTOR_LEN).map(|query| self.nearest_to(query)).collect();
        let mut asked_by: Vec<Vec<usize>> = vec![Vec::new(); self.lists()];
        for (query, lists) in lists_of.iter().enumerate() {
            for &list in lists {
                asked_by[list].push(query);
            }
        }
        let nearest_in = |(list, asked_by): (usize, &Vec<usize>)| {
            let rows = self.rows_of(list);
            let queries =
                asked_by.iter().map(|&query| descriptor(queries, query)).collect::<Vec<_>>().concat();
            let of_list = &descriptors[rows.start * DESCRIPTOR_LEN..rows.end * DESCRIPTOR_LEN];
            nearest_exact(&queries, of_list, |row| owner(rows.start + row))
        };
        let found: Vec<Vec<NearestPoints>> =
            asked_by.par_iter().enumerate().with_max_len(1).map(nearest_in).collect();
        let mut nearest = vec![NearestPoints::default(); count];
        for (asked_by, found) in asked_by.iter().zip(&found) {
            for (&query, found) in asked_by.iter().zip(found) {
                nearest[query].merge(found);
            }
        }
        nearest
    }
}

/// One row of row-major descriptors.
pub(crate) fn descriptor(descriptors: &[u8], row: usize) -> &[u8] {
    &descriptors[row * DESCRIPTOR_LEN..(row + 1) * DESCRIPTOR_LEN]
}

/// Descriptors that one thread assigns at a time.
const ASSIGNED_AT_ONCE: usize = 256;

/// The list whose centroid is nearest to each descriptor, the first of equally near ones.
fn nearest_lists(descriptors: &[u8], centroids: &[u8]) -> Vec<usize> {
    let centroids = DescriptorBlock::new(centroids);
    descriptors
        .par_chunks(ASSIGNED_AT_ONCE * DESCRIPTOR_LEN)
        .with_max_len(1)
        .flat_map_iter(|part| centroids.two_nearest(part))
        .map(|nearest| nearest.index as usize)
        .collect()
}

/// Moves each centroid to the mean of its descriptors; empty lists keep theirs.
fn update_centroids(centroids: &mut [u8], training: &[u8], assigned: &[usize]) {
    let lists = centroids.len() / DESCRIPTOR_LEN;
    let (mut sums, mut counts) = (vec![0_u32; centroids.len()], vec![0_u32; lists]);
    for (descriptor, &list) in training.chunks_exact(DESCRIPTOR_LEN).zip(assigned) {
        counts[list] += 1;
        let sum = &mut sums[list * DESCRIPTOR_LEN..(list + 1) * DESCRIPTOR_LEN];
        for (sum, &byte) in sum.iter_mut().zip(descriptor) {
            *sum += u32::from(byte);
        }
    }
    for (i, centroid) in centroids.iter_mut().enumerate() {
        let count = counts[i / DESCRIPTOR_LEN];
        if let Some(mean) = (sums[i] + count / 2).checked_div(count) {
            *centroid = mean as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng;
    use setloc_features::squared_distance;

    use super::*;

    #[test]
    fn each_query_finds_what_is_nearest_in_its_lists() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let descriptors: Vec<u8> = (0..700 * DESCRIPTOR_LEN).map(|_| rng.random_range(0..90)).collect();
        let (mut lists, order) = InvertedLists::train(&descriptors, 1);
        lists.probes = 7;
        let ordered: Vec<u8> =
            order.iter().flat_map(|&row| descriptor(&descriptors, row as usize)).copied().collect();
        // Several rows a point, so that the two nearest rows are not always of two points.
        let owner = |row: usize| PointId(row as u32 % 100);
        let queries: Vec<u8> = (0..50 * DESCRIPTOR_LEN).map(|_| rng.random_range(0..90)).collect();
        let found = lists.nearest(&queries, &ordered, owner);
        for (query, found) in queries.chunks_exact(DESCRIPTOR_LEN).zip(&found) {
            let rows: Vec<usize> = lists.candidates(query).collect();
            assert!(rows.len() > 20 && rows.len() < 500, "{}", rows.len());
            let mut expected = NearestPoints::default();
            for row in rows {
                expected.offer(owner(row), squared_distance(query, descriptor(&ordered, row)));
            }
            assert_eq!(found, &expected);
        }
        assert_eq!(lists.nearest(&[], &ordered, owner), []);
    }
}
