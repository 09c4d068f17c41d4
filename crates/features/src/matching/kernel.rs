//! Exact two nearest neighbours of u8 descriptors by blocked integer products.
//!
//! ‖q − b‖² = ‖q‖² + ‖b‖² − 2 q·b, so the work is one integer matrix product. Base descriptors are packed so that one
//! vector register holds the same few components of 8 or 16 descriptors; a register tile of queries × base vectors
//! runs over all 128 components, then each finished tile updates the best two of its rows (queries) and, for mutual
//! matching, of its columns (base) in the same pass. A comparison with the second-best distances skips nearly all
//! updates, so the product dominates.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::count;
use super::tiles::Offers;
#[cfg(target_arch = "x86_64")]
use super::{
    avx2::{self, Avx2},
    avx512::Avx512,
    tiles::Walk,
};
use crate::DESCRIPTOR_LEN;

/// Distance of a slot that has seen nothing: above every real squared distance (128 · 255² < 2²³).
pub(super) const UNSEEN: i32 = 1 << 28;
/// Term of a padding row or column: lifts it above [`UNSEEN`].
pub(super) const PADDING: i32 = 1 << 29;

/// Queries that are compared together with the same base descriptors; whole register tiles of every kernel.
pub(super) const QUERY_BLOCK: usize = 12;
/// Base descriptors that are compared together with the same queries; whole register tiles of every kernel.
pub(super) const BASE_BLOCK: usize = 32;

/// Which queries are compared with which base descriptors, block by block, so that all kernels compare the same.
pub(super) trait Comparisons: Copy {
    /// Whether the blocks that this query and this base descriptor lie in are compared.
    fn has(self, query: usize, base: usize) -> bool;
}

/// Each with each.
#[derive(Debug, Clone, Copy)]
pub(super) struct All;

impl Comparisons for All {
    #[inline(always)]
    fn has(self, _: usize, _: usize) -> bool {
        true
    }
}

/// Some blocks with some.
#[derive(Debug)]
pub(super) struct BlockPairs {
    /// Words of one block of queries, a bit for each block of base descriptors.
    words: usize,
    bits: Vec<u64>,
}

impl BlockPairs {
    /// Those of so many blocks of which `compares` says so.
    pub fn new(
        num_query_blocks: usize,
        num_base_blocks: usize,
        compares: impl Fn(usize, usize) -> bool,
    ) -> Self {
        let words = num_base_blocks.div_ceil(64);
        let mut bits = vec![0; num_query_blocks * words];
        for query in 0..num_query_blocks {
            for base in (0..num_base_blocks).filter(|&base| compares(query, base)) {
                bits[query * words + base / 64] |= 1 << (base % 64);
            }
        }
        Self { words, bits }
    }
}

impl Comparisons for &BlockPairs {
    #[inline(always)]
    fn has(self, query: usize, base: usize) -> bool {
        let (query, base) = (query / QUERY_BLOCK, base / BASE_BLOCK);
        self.bits[query * self.words + base / 64] >> (base % 64) & 1 != 0
    }
}

/// The nearest descriptor and the distances of the nearest two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TwoNearest {
    /// Index of the nearest descriptor, the lowest of equally near ones; [`TwoNearest::NO_INDEX`] if there is none.
    pub index: u32,
    /// Squared Euclidean distance of the stored bytes; [`TwoNearest::NO_DISTANCE`] if there is none.
    pub distance2: u32,
    /// Squared distance of the second nearest; [`TwoNearest::NO_DISTANCE`] if there are fewer than two.
    pub second_distance2: u32,
}

impl TwoNearest {
    /// Marks the absence of a neighbour.
    pub const NO_INDEX: u32 = u32::MAX;
    /// Marks the absence of a distance.
    pub const NO_DISTANCE: u32 = u32::MAX;
    /// No neighbour seen yet.
    pub const NONE: Self =
        Self { index: Self::NO_INDEX, distance2: Self::NO_DISTANCE, second_distance2: Self::NO_DISTANCE };

    /// Takes the nearest two of both; at equal distance `self` wins, so merge in ascending index order.
    pub(super) fn merge(&mut self, other: &Self) {
        if other.distance2 < self.distance2 {
            self.second_distance2 = self.distance2.min(other.second_distance2);
            self.distance2 = other.distance2;
            self.index = other.index;
        } else {
            self.second_distance2 = self.second_distance2.min(other.distance2);
        }
    }

    /// Offers one more candidate; at equal distance the earlier one stays.
    pub fn offer(&mut self, index: u32, distance2: u32) {
        if distance2 < self.distance2 {
            self.second_distance2 = self.distance2;
            self.distance2 = distance2;
            self.index = index;
        } else {
            self.second_distance2 = self.second_distance2.min(distance2);
        }
    }
}

/// Which instructions to use; all give identical results.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kernel {
    Scalar,
    #[cfg(target_arch = "x86_64")]
    Avx2Words(avx2::Words),
    /// For [short](avx2::is_short) descriptors only.
    #[cfg(target_arch = "x86_64")]
    Avx2Bytes(avx2::Bytes),
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
}

impl Kernel {
    /// The fastest for any descriptors.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = || Avx2::detect().map(|avx2| Self::Avx2Words(avx2.words()));
            if let Some(kernel) = Avx512::detect().map(Self::Avx512).or_else(avx2) {
                return kernel;
            }
        }
        Self::Scalar
    }

    /// The fastest for these descriptors.
    fn detect_for(queries: &[u8], base: &[u8]) -> Self {
        let any = Self::detect();
        #[cfg(target_arch = "x86_64")]
        if let Self::Avx2Words(_) = any
            && let Some(avx2) = Avx2::detect()
            && avx2::is_short(queries)
            && avx2::is_short(base)
        {
            return Self::Avx2Bytes(avx2.bytes());
        }
        any
    }

    fn pack_base(self, descriptors: &[u8]) -> PackedBase {
        match self {
            Self::Scalar => PackedBase { lines: lines_of(descriptors), terms: terms_of(descriptors) },
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Words(_) => avx2::Words::pack_base(descriptors),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bytes(_) => avx2::Bytes::pack_base(descriptors),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => Avx512::pack_base(descriptors),
        }
    }

    fn pack_queries(self, descriptors: &[u8]) -> PackedQueries {
        match self {
            Self::Scalar => PackedQueries::new(descriptors, 1, |value| value),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Words(_) => avx2::Words::pack_queries(descriptors),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bytes(_) => avx2::Bytes::pack_queries(descriptors),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => Avx512::pack_queries(descriptors),
        }
    }

    /// The nearest two of all queries and, if `both`, of all base descriptors, with those that they are padded with.
    fn two_nearest(
        self,
        queries: &PackedQueries,
        base: &PackedBase,
        compared: impl Comparisons,
        both: bool,
    ) -> [Vec<TwoNearest>; 2] {
        match self {
            Self::Scalar => {
                let mut found =
                    [&queries.terms, &base.terms].map(|terms| vec![TwoNearest::NONE; terms.len()]);
                let [rows, columns] = &mut found;
                search_scalar(queries, base, compared, |row, column, distance2| {
                    rows[row].offer(column as u32, distance2 as u32);
                    columns[column].offer(row as u32, distance2 as u32);
                });
                found
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Words(kernel) => kernel.two_nearest(queries, base, compared, both),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bytes(kernel) => kernel.two_nearest(queries, base, compared, both),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(kernel) => kernel.two_nearest(queries, base, compared, both),
        }
    }

    /// Offers to the queries what is nearer than their bounds.
    fn offer(self, queries: &PackedQueries, base: &PackedBase, mut rows: Offers<'_>) {
        match self {
            Self::Scalar => search_scalar(queries, base, All, |row, column, distance2| {
                if distance2 < rows.bounds[row] {
                    rows.bounds[row] = (rows.offer)(row, distance2, column);
                }
            }),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Words(kernel) => kernel.search(queries, base, &mut rows, &mut (), All),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bytes(kernel) => kernel.search(queries, base, &mut rows, &mut (), All),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(kernel) => kernel.search(queries, base, &mut rows, &mut (), All),
        }
    }
}

/// Sixty-four bytes on a cache line of their own, so that no vector load straddles two.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Line(pub [u8; 64]);

/// Base descriptors packed for one kernel.
pub(super) struct PackedBase {
    pub lines: Vec<Line>,
    /// What each column adds to the squared distance, padded to whole tiles.
    pub terms: Vec<i32>,
}

/// Query descriptors packed for one kernel.
pub(super) struct PackedQueries {
    pub lines: Vec<Line>,
    /// What each row adds to the squared distance, padded to whole tiles.
    pub terms: Vec<i32>,
}

impl PackedQueries {
    /// Row-major queries, each byte as `stored`, padded to whole tiles of `tile_rows`.
    pub fn new<T: Pod>(descriptors: &[u8], tile_rows: usize, stored: impl Fn(u8) -> T) -> Self {
        let padded = count(descriptors).next_multiple_of(tile_rows);
        let lines_per_query = DESCRIPTOR_LEN * size_of::<T>() / size_of::<Line>();
        let mut lines: Vec<Line> = vec![Line::zeroed(); padded * lines_per_query];
        let values: &mut [T] = bytemuck::cast_slice_mut(&mut lines);
        for (target, &value) in values.iter_mut().zip(descriptors) {
            *target = stored(value);
        }
        let mut terms = terms_of(descriptors);
        terms.resize(padded, PADDING);
        Self { lines, terms }
    }
}

/// Descriptors packed once for many searches, as the centroids of an inverted index are.
///
/// ```
/// use setloc_features::{DESCRIPTOR_LEN, DescriptorBlock, TwoNearest};
///
/// let block = DescriptorBlock::new(&[vec![10; DESCRIPTOR_LEN], vec![20; DESCRIPTOR_LEN]].concat());
/// let nearest = block.two_nearest(&[11; DESCRIPTOR_LEN]);
/// assert_eq!(nearest, [TwoNearest { index: 0, distance2: 128, second_distance2: 128 * 81 }]);
/// ```
pub struct DescriptorBlock {
    kernel: Kernel,
    len: usize,
    base: PackedBase,
}

impl std::fmt::Debug for DescriptorBlock {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("DescriptorBlock")
            .field("kernel", &self.kernel)
            .field("len", &self.len)
            .finish_non_exhaustive()
    }
}

impl DescriptorBlock {
    /// Packs row-major descriptors, `n × DESCRIPTOR_LEN` bytes.
    pub fn new(descriptors: &[u8]) -> Self {
        Self::with_kernel(Kernel::detect(), descriptors)
    }

    fn with_kernel(kernel: Kernel, descriptors: &[u8]) -> Self {
        Self { kernel, len: count(descriptors), base: kernel.pack_base(descriptors) }
    }

    /// The nearest two of each query (row-major, `n × DESCRIPTOR_LEN` bytes), indices counted within the block.
    pub fn two_nearest(&self, queries: &[u8]) -> Vec<TwoNearest> {
        self.search(queries, All, false).0
    }

    fn search(
        &self,
        queries: &[u8],
        compared: impl Comparisons,
        both: bool,
    ) -> (Vec<TwoNearest>, Vec<TwoNearest>) {
        let packed = self.kernel.pack_queries(queries);
        let [mut rows, mut columns] = self.kernel.two_nearest(&packed, &self.base, compared, both);
        rows.truncate(count(queries));
        columns.truncate(if both { self.len } else { 0 });
        (rows, columns)
    }
}

/// The two nearest of `base` for each of `queries` (both row-major, `n × DESCRIPTOR_LEN` bytes).
pub fn two_nearest(queries: &[u8], base: &[u8]) -> Vec<TwoNearest> {
    DescriptorBlock::with_kernel(Kernel::detect_for(queries, base), base).two_nearest(queries)
}

/// Queries that are compared with all of a base by one thread at a time; whole blocks.
const QUERIES_AT_ONCE: usize = 16 * QUERY_BLOCK;

/// Offers each query the descriptors of `base` that are nearer than what it has found so far asks for.
///
/// For searches that keep something else than the two nearest descriptors: `bound` tells below which squared distance a further
/// descriptor matters to a query, and `offer` takes such a one, by its number in `base`, in ascending order. Both of `queries` and
/// `base` are row-major, `n × DESCRIPTOR_LEN` bytes; `found` has an entry a query.
///
/// ```
/// use setloc_features::{DESCRIPTOR_LEN, offer_nearer};
///
/// let base = [10, 20, 12].map(|value| [value; DESCRIPTOR_LEN]).concat();
/// // All that are nearer than 128 · 3².
/// let mut found = [vec![]];
/// offer_nearer(&[11; DESCRIPTOR_LEN], &base, &mut found, |_| 1152, |found, at, distance2| found.push((at, distance2)));
/// assert_eq!(found, [[(0, 128), (2, 128)]]);
/// ```
pub fn offer_nearer<F: Send>(
    queries: &[u8],
    base: &[u8],
    found: &mut [F],
    bound: impl Fn(&F) -> u32 + Sync,
    offer: impl Fn(&mut F, usize, u32) + Sync,
) {
    let block = DescriptorBlock::with_kernel(Kernel::detect_for(queries, base), base);
    let parts = queries.par_chunks(QUERIES_AT_ONCE * DESCRIPTOR_LEN).with_max_len(1);
    parts.zip(found.par_chunks_mut(QUERIES_AT_ONCE)).for_each(|(queries, found)| {
        let queries = block.kernel.pack_queries(queries);
        let bound = |found: &F| bound(found).min(UNSEEN as u32) as i32;
        let mut bounds: Vec<i32> = found.iter().map(bound).collect();
        bounds.resize(queries.terms.len(), i32::MIN);
        let mut offer = |row: usize, distance2: i32, column: usize| {
            offer(&mut found[row], column, distance2 as u32);
            bound(&found[row])
        };
        block.kernel.offer(&queries, &block.base, Offers { bounds, offer: &mut offer });
    });
}

/// Both directions in one pass: for each query its nearest two of `base`, for each of `base` its nearest two queries, among
/// those that are compared.
///
/// At equal distance the lower index wins.
pub(super) fn two_nearest_both(
    queries: &[u8],
    base: &[u8],
    compared: impl Comparisons,
) -> (Vec<TwoNearest>, Vec<TwoNearest>) {
    DescriptorBlock::with_kernel(Kernel::detect_for(queries, base), base).search(queries, compared, true)
}

/// Squared Euclidean norm of a descriptor; at most 128 · 255² < 2²³.
pub fn squared_norm(descriptor: &[u8]) -> i32 {
    descriptor.iter().map(|&value| i32::from(value) * i32::from(value)).sum()
}

/// Bytes of a descriptor whose squares are summed side by side.
const LANES: usize = 32;

/// Squared Euclidean distance of two descriptors.
///
/// At most 128 · 255² < 2²³, so it is exact. Loops, so that all of it is compiled for the registers of its caller.
#[inline(always)]
pub fn squared_distance(first: &[u8], second: &[u8]) -> u32 {
    let ((first, first_rest), (second, second_rest)) =
        (first.as_chunks::<LANES>(), second.as_chunks::<LANES>());
    let mut sums = [0; LANES];
    for (first, second) in first.iter().zip(second) {
        for ((sum, &a), &b) in sums.iter_mut().zip(first).zip(second) {
            // Differences of 16 bits are what vector registers square.
            let difference = i32::from(i16::from(a) - i16::from(b));
            *sum += difference * difference;
        }
    }
    for ((sum, &a), &b) in sums.iter_mut().zip(first_rest).zip(second_rest) {
        let difference = i32::from(i16::from(a) - i16::from(b));
        *sum += difference * difference;
    }
    let mut total = 0;
    for sum in sums {
        total += sum;
    }
    total as u32
}

fn lines_of(bytes: &[u8]) -> Vec<Line> {
    bytes.chunks_exact(64).map(bytemuck::pod_read_unaligned).collect()
}

fn terms_of(descriptors: &[u8]) -> Vec<i32> {
    descriptors.chunks_exact(DESCRIPTOR_LEN).map(squared_norm).collect()
}

/// Hands all squared distances on, by row and column.
fn search_scalar(
    queries: &PackedQueries,
    base: &PackedBase,
    compared: impl Comparisons,
    mut take: impl FnMut(usize, usize, i32),
) {
    let base_bytes: &[u8] = bytemuck::cast_slice(&base.lines);
    let query_bytes: &[u8] = bytemuck::cast_slice(&queries.lines);
    for (row, query) in query_bytes.chunks_exact(DESCRIPTOR_LEN).enumerate() {
        let candidates = base_bytes.chunks_exact(DESCRIPTOR_LEN).enumerate();
        for (column, candidate) in candidates.filter(|(column, _)| compared.has(row, *column)) {
            let product: i32 = query.iter().zip(candidate).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum();
            take(row, column, queries.terms[row] + base.terms[column] - 2 * product);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// All that the processor has for these descriptors.
    fn kernels(queries: &[u8], base: &[u8]) -> Vec<Kernel> {
        let mut kernels = vec![Kernel::Scalar];
        #[cfg(target_arch = "x86_64")]
        {
            kernels.extend(Avx2::detect().map(|avx2| Kernel::Avx2Words(avx2.words())));
            if avx2::is_short(queries) && avx2::is_short(base) {
                kernels.extend(Avx2::detect().map(|avx2| Kernel::Avx2Bytes(avx2.bytes())));
            }
            kernels.extend(Avx512::detect().map(Kernel::Avx512));
        }
        kernels
    }

    fn naive(queries: &[u8], base: &[u8]) -> Vec<TwoNearest> {
        queries
            .chunks_exact(DESCRIPTOR_LEN)
            .map(|query| {
                let mut nearest = TwoNearest::NONE;
                for (index, candidate) in base.chunks_exact(DESCRIPTOR_LEN).enumerate() {
                    nearest.offer(index as u32, squared_distance(query, candidate));
                }
                nearest
            })
            .collect()
    }

    #[test]
    fn all_kernels_agree_with_the_definition_at_every_remainder() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        // Few distinct values make ties common; the full range tests the arithmetic's limits.
        for top in [2u8, 38, 255] {
            for (num_queries, num_base) in
                [(1, 1), (1, 2), (5, 15), (12, 32), (13, 33), (7, 129), (25, 64), (61, 290), (3, 0), (0, 3)]
            {
                let mut random = |count: usize| -> Vec<u8> {
                    (0..count * DESCRIPTOR_LEN).map(|_| rng.random_range(0..=top)).collect()
                };
                let (queries, base) = (random(num_queries), random(num_base));
                for kernel in kernels(&queries, &base) {
                    let (rows, columns) =
                        DescriptorBlock::with_kernel(kernel, &base).search(&queries, All, true);
                    assert_eq!(rows, naive(&queries, &base), "{kernel:?} {num_queries} × {num_base}");
                    assert_eq!(columns, naive(&base, &queries), "{kernel:?} {num_queries} × {num_base}");
                    let one_way = DescriptorBlock::with_kernel(kernel, &base).two_nearest(&queries);
                    assert_eq!(rows, one_way);
                }
            }
        }
    }

    #[test]
    fn extreme_bytes_neither_saturate_nor_overflow() {
        let queries = [vec![255; DESCRIPTOR_LEN], vec![0; DESCRIPTOR_LEN]].concat();
        let base = [vec![0; DESCRIPTOR_LEN], vec![254; DESCRIPTOR_LEN]].concat();
        for kernel in kernels(&queries, &base) {
            let nearest = DescriptorBlock::with_kernel(kernel, &base).two_nearest(&queries);
            let far = 128 * 255 * 255;
            assert_eq!(nearest[0], TwoNearest { index: 1, distance2: 128, second_distance2: far });
            assert_eq!(nearest[1], TwoNearest { index: 0, distance2: 0, second_distance2: 128 * 254 * 254 });
        }
    }

    #[test]
    fn the_longest_short_descriptors_do_not_overflow() {
        // A length of 255.996, all of it in components whose products are summed in the same 16 bits.
        let mut long = vec![0; DESCRIPTOR_LEN];
        for (at, value) in [(0, 127), (1, 127), (4, 127), (5, 127), (8, 31), (9, 7), (12, 2), (13, 2)] {
            long[at] = value;
        }
        assert_eq!(squared_norm(&long), 65534);
        let longer = long.iter().map(|&value| value + u8::from(value == 2)).collect::<Vec<_>>();
        let base = [vec![0; DESCRIPTOR_LEN], long.clone(), vec![1; DESCRIPTOR_LEN]].concat();
        for (query, num_kernels) in [(&long, 2), (&longer, 1)] {
            let kernels = kernels(query, &base);
            #[cfg(target_arch = "x86_64")]
            if Avx2::detect().is_some() {
                assert!(kernels.len() > num_kernels, "{kernels:?}");
            }
            for kernel in kernels {
                let nearest = DescriptorBlock::with_kernel(kernel, &base).two_nearest(query);
                assert_eq!(nearest, naive(query, &base), "{kernel:?}");
            }
        }
    }

    #[test]
    fn blocks_are_compared_as_asked_by_all_kernels() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let mut random = |count: usize| -> Vec<u8> {
            (0..count * DESCRIPTOR_LEN).map(|_| rng.random_range(0..=50)).collect()
        };
        // More blocks of base descriptors than bits in a word, and last blocks that are not full.
        let (num_queries, num_base) = (53, 66 * BASE_BLOCK + 7);
        let (queries, base) = (random(num_queries), random(num_base));
        let compares = |query: usize, base: usize| (query + base).is_multiple_of(3);
        let compared =
            BlockPairs::new(num_queries.div_ceil(QUERY_BLOCK), num_base.div_ceil(BASE_BLOCK), compares);
        let mut expected = (vec![TwoNearest::NONE; num_queries], vec![TwoNearest::NONE; num_base]);
        for (row, query) in queries.chunks_exact(DESCRIPTOR_LEN).enumerate() {
            for (column, candidate) in base.chunks_exact(DESCRIPTOR_LEN).enumerate() {
                if compares(row / QUERY_BLOCK, column / BASE_BLOCK) {
                    let distance2 = squared_distance(query, candidate);
                    expected.0[row].offer(column as u32, distance2);
                    expected.1[column].offer(row as u32, distance2);
                }
            }
        }
        for kernel in kernels(&queries, &base) {
            let found = DescriptorBlock::with_kernel(kernel, &base).search(&queries, &compared, true);
            assert_eq!(found, expected, "{kernel:?}");
        }
    }
}
