use serde::{Deserialize, Serialize};

use crate::ViewParams;

/// When a pose may be called localized.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VerdictParams {
    /// Fewest inliers of any pose; fewer is `not_localized` (12 in Sattler et al., ICCV 2011, and in the paper).
    pub min_inliers: usize,
    /// Fewest occupied cells when the image is cut into 8 × 8; inliers in one corner do not fix a pose.
    pub min_cells: usize,
    /// Largest log₁₀ of the expected number of equally good poses among random matches (a-contrario).
    pub max_log10_false_alarms: f64,
    /// Largest support of another, distinct pose, as a share of the support of the one chosen.
    pub max_runner_up: f64,
    /// Largest standard deviation of the centre along its worst axis, as a share of the distance to what it sees.
    pub max_center_sigma: f64,
    /// Largest standard deviation of the rotation about its worst axis, in radians: 0.4°, for 1° with 95 % probability.
    pub max_rotation_sigma_rad: f64,
    /// Fewest observations on the weakest link between the scene and a photo of a set.
    pub min_link: usize,
}

impl Default for VerdictParams {
    fn default() -> Self {
        Self {
            min_inliers: 12,
            min_cells: 5,
            max_log10_false_alarms: -6.0,
            max_runner_up: 0.5,
            max_center_sigma: 0.02,
            max_rotation_sigma_rad: 0.007,
            min_link: 12,
        }
    }
}

/// How scene points are searched for in a photo whose pose is (nearly) known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GuidedParams {
    /// Search radius around the projection in pixels of the photo.
    pub radius_px: f64,
    /// Largest angle between the photo's and some scene image's view of the point, in radians.
    pub max_view_angle_rad: f64,
    /// Largest factor between the expected and the found keypoint size.
    pub max_scale_factor: f64,
    /// A feature may be this factor farther from the point (in descriptor distance) than from its nearest point.
    pub slack: f64,
    /// Distance ratio to the second-best feature within the search radius.
    pub ratio: f64,
}

impl Default for GuidedParams {
    fn default() -> Self {
        Self { radius_px: 8.0, max_view_angle_rad: 1.05, max_scale_factor: 2.5, slack: 1.1, ratio: 0.9 }
    }
}

/// How to localize one photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SingleParams {
    /// Distance ratio of the two nearest scene points.
    pub ratio: f64,
    /// Largest angular error of an inlier, in standard deviations.
    pub max_error_sigmas: f64,
    /// Besides all matches, those of this many best-supported scene images are tried by themselves.
    pub covisible_images: usize,
    /// Most samples that RANSAC draws for one hypothesis; fewer give up earlier on photos of other places.
    pub max_samples: u32,
    /// Whether intrinsics that are told are replaced where the photo clearly shows others.
    pub check_intrinsics: bool,
    /// Search around projections once a pose is known.
    pub guided: GuidedParams,
    /// When the pose may be used.
    pub verdict: VerdictParams,
}

impl Default for SingleParams {
    fn default() -> Self {
        Self {
            ratio: 0.8,
            max_error_sigmas: 4.0,
            covisible_images: 3,
            max_samples: 10_000,
            check_intrinsics: true,
            guided: GuidedParams::default(),
            verdict: VerdictParams::default(),
        }
    }
}

/// How the pose of the rigid camera set is solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CamsetMethod {
    /// Minimal generalized pose and scale in LO-RANSAC.
    #[default]
    Gp4ps,
    /// The paper's: direct linear transformation on six rays, RQ, mean diagonal as scale, Levenberg–Marquardt.
    Dlt,
}

/// How to localize an image set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CamsetParams {
    /// Solver of the rigid pose.
    pub method: CamsetMethod,
    /// Whether poses that photos alone, their local points' depths and the scene's images suggest compete with the
    /// solver's; the paper has none.
    pub other_hypotheses: bool,
    /// Distance ratio of the two scene points nearest to a local point (the paper: 0.6).
    pub ratio: f64,
    /// Distance ratio of the two local points nearest to a scene point (the paper: 0.6).
    pub reverse_ratio: f64,
    /// Whether features without a local point join as evidence.
    pub lone_rays: bool,
    /// How far drift of the local model may move a projection under the rigid pose, in pixels.
    pub drift_px: f64,
    /// Rounds of guided matching and joint refinement.
    pub rounds: usize,
    /// Largest angular error of an inlier of the joint refinement, in standard deviations.
    pub max_error_sigmas: f64,
    /// Search around projections once poses are known.
    pub guided: GuidedParams,
    /// Matching with the scene's images beside its points, for photos that these do not localize.
    pub views: ViewParams,
    /// Whether a scale that nothing else tells is sought by the walls that photos and scene show, where their pixels are at
    /// hand.
    pub scale_by_walls: bool,
    /// When poses may be used.
    pub verdict: VerdictParams,
}

impl Default for CamsetParams {
    fn default() -> Self {
        Self {
            method: CamsetMethod::Gp4ps,
            other_hypotheses: true,
            ratio: 0.8,
            reverse_ratio: 0.9,
            lone_rays: true,
            drift_px: 8.0,
            rounds: 3,
            max_error_sigmas: 4.0,
            guided: GuidedParams::default(),
            views: ViewParams::default(),
            scale_by_walls: true,
            verdict: VerdictParams::default(),
        }
    }
}

impl CamsetParams {
    /// The paper's settings: DLT and no other hypotheses, both ratios 0.6, neither lone rays nor the scene's images,
    /// nor its walls.
    pub fn paper() -> Self {
        Self {
            method: CamsetMethod::Dlt,
            other_hypotheses: false,
            ratio: 0.6,
            reverse_ratio: 0.6,
            lone_rays: false,
            views: ViewParams { max_images: 0, ..ViewParams::default() },
            scale_by_walls: false,
            ..Self::default()
        }
    }
}
