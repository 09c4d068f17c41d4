//! The stages as the jobs call them: one place that knows how the crates' functions are named.

use std::path::Path;

use anyhow::Result;
use setloc_town::TownParams;

pub use setloc_features::{
    DecodeLimits, DecodedImage, FeatureParams, ImageInfo, ImagePyramid, Mask, MatchParams, Posture, decode,
    decode_grey, extract, extract_simulated_views, guess_camera, match_features, match_simulated_views,
    probe, upright_camera,
};

/// Version of decoding and extraction; part of the fingerprint of `features` jobs.
pub const FEATURES_VERSION: u32 = FeatureParams::VERSION;
/// Version of matching.
pub const MATCHING_VERSION: u32 = MatchParams::VERSION;
/// Version of the comparison of all images by their strongest keypoints, and of the matching in it.
pub const CARRIED_VERSION: u32 = setloc_features::CarriedCells::VERSION;
/// Version of the stage.
pub const LIKELY_VERSION: u32 = 1000 * MATCHING_VERSION + 4;
/// Version of what is said of a model's components.
///
/// 2: of images that have features.
pub const LEFT_APART_VERSION: u32 = 2;
/// Version of two-view verification.
pub const VERIFY_VERSION: u32 = setloc_sfm::TWO_VIEW_VERSION;
/// Version of focal lengths by turns on the spot.
pub const TURNED_VERSION: u32 = 1;
/// Version of mapping, and of the guided matching and verification in it.
pub const MAPPER_VERSION: u32 =
    100_000 * VERIFY_VERSION + 1000 * setloc_features::GuidedParams::VERSION + setloc_sfm::MAPPER_VERSION;
/// Version of the alignment of tracks.
pub const ALIGNMENT_VERSION: u32 = setloc_sfm::ALIGNMENT_VERSION;
/// Version of indexing.
pub const INDEX_VERSION: u32 = setloc_index::VERSION;
/// Version of the scene file's making.
///
/// 2: holds the hash of what localization depends on, and only the configuration that the scene depends on.
/// 4: notes. 6: models state lengths that their points do not tell. 7: and the poses at
/// their ends. 8: holds features of its images. 9: half as many.
/// 10: says which images it has grown by. 11: an index for each component, features of all their images, and which of
/// them are placed. 12: about which images it may be folded. 13: which
/// errors its images share. 14: and how these change the stretch of panoramas. 15: adjusted in fewer steps. 16: to first order.
/// 17: what it may be off by its points' residuals, too. 18: warns of what is hardly held. 19: other signs. 20: in the hash of
/// what localization depends on. 22: says of parts joined across walls why. 23: adjusted to measured positions, too.
/// 24: panoramas twist directions, too. 25: each a little by its own. 26: says how their windows are stretched.
/// 28: in doubt where images stand together and share next to nothing. 29: and matches contradict that. 30: errors
/// that neighbouring bearings share by all verified matches. 31: cameras that are not used as they were told. 32: names the right
/// images where some have no features. 33: says what measured positions leave open of its frame.
pub const SCENE_VERSION: u32 = 33;
/// Version of the search for the scene points nearest to a photo's features.
pub const NEAREST_VERSION: u32 = setloc_index::VERSION;
/// Version of single-photo localization.
pub const SINGLE_VERSION: u32 = setloc_camset::VERSION;
/// Version of set localization, and of the matching and verification of photos with the scene's images in it.
pub const CAMSET_VERSION: u32 = 100_000 * VERIFY_VERSION + 1000 * MATCHING_VERSION + setloc_camset::VERSION;
/// Version of the growth of scenes.
pub const GROW_VERSION: u32 = setloc_camset::GROWTH_VERSION;
/// Version of the file of a scene that has grown.
pub const GROWN_VERSION: u32 = 100_000 * GROW_VERSION + 1000 * INDEX_VERSION + SCENE_VERSION;

/// JPEG quality of the sample town.
const SAMPLE_QUALITY: u8 = 92;

/// Renders the sample town as a data set.
///
/// # Errors
/// When the folder cannot be written.
pub fn write_sample(folder: &Path) -> Result<()> {
    Ok(setloc_town::write_dataset(folder, &TownParams::default(), SAMPLE_QUALITY)?)
}
