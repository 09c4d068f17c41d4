//! AVX2: pairs of 16-bit products accumulated in i32.
//!
//! `vpmaddubsw` would do twice the work per instruction but saturates at 16 bits for bytes above 127, so bytes are
//! widened to 16 bits once, when they are packed.

use super::kernel::{Line, PackedBase, PackedQueries, Slots};

/// Queries per register tile.
const ROWS: usize = 6;
/// Base descriptors per vector register.
const LANES: usize = 8;
/// Base vectors per register tile; with 6 queries that makes 12 accumulators of the 16 registers.
const VECTORS: usize = 2;
/// Groups of two components.
const STEPS: usize = crate::DESCRIPTOR_LEN / 2;
/// Base descriptors that stay in the first-level cache while all queries pass: 16 KiB.
const TILE: usize = 64;

pub(super) fn is_available() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        std::arch::is_x86_feature_detected!("avx2")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        false
    }
}

pub(super) fn pack_base(descriptors: &[u8]) -> PackedBase {
    let count = super::count(descriptors);
    let padded = count.next_multiple_of(LANES * VECTORS);
    // A vector of one step is half a line.
    let mut lines: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); padded / LANES * STEPS / 2];
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

pub(super) fn pack_queries(descriptors: &[u8]) -> PackedQueries {
    let count = super::count(descriptors);
    let padded = count.next_multiple_of(ROWS);
    let mut lines: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); padded * 4];
    let words: &mut [i16] = bytemuck::cast_slice_mut(&mut lines);
    for (target, &value) in words.iter_mut().zip(descriptors) {
        *target = i16::from(value);
    }
    let mut terms: Vec<i32> =
        descriptors.chunks_exact(crate::DESCRIPTOR_LEN).map(super::kernel::squared_norm).collect();
    terms.resize(padded, super::kernel::PADDING);
    PackedQueries { lines, terms }
}

#[cfg(not(target_arch = "x86_64"))]
pub(super) fn search(_: &PackedQueries, _: &PackedBase, _: &mut Slots, _: &mut Slots, _: bool) {
    unreachable!("the AVX2 kernel is only chosen where it is available");
}

#[cfg(target_arch = "x86_64")]
pub(super) fn search(
    queries: &PackedQueries,
    base: &PackedBase,
    rows: &mut Slots,
    columns: &mut Slots,
    both: bool,
) {
    assert!(is_available());
    // SAFETY: the instructions are there, as just checked.
    unsafe {
        if both {
            x86::search::<true>(queries, base, rows, columns);
        } else {
            x86::search::<false>(queries, base, rows, columns);
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{
        __m256i, _mm256_add_epi32, _mm256_castsi256_ps, _mm256_cmpgt_epi32, _mm256_loadu_si256,
        _mm256_madd_epi16, _mm256_movemask_ps, _mm256_set1_epi32, _mm256_setzero_si256, _mm256_slli_epi32,
        _mm256_storeu_si256, _mm256_sub_epi32,
    };

    use super::{LANES, Line, PackedBase, PackedQueries, ROWS, STEPS, Slots, TILE, VECTORS};

    const LINES_PER_VECTOR: usize = STEPS / 2;

    #[target_feature(enable = "avx2")]
    pub(super) fn search<const COLUMNS: bool>(
        queries: &PackedQueries,
        base: &PackedBase,
        rows: &mut Slots,
        columns: &mut Slots,
    ) {
        let num_columns = base.terms.len();
        for tile in (0..num_columns).step_by(TILE) {
            let tile_end = (tile + TILE).min(num_columns);
            for row in (0..queries.terms.len()).step_by(ROWS) {
                let query_lines = &queries.lines[row * 4..(row + ROWS) * 4];
                for column in (tile..tile_end).step_by(LANES * VECTORS) {
                    let first = column / LANES * LINES_PER_VECTOR;
                    let base_lines = &base.lines[first..first + VECTORS * LINES_PER_VECTOR];
                    let products = multiply(query_lines, base_lines);
                    update::<COLUMNS>(&products, row, column, queries, base, rows, columns);
                }
            }
        }
    }

    /// Products of 6 queries with 2 × 8 base descriptors.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn multiply(queries: &[Line], base: &[Line]) -> [[__m256i; VECTORS]; ROWS] {
        let queries: &[[i32; STEPS]] = bytemuck::cast_slice(queries);
        let queries: &[[i32; STEPS]; ROWS] = queries.try_into().expect("a full tile of queries");
        let halves: &[[u8; 32]] = bytemuck::cast_slice(base);
        let (left, right) = halves.split_at(STEPS);
        let mut products = [[_mm256_setzero_si256(); VECTORS]; ROWS];
        for (step, (left, right)) in left.iter().zip(right).enumerate() {
            // SAFETY: both are 32 readable bytes.
            let vectors =
                unsafe { [_mm256_loadu_si256(left.as_ptr().cast()), _mm256_loadu_si256(right.as_ptr().cast())] };
            for row in 0..ROWS {
                let query = _mm256_set1_epi32(queries[row][step % STEPS]);
                for vector in 0..VECTORS {
                    let pairs = _mm256_madd_epi16(vectors[vector], query);
                    products[row][vector] = _mm256_add_epi32(products[row][vector], pairs);
                }
            }
        }
        products
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn update<const COLUMNS: bool>(
        products: &[[__m256i; VECTORS]; ROWS],
        row: usize,
        column: usize,
        queries: &PackedQueries,
        base: &PackedBase,
        rows: &mut Slots,
        columns: &mut Slots,
    ) {
        for vector in 0..VECTORS {
            let column = column + vector * LANES;
            let column_terms = load(&base.terms[column..column + LANES]);
            let mut column_second = load(&columns.second[column..column + LANES]);
            for offset in 0..ROWS {
                let row = row + offset;
                let doubled = _mm256_slli_epi32::<1>(products[offset][vector]);
                let row_term = _mm256_set1_epi32(queries.terms[row]);
                let distances = _mm256_add_epi32(_mm256_sub_epi32(column_terms, doubled), row_term);
                let nearer_in_row = lanes(_mm256_cmpgt_epi32(_mm256_set1_epi32(rows.second[row]), distances));
                let nearer_in_column =
                    if COLUMNS { lanes(_mm256_cmpgt_epi32(column_second, distances)) } else { 0 };
                if nearer_in_row | nearer_in_column != 0 {
                    let mut values = [0i32; LANES];
                    // SAFETY: the array is 32 writable bytes.
                    unsafe { _mm256_storeu_si256(values.as_mut_ptr().cast(), distances) };
                    for lane in 0..LANES {
                        if nearer_in_row >> lane & 1 != 0 {
                            rows.update(row, values[lane], column + lane);
                        }
                        if nearer_in_column >> lane & 1 != 0 {
                            columns.update(column + lane, values[lane], row);
                        }
                    }
                    column_second = load(&columns.second[column..column + LANES]);
                }
            }
        }
    }

    /// One bit per lane of a comparison.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn lanes(comparison: __m256i) -> i32 {
        _mm256_movemask_ps(_mm256_castsi256_ps(comparison))
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn load(values: &[i32]) -> __m256i {
        assert!(values.len() >= LANES);
        // SAFETY: at least 32 readable bytes, as just checked.
        unsafe { _mm256_loadu_si256(values.as_ptr().cast()) }
    }
}
