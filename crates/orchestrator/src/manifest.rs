//! The manifest of a batch: many scenes and sets, and parameters to sweep, in one TOML file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::Deserialize;

use crate::config::Config;
use crate::error::Hinted;
use crate::text::read_text;

/// A batch. Paths are relative to the manifest.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Scenes in the order in which they are built.
    #[serde(default)]
    pub scene: Vec<SceneEntry>,
    /// Parameter name to values; every combination is run.
    #[serde(default)]
    pub sweep: BTreeMap<String, Vec<toml::Value>>,
}

/// A scene to build.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneEntry {
    /// Its name: the folder of its results.
    pub name: String,
    /// Folders with panoramas, or files.
    pub panoramas: Vec<PathBuf>,
    /// `exif`, or a table of positions.
    pub gps: Option<String>,
    /// Folder of mask images.
    pub masks: Option<PathBuf>,
    /// Known intrinsics.
    pub cameras: Option<PathBuf>,
    /// Sets to locate in it.
    #[serde(default)]
    pub sets: Vec<SetEntry>,
}

/// A set of photos to locate.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetEntry {
    /// Its name: the folder of its results within the scene's.
    pub name: String,
    /// Folders with photos, or files.
    pub photos: Vec<PathBuf>,
    /// The photo that matters; the last by name when missing.
    pub target: Option<String>,
    /// Folder of mask images.
    pub masks: Option<PathBuf>,
    /// Known intrinsics.
    pub cameras: Option<PathBuf>,
}

/// One combination of swept values.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Variant {
    /// What is added to the folders' names; empty without a sweep.
    pub suffix: String,
    /// `key=value` for each swept parameter.
    pub settings: Vec<String>,
}

impl Manifest {
    /// Reads a manifest and checks its names.
    ///
    /// # Errors
    /// With file, and line or name.
    pub fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = read_text(path)?;
        let manifest: Self = toml::from_str(&text).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("{shown} is no valid manifest"));
            Hinted::wrap(error, "README, \"Many scenes at once\", shows one")
        })?;
        if manifest.scene.is_empty() {
            return Err(Hinted::error(
                format!("{shown} names no scene"),
                "add a [[scene]] with name and panoramas",
            ));
        }
        check_names(manifest.scene.iter().map(|scene| scene.name.as_str()), &[])
            .with_context(|| format!("{shown}: scenes"))?;
        for scene in &manifest.scene {
            // The scene's own results are in a folder and a file of these names.
            check_names(scene.sets.iter().map(|set| set.name.as_str()), &["scene", "scene.setloc"])
                .with_context(|| format!("{shown}: sets of scene `{}`", scene.name))?;
        }
        Ok(manifest)
    }

    /// Every combination of swept values, each checked to be a valid configuration on top of `file` and `settings`.
    ///
    /// # Errors
    /// With the parameter and value that are not valid.
    pub fn variants(&self, file: Option<&Path>, settings: &[String]) -> Result<Vec<Variant>> {
        if let Some((key, _)) = self.sweep.iter().find(|(_, values)| values.is_empty()) {
            let message = format!("[sweep] has no value for `{key}`");
            return Err(Hinted::error(message, "list values, or leave the parameter out"));
        }
        let variants = combinations(&self.sweep);
        for variant in &variants {
            Config::resolve(file, &[settings, &variant.settings].concat()).with_context(|| {
                format!("the configuration with [sweep] {} is not valid", variant.settings.join(", "))
            })?;
        }
        let mut suffixes = BTreeSet::new();
        if let Some(twice) = variants.iter().find(|variant| !suffixes.insert(&variant.suffix)) {
            let message = format!("[sweep] gives two results the name `{}`", twice.suffix);
            return Err(Hinted::error(message, "list each value once"));
        }
        Ok(variants)
    }
}

/// Names become folders: they must be plain, and differ.
fn check_names<'n>(names: impl Iterator<Item = &'n str>, taken: &[&str]) -> Result<()> {
    let mut seen: BTreeSet<&str> = taken.iter().copied().collect();
    for name in names {
        if name.is_empty() || name.starts_with('.') || name.contains(['/', '\\', '\0']) {
            let message = format!("`{name}` cannot name a folder");
            return Err(Hinted::error(message, "use letters, digits, `-` and `_`"));
        }
        if !seen.insert(name) {
            return Err(Hinted::error(format!("the name `{name}` is taken"), "give each a name of its own"));
        }
    }
    Ok(())
}

fn combinations(sweep: &BTreeMap<String, Vec<toml::Value>>) -> Vec<Variant> {
    let mut all = vec![Variant { suffix: String::new(), settings: Vec::new() }];
    let plain = |c: char| if c.is_alphanumeric() || "-_.=+".contains(c) { c } else { '_' };
    for (key, values) in sweep {
        let extend = |variant: &Variant| {
            let one = |value: &toml::Value| {
                let readable = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
                let mut variant = variant.clone();
                variant.suffix.extend(format!("-{key}={readable}").chars().map(plain));
                variant.settings.push(format!("{key}={value}"));
                variant
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

    fn manifest(text: &str) -> Result<Manifest> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("batch.toml");
        std::fs::write(&path, text).unwrap();
        Manifest::read(&path)
    }

    fn error_of<T: std::fmt::Debug>(result: Result<T>) -> String {
        format!("{:#}", result.unwrap_err())
    }

    #[test]
    fn a_sweep_is_every_combination() {
        let scene = "[[scene]]\nname = \"a\"\npanoramas = [\"a\"]\n";
        let sweep = "[sweep]\n\"camset.ratio\" = [0.6, 0.7]\n\"camset.method\" = [\"dlt\"]\n";
        let all = manifest(&format!("{scene}{sweep}")).unwrap().variants(None, &[]).unwrap();
        assert_eq!(all.len(), 2);
        assert_eq!(all[0].suffix, "-camset.method=dlt-camset.ratio=0.6");
        assert_eq!(all[0].settings, ["camset.method=\"dlt\"", "camset.ratio=0.6"]);
    }

    #[test]
    fn a_sweep_over_nothing_that_exists_is_refused_before_anything_runs() {
        let scene = "[[scene]]\nname = \"a\"\npanoramas = [\"a\"]\n";
        let one = |sweep: &str| {
            error_of(manifest(&format!("{scene}[sweep]\n{sweep}")).unwrap().variants(None, &[]))
        };
        assert!(one("\"camset.rato\" = [1]").contains("camset.rato=1"));
        assert!(one("\"camset.ratio\" = [0.6, \"x\"]").contains("camset.ratio=\"x\""));
        assert!(one("\"camset.ratio\" = [0.6, 0.6]").contains("two results"));
    }

    #[test]
    fn a_set_may_have_masks_of_its_own() {
        let scene = "[[scene]]\nname = \"a\"\npanoramas = [\"a\"]\n";
        let set = "[[scene.sets]]\nname = \"b\"\nphotos = [\"b\"]\nmasks = \"m\"\n";
        let read = manifest(&format!("{scene}{set}")).unwrap();
        assert_eq!(read.scene[0].sets[0].masks.as_deref(), Some(Path::new("m")));
        assert_eq!(read.scene[0].masks, None);
    }

    #[test]
    fn names_that_cannot_be_folders_or_meet_are_refused() {
        let scene = |name: &str| format!("[[scene]]\nname = {name:?}\npanoramas = [\"a\"]\n");
        assert!(error_of(manifest(&scene("../a"))).contains("cannot name a folder"));
        assert!(error_of(manifest(&(scene("a") + &scene("a")))).contains("`a` is taken"));
        let set = "[[scene.sets]]\nname = \"scene\"\nphotos = [\"b\"]\n";
        assert!(error_of(manifest(&(scene("a") + set))).contains("`scene` is taken"));
        assert!(error_of(manifest("")).contains("names no scene"));
    }
}
