//! A [`BundleProblem`] as a [`Model`]: angular residuals, poses of 6 scalars, intrinsics as extra blocks.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use rayon::prelude::*;
use setloc_features::{Camera, CameraModel, MAX_CAMERA_PARAMS, ParamRole, PlainRay, UnprojectJacobian};

use super::normal_equations::{BlockTerm, ExtraTerm, Linearized, Link, Model, Structure};
use super::pattern::NONE;
use super::residual::{angular, angular_squared, bearing_change, point_row, rotation_row};
use super::{
    BundleObservation, BundleProblem, CameraPrior, IntrinsicsFreedom, ParameterEstimate, RobustLoss,
};
use crate::Rigid;

/// Scalars of a pose: rotation (right perturbation, camera frame), then translation (world frame).
pub(super) const POSE_DIM: usize = 6;

/// Observations that are worth handing to another thread.
const OBSERVATIONS_PER_TASK: usize = 2048;

/// A pose as the inner loops want it.
#[derive(Debug, Clone, Copy)]
struct PoseState {
    world_from_camera: Rigid,
    rotation: Matrix3<f64>,
}

impl PoseState {
    fn new(world_from_camera: Rigid) -> Self {
        Self { world_from_camera, rotation: *world_from_camera.rotation.to_rotation_matrix().matrix() }
    }

    #[inline]
    fn camera_point(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.tr_mul(&(point - self.world_from_camera.translation))
    }
}

/// One observation.
#[derive(Debug, Clone, Copy)]
struct Ray {
    pose: u32,
    /// Bearing and 1/σ while the intrinsics stay as they were at the start.
    bearing: Vector3<f64>,
    inverse_sigma: f64,
}

impl Ray {
    /// Stands for an observation that cannot be used.
    const UNUSABLE: Self = Self { pose: NONE, bearing: Vector3::new(0.0, 0.0, 0.0), inverse_sigma: 0.0 };

    fn is_usable(&self) -> bool {
        self.pose != NONE
    }
}

/// Pixel and camera of an observation whose intrinsics are estimated.
#[derive(Debug, Clone, Copy)]
struct PixelRay {
    camera: u32,
    pixel: Vector2<f64>,
    noise_px: f64,
    /// What does not change of the ray of a stretched panorama.
    plain: Option<PlainRay>,
}

impl PixelRay {
    fn unproject(&self, camera: &Camera) -> Option<UnprojectJacobian> {
        match &self.plain {
            Some(plain) => Some(camera.unproject_plain(plain)),
            None => camera.unproject_with_jacobian(&self.pixel),
        }
    }

    /// As [`bearing_and_weight`].
    fn bearing_and_weight(&self, camera: &Camera) -> Option<(Vector3<f64>, f64)> {
        let Some(plain) = &self.plain else { return bearing_and_weight(camera, &self.pixel, self.noise_px) };
        let (bearing, pixel_angle) = camera.ray_of_plain(plain);
        Some((bearing, 1.0 / (pixel_angle * self.noise_px)))
    }
}

/// A usable prior on a free pose.
#[derive(Debug, Clone, Copy)]
struct Prior {
    pose: u32,
    position: Vector3<f64>,
    inverse_sigma: Vector3<f64>,
    loss: RobustLoss,
}

/// A camera of which parameters are estimated.
#[derive(Debug, Clone)]
struct FreeIntrinsics {
    camera: u32,
    /// Ascending.
    parameters: Vec<usize>,
    /// The current camera with each of them moved a little.
    moved: Vec<MovedCamera>,
}

impl FreeIntrinsics {
    fn new(index: usize, camera: &Camera, parameters: Vec<usize>) -> Self {
        let mut free = Self { camera: index as u32, parameters, moved: Vec::new() };
        free.refresh(camera);
        free
    }

    fn refresh(&mut self, camera: &Camera) {
        let moved = |&parameter: &usize| MovedCamera::new(camera, parameter);
        self.moved = self.parameters.iter().map(moved).collect();
    }
}

/// A camera one of whose parameters is moved by `by`.
#[derive(Debug, Clone)]
struct MovedCamera {
    camera: Camera,
    by: f64,
}

impl MovedCamera {
    fn new(camera: &Camera, parameter: usize) -> Self {
        let mut camera = camera.clone();
        let by = 1e-6 * camera.params[parameter].abs().max(1.0);
        camera.params[parameter] += by;
        Self { camera, by }
    }

    /// ∂ ln(pixel angle)/∂parameter of a pixel whose bearing moves by `d_bearing`; without it a focal length far off does
    /// not find its way.
    fn d_log_pixel_angle(&self, bearing: &Vector3<f64>, d_bearing: &Vector3<f64>, pixel_angle: f64) -> f64 {
        let moved = self.camera.pixel_angle_towards(&(bearing + d_bearing * self.by));
        moved.map_or(0.0, |after| (after - pixel_angle) / (pixel_angle * self.by))
    }
}

/// What is known beforehand of free parameters of a camera: Σ cᵢ pᵢ = v.
#[derive(Debug, Clone)]
struct ParameterPrior {
    camera: usize,
    extra: usize,
    /// Place among the free parameters, the parameter, and its coefficient over σ.
    terms: Vec<(usize, usize, f64)>,
    /// v/σ.
    value: f64,
    loss: RobustLoss,
}

impl ParameterPrior {
    /// (Σ cᵢ pᵢ − v)/σ.
    fn residual(&self, cameras: &[Camera]) -> f64 {
        let params = &cameras[self.camera].params;
        self.terms.iter().map(|&(_, parameter, weight)| params[parameter] * weight).sum::<f64>() - self.value
    }

    /// Those of a camera whose free parameters are an extra block.
    fn of_camera(prior: &CameraPrior, camera: &Camera, extra: usize, free: &[usize]) -> Vec<Self> {
        let (index, loss) = (prior.camera as usize, prior.loss);
        let of_one = |(at, &parameter): (usize, &usize)| {
            let ParameterEstimate { value, sigma } = prior.parameters[parameter];
            let terms = vec![(at, parameter, 1.0 / sigma)];
            sigma.is_finite().then(|| Self { camera: index, extra, terms, value: value / sigma, loss })
        };
        let mut priors: Vec<Self> = free.iter().enumerate().filter_map(of_one).collect();
        let focal = focal_parameters(camera.model);
        if focal.len() == 2 && free.starts_with(&[0, 1]) && prior.aspect_sigma.is_finite() {
            let weight = 1.0 / (prior.aspect_sigma * camera.focal_length());
            priors.push(Self {
                camera: index,
                extra,
                terms: vec![(0, 0, weight), (1, 1, -weight)],
                value: 0.0,
                loss,
            });
        }
        priors
    }
}

/// The problem, compacted to what is used, with current and candidate state of the camera side.
pub(super) struct Spherical {
    loss: RobustLoss,
    rays: Vec<Ray>,
    /// Parallel to `rays` when any intrinsics are free, else empty; `None` where the bearing does not depend on them.
    pixel_rays: Vec<Option<PixelRay>>,
    poses: Vec<PoseState>,
    candidate_poses: Vec<PoseState>,
    /// Poses of the blocks, ascending.
    pose_of_block: Vec<u32>,
    block_of_pose: Vec<u32>,
    cameras: Vec<Camera>,
    candidate_cameras: Vec<Camera>,
    /// Per extra block.
    intrinsics: Vec<FreeIntrinsics>,
    priors: Vec<Prior>,
    parameter_priors: Vec<ParameterPrior>,
}

/// How a problem maps to unknowns.
pub(super) struct Layout {
    pub structure: Structure,
    /// Index in the problem of each compacted point.
    pub point_of_index: Vec<u32>,
    pub ignored: usize,
    /// Scalar residuals of the priors that are used.
    pub prior_residuals: usize,
}

impl Prior {
    /// (t − p)/σ.
    fn residual(&self, poses: &[PoseState]) -> Vector3<f64> {
        let offset = poses[self.pose as usize].world_from_camera.translation - self.position;
        offset.component_mul(&self.inverse_sigma)
    }
}

impl Spherical {
    /// Drops what is unusable or unused and sorts the rest by point.
    pub fn new(problem: &BundleProblem, loss: RobustLoss) -> (Self, Layout) {
        let pose_usable: Vec<bool> = problem
            .poses
            .iter()
            .map(|pose| {
                let Rigid { rotation, translation } = pose.world_from_camera;
                (pose.camera as usize) < problem.cameras.len()
                    && rotation.coords.iter().chain(translation.iter()).all(|value| value.is_finite())
            })
            .collect();
        let usable_ray = |observation: &BundleObservation| {
            if !*pose_usable.get(observation.pose as usize)? {
                return None;
            }
            let point = problem.points.get(observation.point as usize)?.position;
            let camera = &problem.cameras[problem.poses[observation.pose as usize].camera as usize];
            if !(point.x + point.y + point.z).is_finite() {
                return None;
            }
            let (bearing, inverse_sigma) =
                bearing_and_weight(camera, &observation.pixel, observation.noise_px)?;
            Some(Ray { pose: observation.pose, bearing, inverse_sigma })
        };
        let mut given: Vec<Ray> = problem
            .observations
            .par_iter()
            .with_min_len(OBSERVATIONS_PER_TASK)
            .map(|observation| usable_ray(observation).unwrap_or(Ray::UNUSABLE))
            .collect();
        let by_pixel = given.len();
        let usable_bearing = |seen: &super::BundleBearing| {
            let point = problem.points.get(seen.point as usize)?.position;
            let sound = *pose_usable.get(seen.pose as usize)?
                && (point.x + point.y + point.z).is_finite()
                && (seen.bearing.norm_squared() - 1.0).abs() < 1e-9
                && seen.sigma.is_finite()
                && seen.sigma > 0.0;
            sound.then(|| Ray { pose: seen.pose, bearing: seen.bearing, inverse_sigma: 1.0 / seen.sigma })
        };
        given.extend(problem.bearings.iter().map(|seen| usable_bearing(seen).unwrap_or(Ray::UNUSABLE)));
        let point_of = |index: u32| match problem.observations.get(index as usize) {
            Some(observation) => observation.point as usize,
            None => problem.bearings[index as usize - by_pixel].point as usize,
        };

        // Counting sort by point; within a point the order given stays.
        let mut starts = vec![0_u32; problem.points.len() + 1];
        let mut is_block = vec![false; problem.poses.len()];
        // A camera without observations is no unknown.
        let mut is_seen = vec![false; problem.cameras.len()];
        for (index, ray) in (0..).zip(&given).filter(|(_, ray)| ray.is_usable()) {
            starts[point_of(index) + 1] += 1;
            is_block[ray.pose as usize] = true;
            if (index as usize) < by_pixel {
                is_seen[problem.poses[ray.pose as usize].camera as usize] = true;
            }
        }
        let usable = starts.iter().map(|&count| count as usize).sum::<usize>();
        let mut points = Vec::new();
        let (mut free, mut point_of_index, mut compact) =
            (Vec::new(), Vec::new(), vec![NONE; problem.points.len()]);
        for (index, point) in problem.points.iter().enumerate() {
            if starts[index + 1] > 0 {
                compact[index] = points.len() as u32;
                points.push(point.position);
                free.push(!point.fixed);
                point_of_index.push(index as u32);
            }
            starts[index + 1] += starts[index];
        }
        let mut order = vec![0_u32; usable];
        for (index, _) in (0..).zip(&given).filter(|(_, ray)| ray.is_usable()) {
            let start = &mut starts[point_of(index)];
            order[*start as usize] = index;
            *start += 1;
        }

        let mut ignored = given.len() - usable;
        let mut priors = Vec::new();
        for prior in &problem.position_priors {
            let pose = prior.pose as usize;
            let valid = pose_usable.get(pose) == Some(&true)
                && (prior.position.x + prior.position.y + prior.position.z).is_finite()
                && prior.sigma.iter().all(|sigma| *sigma > 0.0)
                && prior.loss.is_valid();
            if !valid {
                ignored += 1;
            } else if !problem.poses[pose].fixed {
                is_block[pose] = true;
                priors.push(Prior {
                    pose: prior.pose,
                    position: prior.position,
                    inverse_sigma: prior.sigma.map(f64::recip),
                    loss: prior.loss,
                });
            }
        }
        let mut block_of_pose = vec![NONE; problem.poses.len()];
        let mut pose_of_block = Vec::new();
        for (index, pose) in problem.poses.iter().enumerate() {
            if is_block[index] && !pose.fixed {
                block_of_pose[index] = pose_of_block.len() as u32;
                pose_of_block.push(index as u32);
            }
        }

        let (mut intrinsics, mut extra_of_camera) = (Vec::new(), vec![NONE; problem.cameras.len()]);
        for (index, camera) in problem.cameras.iter().enumerate().filter(|&(index, _)| is_seen[index]) {
            let freedom = problem.camera_freedom.get(index).copied().unwrap_or(IntrinsicsFreedom::FIXED);
            let parameters = free_parameters(camera, freedom);
            if !parameters.is_empty() {
                extra_of_camera[index] = intrinsics.len() as u32;
                intrinsics.push(FreeIntrinsics::new(index, camera, parameters));
            }
        }

        let mut parameter_priors = Vec::new();
        for prior in &problem.camera_priors {
            let camera = prior.camera as usize;
            if !prior.fits(problem.cameras.get(camera)) {
                ignored += 1;
                continue;
            }
            let extra = extra_of_camera[camera] as usize;
            if let Some(FreeIntrinsics { parameters, .. }) = intrinsics.get(extra) {
                let camera = &problem.cameras[camera];
                parameter_priors.extend(ParameterPrior::of_camera(prior, camera, extra, parameters));
            }
        }

        let link = |index: u32| {
            let ray = given[index as usize];
            let camera = problem.poses[ray.pose as usize].camera;
            // What is given as a bearing does not depend on a camera.
            let by_pixel = (index as usize) < by_pixel;
            Link {
                point: compact[point_of(index)],
                block: block_of_pose[ray.pose as usize],
                extra: if by_pixel { extra_of_camera[camera as usize] } else { NONE },
            }
        };
        let pixel_ray = |&index: &u32| {
            let &BundleObservation { pose, pixel, noise_px, .. } =
                problem.observations.get(index as usize)?;
            let camera = problem.poses[pose as usize].camera;
            let plain = problem.cameras[camera as usize].plain_ray(&pixel);
            Some(PixelRay { camera, pixel, noise_px, plain })
        };
        let in_order = || order.par_iter().with_min_len(4 * OBSERVATIONS_PER_TASK);
        let (mut links, mut rays) = (Vec::new(), Vec::new());
        in_order().map(|&index| (link(index), given[index as usize])).unzip_into_vecs(&mut links, &mut rays);
        let pixel_rays = if intrinsics.is_empty() { Vec::new() } else { in_order().map(pixel_ray).collect() };

        let poses: Vec<_> = problem.poses.iter().map(|pose| PoseState::new(pose.world_from_camera)).collect();
        let structure = Structure {
            links,
            points,
            free,
            block_count: pose_of_block.len(),
            extra_dims: intrinsics.iter().map(|free| free.parameters.len()).collect(),
        };
        let prior_residuals = 3 * priors.len() + parameter_priors.len();
        let layout = Layout { structure, point_of_index, ignored, prior_residuals };
        let model = Self {
            loss,
            rays,
            pixel_rays,
            candidate_poses: poses.clone(),
            poses,
            pose_of_block,
            block_of_pose,
            candidate_cameras: problem.cameras.clone(),
            cameras: problem.cameras.clone(),
            intrinsics,
            priors,
            parameter_priors,
        };
        (model, layout)
    }

    /// Block of a pose, when it is an unknown.
    pub fn block_of_pose(&self, pose: u32) -> Option<usize> {
        self.block_of_pose.get(pose as usize).filter(|&&block| block != NONE).map(|&block| block as usize)
    }

    /// Writes the current state of everything that is free.
    pub fn store(&self, problem: &mut BundleProblem) {
        for &pose in &self.pose_of_block {
            problem.poses[pose as usize].world_from_camera = self.poses[pose as usize].world_from_camera;
        }
        for &FreeIntrinsics { camera, .. } in &self.intrinsics {
            problem.cameras[camera as usize].clone_from(&self.cameras[camera as usize]);
        }
    }
}

impl Model<POSE_DIM> for Spherical {
    fn loss(&self) -> RobustLoss {
        self.loss
    }

    #[inline]
    fn linearize(
        &self,
        observation: usize,
        link: &Link,
        point: &Vector3<f64>,
        out: &mut Linearized<POSE_DIM>,
    ) {
        let ray = &self.rays[observation];
        let pose = &self.poses[ray.pose as usize];
        let (mut bearing, mut weight) = (ray.bearing, ray.inverse_sigma);
        let mut jacobian = None;
        if link.extra != NONE
            && let Some(seen) = &self.pixel_rays[observation]
            && let Some(of_camera) = seen.unproject(&self.cameras[seen.camera as usize])
        {
            bearing = of_camera.bearing;
            let pixel_angle = of_camera.pixel_angle();
            weight = 1.0 / (pixel_angle * seen.noise_px);
            jacobian = Some((of_camera, pixel_angle, seen.plain.is_some()));
        }
        let x = pose.camera_point(point);
        let angular = angular(&bearing, &x);
        out.extra = [[0.0; MAX_CAMERA_PARAMS]; 2];
        for row in 0..2 {
            out.residual[row] = weight * angular.residual[row];
            let m = angular.wrt_camera_point[row] * weight;
            let by_point = point_row(&m, &pose.rotation);
            out.point[row] = by_point.into();
            if link.block != NONE {
                let by_rotation = rotation_row(&m, &x);
                out.block[row] =
                    [by_rotation.x, by_rotation.y, by_rotation.z, -by_point.x, -by_point.y, -by_point.z];
            }
        }
        if let Some((jacobian, pixel_angle, is_panorama)) = jacobian {
            let FreeIntrinsics { parameters, moved, .. } = &self.intrinsics[link.extra as usize];
            for (k, (&parameter, moved)) in parameters.iter().zip(moved).enumerate() {
                let db = jacobian.d_params.column(parameter).into_owned();
                let change = bearing_change(&bearing, &angular.direction, &db);
                // A stretch of a percent changes what a pixel spans by a percent, and where it looks by many pixels.
                let log_sigma =
                    if is_panorama { 0.0 } else { moved.d_log_pixel_angle(&bearing, &db, pixel_angle) };
                for row in 0..2 {
                    out.extra[row][k] =
                        weight * angular.wrt_direction[row].dot(&change) - out.residual[row] * log_sigma;
                }
            }
        }
    }

    #[inline]
    fn squared_residual(&self, observation: usize, point: &Vector3<f64>) -> f64 {
        let ray = &self.rays[observation];
        let (mut bearing, mut weight) = (ray.bearing, ray.inverse_sigma);
        if let Some(Some(seen)) = self.pixel_rays.get(observation) {
            match seen.bearing_and_weight(&self.candidate_cameras[seen.camera as usize]) {
                Some(of_camera) => (bearing, weight) = of_camera,
                // The candidate intrinsics lost a pixel: no valid state.
                None => return f64::INFINITY,
            }
        }
        let x = self.candidate_poses[ray.pose as usize].camera_point(point);
        angular_squared(&bearing, &x) * (weight * weight)
    }

    fn linearize_block_terms(&self, add: BlockTerm<'_, POSE_DIM>) -> f64 {
        let mut cost = 0.0;
        for prior in &self.priors {
            let r = prior.residual(&self.poses);
            let (rho, weight) = prior.loss.evaluate(r.norm_squared());
            cost += 0.5 * rho;
            let (mut hessian, mut gradient) = ([[0.0; 6]; 6], [0.0; 6]);
            for k in 0..3 {
                hessian[3 + k][3 + k] = weight * prior.inverse_sigma[k].powi(2);
                gradient[3 + k] = weight * prior.inverse_sigma[k] * r[k];
            }
            add(self.block_of_pose[prior.pose as usize] as usize, &hessian, &gradient);
        }
        cost
    }

    fn linearize_extra_terms(&self, add: ExtraTerm<'_>) -> f64 {
        let mut cost = 0.0;
        for prior in &self.parameter_priors {
            let r = prior.residual(&self.cameras);
            let (rho, weight) = prior.loss.evaluate(r * r);
            cost += 0.5 * rho;
            for &(row, _, by_row) in &prior.terms {
                let by_row = weight * by_row;
                let mut of_row = prior.terms.iter().map(|(at, _, by_column)| (*at, by_row * by_column));
                add(prior.extra, row, r * by_row, &mut of_row);
            }
        }
        cost
    }

    fn prior_cost(&self) -> f64 {
        let of_pose =
            |prior: &Prior| 0.5 * prior.loss.evaluate(prior.residual(&self.candidate_poses).norm_squared()).0;
        let of_parameter = |prior: &ParameterPrior| {
            0.5 * prior.loss.evaluate(prior.residual(&self.candidate_cameras).powi(2)).0
        };
        let of_poses: f64 = self.priors.iter().map(of_pose).sum();
        of_poses + self.parameter_priors.iter().map(of_parameter).sum::<f64>()
    }

    fn propose(&mut self, step: &[f64]) -> bool {
        for (block, &pose) in self.pose_of_block.iter().enumerate() {
            let step = &step[block * POSE_DIM..(block + 1) * POSE_DIM];
            let current = &self.poses[pose as usize].world_from_camera;
            let turn = UnitQuaternion::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
            let rotation = UnitQuaternion::new_normalize((current.rotation * turn).into_inner());
            let translation = current.translation + Vector3::new(step[3], step[4], step[5]);
            self.candidate_poses[pose as usize] = PoseState::new(Rigid::new(rotation, translation));
        }
        let mut next = self.pose_of_block.len() * POSE_DIM;
        for FreeIntrinsics { camera, parameters, .. } in &self.intrinsics {
            let (current, candidate) =
                (&self.cameras[*camera as usize], &mut self.candidate_cameras[*camera as usize]);
            for &parameter in parameters {
                candidate.params[parameter] = current.params[parameter] + step[next];
                next += 1;
            }
            let focal = focal_parameters(candidate.model);
            let sane = candidate.params.iter().all(|value| value.is_finite())
                && candidate.params[focal].iter().all(|&focal| focal > 0.0);
            if !sane || candidate.validate().is_err() {
                return false;
            }
        }
        true
    }

    fn accept(&mut self) {
        for &pose in &self.pose_of_block {
            self.poses[pose as usize] = self.candidate_poses[pose as usize];
        }
        for free in &mut self.intrinsics {
            let camera = &mut self.cameras[free.camera as usize];
            camera.params.copy_from_slice(&self.candidate_cameras[free.camera as usize].params);
            free.refresh(camera);
        }
    }

    fn squared_norm(&self) -> f64 {
        let of_pose =
            |&pose: &u32| 1.0 + self.poses[pose as usize].world_from_camera.translation.norm_squared();
        self.pose_of_block.iter().map(of_pose).sum()
    }
}

/// Bearing and 1/σ of a pixel, or `None` when they are no finite positive numbers.
pub(super) fn bearing_and_weight(
    camera: &Camera,
    pixel: &Vector2<f64>,
    noise_px: f64,
) -> Option<(Vector3<f64>, f64)> {
    if !(pixel.x.is_finite() && pixel.y.is_finite() && noise_px.is_finite() && noise_px > 0.0) {
        return None;
    }
    let (bearing, pixel_angle) = camera.ray(pixel)?;
    let weight = 1.0 / (pixel_angle * noise_px);
    (bearing.norm_squared().is_finite() && weight.is_finite() && weight > 0.0).then_some((bearing, weight))
}

/// Focal lengths within the parameters.
fn focal_parameters(model: CameraModel) -> std::ops::Range<usize> {
    match model {
        CameraModel::Equirectangular | CameraModel::StitchedEquirectangular => 0..0,
        CameraModel::Pinhole | CameraModel::Opencv | CameraModel::OpencvFisheye => 0..2,
        _ => 0..1,
    }
}

/// Indices of the parameters that are estimated, ascending.
fn free_parameters(camera: &Camera, freedom: IntrinsicsFreedom) -> Vec<usize> {
    if camera.is_panoramic() {
        let roles = camera.param_roles().iter().enumerate();
        let of_stretch = roles.filter(|(_, role)| **role == ParamRole::Stretch && freedom.distortion);
        return of_stretch.map(|(index, _)| index).collect();
    }
    let focal = focal_parameters(camera.model);
    let principal = focal.end..focal.end + 2;
    let end = camera.params.len().min(MAX_CAMERA_PARAMS);
    (0..end)
        .filter(|index| {
            (focal.contains(index) && freedom.focal)
                || (principal.contains(index) && freedom.principal_point)
                || (*index >= principal.end && freedom.distortion)
        })
        .collect()
}
