use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::DatasetFigures;

/// What a figure says about quality, and how far it may move without meaning anything.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MetricKind {
    /// A number of registered images: more is better.
    Registered,
    /// A distance in metres, or in percent of a scene's extent: less is better.
    Position,
    /// An angle in degrees: less is better.
    Rotation,
    /// A share in percent: more is better.
    Percent,
    /// Seconds: less is better, but machines differ, so it is told and never judged.
    Time,
}

impl MetricKind {
    /// Of a metric's name.
    pub fn of(name: &str) -> Self {
        match name.rsplit('/').next().unwrap_or_default() {
            last if last.ends_with("_m") || last.ends_with("_of_extent") => Self::Position,
            last if last.ends_with("_deg") => Self::Rotation,
            last if last.ends_with("_s") => Self::Time,
            last if last.starts_with("auc") || last.ends_with("_percent") => Self::Percent,
            _ => Self::Registered,
        }
    }

    /// Whether more is better.
    pub fn more_is_better(self) -> bool {
        matches!(self, Self::Registered | Self::Percent)
    }

    /// The least change that counts, whatever the repeats' deviation: another machine's rounding may lead the robust
    /// estimators to other samples.
    pub fn floor(self, baseline: f64) -> f64 {
        match self {
            Self::Registered => 0.5,
            Self::Position => (0.25 * baseline).max(0.003),
            Self::Rotation => (0.25 * baseline).max(0.02),
            Self::Percent => 1.5,
            Self::Time => f64::INFINITY,
        }
    }
}

/// Mean and standard deviation over the repeats.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Repeated {
    /// Arithmetic mean.
    pub mean: f64,
    /// Sample standard deviation, 0 of one repeat.
    pub deviation: f64,
    /// Number of repeats that gave a value.
    pub repeats: usize,
}

impl Repeated {
    /// Of some values, `None` of none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let count = values.len() as f64;
        let mean = (!values.is_empty()).then(|| values.iter().sum::<f64>() / count)?;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let deviation = if values.len() > 1 { (squares / (count - 1.0)).sqrt() } else { 0.0 };
        Some(Self { mean, deviation, repeats: values.len() })
    }
}

/// Metrics by name.
pub type Metrics = BTreeMap<String, Repeated>;

/// The metrics of the repeats of one data set with one parameter set.
pub fn metrics_of(repeats: &[DatasetFigures]) -> Metrics {
    let mut values: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for figures in repeats {
        for (name, value) in flatten(figures) {
            values.entry(name).or_default().push(value);
        }
    }
    values.into_iter().filter_map(|(name, values)| Some((name, Repeated::of(&values)?))).collect()
}

/// The figures of one run that are compared with a baseline.
fn flatten(figures: &DatasetFigures) -> Vec<(String, f64)> {
    let scene = &figures.scene;
    let mut flat = vec![("scene/registered".to_owned(), scene.registered as f64)];
    if let Some(spread) = scene.position_m {
        flat.push(("scene/median_m".to_owned(), spread.median));
        flat.push(("scene/max_m".to_owned(), spread.max));
    }
    if let Some(spread) = scene.rotation_own_deg {
        flat.push(("scene/median_deg".to_owned(), spread.median));
    }
    for (threshold, area) in scene.auc.iter().flatten() {
        flat.push((format!("scene/auc@{threshold}"), *area));
    }
    // Units of a joint reconstruction say nothing by themselves.
    let (units, suffix) = match &figures.joint_reference {
        None => (1.0, "m"),
        Some(joint) => (joint.percent(), "percent_of_extent"),
    };
    for set in &figures.sets {
        for (method, of_method) in &set.methods {
            let mut add =
                |what: &str, value: f64| flat.push((format!("{}/{method}/{what}", set.name), value));
            add("registered", of_method.registered as f64);
            add("target_registered", f64::from(u8::from(of_method.target_registered)));
            if let Some(bounds) = of_method.position_m {
                add(&format!("median_{suffix}"), units * bounds.median);
                add(&format!("max_{suffix}"), units * bounds.max);
            }
            if let Some(bounds) = of_method.rotation_deg {
                add("median_deg", bounds.median);
            }
            if let Some(error) = of_method.target {
                add(&format!("target_{suffix}"), units * error.position_m);
                add("target_deg", error.rotation_deg);
            }
        }
    }
    // Of all sets together: those of one are too few for a share.
    let calibrations = || figures.sets.iter().filter_map(|set| set.methods.get("camset+opt")?.calibration);
    let photos: usize = calibrations().map(|calibration| calibration.photos).sum();
    if photos > 0 {
        let within: usize = calibrations().map(|calibration| calibration.within_95).sum();
        flat.push(("camset+opt/within_95_percent".to_owned(), 100.0 * within as f64 / photos as f64));
    }
    // A stage that took something from the store has no time of its own.
    for stage in figures.stages.iter().filter(|stage| stage.cached == 0) {
        flat.push((format!("time/{}/cpu_s", stage.name), stage.cpu_s));
    }
    flat
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeats_have_mean_and_sample_deviation() {
        let repeated = Repeated::of(&[1.0, 2.0, 3.0]).unwrap();
        assert_eq!((repeated.mean, repeated.deviation, repeated.repeats), (2.0, 1.0, 3));
        assert_eq!(Repeated::of(&[5.0]).unwrap().deviation, 0.0);
        assert!(Repeated::of(&[]).is_none());
    }

    #[test]
    fn a_metric_s_name_says_its_kind() {
        assert_eq!(MetricKind::of("south/camset+opt/target_m"), MetricKind::Position);
        assert_eq!(MetricKind::of("back/camset+opt/median_percent_of_extent"), MetricKind::Position);
        assert_eq!(MetricKind::of("scene/median_deg"), MetricKind::Rotation);
        assert_eq!(MetricKind::of("scene/auc@0.5"), MetricKind::Percent);
        assert_eq!(MetricKind::of("camset+opt/within_95_percent"), MetricKind::Percent);
        assert_eq!(MetricKind::of("time/model/cpu_s"), MetricKind::Time);
        assert_eq!(MetricKind::of("south/single/target_registered"), MetricKind::Registered);
    }
}
