//! Pixels of photos and of the scene's images.

use std::fmt;
use std::sync::Arc;

use setloc_features::ImagePyramid;
use setloc_sfm::ImageId;

/// Whose pixels are asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Picture {
    /// A photo, by its index.
    Photo(usize),
    /// An image of a component of the scene.
    Scene {
        /// The component.
        component: usize,
        /// The image.
        image: ImageId,
    },
}

type Source = dyn Fn(Picture) -> Option<Arc<ImagePyramid>> + Send + Sync;

/// Where the pixels of photos and of the scene's images come from, if they are at hand.
#[derive(Clone, Default)]
pub struct Pictures(Option<Arc<Source>>);

impl Pictures {
    /// Pixels that are read when they are asked for: `None` where they are not at hand.
    pub fn new(source: impl Fn(Picture) -> Option<Arc<ImagePyramid>> + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(source)))
    }

    /// Whether any may be at hand.
    pub fn are_some(&self) -> bool {
        self.0.is_some()
    }

    /// The pixels of one of them.
    pub fn get(&self, picture: Picture) -> Option<Arc<ImagePyramid>> {
        self.0.as_ref().and_then(|source| source(picture))
    }
}

impl fmt::Debug for Pictures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.are_some() { "Pictures(..)" } else { "Pictures(none)" })
    }
}
