use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use serde::Serialize;
use setloc_camset::{PhotoLocalization, Verdict};
use setloc_sfm::{PoseDeviation, Reconstruction, Rigid};

use super::figures::{mean_angular_error_px, own_rotation_errors_deg};
use super::{
    AUC_THRESHOLDS_DEG, Alignment, Bounds, Calibration, Errors, JointReference, NormalizedError, PoseError,
    SceneFigures, auc_percent,
};
use crate::building::{BuildOutcome, Built, SceneSource, build_scene};
use crate::config::Config;
use crate::dataset::{
    CameraBook, GeoSource, ImageFolder, SkippedImage, Truth, list_images, truth_without_image,
};
use crate::error::{Hinted, Interrupted, concerns_the_disk};
use crate::jobs::LocateJobs;
use crate::locating::{Located, Mode, locate};
use crate::pictures::PictureBook;
use crate::scene::SceneFile;
use crate::session::Session;
use crate::subscribers::StageReport;

/// How to bench.
#[derive(Debug, Clone)]
pub struct BenchOptions {
    /// Parameters.
    pub config: Config,
    /// Seed of everything random.
    pub seed: u64,
    /// Whether the scene uses `geo.csv` or EXIF positions.
    pub gps: BenchGps,
    /// Whether photos that no truth tells of are compared with a reconstruction of everything together.
    pub joint_reference: bool,
}

/// Positions given to the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BenchGps {
    /// None.
    #[default]
    None,
    /// The data set's `geo.csv`.
    Geo,
    /// The images' EXIF.
    Exif,
}

/// Figures of one method on one set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodFigures {
    /// Photos that have a pose and the verdict "localized".
    pub registered: usize,
    /// Of these, photos in other components of the scene than the largest.
    pub apart: usize,
    /// Centre errors of the registered photos.
    pub position_m: Option<Bounds>,
    /// Rotation errors of the registered photos.
    pub rotation_deg: Option<Bounds>,
    /// Error of the target, when registered and known.
    pub target: Option<PoseError>,
    /// Whether the target is registered.
    pub target_registered: bool,
    /// How the registered photos' errors compare with their covariances; `None` where none has both.
    pub calibration: Option<Calibration>,
    /// Errors by name of all photos that have a pose, whatever the verdict.
    #[serde(skip)]
    pub errors: Errors,
    /// Errors by name in what the covariance states, of all photos that have one.
    #[serde(skip)]
    pub normalized: BTreeMap<String, NormalizedError>,
    /// All photos' answers.
    #[serde(skip)]
    pub answers: Vec<PhotoLocalization>,
}

/// Figures of one set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SetFigures {
    /// The set's folder.
    pub name: String,
    /// Number of photo files.
    pub images: usize,
    /// The target's name.
    pub target: String,
    /// By method: `single`, `camset`, `camset+opt`.
    pub methods: BTreeMap<String, MethodFigures>,
    /// Registered photos of each local component.
    pub local_models: Vec<usize>,
    /// What to do better.
    pub advice: Vec<String>,
}

/// Figures of a data set, in the schema of `results.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DatasetFigures {
    /// The folder's name.
    pub dataset: String,
    /// The scene.
    pub scene: SceneFigures,
    /// The sets. Errors are in metres where a truth is known, else in units of the joint reconstruction.
    pub sets: Vec<SetFigures>,
    /// What photos are compared with that no truth tells of.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub joint_reference: Option<JointReference>,
    /// Time by stage, without the joint reconstruction.
    pub stages: Vec<StageReport>,
    /// Most memory held, in MiB.
    pub peak_rss_mb: f64,
    /// Wall seconds of the whole bench.
    pub wall_s: f64,
    /// CPU seconds of the whole bench.
    pub cpu_s: f64,
    /// Which positions the scene was given.
    pub gps: String,
    /// Unusable images.
    pub skipped: Vec<SkippedImage>,
    /// Sets without a usable photo, and why.
    pub skipped_sets: BTreeMap<String, String>,
    /// What is worth saying of the images and of the scene.
    pub warnings: Vec<String>,
    /// The scene's largest component.
    #[serde(skip)]
    pub model: Reconstruction,
    /// The scene's errors by image.
    #[serde(skip)]
    pub scene_errors: Errors,
}

const TRUTH: &str = "truth.json";

/// Builds the scene of a data set, locates its sets and compares with its truth.
///
/// # Errors
/// When the folder is no data set, the run was stopped or the store cannot be written.
pub fn bench_dataset(session: &Session, root: &Path, options: &BenchOptions) -> Result<DatasetFigures> {
    let optional = |name: &str| Some(root.join(name)).filter(|path| path.is_file());
    let truth = optional(TRUTH).map(|path| Truth::read(&path)).transpose()?;
    let cameras =
        optional("cameras.json").map(|path| CameraBook::read(&path)).transpose()?.unwrap_or_default();
    let kind =
        ["panoramas", "images"].into_iter().find(|name| root.join(name).is_dir()).ok_or_else(|| {
            Hinted::error(
                format!("{} is no data set", root.display()),
                "a data set has a folder `panoramas` or `images`",
            )
        })?;
    let geo = match options.gps {
        BenchGps::None => GeoSource::None,
        BenchGps::Exif => GeoSource::Exif,
        BenchGps::Geo => GeoSource::Table(root.join("geo.csv")),
    };
    let files = list_below(root, &root.join(kind))?;
    let run_name = |folder: &Path| session.store.name_of("bench", folder);
    let folder = ImageFolder::read(&files, &cameras, &geo, None)?;
    let source = SceneSource {
        folder: &folder,
        config: &options.config,
        seed: options.seed,
        name: &run_name(&root.join(kind)),
        present: None,
    };
    let built = match build_scene(session, source, |_| Ok(()))? {
        BuildOutcome::Built(built) => *built,
        BuildOutcome::Unchanged(..) => anyhow::bail!("the scene was not read: this is a bug"),
    };
    let model = built.scene.main().cloned().unwrap_or_default();
    let pictures = Arc::new(PictureBook::of(&folder.images));
    let estimated = poses_of(&model);
    let truth_of = |prefix: &str| truth.as_ref().map_or_else(BTreeMap::new, |truth| truth.poses(prefix));
    let true_scene = truth_of(&format!("{kind}/"));
    let alignment = Alignment::of_centres(&estimated, &true_scene);
    let scene_errors = alignment.as_ref().map_or_else(Errors::new, |a| errors_of(a, &estimated, &true_scene));
    let scene = scene_figures(
        files.len(),
        &built,
        &model,
        &estimated,
        &true_scene,
        alignment.as_ref(),
        &scene_errors,
    );
    let mut found = Vec::new();
    let mut skipped = built.skipped.clone();
    let mut skipped_sets = BTreeMap::new();
    let mut warnings = folder.warnings.clone();
    warnings.extend(built.scene.warnings.clone());
    let mut names: BTreeSet<String> = files.iter().map(|(name, _)| name.clone()).collect();
    for set in set_folders(root)? {
        let name = set.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        // A set of nothing readable leaves the others as they are.
        let read = list_below(root, &set).and_then(|files| {
            names.extend(files.iter().map(|(name, _)| name.clone()));
            // One file is for all folders; it need not know this one's cameras.
            let knows_any = files.iter().any(|(name, path)| cameras.find(name, path).is_some());
            let known = if knows_any { &cameras } else { &CameraBook::default() };
            Ok((ImageFolder::read(&files, known, &GeoSource::None, None)?, files))
        });
        let (mut photos, files) = match read {
            Ok(read) => read,
            Err(error) => {
                skipped_sets.insert(name, format!("{error:#}"));
                continue;
            }
        };
        let target = files.last().map(|(name, _)| name.clone()).unwrap_or_default();
        let what = LocateJobs {
            scene: Arc::clone(&built.scene),
            pictures: Arc::clone(&pictures),
            config: options.config.clone(),
            seed: options.seed,
        };
        let as_read = photos.clone();
        let located = locate(session, &mut photos, &what, Mode::Both, &run_name(&set), &target)?;
        if located.skipped.len() == files.len() {
            let reasons: Vec<String> =
                located.skipped.iter().map(|photo| format!("{}: {}", photo.name, photo.reason)).collect();
            skipped_sets.insert(name, format!("no usable photo: {}", reasons.join("; ")));
            continue;
        }
        skipped.extend(located.skipped.clone());
        warnings.extend(photos.warnings);
        found.push(LocatedSet { name, images: files.len(), target, located, photos: as_read });
    }
    let names = names.iter().map(String::as_str).collect();
    let of_none = |truth: &Truth| truth_without_image(&root.join(TRUTH), truth, &names);
    warnings.extend(truth.as_ref().and_then(of_none));
    let (wall_s, cpu_s) = session.report.totals();
    let (stages, peak_rss_mb) = (session.report.stages(), crate::clock::peak_rss_mib());
    let is_told = !truth_of("queries/").is_empty();
    let joint_reference = if options.joint_reference && !is_told && !found.is_empty() {
        let photos: Vec<&ImageFolder> = found.iter().map(|set| &set.photos).collect();
        let name = run_name(&root.join("joint"));
        match JointReference::build(session, &folder, &photos, options, &name) {
            Ok(reference) => Some(reference),
            Err(error) if error.is::<Interrupted>() || concerns_the_disk(&error) => return Err(error),
            // What was located is told all the same.
            Err(error) => {
                warnings.push(format!("there is no joint reconstruction to compare with: {error:#}"));
                None
            }
        }
    } else {
        None
    };
    let reference = joint_reference.as_ref().map(|joint| &joint.poses);
    let alignments = alignments_of(&built.scene, reference.unwrap_or(&true_scene));
    let sets = found.into_iter().map(|set| {
        let of_truth = truth_of(&format!("queries/{}/", set.name));
        set_figures(set, &alignments, reference.unwrap_or(&of_truth))
    });
    let sets = sets.collect();
    Ok(DatasetFigures {
        dataset: root.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
        scene,
        sets,
        joint_reference,
        stages,
        peak_rss_mb,
        wall_s,
        cpu_s,
        gps: format!("{:?}", options.gps).to_lowercase(),
        skipped,
        skipped_sets,
        warnings,
        model,
        scene_errors,
    })
}

/// Images of a folder, named by their path below `root`.
fn list_below(root: &Path, folder: &Path) -> Result<Vec<(String, PathBuf)>> {
    let mut files = list_images(&[folder.to_owned()])?;
    for (name, path) in &mut files {
        let below = path
            .strip_prefix(root)
            .with_context(|| format!("{} is not below {}", path.display(), root.display()))?;
        *name = below.to_string_lossy().replace('\\', "/");
    }
    files.sort();
    Ok(files)
}

/// The folders of the query sets, sorted.
fn set_folders(root: &Path) -> Result<Vec<PathBuf>> {
    let queries = root.join("queries");
    if !queries.is_dir() {
        return Ok(Vec::new());
    }
    let entries =
        std::fs::read_dir(&queries).with_context(|| format!("cannot list {}", queries.display()))?;
    let mut folders = entries.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>>>()?;
    folders.retain(|path| path.is_dir());
    folders.sort();
    Ok(folders)
}

pub(super) fn poses_of(model: &Reconstruction) -> BTreeMap<String, Rigid> {
    model.images.iter().filter_map(|image| Some((image.name.clone(), image.world_from_camera?))).collect()
}

fn errors_of(
    alignment: &Alignment,
    estimated: &BTreeMap<String, Rigid>,
    truth: &BTreeMap<String, Rigid>,
) -> Errors {
    let one = |(name, pose): (&String, &Rigid)| Some((name.clone(), alignment.error(pose, truth.get(name)?)));
    estimated.iter().filter_map(one).collect()
}

/// How each component of a scene lies in the truth's frame; `None` where the truth does not tell.
fn alignments_of(scene: &SceneFile, truth: &BTreeMap<String, Rigid>) -> Vec<Option<Alignment>> {
    let align = |(component, model)| {
        let poses = poses_of(model);
        let of_centres = if component == 0 { Alignment::of_centres(&poses, truth) } else { None };
        of_centres.or_else(|| Alignment::of_component(&poses, truth))
    };
    scene.components.iter().enumerate().map(align).collect()
}

fn scene_figures(
    images: usize,
    built: &Built,
    model: &Reconstruction,
    estimated: &BTreeMap<String, Rigid>,
    truth: &BTreeMap<String, Rigid>,
    alignment: Option<&Alignment>,
    errors: &Errors,
) -> SceneFigures {
    let spread = |value: fn(&PoseError) -> f64| Bounds::of(errors.values().map(value)).map(Into::into);
    let stated = |value: &dyn Fn(PoseDeviation) -> f64| {
        let (model, errors) = built.scene.components.first().zip(built.scene.errors.first()?.as_ref())?;
        let deviations = model.registered().filter_map(|id| errors.deviation(model, id));
        Bounds::of(deviations.map(value)).map(Into::into)
    };
    let auc = |areas: [f64; 5]| AUC_THRESHOLDS_DEG.iter().map(f64::to_string).zip(areas).collect();
    SceneFigures {
        images,
        registered: estimated.len(),
        components: built.scene.components.len(),
        misplaced: alignment.map_or(0, |alignment| alignment.misplaced().len()),
        points: model.points.len(),
        observations: model.observation_count(),
        mean_angular_error_px: mean_angular_error_px(model, &built.features),
        position_m: spread(|error| error.position_m),
        rotation_deg: spread(|error| error.rotation_deg),
        rotation_own_deg: Bounds::of(own_rotation_errors_deg(estimated, truth)).map(Into::into),
        position_sigma_m: alignment.and_then(|alignment| stated(&|sigma| sigma.center * alignment.scale())),
        rotation_sigma_deg: stated(&|sigma| sigma.rotation_rad.to_degrees()),
        auc: auc_percent(estimated, truth).map(auc),
    }
}

/// A set and what came out.
struct LocatedSet {
    name: String,
    images: usize,
    target: String,
    located: Located,
    /// The photos with what was known of them before.
    photos: ImageFolder,
}

fn set_figures(
    LocatedSet { name, images, target, located, .. }: LocatedSet,
    alignments: &[Option<Alignment>],
    truth: &BTreeMap<String, Rigid>,
) -> SetFigures {
    let set = located.set.unwrap_or_default();
    let methods = [("single", located.single), ("camset", set.rigid), ("camset+opt", set.refined)];
    let methods = methods
        .map(|(method, answers)| (method.to_owned(), method_figures(answers, &target, alignments, truth)));
    let methods = BTreeMap::from(methods);
    SetFigures { name, images, target, methods, local_models: located.local_models, advice: set.advice }
}

fn method_figures(
    answers: Vec<PhotoLocalization>,
    target: &str,
    alignments: &[Option<Alignment>],
    truth: &BTreeMap<String, Rigid>,
) -> MethodFigures {
    let is_registered =
        |photo: &&PhotoLocalization| photo.verdict == Verdict::Localized && photo.world_from_camera.is_some();
    let apart = answers.iter().filter(is_registered).filter(|photo| photo.component > 0).count();
    let registered: Vec<&str> =
        answers.iter().filter(is_registered).map(|photo| photo.name.as_str()).collect();
    let of_component = |photo: &PhotoLocalization| alignments.get(photo.component)?.as_ref();
    let error = |photo: &PhotoLocalization| {
        let error = of_component(photo)?.error(&photo.world_from_camera?, truth.get(&photo.name)?);
        Some((photo.name.clone(), error))
    };
    let of_all: Errors = answers.iter().filter_map(error).collect();
    let mut errors = of_all.clone();
    errors.retain(|name, _| registered.contains(&name.as_str()));
    let normalized = |photo: &PhotoLocalization| {
        let (pose, covariance) = (photo.world_from_camera?, photo.covariance?);
        let error = of_component(photo)?.normalized_error(&pose, &covariance, truth.get(&photo.name)?)?;
        Some((photo.name.clone(), error))
    };
    let normalized: BTreeMap<String, NormalizedError> = answers.iter().filter_map(normalized).collect();
    let of_registered = normalized.iter().filter(|(name, _)| errors.contains_key(*name));
    MethodFigures {
        registered: registered.len(),
        apart,
        position_m: Bounds::of(errors.values().map(|error| error.position_m)),
        rotation_deg: Bounds::of(errors.values().map(|error| error.rotation_deg)),
        target: errors.get(target).copied(),
        target_registered: registered.contains(&target),
        calibration: Calibration::of(of_registered.map(|(_, error)| *error)),
        errors: of_all,
        normalized,
        answers,
    }
}
