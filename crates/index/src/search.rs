//! The searches: each yields, for one query descriptor, the rows worth comparing.

mod exact;
mod inverted;
mod kd_tree;

pub(crate) use exact::nearest_exact;
pub(crate) use inverted::{InvertedLists, descriptor};
pub(crate) use kd_tree::PrincipalTree;

use serde::{Deserialize, Serialize};

/// The search an index was built with.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) enum Search {
    /// All rows are compared.
    #[default]
    Exact,
    /// Rows are ordered by list; some lists are compared.
    Inverted(InvertedLists),
    /// The nearest rows in the space of the principal components are compared.
    Kiddo(PrincipalTree),
}
