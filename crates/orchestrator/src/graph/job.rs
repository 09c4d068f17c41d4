//! Jobs and the graph they form.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::sync::Arc;

use anyhow::{Context, Result};
use petgraph::Direction;
use petgraph::graph::{DiGraph, NodeIndex};
use petgraph::visit::EdgeRef;
use serde_json::Value;

use super::executor::Executor;
use crate::codec::{self, Artifact};
use crate::fingerprint::ContentHash;

/// A job of a [`JobGraph`].
pub type JobId = NodeIndex;

/// A result: the value and its file.
pub struct Product {
    pub(super) value: Arc<dyn Any + Send + Sync>,
    pub(super) file: Vec<u8>,
    pub(super) is_kept: bool,
}

impl Product {
    /// A job's result.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn new<T: Artifact>(value: T) -> Result<Self> {
        let file = codec::encode(&value)?;
        Ok(Self { value: Arc::new(value), file, is_kept: true })
    }

    /// A result that depends on more than the job's inputs, as on a file that could not be read: it is not kept for another
    /// run.
    #[must_use]
    pub fn for_this_run_only(self) -> Self {
        Self { is_kept: false, ..self }
    }
}

type Work<'a> = Box<dyn Fn(&Inputs<'_, '_>) -> Result<Product> + Send + Sync + 'a>;

/// One unit of work whose result is a function of its parameters and inputs.
pub struct Job<'a> {
    /// Kind, also the stage it counts for.
    pub kind: &'static str,
    /// Version of the code behind the kind.
    pub version: u32,
    /// Name for people, unique in a graph within its kind.
    pub name: String,
    /// Own parameters.
    pub params: Value,
    /// Contents from outside the graph, by role.
    pub external: BTreeMap<String, ContentHash>,
    /// Estimated working memory in bytes.
    pub memory: u64,
    /// The work.
    pub work: Work<'a>,
}

impl Job<'_> {
    /// Kind and name.
    pub fn label(&self) -> String {
        format!("{} {}", self.kind, self.name)
    }
}

/// How a job uses the result of another.
pub(super) enum Use<'a> {
    /// As an input.
    Input {
        role: String,
        /// Whether the user fails with the used job; otherwise it does without.
        required: bool,
    },
    /// To know whether it is to run at all.
    Gate(Opens<'a>),
}

/// Whether the result of a job lets another run.
type Opens<'a> = Box<dyn Fn(&Executor<'_>, JobId) -> Result<bool> + Send + Sync + 'a>;

impl Use<'_> {
    /// The role of an input.
    pub fn role(&self) -> Option<&str> {
        match self {
            Self::Input { role, .. } => Some(role),
            Self::Gate(_) => None,
        }
    }

    /// Whether the user is left out where the used job has no result.
    pub fn is_required(&self) -> bool {
        !matches!(self, Self::Input { required: false, .. })
    }
}

/// A directed acyclic graph of jobs; edges lead from a job to those that use its result.
#[derive(Default)]
pub struct JobGraph<'a> {
    pub(super) graph: DiGraph<Job<'a>, Use<'a>>,
    wanted: BTreeSet<JobId>,
    wanted_files: BTreeSet<JobId>,
}

impl<'a> JobGraph<'a> {
    /// Adds a job; it must be added after the jobs that it uses.
    pub fn add(&mut self, job: Job<'a>) -> JobId {
        self.graph.add_node(job)
    }

    /// Says that the caller will load the result of a job: it stays in memory once it is there.
    pub fn want(&mut self, job: JobId) {
        self.wanted.insert(job);
    }

    /// Says that the caller will ask for the file of a job's result: it stays in memory once it is there.
    pub fn want_file(&mut self, job: JobId) {
        self.wanted_files.insert(job);
    }

    /// Lets `user` use the result of `used`; without it, `user` is left out.
    pub fn require(&mut self, user: JobId, role: impl Into<String>, used: JobId) {
        self.graph.add_edge(used, user, Use::Input { role: role.into(), required: true });
    }

    /// Lets `user` use the result of `used` when there is one.
    pub fn accept(&mut self, user: JobId, role: impl Into<String>, used: JobId) {
        self.graph.add_edge(used, user, Use::Input { role: role.into(), required: false });
    }

    /// Leaves `user` out, and all that requires it, unless what `gate` made is such. It is no input of it: what `user` makes does
    /// not depend on it.
    pub fn run_only_where<T: Artifact>(
        &mut self,
        user: JobId,
        gate: JobId,
        opens: impl Fn(&T) -> bool + Send + Sync + 'a,
    ) {
        let opens: Opens<'a> = Box::new(move |executor, gate| Ok(opens(&*executor.load::<T>(gate)?)));
        self.graph.add_edge(gate, user, Use::Gate(opens));
    }

    /// A job.
    pub fn job(&self, id: JobId) -> &Job<'a> {
        &self.graph[id]
    }

    /// Number of jobs.
    pub fn len(&self) -> usize {
        self.graph.node_count()
    }

    /// Whether there is no job.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The graph in Graphviz' language.
    pub fn to_dot(&self) -> String {
        // Writing to a string cannot fail.
        let mut dot = String::from("digraph setloc {\n  rankdir=LR;\n");
        for id in self.graph.node_indices() {
            let _ = writeln!(dot, "  {} [label={:?}];", id.index(), self.graph[id].label());
        }
        for edge in self.graph.edge_references() {
            let (from, to) = (edge.source().index(), edge.target().index());
            let _ =
                writeln!(dot, "  {from} -> {to} [label={:?}];", edge.weight().role().unwrap_or("only where"));
        }
        dot + "}\n"
    }

    pub(super) fn uses(&self, id: JobId) -> impl Iterator<Item = (JobId, &Use<'a>)> {
        self.graph.edges_directed(id, Direction::Incoming).map(|edge| (edge.source(), edge.weight()))
    }

    /// How many will load a job's result.
    pub(super) fn user_count(&self, id: JobId) -> usize {
        self.users(id).count() + usize::from(self.wanted.contains(&id))
    }

    pub(super) fn wants_file(&self, id: JobId) -> bool {
        self.wanted_files.contains(&id)
    }

    pub(super) fn users(&self, id: JobId) -> impl Iterator<Item = JobId> {
        self.graph.neighbors_directed(id, Direction::Outgoing)
    }
}

/// The results a job may use.
pub struct Inputs<'e, 'a> {
    executor: &'e Executor<'a>,
    id: JobId,
    /// The jobs whose results are used, by role: a model uses thousands.
    used: BTreeMap<&'e str, JobId>,
}

impl<'e, 'a> Inputs<'e, 'a> {
    pub(super) fn new(executor: &'e Executor<'a>, id: JobId) -> Self {
        let used = executor.graph.uses(id).filter_map(|(used, edge)| Some((edge.role()?, used))).collect();
        Self { executor, id, used }
    }

    /// The result in a role.
    ///
    /// # Errors
    /// When there is none, or it can neither be read nor made again.
    pub fn get<T: Artifact>(&self, role: &str) -> Result<Arc<T>> {
        self.find(role)?
            .with_context(|| format!("{} has no input {role}", self.executor.graph.job(self.id).label()))
    }

    /// The content hash of the result in a role.
    ///
    /// # Errors
    /// When there is none.
    pub fn hash(&self, role: &str) -> Result<ContentHash> {
        self.used(role)
            .and_then(|used| self.executor.output(used))
            .with_context(|| format!("{} has no input {role}", self.executor.graph.job(self.id).label()))
    }

    fn used(&self, role: &str) -> Option<JobId> {
        self.used.get(role).copied()
    }

    /// The result in a role, or `None` when the job that makes it failed.
    ///
    /// # Errors
    /// When it can neither be read nor made again.
    pub fn find<T: Artifact>(&self, role: &str) -> Result<Option<Arc<T>>> {
        match self.used(role) {
            Some(used) if self.executor.output(used).is_some() => self.executor.load(used).map(Some),
            _ => Ok(None),
        }
    }
}
