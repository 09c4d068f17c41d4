//! What the jobs hand on, as files.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use setloc_camset::{AnywhereLocalization, Growth, NearestAnywhere, SetLocalization};
use setloc_features::{CarriedCells, ImageFeatures, Keypoint, Match, SimulatedView};
use setloc_index::SceneIndex;
use setloc_sfm::robust::TurnedCamera;
use setloc_sfm::{MapperOutput, TwoView};

use crate::codec::{Artifact, CodecError};
use crate::fingerprint::ContentHash;
use crate::serde_artifact;

/// Features as raw blocks behind a short head: a gigabyte of descriptors is copied, not parsed.
impl Artifact for ImageFeatures {
    const KIND: &'static str = "features";
    const SCHEMA: u32 = 3;

    fn write_payload(&self, payload: &mut Vec<u8>) -> Result<(), CodecError> {
        let count = self.len();
        payload.reserve(64 + count * (size_of::<Keypoint>() + 131));
        payload.extend_from_slice(&self.width.to_le_bytes());
        payload.extend_from_slice(&self.height.to_le_bytes());
        payload.extend_from_slice(&(count as u64).to_le_bytes());
        payload.extend_from_slice(&self.light.to_le_bytes());
        payload.extend_from_slice(&(self.simulated.len() as u32).to_le_bytes());
        for view in &self.simulated {
            payload.extend_from_slice(&view.start.to_le_bytes());
            payload.extend_from_slice(&view.light.to_le_bytes());
        }
        for keypoint in &self.keypoints {
            for value in [keypoint.x, keypoint.y, keypoint.size, keypoint.orientation, keypoint.noise_px] {
                payload.extend_from_slice(&value.to_le_bytes());
            }
        }
        payload.extend_from_slice(bytemuck::cast_slice(&self.colors));
        payload.extend_from_slice(&self.descriptors);
        Ok(())
    }

    fn from_payload(payload: &[u8]) -> Result<Self, CodecError> {
        let wrong = || CodecError::Payload("feature blocks of a wrong length".to_owned());
        let (head, rest) = payload.split_at_checked(24).ok_or_else(wrong)?;
        let number = |bytes: &[u8]| bytes.iter().rev().fold(0_u64, |sum, &byte| (sum << 8) | u64::from(byte));
        let (width, height) = (number(&head[..4]) as u32, number(&head[4..8]) as u32);
        let (count, light) = (number(&head[8..16]) as usize, number(&head[16..20]) as u32);
        let views = number(&head[20..]) as usize;
        let (views, rest) = views.checked_mul(8).and_then(|n| rest.split_at_checked(n)).ok_or_else(wrong)?;
        let simulated: Vec<SimulatedView> = views
            .chunks_exact(8)
            .map(|view| SimulatedView { start: number(&view[..4]) as u32, light: number(&view[4..]) as u32 })
            .collect();
        if light as usize > count {
            return Err(wrong());
        }
        let (keypoints, rest) =
            count.checked_mul(20).and_then(|n| rest.split_at_checked(n)).ok_or_else(wrong)?;
        let (colors, descriptors) =
            count.checked_mul(3).and_then(|n| rest.split_at_checked(n)).ok_or_else(wrong)?;
        if count.checked_mul(setloc_features::DESCRIPTOR_LEN) != Some(descriptors.len()) {
            return Err(wrong());
        }
        let keypoint = |block: &[u8; 20]| {
            let [x, y, size, orientation, noise_px] =
                [0, 4, 8, 12, 16].map(|at| f32::from_le_bytes(std::array::from_fn(|i| block[at + i])));
            Keypoint { x, y, size, orientation, noise_px }
        };
        Ok(Self {
            width,
            height,
            light,
            simulated,
            keypoints: keypoints.as_chunks().0.iter().map(keypoint).collect(),
            descriptors: descriptors.to_vec(),
            colors: colors.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
        })
    }
}

/// Putative matches of two images.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PairMatches(pub Vec<Match>);

impl Artifact for PairMatches {
    const KIND: &'static str = "matches";
    const SCHEMA: u32 = 1;

    fn write_payload(&self, payload: &mut Vec<u8>) -> Result<(), CodecError> {
        payload.extend(self.0.iter().flat_map(|m| [m.first.to_le_bytes(), m.second.to_le_bytes()]).flatten());
        Ok(())
    }

    fn from_payload(payload: &[u8]) -> Result<Self, CodecError> {
        let (chunks, rest) = payload.as_chunks::<8>();
        if !rest.is_empty() {
            return Err(CodecError::Payload("matches of a wrong length".to_owned()));
        }
        let read = |c: &[u8; 8]| Match {
            first: u32::from_le_bytes([c[0], c[1], c[2], c[3]]),
            second: u32::from_le_bytes([c[4], c[5], c[6], c[7]]),
        };
        Ok(Self(chunks.iter().map(read).collect()))
    }
}

/// The geometry of two images, or that there is none.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct VerifiedPair(pub Vec<TwoView>);

/// What two images show of the focal length of their camera if it was turned on the spot between them.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TurnedPair(pub Option<TurnedCamera>);

/// Which parts of photos show what moves with their camera, by the content of the photo; photos without such parts are not in it, so that
/// a photo more changes nothing.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CarriedParts(pub BTreeMap<ContentHash, CarriedCells>);

/// For each image others that look alike, most first; empty for images that nobody asked about.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LikelyImages(pub Vec<Vec<u32>>);

/// Which images a model leaves out of its largest component.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LeftApart {
    /// Their places in the list of the model's images.
    pub images: Vec<u32>,
    /// Pairs of images of which the model tells the relative pose: those of one component.
    pub known_pairs: u64,
    /// All pairs of images.
    pub pairs: u64,
}

impl LeftApart {
    /// Whether the model tells less than half of what it could.
    pub fn is_torn(&self) -> bool {
        2 * self.known_pairs < self.pairs
    }

    /// Whether the model tells more than another of the same images does.
    pub fn tells_more_than(&self, other: &Self) -> bool {
        self.known_pairs > other.known_pairs
    }
}

/// The index of each component, the largest first.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SceneIndices(pub Vec<SceneIndex>);

serde_artifact!(CarriedParts, "carried parts", 1);
serde_artifact!(LikelyImages, "likely images", 1);
serde_artifact!(LeftApart, "images left apart", 1);
serde_artifact!(VerifiedPair, "verified pair", 1);
serde_artifact!(TurnedPair, "turned pair", 1);
serde_artifact!(MapperOutput, "model", 10);
serde_artifact!(SceneIndices, "index", 2);
serde_artifact!(NearestAnywhere, "nearest scene points", 1);
serde_artifact!(AnywhereLocalization, "photo localization", 4);
serde_artifact!(Growth, "growth", 1);
serde_artifact!(SetLocalization, "set localization", 4);
