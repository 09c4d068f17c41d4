//! Robust estimators: LO-RANSAC over the minimal solvers, scored on the sphere.
