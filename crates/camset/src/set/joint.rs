//! One component of a set: rigid pose, joint refinement with guided matching, verdicts.

mod answers;
mod distrust;
mod hinges;
mod hung;
mod looks;
mod observations;
mod ties;
mod walls;

use std::collections::BTreeMap;

use nalgebra::{Matrix6, Vector2, Vector3};
use rayon::prelude::*;
use setloc_features::{Calibration, Camera};
use setloc_sfm::{Reconstruction, Rigid, Similarity, WallSight};

use self::distrust::is_distrusted;
use self::observations::free_views;
use self::walls::agreeing_walls;
use super::called;
use super::correspondences::{SetCorrespondence, correspondences, set_rays};
use super::rigid::{RigidPose, SetPhotos, rigid_pose};
use super::sights::{SetView, Sights};
use crate::evidence::{
    PhotoRays, chance_of_inlier, log10_chance_of_more, log10_false_alarms, median, occupied_cells,
};
use crate::guided::guided_matches;
use crate::refine::{
    JointCamera, JointModel, JointObservations, JointPhoto, KnownOfCamera, SceneView, Sighting,
    refine_jointly,
};
use crate::stretch::PhotoStretch;
use crate::types::DOUBTFUL;
use crate::underfoot::{Ground, Underfoot};
use crate::verdict::{Evidence, MIN_OFF_GROUND, judge_support, weaker};
use crate::{
    CamsetParams, PhotoEvidence, PhotoLocalization, Pictures, QueryPhoto, Scene, SceneMatch, Verdict, Views,
};

/// Correspondences in a minimal sample of the generalized pose with scale.
const SAMPLE: usize = 4;
/// Factors on inlier bound and search radius in the last rounds; before, drift may still be larger.
const WIDENING: [f64; 3] = [2.5, 1.5, 1.0];

/// Fewest matches seen from elsewhere than the rest that give a set its scale at all.
const MIN_FOR_SCALE: usize = 3;

/// Scales at which a set is tried to see what it shows by chance; nearer ones show some of what the right one does.
const OTHER_SCALES: [f64; 10] = [0.15, 0.25, 0.35, 0.5, 0.6, 1.6, 2.0, 2.8, 4.0, 6.0];

/// Largest log₁₀ of the chance of showing as much at a wrong scale: a hundred may have been tried to find this one.
const MAX_LOG10_CHANCE: f64 = -4.0;

/// What became of one local model.
pub(crate) enum ComponentAnswer {
    Localized(Box<ComponentPoses>),
    Refused {
        reasons: Vec<String>,
        /// Matches to the scene of each photo that agree with the best pose.
        scene_points: Vec<usize>,
    },
}

/// Poses of one component, slot by slot.
pub(crate) struct ComponentPoses {
    pub world_from_set: Similarity,
    pub rigid: Vec<PhotoLocalization>,
    pub refined: Vec<PhotoLocalization>,
    /// Whether it stands elsewhere than where it is localized alone.
    pub elsewhere: Vec<bool>,
    /// Where the principal point is of those that show clearly more of the scene as parts of larger pictures.
    pub cut: Vec<Option<Vector2<f64>>>,
    /// Whether too few matches give their scale.
    pub lacks_scale: bool,
    /// Scene points that each photo sees itself.
    pub scene_points: Vec<usize>,
    pub remarks: Vec<String>,
}

impl ComponentPoses {
    /// Makes a photo uncertain, for this reason.
    pub fn doubt(&mut self, slot: usize, reason: &str) {
        for photo in [&mut self.rigid[slot], &mut self.refined[slot]] {
            photo.doubt(reason.to_owned());
        }
    }
}

/// A local model of at least two photos and what is known of them.
pub(crate) struct Component<'a> {
    pub params: &'a CamsetParams,
    pub scene: &'a Scene<'a>,
    pub photos: &'a [QueryPhoto<'a>],
    pub evidence: &'a [PhotoEvidence<'a>],
    pub model: &'a Reconstruction,
    /// Photo indices by slot, ascending.
    pub members: &'a [usize],
    /// What the photos share with images of the scene beside its points.
    pub views: &'a Views,
    /// Pixels of both.
    pub pictures: Option<&'a Pictures>,
}

/// What a local model and the scene show alike.
#[derive(Clone, Copy)]
struct Shared<'a> {
    candidates: &'a [SetCorrespondence],
    sights: &'a Sights,
    walls: &'a [WallSight],
}

/// The joint refinement's result.
struct Joint {
    model: JointModel,
    /// Scene points that each photo sees itself, within the inlier bound.
    direct: Vec<Vec<SceneMatch>>,
    /// Images of the scene that show a local point of each photo, counted by the point, within the inlier bound.
    viewed: Vec<usize>,
    /// How many of all these are of other images than the one with most.
    viewed_from_elsewhere: usize,
    /// Sights of the rigid pose that still agree.
    kept_sights: usize,
    /// Where lone rays of each photo and of images of the scene meet.
    met: Vec<Vec<Vector3<f64>>>,
    /// Patches of the scene's walls that each photo shows.
    walls: Vec<usize>,
    covariances: Vec<Option<Matrix6<f64>>>,
}

impl Joint {
    /// The standpoint whose photos see most of the scene.
    fn main_standpoint(&self) -> usize {
        let mut seen = vec![0_usize; self.direct.len()];
        for (photo, direct) in self.model.photos.iter().zip(&self.direct) {
            seen[photo.standpoint] += direct.len();
        }
        (0..seen.len()).max_by_key(|&slot| (seen[slot], std::cmp::Reverse(slot))).unwrap_or(0)
    }

    /// Slots of the photos that were not taken from there.
    fn away_from_main(&self) -> Vec<usize> {
        let main = self.main_standpoint();
        (0..self.direct.len()).filter(|&slot| self.model.photos[slot].standpoint != main).collect()
    }

    /// Scene points that those see.
    fn seen_from_elsewhere(&self) -> usize {
        self.away_from_main().into_iter().map(|slot| self.direct[slot].len()).sum()
    }
}

/// Stretches below this are not worth a sentence: half a pixel at the edge of a usual photo.
const LEAST_SAID: f64 = 5e-4;

/// What the set shows of directions that intrinsics do not tell, in words.
fn stretch_remark(stretch: &PhotoStretch) -> Option<String> {
    (stretch.is_free && stretch.largest > LEAST_SAID).then(|| {
        format!(
            "directions of its photos differ from what their intrinsics say by up to {:.2} %, as those of photos cut from stitched \
             panoramas do; this is estimated with the poses",
            100.0 * stretch.largest
        )
    })
}

/// Takes back a pose that only a scale out of thin air could give.
fn refuse_without_scale(photo: &mut PhotoLocalization) {
    photo.world_from_camera = None;
    photo.covariance = None;
    photo.verdict = Verdict::NotLocalized;
    photo.reasons.push("how far it is from the photo that sees the scene is not known".to_owned());
}

/// Observations that a photo's six degrees of freedom can fit whatever they are.
const POSE_OBSERVATIONS: usize = 3;

impl Component<'_> {
    /// Localizes the component.
    pub(crate) fn locate(&self, seed: u64) -> ComponentAnswer {
        let params = self.params;
        let rays = self.rays(|slot| &self.model.cameras[self.camera_of(slot)]);
        let mut set_from_camera: Vec<Rigid> = self
            .members
            .iter()
            .map(|&photo| self.model.images[photo].world_from_camera.unwrap_or_default())
            .collect();
        for hung in self.hung(&set_from_camera) {
            hung.follow(&mut set_from_camera);
        }
        let candidates =
            correspondences(params, self.scene.index, self.model, self.members, &rays, self.evidence);
        let set_rays = set_rays(params, self.scene.index, &set_from_camera, &rays, &candidates);
        let photos =
            SetPhotos { set_from_camera: &set_from_camera, members: self.members, evidence: self.evidence };
        let sights = self.sights(&set_from_camera, &rays);
        let ground = Ground::of_scene(self.scene);
        let worth: Vec<f64> = candidates.iter().map(|candidate| ground.worth(candidate.scene)).collect();
        let shown = |pose: &Similarity| {
            let poses = set_from_camera.iter().map(|camera| pose.transform_pose(camera)).collect();
            let found = self.guided(&rays, poses);
            found.iter().flatten().filter(|found| !ground.holds(found.point)).count()
        };
        let (given, sources) = ((&candidates[..], &worth[..]), (&set_rays, &sights));
        let rigid = rigid_pose(params, given, self.model, sources, &photos, shown, seed);
        let Some(mut rigid) = rigid else {
            let reasons =
                vec![format!("no pose explains any of its {} matches to the scene", candidates.len())];
            return ComponentAnswer::Refused { reasons, scene_points: vec![0; self.members.len()] };
        };
        let mut reasons = Vec::new();
        let mut evidence = self.support(&rays, &set_from_camera, (&candidates, &worth), &sights, &rigid);
        if evidence.inliers < params.verdict.min_inliers || evidence.off_ground < MIN_OFF_GROUND {
            let shown = self.shown_off_ground(&ground, &rays, &set_from_camera, &candidates, &rigid);
            if let Some(shown) = shown {
                self.add_shown(&mut evidence, &rays, &rigid, shown);
            }
        }
        if evidence.inliers.max(evidence.shown) < params.verdict.min_inliers {
            judge_support(&params.verdict, &evidence, &mut reasons);
            let mut scene_points = vec![0; self.members.len()];
            for &(slot, _) in rigid.agreeing.iter().flat_map(|&agreeing| &candidates[agreeing].seen_by) {
                scene_points[slot] += 1;
            }
            return ComponentAnswer::Refused { reasons, scene_points };
        }
        let mut shared = Shared { candidates: &candidates, sights: &sights, walls: &[] };
        let mut joint = self.refine_jointly(&set_from_camera, shared, &rigid);
        self.follow_pairs(&mut joint);
        evidence.log10_false_alarms = evidence.log10_false_alarms.min(self.joint_false_alarms(&joint));
        let mut support = judge_support(&params.verdict, &evidence, &mut reasons);
        let mut elsewhere = seen_from_elsewhere(&set_from_camera, &candidates, &rigid.agreeing)
            .max(sights.seen_from_elsewhere(&rigid.sights, &rigid.lone));
        // One standpoint's matches place that standpoint; a few chance matches of the others then fit some scale.
        let has_scale = self.members.len() > 1;
        let mut lacks_scale = false;
        if has_scale
            && elsewhere < params.verdict.min_inliers / 2
            && !self.scale_stands_out(&joint, &rays, &set_from_camera, &rigid)
        {
            if let Some(by_walls) = self.by_walls(&joint, &set_from_camera) {
                rigid.move_to(
                    by_walls.world_from_set,
                    (&set_rays, candidates.len()),
                    &sights,
                    params.max_error_sigmas,
                );
                shared.walls = &by_walls.sights;
                joint = self.refine_jointly(&set_from_camera, shared, &rigid);
                self.follow_pairs(&mut joint);
                elsewhere = joint.walls.iter().sum();
                reasons.push(by_walls.reason);
            }
            lacks_scale = elsewhere < params.verdict.min_inliers / 2;
            if lacks_scale {
                joint.doubt_scale(joint.main_standpoint(), &joint.away_from_main());
                reasons.push(format!(
                    "its scale rests on {elsewhere} matches seen from elsewhere than the rest"
                ));
                support = weaker(support, Verdict::Uncertain);
            }
        }
        let supporting = rigid.agreeing.iter().map(|&number| candidates[number].scene);
        if self.scene.is_doubtful(supporting.chain(joint.direct.iter().flatten().map(|seen| seen.point))) {
            reasons.push(DOUBTFUL.to_owned());
            support = weaker(support, Verdict::Uncertain);
        }
        let doubtful = if lacks_scale { Vec::new() } else { self.doubt_beyond_hinges(&mut joint) };
        let (mut refined, mut elsewhere_alone) =
            self.refined_answers(&candidates, &rigid, &joint, support, &reasons);
        self.doubt_photos(&doubtful, &mut refined);
        if let Some(reason) = self.looks_otherwise(&joint) {
            for photo in &mut refined {
                photo.doubt(reason.clone());
            }
            reasons.push(reason);
        }
        let is_distrusted = is_distrusted(&joint.model.photos, &elsewhere_alone);
        let mut without_scale = Vec::new();
        if has_scale
            && elsewhere.max(joint.seen_from_elsewhere()).max(joint.viewed_from_elsewhere) < MIN_FOR_SCALE
        {
            without_scale = joint.away_from_main();
            for &slot in &without_scale {
                refuse_without_scale(&mut refined[slot]);
            }
        }
        let mut undetermined = rigid.observability.undetermined();
        undetermined.retain(|direction| has_scale || *direction != "scale");
        let mut rigid_support = support;
        if !undetermined.is_empty() {
            reasons.push(format!(
                "the rays of the rigid set do not determine its {}",
                undetermined.join(" and ")
            ));
            rigid_support = Verdict::Uncertain;
        }
        let names: Vec<&str> = self.members.iter().map(|&photo| self.photos[photo].name).collect();
        let mut remarks = vec![format!("{}: {}", called(&names, self.scene.component), reasons.join("; "))];
        remarks.extend(self.contradicted_cameras(&joint.model));
        remarks.extend(stretch_remark(&joint.model.stretch));
        remarks.extend(self.lengths().map(|(slots, length)| self.basis(slots, &length)));
        let mut rigid_answers =
            self.rigid_answers(&set_from_camera, &candidates, &rigid, rigid_support, &reasons);
        // A photo that its own points do not hold in the refinement is held by nothing else before it.
        for (rigid, refined) in rigid_answers.iter_mut().zip(&refined) {
            rigid.verdict = weaker(rigid.verdict, refined.verdict);
        }
        for slot in without_scale {
            refuse_without_scale(&mut rigid_answers[slot]);
        }
        self.doubt_beside_lost(&joint, &mut refined, &mut rigid_answers);
        if is_distrusted {
            let is_outweighed = self.outweighed(&joint);
            let alone = (&mut elsewhere_alone[..], &is_outweighed[..]);
            remarks.push(self.distrust(&mut refined, &mut rigid_answers, alone));
        }
        ComponentAnswer::Localized(Box::new(ComponentPoses {
            world_from_set: rigid.world_from_set,
            rigid: rigid_answers,
            scene_points: joint
                .direct
                .iter()
                .zip(joint.viewed.iter().zip(&joint.walls))
                .map(|(direct, (viewed, walls))| direct.len() + viewed + walls)
                .collect(),
            // Without a pose there is nothing to contradict.
            elsewhere: (refined.iter().zip(elsewhere_alone))
                .map(|(photo, elsewhere)| elsewhere && photo.world_from_camera.is_some())
                .collect(),
            cut: self.cut_pictures(&joint, &ground),
            lacks_scale,
            refined,
            remarks,
        }))
    }

    fn camera_of(&self, slot: usize) -> usize {
        self.model.images[self.members[slot]].camera.index()
    }

    fn rays<'c>(&'c self, camera_of: impl Fn(usize) -> &'c Camera + Sync) -> Vec<PhotoRays<'c>> {
        (0..self.members.len())
            .into_par_iter()
            .with_max_len(1)
            .map(|slot| PhotoRays::new(self.photos[self.members[slot]].features, camera_of(slot)))
            .collect()
    }

    /// What images of the scene show of the local points.
    fn sights(&self, set_from_camera: &[Rigid], rays: &[PhotoRays<'_>]) -> Sights {
        if self.views.matches.is_empty() {
            return Sights::default();
        }
        let tracks: Vec<_> = (0..self.model.points.len()).map(|local| self.track(local)).collect();
        let positions: Vec<_> = self.model.points.iter().map(|point| point.position).collect();
        let set = SetView { set_from_camera, rays, tracks: &tracks, positions: &positions };
        let slot_of = |photo: usize| self.members.binary_search(&photo).ok();
        Sights::new(self.params, self.scene, self.views, &set, slot_of)
    }

    /// What supports the rigid pose, photos taken together.
    fn support(
        &self,
        rays: &[PhotoRays<'_>],
        set_from_camera: &[Rigid],
        (candidates, worth): (&[SetCorrespondence], &[f64]),
        sights: &Sights,
        rigid: &RigidPose,
    ) -> Evidence {
        let mut by_slot: Vec<Vec<SceneMatch>> = vec![Vec::new(); self.members.len()];
        for &number in &rigid.agreeing {
            for &(slot, feature) in &candidates[number].seen_by {
                by_slot[slot].push(SceneMatch { feature, point: candidates[number].scene });
            }
        }
        let (mut chance, mut total, mut cells) = (0.0, 0, 0);
        for (slot, matches) in by_slot.iter().enumerate() {
            let pose = rigid.world_from_set.transform_pose(&set_from_camera[slot]);
            let noise = median(
                matches.iter().map(|&m| rays[slot].match_noise_px(self.scene.index, &pose, m)).collect(),
            );
            // The bound that was applied includes drift.
            let drift = self.params.drift_px / noise.unwrap_or(1.0);
            let bound = self.params.max_error_sigmas.hypot(drift);
            let own = chance_of_inlier(&rays[slot], self.scene.index, &pose, matches, bound);
            chance += own * matches.len() as f64;
            total += matches.len();
            cells = cells.max(occupied_cells(&rays[slot], matches.iter().map(|m| m.feature)));
        }
        let inliers = rigid.agreeing.len();
        let chance = if total > 0 { chance / total as f64 } else { 1.0 };
        let by_rays = log10_false_alarms(candidates.len(), inliers, SAMPLE, chance);
        let by_sights = sights.log10_false_alarms(
            &rigid.sights,
            &rigid.world_from_set,
            self.params.max_error_sigmas,
            SAMPLE,
        );
        let by_lone = sights.lone_log10_false_alarms(&rigid.lone, self.params.max_error_sigmas);
        // A set's pose that its points do not support is none, however many lone rays happen to meet.
        let of_lone = |lone| if self.members.len() > 1 { 0 } else { Sights::worth_of_lone(lone) };
        // A local point that either has shown right counts once.
        let mut points = sights.points(&rigid.sights);
        points.retain(|point| rigid.agreeing.iter().all(|&number| candidates[number].local != Some(*point)));
        let mut sighted = sights.all_points();
        sighted.retain(|point| candidates.iter().all(|candidate| candidate.local != Some(*point)));
        let mut shown: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
        for &at in &rigid.sights {
            for &(slot, feature) in &sights.all[at].photos {
                shown.entry(slot).or_default().push(feature);
            }
        }
        for lone in rigid.lone.iter().map(|&at| &sights.lone[at]) {
            shown.entry(lone.slot).or_default().push(lone.feature);
        }
        for (slot, features) in shown {
            cells = cells.max(occupied_cells(&rays[slot], features.into_iter()));
        }
        let agreeing_worth: f64 = rigid.agreeing.iter().map(|&agreeing| worth[agreeing]).sum();
        let others = points.len() + of_lone(rigid.lone.len());
        Evidence {
            matches: candidates.len() + sighted.len() + of_lone(sights.lone.len()),
            inliers: inliers + others,
            sample: SAMPLE,
            log10_false_alarms: by_rays.min(by_sights).min(by_lone),
            cells,
            runner_up: rigid.runner_up,
            runner_up_share: rigid.runner_up_worth / (agreeing_worth + others as f64),
            off_ground: self.off_ground(rays, set_from_camera, candidates, sights, rigid),
            shown: 0,
        }
    }

    /// How many of the matches, sights and lone rays that agree with a pose are elsewhere than on the ground.
    fn off_ground(
        &self,
        rays: &[PhotoRays<'_>],
        set_from_camera: &[Rigid],
        candidates: &[SetCorrespondence],
        sights: &Sights,
        rigid: &RigidPose,
    ) -> usize {
        let Some(underfoot) = Underfoot::of_scene(self.scene) else { return usize::MAX };
        let pose = |slot: usize| rigid.world_from_set.transform_pose(&set_from_camera[slot]);
        let matched = rigid.agreeing.iter().filter_map(|&number| {
            let found = &candidates[number];
            let (slot, _) = *found.seen_by.first()?;
            Some((pose(slot).translation, self.scene.index.position(found.scene)))
        });
        let sighted = rigid.sights.iter().filter_map(|&at| {
            let (slot, _) = *sights.all[at].photos.first()?;
            Some((pose(slot).translation, rigid.world_from_set.transform_point(&sights.position(at))))
        });
        let seen: Vec<(Vector3<f64>, Vector3<f64>)> = matched.chain(sighted).collect();
        let is_above = |&&at: &&usize| {
            let lone = &sights.lone[at];
            let bearing = &rays[lone.slot].rays.bearings[lone.feature as usize];
            !underfoot.is_below_horizon(&pose(lone.slot), bearing)
        };
        underfoot.count_elsewhere(&seen) + rigid.lone.iter().filter(is_above).count()
    }

    /// What guided matching shows each photo of the scene, where the photos stand so.
    fn guided(&self, rays: &[PhotoRays<'_>], poses: Vec<Rigid>) -> Vec<Vec<SceneMatch>> {
        let shown = |(slot, pose): (usize, Rigid)| self.guided_of(slot, rays, &pose);
        poses.into_par_iter().enumerate().with_max_len(1).map(shown).collect()
    }

    /// The same of one photo.
    fn guided_of(&self, slot: usize, rays: &[PhotoRays<'_>], pose: &Rigid) -> Vec<SceneMatch> {
        let nearest = self.evidence[self.members[slot]].nearest;
        guided_matches(&self.params.guided, self.scene.index, &rays[slot], nearest, pose)
    }

    /// What guided matching shows each photo elsewhere than on the ground, where that stands out, and log₁₀ of the chance of
    /// as much from a wrong place.
    fn shown_off_ground(
        &self,
        ground: &Ground,
        rays: &[PhotoRays<'_>],
        set_from_camera: &[Rigid],
        candidates: &[SetCorrespondence],
        rigid: &RigidPose,
    ) -> Option<(Vec<Vec<SceneMatch>>, f64)> {
        let underfoot = Underfoot::of_scene(self.scene)?;
        let poses: Vec<Rigid> =
            set_from_camera.iter().map(|pose| rigid.world_from_set.transform_pose(pose)).collect();
        let distances = rigid.agreeing.iter().flat_map(|&agreeing| {
            let SetCorrespondence { scene, seen_by, .. } = &candidates[agreeing];
            let (point, poses) = (self.scene.index.position(*scene), &poses);
            seen_by.iter().map(move |(slot, _)| (point - poses[*slot].translation).norm())
        });
        let depth = median(distances.collect())?;
        let slid = |slide: &Vector3<f64>| -> Vec<Rigid> {
            poses.iter().map(|pose| Rigid::new(pose.rotation, pose.translation + slide)).collect()
        };
        let mut shown = self.guided(rays, poses.clone());
        for shown in &mut shown {
            shown.retain(|found| !ground.holds(found.point));
        }
        let found = shown.iter().map(Vec::len).sum();
        let log10_chance = underfoot.log10_chance_elsewhere(ground, depth, found, |slide| {
            self.guided(rays, slid(slide)).into_iter().flatten().collect()
        })?;
        Some((shown, log10_chance))
    }

    /// Counts that as evidence: off the ground in any case, in place of matches where hardly any agree.
    fn add_shown(
        &self,
        evidence: &mut Evidence,
        rays: &[PhotoRays<'_>],
        rigid: &RigidPose,
        (shown, log10_chance): (Vec<Vec<SceneMatch>>, f64),
    ) {
        let count = shown.iter().map(Vec::len).sum();
        evidence.off_ground = evidence.off_ground.max(count);
        if evidence.inliers >= self.params.verdict.min_inliers {
            return;
        }
        let of_photo = |(shown, rays): (&Vec<SceneMatch>, &PhotoRays<'_>)| {
            occupied_cells(rays, shown.iter().map(|found| found.feature))
        };
        evidence.cells = shown.iter().zip(rays).map(of_photo).fold(evidence.cells, usize::max);
        evidence.shown = count;
        evidence.log10_false_alarms = evidence.log10_false_alarms.min(log10_chance);
        evidence.runner_up_share = rigid.runner_up_worth / (evidence.inliers + count) as f64;
    }

    /// log₁₀ of the expected number of random placements of the set that explain as many features as this one.
    ///
    /// The ratio-tested matches of a long set are mostly wrong, because most of its photos do not see the scene, so
    /// few right ones among them prove little. Guided matching is the sharper test: a feature counts when the scene
    /// point that it resembles most falls within the search radius, which by chance is the radius' share of the
    /// image. Three observations a photo are taken off, as many as a free pose can bend to.
    fn joint_false_alarms(&self, joint: &Joint) -> f64 {
        let (mut features, mut explained, mut chance) = (0, 0, 0.0);
        for (slot, direct) in joint.direct.iter().enumerate() {
            let count = self.photos[self.members[slot]].features.len();
            let camera = joint.model.camera_of(slot);
            let radius_share = std::f64::consts::PI * self.params.guided.radius_px.powi(2)
                / (f64::from(camera.width) * f64::from(camera.height)).max(1.0);
            features += count;
            explained += direct.len().saturating_sub(POSE_OBSERVATIONS);
            chance += radius_share * count as f64;
        }
        log10_false_alarms(features, explained, 0, (chance / features.max(1) as f64).min(1.0))
    }

    /// Whether the photos away from the main standpoint show clearly more scene points than the rigid set does at other
    /// scales about that standpoint.
    ///
    /// These other scales tell how many are shown by chance. Far points, which any scale shows, count there as well.
    fn scale_stands_out(
        &self,
        joint: &Joint,
        rays: &[PhotoRays<'_>],
        set_from_camera: &[Rigid],
        rigid: &RigidPose,
    ) -> bool {
        let poses: Vec<Rigid> =
            set_from_camera.iter().map(|pose| rigid.world_from_set.transform_pose(pose)).collect();
        let center = poses[joint.main_standpoint()].translation;
        let away = joint.away_from_main();
        let shown = |scale: f64| -> usize {
            let count = |&slot: &usize| {
                let place = center + (poses[slot].translation - center) * scale;
                self.guided_of(slot, rays, &Rigid::new(poses[slot].rotation, place)).len()
            };
            away.par_iter().with_max_len(1).map(count).sum()
        };
        let found = joint.seen_from_elsewhere();
        let by_chance = OTHER_SCALES.iter().map(|&scale| shown(scale)).max().unwrap_or(0);
        log10_chance_of_more(found, by_chance as f64 + 1.0) <= MAX_LOG10_CHANCE
    }

    /// The paper's T_OPT, with further rounds where the last one shows that photos are stretched or have another focal length.
    fn refine_jointly(&self, set_from_camera: &[Rigid], shared: Shared<'_>, rigid: &RigidPose) -> Joint {
        let first = self.rigid_model(set_from_camera, &rigid.world_from_set);
        let known = |model: &JointModel| model.cameras.iter().filter(|camera| camera.is_known()).count();
        let known_first = known(&first);
        let joint = self.refine_in_rounds(first, 0, shared, rigid);
        if joint.model.stretch.is_free || known(&joint.model) < known_first {
            // The last round has freed it where matches were already right; freed from the rigid pose on it bends to wrong ones.
            self.refine_in_rounds(joint.model, self.params.rounds.min(1), shared, rigid)
        } else {
            joint
        }
    }

    /// The set as it lies in the scene by its rigid pose.
    fn rigid_model(&self, set_from_camera: &[Rigid], world_from_set: &Similarity) -> JointModel {
        let photo = |(slot, pose): (usize, &Rigid)| JointPhoto {
            camera: self.camera_of(slot),
            world_from_camera: world_from_set.transform_pose(pose),
            standpoint: standpoint(set_from_camera, slot),
        };
        let points = self.model.points.iter();
        let mut model = JointModel {
            cameras: self.joint_cameras(),
            photos: set_from_camera.iter().enumerate().map(photo).collect(),
            points: points.map(|point| world_from_set.transform_point(&point.position)).collect(),
            lengths: self.lengths().map(|(slots, length)| (slots, length.held().1)).collect(),
            stretch: PhotoStretch::of_set(self.scene),
        };
        model.give_own_cameras_where_many();
        model
    }

    /// Rounds of the joint refinement: observations are chosen under the present poses, then all poses move.
    ///
    /// Round 0 takes the matches that agree with the rigid pose.
    fn refine_in_rounds(
        &self,
        mut model: JointModel,
        first_round: usize,
        shared: Shared<'_>,
        rigid: &RigidPose,
    ) -> Joint {
        let Shared { candidates, sights, walls } = shared;
        let world_from_set = &rigid.world_from_set;
        let mut covariances = Vec::new();
        for round in first_round..=self.params.rounds {
            let cameras: Vec<Camera> =
                (0..self.members.len()).map(|slot| model.camera_of(slot).clone()).collect();
            let rays = self.rays(|slot| &cameras[slot]);
            let mut observations = if round == 0 {
                self.rigid_observations(candidates, rigid)
            } else {
                let steps = (self.params.rounds - round).min(WIDENING.len() - 1);
                let widening = WIDENING[WIDENING.len() - 1 - steps];
                self.observations(&model, &rays, candidates, world_from_set, widening)
            };
            let agreeing =
                if round == 0 { rigid.sights.clone() } else { self.agreeing_sights(sights, &model) };
            observations.views = free_views(sights, &agreeing, &observations.tracks);
            observations.walls = agreeing_walls(&model, walls, self.params.max_error_sigmas * WIDENING[0]);
            let local_points = model.points.len();
            self.add_lone(sights, &mut model, &rays, &mut observations);
            let last = round == self.params.rounds;
            covariances = refine_jointly(&mut model, self.scene, &rays, &observations, last);
            model.points.truncate(local_points);
        }
        let rays = self.rays(|slot| model.camera_of(slot));
        let direct = self.observations(&model, &rays, candidates, world_from_set, 1.0).direct;
        let agreeing = self.agreeing_sights(sights, &model);
        let mut viewed = vec![0; self.members.len()];
        for &at in &agreeing {
            for &(slot, _) in &sights.all[at].photos {
                viewed[slot] += 1;
            }
        }
        let bound = self.params.max_error_sigmas;
        let (mut met, mut meeting) = (vec![Vec::new(); self.members.len()], Vec::new());
        for (at, lone) in sights.lone.iter().enumerate() {
            let pose = &model.photos[lone.slot].world_from_camera;
            if let Some(point) = lone.meeting_point(&rays[lone.slot], pose, bound) {
                met[lone.slot].push(point);
                meeting.push(at);
            }
        }
        for (viewed, met) in viewed.iter_mut().zip(&met) {
            *viewed += Sights::worth_of_lone(met.len());
        }
        let viewed_from_elsewhere = sights.seen_from_elsewhere(&agreeing, &meeting);
        let kept = |of: &[usize], now: &[usize]| of.iter().filter(|at| now.binary_search(at).is_ok()).count();
        let kept_sights = kept(&rigid.sights, &agreeing) + kept(&rigid.lone, &meeting);
        let mut shown = vec![0; self.members.len()];
        for sight in agreeing_walls(&model, walls, bound) {
            shown[sight.photo] += 1;
        }
        Joint { model, direct, viewed, viewed_from_elsewhere, kept_sights, met, walls: shown, covariances }
    }

    /// Adds what photos and images of the scene show alike beside the local points: points of their own, where the
    /// rays meet.
    fn add_lone(
        &self,
        sights: &Sights,
        model: &mut JointModel,
        rays: &[PhotoRays<'_>],
        observations: &mut JointObservations,
    ) {
        let mut point_of: BTreeMap<(usize, u32), usize> = BTreeMap::new();
        for lone in &sights.lone {
            let key = (lone.slot, lone.feature);
            let pose = &model.photos[lone.slot].world_from_camera;
            let meeting = lone.meeting_point(&rays[lone.slot], pose, self.params.max_error_sigmas);
            let Some(position) = meeting else { continue };
            let point = *point_of.entry(key).or_insert_with(|| {
                let place = rays[lone.slot].place_of(lone.feature);
                let sighting = Sighting {
                    photo: lone.slot,
                    feature: Some(lone.feature),
                    place,
                    keypoint_noise_px: place.noise_px,
                };
                observations.tracks.push((model.points.len(), sighting));
                model.points.push(position);
                model.points.len() - 1
            });
            observations.views.push((point, SceneView { image: lone.seen.image, place: lone.place }));
        }
    }

    /// The sights whose rays pass by the local points where these are now.
    fn agreeing_sights(&self, sights: &Sights, model: &JointModel) -> Vec<usize> {
        let agrees = |at: &usize| {
            let sight = &sights.all[*at];
            sight.error_sigmas_of(&model.points[sight.local]) < self.params.max_error_sigmas
        };
        (0..sights.all.len()).filter(agrees).collect()
    }

    /// A camera is known when all photos that share it say so, but for focal lengths that the local model contradicts.
    fn joint_cameras(&self) -> Vec<JointCamera> {
        let known = |at: usize, camera: &Camera| {
            let mut photos = (0..self.members.len())
                .filter(|&slot| self.camera_of(slot) == at)
                .map(|slot| &self.photos[self.members[slot]]);
            if photos.clone().any(|photo| photo.calibration != Calibration::Known) {
                KnownOfCamera::Usual
            } else if photos.any(|photo| photo.camera != camera) {
                KnownOfCamera::AllButFocal(camera.clone())
            } else {
                KnownOfCamera::Intrinsics
            }
        };
        let cameras = self.model.cameras.iter().enumerate();
        cameras.map(|(at, camera)| JointCamera { known: known(at, camera), camera: camera.clone() }).collect()
    }

    /// What the set shows of focal lengths that were told otherwise, in words.
    fn contradicted_cameras(&self, model: &JointModel) -> Vec<String> {
        let contradicted = |(at, camera): (usize, &JointCamera)| {
            let KnownOfCamera::AllButFocal(_) = camera.known else { return None };
            let photos = (0..self.members.len()).filter(|&slot| self.camera_of(slot) == at);
            let photos: Vec<_> = photos.map(|slot| &self.photos[self.members[slot]]).collect();
            let (told, shown) = (photos.first()?.camera.focal_length(), camera.camera.focal_length());
            let names: Vec<&str> = photos.iter().map(|photo| photo.name).collect();
            Some(format!(
                "the focal length that is told for {} is {told:.1} px; together they show {shown:.1} px ({:+.1} %), which is used",
                names.join(", "),
                100.0 * (shown / told - 1.0)
            ))
        };
        model.cameras.iter().enumerate().filter_map(contradicted).collect()
    }
}

/// First photo with the same centre; the mapper gives photos of one standpoint exactly one.
fn standpoint(set_from_camera: &[Rigid], slot: usize) -> usize {
    let center = set_from_camera[slot].translation;
    (0..slot).find(|&other| set_from_camera[other].translation == center).unwrap_or(slot)
}

/// Number of agreeing correspondences with a ray from another place than the photo that has most of them.
fn seen_from_elsewhere(
    set_from_camera: &[Rigid],
    candidates: &[SetCorrespondence],
    agreeing: &[usize],
) -> usize {
    let mut seen = vec![0_usize; set_from_camera.len()];
    for &(slot, _) in agreeing.iter().flat_map(|&number| &candidates[number].seen_by) {
        seen[slot] += 1;
    }
    let Some(main) = (0..seen.len()).max_by_key(|&slot| seen[slot]) else { return 0 };
    let center = set_from_camera[main].translation;
    let is_elsewhere = |&number: &&usize| {
        candidates[*number].seen_by.iter().any(|&(slot, _)| set_from_camera[slot].translation != center)
    };
    agreeing.iter().filter(is_elsewhere).count()
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use setloc_sfm::PointId;

    use super::*;

    #[test]
    fn matches_of_one_standpoint_say_nothing_of_scale() {
        let at = |x: f64| Rigid::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0));
        let poses = [at(0.0), at(0.0), at(1.0)];
        let seen_by = |slots: &[usize]| SetCorrespondence {
            scene: PointId(0),
            local: None,
            seen_by: slots.iter().map(|&slot| (slot, 0)).collect(),
        };
        let candidates = [seen_by(&[0]), seen_by(&[0]), seen_by(&[1]), seen_by(&[2]), seen_by(&[0, 2])];
        assert_eq!(seen_from_elsewhere(&poses, &candidates, &[0, 1, 2]), 0);
        assert_eq!(seen_from_elsewhere(&poses, &candidates, &[0, 1, 2, 3, 4]), 2);
        assert_eq!(seen_from_elsewhere(&poses, &candidates, &[]), 0);
    }
}
