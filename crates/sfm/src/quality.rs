//! The quality gate: what in a finished model disagrees with its own evidence.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet},
};

use serde::{Deserialize, Serialize};

use crate::{
    ImageId, PairGeometry, Reconstruction, ReconstructionImage, ReconstructionPoint, TwoViewKind,
    common_views::CommonViews, estranged::estranged, listed,
};

/// When to speak up.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct QualityParams {
    /// Rotation between a verified pair and the final poses that counts as disagreement, in degrees.
    pub max_rotation_deg: f64,
    /// Share of points in plain view of two cameras that they must both see. In right models of real tours and rendered streets
    /// no two share less than 0.20 (one room by day and by night 0.75), in folded floors many less than 0.1.
    pub min_shared_view: f64,
    /// Points in plain view below which nothing is concluded.
    pub min_expected_points: usize,
    /// Share of either image's points that must be in plain view of the other for the two to stand together.
    pub min_expected_share: f64,
    /// Fewest points of a well supported image.
    pub min_image_points: usize,
    /// Whether images of scenes are left out that fewer points hold than that, where far more matches contradict their place.
    pub leave_out_misplaced: bool,
}

impl Default for QualityParams {
    fn default() -> Self {
        Self {
            max_rotation_deg: 3.0,
            min_shared_view: 0.1,
            min_expected_points: 150,
            min_expected_share: 0.8,
            min_image_points: 50,
            leave_out_misplaced: true,
        }
    }
}

/// A verified pair of which no geometry agrees with the final model; told by the one with most matches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairDisagreement {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Verified matches of the pair.
    pub matches: usize,
    /// Those that became one point of the model.
    pub used: usize,
    /// Angle between the pair's relative rotation and the model's, in degrees.
    pub rotation_deg: f64,
}

impl PairDisagreement {
    /// Whether so many matches cannot be what the model has that they speak against it by themselves.
    fn is_heavy(&self) -> bool {
        let is_turned = self.rotation_deg > HEAVY_ROTATION_DEG && !self.is_explained();
        self.matches >= HEAVY_MATCHES && (self.is_unused() || is_turned || self.is_barely_used())
    }

    /// Whether the model, in which the pair is turned otherwise, has less than a quarter of what it shares: as of two rooms of like
    /// furniture, where some of it coincides.
    fn is_barely_used(&self) -> bool {
        self.used * 4 < self.matches
    }

    /// Whether most of what the pair shares became points of the model: then these matches fit it, and the pair's own rotation is the
    /// other one of the two that the matches of a wall leave.
    fn is_explained(&self) -> bool {
        self.used * 2 >= self.matches
    }

    /// Whether next to nothing of what the pair shares became points of the model.
    fn is_unused(&self) -> bool {
        self.used * 5 < self.matches
    }
}

/// A verified pair that a model contradicts though it has about as many matches as the model has points where these hold its
/// two images together: it may well be the model that is wrong there. Or one with an image of a larger model, which has far more
/// matches than its first image has points with any of its own.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutvotedPair {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Verified matches of the pair.
    pub matches: usize,
    /// Points of the weakest link between the two, on the way of the strongest links.
    pub held_by: usize,
    /// The images that are with the first when that link is cut, ascending.
    pub side: Vec<ImageId>,
}

impl OutvotedPair {
    /// Matches for each point that holds the model together there.
    pub fn weight(&self) -> f64 {
        self.matches as f64 / self.held_by.max(1) as f64
    }
}

/// Weight from which on a pair makes it doubtful where the images on either side of the link are to each other. In right
/// models of rendered panoramas pairs of repeated structure weigh up to 1.03, in folded ones right pairs 2.1 to 4.2.
const FOLD_WEIGHT: f64 = 1.5;

/// Points that tie an image to a doubtful one, and how far doubt goes from tie to tie. Of six panoramas of a rendered arcade two
/// were cut off, and of the other four two were misplaced.
const DOUBTFUL_TIE: usize = 20;
const DOUBTFUL_STEPS: usize = 2;

/// The registered images of a component about which it may be folded; ascending.
///
/// Those that no link ties to most others once the links that such pairs outweigh are cut, all where none ties more than
/// half; those that stand together and share next to nothing where that [is confirmed](SuspiciousNeighbours::is_confirmed); and those that
/// share points with either, as what looks alike there may have misplaced these, too.
pub fn doubtful_images(
    component: &Reconstruction,
    outvoted: &[OutvotedPair],
    suspicious: &[SuspiciousNeighbours],
) -> Vec<ImageId> {
    let mut doubtful = beyond_outweighed_links(component, outvoted);
    let folded = suspicious.iter().filter(|pair| pair.is_confirmed);
    doubtful.extend(folded.flat_map(|pair| [pair.first, pair.second]));
    if doubtful.is_empty() {
        return Vec::new();
    }
    let images_of = |point: &ReconstructionPoint| point.track.iter().map(|seen| seen.image).collect();
    let seen_by: Vec<BTreeSet<ImageId>> = component.points.iter().map(images_of).collect();
    for _ in 0..DOUBTFUL_STEPS {
        let mut ties: BTreeMap<ImageId, usize> = BTreeMap::new();
        for seen in &seen_by {
            if !seen.is_disjoint(&doubtful) {
                seen.difference(&doubtful).for_each(|image| *ties.entry(*image).or_default() += 1);
            }
        }
        doubtful
            .extend(ties.into_iter().filter(|(_, points)| *points >= DOUBTFUL_TIE).map(|(image, _)| image));
    }
    doubtful.into_iter().collect()
}

/// Images that no link ties to most others of the component once those that some pairs outweigh are cut.
fn beyond_outweighed_links(component: &Reconstruction, outvoted: &[OutvotedPair]) -> BTreeSet<ImageId> {
    let heavy: Vec<&OutvotedPair> = outvoted.iter().filter(|pair| pair.weight() >= FOLD_WEIGHT).collect();
    if heavy.is_empty() {
        return BTreeSet::new();
    }
    let group_of = |image: ImageId| -> Vec<bool> {
        heavy.iter().map(|pair| pair.side.binary_search(&image).is_ok()).collect()
    };
    let mut groups: BTreeMap<Vec<bool>, BTreeSet<ImageId>> = BTreeMap::new();
    for image in component.registered() {
        groups.entry(group_of(image)).or_default().insert(image);
    }
    let all = component.registered().count();
    groups.retain(|_, images| 2 * images.len() <= all);
    groups.into_values().flatten().collect()
}

/// Two cameras that stand together in the model but hardly share what both ought to see: the sign of a fold.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SuspiciousNeighbours {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Points of the first that the second sees from nearly the same place.
    pub expected: usize,
    /// Points that both see, from wherever.
    pub shared: usize,
    /// Whether more than this tells a fold from trees or a wall that stand between: many matches of either contradict the model, or
    /// either shares nothing at all with two that it stands together with.
    pub is_confirmed: bool,
}

impl SuspiciousNeighbours {
    fn share(&self) -> f64 {
        self.shared as f64 / self.expected as f64
    }
}

/// What disagrees, counted; [`Self::sentences`] says it in words.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct QualityReport {
    /// Images of this component.
    pub registered: usize,
    /// All input images.
    pub images: usize,
    /// Verified pairs within the component.
    pub pairs: usize,
    /// Pairs that the model contradicts; expected where façades repeat, as long as they are few.
    pub disagreements: Vec<PairDisagreement>,
    /// Those of them that weigh more than what holds the model together there, and what its images share with larger models.
    pub outvoted: Vec<OutvotedPair>,
    /// Signs of a fold.
    pub suspicious: Vec<SuspiciousNeighbours>,
    /// Registered images with few points.
    pub weak_images: Vec<(ImageId, usize)>,
}

/// Compares a component with the verified pairs that it and the larger ones were built from.
///
/// `is_underfoot` tells of which pairs paving is all that they explain ([`crate::pairs_underfoot`]), none beyond its end: those agree, or
/// say nothing. A street's paving repeats itself exactly where it is rendered, and two panoramas have up to 1600 matches that take one
/// row of stones for another.
pub fn assess(
    params: &QualityParams,
    reconstruction: &Reconstruction,
    larger: &[Reconstruction],
    pairs: &[PairGeometry],
    is_underfoot: &[bool],
) -> QualityReport {
    let n = reconstruction.images.len();
    let mut report = QualityReport {
        registered: reconstruction.registered().count(),
        images: n,
        ..QualityReport::default()
    };
    let views = CommonViews::of(reconstruction);
    // Of the geometries of one pair the model can have one only.
    let mut judged: BTreeMap<(ImageId, ImageId), (PairDisagreement, bool)> = BTreeMap::new();
    let mut telling = Vec::with_capacity(pairs.len());
    for (at, pair) in pairs.iter().enumerate() {
        let is_underfoot = is_underfoot.get(at) == Some(&true);
        if !is_underfoot {
            telling.push(pair);
        }
        let poses = (
            reconstruction.images[pair.first.index()].world_from_camera,
            reconstruction.images[pair.second.index()].world_from_camera,
        );
        let (Some(first), Some(second)) = poses else { continue };
        let used = views.shared(pair.first, pair.second);
        let two_view = &pair.two_view;
        let found = PairDisagreement {
            first: pair.first,
            second: pair.second,
            matches: two_view.inliers.len(),
            used,
            rotation_deg: (second.inverse() * first)
                .rotation
                .angle_to(&two_view.second_from_first.rotation)
                .to_degrees(),
        };
        let is_turned = found.rotation_deg > params.max_rotation_deg
            && two_view.kind == TwoViewKind::General
            && !found.is_explained();
        // What images share that were turned on the spot becomes no points.
        let is_mere_turn =
            two_view.kind == TwoViewKind::PureRotation && found.rotation_deg <= params.max_rotation_deg;
        let agrees = is_mere_turn || !found.is_unused() && !is_turned;
        if is_underfoot && !agrees {
            continue;
        }
        let (kept, any_agrees) =
            judged.entry((pair.first, pair.second)).or_insert_with(|| (found.clone(), false));
        *any_agrees |= agrees;
        if found.matches > kept.matches {
            *kept = found;
        }
    }
    report.pairs = judged.len();
    let disagreements = judged.into_values().filter(|(_, any_agrees)| !any_agrees);
    report.disagreements = disagreements.map(|(found, _)| found).collect();
    let links = strongest_links(n, views.sharing());
    let spots = of_one_spot(&reconstruction.images);
    let heavy: Vec<&PairDisagreement> = report.disagreements.iter().filter(|pair| pair.is_heavy()).collect();
    let contradicted: BTreeSet<ImageId> = heavy.iter().flat_map(|pair| [pair.first, pair.second]).collect();
    report.outvoted = heavy.into_iter().filter_map(|pair| outvoted(pair, &spots, &links)).collect();
    report.outvoted.extend(estranged(reconstruction, larger, &telling, |image| views.most_shared(image)));
    let is_near =
        |seen: usize, by: ImageId| seen as f64 >= params.min_expected_share * views.points_of(by) as f64;
    for (first, second) in views.expecting() {
        let [forth, back] = [views.between(first, second), views.between(second, first)];
        let (wanted, got) = (forth.expected + back.expected, forth.shared + back.shared);
        // One in the street sees nothing of what one behind a door sees, which has most of the street in plain view.
        let together = is_near(forth.expected, first) && is_near(back.expected, second);
        if together
            && wanted >= params.min_expected_points
            && (got as f64) < params.min_shared_view * wanted as f64
        {
            let is_confirmed = contradicted.contains(&first) || contradicted.contains(&second);
            let found = SuspiciousNeighbours { first, second, expected: wanted, shared: got, is_confirmed };
            report.suspicious.push(found);
        }
    }
    let points = reconstruction.registered().map(|image| (image, views.points_of(image)));
    report.weak_images = points.filter(|(_, points)| *points < params.min_image_points).collect();
    confirm_by_each_other(&mut report.suspicious);
    report
}

/// Share of the points in plain view of two images below which they share nothing. In right models the least are 0.03 (one thing under
/// another lamp in each photo) and 0.035 (trees between), in models of what repeats exactly it is 0 to 0.005 of most pairs.
const NOTHING: f64 = 0.01;
/// How many images one must share nothing with: a wall may stand between two.
const MIN_STRANGERS: usize = 2;

/// Confirms what is suspicious of images that share nothing with several that they stand together with.
fn confirm_by_each_other(suspicious: &mut [SuspiciousNeighbours]) {
    let mut strangers: BTreeMap<ImageId, usize> = BTreeMap::new();
    for pair in suspicious.iter().filter(|pair| pair.share() < NOTHING) {
        for image in [pair.first, pair.second] {
            *strangers.entry(image).or_default() += 1;
        }
    }
    strangers.retain(|_, count| *count >= MIN_STRANGERS);
    for pair in suspicious {
        pair.is_confirmed |= strangers.contains_key(&pair.first) || strangers.contains_key(&pair.second);
    }
}

/// Fewest matches of a pair that speaks against a model by itself.
pub(crate) const HEAVY_MATCHES: usize = 50;
/// Rotation from which on none of them can be right in the model, whatever became points.
const HEAVY_ROTATION_DEG: f64 = 30.0;

/// How much a pair must weigh for that. In right models of photos those that are wrong weigh up to 0.50, against wrong
/// ones right ones from 1.3 on.
const MIN_WEIGHT: f64 = 0.75;

/// Two images and the points that they share.
type LinkBetween = (ImageId, ImageId, usize);

/// Groups of images that are tied together: disjoint sets, the smaller one joined to the larger.
#[derive(Clone)]
struct Groups {
    /// Another image of the same group, itself for one of each.
    toward: Vec<usize>,
    /// Images of a group, by that one.
    size: Vec<usize>,
}

impl Groups {
    fn new(images: usize) -> Self {
        Self { toward: (0..images).collect(), size: vec![1; images] }
    }

    fn len(&self) -> usize {
        self.toward.len()
    }

    fn root(&self, mut image: usize) -> usize {
        while self.toward[image] != image {
            image = self.toward[image];
        }
        image
    }

    /// Makes the groups of two images one; `false` where they already are.
    fn union(&mut self, a: usize, b: usize) -> bool {
        let [a, b] = [a, b].map(|image| self.root(image));
        let (larger, smaller) = if self.size[a] >= self.size[b] { (a, b) } else { (b, a) };
        if larger != smaller {
            self.toward[smaller] = larger;
            self.size[larger] += self.size[smaller];
        }
        larger != smaller
    }

    fn equiv(&self, a: usize, b: usize) -> bool {
        self.root(a) == self.root(b)
    }
}

/// Images that were turned on one spot, to which the mapper gives exactly one centre; they need not share any point.
fn of_one_spot(images: &[ReconstructionImage]) -> Groups {
    let mut spots = Groups::new(images.len());
    let mut first_at: BTreeMap<[u64; 3], usize> = BTreeMap::new();
    for (at, image) in images.iter().enumerate() {
        let Some(pose) = image.world_from_camera else { continue };
        // Adding zero makes one of both zeros.
        let center = [0, 1, 2].map(|axis| (pose.translation[axis] + 0.0).to_bits());
        spots.union(*first_at.entry(center).or_insert(at), at);
    }
    spots
}

/// The links that tie all images together by the most points each: the maximum spanning forest, strongest first.
fn strongest_links(images: usize, links: impl Iterator<Item = LinkBetween>) -> Vec<LinkBetween> {
    let mut links: Vec<LinkBetween> = links.collect();
    links.sort_by_key(|&(a, b, points)| (Reverse(points), a, b));
    let mut tied = Groups::new(images);
    links.retain(|&(a, b, _)| tied.union(a.index(), b.index()));
    links
}

/// The pair with what holds its images together, where that is less.
///
/// Images of one spot stay together, but for a pair of them.
fn outvoted(pair: &PairDisagreement, spots: &Groups, links: &[LinkBetween]) -> Option<OutvotedPair> {
    let PairDisagreement { first, second, matches, .. } = *pair;
    let images = spots.len();
    let untied = if spots.equiv(first.index(), second.index()) { Groups::new(images) } else { spots.clone() };
    // The weakest link between the two is that with which the strongest ones first tie them.
    let mut tied = untied.clone();
    let weakest = links.iter().position(|&(a, b, _)| {
        tied.union(a.index(), b.index());
        tied.equiv(first.index(), second.index())
    })?;
    let held_by = links[weakest].2;
    let found = OutvotedPair { first, second, matches, held_by, side: Vec::new() };
    if found.weight() <= MIN_WEIGHT {
        return None;
    }
    let mut tied = untied;
    for (at, &(a, b, _)) in links.iter().enumerate() {
        if at != weakest {
            tied.union(a.index(), b.index());
        }
    }
    let side = (0..images).filter(|&image| tied.equiv(first.index(), image));
    Some(OutvotedPair { side: side.map(|image| ImageId(image as u32)).collect(), ..found })
}

/// Matches from which on a single pair that contradicts the model is worth a word: chance does not make so many.
const LOUD_MATCHES: usize = 100;
/// Share of the pairs from which on they are, however few matches each has.
const LOUD_SHARE: f64 = 0.2;
/// Most pairs that are named.
const MOST_NAMED: usize = 5;

impl QualityReport {
    /// Images with few points on one side of a link that a pair within the component outweighs by far, ascending: where they are
    /// rests on wrong matches. Each with that pair; those that baselines are measured from or to are held by these.
    pub fn misplaced(&self, component: &Reconstruction) -> BTreeMap<ImageId, &OutvotedPair> {
        let weak: BTreeSet<ImageId> = self.weak_images.iter().map(|(image, _)| *image).collect();
        let is_within = |pair: &&OutvotedPair| {
            component.images[pair.second.index()].world_from_camera.is_some() && pair.weight() >= FOLD_WEIGHT
        };
        let mut misplaced = BTreeMap::new();
        for pair in self.outvoted.iter().filter(is_within) {
            let (one, other): (Vec<ImageId>, Vec<ImageId>) =
                component.registered().partition(|image| pair.side.binary_search(image).is_ok());
            let fewer = if one.len() <= other.len() { one } else { other };
            let is_held = |image: &ImageId| component.lengths.iter().any(|length| length.involves(*image));
            if fewer.iter().all(|image| weak.contains(image) && !is_held(image)) {
                for image in fewer {
                    misplaced.entry(image).or_insert(pair);
                }
            }
        }
        misplaced
    }

    /// The report in sentences, worst first; empty when nothing disagrees.
    pub fn sentences(&self, reconstruction: &Reconstruction) -> Vec<String> {
        let name = |image: ImageId| reconstruction.images[image.index()].name.as_str();
        let mut together: Vec<&SuspiciousNeighbours> = self.suspicious.iter().collect();
        together.sort_by(|a, b| a.share().total_cmp(&b.share()));
        let mut lines = worst_of(&together, |pair| said_of_neighbours(pair, name), said_of_more_neighbours);
        // Those that weigh most against what holds their sides together.
        let mut heaviest: Vec<&OutvotedPair> = self.outvoted.iter().collect();
        heaviest.sort_by(|a, b| b.weight().total_cmp(&a.weight()));
        let said = |pair: &OutvotedPair| {
            let is_within = reconstruction.images[pair.second.index()].world_from_camera.is_some();
            said_of_outvoted(pair, is_within, name)
        };
        lines.extend(worst_of(&heaviest, said, said_of_more_outvoted));
        lines.extend(
            (self.weak_images.iter())
                .map(|(image, points)| format!("{} is held by {points} points only", name(*image))),
        );
        lines.extend(self.said_of_disagreements(name));
        lines
    }

    /// The pairs that the model contradicts, where they are many or one has many matches.
    fn said_of_disagreements<'n>(&self, name: impl Fn(ImageId) -> &'n str) -> Option<String> {
        let is_loud = |pair: &PairDisagreement| pair.is_unused() && pair.matches >= LOUD_MATCHES;
        let many = self.disagreements.len() as f64 >= LOUD_SHARE * self.pairs as f64;
        if self.disagreements.is_empty() || !(many || self.disagreements.iter().any(is_loud)) {
            return None;
        }
        let mut worst: Vec<&PairDisagreement> = self.disagreements.iter().collect();
        worst.sort_by_key(|pair| Reverse(pair.matches));
        let named = worst.into_iter().map(|pair| {
            let PairDisagreement { matches, used, rotation_deg, .. } = *pair;
            let how = if pair.is_unused() {
                format!("{used} of {matches} matches used")
            } else {
                format!("{matches} matches, turned by {rotation_deg:.0}°")
            };
            format!("{}–{} ({how})", name(pair.first), name(pair.second))
        });
        Some(format!(
            "{} of {} verified pairs contradict the model, as repeated structure does: {}",
            self.disagreements.len(),
            self.pairs,
            listed(&named.collect::<Vec<_>>(), MOST_NAMED)
        ))
    }
}

/// What is said of the first of some signs, and of how many more there are.
fn worst_of<T>(
    sorted: &[&T],
    said: impl Fn(&T) -> String,
    said_of_more: impl Fn(usize) -> String,
) -> Vec<String> {
    let (named, more) = sorted.split_at(sorted.len().min(MOST_NAMED));
    let lines = named.iter().map(|sign| said(sign));
    lines.chain((!more.is_empty()).then(|| said_of_more(more.len()))).collect()
}

fn said_of_neighbours<'n>(pair: &SuspiciousNeighbours, name: impl Fn(ImageId) -> &'n str) -> String {
    let SuspiciousNeighbours { first, second, expected, shared, is_confirmed } = *pair;
    let why = if is_confirmed {
        "the scene may be folded there"
    } else {
        "something stands between them, or the scene is folded there"
    };
    format!(
        "{} and {} stand together in the model but share {shared} of {expected} points that both ought to see: {why}",
        name(first),
        name(second),
    )
}

fn said_of_more_neighbours(others: usize) -> String {
    format!(
        "{others} more {} together and {} next to none of the points that both ought to see",
        if others == 1 { "pair stands" } else { "pairs stand" },
        if others == 1 { "shares" } else { "share" },
    )
}

fn said_of_outvoted<'n>(pair: &OutvotedPair, is_within: bool, name: impl Fn(ImageId) -> &'n str) -> String {
    let (first, second) = (name(pair.first), name(pair.second));
    let OutvotedPair { matches, held_by, .. } = pair;
    if is_within {
        format!(
            "the {matches} matches of {first} and {second} contradict the model, which {held_by} points hold together \
             between them: it may be wrong there"
        )
    } else {
        format!(
            "{first} shares {matches} matches with {second} of a larger component and {held_by} points at most with \
             any of its own: it may belong there"
        )
    }
}

fn said_of_more_outvoted(others: usize) -> String {
    format!(
        "{others} more {} with as few points between: it may be folded",
        if others == 1 { "pair contradicts the model" } else { "pairs contradict the model" }
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraId, Observation, Rigid, TwoView};
    use nalgebra::{UnitQuaternion, Vector3};
    use setloc_features::{Camera, CameraModel, Match};

    fn image(name: &str, x: f64) -> ReconstructionImage {
        ReconstructionImage {
            name: name.to_owned(),
            camera: CameraId(0),
            world_from_camera: Some(Rigid::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0))),
        }
    }

    fn link((a, b, points): (u32, u32, usize)) -> LinkBetween {
        (ImageId(a), ImageId(b), points)
    }

    #[test]
    fn many_pairs_that_weigh_against_a_model_are_summed_up() {
        let images: Vec<ReconstructionImage> = (0..8).map(|at| image("a.jpg", f64::from(at))).collect();
        let model = Reconstruction { images, ..Reconstruction::default() };
        let pair = |at: u32| OutvotedPair {
            first: ImageId(at),
            second: ImageId(at + 1),
            matches: 100 + at as usize,
            held_by: 60,
            side: Vec::new(),
        };
        let sentences = |count: u32| {
            let outvoted = (0..count).map(pair).collect();
            QualityReport { outvoted, ..QualityReport::default() }.sentences(&model)
        };
        assert_eq!(sentences(5).len(), 5);
        let seven = sentences(7);
        assert_eq!(seven.len(), 6);
        assert!(seven[0].starts_with("the 106 matches"), "{seven:?}");
        assert!(seven[5].starts_with("2 more pairs contradict the model"), "{seven:?}");
    }

    #[test]
    fn photos_that_stand_together_and_share_nothing_are_named() {
        let camera = Camera {
            model: CameraModel::Pinhole,
            width: 800,
            height: 600,
            params: vec![700.0, 700.0, 400.0, 300.0],
        };
        let mut model = Reconstruction {
            cameras: vec![camera],
            images: vec![image("a", 0.0), image("b", 0.1)],
            ..Reconstruction::default()
        };
        // Each sees 200 points of its own, ahead of both.
        for at in 0..400_u32 {
            let (x, y) = (f64::from(at % 20) * 0.2 - 2.0, f64::from(at / 20) * 0.15 - 1.5);
            model.points.push(ReconstructionPoint {
                position: Vector3::new(x, y, 8.0),
                track: vec![Observation { image: ImageId(at % 2), feature: at }],
                color: [0; 3],
                error_sigma: 0.0,
                aligned: None,
                covariance: None,
            });
        }
        let report = assess(&QualityParams::default(), &model, &[], &[], &[]);
        assert_eq!(report.suspicious.len(), 1, "{report:?}");
        assert!(report.sentences(&model)[0].starts_with("a and b stand together"));
        assert!(!report.suspicious[0].is_confirmed);
        let two_view = TwoView::of_equal_features(Rigid::identity(), 0..60);
        let pair = PairGeometry { first: ImageId(0), second: ImageId(1), two_view };
        assert!(assess(&QualityParams::default(), &model, &[], &[pair], &[]).suspicious[0].is_confirmed);
        // So does a third that shares nothing with either.
        let mut three = model.clone();
        three.images.push(image("c", 0.2));
        for (at, point) in three.points.iter_mut().enumerate() {
            point.track[0].image = ImageId(at as u32 % 3);
        }
        let suspicious = assess(&QualityParams::default(), &three, &[], &[], &[]).suspicious;
        assert!(suspicious.len() == 3 && suspicious.iter().all(|pair| pair.is_confirmed), "{suspicious:?}");
        // What the second sees is at its feet, which the first sees from elsewhere: a wall may part them.
        let mut beside = model.clone();
        for point in beside.points.iter_mut().filter(|point| point.track[0].image == ImageId(1)) {
            point.position = point.position * 0.025 + Vector3::x() * 0.1;
        }
        assert_eq!(assess(&QualityParams::default(), &beside, &[], &[], &[]).suspicious, []);
        // Turned away, neither ought to see what the other does.
        let turned = UnitQuaternion::from_euler_angles(0.0, std::f64::consts::PI, 0.0);
        model.images[1].world_from_camera = Some(Rigid::new(turned, Vector3::new(0.1, 0.0, 0.0)));
        assert_eq!(assess(&QualityParams::default(), &model, &[], &[], &[]).suspicious, []);
    }

    #[test]
    fn a_pair_outvotes_what_holds_its_images_together_where_that_is_less() {
        // Two chains of three, tied by few points.
        let points = [
            [(0, 1, 400), (0, 2, 90), (0, 6, 20), (1, 2, 400)],
            [(1, 4, 30), (2, 3, 60), (3, 4, 400), (4, 5, 400)],
        ];
        let links = strongest_links(8, points.concat().into_iter().map(link));
        let strongest = [(0, 1, 400), (1, 2, 400), (3, 4, 400), (4, 5, 400), (2, 3, 60), (0, 6, 20)];
        assert_eq!(links, strongest.map(link));
        let spots = Groups::new(8);
        let found = |first: u32, second: u32, matches: usize| {
            let (first, second) = (ImageId(first), ImageId(second));
            outvoted(&PairDisagreement { first, second, matches, used: 0, rotation_deg: 0.0 }, &spots, &links)
        };
        let across = found(1, 5, 300).expect("weighs more");
        assert_eq!((across.held_by, across.side), (60, [0, 1, 2, 6].map(ImageId).to_vec()));
        assert_eq!(found(1, 5, 40), None);
        assert_eq!(found(0, 2, 250), None);
        // Of an image that nothing ties there is nothing to say.
        assert_eq!(found(0, 7, 300), None);
    }

    #[test]
    fn images_of_one_spot_are_on_one_side_though_they_share_no_point() {
        let images = [0.0, 0.0, 1.0, 2.0].map(|x| image("a", x));
        let spots = of_one_spot(&images);
        let links = strongest_links(4, [(0, 2, 400), (1, 2, 45), (2, 3, 60)].into_iter().map(link));
        let found = |first: u32, second: u32| {
            let (first, second) = (ImageId(first), ImageId(second));
            outvoted(
                &PairDisagreement { first, second, matches: 56, used: 0, rotation_deg: 27.0 },
                &spots,
                &links,
            )
        };
        let across = found(1, 3).expect("weighs as much");
        assert_eq!((across.held_by, across.side), (60, [0, 1, 2].map(ImageId).to_vec()));
        assert_eq!(found(1, 2), None, "the first holds both to the second");
        let within = found(0, 1).expect("one spot is what it contradicts");
        assert_eq!((within.held_by, within.side), (45, [0, 2, 3].map(ImageId).to_vec()));
    }

    #[test]
    fn images_beyond_links_that_are_outweighed_by_far_are_doubtful() {
        let mut model = Reconstruction { images: vec![image("a", 0.0); 7], ..Reconstruction::default() };
        model.images[6].world_from_camera = None;
        let pair = |matches: usize, side: &[u32]| OutvotedPair {
            first: ImageId(side[0]),
            second: ImageId(9),
            matches,
            held_by: 100,
            side: side.iter().map(|&image| ImageId(image)).collect(),
        };
        let doubtful = |pairs: &[OutvotedPair]| -> Vec<u32> {
            doubtful_images(&model, pairs, &[]).into_iter().map(|image| image.0).collect()
        };
        assert_eq!(doubtful(&[]), [0; 0]);
        assert_eq!(doubtful(&[pair(110, &[0, 1])]), [0; 0]);
        assert_eq!(doubtful(&[pair(210, &[0, 1])]), [0, 1]);
        assert_eq!(doubtful(&[pair(210, &[1, 2, 3, 4, 5])]), [0]);
        assert_eq!(doubtful(&[pair(210, &[0]), pair(110, &[1]), pair(300, &[5])]), [0, 5]);
        // No group has most of the images.
        assert_eq!(doubtful(&[pair(210, &[0, 1, 2])]), [0, 1, 2, 3, 4, 5]);
        assert_eq!(doubtful(&[pair(210, &[0, 1]), pair(210, &[4, 5])]), [0, 1, 2, 3, 4, 5]);
        // Nor is one sure that shares points with them, or with one that does.
        model.images = vec![image("a", 0.0); 9];
        for (tied, points) in [([0, 1], 20), ([1, 2], 20), ([0, 3], 19), ([2, 4], 20), ([5, 6], 20)] {
            model.points.extend((0..points).map(|feature| ReconstructionPoint {
                position: Vector3::z(),
                color: [0; 3],
                error_sigma: 0.0,
                covariance: None,
                track: tied.map(|image| Observation { image: ImageId(image), feature }).to_vec(),
                aligned: None,
            }));
        }
        assert_eq!(doubtful_images(&model, &[pair(210, &[0])], &[]), [0, 1, 2].map(ImageId));
        // Two that stand together and share nothing are in doubt, too.
        let together = |is_confirmed| SuspiciousNeighbours {
            first: ImageId(0),
            second: ImageId(6),
            expected: 300,
            shared: 2,
            is_confirmed,
        };
        assert_eq!(doubtful_images(&model, &[], &[together(true)]), [0, 1, 2, 5, 6].map(ImageId));
        // Trees may stand between two that no match speaks against.
        assert_eq!(doubtful_images(&model, &[], &[together(false)]), []);
    }

    #[test]
    fn weak_images_that_far_more_matches_contradict_are_misplaced() {
        let images = (0..5).map(|at| image("", f64::from(at))).collect();
        let model = Reconstruction { images, ..Reconstruction::default() };
        let misplaced = |matches: usize, side: &[u32], weak: &[u32]| -> Vec<u32> {
            let side = side.iter().map(|image| ImageId(*image)).collect();
            let outvoted =
                vec![OutvotedPair { first: ImageId(0), second: ImageId(3), matches, held_by: 20, side }];
            let weak_images = weak.iter().map(|image| (ImageId(*image), 30)).collect();
            let report = QualityReport { outvoted, weak_images, ..QualityReport::default() };
            report.misplaced(&model).into_keys().map(|image| image.0).collect()
        };
        assert_eq!(misplaced(57, &[0], &[0]), [0]);
        assert_eq!(misplaced(57, &[0, 1], &[0, 1, 3]), [0, 1]);
        // The other side is the smaller one.
        assert_eq!(misplaced(57, &[0, 1, 2, 4], &[3]), [3]);
        // What is well held stays, and what hardly more speaks against.
        assert_eq!(misplaced(57, &[0, 1], &[0]), [0; 0]);
        assert_eq!(misplaced(29, &[0], &[0]), [0; 0]);
    }

    #[test]
    fn what_photos_turned_on_the_spot_share_and_paving_speak_against_nothing() {
        let mut model = Reconstruction {
            cameras: vec![Camera::equirectangular(200, 100)],
            images: vec![image("a", 0.0), image("b", 0.0), image("c", 1.0)],
            ..Reconstruction::default()
        };
        let ties = [(0, 0..9), (1, 9..18)].into_iter().flat_map(|(first, at)| at.map(move |at| (first, at)));
        for (first, feature) in ties {
            let track = [first, 2].map(|image| Observation { image: ImageId(image), feature }).to_vec();
            model.points.push(ReconstructionPoint {
                position: Vector3::new(0.0, 0.0, 8.0),
                track,
                color: [0; 3],
                error_sigma: 0.0,
                aligned: None,
                covariance: None,
            });
        }
        let report = |kind, is_underfoot| {
            let inliers = (0..300).map(|at| Match { first: at, second: at }).collect();
            let two_view =
                TwoView { kind, second_from_first: Rigid::identity(), inliers, median_parallax_rad: 0.0 };
            let pair = PairGeometry { first: ImageId(0), second: ImageId(1), two_view };
            assess(&QualityParams::default(), &model, &[], &[pair], &[is_underfoot])
        };
        let of_turn = report(TwoViewKind::PureRotation, false);
        assert_eq!((of_turn.disagreements, of_turn.outvoted), (vec![], vec![]));
        let of_paving = report(TwoViewKind::General, true);
        assert_eq!((of_paving.pairs, of_paving.disagreements, of_paving.outvoted), (0, vec![], vec![]));
        let found = report(TwoViewKind::General, false).outvoted;
        assert_eq!(found.iter().map(|pair| (pair.matches, pair.held_by)).collect::<Vec<_>>(), [(300, 9)]);
    }

    #[test]
    fn matches_count_against_a_model_where_it_uses_few_or_is_turned_far() {
        let pair = |matches, used, rotation_deg| PairDisagreement {
            first: ImageId(0),
            second: ImageId(1),
            matches,
            used,
            rotation_deg,
        };
        assert!(pair(300, 20, 0.5).is_heavy() && pair(300, 90, 90.0).is_heavy());
        assert!(!pair(300, 90, 8.0).is_heavy() && !pair(40, 0, 90.0).is_heavy());
        // A room's door and its panorama, put into the next room, where some things stand alike.
        assert!(pair(295, 69, 6.0).is_heavy());
        // Most of them are points of the model: the pair has the other rotation that a wall leaves.
        assert!(!pair(300, 200, 80.0).is_heavy());
    }

    #[test]
    fn contradictions_are_said_where_one_is_large_or_they_are_many() {
        let model =
            Reconstruction { images: vec![image("a", 0.0), image("b", 1.0)], ..Reconstruction::default() };
        let said = |pairs: usize, matches: usize, used: usize, rotation_deg: f64| {
            let pair =
                PairDisagreement { first: ImageId(0), second: ImageId(1), matches, used, rotation_deg };
            QualityReport { pairs, disagreements: vec![pair], ..QualityReport::default() }.sentences(&model)
        };
        assert_eq!(said(50, 60, 2, 1.0), Vec::<String>::new());
        assert!(said(50, 300, 20, 1.0)[0].contains("a–b (20 of 300 matches used)"));
        assert!(said(4, 60, 2, 1.0)[0].starts_with("1 of 4 verified pairs contradict"));
        // All used, but at another rotation.
        assert!(said(4, 60, 60, 25.0)[0].contains("a–b (60 matches, turned by 25°)"));
    }
}
