//! Matches across a place that agree with its model by chance.
//!
//! Where façades look alike in parallel streets, pairs of panoramas that share nothing are verified, with dozens of matches of which
//! a few lie on the epipolar circles of the model, too. These are far apart and nearly all wrong, what they miss by is
//! spread evenly up to the bound, and since their rays are next to parallel they hold rotations of streets against each other. Where a
//! street is held to the next by a few dozen right matches, they turn it by a third of a degree.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::{Mapper, model::Model, witnesses::count_agreeing};
use crate::{ImageId, PairGeometry};

/// Least share of a pair's matches that lies on the circles of images that stand where the pair says.
const MIN_AGREEING: f64 = 0.8;
/// Farthest apart, in steps from image to image by pairs that agree, that two images see one thing where their own pair disagrees.
const MAX_STEPS: usize = 3;

impl Mapper<'_> {
    /// Leaves out the pairs of images far apart that disagree with the model. Returns the observations dropped.
    pub(super) fn leave_out_strays(&mut self) -> usize {
        let strays = stray_pairs(&self.model, self.params.max_error_sigma);
        if strays.contains(&true) { self.leave_out(&strays) } else { 0 }
    }
}

/// Which pairs disagree with the model though others place their images, and these so that they can see nothing together.
fn stray_pairs(model: &Model<'_>, max_error_sigma: f64) -> Vec<bool> {
    let pairs = model.input.pairs;
    let agreement: Vec<Option<bool>> =
        pairs.par_iter().map(|pair| agrees(model, pair, max_error_sigma)).collect();
    let mut next_to = vec![Vec::new(); model.input.images.len()];
    for (pair, _) in pairs.iter().zip(&agreement).filter(|(_, agrees)| **agrees == Some(true)) {
        next_to[pair.first.index()].push(pair.second);
        next_to[pair.second.index()].push(pair.first);
    }
    let are_far_apart = |pair: &PairGeometry| {
        steps_between(&next_to, pair.first, pair.second).is_some_and(|steps| steps > MAX_STEPS)
    };
    let is_stray =
        |(pair, agrees): (&PairGeometry, &Option<bool>)| *agrees == Some(false) && are_far_apart(pair);
    pairs.par_iter().zip(&agreement).map(is_stray).collect()
}

/// Whether most of a pair's matches lie on the epipolar circles of its images' poses; `None` where one has none.
fn agrees(model: &Model<'_>, pair: &PairGeometry, max_error_sigma: f64) -> Option<bool> {
    let pose = |image: ImageId| Some(model.poses[image.index()]?.world_from_camera);
    let second_from_first = pose(pair.second)?.inverse() * pose(pair.first)?;
    let agreeing = count_agreeing(model, pair, pair.second, &second_from_first, max_error_sigma);
    Some(agreeing as f64 >= MIN_AGREEING * pair.two_view.inliers.len() as f64)
}

/// How many steps lead from one image to another; `None` where none do.
fn steps_between(next_to: &[Vec<ImageId>], from: ImageId, to: ImageId) -> Option<usize> {
    let (mut reached, mut front, mut steps) = (BTreeSet::from([from]), vec![from], 0);
    while !front.is_empty() {
        if reached.contains(&to) {
            return Some(steps);
        }
        let beyond = front.iter().flat_map(|at| &next_to[at.index()]).copied();
        front = beyond.filter(|&image| reached.insert(image)).collect();
        steps += 1;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::super::{
        MapperInput, MapperParams,
        structure::triangulate_image,
        test_street::{POINTS, Street},
    };
    use super::*;
    use crate::Observation;

    const SIGMAS: f64 = 6.0;

    /// Seven panoramas, each next to the one before, of which two have a pair besides whose matches are wrong; `cut` parts them
    /// in the middle but for that.
    fn street(wrong: [usize; 2], cut: bool) -> Street {
        let mut street = Street::new("stray", POINTS, POINTS);
        (2..6).for_each(|image| street.stand_again(image));
        street.match_wrongly(wrong[0], wrong[1]);
        if cut {
            street.unpair(3, 4);
        }
        street
    }

    /// The model of all of them, where they are.
    fn mapped<'a>(street: &Street, input: &'a MapperInput<'a>) -> Model<'a> {
        let mut model = Model::new(input);
        let images = (0..street.poses.len() as u32).map(ImageId);
        images.clone().zip(&street.poses).for_each(|(image, pose)| model.set_pose(image, Some(*pose)));
        let limits = MapperParams::default().limits();
        images.for_each(|image| triangulate_image(&mut model, &street.graph(), limits, image));
        model
    }

    #[test]
    fn wrong_pairs_are_stray_where_others_put_their_images_far_apart() {
        let is_stray = |wrong, cut| {
            let street = street(wrong, cut);
            let input = street.input();
            let strays = stray_pairs(&mapped(&street, &input), SIGMAS);
            let (last, right) = strays.split_last().expect("has pairs");
            assert!(!right.contains(&true), "{strays:?}");
            *last
        };
        assert!(is_stray([0, 6], false));
        assert!(!is_stray([0, 4], false), "three steps by 2 and 3");
        assert!(!is_stray([0, 6], true), "nothing else tells where they stand");
    }

    #[test]
    fn what_only_pairs_tie_that_are_left_out_comes_apart() {
        let street = street([0, 6], false);
        let (input, params) = (street.input(), MapperParams::default());
        let model = mapped(&street, &input);
        let mut mapper = Mapper::over(&params, model, vec![false; 7], 0);
        let seen = |image: u32, feature| Observation { image: ImageId(image), feature };
        let of = |mapper: &Mapper<'_>, seen| mapper.model.point_of(seen);
        // What the wrong pair says of a point that the first two see, and of one that nobody else does.
        let [(matched, wrongly), (alone, too)] = [0, 1].map(Street::wrong_match);
        let shared = of(&mapper, seen(0, matched)).expect("was triangulated");
        for feature in [wrongly, too] {
            let other = of(&mapper, seen(6, feature)).expect("was triangulated");
            mapper.model.remove_point(other);
        }
        let position = mapper.model.point(shared).expect("lives").position;
        mapper.model.add_observation(shared, seen(6, wrongly));
        let lone = of(&mapper, seen(0, alone)).expect("was triangulated");
        mapper.model.remove_point(lone);
        let lone = mapper.model.add_point(position, vec![seen(0, alone), seen(6, too)]);
        // What no pair tells, a pose did.
        let found = of(&mapper, seen(1, 2)).expect("was triangulated");
        mapper.model.remove_point(found);
        mapper.model.remove_observation(shared, seen(1, matched));
        mapper.model.add_observation(shared, seen(1, 2));
        let before = mapper.model.observation_count();
        assert_eq!(mapper.leave_out_strays(), 3);
        assert_eq!(mapper.model.observation_count(), before - 3);
        assert!(mapper.model.point(lone).is_none());
        assert_eq!(of(&mapper, seen(6, wrongly)), None);
        assert_eq!(of(&mapper, seen(0, matched)), Some(shared));
        assert_eq!(of(&mapper, seen(1, 2)), Some(shared));
        assert_eq!(mapper.leave_out_strays(), 0);
    }
}
