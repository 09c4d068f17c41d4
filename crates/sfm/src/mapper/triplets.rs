//! Pairs that others contradict.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::UnitQuaternion;
use setloc_features::Match;

use super::MapperInput;
use crate::{ImageId, PairGeometry, TwoView, TwoViewKind, two_view::verify_turned};

/// Degrees by which the way about a third image may be turned against a pair. (Right pairs of rendered streets are off by 0.04–0.7°, the
/// wrong ones found there by 10–23°.)
const MAX_DEVIATION_DEG: f64 = 5.0;
/// How many times as many matches both pairs of that way must have to contradict the pair.
const STRONGER: f64 = 2.0;
/// How many times as many they must have to bear it out.
const AS_STRONG: f64 = 0.5;

/// The pairs, those anew of which two much stronger ones, about a third image, give another rotation, and none the same.
///
/// Twenty or thirty matches of panoramas far apart, half of them wrong, pass for an essential matrix that is ten degrees off, and
/// a few of them are the points that three images see. Neighbours share hundreds, which tell rotations to a tenth of a degree. So
/// all matches of such a pair are verified once more, with that rotation, and left out where too few agree.
/// Of panoramas only: the matches of one wall that photos share fit two rotations, however many they are.
/// (Rotations of triplets as in C. Zach, M. Klopschitz, M. Pollefeys, "Disambiguating visual relations using loop constraints", CVPR 2010.)
pub(super) fn consistent(input: &MapperInput<'_>, seed: u64) -> Vec<PairGeometry> {
    let views = Views::of(input);
    let turns: Vec<Option<UnitQuaternion<f64>>> =
        input.pairs.iter().map(|pair| views.contradicting(pair)).collect();
    let mut pairs: Vec<PairGeometry> = (input.pairs.iter().zip(&turns))
        .filter(|(_, turn)| turn.is_none())
        .map(|(pair, _)| pair.clone())
        .collect();
    let putative: BTreeMap<_, _> =
        input.putative.iter().map(|pair| ((pair.first, pair.second), &pair.matches)).collect();
    let mut has_geometry: BTreeSet<_> = pairs.iter().map(|pair| (pair.first, pair.second)).collect();
    for (pair, turn) in input.pairs.iter().zip(&turns) {
        let images = (pair.first, pair.second);
        if let Some(turn) = turn
            && let Some(matches) = putative.get(&images)
            && !has_geometry.contains(&images)
            && let Some(two_view) = verified_anew(input, pair, matches, turn, seed)
        {
            has_geometry.insert(images);
            pairs.push(PairGeometry { two_view, ..pair.clone() });
        }
    }
    pairs.sort_by_key(|pair| (pair.first, pair.second));
    pairs
}

/// The geometry of a pair with about this rotation.
fn verified_anew(
    input: &MapperInput<'_>,
    pair: &PairGeometry,
    matches: &[Match],
    turn: &UnitQuaternion<f64>,
    seed: u64,
) -> Option<TwoView> {
    let rays = |image: ImageId, keypoints: &mut dyn Iterator<Item = u32>| {
        let image = &input.images[image.index()];
        image.features.rays_of(&input.cameras[image.camera.index()], keypoints)
    };
    let first = rays(pair.first, &mut matches.iter().map(|m| m.first));
    let second = rays(pair.second, &mut matches.iter().map(|m| m.second));
    let seed = seed ^ (u64::from(pair.first.0) << 32) ^ u64::from(pair.second.0);
    let found = verify_turned(&input.two_view, [&first, &second], matches, turn, seed)?;
    let deviation = found.second_from_first.rotation.angle_to(turn).to_degrees();
    (found.kind == TwoViewKind::General && deviation <= MAX_DEVIATION_DEG).then_some(found)
}

/// How one image is turned against another, and how many matches say so.
struct View {
    second_from_first: UnitQuaternion<f64>,
    matches: usize,
}

/// All geometries of pairs of panoramas, either way, image by image.
struct Views(Vec<BTreeMap<ImageId, Vec<View>>>);

impl Views {
    fn of(input: &MapperInput<'_>) -> Self {
        let mut views: Vec<BTreeMap<_, Vec<_>>> = input.images.iter().map(|_| BTreeMap::new()).collect();
        for PairGeometry { first, second, two_view } in input.pairs {
            if input.is_panoramic(*first) && input.is_panoramic(*second) {
                let (turn, matches) = (two_view.second_from_first.rotation, two_view.inliers.len());
                for (from, to, second_from_first) in [(first, second, turn), (second, first, turn.inverse())]
                {
                    views[from.index()].entry(*to).or_default().push(View { second_from_first, matches });
                }
            }
        }
        Self(views)
    }

    /// The rotation that the strongest way about a third image gives, if that contradicts the pair and none bears it out.
    fn contradicting(&self, pair: &PairGeometry) -> Option<UnitQuaternion<f64>> {
        let (turn, matches) = (pair.two_view.second_from_first.rotation, pair.two_view.inliers.len() as f64);
        let mut strongest: Option<(usize, UnitQuaternion<f64>)> = None;
        for (third, first_ways) in &self.0[pair.first.index()] {
            let Some(second_ways) = self.0[third.index()].get(&pair.second) else { continue };
            for (first, second) in
                first_ways.iter().flat_map(|first| second_ways.iter().map(move |second| (first, second)))
            {
                let about = second.second_from_first * first.second_from_first;
                let weaker = first.matches.min(second.matches);
                if about.angle_to(&turn).to_degrees() > MAX_DEVIATION_DEG {
                    if weaker as f64 >= STRONGER * matches
                        && strongest.is_none_or(|(strength, _)| weaker > strength)
                    {
                        strongest = Some((weaker, about));
                    }
                } else if weaker as f64 >= AS_STRONG * matches {
                    return None;
                }
            }
        }
        strongest.map(|(_, about)| about)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use rand::Rng;
    use setloc_features::{Camera, CameraModel, DESCRIPTOR_LEN, ImageFeatures, Keypoint};

    use super::*;
    use crate::{PutativePair, Rigid, synthetic::seeded};

    /// Pairs of four images by matches and degrees about the vertical, and which of them stay.
    fn kept(model: CameraModel, pairs: &[(u32, u32, u32, f64)]) -> Vec<(u32, u32)> {
        let params =
            if model == CameraModel::Equirectangular { vec![100.0, 50.0] } else { vec![80.0, 50.0, 25.0] };
        let camera = Camera { model, width: 100, height: 50, params };
        let geometry = |&(first, second, matches, degrees): &(u32, u32, u32, f64)| {
            let rotation = UnitQuaternion::from_euler_angles(0.0, degrees.to_radians(), 0.0);
            let two_view = TwoView::of_equal_features(Rigid { rotation, ..Rigid::default() }, 0..matches);
            PairGeometry { first: ImageId(first), second: ImageId(second), two_view }
        };
        let (features, pairs) = (ImageFeatures::default(), pairs.iter().map(geometry).collect::<Vec<_>>());
        let input = MapperInput::of_one_camera(&camera, [&features; 4], &pairs);
        consistent(&input, 0).iter().map(|pair| (pair.first.0, pair.second.0)).collect()
    }

    #[test]
    fn a_pair_that_much_stronger_ones_contradict_is_left_out() {
        let panorama = CameraModel::Equirectangular;
        let (near, far) = ([(0, 1, 160, 10.0), (1, 2, 100, -30.0)], (0, 2, 40, -8.0));
        assert_eq!(kept(panorama, &[near[0], far, near[1]]), [(0, 1), (1, 2)]);
        // It agrees, or the others are not much stronger, or photos.
        assert_eq!(kept(panorama, &[near[0], (0, 2, 40, -19.0), near[1]]).len(), 3);
        assert_eq!(kept(panorama, &[near[0], (0, 2, 60, -8.0), near[1]]).len(), 3);
        assert_eq!(kept(CameraModel::SimplePinhole, &[near[0], far, near[1]]).len(), 3);
        // Both geometries of a pair are asked, and each is judged by itself.
        assert_eq!(kept(panorama, &[near[0], (0, 2, 30, -21.0), far, near[1]]), [(0, 1), (0, 2), (1, 2)]);
    }

    #[test]
    fn a_pair_that_others_bear_out_stays() {
        // The strong ones about the second image are those of a façade that repeats itself; those about the fourth agree.
        let (wrong, right) = ([(0, 1, 460, 10.0), (1, 2, 400, 90.0)], [(0, 3, 90, 5.0), (2, 3, 70, 3.0)]);
        let pair = (0, 2, 100, 2.0);
        assert_eq!(
            kept(CameraModel::Equirectangular, &[wrong[0], pair, right[0], wrong[1], right[1]]).len(),
            5
        );
        assert_eq!(kept(CameraModel::Equirectangular, &[wrong[0], pair, wrong[1]]).len(), 2);
    }

    /// What 100 points look like from three panoramas in a row, keypoint by keypoint, and 60 keypoints elsewhere.
    fn panoramas(camera: &Camera, poses: &[Rigid; 3]) -> [ImageFeatures; 3] {
        let mut rng = seeded("triplets");
        let mut random = |half: f64| Vector3::from_fn(|_, _| rng.random_range(-half..half));
        let points: Vec<Vector3<f64>> = (0..100).map(|_| random(20.0)).collect();
        poses.map(|pose| {
            let rays = points.iter().map(|point| pose.inverse_transform_point(point)).collect::<Vec<_>>();
            let elsewhere = (0..60).map(|_| random(1.0)).collect::<Vec<_>>();
            let keypoint = |ray: &Vector3<f64>| {
                let pixel = camera.project(ray).unwrap();
                let (x, y) = (pixel.x as f32, pixel.y as f32);
                Keypoint { x, y, size: 4.0, orientation: 0.0, noise_px: 0.3 }
            };
            ImageFeatures {
                keypoints: rays.iter().chain(&elsewhere).map(keypoint).collect(),
                descriptors: vec![0; 160 * DESCRIPTOR_LEN],
                width: camera.width,
                height: camera.height,
                ..ImageFeatures::default()
            }
        })
    }

    #[test]
    fn all_matches_of_such_a_pair_are_verified_anew() {
        let camera = Camera {
            model: CameraModel::Equirectangular,
            width: 2000,
            height: 1000,
            params: vec![2000.0, 1000.0],
        };
        let poses = [0.0, 1.0, 2.0].map(|at: f64| {
            Rigid::new(UnitQuaternion::from_euler_angles(0.0, 0.3 * at, 0.0), Vector3::new(at, 0.1 * at, 0.0))
        });
        let features = panoramas(&camera, &poses);
        let same = |range: std::ops::Range<u32>| range.map(|at| Match { first: at, second: at });
        let pair = |first: usize, second: usize, turned: f64, inliers: Vec<Match>| {
            let mut second_from_first = poses[second].inverse() * poses[first];
            second_from_first.rotation *= UnitQuaternion::from_euler_angles(0.0, turned, 0.0);
            let two_view =
                TwoView { kind: TwoViewKind::General, second_from_first, inliers, median_parallax_rad: 0.1 };
            PairGeometry { first: ImageId(first as u32), second: ImageId(second as u32), two_view }
        };
        let pairs = [
            pair(0, 1, 0.0, same(0..100).collect()),
            pair(0, 2, 0.2, same(10..40).collect()),
            pair(1, 2, 0.0, same(0..100).collect()),
        ];
        // 30 right matches and 60 that are wrong.
        let putative = |right: u32| {
            let matches = same(0..right).chain(same(100..160)).collect();
            [PutativePair { first: ImageId(0), second: ImageId(2), matches }]
        };
        let found = |putative: &[PutativePair]| {
            let input = MapperInput { putative, ..MapperInput::of_one_camera(&camera, &features, &pairs) };
            consistent(&input, 1)
        };
        let anew = found(&putative(30));
        assert_eq!(anew.iter().map(|pair| pair.second.0).collect::<Vec<_>>(), [1, 2, 2]);
        let view = &anew[1].two_view;
        assert!(same(0..30).all(|m| view.inliers.contains(&m)) && view.inliers.len() < 40);
        let truth = poses[2].inverse() * poses[0];
        assert!(view.second_from_first.rotation.angle_to(&truth.rotation) < 0.005);
        assert!(view.second_from_first.translation.angle(&truth.translation) < 0.02);
        // Too few that agree.
        assert_eq!(found(&putative(10)).len(), 2);
    }
}
