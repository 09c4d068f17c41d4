//! What photos share with the scene's images beyond its points.
//!
//! A scene point needs two images that see it alike. Where panoramas stand far apart, most of what one of them shows
//! near a photo is no point of the scene, however well both show it. Matched image by image and verified by an essential
//! matrix, such keypoints are rays from known places; a local model gives the points that they see, so the set is
//! resected the other way round: the scene's images are the generalized camera.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{ImageFeatures, MatchParams, Posture, match_features};
use setloc_sfm::{ImageId, Observation, Rigid, TwoViewKind, TwoViewParams, verify_pair};

use crate::{PhotoEvidence, Pictures, QueryPhoto, Scene};

/// How photos are matched with the scene's images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewParams {
    /// Most scene images that a set is matched with: those that see most of the scene points nearest to its features.
    /// 0 leaves it out.
    pub max_images: usize,
    /// Fewest inliers of a verified pair. A mapper is led astray by a wrong pair (see `two_view.min_inliers`), here all
    /// pairs of the set have to agree on one pose.
    pub min_inliers: usize,
}

impl Default for ViewParams {
    fn default() -> Self {
        Self { max_images: 48, min_inliers: 12 }
    }
}

/// A keypoint of a scene image, be it a scene point or not, that shows what a feature of a photo shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct ViewMatch {
    /// Index of the photo.
    pub photo: usize,
    /// Its feature.
    pub feature: u32,
    /// The scene image and its keypoint.
    pub seen: Observation,
}

/// What photos share with the scene's images, and the features of these by image id.
#[derive(Debug, Clone, Default)]
pub struct Views {
    /// Features; `None` where nothing is matched.
    pub features: Vec<Option<ImageFeatures>>,
    /// Verified matches, sorted.
    pub matches: Vec<ViewMatch>,
    /// Verified geometries.
    pub geometries: Vec<ViewGeometry>,
    /// Matches of each photo that passed the ratio test, verified or not.
    pub putative: Vec<usize>,
    /// Pixels of both, to tell a scale that the matches do not; set by whoever locates the set.
    pub pictures: Pictures,
}

/// How a photo stands to a scene image, up to the distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewGeometry {
    /// Index of the photo.
    pub photo: usize,
    /// The scene image.
    pub image: ImageId,
    /// Pose of the photo in the scene image's frame, the translation of unit length.
    pub image_from_photo: Rigid,
    /// Verified matches.
    pub inliers: usize,
}

/// The scene images that most features of the photos are likest to points of, up to so many, ascending.
pub fn likely_images(scene: &Scene<'_>, alone: &[PhotoEvidence<'_>], most: usize) -> Vec<ImageId> {
    let mut votes: Vec<(usize, ImageId)> =
        scene.reconstruction.registered().map(|image| (0, image)).collect();
    if votes.len() > most {
        let mut of_point = vec![0_usize; scene.reconstruction.points.len()];
        for nearest in alone.iter().flat_map(|photo| photo.nearest).filter_map(|nearest| nearest.first) {
            of_point[nearest.point.index()] += 1;
        }
        let mut of_image = vec![0; scene.reconstruction.images.len()];
        for (point, votes) in scene.reconstruction.points.iter().zip(of_point) {
            for seen in &point.track {
                of_image[seen.image.index()] += votes;
            }
        }
        for (votes, image) in &mut votes {
            *votes = of_image[image.index()];
        }
        votes.sort_by_key(|&(votes, image)| (std::cmp::Reverse(votes), image));
        votes.truncate(most);
    }
    let mut images: Vec<ImageId> = votes.into_iter().map(|(_, image)| image).collect();
    images.sort_unstable();
    images
}

/// Matches photos with the scene images `views` by the ratio test and essential matrices, sorted.
///
/// `likely` are the images to match with; cameras of photos whose intrinsics are not known are taken as they are.
/// (D. Nistér, "An efficient solution to the five-point relative pose problem", PAMI 2004, on rays.)
pub fn match_views(
    params: &ViewParams,
    (matching, two_view): (&MatchParams, &TwoViewParams),
    scene: &Scene<'_>,
    views: Vec<Option<ImageFeatures>>,
    likely: &[ImageId],
    photos: &[QueryPhoto<'_>],
    seed: u64,
) -> Views {
    let two_view = &TwoViewParams { min_inliers: params.min_inliers, ..two_view.clone() };
    let pairs: Vec<(usize, ImageId)> =
        (0..photos.len()).flat_map(|photo| likely.iter().map(move |&image| (photo, image))).collect();
    let matched = |&(photo, image): &(usize, ImageId)| {
        let query = &photos[photo];
        let features = views.get(image.index()).and_then(Option::as_ref)?;
        let matches = match_features(matching, Posture::Any, query.features, features);
        let own = query.features.rays_of(query.camera, matches.iter().map(|m| m.first));
        let camera = scene.reconstruction.camera_of(image);
        let theirs = features.rays_of(camera, matches.iter().map(|m| m.second));
        let seed = seed.wrapping_add((photo as u64) << 32 | u64::from(image.0));
        Some((
            photo,
            image,
            verify_pair(two_view, Posture::Any, &own, &theirs, &matches, seed),
            matches.len(),
        ))
    };
    let found: Vec<_> = pairs.par_iter().with_max_len(1).map(matched).collect();
    let (mut matches, mut geometries, mut putative) = (Vec::new(), Vec::new(), vec![0; photos.len()]);
    for (photo, image, verified, count) in found.into_iter().flatten() {
        putative[photo] += count;
        for view in verified {
            if view.kind == TwoViewKind::General {
                let (image_from_photo, inliers) = (view.second_from_first, view.inliers.len());
                geometries.push(ViewGeometry { photo, image, image_from_photo, inliers });
            }
            matches.extend(view.inliers.iter().map(|m| ViewMatch {
                photo,
                feature: m.first,
                seen: Observation { image, feature: m.second },
            }));
        }
    }
    matches.sort_unstable();
    matches.dedup();
    Views { features: views, matches, geometries, putative, pictures: Pictures::default() }
}
