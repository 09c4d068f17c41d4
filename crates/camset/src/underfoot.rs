//! Whether what supports a pose lies on the ground alone.

use nalgebra::Vector3;
use setloc_sfm::Rigid;

use crate::Scene;
use crate::evidence::median;

/// Images stand about upright where the mean of their vertical axes is as long as this; else nobody knows which way is down.
const MIN_UPRIGHT: f64 = 0.9;
/// The ground may rise and fall by this share of the camera's height above it,
const ROUGHNESS: f64 = 0.15;
/// and by this much for each unit of distance.
const SLOPE: f64 = 0.05;
/// Rays less than 3° below the horizon may see anything.
const BELOW_HORIZON: f64 = 0.05;

/// Which way is down in a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Underfoot {
    down: Vector3<f64>,
}

impl Underfoot {
    /// By the images of the scene, which stand upright as street-view panoramas do; `None` where they do not.
    pub(crate) fn of_scene(scene: &Scene<'_>) -> Option<Self> {
        let poses = scene.reconstruction.images.iter().filter_map(|image| image.world_from_camera);
        let axes: Vec<Vector3<f64>> = poses.map(|pose| pose.rotation * Vector3::y()).collect();
        let mean = axes.iter().sum::<Vector3<f64>>() / axes.len().max(1) as f64;
        (mean.norm() >= MIN_UPRIGHT).then(|| Self { down: mean.normalize() })
    }

    /// How many of some points do not lie on the ground under the cameras that see them; each with that camera's centre.
    ///
    /// The ground is at the median of their heights, if the median of their rays goes below the horizon: far walls lie about
    /// it. Paving that repeats itself supports a wrong pose as well as the right one, however many points agree: what
    /// stands on the ground has to agree, too.
    pub(crate) fn count_elsewhere(&self, seen: &[(Vector3<f64>, Vector3<f64>)]) -> usize {
        let below: Vec<f64> = seen.iter().map(|(center, point)| (point - center).dot(&self.down)).collect();
        let slopes = seen.iter().zip(&below).map(|((center, point), below)| below / (point - center).norm());
        let is_below = median(slopes.collect()).is_some_and(|slope| slope > BELOW_HORIZON);
        let Some(height) = median(below.clone()).filter(|height| is_below && *height > 0.0) else {
            return seen.len();
        };
        let is_elsewhere = |((center, point), below): &(&(Vector3<f64>, Vector3<f64>), f64)| {
            !((below - height).abs() <= ROUGHNESS * height + SLOPE * (point - center).norm())
        };
        seen.iter().zip(below).filter(is_elsewhere).count()
    }

    /// Whether a bearing of a camera may be one of the ground.
    pub(crate) fn is_below_horizon(&self, world_from_camera: &Rigid, bearing: &Vector3<f64>) -> bool {
        (world_from_camera.rotation * bearing).dot(&self.down) > BELOW_HORIZON
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOWN: Underfoot = Underfoot { down: Vector3::new(0.0, 0.0, -1.0) };

    fn seen_from(height: f64, points: &[[f64; 3]]) -> usize {
        let center = Vector3::new(0.0, 0.0, height);
        let seen: Vec<_> = points.iter().map(|&point| (center, Vector3::from(point))).collect();
        DOWN.count_elsewhere(&seen)
    }

    #[test]
    fn what_stands_on_the_ground_is_told_from_it() {
        let mut points: Vec<[f64; 3]> = (0..20)
            .map(|at| [f64::from(at) - 10.0, 4.0 + f64::from(at % 5), 0.02 * f64::from(at % 3)])
            .collect();
        assert_eq!(seen_from(1.6, &points), 0);
        points.extend([[0.0, 8.0, 1.2], [1.0, 8.0, 3.0], [2.0, 8.0, 0.9]]);
        assert_eq!(seen_from(1.6, &points), 3);
    }

    #[test]
    fn a_wall_is_no_ground() {
        let wall: Vec<[f64; 3]> = (0..24).map(|at| [f64::from(at % 6), 10.0, f64::from(at / 6)]).collect();
        assert!(seen_from(1.6, &wall) >= 12);
        // Far off, all of it lies about the horizon.
        let far: Vec<[f64; 3]> = wall.iter().map(|[x, _, z]| [*x, 40.0, *z]).collect();
        assert_eq!(seen_from(1.6, &far), 24);
        // All of it above the camera.
        let above: Vec<[f64; 3]> = wall.iter().map(|[x, y, z]| [*x, *y, z + 3.0]).collect();
        assert_eq!(seen_from(1.6, &above), 24);
        assert_eq!(seen_from(1.6, &[]), 0);
    }

    #[test]
    fn bearings_above_the_horizon_see_no_ground() {
        let upright = Rigid::new(
            nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2),
            Vector3::zeros(),
        );
        assert!(DOWN.is_below_horizon(&upright, &Vector3::new(0.0, 0.3, 1.0).normalize()));
        assert!(!DOWN.is_below_horizon(&upright, &Vector3::new(0.0, -0.3, 1.0).normalize()));
        assert!(!DOWN.is_below_horizon(&upright, &Vector3::z()));
    }
}
