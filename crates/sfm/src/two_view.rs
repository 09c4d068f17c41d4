//! Verification of putative matches between two images on the sphere.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use setloc_features::{Match, Posture, Rays};

use crate::{
    ImageId, Rigid,
    robust::{
        RansacParams, estimate_level_pose, estimate_relative_pose, estimate_rotation, estimate_turned_pose,
    },
};

/// Bumped when equal inputs and parameters give another geometry.
pub const TWO_VIEW_VERSION: u32 = 4;

/// How to verify a pair.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TwoViewParams {
    /// Fewest inliers of a verified pair.
    pub min_inliers: usize,
    /// Largest tangent Sampson error of an inlier, in standard deviations.
    pub max_error_sigma: f64,
    /// Median parallax below which a pair counts as a pure rotation, in degrees.
    pub min_parallax_deg: f64,
    /// Share of the inliers that a rotation alone must explain for the pair to count as one.
    pub rotation_share: f64,
    /// Where a rotation explains most of the inliers: the share of the matches it leaves over that a baseline must
    /// explain for the pair not to count as a rotation. Chance alone reaches a tenth.
    pub min_baseline_share: f64,
    /// Most samples of five drawn for one geometry; below a third of inliers a pair is worth little to the mapper.
    pub max_iterations: u32,
    /// Most samples of three drawn before for one geometry of two panoramas, which stand about upright.
    pub max_upright_iterations: u32,
    /// Most samples of five drawn after these, for panoramas that stand tilted.
    pub max_tilted_iterations: u32,
    /// Most geometries of one pair.
    pub max_geometries: usize,
    /// Inliers of a further geometry, as a share of the first's.
    pub min_runner_up_share: f64,
}

impl Default for TwoViewParams {
    fn default() -> Self {
        Self {
            min_inliers: 20,
            max_error_sigma: 6.0,
            min_parallax_deg: 0.5,
            rotation_share: 0.8,
            min_baseline_share: 0.2,
            max_iterations: 2500,
            max_upright_iterations: 1000,
            max_tilted_iterations: 1000,
            max_geometries: 2,
            min_runner_up_share: 0.2,
        }
    }
}

/// What relates the two views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TwoViewKind {
    /// An essential matrix with parallax.
    General,
    /// A rotation explains the matches: no parallax, not for initialization.
    PureRotation,
}

/// The verified geometry of two images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TwoView {
    /// Kind of geometry.
    pub kind: TwoViewKind,
    /// Pose of the first camera in the second's frame, translation of unit length (meaningless for pure rotation).
    pub second_from_first: Rigid,
    /// The matches that agree, sorted by `first`.
    pub inliers: Vec<Match>,
    /// Median parallax angle of the inliers in radians.
    pub median_parallax_rad: f64,
}

#[cfg(test)]
impl TwoView {
    /// A geometry whose matches are of features of one number in both images.
    pub(crate) fn of_equal_features(second_from_first: Rigid, features: impl Iterator<Item = u32>) -> Self {
        Self {
            kind: TwoViewKind::General,
            second_from_first,
            inliers: features.map(|at| Match { first: at, second: at }).collect(),
            median_parallax_rad: 0.3,
        }
    }
}

impl TwoView {
    /// The same geometry with the two images exchanged.
    #[must_use]
    pub fn flipped(&self) -> Self {
        let mut inliers: Vec<Match> = self.inliers.iter().map(|m| m.swapped()).collect();
        inliers.sort_unstable();
        Self { second_from_first: self.second_from_first.inverse(), inliers, ..self.clone() }
    }
}

/// A verified pair of images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairGeometry {
    /// First image.
    pub first: ImageId,
    /// Second image, `first < second`.
    pub second: ImageId,
    /// Its geometry.
    pub two_view: TwoView,
}

impl PairGeometry {
    /// The verified matches with the keypoints of this image, one of the two, first.
    pub(crate) fn matches_from(&self, image: ImageId) -> Vec<Match> {
        let turned = |m: &Match| if self.first == image { *m } else { m.swapped() };
        self.two_view.inliers.iter().map(turned).collect()
    }

    /// The other image and `image_from_other`, its translation of unit length; `None` for an image not of the pair.
    pub fn seen_from(&self, image: ImageId) -> Option<(ImageId, Rigid)> {
        let second_from_first = self.two_view.second_from_first;
        match image {
            _ if image == self.second => Some((self.first, second_from_first)),
            _ if image == self.first => Some((self.second, second_from_first.inverse())),
            _ => None,
        }
    }
}

/// Verifies putative matches by essential matrices on rays; empty when too few agree.
///
/// Where façades repeat, the wrong alignment of two neighbours can have more matches than the right one. So a second
/// geometry is sought among the matches that the first leaves over, and both are returned, best supported first; the
/// mapper decides. `first` and `second` are the rays of all keypoints of the two images, `matches` index into them.
pub fn verify_pair(
    params: &TwoViewParams,
    posture: Posture,
    first: &Rays,
    second: &Rays,
    matches: &[Match],
    seed: u64,
) -> Vec<TwoView> {
    let mut remaining = matches.to_vec();
    let mut found: Vec<TwoView> = Vec::new();
    while found.len() < params.max_geometries {
        let attitude = Attitude::Held(posture);
        let seed = seed.wrapping_add(found.len() as u64);
        let Some(view) = verify_once(params, first, second, &remaining, attitude, seed) else {
            break;
        };
        let share = view.inliers.len() as f64 / found.first().map_or(1, |best| best.inliers.len()) as f64;
        if !found.is_empty() && share < params.min_runner_up_share {
            break;
        }
        remaining.retain(|m| view.inliers.binary_search(m).is_err());
        found.push(view);
    }
    found
}

/// Verifies putative matches of which the rotation is known to a few degrees; `None` when too few agree.
pub(crate) fn verify_turned(
    params: &TwoViewParams,
    [first, second]: [&Rays; 2],
    matches: &[Match],
    second_from_first: &UnitQuaternion<f64>,
    seed: u64,
) -> Option<TwoView> {
    verify_once(params, first, second, matches, Attitude::Turned(second_from_first), seed)
}

/// What is known of how two views are turned against each other.
#[derive(Clone, Copy)]
enum Attitude<'a> {
    /// How they are held.
    Held(Posture),
    /// `second_from_first` to a few degrees.
    Turned(&'a UnitQuaternion<f64>),
}

fn verify_once(
    params: &TwoViewParams,
    first: &Rays,
    second: &Rays,
    matches: &[Match],
    attitude: Attitude<'_>,
    seed: u64,
) -> Option<TwoView> {
    if matches.len() < params.min_inliers {
        return None;
    }
    let gather = |rays: &Rays, index: &dyn Fn(&Match) -> u32| -> (Vec<Vector3<f64>>, Vec<f64>) {
        matches.iter().map(|m| (rays.bearings[index(m) as usize], rays.sigmas[index(m) as usize])).unzip()
    };
    let (first_bearings, first_sigmas) = gather(first, &|m| m.first);
    let (second_bearings, second_sigmas) = gather(second, &|m| m.second);
    let ransac = RansacParams {
        max_error_sigma: params.max_error_sigma,
        min_inliers: params.min_inliers,
        max_iterations: params.max_iterations,
        confidence: 0.999,
        ..RansacParams::default()
    };
    let (bearings, sigmas) = ((&first_bearings, &second_bearings), (&first_sigmas, &second_sigmas));
    let estimate = match attitude {
        Attitude::Turned(turn) => {
            estimate_turned_pose(&ransac, bearings.0, bearings.1, sigmas.0, sigmas.1, turn, seed)?
        }
        Attitude::Held(Posture::Level(_)) => {
            let tilted = RansacParams { max_iterations: params.max_tilted_iterations, ..ransac.clone() };
            let upright = params.max_upright_iterations;
            estimate_level_pose(&tilted, upright, bearings.0, bearings.1, sigmas.0, sigmas.1, seed)?
        }
        Attitude::Held(Posture::Any) => {
            estimate_relative_pose(&ransac, bearings.0, bearings.1, sigmas.0, sigmas.1, seed)?
        }
    };
    if estimate.inliers.len() < params.min_inliers {
        return None;
    }
    let rotation = estimate.second_from_first.rotation;
    let mut parallaxes: Vec<f64> = estimate
        .inliers
        .iter()
        .map(|&index| (rotation * first_bearings[index as usize]).angle(&second_bearings[index as usize]))
        .collect();
    let middle = parallaxes.len() / 2;
    let median_parallax_rad = *parallaxes.select_nth_unstable_by(middle, f64::total_cmp).1;
    let turn =
        estimate_rotation(&ransac, &first_bearings, &second_bearings, &first_sigmas, &second_sigmas, seed);
    let is_turn = turn.as_ref().is_some_and(|turn| {
        let (turned, explained) = (turn.inliers.len() as f64, estimate.inliers.len() as f64);
        // What a baseline explains beyond the turn, and what is left for it to explain.
        let (gained, left) = (explained - turned, matches.len() as f64 - turned);
        turned >= params.rotation_share * explained
            || (turned >= 0.7 * explained && gained < params.min_baseline_share * left)
    });
    let mut second_from_first = estimate.second_from_first;
    let mut inliers = estimate.inliers;
    if let Some(turn) = turn.filter(|_| is_turn) {
        // Without a baseline the essential matrix has directions to spare, which its rotation and chance matches soak up.
        second_from_first.rotation = turn.second_from_first;
        inliers = turn.inliers;
    }
    let rotation_only = is_turn || median_parallax_rad < params.min_parallax_deg.to_radians();
    let mut inliers: Vec<Match> = inliers.iter().map(|&index| matches[index as usize]).collect();
    inliers.sort_unstable();
    Some(TwoView {
        kind: if rotation_only { TwoViewKind::PureRotation } else { TwoViewKind::General },
        second_from_first,
        inliers,
        median_parallax_rad,
    })
}
