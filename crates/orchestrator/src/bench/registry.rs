use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::BenchGps;
use crate::config::Config;
use crate::error::Hinted;
use crate::fingerprint::ContentHash;
use crate::text::read_text;

/// Which data sets a benchmark runs over, and with which parameters.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Registry {
    /// The data sets, in the order in which they are run.
    pub dataset: Vec<DatasetEntry>,
    /// The parameter sets; the defaults alone when none is listed.
    #[serde(default)]
    pub parameters: Vec<ParameterSet>,
}

/// A registered data set.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetEntry {
    /// Its name in tables and in the baseline.
    pub name: String,
    /// Its folder below the data folder; the sample town, rendered when it is needed, when missing.
    pub path: Option<PathBuf>,
    /// [`checksum_of`] the folder.
    pub checksum: Option<ContentHash>,
    /// Where its truth comes from.
    pub truth: TruthKind,
    /// Under which terms it may be used.
    pub licence: String,
    /// Positions given to the scene.
    #[serde(default)]
    pub gps: BenchGps,
}

/// Where a data set's truth comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TruthKind {
    /// Rendered: known exactly.
    Exact,
    /// Measured by better instruments.
    Measured,
    /// None: only registration is counted.
    None,
}

/// A named set of settings.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterSet {
    /// Its name in tables and in the baseline.
    pub name: String,
    /// `stage.key=value` on top of the defaults.
    #[serde(default)]
    pub settings: Vec<String>,
}

/// What a registered data set is at hand as.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Availability {
    /// The folder.
    Present(PathBuf),
    /// To be rendered.
    Rendered,
    /// It is skipped, for this reason.
    Missing(String),
}

impl Registry {
    /// Reads a registry and checks its names and settings.
    ///
    /// # Errors
    /// With file, and line or name.
    pub fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = read_text(path).map_err(|error| {
            Hinted::wrap(error, "name data sets (`setloc bench DATASET`) or a registry (--registry FILE)")
        })?;
        let mut registry: Self =
            toml::from_str(&text).with_context(|| format!("{shown} is no valid registry"))?;
        if registry.parameters.is_empty() {
            registry.parameters.push(ParameterSet { name: "default".to_owned(), settings: Vec::new() });
        }
        let mut names = BTreeSet::new();
        let datasets = registry.dataset.iter().map(|entry| ("data set", &entry.name));
        for (what, name) in datasets.chain(registry.parameters.iter().map(|set| ("parameter set", &set.name)))
        {
            let plain =
                !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_+".contains(c));
            anyhow::ensure!(plain, "{shown}: {what} `{name}`: use letters, digits, `-`, `+` and `_`");
            anyhow::ensure!(names.insert((what, name)), "{shown}: two entries of the name `{name}`");
        }
        for set in &registry.parameters {
            Config::resolve(None, &set.settings)
                .with_context(|| format!("{shown}: parameter set `{}`", set.name))?;
        }
        Ok(registry)
    }

    /// Keeps only the named data sets, all when no name is given.
    ///
    /// # Errors
    /// When a name is not registered.
    pub fn keep_only(&mut self, names: &[String]) -> Result<()> {
        let known: Vec<&str> = self.dataset.iter().map(|entry| entry.name.as_str()).collect();
        if let Some(unknown) = names.iter().find(|name| !known.contains(&name.as_str())) {
            let hint = format!("registered are {}", known.join(", "));
            return Err(Hinted::error(format!("no data set is registered as `{unknown}`"), hint));
        }
        if !names.is_empty() {
            self.dataset.retain(|entry| names.contains(&entry.name));
        }
        Ok(())
    }
}

impl DatasetEntry {
    /// Looks for the data set below the data folder and compares its checksum.
    ///
    /// # Errors
    /// When a file of it cannot be read.
    pub fn find(&self, data: &Path) -> Result<Availability> {
        let Some(path) = &self.path else { return Ok(Availability::Rendered) };
        let folder = data.join(path);
        if !folder.is_dir() {
            return Ok(Availability::Missing(format!("{} is not present", folder.display())));
        }
        if let Some(expected) = self.checksum {
            let found = checksum_of(&folder)?;
            if found != expected {
                let reason = format!("{} has checksum {found}, registered is {expected}", folder.display());
                return Ok(Availability::Missing(reason));
            }
        }
        Ok(Availability::Present(folder))
    }
}

/// One hash over the names and contents of all files of a folder.
///
/// # Errors
/// When a file cannot be read.
pub fn checksum_of(folder: &Path) -> Result<ContentHash> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).with_context(|| format!("cannot list {}", next.display()))? {
            let path = entry?.path();
            if path.is_dir() { folders.push(path) } else { files.push(path) }
        }
    }
    files.sort();
    let hash = |path: &PathBuf| -> Result<[ContentHash; 2]> {
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let name = path.strip_prefix(folder).unwrap_or(path).to_string_lossy().into_owned();
        Ok([ContentHash::of(name.as_bytes()), ContentHash::of(&bytes)])
    };
    let hashes = files.par_iter().map(hash).collect::<Result<Vec<_>>>()?;
    Ok(ContentHash::of_all(&hashes.concat()))
}

#[cfg(test)]
mod tests {
    use setloc_camset::CamsetParams;

    use super::*;

    fn registry(text: &str) -> Result<Registry> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("datasets.toml");
        std::fs::write(&path, text).unwrap();
        Registry::read(&path)
    }

    const ENTRY: &str = "[[dataset]]\nname = \"a\"\npath = \"a\"\ntruth = \"exact\"\nlicence = \"MIT\"\n";

    #[test]
    fn wrong_entries_are_refused_by_name() {
        assert_eq!(registry(ENTRY).unwrap().parameters[0].name, "default");
        let error = |text: &str| format!("{:#}", registry(text).unwrap_err());
        assert!(error(&ENTRY.repeat(2)).contains("two entries of the name `a`"));
        let wrong = format!("{ENTRY}[[parameters]]\nname = \"b\"\nsettings = [\"camset.rato=1\"]\n");
        assert!(error(&wrong).contains("parameter set `b`"));
        let mut one = registry(ENTRY).unwrap();
        assert!(format!("{:#}", one.keep_only(&["b".to_owned()]).unwrap_err()).contains("`b`"));
    }

    #[test]
    fn the_papers_parameter_set_has_the_papers_settings() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let registry = Registry::read(&root.join("benchmarks/datasets.toml")).unwrap();
        let dlt = registry.parameters.iter().find(|set| set.name == "dlt").unwrap();
        let config = Config::resolve(None, &dlt.settings).unwrap();
        assert_eq!(config, Config { camset: CamsetParams::paper(), ..Config::default() });
    }

    #[test]
    fn a_data_set_is_used_only_when_it_is_the_registered_one() {
        let data = tempfile::tempdir().unwrap();
        let mut entry = registry(ENTRY).unwrap().dataset.remove(0);
        assert!(matches!(entry.find(data.path()).unwrap(), Availability::Missing(_)));
        let folder = data.path().join("a");
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join("x"), "content").unwrap();
        assert_eq!(entry.find(data.path()).unwrap(), Availability::Present(folder.clone()));
        entry.checksum = Some(checksum_of(&folder).unwrap());
        assert_eq!(entry.find(data.path()).unwrap(), Availability::Present(folder.clone()));
        std::fs::rename(folder.join("x"), folder.join("y")).unwrap();
        assert!(matches!(entry.find(data.path()).unwrap(), Availability::Missing(_)));
    }
}
