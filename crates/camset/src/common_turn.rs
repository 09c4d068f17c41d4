//! What the matches of photos to a scene err alike, whatever their number.
//!
//! Under another light, keypoints agree less with the scene than they state, and not all of that is noise of each by itself:
//! the photos see what shadows and highlights make of a façade. No residual shows the part that is common, since the poses take
//! it up. The truth does. On a rendered plaza under another sun (three sets; panoramas as they are and turned by up to 5, 15 and 40°)
//! the similarity that best explains a set's matches was off by √2 of its standard deviations, mostly a turn by 0.01–0.03°, with
//! keypoints as with patches of pixels that are placed twice as well; points near one another did not err alike. A fifth of what the
//! keypoints exceed their noise by accounts for it. Where they are as noisy as stated, nothing is added.
//!
//! So that is *considered* (see [`crate::common`]): all that the photos see turns about the middle of the images that see it, and
//! the photos with it.

use nalgebra::{Matrix6, Matrix6x3, Vector3};
use setloc_sfm::Rigid;

use crate::evidence::{PhotoRays, median};
use crate::refine::JointPhoto;
use crate::{Scene, SceneMatch};

/// Standard deviation of the turn about each axis, as a share of that by which most keypoints exceed their noise.
const SHARE: f64 = 0.2;
/// Median length of two coordinates of standard deviation one.
const MEDIAN: f64 = 1.177_41;

/// A turn that scene points have in common.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CommonTurn {
    /// What they turn about.
    center: Vector3<f64>,
    /// Standard deviation about each axis, in radians.
    sigma: f64,
}

impl CommonTurn {
    /// That of what photos see of a scene by keypoints; `None` where they see nothing, or no more off than stated.
    pub fn of(
        scene: &Scene<'_>,
        rays: &[PhotoRays<'_>],
        photos: &[JointPhoto],
        direct: &[Vec<SceneMatch>],
    ) -> Option<Self> {
        let (mut errors, mut squares) = (Vec::new(), 0.0);
        let (mut centers, mut views) = (Vector3::zeros(), 0_usize);
        for ((rays, photo), matches) in rays.iter().zip(photos).zip(direct) {
            for &found in matches {
                let error = rays.error_sigmas(scene.index, &photo.world_from_camera, found);
                if !error.is_finite() {
                    continue;
                }
                errors.push(error);
                squares += rays.rays.sigmas[found.feature as usize].powi(2);
                let images = scene.reconstruction.points[found.point.index()].track.iter();
                for pose in images
                    .filter_map(|seen| scene.reconstruction.images[seen.image.index()].world_from_camera)
                {
                    centers += pose.translation;
                    views += 1;
                }
            }
        }
        let noise = (squares / errors.len() as f64).sqrt();
        let excess = ((median(errors)? / MEDIAN).powi(2) - 1.0).max(0.0).sqrt();
        let turn = Self { center: centers / views as f64, sigma: SHARE * noise * excess };
        (views > 0 && turn.sigma > 0.0).then_some(turn)
    }

    /// What it adds to the covariance of a pose: rotation in the camera's frame, then centre.
    pub fn covariance(&self, world_from_camera: &Rigid) -> Matrix6<f64> {
        let from_center = world_from_camera.translation - self.center;
        let mut by_turn = Matrix6x3::zeros();
        let camera_from_world = world_from_camera.rotation.inverse().to_rotation_matrix();
        by_turn.fixed_view_mut::<3, 3>(0, 0).copy_from(camera_from_world.matrix());
        by_turn.fixed_view_mut::<3, 3>(3, 0).copy_from(&-from_center.cross_matrix());
        by_turn * by_turn.transpose() * self.sigma.powi(2)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector6};

    use super::*;
    use crate::jackknife::deviation;
    use crate::synthetic::World;

    #[test]
    fn only_what_exceeds_the_stated_noise_turns_a_scene() {
        let sigma = |seed: u64, more_noise: f32| {
            let mut world = World::chain(1, 0.0, seed);
            let matches = world.scene_matches(0);
            for (at, found) in matches.iter().enumerate() {
                let keypoint = &mut world.photos[0].features.keypoints[found.feature as usize];
                let [x, y] = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]][at % 4];
                keypoint.x += x * more_noise * keypoint.noise_px;
                keypoint.y += y * more_noise * keypoint.noise_px;
            }
            let view = &world.photos[0];
            let photo = JointPhoto { camera: 0, world_from_camera: view.pose, standpoint: 0 };
            let rays = [PhotoRays::new(&view.features, &world.camera)];
            CommonTurn::of(&world.scene(), &rays, &[photo], &[matches]).map_or(0.0, |turn| turn.sigma)
        };
        let mean = |more_noise| (30..40).map(|seed| sigma(seed, more_noise)).sum::<f64>() / 10.0;
        let (stated, noisy, noisier) = (mean(0.0), mean(1.5), mean(3.0));
        assert!(4.0 * stated < noisy && 1.5 * noisy < noisier, "{stated} {noisy} {noisier}");
    }

    #[test]
    fn the_covariance_is_that_of_poses_turned_about_the_middle() {
        let turn = CommonTurn { center: Vector3::new(1.0, -2.0, 0.5), sigma: 1e-3 };
        let pose =
            Rigid::new(UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2), Vector3::new(7.0, 3.0, -4.0));
        let turned = |axis: Vector3<f64>| {
            let by = UnitQuaternion::from_scaled_axis(axis * turn.sigma);
            Rigid::new(by * pose.rotation, turn.center + by * (pose.translation - turn.center))
        };
        let moved = [Vector3::x(), Vector3::y(), Vector3::z()]
            .map(|axis| (deviation(&pose, &turned(axis)) - deviation(&pose, &turned(-axis))) / 2.0);
        let expected: Matrix6<f64> = moved.iter().map(|moved: &Vector6<f64>| moved * moved.transpose()).sum();
        let found = turn.covariance(&pose);
        assert!((found - expected).norm() < 1e-5 * expected.norm(), "{found} {expected}");
    }
}
