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

use nalgebra::{Matrix3, Matrix3x6, Matrix6, SMatrix, Vector3};
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
    shift_by(&found.position, errors)
}

/// Least information of a point along an axis, as a share of that along its best.
const LEAST_INFORMATION: f64 = 1e-4;

/// How far a point shifts by errors of what sees it: to where the moved rays meet. All rays count as equally exact.
#[derive(Debug, Clone)]
pub(crate) struct Meeting<const N: usize> {
    information: Matrix3<f64>,
    pull: SMatrix<f64, 3, N>,
}

impl<const N: usize> Meeting<N> {
    pub(crate) fn new() -> Self {
        Self { information: Matrix3::zeros(), pull: SMatrix::zeros() }
    }

    /// Adds a ray from `origin`, which errors carry by `carried` (one column each) where it passes the point.
    pub(crate) fn add(&mut self, point: &Vector3<f64>, origin: &Vector3<f64>, carried: &SMatrix<f64, 3, N>) {
        let offset = point - origin;
        let Some(direction) = offset.try_normalize(f64::EPSILON) else { return };
        let across = (Matrix3::identity() - direction * direction.transpose()) / offset.norm_squared();
        self.information += across;
        self.pull += across * carried;
    }

    /// The shift; `None` without rays.
    pub(crate) fn shift(self) -> Option<SMatrix<f64, 3, N>> {
        let eigen = self.information.symmetric_eigen();
        let least = LEAST_INFORMATION * eigen.eigenvalues.max();
        let inverse = eigen.eigenvalues.map(|along| 1.0 / along.max(least));
        let axes = eigen.eigenvectors;
        (least > 0.0).then(|| axes * Matrix3::from_diagonal(&inverse) * axes.transpose() * self.pull)
    }
}

/// Shift of a point by the errors of the photos that see it, which go together.
pub(crate) fn shift_by(
    point: &Vector3<f64>,
    errors: impl Iterator<Item = PoseError>,
) -> Option<Matrix3x6<f64>> {
    let mut meeting = Meeting::new();
    for error in errors {
        meeting.add(point, &error.center, &error.carries(point));
    }
    meeting.shift()
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
