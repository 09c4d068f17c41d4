//! Steps round a corner whose length nothing but the ground tells.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use nalgebra::Vector3;
use setloc_features::{ImageFeatures, ImagePyramid, Match, Rays};

use super::{Corner, corner::Sharpened};
use crate::{
    BaselineLength, ImageId, Observation, PairGeometry, Place, Reconstruction, ReconstructionPoint, Rigid,
    StepPose, TwoViewKind,
    mapper::{
        continuation::reference_among,
        wall::{Bearings, steps_by_wall},
    },
    solvers::triangulation::{WorldRay, triangulate, triangulation_angle},
};

/// Logarithms of the lengths about which a step is sought, in those of its reference baseline, and the standard deviation
/// of each.
const LN_LENGTHS: [f64; 5] = [0.0, 0.4, -0.4, 0.8, -0.8];
const LN_DEVIATION: f64 = 0.15;
/// Most images that are tried, each by its pair of most matches: each takes up to 40 CPU seconds.
const MAX_STEPS: usize = 2;
/// How far another pose may be, as a share of the step and in radians, to be compared by the search about the best.
const NEAR_STEP: f64 = 0.15;
const NEAR_TURN_RAD: f64 = 0.0175;
/// Fewest patches that tell a length by themselves. On nineteen rendered corners seventeen lengths of 66 patches and more
/// put the photo within 0.07 m, two of 32 and 38 half a metre off.
const MIN_PATCHES: usize = 50;
/// Largest error of an observation of a new point, in standard deviations, and the smallest angle of its rays.
const MAX_SIGMAS: f64 = 4.0;
const MIN_ANGLE_RAD: f64 = 0.0175;
/// Seed of the search for walls.
const SEED: u64 = 1;

/// Registers images that share little more than one wall with a registered one, where the pixels of the ground that both
/// show tell how far they stand apart. Returns the images, in the order in which they were registered.
///
/// `pairs` are verified pairs of registered and other images, `features` those of all images of the component. `load` is
/// as of [`sharpen_lengths`](crate::sharpen_lengths). An image gets its pose, a [`BaselineLength`] that says what it rests
/// on, and the matches on the wall as observations.
///
/// # Errors
/// The first of `load`.
pub fn register_by_ground<E>(
    component: &mut Reconstruction,
    pairs: &[PairGeometry],
    features: &[&ImageFeatures],
    load: impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E>,
) -> Result<Vec<ImageId>, E> {
    let mut steps: Vec<Open> = pairs.iter().filter_map(|pair| Open::new(component, pair)).collect();
    steps.sort_by_key(|step| std::cmp::Reverse(step.matches.len()));
    let mut tried = BTreeSet::new();
    steps.retain(|step| tried.insert(step.to));
    steps.truncate(MAX_STEPS);
    let mut registered = Vec::new();
    for step in steps {
        let Some((length, matches)) = step.length(component, features, &load)? else { continue };
        let Some(from) = component.images[step.from.index()].world_from_camera else { continue };
        let Some(reference) = component.images[step.reference.index()].world_from_camera else { continue };
        let baseline = (from.translation - reference.translation).norm();
        let pose = from * length.step().scaled(baseline).first_from_second;
        component.images[step.to.index()].world_from_camera = Some(pose);
        component.lengths.push(length);
        observe(component, features, &step, &matches);
        registered.push(step.to);
    }
    Ok(registered)
}

/// A pair of a registered image and one that waits for the length of its step.
struct Open {
    reference: ImageId,
    from: ImageId,
    to: ImageId,
    /// From the registered image to the other.
    matches: Vec<Match>,
}

impl Open {
    fn new(component: &Reconstruction, pair: &PairGeometry) -> Option<Self> {
        let pose = |image: ImageId| component.images.get(image.index())?.world_from_camera;
        let PairGeometry { first, second, two_view } = pair;
        let (from, to, matches) = match (pose(*first), pose(*second)) {
            (Some(_), None) => (*first, *second, two_view.inliers.clone()),
            (None, Some(_)) => {
                (*second, *first, two_view.inliers.iter().map(|found| found.swapped()).collect())
            }
            _ => return None,
        };
        let reference = reference_of(component, from)?;
        (two_view.kind == TwoViewKind::General).then_some(Self { reference, from, to, matches })
    }

    /// The length that the ground tells, and the matches on the wall.
    fn length<E>(
        &self,
        component: &Reconstruction,
        features: &[&ImageFeatures],
        load: &impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E>,
    ) -> Result<Option<(BaselineLength, Vec<Match>)>, E> {
        let [first, second] = [self.from, self.to].map(|image| rays_of(component, features, image));
        let (bearings_first, sigmas_first) = chosen(&first, self.matches.iter().map(|m| m.first));
        let (bearings_second, sigmas_second) = chosen(&second, self.matches.iter().map(|m| m.second));
        let rays = Bearings {
            first: &bearings_first,
            second: &bearings_second,
            sigmas_first: &sigmas_first,
            sigmas_second: &sigmas_second,
        };
        let steps = steps_by_wall(&rays, SEED);
        let images = [self.reference, self.from, self.to];
        let Some((first, on_wall)) = steps.first() else { return Ok(None) };
        let Some(unknown) = BaselineLength::of_step(images, first, 1.0, 0) else { return Ok(None) };
        let Some(corner) = Corner::new(component, &unknown, load)? else { return Ok(None) };
        let found = corner.by_ground(|sought| {
            let mut found: Vec<(&StepPose, Sharpened)> = steps
                .iter()
                .flat_map(|(step, _)| LN_LENGTHS.map(|ln_length| (step, ln_length)))
                .filter_map(|(step, ln_length)| Some((step, sought(&at_length(step, ln_length.exp()))?)))
                .collect();
            found.sort_by(|(_, a), (_, b)| b.likeness.total_cmp(&a.likeness));
            let mut found = found.into_iter();
            let (step, best) = found.next()?;
            // The length that it was sought about is nothing that is known: it is sought about what came out once more.
            let about = at_length(step, best.pose.first_from_second.translation.norm() / corner.baseline);
            let rival = found.map(|(_, other)| other).find(|other| !is_near(&best.pose, &other.pose));
            if best.decides_against(rival.as_ref()) { sought(&about) } else { None }
        });
        let length = found
            .filter(|found| found.patches >= MIN_PATCHES)
            .and_then(|found| BaselineLength::of_step(images, &found.pose, corner.baseline, found.patches));
        let matches = on_wall.iter().map(|&at| self.matches[at]).collect();
        Ok(length.map(|length| (length, matches)))
    }
}

/// The image that shares most points with a registered one and does not stand at the same place.
fn reference_of(component: &Reconstruction, image: ImageId) -> Option<ImageId> {
    let center_of = |image: ImageId| Some(component.images[image.index()].world_from_camera?.translation);
    let tracks = component.points.iter().map(|point| &point.track[..]);
    let seen = tracks.filter(|track| track.iter().any(|seen| seen.image == image));
    reference_among(seen, &center_of(image)?, center_of)
}

fn rays_of(component: &Reconstruction, features: &[&ImageFeatures], image: ImageId) -> Rays {
    features[image.index()].rays(component.camera_of(image))
}

fn chosen(rays: &Rays, features: impl Iterator<Item = u32>) -> (Vec<Vector3<f64>>, Vec<f64>) {
    features.map(|at| (rays.bearings[at as usize], rays.sigmas[at as usize])).unzip()
}

/// Whether a search about one pose compares the other.
fn is_near(pose: &StepPose, other: &StepPose) -> bool {
    let [pose, other] = [pose, other].map(|step| step.first_from_second);
    let apart = (pose.translation - other.translation).norm();
    apart <= NEAR_STEP * pose.translation.norm() && pose.rotation.angle_to(&other.rotation) <= NEAR_TURN_RAD
}

/// A step of about this length.
fn at_length(step: &StepPose, length: f64) -> StepPose {
    let mut step = step.scaled(length);
    let along = step.first_from_second.translation * LN_DEVIATION;
    let mut of_center = step.covariance.fixed_view_mut::<3, 3>(3, 3);
    of_center += along * along.transpose();
    step
}

/// Makes matches observations of points: of those that the registered image sees, and of new ones.
fn observe(component: &mut Reconstruction, features: &[&ImageFeatures], step: &Open, matches: &[Match]) {
    let rays = [step.from, step.to].map(|image| rays_of(component, features, image));
    let pose = |image: ImageId| component.images[image.index()].world_from_camera;
    let [Some(from), Some(to)] = [step.from, step.to].map(pose) else { return };
    let ray = |pose: &Rigid, rays: &Rays, at: u32| {
        WorldRay::new(pose, &rays.bearings[at as usize], rays.sigmas[at as usize])
    };
    let seen_by = |point: &ReconstructionPoint| {
        point.track.iter().find(|seen| seen.image == step.from).map(|seen| seen.feature)
    };
    let point_of: BTreeMap<u32, usize> =
        (component.points.iter().enumerate()).filter_map(|(at, point)| Some((seen_by(point)?, at))).collect();
    for found in matches {
        let own = Observation { image: step.to, feature: found.second };
        let [first, second] = [ray(&from, &rays[0], found.first), ray(&to, &rays[1], found.second)];
        let agrees = |ray: &WorldRay, position: &Vector3<f64>| {
            ray.angular_error(position) <= MAX_SIGMAS * ray.sigma && ray.depth(position) > 0.0
        };
        if let Some(&at) = point_of.get(&found.first) {
            let point = &mut component.points[at];
            let is_new = point.track.iter().all(|seen| seen.image != step.to);
            if is_new && agrees(&second, &point.position) {
                let at = point.track.partition_point(|seen| *seen < own);
                point.track.insert(at, own);
                if let Some(aligned) = &mut point.aligned {
                    let keypoint = &features[step.to.index()].keypoints[found.second as usize];
                    aligned.places.insert(at, Place::from(keypoint));
                }
            }
            continue;
        }
        let Some(position) = triangulate(&[first, second]) else { continue };
        let angle = triangulation_angle(&first.origin, &second.origin, &position);
        if angle < MIN_ANGLE_RAD || ![first, second].iter().all(|ray| agrees(ray, &position)) {
            continue;
        }
        let errors = [first, second].map(|ray| ray.angular_error(&position) / ray.sigma);
        let mut track = vec![Observation { image: step.from, feature: found.first }, own];
        track.sort_unstable();
        component.points.push(ReconstructionPoint {
            position,
            color: features[step.from.index()].colors.get(found.first as usize).copied().unwrap_or_default(),
            error_sigma: errors.map(|error| error * error).iter().sum::<f64>().sqrt() / 2_f64.sqrt(),
            covariance: None,
            track,
            aligned: None,
        });
    }
}
