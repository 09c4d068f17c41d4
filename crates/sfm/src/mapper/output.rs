//! What comes of mapping, and what happened.

use serde::{Deserialize, Serialize};
use setloc_features::Camera;

use super::{MergeRecord, register::Visibility};
use crate::{
    CameraId, Georegistration, ImageId, OutvotedPair, PairGeometry, Reconstruction, SuspiciousNeighbours,
};

/// How one image entered the model, or why it did not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegistrationRecord {
    /// The image.
    pub image: ImageId,
    /// Whether the pose was accepted.
    pub accepted: bool,
    /// 2D-to-3D matches offered by the verified pairs.
    pub candidates: usize,
    /// Those that agree with the pose.
    pub inliers: usize,
    /// Points in plain view of the pose.
    pub expected: usize,
    /// Those of them that were matched.
    pub matched: usize,
    /// Directions with points in plain view.
    pub expected_cells: usize,
    /// Directions among them in which any was matched.
    pub matched_cells: usize,
}

impl RegistrationRecord {
    pub(super) fn new(
        image: ImageId,
        accepted: bool,
        [candidates, inliers]: [usize; 2],
        seen: &Visibility,
    ) -> Self {
        Self {
            image,
            accepted,
            candidates,
            inliers,
            expected: seen.expected,
            matched: seen.matched,
            expected_cells: seen.expected_cells,
            matched_cells: seen.matched_cells,
        }
    }
}

/// What happened, for people.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapperReport {
    /// Registrations in the order tried.
    pub registrations: Vec<RegistrationRecord>,
    /// Attempts to join components in the order tried.
    pub merges: Vec<MergeRecord>,
    /// How each component lies in the measured frame, when positions were given and fix it.
    pub georegistrations: Vec<Option<Georegistration>>,
    /// Things that disagree, in words.
    pub warnings: Vec<String>,
    /// Guessed cameras that the images that were given each seem not to share.
    pub doubtful: Vec<CameraId>,
}

/// A camera whose told intrinsics its images contradict.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CorrectedCamera {
    /// As it was told.
    pub told: Camera,
    /// As its images show it, and as it is used.
    pub used: Camera,
}

/// Components, largest first, and the report.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapperOutput {
    /// Connected components, largest first.
    ///
    /// Where images cannot share the camera that they were given as one, those at the end of the list of cameras are of
    /// some of them.
    pub components: Vec<Reconstruction>,
    /// Verified pairs of images that no component holds both of.
    pub open_pairs: Vec<PairGeometry>,
    /// Pairs that weigh against what holds each component together there; none is known of components beyond the end.
    pub outvoted: Vec<Vec<OutvotedPair>>,
    /// Images of each component that stand together and share nothing; none is known of components beyond the end.
    pub suspicious: Vec<Vec<SuspiciousNeighbours>>,
    /// Cameras that are not used as they were told.
    pub corrected: Vec<CorrectedCamera>,
    /// What happened.
    pub report: MapperReport,
}

impl MapperOutput {
    /// Those of some pairs whose images no component holds both of.
    pub fn open_among(&self, pairs: &[PairGeometry]) -> Vec<PairGeometry> {
        let is_open = |pair: &&PairGeometry| {
            let first = self.component_of(pair.first);
            first.is_none() || first != self.component_of(pair.second)
        };
        pairs.iter().filter(is_open).cloned().collect()
    }

    /// Those of some pairs that are of an image of a component and one of none.
    pub fn waiting_among(&self, pairs: &[PairGeometry]) -> Vec<PairGeometry> {
        let is_registered = |image: ImageId| self.component_of(image).is_some();
        let waits = |pair: &&PairGeometry| is_registered(pair.first) != is_registered(pair.second);
        pairs.iter().filter(waits).cloned().collect()
    }

    /// The first component that an image is registered in.
    fn component_of(&self, image: ImageId) -> Option<usize> {
        let holds = |model: &Reconstruction| {
            model.images.get(image.index()).is_some_and(|image| image.world_from_camera.is_some())
        };
        self.components.iter().position(holds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ReconstructionImage, Rigid, TwoView};

    #[test]
    fn pairs_that_no_component_holds_both_images_of_are_open() {
        let component = |registered: [bool; 4]| Reconstruction {
            cameras: vec![Camera::equirectangular(200, 100)],
            images: registered
                .map(|is_registered| ReconstructionImage {
                    name: String::new(),
                    camera: CameraId(0),
                    world_from_camera: is_registered.then(Rigid::identity),
                })
                .to_vec(),
            points: Vec::new(),
            lengths: Vec::new(),
        };
        let components = vec![component([true, true, false, false]), component([false, false, true, false])];
        let output = MapperOutput { components, ..MapperOutput::default() };
        let two_view = TwoView::of_equal_features(Rigid::identity(), 0..0);
        let pair = |(first, second)| PairGeometry {
            first: ImageId(first),
            second: ImageId(second),
            two_view: two_view.clone(),
        };
        let pairs = [(0, 1), (1, 2), (3, 0), (2, 3), (3, 9)].map(pair);
        let ends = |pairs: Vec<PairGeometry>| {
            pairs.iter().map(|pair| (pair.first.0, pair.second.0)).collect::<Vec<_>>()
        };
        assert_eq!(ends(output.open_among(&pairs)), [(1, 2), (3, 0), (2, 3), (3, 9)]);
        // The third image has a place already, if in another component.
        assert_eq!(ends(output.waiting_among(&pairs)), [(3, 0), (2, 3)]);
    }
}
