//! Which pose of an image is taken, if any.

use std::sync::OnceLock;

use super::{
    Mapper, RegistrationRecord,
    depths::{Floor, floor_of_all, stands_on_floor},
    latecomers::{hypothesize_from_crossings, hypothesize_from_depths, lead_elsewhere},
    neighbours::{Neighbours, neighbours, share_as_neighbours, share_with_one},
    register::{PoseHypothesis, Visibility, hypothesize, hypothesize_from_pairs, visibility},
    support::{Support, Worth},
    witnesses::{Testimony, count_agreeing},
};
use crate::{ImageId, PointId, Rigid, robust::RansacParams};

/// Share of a pair's matches on the epipolar circles of a pose that make it agree with that pose.
const MIN_ON_CIRCLES: f64 = 0.9;

/// How many times more matches the strongest pair of an image must have with one outside the model than with one inside for
/// it to be of another place, unless most of its matches agree on this one.
const ELSEWHERE_LEAD: f64 = 4.0;
/// Share of the 2D-to-3D matches of an image that agree on its pose where nothing speaks for another place.
const MOST_MATCHES: f64 = 0.5;

/// Who judges poses in a model, and what is known of all of it for that: counted when something asks, and then kept, as nothing
/// changes the model meanwhile.
pub(super) struct Judge<'m, 'a> {
    mapper: &'m Mapper<'a>,
    worth: OnceLock<Worth>,
    floor: OnceLock<Option<Floor>>,
}

impl Judge<'_, '_> {
    /// A pose that may be taken, and what was thought of it and those before.
    pub(super) fn acceptable_pose(
        &self,
        image: ImageId,
    ) -> (Option<PoseHypothesis>, Vec<RegistrationRecord>) {
        let Mapper { params, model, graph, taken, .. } = self.mapper;
        let (sigmas, mut records) = (params.max_error_sigma, Vec::new());
        let mut has_rival = false;
        let seed = self.mapper.seed ^ (u64::from(image.0) << 32);
        let ransac = params.ransac();
        let resected = hypothesize(model, graph, image, &ransac, params.max_pose_hypotheses, seed);
        let pose = self.first_accepted(image, resected, &mut has_rival, &mut records).or_else(|| {
            let confirmed = RansacParams { min_inliers: params.min_confirmed_inliers, ..ransac };
            let mut from_pairs = hypothesize_from_pairs(model, graph, image, &confirmed);
            from_pairs.retain(|pose| {
                pose.inliers.len() as f64 >= params.min_confirmed_share * pose.candidates as f64
                    || pose.inliers.len() >= params.min_registration_inliers
            });
            from_pairs.truncate(params.max_pose_hypotheses);
            self.first_accepted(image, from_pairs, &mut has_rival, &mut records)
        });
        let pose = pose.or_else(|| {
            let crossed = (self.mapper.admits_latecomers)
                .then(|| hypothesize_from_crossings(model, graph, taken, image, sigmas))?;
            // Two directions nearly always cross somewhere.
            let pose = crossed.filter(|pose| self.is_latecomer(image, &pose.world_from_camera))?;
            self.first_accepted(image, vec![pose], &mut has_rival, &mut records)
        });
        let pose = pose.or_else(|| {
            let hung = self
                .mapper
                .admits_by_depths
                .then(|| hypothesize_from_depths(model, self.floor(), graph, taken, image, sigmas))?;
            let pose = hung.filter(|pose| self.may_hang(image, &pose.world_from_camera))?;
            self.first_accepted(image, vec![pose], &mut has_rival, &mut records)
        });
        (pose, records)
    }

    /// The first of these that may be taken; `has_rival` tells whether pairs clearly spoke for one that was refused.
    pub(super) fn first_accepted(
        &self,
        image: ImageId,
        hypotheses: Vec<PoseHypothesis>,
        has_rival: &mut bool,
        records: &mut Vec<RegistrationRecord>,
    ) -> Option<PoseHypothesis> {
        let Mapper { params, model, .. } = self.mapper;
        let mut refused_before = false;
        for hypothesis in hypotheses {
            let seen = hypothesis.visibility;
            let judged = seen.expected >= params.min_visible_points;
            // Where a better supported pose was refused for what it does not see, this one needs evidence of its own.
            let testimony = self.mapper.testimony(image, &hypothesis.world_from_camera, &hypothesis.inliers);
            let plausible = match testimony {
                Some(testimony) => testimony.speaks_for(),
                None if judged => params.is_recognized(&seen),
                None => !refused_before,
            };
            let plausible = plausible
                || hypothesis.length.is_some() && self.may_hang(image, &hypothesis.world_from_camera)
                || self.is_latecomer(image, &hypothesis.world_from_camera);
            refused_before |= !plausible;
            let is_contradicted = model.input.is_panoramic(image) && {
                let support = self.mapper.support(image, &hypothesis.world_from_camera);
                let is_contradicted =
                    support.is_untenable() || (*has_rival || !judged) && support.is_contradicted();
                *has_rival |= support.is_clear();
                is_contradicted
            };
            let accepted = plausible
                && !is_contradicted
                && !self.is_of_elsewhere(image, &hypothesis)
                && self.mapper.pair_agreement(image, &hypothesis.world_from_camera)
                    >= params.min_pair_agreement;
            let (candidates, inliers) = (hypothesis.candidates, hypothesis.inliers.len());
            records.push(RegistrationRecord::new(image, accepted, [candidates, inliers], &seen));
            if accepted {
                return Some(hypothesis);
            }
        }
        None
    }

    /// Whether an image is of a place that is not mapped here, by its pairs, and looks like several places that are.
    ///
    /// The crossings of a town look alike: of 1200 panoramas 22 were taken for other crossings, before any that they stand next
    /// to was mapped, and tore the whole apart by what they share with those. A fifth to two fifths of their 2D-to-3D matches agreed on
    /// one place (median and most), and their strongest pairs were with others at 5 m, by 5 to 10 times. Where a model has just begun,
    /// right images may lead elsewhere by as much; of their matches six to nine in ten agreed.
    fn is_of_elsewhere(&self, image: ImageId, hypothesis: &PoseHypothesis) -> bool {
        let model = &self.mapper.model;
        let is_minority = (hypothesis.inliers.len() as f64) < MOST_MATCHES * hypothesis.candidates as f64;
        is_minority
            && lead_elsewhere(model.pairs_of(image), image, |other| model.is_registered(other))
                >= ELSEWHERE_LEAD
    }

    /// Whether an image may come in late at a pose.
    fn is_latecomer(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        if !self.mapper.admits_latecomers {
            return false;
        }
        let support = self.mapper.support(image, world_from_camera);
        support.is_enough(self.mapper.params.min_initial_points)
            && (support.is_strong() && self.believes(support.widest)
                || self.mapper.shares_with_one(image, world_from_camera))
    }

    /// Whether an image may hang at a pose by one pair whose length depths tell.
    fn may_hang(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        let sigmas = self.mapper.params.max_error_sigma;
        self.right_support(image, world_from_camera).is_some_and(|support| {
            support.is_strong()
                || self.mapper.shares_with_one(image, world_from_camera)
                || stands_on_floor(&self.mapper.model, self.floor(), image, world_from_camera, sigmas)
        })
    }

    /// Whether a registered image is held by pairs such as are right in this model, whatever walls hide from it.
    ///
    /// Less is asked than of one that comes in by a pair ([`Self::may_hang`]): when two parts become one that a door joins, each
    /// image ought to see by all that is in plain view what stands in the other's rooms.
    fn is_held_by_pairs(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        self.right_support(image, world_from_camera).is_some()
    }

    /// What the pairs say for a pose where images may come in by depths, if it is enough and such pairs are right in this model.
    fn right_support(&self, image: ImageId, world_from_camera: &Rigid) -> Option<Support> {
        if !self.mapper.admits_by_depths {
            return None;
        }
        let support = self.mapper.support(image, world_from_camera);
        let is_right = support.is_enough_if_right() && self.believes(support.widest);
        is_right.then_some(support)
    }

    /// What an image sees of what it ought to, where it does not see that.
    pub(super) fn seen_if_misplaced(&self, image: ImageId) -> Option<Visibility> {
        let Mapper { params, model, .. } = self.mapper;
        let pose = model.poses[image.index()]?.world_from_camera;
        let observations = model.observations_of(image);
        let seen = visibility(model, image, &pose, &observations);
        let judged = seen.expected >= params.min_visible_points;
        let is_misplaced = match self.mapper.testimony(image, &pose, &observations) {
            Some(testimony) => testimony.speaks_against(),
            None => {
                judged
                    && !params.is_recognized(&seen)
                    && !self.mapper.shares_as_neighbour(image, &pose)
                    && !self.is_latecomer(image, &pose)
                    && !self.is_held_by_pairs(image, &pose)
            }
        };
        is_misplaced.then_some(seen)
    }

    /// Whether pairs that are so spread are right in the model.
    fn believes(&self, spread: usize) -> bool {
        let Mapper { model, params, .. } = self.mapper;
        self.worth.get_or_init(|| Worth::of(&[model], params.max_error_sigma)).believes(spread)
    }

    fn floor(&self) -> Option<Floor> {
        *self.floor.get_or_init(|| floor_of_all(&self.mapper.model))
    }
}

impl<'a> Mapper<'a> {
    /// Who judges poses in the model as it is.
    pub(super) fn judge(&self) -> Judge<'_, 'a> {
        Judge { mapper: self, worth: OnceLock::new(), floor: OnceLock::new() }
    }

    /// What those say that judge poses in place of what is in plain view; `None` where nobody does.
    pub(super) fn testimony(
        &self,
        image: ImageId,
        world_from_camera: &Rigid,
        inliers: &[(u32, PointId)],
    ) -> Option<Testimony> {
        let witnesses = self.witnesses?;
        Some(witnesses.hear(&self.model, image, world_from_camera, inliers, self.params.max_error_sigma))
    }

    /// What the verified pairs of an image say of a pose.
    pub(super) fn support(&self, image: ImageId, world_from_camera: &Rigid) -> Support {
        Support::of(&self.model, &self.taken, image, world_from_camera, self.params.max_error_sigma)
    }

    fn shares_with_one(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        let (known, asked) = self.neighbours_of(image, world_from_camera);
        share_with_one(&known, &asked)
    }

    /// Whether an image shares with those next to a pose what neighbours do, by what these share with theirs.
    pub(super) fn shares_as_neighbour(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        let (known, asked) = self.neighbours_of(image, world_from_camera);
        share_as_neighbours(&known, &asked)
    }

    /// The pairs of those next to a pose, and what an image there shares with them.
    fn neighbours_of(&self, image: ImageId, world_from_camera: &Rigid) -> (Vec<Neighbours>, Vec<Neighbours>) {
        let model = &self.model;
        let mut is_near = vec![false; model.poses.len()];
        for other in model.registered_neighbours(image) {
            is_near[other.index()] = true;
        }
        let placed = |of: ImageId| {
            let pose = if of == image {
                *world_from_camera
            } else {
                model.poses[of.index()].as_ref()?.world_from_camera
            };
            Some((pose, &model.rays[of.index()]))
        };
        let counts = |first: ImageId, second: ImageId| is_near[first.index()] || is_near[second.index()];
        let pairs = neighbours(model.input, placed, counts, self.params.max_error_sigma);
        pairs.into_iter().partition(|pair| !pair.images.contains(&image))
    }

    /// Share of an image's verified matches to registered images that belong to pairs that agree with a pose.
    ///
    /// Resection from a few points in one corner, or on one plane, can settle on a pose far from the true one; the
    /// essential matrices of the same image rarely share that error. Those of a camera that was found since have another
    /// error, and are not asked. A pair agrees by its rotation, or by its matches: those of one wall fit two rotations, of
    /// which verification takes either.
    fn pair_agreement(&self, image: ImageId, world_from_camera: &Rigid) -> f64 {
        if self.recalibrated[self.model.input.camera_index(image)] {
            return 1.0;
        }
        let (mut agreeing, mut all) = (0, 0);
        for pair in self.model.pairs_of(image) {
            let Some((other, measured)) = pair.seen_from(image) else { continue };
            let Some(pose) = &self.model.poses[other.index()] else { continue };
            let image_from_other = world_from_camera.inverse() * pose.world_from_camera;
            let matches = pair.two_view.inliers.len();
            all += matches;
            let deviation = image_from_other.rotation.angle_to(&measured.rotation);
            let agrees = deviation.to_degrees() <= self.params.max_pair_rotation_deg || {
                let sigmas = self.params.max_error_sigma;
                let on_circles = count_agreeing(&self.model, pair, image, &image_from_other, sigmas);
                on_circles as f64 >= MIN_ON_CIRCLES * matches as f64
            };
            if agrees {
                agreeing += matches;
            }
        }
        if all == 0 { 1.0 } else { agreeing as f64 / all as f64 }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use rand::Rng;
    use setloc_features::{Camera, ImageFeatures, Keypoint};

    use super::*;
    use crate::mapper::{
        MapperInput, MapperParams, Model,
        test_street::{Street, first_two},
        wall,
    };
    use crate::{PairGeometry, TwoView, synthetic::seeded};

    /// Points of one wall fit two rotations, and verification may have taken the other one.
    #[test]
    fn a_pair_that_sees_one_wall_agrees_with_either_pose_that_the_wall_leaves() {
        let mut rng = seeded("one wall");
        let camera = Camera::equirectangular(4096, 2048);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.4);
        let poses = [Rigid::identity(), Rigid::new(turn, Vector3::new(2.0, 0.1, 1.0))];
        let wall: Vec<Vector3<f64>> = (0..120)
            .map(|_| Vector3::new(rng.random_range(-4.0..4.0), rng.random_range(-3.0..3.0), 6.0))
            .collect();
        let features = poses.map(|pose| {
            let mut features = ImageFeatures { width: 4096, height: 2048, ..ImageFeatures::default() };
            for point in &wall {
                let pixel = camera.project(&pose.inverse_transform_point(point)).expect("sees all around");
                let (x, y) = (pixel.x as f32, pixel.y as f32);
                features.keypoints.push(Keypoint { x, y, size: 4.0, orientation: 0.0, noise_px: 0.3 });
                features.colors.push([128; 3]);
            }
            features
        });
        let rays = features.each_ref().map(|features| features.rays(&camera));
        let bearings = wall::Bearings {
            first: &rays[0].bearings,
            second: &rays[1].bearings,
            sigmas_first: &rays[0].sigmas,
            sigmas_second: &rays[1].sigmas,
        };
        let truth = poses[1].inverse() * poses[0];
        let steps = wall::steps_by_wall(&bearings, 1).into_iter();
        let both: Vec<Rigid> = steps.map(|(step, _)| step.first_from_second.inverse()).collect();
        let off_by = |pose: &Rigid| pose.rotation.angle_to(&truth.rotation).to_degrees();
        let other = both.iter().find(|pose| off_by(pose) > 10.0).expect("the wall leaves another pose");
        let two_view = TwoView::of_equal_features(*other, 0..120);
        let pairs = [PairGeometry { first: ImageId(0), second: ImageId(1), two_view }];
        let input = MapperInput::of_one_camera(&camera, &features, &pairs);
        let mut model = Model::new(&input);
        model.set_pose(ImageId(0), Some(poses[0]));
        let params = MapperParams::default();
        let mapper = Mapper::over(&params, model, vec![false; 2], 0);
        assert_eq!(mapper.pair_agreement(ImageId(1), &poses[1]), 1.0);
        assert_eq!(mapper.pair_agreement(ImageId(1), &other.inverse()), 1.0);
        let askew = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.2);
        let askew = Rigid::new(askew * poses[1].rotation, poses[1].translation);
        assert_eq!(mapper.pair_agreement(ImageId(1), &askew), 0.0);
    }

    #[test]
    fn who_looks_like_several_places_waits_for_the_one_that_its_strongest_pair_is_with() {
        // The third panorama shares 20 points with each of the first two, and all with a fourth.
        let mut street = Street::new("elsewhere", 20, 20);
        street.stand_again(2);
        let input = street.input();
        let params = MapperParams::default();
        let image = ImageId(2);
        let accepts = |with_fourth: bool, agreeing: usize| {
            let mut model = first_two(&street, &input);
            if with_fourth {
                model.set_pose(ImageId(3), Some(street.poses[3]));
            }
            let mapper = Mapper::over(&params, model, vec![false; 4], 0);
            let sigmas = params.max_error_sigma;
            let mut pose = PoseHypothesis::at(&mapper.model, &mapper.graph, image, street.poses[2], sigmas);
            assert!(pose.candidates >= 15, "{} candidates", pose.candidates);
            pose.inliers.truncate(pose.candidates * agreeing / 10);
            mapper.judge().first_accepted(image, vec![pose], &mut false, &mut Vec::new()).is_some()
        };
        assert!(!accepts(false, 3), "a third of its matches agree");
        assert!(accepts(false, 7), "most agree");
        assert!(accepts(true, 3), "what it belongs to is mapped");
    }
}
