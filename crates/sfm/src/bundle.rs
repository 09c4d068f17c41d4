//! Sparse bundle adjustment on the sphere.
