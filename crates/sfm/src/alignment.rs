//! Alignment of tracks by their images: keypoints of one point placed where they show the same spot.
//!
//! A detector locates a keypoint on each image alone, to 0.04 of its size. What the adjustment needs is only that the
//! observations of a point agree with *one another*. So of each track one view is the reference, a patch around its
//! keypoint is cut out, and the same patch is sought in the other views near their keypoints ([`setloc_features::Template`]),
//! with the shape that a plane facing the viewers would have there. Then everything is adjusted once more, each
//! observation with its own standard deviation.
//!
//! Two things keep the places free of bias, which all along a street would add up. A first alignment tells how the
//! surfaces are slanted ([`slope`]), and patches are then cut and sought as that surface bends in perspective (and in a
//! panorama), not as an affine map has it. And after the adjustment patches are sought in all other views that
//! see their place, keypoint or not, so that few points hang on two views alone.
//!
//! Tracks, features and points stay what they are; poses, points and free intrinsics move.

use std::cmp::Ordering;
use std::sync::Arc;

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x2, Vector2, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{
    Aligned, ImageFeatures, ImagePyramid, Keypoint, Patch, PatchFrame, PatchParams, Rays, Template,
};

use crate::{
    AlignedTrack, CameraId, ImageId, MeasuredPositions, Observation, Place, Reconstruction, Rigid,
    bundle::{
        self, BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, CameraPrior,
        IntrinsicsFreedom, RobustLoss,
    },
    mapper::MIN_ADJUSTABLE_POINTS,
    model_errors::moved_alike,
    solvers::tangent_basis,
};

/// By how much a panorama's stretch and twist differ from what all of one camera share, as a deviation of each term: 0.0002–0.0008
/// in four real places.
pub(crate) const STITCHING_OF_EACH: f64 = 0.0005;

/// Bumped when equal inputs and parameters give another result.
pub const ALIGNMENT_VERSION: u32 = 28;

/// Cosine between a patch's normal and the steepest view in which it is sought without a keypoint.
const MIN_COSINE: f64 = 0.5;
/// Largest factor between the resolutions of a patch in its reference and where it is sought without a keypoint.
const MAX_ZOOM: f64 = 2.0;

/// Correlation where a patch is expected without a keypoint below which something else is there.
const MIN_CORRELATION_AT_FIRST: f64 = 0.4;

/// Relative decrease of the cost at which the adjustment ends that only tells where to look for further views.
const FIRST_TOLERANCE: f64 = 1e-3;
/// That of the last adjustment. With a loss that bends so early it approaches its end by small steps: a tenth of this
/// takes twice as many and leaves the centres where they are, within a hundredth of their error.
const TOLERANCE: f64 = 1e-5;
/// How many times wider the loss is that the last adjustment begins with.
const WIDE_LOSS: f64 = 8.0;

/// Standard deviation of the entries of the linear map between two patches, which noise and relief leave.
const SHAPE_SIGMA: f64 = 0.05;
/// Largest slope of a surface over the plane that faces its viewers.
const MAX_SLOPE: f64 = 3.0;

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
            max_iterations: 200,
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
    /// Patches found in views whose keypoints do not belong to the track.
    pub further: usize,
}

/// What is known of a component beside its images.
#[derive(Debug, Clone, Copy, Default)]
pub struct KnownOfComponent<'a> {
    /// Whose intrinsics are, by camera; those of cameras beyond the end, which the mapper added, are not.
    pub cameras: &'a [bool],
    /// Measured positions in the frame of the component, which moves in it by little.
    pub positions: Option<&'a MeasuredPositions>,
}

/// Aligns the tracks of a component and adjusts it.
///
/// `features` are those of the component's images, by id. `load` gives the pixels of a registered image and may be called five times
/// for each, from several threads.
///
/// In a component in which photos share a standpoint nothing moves, as what ties their centres together is not known
/// here: its points get their places only. Those that see too little to be adjusted do not count: they go with the image
/// that they were turned from.
///
/// # Errors
/// The first of `load`, in the order of images; the component may then be adjusted by its own views only.
pub fn align_tracks<E: Send>(
    params: &AlignmentParams,
    component: &mut Reconstruction,
    features: &[&ImageFeatures],
    known: KnownOfComponent<'_>,
    load: impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E> + Sync,
) -> Result<AlignmentReport, E> {
    let registered: Vec<ImageId> = component.registered().collect();
    let mut tracks = Tracks::new(params, component, features);
    // The first alignment tells the slant of the surfaces, the second goes by it.
    let (templates, facing) = tracks.align_all(&registered, &load)?;
    // Tens of thousands of blocks: freeing them one after another is felt.
    templates.into_par_iter().for_each(drop);
    tracks.planes = tracks.tilted_planes(&facing);
    let (templates, aligned) = tracks.align_all(&registered, &load)?;
    let mut report =
        AlignmentReport { aligned: aligned.iter().flatten().flatten().count(), ..AlignmentReport::default() };
    report.points = aligned.iter().filter(|track| track.iter().any(Option::is_some)).count();
    report.sought = templates
        .iter()
        .zip(&component.points)
        .filter(|(template, _)| template.is_some())
        .map(|(_, point)| point.track.len() - 1)
        .sum();
    let middles = tracks.middles(&aligned);
    let mut problem = tracks.problem(known.cameras, &aligned, &middles, &[]);
    if shares_standpoints(&problem) {
        let placed = tracks.placed(&aligned, &middles, &[]);
        for (point, placed) in component.points.iter_mut().zip(placed) {
            point.aligned = placed.map(|(aligned, _)| aligned);
        }
        return Ok(report);
    }
    let turned = turned_on_the_spot(&problem);
    let bundle = BundleParams {
        loss: RobustLoss::Cauchy(params.loss_sigma),
        max_iterations: params.max_iterations,
        function_tolerance: TOLERANCE,
        ..BundleParams::default()
    };
    let first = BundleParams { function_tolerance: FIRST_TOLERANCE, ..bundle };
    solve(&first, &mut problem, tracks.component, known.positions);
    let (references, planes) = (tracks.references, tracks.planes);
    store(component, features, &problem);
    let shared = component.cameras.len();
    stitch_each(component, known.cameras);
    // Now it is known where the patches lie in views that no keypoint ties to them.
    let tracks = Tracks { planes, references, ..Tracks::new(params, component, features) };
    let middles = tracks.middles(&aligned);
    let steady = registered.iter().zip(&turned).filter(|(_, turned)| !**turned);
    let steady: Vec<ImageId> = steady.map(|(image, _)| *image).collect();
    let further =
        in_each(&steady, &load, |image, pyramid| tracks.seek_further(image, pyramid, &templates, &middles))?
            .concat();
    report.further = further.len();
    let mut problem = tracks.problem(known.cameras, &aligned, &middles, &further);
    for prior in problem.camera_priors.iter_mut().filter(|prior| prior.camera as usize >= shared) {
        prior.hold_stretch(&tracks.component.cameras[prior.camera as usize], STITCHING_OF_EACH);
    }
    // A loss that bends so early keeps what lies beyond it where it began, each point in a valley of its own: first what is far
    // off comes near (A. Blake, A. Zisserman, "Visual Reconstruction", 1987: graduated non-convexity). The cost ends 2–15 % lower, the
    // same from wherever it begins, and centres of 20 rendered scenes are 2 % nearer to the truth.
    let wide = RobustLoss::Cauchy(WIDE_LOSS * params.loss_sigma);
    let wide = BundleParams { loss: wide, function_tolerance: FIRST_TOLERANCE, ..bundle };
    solve(&wide, &mut problem, tracks.component, known.positions);
    solve(&bundle, &mut problem, tracks.component, known.positions);
    let placed = tracks.placed(&aligned, &middles, &further);
    store(component, features, &problem);
    for (point, placed) in component.points.iter_mut().zip(placed) {
        (point.aligned, point.covariance) = placed.unzip();
    }
    templates.into_par_iter().for_each(drop);
    Ok(report)
}

/// Gives each panorama that is stretched a camera of its own, of what all of them share.
fn stitch_each(component: &mut Reconstruction, camera_fixed: &[bool]) {
    let registered: Vec<ImageId> = component.registered().collect();
    for image in registered {
        let shared = component.images[image.index()].camera;
        if component.cameras[shared.index()].is_stretched() && camera_fixed.get(shared.index()) != Some(&true)
        {
            component.images[image.index()].camera = CameraId(component.cameras.len() as u32);
            component.cameras.push(component.cameras[shared.index()].clone());
        }
    }
}

/// What `work` finds in the pixels of each image; the first error of `load` in the order of images.
fn in_each<T: Send, E: Send>(
    images: &[ImageId],
    load: &(impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E> + Sync),
    work: impl Fn(ImageId, &ImagePyramid) -> T + Sync,
) -> Result<Vec<T>, E> {
    // Without a bound, rayon would leave the last images to one thread.
    let images = images.par_iter().with_max_len(1);
    let found: Vec<Result<T, E>> = images.map(|&image| Ok(work(image, &*load(image)?))).collect();
    found.into_iter().collect()
}

/// Where in a patch [`second_order`] looks: its middle, then places to the left, right, above, below, and at two corners.
pub(crate) const STENCIL: [[f64; 2]; 7] =
    [[0.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [1.0, 1.0], [-1.0, -1.0]];

/// The frame of a patch by where its steps (x, y) lie, to the second order, from where it has the places of [`STENCIL`], by their
/// number there, in units of `reach` steps; `full_turn_px` where the image closes round it.
pub(crate) fn second_order(
    place: impl Fn(usize) -> Option<Vector2<f64>>,
    reach: f64,
    full_turn_px: Option<f64>,
) -> Option<PatchFrame> {
    let center = place(0)?;
    let from_middle = |number: usize| {
        let mut offset = place(number)? - center;
        if let Some(turn) = full_turn_px {
            offset.x -= turn * (offset.x / turn).round();
        }
        Some(offset)
    };
    let h = reach;
    let [left, right] = [from_middle(1)?, from_middle(2)?];
    let [above, below] = [from_middle(3)?, from_middle(4)?];
    let (along_x, along_y) = (right + left, below + above);
    let mixed = 0.5 * (from_middle(5)? + from_middle(6)? - along_x - along_y);
    let curvature =
        [0, 1].map(|axis| Matrix2::new(along_x[axis], mixed[axis], mixed[axis], along_y[axis]) / (h * h));
    let pixel_from_patch = Matrix2::from_columns(&[right - left, below - above]) / (2.0 * h);
    Some(PatchFrame { center, pixel_from_patch, curvature })
}

/// Poses of the registered images, and each image's among them: free but for the first and those that see too little.
pub(crate) fn adjustable_poses(
    component: &Reconstruction,
    seen: impl Fn(ImageId) -> usize,
) -> (Vec<BundlePose>, Vec<Option<u32>>) {
    let (mut poses, mut pose_of_image) = (Vec::new(), vec![None; component.images.len()]);
    for (index, image) in component.images.iter().enumerate() {
        if let Some(world_from_camera) = image.world_from_camera {
            pose_of_image[index] = Some(poses.len() as u32);
            let fixed = poses.is_empty() || seen(ImageId(index as u32)) < MIN_ADJUSTABLE_POINTS;
            poses.push(BundlePose { camera: image.camera.0, world_from_camera, fixed });
        }
    }
    (poses, pose_of_image)
}

/// Adjusts a component, by measured positions, too, where there are.
fn solve(
    params: &BundleParams,
    problem: &mut BundleProblem,
    component: &Reconstruction,
    positions: Option<&MeasuredPositions>,
) {
    leave_out_turned(problem);
    if let Some(positions) = positions {
        hold_by_positions(problem, component, positions, params.loss);
    }
    let before = problem.poses.clone();
    bundle::solve(params, problem);
    follow(problem, &before);
}

/// How many observations each pose of a problem has.
fn seen_by_poses(problem: &BundleProblem) -> Vec<usize> {
    let mut seen = vec![0; problem.poses.len()];
    problem.observations.iter().for_each(|observation| seen[observation.pose as usize] += 1);
    seen
}

/// Frees the frame of a component's adjustment and holds it by measured positions.
///
/// Poses that see too little to be adjusted would hold it fast: they are left out, and follow ([`follow`]).
pub(crate) fn hold_by_positions(
    problem: &mut BundleProblem,
    component: &Reconstruction,
    positions: &MeasuredPositions,
    loss: RobustLoss,
) {
    let seen = seen_by_poses(problem);
    for (pose, seen) in problem.poses.iter_mut().zip(seen) {
        pose.fixed = seen < MIN_ADJUSTABLE_POINTS;
    }
    let poses = &problem.poses;
    problem.observations.retain(|seen| !poses[seen.pose as usize].fixed);
    problem.position_priors = positions.priors(component.registered(), problem.variance_factor(loss));
    let offsets = problem.position_offsets();
    let settled = problem.without_frame(&offsets);
    for ((prior, offset), settled) in problem.position_priors.iter_mut().zip(offsets).zip(settled) {
        prior.position += settled - offset;
    }
}

/// Moves the poses of a problem that were left out of its adjustment as the nearest of the others has moved since `before`.
pub(crate) fn follow(problem: &mut BundleProblem, before: &[BundlePose]) {
    let seen = seen_by_poses(problem);
    let moved: Vec<(Rigid, Rigid)> = (before.iter().zip(&problem.poses).zip(&seen))
        .filter(|(_, seen)| **seen > 0)
        .map(|((before, after), _)| (before.world_from_camera, after.world_from_camera))
        .collect();
    for (pose, _) in problem.poses.iter_mut().zip(seen).filter(|(_, seen)| *seen == 0) {
        let here = pose.world_from_camera.translation;
        let distance = |of: &Rigid| (of.translation - here).norm_squared();
        let nearest = moved.iter().min_by(|a, b| distance(&a.0).total_cmp(&distance(&b.0)));
        if let Some((before, after)) = nearest {
            pose.world_from_camera = moved_alike(&pose.world_from_camera, before, after);
        }
    }
}

/// The poses of a problem by where they stand, those of one place together, and what each has observations: most first.
///
/// Images of one place are photos turned on the spot. They have one centre to the last digit.
fn standpoints(problem: &BundleProblem) -> Vec<Vec<(usize, usize)>> {
    let center = |pose: usize| -> [f64; 3] { problem.poses[pose].world_from_camera.translation.into() };
    let by_place = |a: usize, b: usize| {
        let apart = center(a).into_iter().zip(center(b)).map(|(a, b)| a.total_cmp(&b));
        apart.fold(Ordering::Equal, Ordering::then)
    };
    let mut all: Vec<(usize, usize)> = seen_by_poses(problem).into_iter().enumerate().collect();
    all.sort_by(|a, b| by_place(a.0, b.0).then(b.1.cmp(&a.1)));
    all.chunk_by(|a, b| center(a.0) == center(b.0)).map(<[_]>::to_vec).collect()
}

/// Whether two images of a problem that see enough to be adjusted have one centre, as photos turned on the spot do.
pub(crate) fn shares_standpoints(problem: &BundleProblem) -> bool {
    let second = |of_place: Vec<(usize, usize)>| of_place.get(1).map_or(0, |(_, seen)| *seen);
    standpoints(problem).into_iter().map(second).any(|seen| seen >= MIN_ADJUSTABLE_POINTS)
}

/// Which poses of a problem see too little to be adjusted and stand just where another one does: the mapper puts images that were
/// turned on the spot there.
fn turned_on_the_spot(problem: &BundleProblem) -> Vec<bool> {
    let mut turned = vec![false; problem.poses.len()];
    for of_place in standpoints(problem) {
        let others = of_place.into_iter().skip(1);
        others.for_each(|(pose, seen)| turned[pose] = seen < MIN_ADJUSTABLE_POINTS);
    }
    turned
}

/// Leaves those poses out of an adjustment, so that they [`follow`]: what little they see would hold the images that they were turned
/// from.
pub(crate) fn leave_out_turned(problem: &mut BundleProblem) {
    let turned = turned_on_the_spot(problem);
    problem.observations.retain(|seen| !turned[seen.pose as usize]);
    for (pose, _) in problem.poses.iter_mut().zip(&turned).filter(|(_, turned)| **turned) {
        pose.fixed = true;
    }
    // One that stays has to hold the frame.
    if let Some(first) = turned.iter().position(|turned| !turned) {
        problem.poses[first].fixed = true;
    }
}

/// Templates by point, and where the views show them by point and place in the track.
type Alignments = (Templates, Vec<Vec<Option<Aligned>>>);
type Templates = Vec<Option<Box<Template>>>;

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
        Some(self.pixel_from_world(point, image)? * self.planes[point])
    }

    /// Length along the plane between two samples of a point's patch.
    fn spacing(&self, point: usize) -> Option<f64> {
        let reference = self.component.points[point].track.get(self.references[point])?;
        let area = self.pixel_from_plane(point, reference.image)?.determinant().abs();
        let size = self.keypoint(*reference).size;
        let spacing = (self.params.spacing * f64::from(size)).max(1.0) / area.sqrt();
        (spacing.is_finite() && spacing > 0.0).then_some(spacing)
    }

    fn frame(&self, point: usize, observation: Observation) -> Option<PatchFrame> {
        let pixel_from_plane = self.pixel_from_plane(point, observation.image)?;
        self.frame_at(point, observation.image, self.keypoint(observation).pixel(), &pixel_from_plane)
    }

    /// The patch of a point in a view, with the curvature that its plane has there.
    fn frame_at(
        &self,
        point: usize,
        image: ImageId,
        center: Vector2<f64>,
        pixel_from_plane: &Matrix2<f64>,
    ) -> Option<PatchFrame> {
        let spacing = self.spacing(point)?;
        let camera = self.component.camera_of(image);
        let camera_from_world = self.component.images[image.index()].world_from_camera?.inverse();
        let position = self.component.points[point].position;
        let reach = 0.5 * self.params.patch.radius as f64;
        let place = |number: usize| {
            let on_plane = self.planes[point] * (Vector2::from(STENCIL[number]) * reach) * spacing;
            camera.project(&camera_from_world.transform_point(&(position + on_plane)))
        };
        let PatchFrame { curvature, .. } = second_order(place, reach, camera.full_turn_px())?;
        Some(PatchFrame { center, pixel_from_patch: pixel_from_plane * spacing, curvature })
    }

    /// Planes through the points as the shapes of their patches in the views tell; see [`slope`].
    fn tilted_planes(&self, aligned: &[Vec<Option<Aligned>>]) -> Vec<Matrix3x2<f64>> {
        let tilted = |(point, aligned): (usize, &Vec<Option<Aligned>>)| {
            let plane = &self.planes[point];
            let normal: Vector3<f64> = plane.column(0).cross(&plane.column(1));
            let track = &self.component.points[point].track;
            let reference = self.pixel_from_world(point, track[self.references[point]].image)?;
            let views = track.iter().zip(aligned).filter_map(|(seen, aligned)| {
                Some((self.pixel_from_world(point, seen.image)?, aligned.as_ref()?.shape))
            });
            let slope = slope(plane, &normal, &reference, views)?;
            let (u, v) = tangent_basis(&(normal - plane * slope).try_normalize(0.0)?);
            Some(Matrix3x2::from_columns(&[u, v]))
        };
        let points = aligned.par_iter().enumerate();
        points.map(|entry| tilted(entry).unwrap_or(self.planes[entry.0])).collect()
    }

    /// Pixels that a step of a point spans in a view.
    fn pixel_from_world(&self, point: usize, image: ImageId) -> Option<Matrix2x3<f64>> {
        let camera_from_world = self.component.images[image.index()].world_from_camera?.inverse();
        let in_camera = camera_from_world.transform_point(&self.component.points[point].position);
        let projected = self.component.camera_of(image).project_with_jacobian(&in_camera)?;
        Some(projected.d_direction * camera_from_world.rotation.to_rotation_matrix().matrix())
    }

    /// The patches of all points and where their other views show them.
    fn align_all<E: Send>(
        &self,
        registered: &[ImageId],
        load: &(impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E> + Sync),
    ) -> Result<Alignments, E> {
        let cut = in_each(registered, load, |image, pyramid| self.cut(image, pyramid))?;
        let mut templates: Templates = vec![None; self.component.points.len()];
        for (point, template) in cut.into_iter().flatten() {
            templates[point] = Some(template);
        }
        let found = in_each(registered, load, |image, pyramid| self.align(image, pyramid, &templates))?;
        let mut aligned: Vec<Vec<Option<Aligned>>> =
            self.component.points.par_iter().map(|point| vec![None; point.track.len()]).collect();
        for (point, at, place) in found.into_iter().flatten() {
            aligned[point][at] = Some(place);
        }
        Ok((templates, aligned))
    }

    /// The patches of the points whose reference this image is, where they have texture.
    fn cut(&self, image: ImageId, pyramid: &ImagePyramid) -> Vec<(usize, Box<Template>)> {
        let own = self.seen[image.index()].iter().filter(|(point, at)| self.references[*point] == *at);
        own.filter_map(|&(point, at)| {
            let frame = self.frame(point, self.component.points[point].track[at])?;
            let patch = Patch::cut(&self.params.patch, pyramid, &frame)?;
            Some((point, Box::new(Template::new(&self.params.patch, patch)?)))
        })
        .collect()
    }

    /// Where this image shows the patches that others are the reference of.
    fn align(
        &self,
        image: ImageId,
        pyramid: &ImagePyramid,
        templates: &[Option<Box<Template>>],
    ) -> Vec<(usize, usize, Aligned)> {
        let others = self.seen[image.index()].iter().filter(|(point, at)| self.references[*point] != *at);
        others
            .filter_map(|&(point, at)| {
                let observation = self.component.points[point].track[at];
                let template = templates[point].as_ref()?;
                let frame = self.frame(point, observation)?;
                let aligned = template.align(pyramid, &frame, -1.0)?;
                let limit = self.params.max_shift_sigma * f64::from(self.keypoint(observation).noise_px);
                ((aligned.pixel - frame.center).norm() <= limit).then_some((point, at, aligned))
            })
            .collect()
    }

    /// Where this image shows patches of points that it does not see by a keypoint.
    ///
    /// The adjusted poses say where to look, to less than the noise of a keypoint. What hides the point looks different.
    fn seek_further(
        &self,
        image: ImageId,
        pyramid: &ImagePyramid,
        templates: &[Option<Box<Template>>],
        middles: &[Option<Middle>],
    ) -> Vec<Further> {
        let Some(pose) = self.component.images[image.index()].world_from_camera else { return Vec::new() };
        let seek = |point: usize| {
            let (template, middle) = (templates[point].as_ref()?, middles[point].as_ref()?);
            let position = self.component.points[point].position;
            let reference = self.component.points[point].track[self.references[point]];
            let sight = (pose.translation - position).try_normalize(0.0)?;
            let normal = self.planes[point].column(0).cross(&self.planes[point].column(1));
            if normal.dot(&sight).abs() < MIN_COSINE {
                return None;
            }
            let camera = self.component.camera_of(image);
            let projected = camera.project(&pose.inverse_transform_point(&position))?;
            let pixel_from_plane = self.pixel_from_plane(point, image)?;
            let center = projected - pixel_from_plane * middle.offset;
            let in_reference = self.pixel_from_plane(point, reference.image)?;
            let zoom = (pixel_from_plane.determinant() / in_reference.determinant()).abs().sqrt();
            if !camera.contains(&center) || !(MAX_ZOOM.recip()..=MAX_ZOOM).contains(&zoom) {
                return None;
            }
            let frame = self.frame_at(point, image, center, &pixel_from_plane)?;
            let aligned = template.align(pyramid, &frame, MIN_CORRELATION_AT_FIRST)?;
            let limit = self.params.max_shift_sigma * f64::from(self.keypoint(reference).noise_px) * zoom;
            let noise_px = self.noise_px(&aligned);
            let pixel = aligned.pixel + pixel_from_plane * middle.offset;
            ((aligned.pixel - center).norm() <= limit).then_some(Further {
                point,
                image,
                place: Place { pixel, noise_px },
            })
        };
        self.others_in_reach(image).into_iter().filter_map(seek).collect()
    }

    /// The points that an image does not see by a keypoint, but another that shares points with it does; ascending.
    ///
    /// Far away in a large scene nothing would be found.
    fn others_in_reach(&self, image: ImageId) -> Vec<usize> {
        let mut is_neighbour = vec![false; self.seen.len()];
        let mut left_out = vec![false; self.component.points.len()];
        for &(point, _) in &self.seen[image.index()] {
            left_out[point] = true;
            for seen in &self.component.points[point].track {
                is_neighbour[seen.image.index()] = true;
            }
        }
        let neighbours = self.seen.iter().zip(is_neighbour).filter(|(_, is_neighbour)| *is_neighbour);
        let mut points: Vec<usize> = neighbours
            .flat_map(|(seen, _)| seen)
            .map(|&(point, _)| point)
            .filter(|&point| !std::mem::replace(&mut left_out[point], true))
            .collect();
        points.sort_unstable();
        points
    }

    fn noise_px(&self, aligned: &Aligned) -> f64 {
        (self.params.noise_factor * aligned.noise_px).hypot(self.params.noise_floor_px)
    }

    /// Everything free but known intrinsics and the first pose.
    fn problem(
        &self,
        camera_fixed: &[bool],
        aligned: &[Vec<Option<Aligned>>],
        middles: &[Option<Middle>],
        further: &[Further],
    ) -> BundleProblem {
        let component = self.component;
        let mut problem = BundleProblem {
            cameras: component.cameras.clone(),
            camera_freedom: vec![IntrinsicsFreedom::FIXED; component.cameras.len()],
            ..BundleProblem::default()
        };
        let pose_of_image;
        (problem.poses, pose_of_image) = adjustable_poses(component, |image| self.seen[image.index()].len());
        let mut users = vec![Vec::new(); component.cameras.len()];
        for image in component.registered() {
            users[component.images[image.index()].camera.index()].push(image);
        }
        for (camera, freedom) in problem.camera_freedom.iter_mut().enumerate() {
            let is_told = || match &users[camera][..] {
                [] => false,
                [_] if component.cameras[camera].is_stretched() => true,
                [one] => component.tells_camera_of(&[*one]),
                _ => true,
            };
            if camera_fixed.get(camera) != Some(&true) && is_told() {
                *freedom = IntrinsicsFreedom::FREE;
                let usual = CameraPrior::of_usual_photo(camera as u32, &component.cameras[camera]);
                problem.camera_priors.extend(usual);
            }
        }
        let points = component.points.iter();
        problem.points = points.map(|point| BundlePoint { position: point.position, fixed: false }).collect();
        let mut sightings: Vec<(u32, usize, usize)> = Vec::with_capacity(component.observation_count());
        for (point, seen) in component.points.iter().enumerate() {
            let pose =
                |(at, seen): (usize, &Observation)| Some((pose_of_image[seen.image.index()]?, point, at));
            sightings.extend(seen.track.iter().enumerate().filter_map(pose));
        }
        let observation = |&(pose, point, at): &(u32, usize, usize)| {
            let Place { pixel, noise_px } =
                self.place(point, at, aligned[point][at].as_ref(), middles[point].as_ref());
            BundleObservation { pose, point: point as u32, pixel, noise_px }
        };
        problem.observations = sightings.par_iter().map(observation).collect();
        problem.observations.extend(further.iter().filter_map(|found| {
            let &Further { point, image, place: Place { pixel, noise_px } } = found;
            let pose = pose_of_image[image.index()]?;
            Some(BundleObservation { pose, point: point as u32, pixel, noise_px })
        }));
        for length in &component.lengths {
            length.hold_in(&mut problem, |image| pose_of_image[image.index()]);
        }
        problem
    }

    fn keypoint(&self, observation: Observation) -> &Keypoint {
        &self.features[observation.image.index()].keypoints[observation.feature as usize]
    }

    /// Where a view of the track shows a point.
    fn place(&self, point: usize, at: usize, aligned: Option<&Aligned>, middle: Option<&Middle>) -> Place {
        let observation = self.component.points[point].track[at];
        let keypoint = self.keypoint(observation);
        let aligned = match aligned {
            Some(place) => Some((place.pixel, self.noise_px(place))),
            // The others are where this one is.
            None => (at == self.references[point]).then(|| (keypoint.pixel(), self.params.noise_floor_px)),
        };
        let placed = middle.zip(aligned).and_then(|(middle, (pixel, noise_px))| {
            let pixel = pixel + self.pixel_from_plane(point, observation.image)? * middle.offset;
            Some(Place { pixel, noise_px })
        });
        placed.unwrap_or_else(|| keypoint.into())
    }

    fn middles(&self, aligned: &[Vec<Option<Aligned>>]) -> Vec<Option<Middle>> {
        aligned.par_iter().enumerate().map(|(point, aligned)| self.middle(point, aligned)).collect()
    }

    /// Where the keypoints of a point lie in the mean; `None` when none was aligned with another.
    fn middle(&self, point: usize, aligned: &[Option<Aligned>]) -> Option<Middle> {
        if aligned.iter().all(Option::is_none) {
            return None;
        }
        let (mut information, mut sum) = (Matrix2::zeros(), Vector2::zeros());
        for (at, &observation) in self.component.points[point].track.iter().enumerate() {
            let keypoint = self.keypoint(observation);
            let pixel = match &aligned[at] {
                Some(place) => place.pixel,
                None if at == self.references[point] => keypoint.pixel(),
                None => continue,
            };
            let jacobian = self.pixel_from_plane(point, observation.image)?;
            let weight = 1.0 / f64::from(keypoint.noise_px).powi(2);
            information += jacobian.transpose() * jacobian * weight;
            sum += jacobian.transpose() * (keypoint.pixel() - pixel) * weight;
        }
        let covariance = information.try_inverse()?;
        Some(Middle { offset: covariance * sum, covariance })
    }

    /// The points that were aligned: where their views show them, and their covariance where the cameras are exact.
    ///
    /// What ties the views is as precise as the alignment; which spot of the surface a detector will call the keypoint
    /// is known as the mean of its detections is.
    fn placed(
        &self,
        aligned: &[Vec<Option<Aligned>>],
        middles: &[Option<Middle>],
        further: &[Further],
    ) -> Vec<Option<(AlignedTrack, Matrix3<f32>)>> {
        let mut further_of = vec![Vec::new(); aligned.len()];
        for found in further {
            further_of[found.point].push((found.image, found.place));
        }
        let placed = |(point, further): (usize, Vec<(ImageId, Place)>)| {
            let (middle, plane) = (middles[point].as_ref()?, &self.planes[point]);
            let track = &self.component.points[point].track;
            let places: Vec<Place> = (0..track.len())
                .map(|at| self.place(point, at, aligned[point][at].as_ref(), Some(middle)))
                .collect();
            let seen = track.iter().map(|seen| seen.image).zip(&places);
            let views = seen.chain(further.iter().map(|(image, place)| (*image, place)));
            let information: Matrix3<f64> = views.filter_map(|view| self.information(point, view)).sum();
            let spot = plane * middle.covariance * plane.transpose();
            let covariance = information.try_inverse()? + spot;
            let aligned = AlignedTrack { places, further, spot: spot.cast() };
            covariance.iter().all(|value| value.is_finite()).then(|| (aligned, covariance.cast()))
        };
        further_of.into_par_iter().enumerate().map(placed).collect()
    }

    /// What a view says of the place of a point.
    fn information(&self, point: usize, (image, place): (ImageId, &Place)) -> Option<Matrix3<f64>> {
        let pose = self.component.images[image.index()].world_from_camera?;
        let angle = self.component.camera_of(image).pixel_angle(&place.pixel)?;
        let offset = self.component.points[point].position - pose.translation;
        let sigma = place.noise_px * angle * offset.norm();
        let direction = offset.try_normalize(0.0)?;
        Some((Matrix3::identity() - direction * direction.transpose()) / (sigma * sigma))
    }
}

/// A view of a point's patch without a keypoint there.
#[derive(Debug, Clone, Copy)]
struct Further {
    point: usize,
    image: ImageId,
    /// Where the mean of the point's keypoints is.
    place: Place,
}

/// Slope of the surface over the plane P: it runs through X + P·a + n·(g·a).
///
/// A view with the derivative J of pixels by space shows the surface as J·(P + n·gᵀ). The alignment found the map
/// C = J·P·B·(J₀·P)⁻¹ from the reference's pixels to the view's, so (J − C·J₀)·(P + n·gᵀ) = 0: linear in g. A slope of
/// about one is taken as likely beforehand, against [`SHAPE_SIGMA`] in the entries of B.
fn slope(
    plane: &Matrix3x2<f64>,
    normal: &Vector3<f64>,
    reference: &Matrix2x3<f64>,
    views: impl Iterator<Item = (Matrix2x3<f64>, Matrix2<f64>)>,
) -> Option<Vector2<f64>> {
    let plane_from_reference = (reference * plane).try_inverse()?;
    let (mut sum, mut weight) = (Vector2::zeros(), 0.0);
    for (pixel_from_world, shape) in views {
        let map = pixel_from_world * plane * shape * plane_from_reference;
        let parallax = pixel_from_world - map * reference;
        let lever = parallax * normal;
        sum -= (parallax * plane).transpose() * lever;
        weight += lever.norm_squared() + 0.5 * (SHAPE_SIGMA * pixel_from_world * plane).norm_squared();
    }
    let slope: Vector2<f64> = sum / weight;
    (slope.norm() <= MAX_SLOPE).then_some(slope)
}

/// The mean of a point's keypoints on its plane.
struct Middle {
    /// From the keypoint of the reference.
    offset: Vector2<f64>,
    covariance: Matrix2<f64>,
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
    let rays: Vec<Rays> = (component.images.par_iter().with_max_len(1).zip(features))
        .map(|(image, features)| features.rays(&component.cameras[image.camera.index()]))
        .collect();
    let camera_from_world: Vec<Option<Rigid>> =
        component.images.iter().map(|image| Some(image.world_from_camera?.inverse())).collect();
    component.points.par_iter_mut().for_each(|point| {
        let squared = |seen: &Observation| {
            let (rays, index) = (&rays[seen.image.index()], seen.feature as usize);
            let in_camera = camera_from_world[seen.image.index()]?.transform_point(&point.position);
            let chord = rays.bearings[index] - in_camera.try_normalize(0.0)?;
            Some(chord.norm_squared() / rays.sigmas[index].powi(2))
        };
        let sum: f64 = point.track.iter().filter_map(squared).sum();
        point.error_sigma = (sum / point.track.len().max(1) as f64).sqrt();
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shapes_of_patches_tell_the_slope_of_the_surface() {
        let normal = Vector3::new(0.3, -0.2, 0.9).normalize();
        let (u, v) = tangent_basis(&normal);
        let plane = Matrix3x2::from_columns(&[u, v]);
        let truth = Vector2::new(0.8, -0.4);
        let surface = plane + normal * truth.transpose();
        // Views of a far spot from some directions: the derivative of pixels by space drops the viewing direction.
        let view = |x: f64, y: f64| {
            let sight = (normal + plane * Vector2::new(x, y)).normalize();
            let (right, down) = tangent_basis(&sight);
            Matrix2x3::from_rows(&[right.transpose(), down.transpose()]) * 400.0
        };
        let reference = view(0.0, 0.0);
        let views = [view(0.4, 0.1), view(-0.3, 0.2), view(0.1, -0.5)].map(|pixel_from_world| {
            let map = pixel_from_world * surface * (reference * surface).try_inverse().unwrap();
            let shape = (pixel_from_world * plane).try_inverse().unwrap() * map * (reference * plane);
            (pixel_from_world, shape)
        });
        let found = slope(&plane, &normal, &reference, views.into_iter()).unwrap();
        // What is likely beforehand draws it a little towards none.
        assert!((found - truth).norm() < 0.05 * truth.norm() && found.norm() < truth.norm(), "{found}");
        assert_eq!(slope(&plane, &normal, &reference, [].into_iter()), None);
    }
}
