//! Minimal and linear solvers, one per file: algebra only, no sampling and no scoring.
