//! What the commands share: the store, the listeners and a way to stop.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::Result;

use crate::fingerprint::ContentHash;
use crate::graph::{Broadcast, Executor, JobGraph, Observer, RunOptions, RunResult};
use crate::store::Store;
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

    /// Runs a graph and hands the results to `use_results`.
    ///
    /// # Errors
    /// When stopped, when the store cannot be written, or as `use_results` does.
    pub fn run<R>(
        &self,
        graph: &JobGraph<'_>,
        use_results: impl FnOnce(&Executor<'_>, &RunResult) -> Result<R>,
    ) -> Result<R> {
        let options = RunOptions {
            store: &self.store,
            observer: &self.observer,
            threads: self.limits.threads,
            memory: self.limits.memory,
            stop: &self.stop,
        };
        let executor = Executor::new(graph, &options);
        let result = executor.run()?;
        use_results(&executor, &result)
    }

    /// Remembers the keys of a run under a name, for `plan` and `explain`.
    ///
    /// # Errors
    /// When the store cannot be written.
    pub fn remember(&self, name: &str, keys: BTreeMap<String, ContentHash>) -> Result<()> {
        self.store.remember_run(name, keys)
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
                std::process::exit(2);
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
