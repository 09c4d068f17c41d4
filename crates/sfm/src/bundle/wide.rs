//! Points that cameras see which share little else, kept out of the reduced camera system.
//!
//! A hill behind a town is seen from most of its streets. A handful of such points makes S full, where it has few blocks without
//! them. With Y = W V⁻¹ᐟ² of these points and S₀ of all others (in S₀ they stand still, so it is the more definite of the two),
//! S = S₀ − YYᵀ, and by the formula of Sherman, Morrison and Woodbury
//! S⁻¹ = S₀⁻¹ + S₀⁻¹Y (I − YᵀS₀⁻¹Y)⁻¹ YᵀS₀⁻¹.
//! (N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., SIAM 2002, section 26.3.)

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};

use super::camera_system::{Budget, CameraSystem};
use super::elimination::{Chunk, Couplings};
use super::pattern::BlockPattern;

/// Columns of Y that a point has.
const COLUMNS: usize = 3;
/// Fewest cameras that see a wide point, and least share of pairs of them that nothing narrow couples.
const MIN_CAMERAS: usize = 16;
const MIN_UNCOUPLED: f64 = 0.5;
/// Most wide points: 192 columns of Y take about as long as a factorization of S₀ of a thousand panoramas.
const MAX_POINTS: usize = 64;

/// Adds the blocks of S that shared points fill in, all but wide points', to those of U, and marks these; false when S is beyond the
/// budget.
pub(super) fn fill_by_narrow(pattern: &mut BlockPattern, couplings: &mut Couplings, budget: &Budget) -> bool {
    let count = couplings.free.len();
    let cameras_of = |couplings: &Couplings, point: usize| couplings.of_point(point).len();
    let (few, mut rest): (Vec<usize>, Vec<usize>) =
        (0..count).partition(|&point| cameras_of(couplings, point) < MIN_CAMERAS);
    if !insert_within(budget, few, couplings, pattern) {
        return false;
    }
    rest.sort_by_key(|&point| std::cmp::Reverse(cameras_of(couplings, point)));
    let is_wide = |couplings: &Couplings, point: usize| {
        let (mut uncoupled, mut all) = (0_usize, 0_usize);
        couplings.for_each_pair(point, |row, column| {
            all += usize::from(row != column);
            uncoupled += usize::from(!pattern.contains(row, column));
        });
        uncoupled as f64 >= MIN_UNCOUPLED * all as f64
    };
    let mut wide: Vec<usize> = rest.iter().copied().filter(|&point| is_wide(couplings, point)).collect();
    wide.truncate(MAX_POINTS);
    if !wide.is_empty() {
        couplings.wide = vec![false; count];
        for &point in &wide {
            couplings.wide[point] = true;
        }
    }
    rest.retain(|&point| !couplings.is_wide(point));
    insert_within(budget, rest, couplings, pattern)
}

/// Adds the blocks of some points one after the other; false, and no more are, once S is beyond the budget.
pub(super) fn insert_within(
    budget: &Budget,
    points: impl IntoIterator<Item = usize>,
    couplings: &Couplings,
    pattern: &mut BlockPattern,
) -> bool {
    points.into_iter().all(|point| {
        let fits = budget.may_suffice(pattern);
        if fits {
            couplings.insert(point, pattern);
        }
        fits
    })
}

/// What wide points add to a factorized S₀.
pub(super) struct WidePoints {
    /// Y, by columns.
    columns: Vec<f64>,
    /// S₀⁻¹Y.
    solved: Vec<f64>,
    /// I − YᵀS₀⁻¹Y, one block.
    capacitance: Vec<f64>,
    pattern: BlockPattern,
    system: CameraSystem,
    product: Vec<f64>,
}

impl WidePoints {
    /// Columns of Y for these couplings.
    pub fn columns(couplings: &Couplings) -> usize {
        COLUMNS * couplings.wide.iter().filter(|&&wide| wide).count()
    }

    /// Allocates for so many columns and S of this size; `None` without any.
    pub fn new(size: usize, columns: usize) -> Option<Self> {
        if columns == 0 {
            return None;
        }
        let pattern = BlockPattern::new(vec![columns]);
        Some(Self {
            columns: vec![0.0; size * columns],
            solved: vec![0.0; size * columns],
            capacitance: vec![0.0; columns * columns],
            system: CameraSystem::new(&pattern, 1, &Budget::MEMORY)?,
            pattern,
            product: vec![0.0; columns],
        })
    }

    /// Takes what the chunks' elimination left of wide points, after a factorization of S₀; false when S is not positive definite.
    pub fn factorize(
        &mut self,
        (chunks, couplings, pattern): (&[Chunk], &Couplings, &BlockPattern),
        of_narrow: &mut CameraSystem,
    ) -> bool {
        let (size, count) = (pattern.size(), self.product.len());
        self.columns.fill(0.0);
        let mut of_points = self.columns.chunks_exact_mut(COLUMNS * size);
        for chunk in chunks {
            let mut values = &chunk.wide[..];
            for point in chunk.points.clone().filter(|&point| couplings.is_wide(point)) {
                let Some(columns) = of_points.next() else { return false };
                for slot in couplings.of_point(point) {
                    let (dim, start) = (pattern.dim(slot.block as usize), pattern.start(slot.block as usize));
                    let (of_slot, others) = values.split_at(COLUMNS * dim);
                    for (column, of_slot) in columns.chunks_exact_mut(size).zip(of_slot.chunks_exact(dim)) {
                        column[start..start + dim].copy_from_slice(of_slot);
                    }
                    values = others;
                }
            }
        }
        self.solved.copy_from_slice(&self.columns);
        of_narrow.solve(&mut self.solved, count);
        let y = MatRef::from_column_major_slice(&self.columns, size, count);
        let solved = MatRef::from_column_major_slice(&self.solved, size, count);
        let product = MatMut::from_column_major_slice_mut(&mut self.capacitance, count, count);
        matmul(product, Accum::Replace, y.transpose(), solved, -1.0, Par::Seq);
        self.capacitance.iter_mut().step_by(count + 1).for_each(|diagonal| *diagonal += 1.0);
        self.system.factorize(&self.pattern, &self.capacitance)
    }

    /// Makes S⁻¹b of S₀⁻¹b, after [`WidePoints::factorize`].
    pub fn complete(&mut self, solution: &mut [f64]) {
        let size = solution.len();
        for (product, column) in self.product.iter_mut().zip(self.columns.chunks_exact(size)) {
            *product = column.iter().zip(&*solution).map(|(y, x)| y * x).sum();
        }
        self.system.solve(&mut self.product, 1);
        for (product, column) in self.product.iter().zip(self.solved.chunks_exact(size)) {
            solution.iter_mut().zip(column).for_each(|(to, from)| *to += product * from);
        }
    }
}
