//! Verification of putative matches between two images on the sphere.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use setloc_features::{Match, Posture, Rays};

use crate::{
    ImageId, Rigid,
    robust::{
        RansacParams, estimate_level_pose, estimate_relative_pose, estimate_rotation, estimate_turned_pose,
        median, misfit_of_rotation,
    },
};

/// Bumped when equal inputs and parameters give another geometry.
pub const TWO_VIEW_VERSION: u32 = 6;

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
    /// How many times farther off than a baseline a rotation may leave the matches that both explain and still count as one.
    ///
    /// A long lens sees something small: from the next standpoint it looks turned, to within what keypoints are said to be off.
    pub max_rotation_misfit: f64,
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
            max_rotation_misfit: 3.0,
            max_iterations: 2500,
            max_upright_iterations: 1000,
            max_tilted_iterations: 1000,
            max_geometries: 2,
            min_runner_up_share: 0.2,
        }
    }
}

/// Share of the inliers that a rotation must explain where a baseline explains next to nothing of what it leaves over.
const LEAST_ROTATION_SHARE: f64 = 0.7;

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
        let least = found.first().map_or(0.0, |best| params.min_runner_up_share * best.inliers.len() as f64);
        if (remaining.len() as f64) < least {
            break;
        }
        let Some(view) = verify_once(params, first, second, &remaining, attitude, seed) else {
            break;
        };
        if (view.inliers.len() as f64) < least {
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
    // What fewer agree on is not taken.
    let (least, count) = (params.min_inliers as f64, matches.len());
    let (bearings, sigmas) = ((&first_bearings, &second_bearings), (&first_sigmas, &second_sigmas));
    let estimate = match attitude {
        Attitude::Turned(turn) => {
            let ransac = ransac.enough_for(least, count, 2)?;
            estimate_turned_pose(&ransac, bearings.0, bearings.1, sigmas.0, sigmas.1, turn, seed)?
        }
        Attitude::Held(Posture::Level(_)) => {
            let of = |max_iterations| RansacParams { max_iterations, ..ransac.clone() };
            let upright = of(params.max_upright_iterations).enough_for(least, count, 3)?.max_iterations;
            let tilted = of(params.max_tilted_iterations).enough_for(least, count, 5)?;
            estimate_level_pose(&tilted, upright, bearings.0, bearings.1, sigmas.0, sigmas.1, seed)?
        }
        Attitude::Held(Posture::Any) => {
            let ransac = ransac.enough_for(least, count, 5)?;
            estimate_relative_pose(&ransac, bearings.0, bearings.1, sigmas.0, sigmas.1, seed)?
        }
    };
    if estimate.inliers.len() < params.min_inliers {
        return None;
    }
    let rotation = estimate.second_from_first.rotation;
    let parallaxes = estimate
        .inliers
        .iter()
        .map(|&index| (rotation * first_bearings[index as usize]).angle(&second_bearings[index as usize]));
    let median_parallax_rad = median(parallaxes.collect())?;
    // A turn that explains less of the inliers is none.
    let least = LEAST_ROTATION_SHARE.min(params.rotation_share) * estimate.inliers.len() as f64;
    let turn = estimate_rotation(
        &ransac.enough_for(least, count, 2)?,
        &first_bearings,
        &second_bearings,
        &first_sigmas,
        &second_sigmas,
        seed,
    );
    let is_turn = turn.as_ref().is_some_and(|turn| {
        let (turned, explained) = (turn.inliers.len() as f64, estimate.inliers.len() as f64);
        // What a baseline explains beyond the turn, and what is left for it to explain.
        let (gained, left) = (explained - turned, matches.len() as f64 - turned);
        let explains_as_many = turned >= params.rotation_share * explained
            || (turned >= LEAST_ROTATION_SHARE * explained && gained < params.min_baseline_share * left);
        explains_as_many && {
            let both: Vec<u32> = estimate
                .inliers
                .iter()
                .filter(|at| turn.inliers.binary_search(at).is_ok())
                .copied()
                .collect();
            let (pose, rotation) = (&estimate.second_from_first, &turn.second_from_first);
            misfit_of_rotation((bearings.0, bearings.1), (sigmas.0, sigmas.1), &both, pose, rotation)
                .is_none_or(|misfit| misfit <= params.max_rotation_misfit.powi(2))
        }
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

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::synthetic::{normal, seeded};

    /// The kind of two views, turned by 5°, of something of a tenth of its distance: from two standpoints, or turned on the spot.
    /// Keypoints are off by a quarter of what they are said to be.
    fn kind(steps_aside: bool) -> TwoViewKind {
        const SIGMA: f64 = 8e-4;
        let mut rng = seeded("small");
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.08);
        // The second turns about what it sees where it steps aside, else on the spot.
        let aside = if steps_aside { Vector3::z() - turn * Vector3::z() } else { Vector3::zeros() };
        let (mut first, mut second) = (Rays::default(), Rays::default());
        for _ in 0..300 {
            let mut within = |size: f64| rng.random_range(-size..size);
            let point = Vector3::new(within(0.1), within(0.1), 1.0 + within(0.06));
            for (rays, seen) in [(&mut first, point), (&mut second, turn * point + aside)] {
                let noise = Vector3::new(normal(&mut rng), normal(&mut rng), 0.0) * (SIGMA / 4.0);
                rays.bearings.push((seen.normalize() + noise).normalize());
                rays.sigmas.push(SIGMA);
            }
        }
        let matches: Vec<Match> = (0..300).map(|at| Match { first: at, second: at }).collect();
        let found = verify_pair(&TwoViewParams::default(), Posture::Any, &first, &second, &matches, 3);
        found[0].kind
    }

    #[test]
    fn what_is_small_and_far_looks_turned_from_the_next_standpoint_and_is_not() {
        assert_eq!(kind(true), TwoViewKind::General);
        assert_eq!(kind(false), TwoViewKind::PureRotation);
    }
}
