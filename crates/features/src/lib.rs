//! Images in; keypoints, descriptors, *rays* and pair matches out.
//!
//! Everything downstream works on unit rays on the sphere, so panoramas, fisheye and rectilinear photos live in one
//! problem. This crate owns the camera models (κ and κ⁻¹ of the paper), detection and description, and the
//! two-nearest-neighbour matching of two images. It knows nothing of poses, files or caches: images come as bytes.
//!
//! | step | call | what it settles |
//! |---|---|---|
//! | header | [`probe`] | upright size, EXIF, GPS, GPano, without decoding pixels |
//! | camera | [`guess_camera`], [`Camera`] | pixel ↔ ray with Jacobians; where the guess comes from is said |
//! | pixels | [`decode`] | upright RGB; broken or oversized files are errors, never grey pixels |
//! | features | [`extract`] | SIFT → RootSIFT bytes, closed over a panorama's seam, spread over the sphere |
//! | rays | [`ImageFeatures::rays`] | unit bearings with angular standard deviations |
//! | matches | [`match_features`], [`match_guided`] | exact two nearest neighbours; along epipolar circles once a pose is known |
//! | neighbours | [`NearbyKeypoints`] | keypoints near a direction of the sphere |
//! | patches | [`Template::align`] | one place in two images, to a fraction of a pixel |
//!
//! Conventions: camera frame x right, y down, z forward; the centre of the first pixel is (0.5, 0.5); radians inside,
//! parameters in degrees or pixels say so in their names.
//!
//! The one big decision is that descriptors are *bytes of one common length*. Squared distances then are exact
//! integers, a matrix product away, and the same on every processor: matching runs near the machine's arithmetic peak
//! and gives identical matches with AVX-512, AVX2 or neither ([`DescriptorBlock`]).
//!
//! ```
//! use setloc_features::{
//!     DecodedImage, FeatureParams, ImageInfo, MatchParams, Posture, extract, guess_camera, match_features,
//! };
//!
//! # fn main() -> Result<(), setloc_features::FeatureError> {
//! let rgb = (0..256 * 128 * 3).map(|i: u32| ((i / 3 % 256 / 9 * 37) ^ (i / 768 / 7 * 91)) as u8).collect();
//! let image = DecodedImage::from_rgb(256, 128, rgb)?;
//! let info = ImageInfo { width: 256, height: 128, metadata: image.metadata.clone() };
//! let (camera, source) = guess_camera(&info);
//! assert_eq!(source.to_string(), "panorama by its 2:1 aspect ratio");
//! // Without the oblique views that are simulated where keypoints are few.
//! let params = FeatureParams { faint_tilt: 1.0, ..FeatureParams::default() };
//! let features = extract(&params, &image, &camera, None)?;
//! let rays = features.rays(&camera);
//! assert_eq!(rays.bearings.len(), features.len());
//! let matches = match_features(&MatchParams::default(), Posture::of([&camera; 2]), &features, &features);
//! assert!(matches.iter().all(|found| found.first == found.second));
//! # Ok(())
//! # }
//! ```

mod camera;
mod decode;
mod error;
mod extract;
mod features;
mod geodesy;
mod grey;
mod mask;
mod matching;
mod nearby;
mod patch;
mod sift;
pub mod vectorized;

pub use camera::{
    Calibration, Camera, CameraModel, MAX_CAMERA_PARAMS, ParamRole, PlainRay, ProjectJacobian,
    UnprojectJacobian,
};
pub use decode::{
    CameraSource, DecodeLimits, DecodedImage, GPano, GeoPosition, ImageInfo, ImageMetadata, decode,
    decode_grey, fallback_camera, guess_camera, probe, upright_camera,
};
pub use error::FeatureError;
pub use extract::{FeatureParams, extract, extract_simulated_views, keypoint_noise_px};
pub use features::{DESCRIPTOR_LEN, DESCRIPTOR_NORM, ImageFeatures, Keypoint, Rays, SimulatedView};
pub use geodesy::Wgs84;
pub use grey::GreyImage;
pub use mask::Mask;
pub use matching::{
    CarriedCells, ComparedPhoto, DescriptorBlock, Elevations, GuidedParams, Match, MatchParams, Posture,
    TwoNearest, match_features, match_guided, match_guided_among, match_simulated_views, offer_nearer,
    squared_distance, squared_norm, two_nearest, without_carried, without_carried_cells,
};
pub use nearby::NearbyKeypoints;
pub use patch::{Aligned, ImagePyramid, Patch, PatchFrame, PatchParams, Template};
