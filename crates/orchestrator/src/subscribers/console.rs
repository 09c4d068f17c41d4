use std::collections::{BTreeMap, BTreeSet};
use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use crate::graph::{Event, Observer};
use crate::print;

/// Stages in the order they are shown.
const STAGES: [&str; 13] = [
    "features",
    "carried",
    "matches",
    "turned",
    "verify",
    "model",
    "aligned",
    "local_model",
    "index",
    "scene",
    "nearest",
    "single",
    "camset",
];

/// Bars with rate and remaining time on a terminal, plain lines elsewhere; all on standard error.
pub struct Console {
    terminal: bool,
    state: Mutex<State>,
    /// What was said of jobs that failed.
    failures: Mutex<BTreeSet<String>>,
}

#[derive(Default)]
struct State {
    bars: Option<MultiProgress>,
    stages: BTreeMap<&'static str, Stage>,
}

#[derive(Default)]
struct Stage {
    total: usize,
    done: usize,
    hits: usize,
    bar: Option<ProgressBar>,
}

impl Console {
    /// For this process's standard error.
    pub fn new() -> Self {
        Self {
            terminal: std::io::stderr().is_terminal(),
            state: Mutex::default(),
            failures: Mutex::default(),
        }
    }

    fn step(&self, kind: &str, hit: bool) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(stage) = state.stages.get_mut(kind) else { return };
        stage.done += 1;
        stage.hits += usize::from(hit);
        if let Some(bar) = &stage.bar {
            bar.inc(1);
        }
        stage.show(kind);
    }

    /// One job of a kind less is to be done.
    fn leave_out(&self, kind: &str) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(stage) = state.stages.get_mut(kind) else { return };
        stage.total -= 1;
        if let Some(bar) = &stage.bar {
            bar.set_length(stage.total as u64);
        }
        stage.show(kind);
    }

    fn tell(&self, text: &str) {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        match &state.bars {
            Some(bars) => bars.suspend(|| print::note(text)),
            None => print::note(text),
        }
    }
}

impl Stage {
    /// On a terminal how many were stored, elsewhere a line once all are done.
    fn show(&self, kind: &str) {
        let cached = if self.hits > 0 { format!("({} from cache)", self.hits) } else { String::new() };
        if let Some(bar) = &self.bar {
            bar.set_message(cached);
        } else if self.done == self.total && self.total > 0 {
            print::note(format!("{kind}: {}/{} {cached}", self.done, self.total).trim_end());
        }
    }
}

impl Default for Console {
    fn default() -> Self {
        Self::new()
    }
}

impl Observer for Console {
    fn notice(&self, event: &Event) {
        match event {
            Event::Planned { jobs } => {
                let bars = self.terminal.then(MultiProgress::new);
                let style = ProgressStyle::with_template(
                    "{prefix:>11} {wide_bar} {pos}/{len} {per_sec} eta {eta} {msg}",
                );
                let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
                let mut stages = BTreeMap::new();
                for kind in STAGES {
                    let Some(&total) = jobs.get(kind) else { continue };
                    let bar = bars.as_ref().map(|bars| {
                        let bar = bars.add(ProgressBar::new(total as u64));
                        bar.with_style(style.clone()).with_prefix(kind)
                    });
                    stages.insert(kind, Stage { total, bar, ..Stage::default() });
                }
                *self.state.lock().unwrap_or_else(PoisonError::into_inner) = State { bars, stages };
            }
            Event::Hit { kind, .. } => self.step(kind, true),
            Event::Finished { kind, .. } | Event::Unkept { kind, .. } => self.step(kind, false),
            Event::Skipped { kind, .. } => self.leave_out(kind),
            Event::Failed { kind, job, reason } => {
                let text = format!("warning: {kind} {job}: {reason}");
                // Further graphs of a command try it again.
                if self.failures.lock().unwrap_or_else(PoisonError::into_inner).insert(text.clone()) {
                    self.tell(&text);
                }
                self.step(kind, false);
            }
            Event::Note { text } => self.tell(&format!("note: {text}")),
            Event::Warning { text } => self.tell(&format!("warning: {text}")),
            Event::Started { .. } => {}
            Event::Ended => {
                let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
                for stage in state.stages.values().filter_map(|stage| stage.bar.as_ref()) {
                    stage.finish_and_clear();
                }
                *state = State::default();
            }
        }
    }
}
