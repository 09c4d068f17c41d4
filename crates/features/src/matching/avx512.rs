//! AVX-512 VNNI: four u8 × i8 products per lane and instruction, accumulated in i32 without saturation.
//!
//! `vpdpbusd` multiplies unsigned by signed bytes, so queries are stored minus 128:
//! q·b = (q − 128)·b + 128 Σb, and the column term becomes ‖b‖² − 256 Σb.

use std::arch::x86_64::{
    __m512i, __mmask16, _mm512_add_epi32, _mm512_cmplt_epi32_mask, _mm512_dpbusd_epi32, _mm512_loadu_si512,
    _mm512_mask_blend_epi32, _mm512_max_epi32, _mm512_min_epi32, _mm512_set1_epi32, _mm512_slli_epi32,
    _mm512_storeu_si512, _mm512_sub_epi32,
};

use super::kernel::{Comparisons, Line, PackedBase, PackedQueries};
use super::tiles::{self, Instructions, Lanes, Products, Sink, VECTORS, Walk};

/// Queries per register tile; with 2 base vectors that makes 24 accumulators of the 32 registers.
const ROWS: usize = 12;
/// Base descriptors per vector register.
const LANES: usize = 16;
/// Groups of four components.
const STEPS: usize = crate::DESCRIPTOR_LEN / 4;

/// Proof that the processor has AVX-512 with VNNI.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Avx512(());

impl Avx512 {
    pub fn detect() -> Option<Self> {
        let is_available = std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512bw")
            && std::arch::is_x86_feature_detected!("avx512vnni");
        is_available.then_some(Self(()))
    }

    pub fn pack_base(descriptors: &[u8]) -> PackedBase {
        let padded = super::count(descriptors).next_multiple_of(LANES * VECTORS);
        let mut lines: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); padded / LANES * Self::BASE_LINES];
        let mut terms = vec![super::kernel::PADDING; padded];
        for (index, descriptor) in descriptors.chunks_exact(crate::DESCRIPTOR_LEN).enumerate() {
            let (vector, lane) = (index / LANES, index % LANES);
            for (step, components) in descriptor.chunks_exact(4).enumerate() {
                lines[vector * STEPS + step].0[lane * 4..lane * 4 + 4].copy_from_slice(components);
            }
            let sum: i32 = descriptor.iter().map(|&value| i32::from(value)).sum();
            terms[index] = super::kernel::squared_norm(descriptor) - 256 * sum;
        }
        PackedBase { lines, terms }
    }

    pub fn pack_queries(descriptors: &[u8]) -> PackedQueries {
        PackedQueries::new(descriptors, ROWS, |value| value ^ 0x80)
    }
}

impl Walk<LANES> for Avx512 {
    fn search(
        self,
        queries: &PackedQueries,
        base: &PackedBase,
        rows: &mut impl Sink<LANES>,
        columns: &mut impl Sink<LANES>,
        compared: impl Comparisons,
    ) {
        #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
        fn compiled(
            kernel: Avx512,
            queries: &PackedQueries,
            base: &PackedBase,
            rows: &mut impl Sink<LANES>,
            columns: &mut impl Sink<LANES>,
            compared: impl Comparisons,
        ) {
            tiles::search::<_, ROWS, LANES>(kernel, queries, base, rows, columns, compared);
        }
        // SAFETY: the instructions are there, as `self` proves.
        unsafe { compiled(self, queries, base, rows, columns, compared) }
    }
}

// SAFETY of all intrinsics: `self` proves that the instructions are there.
impl Instructions<ROWS, LANES> for Avx512 {
    type Lanes = Self;
    const QUERY_LINES: usize = 2;
    const BASE_LINES: usize = STEPS;
    const TILE: usize = 128;

    #[inline(always)]
    fn lanes(self) -> Self {
        self
    }

    #[inline(always)]
    fn multiply(self, queries: &[Line], base: &[Line]) -> Products<Self, ROWS, LANES> {
        let queries: &[[i32; STEPS]] = bytemuck::cast_slice(queries);
        let queries: &[[i32; STEPS]; ROWS] = queries.try_into().expect("a full tile of queries");
        let (left, right) = base.split_at(STEPS);
        let mut products = [[self.splat(0); VECTORS]; ROWS];
        for (step, (left, right)) in left.iter().zip(right).enumerate() {
            // SAFETY: a line is 64 readable bytes.
            let vectors = unsafe {
                [_mm512_loadu_si512(left.0.as_ptr().cast()), _mm512_loadu_si512(right.0.as_ptr().cast())]
            };
            for row in 0..ROWS {
                let query = self.splat(queries[row][step % STEPS]);
                for vector in 0..VECTORS {
                    // SAFETY: as above.
                    products[row][vector] =
                        unsafe { _mm512_dpbusd_epi32(products[row][vector], vectors[vector], query) };
                }
            }
        }
        products
    }
}

// SAFETY of all intrinsics: as above.
impl Lanes<LANES> for Avx512 {
    type Vector = __m512i;
    type Mask = __mmask16;

    #[inline(always)]
    fn splat(self, value: i32) -> __m512i {
        // SAFETY: as above.
        unsafe { _mm512_set1_epi32(value) }
    }

    #[inline(always)]
    fn load(self, values: &[i32; LANES]) -> __m512i {
        // SAFETY: 64 readable bytes.
        unsafe { _mm512_loadu_si512(values.as_ptr().cast()) }
    }

    #[inline(always)]
    fn store(self, vector: __m512i) -> [i32; LANES] {
        let mut values = [0; LANES];
        // SAFETY: the array is 64 writable bytes.
        unsafe { _mm512_storeu_si512(values.as_mut_ptr().cast(), vector) };
        values
    }

    #[inline(always)]
    fn distances(self, product: __m512i, column_terms: __m512i, row_term: __m512i) -> __m512i {
        // SAFETY: as above.
        unsafe { _mm512_add_epi32(_mm512_sub_epi32(column_terms, _mm512_slli_epi32::<1>(product)), row_term) }
    }

    #[inline(always)]
    fn min(self, a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: as above.
        unsafe { _mm512_min_epi32(a, b) }
    }

    #[inline(always)]
    fn max(self, a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: as above.
        unsafe { _mm512_max_epi32(a, b) }
    }

    #[inline(always)]
    fn select(self, mask: __mmask16, a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: as above.
        unsafe { _mm512_mask_blend_epi32(mask, b, a) }
    }

    #[inline(always)]
    fn less(self, a: __m512i, b: __m512i) -> __mmask16 {
        // SAFETY: as above.
        unsafe { _mm512_cmplt_epi32_mask(a, b) }
    }

    #[inline(always)]
    fn or(self, a: __mmask16, b: __mmask16) -> __mmask16 {
        a | b
    }

    #[inline(always)]
    fn bits(self, mask: __mmask16) -> u32 {
        u32::from(mask)
    }
}
