//! The ground that photos of known poses show.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::{
    MIN_FIRST,
    sight::{Piece, SPARSE, View},
};
use crate::{
    BaselineLength, ImageId, Reconstruction,
    mapper::plane::{Plane, SeenPoint, find_planes},
    solvers::triangulation::{WorldRay, triangulate},
};

/// Images about the corner of which pairs are taken, and fewest points that both of a pair see.
const IMAGES: usize = 4;
const MIN_SHARED_POINTS: usize = 10;
/// Heights over the ground that are tried, in baselines, and the factor from one to the next.
const HEIGHTS: [f64; 2] = [0.08, 1.5];
const HEIGHT_STEP: f64 = 1.02;
/// Rays that look down by less than this sine are not tried.
const MIN_DOWN: f64 = 0.05;
/// Correlation of patches that count.
const MIN_CORRELATION: f64 = 0.75;
/// Standard deviation of a patch's place, in its steps in the other view, and how many of them it may be off.
const PLACE_SIGMA: f64 = 0.3;
const MAX_SIGMAS: f64 = 3.0;
/// Fewest patches of a plane, and the least cosine between its normal and what the photos take for down.
const MIN_PATCHES: usize = 25;
const MIN_UPRIGHT: f64 = 0.94;
/// Streets are no planes: standard deviations of the two slopes, and of the height as a share of itself, at least.
const MIN_SLOPE: f64 = 0.005;
const MIN_HEIGHT: f64 = 0.01;
/// Least cosine between a ray and the ground's normal: 2°, some thirty heights away.
const MIN_SLANT: f64 = 0.035;
/// Seed of the search for planes.
const SEED: u64 = 1;

/// Pairs of images near a corner that share points, in both orders.
pub(super) fn pairs(component: &Reconstruction, length: &BaselineLength) -> Vec<[ImageId; 2]> {
    let center = |image: ImageId| Some(component.images[image.index()].world_from_camera?.translation);
    let Some(corner) = center(length.from) else { return Vec::new() };
    let mut near: Vec<(f64, ImageId)> = component
        .registered()
        .filter(|image| component.lengths.iter().all(|length| length.to != *image))
        .filter_map(|image| Some(((center(image)? - corner).norm(), image)))
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.truncate(IMAGES);
    let share_points = |a: ImageId, b: ImageId| {
        let both = component
            .points
            .iter()
            .filter(|point| [a, b].iter().all(|image| point.track.iter().any(|seen| seen.image == *image)));
        both.take(MIN_SHARED_POINTS).count() == MIN_SHARED_POINTS
    };
    let near = || near.iter().map(|&(_, image)| image);
    near()
        .flat_map(|a| near().map(move |b| [a, b]))
        .filter(|&[a, b]| a != b && center(a) != center(b) && share_points(a, b))
        .collect()
}

/// A plane by its unit normal and its distance from a camera's centre, in that camera's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ground {
    pub normal: Vector3<f64>,
    pub distance: f64,
}

impl Ground {
    /// Where a bearing of unit length meets the plane; `None` at a grazing angle.
    pub fn meets(&self, bearing: &Vector3<f64>) -> Option<Vector3<f64>> {
        let slant = self.normal.dot(bearing);
        (slant > MIN_SLANT).then(|| bearing * (self.distance / slant))
    }
}

/// The ground in a camera's frame, with what is open of it.
pub(super) struct Floor {
    plane: Plane,
    /// Standard deviations of its slopes and of its height.
    sigmas: Vector3<f64>,
}

impl Floor {
    /// The plane below that most patches of these pairs of views lie on, in the frame of the view `from`.
    pub fn find(pairs: &[[&View<'_>; 2]], from: &View<'_>, baseline: f64) -> Option<Self> {
        let down: Vector3<f64> =
            pairs.iter().map(|[first, _]| first.world_from_camera.rotation * Vector3::y()).sum();
        let down = down.try_normalize(0.0)?;
        let center = from.world_from_camera.translation;
        let seen = |[first, second]: &[&View<'_>; 2]| -> Vec<SeenPoint> {
            let looks_down =
                |bearing: &Vector3<f64>| (first.world_from_camera.rotation * bearing).dot(&down) > MIN_DOWN;
            let pieces = first.pieces(SPARSE, |bearing, _| looks_down(bearing));
            let point = |piece: &Piece| {
                let rays = sweep(first, second, piece, &down, baseline)?;
                SeenPoint::new(&center, &triangulate(&rays)?, &rays)
            };
            pieces.iter().filter_map(point).collect()
        };
        let points: Vec<Vec<SeenPoint>> = pairs.par_iter().with_max_len(1).map(seen).collect();
        let is_ground = |plane: &Plane| plane.normal.dot(&down) >= MIN_UPRIGHT;
        let plane = find_planes(&points.concat(), MIN_PATCHES, SEED)
            .into_iter()
            .filter(is_ground)
            .reduce(|a, b| if b.members.len() > a.members.len() { b } else { a })?
            .turned(&from.world_from_camera.rotation.inverse());
        let least = Vector3::new(MIN_SLOPE, MIN_SLOPE, MIN_HEIGHT * plane.distance);
        let sigmas = plane.sigmas().zip_map(&least, f64::hypot);
        Some(Self { plane, sigmas })
    }

    /// The plane after so many standard deviations of its slopes and its height.
    pub fn ground(&self, sigmas: &Vector3<f64>) -> Ground {
        let (normal, distance) = self.plane.moved(&self.sigmas.component_mul(sigmas));
        Ground { normal, distance }
    }
}

/// The rays to a patch of the first view, where the second looks most like it at any height of the ground.
fn sweep(
    first: &View<'_>,
    second: &View<'_>,
    piece: &Piece,
    down: &Vector3<f64>,
    baseline: f64,
) -> Option<[WorldRay; 2]> {
    let second_from_first = second.world_from_camera.inverse() * first.world_from_camera;
    let normal = first.world_from_camera.rotation.inverse() * down;
    let sigma = PLACE_SIGMA * first.step_px() * first.camera.pixel_angle(&piece.pixel)?;
    let own = WorldRay::new(&first.world_from_camera, &piece.bearing, sigma);
    let steps = ((HEIGHTS[1] / HEIGHTS[0]).ln() / HEIGHT_STEP.ln()) as i32;
    let at_height = |step: i32| {
        let ground = Ground { normal, distance: baseline * HEIGHTS[0] * HEIGHT_STEP.powi(step) };
        let frame = second.frame_of(&second_from_first, &ground, &piece.stencil)?;
        let found = piece.template.align(&second.pyramid, &frame, MIN_FIRST)?;
        if found.correlation < MIN_CORRELATION {
            return None;
        }
        let (bearing, pixel_angle) = second.camera.ray(&found.pixel)?;
        let other =
            WorldRay::new(&second.world_from_camera, &bearing, PLACE_SIGMA * frame.spacing() * pixel_angle);
        let point = triangulate(&[own, other])?;
        let fits = |ray: &WorldRay| ray.angular_error(&point) <= MAX_SIGMAS * ray.sigma;
        (fits(&own) && fits(&other)).then_some((found.correlation, other))
    };
    let best = (0..=steps).filter_map(at_height).reduce(|a, b| if b.0 > a.0 { b } else { a });
    best.map(|(_, other)| [own, other])
}
