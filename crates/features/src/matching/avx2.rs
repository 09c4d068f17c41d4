//! AVX2: pairs of 16-bit products accumulated in i32.
//!
//! `vpmaddubsw` would do twice the work per instruction but saturates at 16 bits for bytes above 127, so bytes are
//! widened to 16 bits once, when they are packed.

use std::arch::x86_64::{
    __m256i, _mm256_add_epi32, _mm256_castsi256_ps, _mm256_cmpgt_epi32, _mm256_loadu_si256,
    _mm256_madd_epi16, _mm256_movemask_ps, _mm256_set1_epi32, _mm256_slli_epi32, _mm256_storeu_si256,
    _mm256_sub_epi32,
};

use super::kernel::{Line, PackedBase, PackedQueries, Slots};
use super::tiles::{self, Instructions, VECTORS};

/// Queries per register tile; with 2 base vectors that makes 12 accumulators of the 16 registers.
const ROWS: usize = 6;
/// Base descriptors per vector register.
const LANES: usize = 8;
/// Groups of two components.
const STEPS: usize = crate::DESCRIPTOR_LEN / 2;

/// Proof that the processor has AVX2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Avx2(());

impl Avx2 {
    pub fn detect() -> Option<Self> {
        std::arch::is_x86_feature_detected!("avx2").then_some(Self(()))
    }

    pub fn pack_base(descriptors: &[u8]) -> PackedBase {
        let padded = super::count(descriptors).next_multiple_of(LANES * VECTORS);
        let mut lines: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); padded / LANES * Self::BASE_LINES];
        let words: &mut [i16] = bytemuck::cast_slice_mut(&mut lines);
        let mut terms = vec![super::kernel::PADDING; padded];
        for (index, descriptor) in descriptors.chunks_exact(crate::DESCRIPTOR_LEN).enumerate() {
            let (vector, lane) = (index / LANES, index % LANES);
            for (step, pair) in descriptor.chunks_exact(2).enumerate() {
                let place = (vector * STEPS + step) * LANES * 2 + lane * 2;
                words[place] = i16::from(pair[0]);
                words[place + 1] = i16::from(pair[1]);
            }
            terms[index] = super::kernel::squared_norm(descriptor);
        }
        PackedBase { lines, terms }
    }

    pub fn pack_queries(descriptors: &[u8]) -> PackedQueries {
        PackedQueries::new(descriptors, ROWS, i16::from)
    }

    pub fn search(
        self,
        queries: &PackedQueries,
        base: &PackedBase,
        rows: &mut Slots,
        columns: &mut Slots,
        both: bool,
    ) {
        // SAFETY: the instructions are there, as `self` proves.
        unsafe {
            if both {
                search::<true>(self, queries, base, rows, columns);
            } else {
                search::<false>(self, queries, base, rows, columns);
            }
        }
    }
}

#[target_feature(enable = "avx2")]
fn search<const COLUMNS: bool>(
    kernel: Avx2,
    queries: &PackedQueries,
    base: &PackedBase,
    rows: &mut Slots,
    columns: &mut Slots,
) {
    tiles::search::<_, ROWS, LANES, COLUMNS>(kernel, queries, base, rows, columns);
}

// SAFETY of all intrinsics: `self` proves that the instructions are there.
impl Instructions<ROWS, LANES> for Avx2 {
    type Vector = __m256i;
    const QUERY_LINES: usize = 4;
    // A vector of one step is half a line.
    const BASE_LINES: usize = STEPS / 2;
    const TILE: usize = 64;

    #[inline(always)]
    fn multiply(self, queries: &[Line], base: &[Line]) -> [[__m256i; VECTORS]; ROWS] {
        let queries: &[[i32; STEPS]] = bytemuck::cast_slice(queries);
        let queries: &[[i32; STEPS]; ROWS] = queries.try_into().expect("a full tile of queries");
        let halves: &[[u8; 32]] = bytemuck::cast_slice(base);
        let (left, right) = halves.split_at(STEPS);
        let mut products = [[self.splat(0); VECTORS]; ROWS];
        for (step, (left, right)) in left.iter().zip(right).enumerate() {
            // SAFETY: both are 32 readable bytes.
            let vectors = unsafe {
                [_mm256_loadu_si256(left.as_ptr().cast()), _mm256_loadu_si256(right.as_ptr().cast())]
            };
            for row in 0..ROWS {
                let query = self.splat(queries[row][step % STEPS]);
                for vector in 0..VECTORS {
                    // SAFETY: as above.
                    products[row][vector] = unsafe {
                        _mm256_add_epi32(products[row][vector], _mm256_madd_epi16(vectors[vector], query))
                    };
                }
            }
        }
        products
    }

    #[inline(always)]
    fn splat(self, value: i32) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_set1_epi32(value) }
    }

    #[inline(always)]
    fn load(self, values: &[i32]) -> __m256i {
        assert!(values.len() >= LANES);
        // SAFETY: at least 32 readable bytes, as just checked.
        unsafe { _mm256_loadu_si256(values.as_ptr().cast()) }
    }

    #[inline(always)]
    fn store(self, vector: __m256i) -> [i32; LANES] {
        let mut values = [0; LANES];
        // SAFETY: the array is 32 writable bytes.
        unsafe { _mm256_storeu_si256(values.as_mut_ptr().cast(), vector) };
        values
    }

    #[inline(always)]
    fn distances(self, product: __m256i, column_terms: __m256i, row_term: __m256i) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_add_epi32(_mm256_sub_epi32(column_terms, _mm256_slli_epi32::<1>(product)), row_term) }
    }

    #[inline(always)]
    fn less(self, a: __m256i, b: __m256i) -> u32 {
        // SAFETY: as above.
        unsafe { _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpgt_epi32(b, a))) as u32 }
    }
}
