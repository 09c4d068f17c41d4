use super::baseline::{Delta, Judgement};
use super::harness::{Harness, HarnessRun, shown};
use super::metrics::{MetricKind, Repeated};
use super::{DatasetFigures, Errors, MethodFigures, SetFigures};
use crate::html::{cell, page, table};
use crate::plot::{Recall, Series, bars, dots, escape, recall_curves};

/// Methods in the order of the plots.
const METHODS: [&str; 3] = ["camset+opt", "camset", "single"];

/// The whole benchmark as one page without anything outside it.
pub fn html_report(harness: &Harness) -> String {
    let mut body = format!(
        "<p>Seeds {}. Registered: has a pose and the verdict “localized”; errors are of registered photos, after aligning the scene to the truth by its images' centres. Mean ± standard deviation over the seeds.</p>",
        harness.seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", ")
    );
    if !harness.skipped.is_empty() {
        let rows = harness.skipped.iter().map(|(name, reason)| vec![cell(name), cell(reason)]);
        body += "<h2>Skipped data sets</h2>";
        body += &table(&["data set", "reason"], rows);
    }
    if let Some(deltas) = &harness.deltas {
        body += "<h2>Against the baseline</h2>";
        body += &deltas_table(deltas);
    }
    for run in &harness.runs {
        body += &run_section(run);
    }
    page("Setloc benchmark", &body)
}

fn deltas_table(deltas: &[Delta]) -> String {
    let changed: Vec<&Delta> = deltas
        .iter()
        .filter(|delta| matches!(delta.judgement, Judgement::Regression | Judgement::Improvement))
        .collect();
    let count = |judgement| deltas.iter().filter(|delta| delta.judgement == judgement).count();
    let mut text = format!(
        "<p>{} regressions, {} improvements, {} within the noise, {} new.</p>",
        count(Judgement::Regression),
        count(Judgement::Improvement),
        count(Judgement::Same),
        count(Judgement::New)
    );
    let value = |value: Option<&Repeated>| value.map_or("–".to_owned(), shown);
    let row = |delta: &&Delta| {
        let class = if delta.judgement == Judgement::Regression { "bad" } else { "good" };
        vec![
            cell(&delta.run),
            format!("<td class='{class}'>{}</td>", escape(&delta.metric)),
            cell(&value(delta.before.as_ref())),
            cell(&value(delta.now.as_ref())),
            cell(&format!("{:.4}", delta.noise)),
        ]
    };
    if !changed.is_empty() {
        text += &table(&["run", "figure", "baseline", "now", "noise"], changed.iter().map(row));
    }
    text
}

fn run_section(run: &HarnessRun) -> String {
    let mut text = format!("<h2>{}</h2><p>{}", escape(&run.name), escape(&run.about));
    if !run.settings.is_empty() {
        text += " Settings: ";
        text += &escape(&run.settings.join(", "));
    }
    text += "</p>";
    let rows = run
        .metrics
        .iter()
        .filter(|(name, _)| MetricKind::of(name) != MetricKind::Time)
        .map(|(name, value)| vec![cell(name), cell(&shown(value))]);
    text += "<details><summary>All figures</summary>";
    text += &table(&["figure", "value"], rows);
    text += "</details>";
    if let Some(first) = run.figures.first() {
        text += &figures_section(first);
    }
    text
}

/// Plots of one data set's first run.
pub fn figures_section(figures: &DatasetFigures) -> String {
    let mut text = String::new();
    let positions = |errors: &Errors| errors.values().map(|error| error.position_m).collect::<Vec<_>>();
    let scene = Recall {
        label: "scene".to_owned(),
        errors: positions(&figures.scene_errors),
        total: figures.scene.images,
    };
    text += &recall_curves("Panoramas within a position error", "m", &[scene]);
    let photos: usize = figures.sets.iter().map(|set| set.images).sum();
    let of_method = |method: &&str| {
        let of_sets = figures.sets.iter().filter_map(|set| set.methods.get(*method));
        let errors = of_sets.flat_map(|of_set| registered_errors(of_set).map(|(_, error)| error)).collect();
        Recall { label: (*method).to_owned(), errors, total: photos }
    };
    let unit = if figures.joint_reference.is_some() { "units" } else { "m" };
    text += &recall_curves(
        "Photos within a position error",
        unit,
        &METHODS.iter().map(of_method).collect::<Vec<_>>(),
    );
    for set in &figures.sets {
        text += &set_plot(set, unit);
    }
    let stages: Vec<(String, f64)> =
        figures.stages.iter().map(|stage| (stage.name.clone(), stage.cpu_s)).collect();
    text + &bars("CPU time by stage", "s", &stages)
}

fn registered_errors(figures: &MethodFigures) -> impl Iterator<Item = (&str, f64)> {
    let registered =
        figures.answers.iter().filter(|photo| photo.verdict == setloc_camset::Verdict::Localized);
    registered.filter_map(|photo| Some((photo.name.as_str(), figures.errors.get(&photo.name)?.position_m)))
}

fn set_plot(set: &SetFigures, unit: &str) -> String {
    let mut names: Vec<String> = set
        .methods
        .values()
        .flat_map(|of_method| of_method.answers.iter().map(|photo| photo.name.clone()))
        .collect();
    names.sort();
    names.dedup();
    let series = |method: &&str| {
        let errors: std::collections::BTreeMap<&str, f64> =
            set.methods.get(*method).into_iter().flat_map(registered_errors).collect();
        let values = names.iter().map(|name| errors.get(name.as_str()).copied()).collect();
        Series { label: (*method).to_owned(), values }
    };
    let series: Vec<Series> = METHODS.iter().map(series).collect();
    dots(&format!("{}: position error by photo (× not registered)", set.name), unit, &names, &series)
}
