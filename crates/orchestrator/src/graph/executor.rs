//! Runs a graph: dependency counting on rayon within a memory budget.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

use super::events::{Event, Observer};
use super::gathering::{Gathering, Limits};
use super::job::{Inputs, JobGraph, JobId, Product, Use};
use crate::clock;
use crate::codec::{self, Artifact};
use crate::error::Interrupted;
use crate::fingerprint::{ContentHash, Fingerprint};
use crate::store::{Output, Store};

/// How to run.
pub struct RunOptions<'a> {
    /// Where results are kept.
    pub store: &'a Store,
    /// Who is told.
    pub observer: &'a dyn Observer,
    /// Most jobs at once.
    pub threads: usize,
    /// Most working memory of the jobs at once, in bytes; a job that alone exceeds it runs alone.
    pub memory: u64,
    /// Set from outside to stop.
    pub stop: &'a AtomicBool,
    /// The name under which what is done is noted from time to time, so that garbage collection leaves it to a run that goes on or
    /// was killed; none where nothing is.
    pub noted_as: Option<&'a str>,
}

/// What became of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum State {
    /// Not yet decided.
    Waiting,
    /// The result was in the store.
    Hit,
    /// It ran.
    Ran,
    /// It failed, for this reason.
    Failed(String),
    /// A job whose result it requires has none, or it was not to run.
    Skipped,
}

/// A finished run.
#[derive(Debug, Clone, Default)]
pub struct RunResult {
    /// Labels of the jobs that ran, sorted.
    pub ran: Vec<String>,
    /// Number of jobs whose result was in the store.
    pub hits: usize,
    /// Labels and reasons of failed jobs.
    pub failed: BTreeMap<String, String>,
    /// Key of each job that has a result, by label.
    pub keys: BTreeMap<String, ContentHash>,
}

impl RunResult {
    /// With what a further graph of the same command came to.
    #[must_use]
    pub fn and(mut self, other: Self) -> Self {
        self.absorb(other);
        self
    }

    /// Adds what a further graph of the same command came to.
    ///
    /// A job that ran of other inputs before, in a first pass, say, is told apart by its label.
    pub fn absorb(&mut self, other: Self) {
        let ran: BTreeSet<String> = other.ran.into_iter().collect();
        let mut found_again = 0;
        for (label, key) in other.keys {
            let apart = self.label_apart(&label, key);
            if ran.contains(&label) {
                self.ran.push(apart.clone());
            } else if self.keys.contains_key(&apart) {
                // What this command made or found before is found again.
                found_again += 1;
            }
            self.keys.insert(apart, key);
        }
        self.hits += other.hits.saturating_sub(found_again);
        self.ran.sort();
        self.ran.dedup();
        self.failed.extend(other.failed);
    }

    /// The first of a job's labels that has no other key.
    fn label_apart(&self, label: &str, key: ContentHash) -> String {
        let is_free = |label: &String| self.keys.get(label).is_none_or(|known| *known == key);
        passes(label).find(is_free).unwrap_or_default()
    }
}

/// The labels of a job that runs more than once in a command, each time of other inputs.
pub fn passes(label: &str) -> impl Iterator<Item = String> {
    std::iter::once(label.to_owned()).chain((2_u64..).map(move |pass| format!("{label} (pass {pass})")))
}

#[derive(Clone)]
struct Slot {
    state: State,
    key: Option<ContentHash>,
    output: Option<ContentHash>,
    value: Option<Arc<dyn Any + Send + Sync>>,
    /// The result's file, where it was made and the caller will ask for it.
    file: Option<Arc<Vec<u8>>>,
    /// Users that have not finished; the value is dropped from memory after the last.
    users_left: usize,
    /// Whether the value is nowhere but in memory.
    is_unstored: bool,
    dependencies_left: usize,
}

struct Shared {
    slots: Vec<Slot>,
    ready: BTreeSet<JobId>,
    in_flight: usize,
    memory_in_flight: u64,
    /// Jobs whose results cannot be kept.
    unkept: Vec<JobId>,
    fatal: Option<anyhow::Error>,
}

/// Threads that keep results. They wait for the disk most of the time, and file systems sync several files at once for
/// the price of one.
const KEEPERS: usize = 4;

/// How often what is done is noted.
const NOTING: Duration = Duration::from_mins(1);

/// What may wait to be kept: what a kill may cost, against a file of records for each result.
const KEEPING: Limits =
    Limits { time: Duration::from_millis(250), enough_bytes: 4 << 20, most_bytes: 32 << 20 };

/// The result of a job on its way to the store.
struct Unkept {
    id: JobId,
    fingerprint: Fingerprint,
    output: ContentHash,
    file: Arc<Vec<u8>>,
    started_secs: f64,
    wall_secs: f64,
    cpu_secs: f64,
}

impl Unkept {
    fn as_output(&self) -> Output<'_> {
        let Self { fingerprint, output, file, cpu_secs, .. } = self;
        Output { fingerprint, hash: *output, file, cpu_secs: *cpu_secs }
    }
}

/// A graph being run.
pub struct Executor<'a> {
    pub(super) graph: &'a JobGraph<'a>,
    options: &'a RunOptions<'a>,
    shared: Mutex<Shared>,
    begun: Instant,
    /// When what is done was noted last.
    noted: Mutex<Instant>,
    /// Jobs running now, and jobs started ever: to know whether a job ran alone.
    running: AtomicUsize,
    started: AtomicUsize,
}

impl<'a> Executor<'a> {
    /// Prepares a run.
    pub fn new(graph: &'a JobGraph<'a>, options: &'a RunOptions<'a>) -> Self {
        let slots: Vec<Slot> = graph
            .graph
            .node_indices()
            .map(|id| Slot {
                state: State::Waiting,
                key: None,
                output: None,
                value: None,
                file: None,
                users_left: graph.user_count(id),
                is_unstored: false,
                dependencies_left: graph.uses(id).count(),
            })
            .collect();
        let ready =
            graph.graph.node_indices().filter(|id| slots[id.index()].dependencies_left == 0).collect();
        let shared =
            Shared { slots, ready, in_flight: 0, memory_in_flight: 0, unkept: Vec::new(), fatal: None };
        Self {
            graph,
            options,
            shared: Mutex::new(shared),
            begun: Instant::now(),
            noted: Mutex::new(Instant::now()),
            running: AtomicUsize::new(0),
            started: AtomicUsize::new(0),
        }
    }

    /// Runs all jobs.
    ///
    /// # Errors
    /// When stopped, or when the store cannot be written. A failing job is no error: see [`RunResult::failed`].
    pub fn run(&self) -> Result<RunResult> {
        self.run_with(|_| ()).map(|(result, ())| result)
    }

    /// Runs all jobs; `meanwhile` gets the results while the last of them are still being kept.
    ///
    /// What it loads must be in memory or have been stored before: see [`JobGraph::want`].
    ///
    /// # Errors
    /// As [`Executor::run`]. `meanwhile` may have been called when what it was given could not be kept.
    pub fn run_with<R>(&self, meanwhile: impl FnOnce(&RunResult) -> R) -> Result<(RunResult, R)> {
        let mut jobs = BTreeMap::new();
        for id in self.graph.graph.node_indices() {
            *jobs.entry(self.graph.job(id).kind.to_owned()).or_insert(0) += 1;
        }
        self.options.observer.notice(&Event::Planned { jobs });
        // Syncing a file to the disk takes as long as many a job does, and no core: it is done beside the jobs.
        let unkept = Gathering::new(KEEPING);
        let used = std::thread::scope(|threads| {
            let open = unkept.open();
            for _ in 0..KEEPERS {
                threads.spawn(|| self.keep_results(&unkept));
            }
            rayon::scope(|scope| self.pump(scope, &unkept));
            drop(open);
            let ended_early = self.lock().fatal.is_some() || self.options.stop.load(Ordering::Relaxed);
            (!ended_early).then(|| meanwhile(&self.result()))
        });
        self.tell_unkept();
        self.options.observer.notice(&Event::Ended);
        if let Some(error) = self.lock().fatal.take() {
            return Err(error);
        }
        used.map(|used| (self.result(), used)).ok_or_else(|| Interrupted.into())
    }

    /// What the jobs came to so far.
    pub fn result(&self) -> RunResult {
        let shared = self.lock();
        let mut result = RunResult::default();
        for id in self.graph.graph.node_indices() {
            let (slot, label) = (&shared.slots[id.index()], self.graph.job(id).label());
            match &slot.state {
                State::Hit => result.hits += 1,
                State::Ran => result.ran.push(label.clone()),
                State::Failed(reason) => drop(result.failed.insert(label.clone(), reason.clone())),
                State::Waiting | State::Skipped => {}
            }
            if let (Some(key), Some(_)) = (slot.key, slot.output) {
                result.keys.insert(label, key);
            }
        }
        result.ran.sort();
        result
    }

    /// Starts as many ready jobs as threads and memory allow, in the order they were added.
    fn pump<'s>(&'s self, scope: &rayon::Scope<'s>, unkept: &'s Gathering<Unkept>) {
        loop {
            let mut shared = self.lock();
            let stopped = self.options.stop.load(Ordering::Relaxed) || shared.fatal.is_some();
            if stopped || shared.in_flight >= self.options.threads.max(1) {
                return;
            }
            let fits = |id: &JobId| {
                shared.in_flight == 0
                    || shared.memory_in_flight + self.graph.job(*id).memory <= self.options.memory
            };
            let Some(id) = shared.ready.iter().copied().find(fits) else { return };
            shared.ready.remove(&id);
            shared.in_flight += 1;
            shared.memory_in_flight += self.graph.job(id).memory;
            drop(shared);
            scope.spawn(move |scope| {
                self.settle(id, unkept);
                self.pump(scope, unkept);
            });
        }
    }

    /// Decides one job and frees those that waited for it.
    fn settle(&self, id: JobId, unkept: &Gathering<Unkept>) {
        let job = self.graph.job(id);
        let (state, key, output) = match self.is_to_run(id) {
            Ok(true) => self.decide(id, unkept),
            Ok(false) => {
                self.options.observer.notice(&Event::Skipped { kind: job.kind, job: job.name.clone() });
                (State::Skipped, None, None)
            }
            Err(error) => (self.failed(id, &error), None, None),
        };
        let mut shared = self.lock();
        shared.in_flight -= 1;
        shared.memory_in_flight -= job.memory;
        let slot = &mut shared.slots[id.index()];
        // Unless keeping the result has failed by now.
        if slot.state == State::Waiting {
            (slot.state, slot.key, slot.output) = (state, key, output);
        }
        for used in self.graph.uses(id).map(|(used, _)| used) {
            let slot = &mut shared.slots[used.index()];
            slot.users_left -= 1;
            if slot.users_left == 0 && !slot.is_unstored {
                slot.value = None;
            }
        }
        for user in self.graph.users(id) {
            let slot = &mut shared.slots[user.index()];
            slot.dependencies_left -= 1;
            if slot.dependencies_left == 0 {
                shared.ready.insert(user);
            }
        }
    }

    /// Whether a job has what it requires, and all that decide about it let it run.
    fn is_to_run(&self, id: JobId) -> Result<bool> {
        if self.graph.uses(id).any(|(used, edge)| edge.is_required() && self.output(used).is_none()) {
            return Ok(false);
        }
        for (gate, edge) in self.graph.uses(id) {
            if let Use::Gate(opens) = edge
                && !opens(self, gate)?
            {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Takes the result from the store or runs the job.
    fn decide(
        &self,
        id: JobId,
        unkept: &Gathering<Unkept>,
    ) -> (State, Option<ContentHash>, Option<ContentHash>) {
        let job = self.graph.job(id);
        let fingerprint = self.fingerprint(id);
        let key = fingerprint.key();
        if let Some(record) = self.options.store.lookup(key) {
            self.options.observer.notice(&Event::Hit { kind: job.kind, job: job.name.clone() });
            return (State::Hit, Some(key), Some(record.output));
        }
        match self.execute(id, fingerprint) {
            Ok((made, is_kept)) => {
                let (output, bytes) = (made.output, made.file.len());
                if is_kept {
                    unkept.add(made, bytes);
                } else {
                    self.finished(&made);
                }
                (State::Ran, Some(key), Some(output))
            }
            Err(error) => (self.failed(id, &error), Some(key), None),
        }
    }

    /// Says that a job failed.
    fn failed(&self, id: JobId, error: &anyhow::Error) -> State {
        let (job, reason) = (self.graph.job(id), format!("{error:#}"));
        let event = Event::Failed { kind: job.kind, job: job.name.clone(), reason: reason.clone() };
        self.options.observer.notice(&event);
        State::Failed(reason)
    }

    /// Stores results until no job is left that could send one.
    fn keep_results(&self, unkept: &Gathering<Unkept>) {
        loop {
            let together = unkept.next();
            if together.is_empty() {
                return;
            }
            if self.keep_together(&together).is_ok() {
                continue;
            }
            // Of what came together, some may still find room.
            for made in &together {
                let Err(error) = self.keep_together(std::slice::from_ref(made)) else { continue };
                let (job, reason) = (self.graph.job(made.id), format!("{error:#}"));
                let event = Event::Unkept { kind: job.kind, job: job.name.clone(), reason: reason.clone() };
                self.options.observer.notice(&event);
                let mut shared = self.lock();
                shared.unkept.push(made.id);
                let slot = &mut shared.slots[made.id.index()];
                (slot.state, slot.output) = (State::Failed(reason), None);
                shared.fatal.get_or_insert(error);
            }
        }
    }

    /// Says which results are not kept, in one line: one reason meets them all.
    fn tell_unkept(&self) {
        let mut unkept = std::mem::take(&mut self.lock().unkept);
        unkept.sort();
        let Some(first) = unkept.first().map(|id| self.graph.job(*id).label()) else { return };
        let text = match unkept.len() {
            1 => format!("cannot keep the result of {first}"),
            count => format!("cannot keep the results of {count} jobs: {first}, …"),
        };
        self.options.observer.notice(&Event::Warning { text });
    }

    fn keep_together(&self, made: &[Unkept]) -> Result<()> {
        let outputs: Vec<Output<'_>> = made.iter().map(Unkept::as_output).collect();
        self.options.store.keep(&outputs)?;
        for made in made {
            self.finished(made);
        }
        self.note_what_is_done();
        Ok(())
    }

    /// Notes from time to time what is done.
    fn note_what_is_done(&self) {
        // One thread that keeps results is enough.
        let (Some(name), Ok(mut noted)) = (self.options.noted_as, self.noted.try_lock()) else { return };
        if noted.elapsed() >= NOTING {
            // What cannot be noted is none of the results.
            let _ = self.options.store.note_unfinished(name, self.result().keys);
            *noted = Instant::now();
        }
    }

    /// Says that a job's result is kept.
    fn finished(&self, made: &Unkept) {
        let job = self.graph.job(made.id);
        self.options.observer.notice(&Event::Finished {
            kind: job.kind,
            job: job.name.clone(),
            started_secs: made.started_secs,
            wall_secs: made.wall_secs,
            cpu_secs: made.cpu_secs,
            bytes: made.file.len() as u64,
        });
    }

    /// What the job's result depends on; all its inputs must be decided.
    fn fingerprint(&self, id: JobId) -> Fingerprint {
        let job = self.graph.job(id);
        let mut inputs = job.external.clone();
        for (used, edge) in self.graph.uses(id) {
            if let Some((role, output)) = edge.role().zip(self.output(used)) {
                inputs.insert(role.to_owned(), output);
            }
        }
        Fingerprint { kind: job.kind.to_owned(), version: job.version, params: job.params.clone(), inputs }
    }

    /// Runs the job's work; whether its result is to be kept.
    fn execute(&self, id: JobId, fingerprint: Fingerprint) -> Result<(Unkept, bool)> {
        let job = self.graph.job(id);
        self.options.observer.notice(&Event::Started { kind: job.kind, job: job.name.clone() });
        let alone = self.running.fetch_add(1, Ordering::SeqCst) == 0;
        let ticket = self.started.fetch_add(1, Ordering::SeqCst);
        let (thread, process, wall) = (clock::thread_cpu_secs(), clock::process_cpu_secs(), Instant::now());
        let started_secs = self.begun.elapsed().as_secs_f64();
        let inputs = Inputs::new(self, id);
        let product = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| (job.work)(&inputs)))
            .unwrap_or_else(|_| Err(anyhow::anyhow!("the job panicked: this is a bug")));
        // A job that ran alone may have used all cores: the process's time is its own.
        let alone = alone && self.started.load(Ordering::SeqCst) == ticket + 1;
        let cpu_secs =
            if alone { clock::process_cpu_secs() - process } else { clock::thread_cpu_secs() - thread };
        let wall_secs = wall.elapsed().as_secs_f64();
        self.running.fetch_sub(1, Ordering::SeqCst);
        let Product { value, file, is_kept } = product?;
        let (output, file) = (ContentHash::of(&file), Arc::new(file));
        let slot = &mut self.lock().slots[id.index()];
        slot.is_unstored = !is_kept;
        if slot.users_left > 0 || slot.is_unstored {
            slot.value = Some(value);
        }
        if self.graph.wants_file(id) {
            slot.file = Some(Arc::clone(&file));
        }
        Ok((Unkept { id, fingerprint, output, file, started_secs, wall_secs, cpu_secs }, is_kept))
    }

    /// Hash of a job's result, `None` when it has none.
    pub fn output(&self, id: JobId) -> Option<ContentHash> {
        self.lock().slots[id.index()].output
    }

    /// A job's result as [`Executor::load`] gives it, `None` when it has none.
    ///
    /// # Errors
    /// When it can neither be read nor made again.
    pub fn load_made<T: Artifact>(&self, id: JobId) -> Result<Option<Arc<T>>> {
        self.output(id).map(|_| self.load(id)).transpose()
    }

    /// What became of a job.
    pub fn state(&self, id: JobId) -> State {
        self.lock().slots[id.index()].state.clone()
    }

    /// A job's result; a damaged file in the store is made again with a warning.
    ///
    /// # Errors
    /// When there is none, or it can neither be read nor made again.
    pub fn load<T: Artifact>(&self, id: JobId) -> Result<Arc<T>> {
        let label = self.graph.job(id).label();
        let (value, key, output) = {
            let slot = &self.lock().slots[id.index()];
            (slot.value.clone(), slot.key, slot.output)
        };
        let value = if let Some(value) = value {
            value
        } else {
            let (key, output) = key.zip(output).with_context(|| format!("{label} has no result"))?;
            match self.options.store.read(key, output).and_then(|file| Ok(codec::decode::<T>(&file)?)) {
                Ok(value) => self.keep(id, Arc::new(value)),
                Err(error) => self.remake(id, output, &error)?,
            }
        };
        value.downcast::<T>().map_err(|_| anyhow::anyhow!("the result of {label} is no {}", T::KIND))
    }

    /// The file of a job's result.
    ///
    /// # Errors
    /// As [`Executor::load`].
    pub fn file<T: Artifact>(&self, id: JobId) -> Result<Arc<Vec<u8>>> {
        let (file, key, output) = {
            let slot = &self.lock().slots[id.index()];
            (slot.file.clone(), slot.key, slot.output)
        };
        if let Some(file) = file {
            return Ok(file);
        }
        let stored = key.zip(output).and_then(|(key, output)| self.options.store.read(key, output).ok());
        stored.map_or_else(|| Ok(codec::encode(&*self.load::<T>(id)?)?), Ok).map(Arc::new)
    }

    fn keep(&self, id: JobId, value: Arc<dyn Any + Send + Sync>) -> Arc<dyn Any + Send + Sync> {
        let slot = &mut self.lock().slots[id.index()];
        if slot.users_left > 0 {
            slot.value = Some(Arc::clone(&value));
        }
        value
    }

    /// Makes a result again whose file cannot be used.
    fn remake(
        &self,
        id: JobId,
        output: ContentHash,
        error: &anyhow::Error,
    ) -> Result<Arc<dyn Any + Send + Sync>> {
        let label = self.graph.job(id).label();
        let text = format!("the stored result of {label} cannot be used and is made again: {error:#}");
        self.options.observer.notice(&Event::Warning { text });
        self.options.store.discard(output);
        let product: Product = (self.graph.job(id).work)(&Inputs::new(self, id))?;
        if product.is_kept
            && let Err(error) = self.options.store.write(&self.fingerprint(id), &product.file, 0.0)
        {
            let text = format!("{label} was made again but cannot be kept: {error:#}");
            self.options.observer.notice(&Event::Warning { text });
        }
        let again = ContentHash::of(&product.file);
        anyhow::ensure!(again == output, "{label} gives another result than before: run the command again");
        let slot = &mut self.lock().slots[id.index()];
        slot.state = State::Ran;
        drop(slot.value.replace(Arc::clone(&product.value)));
        Ok(product.value)
    }

    fn lock(&self) -> MutexGuard<'_, Shared> {
        // A panicking job never holds the lock while it changes anything by halves.
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::graph::{Broadcast, Job};
    use crate::serde_artifact;

    #[derive(serde::Serialize, serde::Deserialize)]
    struct Number(u32);
    serde_artifact!(Number, "number", 1);

    type Work<'a> = &'a (dyn Fn() -> Result<Product> + Send + Sync);

    fn job<'a>(name: &str, memory: u64, work: Work<'a>) -> Job<'a> {
        Job {
            kind: "test",
            version: 1,
            name: name.to_owned(),
            params: json!(name),
            external: BTreeMap::new(),
            memory,
            work: Box::new(move |_| work()),
        }
    }

    fn run(graph: &JobGraph<'_>, store: &Store, stop: &AtomicBool) -> Result<RunResult> {
        let observer = Broadcast::default();
        let options =
            RunOptions { store, observer: &observer, threads: 4, memory: 100, stop, noted_as: None };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
        pool.install(|| Executor::new(graph, &options).run())
    }

    fn store() -> (tempfile::TempDir, Store) {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        (folder, store)
    }

    #[test]
    fn jobs_wait_for_memory_but_one_that_exceeds_it_runs_alone() {
        let (_folder, store) = store();
        let (used, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let hold = |memory: usize| {
            let now = used.fetch_add(memory, Ordering::SeqCst) + memory;
            most.fetch_max(now, Ordering::SeqCst);
            std::thread::sleep(Duration::from_millis(5));
            used.fetch_sub(memory, Ordering::SeqCst);
            Product::new(Number(0))
        };
        let (middle, large) = (|| hold(45), || hold(300));
        let mut graph = JobGraph::default();
        for at in 0..6 {
            graph.add(job(&format!("middle {at}"), 45, &middle));
        }
        assert_eq!(run(&graph, &store, &AtomicBool::new(false)).unwrap().ran.len(), 6);
        assert!(most.load(Ordering::SeqCst) <= 90, "{most:?}");
        graph.add(job("large", 300, &large));
        for at in 6..12 {
            graph.add(job(&format!("middle {at}"), 45, &middle));
        }
        let again = run(&graph, &store, &AtomicBool::new(false)).unwrap();
        assert_eq!((again.ran.len(), again.hits), (7, 6));
        assert_eq!(most.load(Ordering::SeqCst), 300);
    }

    #[test]
    fn a_failing_or_panicking_job_takes_along_only_those_that_require_it() {
        let (_folder, store) = store();
        let fails = || Err(anyhow::anyhow!("no light"));
        let panics = || panic!("a bug");
        let works = || Product::new(Number(1));
        let mut graph = JobGraph::default();
        let (bad, worse, good) = (
            graph.add(job("bad", 1, &fails)),
            graph.add(job("worse", 1, &panics)),
            graph.add(job("good", 1, &works)),
        );
        let user = graph.add(job("requires bad", 1, &works));
        graph.require(user, "a", bad);
        let tolerant = graph.add(job("accepts worse", 1, &works));
        graph.accept(tolerant, "a", worse);
        graph.require(tolerant, "b", good);
        let result = run(&graph, &store, &AtomicBool::new(false)).unwrap();
        assert_eq!(result.ran, ["test accepts worse", "test good"]);
        assert_eq!(result.failed["test bad"], "no light");
        assert!(result.failed["test worse"].contains("panicked"), "{:?}", result.failed);
        assert_eq!(result.keys.len(), 2);
    }

    #[test]
    fn a_job_runs_only_where_another_says_so_and_is_the_same_for_that() {
        let (_folder, store) = store();
        let (works, says) = (|| Product::new(Number(7)), || Product::new(Number(3)));
        let run_where = |most: u32| {
            let mut graph = JobGraph::default();
            let gate = graph.add(job("gate", 1, &says));
            let held = graph.add(job("held", 1, &works));
            graph.run_only_where(held, gate, move |number: &Number| number.0 <= most);
            let user = graph.add(job("user", 1, &works));
            graph.require(user, "a", held);
            run(&graph, &store, &AtomicBool::new(false)).unwrap()
        };
        let closed = run_where(2);
        assert_eq!((closed.ran, closed.failed.len()), (vec!["test gate".to_owned()], 0));
        let open = run_where(3);
        assert_eq!((open.ran, open.hits), (vec!["test held".to_owned(), "test user".to_owned()], 1));
        assert_eq!(run_where(4).hits, 3);
    }

    #[test]
    fn what_is_for_one_run_only_is_made_once_and_never_stored() {
        let (_folder, store) = store();
        let made = AtomicUsize::new(0);
        let work = || {
            made.fetch_add(1, Ordering::SeqCst);
            Ok(Product::new(Number(5))?.for_this_run_only())
        };
        let mut graph = JobGraph::default();
        // Nobody has said that it will be loaded.
        let id = graph.add(job("degraded", 1, &work));
        let (observer, stop) = (Broadcast::default(), AtomicBool::new(false));
        let options = RunOptions {
            store: &store,
            observer: &observer,
            threads: 1,
            memory: 100,
            stop: &stop,
            noted_as: None,
        };
        let executor = Executor::new(&graph, &options);
        executor.run().unwrap();
        assert_eq!(executor.load::<Number>(id).unwrap().0, 5);
        assert_eq!(made.load(Ordering::SeqCst), 1);
        // Nor where it is made in place of a file that is damaged.
        let again = executor.remake(id, executor.output(id).unwrap(), &anyhow::anyhow!("damaged")).unwrap();
        assert_eq!(again.downcast::<Number>().unwrap().0, 5);
        assert!(store.lookup(executor.fingerprint(id).key()).is_none());
    }

    #[test]
    fn both_passes_of_a_job_are_in_what_a_command_came_to() {
        let (key, label) = (|name: &str| ContentHash::of(name.as_bytes()), |name: &str| name.to_owned());
        let ran = |job: &str, of: &str| RunResult {
            ran: vec![label(job)],
            keys: BTreeMap::from([(label(job), key(of)), (label("shared"), key("shared"))]),
            hits: 1,
            ..RunResult::default()
        };
        let mut whole = ran("model", "guess").and(ran("model", "estimate"));
        assert_eq!(whole.ran, ["model", "model (pass 2)"]);
        assert_eq!((whole.keys["model"], whole.keys["model (pass 2)"]), (key("guess"), key("estimate")));
        // What both use was found once.
        assert_eq!((whole.hits, whole.keys.len()), (1, 3));
        let hit = RunResult { ran: Vec::new(), hits: 2, ..ran("model", "estimate") };
        whole.absorb(hit);
        assert_eq!((whole.hits, whole.keys.len()), (1, 3));
    }

    #[test]
    fn a_stop_lets_running_jobs_finish_and_starts_no_other() {
        let (_folder, store) = store();
        let stop = AtomicBool::new(false);
        let stops = || {
            stop.store(true, Ordering::Relaxed);
            Product::new(Number(1))
        };
        let never = || panic!("it must not be started");
        let mut graph = JobGraph::default();
        let first = graph.add(job("first", 1, &stops));
        let second = graph.add(job("second", 1, &never));
        graph.require(second, "a", first);
        assert!(run(&graph, &store, &stop).unwrap_err().is::<Interrupted>());
        let again = graph.plan(&store, &crate::store::RunRecord::default());
        assert_eq!(again[0].prediction, crate::graph::Prediction::Stored);
    }
}
