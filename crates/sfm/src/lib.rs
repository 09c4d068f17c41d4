//! Structure from motion on the sphere.
//!
//! Two-view geometry, triangulation, absolute and generalized pose, robust estimation, sparse bundle adjustment and
//! the incremental mapper, all on unit rays: no pixel, no image plane and no seam exists here. The same code builds
//! the scene from panoramas and the local model from the photos of a set.

pub mod bundle;
mod geometry;
mod mapper;
mod reconstruction;
pub mod robust;
pub mod solvers;
pub mod synthetic;
mod two_view;

pub use geometry::{Rigid, Similarity};
pub use mapper::{InputImage, MapperInput, MapperOutput, MapperParams, MapperReport, reconstruct};
pub use reconstruction::{CameraId, ImageId, Observation, PointId, Reconstruction, ReconstructionImage, ReconstructionPoint};
pub use two_view::{PairGeometry, TwoView, TwoViewKind, TwoViewParams, verify_pair};
