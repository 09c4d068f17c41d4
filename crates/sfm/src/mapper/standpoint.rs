//! Photos taken by turning on the spot, joined to one view of the sphere.
//!
//! Two photos from one centre share no parallax. Mapped one by one, each needs enough points of its own to be placed,
//! the length of a baseline is lost whenever the next standpoint sees another of the turned photos, and noise between
//! the two centres makes up points at wrong depths. But the turn between them is known best of all geometries. So the
//! photos of one standpoint are mapped as one mosaic on the sphere: all their rays in one frame, matched, verified and
//! resected together, and taken apart again afterwards.

use std::borrow::Cow;
use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};
use setloc_features::{
    Calibration, Camera, DESCRIPTOR_LEN, ImageFeatures, Keypoint, Match, Posture, Rays, SimulatedView,
};

use super::{InputImage, MapperInput, MapperOutput, MapperParams};
use crate::{
    BaselineLength, CameraId, ImageId, Observation, PairGeometry, Reconstruction, ReconstructionImage, Rigid,
    TwoViewKind, verify_pair, visibility::is_in_image,
};

/// One photo of a mosaic.
#[derive(Debug, Clone)]
pub(super) struct Member {
    image: ImageId,
    /// Turn from the mosaic's frame into the photo's.
    image_from_mosaic: UnitQuaternion<f64>,
    camera: Camera,
}

/// The part of the sphere that a mosaic covers.
#[derive(Debug, Clone)]
pub struct Mosaic {
    members: Vec<Member>,
    /// The photo's keypoint that each keypoint of the mosaic is.
    origin: Vec<Observation>,
}

impl Mosaic {
    /// Whether a direction of the mosaic's frame falls into one of its photos.
    pub fn covers(&self, direction: &Vector3<f64>) -> bool {
        self.members.iter().any(|member| is_in_image(&member.camera, &(member.image_from_mosaic * direction)))
    }
}

/// The input with mosaics in place of photos from one standpoint.
pub(super) struct Standpoints<'a> {
    original: &'a MapperInput<'a>,
    mosaics: Vec<Mosaic>,
    features: Vec<Cow<'a, ImageFeatures>>,
    cameras: Vec<Camera>,
    calibrations: Vec<Calibration>,
    camera_of: Vec<CameraId>,
    pairs: Vec<PairGeometry>,
}

impl<'a> Standpoints<'a> {
    /// Joins what was taken from one standpoint; `None` when nothing was.
    pub fn find(params: &MapperParams, input: &'a MapperInput<'a>, seed: u64) -> Option<Self> {
        let mut turns = candidate_turns(params, input);
        if turns.is_empty() {
            return None;
        }
        let rays: Vec<Rays> = input
            .images
            .iter()
            .map(|image| image.features.rays(&input.cameras[image.camera.index()]))
            .collect();
        turns
            .retain(|pair| is_mere_turn(params, pair, &rays) && sees_the_overlap(params, input, pair, &rays));
        let groups = groups(input.images.len(), &turns);
        if groups.iter().all(|members| members.len() == 1) {
            return None;
        }
        let mut standpoints = Self {
            original: input,
            mosaics: Vec::new(),
            features: Vec::new(),
            cameras: input.cameras.clone(),
            calibrations: input.calibrations.clone(),
            camera_of: Vec::new(),
            pairs: Vec::new(),
        };
        for members in groups {
            standpoints.add(&members, &rays);
        }
        standpoints.verify(seed);
        Some(standpoints)
    }

    /// The input to map, which lives as long as `self`.
    pub fn input(&self) -> MapperInput<'_> {
        let images = self
            .mosaics
            .iter()
            .zip(&self.features)
            .zip(&self.camera_of)
            .map(|((mosaic, features), &camera)| {
                let of = |member: &Member| &self.original.images[member.image.index()];
                InputImage {
                    name: of(&mosaic.members[0]).name,
                    camera,
                    features: features.as_ref(),
                    position_prior: mosaic.members.iter().find_map(|member| of(member).position_prior),
                    mosaic: (mosaic.members.len() > 1).then_some(mosaic),
                }
            })
            .collect();
        MapperInput {
            cameras: self.cameras.clone(),
            calibrations: self.calibrations.clone(),
            images,
            pairs: &self.pairs,
            putative: &[],
            two_view: self.original.two_view.clone(),
        }
    }

    /// Takes the mosaics of a finished map apart.
    pub fn expand(&self, mut output: MapperOutput) -> MapperOutput {
        for record in &mut output.report.registrations {
            record.image = self.mosaics[record.image.index()].members[0].image;
        }
        for record in &mut output.report.merges {
            for first in &mut record.first_images {
                *first = self.mosaics[first.index()].members[0].image;
            }
        }
        output.components =
            output.components.into_iter().map(|component| self.expand_component(component)).collect();
        output.components.sort_by_key(|component| std::cmp::Reverse(component.registered().count()));
        output
    }

    fn expand_component(&self, component: Reconstruction) -> Reconstruction {
        let mut images: Vec<ReconstructionImage> = self
            .original
            .images
            .iter()
            .map(|image| ReconstructionImage {
                name: image.name.to_owned(),
                camera: image.camera,
                world_from_camera: None,
            })
            .collect();
        for (mosaic, joined) in self.mosaics.iter().zip(&component.images) {
            let Some(world_from_mosaic) = joined.world_from_camera else { continue };
            for member in &mosaic.members {
                let rotation = world_from_mosaic.rotation * member.image_from_mosaic.inverse();
                images[member.image.index()].world_from_camera =
                    Some(Rigid::new(rotation, world_from_mosaic.translation));
            }
        }
        let mut points = component.points;
        for point in &mut points {
            for seen in &mut point.track {
                *seen = self.mosaics[seen.image.index()].origin[seen.feature as usize];
            }
            point.track.sort_unstable();
        }
        let mut cameras = component.cameras;
        cameras.truncate(self.original.cameras.len());
        let first_of = |image: ImageId| self.mosaics[image.index()].members[0].image;
        let mosaic_from_first =
            |image: ImageId| self.mosaics[image.index()].members[0].image_from_mosaic.inverse();
        let of_first = |length: &BaselineLength| {
            let (from, to) = (mosaic_from_first(length.from), mosaic_from_first(length.to));
            length.turned(&from, &to).between(first_of)
        };
        let lengths = component.lengths.iter().map(of_first).collect();
        Reconstruction { cameras, images, points, lengths }
    }

    fn add(&mut self, members: &[(ImageId, UnitQuaternion<f64>)], rays: &[Rays]) {
        let images = &self.original.images;
        let mut mosaic = Mosaic { members: Vec::new(), origin: Vec::new() };
        for &(image, image_from_mosaic) in members {
            let camera = self.original.camera_of(image).clone();
            mosaic.members.push(Member { image, image_from_mosaic, camera });
        }
        let first = images[members[0].0.index()];
        if members.len() == 1 {
            self.features.push(Cow::Borrowed(first.features));
            mosaic.origin = (0..first.features.len() as u32)
                .map(|feature| Observation { image: members[0].0, feature })
                .collect();
            self.camera_of.push(first.camera);
        } else {
            let finest = mosaic.members.iter().map(|member| member.camera.focal_length()).fold(0.0, f64::max);
            let height = (finest * std::f64::consts::PI).round().clamp(16.0, 32_768.0) as u32;
            let sphere = Camera::equirectangular(2 * height, height);
            self.features.push(Cow::Owned(joined_features(&mut mosaic, images, rays, &sphere)));
            self.camera_of.push(CameraId(self.cameras.len() as u32));
            self.cameras.push(sphere);
            self.calibrations.push(Calibration::Known);
        }
        self.mosaics.push(mosaic);
    }

    /// Pairs of mosaics are verified anew on all matches of their photos; pairs of single photos stay as they are.
    fn verify(&mut self, seed: u64) {
        let mut place: Vec<Vec<u32>> =
            self.original.images.iter().map(|image| vec![0; image.features.len()]).collect();
        for mosaic in &self.mosaics {
            for (feature, seen) in mosaic.origin.iter().enumerate() {
                place[seen.image.index()][seen.feature as usize] = feature as u32;
            }
        }
        let mut mosaic_of = BTreeMap::new();
        for (at, mosaic) in self.mosaics.iter().enumerate() {
            mosaic_of.extend(mosaic.members.iter().map(|member| (member.image, at)));
        }
        let mut matches: BTreeMap<(usize, usize), Vec<Match>> = BTreeMap::new();
        let mut collect = |first: ImageId, second: ImageId, found: &[Match]| {
            let (a, b) = (mosaic_of[&first], mosaic_of[&second]);
            if a == b || self.mosaics[a].members.len() + self.mosaics[b].members.len() == 2 {
                return;
            }
            let moved = found.iter().filter_map(|m| {
                let moved = Match {
                    first: *place[first.index()].get(m.first as usize)?,
                    second: *place[second.index()].get(m.second as usize)?,
                };
                Some(if a < b { moved } else { moved.swapped() })
            });
            matches.entry((a.min(b), a.max(b))).or_default().extend(moved);
        };
        for pair in self.original.putative {
            collect(pair.first, pair.second, &pair.matches);
        }
        for pair in self.original.pairs {
            collect(pair.first, pair.second, &pair.two_view.inliers);
        }
        for pair in self.original.pairs {
            let (a, b) = (mosaic_of[&pair.first], mosaic_of[&pair.second]);
            if a != b && self.mosaics[a].members.len() + self.mosaics[b].members.len() == 2 {
                let mut two_view = pair.two_view.clone();
                if a > b {
                    two_view = two_view.flipped();
                }
                let (first, second) = (ImageId(a.min(b) as u32), ImageId(a.max(b) as u32));
                self.pairs.push(PairGeometry { first, second, two_view });
            }
        }
        let rays: Vec<Rays> = self
            .features
            .iter()
            .zip(&self.camera_of)
            .map(|(features, camera)| features.rays(&self.cameras[camera.index()]))
            .collect();
        for ((a, b), mut found) in matches {
            let seed = seed ^ ((a as u64) << 40) ^ ((b as u64) << 16);
            found.sort_unstable();
            found.dedup();
            let views = verify_pair(&self.original.two_view, Posture::Any, &rays[a], &rays[b], &found, seed);
            for two_view in views {
                let (first, second) = (ImageId(a as u32), ImageId(b as u32));
                self.pairs.push(PairGeometry { first, second, two_view });
            }
        }
        self.pairs.sort_by_key(|pair| (pair.first, pair.second));
    }
}

/// All keypoints on one sphere, with the angular noise that they have in their photos: first those of the photos
/// themselves, then those of each simulated view.
fn joined_features(
    mosaic: &mut Mosaic,
    images: &[InputImage<'_>],
    rays: &[Rays],
    sphere: &Camera,
) -> ImageFeatures {
    let mut joined = ImageFeatures { width: sphere.width, height: sphere.height, ..ImageFeatures::default() };
    let of = |member: &Member| images[member.image.index()].features;
    let views = mosaic.members.iter().map(|member| of(member).simulated.len()).max().unwrap_or(0);
    for view in 0..=views {
        let start = joined.len() as u32;
        let mut light = 0;
        for part in 0..2 {
            for member in &mosaic.members {
                let features = of(member);
                let rays = &rays[member.image.index()];
                let mosaic_from_image = member.image_from_mosaic.inverse();
                let parts = match view {
                    0 => Some(features.parts()),
                    _ => features.simulated_parts().nth(view - 1),
                };
                for feature in parts.map_or(0..0, |parts| parts[part].clone()) {
                    let keypoint = features.keypoints[feature];
                    let direction = mosaic_from_image * rays.bearings[feature];
                    let placed = sphere
                        .project(&direction)
                        .and_then(|pixel| Some((pixel, sphere.pixel_angle(&pixel)?)));
                    // A keypoint that its own camera has no ray for gets none here either: infinite noise.
                    let (pixel, angle) = placed.unwrap_or_default();
                    let scale = (rays.sigmas[feature] / angle) as f32 / keypoint.noise_px;
                    joined.keypoints.push(Keypoint {
                        x: pixel.x as f32,
                        y: pixel.y as f32,
                        size: keypoint.size * scale,
                        orientation: keypoint.orientation,
                        noise_px: keypoint.noise_px * scale,
                    });
                    let bytes = feature * DESCRIPTOR_LEN..(feature + 1) * DESCRIPTOR_LEN;
                    joined.descriptors.extend_from_slice(features.descriptors.get(bytes).unwrap_or(&[]));
                    joined.colors.push(features.colors[feature]);
                    mosaic.origin.push(Observation { image: member.image, feature: feature as u32 });
                }
            }
            if part == 0 {
                light = joined.len() as u32 - start;
            }
        }
        if view == 0 {
            joined.light = light;
        } else {
            joined.simulated.push(SimulatedView { start, light });
        }
    }
    joined
}

/// Pairs of photos that may differ by a turn only, best supported first.
///
/// Only photos of known intrinsics are joined: a wrong focal length would bend the mosaic. Panoramas see everything
/// already.
fn candidate_turns<'a>(params: &MapperParams, input: &MapperInput<'a>) -> Vec<&'a PairGeometry> {
    let mut turns: Vec<&PairGeometry> = input
        .pairs
        .iter()
        .filter(|pair| {
            let known = |image: ImageId| {
                let camera = input.camera_index(image);
                input.is_fixed(camera) && !input.is_panoramic(image)
            };
            pair.two_view.kind == TwoViewKind::PureRotation
                && pair.two_view.inliers.len() >= params.min_turn_matches
                && known(pair.first)
                && known(pair.second)
        })
        .collect();
    turns.sort_by_key(|pair| (std::cmp::Reverse(pair.two_view.inliers.len()), pair.first, pair.second));
    turns
}

/// Photos by standpoint, each with the turn from the frame of its standpoint's first photo; better turns come first.
fn groups(count: usize, turns: &[&PairGeometry]) -> Vec<Vec<(ImageId, UnitQuaternion<f64>)>> {
    let mut group_of: Vec<usize> = (0..count).collect();
    let mut from_group: Vec<UnitQuaternion<f64>> = vec![UnitQuaternion::identity(); count];
    for pair in turns {
        let (a, b) = (pair.first.index(), pair.second.index());
        let (kept, gone) = (group_of[a], group_of[b]);
        if kept == gone {
            continue;
        }
        // b's group moves into a's frame: b_from_kept = turn · a_from_kept.
        let gone_from_kept =
            from_group[b].inverse() * pair.two_view.second_from_first.rotation * from_group[a];
        for image in (0..count).filter(|&image| group_of[image] == gone).collect::<Vec<_>>() {
            group_of[image] = kept;
            from_group[image] *= gone_from_kept;
        }
    }
    let mut members: BTreeMap<usize, Vec<(ImageId, UnitQuaternion<f64>)>> = BTreeMap::new();
    for image in 0..count {
        members.entry(group_of[image]).or_default().push((ImageId(image as u32), from_group[image]));
    }
    let mut groups: Vec<_> = members.into_values().collect();
    for group in &mut groups {
        let origin = group[0].1.inverse();
        for (_, turn) in group {
            *turn *= origin;
        }
    }
    groups.sort_by_key(|group| group[0].0);
    groups
}

/// Whether the turn alone puts nearly all matches in place.
fn is_mere_turn(params: &MapperParams, pair: &PairGeometry, rays: &[Rays]) -> bool {
    let (first, second) = (&rays[pair.first.index()], &rays[pair.second.index()]);
    let turn = pair.two_view.second_from_first.rotation;
    let agreeing = pair
        .two_view
        .inliers
        .iter()
        .filter(|m| {
            let (a, b) = (m.first as usize, m.second as usize);
            let sigma = first.sigmas[a].hypot(second.sigmas[b]);
            (turn * first.bearings[a] - second.bearings[b]).norm() <= params.max_error_sigma * sigma
        })
        .count();
    agreeing * 10 >= pair.two_view.inliers.len() * 9
}

/// Whether enough of what both photos ought to see after the turn was matched, and either shows something else, too.
///
/// Photos of two places that look alike match as after a turn, too, but only in what looks alike. A photo of nothing but what the
/// other shows adds nothing to a mosaic, and there one of the two would be left with next to no points: each is resected by itself.
fn sees_the_overlap(
    params: &MapperParams,
    input: &MapperInput<'_>,
    pair: &PairGeometry,
    rays: &[Rays],
) -> bool {
    let turn = pair.two_view.second_from_first.rotation;
    let own = |image: ImageId| input.images[image.index()].features.own_len();
    let shared = |from: ImageId, to: ImageId, turn: UnitQuaternion<f64>| {
        let (bearings, camera) = (&rays[from.index()].bearings[..own(from)], input.camera_of(to));
        bearings.iter().filter(|bearing| is_in_image(camera, &(turn * *bearing))).count() as f64
    };
    let of_first = shared(pair.first, pair.second, turn);
    let of_second = shared(pair.second, pair.first, turn.inverse());
    pair.two_view.inliers.len() as f64 >= params.min_turn_recall * of_first
        && of_first <= MAX_COMMON_SHARE * own(pair.first) as f64
        && of_second <= MAX_COMMON_SHARE * own(pair.second) as f64
}

/// Share of a photo's keypoints above which another of its standpoint shows all that it does.
const MAX_COMMON_SHARE: f64 = 0.9;
