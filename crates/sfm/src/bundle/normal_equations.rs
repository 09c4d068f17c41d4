//! Normal equations of a bundle problem, points eliminated: the part that every residual shares.
//!
//! Unknowns are camera-side blocks of `D` scalars (poses, or poses with intrinsics), optional further camera-side
//! blocks of other sizes (shared intrinsics), and points. With H = JᵀJ and g = Jᵀr split into camera side (U, g_c),
//! points (V, g_p) and coupling (W), the damped step solves
//! S δ_c = −(g_c − W V⁻¹ g_p) with S = U − W V⁻¹ Wᵀ, then V δ_p = −(g_p + Wᵀ δ_c).
//!
//! Work is cut into chunks of consecutive points whose number depends on the problem alone; each sums into its own
//! memory and the chunks are added in order, so the bytes do not depend on the number of threads.

use std::ops::Range;

use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::MAX_CAMERA_PARAMS;

use super::RobustLoss;
use super::camera_system::CameraSystem;
use super::loss::LossSum;
use super::pattern::{BlockPattern, NONE};

/// The damping is λ times the diagonal of H within these bounds.
const DAMPING_RANGE: (f64, f64) = (1e-6, 1e32);
/// A pivot of a point's 3×3 system counts as zero below this share of its diagonal entry.
const VANISHING_PIVOT: f64 = 1e-13;
/// Upper bound of the chunk count; more would cost more in reductions than it gains.
const MAX_CHUNKS: usize = 8;
/// Units of work (observations and pairs of them in a point) that are worth a chunk.
const WORK_PER_CHUNK: usize = 4096;
/// Values of all chunks' reduced systems together: 512 MiB.
const MAX_CHUNK_VALUES: usize = 1 << 26;

/// Which unknowns an observation touches; [`NONE`] for those that are fixed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Link {
    /// Index into the points.
    pub point: u32,
    /// `D`-sized block.
    pub block: u32,
    /// Index into the further camera-side blocks.
    pub extra: u32,
}

/// Residual (2) and Jacobians of one observation; rows first.
#[derive(Debug, Clone, Copy)]
pub(super) struct Linearized<const D: usize> {
    /// r.
    pub residual: [f64; 2],
    /// ∂r/∂point, 2×3.
    pub point: [[f64; 3]; 2],
    /// ∂r/∂block, 2×D.
    pub block: [[f64; D]; 2],
    /// ∂r/∂extra block, 2×k, filled up to its size.
    pub extra: [[f64; MAX_CAMERA_PARAMS]; 2],
}

/// Takes block, JᵀJ and Jᵀr of a term of that block alone.
pub(super) type BlockTerm<'a, const D: usize> = &'a mut dyn FnMut(usize, &[[f64; D]; D], &[f64; D]);

/// A bundle problem: state, candidate state, residuals.
pub(super) trait Model<const D: usize>: Sync {
    /// Loss of all observations.
    fn loss(&self) -> RobustLoss;
    /// Residual and Jacobians at the current state. Blocks that the link has as [`NONE`] need not be filled.
    fn linearize(&self, observation: usize, link: &Link, point: &Vector3<f64>, out: &mut Linearized<D>);
    /// ‖r‖² at the candidate state.
    fn squared_residual(&self, observation: usize, point: &Vector3<f64>) -> f64;
    /// Calls `add(block, h, g)` with the (weighted) JᵀJ and Jᵀr of terms of a single block; returns their cost.
    fn linearize_block_terms(&self, add: BlockTerm<'_, D>) -> f64;
    /// Cost of these terms at the candidate state.
    fn block_terms_cost(&self) -> f64;
    /// Sets the candidate to current ⊞ step (all blocks, then all extra blocks); false when that is no valid state.
    fn propose(&mut self, step: &[f64]) -> bool;
    /// Makes the candidate the current state.
    fn accept(&mut self);
    /// Sum of squares of the camera-side parameters, for the relative step size.
    fn squared_norm(&self) -> f64;
}

/// One (point, camera-side block) coupling; W of it is `dim`×3, by columns.
#[derive(Debug, Clone, Copy)]
struct Slot {
    block: u32,
    offset: u32,
}

/// Where an observation's products go.
#[derive(Debug, Clone, Copy)]
struct Target {
    /// Value offset of block × extra in U, or [`NONE`].
    coupling: u32,
    /// W offset of the block, or [`NONE`].
    block: u32,
    /// W offset of the extra block, or [`NONE`].
    extra: u32,
}

/// Consecutive points and all sums over them.
#[derive(Debug, Default)]
struct Chunk {
    points: Range<usize>,
    coupling: Vec<f64>,
    point_hessian: Vec<[f64; 6]>,
    point_gradient: Vec<[f64; 3]>,
    base: Vec<f64>,
    gradient: Vec<f64>,
    schur: Vec<f64>,
    reduced: Vec<f64>,
    scratch: Vec<f64>,
    candidate: Vec<Vector3<f64>>,
    cost: f64,
    sums: StepSums,
    usable: bool,
}

/// What a step does, summed over the unknowns.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct StepSums {
    /// Decrease of the quadratic model.
    pub predicted: f64,
    /// ‖δ‖².
    pub squared_step: f64,
    /// ‖parameters‖².
    pub squared_norm: f64,
}

/// The normal equations with all memory they ever need.
pub(super) struct NormalEquations<const D: usize> {
    links: Vec<Link>,
    targets: Vec<Target>,
    /// First observation of each point, and the end.
    observation_starts: Vec<usize>,
    /// First slot of each point, and the end.
    slot_starts: Vec<usize>,
    slots: Vec<Slot>,
    points: Vec<Vector3<f64>>,
    free: Vec<bool>,
    block_count: usize,
    pattern: BlockPattern,
    chunks: Vec<Chunk>,
    base: Vec<f64>,
    gradient: Vec<f64>,
    schur: Vec<f64>,
    step: Vec<f64>,
    damping: Vec<f64>,
    system: CameraSystem,
}

impl<const D: usize> NormalEquations<D> {
    /// Plans the elimination.
    ///
    /// `links` are sorted by point; every point has at least one. `block_count` blocks of size `D` and the
    /// extra blocks make the camera side.
    pub fn new(
        links: Vec<Link>,
        points: Vec<Vector3<f64>>,
        free: Vec<bool>,
        block_count: usize,
        extra: &[usize],
    ) -> Self {
        let mut dims = vec![D; block_count];
        dims.extend_from_slice(extra);
        let mut pattern = BlockPattern::new(dims);
        let extra_block = |link: &Link| block_count + link.extra as usize;
        for link in &links {
            if link.block != NONE && link.extra != NONE {
                pattern.insert_base(extra_block(link), link.block as usize);
            }
        }
        let mut observation_starts = Vec::with_capacity(points.len() + 1);
        observation_starts.push(0);
        let (mut slot_starts, mut slots) = (vec![0], Vec::new());
        let mut work_until = Vec::with_capacity(points.len());
        let (mut work, mut end, mut touched) = (0, 0, Vec::new());
        for point in 0..points.len() {
            let start = end;
            while end < links.len() && links[end].point as usize == point {
                end += 1;
            }
            touched.clear();
            if free[point] {
                for link in &links[start..end] {
                    if link.block != NONE {
                        touched.push(link.block);
                    }
                    if link.extra != NONE {
                        touched.push(extra_block(link) as u32);
                    }
                }
                touched.sort_unstable();
                touched.dedup();
                for (index, &row) in touched.iter().enumerate() {
                    for &column in &touched[..=index] {
                        pattern.insert(row as usize, column as usize);
                    }
                }
            }
            slots.extend(touched.iter().map(|&block| Slot { block, offset: 0 }));
            slot_starts.push(slots.len());
            observation_starts.push(end);
            work += 2 * (end - start) + touched.len() * touched.len();
            work_until.push(work);
        }

        let most = (MAX_CHUNK_VALUES / pattern.len().max(1)).clamp(1, MAX_CHUNKS);
        let chunk_count = (work / WORK_PER_CHUNK).clamp(1, most);
        let mut chunks = Vec::with_capacity(chunk_count);
        let mut first = 0;
        for index in 0..chunk_count {
            let last = if index + 1 == chunk_count {
                points.len()
            } else {
                work_until.partition_point(|&until| until <= work * (index + 1) / chunk_count).max(first)
            };
            let (mut coupling_len, mut scratch_len) = (0, 0);
            for point in first..last {
                let before = coupling_len;
                for slot in &mut slots[slot_starts[point]..slot_starts[point + 1]] {
                    slot.offset = coupling_len as u32;
                    coupling_len += 3 * pattern.dim(slot.block as usize);
                }
                scratch_len = scratch_len.max(coupling_len - before);
            }
            chunks.push(Chunk {
                points: first..last,
                coupling: vec![0.0; coupling_len],
                point_hessian: vec![[0.0; 6]; last - first],
                point_gradient: vec![[0.0; 3]; last - first],
                base: vec![0.0; pattern.base_len()],
                gradient: vec![0.0; pattern.size()],
                schur: vec![0.0; pattern.len()],
                reduced: vec![0.0; pattern.size()],
                scratch: vec![0.0; scratch_len],
                candidate: points[first..last].to_vec(),
                ..Chunk::default()
            });
            first = last;
        }

        let targets = links
            .iter()
            .map(|link| {
                let point = link.point as usize;
                let of_point = &slots[slot_starts[point]..slot_starts[point + 1]];
                let offset_of = |block: u32| {
                    of_point
                        .binary_search_by_key(&block, |slot| slot.block)
                        .map_or(NONE, |at| of_point[at].offset)
                };
                let extra = if link.extra == NONE { NONE } else { extra_block(link) as u32 };
                let coupled = link.block != NONE && extra != NONE;
                Target {
                    coupling: if coupled {
                        pattern.offset(extra as usize, link.block as usize) as u32
                    } else {
                        NONE
                    },
                    block: offset_of(link.block),
                    extra: offset_of(extra),
                }
            })
            .collect();
        let system = CameraSystem::new(&pattern);
        Self {
            links,
            targets,
            observation_starts,
            slot_starts,
            slots,
            points,
            free,
            block_count,
            base: vec![0.0; pattern.base_len()],
            gradient: vec![0.0; pattern.size()],
            schur: vec![0.0; pattern.len()],
            step: vec![0.0; pattern.size()],
            damping: vec![0.0; pattern.size()],
            pattern,
            chunks,
            system,
        }
    }

    /// Current points.
    pub fn points(&self) -> &[Vector3<f64>] {
        &self.points
    }

    /// The camera-side step of the last [`NormalEquations::solve`].
    pub fn step(&self) -> &[f64] {
        &self.step
    }

    /// Number of scalar unknowns.
    pub fn unknowns(&self) -> usize {
        self.pattern.size() + 3 * self.free.iter().filter(|&&free| free).count()
    }

    /// Builds H and g at the current state; returns the cost.
    pub fn linearize<M: Model<D>>(&mut self, model: &M) -> f64 {
        let Self { links, targets, observation_starts, points, free, block_count, pattern, chunks, .. } =
            self;
        let loss = model.loss();
        for_each_chunk(chunks, |chunk| {
            chunk.coupling.fill(0.0);
            chunk.base.fill(0.0);
            chunk.gradient.fill(0.0);
            let mut losses = LossSum::new(loss);
            let mut lin = Linearized {
                residual: [0.0; 2],
                point: [[0.0; 3]; 2],
                block: [[0.0; D]; 2],
                extra: [[0.0; MAX_CAMERA_PARAMS]; 2],
            };
            for point in chunk.points.clone() {
                let (mut v, mut g) = ([0.0; 6], [0.0; 3]);
                for observation in observation_starts[point]..observation_starts[point + 1] {
                    let (link, target) = (&links[observation], &targets[observation]);
                    model.linearize(observation, link, &points[point], &mut lin);
                    let [r0, r1] = lin.residual;
                    let weight = losses.add(r0 * r0 + r1 * r1);
                    let (r0, r1) = (weight * r0, weight * r1);
                    let [p0, p1] = &lin.point;
                    let weighted = [p0.map(|value| weight * value), p1.map(|value| weight * value)];
                    if free[point] {
                        let [q0, q1] = &weighted;
                        v[0] += q0[0] * p0[0] + q1[0] * p1[0];
                        v[1] += q0[1] * p0[0] + q1[1] * p1[0];
                        v[2] += q0[1] * p0[1] + q1[1] * p1[1];
                        v[3] += q0[2] * p0[0] + q1[2] * p1[0];
                        v[4] += q0[2] * p0[1] + q1[2] * p1[1];
                        v[5] += q0[2] * p0[2] + q1[2] * p1[2];
                        for k in 0..3 {
                            g[k] += r0 * p0[k] + r1 * p1[k];
                        }
                    }
                    if link.block != NONE {
                        let block = link.block as usize;
                        let start = block * D;
                        let gradient = &mut chunk.gradient[start..start + D];
                        for k in 0..D {
                            gradient[k] += r0 * lin.block[0][k] + r1 * lin.block[1][k];
                        }
                        let hessian = &mut chunk.base[block * D * D..(block + 1) * D * D];
                        for (column, values) in hessian.as_chunks_mut::<D>().0.iter_mut().enumerate() {
                            let (a, b) = (weight * lin.block[0][column], weight * lin.block[1][column]);
                            for row in 0..D {
                                values[row] += lin.block[0][row] * a + lin.block[1][row] * b;
                            }
                        }
                        if target.block != NONE {
                            let coupling = &mut chunk.coupling[target.block as usize..][..3 * D];
                            for (k, values) in coupling.as_chunks_mut::<D>().0.iter_mut().enumerate() {
                                for row in 0..D {
                                    values[row] += lin.block[0][row] * weighted[0][k]
                                        + lin.block[1][row] * weighted[1][k];
                                }
                            }
                        }
                    }
                    if link.extra != NONE {
                        let block = *block_count + link.extra as usize;
                        let (dim, start) = (pattern.dim(block), pattern.start(block));
                        let (e0, e1) = (&lin.extra[0][..dim], &lin.extra[1][..dim]);
                        for k in 0..dim {
                            chunk.gradient[start + k] += r0 * e0[k] + r1 * e1[k];
                        }
                        add_product(
                            &mut chunk.base[pattern.offset(block, block)..],
                            weight,
                            [e0, e1],
                            [e0, e1],
                        );
                        if target.coupling != NONE {
                            let of_block = [&lin.block[0][..], &lin.block[1][..]];
                            add_product(
                                &mut chunk.base[target.coupling as usize..],
                                weight,
                                [e0, e1],
                                of_block,
                            );
                        }
                        if target.extra != NONE {
                            let of_point = [&lin.point[0][..], &lin.point[1][..]];
                            add_product(
                                &mut chunk.coupling[target.extra as usize..],
                                weight,
                                [e0, e1],
                                of_point,
                            );
                        }
                    }
                }
                chunk.point_hessian[point - chunk.points.start] = v;
                chunk.point_gradient[point - chunk.points.start] = g;
            }
            chunk.cost = 0.5 * losses.total();
        });
        let mut cost = 0.0;
        self.base.fill(0.0);
        self.gradient.fill(0.0);
        for chunk in &self.chunks {
            cost += chunk.cost;
            add(&mut self.base, &chunk.base);
            add(&mut self.gradient, &chunk.gradient);
        }
        let (base, gradient) = (&mut self.base, &mut self.gradient);
        cost += model.linearize_block_terms(&mut |block, hessian, block_gradient| {
            add(&mut base[block * D * D..(block + 1) * D * D], hessian.as_flattened());
            add(&mut gradient[block * D..(block + 1) * D], block_gradient);
        });
        cost
    }

    /// Eliminates the points and factorizes S for damping λ; false when that fails.
    pub fn factorize(&mut self, lambda: f64) -> bool {
        for block in 0..self.pattern.block_count() {
            let (offset, dim, start) =
                (self.pattern.offset(block, block), self.pattern.dim(block), self.pattern.start(block));
            for k in 0..dim {
                self.damping[start + k] = lambda * bounded(self.base[offset + k * (dim + 1)]);
            }
        }
        let Self { slot_starts, slots, free, block_count, pattern, chunks, .. } = self;
        for_each_chunk(chunks, |chunk| {
            eliminate::<D>(chunk, lambda, slot_starts, slots, free, *block_count, pattern);
        });
        if !self.chunks.iter().all(|chunk| chunk.usable) {
            return false;
        }
        let (base, chunks) = (&self.base, &self.chunks);
        let sum = |(index, values): (usize, &mut [f64])| {
            let first = index * SEGMENT;
            let from_base = base.len().saturating_sub(first).min(values.len());
            values[..from_base].copy_from_slice(&base[first.min(base.len())..][..from_base]);
            values[from_base..].fill(0.0);
            for chunk in chunks {
                add(values, &chunk.schur[first..first + values.len()]);
            }
        };
        if self.schur.len() > 4 * SEGMENT {
            self.schur.par_chunks_mut(SEGMENT).enumerate().for_each(sum);
        } else {
            self.schur.chunks_mut(SEGMENT).enumerate().for_each(sum);
        }
        for block in 0..self.pattern.block_count() {
            let (offset, dim, start) =
                (self.pattern.offset(block, block), self.pattern.dim(block), self.pattern.start(block));
            for k in 0..dim {
                self.schur[offset + k * (dim + 1)] += self.damping[start + k];
            }
        }
        self.pattern.size() == 0 || self.system.factorize(&self.pattern, &self.schur)
    }

    /// The damped step after [`NormalEquations::factorize`] with the same λ; `None` when it is not finite.
    ///
    /// The candidate points are set; the camera-side step is in [`NormalEquations::step`].
    pub fn solve(&mut self, lambda: f64) -> Option<StepSums> {
        for (step, gradient) in self.step.iter_mut().zip(&self.gradient) {
            *step = -gradient;
        }
        for chunk in &self.chunks {
            for (step, reduced) in self.step.iter_mut().zip(&chunk.reduced) {
                *step += reduced;
            }
        }
        if !self.step.is_empty() {
            self.system.solve(&mut self.step);
        }
        let Self { slot_starts, slots, points, free, pattern, chunks, step, .. } = self;
        for_each_chunk(chunks, |chunk| {
            substitute(chunk, lambda, step, points, slot_starts, slots, free, pattern);
        });
        let mut sums = StepSums::default();
        for ((step, gradient), damping) in self.step.iter().zip(&self.gradient).zip(&self.damping) {
            sums.predicted += 0.5 * step * (damping * step - gradient);
            sums.squared_step += step * step;
        }
        for chunk in &self.chunks {
            sums.predicted += chunk.sums.predicted;
            sums.squared_step += chunk.sums.squared_step;
            sums.squared_norm += chunk.sums.squared_norm;
        }
        (sums.predicted.is_finite() && sums.squared_step.is_finite()).then_some(sums)
    }

    /// Cost of the candidate state.
    pub fn candidate_cost<M: Model<D>>(&mut self, model: &M) -> f64 {
        let (starts, loss) = (&self.observation_starts, model.loss());
        for_each_chunk(&mut self.chunks, |chunk| {
            let mut losses = LossSum::new(loss);
            for (point, position) in chunk.points.clone().zip(&chunk.candidate) {
                for observation in starts[point]..starts[point + 1] {
                    losses.add(model.squared_residual(observation, position));
                }
            }
            chunk.cost = 0.5 * losses.total();
        });
        self.chunks.iter().map(|chunk| chunk.cost).sum::<f64>() + model.block_terms_cost()
    }

    /// Makes the candidate points the current ones.
    pub fn accept(&mut self) {
        for chunk in &self.chunks {
            self.points[chunk.points.clone()].copy_from_slice(&chunk.candidate);
        }
    }

    /// Whether the undamped S stays positive definite when `share` of JᵀJ's diagonal is taken away.
    pub fn is_definite_by(&mut self, share: f64) -> bool {
        if !self.factorize(0.0) {
            return false;
        }
        for block in 0..self.pattern.block_count() {
            let (offset, dim) = (self.pattern.offset(block, block), self.pattern.dim(block));
            for k in 0..dim {
                self.schur[offset + k * (dim + 1)] -= share * self.base[offset + k * (dim + 1)];
            }
        }
        self.pattern.size() == 0 || self.system.factorize(&self.pattern, &self.schur)
    }

    /// Solves S x = `right` in place, after [`NormalEquations::factorize`].
    pub fn solve_camera_side(&mut self, right: &mut [f64]) {
        self.system.solve(right);
    }
}

/// Values of S that one task sums over all chunks.
const SEGMENT: usize = 1 << 14;

fn for_each_chunk(chunks: &mut [Chunk], work: impl Fn(&mut Chunk) + Send + Sync) {
    // One chunk stays on this thread: small problems never wait for another.
    if let [chunk] = chunks {
        work(chunk);
    } else {
        chunks.par_iter_mut().for_each(work);
    }
}

#[inline]
fn add(to: &mut [f64], from: &[f64]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}

/// `to` (rows of `a` × rows of `b`, by columns) += weight · Σ aᵢ bᵢᵀ.
fn add_product(to: &mut [f64], weight: f64, a: [&[f64]; 2], b: [&[f64]; 2]) {
    let dim = a[0].len();
    for column in 0..b[0].len() {
        for row in 0..dim {
            to[column * dim + row] += weight * (a[0][row] * b[0][column] + a[1][row] * b[1][column]);
        }
    }
}

#[inline]
fn bounded(diagonal: f64) -> f64 {
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

fn eliminate<const D: usize>(
    chunk: &mut Chunk,
    lambda: f64,
    slot_starts: &[usize],
    slots: &[Slot],
    free: &[bool],
    block_count: usize,
    pattern: &BlockPattern,
) {
    chunk.schur.fill(0.0);
    chunk.reduced.fill(0.0);
    chunk.usable = true;
    for (index, point) in chunk.points.clone().enumerate() {
        let of_point = &slots[slot_starts[point]..slot_starts[point + 1]];
        if !free[point] || of_point.is_empty() {
            continue;
        }
        let Some([i00, l10, i11, l20, l21, i22]) = point_factor(&chunk.point_hessian[index], lambda) else {
            chunk.usable = false;
            continue;
        };
        let g = &chunk.point_gradient[index];
        let z0 = g[0] * i00;
        let z1 = (g[1] - l10 * z0) * i11;
        let z2 = (g[2] - l20 * z0 - l21 * z1) * i22;
        let first = of_point[0].offset as usize;
        for slot in of_point {
            let dim = pattern.dim(slot.block as usize);
            let w = &chunk.coupling[slot.offset as usize..][..3 * dim];
            let y = &mut chunk.scratch[slot.offset as usize - first..][..3 * dim];
            let start = pattern.start(slot.block as usize);
            let reduced = &mut chunk.reduced[start..start + dim];
            for row in 0..dim {
                let y0 = w[row] * i00;
                let y1 = (w[dim + row] - l10 * y0) * i11;
                let y2 = (w[2 * dim + row] - l20 * y0 - l21 * y1) * i22;
                (y[row], y[dim + row], y[2 * dim + row]) = (y0, y1, y2);
                reduced[row] += y0 * z0 + y1 * z1 + y2 * z2;
            }
        }
        for (position, row) in of_point.iter().enumerate() {
            let row_dim = pattern.dim(row.block as usize);
            let row_y = &chunk.scratch[row.offset as usize - first..][..3 * row_dim];
            for column in &of_point[..=position] {
                let column_dim = pattern.dim(column.block as usize);
                let column_y = &chunk.scratch[column.offset as usize - first..][..3 * column_dim];
                let offset = pattern.offset(row.block as usize, column.block as usize);
                let values = &mut chunk.schur[offset..offset + row_dim * column_dim];
                if (row.block as usize) < block_count {
                    subtract_outer::<D>(values, row_y, column_y);
                } else {
                    subtract_outer_sized(values, row_y, column_y, row_dim, column_dim);
                }
            }
        }
    }
}

/// values (D×D) −= a bᵀ with a, b of D×3, all by columns.
#[inline]
fn subtract_outer<const D: usize>(values: &mut [f64], a: &[f64], b: &[f64]) {
    let ([a0, a1, a2], [b0, b1, b2]) = (a.as_chunks::<D>().0, b.as_chunks::<D>().0) else { return };
    for (column, values) in values.as_chunks_mut::<D>().0.iter_mut().enumerate() {
        for row in 0..D {
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

#[expect(clippy::too_many_arguments, reason = "disjoint borrows of one struct")]
fn substitute(
    chunk: &mut Chunk,
    lambda: f64,
    step: &[f64],
    points: &[Vector3<f64>],
    slot_starts: &[usize],
    slots: &[Slot],
    free: &[bool],
    pattern: &BlockPattern,
) {
    chunk.sums = StepSums::default();
    for (index, point) in chunk.points.clone().enumerate() {
        if !free[point] {
            continue;
        }
        let (v, g) = (&chunk.point_hessian[index], &chunk.point_gradient[index]);
        let Some([i00, l10, i11, l20, l21, i22]) = point_factor(v, lambda) else { continue };
        let mut right = *g;
        for slot in &slots[slot_starts[point]..slot_starts[point + 1]] {
            let (dim, start) = (pattern.dim(slot.block as usize), pattern.start(slot.block as usize));
            let w = &chunk.coupling[slot.offset as usize..][..3 * dim];
            let camera_step = &step[start..start + dim];
            for k in 0..3 {
                right[k] +=
                    w[k * dim..(k + 1) * dim].iter().zip(camera_step).map(|(w, step)| w * step).sum::<f64>();
            }
        }
        let z0 = right[0] * i00;
        let z1 = (right[1] - l10 * z0) * i11;
        let z2 = (right[2] - l20 * z0 - l21 * z1) * i22;
        let d2 = z2 * i22;
        let d1 = (z1 - l21 * d2) * i11;
        let d0 = (z0 - l10 * d1 - l20 * d2) * i00;
        let delta = Vector3::new(-d0, -d1, -d2);
        chunk.candidate[index] = points[point] + delta;
        for (k, diagonal) in [v[0], v[2], v[5]].into_iter().enumerate() {
            chunk.sums.predicted += 0.5 * delta[k] * (lambda * bounded(diagonal) * delta[k] - g[k]);
        }
        chunk.sums.squared_step += delta.norm_squared();
        chunk.sums.squared_norm += points[point].norm_squared();
    }
}
