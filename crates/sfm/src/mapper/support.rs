//! What the verified pairs of an image say of a pose, by where their matches lie.
//!
//! Floors of equal tiles and rooms of one design give wrong pairs whose rotation is right: the rooms stand square to each other.
//! Their directions are wrong, and most of the matches of a right pair miss the epipolar circles of the place that a wrong one
//! gives. One pair may be wrong with more matches than many a right one has, so they are weighed against each other.

use std::collections::BTreeMap;

use super::{model::Model, witnesses::count_agreeing};
use crate::{ImageId, PairGeometry, Rigid};

/// Share of a pair's verified matches on the epipolar circles of a pose from which the pair is for that pose.
const MIN_FOR: f64 = 0.8;
/// Pairs that have to be for a pose.
const MIN_PAIRS_FOR: usize = 2;
/// How many times more matches the pairs for a pose must have than the strongest pair against it, and how many times fewer they
/// may have than the strongest pair with an image that waits: that of a room with another panorama of the room.
const LEAD: usize = 2;

/// What the verified pairs of an image say of a pose.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Support {
    /// Pairs for it.
    pub pairs: usize,
    /// Matches of these.
    pub matches: usize,
    /// Matches of the strongest pair that is against it, of those with images of the model.
    pub against: usize,
    /// Matches of the strongest pair with an image of another large part.
    pub elsewhere: usize,
    /// Matches of the strongest pair with an image that waits, too, and says nothing yet.
    pub waiting: usize,
}

impl Support {
    /// Whether that is enough to take it.
    pub fn is_enough(&self, min_matches: usize) -> bool {
        let asked = (LEAD * self.against.max(self.elsewhere)).max(self.waiting / LEAD);
        self.pairs >= MIN_PAIRS_FOR && self.matches >= min_matches.max(asked)
    }

    /// How many times more matches the strongest pair against it has than all that are for it.
    pub fn contradiction(&self) -> f64 {
        self.against as f64 / self.matches.max(1) as f64
    }

    /// Whether more speaks against it than for it.
    pub fn is_contradicted(&self) -> bool {
        self.contradiction() > 1.0
    }

    /// Whether so much more speaks against it that it is wrong, whatever else may be said for it.
    pub fn is_untenable(&self) -> bool {
        self.contradiction() > LEAD as f64
    }

    /// Whether more than one pair speaks for it, and nothing much against.
    pub fn is_clear(&self) -> bool {
        self.pairs >= MIN_PAIRS_FOR && self.matches >= LEAD * self.against
    }

    /// Asks all pairs of an image; `taken` are the images of other large parts.
    pub fn of(
        model: &Model<'_>,
        taken: &[bool],
        image: ImageId,
        world_from_camera: &Rigid,
        max_error_sigma: f64,
    ) -> Self {
        let pose = |of: ImageId| {
            if of == image {
                Some(*world_from_camera)
            } else {
                Some(model.poses[of.index()]?.world_from_camera)
            }
        };
        let mut support = Self::default();
        for ([first, second], said) in
            ask(model, |pair| pair.seen_from(image).is_some(), pose, max_error_sigma)
        {
            let partner = if first == image { second } else { first };
            if said.agreeing > 0 {
                support.pairs += 1;
                support.matches += said.agreeing;
            } else if model.is_registered(partner) {
                support.against = support.against.max(said.refused);
            } else if taken[partner.index()] {
                support.elsewhere = support.elsewhere.max(said.refused);
            } else {
                support.waiting = support.waiting.max(said.refused);
            }
        }
        support
    }

    /// Asks the pairs between some images of a model and all others.
    pub fn across(model: &Model<'_>, is_inside: impl Fn(ImageId) -> bool, max_error_sigma: f64) -> Self {
        let crosses = |pair: &PairGeometry| {
            let ends = [pair.first, pair.second];
            ends.iter().all(|&image| model.is_registered(image)) && is_inside(ends[0]) != is_inside(ends[1])
        };
        let pose = |of: ImageId| Some(model.poses[of.index()]?.world_from_camera);
        let mut support = Self::default();
        for said in ask(model, crosses, pose, max_error_sigma).into_values() {
            if said.agreeing > 0 {
                support.pairs += 1;
                support.matches += said.agreeing;
            } else {
                support.against = support.against.max(said.refused);
            }
        }
        support
    }
}

/// Matches of the geometries of one pair: of the strongest that agrees with the poses of both images and of the strongest that
/// does not.
#[derive(Debug, Default)]
struct PairSays {
    agreeing: usize,
    refused: usize,
}

/// What those pairs say that `counts` chooses; without a pose nothing agrees.
fn ask(
    model: &Model<'_>,
    counts: impl Fn(&PairGeometry) -> bool,
    pose: impl Fn(ImageId) -> Option<Rigid>,
    max_error_sigma: f64,
) -> BTreeMap<[ImageId; 2], PairSays> {
    let mut said: BTreeMap<[ImageId; 2], PairSays> = BTreeMap::new();
    for pair in model.input.pairs.iter().filter(|pair| counts(pair)) {
        let matches = pair.two_view.inliers.len();
        let agrees = pose(pair.first).zip(pose(pair.second)).is_some_and(|(first, second)| {
            let second_from_first = second.inverse() * first;
            let agreeing = count_agreeing(model, pair, pair.second, &second_from_first, max_error_sigma);
            agreeing as f64 >= MIN_FOR * matches as f64
        });
        let said = said.entry([pair.first, pair.second]).or_default();
        let most = if agrees { &mut said.agreeing } else { &mut said.refused };
        *most = matches.max(*most);
    }
    said
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::{
        Mapper, MapperParams,
        register::{PoseHypothesis, Visibility},
        test_street::{POINTS, Street, first_two},
    };
    use super::*;

    const SIGMAS: f64 = 6.0;

    #[test]
    fn one_pair_or_a_strong_contradiction_is_not_enough() {
        let enough = |pairs, matches, against, waiting| {
            Support { pairs, matches, against, waiting, elsewhere: 0 }.is_enough(50)
        };
        assert!(enough(2, 300, 150, 0) && enough(2, 300, 0, 600));
        assert!(!enough(1, 300, 0, 0) && !enough(2, 49, 0, 0));
        assert!(!enough(2, 300, 160, 0) && !enough(2, 300, 0, 700));
    }

    /// The figures of a room behind a door, in its place and where it was taken for.
    #[test]
    fn a_clear_pose_and_a_contradicted_one_are_told_apart() {
        let of = |pairs, matches, against| Support { pairs, matches, against, ..Support::default() };
        assert!(of(2, 317, 95).is_clear() && !of(2, 317, 95).is_contradicted());
        assert!(!of(1, 317, 0).is_clear() && !of(2, 188, 95).is_clear());
        assert!(of(2, 188, 271).is_contradicted() && !of(2, 188, 271).is_untenable());
        assert!(of(1, 59, 735).is_untenable() && of(0, 0, 20).is_untenable());
        assert!(!Support::default().is_contradicted());
    }

    #[test]
    fn pairs_speak_for_the_true_pose_and_against_one_a_step_aside() {
        let street = Street::new("support", 60, POINTS);
        let input = street.input();
        let model = first_two(&street, &input);
        let truth = street.poses[2];
        let of = |pose: &Rigid| Support::of(&model, &[false; 3], ImageId(2), pose, SIGMAS);
        let right = of(&truth);
        assert_eq!((right.pairs, right.against), (2, 0), "{right:?}");
        assert!(right.matches > 150 && right.is_enough(50) && !right.is_contradicted());
        let aside = Rigid::new(truth.rotation, truth.translation + Vector3::new(2.0, 0.0, 0.0));
        let wrong = of(&aside);
        assert!(wrong.pairs == 0 && wrong.against > 100 && wrong.is_untenable(), "{wrong:?}");
    }

    #[test]
    fn what_is_said_between_two_parts_is_what_the_pairs_across_say() {
        let street = Street::new("across", 60, POINTS);
        let input = street.input();
        let mut model = first_two(&street, &input);
        let across = |model: &Model<'_>| Support::across(model, |image| image == ImageId(2), SIGMAS);
        assert_eq!(across(&model), Support::default());
        let truth = street.poses[2];
        model.set_pose(ImageId(2), Some(truth));
        assert_eq!(across(&model), Support::of(&model, &[false; 3], ImageId(2), &truth, SIGMAS));
        model.set_pose(ImageId(2), Some(Rigid::new(truth.rotation, truth.translation * 1.2)));
        assert!(!across(&model).is_contradicted(), "along the street both directions stay as they are");
        model.set_pose(ImageId(2), Some(Rigid::new(truth.rotation, truth.translation.yzx())));
        assert!(across(&model).is_contradicted());
    }

    /// Nothing that ought to be in plain view tells.
    #[test]
    fn a_panorama_is_not_taken_where_more_speaks_against_it_than_for_it() {
        let street = Street::new("refused", 60, POINTS);
        let (input, params) = (street.input(), MapperParams::default());
        let mapper = Mapper::over(&params, first_two(&street, &input), vec![false; 3], 0);
        let accepts = |aside: f64| {
            let truth = street.poses[2];
            let world_from_camera =
                Rigid::new(truth.rotation, truth.translation + Vector3::new(aside, 0.0, 0.0));
            let visibility = Visibility { expected: 0, matched: 0, expected_cells: 0, matched_cells: 0 };
            let pose = PoseHypothesis { world_from_camera, inliers: Vec::new(), candidates: 20, visibility };
            mapper.first_accepted(ImageId(2), vec![pose], &mut false, &mut Vec::new()).is_some()
        };
        assert!(accepts(0.0) && !accepts(2.0));
    }
}
