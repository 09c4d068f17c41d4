//! Errors that what a photo has added to the scene has in common.
//!
//! A scene that has grown by photos has points that hang on the poses of these. What such a pose is off, all of its
//! points are off together, so that no number of them averages it out: another photo that is placed by them is off as
//! much. The noise of each point tells nothing of it. So common errors are *considered* rather than estimated: the pose
//! is solved once more for each of them, and what it moves by is added to its covariance (S. F. Schmidt, "Application
//! of state-space methods to navigation problems", 1966).
//!
//! How the errors of two photos go together is not known. Neighbours of one set err alike, and errors that go together
//! are the worst for what hangs on several photos; so all are taken to.

use nalgebra::{Matrix3x6, Matrix6, Vector3};
use rayon::prelude::*;
use setloc_sfm::bundle::{self, BundleParams, BundleProblem};
use setloc_sfm::{ImageId, PointId, Rigid};

use crate::jackknife::deviation;
use crate::{GrownImage, Scene};

/// What a pose is off for each of six independent errors of one standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PoseError {
    center: Vector3<f64>,
    /// Turn about the world's axes, in radians, one column an error.
    turn: Matrix3x6<f64>,
    /// Shift of the centre.
    shift: Matrix3x6<f64>,
}

impl PoseError {
    /// From the covariance of a pose (rotation in the camera frame, then centre); `None` where that is none.
    pub(crate) fn new(world_from_camera: &Rigid, covariance: &Matrix6<f64>) -> Option<Self> {
        let mut world_axes = Matrix6::identity();
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        world_axes.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation.matrix());
        // Cholesky's factor does not depend on the units, and those of like poses are alike.
        let errors = (world_axes * covariance * world_axes.transpose()).cholesky()?.l();
        Some(Self {
            center: world_from_camera.translation,
            turn: errors.fixed_rows::<3>(0).into_owned(),
            shift: errors.fixed_rows::<3>(3).into_owned(),
        })
    }

    /// That of a grown image; `None` for others.
    pub(crate) fn of_image(scene: &Scene<'_>, image: ImageId) -> Option<Self> {
        let at = scene.grown.binary_search_by_key(&image, |grown| grown.image).ok()?;
        let GrownImage { covariance, .. } = &scene.grown[at];
        Self::new(scene.reconstruction.images.get(image.index())?.world_from_camera.as_ref()?, covariance)
    }

    /// Shift of a point that is carried along.
    pub(crate) fn carries(&self, point: &Vector3<f64>) -> Matrix3x6<f64> {
        self.shift - (point - self.center).cross_matrix() * self.turn
    }

    /// Standard deviation, per tangent axis, of the direction in which the camera sees a point; in radians.
    pub(crate) fn angular_sigma(&self, point: &Vector3<f64>) -> f64 {
        let (offset, carried) = (point - self.center, self.carries(point));
        let distance2 = offset.norm_squared();
        let lateral =
            (carried.norm_squared() - (offset.transpose() * carried).norm_squared() / distance2) / 2.0;
        if distance2 > 0.0 { (lateral.max(0.0) / distance2).sqrt() } else { 0.0 }
    }

    fn moved(&self, pose: &Rigid, error: usize, sign: f64) -> Rigid {
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(self.turn.column(error) * sign);
        Rigid::new(turn * pose.rotation, pose.translation + self.shift.column(error) * sign)
    }
}

/// Shift of a scene point by its photos' errors, where these alone have made it; `None` for others.
pub(crate) fn shift_of_point(scene: &Scene<'_>, point: PointId) -> Option<Matrix3x6<f64>> {
    let grown = scene.grown.first()?;
    let found = scene.reconstruction.points.get(point.index())?;
    // Grown images come after all others.
    if found.track.first()?.image < grown.image {
        return None;
    }
    let errors = found.track.iter().filter_map(|seen| PoseError::of_image(scene, seen.image));
    mean_shift(&found.position, errors)
}

/// Mean shift of a point that is carried by several photos, whose errors go together.
pub(crate) fn mean_shift(
    point: &Vector3<f64>,
    errors: impl Iterator<Item = PoseError>,
) -> Option<Matrix3x6<f64>> {
    let (mut sum, mut count) = (Matrix3x6::zeros(), 0_usize);
    for error in errors {
        sum += error.carries(point);
        count += 1;
    }
    (count > 0).then(|| sum / count as f64)
}

/// Fixed poses of a bundle problem that common errors move.
#[derive(Debug, Clone, Default)]
pub(crate) struct CommonErrors {
    /// Cameras that hold scene points, which shift with their point.
    pub points: Vec<(u32, Matrix3x6<f64>)>,
    /// Images of the scene.
    pub views: Vec<(u32, PoseError)>,
}

impl CommonErrors {
    /// What they add to the covariances of the first poses of an adjusted problem; `None` when there are none.
    pub(crate) fn spread(
        &self,
        params: &BundleParams,
        problem: &BundleProblem,
        poses: usize,
    ) -> Option<Vec<Matrix6<f64>>> {
        if self.points.is_empty() && self.views.is_empty() {
            return None;
        }
        let solved = |(error, sign): (usize, f64)| {
            let mut moved = problem.clone();
            self.apply(&mut moved, error, sign);
            bundle::solve(params, &mut moved);
            moved.poses.truncate(poses);
            moved.poses
        };
        let signed: Vec<(usize, f64)> = (0..6).flat_map(|error| [(error, 1.0), (error, -1.0)]).collect();
        let solved: Vec<_> = signed.into_par_iter().with_max_len(1).map(solved).collect();
        let of_pose = |pose: usize| {
            let squared = |both: &[Vec<_>]| {
                let [ahead, back]: [&bundle::BundlePose; 2] = [&both[0][pose], &both[1][pose]];
                let moved = deviation(&back.world_from_camera, &ahead.world_from_camera) / 2.0;
                moved * moved.transpose()
            };
            solved.chunks_exact(2).map(squared).sum()
        };
        Some((0..poses).map(of_pose).collect())
    }

    fn apply(&self, problem: &mut BundleProblem, error: usize, sign: f64) {
        for (pose, shift) in &self.points {
            problem.poses[*pose as usize].world_from_camera.translation += shift.column(error) * sign;
        }
        for (pose, view) in &self.views {
            let pose = &mut problem.poses[*pose as usize].world_from_camera;
            *pose = view.moved(pose, error, sign);
        }
    }
}
