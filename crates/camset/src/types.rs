use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};
use setloc_features::{Calibration, Camera, ImageFeatures};
use setloc_index::{NearestPoints, SceneIndex};
use setloc_sfm::{
    ImageId, ModelErrors, OutvotedPair, PairGeometry, PointId, Reconstruction, Rigid, Similarity,
};

use crate::{PathToScene, Pictures, verdict::weaker};

/// One component of a built scene, borrowed.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    /// Which component of the scene it is; 0 is the largest.
    pub component: usize,
    /// Whether measured positions place it, so that its frame is that of all other components of which this is true.
    pub is_placed: bool,
    /// The component's model.
    pub reconstruction: &'a Reconstruction,
    /// Its searchable descriptors.
    pub index: &'a SceneIndex,
    /// Which of its images are photos that it has grown by; ascending, and after all others.
    pub grown: &'a [GrownImage],
    /// Images about which it may be folded ([`setloc_sfm::doubtful_images`]), or that nothing confirms
    /// ([`setloc_sfm::UnconfirmedPair`]); ascending.
    pub doubtful: &'a [ImageId],
    /// What it may be off, where that is told.
    pub errors: Option<&'a ModelErrors>,
}

impl Scene<'_> {
    /// Whether most of these points are seen by doubtful images only.
    pub(crate) fn is_doubtful(&self, points: impl Iterator<Item = PointId>) -> bool {
        if self.doubtful.is_empty() {
            return false;
        }
        let is_doubtful = |image: ImageId| self.doubtful.binary_search(&image).is_ok();
        let (mut doubtful, mut all) = (0_usize, 0_usize);
        for point in points {
            let track = self.reconstruction.points.get(point.index()).map(|point| &point.track[..]);
            all += 1;
            doubtful += usize::from(track.unwrap_or_default().iter().all(|seen| is_doubtful(seen.image)));
        }
        2 * doubtful > all
    }
}

/// Said of a photo that sees most of all what doubtful images of the scene see.
pub(crate) const DOUBTFUL: &str = "the scene may be wrong where it is, as a warning of its build says";

/// An image of the scene that is a photo localized in the scene as it was before.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GrownImage {
    /// The image.
    pub image: ImageId,
    /// Covariance of its pose, as that of a [`PhotoLocalization`].
    pub covariance: Matrix6<f64>,
    /// Median distance of the scene points that it sees, in scene units.
    pub depth: f64,
}

/// One photo to localize.
#[derive(Debug, Clone, Copy)]
pub struct QueryPhoto<'a> {
    /// Name as the user knows it.
    pub name: &'a str,
    /// Its camera.
    pub camera: &'a Camera,
    /// How well the camera's intrinsics are known.
    pub calibration: Calibration,
    /// Its features.
    pub features: &'a ImageFeatures,
}

/// What a set's photos tell of each other, and where their pixels are.
#[derive(Debug, Clone, Copy)]
pub struct LocalModels<'a> {
    /// Components of the set's reconstruction; image `i` of each is photo `i`.
    pub components: &'a [Reconstruction],
    /// Verified pairs of photos that no component holds both of: nothing tells how far these stand apart.
    pub open: &'a [PairGeometry],
    /// Verified pairs of photos that weigh against what holds each component together between them; none where it ends.
    pub outvoted: &'a [Vec<OutvotedPair>],
    /// Pixels of the photos and of the scene's images, as far as they are at hand.
    pub pictures: Option<&'a Pictures>,
}

impl<'a> From<&'a [Reconstruction]> for LocalModels<'a> {
    fn from(components: &'a [Reconstruction]) -> Self {
        Self { components, open: &[], outvoted: &[], pictures: None }
    }
}

/// The answer in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The pose is supported well enough to be used.
    Localized,
    /// There is a pose, but it may be wrong or imprecise; the reasons say why.
    Uncertain,
    /// There is no pose.
    NotLocalized,
}

impl Verdict {
    /// The better, the higher.
    pub fn rank(self) -> u8 {
        match self {
            Self::Localized => 2,
            Self::Uncertain => 1,
            Self::NotLocalized => 0,
        }
    }

    /// As people say it.
    pub fn in_words(self) -> &'static str {
        match self {
            Self::Localized => "localized",
            Self::Uncertain => "uncertain",
            Self::NotLocalized => "not localized",
        }
    }
}

/// Where one photo is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotoLocalization {
    /// Name as the user knows it.
    pub name: String,
    /// The camera, with intrinsics refined when they were not known.
    pub camera: Camera,
    /// Component of the scene in whose frame the pose is; 0 is the largest.
    pub component: usize,
    /// Pose in the component's frame, `None` when not localized.
    pub world_from_camera: Option<Rigid>,
    /// Covariance of the pose: rotation (rad, in the camera frame), then centre (scene units, in the scene frame).
    pub covariance: Option<Matrix6<f64>>,
    /// Observations of scene points that support the pose.
    pub inliers: usize,
    /// The answer in one word.
    pub verdict: Verdict,
    /// Why, in sentences.
    pub reasons: Vec<String>,
}

impl PhotoLocalization {
    /// Makes it uncertain at best, for this reason.
    pub(crate) fn doubt(&mut self, reason: String) {
        self.verdict = weaker(self.verdict, Verdict::Uncertain);
        self.reasons.push(reason);
    }

    /// The answer "not localized" in a component, for one reason.
    pub fn not_localized(photo: &QueryPhoto<'_>, component: usize, reason: impl Into<String>) -> Self {
        Self {
            name: photo.name.to_owned(),
            camera: photo.camera.clone(),
            component,
            world_from_camera: None,
            covariance: None,
            inliers: 0,
            verdict: Verdict::NotLocalized,
            reasons: vec![reason.into()],
        }
    }
}

/// A feature of a photo that shows a scene point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct SceneMatch {
    /// Index of the feature in the photo.
    pub feature: u32,
    /// The scene point.
    pub point: PointId,
}

/// Where one photo is by itself in one component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SingleAnswer {
    /// The answer.
    pub photo: PhotoLocalization,
    /// The scene points that it sees from there; empty when not localized.
    pub inliers: Vec<SceneMatch>,
}

/// Where one photo is by itself in one component, and the scene points that it was sought by.
#[derive(Debug, Clone, PartialEq)]
pub struct SingleLocalization {
    /// Where it is.
    pub answer: SingleAnswer,
    /// The scene points nearest to each of its features, wherever it is.
    pub nearest: Vec<NearestPoints>,
}

/// What a photo says of where it is in one component before it is seen with others; borrowed.
#[derive(Debug, Clone, Copy)]
pub struct PhotoEvidence<'a> {
    /// The answer by itself.
    pub photo: &'a PhotoLocalization,
    /// The scene points that it sees from there; empty when not localized.
    pub inliers: &'a [SceneMatch],
    /// The scene points nearest to each of its features, wherever it is.
    pub nearest: &'a [NearestPoints],
}

impl SingleLocalization {
    /// What it says to a set.
    pub fn evidence(&self) -> PhotoEvidence<'_> {
        self.answer.evidence(&self.nearest)
    }
}

impl SingleAnswer {
    /// What it says to a set, with the scene points that the photo was sought by.
    pub fn evidence<'a>(&'a self, nearest: &'a [NearestPoints]) -> PhotoEvidence<'a> {
        PhotoEvidence { photo: &self.photo, inliers: &self.inliers, nearest }
    }
}

/// The scene points nearest to each feature of one photo, wherever it is.
///
/// They depend on nothing but its descriptors and the scene's, so that a photo can be localized again by other parameters or
/// with another camera without another search.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct NearestAnywhere {
    /// Those of each component of the scene, the largest first; one entry a feature.
    pub components: Vec<Vec<NearestPoints>>,
}

/// Where one photo is by itself, in whichever component of the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AnywhereLocalization {
    /// The answer: that of the component which says most.
    pub photo: PhotoLocalization,
    /// What each component says, the largest first.
    pub components: Vec<SingleAnswer>,
}

/// How a local model lies in the scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlacedModel {
    /// Component of the scene; 0 is the largest.
    pub component: usize,
    /// The component's frame from the local model's.
    pub world_from_set: Similarity,
}

/// Where the photos of a set are.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SetLocalization {
    /// Pose of the rigid camera set, one entry a photo ("camset").
    pub rigid: Vec<PhotoLocalization>,
    /// Poses after the joint refinement, one entry a photo ("camset+opt").
    pub refined: Vec<PhotoLocalization>,
    /// The local models that are placed, by the scene's components.
    pub placed: Vec<PlacedModel>,
    /// Names of photos that are localized alone, but at another place than with the set: either is wrong.
    pub contradicted: Vec<String>,
    /// Names of photos that show that they were cut from larger pictures: of others of their size that is open.
    pub cut: Vec<String>,
    /// The strongest way from the scene to each photo, one entry a photo.
    pub paths: Vec<PathToScene>,
    /// What happened to each local model, the weakest links and which photo to take next, in sentences.
    pub advice: Vec<String>,
}
