//! How to build a model.

use serde::{Deserialize, Serialize};

use super::{register::Visibility, structure::PointLimits};
use crate::{
    bundle::{BundleParams, RobustLoss},
    robust::RansacParams,
};

/// How to build a model from verified pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(clippy::struct_excessive_bools, reason = "each stands for one thing that may be left out")]
pub struct MapperParams {
    /// Largest angular error of an observation, in standard deviations of its ray.
    pub max_error_sigma: f64,
    /// Smallest triangulation angle of a point, in degrees.
    pub min_triangulation_angle_deg: f64,
    /// Fewest points of an initial pair.
    pub min_initial_points: usize,
    /// Smallest median parallax of an initial pair, in degrees.
    pub min_initial_parallax_deg: f64,
    /// Initial pairs tried before a component is given up.
    pub max_initial_pairs: usize,
    /// Fewest inliers of a registration.
    pub min_registration_inliers: usize,
    /// Fewest inliers of a registration whose rotation and direction of movement a verified pair gives: the points then
    /// only have to agree on the length of the baseline.
    pub min_confirmed_inliers: usize,
    /// Smallest share of an image's 2D-to-3D matches that must agree with such a pose.
    pub min_confirmed_share: f64,
    /// Smallest share of the points in plain view that a registration must match; guards against repeated structure.
    pub min_visibility_recall: f64,
    /// Share of the directions with points in plain view in which any was matched that does as well: where all matching
    /// is poor, recall is low everywhere, but a right pose has some matches all around.
    pub min_visibility_coverage: f64,
    /// Points that must be in plain view for the recall to count.
    pub min_visible_points: usize,
    /// Fewest matches of a pure rotation that registers an image at the standpoint of another.
    pub min_turn_matches: usize,
    /// Smallest share of the keypoints that two images ought to share after a turn that must match for them to count as
    /// taken from one standpoint.
    pub min_turn_recall: f64,
    /// Rotation from a verified pair's that still counts as agreement with it, in degrees.
    pub max_pair_rotation_deg: f64,
    /// Smallest share of the verified matches to registered images whose pairs must agree with a pose's rotation.
    pub min_pair_agreement: f64,
    /// Poses tried for one image when repeated structure offers several.
    pub max_pose_hypotheses: usize,
    /// Images adjusted together with a new one.
    pub local_bundle_images: usize,
    /// Growth of the number of images that triggers an adjustment of everything.
    pub global_bundle_growth: f64,
    /// Scale of the Cauchy loss in standard deviations.
    pub loss_sigma: f64,
    /// Whether an image that shares nothing with more than one other gets the length of its baseline from planes of the
    /// model that go on. It applies to local models of photo sets only.
    pub continue_planes: bool,
    /// Whether panoramas, and parts of a place, that one pair joins get the length of that step from what lies beside what the pair
    /// shares and from the floor, where such pairs can be believed. Otherwise they stay apart.
    pub join_by_depths: bool,
    /// Whether photos are asked for the focal lengths that they are told, and have others, a percent off, where these explain
    /// the model clearly better. It applies to local models of photo sets only.
    pub correct_told: bool,
    /// Whether photos are asked for the intrinsics that they are told, and have other focal lengths and distortion where these
    /// explain the model clearly better. It applies to scenes, and with them to photos of the same cameras that are localized
    /// there; where it is on, [`Self::correct_told`] is not asked.
    pub calibrate_photos: bool,
    /// Whether panoramas are asked how their stitching stretches directions ([`CameraModel::StitchedEquirectangular`]), and
    /// have that taken out where it explains the model clearly better.
    ///
    /// [`CameraModel::StitchedEquirectangular`]: setloc_features::CameraModel::StitchedEquirectangular
    pub calibrate_panoramas: bool,
}

impl Default for MapperParams {
    fn default() -> Self {
        Self {
            max_error_sigma: 6.0,
            min_triangulation_angle_deg: 1.0,
            min_initial_points: 50,
            min_initial_parallax_deg: 3.0,
            max_initial_pairs: 30,
            min_registration_inliers: 15,
            min_confirmed_inliers: 8,
            min_confirmed_share: 0.5,
            min_visibility_recall: 0.1,
            min_visibility_coverage: 0.4,
            min_visible_points: 100,
            min_turn_matches: 20,
            min_turn_recall: 0.2,
            max_pair_rotation_deg: 8.0,
            min_pair_agreement: 0.2,
            max_pose_hypotheses: 3,
            local_bundle_images: 5,
            global_bundle_growth: 1.4,
            loss_sigma: 1.0,
            continue_planes: true,
            join_by_depths: true,
            correct_told: true,
            calibrate_photos: true,
            calibrate_panoramas: true,
        }
    }
}

impl MapperParams {
    pub(super) fn limits(&self) -> PointLimits {
        PointLimits {
            max_error_sigma: self.max_error_sigma,
            min_angle_rad: self.min_triangulation_angle_deg.to_radians(),
        }
    }

    pub(super) fn bundle(&self, max_iterations: u32) -> BundleParams {
        BundleParams { loss: RobustLoss::Cauchy(self.loss_sigma), max_iterations, ..BundleParams::default() }
    }

    pub(super) fn is_recognized(&self, seen: &Visibility) -> bool {
        seen.recall() >= self.min_visibility_recall || seen.coverage() >= self.min_visibility_coverage
    }

    pub(super) fn ransac(&self) -> RansacParams {
        RansacParams {
            max_error_sigma: self.max_error_sigma,
            min_inliers: self.min_registration_inliers,
            ..RansacParams::default()
        }
    }
}
