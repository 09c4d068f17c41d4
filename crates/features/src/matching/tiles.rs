//! The walk over register tiles that the vector kernels share.

use super::kernel::{BASE_BLOCK, Comparisons, Line, PackedBase, PackedQueries, QUERY_BLOCK, Slots};

/// Base vectors per register tile.
pub(super) const VECTORS: usize = 2;

/// The instructions of one kernel, for tiles of `ROWS` queries × `VECTORS` × `LANES` base descriptors.
///
/// A value of the type proves that the processor has them. [`search`] is inlined into a function that is compiled for
/// them, and so are these methods.
pub(super) trait Instructions<const ROWS: usize, const LANES: usize>: Copy {
    /// What it does with sums of products.
    type Lanes: Lanes<LANES>;
    /// Cache lines of a packed query.
    const QUERY_LINES: usize;
    /// Cache lines of `LANES` packed base descriptors.
    const BASE_LINES: usize;
    /// Base descriptors that stay in the first-level cache while all queries pass: 16 KiB.
    const TILE: usize;

    /// The processor's vectors of integers.
    fn lanes(self) -> Self::Lanes;
    /// Products of a full tile of queries and base descriptors.
    fn multiply(self, queries: &[Line], base: &[Line]) -> Products<Self::Lanes, ROWS, LANES>;
}

/// Products of a tile, `LANES` a vector.
pub(super) type Products<L, const ROWS: usize, const LANES: usize> =
    [[<L as Lanes<LANES>>::Vector; VECTORS]; ROWS];

/// Arithmetic on vectors of `LANES` integers of 32 bits.
pub(super) trait Lanes<const LANES: usize>: Copy {
    /// `LANES` integers of 32 bits.
    type Vector: Copy;

    /// `value` in every lane.
    fn splat(self, value: i32) -> Self::Vector;
    /// The first `LANES` values.
    fn load(self, values: &[i32]) -> Self::Vector;
    /// All lanes.
    fn store(self, vector: Self::Vector) -> [i32; LANES];
    /// column term + row term − 2 · product.
    fn distances(
        self,
        product: Self::Vector,
        column_terms: Self::Vector,
        row_term: Self::Vector,
    ) -> Self::Vector;
    /// One bit per lane in which `a` is less than `b`.
    fn less(self, a: Self::Vector, b: Self::Vector) -> u32;
}

/// Updates the best two of all rows and, with `COLUMNS`, of all columns, of those that are compared.
#[inline(always)]
pub(super) fn search<K, const ROWS: usize, const LANES: usize, const COLUMNS: bool>(
    kernel: K,
    queries: &PackedQueries,
    base: &PackedBase,
    rows: &mut Slots,
    columns: &mut Slots,
    compared: impl Comparisons,
) where
    K: Instructions<ROWS, LANES>,
{
    const {
        assert!(QUERY_BLOCK.is_multiple_of(ROWS) && BASE_BLOCK.is_multiple_of(LANES * VECTORS));
    }
    let num_columns = base.terms.len();
    for tile in (0..num_columns).step_by(K::TILE) {
        let tile_end = (tile + K::TILE).min(num_columns);
        for row in (0..queries.terms.len()).step_by(ROWS) {
            let query_lines = &queries.lines[row * K::QUERY_LINES..(row + ROWS) * K::QUERY_LINES];
            for column in (tile..tile_end).step_by(LANES * VECTORS) {
                if !compared.has(row, column) {
                    continue;
                }
                let first = column / LANES * K::BASE_LINES;
                let base_lines = &base.lines[first..first + VECTORS * K::BASE_LINES];
                let products = kernel.multiply(query_lines, base_lines);
                update::<K::Lanes, ROWS, LANES, COLUMNS>(
                    kernel.lanes(),
                    &products,
                    row,
                    column,
                    queries,
                    base,
                    rows,
                    columns,
                );
            }
        }
    }
}

#[expect(clippy::too_many_arguments, reason = "the loop's own variables, inlined back into it")]
#[inline(always)]
fn update<L, const ROWS: usize, const LANES: usize, const COLUMNS: bool>(
    lanes: L,
    products: &Products<L, ROWS, LANES>,
    row: usize,
    column: usize,
    queries: &PackedQueries,
    base: &PackedBase,
    rows: &mut Slots,
    columns: &mut Slots,
) where
    L: Lanes<LANES>,
{
    for vector in 0..VECTORS {
        let column = column + vector * LANES;
        let column_terms = lanes.load(&base.terms[column..column + LANES]);
        let mut column_second = lanes.load(&columns.second[column..column + LANES]);
        for offset in 0..ROWS {
            let row = row + offset;
            let row_term = lanes.splat(queries.terms[row]);
            let distances = lanes.distances(products[offset][vector], column_terms, row_term);
            let nearer_in_row = lanes.less(distances, lanes.splat(rows.second[row]));
            let nearer_in_column = if COLUMNS { lanes.less(distances, column_second) } else { 0 };
            if nearer_in_row | nearer_in_column != 0 {
                let values = lanes.store(distances);
                update_rows(&values, nearer_in_row, row, column, rows);
                if COLUMNS && nearer_in_column != 0 {
                    update_columns(&values, nearer_in_column, row, column, columns);
                    column_second = lanes.load(&columns.second[column..column + LANES]);
                }
            }
        }
    }
}

fn update_rows<const LANES: usize>(
    values: &[i32; LANES],
    mut mask: u32,
    row: usize,
    column: usize,
    rows: &mut Slots,
) {
    while mask != 0 {
        let lane = mask.trailing_zeros() as usize;
        rows.update(row, values[lane], column + lane);
        mask &= mask - 1;
    }
}

fn update_columns<const LANES: usize>(
    values: &[i32; LANES],
    mut mask: u32,
    row: usize,
    column: usize,
    columns: &mut Slots,
) {
    while mask != 0 {
        let lane = mask.trailing_zeros() as usize;
        columns.update(column + lane, values[lane], row);
        mask &= mask - 1;
    }
}
