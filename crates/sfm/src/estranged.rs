//! Panoramas that are in one component and share more with another.
//!
//! What a large component refuses, by what walls hide from it, makes components of its own, and of the pairs that are left there more are
//! wrong than elsewhere: the right ones are with the images that are gone.

use std::{cmp::Reverse, collections::BTreeMap};

use crate::{ImageId, OutvotedPair, PairGeometry, Reconstruction, TwoViewKind, quality::HEAVY_MATCHES};

/// Matches of a pair with an image of a larger component for each point of the strongest link within an image's own from which on it
/// is doubtful that the image belongs there. In rendered rooms with the same pictures panoramas that corridors had refused made a
/// part of their own (336 matches with a corridor's, 78 points within); of a right part of a real house 99 and 56.
const MIN_WEIGHT: f64 = 2.0;

/// The panoramas of a component that share by far more with an image of a larger one than points with any of their own; each with
/// that pair.
pub(crate) fn estranged(
    component: &Reconstruction,
    larger: &[Reconstruction],
    pairs: &[&PairGeometry],
    most_shared: impl Fn(ImageId) -> usize,
) -> Vec<OutvotedPair> {
    let is_in = |of: &Reconstruction, image: ImageId| of.images[image.index()].world_from_camera.is_some();
    // By image, its matches with the one of a larger component that it has most with.
    let mut strongest: BTreeMap<ImageId, (usize, Reverse<ImageId>)> = BTreeMap::new();
    for pair in pairs.iter().filter(|pair| pair.two_view.kind == TwoViewKind::General) {
        for (image, other) in [(pair.first, pair.second), (pair.second, pair.first)] {
            if is_in(component, image) && larger.iter().any(|larger| is_in(larger, other)) {
                let most = strongest.entry(image).or_insert((0, Reverse(other)));
                *most = (*most).max((pair.two_view.inliers.len(), Reverse(other)));
            }
        }
    }
    let estranged = |image: ImageId| {
        let &(matches, Reverse(second)) = strongest.get(&image)?;
        let held_by = most_shared(image);
        let pair = OutvotedPair { first: image, second, matches, held_by, side: vec![image] };
        (matches >= HEAVY_MATCHES && pair.weight() >= MIN_WEIGHT).then_some(pair)
    };
    let is_panoramic = |image: &ImageId| component.camera_of(*image).is_panoramic();
    component.registered().filter(is_panoramic).filter_map(estranged).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use setloc_features::Camera;

    use super::*;
    use crate::{
        CameraId, Observation, QualityParams, QualityReport, ReconstructionImage, ReconstructionPoint, Rigid,
        TwoView, assess, doubtful_images,
    };

    #[test]
    fn panoramas_that_share_more_with_a_larger_component_are_strangers_in_theirs() {
        let image = ReconstructionImage {
            name: "a".to_owned(),
            camera: CameraId(0),
            world_from_camera: Some(Rigid::identity()),
        };
        let component = |registered: &[usize], link: [u32; 2], points: u32| {
            let mut model = Reconstruction {
                cameras: vec![Camera::equirectangular(200, 100)],
                images: vec![image.clone(); 5],
                ..Reconstruction::default()
            };
            for (at, image) in model.images.iter_mut().enumerate() {
                image.world_from_camera = image.world_from_camera.filter(|_| registered.contains(&at));
            }
            let point = |feature| ReconstructionPoint {
                position: Vector3::z(),
                color: [0; 3],
                error_sigma: 0.0,
                covariance: None,
                track: link.map(|image| Observation { image: ImageId(image), feature }).to_vec(),
                aligned: None,
            };
            model.points.extend((0..points).map(point));
            model
        };
        let components = [component(&[0, 1, 2], [0, 1], 300), component(&[3, 4], [3, 4], 78)];
        let pair = |first: u32, second: u32, matches: u32| PairGeometry {
            first: ImageId(first),
            second: ImageId(second),
            two_view: TwoView::of_equal_features(Rigid::identity(), 0..matches),
        };
        let found = |at: usize, pairs: &[PairGeometry]| {
            assess(&QualityParams::default(), &components[at], &components[..at], pairs, &[]).outvoted
        };
        assert_eq!(found(1, &[pair(1, 3, 140), pair(3, 4, 90)]), []);
        let strangers = found(1, &[pair(1, 3, 140), pair(0, 3, 336), pair(3, 4, 90)]);
        let [stranger] = &strangers[..] else { panic!("{strangers:?}") };
        assert_eq!((stranger.first, stranger.second, stranger.held_by), (ImageId(3), ImageId(0), 78));
        assert_eq!(doubtful_images(&components[1], &strangers, &[]), [3, 4].map(ImageId));
        let sentences =
            QualityReport { outvoted: strangers, ..QualityReport::default() }.sentences(&components[1]);
        assert!(
            sentences[0].starts_with("a shares 336 matches with a of a larger component"),
            "{sentences:?}"
        );
        // The larger one is not asked.
        assert_eq!(found(0, &[pair(0, 3, 900)]), []);
    }
}
