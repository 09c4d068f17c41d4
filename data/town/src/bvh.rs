//! A bounding volume hierarchy over the solids.

use nalgebra::Vector3;

use crate::geometry::{Bounds, Hit, Ray, Solid};

const LEAF_SIZE: usize = 3;
const BINS: usize = 12;
/// Levels of the tree at most; below half of it nodes are split in two equal parts.
const STACK_DEPTH: usize = 96;

#[derive(Debug)]
struct Node {
    bounds: Bounds,
    /// First solid of a leaf, or the index of the right child (the left one follows its parent).
    first: u32,
    /// Solids of a leaf; 0 for an inner node.
    count: u32,
    /// From the centre of the right child's bounds to that of the left one's.
    right_to_left: Vector3<f64>,
}

/// Solids ordered for quick ray queries.
#[derive(Debug)]
pub struct Hierarchy {
    nodes: Vec<Node>,
    solids: Vec<Solid>,
}

impl Hierarchy {
    pub fn new(solids: &[Solid]) -> Self {
        let boxes: Vec<Bounds> = solids.iter().map(|solid| solid.shape.bounds()).collect();
        let mut order: Vec<u32> = (0..solids.len() as u32).collect();
        let mut nodes = Vec::with_capacity(solids.len());
        if !order.is_empty() {
            build(&boxes, &mut order, 0, 0, &mut nodes);
        }
        let solids = order.iter().map(|&k| solids[k as usize].clone()).collect();
        Self { nodes, solids }
    }

    pub fn solid(&self, index: u32) -> &Solid {
        &self.solids[index as usize]
    }

    /// The nearest solid met nearer than `limit`; with `any`, the first one found.
    pub fn intersect(&self, ray: &Ray, mut limit: f64, any: bool) -> Option<Hit> {
        let mut best = None;
        let mut stack = [0u32; STACK_DEPTH];
        let mut height = usize::from(!self.nodes.is_empty());
        while height > 0 {
            height -= 1;
            let index = stack[height] as usize;
            let node = &self.nodes[index];
            match node.bounds.slabs(ray) {
                Some((enter, _, _)) if enter < limit => {}
                _ => continue,
            }
            if node.count > 0 {
                for k in node.first..node.first + node.count {
                    if let Some(hit) = self.solids[k as usize].shape.intersect(ray, limit, k) {
                        limit = hit.distance;
                        best = Some(hit);
                        if any {
                            return best;
                        }
                    }
                }
            } else {
                let (left, right) = (index as u32 + 1, node.first);
                let is_left_first = node.right_to_left.dot(&ray.direction) < 0.0;
                let (near, far) = if is_left_first { (left, right) } else { (right, left) };
                stack[height] = far;
                stack[height + 1] = near;
                height += 2;
            }
        }
        best
    }
}

fn build(boxes: &[Bounds], order: &mut [u32], offset: usize, depth: usize, nodes: &mut Vec<Node>) {
    let bounds = order.iter().skip(1).fold(boxes[order[0] as usize], |sum, &k| sum.union(&boxes[k as usize]));
    let index = nodes.len();
    let inner = Node { bounds, first: 0, count: 0, right_to_left: Vector3::zeros() };
    if order.len() <= LEAF_SIZE {
        nodes.push(Node { first: offset as u32, count: order.len() as u32, ..inner });
        return;
    }
    nodes.push(inner);
    let middle = if depth < STACK_DEPTH / 2 { split(boxes, order) } else { order.len() / 2 };
    let (left, right) = order.split_at_mut(middle);
    build(boxes, left, offset, depth + 1, nodes);
    nodes[index].first = nodes.len() as u32;
    build(boxes, right, offset + middle, depth + 1, nodes);
    let right = nodes[index].first as usize;
    nodes[index].right_to_left = nodes[index + 1].bounds.center() - nodes[right].bounds.center();
}

/// Orders solids so that the first ones, as many as returned, go to the left child: the cut of least surface area heuristic
/// among evenly spaced ones, or the median where all centres coincide.
fn split(boxes: &[Bounds], order: &mut [u32]) -> usize {
    let center = |k: u32| boxes[k as usize].center();
    let (low, high) = order
        .iter()
        .fold((center(order[0]), center(order[0])), |(a, b), &k| (a.inf(&center(k)), b.sup(&center(k))));
    let mut best: Option<(f64, usize, f64)> = None;
    for axis in 0..3 {
        let width = high[axis] - low[axis];
        if width <= 0.0 {
            continue;
        }
        let mut bins: [Option<(Bounds, usize)>; BINS] = [None; BINS];
        for &k in order.iter() {
            let bin = (((center(k)[axis] - low[axis]) / width * BINS as f64) as usize).min(BINS - 1);
            let filled =
                bins[bin].map_or((boxes[k as usize], 1), |(sum, n)| (sum.union(&boxes[k as usize]), n + 1));
            bins[bin] = Some(filled);
        }
        for cut in 1..BINS {
            let cost = |part: &[Option<(Bounds, usize)>]| {
                let sum = part.iter().flatten().copied().reduce(|a, b| (a.0.union(&b.0), a.1 + b.1));
                sum.map(|(bounds, n)| half_area(&bounds) * n as f64)
            };
            if let (Some(left), Some(right)) = (cost(&bins[..cut]), cost(&bins[cut..]))
                && best.is_none_or(|(least, ..)| left + right < least)
            {
                best = Some((left + right, axis, low[axis] + width * cut as f64 / BINS as f64));
            }
        }
    }
    if let Some((_, axis, plane)) = best {
        order.sort_unstable_by_key(|&k| (center(k)[axis] >= plane, k));
        let middle = order.partition_point(|&k| center(k)[axis] < plane);
        if 0 < middle && middle < order.len() {
            return middle;
        }
    }
    order.len() / 2
}

fn half_area(bounds: &Bounds) -> f64 {
    let size = bounds.max - bounds.min;
    size.x * size.y + size.y * size.z + size.z * size.x
}
