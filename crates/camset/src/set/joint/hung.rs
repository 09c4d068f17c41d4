//! Baselines whose length planes tell, and the photos that hang on them.

use nalgebra::Matrix6;
use setloc_sfm::{BaselineLength, ImageId, Rigid};

use super::ties::Ties;
use super::{Component, Joint, standpoint};

/// A pair of photos whose length planes tell.
pub(super) struct Hung {
    /// The reference, the nearer photo and the farther one.
    slots: [usize; 3],
    length: BaselineLength,
    /// The photos that hang on the pair.
    beyond: Vec<bool>,
}

impl Hung {
    /// Moves the photos beyond the pair as one, so that the farther one stands where the pair has it.
    pub(super) fn follow(&self, poses: &mut [Rigid]) {
        let [reference, from, to] = self.slots;
        if !self.beyond[to] {
            return;
        }
        let baseline = (poses[from].translation - poses[reference].translation).norm();
        let Rigid { rotation, translation } = self.length.pose;
        let moved = poses[from] * Rigid::new(rotation, translation * baseline) * poses[to].inverse();
        for (pose, _) in poses.iter_mut().zip(&self.beyond).filter(|(_, beyond)| **beyond) {
            *pose = moved * *pose;
        }
    }

    /// States the covariances of those photos: what the pair leaves open beside what the nearer photo does.
    fn state(&self, poses: &[Rigid], covariances: &mut [Option<Matrix6<f64>>]) {
        let [reference, from, to] = self.slots;
        if !self.beyond[to] {
            return;
        }
        let (near, far) = (&poses[from], &poses[to]);
        let baseline = near.translation - poses[reference].translation;
        let of_far = match (covariances[reference], covariances[from]) {
            (Some(of_reference), Some(of_near)) => {
                let step = far.translation - near.translation;
                let carried = carried(near, far);
                let mut own = Matrix6::identity();
                let world_from_near = near.rotation.to_rotation_matrix().into_inner();
                own.fixed_view_mut::<3, 3>(3, 3).copy_from(&(world_from_near * baseline.norm()));
                let along = baseline.normalize();
                let center = |covariance: &Matrix6<f64>| covariance.fixed_view::<3, 3>(3, 3).into_owned();
                let of_baseline = along.dot(&((center(&of_reference) + center(&of_near)) * along));
                let mut sum =
                    carried * of_near * carried.transpose() + own * self.length.covariance * own.transpose();
                let mut of_center = sum.fixed_view_mut::<3, 3>(3, 3);
                of_center += step * step.transpose() * (of_baseline / baseline.norm_squared());
                Some(sum)
            }
            _ => None,
        };
        for (slot, covariance) in covariances.iter_mut().enumerate().filter(|(slot, _)| self.beyond[*slot]) {
            let Some(of_far) = of_far else {
                *covariance = None;
                continue;
            };
            let carried = carried(far, &poses[slot]);
            let by_pair = carried * of_far * carried.transpose();
            // What lies between photos beyond the pair is in the adjustment's.
            let is_elsewhere = (poses[slot].translation - far.translation).norm() > 0.0;
            *covariance = match (is_elsewhere, *covariance) {
                (true, Some(own)) => Some(own + by_pair),
                (true, None) => None,
                (false, _) => Some(by_pair),
            };
        }
    }
}

/// How a small error of one pose moves another that is rigidly tied to it: 6×6, both rotations about the camera's axes,
/// then the centres in the world.
fn carried(from: &Rigid, to: &Rigid) -> Matrix6<f64> {
    let [world_from_from, world_from_to] =
        [from, to].map(|pose| pose.rotation.to_rotation_matrix().into_inner());
    let lever = to.translation - from.translation;
    let mut carried = Matrix6::identity();
    carried.fixed_view_mut::<3, 3>(0, 0).copy_from(&(world_from_to.transpose() * world_from_from));
    carried.fixed_view_mut::<3, 3>(3, 0).copy_from(&-(lever.cross_matrix() * world_from_from));
    carried
}

impl Component<'_> {
    /// Lengths of baselines that the local points do not tell, and the slots that they lie between.
    pub(super) fn lengths(&self) -> impl Iterator<Item = ([usize; 3], BaselineLength)> + '_ {
        let slot_of = |image: ImageId| self.members.binary_search(&image.index()).ok();
        self.model.lengths.iter().filter_map(move |&length| {
            let (images, _) = length.held();
            let [reference, from, to] = images.map(slot_of);
            Some(([reference?, from?, to?], length))
        })
    }

    /// The pairs whose length planes tell, and the photos that hang on each.
    pub(super) fn hung(&self, poses: &[Rigid]) -> Vec<Hung> {
        let standpoints: Vec<usize> = (0..poses.len()).map(|slot| standpoint(poses, slot)).collect();
        let hung = |(slots, length)| Hung { slots, length, beyond: self.beyond(&standpoints, slots) };
        self.lengths().map(hung).collect()
    }

    /// Puts the photos that hang on a pair whose length planes tell where that pair has them, and states what it leaves
    /// open.
    ///
    /// The points that the pair shares lie on little more than one wall, which adjusted as free points fits many
    /// directions. Where the scene holds any of these photos, the adjustment stands.
    pub(super) fn follow_pairs(&self, joint: &mut Joint) {
        let mut poses: Vec<Rigid> = joint.model.photos.iter().map(|photo| photo.world_from_camera).collect();
        for hung in self.hung(&poses) {
            let held = |slot: &usize| joint.direct[*slot].len() >= self.params.verdict.min_inliers;
            if (0..poses.len()).filter(|&slot| hung.beyond[slot]).any(|slot| held(&slot)) {
                continue;
            }
            hung.follow(&mut poses);
            hung.state(&poses, &mut joint.covariances);
        }
        for (photo, pose) in joint.model.photos.iter_mut().zip(poses) {
            photo.world_from_camera = pose;
        }
    }

    /// The photos that no common points tie to the reference but through the pair.
    fn beyond(&self, standpoints: &[usize], slots: [usize; 3]) -> Vec<bool> {
        let tracks = (0..self.model.points.len()).map(|local| {
            self.track(local).into_iter().map(|(slot, _)| standpoints[slot]).collect::<Vec<_>>()
        });
        let ties = Ties::new(standpoints.len(), tracks);
        let [reference, from, to] = slots.map(|slot| standpoints[slot]);
        let reached = ties.reached(reference, |a, b| [a, b] == [from, to] || [a, b] == [to, from]);
        standpoints.iter().map(|&standpoint| !reached[standpoint]).collect()
    }

    /// What such a length rests on, in words.
    pub(super) fn basis(&self, [_, from, to]: [usize; 3], length: &BaselineLength) -> String {
        let [from, to] = [from, to].map(|slot| self.photos[self.members[slot]].name);
        format!(
            "the distance of {to} from {from} rests on planes that go on or the ground ({} points, ± {:.0} %), not on common points",
            length.votes,
            100.0 * length.deviation
        )
    }
}
