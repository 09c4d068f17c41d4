//! What photos that are localized add to the scene.
//!
//! Their poses stand as they were found; nothing of the scene moves. A feature that shows a scene point is one more
//! observation of it: the point stays where it is and gets another look. What several photos show and the scene does
//! not know becomes a point. Such a point errs with the photos that see it, which is in its covariance, and in what the
//! scene says of their poses ([`GrownImage`]), so that a photo placed by many of them is not called better known
//! than they are.

mod apply;

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix3, Matrix6, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::Camera;
use setloc_sfm::solvers::triangulation::{WorldRay, max_triangulation_angle, triangulate};
use setloc_sfm::{ImageId, PointId, Reconstruction, Rigid};

pub use apply::GrownScene;

use crate::common::{PoseError, shift_by};
use crate::evidence::{PhotoRays, median};
use crate::guided::guided_matches;
use crate::single::{inliers, union};
use crate::{CamsetParams, PhotoEvidence, PhotoLocalization, QueryPhoto, Scene, SceneMatch, Verdict};

/// Which points of photos the scene grows by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GrowthParams {
    /// Fewest photos that see a new point.
    pub min_photos: usize,
    /// Smallest angle under which the outermost two of them see it, in degrees.
    pub min_parallax_deg: f64,
    /// Largest standard deviation along its worst axis, as a share of its distance from the nearest of them.
    pub max_point_sigma: f64,
}

impl Default for GrowthParams {
    fn default() -> Self {
        Self { min_photos: 2, min_parallax_deg: 2.0, max_point_sigma: 0.02 }
    }
}

/// A photo that becomes an image of the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GrowthPhoto {
    /// Index of the photo.
    pub photo: usize,
    /// Its camera.
    pub camera: Camera,
    /// Its pose in the scene.
    pub world_from_camera: Rigid,
    /// Covariance of the pose: rotation (rad, in the camera frame), then centre (scene units, in the scene frame).
    pub covariance: Matrix6<f64>,
    /// Median distance of the scene points that it sees, new ones with them, in scene units.
    pub depth: f64,
    /// The points that the scene has already, one a feature, by feature.
    pub seen: Vec<SceneMatch>,
}

/// A point that the scene had not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GrowthPoint {
    /// Position in the scene's frame.
    pub position: Vector3<f64>,
    /// sRGB.
    pub color: [u8; 3],
    /// Root mean square of the angular residuals in their standard deviations.
    pub error_sigma: f64,
    /// Covariance of the position, that of the photos' poses with it; in squared scene units.
    pub covariance: Matrix3<f64>,
    /// Index in [`Growth::photos`] and feature of all who see it, sorted.
    pub track: Vec<(usize, u32)>,
}

/// What a scene grows by; see [`Growth::apply`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Growth {
    /// Images.
    pub photos: Vec<GrowthPhoto>,
    /// Points.
    pub points: Vec<GrowthPoint>,
}

/// What localized photos add to a component of a scene: an answer for each photo; those without, not *localized*, or in
/// another component are left out.
///
/// `alone` is what [`locate_single`](crate::locate_single) says of each photo, and `local_models` are as
/// [`locate_set`](crate::locate_set) takes them.
pub fn grow(
    params: &GrowthParams,
    camset: &CamsetParams,
    scene: &Scene<'_>,
    (photos, alone): (&[QueryPhoto<'_>], &[PhotoEvidence<'_>]),
    answers: &[Option<&PhotoLocalization>],
    local_models: &[Reconstruction],
) -> Growth {
    let placed: Vec<Placed<'_>> = (0..photos.len().min(alone.len()))
        .zip(answers)
        .filter_map(|(photo, answer)| Some((photo, (*answer)?)))
        .filter(|(_, answer)| answer.component == scene.component)
        .filter_map(|(photo, answer)| Placed::new(photo, &photos[photo], answer))
        .collect();
    let grower = Grower { params, max_error_sigmas: camset.max_error_sigmas, scene, alone, placed: &placed };
    let guided = |photo: &Placed<'_>| {
        let nearest = alone[photo.photo].nearest;
        let found = guided_matches(&camset.guided, scene.index, &photo.rays, nearest, &photo.pose);
        // What it sees alone has been tested by more than its resemblance.
        let found = union(alone[photo.photo].inliers, &found);
        inliers(&photo.rays, scene.index, &photo.pose, &found, camset.max_error_sigmas)
    };
    let mut seen: Vec<Vec<SceneMatch>> = placed.par_iter().with_max_len(1).map(guided).collect();
    let points = grower.points(local_models, &mut seen);
    let photos = placed.iter().zip(seen).enumerate().map(|(slot, (photo, seen))| {
        let known = seen.iter().map(|found| scene.index.position(found.point));
        let new = points.iter().filter(|point| point.track.iter().any(|&(at, _)| at == slot));
        let distances = known.chain(new.map(|point| point.position));
        let depth = median(distances.map(|point| (point - photo.pose.translation).norm()).collect());
        GrowthPhoto {
            photo: photo.photo,
            camera: photo.rays.camera.clone(),
            world_from_camera: photo.pose,
            covariance: photo.covariance,
            depth: depth.unwrap_or(0.0),
            seen,
        }
    });
    Growth { photos: photos.collect(), points }
}

/// A localized photo.
struct Placed<'a> {
    photo: usize,
    rays: PhotoRays<'a>,
    pose: Rigid,
    covariance: Matrix6<f64>,
    error: PoseError,
}

impl<'a> Placed<'a> {
    fn new(photo: usize, query: &QueryPhoto<'a>, answer: &'a PhotoLocalization) -> Option<Self> {
        let (pose, covariance) = (answer.world_from_camera?, answer.covariance?);
        let error = PoseError::new(&pose, &covariance)?;
        let rays = PhotoRays::new(query.features, &answer.camera);
        (answer.verdict == Verdict::Localized).then_some(Self { photo, rays, pose, covariance, error })
    }

    /// The ray of a feature, as exact as the feature is.
    fn ray(&self, feature: u32) -> Option<WorldRay> {
        let (bearing, sigma) = self.bearing(feature)?;
        Some(WorldRay::new(&self.pose, &bearing, sigma))
    }

    /// Bearing and its standard deviation, where the camera has one.
    fn bearing(&self, feature: u32) -> Option<(Vector3<f64>, f64)> {
        let sigma = *self.rays.rays.sigmas.get(feature as usize)?;
        sigma.is_finite().then(|| (self.rays.rays.bearings[feature as usize], sigma))
    }
}

struct Grower<'a> {
    params: &'a GrowthParams,
    max_error_sigmas: f64,
    scene: &'a Scene<'a>,
    alone: &'a [PhotoEvidence<'a>],
    placed: &'a [Placed<'a>],
}

impl Grower<'_> {
    /// New points of the local models; tracks that turn out to be points of the scene are added to `seen`.
    fn points(&self, local_models: &[Reconstruction], seen: &mut [Vec<SceneMatch>]) -> Vec<GrowthPoint> {
        let mut points = Vec::new();
        for track in local_models.iter().flat_map(|model| self.tracks(model)) {
            match known(&track, seen) {
                Some(point) => self.observe(point, &track, seen),
                None => points.extend(self.triangulated(&track).and_then(|point| {
                    let Some(known) = self.twin(&point) else { return Some(point) };
                    self.observe(known, &point.track, seen);
                    None
                })),
            }
        }
        points
    }

    /// Tracks of a local model among the localized photos.
    fn tracks(&self, model: &Reconstruction) -> Vec<Vec<(usize, u32)>> {
        let slot_of = |image: ImageId| self.placed.binary_search_by_key(&image.index(), |p| p.photo).ok();
        let track = |point: &setloc_sfm::ReconstructionPoint| {
            let seen = point.track.iter().filter_map(|seen| {
                let slot = slot_of(seen.image)?;
                self.placed[slot].bearing(seen.feature).map(|_| (slot, seen.feature))
            });
            seen.collect::<Vec<_>>()
        };
        model.points.iter().map(track).filter(|track| !track.is_empty()).collect()
    }

    /// Notes what of a track shows a scene point, where the photo does not show that by another feature.
    fn observe(&self, point: PointId, track: &[(usize, u32)], seen: &mut [Vec<SceneMatch>]) {
        for &(slot, feature) in track {
            let (photo, found) = (&self.placed[slot], SceneMatch { feature, point });
            let error = photo.rays.error_sigmas(self.scene.index, &photo.pose, found);
            let is_new = seen[slot].iter().all(|other| other.feature != feature && other.point != point);
            if is_new && error < self.max_error_sigmas {
                let at = seen[slot].partition_point(|other| *other < found);
                seen[slot].insert(at, found);
            }
        }
    }

    /// The point of a track, when it is determined well enough.
    fn triangulated(&self, track: &[(usize, u32)]) -> Option<GrowthPoint> {
        let mut track = track.to_vec();
        let (position, rays) = loop {
            let photos: BTreeSet<usize> = track.iter().map(|&(slot, _)| slot).collect();
            if photos.len() < self.params.min_photos.max(2) {
                return None;
            }
            let ray = |&(slot, feature): &(usize, u32)| self.placed[slot].ray(feature);
            let mut rays = track.iter().map(ray).collect::<Option<Vec<WorldRay>>>()?;
            let first = triangulate(&rays)?;
            // The photos' own poses are not exact either.
            for (ray, &(slot, _)) in rays.iter_mut().zip(&track) {
                ray.sigma = ray.sigma.hypot(self.placed[slot].error.angular_sigma(&first));
            }
            let position = triangulate(&rays)?;
            let error = |ray: &WorldRay| ray.angular_error(&position) / ray.sigma;
            let worst = (0..rays.len()).max_by(|&a, &b| error(&rays[a]).total_cmp(&error(&rays[b])))?;
            if error(&rays[worst]) < self.max_error_sigmas {
                break (position, rays);
            }
            track.remove(worst);
        };
        if max_triangulation_angle(&rays, &position) < self.params.min_parallax_deg.to_radians() {
            return None;
        }
        let own = covariance_of(&rays, &position)?;
        let shift = shift_by(&position, track.iter().map(|&(slot, _)| self.placed[slot].error))?;
        let nearest = rays.iter().map(|ray| (position - ray.origin).norm()).fold(f64::INFINITY, f64::min);
        let sigma = own.symmetric_eigenvalues().max().sqrt();
        let squared = rays.iter().map(|ray| (ray.angular_error(&position) / ray.sigma).powi(2)).sum::<f64>();
        let &(slot, feature) = track.first()?;
        track.sort_unstable();
        (sigma < self.params.max_point_sigma * nearest).then(|| GrowthPoint {
            position,
            color: self.placed[slot].rays.features.colors.get(feature as usize).copied().unwrap_or_default(),
            error_sigma: (squared / rays.len() as f64).sqrt(),
            covariance: own + shift * shift.transpose(),
            track,
        })
    }

    /// A scene point that is this point: it looks like one of its features more than all others, and is where it is.
    fn twin(&self, point: &GrowthPoint) -> Option<PointId> {
        let alike = |&(slot, feature): &(usize, u32)| {
            let nearest = self.alone[self.placed[slot].photo].nearest.get(feature as usize)?;
            let found = nearest.first?.point;
            let offset = self.scene.index.position(found) - point.position;
            let covariance = self.scene.index.position_covariance(found) + point.covariance;
            let squared = offset.dot(&(covariance.try_inverse()? * offset));
            (squared < self.max_error_sigmas.powi(2)).then_some(found)
        };
        point.track.iter().filter_map(alike).min()
    }
}

/// The scene point that most features of a track show, of equals the first.
fn known(track: &[(usize, u32)], seen: &[Vec<SceneMatch>]) -> Option<PointId> {
    let mut votes: BTreeMap<PointId, usize> = BTreeMap::new();
    for &(slot, feature) in track {
        if let Ok(at) = seen[slot].binary_search_by_key(&feature, |found| found.feature) {
            *votes.entry(seen[slot][at].point).or_default() += 1;
        }
    }
    votes.into_iter().max_by_key(|&(point, votes)| (votes, std::cmp::Reverse(point))).map(|(point, _)| point)
}

/// Covariance of a point by the rays that meet there.
fn covariance_of(rays: &[WorldRay], point: &Vector3<f64>) -> Option<Matrix3<f64>> {
    let mut information = Matrix3::zeros();
    for ray in rays {
        let offset = point - ray.origin;
        let across = Matrix3::identity() * offset.norm_squared() - offset * offset.transpose();
        information += across / (offset.norm_squared() * ray.sigma).powi(2);
    }
    information.try_inverse()
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use setloc_features::MatchParams;
    use setloc_index::IndexParams;
    use setloc_sfm::TwoViewParams;

    use super::*;
    use crate::jackknife::deviation;
    use crate::synthetic::World;
    use crate::{
        SetLocalization, SingleLocalization, SingleParams, ViewParams, Views, locate_set, locate_single,
        match_views,
    };

    /// The photos of a world as a set, and each alone.
    fn located(world: &World) -> (SetLocalization, Vec<SingleLocalization>) {
        let alone = |photo| locate_single(&SingleParams::default(), &world.scene(), photo, 7);
        let alone: Vec<SingleLocalization> = world.queries().iter().map(alone).collect();
        let borrowed: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
        let (params, models) = (CamsetParams::default(), std::slice::from_ref(&world.local));
        let views = || Ok::<_, Infallible>(Views::default());
        let Ok(set) =
            locate_set(&params, &world.scene(), &world.queries(), &borrowed, models.into(), views, 7);
        (set, alone)
    }

    /// What the first photos of a world add to its scene.
    fn growth_of(world: &World, photos: usize) -> Growth {
        let (set, alone) = located(world);
        let alone: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
        let answers: Vec<Option<&PhotoLocalization>> =
            set.refined.iter().enumerate().map(|(at, photo)| (at < photos).then_some(photo)).collect();
        let (queries, models) = (world.queries(), std::slice::from_ref(&world.local));
        let params = (GrowthParams::default(), CamsetParams::default());
        grow(&params.0, &params.1, &world.scene(), (&queries, &alone), &answers, models)
    }

    fn grown(world: &World, growth: &Growth) -> GrownScene {
        let features: Vec<_> = growth.photos.iter().map(|p| &world.photos[p.photo].features).collect();
        let names: Vec<&str> = growth.photos.iter().map(|photo| world.names[photo.photo].as_str()).collect();
        growth.apply(&world.scene(), &features, &names, &IndexParams::default())
    }

    fn scene_of(grown: &GrownScene) -> Scene<'_> {
        let (reconstruction, index) = (&grown.reconstruction, &grown.index);
        Scene {
            component: 0,
            is_placed: false,
            reconstruction,
            index,
            grown: &grown.grown,
            doubtful: &[],
            errors: None,
        }
    }

    #[test]
    fn photos_add_observations_and_points_that_are_what_they_show() {
        let world = World::chain(6, 0.2, 1);
        let growth = growth_of(&world, 6);
        assert_eq!(growth.photos.len(), 6);
        for photo in &growth.photos {
            let matches = world.scene_matches(photo.photo);
            let right = photo.seen.iter().filter(|found| matches.binary_search(found).is_ok()).count();
            assert!(100 * right >= 98 * photo.seen.len(), "{right} of {}", photo.seen.len());
        }
        assert!(growth.photos[0].seen.len() > 100 && growth.points.len() > 300, "{}", growth.points.len());
        let mut squared = 0.0;
        for point in &growth.points {
            let shown: BTreeSet<usize> = (point.track.iter())
                .filter_map(|&(slot, feature)| world.photos[slot].shows[feature as usize])
                .collect();
            assert_eq!(shown.len(), 1, "{point:?}");
            let truth = shown.iter().map(|&shown| world.position(shown)).next().unwrap();
            let offset = point.position - truth;
            squared += offset.dot(&(point.covariance.try_inverse().unwrap() * offset)) / 3.0;
        }
        let mean = squared / growth.points.len() as f64;
        assert!((0.05..1.5).contains(&mean), "{mean}");
    }

    #[test]
    fn points_of_the_scene_get_no_twin() {
        let world = World::chain(6, 0.2, 2);
        let growth = growth_of(&world, 6);
        let twins = growth.points.iter().filter(|point| {
            let (slot, feature) = point.track[0];
            world.photos[slot].shows[feature as usize].is_some_and(|shown| world.knows(shown))
        });
        let twins = twins.count();
        assert!(50 * twins <= growth.points.len(), "{twins} of {}", growth.points.len());
    }

    #[test]
    fn a_grown_scene_keeps_what_it_had() {
        let world = World::chain(6, 0.2, 3);
        let growth = growth_of(&world, 6);
        let (before, after) = (world.scene(), grown(&world, &growth));
        let points = before.reconstruction.points.len();
        for (at, point) in before.reconstruction.points.iter().enumerate() {
            let id = PointId(at as u32);
            let now = &after.reconstruction.points[at];
            assert_eq!(now.position, point.position);
            assert_eq!(after.index.position_covariance(id), before.index.position_covariance(id));
            assert!(now.track.starts_with(&point.track) && now.track.is_sorted());
        }
        assert_eq!(after.reconstruction.points.len(), points + growth.points.len());
        assert_eq!(after.index.point_count(), after.reconstruction.points.len());
        assert_eq!(after.index.descriptor_count(), after.reconstruction.observation_count());
        assert_eq!(grown(&world, &growth), after);
    }

    #[test]
    fn a_photo_round_the_corner_is_localized_by_what_was_added_and_no_better_than_that_is_known() {
        let (mut sums, mut localized) = ([0.0; 2], 0);
        let seeds = 50..74;
        let count = f64::from(seeds.end - seeds.start);
        for seed in seeds {
            let world = World::chain(7, 0.2, seed as u64);
            let after = grown(&world, &growth_of(&world, 6));
            let photo = &world.queries()[6];
            let locate =
                |scene: &Scene<'_>| locate_single(&SingleParams::default(), scene, photo, 7).answer.photo;
            assert_ne!(locate(&world.scene()).verdict, Verdict::Localized, "{seed}");
            let answer = locate(&scene_of(&after));
            localized += usize::from(answer.verdict == Verdict::Localized);
            let truth = &world.photos[6].pose;
            let normalized = |answer: &PhotoLocalization| {
                let error = deviation(&answer.world_from_camera.unwrap(), truth);
                error.dot(&(answer.covariance.unwrap().try_inverse().unwrap() * error)) / 6.0
            };
            sums[0] += normalized(&answer);
            // Taken as independent, the points' errors would average out.
            sums[1] += normalized(&locate(&Scene { grown: &[], ..scene_of(&after) }));
        }
        let [considered, independent] = sums.map(|sum| sum / count);
        assert!(localized >= 22, "{localized}");
        // The photos that it hangs on have 1.2.
        assert!((0.1..1.5).contains(&considered), "{considered}, {independent}");
        assert!(independent > 1.5 * considered, "{considered}, {independent}");
    }

    #[test]
    fn a_grown_image_is_matched_as_a_panorama_is() {
        let world = World::chain(8, 0.2, 5);
        let after = grown(&world, &growth_of(&world, 6));
        let scene = scene_of(&after);
        let image = scene.grown[5].image;
        let mut features = vec![None; scene.reconstruction.images.len()];
        features[image.index()] = Some(world.photos[5].features.clone());
        let photos = &world.queries()[7..];
        let params = (&MatchParams::default(), &TwoViewParams::default());
        let views = match_views(&ViewParams::default(), params, &scene, features, &[image], photos, 5);
        assert!(views.matches.len() > 50, "{}", views.matches.len());
        let [geometry] = &views.geometries[..] else { panic!("{:?}", views.geometries) };
        let truth = world.photos[5].pose.inverse() * world.photos[7].pose;
        assert!(geometry.image_from_photo.rotation.angle_to(&truth.rotation) < 0.01);
        assert!(geometry.image_from_photo.translation.angle(&truth.translation) < 0.05);
    }

    #[test]
    fn nothing_localized_adds_nothing() {
        let world = World::chain(3, 0.2, 6);
        assert_eq!(growth_of(&world, 0), Growth::default());
    }
}
