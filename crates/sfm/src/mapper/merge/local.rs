//! Similarities between two parts that are sought about single pairs of images.
//!
//! Of long parts that meet at one corner, a few images share a hundred matches, and all others match repeated
//! façades: random samples of all that crosses hardly ever consist of right ones (a twentieth of 3000). Where streets are laid out
//! in a grid, one part laid onto the other explains more matches than the corner where they meet, even of those of the few images
//! there. The strongest pair knows better: two panoramas next to each other have hundreds of matches, most of which no
//! third image sees, so that few of them carry a point. They tell the rotation between the parts and the direction of the baseline,
//! and leave its length and the scale open, which two matches with a point tell.

use std::cmp::Reverse;

use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::{
    super::{model::Model, witnesses::count_on_circles},
    Attempt, MIN_SEED,
    crossing::{Crossing, distinct},
    similarity::Sights,
};
use crate::{ImageId, Observation, PairGeometry, PointId, Rigid, Similarity, TwoViewKind};

/// Pairs of images about which similarities are sought.
pub(super) const LOCAL_PAIRS: usize = 5;
/// Images of either part about each of a pair, itself included.
const LOCAL_IMAGES: usize = 3;
/// Samples of two matches that each give a similarity by a pair.
const SAMPLES: usize = 500;
/// Smallest share of a pair's matches that must still lie on its epipolar circles once the similarity is refined.
const MIN_KEPT_OF_PAIR: f64 = 0.5;
/// Smallest sine squared between what the length of a baseline and the scale change for two matches to tell both.
const MIN_INDEPENDENCE: f64 = 1e-4;

/// A verified pair across, seen from the part that is moved.
struct Across<'p> {
    pair: &'p PairGeometry,
    kept: ImageId,
    moved: ImageId,
    moved_from_kept: Rigid,
}

/// What a pair leaves of a similarity, but for the length of its baseline and the scale.
struct ByPair<'s> {
    kept: &'s Model<'s>,
    moved: &'s Model<'s>,
    kept_pose: Rigid,
    /// Pose of the pair's image of the moved part in the frame of the kept one, at the pair's own length, and in its own.
    moved_pose: Rigid,
    own_pose: Rigid,
}

impl Attempt<'_, '_, '_> {
    /// Similarities about the pairs with most verified matches: the one about the strongest, and the one that explains most of all
    /// matches.
    pub fn local_similarities(&self, crossings: &[Crossing]) -> Vec<Similarity> {
        let seek = |(at, across): (usize, &Across<'_>)| {
            let of_kept = nearest(self.sides.kept, across.kept);
            let of_moved = nearest(self.sides.moved, across.moved);
            let is_near = |crossing: &&Crossing| {
                of_kept.contains(&crossing.kept.image) && of_moved.contains(&crossing.moved.image)
            };
            let near: Vec<Crossing> = crossings.iter().filter(is_near).copied().collect();
            let best = self.with_pair(across, &near).or_else(|| {
                let candidates =
                    Sights::collect(&self.sides, near.iter()).estimate(&self.ransac(), self.seed);
                Some(self.best_of(&near, candidates)?.1)
            })?;
            Some((at, self.sides.score(crossings, &best, self.params.max_error_sigma), best))
        };
        let strongest = self.strongest_across(self.sides.kept.input.pairs);
        let ranked: Vec<(usize, &Across<'_>)> = strongest.iter().enumerate().collect();
        let found: Vec<(usize, f64, Similarity)> =
            ranked.into_par_iter().with_max_len(1).filter_map(seek).collect();
        let best = found.iter().min_by(|a, b| a.1.total_cmp(&b.1));
        let mut chosen: Vec<_> = found.first().into_iter().chain(best).collect();
        chosen.dedup_by_key(|(at, ..)| *at);
        chosen.into_iter().map(|(_, _, similarity)| *similarity).collect()
    }

    /// The [`LOCAL_PAIRS`] verified pairs across with most matches.
    fn strongest_across<'p>(&self, pairs: &'p [PairGeometry]) -> Vec<Across<'p>> {
        let across = |pair: &'p PairGeometry| {
            let (kept, moved) = self.sides.ends(pair.first, pair.second)?;
            let (_, moved_from_kept) = pair.seen_from(moved)?;
            Some(Across { pair, kept, moved, moved_from_kept })
        };
        let mut all: Vec<Across<'p>> = pairs.iter().filter_map(across).collect();
        all.sort_by_key(|across| Reverse(across.pair.two_view.inliers.len()));
        all.truncate(LOCAL_PAIRS);
        all
    }

    /// The similarity that most of these matches agree on of those that a pair leaves; `None` where few do, or what they agree on is
    /// not what the pair says.
    fn with_pair(&self, across: &Across<'_>, near: &[Crossing]) -> Option<Similarity> {
        let &Across { pair, kept, moved, moved_from_kept } = across;
        if pair.two_view.kind == TwoViewKind::PureRotation {
            return None;
        }
        let bound = self.params.max_error_sigma;
        let kept_pose = self.sides.kept.poses[kept.index()].as_ref()?.world_from_camera;
        let by_pair = ByPair {
            kept: self.sides.kept,
            moved: self.sides.moved,
            kept_pose,
            moved_pose: kept_pose * moved_from_kept.inverse(),
            own_pose: self.sides.moved.poses[moved.index()].as_ref()?.world_from_camera,
        };
        let sights: Vec<Sight> = near.iter().flat_map(|crossing| by_pair.sights(crossing)).collect();
        if sights.len() < 2 {
            return None;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let samples = (0..SAMPLES).map(|_| [0; 2].map(|_| &sights[rng.random_range(0..sights.len())]));
        let scored = samples.filter_map(|sample| by_pair.similarity(sample)).map(|similarity| {
            let score = self.sides.score(near, &similarity, bound);
            (score, similarity)
        });
        let (_, best) = scored.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let refined = self.refined(near, best);
        let moved_from_kept = refined.transform_pose(&by_pair.own_pose).inverse() * kept_pose;
        let of_both = [pair.first, pair.second].map(|image| {
            let side = if image == kept { self.sides.kept } else { self.sides.moved };
            &side.rays[image.index()]
        });
        let second_from_first = if pair.first == kept { moved_from_kept } else { moved_from_kept.inverse() };
        let on_circles = count_on_circles(of_both, &second_from_first, &pair.two_view.inliers, bound);
        let is_the_pair_s = on_circles as f64 >= MIN_KEPT_OF_PAIR * pair.two_view.inliers.len() as f64;
        (is_the_pair_s && distinct(&self.sides.agreeing(near, &refined, bound)) >= MIN_SEED)
            .then_some(refined)
    }
}

/// What a ray that leads to a point says: step · length + arm · scale is the target, all of them across the ray.
struct Sight {
    step: Vector3<f64>,
    arm: Vector3<f64>,
    target: Vector3<f64>,
}

impl ByPair<'_> {
    fn rotation(&self) -> UnitQuaternion<f64> {
        self.moved_pose.rotation * self.own_pose.rotation.inverse()
    }

    /// The baseline at the pair's own length.
    fn step(&self) -> Vector3<f64> {
        self.moved_pose.translation - self.kept_pose.translation
    }

    /// What a match says: the ray of the moved image leads to the kept point, and that of the kept image to the moved one.
    fn sights(&self, crossing: &Crossing) -> impl Iterator<Item = Sight> {
        let Self { kept, moved, kept_pose, own_pose, .. } = self;
        let (rotation, step) = (self.rotation(), self.step());
        let seen = |model: &Model<'_>, seen: Observation| {
            let pose = model.poses[seen.image.index()].as_ref()?.world_from_camera;
            let bearing = model.rays[seen.image.index()].bearings[seen.feature as usize];
            Some((pose.rotation * bearing, pose.translation))
        };
        let position = |model: &Model<'_>, id: Option<PointId>| Some(model.point(id?)?.position);
        let across = |ray: Vector3<f64>, arm: Vector3<f64>, target: Vector3<f64>| Sight {
            step: ray.cross(&step),
            arm: ray.cross(&arm),
            target: ray.cross(&target),
        };
        let to_moved = position(moved, crossing.moved_point).zip(seen(kept, crossing.kept));
        let to_moved = to_moved.map(|(point, (ray, from))| {
            across(ray, rotation * (point - own_pose.translation), from - kept_pose.translation)
        });
        let to_kept = position(kept, crossing.kept_point).zip(seen(moved, crossing.moved));
        let to_kept = to_kept.map(|(point, (ray, from))| {
            let arm = rotation * (from - own_pose.translation);
            across(rotation * ray, arm, point - kept_pose.translation)
        });
        to_moved.into_iter().chain(to_kept)
    }

    /// The similarity by two rays to points.
    fn similarity(&self, sights: [&Sight; 2]) -> Option<Similarity> {
        let (length, scale) = length_and_scale(sights)?;
        let rotation = self.rotation();
        let translation =
            self.kept_pose.translation + self.step() * length - rotation * self.own_pose.translation * scale;
        (length > 0.0 && scale > 0.0).then_some(Similarity { scale, rotation, translation })
    }
}

/// Length of the baseline and scale by two rays, where these tell them apart.
fn length_and_scale(sights: [&Sight; 2]) -> Option<(f64, f64)> {
    let sum = |product: fn(&Sight) -> f64| sights.into_iter().map(product).sum::<f64>();
    let (steps, arms) = (sum(|s| s.step.norm_squared()), sum(|s| s.arm.norm_squared()));
    let mixed = sum(|s| s.step.dot(&s.arm));
    let (of_step, of_arm) = (sum(|s| s.step.dot(&s.target)), sum(|s| s.arm.dot(&s.target)));
    let determinant = steps * arms - mixed * mixed;
    (determinant > MIN_INDEPENDENCE * steps * arms).then(|| {
        let length = arms * of_step - mixed * of_arm;
        let scale = steps * of_arm - mixed * of_step;
        (length / determinant, scale / determinant)
    })
}

/// The images of a part nearest to one of them, itself first.
fn nearest(model: &Model<'_>, image: ImageId) -> Vec<ImageId> {
    let center = |image: ImageId| model.poses[image.index()].as_ref().map(|pose| *pose.center());
    let Some(here) = center(image) else { return Vec::new() };
    let distance = |image: &ImageId| center(*image).map_or(f64::INFINITY, |at| (at - here).norm());
    let mut near: Vec<ImageId> = model.registered().collect();
    near.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
    near.truncate(LOCAL_IMAGES);
    near
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapper::{
        MapperParams,
        structure::triangulate_image,
        test_street::{POINTS, Street, first_two},
    };

    #[test]
    fn two_matches_and_a_pair_tell_length_and_scale() {
        let mut street = Street::new("local", 60, POINTS);
        street.stand_again(2);
        let input = street.input();
        let kept = first_two(&street, &input);
        // The other two images by themselves, in another frame.
        let rotation = UnitQuaternion::from_euler_angles(0.1, -1.2, 0.3);
        let truth = Similarity { scale: 2.5, rotation, translation: Vector3::new(4.0, -1.0, 7.0) };
        let mut moved = Model::new(&input);
        for image in [2, 3] {
            moved.set_pose(
                ImageId(image),
                Some(truth.inverse().transform_pose(&street.poses[image as usize])),
            );
        }
        triangulate_image(&mut moved, &street.graph(), MapperParams::default().limits(), ImageId(2));
        let pair = &input.pairs[2];
        let (_, moved_from_kept) = pair.seen_from(ImageId(2)).expect("it is of the pair");
        let kept_pose = street.poses[1];
        let by_pair = ByPair {
            kept: &kept,
            moved: &moved,
            kept_pose,
            // A pair knows its direction only.
            moved_pose: {
                let pose = kept_pose * moved_from_kept.inverse();
                let step = pose.translation - kept_pose.translation;
                Rigid::new(pose.rotation, kept_pose.translation + step.normalize())
            },
            own_pose: truth.inverse().transform_pose(&street.poses[2]),
        };
        let sights = |feature: u32| {
            let [kept_seen, moved_seen] = [1, 2].map(|image| Observation { image: ImageId(image), feature });
            let crossing = Crossing {
                kept: kept_seen,
                moved: moved_seen,
                kept_point: kept.point_of(kept_seen),
                moved_point: moved.point_of(moved_seen),
                verified: true,
            };
            by_pair.sights(&crossing).collect::<Vec<_>>()
        };
        let sights: Vec<Sight> = (0..POINTS as u32).flat_map(sights).collect();
        let samples = sights.iter().zip(&sights[1..]);
        let found = samples.filter_map(|(one, other)| by_pair.similarity([one, other]));
        let mut scales: Vec<f64> = found.map(|similarity| similarity.scale).collect();
        assert!(scales.len() > POINTS, "{} samples", scales.len());
        scales.sort_by(f64::total_cmp);
        let median = scales[scales.len() / 2];
        assert!((median / truth.scale - 1.0).abs() < 0.01, "{median}");
    }

    #[test]
    fn what_length_and_scale_change_alike_tells_neither() {
        let (along, across) = (Vector3::new(1.0, 0.2, -0.4), Vector3::new(0.1, 2.0, 0.3));
        let sight =
            |step: Vector3<f64>, arm: Vector3<f64>| Sight { step, arm, target: step * 3.0 + arm * 0.5 };
        let both = [&sight(along, across), &sight(across, along * 0.3)];
        let (length, scale) = length_and_scale(both).expect("they differ");
        assert!((length - 3.0).abs() < 1e-12 && (scale - 0.5).abs() < 1e-12);
        let alike = sight(along, along * 2.0);
        assert!(length_and_scale([&alike, &alike]).is_none());
        let still = sight(Vector3::zeros(), across);
        assert!(length_and_scale([&still, &still]).is_none());
    }
}
