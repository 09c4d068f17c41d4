//! One configuration: every stage's parameters under its name. Flags override the file, the file the defaults.

mod ranges;

use std::path::Path;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use setloc_camset::{CamsetParams, GrowthParams, SingleParams};
use setloc_index::IndexParams;
use setloc_sfm::{AlignmentParams, GeoregisterParams, MapperParams, QualityParams, TwoViewParams};
use toml::de::DeTable;

use crate::artifacts::LeftApart;
use crate::error::Hinted;
use crate::stages::{FeatureParams, MatchParams};
use crate::text::read_text;

/// Parameters of all stages.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Detection and description.
    pub features: FeatureParams,
    /// Where the features of query photos differ from the scene's.
    pub photos: PhotoParams,
    /// Where the features of images differ that a first model of the scene leaves apart.
    pub second_look: SecondLookParams,
    /// Which pairs are matched.
    pub pairs: PairParams,
    /// Two-nearest-neighbour matching.
    pub matching: MatchParams,
    /// Verification on the sphere.
    pub two_view: TwoViewParams,
    /// Mapping of the scene and of local models.
    pub sfm: MapperParams,
    /// Alignment of a scene's tracks by its images.
    pub alignment: AlignmentParams,
    /// What the quality gate speaks up about.
    pub quality: QualityParams,
    /// Alignment to measured positions.
    pub georegistration: GeoregisterParams,
    /// The scene's index.
    pub index: IndexParams,
    /// Localization of one photo.
    pub single: SingleParams,
    /// Localization of a set.
    pub camset: CamsetParams,
    /// What localized photos add to the scene.
    pub growth: GrowthParams,
}

/// Where the features of query photos differ from the scene's.
///
/// A scene is built from panoramas that lie close together; photos of a set often see one wall from far apart, so
/// oblique views of them are simulated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PhotoParams {
    /// In place of `features.simulated_tilt`.
    pub simulated_tilt: f64,
}

impl Default for PhotoParams {
    fn default() -> Self {
        Self { simulated_tilt: 2.0 }
    }
}

/// Where the features of images differ that a first model of the scene leaves out of its largest component.
///
/// What holds these back is mostly that no third image shares what two of them do. More features cost time, and are
/// sought where the first model shows that they are wanted: where it tells less than half of the images' relative poses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SecondLookParams {
    /// Whether there is a second look.
    pub enabled: bool,
    /// In place of `features.simulated_tilt`, where it is the larger.
    pub simulated_tilt: f64,
}

impl Default for SecondLookParams {
    fn default() -> Self {
        Self { enabled: true, simulated_tilt: 2.0 }
    }
}

/// Which pairs of images are matched.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PairParams {
    /// Up to this many images all pairs are matched.
    pub exhaustive_up_to: usize,
    /// Above that, each image is matched with this many next ones in the order of names.
    pub window: usize,
    /// Above that, each image is also matched with this many nearest ones by measured position.
    pub nearest: usize,
    /// Above that, each image without a measured position is also matched with this many that look most alike.
    pub alike: usize,
}

impl Default for PairParams {
    fn default() -> Self {
        Self { exhaustive_up_to: 60, window: 8, nearest: 16, alike: 16 }
    }
}

impl Config {
    /// How features of query photos are extracted.
    pub fn photo_features(&self) -> FeatureParams {
        FeatureParams { simulated_tilt: self.photos.simulated_tilt, ..self.features.clone() }
    }

    /// Whether the images that a first model of the scene leaves apart are looked at once more.
    pub fn looks_again(&self, left: &LeftApart) -> bool {
        self.second_look.enabled && left.is_torn()
    }

    /// How features of images are extracted that a first model of the scene leaves apart.
    pub fn second_features(&self) -> FeatureParams {
        FeatureParams {
            simulated_tilt: self.features.simulated_tilt.max(self.second_look.simulated_tilt),
            ..self.features.clone()
        }
    }

    /// Defaults, then the file, then `key=value` settings such as `two_view.min_inliers=30`.
    ///
    /// # Errors
    /// With file and line or the setting, key, and what is allowed when something is unknown, of the wrong type or out of its range.
    pub fn resolve(file: Option<&Path>, settings: &[String]) -> Result<Self> {
        let text = file.map(read_text).transpose()?.unwrap_or_default();
        let lists = "`setloc build --print-config` lists all keys with their values";
        // Checked on its own first, so that the error shows the line in the file.
        let mut config = toml::from_str::<Self>(&text).map_err(|error| {
            let shown = file.unwrap_or(Path::new("")).display();
            let error = anyhow::Error::new(error).context(format!("{shown} is not a valid configuration"));
            Hinted::wrap(error, lists)
        })?;
        let mut table = toml::from_str::<toml::Table>(&text)?;
        // One by one, so that the error names the setting.
        for setting in settings {
            apply(&mut table, setting)?;
            config = toml::from_str(&toml::to_string(&table)?).map_err(|error| {
                Hinted::error(format!("invalid setting `{setting}`: {}", error.message()), lists)
            })?;
        }
        config.check_ranges(file.map(|path| (path, text.as_str())), settings)?;
        Ok(config)
    }

    /// Checks all numbers; with the place that each which is out of its range comes from.
    fn check_ranges(&self, file: Option<(&Path, &str)>, settings: &[String]) -> Result<()> {
        let violations = ranges::violations(&toml::Table::try_from(self)?);
        if violations.is_empty() {
            return Ok(());
        }
        let in_words = |(key, what): &(String, String)| {
            let sets = |setting: &&String| {
                setting.split_once('=').is_some_and(|(name, _)| name.trim() == key.as_str())
            };
            if let Some(setting) = settings.iter().rfind(sets) {
                return format!("--set {setting}: {what}");
            }
            let line = file.and_then(|(path, text)| Some((path.display(), line_of(text, key)?)));
            line.map_or_else(|| what.clone(), |(path, line)| format!("{path}, line {line}: {what}"))
        };
        let violations: Vec<String> = violations.iter().map(in_words).collect();
        Err(Hinted::error(
            format!("invalid setting: {}", violations.join("; ")),
            "`setloc build --print-config` without settings lists the defaults",
        ))
    }

    /// The part that a scene depends on, as TOML: without localization.
    ///
    /// # Errors
    /// When a value has no TOML form.
    pub fn scene_toml(&self) -> Result<String> {
        let mut table = toml::Table::try_from(self)?;
        for localization in ["single", "camset", "growth"] {
            table.remove(localization);
        }
        Ok(toml::to_string_pretty(&table)?)
    }

    /// As TOML.
    ///
    /// # Errors
    /// When a value has no TOML form.
    pub fn to_toml(&self) -> Result<String> {
        Ok(toml::to_string_pretty(self)?)
    }
}

/// Puts one `a.b=value` into a table.
fn apply(table: &mut toml::Table, setting: &str) -> Result<()> {
    let wrong = || Hinted::error(format!("`{setting}` is no setting"), "write it as --set stage.key=value");
    let (key, value) = setting.split_once('=').ok_or_else(wrong)?;
    let value = parse_value(value.trim());
    let mut parts: Vec<&str> = key.trim().split('.').collect();
    let last = parts.pop().filter(|last| !last.is_empty()).ok_or_else(wrong)?;
    let mut at = table;
    for part in parts {
        let next = at.entry(part).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        at = next.as_table_mut().ok_or_else(wrong)?;
    }
    at.insert(last.to_owned(), value);
    Ok(())
}

/// The line of a key's value, from 1 on.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let table = DeTable::parse(text).ok()?;
    let mut names = key.split('.');
    let mut value = table.get_ref().get(names.next()?)?;
    for name in names {
        value = value.get_ref().get(name)?;
    }
    Some(1 + text.get(..value.span().start)?.matches('\n').count())
}

/// A TOML value; what is none is a string.
fn parse_value(text: &str) -> toml::Value {
    let parsed = toml::from_str::<toml::Table>(&format!("value = {text}")).ok();
    parsed.and_then(|mut table| table.remove("value")).unwrap_or_else(|| toml::Value::String(text.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_override_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("setloc.toml");
        std::fs::write(&path, "[two_view]\nmin_inliers = 30\n[pairs]\nwindow = 3\n").unwrap();
        let config = Config::resolve(Some(&path), &["two_view.min_inliers=40".to_owned()]).unwrap();
        assert_eq!((config.two_view.min_inliers, config.pairs.window), (40, 3));
    }

    #[test]
    fn unknown_keys_are_named_with_the_line_and_the_allowed_ones() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("setloc.toml");
        std::fs::write(&path, "[pairs]\nwindw = 3\n").unwrap();
        let error = format!("{:#}", Config::resolve(Some(&path), &[]).unwrap_err());
        assert!(
            error.contains("setloc.toml") && error.contains("line 2") && error.contains("window"),
            "{error}"
        );
        for setting in ["pairs.windw=3", "pairs.window=many"] {
            let settings = ["two_view.min_inliers=40".to_owned(), setting.to_owned()];
            let error = Config::resolve(None, &settings).unwrap_err().to_string();
            assert!(error.starts_with(&format!("invalid setting `{setting}`: ")), "{error}");
        }
    }

    #[test]
    fn numbers_out_of_range_are_named_with_what_is_expected() {
        let settings = ["two_view.max_iterations=30", "features.sigma_px=nan", "single.guided.ratio=1.5"];
        let settings = settings.map(str::to_owned);
        let error = format!("{:#}", Config::resolve(None, &settings).unwrap_err());
        for part in [
            "`two_view.max_iterations` is 30, expected 50 to 1000000000",
            "`features.sigma_px` is NaN, expected 0.5 to 10",
            "`single.guided.ratio` is 1.5, expected above 0, at most 1",
        ] {
            assert!(error.contains(part), "{error}");
        }
        assert!(error.contains("--set features.sigma_px=nan: `features.sigma_px` is NaN"), "{error}");
    }

    #[test]
    fn numbers_of_a_file_that_are_out_of_range_are_named_with_their_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("setloc.toml");
        let text =
            "[features]\nsigma_px = nan\n\n[single]\nguided.ratio = 1.5\n[single.verdict]\nmin_inliers = 1\n";
        std::fs::write(&path, text).unwrap();
        let error = Config::resolve(Some(&path), &["single.verdict.min_inliers=9".to_owned()]).unwrap_err();
        let error = error.to_string().replace(&path.display().to_string(), "setloc.toml");
        let expected = "invalid setting: setloc.toml, line 2: `features.sigma_px` is NaN, expected 0.5 to 10; \
                        setloc.toml, line 5: `single.guided.ratio` is 1.5, expected above 0, at most 1";
        assert_eq!(error, expected);
    }

    #[test]
    fn printed_config_reads_back() {
        let text = Config::default().to_toml().unwrap();
        assert_eq!(toml::from_str::<Config>(&text).unwrap(), Config::default());
    }
}
