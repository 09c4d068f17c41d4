//! AVX-512 VNNI: four u8 × i8 products per lane and instruction, accumulated in i32 without saturation.
//!
//! `vpdpbusd` multiplies unsigned by signed bytes, so queries are stored minus 128:
//! q·b = (q − 128)·b + 128 Σb, and the column term becomes ‖b‖² − 256 Σb.

use super::kernel::{Line, PackedBase, PackedQueries, Slots};

/// Queries per register tile.
const ROWS: usize = 12;
/// Base descriptors per vector register.
const LANES: usize = 16;
/// Base vectors per register tile; with 12 queries that makes 24 accumulators of the 32 registers.
const VECTORS: usize = 2;
/// Groups of four components.
const STEPS: usize = crate::DESCRIPTOR_LEN / 4;
/// Base descriptors that stay in the first-level cache while all queries pass: 16 KiB.
const TILE: usize = 128;

pub(super) fn is_available() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        std::arch::is_x86_feature_detected!("avx512f")
            && std::arch::is_x86_feature_detected!("avx512bw")
            && std::arch::is_x86_feature_detected!("avx512vnni")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        false
    }
}

pub(super) fn pack_base(descriptors: &[u8]) -> PackedBase {
    let count = super::count(descriptors);
    let padded = count.next_multiple_of(LANES * VECTORS);
    let mut lines: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); padded / LANES * STEPS];
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

pub(super) fn pack_queries(descriptors: &[u8]) -> PackedQueries {
    let count = super::count(descriptors);
    let padded = count.next_multiple_of(ROWS);
    let mut lines: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); padded * 2];
    let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut lines);
    for (target, &value) in bytes.iter_mut().zip(descriptors) {
        *target = value ^ 0x80;
    }
    let mut terms: Vec<i32> =
        descriptors.chunks_exact(crate::DESCRIPTOR_LEN).map(super::kernel::squared_norm).collect();
    terms.resize(padded, super::kernel::PADDING);
    PackedQueries { lines, terms }
}

#[cfg(not(target_arch = "x86_64"))]
pub(super) fn search(_: &PackedQueries, _: &PackedBase, _: &mut Slots, _: &mut Slots, _: bool) {
    unreachable!("the AVX-512 kernel is only chosen where it is available");
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
        __m512i, _mm512_add_epi32, _mm512_cmplt_epi32_mask, _mm512_dpbusd_epi32, _mm512_loadu_si512,
        _mm512_set1_epi32, _mm512_setzero_si512, _mm512_slli_epi32, _mm512_storeu_si512, _mm512_sub_epi32,
    };

    use super::{LANES, Line, PackedBase, PackedQueries, ROWS, STEPS, Slots, TILE, VECTORS};

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
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
                let query_lines = &queries.lines[row * 2..(row + ROWS) * 2];
                for column in (tile..tile_end).step_by(LANES * VECTORS) {
                    let first = column / LANES * STEPS;
                    let products = multiply(query_lines, &base.lines[first..first + VECTORS * STEPS]);
                    update::<COLUMNS>(&products, row, column, queries, base, rows, columns);
                }
            }
        }
    }

    /// Products of 12 queries with 2 × 16 base descriptors.
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    #[inline]
    fn multiply(queries: &[Line], base: &[Line]) -> [[__m512i; VECTORS]; ROWS] {
        let queries: &[[i32; STEPS]] = bytemuck::cast_slice(queries);
        let queries: &[[i32; STEPS]; ROWS] = queries.try_into().expect("a full tile of queries");
        let (left, right) = base.split_at(STEPS);
        let mut products = [[_mm512_setzero_si512(); VECTORS]; ROWS];
        for (step, (left, right)) in left.iter().zip(right).enumerate() {
            // SAFETY: a line is 64 readable bytes.
            let vectors =
                unsafe { [_mm512_loadu_si512(left.0.as_ptr().cast()), _mm512_loadu_si512(right.0.as_ptr().cast())] };
            for row in 0..ROWS {
                let query = _mm512_set1_epi32(queries[row][step % STEPS]);
                products[row][0] = _mm512_dpbusd_epi32(products[row][0], vectors[0], query);
                products[row][1] = _mm512_dpbusd_epi32(products[row][1], vectors[1], query);
            }
        }
        products
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    #[inline]
    fn update<const COLUMNS: bool>(
        products: &[[__m512i; VECTORS]; ROWS],
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
                let doubled = _mm512_slli_epi32::<1>(products[offset][vector]);
                let row_term = _mm512_set1_epi32(queries.terms[row]);
                let distances = _mm512_add_epi32(_mm512_sub_epi32(column_terms, doubled), row_term);
                let nearer_in_row = _mm512_cmplt_epi32_mask(distances, _mm512_set1_epi32(rows.second[row]));
                let nearer_in_column =
                    if COLUMNS { _mm512_cmplt_epi32_mask(distances, column_second) } else { 0 };
                if nearer_in_row | nearer_in_column != 0 {
                    let mut values = [0i32; LANES];
                    // SAFETY: the array is 64 writable bytes.
                    unsafe { _mm512_storeu_si512(values.as_mut_ptr().cast(), distances) };
                    update_rows(&values, nearer_in_row, row, column, rows);
                    if COLUMNS && nearer_in_column != 0 {
                        update_columns(&values, nearer_in_column, row, column, columns);
                        column_second = load(&columns.second[column..column + LANES]);
                    }
                }
            }
        }
    }

    fn update_rows(values: &[i32; LANES], mut mask: u16, row: usize, column: usize, rows: &mut Slots) {
        while mask != 0 {
            let lane = mask.trailing_zeros() as usize;
            rows.update(row, values[lane], column + lane);
            mask &= mask - 1;
        }
    }

    fn update_columns(values: &[i32; LANES], mut mask: u16, row: usize, column: usize, columns: &mut Slots) {
        while mask != 0 {
            let lane = mask.trailing_zeros() as usize;
            columns.update(column + lane, values[lane], row);
            mask &= mask - 1;
        }
    }

    #[target_feature(enable = "avx512f")]
    #[inline]
    fn load(values: &[i32]) -> __m512i {
        assert!(values.len() >= LANES);
        // SAFETY: at least 64 readable bytes, as just checked.
        unsafe { _mm512_loadu_si512(values.as_ptr().cast()) }
    }
}
