use std::path::Path;

use anyhow::{Context, Result};
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;
use setloc_camset::Verdict;

use super::{Digest, ImageRow, Standing};
use crate::dataset::SkippedImage;
use crate::error::Hinted;
use crate::subscribers::StageReport;
use crate::text::apart;

/// An image of a scene with fewer observations than this share of the median is named as weak.
const WEAK_SHARE: f64 = 0.2;

/// `poses.json` of either command.
enum Poses {
    Scene(ScenePoses),
    Located(LocatedPoses),
}

impl Poses {
    /// That of the command which it has the keys of.
    fn read(file: &Path, bytes: &[u8]) -> Result<Self> {
        let shown = file.display();
        let damaged = |error: serde_json::Error| {
            let error = anyhow::Error::new(error).context(format!("{shown} is damaged"));
            Hinted::wrap(error, "run the command again that wrote it")
        };
        let json: Value = serde_json::from_slice(bytes).map_err(damaged)?;
        if json.get("components").is_some() {
            return serde_json::from_value(json).map(Self::Scene).map_err(damaged);
        }
        if json.get("photos").is_some() {
            return serde_json::from_value(json).map(Self::Located).map_err(damaged);
        }
        let is_of_bench = file.with_file_name("results.json").is_file();
        let hint = if is_of_bench {
            "results of `setloc bench` are in the report.html beside it"
        } else {
            "name the output folder of `setloc build` or `setloc locate`"
        };
        Err(Hinted::error(format!("{shown} holds no results of `build` or `locate`"), hint))
    }
}

#[derive(Deserialize)]
struct ScenePoses {
    components: Vec<Component>,
    warnings: Vec<String>,
    #[serde(default)]
    notes: Vec<String>,
}

#[derive(Deserialize)]
struct Component {
    points: usize,
    observations: usize,
    images: Vec<SceneImage>,
    /// Whether its frame is not that of the largest.
    #[serde(default)]
    own_frame: bool,
}

#[derive(Deserialize)]
struct SceneImage {
    name: String,
    world_from_camera: Option<IgnoredAny>,
    observations: usize,
    /// Whether it is a photo that the scene has grown by.
    #[serde(default)]
    grown: bool,
}

#[derive(Deserialize)]
struct LocatedPoses {
    target: String,
    photos: Vec<Photo>,
    advice: Option<Vec<String>>,
    skipped: Vec<SkippedImage>,
    #[serde(default)]
    scene_warnings: Vec<String>,
}

#[derive(Deserialize)]
struct Photo {
    name: String,
    verdict: Verdict,
    method: String,
    inliers: usize,
    reasons: Vec<String>,
    sigma: Option<Sigma>,
    wgs84_sigma: Option<MapSigma>,
    world_from_camera: Option<IgnoredAny>,
    #[serde(default)]
    component: usize,
    /// Whether its pose is not in the frame of the largest component.
    #[serde(default)]
    own_frame: bool,
}

#[derive(Deserialize)]
struct Sigma {
    rotation_deg: f64,
    position: f64,
}

#[derive(Deserialize)]
struct MapSigma {
    horizontal_m: f64,
}

/// `report.json`; a folder without one has no times.
#[derive(Default, Deserialize)]
struct Report {
    stages: Vec<StageReport>,
    #[serde(default)]
    skipped: Vec<SkippedImage>,
    /// Of the images, and of a build also its scene's.
    #[serde(default)]
    warnings: Vec<String>,
    /// The same, and on cameras that were estimated.
    #[serde(default)]
    notes: Vec<String>,
}

impl Digest {
    /// Reads an output folder of `build` or `locate`.
    ///
    /// # Errors
    /// When it is none, or a file of it is damaged.
    pub fn read(folder: &Path) -> Result<Self> {
        let file = folder.join("poses.json");
        let bytes = std::fs::read(&file).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("cannot read {}", file.display()));
            Hinted::wrap(error, "name the output folder of `setloc build` or `setloc locate`")
        })?;
        let poses = Poses::read(&file, &bytes)?;
        let file = folder.join("report.json");
        let report = match std::fs::read(&file) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .with_context(|| format!("{} is no report of a run", file.display()))?,
            Err(_) => Report::default(),
        };
        let title = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        let title = title.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let digest = match poses {
            Poses::Scene(scene) => of_scene(&title, scene, report.skipped),
            Poses::Located(located) => of_photos(&title, located),
        };
        Ok(Self {
            stages: report.stages,
            warnings: with_further(report.warnings, &digest.warnings),
            notes: with_further(report.notes, &digest.notes),
            top_view: std::fs::read(folder.join("top_view.png")).ok(),
            ..digest
        })
    }
}

/// Some lines and those of others that are not among them.
fn with_further(mut lines: Vec<String>, others: &[String]) -> Vec<String> {
    let further: Vec<String> = others.iter().filter(|line| !lines.contains(line)).cloned().collect();
    lines.extend(further);
    lines
}

fn of_scene(name: &str, scene: ScenePoses, skipped: Vec<SkippedImage>) -> Digest {
    let Some(main) = scene.components.first() else {
        return Digest {
            title: format!("Scene {name}"),
            headline: "No image could be registered.".to_owned(),
            warnings: scene.warnings,
            notes: scene.notes,
            skipped,
            ..Digest::default()
        };
    };
    let registered_in =
        |model: &Component| model.images.iter().filter(|image| image.world_from_camera.is_some()).count();
    let registered = registered_in(main);
    let apart: usize = scene.components.iter().skip(1).map(registered_in).sum();
    let grown = main.images.iter().filter(|image| image.grown).count();
    let built = main.images.iter().filter(|image| !image.grown);
    let mut observations: Vec<usize> = built.map(|image| image.observations).collect();
    observations.sort_unstable();
    let least = WEAK_SHARE * observations.get(observations.len() / 2).map_or(0.0, |&median| median as f64);
    let row = |image: &SceneImage| {
        let others = scene.components.iter().enumerate().skip(1);
        let mut others = others.filter(|_| image.world_from_camera.is_none());
        let elsewhere = others.find_map(|(at, component)| {
            let is_it = |other: &&SceneImage| other.name == image.name && other.world_from_camera.is_some();
            component.images.iter().find(is_it).map(|image| (at, image))
        });
        let (standing, verdict) = match (&image.world_from_camera, elsewhere) {
            (None, None) => (Standing::Bad, "not registered".to_owned()),
            (None, Some((at, _))) => (Standing::Good, format!("registered in component {}", at + 1)),
            (Some(_), _) if image.grown => (Standing::Good, "added by growth".to_owned()),
            (Some(_), _) if (image.observations as f64) < least => (Standing::Weak, "weakly tied".to_owned()),
            (Some(_), _) => (Standing::Good, "registered".to_owned()),
        };
        let observations = elsewhere.map_or(image.observations, |(_, image)| image.observations);
        ImageRow {
            name: image.name.clone(),
            standing,
            verdict,
            evidence: format!("{observations} observations"),
            reasons: Vec::new(),
            is_target: false,
        }
    };
    let images: Vec<ImageRow> = main.images.iter().map(row).collect();
    let of_standing = |standing| {
        let names = images.iter().filter(|image| image.standing == standing).map(|image| image.name.as_str());
        names.collect::<Vec<_>>().join(", ")
    };
    let (lost, weak) = (of_standing(Standing::Bad), of_standing(Standing::Weak));
    let mut advice = Vec::new();
    if !lost.is_empty() {
        advice
            .push(format!("not registered: {lost}; panoramas between them and the others would tie them in"));
    }
    if !weak.is_empty() {
        advice.push(format!("weakly tied: {weak}; panoramas beside them would make them firm"));
    }
    if scene.components.len() > 1 {
        let is_apart = scene.components.iter().any(|component| component.own_frame);
        advice.push(format!(
            "the scene falls into {} parts{}: panoramas between them would join them",
            scene.components.len(),
            if is_apart { ", not all in one frame" } else { "" }
        ));
    }
    Digest {
        title: format!("Scene {name}"),
        headline: format!(
            "{registered} of {} images registered{}{}, {} points, {} observations.",
            main.images.len(),
            if apart > 0 { format!(", {apart} in other components") } else { String::new() },
            if grown > 0 { format!(", {grown} of them added by growth") } else { String::new() },
            main.points,
            main.observations
        ),
        warnings: scene.warnings,
        notes: scene.notes,
        advice,
        images,
        skipped,
        ..Digest::default()
    }
}

fn of_photos(name: &str, located: LocatedPoses) -> Digest {
    let row = |photo: Photo| {
        let standing = match photo.verdict {
            Verdict::Localized => Standing::Good,
            Verdict::Uncertain => Standing::Weak,
            Verdict::NotLocalized => Standing::Bad,
        };
        let verdict = photo.verdict.in_words();
        let precision = photo.sigma.map_or_else(String::new, |sigma| {
            format!(", σ {:.3} and {:.3}°", sigma.position, sigma.rotation_deg)
        });
        let on_map = photo
            .wgs84_sigma
            .map_or_else(String::new, |sigma| format!(", {:.2} m on the map", sigma.horizontal_m));
        let is_apart = photo.world_from_camera.is_some() && photo.own_frame;
        let frame = if is_apart { format!(", {}", apart(photo.component)) } else { String::new() };
        ImageRow {
            is_target: photo.name == located.target,
            name: photo.name,
            standing,
            verdict: verdict.to_owned(),
            evidence: format!("{}, {} inliers{precision}{on_map}{frame}", photo.method, photo.inliers),
            reasons: photo.reasons,
        }
    };
    let images: Vec<ImageRow> = located.photos.into_iter().map(row).collect();
    let localized = images.iter().filter(|image| image.standing == Standing::Good).count();
    let target =
        images.iter().find(|image| image.is_target).map_or("without an answer", |image| &image.verdict);
    Digest {
        title: format!("Photos {name}"),
        headline: format!(
            "Target {}: {target}. {localized} of {} photos localized.",
            located.target,
            images.len()
        ),
        warnings: located.scene_warnings.iter().map(|warning| format!("of the scene: {warning}")).collect(),
        advice: located.advice.unwrap_or_default(),
        images,
        skipped: located.skipped,
        ..Digest::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_that_are_damaged_or_of_others_are_told_apart() {
        let folder = tempfile::tempdir().unwrap();
        let said = |text: &str| {
            std::fs::write(folder.path().join("poses.json"), text).unwrap();
            let error = Digest::read(folder.path()).unwrap_err();
            let hint =
                error.chain().find_map(|cause| cause.downcast_ref::<Hinted>()).unwrap().hint().to_owned();
            (format!("{error:#}"), hint)
        };
        let (error, hint) = said("{\"components\": [");
        assert!(
            error.contains("poses.json is damaged: EOF") && hint.contains("run the command again"),
            "{error}"
        );
        let (error, _) = said("{\"components\": []}");
        assert!(error.contains("poses.json is damaged: missing field `warnings`"), "{error}");
        let (error, hint) = said("{\"a.jpg\": {\"R\": [], \"C\": []}}");
        assert!(error.contains("holds no results of") && hint.contains("output folder"), "{error} {hint}");
        std::fs::write(folder.path().join("results.json"), "").unwrap();
        assert!(said("{}").1.contains("report.html"));
    }
}
