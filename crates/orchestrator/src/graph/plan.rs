//! What a run would do, and why, without doing it.

use std::collections::BTreeMap;

use petgraph::algo::toposort;
use serde::Serialize;

use super::executor::passes;
use super::job::JobGraph;
use crate::fingerprint::{ContentHash, Fingerprint};
use crate::store::{RunRecord, Store};

/// Whether a job would run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Prediction {
    /// The result is in the store.
    Stored,
    /// It would run.
    Runs,
    /// It runs unless a job it uses gives the same bytes as before.
    Follows,
}

/// One job of a plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlannedJob {
    /// Kind of job.
    pub kind: &'static str,
    /// Its name.
    pub job: String,
    /// Whether it would run.
    pub prediction: Prediction,
    /// Why, in sentences.
    pub reasons: Vec<String>,
}

impl JobGraph<'_> {
    /// What running this graph on `store` would do; `last` tells what changed.
    pub fn plan(&self, store: &Store, last: &RunRecord) -> Vec<PlannedJob> {
        let order = toposort(&self.graph, None).unwrap_or_default();
        let mut outputs: BTreeMap<_, ContentHash> = BTreeMap::new();
        let mut planned = BTreeMap::new();
        for id in order {
            let job = self.job(id);
            let mut inputs = job.external.clone();
            let mut waits_for = Vec::new();
            for (used, edge) in self.uses(id) {
                match (outputs.get(&used), edge.role()) {
                    (Some(output), Some(role)) => drop(inputs.insert(role.to_owned(), *output)),
                    (Some(_), None) => {}
                    (None, _) => waits_for.push(format!("uses {}", self.job(used).label())),
                }
            }
            let fingerprint = Fingerprint {
                kind: job.kind.to_owned(),
                version: job.version,
                params: job.params.clone(),
                inputs,
            };
            let (prediction, reasons) = if waits_for.is_empty() {
                match store.lookup(fingerprint.key()) {
                    Some(record) => {
                        outputs.insert(id, record.output);
                        (Prediction::Stored, Vec::new())
                    }
                    None => (Prediction::Runs, why(&fingerprint, &job.label(), store, last)),
                }
            } else {
                waits_for.sort();
                (Prediction::Follows, waits_for)
            };
            planned.insert(id, PlannedJob { kind: job.kind, job: job.name.clone(), prediction, reasons });
        }
        planned.into_values().collect()
    }
}

/// What differs from the job's last run; from the nearest of its passes, where it had several.
fn why(now: &Fingerprint, label: &str, store: &Store, last: &RunRecord) -> Vec<String> {
    let mut keys = passes(label).map_while(|label| last.jobs.get(&label)).peekable();
    if keys.peek().is_none() {
        return vec!["never ran before".to_owned()];
    }
    let changes = |key: &ContentHash| Some(now.changes_since(&store.record(*key)?.fingerprint));
    let Some(changes) = keys.filter_map(changes).min_by_key(Vec::len) else {
        return vec!["its last fingerprint is no longer kept".to_owned()];
    };
    if changes.is_empty() { vec!["its result is no longer in the store".to_owned()] } else { changes }
}
