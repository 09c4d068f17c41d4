//! Poses judged by what lies away from a floor that repeats itself.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use setloc_features::{Match, Rays};

use super::model::Model;
use crate::{ImageId, PairGeometry, PointId, Rigid, solvers::essential::essential_from_pose};

/// Fewest matches with an image by which it can judge a pose.
const MIN_MATCHES: usize = 8;
/// Fewest images that must speak for a pose.
const MIN_WITNESSES: usize = 2;
/// Angle in degrees that two of the baselines to these must have between them: along one line, a place is as good as the
/// next.
const MIN_SPREAD_DEG: f64 = 15.0;

/// The matches that lie on the epipolar circles of a pose.
pub(super) fn on_circles<'m>(
    [first, second]: [&'m Rays; 2],
    second_from_first: &Rigid,
    matches: &'m [Match],
    max_error_sigma: f64,
) -> impl Iterator<Item = &'m Match> {
    let second_from_ray = essential_from_pose(second_from_first);
    let first_from_ray = second_from_ray.transpose();
    matches.iter().filter(move |m| {
        let (a, b) = (m.first as usize, m.second as usize);
        let (forth, back) = (second_from_ray * first.bearings[a], first_from_ray * second.bearings[b]);
        let sigma = (forth.norm() * second.sigmas[b]).hypot(back.norm() * first.sigmas[a]);
        sigma.is_finite() && second.bearings[b].dot(&forth).abs() <= max_error_sigma * sigma
    })
}

/// How many they are.
pub(super) fn count_on_circles(
    rays: [&Rays; 2],
    second_from_first: &Rigid,
    matches: &[Match],
    max_error_sigma: f64,
) -> usize {
    on_circles(rays, second_from_first, matches, max_error_sigma).count()
}

/// How many of a pair's verified matches lie on the epipolar circles of a pose of `image`, one of the two, relative to the
/// other.
pub(super) fn count_agreeing(
    model: &Model<'_>,
    pair: &PairGeometry,
    image: ImageId,
    image_from_other: &Rigid,
    max_error_sigma: f64,
) -> usize {
    let second_from_first = if pair.first == image { image_from_other.inverse() } else { *image_from_other };
    let rays = [pair.first, pair.second].map(|image| &model.rays[image.index()]);
    count_on_circles(rays, &second_from_first, &pair.two_view.inliers, max_error_sigma)
}

/// The verified matches of images away from what repeats itself, geometry by geometry.
///
/// Where a floor repeats itself, most of what is in plain view of a right pose does not match, and much of what is not
/// does. What lies elsewhere is little, but little of it is wrong.
#[derive(Debug)]
pub(super) struct Witnesses {
    matches: BTreeMap<(ImageId, ImageId), Vec<Vec<Match>>>,
    /// Whether a keypoint lies elsewhere, image by image.
    elsewhere: Vec<Vec<bool>>,
}

/// What images say of a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Testimony {
    /// Those that have most of what they share with the image on the pose's epipolar circles.
    pub agreeing: usize,
    /// All that were asked.
    pub asked: usize,
    /// Whether a place further along the baselines to the agreeing ones would be as good.
    pub is_loose: bool,
}

impl Testimony {
    /// Whether the pose is wrong.
    pub fn speaks_against(&self) -> bool {
        self.asked >= MIN_WITNESSES && 2 * self.agreeing <= self.asked
    }

    /// Whether the pose is right.
    pub fn speaks_for(&self) -> bool {
        self.agreeing >= MIN_WITNESSES && 2 * self.agreeing > self.asked && !self.is_loose
    }
}

impl Witnesses {
    /// Those of verified pairs, given which keypoints lie elsewhere.
    pub fn new(pairs: &[PairGeometry], elsewhere: Vec<Vec<bool>>) -> Self {
        let mut of_pairs: BTreeMap<_, Vec<Vec<Match>>> = BTreeMap::new();
        for pair in pairs {
            let (first, second) = (&elsewhere[pair.first.index()], &elsewhere[pair.second.index()]);
            let counts = |m: &&Match| first[m.first as usize] && second[m.second as usize];
            let matches: Vec<Match> = pair.two_view.inliers.iter().filter(counts).copied().collect();
            if matches.len() >= MIN_MATCHES {
                of_pairs.entry((pair.first, pair.second)).or_default().push(matches);
            }
        }
        Self { matches: of_pairs, elsewhere }
    }

    /// What the registered images say of a pose, each by the geometry that shares most with it.
    pub fn hear(
        &self,
        model: &Model<'_>,
        image: ImageId,
        world_from_camera: &Rigid,
        inliers: &[(u32, PointId)],
        max_error_sigma: f64,
    ) -> Testimony {
        let mut asked = 0;
        let mut agreeing: Vec<Vector3<f64>> = Vec::new();
        for (&(first, second), geometries) in &self.matches {
            let other = if first == image { second } else { first };
            let Some(pose) = &model.poses[other.index()] else { continue };
            if first != image && second != image {
                continue;
            }
            let pose_of = |of: ImageId| if of == image { world_from_camera } else { &pose.world_from_camera };
            let second_from_first = pose_of(second).inverse() * *pose_of(first);
            let rays = [first, second].map(|image| &model.rays[image.index()]);
            let on_circles =
                |matches: &Vec<Match>| count_on_circles(rays, &second_from_first, matches, max_error_sigma);
            let most = geometries.iter().map(on_circles).max().unwrap_or(0);
            let all = geometries.iter().map(Vec::len).max().unwrap_or(0);
            asked += 1;
            if 2 * most > all {
                agreeing.push(world_from_camera.translation - pose.center());
            }
        }
        let is_apart = |a: &Vector3<f64>, b: &Vector3<f64>| {
            a.cross(b).norm() > MIN_SPREAD_DEG.to_radians().sin() * a.norm() * b.norm()
        };
        let is_spread =
            agreeing.iter().enumerate().any(|(at, a)| agreeing[..at].iter().any(|b| is_apart(a, b)));
        let elsewhere = &self.elsewhere[image.index()];
        let points = inliers.iter().filter(|(feature, _)| elsewhere[*feature as usize]).count();
        Testimony { agreeing: agreeing.len(), asked, is_loose: !is_spread && points < MIN_MATCHES }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use setloc_features::{Camera, ImageFeatures, Keypoint};

    use super::*;
    use crate::{
        MapperInput, TwoView,
        synthetic::{random_unit, seeded},
    };

    const POINTS: usize = 40;

    /// What the images at all other centres say of the first, `shift` from where it is.
    fn heard(centers: &[Vector3<f64>], shift: Vector3<f64>) -> Testimony {
        let mut rng = seeded("witnesses");
        let camera = Camera::equirectangular(2048, 1024);
        let points: Vec<Vector3<f64>> = (0..POINTS).map(|_| random_unit(&mut rng) * 4.0).collect();
        let features: Vec<ImageFeatures> = centers
            .iter()
            .map(|center| {
                let mut features = ImageFeatures { width: 2048, height: 1024, ..ImageFeatures::default() };
                for pixel in points.iter().filter_map(|point| camera.project(&(point - center))) {
                    let (x, y) = (pixel.x as f32, pixel.y as f32);
                    features.keypoints.push(Keypoint { x, y, size: 5.0, orientation: 0.0, noise_px: 0.3 });
                }
                features
            })
            .collect();
        let pose = |at: usize| Rigid::new(UnitQuaternion::identity(), centers[at]);
        let pairs: Vec<PairGeometry> = (1..centers.len())
            .map(|other| PairGeometry {
                first: ImageId(0),
                second: ImageId(other as u32),
                two_view: TwoView::of_equal_features(pose(other).inverse() * pose(0), 0..POINTS as u32),
            })
            .collect();
        let input = MapperInput::of_one_camera(&camera, &features, &pairs);
        let mut model = Model::new(&input);
        for other in 1..centers.len() {
            model.set_pose(ImageId(other as u32), Some(pose(other)));
        }
        let witnesses = Witnesses::new(&pairs, vec![vec![true; POINTS]; centers.len()]);
        let moved = Rigid::new(UnitQuaternion::identity(), centers[0] + shift);
        witnesses.hear(&model, ImageId(0), &moved, &[], 6.0)
    }

    #[test]
    fn a_pose_one_tile_aside_is_told_from_the_right_one() {
        let round = [Vector3::zeros(), Vector3::x(), Vector3::z(), Vector3::new(-1.0, 0.0, 1.0)];
        let right = heard(&round, Vector3::zeros());
        assert_eq!(right, Testimony { agreeing: 3, asked: 3, is_loose: false });
        assert!(right.speaks_for() && !right.speaks_against());
        let aside = heard(&round, Vector3::x() * 0.5);
        assert!(aside.speaks_against() && !aside.speaks_for(), "{aside:?}");
    }

    #[test]
    fn images_along_one_line_do_not_say_where_on_it() {
        let line = [Vector3::zeros(), Vector3::x(), Vector3::x() * 2.0];
        for shift in [Vector3::zeros(), Vector3::x() * -0.5] {
            let heard = heard(&line, shift);
            assert_eq!(heard, Testimony { agreeing: 2, asked: 2, is_loose: true });
            assert!(!heard.speaks_for() && !heard.speaks_against());
        }
    }
}
