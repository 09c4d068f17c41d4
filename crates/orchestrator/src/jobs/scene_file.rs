//! Makes the scene file of a model.

use std::collections::BTreeSet;

use anyhow::Result;
use rayon::prelude::*;
use serde_json::{Value, json};
use setloc_features::{ImageFeatures, Wgs84};
use setloc_sfm::{
    ImageId, MapperOutput, MeasuredPosition, MergeRecord, ModelErrors, Reconstruction,
    shared_sigma_of_matches,
};

use super::accuracy::Accuracy;
use super::features::features_role;
use super::model::{
    ModelPair, features_at, image_of_place_holder, places_of_images, verified_of, with_names,
};
use super::notes::{Doubt, Recall, lengths_note, shared_errors_note, stretch_note, worst_recall};
use super::positions::{self, Fix, Measurements};
use crate::artifacts::SceneIndices;
use crate::codec::Artifact;
use crate::fingerprint::ContentHash;
use crate::graph::Inputs;
use crate::scene::{Block, NO_ALTITUDE, SceneFile, has_altitude};
use crate::stages;

/// What goes into a scene file beside its model and index.
pub(super) struct SceneRecipe {
    /// Names of the images, in the order of the model's.
    pub names: Vec<String>,
    /// The middle of the measured positions.
    pub origin: Option<Wgs84>,
    /// Measured positions of the images.
    pub measured: Measurements,
    /// Pairs of the images.
    pub pairs: Vec<ModelPair>,
    /// All parameters of a scene, as TOML.
    pub config: String,
}

impl SceneRecipe {
    /// What the file depends on.
    pub fn params(&self) -> Value {
        let Self { names, origin, measured, config, pairs: _ } = self;
        let mut params = json!({ "names": names, "origin": origin, "config": config });
        if origin.is_some() {
            params["positions"] = json!([measured.positions, measured.params]);
        }
        params
    }

    /// The scene of the model and the index of a job.
    pub fn make(&self, inputs: &Inputs<'_, '_>) -> Result<SceneFile> {
        let output = inputs.get::<MapperOutput>("model")?;
        let indices = inputs.get::<SceneIndices>("index")?;
        let ((components, indices_of_file), features) = rayon::join(
            || {
                let named = output.components.iter().map(|model| named(model, &self.names));
                (named.collect::<Vec<_>>(), indices.0.clone())
            },
            || features_of_registered(inputs, &output),
        );
        let georegistrations = &output.report.georegistrations;
        let placed: Vec<bool> = georegistrations.iter().map(Option::is_some).collect();
        let frame_errors = georegistrations.iter().map(|placed| placed.as_ref()?.errors.clone()).collect();
        let origin = self.origin.filter(|_| placed.first() == Some(&true));
        let origin =
            origin.map(|at| if self.has_altitudes() { at } else { Wgs84 { alt: NO_ALTITUDE, ..at } });
        let doubts: Vec<Doubt> = (output.components.iter())
            .zip(output.outvoted.iter().zip(&output.suspicious))
            .map(|(component, (outvoted, suspicious))| Doubt::of(component, outvoted, suspicious))
            .collect();
        let shared_sigmas = self.shared_sigmas(inputs, &output)?;
        let errors: Vec<Option<ModelErrors>> = (output.components.iter())
            .zip(georegistrations.iter().zip(&shared_sigmas))
            .map(|(component, (placed, shared))| {
                let positions = self.measured.for_adjustment(component, placed.as_ref());
                ModelErrors::of_model(component, positions.as_ref(), *shared)
            })
            .collect();
        let mut scene = SceneFile {
            indices: indices_of_file,
            placed: placed.into_iter().map(|is_placed| is_placed && origin.is_some()).collect(),
            frame_errors,
            content: content(inputs, &output, &shared_sigmas)?,
            features: features?,
            config: self.config.clone(),
            components,
            doubtful: doubts.iter().map(Doubt::images).collect(),
            corrected: output.corrected.clone(),
            errors,
            origin,
            warnings: Vec::new(),
            notes: Vec::new(),
            grown: Vec::new(),
            grown_from: Vec::new(),
        };
        (scene.warnings, scene.notes) = self.said_of(&output, &doubts, &scene);
        Ok(scene)
    }

    /// What the verified matches of each component show of errors that neighbouring bearings share.
    fn shared_sigmas(&self, inputs: &Inputs<'_, '_>, output: &MapperOutput) -> Result<Vec<f64>> {
        let places = places_of_images(output);
        let features = features_at(inputs, &places)?;
        let features: Vec<&ImageFeatures> = features.iter().map(|features| &**features).collect();
        let id_of = places.iter().enumerate().map(|(id, at)| (*at, ImageId(id as u32))).collect();
        let pairs = verified_of(inputs, &self.pairs, &id_of)?;
        let sigma = |component| shared_sigma_of_matches(component, &features, &pairs);
        Ok(output.components.iter().map(sigma).collect())
    }

    /// Whether any measured position has a height.
    fn has_altitudes(&self) -> bool {
        self.measured.positions.iter().flatten().any(|position| position.has_height)
    }

    /// Warnings and notes about a scene of this model.
    fn said_of(
        &self,
        output: &MapperOutput,
        doubts: &[Doubt],
        scene: &SceneFile,
    ) -> (Vec<String>, Vec<String>) {
        let Self { names, measured, .. } = self;
        // With the names that images have in the scene, of which those without features are none.
        let models = || scene.components.iter().enumerate();
        let contradicted = (output.components.iter())
            .zip(&output.report.georegistrations)
            .flat_map(|(component, placed)| measured.warnings(component, placed.as_ref()));
        let warnings = output.report.warnings.iter().cloned().chain(contradicted);
        let accuracies: Vec<Option<(&Reconstruction, Accuracy)>> =
            (scene.components.iter().zip(&scene.errors))
                .map(|(model, errors)| Some((model, Accuracy::of_model(model, errors.as_ref()?)?)))
                .collect();
        let of_largest = accuracies.first().and_then(Option::as_ref);
        let unit = if scene.origin.is_some() { " m" } else { "" };
        let relative = scene.origin.filter(|origin| !has_altitude(*origin)).map(|_| {
            "the measured positions have no altitudes: heights are relative, and left out where WGS84 is told".to_owned()
        });
        let fixes = fixes_of(output, &measured.positions);
        let frame_errors = scene.frame_errors.first().and_then(Option::as_ref);
        let recall = worst_recall(&scene.indices);
        let doubts = scene.components.iter().zip(doubts);
        let warnings = warnings
            .map(|text| with_names(&text, names))
            .chain(doubts.filter_map(|(component, doubt)| doubt.warning(component)))
            .chain(accuracies.iter().flatten().filter_map(|(model, accuracy)| accuracy.warning(model)))
            .chain(recall.as_ref().and_then(Recall::warning))
            .chain(fixes.as_deref().and_then(|fixes| positions::warning(fixes, frame_errors)));
        let notes = (output.report.merges.iter().filter_map(MergeRecord::sentence))
            .chain(recall.as_ref().map(Recall::note))
            .chain(fixes.as_deref().map(|fixes| positions::note(fixes, frame_errors, names.len())))
            .chain(relative)
            .chain(of_largest.and_then(|(model, accuracy)| accuracy.note(model, unit)))
            .chain(models().filter_map(lengths_note))
            .chain(models().filter_map(stretch_note))
            .chain(scene.errors.iter().enumerate().filter_map(shared_errors_note));
        (warnings.collect(), notes.collect())
    }
}

/// A hash of what a scene is made of, whatever its images are called.
fn content(inputs: &Inputs<'_, '_>, output: &MapperOutput, shared_sigmas: &[f64]) -> Result<ContentHash> {
    let made_by = ContentHash::of(&stages::SCENE_VERSION.to_le_bytes());
    let mut content = vec![inputs.hash("model")?, inputs.hash("index")?, made_by];
    content.extend(shared_sigmas.iter().map(|sigma| ContentHash::of(&sigma.to_le_bytes())));
    for at in places_of_images(output) {
        content.push(inputs.hash(&features_role(at))?);
    }
    Ok(ContentHash::of_all(&content))
}

/// The measured images of the largest component, where they place it.
fn fixes_of(output: &MapperOutput, measured: &[Option<MeasuredPosition>]) -> Option<Vec<Fix>> {
    let placed = output.report.georegistrations.first()?.as_ref()?;
    Some(positions::fixes(output.components.first()?, placed, measured))
}

/// Keypoints of an image that go into the scene file, of the bright and of the dark; twice as many cost 200
/// panoramas 60 MB more.
pub(super) const KEPT_FEATURES: usize = 1024;

/// The strongest features of the images that a component has registered, as blocks.
fn features_of_registered(inputs: &Inputs<'_, '_>, output: &MapperOutput) -> Result<Vec<Block>> {
    let Some(main) = output.components.first() else { return Ok(Vec::new()) };
    let registered: BTreeSet<ImageId> =
        output.components.iter().flat_map(Reconstruction::registered).collect();
    let block = |id: ImageId| {
        let name = &main.images[id.index()].name;
        let Some(at) = image_of_place_holder(name).filter(|_| registered.contains(&id)) else {
            return Ok(Block::default());
        };
        let features = inputs.get::<ImageFeatures>(&features_role(at))?;
        let mut block = Block::default();
        features.strongest(KEPT_FEATURES).write_payload(&mut block.0)?;
        Ok(block)
    };
    // Tens of megabytes are touched first here: on all cores.
    let images = (0..main.images.len() as u32).into_par_iter().with_max_len(1).map(ImageId);
    let blocks: Vec<Result<Block>> = images.map(block).collect();
    blocks.into_iter().collect()
}

/// The model with the images' names in place of the place holders.
fn named(model: &Reconstruction, names: &[String]) -> Reconstruction {
    let mut model = model.clone();
    for image in &mut model.images {
        image.name = with_names(&image.name, names);
    }
    // Where pixels show the points has done its part: it placed the points.
    for point in &mut model.points {
        point.aligned = None;
    }
    model
}
