//! What a build or a localization came to, read back from its output folder, for people.

mod read;
mod show;

use crate::dataset::SkippedImage;
use crate::subscribers::StageReport;

/// The results in one output folder.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Digest {
    /// What it is of.
    pub title: String,
    /// The one sentence that matters.
    pub headline: String,
    /// What looks wrong or weak.
    pub warnings: Vec<String>,
    /// What is worth knowing: parts that were joined, what the index misses.
    pub notes: Vec<String>,
    /// What to do better.
    pub advice: Vec<String>,
    /// One row an image.
    pub images: Vec<ImageRow>,
    /// Images that could not be used.
    pub skipped: Vec<SkippedImage>,
    /// What each stage cost.
    pub stages: Vec<StageReport>,
    /// The picture from above (PNG), when it is there.
    pub top_view: Option<Vec<u8>>,
}

/// How an image fared.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageRow {
    /// Its name.
    pub name: String,
    /// How far it may be used.
    pub standing: Standing,
    /// The verdict in words.
    pub verdict: String,
    /// What speaks for it: matches, observations, precision.
    pub evidence: String,
    /// Why the verdict is what it is.
    pub reasons: Vec<String>,
    /// Whether it is the target.
    pub is_target: bool,
}

/// How far an image's pose may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Standing {
    /// It may.
    Good,
    /// With care.
    Weak,
    /// There is none.
    Bad,
}
