use std::num::NonZero;
use std::sync::OnceLock;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::DESCRIPTOR_LEN;

/// Dimensions of the tree: kd-trees serve few dimensions only, and eight components keep most of the order.
const COMPONENTS: usize = 8;

type Tree = ImmutableKdTree<f32, COMPONENTS>;

/// The rows as points of their eight first principal components, in a kd-tree.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct PrincipalTree {
    mean: Vec<f32>,
    /// `COMPONENTS` rows of `DESCRIPTOR_LEN` coefficients.
    basis: Vec<f32>,
    coordinates: Vec<[f32; COMPONENTS]>,
    /// Rows re-ranked per query.
    pub(crate) candidates: usize,
    /// Built from `coordinates` at first use; quick, and not worth storing.
    #[serde(skip)]
    tree: Lazy,
}

/// A tree that is a function of the data beside it, so it takes no part in comparison and copying.
#[derive(Default)]
struct Lazy(OnceLock<Option<Tree>>);

impl std::fmt::Debug for Lazy {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(if self.0.get().is_some() { "Lazy(built)" } else { "Lazy(not built)" })
    }
}

impl Clone for Lazy {
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl PartialEq for Lazy {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

impl PrincipalTree {
    /// Finds the principal components of all rows and projects the rows onto them.
    pub(crate) fn train(descriptors: &[u8]) -> Self {
        let rows = (descriptors.len() / DESCRIPTOR_LEN).max(1) as f64;
        let mut mean = DVector::<f64>::zeros(DESCRIPTOR_LEN);
        for row in descriptors.chunks_exact(DESCRIPTOR_LEN) {
            mean += DVector::from_iterator(DESCRIPTOR_LEN, row.iter().map(|&byte| f64::from(byte)));
        }
        mean /= rows;
        // Second moments are sums of integers below 2^53: exact, whatever the order.
        let mut moments = vec![0_u64; DESCRIPTOR_LEN * DESCRIPTOR_LEN];
        for row in descriptors.chunks_exact(DESCRIPTOR_LEN) {
            for (i, &a) in row.iter().enumerate() {
                let line = &mut moments[i * DESCRIPTOR_LEN..(i + 1) * DESCRIPTOR_LEN];
                for (moment, &b) in line.iter_mut().zip(row) {
                    *moment += u64::from(u32::from(a) * u32::from(b));
                }
            }
        }
        let covariance =
            DMatrix::from_iterator(DESCRIPTOR_LEN, DESCRIPTOR_LEN, moments.iter().map(|&m| m as f64 / rows))
                - &mean * mean.transpose();
        let eigen = SymmetricEigen::new(covariance);
        let mut order: Vec<usize> = (0..DESCRIPTOR_LEN).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let basis = order
            .iter()
            .take(COMPONENTS)
            .flat_map(|&column| {
                eigen.eigenvectors.column(column).iter().map(|&value| value as f32).collect::<Vec<_>>()
            })
            .collect();
        let mut tree = Self {
            mean: mean.iter().map(|&value| value as f32).collect(),
            basis,
            coordinates: Vec::new(),
            candidates: 128,
            tree: Lazy::default(),
        };
        tree.coordinates =
            descriptors.par_chunks_exact(DESCRIPTOR_LEN).map(|row| tree.project(row)).collect();
        tree
    }

    fn project(&self, descriptor: &[u8]) -> [f32; COMPONENTS] {
        std::array::from_fn(|component| {
            let basis = &self.basis[component * DESCRIPTOR_LEN..(component + 1) * DESCRIPTOR_LEN];
            basis.iter().zip(descriptor).zip(&self.mean).map(|((b, &d), m)| b * (f32::from(d) - m)).sum()
        })
    }

    /// Rows nearest to the query in the space of the principal components.
    pub(crate) fn candidates(&self, query: &[u8]) -> Vec<u32> {
        let tree = self.tree.0.get_or_init(|| Tree::new_from_slice(&self.coordinates).ok());
        let (Some(tree), Some(count)) = (tree, NonZero::new(self.candidates.min(self.coordinates.len())))
        else {
            return Vec::new();
        };
        let nearest = tree.query(&self.project(query)).nearest_n::<SquaredEuclidean<f32>>(count).execute();
        nearest.into_iter().map(|item| item.item).collect()
    }
}
