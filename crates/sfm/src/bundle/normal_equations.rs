//! Normal equations of a bundle problem, points eliminated: the part that every residual shares.
//!
//! Unknowns are camera-side blocks of `D` scalars (poses, or poses with intrinsics), optional further camera-side
//! blocks of other sizes (shared intrinsics), and points. With H = JᵀJ and g = Jᵀr split into camera side (U, g_c),
//! points (V, g_p) and coupling (W), the damped step solves
//! S δ_c = −(g_c − W V⁻¹ g_p) with S = U − W V⁻¹ Wᵀ, then V δ_p = −(g_p + Wᵀ δ_c).
//!
//! Work is cut into chunks of consecutive points whose number depends on the problem alone; each sums into its own
//! memory and the chunks are added in order, so the bytes do not depend on the number of threads.
//!
//! S is formed and factorized while that is within a [`Budget`]; beyond, that of [split points](super::split) is, and products with S
//! are made from U, V and W.

use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::MAX_CAMERA_PARAMS;

use super::RobustLoss;
use super::camera_system::{Budget, CameraSystem};
use super::elimination::{Chunk, Couplings, Slot, StepSums, bounded, for_each_chunk, insert_pairs};
use super::iterative::{ImplicitSchur, IterativeSystem};
use super::loss::LossSum;
use super::pattern::{BlockPattern, NONE};
use super::split::{copied, split};

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

/// Takes extra block and row of it, and of a term of that block alone Jᵀr and the values of JᵀJ in that row, by column.
pub(super) type ExtraTerm<'a> = &'a mut dyn FnMut(usize, usize, f64, &mut dyn Iterator<Item = (usize, f64)>);

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
    /// Calls `add` with terms of single further blocks, row by row; returns their cost.
    fn linearize_extra_terms(&self, _: ExtraTerm<'_>) -> f64 {
        0.0
    }
    /// Cost of the terms of single blocks at the candidate state.
    fn prior_cost(&self) -> f64;
    /// Sets the candidate to current ⊞ step (all blocks, then all extra blocks); false when that is no valid state.
    fn propose(&mut self, step: &[f64]) -> bool;
    /// Makes the candidate the current state.
    fn accept(&mut self);
    /// Sum of squares of the camera-side parameters, for the relative size of their step.
    fn squared_norm(&self) -> f64;
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
    /// Copy of the point in its chunk, or [`NONE`].
    copy: u32,
}

/// What is unknown, and which of it each observation touches.
#[derive(Debug, Default)]
pub(super) struct Structure {
    /// Of all observations, sorted by point; every point has at least one.
    pub links: Vec<Link>,
    /// Initial positions.
    pub points: Vec<Vector3<f64>>,
    /// Whether each point is an unknown.
    pub free: Vec<bool>,
    /// Number of camera-side blocks of size `D`.
    pub block_count: usize,
    /// Sizes of the further camera-side blocks.
    pub extra_dims: Vec<usize>,
}

/// How S δ = b is solved.
enum ReducedSystem {
    /// By a factorization of S.
    Direct(CameraSystem),
    /// By products with S and a factorization of what it is with points split.
    Iterative(IterativeSystem),
}

/// The normal equations with all memory they ever need.
pub(super) struct NormalEquations<const D: usize> {
    links: Vec<Link>,
    targets: Vec<Target>,
    /// First observation of each point, and the end.
    observation_starts: Vec<usize>,
    couplings: Couplings,
    points: Vec<Vector3<f64>>,
    block_count: usize,
    /// Blocks of S, or of what it is with points split.
    pattern: BlockPattern,
    chunks: Vec<Chunk>,
    base: Vec<f64>,
    gradient: Vec<f64>,
    /// S in the blocks of the pattern, or what it is with points split.
    schur: Vec<f64>,
    step: Vec<f64>,
    /// The step as it was proposed last.
    stretched: Vec<f64>,
    damping: Vec<f64>,
    /// λ for which the points are eliminated.
    eliminated_for: Option<f64>,
    system: ReducedSystem,
}

impl<const D: usize> NormalEquations<D> {
    /// Plans the elimination. S is formed and factorized within the budget, else solved by its products.
    pub fn new(structure: Structure, budget: &Budget) -> Self {
        let Structure { links, points, free, block_count, extra_dims } = structure;
        let mut dims = vec![D; block_count];
        dims.extend(extra_dims);
        let mut pattern = BlockPattern::new(dims);
        let extra_block = |link: &Link| block_count + link.extra as usize;
        for link in &links {
            if link.block != NONE && link.extra != NONE {
                pattern.insert_base(extra_block(link), link.block as usize);
            }
        }
        let mut observation_starts = Vec::with_capacity(points.len() + 1);
        observation_starts.push(0);
        let mut couplings = Couplings { starts: vec![0], slots: Vec::new(), free, copies: None };
        let (mut end, mut touched) = (0, Vec::new());
        for point in 0..points.len() {
            let start = end;
            while end < links.len() && links[end].point as usize == point {
                end += 1;
            }
            touched.clear();
            if couplings.free[point] {
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
            }
            couplings.slots.extend(touched.iter().map(|&block| Slot { block, offset: 0 }));
            couplings.starts.push(couplings.slots.len());
            observation_starts.push(end);
        }

        let filled = if budget.is_of_whole() { with_fill(&pattern, &couplings, budget) } else { None };
        let mut work = 0;
        let work_until: Vec<usize> = (0..points.len())
            .map(|point| {
                let touched = couplings.of_point(point).len();
                work += 2 * (observation_starts[point + 1] - observation_starts[point]) + touched * touched;
                work
            })
            .collect();
        let chunks_of = |len: usize| {
            (work / WORK_PER_CHUNK).clamp(1, (MAX_CHUNK_VALUES / len.max(1)).clamp(1, MAX_CHUNKS))
        };
        let direct = filled.and_then(|filled| {
            let accumulated = filled.len() * (1 + chunks_of(filled.len()));
            let system = CameraSystem::new(&filled, &budget.without(accumulated)?)?;
            Some((filled, ReducedSystem::Direct(system)))
        });
        let (pattern, system) = direct.unwrap_or_else(|| {
            let (pattern, preconditioner) = split(&pattern, block_count, &links, &mut couplings, budget);
            let system = IterativeSystem::new(&pattern, preconditioner);
            (pattern, ReducedSystem::Iterative(system))
        });

        let chunk_count = chunks_of(pattern.len());
        let (mut ranges, mut slots_left) = (Vec::with_capacity(chunk_count), &mut couplings.slots[..]);
        let mut first = 0;
        for index in 0..chunk_count {
            let last = if index + 1 == chunk_count {
                points.len()
            } else {
                work_until.partition_point(|&until| until <= work * (index + 1) / chunk_count).max(first)
            };
            let own = couplings.starts[last] - couplings.starts[first];
            let (slots, others) = std::mem::take(&mut slots_left).split_at_mut(own);
            ranges.push((first..last, slots));
            (first, slots_left) = (last, others);
        }
        let chunk = |(range, slots): (std::ops::Range<usize>, &mut [Slot])| {
            let (mut coupling_len, mut scratch_len) = (0, 0);
            for point in range.clone() {
                let before = coupling_len;
                let first = couplings.starts[range.start];
                for slot in &mut slots[couplings.starts[point] - first..couplings.starts[point + 1] - first] {
                    slot.offset = coupling_len as u32;
                    coupling_len += 3 * pattern.dim(slot.block as usize);
                }
                scratch_len = scratch_len.max(coupling_len - before);
            }
            let count = range.len();
            let copies = (couplings.copies.as_ref())
                .map(|copies| copies.starts[range.end] - copies.starts[range.start]);
            Chunk {
                candidate: points[range.clone()].to_vec(),
                points: range,
                coupling: vec![0.0; coupling_len],
                point_hessian: vec![[0.0; 6]; count],
                point_gradient: vec![[0.0; 3]; count],
                copy_hessian: vec![[0.0; 6]; copies.unwrap_or(0)],
                factors: vec![[0.0; 6]; copies.map_or(0, |_| count)],
                base: vec![0.0; pattern.base_len()],
                gradient: vec![0.0; pattern.size()],
                schur: vec![0.0; pattern.len()],
                reduced: vec![0.0; pattern.size()],
                scratch: vec![0.0; scratch_len],
                ..Chunk::default()
            }
        };
        let chunks: Vec<Chunk> = ranges.into_par_iter().with_max_len(1).map(chunk).collect();

        let targets = links
            .par_iter()
            .with_min_len(WORK_PER_CHUNK)
            .map(|link| {
                let (mut seen, mut copy) = (couplings.of_point(link.point as usize), NONE);
                if let Some(copies) = &couplings.copies
                    && let Some(index) = copied(copies, &couplings.slots, link)
                {
                    seen = &couplings.slots[copies.slots(index)];
                    let chunk = chunks.partition_point(|chunk| chunk.points.end <= link.point as usize);
                    copy = (index - copies.starts[chunks[chunk].points.start]) as u32;
                }
                let offset_of = |block: u32| {
                    seen.binary_search_by_key(&block, |slot| slot.block).map_or(NONE, |at| seen[at].offset)
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
                    copy,
                }
            })
            .collect();
        Self {
            links,
            targets,
            observation_starts,
            couplings,
            points,
            block_count,
            base: vec![0.0; pattern.base_len()],
            gradient: vec![0.0; pattern.size()],
            schur: vec![0.0; pattern.len()],
            step: vec![0.0; pattern.size()],
            stretched: Vec::new(),
            damping: vec![0.0; pattern.size()],
            pattern,
            chunks,
            eliminated_for: None,
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
        self.pattern.size() + 3 * self.couplings.free.iter().filter(|&&free| free).count()
    }

    /// The iterative system with its counts, unless S is factorized.
    pub fn iterative(&self) -> Option<&IterativeSystem> {
        match &self.system {
            ReducedSystem::Direct(_) => None,
            ReducedSystem::Iterative(system) => Some(system),
        }
    }

    /// Builds H and g at the current state and eliminates the points for damping λ; returns the cost.
    ///
    /// [`NormalEquations::factorize`] does the latter for any λ, but waking other threads takes as long as many points
    /// do: small problems are handed out as few times as possible.
    pub fn linearize<M: Model<D>>(&mut self, model: &M, lambda: f64) -> f64 {
        let Self {
            links, targets, observation_starts, points, couplings, block_count, pattern, chunks, ..
        } = self;
        let loss = model.loss();
        for_each_chunk(chunks, |chunk| {
            chunk.coupling.fill(0.0);
            chunk.base.fill(0.0);
            chunk.gradient.fill(0.0);
            chunk.copy_hessian.fill([0.0; 6]);
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
                    if couplings.free[point] {
                        add_point_square(&mut v, &weighted, &lin.point);
                        if let Some(v) = chunk.copy_hessian.get_mut(target.copy as usize) {
                            add_point_square(v, &weighted, &lin.point);
                        }
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
            chunk.eliminate::<D>(lambda, couplings, pattern);
        });
        self.eliminated_for = Some(lambda);
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
        let (pattern, block_count) = (&self.pattern, self.block_count);
        cost += model.linearize_extra_terms(&mut |extra, row, first, second| {
            let block = block_count + extra;
            gradient[pattern.start(block) + row] += first;
            for (column, value) in second {
                base[pattern.offset(block, block) + column * pattern.dim(block) + row] += value;
            }
        });
        cost
    }

    /// Eliminates the points and factorizes S, or what it is with points split, for damping λ; false when that fails.
    pub fn factorize(&mut self, lambda: f64) -> bool {
        for block in 0..self.pattern.block_count() {
            let (offset, dim, start) =
                (self.pattern.offset(block, block), self.pattern.dim(block), self.pattern.start(block));
            for k in 0..dim {
                self.damping[start + k] = lambda * bounded(self.base[offset + k * (dim + 1)]);
            }
        }
        if self.eliminated_for != Some(lambda) {
            let Self { couplings, pattern, chunks, .. } = self;
            for_each_chunk(chunks, |chunk| chunk.eliminate::<D>(lambda, couplings, pattern));
            self.eliminated_for = Some(lambda);
        }
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
        self.factorize_schur()
    }

    fn factorize_schur(&mut self) -> bool {
        let Self { pattern, schur, system, .. } = self;
        match system {
            _ if pattern.size() == 0 => true,
            ReducedSystem::Direct(system) => system.factorize(pattern, schur),
            ReducedSystem::Iterative(system) => system.prepare(pattern, schur),
        }
    }

    /// Finds the camera side of the damped step, after [`NormalEquations::factorize`]; false when there is none.
    pub fn solve(&mut self) -> bool {
        for (step, gradient) in self.step.iter_mut().zip(&self.gradient) {
            *step = -gradient;
        }
        for chunk in &self.chunks {
            for (step, reduced) in self.step.iter_mut().zip(&chunk.reduced) {
                *step += reduced;
            }
        }
        let Self { couplings, pattern, chunks, step, base, damping, eliminated_for, system, .. } = self;
        if step.is_empty() {
            return true;
        }
        match system {
            ReducedSystem::Direct(system) => {
                system.solve(step);
                true
            }
            ReducedSystem::Iterative(system) => {
                // Products go where the elimination left the right-hand side.
                *eliminated_for = None;
                let schur = ImplicitSchur { couplings, pattern, base, damping };
                let multiply = |x: &[f64], to: &mut [f64]| schur.multiply::<D>(chunks, x, to);
                system.solve(step, multiply)
            }
        }
    }

    /// What the step found by [`NormalEquations::solve`] for this λ leads to, stretched; `None` when it is not finite.
    ///
    /// The sums are of the step as it is. The model's candidate and the candidate points are set; the cost of a candidate that
    /// is no valid state is infinite.
    pub fn propose<M: Model<D>>(
        &mut self,
        lambda: f64,
        stretch: f64,
        model: &mut M,
    ) -> Option<(StepSums, f64)> {
        let Self { observation_starts: starts, couplings, points, pattern, chunks, step, stretched, .. } =
            self;
        stretched.clear();
        stretched.extend(step.iter().map(|value| value * stretch));
        let is_valid = model.propose(stretched);
        let (model, loss) = (&*model, model.loss());
        for_each_chunk(chunks, |chunk| {
            chunk.substitute((lambda, stretch), step, points, couplings, pattern);
            let mut losses = LossSum::new(loss);
            if is_valid {
                for (point, position) in chunk.points.clone().zip(&chunk.candidate) {
                    for observation in starts[point]..starts[point + 1] {
                        losses.add(model.squared_residual(observation, position));
                    }
                }
            }
            chunk.cost = 0.5 * losses.total();
        });
        // What the model decreases by also holds for conjugate gradients: what they leave is perpendicular to their step.
        let mut sums = StepSums::default();
        for ((step, gradient), damping) in self.step.iter().zip(&self.gradient).zip(&self.damping) {
            sums.predicted += 0.5 * step * (damping * step - gradient);
            sums.squared_step += step * step;
        }
        for chunk in &self.chunks {
            sums.predicted += chunk.sums.predicted;
            sums.largest_point_step = sums.largest_point_step.max(chunk.sums.largest_point_step);
        }
        let cost = if is_valid {
            self.chunks.iter().map(|chunk| chunk.cost).sum::<f64>() + model.prior_cost()
        } else {
            f64::INFINITY
        };
        (sums.predicted.is_finite() && sums.squared_step.is_finite()).then_some((sums, cost))
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
        self.factorize_schur()
    }

    /// Solves S x = `right` in place, after [`NormalEquations::factorize`]; false when S is not factorized as a whole.
    pub fn solve_camera_side(&mut self, right: &mut [f64]) -> bool {
        match &mut self.system {
            ReducedSystem::Direct(system) => {
                system.solve(right);
                true
            }
            ReducedSystem::Iterative(_) => false,
        }
    }
}

/// The blocks of U and those that shared points fill in; `None` once they are beyond the budget.
fn with_fill(base: &BlockPattern, couplings: &Couplings, budget: &Budget) -> Option<BlockPattern> {
    let mut pattern = base.clone();
    let fits = (0..couplings.free.len()).all(|point| {
        let fits = budget.may_suffice(&pattern);
        if fits {
            insert_pairs(couplings.of_point(point), &mut pattern);
        }
        fits
    });
    fits.then_some(pattern)
}

/// Values of S that one task sums over all chunks.
const SEGMENT: usize = 1 << 14;

#[inline]
fn add(to: &mut [f64], from: &[f64]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}

/// Adds JᵀJ of an observation of a point to its V, a lower triangle by rows.
#[inline]
fn add_point_square(v: &mut [f64; 6], [q0, q1]: &[[f64; 3]; 2], [p0, p1]: &[[f64; 3]; 2]) {
    v[0] += q0[0] * p0[0] + q1[0] * p1[0];
    v[1] += q0[1] * p0[0] + q1[1] * p1[0];
    v[2] += q0[1] * p0[1] + q1[1] * p1[1];
    v[3] += q0[2] * p0[0] + q1[2] * p1[0];
    v[4] += q0[2] * p0[1] + q1[2] * p1[1];
    v[5] += q0[2] * p0[2] + q1[2] * p1[2];
}

/// `to` (rows of `a` × rows of `b`, by columns) += weight · Σ aᵢ bᵢᵀ.
#[inline]
fn add_product(to: &mut [f64], weight: f64, [a0, a1]: [&[f64]; 2], [b0, b1]: [&[f64]; 2]) {
    for ((to, b0), b1) in to.chunks_exact_mut(a0.len().max(1)).zip(b0).zip(b1) {
        for ((to, a0), a1) in to.iter_mut().zip(a0).zip(a1) {
            *to += weight * (a0 * b0 + a1 * b1);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::bundle::LinearSolver;

    /// Residuals that are linear in what they touch, with Jacobians drawn at random.
    struct Linear(Vec<Linearized<3>>);

    impl Model<3> for Linear {
        fn loss(&self) -> RobustLoss {
            RobustLoss::Trivial
        }
        fn linearize(&self, observation: usize, _: &Link, _: &Vector3<f64>, out: &mut Linearized<3>) {
            *out = self.0[observation];
        }
        fn squared_residual(&self, observation: usize, _: &Vector3<f64>) -> f64 {
            self.0[observation].residual.iter().map(|residual| residual * residual).sum()
        }
        fn linearize_block_terms(&self, add: BlockTerm<'_, 3>) -> f64 {
            add(1, &[[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 4.0]], &[0.5, 0.6, 0.7]);
            0.0
        }
        fn prior_cost(&self) -> f64 {
            0.0
        }
        fn propose(&mut self, _: &[f64]) -> bool {
            true
        }
        fn accept(&mut self) {}
        fn squared_norm(&self) -> f64 {
            1.0
        }
    }

    fn drawn(rng: &mut ChaCha8Rng) -> Linearized<3> {
        let mut draw = || rng.random_range(-1.0..1.0);
        Linearized {
            residual: [draw(), draw()],
            point: [(); 2].map(|()| [(); 3].map(|()| draw())),
            block: [(); 2].map(|()| [(); 3].map(|()| draw())),
            extra: [(); 2].map(|()| [(); MAX_CAMERA_PARAMS].map(|()| draw())),
        }
    }

    /// Seven blocks, two further blocks of 2 and 4 scalars, fixed points, a fixed block, a point seen twice by one.
    fn example() -> (Linear, impl Fn() -> Structure) {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (mut links, mut linear) = (Vec::new(), Vec::new());
        for point in 0..60 {
            for _ in 0..rng.random_range(2..5) {
                let block = rng.random_range(0..8);
                let extra = if block % 3 == 2 { NONE } else { block % 3 };
                links.push(Link { point, block: if block == 7 { NONE } else { block }, extra });
                linear.push(drawn(&mut rng));
            }
        }
        let structure = move || Structure {
            links: links.clone(),
            points: vec![Vector3::zeros(); 60],
            free: (0..60).map(|point| point % 9 != 0).collect(),
            block_count: 7,
            extra_dims: vec![2, 4],
        };
        (Linear(linear), structure)
    }

    /// The blocks of S as a full matrix.
    fn full(pattern: &BlockPattern, blocks: &[f64]) -> Vec<Vec<f64>> {
        let mut full = vec![vec![0.0; pattern.size()]; pattern.size()];
        for column_block in 0..pattern.block_count() {
            let (columns, start) = (pattern.dim(column_block), pattern.start(column_block));
            for (row_block, offset) in pattern.column(column_block) {
                let rows = pattern.dim(row_block);
                for (index, &value) in blocks[offset..offset + rows * columns].iter().enumerate() {
                    let (row, column) = (pattern.start(row_block) + index % rows, start + index / rows);
                    full[column][row] = value;
                    full[row][column] = value;
                }
            }
        }
        full
    }

    fn assert_near(found: &[f64], expected: &[f64], bound: f64) {
        for (row, (found, expected)) in found.iter().zip(expected).enumerate() {
            assert!((found - expected).abs() < bound, "row {row}: {found} {expected}");
        }
    }

    #[test]
    fn implicit_products_are_those_of_the_explicit_system() {
        let (small, of_small) = example();
        let (street, of_street) = street(250);
        let of_structure = |model: &Linear, structure: &dyn Fn() -> Structure, budget: &Budget| {
            let mut direct = NormalEquations::<3>::new(structure(), &Budget::MEMORY);
            let mut implicit = NormalEquations::<3>::new(structure(), budget);
            for equations in [&mut direct, &mut implicit] {
                equations.linearize(model, 1e-2);
                assert!(equations.factorize(1e-3));
            }
            let explicit = full(&direct.pattern, &direct.schur);
            let NormalEquations { couplings, pattern, base, damping, chunks, .. } = &mut implicit;
            let operator = ImplicitSchur { couplings, pattern, base, damping };
            for (column, explicit) in explicit.iter().enumerate() {
                let (mut x, mut product) = (vec![0.0; explicit.len()], vec![0.0; explicit.len()]);
                x[column] = 1.0;
                operator.multiply::<3>(chunks, &x, &mut product);
                assert_near(&product, explicit, 1e-10);
            }
        };
        of_structure(&small, &of_small, &Budget::new(LinearSolver::Iterative, small.0.len()));
        of_structure(&street, &of_street, &Budget::tight());
    }

    #[test]
    fn pattern_within_the_budget_is_factorized_and_beyond_it_is_not() {
        let (model, structure) = example();
        let count = model.0.len();
        for (solver, is_direct) in
            [(LinearSolver::Auto, true), (LinearSolver::Direct, true), (LinearSolver::Iterative, false)]
        {
            let equations = NormalEquations::<3>::new(structure(), &Budget::new(solver, count));
            assert_eq!(matches!(equations.system, ReducedSystem::Direct(_)), is_direct, "{solver:?}");
        }
        let needed = NormalEquations::<3>::new(structure(), &Budget::MEMORY).pattern.len();
        let tight = Budget::MEMORY.without((1 << 28) - needed).unwrap();
        let equations = NormalEquations::<3>::new(structure(), &tight);
        assert!(matches!(equations.system, ReducedSystem::Iterative(_)), "no room for the factor");
    }

    /// A street, of which neighbours see what lies at it, and four points that all see.
    fn street(blocks: u32) -> (Linear, impl Fn() -> Structure) {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let (mut links, mut linear) = (Vec::new(), Vec::new());
        let seen_by = |point: u32| {
            if point % blocks == 40 && point > blocks {
                0..blocks
            } else {
                point % blocks..(point % blocks + 3).min(blocks)
            }
        };
        for point in 0..5 * blocks {
            for block in seen_by(point) {
                links.push(Link { point, block, extra: block % 2 });
                linear.push(drawn(&mut rng));
            }
        }
        let structure = move || Structure {
            links: links.clone(),
            points: vec![Vector3::zeros(); 5 * blocks as usize],
            free: (0..5 * blocks).map(|point| point != 4 * blocks + 40).collect(),
            block_count: blocks as usize,
            extra_dims: vec![2, 4],
        };
        (Linear(linear), structure)
    }

    #[test]
    fn preconditioner_is_the_system_of_the_split_problem() {
        let (model, structure) = street(250);
        let mut implicit = NormalEquations::<3>::new(structure(), &Budget::tight());
        let copies = implicit.couplings.copies.as_ref().unwrap();
        // Copies as points of their own; what is no unknown has none.
        let mut split = structure();
        let copied: Vec<_> =
            split.links.iter().map(|link| copied(copies, &implicit.couplings.slots, link)).collect();
        let fixed = copies.count();
        assert!(fixed > split.points.len() + 100);
        let mut order: Vec<usize> = (0..split.links.len()).collect();
        order.sort_by_key(|&at| copied[at].unwrap_or(fixed));
        let link = |&at: &usize| Link { point: copied[at].unwrap_or(fixed) as u32, ..split.links[at] };
        split.links = order.iter().map(link).collect();
        split.points = vec![Vector3::zeros(); fixed + 1];
        split.free = (0..=fixed).map(|copy| copy < fixed).collect();
        let of_split = Linear(order.iter().map(|&at| model.0[at]).collect());
        let mut direct = NormalEquations::<3>::new(split, &Budget::MEMORY);
        direct.linearize(&of_split, 1e-2);
        implicit.linearize(&model, 1e-2);
        assert!(direct.factorize(1e-3) && implicit.factorize(1e-3));
        let [found, expected] =
            [&implicit, &direct].map(|equations| full(&equations.pattern, &equations.schur));
        for (found, expected) in found.iter().zip(&expected) {
            assert_near(found, expected, 1e-10);
        }
    }

    #[test]
    fn few_iterations_solve_a_street_with_points_that_all_see() {
        let (model, structure) = street(250);
        let mut equations =
            [Budget::tight(), Budget::MEMORY].map(|budget| NormalEquations::<3>::new(structure(), &budget));
        assert!(4 * equations[0].pattern.len() < equations[1].pattern.len());
        for lambda in [1e-6, 1.0] {
            let before = equations[0].iterative().unwrap().iterations();
            let [found, expected] = equations.each_mut().map(|equations| {
                equations.linearize(&model, 1.0);
                assert!(equations.factorize(lambda) && equations.solve());
                equations.step().to_vec()
            });
            let of =
                |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
            let apart = of(&mut found.iter().zip(&expected).map(|(found, expected)| found - expected));
            assert!(apart < 0.02 * of(&mut expected.iter().copied()), "{apart}");
            let iterations = equations[0].iterative().unwrap().iterations() - before;
            assert!((1..40).contains(&iterations), "{iterations}");
        }
    }

    #[test]
    fn a_preconditioner_that_is_indefinite_is_refused() {
        let (model, structure) = street(250);
        let mut equations = NormalEquations::<3>::new(structure(), &Budget::tight());
        equations.linearize(&model, 1e-3);
        assert!(equations.factorize(1e-3));
        equations.schur[0] = -1.0;
        assert!(!equations.factorize_schur());
    }
}
