mod rigid;
mod similarity;

pub use rigid::Rigid;
pub use similarity::{Similarity, nearest_rotation};
