//! What the verified pairs of an image say of a pose, by where their matches lie.
//!
//! Floors of equal tiles and rooms of one design give wrong pairs whose rotation is right: the rooms stand square to each other.
//! Their directions are wrong, and most of the matches of a right pair miss the epipolar circles of the place that a wrong one
//! gives. One pair may be wrong with more matches than many a right one has, so they are weighed against each other.

use std::{cmp::Reverse, collections::BTreeMap};

use setloc_features::Match;

use super::{model::Model, witnesses::count_agreeing};
use crate::{ImageId, PairGeometry, Rigid, direction};

/// Share of a pair's verified matches on the epipolar circles of a pose from which the pair is for that pose.
pub(super) const MIN_FOR: f64 = 0.8;
/// Pairs that have to be for a pose.
const MIN_PAIRS_FOR: usize = 2;
/// How many times more matches the pairs for a pose must have than the strongest pair against it, and how many times fewer they
/// may have than the strongest pair with an image that waits: that of a room with another panorama of the room. With as many times
/// fewer matches or directions than a pair against it a place is wrong.
const LEAD: usize = 2;
/// Spread of the most spread pair for a pose from which nothing else is asked of what they see: of wrong pairs in rendered floors
/// and streets nine tenths have less than 53, the most spread one 148, the next 82.
const STRONG_SPREAD: usize = 80;
/// Largest share of wrong pairs among those of a model that are as spread as a pair, or more, for that pair to be believed by
/// itself.
const MAX_WRONG: f64 = 0.1;

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
    /// How spread the matches of the pairs for it are ([`direction::spread`]), all together.
    pub spread: usize,
    /// The same of the most spread pair for it. All pairs across two streets may be of one façade, of which more of them show no
    /// more, and a room that stands twice has all its pairs twice.
    pub widest: usize,
    /// The same of the most spread pair that is against it, with an image of the model or of another large part.
    pub spread_against: usize,
    /// The same of the most spread pair with an image that waits.
    pub spread_waiting: usize,
    /// How spread, in the image itself, the matches of all pairs for it are, each direction counted once; `None` of several images.
    pub directions: Option<usize>,
}

impl Support {
    /// Whether that is enough to take it.
    pub fn is_enough(&self, min_matches: usize) -> bool {
        let asked = (LEAD * self.against.max(self.elsewhere)).max(self.waiting / LEAD);
        self.pairs >= MIN_PAIRS_FOR && self.matches >= min_matches.max(asked)
    }

    /// Whether one of the pairs for it leaves few directions out, so that no copy of a part of its surroundings explains it.
    pub fn is_strong(&self) -> bool {
        self.widest >= STRONG_SPREAD
    }

    /// Whether it may be taken by what even one pair says, if such pairs are right.
    pub fn is_enough_if_right(&self) -> bool {
        self.pairs > 0
            && self.spread >= LEAD * self.spread_against
            && LEAD * self.widest >= self.spread_waiting
    }

    /// Whether more speaks against it than for it.
    pub fn is_contradicted(&self) -> bool {
        self.against > self.matches
    }

    /// How far what speaks against it is beyond what may, relative to that: above one it is wrong, whatever else may be said for it.
    ///
    /// That is where the strongest pair against it has [`LEAD`] times the matches of all that are for it, or the most spread one is
    /// as many times as spread as all these together. One picture that hangs in two rooms has hundreds of matches with each
    /// panorama that sees it, all in the same few directions: of 304 places in fourteen models of rendered floors the ten that are
    /// contradicted by more than 1.4 times as many are wrong, and right ones by up to 1.3; in plaza, real streets and a real house
    /// by up to 0.5.
    pub fn contradiction(&self) -> f64 {
        let times = |against: usize, all: usize| against as f64 / (LEAD * all.max(1)) as f64;
        let of_directions = self.directions.map_or(0.0, |all| times(self.spread_against, all));
        times(self.against, self.matches).max(of_directions)
    }

    /// Whether it is wrong by that.
    pub fn is_untenable(&self) -> bool {
        self.contradiction() > 1.0
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
        let asked = ask(model, model.pairs_of(image), pose, max_error_sigma);
        let mut support =
            Self { directions: Some(directions(model, image, asked.values())), ..Self::default() };
        for ([first, second], said) in asked {
            let partner = if first == image { second } else { first };
            if said.agreeing.matches > 0 {
                support.add(said.agreeing);
            } else if model.is_registered(partner) {
                support.against = support.against.max(said.refused.matches);
                support.spread_against = support.spread_against.max(said.refused.spread);
            } else if taken[partner.index()] {
                support.elsewhere = support.elsewhere.max(said.refused.matches);
                support.spread_against = support.spread_against.max(said.refused.spread);
            } else {
                support.waiting = support.waiting.max(said.refused.matches);
                support.spread_waiting = support.spread_waiting.max(said.refused.spread);
            }
        }
        support
    }

    fn add(&mut self, agreeing: Strength) {
        self.pairs += 1;
        self.matches += agreeing.matches;
        self.spread += agreeing.spread;
        self.widest = self.widest.max(agreeing.spread);
    }

    /// Asks the pairs between some images of a model and all others.
    pub fn across(model: &Model<'_>, is_inside: impl Fn(ImageId) -> bool, max_error_sigma: f64) -> Self {
        let crosses = |pair: &&PairGeometry| is_inside(pair.first) != is_inside(pair.second);
        Self::by(model, model.input.pairs.iter().filter(crosses), max_error_sigma)
    }

    /// Asks those of some pairs that are between images of a model.
    pub fn by<'p>(
        model: &Model<'_>,
        pairs: impl Iterator<Item = &'p PairGeometry>,
        max_error_sigma: f64,
    ) -> Self {
        let pose = |of: ImageId| Some(model.poses[of.index()]?.world_from_camera);
        let asked = pairs.filter(|pair| is_within(model, pair));
        Self::of_said(ask(model, asked, pose, max_error_sigma).values())
    }

    fn of_said<'s>(all: impl Iterator<Item = &'s PairSays<'s>>) -> Self {
        let mut support = Self::default();
        for said in all {
            if said.agreeing.matches > 0 {
                support.add(said.agreeing);
            } else {
                support.against = support.against.max(said.refused.matches);
                support.spread_against = support.spread_against.max(said.refused.spread);
            }
        }
        support
    }
}

/// The few images of a model that the pairs with all others speak most against, together, where that is untenable.
///
/// Two panoramas of a room have a strong pair with each other wherever they are put. So not only single images are asked but
/// what the strongest ties of a model make of them, up to `max_images`. Several pairs that are against a place speak together
/// where they agree on another: `elsewhere` gives the place of an image that most of its pairs agree on.
pub(super) fn most_contradicted(
    model: &Model<'_>,
    may_leave: impl Fn(ImageId) -> bool,
    elsewhere: impl Fn(ImageId) -> Option<Rigid>,
    max_images: usize,
    max_error_sigma: f64,
) -> Option<Vec<ImageId>> {
    if !model.registered().any(&may_leave) {
        return None;
    }
    let pose = |of: ImageId| Some(model.poses[of.index()]?.world_from_camera);
    let inside = model.input.pairs.iter().filter(|pair| is_within(model, pair));
    let said = ask(model, inside, pose, max_error_sigma);
    let mut said_of: Vec<Vec<(&[ImageId; 2], &PairSays<'_>)>> = vec![Vec::new(); model.poses.len()];
    for (images, said) in &said {
        for image in images {
            said_of[image.index()].push((images, said));
        }
    }
    let mut ties: Vec<(usize, [ImageId; 2])> =
        said.iter().map(|(images, said)| (said.agreeing.matches, *images)).collect();
    ties.retain(|(matches, _)| *matches > 0);
    ties.sort_unstable_by_key(|&(matches, images)| (Reverse(matches), images));
    let mut group_of: Vec<usize> = (0..model.poses.len()).collect();
    let mut members: Vec<Vec<ImageId>> =
        (0..model.poses.len() as u32).map(|image| vec![ImageId(image)]).collect();
    let mut groups: Vec<Vec<ImageId>> = model.registered().map(|image| vec![image]).collect();
    for (_, images) in ties {
        let [into, from] = images.map(|image| group_of[image.index()]);
        if into == from {
            continue;
        }
        let joining = std::mem::take(&mut members[from]);
        for image in &joining {
            group_of[image.index()] = into;
        }
        members[into].extend(joining);
        if members[into].len() <= max_images {
            let mut group = members[into].clone();
            group.sort_unstable();
            groups.push(group);
        }
    }
    let mut most: Option<(f64, Vec<ImageId>)> = None;
    for group in groups.into_iter().filter(|group| group.iter().all(|&image| may_leave(image))) {
        let crosses = |images: &[ImageId; 2]| group.contains(&images[0]) != group.contains(&images[1]);
        let of_members = || group.iter().flat_map(|image| &said_of[image.index()]);
        let across = || of_members().filter(|(images, _)| crosses(images)).map(|(_, said)| *said);
        let mut support = Support::of_said(across());
        if let [image] = group[..] {
            support.directions = Some(directions(model, image, across()));
        }
        if (LEAD * support.against) as f64 > support.matches as f64 && !support.is_untenable() {
            let other_places = group.iter().filter_map(|&image| {
                let place = elsewhere(image)?;
                Some(matches_for_another_place(model, &group, image, &place, max_error_sigma))
            });
            support.against = other_places.max().unwrap_or(0).max(support.against);
        }
        let contradiction = support.contradiction();
        if support.is_untenable() && most.as_ref().is_none_or(|(most, _)| contradiction > *most) {
            most = Some((contradiction, group));
        }
    }
    most.map(|(_, group)| group)
}

/// Matches of the pairs of an image with those beyond its group that are for another place of it and not for its own.
fn matches_for_another_place(
    model: &Model<'_>,
    group: &[ImageId],
    image: ImageId,
    place: &Rigid,
    max_error_sigma: f64,
) -> usize {
    let leads_away = |pair: &&PairGeometry| {
        let other = pair.seen_from(image).map(|(other, _)| other);
        other.is_some_and(|other| model.is_registered(other) && !group.contains(&other))
    };
    let pairs = || model.pairs_of(image).filter(leads_away);
    let current = |of: ImageId| Some(model.poses[of.index()]?.world_from_camera);
    let other = |of: ImageId| if of == image { Some(*place) } else { current(of) };
    let now = ask(model, pairs(), current, max_error_sigma);
    let there = ask(model, pairs(), other, max_error_sigma);
    let is_moot = |images: &[ImageId; 2]| now.get(images).is_some_and(|said| said.agreeing.matches > 0);
    there.iter().filter(|(images, _)| !is_moot(images)).map(|(_, said)| said.agreeing.matches).sum()
}

/// How far pairs are to be believed by themselves: what those of a model are worth, whose poses tell which are right.
///
/// In a house without repeated things all of 36 pairs are right, in a rendered floor of equal tiles and pictures a third of 305;
/// but of those whose matches spread over many directions nearly all are.
#[derive(Debug)]
pub(super) struct Worth {
    /// How spread each pair is, and whether it is right; the most spread first.
    known: Vec<(usize, bool)>,
}

impl Worth {
    /// Of the pairs between images of one of these models.
    pub fn of(models: &[&Model<'_>], max_error_sigma: f64) -> Self {
        let of_model = |model: &&Model<'_>| -> Vec<(usize, bool)> {
            let known = |pair: &PairGeometry| {
                let pose = |of: ImageId| Some(model.poses[of.index()]?.world_from_camera);
                let second_from_first = pose(pair.second)?.inverse() * pose(pair.first)?;
                let is_right = is_for(model, pair, pair.second, &second_from_first, max_error_sigma);
                Some((spread(model, pair), is_right))
            };
            model.input.pairs.iter().filter_map(known).collect()
        };
        let mut known: Vec<(usize, bool)> = models.iter().flat_map(of_model).collect();
        known.sort_unstable_by_key(|&(spread, is_right)| (Reverse(spread), is_right));
        Self { known }
    }

    /// Whether pairs that are so spread are right, by Laplace's rule of succession; those that are more spread are so no less
    /// often than those that are less.
    pub fn believes(&self, spread: usize) -> bool {
        let (mut all, mut wrong) = (0, 0);
        let mut are_right = |more: &[(usize, bool)]| {
            all += more.len();
            wrong += more.iter().filter(|(_, is_right)| !is_right).count();
            (wrong + 1) as f64 <= MAX_WRONG * (all + 2) as f64
        };
        let (as_spread, less) =
            self.known.split_at(self.known.partition_point(|(of_pair, _)| *of_pair >= spread));
        are_right(as_spread) || less.chunk_by(|a, b| a.0 == b.0).any(are_right)
    }
}

/// The spread of a pair's verified matches in that of its two images in which they are less spread; images of other parts have
/// no rays and are not asked.
fn spread(model: &Model<'_>, pair: &PairGeometry) -> usize {
    let spread_in = |image: ImageId, feature: fn(&Match) -> u32| {
        let bearings = &model.rays[image.index()].bearings;
        let seen = pair.two_view.inliers.iter().filter_map(|m| bearings.get(feature(m) as usize));
        (!bearings.is_empty()).then(|| direction::spread(seen))
    };
    let spreads = [spread_in(pair.first, |m| m.first), spread_in(pair.second, |m| m.second)];
    spreads.into_iter().flatten().min().unwrap_or(0)
}

/// How spread the matches of all agreeing pairs of an image are, together and in that image.
fn directions<'s>(model: &Model<'_>, image: ImageId, said: impl Iterator<Item = &'s PairSays<'s>>) -> usize {
    let bearings = &model.rays[image.index()].bearings;
    let matches: Vec<Match> =
        said.flat_map(|said| &said.agreeing_pairs).flat_map(|pair| pair.matches_from(image)).collect();
    direction::spread(matches.iter().filter_map(|m| bearings.get(m.first as usize)))
}

/// Whether a pair is for a pose of `image`, one of the two, relative to the other.
pub(super) fn is_for(
    model: &Model<'_>,
    pair: &PairGeometry,
    image: ImageId,
    image_from_other: &Rigid,
    max_error_sigma: f64,
) -> bool {
    let agreeing = count_agreeing(model, pair, image, image_from_other, max_error_sigma);
    agreeing as f64 >= MIN_FOR * pair.two_view.inliers.len() as f64
}

/// What a pair weighs.
#[derive(Debug, Clone, Copy, Default)]
struct Strength {
    matches: usize,
    spread: usize,
}

impl Strength {
    fn max(self, other: Self) -> Self {
        Self { matches: self.matches.max(other.matches), spread: self.spread.max(other.spread) }
    }
}

/// The geometries of one pair: the strongest that agrees with the poses of both images and the strongest that does not.
#[derive(Debug, Default)]
struct PairSays<'p> {
    agreeing: Strength,
    refused: Strength,
    /// All that agree.
    agreeing_pairs: Vec<&'p PairGeometry>,
}

/// Whether both images of a pair are registered.
fn is_within(model: &Model<'_>, pair: &PairGeometry) -> bool {
    model.is_registered(pair.first) && model.is_registered(pair.second)
}

/// What pairs say; without a pose nothing agrees.
fn ask<'p>(
    model: &Model<'_>,
    pairs: impl Iterator<Item = &'p PairGeometry>,
    pose: impl Fn(ImageId) -> Option<Rigid>,
    max_error_sigma: f64,
) -> BTreeMap<[ImageId; 2], PairSays<'p>> {
    let mut said: BTreeMap<[ImageId; 2], PairSays<'p>> = BTreeMap::new();
    for pair in pairs {
        let agrees = pose(pair.first).zip(pose(pair.second)).is_some_and(|(first, second)| {
            is_for(model, pair, pair.second, &(second.inverse() * first), max_error_sigma)
        });
        let said = said.entry([pair.first, pair.second]).or_default();
        let strength = Strength { matches: pair.two_view.inliers.len(), spread: spread(model, pair) };
        if agrees {
            said.agreeing_pairs.push(pair);
        }
        let most = if agrees { &mut said.agreeing } else { &mut said.refused };
        *most = most.max(strength);
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
            Support { pairs, matches, against, waiting, ..Support::default() }.is_enough(50)
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

    /// The figures of a panorama that one picture puts into another room, and of one in its place.
    #[test]
    fn many_matches_in_few_directions_do_not_outweigh_a_pair_that_shows_more() {
        let of = |directions: usize, spread_against: usize| {
            let (pairs, matches, against) = (3, 288, 224);
            let directions = Some(directions);
            Support { pairs, matches, against, spread_against, directions, ..Support::default() }
        };
        assert!(of(30, 67).is_untenable() && !of(62, 82).is_untenable());
        assert!(of(30, 67).contradiction() > of(30, 62).contradiction());
        // Of several images together matches alone tell.
        assert!(!Support { directions: None, ..of(30, 67) }.is_untenable());
    }

    #[test]
    fn directions_that_several_pairs_show_count_once() {
        let street = Street::new("directions", 60, POINTS);
        let input = street.input();
        let model = first_two(&street, &input);
        let support = Support::of(&model, &[false; 3], ImageId(2), &street.poses[2], SIGMAS);
        let together = support.directions.expect("of one image");
        assert_eq!(support.pairs, 2);
        assert!(support.widest <= together && together < support.spread, "{support:?}");
        let elsewhere = Rigid::new(street.poses[2].rotation, street.poses[2].translation.yzx());
        let support = Support::of(&model, &[false; 3], ImageId(2), &elsewhere, SIGMAS);
        assert_eq!(support.directions, Some(0));
    }

    #[test]
    fn pairs_are_believed_by_what_those_as_spread_or_less_are_worth() {
        let worth = |known: &[(usize, bool)]| Worth { known: known.to_vec() };
        let all_right: Vec<(usize, bool)> = (0..9).map(|at| (60 - at, true)).collect();
        assert!(worth(&all_right[..8]).believes(20) && worth(&all_right[..8]).believes(52));
        assert!(!worth(&all_right[..7]).believes(20), "too few to tell");
        // What less spread pairs are worth, those that are more spread are, too.
        assert!(worth(&all_right).believes(59));
        let mixed = [all_right, vec![(40, false), (39, true), (38, false)]].concat();
        assert!(worth(&mixed).believes(41) && !worth(&mixed).believes(40) && !worth(&mixed).believes(38));
        assert!(!worth(&[]).believes(1000));
    }

    #[test]
    fn two_that_belong_together_are_contradicted_together() {
        // The third and the fourth image have a strong pair with each other, and stand aside.
        let mut street = Street::new("together", 60, POINTS);
        street.stand_again(2);
        let input = street.input();
        let mut model = Model::new(&input);
        let place = |model: &mut Model<'_>, aside: f64| {
            let step = Vector3::new(aside, 0.0, aside);
            for (image, pose) in street.poses.iter().enumerate() {
                let step = if image >= 2 { step } else { Vector3::zeros() };
                let pose = Rigid::new(pose.rotation, pose.translation + step);
                model.set_pose(ImageId(image as u32), Some(pose));
            }
        };
        let may_leave = |image: ImageId| image >= ImageId(2);
        let contradicted =
            |model: &Model<'_>, most: usize| most_contradicted(model, may_leave, |_| None, most, SIGMAS);
        place(&mut model, 3.0);
        assert_eq!(contradicted(&model, 2), Some(vec![ImageId(2), ImageId(3)]));
        assert_eq!(contradicted(&model, 1), None);
        place(&mut model, 0.0);
        assert_eq!(contradicted(&model, 2), None);
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
        let of_image = Support::of(&model, &[false; 3], ImageId(2), &truth, SIGMAS);
        assert_eq!(across(&model), Support { directions: None, ..of_image });
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
            let inliers = Vec::new();
            let pose =
                PoseHypothesis { world_from_camera, inliers, candidates: 20, visibility, length: None };
            mapper.judge().first_accepted(ImageId(2), vec![pose], &mut false, &mut Vec::new()).is_some()
        };
        assert!(accepts(0.0) && !accepts(2.0));
    }
}
