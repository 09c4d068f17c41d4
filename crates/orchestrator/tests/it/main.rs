//! The program and the library as a whole: one binary, which compiles in a fraction of the time of one for each file.

#![allow(clippy::unwrap_used, reason = "the helpers of tests, too, may fail by panicking")]

mod bad_input;
mod batch;
mod bench;
mod cache;
mod calibration;
mod cli;
mod common;
mod components;
mod disk;
mod stopping;
