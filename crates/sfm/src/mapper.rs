//! The incremental mapper: from verified pairs to components.

mod adjust;
mod ambiguity;
mod calibration;
pub(crate) mod continuation;
mod corner;
mod correspondence;
mod depths;
mod direction;
mod divide;
mod initial;
mod latecomers;
mod lens;
mod merge;
mod model;
mod nearby;
mod neighbours;
mod parts;
pub(crate) mod plane;
mod projection;
mod register;
mod repeated;
mod sides;
mod standpoint;
mod stitching;
mod structure;
mod support;
#[cfg(test)]
mod test_street;
mod told;
mod triplets;
mod turned;
mod votes;
pub(crate) mod wall;
mod witnesses;

use std::{cmp::Reverse, collections::BTreeMap};

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{Calibration, Camera, ImageFeatures, Match};

pub(crate) use self::adjust::{MIN_ADJUSTABLE_POINTS, MIN_CALIBRATING_POINTS};
pub(crate) use self::corner::ln_false_alarms;
pub use self::{
    merge::{MergeRecord, MergeVerdict},
    standpoint::Mosaic,
};

use self::{
    adjust::{Scope, adjust},
    ambiguity::settle_pose,
    calibration::calibrate,
    continuation::{Continued, continue_planes},
    correspondence::CorrespondenceGraph,
    depths::{is_indoors, stands_on_floor},
    divide::divide,
    latecomers::{
        FEW_IMAGES, best_crossing, count_held_by_pairs, hypothesize_from_crossings, hypothesize_from_depths,
    },
    lens::choose_lenses,
    model::Model,
    neighbours::{Neighbours, neighbours, share_as_neighbours, share_with_one},
    parts::{Anchors, Part, Parts},
    projection::search_by_projection,
    register::{
        PoseHypothesis, Visibility, count_scene_matches, hypothesize, hypothesize_baseline,
        hypothesize_from_pairs, register, visibility,
    },
    repeated::Underfoot,
    standpoint::Standpoints,
    stitching::measure_stitching,
    structure::{PointLimits, complete_and_merge, filter, triangulate_image, triangulate_match},
    support::{Support, Worth},
    told::correct_told,
    witnesses::{Testimony, Witnesses, count_agreeing},
};
use crate::{
    BaselineLength, CameraId, Georegistration, ImageId, Observation, OutvotedPair, PairGeometry, PointId,
    Reconstruction, Rigid, TwoViewKind, TwoViewParams,
    bundle::{BundleParams, RobustLoss},
    robust::RansacParams,
};

/// Bumped when equal inputs and parameters give another model.
pub const MAPPER_VERSION: u32 = 47;

/// How to build a model from verified pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(clippy::struct_excessive_bools, reason = "each stands for one thing that may be left out")]
pub struct MapperParams {
    /// Largest angular error of an observation, in standard deviations of its ray.
    pub max_error_sigma: f64,
    /// Smallest triangulation angle of a point, in degrees.
    pub min_triangulation_angle_deg: f64,
    /// Fewest points of an initial pair.
    pub min_initial_points: usize,
    /// Smallest median parallax of an initial pair, in degrees.
    pub min_initial_parallax_deg: f64,
    /// Initial pairs tried before a component is given up.
    pub max_initial_pairs: usize,
    /// Fewest inliers of a registration.
    pub min_registration_inliers: usize,
    /// Fewest inliers of a registration whose rotation and direction of movement a verified pair gives: the points then
    /// only have to agree on the length of the baseline.
    pub min_confirmed_inliers: usize,
    /// Smallest share of an image's 2D-to-3D matches that must agree with such a pose.
    pub min_confirmed_share: f64,
    /// Smallest share of the points in plain view that a registration must match; guards against repeated structure.
    pub min_visibility_recall: f64,
    /// Share of the directions with points in plain view in which any was matched that does as well: where all matching
    /// is poor, recall is low everywhere, but a right pose has some matches all around.
    pub min_visibility_coverage: f64,
    /// Points that must be in plain view for the recall to count.
    pub min_visible_points: usize,
    /// Fewest matches of a pure rotation that registers an image at the standpoint of another.
    pub min_turn_matches: usize,
    /// Smallest share of the keypoints that two images ought to share after a turn that must match for them to count as
    /// taken from one standpoint.
    pub min_turn_recall: f64,
    /// Rotation from a verified pair's that still counts as agreement with it, in degrees.
    pub max_pair_rotation_deg: f64,
    /// Smallest share of the verified matches to registered images whose pairs must agree with a pose's rotation.
    pub min_pair_agreement: f64,
    /// Poses tried for one image when repeated structure offers several.
    pub max_pose_hypotheses: usize,
    /// Images adjusted together with a new one.
    pub local_bundle_images: usize,
    /// Growth of the number of images that triggers an adjustment of everything.
    pub global_bundle_growth: f64,
    /// Scale of the Cauchy loss in standard deviations.
    pub loss_sigma: f64,
    /// Whether an image that shares nothing with more than one other gets the length of its baseline from planes of the
    /// model that go on. It applies to local models of photo sets only.
    pub continue_planes: bool,
    /// Whether panoramas, and parts of a place, that one pair joins get the length of that step from what lies beside what the pair
    /// shares and from the floor, where such pairs can be believed. Otherwise they stay apart.
    pub join_by_depths: bool,
    /// Whether photos are asked for the focal lengths that they are told, and have others, a percent off, where these explain
    /// the model clearly better. It applies to local models of photo sets only.
    pub correct_told: bool,
    /// Whether panoramas are asked how their stitching stretches directions ([`CameraModel::StitchedEquirectangular`]), and
    /// have that taken out where it explains the model clearly better.
    ///
    /// [`CameraModel::StitchedEquirectangular`]: setloc_features::CameraModel::StitchedEquirectangular
    pub calibrate_panoramas: bool,
}

impl Default for MapperParams {
    fn default() -> Self {
        Self {
            max_error_sigma: 6.0,
            min_triangulation_angle_deg: 1.0,
            min_initial_points: 50,
            min_initial_parallax_deg: 3.0,
            max_initial_pairs: 30,
            min_registration_inliers: 15,
            min_confirmed_inliers: 8,
            min_confirmed_share: 0.5,
            min_visibility_recall: 0.1,
            min_visibility_coverage: 0.4,
            min_visible_points: 100,
            min_turn_matches: 20,
            min_turn_recall: 0.2,
            max_pair_rotation_deg: 8.0,
            min_pair_agreement: 0.2,
            max_pose_hypotheses: 3,
            local_bundle_images: 5,
            global_bundle_growth: 1.4,
            loss_sigma: 1.0,
            continue_planes: true,
            join_by_depths: true,
            correct_told: true,
            calibrate_panoramas: true,
        }
    }
}

impl MapperParams {
    fn limits(&self) -> PointLimits {
        PointLimits {
            max_error_sigma: self.max_error_sigma,
            min_angle_rad: self.min_triangulation_angle_deg.to_radians(),
        }
    }

    fn bundle(&self, max_iterations: u32) -> BundleParams {
        BundleParams { loss: RobustLoss::Cauchy(self.loss_sigma), max_iterations, ..BundleParams::default() }
    }

    fn is_recognized(&self, seen: &Visibility) -> bool {
        seen.recall() >= self.min_visibility_recall || seen.coverage() >= self.min_visibility_coverage
    }

    fn ransac(&self) -> RansacParams {
        RansacParams {
            max_error_sigma: self.max_error_sigma,
            min_inliers: self.min_registration_inliers,
            ..RansacParams::default()
        }
    }
}

/// One image to map.
#[derive(Debug, Clone, Copy)]
pub struct InputImage<'a> {
    /// Name as the user knows it.
    pub name: &'a str,
    /// Index into [`MapperInput::cameras`].
    pub camera: CameraId,
    /// Its features.
    pub features: &'a ImageFeatures,
    /// Measured centre in local east-north-up metres, when GPS is given.
    pub position_prior: Option<Vector3<f64>>,
    /// What it covers, when it is a mosaic of photos from one standpoint; `None` for plain images.
    pub mosaic: Option<&'a Mosaic>,
}

impl<'a> InputImage<'a> {
    /// A plain image whose centre was not measured.
    pub fn new(name: &'a str, camera: CameraId, features: &'a ImageFeatures) -> Self {
        Self { name, camera, features, position_prior: None, mosaic: None }
    }
}

/// What the mapper works on.
#[derive(Debug, Clone)]
pub struct MapperInput<'a> {
    /// Cameras, shared by images.
    pub cameras: Vec<Camera>,
    /// How well each camera is known; all but guesses stay fixed.
    pub calibrations: Vec<Calibration>,
    /// All images; ids are indices.
    pub images: Vec<InputImage<'a>>,
    /// Verified pairs.
    pub pairs: &'a [PairGeometry],
    /// All matches of the pairs, also those that no geometry explains; pairs left out count with their inliers.
    pub putative: &'a [PutativePair],
    /// How pairs of mosaics are verified.
    pub two_view: TwoViewParams,
}

impl MapperInput<'_> {
    /// Whether the intrinsics of a camera stay as they are.
    pub(crate) fn is_fixed(&self, camera: usize) -> bool {
        self.calibrations[camera].is_settled()
    }

    /// The camera of an image.
    pub(crate) fn camera_of(&self, image: ImageId) -> &Camera {
        &self.cameras[self.images[image.index()].camera.index()]
    }

    /// Whether an image is a panorama.
    pub(crate) fn is_panoramic(&self, image: ImageId) -> bool {
        self.camera_of(image).is_panoramic()
    }
}

/// All matches of two images, before verification.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PutativePair {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Its matches.
    pub matches: Vec<Match>,
}

/// How one image entered the model, or why it did not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegistrationRecord {
    /// The image.
    pub image: ImageId,
    /// Whether the pose was accepted.
    pub accepted: bool,
    /// 2D-to-3D matches offered by the verified pairs.
    pub candidates: usize,
    /// Those that agree with the pose.
    pub inliers: usize,
    /// Points in plain view of the pose.
    pub expected: usize,
    /// Those of them that were matched.
    pub matched: usize,
    /// Directions with points in plain view.
    pub expected_cells: usize,
    /// Directions among them in which any was matched.
    pub matched_cells: usize,
}

impl RegistrationRecord {
    fn new(image: ImageId, accepted: bool, [candidates, inliers]: [usize; 2], seen: &Visibility) -> Self {
        Self {
            image,
            accepted,
            candidates,
            inliers,
            expected: seen.expected,
            matched: seen.matched,
            expected_cells: seen.expected_cells,
            matched_cells: seen.matched_cells,
        }
    }
}

/// What happened, for people.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapperReport {
    /// Registrations in the order tried.
    pub registrations: Vec<RegistrationRecord>,
    /// Attempts to join components in the order tried.
    pub merges: Vec<MergeRecord>,
    /// How each component lies in the measured frame, when positions were given and fix it.
    pub georegistrations: Vec<Option<Georegistration>>,
    /// Things that disagree, in words.
    pub warnings: Vec<String>,
    /// Guessed cameras that the images that were given each seem not to share.
    pub doubtful: Vec<CameraId>,
}

/// Components, largest first, and the report.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapperOutput {
    /// Connected components, largest first.
    ///
    /// Where images cannot share the camera that they were given as one, those at the end of the list of cameras are of
    /// some of them.
    pub components: Vec<Reconstruction>,
    /// Verified pairs of images that no component holds both of.
    pub open_pairs: Vec<PairGeometry>,
    /// Pairs that weigh against what holds each component together there; none is known of components beyond the end.
    pub outvoted: Vec<Vec<OutvotedPair>>,
    /// What happened.
    pub report: MapperReport,
}

impl MapperOutput {
    /// Those of some pairs whose images no component holds both of.
    pub fn open_among(&self, pairs: &[PairGeometry]) -> Vec<PairGeometry> {
        let is_open = |pair: &&PairGeometry| {
            let first = self.component_of(pair.first);
            first.is_none() || first != self.component_of(pair.second)
        };
        pairs.iter().filter(is_open).cloned().collect()
    }

    /// Those of some pairs that are of an image of a component and one of none.
    pub fn waiting_among(&self, pairs: &[PairGeometry]) -> Vec<PairGeometry> {
        let is_registered = |image: ImageId| self.component_of(image).is_some();
        let waits = |pair: &&PairGeometry| is_registered(pair.first) != is_registered(pair.second);
        pairs.iter().filter(waits).cloned().collect()
    }

    /// The first component that an image is registered in.
    fn component_of(&self, image: ImageId) -> Option<usize> {
        let holds = |model: &Reconstruction| {
            model.images.get(image.index()).is_some_and(|image| image.world_from_camera.is_some())
        };
        self.components.iter().position(holds)
    }
}

/// Builds all components from verified pairs, largest first; those that a similarity is supported between become one.
///
/// Images that share no geometry with others are in no component. The frame of a component is its first camera's,
/// with the first baseline as unit of length, until it is georegistered.
///
/// Where images turn out not to share the camera that they were given as one, they are mapped again with several, unless it is
/// known or a bare guess: see [`MapperOutput::components`] and [`MapperReport::doubtful`]. Focal lengths that are told and that the
/// largest component contradicts are replaced, and all is mapped again: see [`MapperParams::correct_told`].
pub fn reconstruct(params: &MapperParams, input: &MapperInput<'_>, seed: u64) -> MapperOutput {
    let mut output = reconstruct_with(params, input, seed);
    let mut used = input.clone();
    for _ in 0..MAX_CORRECTIONS {
        let Some(largest) = output.components.first().filter(|_| params.correct_told) else { break };
        let Some(corrected) = correct_told(params, (input, &used), largest) else { break };
        let again = reconstruct_with(params, &corrected, seed);
        if (registered_in(&again) as f64) < MIN_KEPT * registered_in(&output) as f64 {
            break;
        }
        (output, used) = (again, corrected);
    }
    for _ in 0..MAX_DIVISIONS {
        let Some(largest) = output.components.first() else { break };
        let division = divide(params, input, &used, largest);
        output.report.doubtful = division.doubtful;
        let Some(divided) = division.input else { break };
        let mut again = reconstruct_with(params, &divided, seed);
        if (registered_in(&again) as f64) < MIN_KEPT * registered_in(&output) as f64 {
            break;
        }
        again.report.doubtful.clone_from(&output.report.doubtful);
        (output, used) = (again, divided);
    }
    output
}

/// Images of the largest component.
fn registered_in(output: &MapperOutput) -> usize {
    output.components.first().map_or(0, |component| component.registered().count())
}

/// How often images are mapped again with other focal lengths than they are told.
const MAX_CORRECTIONS: usize = 2;
/// How often images are mapped again with other cameras.
const MAX_DIVISIONS: usize = 2;
/// Share of the images of the largest component that has to be left with these.
const MIN_KEPT: f64 = 0.75;

/// The same with cameras shared as they are given.
fn reconstruct_with(params: &MapperParams, input: &MapperInput<'_>, seed: u64) -> MapperOutput {
    if let Some(standpoints) = Standpoints::find(params, input, seed) {
        return standpoints.expand(reconstruct_images(params, &standpoints.input(), seed));
    }
    let pairs = triplets::consistent(input, seed);
    let input = &MapperInput { pairs: &pairs, ..input.clone() };
    let output = reconstruct_images(params, input, seed);
    let Some(underfoot) = Underfoot::find(input) else { return output };
    let Some((rest, warning)) = underfoot.better_input(&output.components, seed) else { return output };
    let bare = MapperInput { pairs: &rest.pairs, putative: &rest.putative, ..input.clone() };
    let mut parts = Parts::map(params, &bare, seed);
    parts.report.warnings.push(warning);
    let pairs = underfoot.borne_out(&parts.all);
    let input = MapperInput { pairs: &pairs, ..input.clone() };
    let witnesses = underfoot.witnesses(&pairs);
    let mut parts = parts.over(&input);
    parts.grow_again(&witnesses);
    parts.finished()
}

fn reconstruct_images(params: &MapperParams, input: &MapperInput<'_>, seed: u64) -> MapperOutput {
    Parts::map(params, input, seed).finished()
}

/// The pairs of which no image is taken.
fn enabled_pairs(input: &MapperInput<'_>, taken: &[bool]) -> Vec<bool> {
    input.pairs.iter().map(|pair| !taken[pair.first.index()] && !taken[pair.second.index()]).collect()
}

/// How many times farther off observations may be when a finished model is opened to them once more.
///
/// A model keeps what agrees with it, and what it keeps holds it where it is: a panorama that came in a quarter of a
/// degree off, half a dozen pixels, had refused the matches that would have turned it.
const REOPENED: f64 = 8.0;

/// Share of a pair's matches on the epipolar circles of a pose that make it agree with that pose.
const MIN_ON_CIRCLES: f64 = 0.9;

/// How often pairs are ranked for one component, each time without the images of those that were tried in vain.
const MAX_STARTS: usize = 4;

/// A verified pair of a registered image and one that waits.
struct Edge {
    /// Index of the pair.
    pair: usize,
    image: ImageId,
    other: ImageId,
    image_from_other: Rigid,
}

struct Mapper<'a> {
    params: &'a MapperParams,
    model: Model<'a>,
    graph: CorrespondenceGraph,
    enabled: Vec<bool>,
    /// Images of earlier components.
    taken: Vec<bool>,
    anchors: Anchors,
    /// 2D-to-3D matches that an image had when its camera was last sought.
    calibrated_at: Vec<usize>,
    /// Cameras that were found so before any of their images was registered: the pairs were verified with worse ones.
    recalibrated: Vec<bool>,
    /// 2D-to-3D matches that an image had when it was last refused.
    refused_at: Vec<usize>,
    /// Points that a registered image had when the baseline of a pair (by index) was last sought.
    baseline_tried: BTreeMap<usize, usize>,
    /// The same for planes.
    planes_tried: BTreeMap<usize, usize>,
    records: Vec<RegistrationRecord>,
    images_at_last_global: usize,
    /// What judges poses in place of what is in plain view, where a floor repeats itself.
    witnesses: Option<&'a Witnesses>,
    /// Whether images come in that only their pairs and what they share with neighbours speak for.
    admits_latecomers: bool,
    /// Whether such images may come in by one pair whose length depths tell.
    admits_by_depths: bool,
    seed: u64,
}

impl<'a> Mapper<'a> {
    fn new(
        params: &'a MapperParams,
        input: &'a MapperInput<'a>,
        taken: Vec<bool>,
        seed: u64,
    ) -> Option<Self> {
        let has_work = enabled_pairs(input, &taken).contains(&true);
        has_work.then(|| Self::over(params, Model::without(input, &taken), taken, seed))
    }

    /// Works on a model from images that are not taken.
    fn over(params: &'a MapperParams, model: Model<'a>, taken: Vec<bool>, seed: u64) -> Self {
        let input = model.input;
        let enabled = enabled_pairs(input, &taken);
        let counts: Vec<usize> = input.images.iter().map(|image| image.features.len()).collect();
        Self {
            params,
            graph: CorrespondenceGraph::build(&counts, input.pairs, &enabled),
            images_at_last_global: model.registered_count().max(2),
            model,
            enabled,
            taken,
            anchors: vec![None; input.images.len()],
            calibrated_at: vec![0; input.images.len()],
            recalibrated: vec![false; input.cameras.len()],
            refused_at: vec![0; input.images.len()],
            baseline_tried: BTreeMap::new(),
            planes_tried: BTreeMap::new(),
            records: Vec::new(),
            witnesses: None,
            admits_latecomers: false,
            admits_by_depths: false,
            seed,
        }
    }

    /// Lets images come in from now on that only their pairs speak for.
    fn admit_latecomers(&mut self) {
        self.admits_latecomers = true;
        self.admits_by_depths = self.params.join_by_depths && is_indoors(&self.model);
    }

    fn into_part(self) -> Part {
        Part { component: self.model.into_reconstruction(), anchors: self.anchors }
    }

    /// Starts from the best pair that gives points; whether there is one.
    ///
    /// Images of pairs that were tried in vain are `barren`: what they share looks good and is not, and would keep all
    /// other places from being tried. No component starts from them, but they may join one.
    fn initialize(&mut self, barren: &mut [bool]) -> bool {
        for _ in 0..MAX_STARTS {
            let fruitful = |pair: &PairGeometry| !barren[pair.first.index()] && !barren[pair.second.index()];
            let worth: Vec<bool> = (self.enabled.iter().zip(self.model.input.pairs))
                .map(|(enabled, pair)| *enabled && fruitful(pair))
                .collect();
            let ranked = initial::ranked_pairs(self.params, &self.model, &self.graph, &worth);
            if ranked.is_empty() {
                return false;
            }
            if self.start_from(&ranked) {
                return true;
            }
            for pair in ranked.into_iter().map(|candidate| &self.model.input.pairs[candidate]) {
                barren[pair.first.index()] = true;
                barren[pair.second.index()] = true;
            }
        }
        false
    }

    fn start_from(&mut self, ranked: &[usize]) -> bool {
        for &candidate in ranked {
            let pair = &self.model.input.pairs[candidate];
            let (first, second) = (pair.first, pair.second);
            self.model.set_pose(first, Some(Rigid::identity()));
            self.model.set_pose(second, Some(pair.two_view.second_from_first.inverse()));
            triangulate_image(&mut self.model, &self.graph, self.params.limits(), first);
            self.adjust_all(30);
            self.filter_all(self.params.limits());
            triangulate_image(&mut self.model, &self.graph, self.params.limits(), first);
            if self.model.observed_points(first) >= self.params.min_initial_points {
                return true;
            }
            self.model.unregister(first);
            self.model.unregister(second);
        }
        false
    }

    fn grow(&mut self) {
        loop {
            let found = (self.register_next())
                .or_else(|| self.register_by_turn())
                .or_else(|| self.register_by_baseline())
                .or_else(|| self.register_by_planes());
            let Some(image) = found else { break };
            triangulate_image(&mut self.model, &self.graph, self.params.limits(), image);
            let scope = Scope::local(&self.model, image, self.params.local_bundle_images);
            adjust(&mut self.model, &self.params.bundle(10), &scope);
            let mut moved = self.follow_anchors();
            moved.extend(scope.free_images);
            let points = self.model.seen_by(&moved);
            filter(&mut self.model, self.params.limits(), &points);
            triangulate_image(&mut self.model, &self.graph, self.params.limits(), image);
            settle_pose(&mut self.model, &self.graph, self.params, image, self.seed);
            let count = self.model.registered_count();
            let has_grown =
                count as f64 >= self.images_at_last_global as f64 * self.params.global_bundle_growth;
            // Who is taken out and comes in again makes it no larger.
            if has_grown || count <= 4 && count > self.images_at_last_global {
                self.refine(1, 10);
                self.images_at_last_global = count;
                self.expel_misplaced();
            }
        }
    }

    /// Registers the image whose points in the model support its pose best.
    fn register_next(&mut self) -> Option<ImageId> {
        self.calibrate_waiting();
        let (image, hypothesis) = self.next_image()?;
        register(&mut self.model, image, &hypothesis);
        Some(image)
    }

    /// Registers an image by one verified pair whose baseline gets its length from points that were hard to match.
    ///
    /// Where each image shares one part of a wall with the image before and another part with the image after, no match
    /// sees three of them, and the length of each baseline is unknown. The pair's epipolar circles then find what the
    /// ratio test over the whole image refused. Many such matches are wrong, but only the right length is one that many
    /// agree on.
    fn register_by_baseline(&mut self) -> Option<ImageId> {
        let mut found: Vec<(Edge, PoseHypothesis)> = Vec::new();
        for edge in self.open_edges() {
            // Nothing new can be found until the other image has other points.
            let points = self.model.observed_points(edge.other);
            if self.baseline_tried.insert(edge.pair, points) == Some(points) {
                continue;
            }
            let Edge { image, other, image_from_other, .. } = edge;
            let hypothesis =
                hypothesize_baseline(&self.model, image, other, &image_from_other, &self.params.ransac());
            found.extend(hypothesis.map(|pose| (edge, pose)));
        }
        found.sort_by_key(|(_, pose)| Reverse(pose.inliers.len()));
        let mut found = found.into_iter();
        let mut records = Vec::new();
        let accepted = found.by_ref().find_map(|(edge, pose)| {
            Some((edge.image, self.first_accepted(edge.image, vec![pose], &mut false, &mut records)?))
        });
        self.records.append(&mut records);
        // Those that were not looked at come again.
        for (edge, _) in found {
            self.baseline_tried.remove(&edge.pair);
        }
        let (image, pose) = accepted?;
        register(&mut self.model, image, &pose);
        Some(image)
    }

    /// Registers an image by one verified pair whose baseline gets its length from planes of the model that go on.
    fn register_by_planes(&mut self) -> Option<ImageId> {
        if !self.params.continue_planes {
            return None;
        }
        let mut found: Vec<(usize, Continued)> = Vec::new();
        for edge in self.open_edges() {
            let points = self.model.observed_points(edge.other);
            if self.planes_tried.insert(edge.pair, points) == Some(points) {
                continue;
            }
            let Edge { pair, image, other, image_from_other } = edge;
            let verified = self.model.input.pairs[pair].matches_from(other);
            let seed = self.seed ^ ((pair as u64) << 32);
            let continued = continue_planes(&self.model, image, other, (&image_from_other, &verified), seed);
            found.extend(continued.map(|continued| (pair, continued)));
        }
        found.sort_by_key(|(_, continued)| Reverse(continued.length.votes));
        let mut found = found.into_iter();
        let mut records = Vec::new();
        let accepted = found.by_ref().find_map(|(_, continued)| {
            let Continued { world_from_camera, length, .. } = continued;
            let BaselineLength { to, votes, .. } = length;
            let hypothesis = PoseHypothesis {
                world_from_camera,
                inliers: Vec::new(),
                candidates: votes,
                visibility: visibility(&self.model, to, &world_from_camera, &[]),
                length: Some(length),
            };
            Some((self.first_accepted(to, vec![hypothesis], &mut false, &mut records)?, continued))
        });
        self.records.append(&mut records);
        for (pair, _) in found {
            self.planes_tried.remove(&pair);
        }
        let (pose, Continued { length, matches, .. }) = accepted?;
        let BaselineLength { from, to: image, .. } = length;
        register(&mut self.model, image, &pose);
        for m in matches {
            let [a, b] =
                [(from, m.first), (image, m.second)].map(|(image, feature)| Observation { image, feature });
            triangulate_match(&mut self.model, self.params.limits(), a, b);
        }
        Some(image)
    }

    /// Verified pairs with parallax from a registered image to one that waits.
    fn open_edges(&self) -> Vec<Edge> {
        let open = |(index, pair): (usize, &PairGeometry)| {
            let image = if self.model.is_registered(pair.first) { pair.second } else { pair.first };
            let (other, image_from_other) = pair.seen_from(image)?;
            let is_open = !self.model.is_registered(image)
                && self.model.is_registered(other)
                && !self.taken[image.index()]
                && self.knows_camera_of(image)
                && pair.two_view.kind != TwoViewKind::PureRotation
                && pair.two_view.inliers.len() >= self.params.min_initial_points;
            is_open.then_some(Edge { pair: index, image, other, image_from_other })
        };
        self.model.input.pairs.iter().enumerate().filter_map(open).collect()
    }

    /// Whether anything has told the camera of an image that waits.
    ///
    /// The geometry of a pair under a guess of the focal length fits its matches, mostly those on one wall, and is wrong. Who
    /// waits for points instead gets a camera with them.
    fn knows_camera_of(&self, image: ImageId) -> bool {
        let camera = self.model.input.images[image.index()].camera.index();
        self.model.input.is_fixed(camera)
            || !self.model.cameras[camera].is_bare_guess()
            || !self.model.registered_with(camera).is_empty()
    }

    /// Finds the intrinsics of unknown cameras that no registered image has, where a waiting image tells them.
    fn calibrate_waiting(&mut self) {
        let camera_of = |image: ImageId| self.model.input.images[image.index()].camera.index();
        let mut is_settled: Vec<bool> =
            self.model.input.calibrations.iter().map(|calibration| calibration.is_settled()).collect();
        self.model.registered().for_each(|image| is_settled[camera_of(image)] = true);
        if !is_settled.contains(&false) {
            return;
        }
        for image in (0..self.model.poses.len() as u32).map(ImageId) {
            let camera = self.model.input.images[image.index()].camera.index();
            if self.taken[image.index()] || is_settled[camera] {
                continue;
            }
            let count = count_scene_matches(&self.model, &self.graph, image);
            let tried = &mut self.calibrated_at[image.index()];
            if count < self.params.min_registration_inliers || count <= *tried * 11 / 10 {
                continue;
            }
            *tried = count;
            let seed = self.seed ^ (u64::from(image.0) << 32);
            if let Some(found) = calibrate(&self.model, &self.graph, image, &self.params.ransac(), seed) {
                self.model.cameras[camera] = found;
                self.model.refresh_rays(camera);
                self.recalibrated[camera] = true;
                is_settled[camera] = true;
                // What was refused was refused under the guess.
                for (image, refused_at) in self.model.input.images.iter().zip(&mut self.refused_at) {
                    if image.camera.index() == camera {
                        *refused_at = 0;
                    }
                }
            }
        }
    }

    fn filter_all(&mut self, limits: PointLimits) -> usize {
        let points = self.model.live_ids();
        filter(&mut self.model, limits, &points)
    }

    /// The image to register next: the best supported acceptable pose among the few with most matches.
    fn next_image(&mut self) -> Option<(ImageId, PoseHypothesis)> {
        let open: Vec<ImageId> = (0..self.model.poses.len() as u32)
            .map(ImageId)
            .filter(|&image| !self.model.is_registered(image) && !self.taken[image.index()])
            .collect();
        let mut waiting: Vec<(usize, ImageId)> = open
            .into_par_iter()
            .with_max_len(1)
            .map(|image| (self.count_offered(image), image))
            .filter(|&(count, image)| {
                count >= self.params.min_confirmed_inliers.min(self.params.min_registration_inliers)
                    && count > self.refused_at[image.index()] * 11 / 10
            })
            .collect();
        waiting.sort_by_key(|&(count, image)| (Reverse(count), image));
        let mut best: Option<(ImageId, PoseHypothesis)> = None;
        // The first few in any case, the others until one is acceptable.
        let (few, others) = waiting.split_at(waiting.len().min(3));
        for tried in std::iter::once(few).chain(others.chunks(2)) {
            let poses: Vec<_> =
                tried.par_iter().with_max_len(1).map(|&(_, image)| self.acceptable_pose(image)).collect();
            for (&(count, image), (pose, mut records)) in tried.iter().zip(poses) {
                self.records.append(&mut records);
                match pose {
                    Some(pose) => {
                        if best.as_ref().is_none_or(|(_, other)| pose.inliers.len() > other.inliers.len()) {
                            best = Some((image, pose));
                        }
                    }
                    None => self.refused_at[image.index()] = count,
                }
            }
            if best.is_some() {
                break;
            }
        }
        best
    }

    /// A pose that may be taken, and what was thought of it and those before.
    fn acceptable_pose(&self, image: ImageId) -> (Option<PoseHypothesis>, Vec<RegistrationRecord>) {
        let mut records = Vec::new();
        let mut has_rival = false;
        let seed = self.seed ^ (u64::from(image.0) << 32);
        let ransac = self.params.ransac();
        let resected =
            hypothesize(&self.model, &self.graph, image, &ransac, self.params.max_pose_hypotheses, seed);
        let pose = self.first_accepted(image, resected, &mut has_rival, &mut records).or_else(|| {
            let confirmed = RansacParams { min_inliers: self.params.min_confirmed_inliers, ..ransac };
            let mut from_pairs = hypothesize_from_pairs(&self.model, &self.graph, image, &confirmed);
            from_pairs.retain(|pose| {
                pose.inliers.len() as f64 >= self.params.min_confirmed_share * pose.candidates as f64
                    || pose.inliers.len() >= self.params.min_registration_inliers
            });
            from_pairs.truncate(self.params.max_pose_hypotheses);
            self.first_accepted(image, from_pairs, &mut has_rival, &mut records)
        });
        let pose = pose.or_else(|| {
            let crossed = (self.admits_latecomers).then(|| {
                let sigmas = self.params.max_error_sigma;
                hypothesize_from_crossings(&self.model, &self.graph, &self.taken, image, sigmas)
            })?;
            // Two directions nearly always cross somewhere.
            let pose = crossed.filter(|pose| self.is_latecomer(image, &pose.world_from_camera))?;
            self.first_accepted(image, vec![pose], &mut has_rival, &mut records)
        });
        let pose = pose.or_else(|| {
            let hung = self.admits_by_depths.then(|| {
                let sigmas = self.params.max_error_sigma;
                hypothesize_from_depths(&self.model, &self.graph, &self.taken, image, sigmas)
            })?;
            let pose = hung.filter(|pose| self.may_hang(image, &pose.world_from_camera))?;
            self.first_accepted(image, vec![pose], &mut has_rival, &mut records)
        });
        (pose, records)
    }

    /// The first of these that may be taken; `has_rival` tells whether pairs clearly spoke for one that was refused.
    fn first_accepted(
        &self,
        image: ImageId,
        hypotheses: Vec<PoseHypothesis>,
        has_rival: &mut bool,
        records: &mut Vec<RegistrationRecord>,
    ) -> Option<PoseHypothesis> {
        let mut refused_before = false;
        for hypothesis in hypotheses {
            let seen = hypothesis.visibility;
            let judged = seen.expected >= self.params.min_visible_points;
            // Where a better supported pose was refused for what it does not see, this one needs evidence of its own.
            let testimony = self.testimony(image, &hypothesis.world_from_camera, &hypothesis.inliers);
            let plausible = match testimony {
                Some(testimony) => testimony.speaks_for(),
                None if judged => self.params.is_recognized(&seen),
                None => !refused_before,
            };
            let plausible = plausible
                || hypothesis.length.is_some() && self.may_hang(image, &hypothesis.world_from_camera)
                || self.is_latecomer(image, &hypothesis.world_from_camera);
            refused_before |= !plausible;
            let is_contradicted = self.model.input.is_panoramic(image) && {
                let support = self.support(image, &hypothesis.world_from_camera);
                let is_contradicted =
                    support.is_untenable() || (*has_rival || !judged) && support.is_contradicted();
                *has_rival |= support.is_clear();
                is_contradicted
            };
            let accepted = plausible
                && !is_contradicted
                && self.pair_agreement(image, &hypothesis.world_from_camera)
                    >= self.params.min_pair_agreement;
            let (candidates, inliers) = (hypothesis.candidates, hypothesis.inliers.len());
            records.push(RegistrationRecord::new(image, accepted, [candidates, inliers], &seen));
            if accepted {
                return Some(hypothesis);
            }
        }
        None
    }

    /// What those say that judge poses in place of what is in plain view; `None` where nobody does.
    fn testimony(
        &self,
        image: ImageId,
        world_from_camera: &Rigid,
        inliers: &[(u32, PointId)],
    ) -> Option<Testimony> {
        let witnesses = self.witnesses?;
        Some(witnesses.hear(&self.model, image, world_from_camera, inliers, self.params.max_error_sigma))
    }

    /// What the verified pairs of an image say of a pose.
    fn support(&self, image: ImageId, world_from_camera: &Rigid) -> Support {
        Support::of(&self.model, &self.taken, image, world_from_camera, self.params.max_error_sigma)
    }

    /// Whether an image may come in late at a pose.
    fn is_latecomer(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        if !self.admits_latecomers {
            return false;
        }
        let support = self.support(image, world_from_camera);
        let is_believed = || Worth::of(&[&self.model], self.params.max_error_sigma).believes(support.widest);
        support.is_enough(self.params.min_initial_points)
            && (support.is_strong() && is_believed() || self.shares_with_one(image, world_from_camera))
    }

    /// Whether an image may hang at a pose by one pair whose length depths tell.
    fn may_hang(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        if !self.admits_by_depths {
            return false;
        }
        let sigmas = self.params.max_error_sigma;
        let support = self.support(image, world_from_camera);
        let is_at_home = || {
            support.is_strong()
                || self.shares_with_one(image, world_from_camera)
                || stands_on_floor(&self.model, image, world_from_camera, sigmas)
        };
        support.is_enough_if_right()
            && Worth::of(&[&self.model], sigmas).believes(support.widest)
            && is_at_home()
    }

    /// Whether a registered image hangs so.
    fn hangs(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        self.model.lengths.iter().any(|length| length.to == image) && self.may_hang(image, world_from_camera)
    }

    fn shares_with_one(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
        let (known, asked) = self.neighbours_of(image, world_from_camera);
        share_with_one(&known, &asked)
    }

    /// Whether an image shares with those next to a pose what neighbours do, by what these share with theirs.
    fn shares_as_neighbour(&self, image: ImageId, world_from_camera: &Rigid) -> bool {
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
        if self.recalibrated[self.model.input.images[image.index()].camera.index()] {
            return 1.0;
        }
        let (mut agreeing, mut all) = (0, 0);
        for pair in self.model.input.pairs {
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

    /// Takes out images that do not see what their neighbours in the model see.
    ///
    /// An image that came in through a repeated façade (the initial pair too) is found out once the true surroundings
    /// of the place have been mapped, or by pairs that speak against it. It is offered again when more of the model can be
    /// matched to it.
    fn expel_misplaced(&mut self) -> usize {
        let mut expelled = 0;
        let mut waiting: Vec<ImageId> = self.model.registered().collect();
        while let Some(group) = self.most_contradicted() {
            for image in group {
                if let Some(seen) = self.seen_by(image) {
                    self.expel(image, &seen);
                    expelled += 1;
                }
                waiting.retain(|other| *other != image);
            }
        }
        // Who is taken out changes what those after it ought to see.
        while let Some((at, seen)) = self.first_misplaced(&waiting) {
            self.expel(waiting[at], &seen);
            expelled += 1;
            waiting.drain(..=at);
        }
        expelled
    }

    fn expel(&mut self, image: ImageId, seen: &Visibility) {
        let points = self.model.observed_points(image);
        self.records.push(RegistrationRecord::new(image, false, [points, points], seen));
        self.model.unregister(image);
        self.refused_at[image.index()] = self.count_offered(image);
    }

    /// Matches by which an image that waits may come in: one that was refused is asked again when there are more.
    fn count_offered(&self, image: ImageId) -> usize {
        let of_pairs = if self.admits_latecomers { count_held_by_pairs(&self.model, image) } else { 0 };
        count_scene_matches(&self.model, &self.graph, image).max(of_pairs)
    }

    /// The panoramas whose pairs speak most against their place, where that is untenable: one or a few that belong together.
    fn most_contradicted(&self) -> Option<Vec<ImageId>> {
        if self.model.registered_count() <= 3 {
            return None;
        }
        let at_most = FEW_IMAGES.min(self.model.registered_count() / 3);
        let may_leave = |image: ImageId| self.model.input.is_panoramic(image);
        let sigmas = self.params.max_error_sigma;
        let elsewhere = |image: ImageId| best_crossing(&self.model, &self.taken, image, sigmas);
        support::most_contradicted(&self.model, may_leave, elsewhere, at_most, sigmas)
    }

    /// What a registered image sees of what it ought to.
    fn seen_by(&self, image: ImageId) -> Option<Visibility> {
        let pose = self.model.poses[image.index()]?.world_from_camera;
        Some(visibility(&self.model, image, &pose, &self.model.observations_of(image)))
    }

    /// The place of the first of these images that does not see what it ought to.
    fn first_misplaced(&self, images: &[ImageId]) -> Option<(usize, Visibility)> {
        if self.model.registered_count() <= 3 {
            return None;
        }
        let misplaced = |(at, &image): (usize, &ImageId)| {
            let pose = self.model.poses[image.index()]?.world_from_camera;
            let observations = self.model.observations_of(image);
            let seen = visibility(&self.model, image, &pose, &observations);
            let judged = seen.expected >= self.params.min_visible_points;
            let is_misplaced = match self.testimony(image, &pose, &observations) {
                Some(testimony) => testimony.speaks_against(),
                None => {
                    judged
                        && !self.params.is_recognized(&seen)
                        && !self.shares_as_neighbour(image, &pose)
                        && !self.is_latecomer(image, &pose)
                        && !self.hangs(image, &pose)
                }
            };
            is_misplaced.then_some((at, seen))
        };
        images.par_iter().with_max_len(1).enumerate().find_map_first(misplaced)
    }

    fn adjust_all(&mut self, max_iterations: u32) {
        let scope = Scope::global(&self.model);
        adjust(&mut self.model, &self.params.bundle(max_iterations), &scope);
        self.follow_anchors();
    }

    /// Adjusts everything, drops what disagrees and takes in what now agrees, `rounds` times or until nothing changes.
    fn refine(&mut self, rounds: usize, max_iterations: u32) {
        self.refine_within(self.params.limits(), rounds, max_iterations);
    }

    fn refine_within(&mut self, limits: PointLimits, rounds: usize, max_iterations: u32) {
        for _ in 0..rounds {
            let observations: usize = self.model.live_points().map(|(_, point)| point.track.len()).sum();
            self.adjust_all(max_iterations);
            let mut changes = self.filter_all(limits);
            let before: usize = self.model.live_points().count();
            for image in self.model.registered().collect::<Vec<_>>() {
                triangulate_image(&mut self.model, &self.graph, limits, image);
            }
            changes += self.model.live_points().count() - before;
            changes += complete_and_merge(&mut self.model, &self.graph, limits);
            if changes * 1000 < observations {
                break;
            }
        }
    }

    fn finish(&mut self) {
        self.refine(2, 20);
        if choose_lenses(&mut self.model, self.params) {
            self.refine(4, 20);
            self.grow();
        }
        self.replace_misplaced();
        for image in self.model.registered().collect::<Vec<_>>() {
            settle_pose(&mut self.model, &self.graph, self.params, image, self.seed);
        }
        let wide = self.params.limits().widened(REOPENED);
        self.refine_within(wide, 2, 20);
        if self.params.calibrate_panoramas && measure_stitching(&mut self.model, self.params) {
            self.refine_within(wide, 2, 20);
        }
        self.refine(4, 20);
        self.adjust_all(30);
        self.filter_all(self.params.limits());
    }

    /// Takes out whoever is misplaced, who may find its right place in the finished surroundings.
    fn replace_misplaced(&mut self) {
        for _ in 0..3 {
            if self.expel_misplaced() == 0 {
                break;
            }
            self.grow();
        }
    }

    /// Seeks further observations of points, a second time with the better poses; whether there were any.
    fn see_again(&mut self) -> bool {
        let mut found = false;
        for _ in 0..2 {
            if search_by_projection(&mut self.model, self.params.max_error_sigma) == 0 {
                break;
            }
            found = true;
            self.refine(1, 20);
        }
        if found {
            self.adjust_all(30);
            self.filter_all(self.params.limits());
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use rand::Rng;
    use setloc_features::Keypoint;

    use super::test_street::{POINTS, Street, first_two};
    use super::*;
    use crate::synthetic::seeded;
    use crate::{ReconstructionImage, TwoView, TwoViewKind};

    /// The other two images agree, so nothing but the third one's own matches can turn it.
    #[test]
    fn an_image_that_came_in_askew_is_put_right_by_matches_that_its_pose_had_refused() {
        let street = Street::new("askew", 12, POINTS);
        let (input, params) = (street.input(), MapperParams::default());
        let askew = |degrees: f64| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), degrees.to_radians());
            let mut model = first_two(&street, &input);
            let truth = street.poses[2];
            model.set_pose(ImageId(2), Some(Rigid::new(turn * truth.rotation, truth.translation)));
            Mapper::over(&params, model, vec![false; 3], 0)
        };
        let off_by = |mapper: &Mapper<'_>| {
            let rotation =
                |image: usize| mapper.model.poses[image].expect("is registered").world_from_camera.rotation;
            let truth = street.poses[0].rotation.inverse() * street.poses[2].rotation;
            (rotation(0).inverse() * rotation(2)).angle_to(&truth).to_degrees()
        };
        let (mut narrow, mut wide) = (askew(2.0), askew(2.0));
        narrow.refine(4, 20);
        assert!(off_by(&narrow) > 1.9, "{}", off_by(&narrow));
        wide.refine_within(params.limits().widened(REOPENED), 4, 20);
        wide.refine(4, 20);
        assert!(off_by(&wide) < 0.1, "{}", off_by(&wide));
    }

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
        let two_view = TwoView {
            kind: TwoViewKind::General,
            second_from_first: *other,
            inliers: (0..120).map(|at| Match { first: at, second: at }).collect(),
            median_parallax_rad: 0.3,
        };
        let pairs = [PairGeometry { first: ImageId(0), second: ImageId(1), two_view }];
        let input = MapperInput {
            cameras: vec![camera.clone()],
            calibrations: vec![Calibration::Known],
            images: features.iter().map(|features| InputImage::new("photo", CameraId(0), features)).collect(),
            pairs: &pairs,
            putative: &[],
            two_view: TwoViewParams::default(),
        };
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
    fn pairs_that_no_component_holds_both_images_of_are_open() {
        let component = |registered: [bool; 4]| Reconstruction {
            cameras: vec![Camera::equirectangular(200, 100)],
            images: registered
                .map(|is_registered| ReconstructionImage {
                    name: String::new(),
                    camera: CameraId(0),
                    world_from_camera: is_registered.then(Rigid::identity),
                })
                .to_vec(),
            points: Vec::new(),
            lengths: Vec::new(),
        };
        let components = vec![component([true, true, false, false]), component([false, false, true, false])];
        let output = MapperOutput { components, ..MapperOutput::default() };
        let two_view = TwoView {
            kind: TwoViewKind::General,
            second_from_first: Rigid::identity(),
            inliers: Vec::new(),
            median_parallax_rad: 0.1,
        };
        let pair = |(first, second)| PairGeometry {
            first: ImageId(first),
            second: ImageId(second),
            two_view: two_view.clone(),
        };
        let pairs = [(0, 1), (1, 2), (3, 0), (2, 3), (3, 9)].map(pair);
        let ends = |pairs: Vec<PairGeometry>| {
            pairs.iter().map(|pair| (pair.first.0, pair.second.0)).collect::<Vec<_>>()
        };
        assert_eq!(ends(output.open_among(&pairs)), [(1, 2), (3, 0), (2, 3), (3, 9)]);
        // The third image has a place already, if in another component.
        assert_eq!(ends(output.waiting_among(&pairs)), [(3, 0), (2, 3)]);
    }
}
