use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::clock;
use crate::graph::{Event, Observer};

/// What one stage cost.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct StageReport {
    /// Job kind.
    pub name: String,
    /// Seconds in which at least one job of the stage ran.
    pub wall_s: f64,
    /// CPU seconds of its jobs.
    pub cpu_s: f64,
    /// Jobs that ran.
    pub ran: usize,
    /// Jobs whose result was in the store.
    pub cached: usize,
    /// Jobs that failed.
    pub failed: usize,
}

/// Time, CPU, memory and cache hits of one or several runs.
pub struct RunReport {
    begun: Instant,
    cpu_at_begin: f64,
    stages: Mutex<Stages>,
}

#[derive(Default)]
struct Stages {
    order: Vec<&'static str>,
    reports: BTreeMap<&'static str, StageReport>,
    /// Start and end of each job in seconds since the report began.
    spans: BTreeMap<&'static str, Vec<(f64, f64)>>,
}

impl RunReport {
    /// Begins to count.
    pub fn new() -> Self {
        Self { begun: Instant::now(), cpu_at_begin: clock::process_cpu_secs(), stages: Mutex::default() }
    }

    /// Stages in the order of their first job.
    pub fn stages(&self) -> Vec<StageReport> {
        let stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
        let mut reports = Vec::new();
        for kind in &stages.order {
            let mut report = stages.reports.get(kind).cloned().unwrap_or_default();
            report.wall_s = covered(stages.spans.get(kind).map_or(&[], Vec::as_slice));
            reports.push(report);
        }
        reports
    }

    /// As JSON, with the whole process's figures.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::json!({
            "stages": self.stages(),
            "wall_s": self.begun.elapsed().as_secs_f64(),
            "cpu_s": clock::process_cpu_secs() - self.cpu_at_begin,
            "peak_rss_mb": clock::peak_rss_mib(),
        })
    }

    /// Wall and CPU seconds so far.
    pub fn totals(&self) -> (f64, f64) {
        (self.begun.elapsed().as_secs_f64(), clock::process_cpu_secs() - self.cpu_at_begin)
    }

    fn with(&self, kind: &'static str, change: impl FnOnce(&mut StageReport)) {
        let mut stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
        if !stages.order.contains(&kind) {
            stages.order.push(kind);
        }
        let report = stages.reports.entry(kind).or_default();
        kind.clone_into(&mut report.name);
        change(report);
    }
}

impl Default for RunReport {
    fn default() -> Self {
        Self::new()
    }
}

/// Total length of the union of spans.
fn covered(spans: &[(f64, f64)]) -> f64 {
    let mut spans = spans.to_vec();
    spans.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut total, mut end) = (0.0, f64::NEG_INFINITY);
    for (from, to) in spans {
        total += (to - from.max(end)).max(0.0);
        end = end.max(to);
    }
    total
}

impl Observer for RunReport {
    fn notice(&self, event: &Event) {
        match event {
            Event::Finished { kind, wall_secs, cpu_secs, .. } => {
                let end = self.begun.elapsed().as_secs_f64();
                self.with(kind, |report| {
                    report.ran += 1;
                    report.cpu_s += cpu_secs;
                });
                let mut stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
                stages.spans.entry(kind).or_default().push((end - wall_secs, end));
            }
            Event::Hit { kind, .. } => self.with(kind, |report| report.cached += 1),
            Event::Failed { kind, .. } | Event::Unkept { kind, .. } => {
                self.with(kind, |report| report.failed += 1);
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlapping_spans_count_once() {
        assert_eq!(covered(&[(0.0, 2.0), (5.0, 6.0), (1.0, 3.0), (1.5, 2.0)]), 4.0);
    }
}
