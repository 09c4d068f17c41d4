//! Parts that single verified pairs join.
//!
//! Rooms with bare walls fall into parts that share one pair, whose matches no third image sees, so that no point tells how large
//! one part is beside the other. Depths do ([`depths`]): on either side the pair's matches lie beside the part's own points,
//! or on the floor that it knows, so that the length of the pair's baseline is known in both units.

use super::{
    super::{
        Mapper,
        depths::{self, Floor, floor_of_all, stands_on_floor},
        model::Model,
        structure::{complete_and_merge, triangulate_image},
        support::{Support, Worth},
    },
    Attempt, MergeRecord, MergeVerdict, Part,
    local::LOCAL_PAIRS,
};
use crate::{BaselineLength, ImageId, PairGeometry, Similarity, TwoViewKind};

/// A similarity by one pair.
struct Hung {
    kept_from_moved: Similarity,
    /// The pair's baseline, in lengths of one of either part.
    lengths: [BaselineLength; 2],
    /// What all pairs across say of it.
    support: Support,
    /// Whether the image of the moved part that the pair is of stands on the floor of the kept one.
    is_on_floor: bool,
    /// Images of the moved part that the pairs with images of the kept one speak against.
    strangers: Vec<ImageId>,
}

/// What comes of two parts that pairs cross.
pub(super) enum Outcome {
    /// They are one.
    Joined(Part),
    /// These images of the moved part do not belong with the others, by what the kept part's images say of them.
    Strangers(Vec<ImageId>),
}

impl<'a> Attempt<'_, '_, 'a> {
    /// The joined part, where one pair tells how, no other contradicts it, and such pairs are right in both parts.
    pub fn run_hung(&self, taken: Vec<bool>, records: &mut Vec<MergeRecord>) -> Option<Outcome> {
        let sides = [self.sides.kept, self.sides.moved];
        if !sides.iter().all(|side| side.registered().all(|image| side.input.is_panoramic(image))) {
            return None;
        }
        let hung = self.best_hung(&taken)?;
        let sigmas = self.params.max_error_sigma;
        let is_fit = hung.support.is_enough_if_right()
            && (hung.support.is_strong() || hung.is_on_floor)
            && Worth::of(&sides, sigmas).believes(hung.support.widest)
            && !self.positions_disagree(&hung.kept_from_moved);
        if is_fit && !hung.strangers.is_empty() {
            return Some(Outcome::Strangers(hung.strangers));
        }
        let joined = is_fit.then(|| self.join_hung(&hung, taken)).flatten();
        let verdict = match joined {
            Some(_) => MergeVerdict::Hung,
            None if is_fit => MergeVerdict::Contradicted,
            None => MergeVerdict::Unsupported,
        };
        records.push(MergeRecord {
            candidates: hung.support.matches + hung.support.against,
            inliers: hung.support.matches,
            ..self.record(verdict)
        });
        Some(Outcome::Joined(joined?.into_part()))
    }

    /// The similarity by one of the strongest pairs across that most speaks for.
    fn best_hung(&self, taken: &[bool]) -> Option<Hung> {
        let is_moved = |image: ImageId| self.sides.moved.is_registered(image);
        let mut pairs: Vec<&PairGeometry> = (self.sides.kept.input.pairs.iter())
            .filter(|pair| pair.two_view.kind != TwoViewKind::PureRotation && self.crosses(pair))
            .collect();
        pairs.sort_by_key(|pair| std::cmp::Reverse(pair.two_view.inliers.len()));
        let floors = [self.sides.kept, self.sides.moved].map(floor_of_all);
        let by_pair = |pair| self.by_pair(pair, floors);
        let suggested: Vec<_> = pairs.into_iter().take(LOCAL_PAIRS).filter_map(by_pair).collect();
        let mut joint = self.joint(&suggested.first()?.0, taken);
        let mut best: Option<Hung> = None;
        for (kept_from_moved, lengths) in suggested {
            let sigmas = self.params.max_error_sigma;
            for image in self.sides.moved.registered() {
                joint.set_pose(image, self.pose_in_kept(image, &kept_from_moved));
            }
            let support = Support::across(&joint, is_moved, sigmas);
            if best.as_ref().is_none_or(|best| support.spread > best.support.spread) {
                let image = lengths[0].to;
                let pose = self.pose_in_kept(image, &kept_from_moved);
                let is_on_floor = pose
                    .is_some_and(|pose| stands_on_floor(&joint, floor_of_all(&joint), image, &pose, sigmas));
                let strangers = self.strangers(&joint);
                best = Some(Hung { kept_from_moved, lengths, support, is_on_floor, strangers });
            }
        }
        best
    }

    /// The images of the moved part that the pairs with images of the kept one speak against, at the poses of a model.
    ///
    /// Two rooms that wrong pairs had joined would come in together where one of them belongs.
    fn strangers(&self, joint: &Model<'_>) -> Vec<ImageId> {
        let is_stranger = |&image: &ImageId| {
            let leads_there = |pair: &&PairGeometry| {
                pair.seen_from(image).is_some_and(|(other, _)| self.sides.kept.is_registered(other))
            };
            let pairs = joint.pairs_of(image).filter(leads_there);
            Support::by(joint, pairs, self.params.max_error_sigma).is_contradicted()
        };
        self.sides.moved.registered().filter(is_stranger).collect()
    }

    /// Whether a pair is of an image of either part.
    fn crosses(&self, pair: &PairGeometry) -> bool {
        self.sides.ends(pair.first, pair.second).is_some()
    }

    /// The similarity by a pair across, with its length in both parts, below whose images these floors are.
    ///
    /// Where nothing beside the pair's matches tells its length in one of the parts, the other's and both floors do.
    fn by_pair(
        &self,
        pair: &PairGeometry,
        floors: [Option<Floor>; 2],
    ) -> Option<(Similarity, [BaselineLength; 2])> {
        let sides = [self.sides.kept, self.sides.moved];
        let is_kept_first = sides[0].is_registered(pair.first);
        let ends = if is_kept_first { [pair.first, pair.second] } else { [pair.second, pair.first] };
        let beside = |from: usize| {
            let to = 1 - from;
            let (_, to_from_from) = pair.seen_from(ends[to])?;
            let (rays, matches) = (&sides[to].rays[ends[to].index()], pair.matches_from(ends[from]));
            depths::step(sides[from], floors[from], [ends[from], ends[to]], rays, &to_from_from, &matches)
        };
        let steps = [beside(0), beside(1)];
        let by_floors = |from: usize| {
            let to = 1 - from;
            let (_, to_from_from) = pair.seen_from(ends[to])?;
            let (floors, images) = ([floors[from]?, floors[to]?], [ends[from], ends[to]]);
            depths::step_by_floors(sides[from], floors, images, &to_from_from, steps[to].as_ref()?)
        };
        let [kept, moved] = [0, 1].map(|from| steps[from].or_else(|| by_floors(from)));
        let ((kept_step, kept_length), (moved_step, moved_length)) = (kept?, moved?);
        let pose = |at: usize| Some(sides[at].poses[ends[at].index()]?.world_from_camera);
        let (in_kept, in_moved) = (pose(0)? * kept_step, pose(1)?);
        let rotation = in_kept.rotation * in_moved.rotation.inverse();
        let scale = kept_step.translation.norm() / moved_step.translation.norm();
        let translation = in_kept.translation - rotation * in_moved.translation * scale;
        Some((Similarity { scale, rotation, translation }, [kept_length, moved_length]))
    }

    /// The finished whole, unless it loses what either part knew.
    fn join_hung(&self, hung: &Hung, taken: Vec<bool>) -> Option<Mapper<'a>> {
        let mut mapper = self.mapper_over(&hung.kept_from_moved, taken);
        mapper.admit_latecomers();
        mapper.model.lengths.extend(hung.lengths);
        let limits = self.params.limits();
        for image in self.sides.moved.registered() {
            triangulate_image(&mut mapper.model, &mapper.graph, limits, image);
        }
        complete_and_merge(&mut mapper.model, &mapper.graph, limits);
        mapper.refine(2, 20);
        if !self.keeps_points(&mapper.model) || self.is_contradicted(&mapper.model) {
            return None;
        }
        mapper.grow();
        mapper.finish();
        self.keeps_images(&mapper).then_some(mapper)
    }
}
