//! Whether photos show the scene's surfaces as its images do.
//!
//! Matches tell that a photo shows some of what a place shows, not that it shows the place: posters of one series share a title and a
//! row of icons, and a photo of one has a pose before another that all of these agree on. What tells them apart is the rest of the
//! poster. A photo's place is on a surface of the scene where a point that the photos of a set have triangulated is as far away as the
//! scene's points about it: nothing is in between, whatever else hides the scene. There its pixels look as those of the scene's images
//! do, under any light, and no more than by chance where the place is another.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use setloc_features::{Camera, ImagePyramid, Patch, PatchFrame, PatchParams, Template};

use crate::{
    ImageId, Reconstruction, Rigid,
    ground::{
        floor::Ground,
        sight::{View, step_px},
    },
};

/// How near to a place scene points are looked for, and how many of the nearest.
const REACH_RAD: f64 = 0.04;
const NEAREST: usize = 12;
/// How many of these must be as far away as the place, and what that is, as a difference of logarithms.
const MIN_NEAR: usize = 3;
const SAME_SURFACE: f64 = 0.05;
/// How many of these an image must see to show the surface; it shows it alike where its pixels there are up to this factor of a
/// patch's steps, and up to this angle aside.
const MIN_SEEN: usize = 2;
const MAX_SIZE: f64 = 2.0;
const MIN_COSINE: f64 = 0.75;
/// What a doubling of the size is worth as a difference of cosines.
const SIZE_WORTH: f64 = 0.2;
/// How far the surface may be tilted where hardly any point tells: it faces the photo else.
const FACING: f64 = 0.1 * REACH_RAD * REACH_RAD;
/// Most images of the scene that a photo is compared with, and most of its places.
const MAX_IMAGES: usize = 3;
const MAX_PLACES: usize = 240;
/// Patches that are compared, and the coarser ones by which the best place for that is found: poses are off by some pixels.
const PATCH: PatchParams =
    PatchParams { radius: 8, max_iterations: 0, min_correlation: 0.0, max_distortion: 1.0 };
const COARSE: PatchParams = PatchParams { radius: 4, ..PATCH };
const COARSER: f64 = PATCH.radius as f64 / COARSE.radius as f64;
/// How far about the expected place, in steps of the coarser patch.
const SEARCH: i32 = 2;
/// How far aside, in steps of a patch, what is found is found by chance.
const ASIDE: f64 = 24.0;
/// Correlation from which on patches look alike.
const MIN_ALIKE: f64 = 0.7;

/// A photo whose pose is in question.
#[derive(Debug, Clone)]
pub struct PlacedPhoto<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// Its pose, world-from-camera.
    pub world_from_camera: Rigid,
}

/// A place of a photo that is on a surface of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePlace {
    /// The image of the scene that shows the surface most as the photo does.
    pub image: ImageId,
    pixel: Vector2<f64>,
    /// Normal over distance of the surface, in the photo's frame.
    plane: Vector3<f64>,
}

/// How much of what photos show looks as in the scene's images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Likeness {
    /// Places that were compared.
    pub compared: usize,
    /// How many of these look alike.
    pub alike: usize,
    /// Places aside that were compared with them, where what looks alike does so by chance.
    pub compared_aside: usize,
    /// How many of these look alike.
    pub alike_aside: usize,
}

impl Likeness {
    /// With what is known of further photos.
    pub fn and(&self, other: &Self) -> Self {
        Self {
            compared: self.compared + other.compared,
            alike: self.alike + other.alike,
            compared_aside: self.compared_aside + other.compared_aside,
            alike_aside: self.alike_aside + other.alike_aside,
        }
    }

    /// The share of places that look alike by chance.
    pub fn by_chance(&self) -> f64 {
        self.alike_aside as f64 / self.compared_aside.max(1) as f64
    }

    /// The share of places that look alike, of those that do not do so by chance.
    pub fn share(&self) -> f64 {
        let share = self.alike as f64 / self.compared.max(1) as f64;
        (share - self.by_chance()) / (1.0 - self.by_chance()).max(f64::EPSILON)
    }

    fn count(&mut self, compared: &Compared) {
        self.compared += 1;
        self.alike += usize::from(compared.here);
        for is_alike in compared.aside.iter().flatten() {
            self.compared_aside += 1;
            self.alike_aside += usize::from(*is_alike);
        }
    }
}

/// A scene point in sight of a photo.
struct InSight {
    point: usize,
    bearing: Vector3<f64>,
    distance: f64,
}

/// The places of a photo that are on surfaces of the scene, of those where it shows `shown`, which are in the scene's frame.
pub fn places_on_surfaces(
    scene: &Reconstruction,
    photo: &PlacedPhoto<'_>,
    shown: &[Vector3<f64>],
) -> Vec<SurfacePlace> {
    if shown.is_empty() {
        return Vec::new();
    }
    let camera_from_world = photo.world_from_camera.inverse();
    let in_sight = |point: usize| {
        let at = camera_from_world.transform_point(&scene.points[point].position);
        let bearing = at.try_normalize(0.0)?;
        photo.camera.project(&bearing).filter(|pixel| photo.camera.contains(pixel))?;
        Some(InSight { point, bearing, distance: at.norm() })
    };
    let in_sight: Vec<InSight> =
        (0..scene.points.len()).into_par_iter().with_min_len(256).filter_map(in_sight).collect();
    let place = |position| photo.place_on_surface(scene, &in_sight, position);
    let mut places: Vec<SurfacePlace> = shown.par_iter().filter_map(place).collect();
    let mut by_image: BTreeMap<ImageId, usize> = BTreeMap::new();
    for place in &places {
        *by_image.entry(place.image).or_default() += 1;
    }
    let mut images: Vec<ImageId> = by_image.keys().copied().collect();
    images.sort_by_key(|image| (Reverse(by_image[image]), *image));
    images.truncate(MAX_IMAGES);
    places.retain(|place| images.contains(&place.image));
    let every = places.len().div_ceil(MAX_PLACES).max(1);
    places.into_iter().step_by(every).collect()
}

impl PlacedPhoto<'_> {
    fn place_on_surface(
        &self,
        scene: &Reconstruction,
        in_sight: &[InSight],
        position: &Vector3<f64>,
    ) -> Option<SurfacePlace> {
        let at = self.world_from_camera.inverse().transform_point(position);
        let (bearing, distance) = (at.try_normalize(0.0)?, at.norm());
        let pixel = self.camera.project(&bearing).filter(|pixel| self.camera.contains(pixel))?;
        let step = self.camera.pixel_angle(&pixel).filter(|angle| *angle > 0.0)? * step_px(self.camera);
        let reach = REACH_RAD.cos();
        let mut near: Vec<(f64, &InSight)> = in_sight
            .iter()
            .map(|other| (other.bearing.dot(&bearing), other))
            .filter(|(cosine, _)| *cosine > reach)
            .collect();
        near.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.point.cmp(&b.1.point)));
        near.truncate(NEAREST);
        near.retain(|(_, other)| (other.distance / distance).ln().abs() < SAME_SURFACE);
        if near.len() < MIN_NEAR {
            return None;
        }
        let own = position - self.world_from_camera.translation;
        let likeness = |image: ImageId| {
            let pose = scene.images[image.index()].world_from_camera?;
            let camera = scene.camera_of(image);
            let theirs = position - pose.translation;
            let pixel = camera.project(&pose.inverse().transform_point(position))?;
            let size = theirs.norm() * camera.pixel_angle(&pixel)? / (distance * step);
            let cosine = own.dot(&theirs) / (own.norm() * theirs.norm());
            let is_alike = cosine > MIN_COSINE && size.ln().abs() < MAX_SIZE.ln();
            is_alike.then(|| cosine - SIZE_WORTH * size.log2().abs())
        };
        let mut seen_by: BTreeMap<ImageId, usize> = BTreeMap::new();
        for seen in near.iter().flat_map(|(_, other)| &scene.points[other.point].track) {
            *seen_by.entry(seen.image).or_default() += 1;
        }
        let images = seen_by.into_iter().filter(|(_, count)| *count >= MIN_SEEN);
        let (_, image) = images
            .filter_map(|(image, _)| Some((likeness(image)?, image)))
            .reduce(|best, next| if next.0 > best.0 { next } else { best })?;
        let facing = bearing / distance;
        let (mut square, mut pull) = (Matrix3::identity() * FACING, Vector3::zeros());
        for (_, other) in &near {
            square += other.bearing * other.bearing.transpose();
            pull += other.bearing * (other.distance.recip() - facing.dot(&other.bearing));
        }
        let tilt = square.cholesky().map(|square| square.solve(&pull));
        let tilted = facing + tilt.unwrap_or_default();
        let agrees = (tilted.dot(&bearing) * distance).ln().abs() < SAME_SURFACE;
        Some(SurfacePlace { image, pixel, plane: if agrees { tilted } else { facing } })
    }
}

/// How much of what a photo of these pixels shows at `places` looks as in the scene's images.
///
/// `load` gives the pixels of an image, `None` where they are not at hand.
pub fn likeness_of(
    scene: &Reconstruction,
    (photo, pyramid): (&PlacedPhoto<'_>, &Arc<ImagePyramid>),
    places: &[SurfacePlace],
    load: impl Fn(ImageId) -> Option<Arc<ImagePyramid>>,
) -> Likeness {
    let own = View {
        camera: photo.camera,
        world_from_camera: photo.world_from_camera,
        pyramid: Arc::clone(pyramid),
    };
    let mut by_image: BTreeMap<ImageId, Vec<(usize, &SurfacePlace)>> = BTreeMap::new();
    for (at, place) in places.iter().enumerate() {
        by_image.entry(place.image).or_default().push((at, place));
    }
    let mut likeness = Likeness::default();
    for (image, places) in by_image {
        let Some(world_from_camera) = scene.images[image.index()].world_from_camera else { continue };
        let Some(pyramid) = load(image) else { continue };
        let other = View { camera: scene.camera_of(image), world_from_camera, pyramid };
        let looked: Vec<Compared> =
            places.par_iter().filter_map(|&(at, place)| Compared::new(&own, &other, place, at)).collect();
        for compared in &looked {
            likeness.count(compared);
        }
    }
    likeness
}

/// Whether a place looks alike, and two aside.
struct Compared {
    here: bool,
    aside: [Option<bool>; 2],
}

impl Compared {
    /// `number` turns the direction to what is aside.
    fn new(own: &View<'_>, other: &View<'_>, place: &SurfacePlace, number: usize) -> Option<Self> {
        let step = own.step_px();
        let cut = |params: &PatchParams, step: f64| {
            let frame = PatchFrame {
                center: place.pixel,
                pixel_from_patch: Matrix2::identity() * step,
                curvature: [Matrix2::zeros(); 2],
            };
            Template::new(params, Patch::cut(params, &own.pyramid, &frame)?)
        };
        let distance = place.plane.norm().recip();
        let surface = Ground { normal: place.plane * distance, distance };
        let other_from_own = other.world_from_camera.inverse() * own.world_from_camera;
        let sought = Sought {
            fine: cut(&PATCH, step)?,
            coarse: cut(&COARSE, step * COARSER)?,
            pyramid: &other.pyramid,
            frame: other.frame_of(&other_from_own, &surface, &own.stencil(&place.pixel))?,
        };
        let here = sought.is_alike_about(Vector2::zeros())?;
        let turn = (number % 8) as f64 * std::f64::consts::FRAC_PI_4;
        let aside = Vector2::new(turn.cos(), turn.sin()) * ASIDE;
        Some(Self { here, aside: [aside, -aside].map(|aside| sought.is_alike_about(aside)) })
    }
}

/// A patch of a photo and where an image should show it.
struct Sought<'a> {
    fine: Template,
    coarse: Template,
    pyramid: &'a ImagePyramid,
    frame: PatchFrame,
}

impl Sought<'_> {
    /// Whether the image shows it within the search of a place so many steps aside; `None` where that is beyond its edge.
    fn is_alike_about(&self, aside: Vector2<f64>) -> Option<bool> {
        let (_, found) = self.best_about(aside, SEARCH, COARSER)?;
        let (correlation, _) = self.best_about(found, 1, 1.0)?;
        Some(correlation >= MIN_ALIKE)
    }

    /// The shift of greatest correlation of those up to so many steps about a middle; by the coarse patch where these are its steps.
    fn best_about(&self, middle: Vector2<f64>, reach: i32, step: f64) -> Option<(f64, Vector2<f64>)> {
        let template = if step > 1.0 { &self.coarse } else { &self.fine };
        let shifts = (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| (x, y)));
        let tried = shifts.filter_map(|(x, y)| {
            let shift = middle + Vector2::new(f64::from(x), f64::from(y)) * step;
            let frame = PatchFrame {
                center: self.frame.center + self.frame.pixel_from_patch * shift,
                pixel_from_patch: self.frame.pixel_from_patch * step,
                curvature: self.frame.curvature.map(|curvature| curvature * step.powi(2)),
            };
            Some((template.correlation(self.pyramid, &frame)?, shift))
        });
        tried.reduce(|best, next| if next.0 > best.0 { next } else { best })
    }
}
