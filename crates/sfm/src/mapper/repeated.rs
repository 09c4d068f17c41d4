//! Places that repeat themselves underfoot.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::{Match, Posture, Rays};

use super::sides::{compare, count_matches, count_shareable, sees_all_around};
use super::witnesses::{Witnesses, count_on_circles};
use super::{InputImage, MapperInput, Part, PutativePair};
use crate::{ImageId, MOST_NAMED, PairGeometry, Reconstruction, Rigid, TwoViewKind, listed, verify_pair};

/// Share of all verified matches that must lie in one-sided geometries for a model to be judged by the rest. Rendered
/// rooms with floors of exactly repeated tiles or planks have 0.12 to 0.78, two with other floors 0.03 and 0.05, rendered
/// streets up to 0.16, real ones 0.22 (trees that match nowhere) and 0.27 (a rider moves with the camera), towns nothing.
const MIN_REPEATED_SHARE: f64 = 0.2;
/// Largest angle in degrees from straight down to the middle of what such a geometry explains. One-sided matches of a wall
/// opposite trees are right ones.
const MAX_POLE_DEG: f64 = 45.0;
/// Fewest pairs by which a model is judged, and the share of their matches that must agree with it. Of the pairs without
/// what lies underfoot right models have 0.98 to 1.00 (0.58 where a wallpaper repeats itself), folded ones 0.34 and 0.40.
const MIN_JUDGING_PAIRS: usize = 3;
const MIN_AGREEMENT: f64 = 0.5;
/// The same of sets of photos: right models of rendered sets have 0.97 to 1.00, one folded by paving 0.48.
const MIN_AGREEMENT_OF_PHOTOS: f64 = 0.7;
/// Share of an image's points that must lie away from what repeats itself underfoot for more than that to hold it. In seven
/// rendered rooms right images have 0.13 or more, one that the floor folded 0.015.
const MIN_ELSEWHERE: f64 = 0.05;
/// Largest angle in degrees between the baseline of such a pair and that of the model.
const MAX_BASELINE_DEG: f64 = 15.0;
/// Largest angle in degrees from straight down, or from the middle of what repeats itself, of what is left out.
const MAX_REPEATED_DEG: f64 = 70.0;
/// The same from a photo's vertical axis: a photo looks ahead, and sees the ground far off.
const MAX_REPEATED_IN_PHOTO_DEG: f64 = 85.0;
/// Share of a geometry's matches underfoot in both panoramas, or below the middle of photos, from which it explains that. In streets
/// whose paving repeats itself exactly, right geometries have up to 0.33 there, wrong ones nearly all.
const MIN_BELOW: f64 = 0.9;
/// [`MIN_SIDE_SHARE`] of photos, which see one side more than others.
const MIN_SIDE_SHARE_OF_PHOTOS: f64 = 0.15;
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
const WARNING: &str = "many verified matches lie underfoot only and what the rest tells contradicts them, as on a floor of equal tiles that makes places a whole number of tiles apart look one: the scene was made without that side, and of it holds only what agrees; leaving it out of the features (nadir_cone_deg, masks) is safer";

/// Matches and pairs in place of an input's own.
pub(super) struct Remainder {
    pub putative: Vec<PutativePair>,
    pub pairs: Vec<PairGeometry>,
}

/// How far the baselines of these pairs agree with a model: the share of their matches, each pair by its best
/// geometry; `None` where they are too few.
fn agreement<'p>(
    pairs: impl Iterator<Item = &'p PairGeometry>,
    components: &[Reconstruction],
) -> Option<f64> {
    let mut judged: BTreeMap<(ImageId, ImageId), (usize, bool)> = BTreeMap::new();
    for pair in pairs.filter(|pair| pair.two_view.kind != TwoViewKind::PureRotation) {
        let Some(placed) = second_from_first(pair, components) else { continue };
        let angle = placed.translation.angle(&pair.two_view.second_from_first.translation);
        let (matches, agrees) = judged.entry((pair.first, pair.second)).or_default();
        *matches = pair.two_view.inliers.len().max(*matches);
        *agrees |= angle <= MAX_BASELINE_DEG.to_radians();
    }
    let all: usize = judged.values().map(|(matches, _)| matches).sum();
    let agreeing: usize = judged.values().filter(|(_, agrees)| *agrees).map(|(matches, _)| matches).sum();
    (judged.len() >= MIN_JUDGING_PAIRS && all > 0).then(|| agreeing as f64 / all as f64)
}

/// The first camera of a pair in the second's frame, by the component that both are in.
fn second_from_first<'c>(
    pair: &PairGeometry,
    components: impl IntoIterator<Item = &'c Reconstruction>,
) -> Option<Rigid> {
    components.into_iter().find_map(|component| {
        let pose = |image: ImageId| component.images[image.index()].world_from_camera;
        Some(pose(pair.second)?.inverse() * pose(pair.first)?)
    })
}

/// What the pairs of an input see underfoot only.
pub(super) struct Underfoot<'a> {
    input: &'a MapperInput<'a>,
    /// Of photos, and of panoramas that see all around.
    rays: Vec<Option<Rays>>,
    is_photo: Vec<bool>,
    /// Whether a pair of the input explains what lies underfoot and nothing else.
    is_one_sided: Vec<bool>,
    /// The middle of what each image sees of that, of any length: up to 38° aside, where it sees most of it.
    middles: Vec<Vector3<f64>>,
    /// Straight down for images that do, else zero.
    downs: Vec<Vector3<f64>>,
}

impl<'a> Underfoot<'a> {
    /// `None` where no pair does.
    pub fn find(input: &'a MapperInput<'a>) -> Option<Self> {
        let is_photo = photos_of(input);
        let rays = rays_of(input, &is_photo);
        let is_one_sided = one_sided(input, &rays, &is_photo);
        let mut middles = vec![Vector3::zeros(); rays.len()];
        for (pair, _) in input.pairs.iter().zip(&is_one_sided).filter(|(_, one_sided)| **one_sided) {
            for m in &pair.two_view.inliers {
                for (image, feature) in [(pair.first, m.first), (pair.second, m.second)] {
                    if let Some(rays) = &rays[image.index()] {
                        middles[image.index()] += rays.bearings[feature as usize];
                    }
                }
            }
        }
        let down = |middle: &Vector3<f64>| if middle.norm() > 0.0 { Vector3::y() } else { Vector3::zeros() };
        let downs: Vec<Vector3<f64>> = middles.iter().map(down).collect();
        for ((middle, down), _) in middles.iter_mut().zip(&downs).zip(&is_photo).filter(|(_, photo)| **photo)
        {
            // What a photo sees of the ground is ahead rather than down.
            *middle = *down;
        }
        is_one_sided.contains(&true).then_some(Self { input, rays, is_photo, is_one_sided, middles, downs })
    }

    /// The pairs that explain what lies underfoot only, or those that do not.
    fn pairs(&self, one_sided: bool) -> impl Iterator<Item = &'a PairGeometry> {
        let judged = self.input.pairs.iter().zip(&self.is_one_sided);
        judged.filter(move |(_, is_one_sided)| **is_one_sided == one_sided).map(|(pair, _)| pair)
    }

    /// What the model ought to be made of in place of all, and what to say of it; `None` where nothing speaks against
    /// it.
    ///
    /// On a floor of exactly repeated tiles each panorama matches the tiles under any other as if it stood a whole number
    /// of tiles away: all fall together within one tile, and agree on it. The walls around contradict, but are
    /// outvoted, and the floor's matches are not told from right ones one by one. Where the walls contradict the whole
    /// model, none of the floor's matches counts at first. Where the model contradicts the floor's pairs, these count for
    /// nothing with images that the floor alone holds. A floor that is right agrees with the walls, and comes back once
    /// they hold the model ([`Self::borne_out`]). What judges is farther from the floor's matches than what maps: it needs no
    /// walls on every side, but a floor beyond the cone that agrees with itself would speak for the fold.
    pub fn better_input(&self, components: &[Reconstruction], seed: u64) -> Option<(Remainder, String)> {
        if self.share() > MIN_REPEATED_SHARE {
            let judging = self.left_out(&self.middles, |_| true, seed);
            let enough = if self.is_photo.contains(&false) { MIN_AGREEMENT } else { MIN_AGREEMENT_OF_PHOTOS };
            if agreement(judging.pairs.iter(), components).is_some_and(|share| share < enough) {
                return Some((self.left_out(&self.downs, |_| true, seed), WARNING.to_owned()));
            }
        }
        agreement(self.pairs(true), components).filter(|share| *share < MIN_AGREEMENT)?;
        let held = self.held_underfoot(components);
        if held.is_empty() {
            return None;
        }
        let names: Vec<&str> = held.iter().map(|image| self.input.images[image.index()].name).collect();
        let warning = format!(
            "the floor repeats itself, and nothing else held {}: what lies underfoot counts there only where the rest agrees",
            listed(&names, MOST_NAMED)
        );
        Some((self.left_out(&self.downs, |image| held.contains(&image), seed), warning))
    }

    /// The pairs that count once the walls hold a model: those that explain more than what lies underfoot, and of images
    /// whose poses are known those only that the poses bear out.
    pub fn borne_out(&self, parts: &[Part]) -> Vec<PairGeometry> {
        let is_borne_out = |pair: &&PairGeometry| {
            let placed = second_from_first(pair, parts.iter().map(|part| &part.component));
            let rays = both(&self.rays, pair.first, pair.second);
            let Some((placed, rays)) = placed.zip(rays) else { return true };
            let matches = &pair.two_view.inliers;
            let agreeing = count_on_circles(rays, &placed, matches, self.input.two_view.max_error_sigma);
            agreeing as f64 >= MIN_AGREEMENT * matches.len() as f64
        };
        self.pairs(false).filter(is_borne_out).cloned().collect()
    }

    /// What these pairs say of poses by what lies elsewhere.
    pub fn witnesses(&self, pairs: &[PairGeometry]) -> Witnesses {
        let elsewhere = (self.input.images.iter().enumerate())
            .map(|(image, source)| {
                let features = 0..source.features.len() as u32;
                features.map(|feature| !self.is_near(&self.downs, ImageId(image as u32), feature)).collect()
            })
            .collect();
        Witnesses::new(pairs, elsewhere)
    }

    /// Share of all verified matches that lie in one-sided geometries.
    fn share(&self) -> f64 {
        let all: usize = self.input.pairs.iter().map(|pair| pair.two_view.inliers.len()).sum();
        let count: usize = self.pairs(true).map(|pair| pair.two_view.inliers.len()).sum();
        count as f64 / all.max(1) as f64
    }

    fn is_near(&self, poles: &[Vector3<f64>], image: ImageId, feature: u32) -> bool {
        let pole = &poles[image.index()];
        let angle = if self.is_photo[image.index()] { MAX_REPEATED_IN_PHOTO_DEG } else { MAX_REPEATED_DEG };
        let bearing = self.rays[image.index()].as_ref().map(|rays| rays.bearings[feature as usize]);
        bearing.is_some_and(|bearing| bearing.dot(pole) > angle.to_radians().cos() * pole.norm())
    }

    /// Registered images of which next to no point lies away from what repeats itself.
    fn held_underfoot(&self, components: &[Reconstruction]) -> Vec<ImageId> {
        let mut held = Vec::new();
        for component in components {
            let mut counts = vec![[0_usize; 2]; component.images.len()];
            for seen in component.points.iter().flat_map(|point| &point.track) {
                counts[seen.image.index()]
                    [usize::from(self.is_near(&self.middles, seen.image, seen.feature))] += 1;
            }
            let is_held = |image: &ImageId| {
                let [elsewhere, underfoot] = counts[image.index()];
                underfoot > 0 && (elsewhere as f64) < MIN_ELSEWHERE * (elsewhere + underfoot) as f64
            };
            held.extend(component.registered().filter(is_held));
        }
        held
    }

    /// All matches and pairs, but in pairs with such images without what lies near the poles, and verified again.
    fn left_out(
        &self,
        poles: &[Vector3<f64>],
        concerns: impl Fn(ImageId) -> bool + Sync,
        seed: u64,
    ) -> Remainder {
        let is_concerned = |first: ImageId, second: ImageId| concerns(first) || concerns(second);
        let verified: Vec<(PutativePair, Vec<PairGeometry>)> = (self.input.putative)
            .par_iter()
            .with_max_len(1)
            .enumerate()
            .filter(|(_, pair)| is_concerned(pair.first, pair.second))
            .map(|(at, pair)| {
                let PutativePair { first, second, .. } = *pair;
                let mut left = pair.clone();
                left.matches.retain(|m| {
                    !self.is_near(poles, first, m.first) && !self.is_near(poles, second, m.second)
                });
                let seed = seed.wrapping_add(at as u64);
                let posture = Posture::of([first, second].map(|image| self.input.camera_of(image)));
                let geometries = both(&self.rays, first, second)
                    .map(|[a, b]| verify_pair(&self.input.two_view, posture, a, b, &left.matches, seed));
                let pair = |two_view| PairGeometry { first, second, two_view };
                (left, geometries.into_iter().flatten().map(pair).collect())
            })
            .collect();
        let (mut putative, pairs): (Vec<_>, Vec<Vec<_>>) = verified.into_iter().unzip();
        let mut pairs = pairs.concat();
        putative.extend(
            self.input.putative.iter().filter(|pair| !is_concerned(pair.first, pair.second)).cloned(),
        );
        pairs.extend(self.input.pairs.iter().filter(|pair| !is_concerned(pair.first, pair.second)).cloned());
        Remainder { putative, pairs }
    }
}

/// Whether each pair of an input explains what lies underfoot, and next to nothing else.
///
/// Paving repeats itself as nothing else does: what such a pair says of a model counts where it agrees, and speaks against nothing.
pub fn pairs_underfoot(input: &MapperInput<'_>) -> Vec<bool> {
    let is_photo = photos_of(input);
    one_sided(input, &rays_of(input, &is_photo), &is_photo)
}

fn photos_of(input: &MapperInput<'_>) -> Vec<bool> {
    input.images.iter().map(|image| !input.cameras[image.camera.index()].is_panoramic()).collect()
}

/// Rays of photos, and of panoramas that see all around.
fn rays_of(input: &MapperInput<'_>, is_photo: &[bool]) -> Vec<Option<Rays>> {
    let rays_of = |(image, is_photo): (&InputImage<'_>, &bool)| {
        let rays = image.mosaic.is_none().then(|| image.features.rays(&input.cameras[image.camera.index()]));
        rays.filter(|rays| *is_photo || sees_all_around(rays))
    };
    input.images.par_iter().with_max_len(1).zip(is_photo).map(rays_of).collect()
}

fn one_sided(input: &MapperInput<'_>, rays: &[Option<Rays>], is_photo: &[bool]) -> Vec<bool> {
    let matches: BTreeMap<(ImageId, ImageId), &[Match]> =
        input.putative.iter().map(|pair| ((pair.first, pair.second), &pair.matches[..])).collect();
    let judge = |pair: &PairGeometry| {
        let all = matches.get(&(pair.first, pair.second)).copied().unwrap_or_default();
        let are_photos = [pair.first, pair.second].map(|image| is_photo[image.index()]);
        both(rays, pair.first, pair.second).is_some_and(|rays| is_one_sided(rays, are_photos, pair, all))
    };
    input.pairs.par_iter().with_max_len(8).map(judge).collect()
}

fn both(rays: &[Option<Rays>], first: ImageId, second: ImageId) -> Option<[&Rays; 2]> {
    Some([rays[first.index()].as_ref()?, rays[second.index()].as_ref()?])
}

/// Whether a geometry explains what lies underfoot, and next to nothing else.
fn is_one_sided(
    [first, second]: [&Rays; 2],
    are_photos: [bool; 2],
    pair: &PairGeometry,
    matches: &[Match],
) -> bool {
    let inliers = &pair.two_view.inliers;
    let looks_below = |rays: &Rays, is_photo: bool, feature: u32| {
        let least = if is_photo { 0.0 } else { MAX_REPEATED_DEG.to_radians().cos() };
        rays.bearings.get(feature as usize).is_some_and(|bearing| bearing.y > least)
    };
    let are_most = |count: usize| count as f64 >= MIN_BELOW * inliers.len() as f64;
    if !are_photos.contains(&true) {
        let below = |m: &&Match| looks_below(first, false, m.first) && looks_below(second, false, m.second);
        if are_most(inliers.iter().filter(below).count()) {
            return true;
        }
    }
    let underfoot = |rays: &Rays, is_photo: bool, feature: fn(&Match) -> u32| {
        if is_photo {
            return are_most(inliers.iter().filter(|m| looks_below(rays, true, feature(m))).count());
        }
        let seen = inliers.iter().filter_map(|m| rays.bearings.get(feature(m) as usize));
        seen.sum::<Vector3<f64>>().angle(&Vector3::y()) <= MAX_POLE_DEG.to_radians()
    };
    if !underfoot(first, are_photos[0], |m| m.first) || !underfoot(second, are_photos[1], |m| m.second) {
        return false;
    }
    let explained = count_matches(first, inliers);
    let of_matches = compare(&count_matches(first, matches), &explained, MIN_SIDE_MATCHES);
    if are_photos.contains(&true) {
        return of_matches.worst < MIN_SIDE_SHARE_OF_PHOTOS;
    }
    if of_matches.worst < MIN_SIDE_SHARE {
        return true;
    }
    let shareable = count_shareable(first, second, &pair.two_view.second_from_first.rotation);
    let of_keypoints = compare(&shareable, &explained, MIN_SIDE_KEYPOINTS);
    of_keypoints.best > NEAR_SHARE && of_keypoints.worst < MIN_NEAR_SIDE_SHARE
}
