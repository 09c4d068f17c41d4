//! What a run tells its subscribers.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

/// Something happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// A run begins: number of jobs by kind.
    Planned {
        /// Jobs by kind.
        jobs: BTreeMap<String, usize>,
    },
    /// A job runs.
    Started {
        /// Its kind.
        kind: &'static str,
        /// Its name.
        job: String,
    },
    /// A job's result was in the store.
    Hit {
        /// Its kind.
        kind: &'static str,
        /// Its name.
        job: String,
    },
    /// A job is done.
    Finished {
        /// Its kind.
        kind: &'static str,
        /// Its name.
        job: String,
        /// Seconds since the run began.
        started_secs: f64,
        /// Wall seconds.
        wall_secs: f64,
        /// CPU seconds.
        cpu_secs: f64,
        /// Size of the result.
        bytes: u64,
    },
    /// A job failed; what can go on without it does.
    Failed {
        /// Its kind.
        kind: &'static str,
        /// Its name.
        job: String,
        /// Why.
        reason: String,
    },
    /// A job's result cannot be kept; the run ends with the reason, and a warning tells all of them at once.
    Unkept {
        /// Its kind.
        kind: &'static str,
        /// Its name.
        job: String,
        /// Why.
        reason: String,
    },
    /// A job was left out: an input of it has failed or was left out, or it was not to run.
    Skipped {
        /// Its kind.
        kind: &'static str,
        /// Its name.
        job: String,
    },
    /// Something for a person to know.
    Note {
        /// The sentence.
        text: String,
    },
    /// Something to tell a person.
    Warning {
        /// The sentence.
        text: String,
    },
    /// The run is over.
    Ended,
}

/// A subscriber.
pub trait Observer: Send + Sync {
    /// Takes note of an event; called from any thread.
    fn notice(&self, event: &Event);
}

/// Tells several subscribers.
#[derive(Clone, Default)]
pub struct Broadcast(Vec<Arc<dyn Observer>>);

impl Broadcast {
    /// To these subscribers.
    pub fn new(observers: Vec<Arc<dyn Observer>>) -> Self {
        Self(observers)
    }
}

impl Observer for Broadcast {
    fn notice(&self, event: &Event) {
        self.0.iter().for_each(|observer| observer.notice(event));
    }
}
