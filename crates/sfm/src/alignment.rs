//! Alignment of tracks by their images: keypoints of one point placed where they show the same spot.
//!
//! A detector locates a keypoint on each image alone, to 0.04 of its size. What the adjustment needs is only that the
//! observations of a point agree with *one another*. So of each track one view is the reference, a patch around its
//! keypoint is cut out, and the same patch is sought in the other views near their keypoints ([`setloc_features::Template`]),
//! with the shape that a plane facing the viewers would have there. Then everything is adjusted once more, each
//! observation with its own standard deviation.
//!
//! Tracks, features and points stay what they are; poses, points and free intrinsics move.

use std::cmp::Ordering;
use std::sync::Arc;

use nalgebra::{Matrix2, Matrix3x2, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{Aligned, ImageFeatures, ImagePyramid, Patch, PatchFrame, PatchParams, Rays, Template};

use crate::{
    ImageId, Observation, Reconstruction, Rigid,
    bundle::{
        self, BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, IntrinsicsFreedom,
        RobustLoss,
    },
    mapper::MIN_ADJUSTABLE_POINTS,
    solvers::tangent_basis,
};

/// Bumped when equal inputs and parameters give another result.
pub const ALIGNMENT_VERSION: u32 = 1;

/// How the observations of a track are aligned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlignmentParams {
    /// Whether scenes are aligned at all.
    pub enabled: bool,
    /// Spacing of a patch's samples in the reference view, as a share of the keypoint's size; at least a pixel.
    pub spacing: f64,
    /// Largest shift from a keypoint, in its standard deviations.
    pub max_shift_sigma: f64,
    /// Standard deviation in pixels that is added in square to what the patches state: their surfaces are no planes.
    pub noise_floor_px: f64,
    /// Factor on what the patches state, for the tails of real differences: as that of the keypoints' own.
    pub noise_factor: f64,
    /// Scale of the Cauchy loss of the adjustment in standard deviations. These are stated twice as large as most
    /// residuals are, so the loss bends at what is common.
    pub loss_sigma: f64,
    /// Most steps of the adjustment.
    pub max_iterations: u32,
    /// Patches.
    pub patch: PatchParams,
}

impl Default for AlignmentParams {
    fn default() -> Self {
        Self {
            enabled: true,
            spacing: 0.25,
            max_shift_sigma: 3.0,
            noise_floor_px: 0.03,
            noise_factor: 2.0,
            loss_sigma: 0.5,
            max_iterations: 50,
            patch: PatchParams::default(),
        }
    }
}

/// What happened, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct AlignmentReport {
    /// Points with at least one aligned observation.
    pub points: usize,
    /// Observations sought in another view.
    pub sought: usize,
    /// Those that were found.
    pub aligned: usize,
}

/// Aligns the tracks of a component and adjusts it.
///
/// `features` are those of the component's images, by id; `camera_fixed` says whose intrinsics are known. `load` gives
/// the pixels of a registered image and may be called twice for each, from several threads.
///
/// A component in which photos share a standpoint is left as it is: what ties their centres together is not known here.
///
/// # Errors
/// The first of `load`, in the order of images; the component is then left as it was.
pub fn align_tracks<E: Send>(
    params: &AlignmentParams,
    component: &mut Reconstruction,
    features: &[&ImageFeatures],
    camera_fixed: &[bool],
    load: impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E> + Sync,
) -> Result<AlignmentReport, E> {
    let registered: Vec<ImageId> = component.registered().collect();
    if shares_standpoints(component, &registered) {
        return Ok(AlignmentReport::default());
    }
    let tracks = Tracks::new(params, component, features);
    let cut: Vec<Vec<(usize, Patch)>> = registered
        .par_iter()
        .map(|&image| Ok(tracks.cut(image, &*load(image)?)))
        .collect::<Vec<Result<_, E>>>()
        .into_iter()
        .collect::<Result<_, E>>()?;
    let mut patches: Vec<Option<Patch>> = vec![None; component.points.len()];
    for (point, patch) in cut.into_iter().flatten() {
        patches[point] = Some(patch);
    }
    let found: Vec<Vec<(usize, usize, Aligned)>> = registered
        .par_iter()
        .map(|&image| Ok(tracks.align(image, &*load(image)?, &patches)))
        .collect::<Vec<Result<_, E>>>()
        .into_iter()
        .collect::<Result<_, E>>()?;
    let mut aligned: Vec<Vec<Option<Aligned>>> =
        component.points.iter().map(|point| vec![None; point.track.len()]).collect();
    let mut report = AlignmentReport::default();
    for (point, at, place) in found.into_iter().flatten() {
        aligned[point][at] = Some(place);
        report.aligned += 1;
    }
    report.points = aligned.iter().filter(|track| track.iter().any(Option::is_some)).count();
    report.sought = patches
        .iter()
        .zip(&component.points)
        .filter(|(patch, _)| patch.is_some())
        .map(|(_, point)| point.track.len() - 1)
        .sum();
    let mut problem = tracks.problem(camera_fixed, &aligned);
    let bundle = BundleParams {
        loss: RobustLoss::Cauchy(params.loss_sigma),
        max_iterations: params.max_iterations,
        ..BundleParams::default()
    };
    bundle::solve(&bundle, &mut problem);
    store(component, features, &problem);
    Ok(report)
}

/// Whether two images have one centre, as photos turned on the spot do.
fn shares_standpoints(component: &Reconstruction, registered: &[ImageId]) -> bool {
    let mut centers: Vec<[f64; 3]> = registered
        .iter()
        .filter_map(|image| Some(component.images[image.index()].world_from_camera?.translation.into()))
        .collect();
    centers.sort_by(|a, b| {
        a.iter().zip(b).map(|(a, b)| a.total_cmp(b)).find(|order| order.is_ne()).unwrap_or(Ordering::Equal)
    });
    centers.windows(2).any(|pair| pair[0] == pair[1])
}

/// A component with what is asked of its tracks.
struct Tracks<'a> {
    params: &'a AlignmentParams,
    component: &'a Reconstruction,
    features: &'a [&'a ImageFeatures],
    /// A plane through each point that faces its viewers: unit vectors along it.
    planes: Vec<Matrix3x2<f64>>,
    /// Place in its track of the observation that the others are aligned with.
    references: Vec<usize>,
    /// The points that each image sees, with the place in their tracks.
    seen: Vec<Vec<(usize, usize)>>,
}

impl<'a> Tracks<'a> {
    fn new(
        params: &'a AlignmentParams,
        component: &'a Reconstruction,
        features: &'a [&'a ImageFeatures],
    ) -> Self {
        let mut seen = vec![Vec::new(); component.images.len()];
        let (mut planes, mut references) = (Vec::new(), Vec::new());
        for (index, point) in component.points.iter().enumerate() {
            let sight = |seen: &Observation| {
                let pose = component.images[seen.image.index()].world_from_camera?;
                (pose.translation - point.position).try_normalize(0.0)
            };
            let sum: Vector3<f64> = point.track.iter().filter_map(sight).sum();
            let normal = sum.try_normalize(0.0).unwrap_or_else(Vector3::z);
            // The view in the middle differs least from the others.
            let mut reference = (0, f64::NEG_INFINITY);
            for (at, observation) in point.track.iter().enumerate() {
                seen[observation.image.index()].push((index, at));
                let cosine = sight(observation).map_or(f64::NEG_INFINITY, |sight| sight.dot(&normal));
                if cosine > reference.1 {
                    reference = (at, cosine);
                }
            }
            references.push(reference.0);
            let (u, v) = tangent_basis(&normal);
            planes.push(Matrix3x2::from_columns(&[u, v]));
        }
        Self { params, component, features, planes, references, seen }
    }

    /// Pixels that a step along the plane of a point spans in a view, where it is seen at all.
    fn pixel_from_plane(&self, point: usize, image: ImageId) -> Option<Matrix2<f64>> {
        let pose = self.component.images[image.index()].world_from_camera?;
        let camera_from_world = pose.inverse();
        let in_camera = camera_from_world.transform_point(&self.component.points[point].position);
        let projected = self.component.camera_of(image).project_with_jacobian(&in_camera)?;
        let rotation = camera_from_world.rotation.to_rotation_matrix();
        Some(projected.d_direction * rotation.matrix() * self.planes[point])
    }

    /// Length along the plane between two samples of a point's patch.
    fn spacing(&self, point: usize) -> Option<f64> {
        let reference = self.component.points[point].track.get(self.references[point])?;
        let area = self.pixel_from_plane(point, reference.image)?.determinant().abs();
        let size = self.features[reference.image.index()].keypoints[reference.feature as usize].size;
        let spacing = (self.params.spacing * f64::from(size)).max(1.0) / area.sqrt();
        (spacing.is_finite() && spacing > 0.0).then_some(spacing)
    }

    fn frame(&self, point: usize, observation: Observation) -> Option<PatchFrame> {
        let pixel_from_plane = self.pixel_from_plane(point, observation.image)?;
        let keypoint = &self.features[observation.image.index()].keypoints[observation.feature as usize];
        let pixel_from_patch = pixel_from_plane * self.spacing(point)?;
        Some(PatchFrame { center: keypoint.pixel(), pixel_from_patch })
    }

    /// The patches of the points whose reference this image is.
    fn cut(&self, image: ImageId, pyramid: &ImagePyramid) -> Vec<(usize, Patch)> {
        let own = self.seen[image.index()].iter().filter(|(point, at)| self.references[*point] == *at);
        own.filter_map(|&(point, at)| {
            let frame = self.frame(point, self.component.points[point].track[at])?;
            Some((point, Patch::cut(&self.params.patch, pyramid, &frame)?))
        })
        .collect()
    }

    /// Where this image shows the patches that others are the reference of.
    fn align(
        &self,
        image: ImageId,
        pyramid: &ImagePyramid,
        patches: &[Option<Patch>],
    ) -> Vec<(usize, usize, Aligned)> {
        let others = self.seen[image.index()].iter().filter(|(point, at)| self.references[*point] != *at);
        others
            .filter_map(|&(point, at)| {
                let observation = self.component.points[point].track[at];
                let frame = self.frame(point, observation)?;
                let aligned =
                    Template::new(&self.params.patch, patches[point].as_ref()?)?.align(pyramid, &frame)?;
                let keypoint = &self.features[image.index()].keypoints[observation.feature as usize];
                let limit = self.params.max_shift_sigma * f64::from(keypoint.noise_px);
                ((aligned.pixel - frame.center).norm() <= limit).then_some((point, at, aligned))
            })
            .collect()
    }

    /// Everything free but known intrinsics and the first pose.
    fn problem(&self, camera_fixed: &[bool], aligned: &[Vec<Option<Aligned>>]) -> BundleProblem {
        let component = self.component;
        let mut problem = BundleProblem {
            cameras: component.cameras.clone(),
            camera_freedom: vec![IntrinsicsFreedom::FIXED; component.cameras.len()],
            ..BundleProblem::default()
        };
        let mut pose_of_image = vec![None; component.images.len()];
        let mut users = vec![0; component.cameras.len()];
        for (index, image) in component.images.iter().enumerate() {
            if let Some(world_from_camera) = image.world_from_camera {
                pose_of_image[index] = Some(problem.poses.len() as u32);
                let fixed = problem.poses.is_empty() || self.seen[index].len() < MIN_ADJUSTABLE_POINTS;
                problem.poses.push(BundlePose { camera: image.camera.0, world_from_camera, fixed });
                users[image.camera.index()] += 1;
            }
        }
        for (camera, freedom) in problem.camera_freedom.iter_mut().enumerate() {
            if camera_fixed.get(camera) == Some(&false) && users[camera] >= 2 {
                *freedom = IntrinsicsFreedom::LENS;
            }
        }
        let floor = self.params.noise_floor_px;
        for (index, point) in component.points.iter().enumerate() {
            problem.points.push(BundlePoint { position: point.position, fixed: false });
            let any = aligned[index].iter().any(Option::is_some);
            for (at, seen) in point.track.iter().enumerate() {
                let Some(pose) = pose_of_image[seen.image.index()] else { continue };
                let keypoint = &self.features[seen.image.index()].keypoints[seen.feature as usize];
                let (pixel, noise_px) = match &aligned[index][at] {
                    Some(place) => (place.pixel, (self.params.noise_factor * place.noise_px).hypot(floor)),
                    // The others are where this one is.
                    None if any && at == self.references[index] => (keypoint.pixel(), floor),
                    None => (keypoint.pixel(), f64::from(keypoint.noise_px)),
                };
                problem.observations.push(BundleObservation { pose, point: index as u32, pixel, noise_px });
            }
        }
        problem
    }
}

/// Takes over what was adjusted.
fn store(component: &mut Reconstruction, features: &[&ImageFeatures], problem: &BundleProblem) {
    for (camera, adjusted) in component.cameras.iter_mut().zip(&problem.cameras) {
        if adjusted.validate().is_ok() {
            *camera = adjusted.clone();
        }
    }
    let mut poses = problem.poses.iter();
    for image in &mut component.images {
        if let Some(pose) = &mut image.world_from_camera
            && let Some(adjusted) = poses.next()
        {
            *pose = adjusted.world_from_camera;
        }
    }
    for (point, adjusted) in component.points.iter_mut().zip(&problem.points) {
        point.position = adjusted.position;
    }
    let rays: Vec<Rays> = (component.images.iter().zip(features))
        .map(|(image, features)| features.rays(&component.cameras[image.camera.index()]))
        .collect();
    let camera_from_world: Vec<Option<Rigid>> =
        component.images.iter().map(|image| Some(image.world_from_camera?.inverse())).collect();
    for point in &mut component.points {
        let squared = |seen: &Observation| {
            let (rays, index) = (&rays[seen.image.index()], seen.feature as usize);
            let in_camera = camera_from_world[seen.image.index()]?.transform_point(&point.position);
            let chord = rays.bearings[index] - in_camera.try_normalize(0.0)?;
            Some(chord.norm_squared() / rays.sigmas[index].powi(2))
        };
        let sum: f64 = point.track.iter().filter_map(squared).sum();
        point.error_sigma = (sum / point.track.len().max(1) as f64).sqrt();
    }
}
