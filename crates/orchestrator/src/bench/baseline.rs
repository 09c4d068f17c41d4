use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use super::metrics::{MetricKind, Metrics, Repeated};
use crate::error::Hinted;

/// How many standard deviations of the repeats a change must exceed to count.
const NOISE_SIGMAS: f64 = 3.0;

/// Figures to compare with: by `data set/parameter set`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Metrics of each run.
    pub runs: BTreeMap<String, Metrics>,
}

/// What a change means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Judgement {
    /// Worse by more than the noise.
    Regression,
    /// Better by more than the noise.
    Improvement,
    /// The baseline has no such figure.
    New,
    /// Within the noise, or a time.
    Same,
}

/// A figure beside the baseline's.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Delta {
    /// Data set and parameter set.
    pub run: String,
    /// Name of the figure.
    pub metric: String,
    /// The baseline's.
    pub before: Option<Repeated>,
    /// Now; `None` when there is none any more.
    pub now: Option<Repeated>,
    /// The change that would count.
    pub noise: f64,
    /// What it means.
    pub judgement: Judgement,
}

impl Baseline {
    /// Reads a baseline; a missing file is an empty one.
    ///
    /// # Errors
    /// When the file is none.
    pub fn read(path: &Path) -> Result<Self> {
        let text = match std::fs::read_to_string(path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Self::default()),
            text => text.with_context(|| format!("cannot read {}", path.display()))?,
        };
        serde_json::from_str(&text).map_err(|error| {
            let error = anyhow::Error::new(error).context(format!("{} is no baseline", path.display()));
            Hinted::wrap(error, "make it again with `setloc bench --update-baseline`")
        })
    }

    /// Puts the figures of runs in place of the old ones; runs that were not made keep theirs.
    pub fn update(&mut self, runs: &BTreeMap<String, Metrics>) {
        self.runs.extend(runs.clone());
    }

    /// Every figure of these runs, and of the baseline about them, side by side; regressions first.
    pub fn compare(&self, runs: &BTreeMap<String, Metrics>) -> Vec<Delta> {
        let mut deltas = Vec::new();
        for (run, metrics) in runs {
            let empty = Metrics::new();
            let before = self.runs.get(run).unwrap_or(&empty);
            let only_before = before.keys().filter(|name| !metrics.contains_key(*name));
            for metric in metrics.keys().chain(only_before) {
                let (before, now) = (before.get(metric).copied(), metrics.get(metric).copied());
                let (noise, judgement) = judge(MetricKind::of(metric), before, now);
                let (run, metric) = (run.clone(), metric.clone());
                deltas.push(Delta { run, metric, before, now, noise, judgement });
            }
        }
        deltas.sort_by(|a, b| (a.judgement, &a.run, &a.metric).cmp(&(b.judgement, &b.run, &b.metric)));
        deltas
    }
}

fn judge(kind: MetricKind, before: Option<Repeated>, now: Option<Repeated>) -> (f64, Judgement) {
    let Some(before) = before else { return (0.0, Judgement::New) };
    let Some(now) = now else {
        // A time is gone when its stage came from the store; an error, when nothing is registered any more.
        let gone = if kind == MetricKind::Time { Judgement::Same } else { Judgement::Regression };
        return (0.0, gone);
    };
    let noise = kind.floor(before.mean).max(NOISE_SIGMAS * before.deviation.hypot(now.deviation));
    let gain = if kind.more_is_better() { now.mean - before.mean } else { before.mean - now.mean };
    let judgement = match gain {
        gain if gain < -noise => Judgement::Regression,
        gain if gain > noise => Judgement::Improvement,
        _ => Judgement::Same,
    };
    (noise, judgement)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs(figures: &[(&str, &[f64])]) -> BTreeMap<String, Metrics> {
        let metrics = figures
            .iter()
            .map(|(name, values)| ((*name).to_owned(), Repeated::of(values).unwrap()))
            .collect();
        BTreeMap::from([("a/default".to_owned(), metrics)])
    }

    fn judgements(before: &[(&str, &[f64])], now: &[(&str, &[f64])]) -> Vec<(String, Judgement)> {
        let mut baseline = Baseline::default();
        baseline.update(&runs(before));
        baseline.compare(&runs(now)).into_iter().map(|delta| (delta.metric, delta.judgement)).collect()
    }

    fn one(name: &str, before: &[f64], now: &[f64]) -> Judgement {
        judgements(&[(name, before)], &[(name, now)])[0].1
    }

    #[test]
    fn one_photo_less_is_a_regression_and_one_more_an_improvement() {
        assert_eq!(one("s/single/registered", &[9.0], &[8.0]), Judgement::Regression);
        assert_eq!(one("s/single/registered", &[9.0], &[10.0]), Judgement::Improvement);
    }

    #[test]
    fn what_the_repeats_scatter_is_noise() {
        assert_eq!(one("s/camset/median_m", &[0.05], &[0.2]), Judgement::Regression);
        assert_eq!(one("s/camset/median_m", &[0.01, 0.05, 0.09], &[0.1, 0.15, 0.05]), Judgement::Same);
        assert_eq!(one("scene/auc@5", &[99.0], &[97.0]), Judgement::Regression);
        assert_eq!(one("scene/auc@5", &[99.0, 97.0], &[97.0, 96.0]), Judgement::Same);
    }

    #[test]
    fn a_figure_that_is_gone_is_a_regression_but_a_time_never_is() {
        let before: &[(&str, &[f64])] = &[("s/camset/target_m", &[0.1]), ("time/model/cpu_s", &[1.0])];
        let gone = judgements(before, &[("scene/registered", &[1.0])]);
        assert_eq!(gone[0], ("s/camset/target_m".to_owned(), Judgement::Regression));
        assert_eq!(gone[1], ("scene/registered".to_owned(), Judgement::New));
        assert_eq!(one("time/model/cpu_s", &[1.0], &[100.0]), Judgement::Same);
    }
}
