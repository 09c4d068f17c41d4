//! Errors of bearings that neighbouring directions of an image share, by all verified matches.
//!
//! Residuals of a model's points show less than there is. Where stitching has moved a region of a panorama by more than an adjustment
//! takes for noise, its matches are in no point, and of points of two views no error along the epipolar plane is seen. So each verified
//! match is asked by how much its bearing misses the plane of its partner's bearing and the baseline. By itself that is noise, the
//! partner's errors, or a chance match; but of matches with *different* partners in neighbouring directions of an image the products are
//! zero in the mean, unless that image's directions are off together.

use nalgebra::Vector3;
use rayon::prelude::*;
use setloc_features::{ImageFeatures, Rays};

use super::shared::{APART, MAX_IMAGES, MIN_PAIRS, MIN_SHARE, Mean};
use crate::{ImageId, PairGeometry, Reconstruction, TwoViewKind, robust::median};

/// Rotation in radians between a pair and the model from which on the pair is not what the model shows.
const MAX_ROTATION: f64 = 0.05;
/// Sines of the angles between two bearings and the baseline, together, below which no plane is told.
const MIN_SIZE: f64 = 0.1;
/// How many times the median miss of all matches that of a pair may be, and how many times a match may miss. Panoramas whose
/// regions are moved by several tenths of a degree have pairs of three times; of right models of repeated structure, wrong matches
/// are what misses by more.
const MAX_OF_PAIR: f64 = 4.0;
const MAX_MISS: f64 = 8.0;
/// Fewest images that show shared errors, beside the one that shows most.
const MIN_IMAGES: usize = 2;
/// Most matches of an image that are compared.
const MAX_MATCHES: usize = 2000;
/// What the median of the absolute values of Gaussian errors is times to be their standard deviation.
const SIGMA_OF_MEDIAN: f64 = 1.4826;

/// By how much two bearings miss a common plane with the baseline, for one of the two.
struct Miss {
    /// That bearing.
    bearing: Vector3<f64>,
    /// In radians, as a share of both bearings' errors (the Sampson distance on the sphere).
    off: f64,
    /// Derivative of `off` by the bearing.
    gradient: Vector3<f64>,
    image: ImageId,
    partner: ImageId,
}

/// Standard deviation of what neighbouring bearings of a model's images share, per tangent axis, in radians; 0 where its verified
/// matches show none that matters, or are too few to tell.
///
/// `pairs` are the verified pairs with the geometries that the model was built from.
pub fn shared_sigma_of_matches(
    model: &Reconstruction,
    features: &[&ImageFeatures],
    pairs: &[PairGeometry],
) -> f64 {
    let is_registered = |image: ImageId| model.images[image.index()].world_from_camera.is_some();
    let within = |pair: &&PairGeometry| is_registered(pair.first) && is_registered(pair.second);
    let pairs: Vec<&PairGeometry> = pairs.iter().filter(within).collect();
    let rays = rays_of_matches(model, features, &pairs);
    let mut of_pairs: Vec<Vec<Miss>> = pairs.par_iter().map(|pair| misses(model, &rays, pair)).collect();
    let sizes = |misses: &[Miss]| -> Vec<f64> { misses.iter().map(|miss| miss.off.abs()).collect() };
    let Some(usual) = median(of_pairs.iter().flat_map(|misses| sizes(misses)).collect()) else { return 0.0 };
    of_pairs.retain(|misses| median(sizes(misses)).is_some_and(|median| median <= MAX_OF_PAIR * usual));
    let mut of_images: Vec<Vec<Miss>> = model.images.iter().map(|_| Vec::new()).collect();
    for miss in of_pairs.into_iter().flatten().filter(|miss| miss.off.abs() <= MAX_MISS * usual) {
        of_images[miss.image.index()].push(miss);
    }
    of_images.retain(|misses| !misses.is_empty());
    let every = (of_images.len() / MAX_IMAGES).max(1);
    let compared: Vec<&Vec<Miss>> = of_images.iter().step_by(every).collect();
    let mut products: Vec<Mean> = compared.par_iter().map(|misses| shared_by(misses)).collect();
    products.sort_by(|a, b| a.sum.total_cmp(&b.sum));
    // What the image shows that shows most may be one wrong pose.
    products.pop();
    let telling = products.iter().filter(|mean| mean.count >= MIN_PAIRS / MIN_IMAGES).count();
    let mut all = Mean::default();
    for mean in &products {
        all.join(mean);
    }
    // Half of the variance of a miss is that of either bearing.
    let least = MIN_SHARE * 2.0 * (SIGMA_OF_MEDIAN * usual).powi(2);
    let is_shown = telling >= MIN_IMAGES && all.count >= MIN_PAIRS && all.value() > least;
    if is_shown { all.value().sqrt() } else { 0.0 }
}

/// The bearings of the keypoints that are matched, by image.
fn rays_of_matches(
    model: &Reconstruction,
    features: &[&ImageFeatures],
    pairs: &[&PairGeometry],
) -> Vec<Rays> {
    let mut matched: Vec<Vec<u32>> = model.images.iter().map(|_| Vec::new()).collect();
    for pair in pairs {
        matched[pair.first.index()].extend(pair.two_view.inliers.iter().map(|m| m.first));
        matched[pair.second.index()].extend(pair.two_view.inliers.iter().map(|m| m.second));
    }
    let rays = |(at, keypoints): (usize, Vec<u32>)| match features.get(at) {
        Some(features) => features.rays_of(model.camera_of(ImageId(at as u32)), keypoints),
        None => Rays::default(),
    };
    matched.into_par_iter().enumerate().map(rays).collect()
}

/// What the bearings of a pair miss, of the first image and of the second.
fn misses(model: &Reconstruction, rays: &[Rays], pair: &PairGeometry) -> Vec<Miss> {
    let pose = |image: ImageId| model.images[image.index()].world_from_camera;
    let (Some(first), Some(second)) = (pose(pair.first), pose(pair.second)) else { return Vec::new() };
    let second_from_first = second.inverse() * first;
    let turned = second_from_first.rotation.angle_to(&pair.two_view.second_from_first.rotation);
    let Some(baseline) = second_from_first.translation.try_normalize(0.0) else { return Vec::new() };
    if pair.two_view.kind != TwoViewKind::General || turned > MAX_ROTATION {
        return Vec::new();
    }
    let bearing = |image: ImageId, feature: u32| {
        let bearing = rays[image.index()].bearings.get(feature as usize)?;
        (*bearing != Vector3::zeros()).then_some(*bearing)
    };
    let mut misses = Vec::new();
    for found in &pair.two_view.inliers {
        let bearings = (bearing(pair.first, found.first), bearing(pair.second, found.second));
        let (Some(a), Some(b)) = bearings else { continue };
        let turned_a = second_from_first.rotation * a;
        // b · (t × R a) = 0 of a match that agrees: its gradients by R a and by b.
        let (by_a, by_b) = (b.cross(&baseline), baseline.cross(&turned_a));
        let size = by_a.norm().hypot(by_b.norm());
        if size > MIN_SIZE {
            let off = b.dot(&by_b) / size;
            let in_first = second_from_first.rotation.inverse() * by_a / size;
            let miss = |bearing, gradient, image, partner| Miss { bearing, off, gradient, image, partner };
            misses.push(miss(a, in_first, pair.first, pair.second));
            misses.push(miss(b, by_b / size, pair.second, pair.first));
        }
    }
    misses
}

/// The mean of what neighbouring bearings of one image share, told by matches with different partners.
fn shared_by(misses: &[Miss]) -> Mean {
    let (near, far) = (APART[1].cos(), APART[0].cos());
    let mut shared = Mean::default();
    let compared: Vec<&Miss> = misses.iter().step_by(misses.len().div_ceil(MAX_MATCHES).max(1)).collect();
    for (at, a) in compared.iter().enumerate() {
        for b in &compared[at + 1..] {
            if a.partner != b.partner && (near..=far).contains(&a.bearing.dot(&b.bearing)) {
                // What a product is expected to be, of shared errors of one variance on all axes.
                let expected = a.gradient.dot(&b.gradient);
                shared.add(a.off * b.off * expected, expected.powi(2));
            }
        }
    }
    shared
}

#[cfg(test)]
mod tests {
    use setloc_features::{Camera, Keypoint, Match};

    use super::*;
    use crate::{Rigid, TwoView, model_errors::tests::seen_street};

    /// What a street shows whose bearings share errors of this size, with this share of its matches wrong.
    fn shown(shared_rad: f64, wrong: usize) -> f64 {
        let (model, truth) = seen_street(9, &Camera::equirectangular(4096, 2048), 0.3, shared_rad, 5);
        let count = model.points.iter().flat_map(|point| &point.track).map(|seen| seen.feature + 1).max();
        let blank = Keypoint { x: 1.0, y: 1.0, size: 3.0, orientation: 0.0, noise_px: 0.3 };
        let mut of_images = vec![vec![blank; count.unwrap_or(0) as usize]; model.images.len()];
        for point in &model.points {
            let places = &point.aligned.as_ref().expect("has places").places;
            for (seen, place) in point.track.iter().zip(places) {
                let keypoint = &mut of_images[seen.image.index()][seen.feature as usize];
                (keypoint.x, keypoint.y) = (place.pixel.x as f32, place.pixel.y as f32);
            }
        }
        let features = |keypoints| ImageFeatures { keypoints, ..ImageFeatures::default() };
        let features: Vec<ImageFeatures> = of_images.into_iter().map(features).collect();
        let pair = |first: usize, second: usize| {
            let of_both = model.points.iter().filter_map(|point| {
                let of = |at: usize| point.track.iter().find(|seen| seen.image.index() == at);
                of(first).and(of(second)).map(|seen| seen.feature)
            });
            let matched: Vec<u32> = of_both.collect();
            let inliers = (matched.iter().enumerate())
                .map(|(at, &first)| {
                    let is_wrong = wrong > 0 && at % wrong == 0;
                    let second = if is_wrong { matched[(at * 7 + 3) % matched.len()] } else { first };
                    Match { first, second }
                })
                .collect();
            let second_from_first: Rigid = truth[second].inverse() * truth[first];
            let [first, second] = [first, second].map(|at| ImageId(at as u32));
            let of_all = TwoView::of_equal_features(second_from_first, 0..0);
            PairGeometry { first, second, two_view: TwoView { inliers, ..of_all } }
        };
        let near = (0..9).flat_map(|first| (first + 1..9.min(first + 4)).map(move |second| (first, second)));
        let pairs: Vec<PairGeometry> = near.map(|(first, second)| pair(first, second)).collect();
        shared_sigma_of_matches(&model, &features.iter().collect::<Vec<_>>(), &pairs)
    }

    #[test]
    fn matches_show_what_neighbouring_bearings_share_and_nothing_where_they_share_nothing() {
        for wrong in [0, 8] {
            assert_eq!(shown(0.0, wrong), 0.0);
            let share = shown(4e-4, wrong) / 4e-4;
            assert!((0.75..1.25).contains(&share), "{share} of it, one of {wrong} wrong");
        }
    }
}
