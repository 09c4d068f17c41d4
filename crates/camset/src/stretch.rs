//! Photos whose directions differ from what their intrinsics say.
//!
//! A photo that was cut from a stitched panorama has the panorama's stretch (`STITCHED_EQUIRECTANGULAR`), turned to where it looks;
//! no focal length says it. A stretch I + Q of all directions is, to a pinhole, other focal lengths and another principal point
//! ([`setloc_features::CameraModel::StitchedEquirectangular`] has the terms), which is also what a calibration of another focus or
//! temperature is off by. Before a wall such an error looks like a step aside and a turn back: a photo at 7 m from one is 0.06 m off by
//! 0.3 %, without a residual that stands out. All photos of a set together tell.

use nalgebra::{UnitQuaternion, Vector2};
use setloc_features::{Camera, ParamRole};
use setloc_sfm::Place;
use setloc_sfm::bundle::{BundleProblem, CameraPrior, IntrinsicsFreedom};

use crate::Scene;
use crate::refine::place_on;

/// Standard deviation of the terms that turn with the photo's heading. Panoramas of consumer cameras stretch by 0.2–0.6 %.
const SIGMA: f64 = 0.003;
/// Of the terms of a twist, which within a photo hardly differs from a turn of it, where the scene says nothing: by as much as one
/// panorama's differs from another's.
const TWIST_SIGMA: f64 = 0.0005;
/// And where it says that there is next to none.
const LEAST_TWIST_SIGMA: f64 = 1e-4;
/// Share of the cost that stretches must spare to be believed: true intrinsics of four rendered sets spare at most 0.8 %, those of
/// photos cut from panoramas of three real places mostly 4–16 %.
const LEAST_SPARED: f64 = 0.02;
/// And how much cost for every parameter, unless they are likely. Half is what noise spares.
const LEAST_PER_PARAMETER: f64 = 1.0;

/// Whether photos of known intrinsics may be stretched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PhotoStretch {
    /// They may, each standpoint by itself.
    pub is_free: bool,
    /// The scene's own panoramas are: those of one place are mostly of one kind.
    pub is_likely: bool,
    /// Standard deviation of the terms of their twist.
    pub twist_sigma: f64,
    /// The largest that was found, as a share.
    pub largest: f64,
}

impl Default for PhotoStretch {
    /// Of photos of which neither the scene nor they say anything.
    fn default() -> Self {
        Self { is_free: false, is_likely: false, twist_sigma: TWIST_SIGMA, largest: 0.0 }
    }
}

impl PhotoStretch {
    /// Of a photo alone, whose residuals hardly tell: it may where that is likely.
    pub fn of_one(scene: &Scene<'_>) -> Self {
        let stretched = scene.reconstruction.cameras.iter().filter(|camera| camera.is_stretched());
        let twists: Vec<f64> = stretched.flat_map(|camera| camera.twist().to_vec()).collect();
        let is_likely = !twists.is_empty();
        let mean_square = twists.iter().map(|term| term * term).sum::<f64>() / twists.len() as f64;
        let twist_sigma = if is_likely { mean_square.sqrt().max(LEAST_TWIST_SIGMA) } else { TWIST_SIGMA };
        Self { is_free: is_likely, is_likely, twist_sigma, largest: 0.0 }
    }

    /// Of a set, whose residuals are asked: well calibrated photos are four times as far off where they may be stretched.
    pub fn of_set(scene: &Scene<'_>) -> Self {
        Self { is_free: false, ..Self::of_one(scene) }
    }

    /// Whether these stretches spare more than noise would, and most poses alike.
    ///
    /// A photo that wrong matches have turned takes a stretch, too, and its neighbours give it theirs: of 24 photos before a café with
    /// equal flower boxes one had half of all that was spared, 0.33 of its own cost, and the middle one 0.008.
    pub fn is_worth(&self, freed: &Freed, as_told: &Costs, stretched: &Costs) -> bool {
        let spared = as_told.total - stretched.total;
        let parameters = freed.terms * freed.cameras.len();
        let enough = if self.is_likely { 0.0 } else { LEAST_PER_PARAMETER * parameters as f64 };
        spared > LEAST_SPARED * as_told.total
            && spared > enough
            && as_told.middle_share_spared(stretched) > LEAST_SPARED
    }

    /// Notes what an adjustment found.
    pub fn note(&mut self, problem: &BundleProblem, freed: &Freed) {
        self.is_free = true;
        self.largest =
            freed.cameras.iter().map(|&at| problem.cameras[at].largest_stretch()).fold(0.0, f64::max);
    }
}

/// What an adjustment costs.
#[derive(Debug, Clone)]
pub(crate) struct Costs {
    /// All of it.
    pub total: f64,
    /// That of the observations of each of the poses that are asked.
    pub by_pose: Vec<f64>,
}

impl Costs {
    /// The share of its own cost that another adjustment spares the middle one of the poses.
    fn middle_share_spared(&self, other: &Self) -> f64 {
        let share = |(own, other): (&f64, &f64)| if *own > 0.0 { 1.0 - other / own } else { 0.0 };
        let mut shares: Vec<f64> = self.by_pose.iter().zip(&other.by_pose).map(share).collect();
        shares.sort_by(f64::total_cmp);
        shares.get(shares.len() / 2).copied().unwrap_or(0.0)
    }
}

/// Which cameras of a problem are spheres that may be stretched.
#[derive(Debug, Default)]
pub(crate) struct Freed {
    cameras: Vec<usize>,
    /// Parameters that are estimated of each.
    terms: usize,
}

impl Freed {
    /// Gives each of these poses a camera of its own that sees all around and may be stretched; what they saw they see there.
    pub fn new(problem: &mut BundleProblem, sphere: &Camera, poses: &[usize], twist_sigma: f64) -> Self {
        let (mut freed, mut told) = (Self::default(), vec![None; problem.poses.len()]);
        let Some(stitched) = sphere.as_stitched() else { return freed };
        freed.terms = stitched.param_roles().iter().filter(|role| **role == ParamRole::Stretch).count();
        problem.camera_freedom.resize(problem.cameras.len(), IntrinsicsFreedom::FIXED);
        for &pose in poses {
            let at = problem.cameras.len();
            told[pose] = Some(std::mem::replace(&mut problem.poses[pose].camera, at as u32) as usize);
            problem.camera_priors.extend(prior(at, &stitched, twist_sigma));
            problem.camera_freedom.push(IntrinsicsFreedom::FREE);
            problem.cameras.push(stitched.clone());
            freed.cameras.push(at);
        }
        for seen in &mut problem.observations {
            let Some(camera) = told[seen.pose as usize].map(|camera| &problem.cameras[camera]) else {
                continue;
            };
            if camera == sphere {
                continue;
            }
            let place = Place { pixel: seen.pixel, noise_px: seen.noise_px };
            // What has no ray was no use before either.
            let nowhere = Place { pixel: Vector2::repeat(f64::NAN), noise_px: 1.0 };
            let there = place_on(sphere, camera, &UnitQuaternion::identity(), &place).unwrap_or(nowhere);
            (seen.pixel, seen.noise_px) = (there.pixel, there.noise_px);
        }
        freed
    }
}

/// What is known of a photo's stretch: as of a panorama that looks anywhere, ahead against the sides.
fn prior(at: usize, stitched: &Camera, twist_sigma: f64) -> Option<CameraPrior> {
    let mut prior = CameraPrior::of_usual_photo(at as u32, stitched)?;
    for (known, name) in prior.parameters.iter_mut().zip(stitched.model.param_names()) {
        match *name {
            "xx" | "xz" => known.sigma = SIGMA,
            "txx" | "txy" | "txz" | "tyz" | "tyy" => known.sigma = twist_sigma,
            _ => {}
        }
    }
    Some(prior)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use setloc_features::CameraModel;
    use setloc_sfm::Rigid;
    use setloc_sfm::bundle::{BundleObservation, BundlePose};

    use super::*;

    #[test]
    fn what_a_photo_saw_its_sphere_sees_in_the_same_direction_as_exactly() {
        let told = Camera {
            model: CameraModel::Opencv,
            width: 1600,
            height: 1200,
            params: vec![900.0, 905.0, 810.0, 590.0, -0.1, 0.02, 0.001, 0.0],
        };
        let sphere = Camera::equirectangular(4096, 2048);
        let pose = |camera| BundlePose {
            camera,
            world_from_camera: Rigid::new(UnitQuaternion::identity(), Vector3::zeros()),
            fixed: false,
        };
        let seen = |pose, pixel| BundleObservation { pose, point: 0, pixel, noise_px: 0.7 };
        let pixel = Vector2::new(1500.0, 200.0);
        let mut problem = BundleProblem {
            cameras: vec![told.clone(), sphere.clone()],
            poses: vec![pose(0), pose(0), pose(1)],
            observations: vec![
                seen(0, pixel),
                seen(1, pixel),
                seen(2, pixel),
                seen(0, Vector2::repeat(f64::NAN)),
            ],
            ..BundleProblem::default()
        };
        let before = problem.clone();
        let freed = Freed::new(&mut problem, &sphere, &[0, 2], TWIST_SIGMA);
        assert_eq!(freed.cameras, [2, 3]);
        assert_eq!(problem.poses.iter().map(|pose| pose.camera).collect::<Vec<_>>(), [2, 0, 3]);
        assert_eq!(problem.camera_freedom[..2], [IntrinsicsFreedom::FIXED; 2]);
        assert_eq!(problem.camera_priors.iter().map(|prior| prior.camera).collect::<Vec<_>>(), [2, 3]);
        let moved = &problem.observations[0];
        let (bearing, angle) = problem.cameras[2].ray(&moved.pixel).unwrap();
        let (expected, pixel_angle) = told.ray(&pixel).unwrap();
        assert!((bearing - expected).norm() < 1e-12);
        assert!((angle * moved.noise_px / (pixel_angle * 0.7) - 1.0).abs() < 1e-9);
        assert_eq!(problem.observations[1..3], before.observations[1..3]);
        assert!(problem.observations[3].pixel.x.is_nan());
    }

    #[test]
    fn noise_is_not_worth_a_stretch_that_nothing_else_speaks_for() {
        let freed = Freed { cameras: vec![3, 4], terms: 4 };
        let (unlikely, likely) =
            (PhotoStretch::default(), PhotoStretch { is_likely: true, ..PhotoStretch::default() });
        // Two poses of equal cost.
        let costs = |total: f64| Costs { total, by_pose: vec![total / 2.0; 2] };
        for stretch in [unlikely, likely] {
            assert!(stretch.is_worth(&freed, &costs(300.0), &costs(290.0)));
            assert!(!stretch.is_worth(&freed, &costs(3000.0), &costs(2945.0)), "not two percent");
        }
        assert!(
            !unlikely.is_worth(&freed, &costs(300.0), &costs(293.0)),
            "not a unit for each of eight parameters"
        );
        assert!(likely.is_worth(&freed, &costs(300.0), &costs(293.0)));
    }

    #[test]
    fn what_one_photo_gains_speaks_for_no_stretch_of_all() {
        let freed = Freed { cameras: vec![3, 4, 5], terms: 4 };
        let (told, mut stretched) = (
            Costs { total: 900.0, by_pose: vec![300.0, 300.0, 300.0] },
            Costs { total: 800.0, by_pose: vec![298.0, 202.0, 298.0] },
        );
        for stretch in [PhotoStretch::default(), PhotoStretch { is_likely: true, ..PhotoStretch::default() }]
        {
            assert!(!stretch.is_worth(&freed, &told, &stretched));
        }
        stretched.by_pose = vec![270.0, 250.0, 280.0];
        assert!(PhotoStretch::default().is_worth(&freed, &told, &stretched));
    }
}
