use std::f64::consts::PI;
use std::ops::Range;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::kernel::{TwoNearest, squared_distance};
use super::{Match, Parts, collect, match_simulated, passes};
use crate::{DESCRIPTOR_LEN, DESCRIPTOR_NORM, ImageFeatures, Rays};
use crate::{vectorized, vectorized::Level};

/// How to match two images of known relative pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GuidedParams {
    /// Largest ratio of nearest to second-nearest distance within the band; looser than without a pose, since most
    /// wrong candidates are gone.
    pub ratio: f64,
    /// Largest distance of two descriptors as unit vectors, in (0, √2].
    pub max_distance: f64,
    /// Half width in radians of the band about the epipolar great circle.
    pub max_angle_rad: f64,
}

impl GuidedParams {
    /// Changes whenever the same parameters and inputs give other matches.
    ///
    /// 1: band about the great circle, ratio and mutual test. 2: simulated views. 3: of these only what is needed.
    pub const VERSION: u32 = 3;
}

impl Default for GuidedParams {
    fn default() -> Self {
        Self { ratio: 0.85, max_distance: 0.6, max_angle_rad: 0.004 }
    }
}

/// Most sectors about the epipole.
const MAX_SECTORS: usize = 2048;

/// Matches again along the epipolar great circles of a known relative pose.
///
/// `second_from_first` is the essential matrix with bᵀ E a = 0 for bearings a of the first and b of the second image.
/// For each keypoint of the first only those of the second within `max_angle_rad` of the plane with normal E a are
/// candidates; nearest, second nearest (ratio) and mutual tests are taken among candidates. The whole great circle
/// counts, so that the sign of E does not matter: callers check depth signs afterwards. Degenerate E (zero) gives no
/// matches. Matches come in ascending order; simulated views are treated as in [`super::match_features`].
pub fn match_guided(
    params: &GuidedParams,
    first: (&ImageFeatures, &Rays),
    second: (&ImageFeatures, &Rays),
    second_from_first: &Matrix3<f64>,
) -> Vec<Match> {
    match_where(params, first, second, second_from_first, None)
}

/// Those matches of [`match_guided`] of which one keypoint at least is needed: far faster where few are.
///
/// `needed` says of every keypoint of the first and of the second image whether it is. What repeats itself in a simulated view
/// is told among the matches that are needed.
pub fn match_guided_among(
    params: &GuidedParams,
    first: (&ImageFeatures, &Rays),
    second: (&ImageFeatures, &Rays),
    second_from_first: &Matrix3<f64>,
    needed: [&[bool]; 2],
) -> Vec<Match> {
    match_where(params, first, second, second_from_first, Some(needed))
}

/// All matches; where only some keypoints are needed, those of these and any of the others.
fn match_where(
    params: &GuidedParams,
    first: (&ImageFeatures, &Rays),
    second: (&ImageFeatures, &Rays),
    second_from_first: &Matrix3<f64>,
    needed: Option<[&[bool]; 2]>,
) -> Vec<Match> {
    if [first.0, second.0]
        .iter()
        .any(|features| features.descriptors.len() != features.len() * DESCRIPTOR_LEN)
    {
        // Keypoints alone match nothing.
        return Vec::new();
    }
    let is_needed = |m: &Match| {
        needed.is_none_or(|[of_first, of_second]| of_first[m.first as usize] || of_second[m.second as usize])
    };
    let of_views = |a: Parts, b: Parts| {
        let mut found = Vec::new();
        for (a, b) in a.into_iter().zip(b) {
            let needed = needed.map(|[of_first, of_second]| [&of_first[a.clone()], &of_second[b.clone()]]);
            match_parts(params, [(first, a), (second, b)], second_from_first, needed, &mut found);
        }
        found.retain(is_needed);
        found
    };
    let own = of_views(first.0.parts(), second.0.parts());
    if first.0.simulated.is_empty() && second.0.simulated.is_empty() {
        return own;
    }
    match_simulated(first.0, second.0, own, of_views)
}

type Part<'a> = ((&'a ImageFeatures, &'a Rays), Range<usize>);

fn match_parts(
    params: &GuidedParams,
    parts: [Part<'_>; 2],
    second_from_first: &Matrix3<f64>,
    needed: Option<[&[bool]; 2]>,
    found: &mut Vec<Match>,
) {
    let mut search = Search::new(parts, second_from_first, params.max_angle_rad);
    let max_distance = params.max_distance * f64::from(DESCRIPTOR_NORM);
    let accepts = |nearest: &TwoNearest| passes(nearest, params.ratio, max_distance);
    match needed {
        None => search.compare(|_| true, |_| true, Offer::Both),
        Some([of_first, of_second]) => {
            let (is_first, is_second) = (|at: u32| of_first[at as usize], |at: u32| of_second[at as usize]);
            search.compare(is_first, |_| true, Offer::Both);
            search.compare(|at| !is_first(at), is_second, Offer::Both);
            // What needed ones are nearest to must find them nearest among all.
            let nearest_to = |of: &[TwoNearest], is_asked: &[bool], others: &[bool]| {
                let mut asked = vec![false; others.len()];
                for (nearest, _) in
                    of.iter().zip(is_asked).filter(|(nearest, asked)| **asked && accepts(nearest))
                {
                    asked[nearest.index as usize] = !others[nearest.index as usize];
                }
                asked
            };
            let of_needed_first = nearest_to(&search.forward, of_first, of_second);
            let of_needed_second = nearest_to(&search.backward, of_second, of_first);
            search.compare(|at| of_needed_second[at as usize], |at| !is_second(at), Offer::ToFirst);
            search.compare(|at| !is_first(at), |at| of_needed_first[at as usize], Offer::ToSecond);
        }
    }
    let matches = collect(&search.forward, accepts, |first, second| {
        let back = &search.backward[second as usize];
        back.index == first && accepts(back)
    });
    let [first, second] = [0, 1].map(|side: usize| search.parts[side].1.start as u32);
    found.extend(matches.iter().map(|m| Match { first: m.first + first, second: m.second + second }));
}

/// Whose nearest a comparison may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Offer {
    Both,
    ToFirst,
    ToSecond,
}

/// What has been found nearest to each keypoint of two images within the bands of the other's epipolar circles.
struct Search<'a> {
    parts: [Part<'a>; 2],
    second_from_first: Matrix3<f64>,
    max_angle_rad: f64,
    forward: Vec<TwoNearest>,
    backward: Vec<TwoNearest>,
}

impl<'a> Search<'a> {
    fn new(parts: [Part<'a>; 2], second_from_first: &Matrix3<f64>, max_angle_rad: f64) -> Self {
        let [forward, backward] = [&parts[0].1, &parts[1].1].map(|part| vec![TwoNearest::NONE; part.len()]);
        Self { parts, second_from_first: *second_from_first, max_angle_rad, forward, backward }
    }

    /// Compares these keypoints of the first image with those of the second that lie in their bands.
    fn compare(&mut self, of_first: impl Fn(u32) -> bool, of_second: impl Fn(u32) -> bool, offer: Offer) {
        let [(first, a), (second, b)] = &self.parts;
        let (queries, others) = (&first.1.bearings[a.clone()], &second.1.bearings[b.clone()]);
        let asked: Vec<u32> = (0..others.len() as u32).filter(|&at| of_second(at)).collect();
        let Some(sectors) = Sectors::new(others, asked, &self.second_from_first, self.max_angle_rad) else {
            return;
        };
        let (level, max_sine) = (Level::detect(), self.max_angle_rad.sin());
        let base = &second.0.descriptors[b.start * DESCRIPTOR_LEN..b.end * DESCRIPTOR_LEN];
        let (mut sines, mut candidates, mut distances) = (Vec::new(), Vec::new(), Vec::new());
        for (at, bearing) in (0u32..).zip(queries).filter(|(at, _)| of_first(*at)) {
            let Some(plane) = (self.second_from_first * bearing).try_normalize(f64::EPSILON) else {
                continue;
            };
            let (members, bearings) = sectors.candidates(&plane);
            sines_to_plane(level, bearings, &plane, &mut sines);
            // Without a branch, which nobody could foresee.
            candidates.clear();
            candidates.resize(members.len(), 0);
            let mut found = 0;
            for (&member, &sine) in members.iter().zip(&sines) {
                candidates[found] = member;
                found += usize::from(sine <= max_sine);
            }
            candidates.truncate(found);
            squared_distances(
                level,
                first.0.descriptor(a.start + at as usize),
                base,
                &candidates,
                &mut distances,
            );
            for (&candidate, &distance2) in candidates.iter().zip(&distances) {
                if offer != Offer::ToSecond {
                    self.forward[at as usize].offer(candidate, distance2);
                }
                if offer != Offer::ToFirst {
                    self.backward[candidate as usize].offer(at, distance2);
                }
            }
        }
    }
}

vectorized! {
    /// Squared distances of a descriptor from some of an image's.
    fn squared_distances(query: &[u8], base: &[u8], candidates: &[u32], distances: &mut Vec<u32>) {
        distances.clear();
        distances.resize(candidates.len(), 0);
        // With lengths that are known the loop has no rest.
        let Some(query) = query.first_chunk::<DESCRIPTOR_LEN>() else { return };
        let (base, _) = base.as_chunks::<DESCRIPTOR_LEN>();
        for (distance2, &candidate) in distances.iter_mut().zip(candidates) {
            *distance2 = squared_distance(query, &base[candidate as usize]);
        }
    }
}

vectorized! {
    /// Sines of the angles between bearings, by their coordinates, and a plane of unit normal.
    fn sines_to_plane(bearings: [&[f64]; 3], normal: &Vector3<f64>, sines: &mut Vec<f64>) {
        let [x, y, z] = bearings;
        sines.clear();
        sines.resize(x.len(), 0.0);
        for (((sine, &x), &y), &z) in sines.iter_mut().zip(x).zip(y).zip(z) {
            *sine = (x * normal.x + y * normal.y + z * normal.z).abs();
        }
    }
}

/// Grows with the azimuth of a direction, from 0 to 1 over half a turn, and the same for the opposite one: a function of it that takes
/// two divisions' time, with which sectors differ in width by a factor of two.
fn part_of_half_turn(x: f64, y: f64) -> f64 {
    let x = if y < 0.0 { -x } else { x };
    0.5 - 0.5 * x / (x.abs() + y.abs()).max(f64::MIN_POSITIVE)
}

/// Most that [`part_of_half_turn`] grows by, a radian.
const STEEPEST_PART: f64 = 0.5;

/// Some of the second image's keypoints by azimuth about its epipole: every epipolar plane contains the epipole, so the
/// keypoints near one plane are those of nearly one azimuth (modulo π, a plane has two sides).
struct Sectors {
    x_axis: Vector3<f64>,
    y_axis: Vector3<f64>,
    /// The keypoints of all sectors, those of one in index order, and the coordinates of their bearings.
    members: Vec<u32>,
    bearings: [Vec<f64>; 3],
    starts: Vec<usize>,
}

impl Sectors {
    /// Those of these keypoints that have a ray; `None` where there are none, or no epipole.
    fn new(
        bearings: &[Vector3<f64>],
        mut keypoints: Vec<u32>,
        second_from_first: &Matrix3<f64>,
        max_angle_rad: f64,
    ) -> Option<Self> {
        // Keypoints without a ray have the zero vector, which lies in every plane.
        keypoints.retain(|&keypoint| bearings[keypoint as usize] != Vector3::zeros());
        if keypoints.is_empty() {
            return None;
        }
        let svd = second_from_first.transpose().svd(false, true);
        let v_t = svd.v_t?;
        let smallest = svd.singular_values.imin();
        if svd.singular_values.max() <= 0.0 || !second_from_first.iter().all(|value| value.is_finite()) {
            return None;
        }
        let epipole = v_t.row(smallest).transpose();
        let helper = Vector3::ith(epipole.iamin(), 1.0);
        let x_axis = epipole.cross(&helper).normalize();
        let y_axis = epipole.cross(&x_axis);
        // Sectors of about the band's width: narrower ones would only list each keypoint more often.
        let count = ((PI / (2.0 * max_angle_rad.max(1e-6))) as usize).clamp(1, MAX_SECTORS);
        let max_sine = max_angle_rad.sin();
        let span = |keypoint: &u32| {
            let bearing = &bearings[*keypoint as usize];
            let (x, y) = (bearing.dot(&x_axis), bearing.dot(&y_axis));
            // sin(deviation) = sin(angle to the epipole) · sin(azimuth difference), and the tangent of the latter is above it. A
            // little wider, so that rounding never hides a candidate that the exact test accepts.
            let rest = x * x + y * y - max_sine * max_sine;
            let half = STEEPEST_PART * (max_sine / rest.max(0.0).sqrt() + 1e-9);
            // Also where it is infinite.
            if !(half < 0.5) {
                return (0, count);
            }
            let part = part_of_half_turn(x, y) + 1.0;
            let begin = ((part - half) * count as f64) as usize;
            let end = ((part + half) * count as f64) as usize;
            (begin % count, (end - begin + 1).min(count))
        };
        let spans: Vec<(usize, usize)> = keypoints.iter().map(span).collect();
        // A span may go past the last sector once.
        let wrapped = |sector: usize| if sector < count { sector } else { sector - count };
        let mut starts = vec![0; count + 1];
        for &(begin, len) in &spans {
            (begin..begin + len).for_each(|sector| starts[wrapped(sector) + 1] += 1);
        }
        for sector in 0..count {
            starts[sector + 1] += starts[sector];
        }
        let mut next = starts.clone();
        let mut members = vec![0; starts[count]];
        for (&keypoint, &(begin, len)) in keypoints.iter().zip(&spans) {
            for sector in (begin..begin + len).map(wrapped) {
                members[next[sector]] = keypoint;
                next[sector] += 1;
            }
        }
        let bearings = [0, 1, 2]
            .map(|axis: usize| members.iter().map(|&member| bearings[member as usize][axis]).collect());
        Some(Self { x_axis, y_axis, members, bearings, starts })
    }

    /// Keypoints that may lie in the band of the plane with this normal, in index order, and their bearings.
    fn candidates(&self, plane: &Vector3<f64>) -> (&[u32], [&[f64]; 3]) {
        // The plane's azimuth is a quarter turn from its normal's.
        let part = part_of_half_turn(-plane.dot(&self.y_axis), plane.dot(&self.x_axis));
        let count = self.starts.len() - 1;
        let sector = ((part * count as f64) as usize).min(count - 1);
        let range = self.starts[sector]..self.starts[sector + 1];
        (&self.members[range.clone()], [0, 1, 2].map(|axis: usize| &self.bearings[axis][range.clone()]))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::Keypoint;

    struct Pair {
        first: (ImageFeatures, Rays),
        second: (ImageFeatures, Rays),
        essential: Matrix3<f64>,
    }

    /// Points all round two panoramas; every descriptor occurs twice, at different places.
    fn pair() -> Pair {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let rotation = Rotation3::from_euler_angles(0.2, 1.1, -0.4);
        let translation = Vector3::new(0.5, -0.1, 0.7);
        let mut rays = (Rays::default(), Rays::default());
        let mut descriptors = Vec::new();
        for index in 0..400 {
            let point = Vector3::from_fn(|_, _| rng.random_range(-5.0..5.0));
            rays.0.bearings.push(point.normalize());
            rays.1.bearings.push((rotation * point + translation).normalize());
            let descriptor: Vec<u8> = if index % 2 == 0 {
                (0..DESCRIPTOR_LEN).map(|_| rng.random_range(0..90)).collect()
            } else {
                descriptors[descriptors.len() - DESCRIPTOR_LEN..].to_vec()
            };
            descriptors.extend(descriptor);
        }
        let keypoints: Vec<Keypoint> = vec![bytemuck::Zeroable::zeroed(); 400];
        let features = ImageFeatures { keypoints, descriptors, ..ImageFeatures::default() };
        let essential = translation.cross_matrix() * rotation.matrix();
        Pair { first: (features.clone(), rays.0), second: (features, rays.1), essential }
    }

    #[test]
    fn geometry_tells_repeated_descriptors_apart() {
        let pair = pair();
        let params = GuidedParams { max_angle_rad: 0.002, ..GuidedParams::default() };
        let matches = match_guided(
            &params,
            (&pair.first.0, &pair.first.1),
            (&pair.second.0, &pair.second.1),
            &pair.essential,
        );
        assert!(matches.len() > 370, "{}", matches.len());
        assert!(matches.iter().all(|found| found.first == found.second));
    }

    #[test]
    fn sectors_hide_no_candidate_of_the_band() {
        let pair = pair();
        for max_angle in [1e-4_f64, 0.01, 0.3, 1.5] {
            let bearings = &pair.second.1.bearings;
            let all = (0..bearings.len() as u32).collect();
            let sectors = Sectors::new(bearings, all, &pair.essential, max_angle).unwrap();
            for bearing in &pair.first.1.bearings {
                let plane = (pair.essential * bearing).normalize();
                let (listed, _) = sectors.candidates(&plane);
                for (index, other) in (0u32..).zip(bearings) {
                    if other.dot(&plane).abs() <= max_angle.sin() {
                        assert!(listed.contains(&index), "angle {max_angle}");
                    }
                }
            }
        }
    }

    #[test]
    fn those_of_needed_keypoints_are_the_same_as_among_all() {
        let pair = pair();
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let (first, second) = ((&pair.first.0, &pair.first.1), (&pair.second.0, &pair.second.1));
        for share in [0.0, 0.05, 0.3, 1.0] {
            let needed = [(); 2].map(|()| (0..400).map(|_| rng.random_bool(share)).collect::<Vec<bool>>());
            let is_needed = |m: &Match| needed[0][m.first as usize] || needed[1][m.second as usize];
            for max_angle_rad in [0.002, 0.02, 0.2] {
                let params = GuidedParams { max_angle_rad, ratio: 0.95, ..GuidedParams::default() };
                let mut all = match_guided(&params, first, second, &pair.essential);
                all.retain(is_needed);
                let asked = [&needed[0][..], &needed[1][..]];
                let among = match_guided_among(&params, first, second, &pair.essential, asked);
                assert_eq!(among, all, "{share} {max_angle_rad}");
                assert!(share < 0.3 || max_angle_rad > 0.1 || all.len() > 50, "{}", all.len());
            }
        }
    }

    #[test]
    fn distances_are_the_same_by_all_instructions() {
        let pair = pair();
        let descriptors = &pair.first.0.descriptors;
        let candidates: Vec<u32> = (0..400).step_by(3).collect();
        let query = &descriptors[DESCRIPTOR_LEN..2 * DESCRIPTOR_LEN];
        let of = |at: &u32| &descriptors[*at as usize * DESCRIPTOR_LEN..][..DESCRIPTOR_LEN];
        let expected: Vec<u32> = candidates.iter().map(|at| squared_distance(query, of(at))).collect();
        for level in [Level::BASELINE, Level::detect()] {
            let mut distances = Vec::new();
            squared_distances(level, query, descriptors, &candidates, &mut distances);
            assert_eq!(distances, expected, "{level:?}");
        }
    }

    #[test]
    fn a_zero_matrix_or_empty_images_give_no_matches() {
        let pair = pair();
        let params = GuidedParams::default();
        let first = (&pair.first.0, &pair.first.1);
        assert!(match_guided(&params, first, first, &Matrix3::zeros()).is_empty());
        let none = (ImageFeatures::default(), Rays::default());
        assert!(match_guided(&params, first, (&none.0, &none.1), &pair.essential).is_empty());
    }
}
