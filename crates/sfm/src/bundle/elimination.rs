//! Elimination of points: what one chunk of consecutive points adds to S, to products with S, and gets back from a step.

use std::ops::Range;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::pattern::BlockPattern;

/// The damping is λ times the diagonal of H within these bounds.
const DAMPING_RANGE: (f64, f64) = (1e-6, 1e32);
/// A pivot of a point's 3×3 system counts as zero below this share of its diagonal entry.
const VANISHING_PIVOT: f64 = 1e-13;

/// One (point, camera-side block) coupling; W of it is `dim`×3, by columns.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slot {
    pub block: u32,
    /// Of W, in its chunk.
    pub offset: u32,
}

/// Which camera-side blocks see each point.
#[derive(Debug, Default)]
pub(super) struct Couplings {
    /// First slot of each point, and the end.
    pub starts: Vec<usize>,
    /// Ascending by block within a point, or within a copy of one; none where the point is fixed.
    pub slots: Vec<Slot>,
    /// Whether each point is an unknown.
    pub free: Vec<bool>,
    /// [Copies](super::split) of the points, where S stays implicit.
    pub copies: Option<Copies>,
}

/// Consecutive slots of each point, one copy after the other.
#[derive(Debug)]
pub(super) struct Copies {
    /// First copy of each point, and the end.
    pub starts: Vec<usize>,
    /// First slot of each copy, and the end.
    pub slot_starts: Vec<usize>,
}

impl Copies {
    pub fn count(&self) -> usize {
        self.slot_starts.len() - 1
    }

    /// Copies of a point.
    #[inline]
    pub fn of_point(&self, point: usize) -> Range<usize> {
        self.starts[point]..self.starts[point + 1]
    }

    /// Slots of a copy, ascending by block.
    #[inline]
    pub fn slots(&self, copy: usize) -> Range<usize> {
        self.slot_starts[copy]..self.slot_starts[copy + 1]
    }
}

impl Couplings {
    #[inline]
    pub fn of_point(&self, point: usize) -> &[Slot] {
        &self.slots[self.starts[point]..self.starts[point + 1]]
    }
}

/// Adds the blocks of all pairs of some slots, ascending by block.
pub(super) fn insert_pairs(slots: &[Slot], pattern: &mut BlockPattern) {
    for (index, row) in slots.iter().enumerate() {
        for column in &slots[..=index] {
            pattern.insert(row.block as usize, column.block as usize);
        }
    }
}

/// Consecutive points and all sums over them.
#[derive(Debug, Default)]
pub(super) struct Chunk {
    pub points: Range<usize>,
    /// W of all slots.
    pub coupling: Vec<f64>,
    /// V of each point: lower triangle by rows.
    pub point_hessian: Vec<[f64; 6]>,
    pub point_gradient: Vec<[f64; 3]>,
    /// V of each copy of points.
    pub copy_hessian: Vec<[f64; 6]>,
    /// [`point_factor`] of each point where there are copies, else empty.
    pub factors: Vec<[f64; 6]>,
    pub base: Vec<f64>,
    pub gradient: Vec<f64>,
    /// −W V⁻¹ Wᵀ in the blocks of the pattern, of copies where there are any.
    pub schur: Vec<f64>,
    /// W V⁻¹ times g_p, or times Wᵀx.
    pub reduced: Vec<f64>,
    pub scratch: Vec<f64>,
    pub candidate: Vec<Vector3<f64>>,
    pub cost: f64,
    pub sums: StepSums,
    pub usable: bool,
}

/// What a step does, summed over the unknowns.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct StepSums {
    /// Decrease of the quadratic model.
    pub predicted: f64,
    /// ‖δ‖² of the camera side.
    pub squared_step: f64,
    /// Largest ‖δ‖² of a point, as a share of the square of its distance from the origin.
    ///
    /// Of each by itself: beside one that rays make run off to infinity no step of all others is large.
    pub largest_point_step: f64,
}

/// Rows of the blocks of stitched panoramas' cameras, the most frequent beside poses.
const STITCHING: usize = 9;

impl Chunk {
    /// Subtracts W V⁻¹ Wᵀ from S and adds up W V⁻¹ g_p, for damping λ.
    pub fn eliminate<const D: usize>(&mut self, lambda: f64, couplings: &Couplings, pattern: &BlockPattern) {
        self.schur.fill(0.0);
        self.reduced.fill(0.0);
        self.usable = true;
        for (index, point) in self.points.clone().enumerate() {
            let of_point = couplings.of_point(point);
            if of_point.is_empty() {
                continue;
            }
            let Some(factor) = point_factor(&self.point_hessian[index], lambda) else {
                self.usable = false;
                continue;
            };
            self.scale_couplings(of_point, &factor, pattern);
            let [z0, z1, z2] = forward(&factor, self.point_gradient[index]);
            let first = of_point[0].offset as usize;
            for slot in of_point {
                let (dim, start) = (pattern.dim(slot.block as usize), pattern.start(slot.block as usize));
                let y = &self.scratch[slot.offset as usize - first..][..3 * dim];
                add_columns(&mut self.reduced[start..start + dim], y, [z0, z1, z2]);
            }
            match &couplings.copies {
                Some(copies) => {
                    self.factors[index] = factor;
                    let first_copy = copies.starts[self.points.start];
                    for copy in copies.of_point(point) {
                        let slots = &couplings.slots[copies.slots(copy)];
                        let Some(factor) = point_factor(&self.copy_hessian[copy - first_copy], lambda) else {
                            self.usable = false;
                            continue;
                        };
                        self.scale_couplings(slots, &factor, pattern);
                        self.subtract_products::<D>(slots, pattern);
                    }
                }
                None => self.subtract_products::<D>(of_point, pattern),
            }
        }
    }

    /// Sets the scratch memory to W V⁻¹ᐟ² of these slots, which follow each other.
    #[inline]
    fn scale_couplings(&mut self, slots: &[Slot], factor: &[f64; 6], pattern: &BlockPattern) {
        let &[i00, l10, i11, l20, l21, i22] = factor;
        let first = slots[0].offset as usize;
        for slot in slots {
            let dim = pattern.dim(slot.block as usize);
            let w = &self.coupling[slot.offset as usize..][..3 * dim];
            let y = &mut self.scratch[slot.offset as usize - first..][..3 * dim];
            for row in 0..dim {
                let y0 = w[row] * i00;
                let y1 = (w[dim + row] - l10 * y0) * i11;
                let y2 = (w[2 * dim + row] - l20 * y0 - l21 * y1) * i22;
                (y[row], y[dim + row], y[2 * dim + row]) = (y0, y1, y2);
            }
        }
    }

    /// Subtracts the products of what is in the scratch memory for these slots from the blocks of S.
    #[inline]
    fn subtract_products<const D: usize>(&mut self, slots: &[Slot], pattern: &BlockPattern) {
        let first = slots[0].offset as usize;
        for (position, row) in slots.iter().enumerate() {
            let row_dim = pattern.dim(row.block as usize);
            let row_y = &self.scratch[row.offset as usize - first..][..3 * row_dim];
            for column in &slots[..=position] {
                let column_dim = pattern.dim(column.block as usize);
                let column_y = &self.scratch[column.offset as usize - first..][..3 * column_dim];
                let offset = pattern.offset(row.block as usize, column.block as usize);
                let values = &mut self.schur[offset..offset + row_dim * column_dim];
                if row_dim == D && column_dim == D {
                    subtract_outer::<D, D>(values, row_y, column_y);
                } else if row_dim == STITCHING && column_dim == D {
                    subtract_outer::<STITCHING, D>(values, row_y, column_y);
                } else if row_dim == STITCHING && column_dim == STITCHING {
                    subtract_outer::<STITCHING, STITCHING>(values, row_y, column_y);
                } else {
                    subtract_outer_sized(values, row_y, column_y, row_dim, column_dim);
                }
            }
        }
    }

    /// `reduced` = W V⁻¹ Wᵀ x, after [`Chunk::eliminate`] with the factors kept.
    pub fn multiply<const D: usize>(&mut self, x: &[f64], couplings: &Couplings, pattern: &BlockPattern) {
        self.reduced.fill(0.0);
        for (point, factor) in self.points.clone().zip(&self.factors) {
            let of_point = couplings.of_point(point);
            // One sum per row: independent of each other, so the compiler makes vectors of them.
            let (mut y, mut sums) = ([0.0; 3], [[0.0; D]; 3]);
            for slot in of_point {
                let (dim, start) = (pattern.dim(slot.block as usize), pattern.start(slot.block as usize));
                let w = &self.coupling[slot.offset as usize..][..3 * dim];
                let x = &x[start..start + dim];
                if dim == D {
                    for (sums, w) in sums.iter_mut().zip(w.as_chunks::<D>().0) {
                        for row in 0..D {
                            sums[row] += w[row] * x[row];
                        }
                    }
                } else {
                    add_transposed(&mut y, w, x);
                }
            }
            for (y, sums) in y.iter_mut().zip(&sums) {
                *y += sums.iter().sum::<f64>();
            }
            let z = backward(factor, forward(factor, y));
            for slot in of_point {
                let (dim, start) = (pattern.dim(slot.block as usize), pattern.start(slot.block as usize));
                let w = &self.coupling[slot.offset as usize..][..3 * dim];
                let reduced = &mut self.reduced[start..start + dim];
                if dim == D {
                    add_columns(&mut reduced[..D], w, z);
                } else {
                    add_columns(reduced, w, z);
                }
            }
        }
    }

    /// Sets the candidate points, stretched, and the sums as they are, for a camera-side step that solves the system of damping λ.
    pub fn substitute(
        &mut self,
        (lambda, stretch): (f64, f64),
        step: &[f64],
        points: &[Vector3<f64>],
        couplings: &Couplings,
        pattern: &BlockPattern,
    ) {
        self.sums = StepSums::default();
        for (index, point) in self.points.clone().enumerate() {
            if !couplings.free[point] {
                continue;
            }
            let (v, g) = (&self.point_hessian[index], &self.point_gradient[index]);
            let Some(factor) = point_factor(v, lambda) else { continue };
            let mut right = *g;
            for slot in couplings.of_point(point) {
                let (dim, start) = (pattern.dim(slot.block as usize), pattern.start(slot.block as usize));
                let w = &self.coupling[slot.offset as usize..][..3 * dim];
                add_transposed(&mut right, w, &step[start..start + dim]);
            }
            let [d0, d1, d2] = backward(&factor, forward(&factor, right));
            let delta = Vector3::new(-d0, -d1, -d2);
            self.candidate[index] = points[point] + delta * stretch;
            for (k, diagonal) in [v[0], v[2], v[5]].into_iter().enumerate() {
                self.sums.predicted += 0.5 * delta[k] * (lambda * bounded(diagonal) * delta[k] - g[k]);
            }
            let relative = delta.norm_squared() / points[point].norm_squared();
            self.sums.largest_point_step = self.sums.largest_point_step.max(relative);
        }
    }
}

/// Works on all chunks, on as many threads as there are.
pub(super) fn for_each_chunk(chunks: &mut [Chunk], work: impl Fn(&mut Chunk) + Send + Sync) {
    // One chunk stays on this thread: small problems never wait for another.
    if let [chunk] = chunks {
        work(chunk);
    } else {
        chunks.par_iter_mut().with_max_len(1).for_each(work);
    }
}

/// D of the damping λD: a diagonal entry of H, within bounds.
#[inline]
pub(super) fn bounded(diagonal: f64) -> f64 {
    diagonal.clamp(DAMPING_RANGE.0, DAMPING_RANGE.1)
}

/// Cholesky factor of V + λD (lower triangle by rows) with reciprocal diagonal; `None` when it is not finite.
///
/// A pivot that vanishes (the depth of a point seen once, without damping) gets the reciprocal zero. That makes a
/// generalized inverse, which is enough: W and g_p lie in the range of V.
#[inline]
fn point_factor(v: &[f64; 6], lambda: f64) -> Option<[f64; 6]> {
    let reciprocal_root = |pivot: f64, diagonal: f64| {
        if pivot <= VANISHING_PIVOT * diagonal { 0.0 } else { 1.0 / pivot.sqrt() }
    };
    let damped = |value: f64| value + lambda * bounded(value);
    let (d0, d1, d2) = (damped(v[0]), damped(v[2]), damped(v[5]));
    let i00 = reciprocal_root(d0, d0);
    let (l10, l20) = (v[1] * i00, v[3] * i00);
    let i11 = reciprocal_root(d1 - l10 * l10, d1);
    let l21 = (v[4] - l20 * l10) * i11;
    let i22 = reciprocal_root(d2 - l20 * l20 - l21 * l21, d2);
    // What is not finite before reaches the last pivot.
    (i00.is_finite() && i11.is_finite() && i22.is_finite()).then_some([i00, l10, i11, l20, l21, i22])
}

/// L⁻¹ y with a [`point_factor`].
#[inline]
fn forward(&[i00, l10, i11, l20, l21, i22]: &[f64; 6], y: [f64; 3]) -> [f64; 3] {
    let z0 = y[0] * i00;
    let z1 = (y[1] - l10 * z0) * i11;
    let z2 = (y[2] - l20 * z0 - l21 * z1) * i22;
    [z0, z1, z2]
}

/// L⁻ᵀ z with a [`point_factor`].
#[inline]
fn backward(&[i00, l10, i11, l20, l21, i22]: &[f64; 6], z: [f64; 3]) -> [f64; 3] {
    let d2 = z[2] * i22;
    let d1 = (z[1] - l21 * d2) * i11;
    let d0 = (z[0] - l10 * d1 - l20 * d2) * i00;
    [d0, d1, d2]
}

/// y += Wᵀ x with W of `x.len()`×3.
#[inline]
fn add_transposed(y: &mut [f64; 3], w: &[f64], x: &[f64]) {
    let dim = x.len();
    for k in 0..3 {
        y[k] += w[k * dim..(k + 1) * dim].iter().zip(x).map(|(w, x)| w * x).sum::<f64>();
    }
}

/// `to` += W z with W of `to.len()`×3.
#[inline]
fn add_columns(to: &mut [f64], w: &[f64], z: [f64; 3]) {
    let dim = to.len();
    let (w0, w1, w2) = (&w[..dim], &w[dim..2 * dim], &w[2 * dim..3 * dim]);
    for row in 0..dim {
        to[row] += w0[row] * z[0] + w1[row] * z[1] + w2[row] * z[2];
    }
}

/// values (ROWS×COLUMNS) −= a bᵀ with a of ROWS×3 and b of COLUMNS×3, all by columns.
#[inline]
fn subtract_outer<const ROWS: usize, const COLUMNS: usize>(values: &mut [f64], a: &[f64], b: &[f64]) {
    let ([a0, a1, a2], [b0, b1, b2]) = (a.as_chunks::<ROWS>().0, b.as_chunks::<COLUMNS>().0) else { return };
    for (column, values) in values.as_chunks_mut::<ROWS>().0.iter_mut().enumerate() {
        for row in 0..ROWS {
            values[row] -= a0[row] * b0[column] + a1[row] * b1[column] + a2[row] * b2[column];
        }
    }
}

/// The same for any sizes.
fn subtract_outer_sized(values: &mut [f64], a: &[f64], b: &[f64], rows: usize, columns: usize) {
    for column in 0..columns {
        let (b0, b1, b2) = (b[column], b[columns + column], b[2 * columns + column]);
        for row in 0..rows {
            values[column * rows + row] -= a[row] * b0 + a[rows + row] * b1 + a[2 * rows + row] * b2;
        }
    }
}
