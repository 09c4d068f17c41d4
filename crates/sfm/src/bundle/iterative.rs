//! Preconditioned conjugate gradients on a reduced camera system that is never formed.
//!
//! S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle Adjustment in the Large", ECCV 2010, section 4: products with
//! S by its factors ("implicit"), steps that are only as exact as is useful ("inexact"). The preconditioner is a factorization of
//! what S is with [points split](super::split).

use super::camera_system::CameraSystem;
use super::elimination::{Chunk, Couplings, for_each_chunk};
use super::pattern::BlockPattern;

/// Most iterations of one step.
const MAX_ITERATIONS: u32 = 500;
/// Relative residual to which a step is solved, in the norm of the preconditioner.
const FORCING: f64 = 0.01;

/// S = U + λD − W V⁻¹ Wᵀ by its parts.
pub(super) struct ImplicitSchur<'a> {
    /// The points' part, W and V⁻¹ of which are in the chunks.
    pub couplings: &'a Couplings,
    /// Blocks of U, among others.
    pub pattern: &'a BlockPattern,
    /// Values of U.
    pub base: &'a [f64],
    /// Diagonal of λD.
    pub damping: &'a [f64],
}

impl ImplicitSchur<'_> {
    /// `to` = S x, after the chunks' elimination; sums in the chunks' order.
    pub fn multiply<const D: usize>(&self, chunks: &mut [Chunk], x: &[f64], to: &mut [f64]) {
        for_each_chunk(chunks, |chunk| chunk.multiply::<D>(x, self.couplings, self.pattern));
        self.multiply_base(x, to);
        for chunk in chunks {
            add_scaled(to, -1.0, &chunk.reduced);
        }
    }

    /// `to` = (U + λD) x.
    fn multiply_base(&self, x: &[f64], to: &mut [f64]) {
        let Self { pattern, base, damping, .. } = self;
        for ((to, damping), x) in to.iter_mut().zip(*damping).zip(x) {
            *to = damping * x;
        }
        for column_block in 0..pattern.block_count() {
            let (columns, start) = (pattern.dim(column_block), pattern.start(column_block));
            // What comes behind U is fill by copies of points.
            let of_base = pattern.column(column_block).filter(|&(_, offset)| offset < pattern.base_len());
            for (row_block, offset) in of_base {
                let (rows, row_start) = (pattern.dim(row_block), pattern.start(row_block));
                for (column, values) in base[offset..offset + rows * columns].chunks_exact(rows).enumerate() {
                    let mut transposed = 0.0;
                    for (row, value) in values.iter().enumerate() {
                        to[row_start + row] += value * x[start + column];
                        transposed += value * x[row_start + row];
                    }
                    if row_block != column_block {
                        to[start + column] += transposed;
                    }
                }
            }
        }
    }
}

/// Preconditioner and memory of the iterations.
pub(super) struct IterativeSystem {
    /// None where there is no memory for it.
    preconditioner: Option<CameraSystem>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    product: Vec<f64>,
    preconditioned: Vec<f64>,
    iterations: u64,
    truncated: u32,
}

impl IterativeSystem {
    /// Allocates for systems of one pattern, preconditioned by a factorization of what has it.
    pub fn new(pattern: &BlockPattern, preconditioner: Option<CameraSystem>) -> Self {
        let vector = || vec![0.0; pattern.size()];
        Self {
            preconditioner,
            residual: vector(),
            direction: vector(),
            product: vector(),
            preconditioned: vector(),
            iterations: 0,
            truncated: 0,
        }
    }

    /// Iterations of all steps so far.
    pub fn iterations(&self) -> u64 {
        self.iterations
    }

    /// Steps that met the limit of iterations.
    pub fn truncated(&self) -> u32 {
        self.truncated
    }

    /// Factorizes the preconditioner; false when it is not positive definite.
    pub fn prepare(&mut self, pattern: &BlockPattern, blocks: &[f64]) -> bool {
        self.preconditioner.as_mut().is_none_or(|preconditioner| preconditioner.factorize(pattern, blocks))
    }

    /// Solves S x = b in place as exactly as a Newton step needs; false when S is not positive definite along a
    /// direction sought, or anything is not finite.
    ///
    /// `multiply(x, y)` sets y = S x. Meeting the limit of iterations is counted and no failure: each of them decreases
    /// the quadratic model.
    pub fn solve(&mut self, right: &mut [f64], mut multiply: impl FnMut(&[f64], &mut [f64])) -> bool {
        let Self { preconditioner, residual, direction, product, preconditioned, .. } = self;
        let mut precondition = |from: &[f64], to: &mut [f64]| {
            to.copy_from_slice(from);
            if let Some(preconditioner) = preconditioner {
                preconditioner.solve(to);
            }
        };
        residual.copy_from_slice(right);
        right.fill(0.0);
        precondition(residual, preconditioned);
        direction.copy_from_slice(preconditioned);
        let initial = dot(residual, preconditioned);
        let mut rho = initial;
        let sought = FORCING * FORCING * initial;
        let mut iterations = 0;
        while rho > sought && iterations < MAX_ITERATIONS {
            iterations += 1;
            self.iterations += 1;
            multiply(direction, product);
            let curvature = dot(direction, product);
            let length = rho / curvature;
            if curvature <= 0.0 || !length.is_finite() {
                return false;
            }
            add_scaled(right, length, direction);
            add_scaled(residual, -length, product);
            precondition(residual, preconditioned);
            let next = dot(residual, preconditioned);
            let share = next / rho;
            for (direction, preconditioned) in direction.iter_mut().zip(&*preconditioned) {
                *direction = preconditioned + share * *direction;
            }
            rho = next;
        }
        self.truncated += u32::from(rho > sought);
        rho.is_finite()
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn add_scaled(to: &mut [f64], factor: f64, from: &[f64]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += factor * from;
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;
    use crate::bundle::camera_system::Budget;

    /// A positive definite matrix of three blocks, its pattern and values of the diagonal blocks.
    fn example() -> (DMatrix<f64>, BlockPattern, Vec<f64>) {
        let pattern = BlockPattern::new(vec![3, 2, 3]);
        let root = DMatrix::from_fn(8, 8, |row, column| {
            ((3 * row + 5 * column) as f64).sin() + if row == column { 2.0 } else { 0.0 }
        });
        let matrix = &root * root.transpose();
        let mut blocks = vec![0.0; pattern.len()];
        for block in 0..3 {
            let (offset, dim, start) =
                (pattern.offset(block, block), pattern.dim(block), pattern.start(block));
            blocks[offset..offset + dim * dim]
                .copy_from_slice(matrix.view((start, start), (dim, dim)).clone_owned().as_slice());
        }
        (matrix, pattern, blocks)
    }

    fn preconditioned(pattern: &BlockPattern) -> IterativeSystem {
        IterativeSystem::new(pattern, CameraSystem::new(pattern, &Budget::MEMORY))
    }

    fn multiply_by(matrix: &DMatrix<f64>) -> impl FnMut(&[f64], &mut [f64]) + '_ {
        move |x, to| to.copy_from_slice((matrix * DMatrix::from_column_slice(x.len(), 1, x)).as_slice())
    }

    #[test]
    fn repeated_steps_converge_to_the_solution() {
        let (matrix, pattern, blocks) = example();
        let mut system = preconditioned(&pattern);
        assert!(system.prepare(&pattern, &blocks));
        let truth = DMatrix::from_fn(8, 1, |row, _| (row as f64).cos());
        let mut found = DMatrix::zeros(8, 1);
        for _ in 0..14 {
            let mut step = (&matrix * (&truth - &found)).as_slice().to_vec();
            assert!(system.solve(&mut step, multiply_by(&matrix)));
            found += DMatrix::from_column_slice(8, 1, &step);
        }
        assert!((found - truth).norm() < 1e-10);
        // As many as there are dimensions suffice for each step, but for round-off.
        assert!((14..14 * 12).contains(&system.iterations()) && system.truncated() == 0);
    }

    #[test]
    fn block_diagonal_matrix_takes_one_iteration() {
        let (mut matrix, pattern, blocks) = example();
        for row in 0..8 {
            for column in 0..8 {
                let block = |index: usize| usize::from(index >= 3) + usize::from(index >= 5);
                if block(row) != block(column) {
                    matrix[(row, column)] = 0.0;
                }
            }
        }
        let mut system = preconditioned(&pattern);
        assert!(system.prepare(&pattern, &blocks));
        let mut right = (&matrix * DMatrix::repeat(8, 1, 1.0)).as_slice().to_vec();
        assert!(system.solve(&mut right, multiply_by(&matrix)));
        assert!(right.iter().all(|value| (value - 1.0).abs() < 1e-12));
        assert_eq!(system.iterations(), 1);
    }

    #[test]
    fn refuses_what_is_not_positive_definite() {
        let (matrix, pattern, mut blocks) = example();
        let mut system = preconditioned(&pattern);
        assert!(system.prepare(&pattern, &blocks));
        assert!(!system.solve(&mut [1.0; 8], multiply_by(&-&matrix)));
        assert!(!system.solve(&mut [f64::NAN; 8], multiply_by(&matrix)));
        blocks[pattern.offset(1, 1)] = -1.0;
        assert!(!system.prepare(&pattern, &blocks));
    }

    #[test]
    fn what_the_limit_of_iterations_does_not_solve_is_counted() {
        // A chain held at one end and pulled at the other.
        let size = 3 * MAX_ITERATIONS as usize;
        let mut system = IterativeSystem::new(&BlockPattern::new(vec![size]), None);
        let mut right = vec![0.0; size];
        right[size - 1] = 1.0;
        let multiply = |x: &[f64], to: &mut [f64]| {
            for (at, to) in to.iter_mut().enumerate() {
                let next = x.get(at + 1).map_or(0.0, |next| x[at] - next);
                *to = next + if at == 0 { x[0] } else { x[at] - x[at - 1] };
            }
        };
        assert!(system.solve(&mut right, multiply));
        assert_eq!((system.iterations(), system.truncated()), (u64::from(MAX_ITERATIONS), 1));
    }

    #[test]
    fn nothing_to_solve_is_solved() {
        let (matrix, pattern, blocks) = example();
        let mut system = preconditioned(&pattern);
        assert!(system.prepare(&pattern, &blocks));
        let mut right = [0.0; 8];
        assert!(system.solve(&mut right, multiply_by(&matrix)));
        assert_eq!(right, [0.0; 8]);
    }
}
