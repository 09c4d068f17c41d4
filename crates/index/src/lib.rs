//! The scene's descriptors made searchable: 2D-to-3D and 3D-to-3D matching.
//!
//! A [`SceneIndex`] answers one question, for one descriptor or for all descriptors of a local 3D point: which two
//! *scene points* are nearest? Two observations of one point never compete with each other, so the ratio test of the
//! paper compares places and not photographs of the same place. Which search answers the question (exact, inverted
//! lists, kd-tree) is a parameter; approximate searches measure their recall when they are built and carry it along.
//!
//! The index is self-contained: it holds positions, covisibility and what guided matching needs of every
//! observation, so no features and no reconstruction have to be kept beside it. It knows no poses of queries.
//!
//! [`images_alike`] tells, before there is a scene, which of many images are worth comparing at all.

pub mod bytes;
mod kernel;
mod matching;
mod nearest;
mod params;
mod retrieval;
mod scene_index;
mod search;

pub use kernel::squared_distances;
pub use matching::{Correspondence, LocalDescriptors, PointCorrespondence};
pub use nearest::{NearestPoints, Neighbour};
pub use params::{Backend, IndexParams};
pub use retrieval::images_alike;
pub use scene_index::{IndexGrowth, Row, SceneIndex};

/// Version of the index's contents; bumped whenever equal inputs give another index.
///
/// 1: exact, inverted lists, kd-tree over eight principal components. 2: covariances of aligned points. 3: one index for
/// each component of a scene.
pub const VERSION: u32 = 3;
