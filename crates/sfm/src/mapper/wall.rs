//! The pose of an image that sees hardly more than one wall with the image before it.
//!
//! A wall alone fits essential matrices of many directions, and matches sought along epipolar circles fit whichever
//! they were sought for. What a wall does tell is a homography H ∝ R + t·nᵀ/d, which every match on it has to meet in
//! both coordinates, so that chance matches hardly do. R, t/d and n follow from H up to two solutions (Y. Ma, S. Soatto,
//! J. Košecká, S. Sastry, "An Invitation to 3-D Vision", 2004, § 5.3.3). Points on known planes beside the wall then
//! give the length and sharpen the rest.

use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Vector2, Vector3};

use crate::{
    Rigid, StepPose,
    robust::{
        AngularResidual, RansacParams,
        absolute_pose::turned,
        estimate_ray_homography,
        least_squares::{LeastSquares, Normal, cauchy, minimize},
    },
    solvers::tangent_basis,
};

/// How the homography of the wall is estimated.
const RANSAC: RansacParams = RansacParams {
    max_error_sigma: 4.0,
    min_iterations: 500,
    max_iterations: 4000,
    confidence: 0.9999,
    min_inliers: 40,
};
/// Relief of a wall as a share of its distance: it shifts matches along the parallax by this share of it, and not across.
const RELIEF: f64 = 0.015;
/// Largest error of a match on the wall or on a known plane, in standard deviations.
const MAX_SIGMAS: f64 = 4.0;
/// Inverse square of the scale of the loss, in standard deviations.
const INVERSE_SCALE_SQUARED: f64 = 0.25;
/// Most steps of the adjustment, and how often matches are chosen anew.
const STEPS: usize = 50;
const ROUNDS: usize = 3;
/// Groups of neighbouring matches of which each is left out once.
const GROUPS: usize = 8;
/// Known planes that count apart.
pub(crate) const PLANES: usize = 2;
/// Rotation, step, normal, logarithm of the wall's distance, and of each known plane's.
const UNKNOWNS: usize = 9 + PLANES;

/// Matches of two images: bearings in the first image's frame and the second's, and their standard deviations.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bearings<'a> {
    pub first: &'a [Vector3<f64>],
    pub second: &'a [Vector3<f64>],
    pub sigmas_first: &'a [f64],
    pub sigmas_second: &'a [f64],
}

/// A match on a known plane.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OnPlane {
    /// The match, by its place in the list.
    pub at: usize,
    /// Number of the plane, below [`PLANES`].
    pub plane: usize,
    /// Depth of the plane along the first bearing.
    pub depth: f64,
}

/// Two views of a wall: the second's pose, and the wall in the first's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct WallPair {
    rotation: Matrix3<f64>,
    /// Of the first image's centre in the second's frame.
    translation: Vector3<f64>,
    /// Unit normal, away from the first image.
    pub normal: Vector3<f64>,
    distance: f64,
    /// Factors on the known planes' distances.
    factors: [f64; PLANES],
}

/// The pose with its uncertainty.
#[derive(Debug, Clone)]
pub(crate) struct Measured {
    pub pair: WallPair,
    /// Matches that agree, ascending.
    pub matches: Vec<usize>,
    /// How many of them lie on known planes.
    pub on_planes: usize,
    /// Of rotation (in the second image's axes) and of its centre (in the first's).
    pub covariance: Matrix6<f64>,
}

impl WallPair {
    /// The pose of the second camera.
    pub fn second_from_first(&self) -> Rigid {
        Rigid::from_matrix(&self.rotation, self.translation)
    }

    /// The direction in which the second image sees the wall along a bearing of the first; `None` behind it.
    pub fn seen(&self, first: &Vector3<f64>) -> Option<Vector3<f64>> {
        let slant = self.normal.dot(first);
        (slant > 0.0).then(|| self.rotation * first + self.translation * (slant / self.distance))
    }

    /// How a match that is seen in this direction of the second image differs from its place, in standard deviations:
    /// along the parallax at this pose, where relief counts, and across it.
    fn residual(&self, rays: &Bearings<'_>, at: usize, seen: &Vector3<f64>) -> Residual {
        let bearing = &rays.second[at];
        let (first, second) = (rays.sigmas_first[at], rays.sigmas_second[at]);
        let sigma = first.hypot(second);
        let plain = AngularResidual::new(bearing, seen, sigma);
        let (u, v) = tangent_basis(bearing);
        let parallax = (self.rotation * rays.first[at]).angle(bearing);
        let along = Vector2::new(u.dot(&self.translation), v.dot(&self.translation));
        let along = along.try_normalize(0.0).unwrap_or_else(Vector2::x);
        let looser = sigma / sigma.hypot(RELIEF * parallax);
        let (by_u, by_v) = plain.rows;
        let across = Vector2::new(-along.y, along.x);
        Residual {
            value: [plain.value.dot(&along) * looser, plain.value.dot(&across)],
            rows: [(by_u * along.x + by_v * along.y) * looser, by_u * across.x + by_v * across.y],
        }
    }

    /// Whether a match lies on the wall.
    fn shows(&self, rays: &Bearings<'_>, at: usize) -> bool {
        self.seen(&rays.first[at])
            .is_some_and(|seen| self.residual(rays, at, &seen).squared() <= MAX_SIGMAS.powi(2))
    }

    /// Of the first so many matches those on the wall, ascending.
    fn among(&self, rays: &Bearings<'_>, candidates: usize) -> Vec<usize> {
        (0..candidates.min(rays.first.len())).filter(|&at| self.shows(rays, at)).collect()
    }

    /// The pairs that a wall of most matches leaves, the one with more of them first; at a wall of distance one.
    pub fn find(rays: &Bearings<'_>, seed: u64) -> Vec<Self> {
        let Bearings { first, second, sigmas_first, sigmas_second } = *rays;
        let found = estimate_ray_homography(&RANSAC, first, second, sigmas_first, sigmas_second, seed);
        let Some(found) = found else { return Vec::new() };
        let seen = found.inliers.iter().map(|&at| first[at as usize]).sum::<Vector3<f64>>();
        let mut pairs: Vec<(usize, Self)> = decompose(&found.second_from_first, &seen)
            .into_iter()
            .map(|pair| pair.adjusted(rays, first.len(), &[], [0.0; PLANES]))
            .map(|pair| (pair.among(rays, first.len()).len(), pair))
            .filter(|(count, _)| *count >= RANSAC.min_inliers)
            .collect();
        pairs.sort_by_key(|(count, _)| std::cmp::Reverse(*count));
        pairs.into_iter().map(|(_, pair)| pair).collect()
    }

    /// The same at another length of the step.
    #[must_use]
    pub fn scaled(&self, length: f64) -> Self {
        let factor = length / self.translation.norm();
        Self { translation: self.translation * factor, distance: self.distance * factor, ..*self }
    }

    /// Adjusts everything by the matches on the wall and those on known planes, whose distances have these relative
    /// standard deviations.
    fn adjusted(
        mut self,
        rays: &Bearings<'_>,
        candidates: usize,
        on_planes: &[OnPlane],
        deviations: [f64; PLANES],
    ) -> Self {
        for _ in 0..ROUNDS {
            let on_wall = self.among(rays, candidates);
            let on_planes = self.agreeing(rays, on_planes);
            let fit = WallFit { rays, base: self, on_wall: &on_wall, on_planes: &on_planes, deviations };
            self = minimize::<UNKNOWNS, _>(&fit, self, STEPS);
        }
        self
    }

    fn agreeing(&self, rays: &Bearings<'_>, on_planes: &[OnPlane]) -> Vec<OnPlane> {
        let agrees = |on: &&OnPlane| {
            self.residual(rays, on.at, &self.seen_on(rays, on)).squared() <= MAX_SIGMAS.powi(2)
        };
        on_planes.iter().filter(agrees).copied().collect()
    }

    fn seen_on(&self, rays: &Bearings<'_>, on: &OnPlane) -> Vector3<f64> {
        self.rotation * rays.first[on.at] * (on.depth * self.factors[on.plane]) + self.translation
    }

    /// The pose by wall and known planes, and what all of these leave open; `None` where that is not bounded.
    ///
    /// The first so many matches may lie on the wall, those on known planes are given.
    /// The covariance is that of the adjustment, residuals taken as they are, and that among estimates without each of
    /// some groups of neighbours, which share the relief of their piece of the wall.
    pub fn measure(
        &self,
        rays: &Bearings<'_>,
        candidates: usize,
        on_planes: &[OnPlane],
        deviations: [f64; PLANES],
    ) -> Option<Measured> {
        let pair = (*self).adjusted(rays, candidates, on_planes, deviations);
        let on_wall = pair.among(rays, candidates);
        let on_planes = pair.agreeing(rays, on_planes);
        let fit = WallFit { rays, base: pair, on_wall: &on_wall, on_planes: &on_planes, deviations };
        let mut covariance = fit.covariance(&pair)?;
        // Neighbours from side to side, or from above to below, whichever is wider.
        let middle = on_wall.iter().map(|&at| rays.first[at]).sum::<Vector3<f64>>();
        let (u, v) = tangent_basis(&middle.try_normalize(0.0)?);
        let spread =
            |axis: &Vector3<f64>| on_wall.iter().map(|&at| rays.first[at].dot(axis).powi(2)).sum::<f64>();
        for axis in [u, v] {
            if spread(&axis) <= 0.0 {
                continue;
            }
            let mut ordered = on_wall.clone();
            ordered.sort_by(|&a, &b| rays.first[a].dot(&axis).total_cmp(&rays.first[b].dot(&axis)));
            let mut group_of = vec![0; rays.first.len()];
            for (place, &at) in ordered.iter().enumerate() {
                group_of[at] = place * GROUPS / ordered.len();
            }
            for (place, on) in on_planes.iter().enumerate() {
                group_of[on.at] = place * GROUPS / on_planes.len();
            }
            let mut shifts: Vec<SVector<f64, 6>> = Vec::new();
            for group in 0..GROUPS {
                let on_wall: Vec<usize> =
                    on_wall.iter().copied().filter(|&at| group_of[at] != group).collect();
                let on_planes: Vec<OnPlane> =
                    on_planes.iter().copied().filter(|on| group_of[on.at] != group).collect();
                let fit = WallFit { rays, base: pair, on_wall: &on_wall, on_planes: &on_planes, deviations };
                shifts.push(pair.shift_to(&minimize::<UNKNOWNS, _>(&fit, pair, STEPS)));
            }
            let mean = shifts.iter().sum::<SVector<f64, 6>>() / GROUPS as f64;
            let scatter: Matrix6<f64> =
                shifts.iter().map(|shift| (shift - mean) * (shift - mean).transpose()).sum();
            // Both orders estimate the same.
            covariance += scatter * (0.5 * (GROUPS - 1) as f64 / GROUPS as f64);
        }
        let mut matches = on_wall;
        matches.extend(on_planes.iter().map(|on| on.at));
        matches.sort_unstable();
        matches.dedup();
        let sound = covariance.iter().all(|value| value.is_finite());
        sound.then_some(Measured { pair, matches, on_planes: on_planes.len(), covariance })
    }

    /// Centre of the second image in the first's frame.
    fn center(&self) -> Vector3<f64> {
        -(self.rotation.transpose() * self.translation)
    }

    /// Rotation in the second image's axes and shift of its centre to another pose.
    pub fn shift_to(&self, other: &Self) -> SVector<f64, 6> {
        let turn = Rigid::from_matrix(&(self.rotation * other.rotation.transpose()), Vector3::zeros());
        let (turn, shift) = (turn.rotation.scaled_axis(), other.center() - self.center());
        SVector::from([turn.x, turn.y, turn.z, shift.x, shift.y, shift.z])
    }
}

/// The poses of the second image, at a step of length one, that a wall leaves by itself, and the matches on it.
///
/// The covariances leave out the length, which nothing tells.
pub(crate) fn steps_by_wall(rays: &Bearings<'_>, seed: u64) -> Vec<(StepPose, Vec<usize>)> {
    let step = |wall: WallPair| {
        let measured = wall.scaled(1.0).measure(rays, rays.first.len(), &[], [0.0; PLANES])?;
        let first_from_second = measured.pair.second_from_first().inverse();
        let length = first_from_second.translation.norm();
        let step = StepPose { first_from_second, covariance: measured.covariance };
        Some((step.scaled(length.recip()), measured.matches))
    };
    WallPair::find(rays, seed).into_iter().filter_map(step).collect()
}

/// The poses of a homography of rays, its plane at distance one and seen in this direction.
fn decompose(homography: &Matrix3<f64>, seen: &Vector3<f64>) -> Vec<WallPair> {
    let svd = homography.svd(false, true);
    let Some(rows) = svd.v_t else { return Vec::new() };
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    let middle = svd.singular_values[order[1]];
    if middle <= 0.0 {
        return Vec::new();
    }
    let homography = homography / middle;
    let [s1, _, s3] = order.map(|at| (svd.singular_values[at] / middle).powi(2));
    let [v1, v2, v3] = order.map(|at| rows.row(at).transpose());
    if !(s1 - s3 > 1e-9) {
        return Vec::new();
    }
    let (a, b) = ((1.0 - s3).max(0.0).sqrt(), (s1 - 1.0).max(0.0).sqrt());
    let pose = |sign: f64| {
        let along = (v1 * a + v3 * (sign * b)) / (s1 - s3).sqrt();
        let normal = v2.cross(&along);
        let normal = if normal.dot(seen) < 0.0 { -normal } else { normal };
        let before = Matrix3::from_columns(&[v2, along, v2.cross(&along)]);
        let (first, second) = (homography * v2, homography * along);
        let after = Matrix3::from_columns(&[first, second, first.cross(&second)]);
        let rotation = after * before.transpose();
        let translation = (homography - rotation) * normal;
        WallPair { rotation, translation, normal, distance: 1.0, factors: [1.0; PLANES] }
    };
    [1.0, -1.0].into_iter().map(pose).filter(|pair| pair.translation.norm() > 0.0).collect()
}

/// A whitened residual along the parallax and across it, with the derivatives by the point in the second frame.
struct Residual {
    value: [f64; 2],
    rows: [Vector3<f64>; 2],
}

impl Residual {
    fn squared(&self) -> f64 {
        self.value[0].powi(2) + self.value[1].powi(2)
    }
}

struct WallFit<'a> {
    rays: &'a Bearings<'a>,
    /// Where the noise of the matches is judged.
    base: WallPair,
    on_wall: &'a [usize],
    on_planes: &'a [OnPlane],
    deviations: [f64; PLANES],
}

impl WallFit<'_> {
    /// Covariance of rotation and centre, scaled by the residuals where they are larger than stated.
    fn covariance(&self, pair: &WallPair) -> Option<Matrix6<f64>> {
        let (mut normal, mut squared) =
            (Normal::<UNKNOWNS> { matrix: SMatrix::zeros(), gradient: SVector::zeros() }, 0.0);
        self.accumulate(pair, &mut normal);
        let mut weights = 0.0;
        for residual in self.residuals(pair) {
            let (_, weight) = cauchy(residual.squared(), INVERSE_SCALE_SQUARED);
            squared += weight * residual.squared();
            weights += 2.0 * weight;
        }
        normal.matrix.fill_upper_triangle_with_lower_triangle();
        let inverse = normal.matrix.cholesky()?.inverse() * (squared / weights).max(1.0);
        // Turning the first's axes by ω on the left: R ← exp(ω)·R, centre −Rᵀ·t.
        let mut jacobian = SMatrix::<f64, 6, UNKNOWNS>::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-Matrix3::identity());
        let back = pair.rotation.transpose();
        jacobian.fixed_view_mut::<3, 3>(3, 0).copy_from(&-(back * pair.translation.cross_matrix()));
        jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(&-back);
        Some(jacobian * inverse * jacobian.transpose())
    }

    /// Of all matches that can be seen.
    fn residuals<'s>(&'s self, pair: &'s WallPair) -> impl Iterator<Item = Residual> + 's {
        let on_wall = self
            .on_wall
            .iter()
            .filter_map(|&at| Some(self.base.residual(self.rays, at, &pair.seen(&self.rays.first[at])?)));
        let on_planes = self
            .on_planes
            .iter()
            .map(|on| self.base.residual(self.rays, on.at, &pair.seen_on(self.rays, on)));
        on_wall.chain(on_planes)
    }

    fn priors(&self, pair: &WallPair) -> [(f64, f64); PLANES] {
        std::array::from_fn(|plane| {
            let deviation = if self.deviations[plane] > 0.0 { self.deviations[plane] } else { 1.0 };
            (pair.factors[plane].ln() / deviation, 1.0 / deviation)
        })
    }

    /// A scale that nothing tells stays where it is.
    fn gauge(&self, pair: &WallPair) -> Option<f64> {
        self.on_planes.is_empty().then(|| (pair.distance / self.base.distance).ln() / GAUGE)
    }
}

/// Standard deviation of the logarithm of a wall's distance where no known plane tells it.
const GAUGE: f64 = 1e-3;

impl LeastSquares<UNKNOWNS> for WallFit<'_> {
    type Model = WallPair;

    /// Parameters: R ← exp(ω)·R, t ← t + δ, the normal along its tangents, ln d, and the logarithms of the factors.
    fn accumulate(&self, pair: &WallPair, normal: &mut Normal<UNKNOWNS>) -> f64 {
        let mut cost = 0.0;
        let (u, v) = tangent_basis(&pair.normal);
        let mut add = |residual: &Residual, jacobian: &SMatrix<f64, 3, UNKNOWNS>| {
            let (loss, weight) = cauchy(residual.squared(), INVERSE_SCALE_SQUARED);
            cost += loss;
            for (value, row) in residual.value.into_iter().zip(residual.rows) {
                normal.add(value, &jacobian.tr_mul(&row), weight);
            }
        };
        for &at in self.on_wall {
            let first = &self.rays.first[at];
            let Some(seen) = pair.seen(first) else { continue };
            let residual = self.base.residual(self.rays, at, &seen);
            let inverse = pair.normal.dot(first) / pair.distance;
            let mut jacobian = SMatrix::<f64, 3, UNKNOWNS>::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-(pair.rotation * first).cross_matrix());
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&(Matrix3::identity() * inverse));
            jacobian.set_column(6, &(pair.translation * (u.dot(first) / pair.distance)));
            jacobian.set_column(7, &(pair.translation * (v.dot(first) / pair.distance)));
            jacobian.set_column(8, &-(pair.translation * inverse));
            add(&residual, &jacobian);
        }
        for on in self.on_planes {
            let seen = pair.seen_on(self.rays, on);
            let residual = self.base.residual(self.rays, on.at, &seen);
            let reached = seen - pair.translation;
            let mut jacobian = SMatrix::<f64, 3, UNKNOWNS>::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-reached.cross_matrix());
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
            jacobian.set_column(9 + on.plane, &reached);
            add(&residual, &jacobian);
        }
        let mut hold = |parameter: usize, value: f64, slope: f64| {
            let mut row = SVector::<f64, UNKNOWNS>::zeros();
            row[parameter] = slope;
            normal.add(value, &row, 1.0);
            cost += value * value;
        };
        for (plane, (value, slope)) in self.priors(pair).into_iter().enumerate() {
            hold(9 + plane, value, slope);
        }
        if let Some(value) = self.gauge(pair) {
            hold(8, value, 1.0 / GAUGE);
        }
        cost
    }

    fn cost(&self, pair: &WallPair) -> f64 {
        let hidden = self.on_wall.iter().any(|&at| pair.seen(&self.rays.first[at]).is_none());
        if hidden {
            return f64::INFINITY;
        }
        let matches: f64 =
            self.residuals(pair).map(|residual| cauchy(residual.squared(), INVERSE_SCALE_SQUARED).0).sum();
        let held: f64 = self.priors(pair).iter().map(|(value, _)| value * value).sum();
        matches + held + self.gauge(pair).map_or(0.0, |value| value * value)
    }

    fn step(&self, pair: &WallPair, delta: &SVector<f64, UNKNOWNS>) -> WallPair {
        let (u, v) = tangent_basis(&pair.normal);
        WallPair {
            rotation: turned(&pair.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: pair.translation + delta.fixed_rows::<3>(3),
            normal: (pair.normal + u * delta[6] + v * delta[7]).normalize(),
            distance: pair.distance * delta[8].exp(),
            factors: std::array::from_fn(|plane| pair.factors[plane] * delta[9 + plane].exp()),
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use rand::Rng;

    use super::*;
    use crate::synthetic::{normal, normal_vector, seeded};

    const SIGMA: f64 = 5e-4;

    struct Corner {
        first: Vec<Vector3<f64>>,
        second: Vec<Vector3<f64>>,
        sigmas: Vec<f64>,
        on_planes: Vec<OnPlane>,
        pose: Rigid,
    }

    impl Corner {
        /// A wall 28 ahead with 160 points and relief, 20 points of a wall at 6 to the left of it, after a step of 5.
        fn new(name: &str, noise: f64, relief: f64) -> Self {
            let mut rng = seeded(name);
            let turn = UnitQuaternion::from_euler_angles(0.02, 0.5, -0.03);
            let pose = Rigid::new(turn, -(turn * Vector3::new(0.4, -0.1, 5.0)));
            let mut corner = Self {
                first: Vec::new(),
                second: Vec::new(),
                sigmas: Vec::new(),
                on_planes: Vec::new(),
                pose,
            };
            for at in 0..180 {
                let [a, b]: [f64; 2] = [0; 2].map(|_| rng.random_range(-1.0..1.0));
                let mut point = if at < 160 {
                    Vector3::new(4.0 * a, 5.0 * b - 2.0, 28.0)
                } else {
                    Vector3::new(-6.0, 4.0 * b - 2.0, 25.0 + 2.0 * a)
                };
                let depth = point.norm();
                point *= 1.0 + relief * normal(&mut rng);
                corner
                    .first
                    .push((point.normalize() + normal_vector(&mut rng) * (noise * SIGMA)).normalize());
                let seen = pose.transform_point(&point).normalize();
                corner.second.push((seen + normal_vector(&mut rng) * (noise * SIGMA)).normalize());
                corner.sigmas.push(SIGMA);
                if at >= 160 {
                    corner.on_planes.push(OnPlane { at, plane: 0, depth });
                }
            }
            corner
        }

        fn measure(&self) -> Measured {
            let rays = Bearings {
                first: &self.first,
                second: &self.second,
                sigmas_first: &self.sigmas,
                sigmas_second: &self.sigmas,
            };
            let found = WallPair::find(&rays, 7);
            assert!(!found.is_empty());
            let measured = found
                .iter()
                .filter_map(|pair| pair.scaled(4.95).measure(&rays, 160, &self.on_planes, [0.03, 0.0]));
            // The wrong one of the two poses of a homography puts the known plane's points elsewhere.
            measured.max_by_key(|measured| measured.on_planes).unwrap()
        }

        /// Rotation about the second camera's axes and shift of its centre from the truth.
        fn error(&self, measured: &Measured) -> SVector<f64, 6> {
            let (found, truth) = (measured.pair.second_from_first().inverse(), self.pose.inverse());
            let turn = (truth.rotation.inverse() * found.rotation).scaled_axis();
            let shift = found.translation - truth.translation;
            SVector::from([turn.x, turn.y, turn.z, shift.x, shift.y, shift.z])
        }
    }

    #[test]
    fn exact_walls_give_the_pose_exactly() {
        let corner = Corner::new("exact wall", 0.0, 0.0);
        let measured = corner.measure();
        assert_eq!((measured.matches.len(), measured.on_planes), (180, 20));
        assert!(corner.error(&measured).norm() < 1e-5, "{}", corner.error(&measured));
        assert!((measured.pair.normal - Vector3::z()).norm() < 1e-5);
    }

    #[test]
    fn the_covariance_holds_the_error() {
        let trials = 40;
        let mut squared = 0.0;
        for trial in 0..trials {
            let corner = Corner::new(&format!("wall {trial}"), 1.0, 0.005);
            let measured = corner.measure();
            let error = corner.error(&measured);
            squared += error.dot(&(measured.covariance.try_inverse().unwrap() * error)) / 6.0;
        }
        let mean = squared / f64::from(trials);
        assert!((0.1..1.3).contains(&mean), "{mean}");
    }

    #[test]
    fn matches_of_no_wall_give_none() {
        let mut corner = Corner::new("no wall", 1.0, 0.0);
        let mut rng = seeded("shuffled");
        for second in &mut corner.second {
            *second = (Vector3::z() * 2.0 + normal_vector(&mut rng)).normalize();
        }
        let (rays, sigmas) = (&corner.first, &corner.sigmas);
        let rays =
            Bearings { first: rays, second: &corner.second, sigmas_first: sigmas, sigmas_second: sigmas };
        assert!(WallPair::find(&rays, 8).is_empty());
    }
}
