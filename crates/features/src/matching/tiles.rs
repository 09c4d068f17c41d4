//! The walk over register tiles that the vector kernels share.

use super::TwoNearest;
use super::kernel::{BASE_BLOCK, Comparisons, Line, PackedBase, PackedQueries, QUERY_BLOCK, UNSEEN};

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
    /// What holds for each lane.
    type Mask: Copy;

    /// `value` in every lane.
    fn splat(self, value: i32) -> Self::Vector;
    /// These values.
    fn load(self, values: &[i32; LANES]) -> Self::Vector;
    /// All lanes.
    fn store(self, vector: Self::Vector) -> [i32; LANES];
    /// column term + row term − 2 · product.
    fn distances(
        self,
        product: Self::Vector,
        column_terms: Self::Vector,
        row_term: Self::Vector,
    ) -> Self::Vector;
    /// The smaller of both, lane by lane.
    fn min(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// The larger of both, lane by lane.
    fn max(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// `a` in the lanes of a mask, `b` in the others.
    fn select(self, mask: Self::Mask, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// The lanes in which `a` is less than `b`.
    fn less(self, a: Self::Vector, b: Self::Vector) -> Self::Mask;
    /// The lanes of either.
    fn or(self, a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// One bit per lane.
    fn bits(self, mask: Self::Mask) -> u32;
}

/// Squared distances of a tile, `LANES` a vector.
pub(super) type Distances<L, const ROWS: usize, const LANES: usize> = Products<L, ROWS, LANES>;

/// Takes the squared distances of the tiles, those of a row in ascending order of columns and the other way round.
pub(super) trait Sink<const LANES: usize> {
    /// Takes a tile that starts at this row and column.
    fn take<L: Lanes<LANES>, const ROWS: usize>(
        &mut self,
        lanes: L,
        distances: &Distances<L, ROWS, LANES>,
        row: usize,
        column: usize,
    );
}

/// Where nobody asks.
impl<const LANES: usize> Sink<LANES> for () {
    #[inline(always)]
    fn take<L: Lanes<LANES>, const ROWS: usize>(
        &mut self,
        _: L,
        _: &Distances<L, ROWS, LANES>,
        _: usize,
        _: usize,
    ) {
    }
}

/// [`search`], compiled for a kernel's instructions.
pub(super) trait Walk<const LANES: usize>: Copy {
    /// Hands all distances to `rows` and `columns`, of those that are compared.
    fn search(
        self,
        queries: &PackedQueries,
        base: &PackedBase,
        rows: &mut impl Sink<LANES>,
        columns: &mut impl Sink<LANES>,
        compared: impl Comparisons,
    );

    /// The nearest two of all rows and, if `both`, of all columns, padded, of those that are compared.
    fn two_nearest(
        self,
        queries: &PackedQueries,
        base: &PackedBase,
        compared: impl Comparisons,
        both: bool,
    ) -> [Vec<TwoNearest>; 2] {
        let mut rows = TwoOfRows::new(queries.terms.len());
        if !both {
            self.search(queries, base, &mut rows, &mut (), compared);
            return [rows.finish(), Vec::new()];
        }
        let mut columns = TwoOfColumns::new(base.terms.len());
        self.search(queries, base, &mut rows, &mut columns, compared);
        [rows.finish(), columns.finish()]
    }
}

/// Hands all distances to `rows` and `columns`, of those that are compared.
#[inline(always)]
pub(super) fn search<K, const ROWS: usize, const LANES: usize>(
    kernel: K,
    queries: &PackedQueries,
    base: &PackedBase,
    rows: &mut impl Sink<LANES>,
    columns: &mut impl Sink<LANES>,
    compared: impl Comparisons,
) where
    K: Instructions<ROWS, LANES>,
{
    const {
        assert!(QUERY_BLOCK.is_multiple_of(ROWS) && BASE_BLOCK.is_multiple_of(LANES * VECTORS));
    }
    let (num_columns, lanes) = (base.terms.len(), kernel.lanes());
    let (column_terms, _) = base.terms.as_chunks::<LANES>();
    for tile in (0..num_columns).step_by(K::TILE) {
        let tile_end = (tile + K::TILE).min(num_columns);
        for row in (0..queries.terms.len()).step_by(ROWS) {
            let query_lines = &queries.lines[row * K::QUERY_LINES..(row + ROWS) * K::QUERY_LINES];
            let row_terms: &[i32; ROWS] = queries.terms[row..].first_chunk().expect("a full tile of queries");
            for column in (tile..tile_end).step_by(LANES * VECTORS) {
                if !compared.has(row, column) {
                    continue;
                }
                let first = column / LANES;
                let base_lines = &base.lines[first * K::BASE_LINES..(first + VECTORS) * K::BASE_LINES];
                let mut distances = kernel.multiply(query_lines, base_lines);
                let column_terms: &[[i32; LANES]; VECTORS] =
                    column_terms[first..].first_chunk().expect("a full tile of base descriptors");
                for offset in 0..ROWS {
                    let row_term = lanes.splat(row_terms[offset]);
                    for vector in 0..VECTORS {
                        let (product, term) = (distances[offset][vector], lanes.load(&column_terms[vector]));
                        distances[offset][vector] = lanes.distances(product, term, row_term);
                    }
                }
                rows.take(lanes, &distances, row, column);
                columns.take(lanes, &distances, row, column);
            }
        }
    }
}

/// The lanes in which any of these is less than a bound.
#[inline(always)]
fn any_less<L: Lanes<LANES>, const N: usize, const LANES: usize>(
    lanes: L,
    distances: [L::Vector; N],
    bound: L::Vector,
) -> L::Mask {
    let mut any = lanes.less(distances[0], bound);
    for at in 1..N {
        any = lanes.or(any, lanes.less(distances[at], bound));
    }
    any
}

/// The nearest two of one vector of rows or columns, each lane by itself and without a branch, as many of them change often.
#[derive(Clone, Copy)]
struct LaneTwo<const LANES: usize> {
    best: [i32; LANES],
    second: [i32; LANES],
    /// What was given with the nearest.
    index: [i32; LANES],
}

impl<const LANES: usize> LaneTwo<LANES> {
    const NONE: Self = Self { best: [UNSEEN; LANES], second: [UNSEEN; LANES], index: [-1; LANES] };

    /// Whether any of these is one of the nearest two of its lane.
    #[inline(always)]
    fn is_any_nearer<L: Lanes<LANES>, const N: usize>(&self, lanes: L, distances: [L::Vector; N]) -> bool {
        lanes.bits(any_less(lanes, distances, lanes.load(&self.second))) != 0
    }

    /// Takes vectors of distances, each with what stands for it, in this order.
    #[inline(always)]
    fn take<L: Lanes<LANES>, const N: usize>(
        &mut self,
        lanes: L,
        distances: [L::Vector; N],
        indices: [L::Vector; N],
    ) {
        let (mut best, mut second) = (lanes.load(&self.best), lanes.load(&self.second));
        let mut index = lanes.load(&self.index);
        for at in 0..N {
            let nearer = lanes.less(distances[at], best);
            second = lanes.min(second, lanes.max(best, distances[at]));
            best = lanes.min(best, distances[at]);
            index = lanes.select(nearer, indices[at], index);
        }
        self.best = lanes.store(best);
        self.second = lanes.store(second);
        self.index = lanes.store(index);
    }

    /// What one lane has found, `offset` added to its index.
    fn found(&self, lane: usize, offset: usize) -> TwoNearest {
        let distance = |value: i32| if value == UNSEEN { TwoNearest::NO_DISTANCE } else { value as u32 };
        let index = usize::try_from(self.index[lane]);
        TwoNearest {
            index: index.map_or(TwoNearest::NO_INDEX, |index| (index + offset) as u32),
            distance2: distance(self.best[lane]),
            second_distance2: distance(self.second[lane]),
        }
    }
}

/// The nearest two of each row: those of every `LANES`-th column by themselves.
pub(super) struct TwoOfRows<const LANES: usize>(Vec<LaneTwo<LANES>>);

impl<const LANES: usize> TwoOfRows<LANES> {
    pub fn new(rows: usize) -> Self {
        Self(vec![LaneTwo::NONE; rows])
    }

    pub fn finish(&self) -> Vec<TwoNearest> {
        let of_row = |lanes: &LaneTwo<LANES>| {
            (0..LANES).map(|lane| lanes.found(lane, lane)).fold(TwoNearest::NONE, |found, other| {
                // Of equally near ones the lowest index.
                let is_first = (found.distance2, found.index) <= (other.distance2, other.index);
                let (mut first, second) = if is_first { (found, other) } else { (other, found) };
                first.merge(&second);
                first
            })
        };
        self.0.iter().map(of_row).collect()
    }
}

impl<const LANES: usize> Sink<LANES> for TwoOfRows<LANES> {
    #[inline(always)]
    fn take<L: Lanes<LANES>, const ROWS: usize>(
        &mut self,
        lanes: L,
        distances: &Distances<L, ROWS, LANES>,
        row: usize,
        column: usize,
    ) {
        let mut columns = [lanes.splat(column as i32); VECTORS];
        for vector in 1..VECTORS {
            columns[vector] = lanes.splat((column + vector * LANES) as i32);
        }
        let rows: &mut [LaneTwo<LANES>; ROWS] =
            self.0[row..].first_chunk_mut().expect("a full tile of queries");
        for offset in 0..ROWS {
            rows[offset].take(lanes, distances[offset], columns);
        }
    }
}

/// The nearest two of each column.
pub(super) struct TwoOfColumns<const LANES: usize>(Vec<LaneTwo<LANES>>);

impl<const LANES: usize> TwoOfColumns<LANES> {
    pub fn new(columns: usize) -> Self {
        Self(vec![LaneTwo::NONE; columns.div_ceil(LANES)])
    }

    pub fn finish(&self) -> Vec<TwoNearest> {
        self.0.iter().flat_map(|lanes| (0..LANES).map(|lane| lanes.found(lane, 0))).collect()
    }
}

impl<const LANES: usize> Sink<LANES> for TwoOfColumns<LANES> {
    #[inline(always)]
    fn take<L: Lanes<LANES>, const ROWS: usize>(
        &mut self,
        lanes: L,
        distances: &Distances<L, ROWS, LANES>,
        row: usize,
        column: usize,
    ) {
        let columns: &mut [LaneTwo<LANES>; VECTORS] =
            self.0[column / LANES..].first_chunk_mut().expect("a full tile of base descriptors");
        for vector in 0..VECTORS {
            let mut of_vector = [distances[0][vector]; ROWS];
            for offset in 1..ROWS {
                of_vector[offset] = distances[offset][vector];
            }
            if !columns[vector].is_any_nearer(lanes, of_vector) {
                continue;
            }
            let mut rows = [lanes.splat(row as i32); ROWS];
            for offset in 1..ROWS {
                rows[offset] = lanes.splat((row + offset) as i32);
            }
            columns[vector].take(lanes, of_vector, rows);
        }
    }
}

/// Rows that hand on what is nearer than their bounds.
pub(super) struct Offers<'a> {
    /// For each row, padded, the squared distance below which a base descriptor is offered.
    pub bounds: Vec<i32>,
    /// Takes row, squared distance and column, and tells the row's new bound.
    pub offer: &'a mut dyn FnMut(usize, i32, usize) -> i32,
}

impl<const LANES: usize> Sink<LANES> for Offers<'_> {
    #[inline(always)]
    fn take<L: Lanes<LANES>, const ROWS: usize>(
        &mut self,
        lanes: L,
        distances: &Distances<L, ROWS, LANES>,
        row: usize,
        column: usize,
    ) {
        let bounds: &[i32; ROWS] = self.bounds[row..].first_chunk().expect("a full tile of queries");
        let mut any = any_less(lanes, distances[0], lanes.splat(bounds[0]));
        for offset in 1..ROWS {
            any = lanes.or(any, any_less(lanes, distances[offset], lanes.splat(bounds[offset])));
        }
        // Of most tiles nothing is.
        if lanes.bits(any) == 0 {
            return;
        }
        for offset in 0..ROWS {
            let row = row + offset;
            for vector in 0..VECTORS {
                let mut near =
                    lanes.bits(lanes.less(distances[offset][vector], lanes.splat(self.bounds[row])));
                let values = lanes.store(distances[offset][vector]);
                while near != 0 {
                    let lane = near.trailing_zeros() as usize;
                    near &= near - 1;
                    // An earlier lane may have lowered the bound.
                    if values[lane] < self.bounds[row] {
                        self.bounds[row] = (self.offer)(row, values[lane], column + vector * LANES + lane);
                    }
                }
            }
        }
    }
}
