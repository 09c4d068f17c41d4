use serde::{Deserialize, Serialize};

/// How nearest descriptors are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Backend {
    /// `exact` for small scenes, `inverted` for large ones; see [`IndexParams::exact_below`].
    #[default]
    Auto,
    /// Blocked brute force over integer dot products.
    Exact,
    /// Inverted lists of a k-means quantizer; as many lists are visited as the wanted recall needs.
    Inverted,
    /// The paper's kd-tree: `kiddo` over the eight first principal components, candidates re-ranked exactly.
    Kiddo,
}

/// How to index a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IndexParams {
    /// Which search to use.
    pub backend: Backend,
    /// `auto` searches exactly below this number of descriptors; above, inverted lists are many times faster.
    pub exact_below: usize,
    /// Share of the exact two nearest points that an approximate search has to find (the paper asks for 0.95).
    pub target_recall: f64,
    /// Number of queries, taken from the scene's own descriptors, on which recall is measured.
    pub recall_queries: usize,
    /// Largest number of candidates that the kd-tree re-ranks for one query.
    pub max_candidates: usize,
    /// Seed of the quantizer and of the choice of recall queries.
    pub seed: u64,
}

impl Default for IndexParams {
    fn default() -> Self {
        Self {
            backend: Backend::Auto,
            exact_below: 20_000,
            target_recall: 0.98,
            recall_queries: 500,
            max_candidates: 1024,
            seed: 0,
        }
    }
}
