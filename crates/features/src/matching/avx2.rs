//! AVX2, in two ways: 16-bit words for any descriptors, bytes at twice the pace for short ones.
//!
//! Both multiply pairs of components and add the two products. `vpmaddwd` takes words and sums in 32 bits.
//! `vpmaddubsw` takes bytes, twice as many, but sums in 16 bits, signed: two products of bytes up to 127 fit, and sums of
//! such pairs stay below 2¹⁶ where descriptors [are short](is_short).

use std::arch::x86_64::{
    __m256i, _mm256_add_epi16, _mm256_add_epi32, _mm256_and_si256, _mm256_blendv_epi8, _mm256_castsi256_ps,
    _mm256_cmpgt_epi32, _mm256_loadu_si256, _mm256_madd_epi16, _mm256_maddubs_epi16, _mm256_max_epi32,
    _mm256_min_epi32, _mm256_movemask_ps, _mm256_or_si256, _mm256_set1_epi32, _mm256_slli_epi32,
    _mm256_srli_epi32, _mm256_storeu_si256, _mm256_sub_epi32,
};

use bytemuck::{Pod, Zeroable};

use super::kernel::{Comparisons, Line, PackedBase, PackedQueries, squared_norm};
use super::tiles::{self, Instructions, Lanes, Products, Sink, VECTORS, Walk};
use crate::DESCRIPTOR_LEN;

/// Queries per register tile; with 2 base vectors that makes 12 accumulators of the 16 registers.
const ROWS: usize = 6;
/// Base descriptors per vector register.
const LANES: usize = 8;

/// Proof that the processor has AVX2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Avx2(());

impl Avx2 {
    pub fn detect() -> Option<Self> {
        std::arch::is_x86_feature_detected!("avx2").then_some(Self(()))
    }

    /// Components as 16-bit words.
    pub fn words(self) -> Words {
        Words(self)
    }

    /// Components as bytes, for descriptors that [are short](is_short).
    pub fn bytes(self) -> Bytes {
        Bytes(self)
    }
}

/// Whether sums of products of any two of these and other such descriptors fit in 16 bits.
///
/// A lane of 32 bits takes four components, two in each half. Products are not negative, so no sum on the way is above
/// the last one, and that is at most the product of the lengths of what the half takes.
pub(super) fn is_short(descriptors: &[u8]) -> bool {
    let is_short = |descriptor: &[u8]| {
        let mut squares = [0_u32; 4];
        for components in descriptor.as_chunks::<4>().0 {
            for (square, &component) in squares.iter_mut().zip(components) {
                *square += u32::from(component).pow(2);
            }
        }
        squares[0] + squares[1] < 1 << 16 && squares[2] + squares[3] < 1 << 16
    };
    descriptors.iter().fold(0, |all, &byte| all | byte) <= 127
        && descriptors.chunks_exact(DESCRIPTOR_LEN).all(is_short)
}

/// Multiplies 16-bit words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Words(Avx2);

impl Words {
    pub fn pack_base(descriptors: &[u8]) -> PackedBase {
        pack_base::<Self, i16, 2>(descriptors, i16::from)
    }

    pub fn pack_queries(descriptors: &[u8]) -> PackedQueries {
        PackedQueries::new(descriptors, ROWS, i16::from)
    }
}

/// Multiplies bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Bytes(Avx2);

impl Bytes {
    pub fn pack_base(descriptors: &[u8]) -> PackedBase {
        debug_assert!(is_short(descriptors));
        pack_base::<Self, u8, 4>(descriptors, |byte| byte)
    }

    pub fn pack_queries(descriptors: &[u8]) -> PackedQueries {
        debug_assert!(is_short(descriptors));
        PackedQueries::new(descriptors, ROWS, |byte| byte)
    }
}

/// Packs the same `PER_LANE` components of `LANES` descriptors side by side.
fn pack_base<K: Instructions<ROWS, LANES>, T: Pod, const PER_LANE: usize>(
    descriptors: &[u8],
    stored: impl Fn(u8) -> T,
) -> PackedBase {
    let padded = super::count(descriptors).next_multiple_of(LANES * VECTORS);
    let mut lines: Vec<Line> = vec![Line::zeroed(); padded / LANES * K::BASE_LINES];
    let values: &mut [T] = bytemuck::cast_slice_mut(&mut lines);
    let mut terms = vec![super::kernel::PADDING; padded];
    for (index, descriptor) in descriptors.chunks_exact(DESCRIPTOR_LEN).enumerate() {
        let (vector, lane) = (index / LANES, index % LANES);
        for (step, components) in descriptor.chunks_exact(PER_LANE).enumerate() {
            let place = vector * LANES * DESCRIPTOR_LEN + (step * LANES + lane) * PER_LANE;
            for (value, &byte) in values[place..place + PER_LANE].iter_mut().zip(components) {
                *value = stored(byte);
            }
        }
        terms[index] = squared_norm(descriptor);
    }
    PackedBase { lines, terms }
}

impl<K: Instructions<ROWS, LANES, Lanes = Avx2>> Walk<LANES> for K {
    fn search(
        self,
        queries: &PackedQueries,
        base: &PackedBase,
        rows: &mut impl Sink<LANES>,
        columns: &mut impl Sink<LANES>,
        compared: impl Comparisons,
    ) {
        #[target_feature(enable = "avx2")]
        fn compiled<K: Instructions<ROWS, LANES>>(
            kernel: K,
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
impl Instructions<ROWS, LANES> for Words {
    type Lanes = Avx2;
    const QUERY_LINES: usize = 4;
    const BASE_LINES: usize = 32;
    const TILE: usize = 64;

    #[inline(always)]
    fn lanes(self) -> Avx2 {
        self.0
    }

    #[inline(always)]
    fn multiply(self, queries: &[Line], base: &[Line]) -> Products<Avx2, ROWS, LANES> {
        multiply::<_, { DESCRIPTOR_LEN / 2 }>(self, queries, base)
    }
}

// SAFETY of all intrinsics: `self` proves that the instructions are there.
impl Instructions<ROWS, LANES> for Bytes {
    type Lanes = Avx2;
    const QUERY_LINES: usize = 2;
    const BASE_LINES: usize = 16;
    const TILE: usize = 128;

    #[inline(always)]
    fn lanes(self) -> Avx2 {
        self.0
    }

    #[inline(always)]
    fn multiply(self, queries: &[Line], base: &[Line]) -> Products<Avx2, ROWS, LANES> {
        let mut products = multiply::<_, { DESCRIPTOR_LEN / 4 }>(self, queries, base);
        let low = self.0.splat(0xffff);
        for row in &mut products {
            for sums in row {
                // SAFETY: as above.
                *sums =
                    unsafe { _mm256_add_epi32(_mm256_and_si256(*sums, low), _mm256_srli_epi32::<16>(*sums)) };
            }
        }
        products
    }
}

/// The one instruction that differs. (No closure: that would not be compiled for the processor's features.)
trait AddProducts: Instructions<ROWS, LANES, Lanes = Avx2> {
    fn add_products(self, sums: __m256i, base: __m256i, query: __m256i) -> __m256i;
}

impl AddProducts for Words {
    #[inline(always)]
    fn add_products(self, sums: __m256i, base: __m256i, query: __m256i) -> __m256i {
        // SAFETY: the instructions are there, as `self` proves.
        unsafe { _mm256_add_epi32(sums, _mm256_madd_epi16(base, query)) }
    }
}

impl AddProducts for Bytes {
    #[inline(always)]
    fn add_products(self, sums: __m256i, base: __m256i, query: __m256i) -> __m256i {
        // SAFETY: the instructions are there, as `self` proves.
        unsafe { _mm256_add_epi16(sums, _mm256_maddubs_epi16(base, query)) }
    }
}

/// Runs over all components of a tile, `STEPS` groups of as many as fill 32 bits.
#[inline(always)]
fn multiply<K: AddProducts, const STEPS: usize>(
    kernel: K,
    queries: &[Line],
    base: &[Line],
) -> Products<Avx2, ROWS, LANES> {
    let lanes = kernel.lanes();
    let (queries, _) = bytemuck::cast_slice::<_, i32>(queries).as_chunks::<STEPS>();
    let queries: &[[i32; STEPS]; ROWS] = queries.try_into().expect("a full tile of queries");
    // A vector of one step is half a line.
    let halves: &[[u8; 32]] = bytemuck::cast_slice(base);
    let (left, right) = halves.split_at(STEPS);
    let mut products = [[lanes.splat(0); VECTORS]; ROWS];
    for (step, (left, right)) in left.iter().zip(right).enumerate() {
        // SAFETY: both are 32 readable bytes.
        let vectors =
            unsafe { [_mm256_loadu_si256(left.as_ptr().cast()), _mm256_loadu_si256(right.as_ptr().cast())] };
        for row in 0..ROWS {
            let query = lanes.splat(queries[row][step % STEPS]);
            for vector in 0..VECTORS {
                products[row][vector] = kernel.add_products(products[row][vector], vectors[vector], query);
            }
        }
    }
    products
}

// SAFETY of all intrinsics: `self` proves that the instructions are there.
impl Lanes<LANES> for Avx2 {
    type Vector = __m256i;
    /// All bits of a lane.
    type Mask = __m256i;

    #[inline(always)]
    fn splat(self, value: i32) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_set1_epi32(value) }
    }

    #[inline(always)]
    fn load(self, values: &[i32; LANES]) -> __m256i {
        // SAFETY: 32 readable bytes.
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
    fn min(self, a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_min_epi32(a, b) }
    }

    #[inline(always)]
    fn max(self, a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_max_epi32(a, b) }
    }

    #[inline(always)]
    fn select(self, mask: __m256i, a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_blendv_epi8(b, a, mask) }
    }

    #[inline(always)]
    fn less(self, a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_cmpgt_epi32(b, a) }
    }

    #[inline(always)]
    fn or(self, a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_or_si256(a, b) }
    }

    #[inline(always)]
    fn bits(self, mask: __m256i) -> u32 {
        // SAFETY: as above.
        unsafe { _mm256_movemask_ps(_mm256_castsi256_ps(mask)) as u32 }
    }
}
