use std::path::PathBuf;

use anyhow::{Context, Result};
use serde::Deserialize;

use super::Answer;
use super::args::{BatchArgs, BuildArgs, LocateArgs, RunArgs, SourceArgs};
use crate::error::Interrupted;
use crate::locating::Mode;
use crate::print;

/// Many scenes and sets in one file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    #[serde(default)]
    scene: Vec<SceneEntry>,
    /// Parameter name to values; every combination is run.
    #[serde(default)]
    sweep: std::collections::BTreeMap<String, Vec<toml::Value>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneEntry {
    name: String,
    panoramas: Vec<PathBuf>,
    gps: Option<String>,
    masks: Option<PathBuf>,
    cameras: Option<PathBuf>,
    #[serde(default)]
    sets: Vec<SetEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SetEntry {
    name: String,
    photos: Vec<PathBuf>,
    target: Option<String>,
    cameras: Option<PathBuf>,
}

/// `setloc batch`
///
/// One failing scene does not stop the others. All runs share one store, so a sweep repeats only what depends on the
/// swept parameter.
pub fn run(args: &BatchArgs) -> Result<Answer> {
    let shown = args.manifest.display();
    let text = std::fs::read_to_string(&args.manifest).with_context(|| format!("cannot read {shown}"))?;
    let manifest: Manifest =
        toml::from_str(&text).with_context(|| format!("{shown} is no valid manifest"))?;
    let base = args.manifest.parent().map(PathBuf::from).unwrap_or_default();
    let cache = args.run.cache.clone().unwrap_or_else(|| args.output.join(".setloc-cache"));
    let (mut summary, mut failures, mut negatives) = (Vec::new(), 0, 0);
    for (suffix, settings) in combinations(&manifest.sweep) {
        let mut run = RunArgs { cache: Some(cache.clone()), ..args.run.clone() };
        run.settings.extend(settings);
        for entry in &manifest.scene {
            let folder = args.output.join(format!("{}{suffix}", entry.name));
            let mut outcomes = Vec::new();
            let source = SourceArgs {
                panoramas: entry.panoramas.iter().map(|path| base.join(path)).collect(),
                output: folder.join("scene.setloc"),
                gps: entry
                    .gps
                    .clone()
                    .map(|gps| if gps == "exif" { gps } else { base.join(gps).display().to_string() }),
                masks: entry.masks.as_ref().map(|path| base.join(path)),
                cameras: entry.cameras.as_ref().map(|path| base.join(path)),
                run: run.clone(),
            };
            let scene = source.output.clone();
            let built = super::build::run(&BuildArgs { source, export: None, print_config: false });
            let usable = built.is_ok();
            outcomes.push((format!("{}{suffix}", entry.name), built));
            for set in entry.sets.iter().filter(|_| usable) {
                let located = super::locate::run(&LocateArgs {
                    scene: scene.clone(),
                    photos: set.photos.iter().map(|path| base.join(path)).collect(),
                    target: set.target.clone(),
                    mode: Mode::Auto,
                    cameras: set.cameras.as_ref().map(|path| base.join(path)),
                    output: folder.join(&set.name),
                    run: run.clone(),
                });
                outcomes.push((format!("{}{suffix}/{}", entry.name, set.name), located));
            }
            for (name, outcome) in outcomes {
                let word = match outcome {
                    Ok(Answer::Done) => "done".to_owned(),
                    Ok(Answer::Negative) => {
                        negatives += 1;
                        "negative".to_owned()
                    }
                    Err(error) if error.is::<Interrupted>() => return Err(error),
                    Err(error) => {
                        failures += 1;
                        super::show(&error);
                        format!("failed: {error:#}")
                    }
                };
                summary.push(format!("{name}\t{word}"));
            }
        }
    }
    for line in &summary {
        print::data(line);
    }
    anyhow::ensure!(failures == 0, "{failures} of {} parts failed", summary.len());
    Ok(if negatives == 0 { Answer::Done } else { Answer::Negative })
}

/// Every combination of swept values: a name to add to folders, and the settings.
fn combinations(sweep: &std::collections::BTreeMap<String, Vec<toml::Value>>) -> Vec<(String, Vec<String>)> {
    let mut all = vec![(String::new(), Vec::new())];
    for (key, values) in sweep {
        let extend = |(suffix, settings): &(String, Vec<String>)| {
            let one = |value: &toml::Value| {
                let mut settings = settings.clone();
                settings.push(format!("{key}={value}"));
                (format!("{suffix}-{key}={}", value.to_string().replace(['/', '"'], "")), settings)
            };
            values.iter().map(one).collect::<Vec<_>>()
        };
        all = all.iter().flat_map(extend).collect();
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sweep_is_every_combination() {
        let sweep = toml::from_str("\"camset.a\" = [1, 2]\n\"sfm.b\" = [true, false, true]").unwrap();
        let all = combinations(&sweep);
        assert_eq!(all.len(), 6);
        assert_eq!(
            all[0],
            ("-camset.a=1-sfm.b=true".to_owned(), vec!["camset.a=1".to_owned(), "sfm.b=true".to_owned()])
        );
    }
}
