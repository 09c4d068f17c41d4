use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use rayon::prelude::*;
use serde_json::Value;
use setloc_features::{Calibration, Camera, ImageFeatures};
use setloc_sfm::{ImageId, MOST_NAMED, Reconstruction, listed};

use super::Answer;
use super::args::{BuildArgs, PlanArgs, PlanFormat, SourceArgs};
use super::outputs::{PAGE, PICTURE, refuse_folder, refuse_image_folder, refuse_input};
use crate::building::{
    BuildOutcome, Built, Pass, SceneSource, alike_pairs, asks_turns, build_scene, by_passes,
    has_guessed_cameras, left_apart, tell_cameras,
};
use crate::codec;
use crate::colmap::{ColmapFormat, PARTS};
use crate::config::Config;
use crate::dataset::{CameraOrigin, ImageFolder, SkippedImage, SourceImage, list_images, unread_images};
use crate::error::Hinted;
use crate::export::{Marker, colmap_lacks, ply, remove_colmap, renew_colmap, scene_json, top_view_png};
use crate::fingerprint::ContentHash;
use crate::graph::{JobGraph, Prediction};
use crate::jobs::{LikelyJobs, SceneInputs, add_first_model, add_model_apart, add_scene};
use crate::pictures::PictureBook;
use crate::print;
use crate::scene::SceneFile;
use crate::session::{Session, cache_folder};
use crate::sources::features_of;
use crate::store::{RunRecord, Store, remove_files, write_atomically};
use crate::turning::{TurnedJobs, guess_by_turns};

/// Blue, for cameras of the scene.
pub const SCENE_COLOR: [u8; 3] = [30, 90, 220];
/// Green, for photos that a scene has grown by.
const GROWN_COLOR: [u8; 3] = [20, 150, 60];

/// `setloc build`
pub fn run(args: &BuildArgs) -> Result<Answer> {
    if args.print_config {
        print::data(args.source.run.config()?.to_toml()?.trim_end())?;
        return Ok(Answer::Done);
    }
    Ok(build(args)?.answer)
}

/// What a build came to.
pub struct BuiltScene {
    pub scene: Arc<SceneFile>,
    /// How many images it was given.
    pub images: usize,
    /// Negative when no image is registered.
    pub answer: Answer,
}

/// Builds the scene and writes its files.
pub fn build(args: &BuildArgs) -> Result<BuiltScene> {
    let config = args.source.run.config()?;
    let output = &args.source.output;
    refuse_folder("-o", output, "scene.setloc")?;
    let export = args.export.clone().unwrap_or_else(|| export_folder(output));
    let files = list_sources(&args.source)?;
    refuse_inputs(&args.source, &files, &export)?;
    let before = FileBefore::read(output)?;
    let mut folder = read_sources(&args.source, &files)?;
    refuse_input(folder.mask_files(), output)?;
    let session = args.source.run.session(output, Some(&export))?;
    let name = session.store.name_of("build", output);
    // The report is written last: exports of another scene, as a killed run leaves them, are none of this one.
    let present = before.as_ref().map(|file| file.hash).filter(|hash| has_exports(&export, *hash));
    let stays =
        |scene: &SceneFile| scene.main().is_none() && before.as_ref().is_some_and(|file| file.is_of_use);
    let write = |built: &Built| {
        if stays(&built.scene) {
            return Ok(());
        }
        // Until it is written again nothing says whose these exports are.
        remove_files(&export, &[REPORT])?;
        let models = || write_models(&export, &built.scene, &built.features);
        let (scene, models) = rayon::join(|| write_atomically(output, &built.file), models);
        scene.and(models)
    };
    let seed = args.source.run.seed;
    let source = SceneSource { folder: &folder, config: &config, seed, name: &name, present };
    let outcome = build_scene(&session, source, write)?;
    let (scene, run, skipped, written) = match outcome {
        BuildOutcome::Unchanged(run, skipped, warnings) => {
            add_warnings(&mut folder, warnings);
            let scene = Arc::new(SceneFile::read(output)?);
            renew_report(&export, &scene, &skipped, &told_by_scene(&folder, &scene))?;
            (scene, run, skipped, Written::AsBefore)
        }
        BuildOutcome::Built(built) => {
            let Built { scene, hash, skipped, warnings, run, .. } = *built;
            add_warnings(&mut folder, warnings);
            let written = if stays(&scene) { Written::Nothing } else { Written::Anew };
            if written == Written::Anew {
                let told = told_by_scene(&folder, &scene);
                write_report(&export, (&scene, hash), &skipped, &told, &session)?;
            }
            (scene, run, skipped, written)
        }
    };
    if written != Written::Nothing {
        PictureBook::of(&folder.images).write(output)?;
    }
    let images = folder.images.len() + folder.skipped.len();
    tell(&scene, &folder, images, &export);
    warn_skipped(&skipped);
    let (wall, cpu) = session.report.totals();
    let (ran, hits) = (run.ran.len(), run.hits);
    print::note(&format!("{ran} jobs ran, {hits} came from the cache; {wall:.1} s, {cpu:.1} CPU s"));
    let outputs = format!("{} and {}/", output.display(), export.display());
    print::note(&match (written, ran) {
        (Written::Anew, _) => format!("wrote {outputs}"),
        (Written::AsBefore, 0) => format!("{} is up to date: nothing changed", output.display()),
        (Written::AsBefore, _) => format!("{outputs} stay as they are: the scene is the same"),
        (Written::Nothing, _) => format!("{outputs} stay as they were: there is no scene to replace them"),
    });
    let answer = if scene.main().is_some() { Answer::Done } else { Answer::Negative };
    Ok(BuiltScene { scene, images, answer })
}

/// What became of the files that were there before a build.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Written {
    /// They are of the scene that was built.
    Anew,
    /// The same scene was built.
    AsBefore,
    /// Nothing was registered, and they stay.
    Nothing,
}

/// The file that a build would replace.
struct FileBefore {
    hash: ContentHash,
    /// Whether it is anything but a scene without images.
    is_of_use: bool,
}

impl FileBefore {
    /// Reads it, if it is there.
    ///
    /// # Errors
    /// When it is a scene that has grown: no build has what it has grown by.
    fn read(output: &Path) -> Result<Option<Self>> {
        let Ok(bytes) = std::fs::read(output) else { return Ok(None) };
        let scene: Option<SceneFile> = codec::decode(&bytes).ok();
        let grown = scene.as_ref().map_or(0, |scene| scene.grown.len());
        if grown > 0 {
            return Err(Hinted::error(
                format!("{} has grown by {grown} photos, which a build would lose", output.display()),
                "name another file with -o, or remove this one",
            ));
        }
        let is_of_use = scene.is_none_or(|scene| scene.main().is_some());
        Ok(Some(Self { hash: ContentHash::of(&bytes), is_of_use }))
    }
}

/// Says what the scene is, and what of it is not in all places where it might be sought.
fn tell(scene: &SceneFile, folder: &ImageFolder, images: usize, export: &Path) {
    summarize(scene, images);
    told_by_scene(folder, scene).estimated_cameras().iter().for_each(|line| print::note(line));
    if let Some(lack) = scene.main().and_then(colmap_lacks) {
        print::note(&format!("warning: no COLMAP model is written: {lack}"));
    }
    if scene.components.len() > 1 {
        print::note(&format!("the other components are in {}/component_2 and so on", export.display()));
    }
}

/// `setloc plan`
pub fn plan(args: &PlanArgs) -> Result<Answer> {
    let config = args.source.run.config()?;
    let folder = read_sources(&args.source, &list_sources(&args.source)?)?;
    let store = Store::at(&cache_folder(args.source.run.cache.as_deref(), &args.source.output));
    let name = store.name_of("build", &args.source.output);
    let alike = stored_alike_pairs(args, &folder, &config, (&store, &name))?;
    let (images, seed) = (&folder.images[..], args.source.run.seed);
    let inputs = SceneInputs { images, alike: &alike, config: &config, seed };
    let graph = next_jobs(args, inputs, (&store, &name))?;
    if args.format == PlanFormat::Dot {
        print::data(graph.to_dot().trim_end())?;
        return Ok(Answer::Done);
    }
    let planned = graph.plan(&store, &store.run(&name));
    if args.format == PlanFormat::Json {
        print::data(&serde_json::to_string_pretty(&planned)?)?;
        return Ok(Answer::Done);
    }
    for job in planned.iter().filter(|job| job.prediction == Prediction::Runs) {
        print::data(&format!("runs     {} {}: {}", job.kind, job.job, job.reasons.join("; ")))?;
    }
    for job in planned.iter().filter(|job| job.prediction == Prediction::Follows) {
        let (first, more) = (&job.reasons[0], job.reasons.len() - 1);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        print::data(&format!("follows  {} {}: {first}{more}", job.kind, job.job))?;
    }
    let count = |what| planned.iter().filter(|job| job.prediction == what).count();
    let (runs, follows, stored) =
        (count(Prediction::Runs), count(Prediction::Follows), count(Prediction::Stored));
    print::data(&format!("{runs} jobs run, {follows} depend on them, {stored} are stored"))?;
    Ok(Answer::Done)
}

/// Whether the results of all jobs are stored, so that running them only reads.
fn is_stored(graph: &JobGraph<'_>, store: &Store) -> bool {
    let planned = graph.plan(store, &RunRecord::default());
    planned.iter().all(|job| job.prediction == Prediction::Stored)
}

/// Pairs of images that look alike, as far as that is known: a plan runs nothing.
fn stored_alike_pairs(
    args: &PlanArgs,
    folder: &ImageFolder,
    config: &Config,
    (store, name): (&Store, &str),
) -> Result<Vec<(usize, usize)>> {
    let mut graph = JobGraph::default();
    if LikelyJobs::add(&mut graph, "all", &folder.images, &config.features, config)?.is_none() {
        return Ok(Vec::new());
    }
    if !is_stored(&graph, store) {
        print::note(
            "pairs of images that look alike are chosen once their features are known, and not listed",
        );
        return Ok(Vec::new());
    }
    let session = args.source.run.session(&args.source.output, None)?;
    Ok(alike_pairs(&session, name, &folder.images, &config.features, config)?.0)
}

/// The jobs of the scene; where its cameras are a guess, those of the model that tells them as long as some of these are not
/// stored. Where its model is torn, those of the second pass, as long as that may tell more.
fn next_jobs<'g>(
    args: &PlanArgs,
    inputs: SceneInputs<'_>,
    (store, name): (&Store, &str),
) -> Result<JobGraph<'g>> {
    let session = || args.source.run.session(&args.source.output, None);
    let images = match planned_cameras(args, inputs, (store, name))? {
        Planned::Known(images) => images,
        Planned::Jobs(graph) => return Ok(graph),
    };
    let images = &images[..];
    let untold = |_| ();
    by_passes(inputs.config, images, untold, |images, stays| {
        let inputs = SceneInputs { images, ..inputs };
        let mut graph = JobGraph::default();
        let apart = add_model_apart(&mut graph, inputs)?;
        graph.want(apart.job);
        if is_stored(&graph, store)
            && let Some((left, again)) = left_apart(&session()?, name, (&graph, &apart), images)?
            && !stays(&left)
        {
            return Ok(Pass::Leaves(left, again));
        }
        let mut graph = JobGraph::default();
        add_scene(&mut graph, inputs)?;
        Ok(Pass::Stays(graph))
    })
}

/// What a plan needs and can have without running anything, or the jobs that are to be run for it.
enum Planned<'g, T> {
    Known(T),
    Jobs(JobGraph<'g>),
}

/// The images with their cameras, as [`estimate_cameras`](crate::building::estimate_cameras) tells those that are guessed.
fn planned_cameras<'g>(
    args: &PlanArgs,
    inputs: SceneInputs<'_>,
    (store, name): (&Store, &str),
) -> Result<Planned<'g, Vec<SourceImage>>> {
    let session = || args.source.run.session(&args.source.output, None);
    let SceneInputs { alike, config, seed, .. } = inputs;
    let mut images = inputs.images.to_vec();
    if !has_guessed_cameras(&images) {
        return Ok(Planned::Known(images));
    }
    let params = (&config.features, config);
    if asks_turns(&images)
        && let Some(jobs) = TurnedJobs::of(&images, alike, params, seed)
    {
        if !is_stored(&jobs.graph, store) {
            print::note(
                "focal lengths are sought by photos of one spot, and what follows from them is not listed",
            );
            return Ok(Planned::Jobs(jobs.graph));
        }
        guess_by_turns(&session()?, name, &mut images, alike, params, seed)?;
    }
    // A second model only where the first leaves doubt.
    let mut told = None;
    for _ in 0..2 {
        let inputs = SceneInputs { images: told.as_deref().unwrap_or(&images), ..inputs };
        let mut graph = JobGraph::default();
        add_first_model(&mut graph, inputs)?;
        if !is_stored(&graph, store) {
            print::note("cameras are estimated by a first model, and what follows from them is not listed");
            return Ok(Planned::Jobs(graph));
        }
        let found = tell_cameras(&session()?, name, inputs)?;
        let is_last = found.told.is_none() || !found.is_doubtful;
        told = found.told.or(told);
        if is_last {
            break;
        }
    }
    Ok(Planned::Known(told.unwrap_or_else(|| inputs.images.to_vec())))
}

/// Neither the scene nor what is exported may replace what the scene is made from.
fn refuse_inputs(source: &SourceArgs, files: &[(String, PathBuf)], export: &Path) -> Result<()> {
    let hint = "name the scene otherwise, or a folder for its exports with --export";
    refuse_image_folder(&source.panoramas, export, hint)?;
    let images = files.iter().map(|(_, path)| path.as_path());
    let table = source.gps.as_deref().map(Path::new);
    let others = [table, source.cameras.as_deref(), source.run.config.as_deref()];
    refuse_input(images.chain(others.into_iter().flatten()), &source.output)
}

/// The scene whose exports are in a folder.
pub fn reported_scene(folder: &Path) -> Option<ContentHash> {
    let report: Value = serde_json::from_slice(&std::fs::read(folder.join(REPORT)).ok()?).ok()?;
    serde_json::from_value(report["scene"].clone()).ok()
}

/// Whether all that was exported of a scene is in a folder as it was written.
fn has_exports(folder: &Path, scene: ContentHash) -> bool {
    let exports = || -> Option<BTreeMap<String, ContentHash>> {
        let report: Value = serde_json::from_slice(&std::fs::read(folder.join(REPORT)).ok()?).ok()?;
        serde_json::from_value(report[EXPORTS].clone()).ok()
    };
    let is_whole = |(name, hash): (&String, &ContentHash)| {
        std::fs::read(folder.join(name)).is_ok_and(|file| ContentHash::of(&file) == *hash)
    };
    reported_scene(folder) == Some(scene) && exports().is_some_and(|exports| exports.par_iter().all(is_whole))
}

/// What [`write_models`] has written of so many components, by the path in the folder.
fn exports_of(folder: &Path, components: usize) -> Result<BTreeMap<String, ContentHash>> {
    let mut files = vec![PathBuf::from(POSES)];
    for at in 0..components.max(1) {
        let of_component = component_folder(Path::new(""), at);
        files.extend([POINT_CLOUD, PICTURE].map(|name| of_component.join(name)));
        let of_colmap =
            PARTS.map(|part| of_component.join(COLMAP_MODEL).join(ColmapFormat::Binary.file(part)));
        files.extend(of_colmap.into_iter().filter(|file| folder.join(file).is_file()));
    }
    let hash = |file: PathBuf| {
        let path = folder.join(&file);
        let content = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok((file.to_string_lossy().into_owned(), ContentHash::of(&content)))
    };
    files.into_par_iter().with_max_len(1).map(hash).collect()
}

fn list_sources(source: &SourceArgs) -> Result<Vec<(String, PathBuf)>> {
    if source.panoramas.is_empty() {
        return Err(Hinted::error(
            "no panoramas given",
            "name a folder: setloc build PANORAMAS -o scene.setloc",
        ));
    }
    list_images(&source.panoramas)
}

fn read_sources(source: &SourceArgs, files: &[(String, PathBuf)]) -> Result<ImageFolder> {
    let masks = source.masks.as_deref();
    let mut folder = ImageFolder::read(files, &source.camera_book()?, &source.geo(), masks)?;
    folder.warnings.extend(unread_images(&source.panoramas, masks));
    remark(&folder);
    Ok(folder)
}

/// Says what the cameras rest on, and what is odd about the images.
pub fn remark(folder: &ImageFolder) {
    for summary in [folder.camera_summary(), folder.mask_summary()].iter().flatten() {
        print::note(summary);
    }
    warn(&folder.warnings);
}

/// Says and notes what turned out to be odd about the images.
fn add_warnings(folder: &mut ImageFolder, warnings: Vec<String>) {
    warn(&warnings);
    folder.warnings.extend(warnings);
}

pub(super) fn warn(warnings: &[String]) {
    for warning in warnings {
        print::note(&format!("warning: {warning}"));
    }
}

/// The scene file's name without its ending, or with `-export` when it has none.
pub fn export_folder(output: &Path) -> PathBuf {
    let folder = output.with_extension("");
    if folder == output { PathBuf::from(format!("{}-export", output.display())) } else { folder }
}

/// Blue markers for the registered images of a model, green ones for those of the names `grown`.
pub fn scene_markers(model: &Reconstruction, grown: &BTreeSet<&str>) -> Vec<Marker> {
    let marker = |id: ImageId| {
        let directed = !model.camera_of(id).is_panoramic();
        let image = &model.images[id.index()];
        let color = if grown.contains(image.name.as_str()) { GROWN_COLOR } else { SCENE_COLOR };
        image.world_from_camera.map(|world_from_camera| Marker { world_from_camera, color, directed })
    };
    model.registered().filter_map(marker).collect()
}

/// The images with the cameras that the scene has of those that it has registered in place of guessed ones.
fn told_by_scene(folder: &ImageFolder, scene: &SceneFile) -> ImageFolder {
    let registered = |component: &Reconstruction, id: ImageId| {
        (component.images[id.index()].name.clone(), component.camera_of(id).clone())
    };
    let told: BTreeMap<String, Camera> = (scene.components.iter())
        .flat_map(|component| component.registered().map(|id| registered(component, id)))
        .collect();
    let image = |image: &SourceImage| {
        let camera = told.get(&image.name).filter(|_| image.calibration == Calibration::Guessed)?.clone();
        Some(SourceImage { camera, camera_origin: CameraOrigin::Estimated, ..image.clone() })
    };
    let images = folder.images.iter().map(|given| image(given).unwrap_or_else(|| given.clone())).collect();
    folder.once_told(images)
}

/// Poses, and of each component the point cloud, COLMAP model and picture: of the largest in the folder itself, of the
/// second in its `component_2`, and so on. With features by image name, COLMAP models have the tracks.
pub fn write_models(
    folder: &Path,
    scene: &SceneFile,
    features: &BTreeMap<String, Arc<ImageFeatures>>,
) -> Result<()> {
    let none = [Reconstruction::default()];
    // A page of other results would contradict these.
    remove_files(folder, &[PAGE])?;
    let components = if scene.components.is_empty() { &none[..] } else { &scene.components };
    let grown = scene.grown_names();
    let write = |(at, component)| write_model(&component_folder(folder, at), component, features, &grown);
    let (poses, models) = rayon::join(
        || write_json(&folder.join(POSES), &scene_json(scene)),
        || components.par_iter().with_max_len(1).enumerate().try_for_each(write),
    );
    poses.and(models)?;
    // An earlier scene may have had more of them.
    let older = (components.len()..).map(|at| component_folder(folder, at));
    older.take_while(|folder| folder.is_dir()).try_for_each(|folder| remove_model(&folder))
}

/// Where the exports of a component are: of the largest in the folder itself. Numbers are those that people are told.
fn component_folder(folder: &Path, at: usize) -> PathBuf {
    if at == 0 { folder.to_owned() } else { folder.join(format!("component_{}", at + 1)) }
}

const REPORT: &str = "report.json";
/// Of the report: hashes of the files beside it.
const EXPORTS: &str = "exports";
const POSES: &str = "poses.json";
const POINT_CLOUD: &str = "points.ply";
const COLMAP_MODEL: &str = "colmap";

fn write_model(
    folder: &Path,
    model: &Reconstruction,
    features: &BTreeMap<String, Arc<ImageFeatures>>,
    grown: &BTreeSet<&str>,
) -> Result<()> {
    let model = &model.by_name();
    let markers = scene_markers(model, grown);
    let centres: Vec<_> =
        markers.iter().map(|marker| (marker.world_from_camera.translation, marker.color)).collect();
    let features = features_of(model, features);
    let writers: [&(dyn Fn() -> Result<()> + Sync); 3] = [
        // What COLMAP lacks is said when the scene is.
        &|| renew_colmap(&folder.join(COLMAP_MODEL), model, &features).map(drop),
        &|| write_atomically(&folder.join(POINT_CLOUD), ply(model, &centres).as_bytes()),
        &|| write_atomically(&folder.join(PICTURE), &top_view_png(model, &markers)?),
    ];
    writers.into_par_iter().with_max_len(1).try_for_each(|write| write())
}

/// Removes what [`write_model`] wrote for an earlier scene, and the folder if nothing else is in it.
fn remove_model(folder: &Path) -> Result<()> {
    remove_colmap(&folder.join(COLMAP_MODEL))?;
    remove_files(folder, &[POINT_CLOUD, PICTURE])
}

/// What the run cost, what was exported, and what is to be said of the scene and of the images that it was given, with the cameras that
/// it told; written last.
pub fn write_report(
    folder: &Path,
    (scene, hash): (&SceneFile, ContentHash),
    skipped: &[SkippedImage],
    images: &ImageFolder,
    session: &Session,
) -> Result<()> {
    let mut report = session.report.to_json();
    report["scene"] = serde_json::json!(hash);
    report[EXPORTS] = serde_json::json!(exports_of(folder, scene.components.len())?);
    note_remarks(&mut report, scene, skipped, images);
    write_json(&folder.join(REPORT), &report)
}

/// The same of a scene that is there already: what the run cost that made it stays.
fn renew_report(
    folder: &Path,
    scene: &SceneFile,
    skipped: &[SkippedImage],
    images: &ImageFolder,
) -> Result<()> {
    let file = folder.join(REPORT);
    let before: Value = serde_json::from_slice(&std::fs::read(&file)?)?;
    let mut report = before.clone();
    note_remarks(&mut report, scene, skipped, images);
    if report == before {
        return Ok(());
    }
    remove_files(folder, &[PAGE])?;
    write_json(&file, &report)
}

fn note_remarks(report: &mut Value, scene: &SceneFile, skipped: &[SkippedImage], images: &ImageFolder) {
    report["skipped"] = serde_json::json!(skipped);
    report["warnings"] = serde_json::json!([&images.warnings[..], &scene.warnings].concat());
    report["notes"] = serde_json::json!([&scene.notes[..], &images.estimated_cameras()].concat());
}

/// Readable JSON, as a file.
pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    write_atomically(path, readable_json(value)?.as_bytes())
}

/// Readable JSON that ends as a file does.
pub fn readable_json(value: &impl serde::Serialize) -> Result<String> {
    Ok(serde_json::to_string_pretty(value)? + "\n")
}

/// Says what a scene is.
pub fn summarize(scene: &SceneFile, images: usize) {
    match scene.main() {
        Some(model) => print::note(&format!(
            "scene: {}/{images} images, {} components, {} points, {} observations",
            model.registered().count(),
            scene.components.len(),
            model.points.len(),
            model.observation_count()
        )),
        None => print::note(&format!("scene: 0/{images} images could be registered")),
    }
    let unregistered = scene.unregistered();
    if !unregistered.is_empty() {
        print::note(&format!("not registered: {}", listed(&unregistered, MOST_NAMED)));
    }
    for note in &scene.notes {
        print::note(&format!("note: {note}"));
    }
    warn(&scene.warnings);
}

/// Says which images were left out.
pub fn warn_skipped(skipped: &[SkippedImage]) {
    for image in skipped {
        print::note(&format!("skipped {}: {}", image.name, image.reason));
    }
    if !skipped.is_empty() {
        print::note(&format!("{} images skipped", skipped.len()));
    }
}
