//! What a scene may be off ([`setloc_sfm::ModelErrors`]), in the poses of photos.
//!
//! Scene points of one region are off together, by the poses of the images that see them and by what their bearings share there, and
//! so is a photo that sees little else. As in [`crate::common`] these errors are *considered* rather than estimated: for each draw of
//! them the photos are adjusted again, and what their poses move by in the mean of the draws is added to their covariances.
//!
//! What neighbouring bearings of stitched panoramas share, those of photos that were cut from such do, too: where the scene's panoramas
//! are, the bearings of each standpoint of the set have errors of their own of that size.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix6, Vector3};
use rayon::prelude::*;
use setloc_features::Camera;
use setloc_sfm::bundle::{self, BundleParams, BundleProblem};
use setloc_sfm::{BearingField, ImageId, ModelErrors, PointId};

use crate::Scene;
use crate::common::Meeting;
use crate::jackknife::deviation;

/// What of a bundle problem hangs on images of the scene.
#[derive(Debug, Clone, Default)]
pub(crate) struct HeldByScene {
    /// Cameras that hold each scene point, which shift with it.
    pub points: BTreeMap<PointId, Vec<u32>>,
    /// Poses that are images of the scene.
    pub views: BTreeMap<u32, ImageId>,
}

impl HeldByScene {
    /// What its errors add to the covariances of the first poses of an adjusted problem; `None` when there are none.
    pub(crate) fn spread(
        &self,
        scene: &Scene<'_>,
        params: &BundleParams,
        problem: &BundleProblem,
        poses: usize,
    ) -> Option<Vec<Matrix6<f64>>> {
        let errors = scene.errors.filter(|errors| errors.draws() > 0)?;
        if self.points.is_empty() && self.views.is_empty() {
            return None;
        }
        let images = self.images(scene);
        // Photos in a place of stitched panoramas are mostly cut from such, too.
        let is_stitched = scene.reconstruction.cameras.iter().any(Camera::is_stretched);
        let draws: Vec<u32> = (0..errors.draws()).collect();
        // It may lie at the optimum of another loss, and what leads to that of this one is in no draw.
        let mut unmoved = problem.clone();
        bundle::solve(params, &mut unmoved);
        let deviations = |&draw: &u32| {
            let mut moved = problem.clone();
            self.apply(&Draw::new(scene, errors, draw, &images), &mut moved);
            if is_stitched {
                let fields: Vec<_> =
                    (0..poses as u32).map(|pose| errors.field_of_another(pose, draw)).collect();
                displace(&mut moved, |pose| fields.get(pose as usize));
            }
            bundle::solve(params, &mut moved);
            let pairs = unmoved.poses.iter().zip(&moved.poses).take(poses);
            pairs.map(|(a, b)| deviation(&a.world_from_camera, &b.world_from_camera)).collect::<Vec<_>>()
        };
        let moved: Vec<_> = draws.par_iter().with_max_len(1).map(deviations).collect();
        let of_pose = |pose: usize| {
            let squared = moved.iter().map(|draw| draw[pose] * draw[pose].transpose());
            squared.sum::<Matrix6<f64>>() / errors.degrees_of_freedom()
        };
        Some((0..poses).map(of_pose).collect())
    }

    /// The images that see any of it.
    fn images(&self, scene: &Scene<'_>) -> BTreeSet<ImageId> {
        let points = self.points.keys().filter_map(|point| scene.reconstruction.points.get(point.index()));
        let see = points.flat_map(|point| point.track.iter().map(|seen| seen.image));
        see.chain(self.views.values().copied()).collect()
    }

    fn apply(&self, draw: &Draw<'_>, problem: &mut BundleProblem) {
        for (&point, poses) in &self.points {
            let shift = draw.shift_of(point).unwrap_or_default();
            for &pose in poses {
                problem.poses[pose as usize].world_from_camera.translation += shift;
            }
        }
        for (&pose, &image) in &self.views {
            let pose = &mut problem.poses[pose as usize].world_from_camera;
            *pose = draw.errors.pose(image, draw.number).unwrap_or(*pose);
        }
        displace(problem, |pose| self.views.get(&pose).and_then(|image| draw.fields.get(image)));
    }
}

/// Moves what poses see by the errors of their bearings.
fn displace<'f>(problem: &mut BundleProblem, field_of: impl Fn(u32) -> Option<&'f BearingField>) {
    for seen in &mut problem.observations {
        let camera = &problem.cameras[problem.poses[seen.pose as usize].camera as usize];
        let there = field_of(seen.pose).and_then(|field| field.moved(camera, &seen.pixel));
        seen.pixel = there.unwrap_or(seen.pixel);
    }
}

/// One draw of the errors.
struct Draw<'a> {
    scene: &'a Scene<'a>,
    errors: &'a ModelErrors,
    number: u32,
    fields: BTreeMap<ImageId, BearingField>,
}

impl<'a> Draw<'a> {
    fn new(scene: &'a Scene<'a>, errors: &'a ModelErrors, number: u32, images: &BTreeSet<ImageId>) -> Self {
        let field = |&image: &ImageId| (image, errors.field(scene.reconstruction, image, number));
        let fields = images.iter().map(field).collect();
        Self { scene, errors, number, fields }
    }

    /// How far a scene point shifts: to where the moved rays to it meet.
    fn shift_of(&self, point: PointId) -> Option<Vector3<f64>> {
        let scene = self.scene.reconstruction;
        let found = scene.points.get(point.index())?;
        let mut meeting = Meeting::new();
        for seen in &found.track {
            let Some(pose) = scene.images.get(seen.image.index())?.world_from_camera else { continue };
            let Some(field) = self.fields.get(&seen.image) else { continue };
            let offset = found.position - pose.translation;
            let Some(direction) = offset.try_normalize(f64::EPSILON) else { continue };
            let bearing = pose.rotation.inverse() * direction;
            let moved = self.errors.pose(seen.image, self.number).unwrap_or(pose);
            let there = moved.translation + moved.rotation * (bearing + field.at(&bearing)) * offset.norm();
            meeting.add(&found.position, &pose.translation, &(there - found.position));
        }
        meeting.shift()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::World;
    use setloc_sfm::Rigid;
    use setloc_sfm::solvers::triangulation::{WorldRay, triangulate};

    /// Panoramas that a draw moves by a common turn and shift.
    fn moved_together(world: &World, draws: usize) -> (Rigid, Vec<Vec<Option<Rigid>>>) {
        let turn = nalgebra::UnitQuaternion::from_euler_angles(0.001, 0.002, -0.001);
        let motion = Rigid::new(turn, Vector3::new(0.02, -0.01, 0.03));
        let images = &world.scene().reconstruction.images;
        let moved = |pose: &Rigid| {
            Rigid::new(motion.rotation * pose.rotation, motion.transform_point(&pose.translation))
        };
        let poses = images.iter().map(|image| image.world_from_camera.as_ref().map(moved)).collect();
        (motion, vec![poses; draws])
    }

    #[test]
    fn points_go_where_their_panoramas_go() {
        let world = World::chain(1, 0.0, 71);
        let (motion, poses) = moved_together(&world, 1);
        let errors = ModelErrors::new(0.0, poses);
        let scene = world.scene();
        let images = scene.reconstruction.registered().collect();
        let draw = Draw::new(&scene, &errors, 0, &images);
        for (at, point) in scene.reconstruction.points.iter().enumerate().take(200) {
            let expected = motion.transform_point(&point.position) - point.position;
            let shift = draw.shift_of(PointId(at as u32)).unwrap();
            assert!((shift - expected).norm() < 0.05 * expected.norm(), "{at}: {shift} {expected}");
        }
    }

    #[test]
    fn points_go_where_rays_with_errors_meet() {
        let world = World::chain(1, 0.0, 72);
        let errors = ModelErrors::new(1e-3, vec![Vec::new()]);
        let scene = world.scene();
        let images = scene.reconstruction.registered().collect();
        let draw = Draw::new(&scene, &errors, 0, &images);
        let mut moved = 0;
        for (at, point) in scene.reconstruction.points.iter().enumerate().take(200) {
            let rays: Vec<WorldRay> = point
                .track
                .iter()
                .map(|seen| {
                    let pose = scene.reconstruction.images[seen.image.index()].world_from_camera.unwrap();
                    let bearing = pose.inverse().transform_point(&point.position).normalize();
                    let off = errors.field(scene.reconstruction, seen.image, 0).at(&bearing);
                    WorldRay::new(&pose, &(bearing + off).normalize(), 1e-3)
                })
                .collect();
            let Some(met) = triangulate(&rays) else { continue };
            let (expected, shift) = (met - point.position, draw.shift_of(PointId(at as u32)).unwrap());
            moved += usize::from((shift - expected).norm() < 0.1 * expected.norm());
        }
        assert!(moved > 180, "{moved}");
    }

    #[test]
    fn photos_among_stitched_panoramas_have_errors_of_their_own() {
        let mut world = World::chain(2, 0.2, 74);
        let poses: Vec<_> =
            world.scene().reconstruction.images.iter().map(|image| image.world_from_camera).collect();
        let errors = ModelErrors::new(5e-4, vec![poses; 16]);
        let added = |world: &World| {
            let alone = |errors: Option<&ModelErrors>| {
                let scene = Scene { errors, ..world.scene() };
                let photo = world.queries()[0];
                let found = crate::locate_single(&crate::SingleParams::default(), &scene, &photo, 1);
                found.answer.photo.covariance.expect("is localized").fixed_view::<3, 3>(0, 0).trace()
            };
            alone(Some(&errors)) - alone(None)
        };
        let plain = added(&world);
        for camera in &mut world.scene_model.cameras {
            *camera = camera.as_stitched().expect("a panorama");
        }
        let stitched = added(&world);
        assert!(plain > 0.0 && stitched > 1.5 * plain, "{plain} {stitched}");
    }

    #[test]
    fn what_all_panoramas_share_is_in_the_covariance_of_a_photo_beside_them() {
        let world = World::chain(2, 0.2, 73);
        let alone = |errors: Option<&ModelErrors>| {
            let scene = Scene { errors, ..world.scene() };
            let photo = world.queries()[0];
            let found = crate::locate_single(&crate::SingleParams::default(), &scene, &photo, 1);
            found.answer.photo.covariance.expect("is localized")
        };
        let (motion, poses) = moved_together(&world, 16);
        let errors = ModelErrors::new(0.0, poses);
        let added = alone(Some(&errors)) - alone(None);
        // A common motion moves the photo as a point of the scene; sixteen equal draws are one standard deviation of a
        // covariance that is known to twelve degrees of freedom.
        let center = world.photos[0].pose.translation;
        let shift = motion.transform_point(&center) - center;
        let expected = shift * shift.transpose() * (16.0 / 12.0);
        let center = added.fixed_view::<3, 3>(3, 3).into_owned();
        assert!((center - expected).norm() < 0.1 * expected.norm(), "{center} {expected}");
        assert_eq!(alone(Some(&ModelErrors::new(1.0, Vec::new()))), alone(None));
    }
}
