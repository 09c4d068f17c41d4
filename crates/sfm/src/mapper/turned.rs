//! Images that are a mere turn away from one of the model: they stand where that one stands.

use nalgebra::UnitQuaternion;

use super::{Mapper, adjust::is_adjustable};
use crate::{ImageId, PairGeometry, Rigid, TwoViewKind};

impl Mapper<'_> {
    /// Registers an image at the standpoint of one that it is a mere turn away from.
    ///
    /// Photos taken by turning on the spot share no parallax, so they have no points in common to resect from; but the
    /// turn itself is known best of all, and through it the next standpoint's matches reach the model.
    ///
    /// Two panoramas with no more in common than what is far off differ by a turn, too, however far apart they are; on the spot
    /// they would share most of what they see.
    pub(super) fn register_by_turn(&mut self) -> Option<ImageId> {
        let mut best: Option<(usize, ImageId, ImageId, UnitQuaternion<f64>)> = None;
        for pair in self.model.input.pairs {
            let matches = pair.two_view.inliers.len();
            if pair.two_view.kind != TwoViewKind::PureRotation
                || matches < self.params.min_turn_matches
                || self.shares_what_is_far_off(pair)
            {
                continue;
            }
            for image in [pair.second, pair.first] {
                let Some((anchor, image_from_anchor)) = pair.seen_from(image) else { continue };
                let open = !self.model.is_registered(image)
                    && !self.taken[image.index()]
                    && self.anchors[image.index()].is_none()
                    && self.model.is_registered(anchor)
                    && self.knows_camera_of(image);
                if open && best.is_none_or(|(most, ..)| matches > most) {
                    best = Some((matches, image, anchor, image_from_anchor.rotation));
                }
            }
        }
        let (_, image, anchor, image_from_anchor) = best?;
        self.anchors[image.index()] = Some((anchor, image_from_anchor));
        self.place_by_turn(image);
        Some(image)
    }

    /// Whether the images of a pair are panoramas that share less than they would on one spot.
    fn shares_what_is_far_off(&self, pair: &PairGeometry) -> bool {
        let input = self.model.input;
        let images = [pair.first, pair.second];
        let fewest = images.map(|image| input.images[image.index()].features.own_len()).into_iter().min();
        images.iter().all(|&image| input.is_panoramic(image))
            && (pair.two_view.inliers.len() as f64)
                < self.params.min_turn_recall * fewest.unwrap_or_default() as f64
    }

    fn place_by_turn(&mut self, image: ImageId) {
        if let Some((anchor, image_from_anchor)) = self.anchors[image.index()]
            && let Some(pose) = &self.model.poses[anchor.index()]
        {
            let world_from_anchor = pose.world_from_camera;
            let rotation = world_from_anchor.rotation * image_from_anchor.inverse();
            self.model.set_pose(image, Some(Rigid::new(rotation, world_from_anchor.translation)));
        }
    }

    /// Images with too few points to be adjusted stay with the image that they were turned from. Returns those moved.
    pub(super) fn follow_anchors(&mut self) -> Vec<ImageId> {
        let follows =
            |image: &ImageId| self.anchors[image.index()].is_some() && !is_adjustable(&self.model, *image);
        let followers: Vec<ImageId> = self.model.registered().filter(follows).collect();
        for &image in &followers {
            self.place_by_turn(image);
        }
        followers
    }
}

#[cfg(test)]
mod tests {
    use setloc_features::Camera;

    use super::*;
    use crate::mapper::{
        MapperInput, MapperParams, Model,
        test_street::{POINTS, Street},
    };

    /// Whether the third of three images, of which two are registered, comes in by a turn of so many matches from the second, and
    /// then where that one stands.
    fn comes_in(camera: Camera, matches: usize) -> bool {
        let street = Street::new("turned", 0, matches);
        let mut pairs = street.input().pairs.to_vec();
        pairs[2].two_view.kind = TwoViewKind::PureRotation;
        let input = MapperInput { pairs: &pairs, cameras: vec![camera], ..street.input() };
        let mut model = Model::new(&input);
        model.set_pose(ImageId(0), Some(street.poses[0]));
        model.set_pose(ImageId(1), Some(street.poses[1]));
        let params = MapperParams::default();
        let mut mapper = Mapper::over(&params, model, vec![false; 3], 0);
        let found = mapper.register_by_turn();
        let pose = mapper.model.poses[2].map(|pose| pose.world_from_camera);
        assert_eq!(found.is_some(), pose.is_some());
        pose.is_some_and(|pose| {
            assert!((pose.translation - street.poses[1].translation).norm() < 1e-9);
            assert!(pose.rotation.angle_to(&street.poses[2].rotation) < 1e-9);
            true
        })
    }

    #[test]
    fn panoramas_that_share_what_is_far_off_do_not_stand_in_one_place() {
        let panorama = Camera::equirectangular(2048, 1024);
        assert!(!comes_in(panorama.clone(), POINTS / 6));
        assert!(comes_in(panorama, POINTS / 3));
    }

    #[test]
    fn photos_share_what_both_see_after_the_turn() {
        let photo = Camera::from_focal_guess(2048, 1024, 1500.0);
        assert!(comes_in(photo.clone(), POINTS / 6));
        assert!(!comes_in(photo, POINTS / 10));
    }
}
