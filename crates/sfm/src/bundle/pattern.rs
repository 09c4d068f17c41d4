//! Which blocks of the reduced camera system exist, and where they are stored.

/// "No block", "not free".
pub(super) const NONE: u32 = u32::MAX;

/// Up to this number of blocks along the diagonal a packed table of offsets (8 MiB) spares searching for them.
const TABLE_BLOCKS: usize = 2048;

/// The lower block triangle of a symmetric matrix: blocks of mixed sizes, each stored column by column.
///
/// Blocks that the normal equations have before elimination (the diagonal, pose × own intrinsics) come first, so that
/// the first [`BlockPattern::base_len`] values are those of JᵀJ itself and the rest is fill by shared points. Memory
/// grows by the blocks that exist, not by the square of the cameras.
#[derive(Debug, Clone)]
pub(super) struct BlockPattern {
    dims: Vec<usize>,
    starts: Vec<usize>,
    /// Row and value offset of the blocks of each column, ascending.
    columns: Vec<Vec<(u32, u32)>>,
    /// The same offsets by packed (row, column ≤ row), or [`NONE`]; empty beyond [`TABLE_BLOCKS`].
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
        let table_len = if dims.len() <= TABLE_BLOCKS { dims.len() * (dims.len() + 1) / 2 } else { 0 };
        let (columns, table) = (vec![Vec::new(); dims.len()], vec![NONE; table_len]);
        let mut pattern = Self { dims, starts, columns, table, base_len: 0, len: 0 };
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
        if !self.table.is_empty() {
            let entry = &mut self.table[packed(row, column)];
            if *entry != NONE {
                return;
            }
            *entry = self.len as u32;
        }
        let blocks = &mut self.columns[column];
        if let Err(place) = blocks.binary_search_by_key(&(row as u32), |block| block.0) {
            blocks.insert(place, (row as u32, self.len as u32));
            self.len += self.dims[row] * self.dims[column];
        }
    }

    /// Whether there is a block; `column` ≤ `row`.
    pub fn contains(&self, row: usize, column: usize) -> bool {
        if self.table.is_empty() {
            return self.columns[column].binary_search_by_key(&(row as u32), |block| block.0).is_ok();
        }
        self.table[packed(row, column)] != NONE
    }

    /// Value offset of an existing block; `column` ≤ `row`.
    #[inline]
    pub fn offset(&self, row: usize, column: usize) -> usize {
        if !self.table.is_empty() {
            return self.table[packed(row, column)] as usize;
        }
        let blocks = &self.columns[column];
        let place = blocks.partition_point(|block| (block.0 as usize) < row);
        debug_assert_eq!(blocks[place].0 as usize, row);
        blocks[place].1 as usize
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

    /// Rows and value offsets of the blocks of one block column, ascending from the diagonal.
    #[inline]
    pub fn column(&self, column: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.columns[column].iter().map(|&(row, offset)| (row as usize, offset as usize))
    }

    /// Rows of the blocks of one block column, ascending from the diagonal.
    pub fn rows(&self, column: usize) -> impl Iterator<Item = usize> + '_ {
        self.column(column).map(|(row, _)| row)
    }
}

#[inline]
fn packed(row: usize, column: usize) -> usize {
    row * (row + 1) / 2 + column
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_are_the_same_with_and_without_a_table() {
        let insert = |count: usize| {
            let mut pattern = BlockPattern::new((0..count).map(|block| 1 + block % 3).collect());
            pattern.insert_base(7, 2);
            for step in [5, 3, 5] {
                for row in (0..1900).step_by(step) {
                    pattern.insert(row, row / step);
                }
            }
            pattern
        };
        let (small, large) = (insert(TABLE_BLOCKS), insert(TABLE_BLOCKS + 1));
        assert!(!small.table.is_empty() && large.table.is_empty());
        // The one further diagonal block shifts all that comes after the diagonal.
        let shift = large.len() - small.len();
        assert_eq!((large.base_len() - small.base_len(), shift), (shift, large.dim(TABLE_BLOCKS).pow(2)));
        for column in 0..TABLE_BLOCKS {
            assert!(small.rows(column).eq(large.rows(column)));
            for (row, offset) in small.column(column) {
                assert_eq!(small.offset(row, column), offset);
                assert_eq!(large.offset(row, column), offset + if row == column { 0 } else { shift });
            }
        }
    }
}
