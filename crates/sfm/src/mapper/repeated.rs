//! Places that repeat themselves underfoot.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::{Match, Rays};

use super::sides::{compare, count_matches, count_shareable, sees_all_around};
use super::{MapperInput, PutativePair};
use crate::{ImageId, PairGeometry, Reconstruction, TwoViewKind, verify_pair};

/// Share of all verified matches that must lie in one-sided geometries for the place to count as one that repeats
/// itself. Two rendered rooms with floors of exactly repeated tiles have 0.76 and 0.54, two with other floors 0.03 and 0.05,
/// rendered streets up to 0.16, real ones 0.22 (trees that match nowhere) and 0.27 (a rider moves with the camera), towns nothing.
const MIN_REPEATED_SHARE: f64 = 0.4;
/// Largest angle in degrees from straight down to the middle of what such a geometry explains. One-sided matches of a wall
/// opposite trees are right ones.
const MAX_POLE_DEG: f64 = 45.0;
/// Fewest pairs of the rest by which a model is judged, and the share of their matches that must agree with it.
const MIN_JUDGING_PAIRS: usize = 3;
const MIN_AGREEMENT: f64 = 0.5;
/// Largest angle in degrees between the baseline of such a pair and that of the model.
const MAX_BASELINE_DEG: f64 = 15.0;
/// Largest angle in degrees from the middle of what repeats itself to what is left out.
const MAX_REPEATED_DEG: f64 = 70.0;
/// Share of the matches that a geometry explains on its worst side, relative to its best, below which it is one-sided.
const MIN_SIDE_SHARE: f64 = 0.05;
/// Fewest matches by which a side is judged.
const MIN_SIDE_MATCHES: usize = 30;
/// Share of the keypoints that match on the best side from which two images claim to stand close together, so that
/// keypoints must match on all sides.
const NEAR_SHARE: f64 = 0.08;
/// Share of the keypoints matched on the worst side, relative to the best, below which such a geometry is one-sided.
const MIN_NEAR_SIDE_SHARE: f64 = 0.08;
/// Fewest keypoints by which a side is judged.
const MIN_SIDE_KEYPOINTS: usize = 60;

/// Said of a place whose repeated side was left out.
pub(super) const WARNING: &str = "most verified matches lie on one side of the panoramas, as on a floor of equal tiles that makes places a whole number of tiles apart look one: that side was left out, and the scene is held by the rest; leaving it out of the features (nadir_cone_deg, masks) is safer";

/// What is left of the matches and pairs of a place that repeats itself underfoot.
pub(super) struct Remainder {
    /// Matches away from the repeated side.
    pub putative: Vec<PutativePair>,
    /// Geometries of these.
    pub pairs: Vec<PairGeometry>,
}

impl Remainder {
    /// Whether the baselines of these pairs contradict a model of all matches.
    ///
    /// A floor that is right agrees with the walls; one that folds the model puts the walls anywhere.
    pub fn contradicts(&self, components: &[Reconstruction]) -> bool {
        let mut judged: BTreeMap<(ImageId, ImageId), (usize, bool)> = BTreeMap::new();
        for pair in self.pairs.iter().filter(|pair| pair.two_view.kind != TwoViewKind::PureRotation) {
            let placed = components.iter().find_map(|component| {
                let pose = |image: ImageId| component.images[image.index()].world_from_camera;
                Some(pose(pair.second)?.inverse() * pose(pair.first)?)
            });
            let Some(placed) = placed else { continue };
            let angle = placed.translation.angle(&pair.two_view.second_from_first.translation);
            let (matches, agrees) = judged.entry((pair.first, pair.second)).or_default();
            *matches = pair.two_view.inliers.len().max(*matches);
            *agrees |= angle <= MAX_BASELINE_DEG.to_radians();
        }
        let all: usize = judged.values().map(|(matches, _)| matches).sum();
        let agreeing: usize = judged.values().filter(|(_, agrees)| *agrees).map(|(matches, _)| matches).sum();
        judged.len() >= MIN_JUDGING_PAIRS && (agreeing as f64) < MIN_AGREEMENT * all as f64
    }
}

/// Leaves the side underfoot out of all matches, where so many geometries explain nothing else that the place may
/// repeat itself; `None` elsewhere.
///
/// On a floor of exactly repeated tiles each panorama matches the tiles under any other as if it stood a whole number of
/// tiles away: all fall together within one tile, and agree on it. The walls around contradict, but are outvoted, and
/// the floor's matches are not told from right ones one by one. So none of them counts, and pairs are verified again by
/// what is left. Elsewhere one-sided pairs are few and outvoted themselves.
pub(super) fn without_repeated_side(input: &MapperInput<'_>, seed: u64) -> Option<Remainder> {
    let rays: Vec<Option<Rays>> = (input.images.par_iter().with_max_len(1))
        .map(|image| {
            let camera = &input.cameras[image.camera.index()];
            let rays = (camera.is_panoramic() && image.mosaic.is_none()).then(|| image.features.rays(camera));
            rays.filter(sees_all_around)
        })
        .collect();
    let rays_of = |first: ImageId, second: ImageId| {
        Some([rays[first.index()].as_ref()?, rays[second.index()].as_ref()?])
    };
    let matches: BTreeMap<(ImageId, ImageId), &[Match]> =
        input.putative.iter().map(|pair| ((pair.first, pair.second), &pair.matches[..])).collect();
    let is_one_sided: Vec<bool> = (input.pairs.par_iter().with_max_len(8))
        .map(|pair| {
            let all = matches.get(&(pair.first, pair.second)).copied().unwrap_or_default();
            rays_of(pair.first, pair.second).is_some_and(|rays| is_one_sided(rays, pair, all))
        })
        .collect();
    let one_sided =
        || input.pairs.iter().zip(&is_one_sided).filter(|(_, is_one)| **is_one).map(|(pair, _)| pair);
    let count: usize = one_sided().map(|pair| pair.two_view.inliers.len()).sum();
    let all: usize = input.pairs.iter().map(|pair| pair.two_view.inliers.len()).sum();
    if count as f64 <= MIN_REPEATED_SHARE * all as f64 {
        return None;
    }
    // Where each image sees what repeats itself.
    let mut poles = vec![Vector3::zeros(); rays.len()];
    for pair in one_sided() {
        for m in &pair.two_view.inliers {
            for (image, feature) in [(pair.first, m.first), (pair.second, m.second)] {
                if let Some(rays) = &rays[image.index()] {
                    poles[image.index()] += rays.bearings[feature as usize];
                }
            }
        }
    }
    let is_repeated = |image: ImageId, feature: u32| {
        let pole: &Vector3<f64> = &poles[image.index()];
        let bearing = rays[image.index()].as_ref().map(|rays| rays.bearings[feature as usize]);
        bearing.is_some_and(|bearing| bearing.dot(pole) > MAX_REPEATED_DEG.to_radians().cos() * pole.norm())
    };
    let verified: Vec<(PutativePair, Vec<PairGeometry>)> = (input
        .putative
        .par_iter()
        .with_max_len(1)
        .enumerate())
    .map(|(at, pair)| {
        let PutativePair { first, second, .. } = *pair;
        let mut left = pair.clone();
        left.matches.retain(|m| !is_repeated(first, m.first) && !is_repeated(second, m.second));
        let geometries = match rays_of(first, second) {
            Some([a, b]) => verify_pair(&input.two_view, a, b, &left.matches, seed.wrapping_add(at as u64)),
            None => Vec::new(),
        };
        (left, geometries.into_iter().map(|two_view| PairGeometry { first, second, two_view }).collect())
    })
    .collect();
    let (putative, pairs): (Vec<_>, Vec<Vec<_>>) = verified.into_iter().unzip();
    Some(Remainder { putative, pairs: pairs.concat() })
}

/// Whether a geometry explains what lies underfoot, and next to nothing else.
fn is_one_sided([first, second]: [&Rays; 2], pair: &PairGeometry, matches: &[Match]) -> bool {
    let underfoot = |rays: &Rays, feature: fn(&Match) -> u32| {
        let seen = pair.two_view.inliers.iter().filter_map(|m| rays.bearings.get(feature(m) as usize));
        seen.sum::<Vector3<f64>>().angle(&Vector3::y()) <= MAX_POLE_DEG.to_radians()
    };
    if !underfoot(first, |m| m.first) || !underfoot(second, |m| m.second) {
        return false;
    }
    let explained = count_matches(first, &pair.two_view.inliers);
    let of_matches = compare(&count_matches(first, matches), &explained, MIN_SIDE_MATCHES);
    if of_matches.worst < MIN_SIDE_SHARE {
        return true;
    }
    let shareable = count_shareable(first, second, &pair.two_view.second_from_first.rotation);
    let of_keypoints = compare(&shareable, &explained, MIN_SIDE_KEYPOINTS);
    of_keypoints.best > NEAR_SHARE && of_keypoints.worst < MIN_NEAR_SIDE_SHARE
}
