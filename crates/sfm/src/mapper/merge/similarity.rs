use nalgebra::{SMatrix, SVector, UnitQuaternion, Vector3};

use super::crossing::{Crossing, Sides};
use crate::{
    Observation, PointId, Rigid, Similarity,
    mapper::model::Model,
    robust::{
        AngularResidual, GeneralizedPoseOptions, GeneralizedRay, RansacParams, estimate_generalized_pose,
        least_squares::{LeastSquares, Normal, cauchy, minimize},
    },
};

/// A ray of one component and the point of the other that it was matched with, each in its own frame.
#[derive(Debug, Clone, Copy)]
struct Sight {
    ray: GeneralizedRay,
    /// Distance to the point of its own component that the ray sees, when it sees one.
    own_distance: Option<f64>,
    point: Vector3<f64>,
}

/// What matches between two components say of the similarity: the rays of either to the points of the other.
#[derive(Debug, Clone, Default)]
pub(super) struct Sights {
    /// Rays of the moved component to points of the kept one.
    of_moved: Vec<Sight>,
    /// Rays of the kept component to points of the moved one.
    of_kept: Vec<Sight>,
}

/// Samples that one estimate may cost.
const MAX_SAMPLES: u32 = 5000;
/// Quantiles of the ratios of distances that are tried as scale where rays of one centre leave it open.
const SCALE_QUANTILES: [f64; 3] = [0.25, 0.5, 0.75];

impl Sights {
    /// The rays of these matches, each with every point once.
    pub fn collect<'c>(sides: &Sides<'_, '_>, crossings: impl Iterator<Item = &'c Crossing>) -> Self {
        let (mut of_moved, mut of_kept) = (Vec::new(), Vec::new());
        for crossing in crossings {
            of_moved.extend(crossing.kept_point.map(|id| (crossing.moved, id)));
            of_kept.extend(crossing.moved_point.map(|id| (crossing.kept, id)));
        }
        Self {
            of_moved: sights(of_moved, sides.moved, sides.kept),
            of_kept: sights(of_kept, sides.kept, sides.moved),
        }
    }

    /// Similarities kept_from_moved that samples of the rays of either side suggest.
    pub fn estimate(&self, params: &RansacParams, seed: u64) -> Vec<Similarity> {
        let params = RansacParams { max_iterations: MAX_SAMPLES, ..params.clone() };
        let mut found = estimate_side(&params, &self.of_moved, seed);
        let inverse = estimate_side(&params, &self.of_kept, seed ^ 0x5eed);
        found.extend(inverse.iter().map(Similarity::inverse));
        found
    }

    /// Levenberg–Marquardt on the rays of both sides, with a Cauchy loss.
    pub fn refine(&self, kept_from_moved: &Similarity, loss_sigma: f64) -> Similarity {
        minimize::<7, _>(&Fit::new(self, loss_sigma), Unknowns::new(kept_from_moved), 30).similarity()
    }

    /// Standard deviation of the logarithm of the scale; infinite where the rays leave it open.
    pub fn log_scale_sigma(&self, kept_from_moved: &Similarity, loss_sigma: f64) -> f64 {
        let mut normal = Normal { matrix: SMatrix::zeros(), gradient: SVector::zeros() };
        Fit::new(self, loss_sigma).accumulate(&Unknowns::new(kept_from_moved), &mut normal);
        let variance = normal.matrix.cholesky().map(|factor| factor.inverse()[(6, 6)]);
        variance.filter(|variance| variance.is_finite()).map_or(f64::INFINITY, f64::sqrt)
    }
}

fn sights(mut found: Vec<(Observation, PointId)>, of: &Model<'_>, to: &Model<'_>) -> Vec<Sight> {
    found.sort_unstable();
    found.dedup();
    let sight = |(seen, id): (Observation, PointId)| {
        let ray = of.world_ray(seen)?;
        let own = of.point_of(seen).and_then(|own| of.point(own));
        let ray = GeneralizedRay {
            origin: ray.origin,
            direction: ray.direction,
            sigma: ray.sigma,
            camera: seen.image.0,
        };
        Some(Sight {
            ray,
            own_distance: own.map(|own| (own.position - ray.origin).norm()),
            point: to.point(id)?.position,
        })
    };
    found.into_iter().filter_map(sight).collect()
}

/// Poses and scales of the component whose rays these are, in the frame of the points.
///
/// Rays of one centre leave the scale open; then both components' distances to what they see in common give it.
fn estimate_side(params: &RansacParams, sights: &[Sight], seed: u64) -> Vec<Similarity> {
    let rays: Vec<GeneralizedRay> = sights.iter().map(|sight| sight.ray).collect();
    let points: Vec<Vector3<f64>> = sights.iter().map(|sight| sight.point).collect();
    let options = GeneralizedPoseOptions::default();
    let Some(found) = estimate_generalized_pose(params, &rays, &points, &options, seed) else {
        return Vec::new();
    };
    let set = found.world_from_set;
    if found.scale_observable {
        return vec![set];
    }
    let agreeing = || found.inliers.iter().map(|&at| &sights[at as usize]);
    let Some(origin) = agreeing().next().map(|sight| sight.ray.origin) else { return Vec::new() };
    let center = set.transform_point(&origin);
    let ratio = |sight: &Sight| Some((sight.point - center).norm() / sight.own_distance?);
    let mut ratios: Vec<f64> =
        agreeing().filter_map(ratio).filter(|ratio| ratio.is_finite() && *ratio > 0.0).collect();
    if ratios.is_empty() {
        return Vec::new();
    }
    ratios.sort_by(f64::total_cmp);
    let of_scale = |quantile: &f64| {
        let scale = ratios[(quantile * (ratios.len() - 1) as f64).round() as usize];
        Similarity { scale, rotation: set.rotation, translation: center - set.rotation * origin * scale }
    };
    SCALE_QUANTILES.iter().map(of_scale).collect()
}

/// The similarity as x ↦ R·x + t of the kept frame and the scale s of the moved one: y_moved·s = R·x_kept + t.
///
/// So the unknowns act alike on the rays of both sides.
#[derive(Debug, Clone, Copy)]
struct Unknowns {
    axes: Rigid,
    scale: f64,
}

impl Unknowns {
    fn new(kept_from_moved: &Similarity) -> Self {
        let axes = Rigid::new(kept_from_moved.rotation, kept_from_moved.translation).inverse();
        Self { axes, scale: kept_from_moved.scale }
    }

    fn similarity(&self) -> Similarity {
        let inverse = self.axes.inverse();
        Similarity { scale: self.scale, rotation: inverse.rotation, translation: inverse.translation }
    }

    /// The matched point relative to the centre of a moved ray, up to scale, in the moved frame: R·X + t − s·o.
    fn seen_by_moved(&self, sight: &Sight) -> Vector3<f64> {
        self.axes.transform_point(&sight.point) - sight.ray.origin * self.scale
    }

    /// The same for a kept ray, in the kept frame: Rᵀ·(s·Y − t) − o.
    fn seen_by_kept(&self, sight: &Sight) -> Vector3<f64> {
        self.axes.inverse_transform_point(&(sight.point * self.scale)) - sight.ray.origin
    }
}

struct Fit<'a> {
    sights: &'a Sights,
    inverse_scale_squared: f64,
}

impl<'a> Fit<'a> {
    fn new(sights: &'a Sights, loss_sigma: f64) -> Self {
        Self { sights, inverse_scale_squared: loss_sigma.powi(-2) }
    }

    /// Weighs one residual; `column` maps its gradient by the target (3×1) to that by the unknowns (7×1).
    fn add(
        &self,
        sight: &Sight,
        target: &Vector3<f64>,
        column: impl Fn(&Vector3<f64>) -> SVector<f64, 7>,
        normal: &mut Normal<7>,
    ) -> f64 {
        let residual = AngularResidual::new(&sight.ray.direction, target, sight.ray.sigma);
        let (loss, weight) = cauchy(residual.value.norm_squared(), self.inverse_scale_squared);
        normal.add(residual.value.x, &column(&residual.rows.0), weight);
        normal.add(residual.value.y, &column(&residual.rows.1), weight);
        loss
    }
}

impl LeastSquares<7> for Fit<'_> {
    type Model = Unknowns;

    /// Parameters: R ← exp(δω)·R (3), t ← t + δt (3), s ← s·exp(δσ) (1).
    fn accumulate(&self, model: &Unknowns, normal: &mut Normal<7>) -> f64 {
        let mut cost = 0.0;
        for sight in &self.sights.of_moved {
            let (turned, shift) = (model.axes.rotation * sight.point, sight.ray.origin * model.scale);
            let column = |row: &Vector3<f64>| {
                let turn = turned.cross(row);
                SVector::from([turn.x, turn.y, turn.z, row.x, row.y, row.z, -row.dot(&shift)])
            };
            cost += self.add(sight, &model.seen_by_moved(sight), column, normal);
        }
        for sight in &self.sights.of_kept {
            let scaled = sight.point * model.scale;
            let arm = scaled - model.axes.translation;
            let column = |row: &Vector3<f64>| {
                let row = model.axes.rotation * row;
                let turn = row.cross(&arm);
                SVector::from([turn.x, turn.y, turn.z, -row.x, -row.y, -row.z, row.dot(&scaled)])
            };
            cost += self.add(sight, &model.seen_by_kept(sight), column, normal);
        }
        cost
    }

    fn cost(&self, model: &Unknowns) -> f64 {
        let loss = |sight: &Sight, target: Vector3<f64>| {
            let squared = AngularResidual::squared(&sight.ray.direction, &target, sight.ray.sigma.powi(-2));
            cauchy(squared, self.inverse_scale_squared).0
        };
        let moved = self.sights.of_moved.iter().map(|sight| loss(sight, model.seen_by_moved(sight)));
        let kept = self.sights.of_kept.iter().map(|sight| loss(sight, model.seen_by_kept(sight)));
        moved.chain(kept).sum()
    }

    fn step(&self, model: &Unknowns, delta: &SVector<f64, 7>) -> Unknowns {
        let turn = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned());
        Unknowns {
            axes: Rigid::new(
                turn * model.axes.rotation,
                model.axes.translation + delta.fixed_rows::<3>(3).into_owned(),
            ),
            scale: model.scale * delta[6].exp(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        GeneralizedProblem, normal_vector, perturb, random_unit, same_similarity, seeded,
    };
    use rand::Rng;

    /// Rays of three cameras on either side to points all around, with truth.
    fn problem(name: &str, sigma: f64) -> (Sights, Similarity) {
        let mut rng = seeded(name);
        let cameras: Vec<u32> = (0..60).map(|at| at % 3).collect();
        let forward = GeneralizedProblem::exact(&mut rng, &cameras, false);
        let truth = forward.world_from_set;
        let mut of_moved: Vec<Sight> = (forward.rays.iter().zip(&forward.points))
            .map(|(ray, point)| Sight { ray: *ray, own_distance: None, point: *point })
            .collect();
        let origins: Vec<Vector3<f64>> = (0..3).map(|_| normal_vector(&mut rng)).collect();
        let mut of_kept: Vec<Sight> = (0..60)
            .map(|at| {
                let camera = at % 3;
                let point = random_unit(&mut rng) * rng.random_range(1.0..8.0);
                let origin = origins[camera];
                let direction = (truth.transform_point(&point) - origin).normalize();
                let ray = GeneralizedRay { origin, direction, sigma: 1e-3, camera: camera as u32 };
                Sight { ray, own_distance: None, point }
            })
            .collect();
        for sight in of_moved.iter_mut().chain(&mut of_kept) {
            sight.ray.sigma = 1e-3;
            sight.ray.direction = perturb(&mut rng, &sight.ray.direction, sigma);
        }
        (Sights { of_moved, of_kept }, truth)
    }

    #[test]
    fn derivative_agrees_with_differences() {
        let (sights, truth) = problem("crossing derivative", 1e-3);
        let model = Unknowns::new(&truth);
        // So wide a loss that the cost is the sum of squares, whose gradient is twice the accumulated one.
        let fit = Fit::new(&sights, 1e6);
        let mut normal = Normal { matrix: SMatrix::zeros(), gradient: SVector::zeros() };
        fit.accumulate(&model, &mut normal);
        for k in 0..7 {
            let mut step = SVector::<f64, 7>::zeros();
            step[k] = 1e-6;
            let change = (fit.cost(&fit.step(&model, &step)) - fit.cost(&fit.step(&model, &-step))) / 2e-6;
            let scale = normal.gradient.norm();
            assert!((change - 2.0 * normal.gradient[k]).abs() < 1e-4 * scale, "{k}");
        }
    }

    #[test]
    fn exact_rays_of_both_sides_give_the_similarity() {
        let (sights, truth) = problem("crossing exact", 0.0);
        let all = sights.estimate(&RansacParams::default(), 3);
        assert!(!all.is_empty());
        assert!(all.iter().all(|found| same_similarity(&sights.refine(found, 1.0), &truth, 1e-9)));
    }

    #[test]
    fn both_sides_refine_better_than_one_and_state_the_error_of_scale() {
        let (mut both, mut one, mut stated) = (0.0, 0.0, 0.0);
        for round in 0..40 {
            let (sights, truth) = problem(&format!("crossing noise {round}"), 1e-3);
            let half = Sights { of_kept: Vec::new(), ..sights.clone() };
            let error = |found: &Similarity| (found.scale / truth.scale).ln().powi(2);
            let found = sights.refine(&truth, 1e3);
            both += error(&found);
            stated += sights.log_scale_sigma(&found, 1e3).powi(2);
            one += error(&half.refine(&truth, 1e3));
        }
        assert!(both < one);
        assert!((0.5..2.0).contains(&(both / stated)), "{both} {stated}");
    }

    #[test]
    fn one_centre_on_either_side_gives_scale_by_what_both_see() {
        let mut rng = seeded("one centre");
        let forward = GeneralizedProblem::exact(&mut rng, &[0; 40], false);
        let truth = forward.world_from_set;
        let moved_from_kept = truth.inverse();
        let of_moved: Vec<Sight> = (forward.rays.iter().zip(&forward.points))
            .map(|(ray, point)| {
                let own = moved_from_kept.transform_point(point);
                Sight { ray: *ray, own_distance: Some((own - ray.origin).norm()), point: *point }
            })
            .collect();
        let sights = Sights { of_moved, of_kept: Vec::new() };
        let all = sights.estimate(&RansacParams::default(), 4);
        assert!(!all.is_empty());
        assert!(all.iter().all(|found| same_similarity(found, &truth, 1e-6)));
        assert!(sights.log_scale_sigma(&truth, 1.0) > 1e3);
    }
}
