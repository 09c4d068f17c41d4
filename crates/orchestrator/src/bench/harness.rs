use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::baseline::{Delta, Judgement};
use super::metrics::{MetricKind, Metrics, Repeated};
use super::{DatasetFigures, TruthKind};
use crate::text::add;

/// What a benchmark over several data sets, parameter sets and seeds came to.
#[derive(Debug, Clone, Default)]
pub struct Harness {
    /// Seeds of the repeats.
    pub seeds: Vec<u64>,
    /// The runs in their order.
    pub runs: Vec<HarnessRun>,
    /// Names of data sets that were not run, and why.
    pub skipped: Vec<(String, String)>,
    /// The comparison, when there is a baseline.
    pub deltas: Option<Vec<Delta>>,
}

/// All repeats of one data set with one parameter set.
#[derive(Debug, Clone)]
pub struct HarnessRun {
    /// `data set/parameter set`.
    pub name: String,
    /// Truth and licence, for people.
    pub about: String,
    /// The parameter set's settings.
    pub settings: Vec<String>,
    /// Figures of each repeat.
    pub figures: Vec<DatasetFigures>,
    /// Mean and deviation of each figure.
    pub metrics: Metrics,
}

/// What is said of a data set's truth and licence.
pub fn about(truth: TruthKind, joint_reference: bool, licence: &str) -> String {
    let truth = match truth {
        TruthKind::Exact => "Truth: exact (rendered).",
        TruthKind::Measured => "Truth: measured.",
        TruthKind::None if joint_reference => {
            "No truth: photos are compared with a reconstruction of scene and photos together."
        }
        TruthKind::None => "No truth.",
    };
    format!("{truth} Licence: {licence}.")
}

impl Harness {
    /// The figures by run, as a baseline keeps them.
    pub fn metrics(&self) -> BTreeMap<String, Metrics> {
        self.runs.iter().map(|run| (run.name.clone(), run.metrics.clone())).collect()
    }

    /// Whether something is worse than the baseline by more than the noise.
    pub fn has_regressed(&self) -> bool {
        self.deltas.iter().flatten().any(|delta| delta.judgement == Judgement::Regression)
    }

    /// As JSON.
    pub fn to_json(&self) -> Value {
        let runs: Vec<Value> = self
            .runs
            .iter()
            .map(|run| {
                json!({
                    "run": run.name, "about": run.about, "settings": run.settings, "metrics": run.metrics,
                    "repeats": run.figures,
                })
            })
            .collect();
        let skipped: Vec<Value> =
            self.skipped.iter().map(|(name, reason)| json!({ "dataset": name, "reason": reason })).collect();
        json!({ "schema": 1, "seeds": self.seeds, "runs": runs, "skipped": skipped, "deltas": self.deltas })
    }

    /// Tables in Markdown.
    pub fn to_markdown(&self) -> String {
        let mut text = String::from("# Benchmark\n");
        for (name, reason) in &self.skipped {
            add(&mut text, format_args!("\nSkipped {name}: {reason}\n"));
        }
        for run in &self.runs {
            add(&mut text, format_args!("\n## {}\n\n{}\n", run.name, run.about));
            if !run.settings.is_empty() {
                add(&mut text, format_args!("\nSettings: `{}`\n", run.settings.join("`, `")));
            }
            text += "\n| figure | value |\n|---|---|\n";
            for (name, value) in
                run.metrics.iter().filter(|(name, _)| MetricKind::of(name) != MetricKind::Time)
            {
                add(&mut text, format_args!("| {name} | {} |\n", shown(value)));
            }
        }
        if let Some(deltas) = &self.deltas {
            text += "\n## Against the baseline\n\n";
            text += &deltas_markdown(deltas);
        }
        text
    }
}

/// `mean ± deviation`.
pub(super) fn shown(value: &Repeated) -> String {
    if value.repeats > 1 {
        format!("{:.4} ± {:.4}", value.mean, value.deviation)
    } else {
        format!("{:.4}", value.mean)
    }
}

fn deltas_markdown(deltas: &[Delta]) -> String {
    let mut text = String::new();
    let count = |judgement| deltas.iter().filter(|delta| delta.judgement == judgement).count();
    let told = |delta: &&Delta| matches!(delta.judgement, Judgement::Regression | Judgement::Improvement);
    if deltas.iter().any(|delta| told(&delta)) {
        text += "| run | figure | baseline | now | noise | |\n|---|---|---|---|---|---|\n";
    }
    let value = |value: Option<&Repeated>| value.map_or("–".to_owned(), shown);
    for delta in deltas.iter().filter(told) {
        let word = if delta.judgement == Judgement::Regression { "**worse**" } else { "better" };
        let (before, now) = (value(delta.before.as_ref()), value(delta.now.as_ref()));
        add(
            &mut text,
            format_args!(
                "| {} | {} | {before} | {now} | {:.4} | {word} |\n",
                delta.run, delta.metric, delta.noise
            ),
        );
    }
    add(
        &mut text,
        format_args!(
            "\n{} regressions, {} improvements, {} within the noise, {} new.\n",
            count(Judgement::Regression),
            count(Judgement::Improvement),
            count(Judgement::Same),
            count(Judgement::New)
        ),
    );
    text + "Noise is 3 standard deviations of the repeats, and at least half an image, 3 mm or 25 %, 0.02° or 25 %, 1.5 points of AUC.\nTimes are told in `results.json` and never judged.\n"
}
