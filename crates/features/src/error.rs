/// What can go wrong between image bytes and features.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FeatureError {
    /// The camera description is not usable.
    #[error("camera {model}: {reason}")]
    InvalidCamera {
        /// COLMAP's name of the model.
        model: &'static str,
        /// What is wrong, with the value.
        reason: String,
    },
}
