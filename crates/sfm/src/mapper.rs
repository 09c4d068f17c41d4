//! The incremental mapper: from verified pairs to components.

mod adjust;
mod ambiguity;
mod bend;
mod calibration;
pub(crate) mod continuation;
mod corner;
mod correspondence;
mod depths;
mod divide;
mod initial;
mod input;
mod judge;
mod latecomers;
mod lens;
mod merge;
mod model;
mod nearby;
mod neighbours;
mod output;
mod params;
mod parts;
pub(crate) mod plane;
mod projection;
mod register;
mod repeated;
mod sides;
mod standpoint;
mod stitching;
mod stray;
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

use rayon::prelude::*;

pub(crate) use self::adjust::{MIN_ADJUSTABLE_POINTS, MIN_CALIBRATING_POINTS};
pub(crate) use self::corner::ln_false_alarms;
pub use self::{
    input::{InputImage, MapperInput, PutativePair},
    merge::{MergeRecord, MergeVerdict, Recognition},
    output::{CorrectedCamera, MapperOutput, MapperReport, RegistrationRecord},
    params::MapperParams,
    repeated::pairs_underfoot,
    standpoint::Mosaic,
};

use self::{
    adjust::{Scope, adjust},
    ambiguity::settle_pose,
    calibration::calibrate,
    continuation::{Continued, continue_planes},
    correspondence::CorrespondenceGraph,
    depths::is_indoors,
    divide::divide,
    latecomers::{FEW_IMAGES, best_crossing, count_held_by_pairs},
    lens::choose_lenses,
    model::Model,
    parts::{Anchors, Part, Parts},
    projection::search_by_projection,
    register::{PoseHypothesis, Visibility, count_scene_matches, hypothesize_baseline, register, visibility},
    repeated::Underfoot,
    standpoint::Standpoints,
    stitching::measure_stitching,
    structure::{PointLimits, complete_and_merge, filter, separate, triangulate_image, triangulate_match},
    told::{correct_told, corrections, said_of_corrections},
    witnesses::Witnesses,
};
use crate::{BaselineLength, ImageId, Observation, PairGeometry, Rigid, TwoViewKind, bundle::BundleParams};

/// Bumped when equal inputs and parameters give another model.
pub const MAPPER_VERSION: u32 = 81;

/// Builds all components from verified pairs, largest first; those that a similarity is supported between become one.
///
/// Images that share no geometry with others are in no component. The frame of a component is its first camera's,
/// with the first baseline as unit of length, until it is georegistered.
///
/// Where images turn out not to share the camera that they were given as one, they are mapped again with several, unless it is
/// known or a bare guess: see [`MapperOutput::components`] and [`MapperReport::doubtful`]. Intrinsics that are told and that the
/// largest component contradicts are replaced, and all is mapped again: see [`MapperParams::correct_told`] and
/// [`MapperParams::calibrate_photos`].
pub fn reconstruct(params: &MapperParams, input: &MapperInput<'_>, seed: u64) -> MapperOutput {
    let mut output = reconstruct_with(params, input, seed);
    let mut used = input.clone();
    for _ in 0..MAX_CORRECTIONS {
        let Some(largest) = output.components.first() else { break };
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
    let corrected = corrections(input, &used.cameras);
    if params.calibrate_photos {
        output.report.warnings.extend(said_of_corrections(input, &corrected));
    }
    output.corrected = corrected.into_values().collect();
    output
}

/// Images of the largest component.
fn registered_in(output: &MapperOutput) -> usize {
    output.components.first().map_or(0, |component| component.registered().count())
}

/// How often images are mapped again with other intrinsics than they are told.
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

/// All matches of the enabled pairs.
fn graph_of(input: &MapperInput<'_>, enabled: &[bool]) -> CorrespondenceGraph {
    let counts: Vec<usize> = input.images.iter().map(|image| image.features.len()).collect();
    CorrespondenceGraph::build(&counts, input.pairs, enabled)
}

/// How many times farther off observations may be when a finished model is opened to them once more.
///
/// A model keeps what agrees with it, and what it keeps holds it where it is: a panorama that came in a quarter of a
/// degree off, half a dozen pixels, had refused the matches that would have turned it.
const REOPENED: f64 = 8.0;

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
    /// Images about which it was tried to straighten the model.
    straightened: Vec<bool>,
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
        Self {
            params,
            graph: graph_of(input, &enabled),
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
            straightened: vec![false; input.images.len()],
            records: Vec::new(),
            witnesses: None,
            admits_latecomers: false,
            admits_by_depths: false,
            seed,
        }
    }

    /// Takes no match of these pairs any more, nor what only they tie together. Returns the observations dropped.
    fn leave_out(&mut self, pairs: &[bool]) -> usize {
        self.enabled.iter_mut().zip(pairs).for_each(|(enabled, left_out)| *enabled &= !left_out);
        self.graph = graph_of(self.model.input, &self.enabled);
        let left_out = graph_of(self.model.input, pairs);
        separate(&mut self.model, &self.graph, &left_out)
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
        let (judge, mut records) = (self.judge(), Vec::new());
        let accepted = found.by_ref().find_map(|(edge, pose)| {
            Some((edge.image, judge.first_accepted(edge.image, vec![pose], &mut false, &mut records)?))
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
        let (judge, mut records) = (self.judge(), Vec::new());
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
            Some((judge.first_accepted(to, vec![hypothesis], &mut false, &mut records)?, continued))
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
        let camera = self.model.input.camera_index(image);
        self.model.input.is_fixed(camera)
            || !self.model.cameras[camera].is_bare_guess()
            || !self.model.registered_with(camera).is_empty()
    }

    /// Finds the intrinsics of unknown cameras that no registered image has, where a waiting image tells them.
    fn calibrate_waiting(&mut self) {
        let camera_of = |image: ImageId| self.model.input.camera_index(image);
        let mut is_settled: Vec<bool> =
            self.model.input.calibrations.iter().map(|calibration| calibration.is_settled()).collect();
        self.model.registered().for_each(|image| is_settled[camera_of(image)] = true);
        if !is_settled.contains(&false) {
            return;
        }
        for image in (0..self.model.poses.len() as u32).map(ImageId) {
            let camera = self.model.input.camera_index(image);
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
        let judge = self.judge();
        let (mut records, mut refused) = (Vec::new(), Vec::new());
        let mut best: Option<(ImageId, PoseHypothesis)> = None;
        // The first few in any case, the others until one is acceptable.
        let (few, others) = waiting.split_at(waiting.len().min(3));
        for tried in std::iter::once(few).chain(others.chunks(2)) {
            let poses: Vec<_> =
                tried.par_iter().with_max_len(1).map(|&(_, image)| judge.acceptable_pose(image)).collect();
            for (&(count, image), (pose, mut of_image)) in tried.iter().zip(poses) {
                records.append(&mut of_image);
                match pose {
                    Some(pose) => {
                        if best.as_ref().is_none_or(|(_, other)| pose.inliers.len() > other.inliers.len()) {
                            best = Some((image, pose));
                        }
                    }
                    None => refused.push((count, image)),
                }
            }
            if best.is_some() {
                break;
            }
        }
        self.records.append(&mut records);
        for (count, image) in refused {
            self.refused_at[image.index()] = count;
        }
        best
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
            if let [image] = group[..]
                && self.straighten(image)
            {
                continue;
            }
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
        let judge = self.judge();
        let misplaced = |(at, &image): (usize, &ImageId)| Some((at, judge.seen_if_misplaced(image)?));
        images.par_iter().with_max_len(1).enumerate().find_map_first(misplaced)
    }

    /// How many of these images do not see what they ought to.
    fn misplaced_count(&self, images: impl Iterator<Item = ImageId>) -> usize {
        let images: Vec<ImageId> = images.collect();
        let judge = self.judge();
        let is_misplaced = |image: &ImageId| judge.seen_if_misplaced(*image).is_some();
        images.into_par_iter().with_max_len(1).filter(is_misplaced).count()
    }

    fn adjust_all(&mut self, max_iterations: u32) {
        self.adjust_all_by(&self.params.bundle(max_iterations));
    }

    fn adjust_all_by(&mut self, params: &BundleParams) {
        self.adjust_within(params, &Scope::global(&self.model));
    }

    fn adjust_within(&mut self, params: &BundleParams, scope: &Scope) {
        adjust(&mut self.model, params, scope);
        self.follow_anchors();
    }

    /// Adjusts everything, drops what disagrees and takes in what now agrees, `rounds` times or until nothing changes.
    fn refine(&mut self, rounds: usize, max_iterations: u32) {
        self.refine_within(self.params.limits(), rounds, max_iterations);
    }

    fn refine_within(&mut self, limits: PointLimits, rounds: usize, max_iterations: u32) {
        self.refine_by(Scope::global, limits, rounds, max_iterations);
    }

    /// The same, of which adjustments move what is in a scope alone.
    fn refine_by(
        &mut self,
        scope: impl Fn(&Model<'a>) -> Scope,
        limits: PointLimits,
        rounds: usize,
        max_iterations: u32,
    ) {
        for _ in 0..rounds {
            let observations = self.model.observation_count();
            let scope = scope(&self.model);
            self.adjust_within(&self.params.bundle(max_iterations), &scope);
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
    use nalgebra::{UnitQuaternion, Vector3};

    use super::test_street::{POINTS, Street, first_two};
    use super::*;

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
}
