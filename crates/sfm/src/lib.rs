//! Structure from motion on the sphere.
//!
//! Two-view geometry, triangulation, absolute and generalized pose, robust estimation, sparse bundle adjustment and
//! the incremental mapper, all on unit rays: no pixel, no image plane and no seam exists here, but for [`align_tracks`],
//! which goes back to the images. The same code builds the scene from panoramas and the local model from the photos of
//! a set.

mod alignment;
pub mod bundle;
mod common_views;
mod direction;
mod estranged;
mod frame_errors;
mod geometry;
mod georegister;
mod ground;
mod listing;
mod mapper;
mod model_errors;
mod quality;
mod reconstruction;
pub mod robust;
pub mod solvers;
mod surfaces;
pub mod synthetic;
mod two_view;
mod unconfirmed;
mod visibility;
mod walls;

pub use alignment::{ALIGNMENT_VERSION, AlignmentParams, AlignmentReport, KnownOfComponent, align_tracks};
pub use frame_errors::FrameErrors;
pub use geometry::{Rigid, Similarity, nearest_rotation};
pub use georegister::{GeoregisterParams, Georegistration, MeasuredPosition, MeasuredPositions, georegister};
pub use ground::{register_by_ground, sharpen_lengths};
pub use listing::{MOST_NAMED, listed};
pub use mapper::{
    CorrectedCamera, InputImage, MAPPER_VERSION, MapperInput, MapperOutput, MapperParams, MapperReport,
    MergeRecord, MergeVerdict, Mosaic, PutativePair, Recognition, RegistrationRecord, pairs_underfoot,
    reconstruct,
};
pub use model_errors::{BearingField, ModelErrors, PoseDeviation, shared_sigma_of_matches};
pub use quality::{
    OutvotedPair, PairDisagreement, QualityParams, QualityReport, SuspiciousNeighbours, assess,
    doubtful_images,
};
pub use reconstruction::{
    AlignedTrack, BaselineLength, CameraId, ImageId, Observation, Place, PointId, Reconstruction,
    ReconstructionImage, ReconstructionPoint, StepPose,
};
pub use surfaces::{Likeness, PlacedPhoto, SurfacePlace, likeness_of, places_on_surfaces};
pub use two_view::{PairGeometry, TWO_VIEW_VERSION, TwoView, TwoViewKind, TwoViewParams, verify_pair};
pub use unconfirmed::UnconfirmedPair;
pub use walls::{DistantPhoto, ScaleByWalls, WallSight, scale_by_walls};
