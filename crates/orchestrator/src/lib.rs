//! Job graph, content-hash cache, command line, benchmark harness, import and export.
//!
//! The stages of the crates below are pure functions; this crate is the only one that touches files, processes and
//! the terminal. Its one decision: the key of a job is the hash of a readable [`fingerprint::Fingerprint`] over the
//! *content* of its inputs. So an unchanged output stops a re-run downstream, a renamed or touched file re-runs
//! nothing, and "why did this run?" is a comparison of two small JSON texts.

pub mod artifacts;
pub mod bench;
pub mod building;
pub mod cli;
pub mod clock;
pub mod codec;
mod colmap;
pub mod config;
pub mod dataset;
pub mod digest;
pub mod error;
pub mod export;
pub mod fingerprint;
pub mod graph;
pub mod html;
pub mod import;
pub mod jobs;
pub mod locating;
pub mod manifest;
pub mod pictures;
pub mod plot;
pub mod print;
pub mod scene;
pub mod session;
pub mod sources;
pub mod stages;
pub mod store;
pub mod subscribers;
pub mod text;
pub mod turning;
