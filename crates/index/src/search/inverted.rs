use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{DESCRIPTOR_LEN, DescriptorBlock};

use crate::squared_distances;

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
        let training: Vec<u8> =
            training.iter().flat_map(|&row| descriptor(descriptors, row)).copied().collect();
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

    /// Row ranges of the lists nearest to the query, nearest first.
    pub(crate) fn candidates(&self, query: &[u8]) -> Vec<std::ops::Range<usize>> {
        let mut distances = vec![0; self.lists()];
        squared_distances(query, &self.centroids, &mut distances);
        let mut lists: Vec<usize> = (0..distances.len()).collect();
        let key = |&list: &usize| (distances[list], list);
        let probes = self.probes.clamp(1, lists.len().max(1));
        if probes < lists.len() {
            lists.select_nth_unstable_by_key(probes - 1, key);
            lists.truncate(probes);
        }
        lists.sort_unstable_by_key(key);
        lists.into_iter().map(|list| self.starts[list] as usize..self.starts[list + 1] as usize).collect()
    }
}

fn descriptor(descriptors: &[u8], row: usize) -> &[u8] {
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
