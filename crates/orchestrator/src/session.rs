//! What the commands share: the store, the listeners and a way to stop.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::Result;

use crate::clock;
use crate::graph::{Broadcast, Event, Executor, JobGraph, Observer, RunOptions, RunResult};
use crate::store::{LastRun, Store};
use crate::subscribers::{Console, JsonLog, RunReport};

/// How much of the machine a session may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Most jobs at once.
    pub threads: usize,
    /// Most working memory of the jobs at once, in bytes.
    pub memory: u64,
}

/// One command's run or runs.
pub struct Session {
    /// Where results are kept.
    pub store: Store,
    /// What it cost.
    pub report: Arc<RunReport>,
    observer: Broadcast,
    limits: Limits,
    stop: Arc<AtomicBool>,
}

impl Session {
    /// Opens the store and begins to listen; `log` is the JSON-lines file.
    ///
    /// # Errors
    /// When store or log cannot be written.
    pub fn open(cache: &Path, log: Option<&Path>, limits: Limits, stop: Arc<AtomicBool>) -> Result<Self> {
        let store = Store::open(cache)?;
        let report = Arc::new(RunReport::new());
        let mut observers: Vec<Arc<dyn Observer>> = vec![Arc::clone(&report) as _, Arc::new(Console::new())];
        if let Some(path) = log {
            observers.push(Arc::new(JsonLog::create(path)?));
        }
        Ok(Self { store, report, observer: Broadcast::new(observers), limits, stop })
    }

    /// Runs a graph and hands the results to `use_results` once they are kept.
    ///
    /// What is done is noted under `name` every minute and where the run does not come to its end, so that garbage
    /// collection leaves it to the run and to the next attempt.
    ///
    /// # Errors
    /// When stopped, when the store cannot be written, or as `use_results` does.
    pub fn run<R>(
        &self,
        name: &str,
        graph: &JobGraph<'_>,
        use_results: impl FnOnce(&Executor<'_>, &RunResult) -> Result<R>,
    ) -> Result<R> {
        let options = self.options(name);
        let executor = Executor::new(graph, &options);
        let run = self.noting_unfinished(name, &executor, executor.run())?;
        use_results(&executor, &run)
    }

    /// Runs a graph; `meanwhile` gets the results while the last of them are still being kept, as
    /// [`Executor::run_with`].
    ///
    /// # Errors
    /// When stopped or when the store cannot be written; what was done is then noted as by [`Session::run`].
    pub fn run_with<R>(
        &self,
        name: &str,
        graph: &JobGraph<'_>,
        meanwhile: impl FnOnce(&Executor<'_>, &RunResult) -> R,
    ) -> Result<(RunResult, R)> {
        let options = self.options(name);
        let executor = Executor::new(graph, &options);
        let run = executor.run_with(|run| meanwhile(&executor, run));
        self.noting_unfinished(name, &executor, run)
    }

    fn options<'o>(&'o self, name: &'o str) -> RunOptions<'o> {
        RunOptions {
            store: &self.store,
            observer: &self.observer,
            threads: self.limits.threads,
            memory: self.limits.memory,
            stop: &self.stop,
            noted_as: Some(name),
        }
    }

    fn noting_unfinished<T>(&self, name: &str, executor: &Executor<'_>, run: Result<T>) -> Result<T> {
        if run.is_err() {
            // On a full disk this fails as well; what the caller has to hear is why the run ended.
            let _ = self.store.note_unfinished(name, executor.result().keys);
        }
        run
    }

    /// Tells a person something.
    pub fn note(&self, text: String) {
        self.observer.notice(&Event::Note { text });
    }

    /// Remembers a run under a name, for `plan`, `explain` and `status`; that it cannot is a warning, since its results are
    /// there.
    pub fn remember(&self, name: &str, run: &RunResult) {
        let last = LastRun {
            ended_unix_s: clock::unix_secs(),
            ran: run.ran.len(),
            stored: run.keys.len().saturating_sub(run.ran.len()),
            failed: run.failed.clone(),
        };
        if let Err(error) = self.store.remember_run(name, run.keys.clone(), last) {
            let text = format!("`{name}` is not remembered for `plan`, `explain` and `cache gc`: {error:#}");
            self.observer.notice(&Event::Warning { text });
        }
    }
}

/// The flag that Ctrl-C and SIGTERM set; a second one ends the process at once.
pub fn stop_on_signal() -> Arc<AtomicBool> {
    static STOP: OnceLock<Arc<AtomicBool>> = OnceLock::new();
    let install = || {
        let stop = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&stop);
        let handler = move || {
            if flag.swap(true, Ordering::SeqCst) {
                std::process::exit(i32::from(crate::cli::STOPPED));
            }
            crate::print::note("stopping after the running jobs; press Ctrl-C again to stop at once");
        };
        // Without a handler the signal ends the process, which loses no finished job either.
        let _ = ctrlc::set_handler(handler);
        stop
    };
    Arc::clone(STOP.get_or_init(install))
}

/// The store's folder: `--cache`, else `SETLOC_CACHE`, else `.setloc-cache` beside the output.
pub fn cache_folder(given: Option<&Path>, output: &Path) -> PathBuf {
    let beside = || output.parent().unwrap_or(Path::new("")).join(".setloc-cache");
    given.map_or_else(beside, Path::to_owned)
}
