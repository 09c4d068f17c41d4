//! Whether what supports a pose lies on the ground alone.

use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;
use setloc_sfm::{PointId, Rigid};

use crate::evidence::{log10_chance_of_more, median};
use crate::{Scene, SceneMatch};

/// The ground may rise and fall by this share of the camera's height above it,
const ROUGHNESS: f64 = 0.15;
/// and by this much for each unit of distance.
const SLOPE: f64 = 0.05;
/// How far photos are slid along the ground to see what they show by chance, as shares of the depth,
const SLIDES: [f64; 3] = [0.1, 0.2, 0.4];
/// in how many directions.
const DIRECTIONS: u32 = 8;
/// Matches that a pose can bend to, and one that tells.
const POSE_MATCHES: usize = 4;
/// Largest log₁₀ of the chance of showing as many points elsewhere than on the ground from a wrong place. Right poses of sets
/// have −14 to −1300 in rendered streets, of photos alone −1 to −250, and wrong ones that rest on paving 0.
const MAX_LOG10_CHANCE: f64 = -4.0;
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
        scene.reconstruction.down().map(|down| Self { down })
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
            !is_level(*below, height, (point - center).norm())
        };
        seen.iter().zip(below).filter(is_elsewhere).count()
    }

    /// log₁₀ of the chance of as many matches elsewhere than on the ground from a wrong place as guided matching found; `None`
    /// where these are not clearly more than photos show that are slid along it.
    ///
    /// `shown` finds the matches of photos that are moved so; `depth` is how far off what they see is. The ratio test hides
    /// what repeats or looks alike, guided matching shows it, by chance as well: what slid photos show tells how much.
    pub(crate) fn log10_chance_elsewhere(
        &self,
        ground: &Ground,
        depth: f64,
        found: usize,
        shown: impl Fn(&Vector3<f64>) -> Vec<SceneMatch> + Sync,
    ) -> Option<f64> {
        let aside = self.slides(depth);
        let count = |slide: &Vector3<f64>| ground.count_off(&shown(slide));
        let by_chance = aside.par_iter().with_max_len(1).map(count).max().unwrap_or(0) + POSE_MATCHES;
        let chance = log10_chance_of_more(found, by_chance as f64);
        (chance <= MAX_LOG10_CHANCE).then_some(chance)
    }

    /// Displacements along the ground.
    fn slides(&self, depth: f64) -> Vec<Vector3<f64>> {
        let axis = if self.down.x.abs() < 0.5 { Vector3::x() } else { Vector3::y() };
        let ahead = self.down.cross(&axis).normalize();
        let along = |direction: u32| {
            let angle = std::f64::consts::TAU * f64::from(direction) / f64::from(DIRECTIONS);
            UnitQuaternion::from_scaled_axis(self.down * angle) * ahead
        };
        let directions: Vec<Vector3<f64>> = (0..DIRECTIONS).map(along).collect();
        SLIDES.iter().flat_map(|share| directions.iter().map(move |along| along * (share * depth))).collect()
    }

    /// Whether a bearing of a camera may be one of the ground.
    pub(crate) fn is_below_horizon(&self, world_from_camera: &Rigid, bearing: &Vector3<f64>) -> bool {
        (world_from_camera.rotation * bearing).dot(&self.down) > BELOW_HORIZON
    }
}

/// Whether what lies so far below a camera, at a distance, may be on the ground.
fn is_level(below: f64, height: f64, distance: f64) -> bool {
    (below - height).abs() <= ROUGHNESS * height + SLOPE * distance
}

/// Rays this far below the horizon, as the sine of the angle, see the ground as a rule: what shows its height.
const STEEP: f64 = 0.3;
/// Points of steep rays that show an image's height above the ground where they agree,
const MIN_STEEP: usize = 20;
/// and the share of all of them that do.
const MIN_AGREEING: f64 = 0.5;
/// What a match to the ground counts beside one to what stands on it.
const GROUND_WORTH: f64 = 0.25;

/// Which points of a scene lie on the ground.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Ground {
    /// By the point; beyond its end they do not.
    is_ground: Vec<bool>,
}

impl Ground {
    /// By how far below the images of the scene the points lie: each image's height is where most of what it sees steeply
    /// below itself is.
    ///
    /// No point does where images do not stand upright.
    pub(crate) fn of_scene(scene: &Scene<'_>) -> Self {
        let Some(Underfoot { down }) = Underfoot::of_scene(scene) else { return Self::default() };
        let index = scene.index;
        let ids = || (0..index.point_count() as u32).map(PointId);
        let seen_from = |point: PointId| {
            index.rows_of(point).iter().filter_map(move |&row| {
                let image = index.row(row).image;
                let offset = index.position(point) - index.center(image)?;
                Some((image, offset.dot(&down), offset.norm()))
            })
        };
        let mut steep: Vec<Vec<f64>> = vec![Vec::new(); scene.reconstruction.images.len()];
        for (image, below, distance) in ids().flat_map(seen_from) {
            if below > STEEP * distance
                && let Some(seen) = steep.get_mut(image.index())
            {
                seen.push(below);
            }
        }
        let heights: Vec<Option<f64>> = steep.into_iter().map(height_above_ground).collect();
        let is_ground = |point: PointId| {
            seen_from(point).any(|(image, below, distance)| {
                let height = heights.get(image.index()).copied().flatten();
                height.is_some_and(|height| is_level(below, height, distance))
            })
        };
        Self { is_ground: ids().map(is_ground).collect() }
    }

    /// What a match to a point counts towards a pose.
    ///
    /// Paving and tiles repeat themselves as nothing else does, so a pose aside can have more of them than the right one.
    pub(crate) fn worth(&self, point: PointId) -> f64 {
        if self.holds(point) { GROUND_WORTH } else { 1.0 }
    }

    /// How many matches are to points that do not lie on it.
    pub(crate) fn count_off(&self, matches: &[SceneMatch]) -> usize {
        matches.iter().filter(|found| !self.holds(found.point)).count()
    }

    /// Whether a point lies on the ground.
    pub(crate) fn holds(&self, point: PointId) -> bool {
        self.is_ground.get(point.index()) == Some(&true)
    }
}

/// Where most of these are that an image has steeply below itself, if that is where they mostly are.
fn height_above_ground(mut below: Vec<f64>) -> Option<f64> {
    below.sort_by(f64::total_cmp);
    let mut first = 0;
    let mut most: Option<(usize, f64)> = None;
    for last in 0..below.len() {
        while below[first] * (1.0 + ROUGHNESS) < below[last] {
            first += 1;
        }
        let count = last + 1 - first;
        if most.is_none_or(|(least, _)| count > least) {
            most = Some((count, below[usize::midpoint(first, last)]));
        }
    }
    let (count, height) = most?;
    (count >= MIN_STEEP && count as f64 >= MIN_AGREEING * below.len() as f64).then_some(height)
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
    fn the_height_above_the_ground_is_where_most_of_what_is_seen_steeply_below_lies() {
        let ground = (0..30).map(|at| 2.0 + 0.005 * f64::from(at));
        let low_walls = (0..20).map(|at| 0.5 + 0.05 * f64::from(at));
        let height = height_above_ground(ground.clone().chain(low_walls).collect()).expect("is seen");
        assert!((2.0..2.2).contains(&height), "{height}");
        // Steps, slopes or too few points show none.
        assert_eq!(height_above_ground((1..60).map(f64::from).collect()), None);
        assert_eq!(height_above_ground(ground.take(15).collect()), None);
        assert_eq!(height_above_ground(Vec::new()), None);
    }

    #[test]
    fn points_of_a_scene_are_on_the_ground_where_its_images_stand_that_far_above() {
        let world = crate::synthetic::World::chain(3, 0.2, 4);
        let scene = world.scene();
        let ground = Ground::of_scene(&scene);
        let ids = (0..scene.index.point_count() as u32).map(PointId);
        let on_ground: Vec<PointId> = ids.filter(|point| ground.holds(*point)).collect();
        assert!(!on_ground.is_empty());
        for point in &on_ground {
            assert_eq!(ground.worth(*point), GROUND_WORTH);
        }
        assert!(on_ground.len() < scene.index.point_count() / 2, "{}", on_ground.len());
        assert_eq!(Ground::default().worth(PointId(7)), 1.0);
    }

    #[test]
    fn what_guided_matching_shows_elsewhere_counts_where_slid_photos_show_clearly_less() {
        let ground = Ground { is_ground: vec![true; 100] };
        let matches = |paving: u32, facades: u32| -> Vec<SceneMatch> {
            let points = (0..paving).chain(100..100 + facades);
            points.map(|point| SceneMatch { feature: point, point: PointId(point) }).collect()
        };
        let chance = |here: u32, aside: u32| {
            let found = ground.count_off(&matches(60, here));
            assert_eq!(found, here as usize);
            DOWN.log10_chance_elsewhere(&ground, 5.0, found, |slide| {
                assert!(slide.z.abs() < 1e-12 && slide.norm() > 0.1 && slide.norm() < 2.5);
                matches(40, aside)
            })
        };
        assert!(chance(40, 4).expect("stands out") < -10.0);
        assert_eq!([chance(40, 30), chance(5, 0), chance(0, 0)], [None; 3]);
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
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2),
            Vector3::zeros(),
        );
        assert!(DOWN.is_below_horizon(&upright, &Vector3::new(0.0, 0.3, 1.0).normalize()));
        assert!(!DOWN.is_below_horizon(&upright, &Vector3::new(0.0, -0.3, 1.0).normalize()));
        assert!(!DOWN.is_below_horizon(&upright, &Vector3::z()));
    }
}
