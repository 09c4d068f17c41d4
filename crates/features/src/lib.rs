//! Images in; keypoints, descriptors, *rays* and pair matches out.
//!
//! Everything downstream works on unit rays on the sphere, so panoramas, fisheye and rectilinear photos live in one
//! problem. This crate owns the camera models (κ and κ⁻¹ of the paper), detection and description, and the
//! two-nearest-neighbour matching of two images. It knows nothing of poses, files or caches.

mod camera;
mod error;
mod features;
mod matching;

pub use camera::{Camera, CameraModel, MAX_CAMERA_PARAMS, ParamRole, ProjectJacobian, UnprojectJacobian};
pub use error::FeatureError;
pub use features::{DESCRIPTOR_LEN, DESCRIPTOR_NORM, ImageFeatures, Keypoint, Rays};
pub use matching::{
    DescriptorBlock, GuidedParams, Match, MatchParams, TwoNearest, match_features, match_guided, two_nearest,
};
