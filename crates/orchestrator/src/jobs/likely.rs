//! Which images look alike: pairs for large unordered sets whose places nobody measured.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use anyhow::Result;
use rayon::prelude::*;
use serde_json::json;
use setloc_features::{Camera, CarriedCells, ImageFeatures, without_carried, without_carried_cells};
use setloc_index::images_alike;

use super::carried::add_carried;
use super::features::{add_features_of, features_role};
use crate::artifacts::{CarriedParts, LikelyImages};
use crate::config::Config;
use crate::dataset::SourceImage;
use crate::fingerprint::ContentHash;
use crate::graph::{Inputs, Job, JobGraph, JobId, Product};
use crate::stages::{self, MatchParams};

/// Keypoints by which images are compared, of the bright and of the dark. With half as many, 63 of 198 third neighbours of a
/// rendered street were not among the 16 most alike in place of 30; with twice as many 14, at four times the work.
const STRONGEST: usize = 512;

/// So many times as many images as are asked for are compared with each: those that most of its descriptors speak for.
const CANDIDATES: usize = 3;

/// Of how many most alike images the most alike are taken, too: the next on either side.
const NEAREST: usize = 3;

/// The jobs that tell which images look alike.
#[derive(Debug, Clone)]
pub struct LikelyJobs {
    /// The images in the order of their content, as places in the list given.
    order: Vec<usize>,
    /// The job whose result they are.
    pub likely: JobId,
}

impl LikelyJobs {
    /// Adds extraction and comparison; `None` where pairs are chosen without.
    ///
    /// Up to [`PairParams::exhaustive_up_to`](crate::config::PairParams) images all are matched, and those with a measured
    /// position with their neighbours.
    ///
    /// # Errors
    /// When parameters have no JSON form.
    pub fn add(
        graph: &mut JobGraph<'_>,
        name: &str,
        images: &[SourceImage],
        features: &stages::FeatureParams,
        config: &Config,
    ) -> Result<Option<Self>> {
        let is_wanted = |image: &SourceImage| image.position.is_none();
        let most = config.pairs.alike;
        if images.len() <= config.pairs.exhaustive_up_to || most == 0 || !images.iter().any(is_wanted) {
            return Ok(None);
        }
        // Whatever an image is called, the result is the same.
        let mut order: Vec<usize> = (0..images.len()).collect();
        order.sort_by_key(|&at| (images[at].hash, at));
        let ordered: Vec<SourceImage> = order.iter().map(|&at| images[at].clone()).collect();
        let wanted: Vec<bool> = ordered.iter().map(is_wanted).collect();
        let features = add_features_of(graph, &ordered, features);
        let carried: BTreeSet<JobId> =
            add_carried(graph, &ordered, &features).into_iter().flatten().collect();
        let sizes = carried.len();
        let cameras: Vec<Camera> = ordered.iter().map(|image| image.camera.clone()).collect();
        let matching = config.matching.clone();
        let hashes: Vec<ContentHash> = ordered.iter().map(|image| image.hash).collect();
        let params = json!({
            "images": hashes, "cameras": cameras, "matching": matching, "strongest": STRONGEST, "alike": most,
            "wanted": wanted,
        });
        let work = move |inputs: &Inputs<'_, '_>| {
            let strongest = (0..wanted.len()).into_par_iter().with_max_len(1).map(|at| {
                let features = inputs.find::<ImageFeatures>(&features_role(at))?;
                Ok(features.map(|features| features.strongest(STRONGEST)).unwrap_or_default())
            });
            let strongest: Vec<ImageFeatures> = strongest.collect::<Result<_>>()?;
            let mut carried = CarriedParts::default();
            for size in 0..sizes {
                carried.0.extend(inputs.get::<CarriedParts>(&carried_role(size))?.0.clone());
            }
            let carried: Vec<CarriedCells> =
                hashes.iter().map(|hash| carried.0.get(hash).cloned().unwrap_or_default()).collect();
            let images = Compared { features: &strongest, carried: &carried, cameras: &cameras };
            Product::new(LikelyImages(most_alike(&matching, &images, &wanted, most)))
        };
        let likely = graph.add(Job {
            kind: "likely",
            version: stages::LIKELY_VERSION,
            name: name.to_owned(),
            params,
            external: BTreeMap::new(),
            // Features, their descriptors once more, and the votes of each two.
            memory: images.len() as u64 * (STRONGEST as u64 * 2 * 320 + images.len() as u64 * 2),
            work: Box::new(work),
        });
        for (at, &features) in features.iter().enumerate() {
            graph.accept(likely, features_role(at), features);
        }
        for (size, job) in carried.into_iter().enumerate() {
            graph.require(likely, carried_role(size), job);
        }
        graph.want(likely);
        Ok(Some(Self { order, likely }))
    }

    /// The pairs, as places in the list of images: of images that look alike, and of those that look most like the
    /// same third.
    ///
    /// The next but one often looks less alike than what merely repeats itself (14 of 198 on a rendered street), and
    /// without it nothing tells one step's length from the next.
    pub fn pairs(&self, found: &LikelyImages) -> Vec<(usize, usize)> {
        let place = |at: u32| self.order.get(at as usize).copied();
        let first =
            |at: u32| found.0.get(at as usize).map_or(&[][..], |others| &others[..others.len().min(NEAREST)]);
        let of_one = |(at, others): (usize, &Vec<u32>)| {
            let beyond = first(at as u32).iter().flat_map(|&next| first(next));
            let pair = |other: &u32| Some((place(at as u32)?, place(*other)?));
            let pairs = others.iter().chain(beyond).filter_map(pair).filter(|(a, b)| a != b);
            pairs.map(|(a, b)| (a.min(b), a.max(b))).collect::<Vec<_>>()
        };
        let mut pairs: Vec<(usize, usize)> = found.0.iter().enumerate().flat_map(of_one).collect();
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    }
}

/// What tells of the photos of a size what moves with their cameras.
fn carried_role(size: usize) -> String {
    format!("carried {size:04}")
}

/// What is compared of images, one of each an image.
struct Compared<'a> {
    features: &'a [ImageFeatures],
    carried: &'a [CarriedCells],
    cameras: &'a [Camera],
}

impl Compared<'_> {
    /// How many matches two of them share.
    fn shared(&self, matching: &MatchParams, [a, b]: [usize; 2]) -> usize {
        let [first, second] = [a, b].map(|at| &self.features[at]);
        let found = stages::match_features(matching, stages::Posture::Any, first, second);
        let posture = stages::Posture::of([a, b].map(|at| &self.cameras[at]));
        let found = without_carried(found, posture, first, second);
        without_carried_cells(found, [a, b].map(|at| &self.carried[at]), first, second).len()
    }
}

/// The pairs that are compared: of few images all, else of each wanted one and those that most of its descriptors speak for.
fn candidates(features: &[ImageFeatures], wanted: &[bool], most: usize) -> Vec<[usize; 2]> {
    let (count, each) = (features.len(), most.saturating_mul(CANDIDATES));
    let is_asked = |a: usize, b: usize| wanted[a] || wanted[b];
    if count <= each + 1 {
        let pairs = (0..count).flat_map(|a| (a + 1..count).map(move |b| [a, b]));
        return pairs.filter(|&[a, b]| is_asked(a, b)).collect();
    }
    let descriptors: Vec<&[u8]> = features.iter().map(|features| &features.descriptors[..]).collect();
    let found = images_alike(&descriptors, each, 0);
    let of_one = |(a, others): (usize, &Vec<u32>)| {
        others.iter().map(|&b| [a.min(b as usize), a.max(b as usize)]).collect::<Vec<_>>()
    };
    let mut pairs: Vec<[usize; 2]> =
        found.iter().enumerate().filter(|&(at, _)| wanted[at]).flat_map(of_one).collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// For each wanted image so many others that share most matches with it, most first.
fn most_alike(matching: &MatchParams, images: &Compared<'_>, wanted: &[bool], most: usize) -> Vec<Vec<u32>> {
    let matching = MatchParams { screen_features: 0, ..matching.clone() };
    let pairs = candidates(images.features, wanted, most);
    let shared: Vec<u32> =
        pairs.par_iter().with_max_len(1).map(|&pair| images.shared(&matching, pair) as u32).collect();
    let mut likely = vec![Vec::new(); wanted.len()];
    for (&[a, b], &shared) in pairs.iter().zip(&shared).filter(|&(_, &shared)| shared > 0) {
        for (at, other) in [(a, b), (b, a)] {
            if wanted[at] {
                likely[at].push((Reverse(shared), other as u32));
            }
        }
    }
    let most_of = |mut others: Vec<(Reverse<u32>, u32)>| {
        others.sort_unstable();
        others.truncate(most);
        others.into_iter().map(|(_, other)| other).collect()
    };
    likely.into_iter().map(most_of).collect()
}

#[cfg(test)]
mod tests {
    use setloc_features::{DESCRIPTOR_LEN, Keypoint};

    use super::*;

    /// Images along a street: each shares half of its keypoints with the next.
    fn street(count: usize) -> Vec<ImageFeatures> {
        let mut state = 1_u64;
        let mut value = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u8 % 90
        };
        let blocks: Vec<Vec<u8>> =
            (0..=count).map(|_| (0..40 * DESCRIPTOR_LEN).map(|_| value()).collect()).collect();
        let image = |pair: &[Vec<u8>]| ImageFeatures {
            width: 100,
            height: 50,
            keypoints: vec![Keypoint { x: 1.0, y: 1.0, size: 3.0, orientation: 0.0, noise_px: 0.1 }; 80],
            descriptors: pair.concat(),
            colors: vec![[0; 3]; 80],
            ..ImageFeatures::default()
        };
        blocks.windows(2).map(image).collect()
    }

    #[test]
    fn neighbours_look_most_alike_and_only_who_asks_gets_an_answer() {
        let (features, cameras) = (street(6), vec![Camera::equirectangular(100, 50); 6]);
        let carried = vec![CarriedCells::default(); 6];
        let images = Compared { features: &features, carried: &carried, cameras: &cameras };
        let found = most_alike(&MatchParams::default(), &images, &[true; 6], 2);
        assert_eq!(found, [vec![1], vec![0, 2], vec![1, 3], vec![2, 4], vec![3, 5], vec![4]]);
        let wanted = [false, false, true, false, false, false];
        let one = most_alike(&MatchParams::default(), &images, &wanted, 1);
        assert_eq!(one, [vec![], vec![], vec![1], vec![], vec![], vec![]]);
    }

    #[test]
    fn of_many_images_those_that_inverted_lists_propose_are_compared() {
        let count = 60;
        let (features, cameras) = (street(count), vec![Camera::equirectangular(100, 50); count]);
        let carried = vec![CarriedCells::default(); count];
        let images = Compared { features: &features, carried: &carried, cameras: &cameras };
        let pairs = candidates(&features, &[true; 60], 2);
        assert!(pairs.len() <= 6 * count, "{}", pairs.len());
        let found = most_alike(&MatchParams::default(), &images, &[true; 60], 2);
        for (at, others) in (0_u32..).zip(&found).skip(1).take(count - 2) {
            assert_eq!(others, &[at - 1, at + 1]);
        }
    }

    #[test]
    fn pairs_are_of_the_images_as_given() {
        let mut graph = JobGraph::default();
        let config = Config::default();
        let none = LikelyJobs::add(&mut graph, "few", &[], &config.features, &config).unwrap();
        assert!(none.is_none() && graph.is_empty());
        let likely = graph.add(Job {
            kind: "likely",
            version: 1,
            name: String::new(),
            params: json!(null),
            external: BTreeMap::new(),
            memory: 0,
            work: Box::new(|_| Product::new(LikelyImages::default())),
        });
        let jobs = LikelyJobs { order: vec![2, 0, 1], likely };
        let found = LikelyImages(vec![vec![1], vec![0, 2], vec![9]]);
        // The first two look alike, the last two; and the first and last both look like the second.
        assert_eq!(jobs.pairs(&found), [(0, 1), (0, 2), (1, 2)]);
    }
}
