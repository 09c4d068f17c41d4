//! Which blocks of the reduced camera system exist, and where they are stored.

/// "No block", "not free".
pub(super) const NONE: u32 = u32::MAX;

/// The lower block triangle of a symmetric matrix: blocks of mixed sizes, each stored column by column.
///
/// Blocks that the normal equations have before elimination (the diagonal, pose × own intrinsics) come first, so that
/// the first [`BlockPattern::base_len`] values are those of JᵀJ itself and the rest is fill by shared points.
#[derive(Debug)]
pub(super) struct BlockPattern {
    dims: Vec<usize>,
    starts: Vec<usize>,
    /// Value offset by packed (row, column ≤ row), or [`NONE`].
    table: Vec<u32>,
    base_len: usize,
    len: usize,
}

impl BlockPattern {
    /// A pattern with the diagonal only.
    pub fn new(dims: Vec<usize>) -> Self {
        let mut starts = Vec::with_capacity(dims.len() + 1);
        starts.push(0);
        for (index, dim) in dims.iter().enumerate() {
            starts.push(starts[index] + dim);
        }
        let table = vec![NONE; dims.len() * (dims.len() + 1) / 2];
        let mut pattern = Self { dims, starts, table, base_len: 0, len: 0 };
        for block in 0..pattern.dims.len() {
            pattern.insert(block, block);
        }
        pattern.base_len = pattern.len;
        pattern
    }

    /// Adds a block of JᵀJ; all of these before the first [`BlockPattern::insert`].
    pub fn insert_base(&mut self, row: usize, column: usize) {
        debug_assert_eq!(self.base_len, self.len);
        self.insert(row, column);
        self.base_len = self.len;
    }

    /// Adds a block, once; `column` ≤ `row`.
    #[inline]
    pub fn insert(&mut self, row: usize, column: usize) {
        let entry = &mut self.table[packed(row, column)];
        if *entry == NONE {
            *entry = self.len as u32;
            self.len += self.dims[row] * self.dims[column];
        }
    }

    /// Value offset of an existing block; `column` ≤ `row`.
    #[inline]
    pub fn offset(&self, row: usize, column: usize) -> usize {
        self.table[packed(row, column)] as usize
    }

    /// Number of blocks along the diagonal.
    pub fn block_count(&self) -> usize {
        self.dims.len()
    }

    /// Scalar size of a block.
    #[inline]
    pub fn dim(&self, block: usize) -> usize {
        self.dims[block]
    }

    /// First scalar row of a block.
    #[inline]
    pub fn start(&self, block: usize) -> usize {
        self.starts[block]
    }

    /// Scalar size of the matrix.
    pub fn size(&self) -> usize {
        self.starts[self.dims.len()]
    }

    /// Number of stored values.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Number of stored values of JᵀJ.
    pub fn base_len(&self) -> usize {
        self.base_len
    }

    /// Rows of the blocks of one block column, ascending from the diagonal.
    pub fn rows(&self, column: usize) -> impl Iterator<Item = usize> + '_ {
        (column..self.dims.len()).filter(move |&row| self.table[packed(row, column)] != NONE)
    }
}

#[inline]
fn packed(row: usize, column: usize) -> usize {
    row * (row + 1) / 2 + column
}
