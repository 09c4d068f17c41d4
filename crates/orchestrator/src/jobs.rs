//! The job kinds and how they depend on each other.

mod accuracy;
mod alignment;
mod carried;
mod features;
mod grow;
mod likely;
mod locate;
mod matching;
mod model;
mod notes;
mod pairs;
mod pixels;
mod positions;
mod scene;
mod scene_file;

pub use carried::said_of_carried;
pub use features::{Looks, add_features_of, features_role};
pub use grow::{GROWN_KIND, LocatedJobs, SCENE_INPUT, add_grown};
pub use likely::LikelyJobs;
pub use locate::{LocateJobs, SetJobs, SingleJobs, add_set, add_singles};
pub use matching::{PairSource, add_turned};
pub use model::{ModelJobs, ModelKind, add_model, divided_guesses};
pub use pairs::choose_pairs;
pub use positions::how_fixed;
pub use scene::{
    ApartJob, SCENE_KIND, SceneInputs, SceneJobs, SceneModelJobs, add_first_model, add_model_apart, add_scene,
};

use crate::fingerprint::ContentHash;

/// A seed of its own for each use, the same whatever else is in the run.
fn derived_seed(seed: u64, parts: &[&str]) -> u64 {
    ContentHash::of(format!("{seed}/{}", parts.join("/")).as_bytes()).seed()
}
