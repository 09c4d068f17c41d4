//! Mapping on synthetic and rendered places with exact truth.

mod alignment;
mod continuation;
mod ground;
mod mapper;
mod repeated_floor;
mod walls;
