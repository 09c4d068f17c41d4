//! Cholesky of the reduced camera system: dense when small or full, sparse supernodal otherwise.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::{factor, solve};
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, Mat, MatMut, Par, Side};

use super::LinearSolver;
use super::pattern::BlockPattern;

/// Up to this scalar size the dense factorization wins whatever the fill.
const DENSE_SIZE: usize = 600;
/// Share of the lower triangle above which the dense factorization wins at any size.
const DENSE_FILL: f64 = 0.4;

/// Numbers that S, the chunks' shares in it and its factorization may take: 2 GiB.
const MAX_VALUES: usize = 1 << 28;
/// Operations of a factorization that are never too many, about a twentieth of a second: S of 300 cameras, full.
const MIN_OPERATIONS: f64 = 2e9;
/// Operations of a factorization, per observation, that are not too many: as long as ten products with S take.
const OPERATIONS_PER_OBSERVATION: f64 = 5e3;

/// What a factorization may cost.
#[derive(Debug, Clone, Copy)]
pub(super) struct Budget {
    /// Most numbers stored.
    values: usize,
    /// Most multiplications and additions of one factorization.
    operations: f64,
    /// Whether S may be factorized as a whole.
    of_whole: bool,
}

impl Budget {
    /// Whatever it takes: as much as offsets of 32 bits reach, 32 GiB.
    const ANY: Self = Self { values: u32::MAX as usize, operations: f64::INFINITY, of_whole: true };
    /// What fits into memory, however long it takes.
    pub const MEMORY: Self = Self { values: MAX_VALUES, ..Self::ANY };

    /// What a solver spends on a problem of so many observations before it leaves S implicit.
    pub fn new(solver: LinearSolver, observations: usize) -> Self {
        match solver {
            LinearSolver::Auto => Self::MEMORY.within_time(observations),
            LinearSolver::Direct => Self::ANY,
            LinearSolver::Iterative => Self { of_whole: false, ..Self::MEMORY.within_time(observations) },
        }
    }

    /// No more than takes about as long as what else there is to a step on so many observations.
    pub fn within_time(self, observations: usize) -> Self {
        let operations = MIN_OPERATIONS.max(OPERATIONS_PER_OBSERVATION * observations as f64);
        Self { operations: operations.min(self.operations), ..self }
    }

    /// Whether S may be factorized as a whole.
    pub fn is_of_whole(&self) -> bool {
        self.of_whole
    }

    /// What is left when so many numbers are stored elsewhere.
    pub fn without(&self, values: usize) -> Option<Self> {
        Some(Self { values: self.values.checked_sub(values)?, ..*self })
    }

    /// Whether a pattern may be within the budget; when not, no ordering of it is.
    ///
    /// A factor has at least the values of S (the upper halves of diagonal blocks, counted here, are few), and their
    /// numbers in the columns, squared, add up to at least what equal columns would.
    pub fn may_suffice(&self, pattern: &BlockPattern) -> bool {
        let values = pattern.len() as f64;
        pattern.len() <= self.values && values * values <= self.operations * pattern.size() as f64
    }
}

#[expect(clippy::large_enum_variant, reason = "one per problem, never moved in a loop")]
/// A factorization whose memory and symbolic analysis are reused over all iterations.
pub(super) enum CameraSystem {
    /// Cholesky in place on a full matrix.
    Dense { matrix: Mat<f64>, memory: MemBuffer },
    /// Cholesky on compressed columns of the lower triangle.
    Sparse {
        column_starts: Vec<usize>,
        rows: Vec<usize>,
        values: Vec<f64>,
        symbolic: SymbolicCholesky<usize>,
        factor: Vec<f64>,
        memory: MemBuffer,
    },
}

impl CameraSystem {
    /// Chooses the factorization and allocates for it; `None` when it is beyond the budget.
    pub fn new(pattern: &BlockPattern, budget: &Budget) -> Option<Self> {
        let size = pattern.size();
        let fill = pattern.len() as f64 / (0.5 * (size * size) as f64).max(1.0);
        if size > DENSE_SIZE && fill < DENSE_FILL {
            return Self::sparse(pattern, budget);
        }
        let operations = (size as f64).powi(3) / 3.0;
        let fits = size.checked_mul(size)? <= budget.values && operations <= budget.operations;
        fits.then(|| Self::dense(size))
    }

    fn dense(size: usize) -> Self {
        let scratch = factor::cholesky_in_place_scratch::<f64>(size, Par::Seq, faer::Spec::default())
            .or(solve::solve_in_place_scratch::<f64>(size, 1, Par::Seq));
        Self::Dense { matrix: Mat::zeros(size, size), memory: MemBuffer::new(scratch) }
    }

    fn sparse(pattern: &BlockPattern, budget: &Budget) -> Option<Self> {
        // Row indices and values.
        if 2 * pattern.len() > budget.values {
            return None;
        }
        let (mut column_starts, mut rows) = (vec![0], Vec::with_capacity(pattern.len()));
        for block_column in 0..pattern.block_count() {
            for column in 0..pattern.dim(block_column) {
                for block_row in pattern.rows(block_column) {
                    let first = if block_row == block_column { column } else { 0 };
                    rows.extend((first..pattern.dim(block_row)).map(|row| pattern.start(block_row) + row));
                }
                column_starts.push(rows.len());
            }
        }
        let size = pattern.size();
        let structure = SymbolicSparseColMatRef::new_checked(size, size, &column_starts, None, &rows);
        let symbolic = factorize_symbolic_cholesky(
            structure,
            Side::Lower,
            SymmetricOrdering::Amd,
            CholeskySymbolicParams::default(),
        )
        .ok()?;
        let values = 2 * rows.len() + symbolic.len_val();
        if values > budget.values || operations(&symbolic) > budget.operations {
            return None;
        }
        let scratch = symbolic
            .factorize_numeric_llt_scratch::<f64>(Par::Seq, faer::Spec::default())
            .or(symbolic.solve_in_place_scratch::<f64>(1, Par::Seq));
        Some(Self::Sparse {
            values: vec![0.0; rows.len()],
            factor: vec![0.0; symbolic.len_val()],
            memory: MemBuffer::new(scratch),
            column_starts,
            rows,
            symbolic,
        })
    }

    /// Factorizes the matrix of these block values; false when it is not positive definite.
    pub fn factorize(&mut self, pattern: &BlockPattern, blocks: &[f64]) -> bool {
        match self {
            Self::Dense { matrix, memory } => {
                for block_column in 0..pattern.block_count() {
                    let start = pattern.start(block_column);
                    for block_row in pattern.rows(block_column) {
                        let (dim, row) = (pattern.dim(block_row), pattern.start(block_row));
                        let offset = pattern.offset(block_row, block_column);
                        for column in 0..pattern.dim(block_column) {
                            let from = &blocks[offset + column * dim..][..dim];
                            matrix.col_as_slice_mut(start + column)[row..row + dim].copy_from_slice(from);
                        }
                    }
                    // The factor overwrites what was zero.
                    for other in start..start + pattern.dim(block_column) {
                        let column = matrix.col_as_slice_mut(other);
                        let mut next = start;
                        for block_row in pattern.rows(block_column) {
                            column[next..pattern.start(block_row)].fill(0.0);
                            next = pattern.start(block_row) + pattern.dim(block_row);
                        }
                        column[next..].fill(0.0);
                    }
                }
                let stack = MemStack::new(memory);
                factor::cholesky_in_place(
                    matrix.as_mut(),
                    factor::LltRegularization::default(),
                    Par::Seq,
                    stack,
                    faer::Spec::default(),
                )
                .is_ok()
            }
            Self::Sparse { column_starts, rows, values, symbolic, factor, memory } => {
                let mut next = 0;
                for block_column in 0..pattern.block_count() {
                    for column in 0..pattern.dim(block_column) {
                        for block_row in pattern.rows(block_column) {
                            let first = if block_row == block_column { column } else { 0 };
                            let dim = pattern.dim(block_row);
                            let offset = pattern.offset(block_row, block_column) + column * dim;
                            let count = dim - first;
                            values[next..next + count].copy_from_slice(&blocks[offset + first..offset + dim]);
                            next += count;
                        }
                    }
                }
                let size = pattern.size();
                let structure = SymbolicSparseColMatRef::new_checked(size, size, column_starts, None, rows);
                symbolic
                    .factorize_numeric_llt(
                        factor,
                        SparseColMatRef::new(structure, values),
                        Side::Lower,
                        factor::LltRegularization::default(),
                        Par::Seq,
                        MemStack::new(memory),
                        faer::Spec::default(),
                    )
                    .is_ok()
            }
        }
    }

    /// Solves for a right-hand side in place, after a successful [`CameraSystem::factorize`].
    pub fn solve(&mut self, right: &mut [f64]) {
        let size = right.len();
        let right = MatMut::from_column_major_slice_mut(right, size, 1);
        match self {
            Self::Dense { matrix, memory } => {
                solve::solve_in_place(matrix.as_ref(), right, Par::Seq, MemStack::new(memory));
            }
            Self::Sparse { symbolic, factor, memory, .. } => {
                let llt = LltRef::<'_, usize, f64>::new(symbolic, factor);
                llt.solve_in_place_with_conj(Conj::No, right, Par::Seq, MemStack::new(memory));
            }
        }
    }
}

/// Multiplications and additions of a numeric factorization: Σ (values in a column of the factor)².
fn operations(symbolic: &SymbolicCholesky<usize>) -> f64 {
    let squares = |columns: usize, below: usize| -> f64 {
        (below + 1..=below + columns).map(|length| (length as f64).powi(2)).sum()
    };
    match symbolic.raw() {
        SymbolicCholeskyRaw::Simplicial(simplicial) => {
            simplicial.col_ptr().windows(2).map(|ends| squares(1, ends[1] - ends[0] - 1)).sum()
        }
        SymbolicCholeskyRaw::Supernodal(supernodal) => {
            let columns = supernodal.supernode_begin().iter().zip(supernodal.supernode_end());
            let below = supernodal.col_ptr_for_row_idx().windows(2);
            columns.zip(below).map(|((begin, end), below)| squares(end - begin, below[1] - below[0])).sum()
        }
    }
}

#[cfg(test)]
impl Budget {
    /// A million operations, for a factorization of 250 cameras along a street, and not if they all see the same.
    pub fn tight() -> Self {
        Self { operations: 1e6, ..Self::MEMORY }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A banded, diagonally dominant matrix of mixed block sizes, as blocks and as a full matrix.
    fn example(count: usize) -> (BlockPattern, Vec<f64>, Mat<f64>) {
        let dims: Vec<_> = (0..count).map(|block| if block % 5 == 4 { 3 } else { 6 }).collect();
        let mut pattern = BlockPattern::new(dims);
        for row in 1..count {
            pattern.insert(row, row - 1);
            pattern.insert(row, row / 3);
        }
        let (mut blocks, size) = (vec![0.0; pattern.len()], pattern.size());
        let mut full = Mat::zeros(size, size);
        for column_block in 0..count {
            for row_block in pattern.rows(column_block) {
                for column in 0..pattern.dim(column_block) {
                    for row in 0..pattern.dim(row_block) {
                        let (r, c) = (pattern.start(row_block) + row, pattern.start(column_block) + column);
                        let value = if r == c { 60.0 } else { ((r * c + r + c) as f64 * 0.7).sin() };
                        blocks[pattern.offset(row_block, column_block)
                            + column * pattern.dim(row_block)
                            + row] = value;
                        full[(r, c)] = value;
                        full[(c, r)] = value;
                    }
                }
            }
        }
        (pattern, blocks, full)
    }

    #[test]
    fn dense_and_sparse_solve_the_system_twice() {
        let (pattern, blocks, full) = example(40);
        let sparse = CameraSystem::sparse(&pattern, &Budget::ANY).unwrap();
        for mut system in [sparse, CameraSystem::dense(pattern.size())] {
            for round in 0..2 {
                assert!(system.factorize(&pattern, &blocks));
                let truth = Mat::from_fn(pattern.size(), 1, |row, _| (row as f64 + f64::from(round)).cos());
                let mut right = (&full * &truth).col_as_slice(0).to_vec();
                system.solve(&mut right);
                for (row, value) in right.iter().enumerate() {
                    assert!((value - truth[(row, 0)]).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn large_sparse_patterns_take_the_sparse_path() {
        let (pattern, ..) = example(200);
        let system = |pattern: &BlockPattern| CameraSystem::new(pattern, &Budget::ANY);
        assert!(matches!(system(&pattern), Some(CameraSystem::Sparse { .. })));
        assert!(matches!(system(&example(30).0), Some(CameraSystem::Dense { .. })));
    }

    #[test]
    fn refuses_an_indefinite_matrix() {
        let (pattern, mut blocks, _) = example(40);
        blocks[pattern.offset(7, 7)] = -1.0;
        assert!(!CameraSystem::sparse(&pattern, &Budget::ANY).unwrap().factorize(&pattern, &blocks));
        assert!(!CameraSystem::dense(pattern.size()).factorize(&pattern, &blocks));
    }

    #[test]
    fn operations_are_those_of_the_columns_of_the_factor() {
        let full = |count: usize| {
            let mut pattern = BlockPattern::new(vec![6; count]);
            for row in 0..count {
                for column in 0..row {
                    pattern.insert(row, column);
                }
            }
            pattern
        };
        // Σ k² over all columns: the same whatever the order.
        for count in [1, 30] {
            let Some(CameraSystem::Sparse { symbolic, .. }) =
                CameraSystem::sparse(&full(count), &Budget::ANY)
            else {
                panic!("sparse was asked for");
            };
            let size = (6 * count) as f64;
            let expected = size * (size + 1.0) * (2.0 * size + 1.0) / 6.0;
            assert!((operations(&symbolic) - expected).abs() < 1e-9 * expected);
        }
        let pattern = full(20);
        let budget = |operations: f64| Budget { operations, ..Budget::ANY };
        let least = (pattern.len() as f64).powi(2) / pattern.size() as f64;
        assert!(budget(least * 1.01).may_suffice(&pattern) && !budget(least * 0.99).may_suffice(&pattern));
        assert!(CameraSystem::new(&pattern, &budget(120.0_f64.powi(3) * 0.34)).is_some());
        assert!(CameraSystem::new(&pattern, &budget(120.0_f64.powi(3) * 0.32)).is_none());
        let (sparse, ..) = example(200);
        assert!(CameraSystem::new(&sparse, &budget(1e3)).is_none());
        assert!(
            CameraSystem::new(&sparse, &Budget { values: 3 * sparse.len() / 2, ..Budget::ANY }).is_none()
        );
    }
}
