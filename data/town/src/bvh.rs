//! A bounding volume hierarchy over the solids.

use crate::geometry::{Bounds, Hit, Ray, Solid};

const LEAF_SIZE: usize = 3;
/// Deep enough for 2³² solids: the tree is split at the median.
const STACK_DEPTH: usize = 64;

#[derive(Debug)]
struct Node {
    bounds: Bounds,
    /// First solid of a leaf, or the index of the right child (the left one follows its parent).
    first: u32,
    /// Solids of a leaf; 0 for an inner node.
    count: u32,
}

/// Solids ordered for quick ray queries.
#[derive(Debug)]
pub struct Hierarchy {
    nodes: Vec<Node>,
    solids: Vec<Solid>,
}

impl Hierarchy {
    pub fn new(solids: Vec<Solid>) -> Self {
        let boxes: Vec<Bounds> = solids.iter().map(|solid| solid.shape.bounds()).collect();
        let mut order: Vec<u32> = (0..solids.len() as u32).collect();
        let mut nodes = Vec::with_capacity(solids.len());
        if !order.is_empty() {
            build(&boxes, &mut order, 0, &mut nodes);
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
                let offset =
                    self.nodes[left as usize].bounds.center() - self.nodes[right as usize].bounds.center();
                let (near, far) =
                    if offset.dot(&ray.direction) < 0.0 { (left, right) } else { (right, left) };
                stack[height] = far;
                stack[height + 1] = near;
                height += 2;
            }
        }
        best
    }
}

fn build(boxes: &[Bounds], order: &mut [u32], offset: usize, nodes: &mut Vec<Node>) {
    let bounds = order.iter().skip(1).fold(boxes[order[0] as usize], |sum, &k| sum.union(&boxes[k as usize]));
    let index = nodes.len();
    if order.len() <= LEAF_SIZE {
        nodes.push(Node { bounds, first: offset as u32, count: order.len() as u32 });
        return;
    }
    nodes.push(Node { bounds, first: 0, count: 0 });
    let axis = (bounds.max - bounds.min).imax();
    let middle = order.len() / 2;
    order.select_nth_unstable_by(middle, |&a, &b| {
        boxes[a as usize].center()[axis].total_cmp(&boxes[b as usize].center()[axis]).then(a.cmp(&b))
    });
    let (left, right) = order.split_at_mut(middle);
    build(boxes, left, offset, nodes);
    nodes[index].first = nodes.len() as u32;
    build(boxes, right, offset + middle, nodes);
}
