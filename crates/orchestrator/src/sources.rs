//! What a scene was made from, as far as a store still has it.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Result;
use rayon::prelude::*;
use setloc_features::ImageFeatures;
use setloc_sfm::Reconstruction;

use crate::codec;
use crate::fingerprint::{ContentHash, Fingerprint};
use crate::jobs::{GROWN_KIND, SCENE_INPUT, SCENE_KIND, features_role};
use crate::store::Store;

/// All features of a scene's images by name, of those that the store still has; `file` is the hash of the scene's file.
///
/// A scene file has the strongest features of its images only. What it was made from is in the record of the job that made
/// it, and of a scene that has grown in those of the scenes before.
///
/// # Errors
/// When the store cannot be listed.
pub fn stored_features(store: &Store, file: ContentHash) -> Result<BTreeMap<String, Arc<ImageFeatures>>> {
    let records = store.records_of(&[SCENE_KIND, GROWN_KIND])?;
    let mut made_by: BTreeMap<ContentHash, Fingerprint> =
        records.into_iter().map(|record| (record.output, record.fingerprint)).collect();
    let mut inputs: BTreeMap<String, ContentHash> = BTreeMap::new();
    let mut next = Some(file);
    // Each is taken out, so that this ends.
    while let Some(made) = next.and_then(|hash| made_by.remove(&hash)) {
        inputs.extend(features_by_name(&made));
        next = made.inputs.get(SCENE_INPUT).copied();
    }
    let read = |(name, hash): (String, ContentHash)| {
        let features = codec::decode(&store.object(hash).ok()?).ok()?;
        Some((name, Arc::new(features)))
    };
    let inputs: Vec<_> = inputs.into_iter().collect();
    Ok(inputs.into_par_iter().with_max_len(1).filter_map(read).collect())
}

/// The features of a model's images, in their order.
pub fn features_of<'f>(
    model: &Reconstruction,
    features: &'f BTreeMap<String, Arc<ImageFeatures>>,
) -> Vec<Option<&'f ImageFeatures>> {
    model.images.iter().map(|image| features.get(&image.name).map(|features| &**features)).collect()
}

/// Says of how many registered images of these models a store no longer has the features, so that a COLMAP model lacks what
/// they show; `None` where it has all.
pub fn missing_features<'m>(
    models: impl IntoIterator<Item = &'m Reconstruction>,
    features: &BTreeMap<String, Arc<ImageFeatures>>,
) -> Option<String> {
    let (mut images, mut missing) = (0, 0);
    for model in models {
        for id in model.registered() {
            images += 1;
            missing += usize::from(!features.contains_key(&model.images[id.index()].name));
        }
    }
    (missing > 0).then(|| {
        format!(
            "the COLMAP model lacks 2D points and tracks of {missing} of {images} images, whose keypoints are not in the store: \
             name the one of the scene's build with --cache"
        )
    })
}

/// The features that a job which makes a scene was given, by the names that their images have in it.
fn features_by_name(made: &Fingerprint) -> impl Iterator<Item = (String, ContentHash)> {
    let names = made.params["names"].as_array().into_iter().flatten().enumerate();
    names.filter_map(|(at, name)| Some((name.as_str()?.to_owned(), *made.inputs.get(&features_role(at))?)))
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use setloc_features::Keypoint;
    use setloc_sfm::{CameraId, ReconstructionImage, Rigid};

    use super::*;

    #[test]
    fn images_without_stored_features_are_counted() {
        let image = |name: &str, is_registered: bool| ReconstructionImage {
            name: name.to_owned(),
            camera: CameraId(0),
            world_from_camera: is_registered.then(Rigid::identity),
        };
        let images = vec![image("a", true), image("b", true), image("c", false)];
        let models = [Reconstruction { images, ..Reconstruction::default() }];
        let stored = |names: &[&str]| -> BTreeMap<String, Arc<ImageFeatures>> {
            names.iter().map(|name| ((*name).to_owned(), Arc::default())).collect()
        };
        assert_eq!(missing_features(&models, &stored(&["a", "b"])), None);
        let said = missing_features(&models, &stored(&["a"])).unwrap();
        assert!(said.contains("of 1 of 2 images"), "{said}");
    }

    #[test]
    fn features_are_those_of_all_scenes_that_one_has_grown_from() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let keep = |kind: &str, params, inputs, file: &[u8]| {
            let fingerprint = Fingerprint { kind: kind.to_owned(), version: 1, params, inputs };
            store.write(&fingerprint, file, 0.0).unwrap()
        };
        let features = |count: usize| {
            let keypoint = Keypoint { x: 1.0, y: 2.0, size: 3.0, orientation: 0.0, noise_px: 0.5 };
            ImageFeatures {
                keypoints: vec![keypoint; count],
                descriptors: vec![0; count * setloc_features::DESCRIPTOR_LEN],
                colors: vec![[0; 3]; count],
                ..ImageFeatures::default()
            }
        };
        let kept = |count: usize| {
            let file = codec::encode(&features(count)).unwrap();
            keep("features", json!({ "of": count }), BTreeMap::new(), &file)
        };
        let scene = |kind, names: &[&str], inputs: Vec<(String, ContentHash)>, file: &[u8]| {
            keep(kind, json!({ "names": names }), inputs.into_iter().collect(), file)
        };
        let gone = ContentHash::of(b"collected as garbage");
        // `b` has no features.
        let inputs =
            vec![(features_role(0), kept(100)), (features_role(2), gone), (features_role(3), kept(101))];
        let built = scene(SCENE_KIND, &["a", "b", "c", "d"], inputs, b"a scene");
        let inputs = vec![(SCENE_INPUT.to_owned(), built), (features_role(0), kept(102))];
        let grown = scene(GROWN_KIND, &["grown-1/a"], inputs, b"a grown scene");
        let found = |file| -> Vec<(String, usize)> {
            let features = stored_features(&store, file).unwrap();
            features.into_iter().map(|(name, features)| (name, features.len())).collect()
        };
        let named = |name: &str, count| (name.to_owned(), count);
        assert_eq!(found(built), [named("a", 100), named("d", 101)]);
        assert_eq!(found(grown), [named("a", 100), named("d", 101), named("grown-1/a", 102)]);
        assert!(found(gone).is_empty());
        assert!(stored_features(&Store::at(&folder.path().join("nowhere")), built).unwrap().is_empty());
    }
}
