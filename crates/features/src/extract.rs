use std::cmp::Ordering;

use serde::{Deserialize, Serialize};

use crate::error::check;
use crate::sift::{SiftParams, SiftPoint, detect_and_describe};
use crate::{
    Camera, DESCRIPTOR_NORM, DecodedImage, FeatureError, GreyImage, ImageFeatures, Keypoint, Mask,
    SimulatedView,
};

/// How to detect and describe points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FeatureParams {
    /// Most keypoints per image.
    pub max_features: usize,
    /// Longest side in pixels at which points are detected, but for `enlargement`; larger images are reduced first. Detection of
    /// a 4096 × 2048 panorama takes about 0.2 GB, in proportion to its pixels.
    pub max_side: u32,
    /// How many times its size an image that is no longer than `max_side` is made before points are detected, and larger ones to
    /// match.
    ///
    /// With `sigma_px` it says how fine points may be: the first scale is a blur of `sigma_px / enlargement` pixels of the image.
    pub enlargement: f64,
    /// Least contrast of a keypoint, as OpenCV scales it; lower gives more and weaker points.
    pub contrast_threshold: f64,
    /// Keypoints below which weaker ones are taken in, down to a quarter of `contrast_threshold`: bare walls have little
    /// contrast, and all that there is. 0 never does; never more than `max_features`.
    pub min_features: usize,
    /// Largest ratio of principal curvatures; lower drops more points on edges.
    pub edge_threshold: f64,
    /// Scales per octave.
    pub octave_layers: u32,
    /// Blur of the first scale in pixels of the enlarged image.
    pub sigma_px: f64,
    /// Share in [0, 1] of the keypoints that is spread evenly over the image (over the sphere, for panoramas); the
    /// rest goes to the strongest wherever they are.
    pub even_share: f64,
    /// Half angle in degrees of a cone about straight down that gives no keypoints (car, tripod); panoramas only.
    pub nadir_cone_deg: f64,
    /// Tilt whose view of the surfaces is simulated besides the image itself: points are also detected in the image
    /// squeezed by this factor along x, and along y. 1 simulates none.
    ///
    /// SIFT bears about 45° between the directions of sight; a wall seen straight on and the same wall seen along the
    /// street differ by far more. Squeezing one of the two photos makes up for it (J.-M. Morel, G. Yu, "ASIFT: A new
    /// framework for fully affine invariant image comparison", SIAM J. Imaging Sciences 2009). A tilt of 2 is 60°.
    pub simulated_tilt: f64,
    /// The same for images with fewer than `min_features` keypoints of the usual contrast, where it is the larger.
    ///
    /// Rooms are small and bare: what two panoramas share of them they see from directions far apart, and any match counts.
    pub faint_tilt: f64,
}

impl FeatureParams {
    /// Changes whenever the same parameters and pixels give other features.
    ///
    /// 1: OpenCV SIFT, RootSIFT u8, half-pixel corrected, seam padded, spread over the sphere.
    /// 2: own SIFT, bright and dark spots apart. 3: simulated views. 4: large simulated views without their finest points.
    /// 5: weaker keypoints where there are few. 6: keypoints end at most five pixels from where they begin to be sought.
    /// 7: simulated views where there are few. 8: described on layers that are kept in steps of 1/256. 9: enlarged by a quarter in
    /// place of doubled. 10: black and white beside steep edges stay what they are.
    pub const VERSION: u32 = 10;

    /// Whether [`extract_simulated_views`] finds more in an image than `own`: views of faint images are simulated from the first.
    pub fn adds_views_to(&self, own: &ImageFeatures) -> bool {
        own.simulated.is_empty() || self.simulated_tilt > self.faint_tilt
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`FeatureError::InvalidParameter`] with the value at fault.
    pub fn validate(&self) -> Result<(), FeatureError> {
        let positive = |name, value: f64| check(name, value, "positive", value > 0.0 && value.is_finite());
        check(
            "max_features",
            self.max_features as f64,
            "1 to 1000000",
            (1..=1_000_000).contains(&self.max_features),
        )?;
        check("max_side", self.max_side.into(), "32 to 32768", (32..=32_768).contains(&self.max_side))?;
        check("enlargement", self.enlargement, "1 to 4", (1.0..=4.0).contains(&self.enlargement))?;
        positive("contrast_threshold", self.contrast_threshold)?;
        positive("edge_threshold", self.edge_threshold)?;
        check("octave_layers", self.octave_layers.into(), "1 to 10", (1..=10).contains(&self.octave_layers))?;
        check("sigma_px", self.sigma_px, "0.5 to 10", (0.5..=10.0).contains(&self.sigma_px))?;
        check("even_share", self.even_share, "in [0, 1]", (0.0..=1.0).contains(&self.even_share))?;
        check(
            "nadir_cone_deg",
            self.nadir_cone_deg,
            "in [0, 90]",
            (0.0..=90.0).contains(&self.nadir_cone_deg),
        )?;
        let in_range = (1.0..=8.0).contains(&self.simulated_tilt);
        check("simulated_tilt", self.simulated_tilt, "in [1, 8]", in_range)?;
        check("faint_tilt", self.faint_tilt, "in [1, 8]", (1.0..=8.0).contains(&self.faint_tilt))
    }
}

impl Default for FeatureParams {
    fn default() -> Self {
        Self {
            max_features: 16384,
            max_side: 4096,
            enlargement: 1.25,
            contrast_threshold: 0.04,
            min_features: 4096,
            edge_threshold: 10.0,
            octave_layers: 3,
            sigma_px: 1.0,
            even_share: 0.6,
            nadir_cone_deg: 0.0,
            simulated_tilt: 1.0,
            faint_tilt: 2.0,
        }
    }
}

/// Columns repeated beyond the seam, as a share of the width: keypoints up to about 1/40 of the width across are
/// described from the same pixels as anywhere else.
const SEAM_SHARE: usize = 24;
/// A simulated view of more pixels is halved for detection: its finest points are hardly ever what a pair lacks that needs it, and
/// cost three quarters of the time. Smaller photos need all that they have.
const FULL_VIEW_PIXELS: f64 = 800_000.0;
/// Contrast of the weakest keypoints of images that have few, as a share of the usual.
const WEAK_CONTRAST: f64 = 0.25;
/// Cells along the longer side of the grid that spreads keypoints.
const CELLS: usize = 16;
/// Detects SIFT keypoints and describes them as RootSIFT.
///
/// R. Arandjelović, A. Zisserman, "Three things everyone should know to improve object retrieval", CVPR 2012: the
/// square root of the L1-normalized descriptor, here times [`DESCRIPTOR_NORM`], rounded and clipped at 255, so all
/// stored descriptors have about one length and squared distances are exact integers.
///
/// A panorama that closes on itself is extended over its seam for detection and only keypoints inside are kept:
/// nothing is lost or doubled there, but for what lies within a tenth of a pixel of it. Keypoints are chosen for
/// strength and spread (see [`FeatureParams::even_share`]) and come strongest first. A point with two orientations is
/// two keypoints. `mask` pixels of 0 give no keypoints. An image without texture gives empty features.
///
/// Single-threaded: callers work on several images in parallel.
///
/// # Errors
/// [`FeatureError::InvalidParameter`], [`FeatureError::InvalidCamera`], [`FeatureError::SizeMismatch`] if the camera
/// is of another image size, [`FeatureError::Detector`] if OpenCV fails.
pub fn extract(
    params: &FeatureParams,
    image: &DecodedImage,
    camera: &Camera,
    mask: Option<&Mask>,
) -> Result<ImageFeatures, FeatureError> {
    extract_beside(params, image, camera, mask, None)
}

/// What [`extract`] finds in an image in which it found `own` without simulated views: with the same parameters, but with a
/// [`simulated_tilt`](FeatureParams::simulated_tilt) of 1.
///
/// # Errors
/// Those of [`extract`].
pub fn extract_simulated_views(
    params: &FeatureParams,
    image: &DecodedImage,
    camera: &Camera,
    mask: Option<&Mask>,
    own: &ImageFeatures,
) -> Result<ImageFeatures, FeatureError> {
    extract_beside(params, image, camera, mask, Some(own))
}

/// [`extract`], with what it finds without simulated views but those of faint images, where that is known.
fn extract_beside(
    params: &FeatureParams,
    image: &DecodedImage,
    camera: &Camera,
    mask: Option<&Mask>,
    known: Option<&ImageFeatures>,
) -> Result<ImageFeatures, FeatureError> {
    params.validate()?;
    camera.validate()?;
    let (width, height) = (image.width, image.height);
    if (camera.width, camera.height) != (width, height) {
        return Err(FeatureError::SizeMismatch {
            what: "camera",
            expected_width: width,
            expected_height: height,
            width: camera.width,
            height: camera.height,
        });
    }
    if let Some(own) = known
        && !params.adds_views_to(own)
    {
        return Ok(own.clone());
    }
    let padding = if camera.wraps_around() { width as usize / SEAM_SHARE } else { 0 };
    let reduction = (f64::from(params.max_side) / f64::from(width.max(height))).min(1.0);
    let whole = GreyImage::from(image).wrapped(padding);
    let size = [whole.width, whole.height];
    let share = params.enlargement * reduction;
    let enlargement = share.max(1.0);
    let grey = if share < 1.0 { whole.reduced([share; 2])? } else { whole };
    let source = Source {
        params,
        image,
        camera,
        mask,
        padding: padding as f32,
        size,
        pixel: reduction.recip() as f32,
    };
    let (mut features, is_faint) = if let Some(own) = known {
        (own.without_simulated_views(), !own.simulated.is_empty())
    } else {
        let mut features = ImageFeatures { width, height, ..ImageFeatures::default() };
        let view = View { grey: &grey, enlargement, tilt: [1.0; 2] };
        let (light, usual) = source.append_view(&view, params.max_features, &mut features);
        features.light = light;
        (features, usual < params.min_features.min(params.max_features))
    };
    let tilt = if is_faint { params.simulated_tilt.max(params.faint_tilt) } else { params.simulated_tilt };
    if tilt > 1.0 {
        for tilt in [[tilt, 1.0], [1.0, tilt]] {
            let pixels = enlargement.powi(2) * grey.values.len() as f64 / (tilt[0] * tilt[1]);
            let share = if pixels > FULL_VIEW_PIXELS { 0.5 * enlargement } else { enlargement };
            let squeezed = grey.reduced(tilt.map(|tilt| share.min(1.0) / tilt))?;
            let start = features.len() as u32;
            let view = View { grey: &squeezed, enlargement: share.max(1.0), tilt };
            let (light, _) = source.append_view(&view, params.max_features / 2, &mut features);
            features.simulated.push(SimulatedView { start, light });
        }
    }
    Ok(features)
}

/// What all views of an image are made from.
struct Source<'a> {
    params: &'a FeatureParams,
    image: &'a DecodedImage,
    camera: &'a Camera,
    mask: Option<&'a Mask>,
    /// Image pixels left of the image's first column.
    padding: f32,
    /// The image with these, in image pixels.
    size: [usize; 2],
    /// Image pixels per pixel of the image as `max_side` reduces it.
    pixel: f32,
}

/// What points are detected in.
struct View<'a> {
    grey: &'a GreyImage,
    enlargement: f64,
    /// By how much it is squeezed along x and y.
    tilt: [f64; 2],
}

impl Source<'_> {
    /// Detects in one view and appends at most `budget` keypoints. Returns how many of them are light, and how many there are
    /// of the usual contrast, chosen or not.
    fn append_view(&self, view: &View<'_>, budget: usize, features: &mut ImageFeatures) -> (u32, usize) {
        let View { grey, enlargement, tilt } = *view;
        let Self { params, image, camera, .. } = self;
        let (width, height) = (image.width, image.height);
        // In proportion to what the view may have at most.
        let fewest = params.min_features.min(params.max_features) * budget / params.max_features;
        let is_usual = |candidate: &Candidate| {
            f64::from(candidate.response) * f64::from(params.octave_layers) >= params.contrast_threshold
        };
        let sift = SiftParams {
            contrast_threshold: params.contrast_threshold,
            weak_contrast_threshold: WEAK_CONTRAST * params.contrast_threshold,
            min_points: fewest,
            edge_threshold: params.edge_threshold,
            octave_layers: params.octave_layers as usize,
            sigma_px: params.sigma_px,
            // What lenses and interpolation have blurred already is not taken off: the finest scale would be left with their noise.
            image_sigma_px: 0.0,
            enlargement,
        };
        let scale = [self.size[0] as f32 / grey.width as f32, self.size[1] as f32 / grey.height as f32];
        let in_image = |x: f32, y: f32| (x * scale[0] - self.padding, y * scale[1]);
        let nadir = (params.nadir_cone_deg > 0.0 && camera.is_panoramic())
            .then(|| params.nadir_cone_deg.to_radians().cos());
        let allows = |x: f32, y: f32| {
            let (x, y) = in_image(x, y);
            let inside = (0.0..width as f32).contains(&x) && (0.0..height as f32).contains(&y);
            let ray = || camera.unproject(&nalgebra::Vector2::new(x.into(), y.into()));
            inside
                && self.mask.is_none_or(|mask| mask.allows(x, y, width, height))
                && nadir.is_none_or(|limit| ray().is_none_or(|ray| ray.y < limit))
        };
        let mut usual_count = 0;
        let choose = |points: &[SiftPoint]| {
            let candidate = |(index, point): (usize, &SiftPoint)| {
                let (x, y) = in_image(point.x, point.y);
                Candidate { index, x, y, response: point.response, is_light: point.is_light }
            };
            let mut candidates: Vec<Candidate> = points.iter().enumerate().map(candidate).collect();
            // A total order, so that the choice does not depend on the detector's.
            candidates.sort_by(|a, b| {
                b.response
                    .total_cmp(&a.response)
                    .then(a.y.total_cmp(&b.y))
                    .then(a.x.total_cmp(&b.x))
                    .then(a.index.cmp(&b.index))
            });
            let (usual, weaker) = candidates.split_at(candidates.partition_point(is_usual));
            usual_count = usual.len();
            let mut chosen = choose(budget, params.even_share, camera, usual);
            chosen.extend(choose(fewest.saturating_sub(usual.len()), params.even_share, camera, weaker));
            chosen.sort_by_key(|candidate| !candidate.is_light);
            chosen.iter().map(|candidate| candidate.index).collect()
        };
        let (points, descriptors) = detect_and_describe(&sift, grey.view(), allows, choose);
        // One figure for both axes of a squeezed view: their geometric mean.
        let size_scale = (scale[0] * scale[1]).sqrt();
        let pixel = self.pixel * (tilt[0] * tilt[1]).sqrt() as f32;
        for (point, descriptor) in points.iter().zip(&descriptors) {
            let (x, y) = in_image(point.x, point.y);
            let at = (y as usize * width as usize + x as usize) * 3;
            features.colors.push([image.rgb[at], image.rgb[at + 1], image.rgb[at + 2]]);
            let size = point.size * size_scale;
            let noise_px = keypoint_noise_px(size / pixel) * pixel;
            features.keypoints.push(Keypoint { x, y, size, orientation: point.orientation, noise_px });
            push_root_sift(descriptor, &mut features.descriptors);
        }
        (points.iter().filter(|point| point.is_light).count() as u32, usual_count)
    }
}

/// Expected standard deviation in pixels of the position of a keypoint with this diameter.
///
/// Grows linearly with the scale, since a larger region is located on a coarser grid, up to a diameter of 30 pixels.
/// The slope and the offset are twice those of the median epipolar deviation of correct matches on rendered
/// panoramas of exact pose, so that matches of real sensors and changing views, whose tails are longer, stay inside.
pub fn keypoint_noise_px(size: f32) -> f32 {
    0.2 + 0.07 * size.min(30.0)
}

struct Candidate {
    index: usize,
    x: f32,
    y: f32,
    response: f32,
    is_light: bool,
}

/// The strongest of each cell up to an even share, then the strongest of the rest; strongest first.
fn choose<'a>(
    budget: usize,
    even_share: f64,
    camera: &Camera,
    candidates: &'a [Candidate],
) -> Vec<&'a Candidate> {
    if candidates.len() <= budget {
        return candidates.iter().collect();
    }
    let grid = Grid::new(camera);
    let cells: Vec<usize> = candidates.iter().map(|candidate| grid.cell(camera, candidate)).collect();
    let mut counts = vec![0usize; grid.columns * grid.rows];
    for &cell in &cells {
        counts[cell] += 1;
    }
    let quota = cell_quota(&counts, (budget as f64 * even_share) as usize);
    let mut taken = vec![0usize; counts.len()];
    let mut kept = vec![false; candidates.len()];
    for (index, &cell) in cells.iter().enumerate() {
        if taken[cell] < quota {
            taken[cell] += 1;
            kept[index] = true;
        }
    }
    let mut left = budget - taken.iter().sum::<usize>();
    for kept in &mut kept {
        if left == 0 {
            break;
        }
        if !*kept {
            *kept = true;
            left -= 1;
        }
    }
    candidates.iter().zip(kept).filter(|(_, kept)| *kept).map(|(candidate, _)| candidate).collect()
}

/// The largest number per cell that keeps the sum within the budget: sparse cells leave their share to the others.
fn cell_quota(counts: &[usize], budget: usize) -> usize {
    let (mut low, mut high) = (0, budget);
    while low < high {
        let middle = (low + high).div_ceil(2);
        match counts.iter().map(|&count| count.min(middle)).sum::<usize>().cmp(&budget) {
            Ordering::Greater => high = middle - 1,
            _ => low = middle,
        }
    }
    low
}

/// Cells of equal solid angle for panoramas, of equal pixel area for photos.
struct Grid {
    columns: usize,
    rows: usize,
}

impl Grid {
    fn new(camera: &Camera) -> Self {
        let longer = f64::from(camera.width.max(camera.height));
        let cells = |side: u32| ((CELLS as f64 * f64::from(side) / longer).round() as usize).max(1);
        Self { columns: cells(camera.width), rows: cells(camera.height) }
    }

    fn cell(&self, camera: &Camera, candidate: &Candidate) -> usize {
        let x = f64::from(candidate.x) / f64::from(camera.width);
        let y = f64::from(candidate.y) / f64::from(camera.height);
        // Archimedes: equal steps of the sine of latitude are equal areas.
        let sine = |y: f64| {
            let pixel = nalgebra::Vector2::new(0.0, y);
            camera.unproject(&pixel).map_or(0.0, |ray| ray.y)
        };
        let y = if camera.is_panoramic() {
            let (top, bottom) = (sine(0.0), sine(camera.height.into()));
            (sine(candidate.y.into()) - top) / (bottom - top)
        } else {
            y
        };
        let place = |share: f64, cells: usize| ((share * cells as f64) as usize).min(cells - 1);
        place(y, self.rows) * self.columns + place(x, self.columns)
    }
}

/// Appends the square root of the L1-normalized descriptor in bytes.
fn push_root_sift(descriptor: &[f32], target: &mut Vec<u8>) {
    let sum: f32 = descriptor.iter().sum();
    let scale = if sum > 0.0 { f32::from(DESCRIPTOR_NORM) / sum.sqrt() } else { 0.0 };
    // The cast saturates at 255.
    target.extend(descriptor.iter().map(|value| (value.sqrt() * scale).round() as u8));
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::*;
    use crate::{DESCRIPTOR_LEN, MatchParams, Posture, match_features};

    /// In the middle of an octave: what lies just between two may be found in both.
    const BLOB: f64 = 4.7;
    /// How far from its centre a blob may be found: a fortieth of a pixel of the octave that it is found in.
    const NEAR: f64 = 0.08;

    /// Bright Gaussian blobs on grey, x periodic.
    fn blobs(width: u32, height: u32, centers: &[[f64; 2]]) -> DecodedImage {
        blobs_of(150.0, width, height, centers)
    }

    fn blobs_of(brightness: f64, width: u32, height: u32, centers: &[[f64; 2]]) -> DecodedImage {
        let mut rgb = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let mut value = 60.0;
                for center in centers {
                    let dx = (f64::from(x) + 0.5 - center[0]).abs();
                    let dx = dx.min(f64::from(width) - dx);
                    let dy = f64::from(y) + 0.5 - center[1];
                    value += brightness * (-(dx * dx + dy * dy) / (2.0 * BLOB * BLOB)).exp();
                }
                rgb.extend([value.min(255.0) as u8; 3]);
            }
        }
        DecodedImage::from_rgb(width, height, rgb).unwrap()
    }

    /// A reproducible picture with texture of several sizes everywhere.
    fn texture(width: u32, height: u32) -> DecodedImage {
        let wave = |x: u32, y: u32, a: u32, b: u32| f64::from(x * a + y * b) * 0.013;
        let rgb = (0..height)
            .flat_map(|y| {
                (0..width).flat_map(move |x| {
                    let (i, j) = (x / 6, y / 5);
                    let hash = (i.wrapping_mul(2654435761) ^ j.wrapping_mul(2246822519))
                        .wrapping_mul(3266489917)
                        >> 25;
                    [(f64::from(hash) + 60.0 * (wave(x, y, 3, 1).sin() + 1.0)) as u8; 3]
                })
            })
            .collect();
        DecodedImage::from_rgb(width, height, rgb).unwrap()
    }

    fn photo(width: u32, height: u32) -> Camera {
        Camera::from_focal_guess(width, height, f64::from(width))
    }

    fn nearest(features: &ImageFeatures, center: [f64; 2]) -> f64 {
        let target = Vector2::from(center);
        features
            .keypoints
            .iter()
            .map(|keypoint| (keypoint.pixel() - target).norm())
            .fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn keypoints_lie_where_the_blobs_are() {
        let centers = [[60.5, 70.5], [130.3, 60.8], [90.75, 140.25], [170.0, 150.0]];
        let features =
            extract(&FeatureParams::default(), &blobs(240, 200, &centers), &photo(240, 200), None).unwrap();
        for center in centers {
            assert!(nearest(&features, center) < NEAR, "{center:?}: {}", nearest(&features, center));
        }
    }

    #[test]
    fn faint_keypoints_are_taken_in_where_there_are_few() {
        let (faint, clear) = ([[60.5, 70.5], [130.3, 60.8]], [[90.75, 140.25], [170.0, 150.0]]);
        let mut image = blobs_of(18.0, 240, 200, &faint);
        for (value, clear) in image.rgb.iter_mut().zip(&blobs_of(90.0, 240, 200, &clear).rgb) {
            *value += clear - 60;
        }
        let found = |min_features| {
            let params = FeatureParams { min_features, faint_tilt: 1.0, ..FeatureParams::default() };
            extract(&params, &image, &photo(240, 200), None).unwrap()
        };
        let (without, with) = (found(0), found(4096));
        for center in clear {
            assert!(nearest(&without, center) < 0.1 && nearest(&with, center) < 0.1);
        }
        for center in faint {
            assert!(nearest(&without, center) > 5.0, "{}", nearest(&without, center));
            assert!(nearest(&with, center) < 0.5, "{}", nearest(&with, center));
        }
        // Enough is enough; and of the faint ones no more than are asked for.
        assert_eq!(found(without.len()), without);
        assert_eq!(found(without.len() + 1).len(), without.len() + 1);
    }

    #[test]
    fn keypoints_of_simulated_views_lie_where_the_blobs_are() {
        let centers = [[60.5, 70.5], [130.3, 60.8], [90.75, 140.25], [170.0, 150.0]];
        let params = FeatureParams { simulated_tilt: 1.5, faint_tilt: 1.0, ..FeatureParams::default() };
        let features = extract(&params, &blobs(240, 200, &centers), &photo(240, 200), None).unwrap();
        assert_eq!(features.simulated.len(), 2);
        for view in features.simulated_parts() {
            let of_view: Vec<Keypoint> = features.keypoints[view[0].start..view[1].end].to_vec();
            let of_view = ImageFeatures { keypoints: of_view, ..ImageFeatures::default() };
            for center in centers {
                assert!(nearest(&of_view, center) < 0.2, "{center:?}: {}", nearest(&of_view, center));
            }
        }
    }

    #[test]
    fn oblique_views_are_simulated_where_keypoints_are_few() {
        let image = blobs(240, 200, &[[60.5, 70.5], [130.3, 60.8], [90.75, 140.25], [170.0, 150.0]]);
        let views =
            |params: FeatureParams| extract(&params, &image, &photo(240, 200), None).unwrap().simulated.len();
        let of_min = |min_features| views(FeatureParams { min_features, ..FeatureParams::default() });
        assert_eq!([of_min(0), of_min(4), of_min(4096)], [0, 0, 2]);
        assert_eq!(views(FeatureParams { faint_tilt: 1.0, ..FeatureParams::default() }), 0);
    }

    #[test]
    fn views_are_the_same_where_the_image_itself_is_known() {
        let image = blobs(240, 200, &[[60.5, 70.5], [130.3, 60.8], [90.75, 140.25], [170.0, 150.0]]);
        // Neither of two images without views is faint, and one that is has views already.
        for (min_features, simulated_tilt, faint_tilt) in
            [(0, 1.5, 2.0), (4096, 1.5, 1.0), (4096, 1.5, 2.0), (4096, 3.0, 2.0)]
        {
            let params =
                FeatureParams { min_features, simulated_tilt, faint_tilt, ..FeatureParams::default() };
            let camera = photo(240, 200);
            let own =
                extract(&FeatureParams { simulated_tilt: 1.0, ..params.clone() }, &image, &camera, None)
                    .unwrap();
            let whole = extract(&params, &image, &camera, None).unwrap();
            assert!(!whole.simulated.is_empty());
            assert_eq!(extract_simulated_views(&params, &image, &camera, None, &own).unwrap(), whole);
        }
    }

    #[test]
    fn a_simulated_view_matches_a_wall_seen_along_the_street() {
        // Seen at a slant, a wall is narrower by about the tilt.
        const TILT: u32 = 3;
        let straight = texture(900, 300);
        let slanted = (0..300)
            .flat_map(|y| (0..300).map(move |x| (x, y)))
            .flat_map(|(x, y)| {
                let of = |dx: u32| u32::from(straight.rgb[((y * 900 + x * TILT + dx) * 3) as usize]);
                [((0..TILT).map(of).sum::<u32>() / TILT) as u8; 3]
            })
            .collect();
        let slanted = DecodedImage::from_rgb(300, 300, slanted).unwrap();
        let right = |simulated_tilt: f64| {
            let params = FeatureParams { simulated_tilt, faint_tilt: 1.0, ..FeatureParams::default() };
            let first = extract(&params, &straight, &photo(900, 300), None).unwrap();
            let second = extract(&params, &slanted, &photo(300, 300), None).unwrap();
            let matches = match_features(&MatchParams::default(), Posture::Any, &first, &second);
            let near = matches.iter().filter(|m| {
                let (a, b) = (first.keypoints[m.first as usize], second.keypoints[m.second as usize]);
                (a.x / TILT as f32 - b.x).abs() < 2.0 && (a.y - b.y).abs() < 2.0
            });
            near.count()
        };
        let (without, with) = (right(1.0), right(2.5));
        assert!(with > 20 && with > 3 * without, "{with} with, {without} without");
    }

    #[test]
    fn reduced_images_give_keypoints_in_full_pixels() {
        let centers = [[60.5, 70.5], [130.3, 60.8], [90.75, 140.25]];
        let params = FeatureParams { max_side: 160, ..FeatureParams::default() };
        let features = extract(&params, &blobs(240, 200, &centers), &photo(240, 200), None).unwrap();
        for center in centers {
            assert!(nearest(&features, center) < 0.1, "{center:?}: {}", nearest(&features, center));
        }
    }

    #[test]
    fn the_seam_neither_loses_nor_doubles_a_blob() {
        for x in [0.3, 3.0, 399.9, 200.0] {
            let image = blobs(400, 200, &[[x, 100.0]]);
            let camera = Camera::equirectangular(400, 200);
            let params = FeatureParams { min_features: 0, ..FeatureParams::default() };
            let features = extract(&params, &image, &camera, None).unwrap();
            let mut places: Vec<_> =
                features.keypoints.iter().map(|k| (k.x.to_bits(), k.y.to_bits())).collect();
            places.dedup();
            assert_eq!(places.len(), 1, "{x}: {:?}", features.keypoints);
            let keypoint = features.keypoints[0];
            let dx = (f64::from(keypoint.x) - x + 200.0).rem_euclid(400.0) - 200.0;
            assert!(dx.hypot(f64::from(keypoint.y) - 100.0) < NEAR, "{x}: {keypoint:?}");
        }
    }

    #[test]
    fn descriptors_across_the_seam_equal_those_elsewhere() {
        let camera = Camera::equirectangular(960, 480);
        let middle = texture(960, 480);
        let mut turned = middle.clone();
        for (target, source) in turned.rgb.chunks_exact_mut(960 * 3).zip(middle.rgb.chunks_exact(960 * 3)) {
            target.copy_from_slice(source);
            target.rotate_left(480 * 3);
        }
        let params = FeatureParams::default();
        let first = extract(&params, &middle, &camera, None).unwrap();
        let second = extract(&params, &turned, &camera, None).unwrap();
        let near_middle = |keypoint: &Keypoint| (keypoint.x - 480.0).abs() < 10.0 && keypoint.size < 4.0;
        let mut compared = 0;
        for (index, keypoint) in
            first.keypoints.iter().enumerate().filter(|(_, keypoint)| near_middle(keypoint))
        {
            let x = (keypoint.x + 480.0) % 960.0;
            let twin = (0..second.len()).find(|&other| {
                let candidate = second.keypoints[other];
                (candidate.x - x).abs() < 0.02
                    && (candidate.y - keypoint.y).abs() < 0.02
                    && (candidate.orientation - keypoint.orientation).abs() < 0.01
            });
            let twin = twin.unwrap_or_else(|| panic!("{keypoint:?} has no twin across the seam"));
            let difference = first
                .descriptor(index)
                .iter()
                .zip(second.descriptor(twin))
                .map(|(&a, &b)| a.abs_diff(b))
                .max();
            assert!(difference <= Some(3), "{difference:?}");
            compared += 1;
        }
        assert!(compared > 10, "{compared}");
    }

    #[test]
    fn stored_descriptors_have_about_one_length() {
        let features =
            extract(&FeatureParams::default(), &texture(300, 200), &photo(300, 200), None).unwrap();
        assert!(features.len() > 100);
        assert_eq!(features.descriptors.len(), features.len() * DESCRIPTOR_LEN);
        for index in 0..features.len() {
            let norm2: f64 = features.descriptor(index).iter().map(|&value| f64::from(value).powi(2)).sum();
            assert!((norm2.sqrt() - 512.0).abs() < 8.0, "{}", norm2.sqrt());
        }
    }

    #[test]
    fn a_small_budget_is_kept_and_spread() {
        let image = texture(600, 300);
        let camera = Camera::equirectangular(600, 300);
        let params = FeatureParams { max_features: 256, even_share: 1.0, ..FeatureParams::default() };
        let features = extract(&params, &image, &camera, None).unwrap();
        assert!(features.len() <= 256 && features.len() > 200, "{}", features.len());
        let near_pole = |keypoint: &&Keypoint| (keypoint.y - 150.0).abs() > 100.0;
        // Beyond 60° of latitude lie 13 % of the sphere, but a third of the rows.
        let share = features.keypoints.iter().filter(near_pole).count() as f64 / features.len() as f64;
        assert!((0.05..0.22).contains(&share), "{share}");
    }

    #[test]
    fn masks_and_the_nadir_cone_keep_keypoints_out() {
        let image = texture(600, 300);
        let camera = Camera::equirectangular(600, 300);
        let mut values = vec![255; 60 * 30];
        values.iter_mut().enumerate().filter(|(index, _)| index % 60 < 30).for_each(|(_, value)| *value = 0);
        let mask = Mask::new(60, 30, values).unwrap();
        let params = FeatureParams { nadir_cone_deg: 45.0, ..FeatureParams::default() };
        let features = extract(&params, &image, &camera, Some(&mask)).unwrap();
        assert!(features.len() > 100);
        assert!(features.keypoints.iter().all(|keypoint| keypoint.x >= 300.0 && keypoint.y <= 225.1));
    }

    #[test]
    fn images_without_texture_or_hardly_any_pixels_are_empty() {
        for (width, height) in [(64, 64), (1, 1), (3, 200)] {
            let image =
                DecodedImage::from_rgb(width, height, vec![0; (width * height * 3) as usize]).unwrap();
            let features = extract(&FeatureParams::default(), &image, &photo(width, height), None).unwrap();
            assert!(features.is_empty());
            assert_eq!((features.width, features.height), (width, height));
        }
    }

    #[test]
    fn wrong_sizes_and_parameters_are_named() {
        let image = texture(60, 40);
        let error = extract(&FeatureParams::default(), &image, &photo(40, 60), None).unwrap_err();
        assert_eq!(error.to_string(), "camera: expected 60 × 40, got 40 × 60");
        let params = FeatureParams { even_share: f64::NAN, ..FeatureParams::default() };
        assert!(extract(&params, &image, &photo(60, 40), None).is_err());
    }

    #[test]
    fn sparse_cells_leave_their_share_to_others() {
        assert_eq!(cell_quota(&[0, 1, 100, 100], 61), 30);
        assert_eq!(cell_quota(&[5, 5], 100), 100);
        assert_eq!(cell_quota(&[5, 5], 0), 0);
    }
}
