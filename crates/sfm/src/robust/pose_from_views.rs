//! The pose of a view by epipolar constraints with several whose poses are known.

use nalgebra::{Matrix3, SVector, Vector3};

use super::absolute_pose::turned;
use super::least_squares::{LeastSquares, Normal, cauchy, minimize};
use super::ransac::RansacParams;
use super::relative_pose::{RelativeMatches, SecondFromFirst, sampson_derivative};
use crate::Rigid;

/// A view whose pose is known, and what it shares with the one that is sought: unit bearings in either and their standard
/// deviations in radians, match by match.
#[derive(Debug, Clone)]
pub(crate) struct KnownView {
    pub world_from_camera: Rigid,
    pub bearings: Vec<Vector3<f64>>,
    pub sigmas: Vec<f64>,
    pub sought_bearings: Vec<Vector3<f64>>,
    pub sought_sigmas: Vec<f64>,
}

/// Refines the pose of a view by what it shares with views whose poses are known, none of which a third view has to see.
///
/// Levenberg–Marquardt on tangent Sampson errors with a Cauchy loss. Two views tell where the sought one is unless it stands in
/// line with them; each further one says whether that is so.
pub(crate) fn refine_pose_from_views(
    params: &RansacParams,
    views: &[KnownView],
    world_from_sought: &Rigid,
) -> Rigid {
    let constraints: Vec<Constraint<'_>> =
        views.iter().filter_map(|view| Constraint::new(params, view)).collect();
    if constraints.is_empty() {
        return *world_from_sought;
    }
    let sought_from_world = world_from_sought.inverse();
    let initial = SoughtFromWorld {
        rotation: sought_from_world.rotation.to_rotation_matrix().into_inner(),
        translation: sought_from_world.translation,
    };
    let refined = minimize::<6, _>(&FitToViews(&constraints), initial, 30);
    Rigid::from_matrix(&refined.rotation, refined.translation).inverse()
}

#[derive(Debug, Clone, Copy)]
struct SoughtFromWorld {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

struct Constraint<'a> {
    /// From the known view to the sought one.
    matches: RelativeMatches<'a>,
    world_from_known: Matrix3<f64>,
    center: Vector3<f64>,
}

impl<'a> Constraint<'a> {
    fn new(params: &RansacParams, view: &'a KnownView) -> Option<Self> {
        let KnownView { world_from_camera, bearings, sigmas, sought_bearings, sought_sigmas } = view;
        Some(Self {
            matches: RelativeMatches::new(params, bearings, sought_bearings, sigmas, sought_sigmas)?,
            world_from_known: world_from_camera.rotation.to_rotation_matrix().into_inner(),
            center: world_from_camera.translation,
        })
    }

    /// The relative pose, and the length of the baseline; `None` of two views in one place.
    fn sought_from_known(&self, sought: &SoughtFromWorld) -> Option<(SecondFromFirst, f64)> {
        let baseline = sought.rotation * self.center + sought.translation;
        let length = baseline.norm();
        let relative = SecondFromFirst {
            rotation: sought.rotation * self.world_from_known,
            translation: baseline / length,
        };
        (length > 0.0).then_some((relative, length))
    }
}

struct FitToViews<'v, 'a>(&'v [Constraint<'a>]);

impl LeastSquares<6> for FitToViews<'_, '_> {
    type Model = SoughtFromWorld;

    /// With b = R·c + t the baseline in the sought frame and R ← exp(δω)·R, t ← t + δt: δb = δω × (R·c) + δt; residuals depend
    /// on the direction of b only.
    fn accumulate(&self, model: &SoughtFromWorld, normal: &mut Normal<6>) -> f64 {
        let mut cost = 0.0;
        for constraint in self.0 {
            let Some((relative, length)) = constraint.sought_from_known(model) else { continue };
            let (data, along) = (&constraint.matches, &relative.translation);
            let arm = model.rotation * constraint.center;
            for (i, second) in data.second.iter().enumerate() {
                let term = data.sampson(&relative, i);
                let (turn, shift) = sampson_derivative(&term, second, along, data.variances[i]);
                let shift = (shift - along * along.dot(&shift)) / length;
                let turn = turn + arm.cross(&shift);
                let value = term.error / term.variance.sqrt();
                let (loss, weight) = cauchy(value * value, data.inverse_scale_squared);
                cost += loss;
                let row = SVector::<f64, 6>::from([turn.x, turn.y, turn.z, shift.x, shift.y, shift.z]);
                normal.add(value, &row, weight);
            }
        }
        cost
    }

    fn cost(&self, model: &SoughtFromWorld) -> f64 {
        let mut cost = 0.0;
        for constraint in self.0 {
            let Some((relative, _)) = constraint.sought_from_known(model) else { continue };
            let data = &constraint.matches;
            for i in 0..data.second.len() {
                cost += data.loss(&relative, i);
            }
        }
        cost
    }

    fn step(&self, model: &SoughtFromWorld, delta: &SVector<f64, 6>) -> SoughtFromWorld {
        SoughtFromWorld {
            rotation: turned(&model.rotation, &delta.fixed_rows::<3>(0).into_owned()),
            translation: model.translation + delta.fixed_rows::<3>(3),
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::synthetic::{perturb, random_unit, seeded};

    const SIGMA: f64 = 0.5 / 800.0;

    /// Views of a few places, each with points of its own in common with the sought one.
    fn views(centers: &[[f64; 3]], sought: &Rigid, rng: &mut ChaCha8Rng) -> Vec<KnownView> {
        let view = |center: &[f64; 3]| {
            let rotation = UnitQuaternion::from_scaled_axis(random_unit(rng));
            let world_from_camera = Rigid::new(rotation, Vector3::from(*center));
            let points: Vec<Vector3<f64>> = (0..40).map(|_| 4.0 * random_unit(rng)).collect();
            let mut seen = |from: &Rigid| -> Vec<Vector3<f64>> {
                let direction = |point| from.inverse_transform_point(point).normalize();
                points.iter().map(|point| perturb(rng, &direction(point), SIGMA)).collect()
            };
            KnownView {
                bearings: seen(&world_from_camera),
                sought_bearings: seen(sought),
                sigmas: vec![SIGMA; 40],
                sought_sigmas: vec![SIGMA; 40],
                world_from_camera,
            }
        };
        centers.iter().map(view).collect()
    }

    fn sought() -> Rigid {
        Rigid::new(UnitQuaternion::from_euler_angles(0.1, -2.0, 0.3), Vector3::new(0.6, 0.1, 0.8))
    }

    #[test]
    fn views_that_share_no_point_with_each_other_tell_the_pose() {
        let params = RansacParams { max_error_sigma: 6.0, ..RansacParams::default() };
        let centers = [[0.0; 3], [2.0, 0.1, 0.5], [0.7, -0.1, 2.5]];
        for seed in 0..50 {
            let mut rng = seeded(&format!("views {seed}"));
            let views = views(&centers, &sought(), &mut rng);
            let turn = UnitQuaternion::from_scaled_axis(0.03 * random_unit(&mut rng));
            let initial =
                Rigid::new(turn * sought().rotation, sought().translation + 0.1 * random_unit(&mut rng));
            let refined = refine_pose_from_views(&params, &views, &initial);
            let off = (refined.translation - sought().translation).norm();
            assert!(off < 0.01, "{off}");
            assert!(refined.rotation.angle_to(&sought().rotation) < 0.002, "{refined:?}");
        }
    }

    #[test]
    fn nothing_shared_leaves_the_pose() {
        let params = RansacParams::default();
        assert_eq!(refine_pose_from_views(&params, &[], &sought()), sought());
        let mut rng = seeded("in one place");
        let at = sought().translation;
        let here = views(&[[at.x, at.y, at.z]], &sought(), &mut rng);
        let refined = refine_pose_from_views(&params, &here, &sought());
        assert!(refined.translation.iter().all(|value| value.is_finite()), "{refined:?}");
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let mut rng = seeded("derivatives");
        let params = RansacParams { max_error_sigma: 6.0, ..RansacParams::default() };
        let views = views(&[[0.0; 3], [2.0, 0.1, 0.5]], &sought(), &mut rng);
        let constraints: Vec<Constraint<'_>> =
            views.iter().filter_map(|view| Constraint::new(&params, view)).collect();
        let fit = FitToViews(&constraints);
        let pose = sought().inverse();
        let model = SoughtFromWorld {
            rotation: turned(
                &pose.rotation.to_rotation_matrix().into_inner(),
                &Vector3::new(0.01, 0.02, 0.0),
            ),
            translation: pose.translation + Vector3::new(0.03, 0.0, -0.02),
        };
        let mut at = Normal::zeros();
        fit.accumulate(&model, &mut at);
        for axis in 0..6 {
            let moved = |by: f64| {
                let mut delta = SVector::<f64, 6>::zeros();
                delta[axis] = by;
                fit.cost(&fit.step(&model, &delta))
            };
            // The cost is the sum of ρ(r²), of which the gradient of ½ρ is accumulated.
            let expected = (moved(1e-6) - moved(-1e-6)) / 4e-6;
            assert!(
                (at.gradient[axis] - expected).abs() <= 1e-4 * expected.abs().max(1.0),
                "{axis}: {expected}"
            );
        }
    }
}
