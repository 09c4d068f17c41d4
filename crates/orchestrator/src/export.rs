//! Scenes and poses as files that people and other programs read.

mod colmap;
mod geographic;
mod geojson;
mod kml;
mod nerfstudio;
mod ply;
mod poses;
mod top_view;

pub use colmap::{colmap_lacks, error_px, remove_colmap, renew_colmap, write_colmap};
pub use geojson::geojson;
pub use kml::kml;
pub use nerfstudio::nerfstudio;
pub use ply::ply;
pub use poses::{
    localization_json, localizations_json, origin_json, pose_json, scene_images_json, scene_json,
    stated_sigma,
};
pub use top_view::{Marker, top_view_png};
