//! The job graph: what depends on what, run on all cores, with results from the store where they are known.

mod events;
mod executor;
mod gathering;
mod job;
mod plan;

pub use events::{Broadcast, Event, Observer};
pub use executor::{Executor, RunOptions, RunResult, State};
pub use job::{Inputs, Job, JobGraph, JobId, Product};
pub use plan::{PlannedJob, Prediction};
