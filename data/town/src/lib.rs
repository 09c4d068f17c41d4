//! A small procedural town, ray-cast into panoramas and photos with exact truth.
//!
//! [`Town`] is the sample the demo and the whole-pipeline tests run on: a street of textured façades seen by
//! equirectangular panoramas under one light, and a set of photos under another light that begins beside the panoramas
//! and turns into a lane whose façades no panorama sees. The crate knows nothing of features, matching or poses
//! beyond its own truth.
//!
//! The one decision: geometry is analytic (boxes, prisms, cylinders in a bounding volume hierarchy; windows are
//! recesses cut into façade planes), and texture is a function of the place on the surface *and* of the pixel's
//! footprint there. So a view needs no mesh, no texture files and no memory to speak of, distant texture fades out
//! rather than aliasing, and a sample of any size follows from a seed.
//!
//! World frame: east, north, up in metres. Camera frame: x right, y down, z forward.

mod bvh;
mod dataset;
mod error;
mod facade;
mod geometry;
mod layout;
mod light;
mod material;
mod noise;
mod params;
mod render;
mod town;

pub use dataset::{PHOTO_SET, write_dataset};
pub use error::TownError;
pub use params::{TownParams, VERSION};
pub use render::RenderedView;
pub use town::{Town, View};
