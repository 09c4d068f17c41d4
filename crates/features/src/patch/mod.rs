//! Small patches of images, aligned with one another to a fraction of a pixel.

mod alignment;
mod pyramid;

pub use alignment::{Aligned, Patch, PatchFrame, PatchParams, Template};
pub use pyramid::ImagePyramid;
