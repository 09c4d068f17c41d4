//! The scale of photos about a known place by the walls that they show.
//!
//! Where one standpoint of a set sees a scene and the others hardly do, these show some part of the same walls, from farther
//! off, between poles and at a slant: too little for keypoints that match, and enough for pixels. What the scene's images
//! show of the planes among its points is laid over the photos at one scale after the other; at the right one patches of
//! all photos correlate, at others chance ones do. It is a plane sweep (R. T. Collins, "A space-sweep approach to true
//! multi-image matching", CVPR 1996) whose planes are known and whose cameras are not.

use std::sync::Arc;

use nalgebra::{Matrix2, Matrix3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use setloc_features::{Camera, ImagePyramid, Patch, PatchFrame, PatchParams, Template};

use crate::{
    ImageId, Place, PointId, Reconstruction, ReconstructionPoint, Rigid,
    ground::{
        PATCH,
        floor::Ground,
        sight::{Piece, View},
    },
    mapper::plane::{Plane, SeenPoint, find_planes},
    solvers::triangulation::{WorldRay, triangulate},
};

/// Fewest points of a wall.
const MIN_WALL_POINTS: usize = 20;
/// Largest cosine between the normal of a wall and down. The ground repeats itself, and seen at a grazing angle any of it is
/// like the next.
const MAX_LYING: f64 = 0.7;
/// How far a wall goes on beyond its points, as an angle about its image, in cells.
const CELL_RAD: f64 = 0.03;
const BEYOND: i64 = 2;
/// Steps between the middles of neighbouring patches; patches overlap by little, so that each is a witness of its own.
const SPACING: [f64; 2] = [12.0; 2];
/// Range of scales that are tried, as the longest step in distances of the walls, and the factor from one to the next.
const STEPS: [f64; 2] = [0.04, 3.0];
const SCALE_STEP: f64 = 1.03;
/// Scales about the best that are tried once more, as the number of steps to each side and the factor.
const FINE_STEPS: i32 = 9;
const FINE_STEP: f64 = 1.006;
/// Correlation of patches that count when scales are compared. What looks alike by chance (courses of bricks, floors of a car park)
/// is mostly less so: from 0.75 on, the right scale of five sets had 1.3–13 times as many as any other, from 0.85 on 2.1–18
/// times.
const MIN_ALIKE: f64 = 0.85;
/// Correlation of patches that are placed.
const MIN_CORRELATION: f64 = 0.75;
/// The same of a patch of few, coarse samples, below which it is not looked at closer.
const MIN_COARSE: f64 = 0.5;
const COARSE: PatchParams =
    PatchParams { radius: 3, max_iterations: 0, min_correlation: 0.0, max_distortion: 1.0 };
/// Other scales show by chance what those more than this factor away do.
const APART: f64 = 1.3;
/// Correlation at the first look below which a patch is not followed.
const MIN_FIRST: f64 = 0.5;
/// Standard deviation of a patch's place, in its steps in the other image, and of how far it may be from where it is expected.
const PLACE_SIGMA: f64 = 0.3;
const MAX_OFF: f64 = 4.0;
/// Farthest that the place where rays meet may be from one, in standard deviations.
const MAX_SIGMAS: f64 = 4.0;
/// How far what a wall shows may be off the plane of its points, as a share of its distance: windows stand back.
const RELIEF: f64 = 0.04;
/// Neighbouring patches err alike, as the wall is no plane there: so many count as one.
const ALIKE: f64 = 4.0;
/// Least cosine between the normal of a wall and the rays to it, in the image and in the photo.
const MIN_SLANT: f64 = 0.1;
const SEED: u64 = 1;

/// A photo of which all but the length of the way to it is known.
pub struct DistantPhoto<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// World-from-camera.
    pub rotation: UnitQuaternion<f64>,
    /// From the known place to its centre, at scale one.
    pub step: Vector3<f64>,
    /// Its pixels.
    pub pyramid: Arc<ImagePyramid>,
}

/// A spot of a wall that a photo shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WallSight {
    /// Index of the photo.
    pub photo: usize,
    /// Where it shows the spot.
    pub place: Place,
    /// The spot.
    pub position: Vector3<f64>,
    /// What is not known of that.
    pub covariance: Matrix3<f64>,
}

/// The scale at which photos show most of a scene's walls.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ScaleByWalls {
    /// The scale.
    pub scale: f64,
    /// Patches that look alike there.
    pub found: usize,
    /// The most that do at any scale far from it.
    pub by_chance: usize,
    /// These patches.
    pub sights: Vec<WallSight>,
}

/// Seeks the scale at which `photos`, about a known place, show the walls of a scene as its `images` do.
///
/// `covariance` is that of a scene point; `load` gives the pixels of an image, `None` where they are not at hand. The answer is
/// the best there is: whether it stands out from chance is for the caller to judge. `None` where no wall is in sight.
pub fn scale_by_walls(
    scene: &Reconstruction,
    images: &[ImageId],
    covariance: impl Fn(PointId) -> Matrix3<f64>,
    load: impl Fn(ImageId) -> Option<Arc<ImagePyramid>>,
    place: &Vector3<f64>,
    photos: &[DistantPhoto<'_>],
) -> Option<ScaleByWalls> {
    let mut looks: Vec<Look<'_>> = images
        .iter()
        .filter_map(|&image| Look::new(scene, image, &covariance, load(image)?))
        .filter(|look| !look.walls.is_empty())
        .collect();
    // Names and order of the images say nothing.
    looks.sort_by_key(|look| look.image);
    let mut distances: Vec<f64> = looks.iter().flat_map(|look| look.distances(place)).collect();
    distances.sort_by(f64::total_cmp);
    let distance = *distances.get(distances.len() / 2)?;
    let longest = photos.iter().map(|photo| photo.step.norm()).fold(0.0, f64::max);
    if !(longest > 0.0 && distance > 0.0) {
        return None;
    }
    let spots: Vec<Vec<Spot>> = photos.iter().map(|photo| photo.spots(place)).collect();
    let sweep = Sweep { looks: &looks, place, photos, spots: &spots };
    let [first, last] = STEPS.map(|step| step * distance / longest);
    let count = ((last / first).ln() / SCALE_STEP.ln()) as i32;
    let scales: Vec<f64> = (0..=count).map(|step| first * SCALE_STEP.powi(step)).collect();
    let shown: Vec<(usize, f64)> = scales.iter().map(|&scale| sweep.shown(scale)).collect();
    let best = (0..scales.len()).max_by(|&a, &b| shown[a].1.total_cmp(&shown[b].1).then(b.cmp(&a)))?;
    let is_apart = |at: &usize| (scales[*at] / scales[best]).ln().abs() > APART.ln();
    let by_chance = (0..scales.len()).filter(is_apart).map(|at| shown[at].0).max().unwrap_or(0);
    let fine = (-FINE_STEPS..=FINE_STEPS).map(|step| scales[best] * FINE_STEP.powi(step));
    let (scale, (found, _)) = fine
        .map(|scale| (scale, sweep.shown(scale)))
        .reduce(|best, next| if next.1.1 > best.1.1 { next } else { best })?;
    Some(ScaleByWalls { scale, found, by_chance, sights: sweep.sights(scale) })
}

impl DistantPhoto<'_> {
    fn view(&self, place: &Vector3<f64>, scale: f64) -> View<'_> {
        let world_from_camera = Rigid::new(self.rotation, place + self.step * scale);
        View { camera: self.camera, world_from_camera, pyramid: Arc::clone(&self.pyramid) }
    }

    /// Its patches that have texture.
    fn spots(&self, place: &Vector3<f64>) -> Vec<Spot> {
        let view = self.view(place, 1.0);
        let spot = |piece: Piece| {
            let frame = PatchFrame {
                center: piece.pixel,
                pixel_from_patch: Matrix2::identity() * (view.step_px() * COARSER),
                curvature: [Matrix2::zeros(); 2],
            };
            let coarse = Template::new(&COARSE, Patch::cut(&COARSE, &view.pyramid, &frame)?)?;
            Some(Spot { piece, coarse })
        };
        view.pieces(SPACING, |_, _| true).into_iter().filter_map(spot).collect()
    }
}

/// A patch of a photo, in fine samples and in few coarse ones.
struct Spot {
    piece: Piece,
    coarse: Template,
}

/// Steps of a fine patch in one of a coarse one.
const COARSER: f64 = PATCH.radius as f64 / COARSE.radius as f64;

fn coarser(frame: &PatchFrame) -> PatchFrame {
    PatchFrame {
        center: frame.center,
        pixel_from_patch: frame.pixel_from_patch * COARSER,
        curvature: frame.curvature.map(|curvature| curvature * COARSER.powi(2)),
    }
}

/// A wall as one image shows it.
struct Wall {
    /// In the world's axes, from the image's centre.
    plane: Plane,
    /// Directions in which it is, by their cell.
    cells: Vec<bool>,
}

/// An image of the scene and the walls that it shows.
struct Look<'a> {
    image: ImageId,
    view: View<'a>,
    walls: Vec<Wall>,
}

/// Cells of directions, across and down.
fn cells() -> [i64; 2] {
    let across = (std::f64::consts::TAU / CELL_RAD).ceil() as i64;
    [across, (across + 1) / 2]
}

fn cell_of(direction: &Vector3<f64>) -> [i64; 2] {
    let [across, down] = cells();
    let longitude = direction.x.atan2(direction.z) / std::f64::consts::TAU + 0.5;
    let latitude = direction.y.atan2(direction.x.hypot(direction.z)) / std::f64::consts::PI + 0.5;
    let cell = |share: f64, count: i64| ((share * count as f64) as i64).clamp(0, count - 1);
    [cell(longitude, across), cell(latitude, down)]
}

impl<'a> Look<'a> {
    fn new(
        scene: &'a Reconstruction,
        image: ImageId,
        covariance: &impl Fn(PointId) -> Matrix3<f64>,
        pyramid: Arc<ImagePyramid>,
    ) -> Option<Self> {
        let world_from_camera = scene.images.get(image.index())?.world_from_camera?;
        let center = world_from_camera.translation;
        let seen = |(at, point): (usize, &ReconstructionPoint)| {
            let is_seen = point.track.iter().any(|seen| seen.image == image);
            is_seen.then(|| SeenPoint::known(point.position - center, covariance(PointId(at as u32))))?
        };
        let points: Vec<SeenPoint> = scene.points.iter().enumerate().filter_map(seen).collect();
        let down = scene.down();
        let is_wall = |plane: &Plane| down.is_none_or(|down| plane.normal.dot(&down).abs() <= MAX_LYING);
        let planes = find_planes(&points, MIN_WALL_POINTS, SEED).into_iter().filter(is_wall);
        let walls = planes.map(|plane| {
            let [across, down] = cells();
            let mut cells = vec![false; (across * down) as usize];
            for &member in &plane.members {
                let [x, y] = cell_of(&points[member].position);
                for (dx, dy) in (-BEYOND..=BEYOND).flat_map(|dx| (-BEYOND..=BEYOND).map(move |dy| (dx, dy))) {
                    let (x, y) = ((x + dx).rem_euclid(across), (y + dy).clamp(0, down - 1));
                    cells[(y * across + x) as usize] = true;
                }
            }
            Wall { plane, cells }
        });
        let walls = walls.collect();
        let camera = scene.camera_of(image);
        Some(Self { image, view: View { camera, world_from_camera, pyramid }, walls })
    }

    /// How far the walls are from a place.
    fn distances<'s>(&'s self, place: &'s Vector3<f64>) -> impl Iterator<Item = f64> + 's {
        let center = self.view.world_from_camera.translation;
        self.walls.iter().map(move |wall| (wall.plane.centroid() + center - place).norm())
    }

    /// The wall that a photo has along a ray, and how far: the nearest that this image shows there.
    fn wall_along(&self, from: &Vector3<f64>, direction: &Vector3<f64>) -> Option<(&Wall, f64)> {
        let center = self.view.world_from_camera.translation;
        let [across, _] = cells();
        let met = self.walls.iter().filter_map(|wall| {
            let slant = wall.plane.normal.dot(direction);
            let depth = (wall.plane.distance - wall.plane.normal.dot(&(from - center))) / slant;
            let spot = from + direction * depth - center;
            let [x, y] = cell_of(&spot);
            let is_near = depth > 0.0 && slant > MIN_SLANT && wall.cells[(y * across + x) as usize];
            (is_near && wall.plane.normal.dot(&spot) > MIN_SLANT * spot.norm()).then_some((wall, depth))
        });
        met.reduce(|a, b| if b.1 < a.1 { b } else { a })
    }
}

struct Sweep<'a> {
    looks: &'a [Look<'a>],
    place: &'a Vector3<f64>,
    photos: &'a [DistantPhoto<'a>],
    spots: &'a [Vec<Spot>],
}

/// A patch of a photo laid over an image.
struct Laid<'a> {
    look: &'a Look<'a>,
    wall: &'a Wall,
    /// The wall in the photo's frame.
    plane: Ground,
    correlation: f64,
}

impl<'a> Sweep<'a> {
    /// How many patches look alike at a scale, and by how much more than is asked.
    fn shown(&self, scale: f64) -> (usize, f64) {
        let alike = |photo: usize, spot: &Spot| {
            let laid = self.laid(photo, spot, scale)?;
            (laid.correlation >= MIN_ALIKE).then_some(laid.correlation - MIN_ALIKE / 2.0)
        };
        let of_photo = |photo: usize| -> Vec<f64> {
            self.spots[photo].par_iter().with_min_len(64).filter_map(|spot| alike(photo, spot)).collect()
        };
        let all: Vec<f64> = (0..self.photos.len()).flat_map(of_photo).collect();
        (all.len(), all.iter().sum())
    }

    /// A patch of a photo laid over the image that shows it most alike.
    fn laid(&self, photo: usize, Spot { piece, coarse }: &Spot, scale: f64) -> Option<Laid<'a>> {
        let view = self.photos[photo].view(self.place, scale);
        let direction = view.world_from_camera.rotation * piece.bearing;
        let over = |look: &'a Look<'a>| {
            let (wall, depth) = look.wall_along(&view.world_from_camera.translation, &direction)?;
            let normal = view.world_from_camera.rotation.inverse() * wall.plane.normal;
            let ground = Ground { normal, distance: depth * normal.dot(&piece.bearing) };
            let other_from_self = look.view.world_from_camera.inverse() * view.world_from_camera;
            let frame = look.view.frame_of(&other_from_self, &ground, &piece.stencil)?;
            if coarse.correlation(&look.view.pyramid, &coarser(&frame))? < MIN_COARSE {
                return None;
            }
            let correlation = piece.template.correlation(&look.view.pyramid, &frame)?;
            Some(Laid { look, wall, plane: ground, correlation })
        };
        self.looks.iter().filter_map(over).reduce(|a, b| if b.correlation > a.correlation { b } else { a })
    }

    /// The patches that look alike at a scale, where the images show them.
    fn sights(&self, scale: f64) -> Vec<WallSight> {
        let of_photo = |photo: usize| -> Vec<WallSight> {
            let view = self.photos[photo].view(self.place, scale);
            let sight = |spot: &Spot| {
                let (position, covariance) =
                    self.place_of(&view, &spot.piece, &self.laid(photo, spot, scale)?)?;
                let place = Place { pixel: spot.piece.pixel, noise_px: PLACE_SIGMA * view.step_px() };
                Some(WallSight { photo, place, position, covariance: covariance * ALIKE })
            };
            self.spots[photo].par_iter().filter_map(sight).collect()
        };
        (0..self.photos.len()).flat_map(of_photo).collect()
    }

    /// Where a patch is that looks alike, and what is not known of that: where the rays of all images that show it meet, or,
    /// where one does, on the wall as far as that is a plane.
    fn place_of(
        &self,
        view: &View<'_>,
        piece: &Piece,
        laid: &Laid<'_>,
    ) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let ray_of = |look: &Look<'_>| {
            let other_from_self = look.view.world_from_camera.inverse() * view.world_from_camera;
            let frame = look.view.frame_of(&other_from_self, &laid.plane, &piece.stencil)?;
            let found = piece.template.align(&look.view.pyramid, &frame, MIN_FIRST)?;
            let off = (found.pixel - frame.center).norm();
            let is_alike = found.correlation >= MIN_CORRELATION && off <= MAX_OFF * frame.spacing();
            let (bearing, pixel_angle) = look.view.camera.ray(&found.pixel).filter(|_| is_alike)?;
            let sigma = PLACE_SIGMA * frame.spacing() * pixel_angle;
            Some(WorldRay::new(&look.view.world_from_camera, &bearing, sigma))
        };
        let own = ray_of(laid.look)?;
        let others = self.looks.iter().filter(|look| look.image != laid.look.image);
        let rays: Vec<WorldRay> = std::iter::once(own).chain(others.filter_map(ray_of)).collect();
        let center = own.origin;
        let offset = own.direction * laid.wall.plane.depth_along(&own.direction)?;
        let off_plane = (laid.wall.plane.relative_sigma(&offset).hypot(RELIEF)) * offset.norm();
        let fits = |position: &Vector3<f64>| {
            rays.iter().all(|ray| ray.angular_error(position) <= MAX_SIGMAS * ray.sigma)
        };
        let met = triangulate(&rays).filter(|position| rays.len() > 1 && fits(position));
        let met = met.and_then(|position| Some((position, SeenPoint::new(&center, &position, &rays)?)));
        if let Some((position, seen)) = met
            && seen.along(&own.direction) < off_plane
        {
            return Some((position, seen.covariance));
        }
        let along = own.direction * own.direction.transpose();
        let across = (own.sigma * offset.norm()).powi(2);
        let covariance = (Matrix3::identity() - along) * across + along * off_plane.powi(2);
        Some((center + offset, covariance))
    }
}
