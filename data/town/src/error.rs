use std::path::PathBuf;

/// What can go wrong between parameters and a rendered data set.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TownError {
    /// A parameter is outside its range.
    #[error("{name} = {value} is outside {allowed}")]
    InvalidParameter {
        /// The field of [`crate::TownParams`].
        name: &'static str,
        /// Its value as given.
        value: String,
        /// The allowed range, in words.
        allowed: &'static str,
    },
    /// A view index beyond the last view.
    #[error("view {index} of a town with {count} views")]
    NoSuchView {
        /// The index asked for.
        index: usize,
        /// How many views there are.
        count: usize,
    },
    /// A camera of the town is not a valid one.
    #[error("camera of the town")]
    Camera(#[from] setloc_features::FeatureError),
    /// A file of the data set could not be written.
    #[error("writing {}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// An image could not be encoded.
    #[error("encoding {name}")]
    Encode {
        /// The view's name.
        name: String,
        /// The encoder's reason.
        source: image::ImageError,
    },
}
