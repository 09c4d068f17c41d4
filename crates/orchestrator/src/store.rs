//! The content-addressed store: results of jobs, found again by fingerprint.
//!
//! `objects/ab/<hash>` holds artifact files by the hash of their content, `keys/<hash>.jsonl` the readable fingerprints
//! of jobs with the hash of their output, a line each, `runs/<name>.json` which job had which key in the last run of
//! that name. Small artifacts are in their job's record itself, and jobs that end at about the same time share a file of
//! records: making and syncing a file costs as much as many a job.
//! Every file is written beside its place, synced and renamed, so a reader sees a whole file or none, two processes
//! at once at worst do the same work twice, and nothing has to be locked.

mod records;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::error::Hinted;
use crate::fingerprint::{ContentHash, Fingerprint};

use records::Records;

pub use records::KeyRecord;

/// A job's result to be kept.
#[derive(Debug, Clone, Copy)]
pub struct Output<'a> {
    /// What it is a function of.
    pub fingerprint: &'a Fingerprint,
    /// Hash of its file.
    pub hash: ContentHash,
    /// Its file.
    pub file: &'a [u8],
    /// CPU seconds that making it took.
    pub cpu_secs: f64,
}

/// Size and contents of a store.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StoreSummary {
    /// Per job kind: count and bytes of outputs that are here.
    pub kinds: BTreeMap<String, (usize, u64)>,
    /// Objects that no key refers to.
    pub orphans: usize,
    /// Files that a killed process left half written.
    pub unfinished: usize,
    /// Bytes of all outputs, those in records too.
    pub bytes: u64,
}

/// A folder of results.
#[derive(Debug, Clone)]
pub struct Store {
    root: PathBuf,
    records: Records,
}

impl Store {
    /// Opens the store in `root`, making the folder when it is missing.
    ///
    /// # Errors
    /// When the folders cannot be made.
    pub fn open(root: &Path) -> Result<Self> {
        for folder in ["objects", "keys", "runs"] {
            create_folder(&root.join(folder)).map_err(with_other_store)?;
        }
        Ok(Self::at(root))
    }

    /// The store in `root` as it is; nothing is made. A missing folder is an empty store.
    pub fn at(root: &Path) -> Self {
        Self { root: root.to_owned(), records: Records::at(root.join("keys")) }
    }

    /// How runs that make `output` are called: by its place beside the store, so that both can be moved together.
    pub fn name_of(&self, verb: &str, output: &Path) -> String {
        let (output, root) = (resolved(output), resolved(&self.root));
        let beside = root.parent().and_then(|folder| output.strip_prefix(folder).ok());
        format!("{verb} {}", beside.unwrap_or(&output).display())
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    fn object_path(&self, hash: ContentHash) -> PathBuf {
        let name = hash.to_string();
        self.root.join("objects").join(&name[..2]).join(name)
    }

    /// The record of a finished job whose output is still here, an object in full length; a damaged record counts as
    /// none.
    pub fn lookup(&self, key: ContentHash) -> Option<KeyRecord> {
        let has_output = |record: &KeyRecord| {
            let object = || fs::metadata(self.object_path(record.output));
            record.content().is_some() || object().is_ok_and(|object| object.len() == record.bytes)
        };
        self.record(key).filter(has_output)
    }

    /// The record of a key whether or not its output is still here.
    pub fn record(&self, key: ContentHash) -> Option<KeyRecord> {
        self.records.find(key)
    }

    /// The output's file of the job with this key, its hash verified.
    ///
    /// # Errors
    /// When it is missing, unreadable or damaged.
    pub fn read(&self, key: ContentHash, hash: ContentHash) -> Result<Vec<u8>> {
        let bytes = match fs::read(self.object_path(hash)) {
            Err(error) if error.kind() == ErrorKind::NotFound => {
                self.record(key).and_then(|record| record.content().map(<[u8]>::to_vec)).ok_or(error)
            }
            object => object,
        };
        verified(bytes, hash)
    }

    /// An output's file that is an object, as all but small ones are, its hash verified.
    ///
    /// # Errors
    /// When it is missing, unreadable or damaged.
    pub fn object(&self, hash: ContentHash) -> Result<Vec<u8>> {
        verified(fs::read(self.object_path(hash)), hash)
    }

    /// All undamaged records of jobs of these kinds.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn records_of(&self, kinds: &[&str]) -> Result<Vec<KeyRecord>> {
        self.records.of_kinds(kinds)
    }

    /// Stores an artifact file and what it was made from; returns its content hash.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn write(&self, fingerprint: &Fingerprint, file: &[u8], cpu_secs: f64) -> Result<ContentHash> {
        let hash = ContentHash::of(file);
        self.keep(&[Output { fingerprint, hash, file, cpu_secs }])?;
        Ok(hash)
    }

    /// Stores results, their records in one file.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn keep(&self, outputs: &[Output<'_>]) -> Result<()> {
        self.keep_all(outputs).map_err(with_other_store)
    }

    fn keep_all(&self, outputs: &[Output<'_>]) -> Result<()> {
        let mut records = Vec::with_capacity(outputs.len());
        for &Output { fingerprint, hash, file, cpu_secs } in outputs {
            let record = KeyRecord::new(fingerprint.clone(), hash, file, cpu_secs);
            let path = self.object_path(hash);
            if record.content().is_none() && !fs::read(&path).is_ok_and(|old| old == file) {
                write_atomically(&path, file)?;
            }
            records.push(record);
        }
        self.records.add(&records)
    }

    /// Removes an artifact, as when it was found damaged.
    pub fn discard(&self, hash: ContentHash) {
        // A file that cannot be removed is replaced by the next write.
        let _ = fs::remove_file(self.object_path(hash));
    }

    /// What is known of the runs of this name; empty when there was none.
    pub fn run(&self, name: &str) -> RunRecord {
        read_run(&self.run_path(name))
            .unwrap_or_else(|| RunRecord { name: name.to_owned(), ..RunRecord::default() })
    }

    /// Remembers the keys of a run; the run before becomes `previous` when something changed.
    ///
    /// # Errors
    /// When the disk is full or not writable; not when nothing new was to be noted but the time.
    pub fn remember_run(&self, name: &str, jobs: BTreeMap<String, ContentHash>, last: LastRun) -> Result<()> {
        let before = self.run(name);
        let same = before.jobs == jobs && before.unfinished.is_empty();
        let previous = if before.jobs == jobs { before.previous } else { before.jobs };
        let record =
            RunRecord { name: before.name, jobs, previous, unfinished: BTreeMap::new(), last: Some(last) };
        let written = self.write_run(&record);
        if same { Ok(()) } else { written }
    }

    /// Notes the results of a run that was stopped, beside those of the last whole one.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn note_unfinished(&self, name: &str, jobs: BTreeMap<String, ContentHash>) -> Result<()> {
        let mut record = self.run(name);
        record.unfinished.extend(jobs);
        self.write_run(&record)
    }

    fn write_run(&self, record: &RunRecord) -> Result<()> {
        write_atomically(&self.run_path(&record.name), serde_json::to_string_pretty(record)?.as_bytes())
    }

    /// All remembered runs by name.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn runs(&self) -> Result<BTreeMap<String, RunRecord>> {
        let folder = self.root.join("runs");
        let entries = match fs::read_dir(&folder) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(BTreeMap::new()),
            entries => entries.with_context(|| format!("cannot list {}", folder.display()))?,
        };
        let mut runs = BTreeMap::new();
        for entry in entries {
            if let Some(record) = read_run(&entry?.path()) {
                runs.insert(record.name.clone(), record);
            }
        }
        Ok(runs)
    }

    /// The readable part of the name for people, some of its hash to tell apart what reads alike.
    fn run_path(&self, name: &str) -> PathBuf {
        let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
        let tail: String = name.chars().rev().take(80).map(plain).collect();
        let readable: String = tail.chars().rev().collect();
        let hash = ContentHash::of(name.as_bytes()).to_string();
        self.root.join("runs").join(format!("{}-{}.json", readable.trim_start_matches('.'), &hash[..8]))
    }

    /// Counts what is here.
    ///
    /// # Errors
    /// When the folders cannot be listed.
    pub fn summary(&self) -> Result<StoreSummary> {
        let mut summary = StoreSummary::default();
        let mut objects = BTreeSet::new();
        for path in files_below(&self.root.join("objects"))? {
            summary.bytes += fs::metadata(&path).map_or(0, |metadata| metadata.len());
            objects.insert(path.file_name().unwrap_or_default().to_string_lossy().into_owned());
        }
        let mut used = BTreeSet::new();
        for record in self.records.all()?.into_iter().flat_map(|(_, records)| records) {
            let is_here = if let Some(content) = record.content() {
                summary.bytes += content.len() as u64;
                true
            } else {
                let name = record.output.to_string();
                let is_here = objects.contains(&name);
                used.insert(name);
                is_here
            };
            if !is_here {
                // What is gone is known still, for `explain`.
                continue;
            }
            let entry = summary.kinds.entry(record.fingerprint.kind).or_default();
            entry.0 += 1;
            entry.1 += record.bytes;
        }
        for folder in ["objects", "keys", "runs"] {
            summary.unfinished += temporary_files_below(&self.root.join(folder))?.len();
        }
        summary.orphans = objects.difference(&used).count();
        Ok(summary)
    }

    /// Hashes every output, in objects and in records; removes damaged ones and returns their names.
    ///
    /// # Errors
    /// When the folders cannot be listed.
    pub fn verify(&self) -> Result<Vec<String>> {
        let mut damaged = Vec::new();
        for path in files_below(&self.root.join("objects"))? {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default().to_owned();
            if fs::read(&path).map(|bytes| ContentHash::of(&bytes).to_string()).ok().as_deref() != Some(&name)
            {
                remove(&path)?;
                damaged.push(name);
            }
        }
        damaged.append(&mut self.records.remove_damaged()?);
        Ok(damaged)
    }

    /// Removes what the remembered runs do not use, then, oldest first, until at most `max_bytes` are left.
    ///
    /// What is younger than `min_age` may belong to a run that goes on at this moment, and is left alone, even if it is
    /// more than that.
    ///
    /// # Errors
    /// When the folders cannot be listed or changed.
    pub fn collect_garbage(&self, max_bytes: Option<u64>, min_age: Duration) -> Result<Removed> {
        let now = SystemTime::now();
        let age = |metadata: &fs::Metadata| {
            metadata.modified().ok().and_then(|at| now.duration_since(at).ok()).unwrap_or_default()
        };
        let mut live = BTreeSet::new();
        for run in self.runs()?.into_values() {
            live.extend(run.jobs.into_values().chain(run.unfinished.into_values()));
        }
        let (mut used, mut young_outputs) = (BTreeSet::new(), BTreeSet::new());
        let (mut kept, mut removed) = (Vec::new(), Removed::default());
        let mut unwanted: BTreeMap<PathBuf, BTreeSet<ContentHash>> = BTreeMap::new();
        for (file, records) in self.records.all()? {
            let Ok(metadata) = fs::metadata(&file) else { continue };
            let young = age(&metadata) < min_age;
            for record in records {
                if young {
                    young_outputs.insert(record.output.to_string());
                }
                let wanted = young || live.contains(&record.key());
                match (record.content(), wanted) {
                    (Some(_), true) => {
                        let place = Kept::Record(file.clone(), record.key());
                        kept.push((young, metadata.modified()?, record.bytes, place));
                    }
                    (Some(_), false) => removed.count(record.bytes),
                    (None, true) => drop(used.insert(record.output.to_string())),
                    (None, false) => {}
                }
                if !wanted {
                    unwanted.entry(file.clone()).or_default().insert(record.key());
                }
            }
        }
        for folder in ["objects", "keys", "runs"] {
            for path in temporary_files_below(&self.root.join(folder))? {
                let Ok(metadata) = fs::metadata(&path) else { continue };
                if age(&metadata) >= min_age {
                    remove(&path)?;
                    removed.count(metadata.len());
                }
            }
        }
        for path in files_below(&self.root.join("objects"))? {
            let Ok(metadata) = fs::metadata(&path) else { continue };
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let young = young_outputs.contains(name) || age(&metadata) < min_age;
            if young || used.contains(name) {
                kept.push((young, metadata.modified()?, metadata.len(), Kept::Object(path)));
            } else {
                remove(&path)?;
                removed.count(metadata.len());
            }
        }
        // What is young comes last.
        kept.sort();
        let mut size: u64 = kept.iter().map(|(_, _, bytes, _)| bytes).sum();
        let fits = |size| max_bytes.is_none_or(|limit| size <= limit);
        for (young, _, bytes, place) in kept {
            if young || fits(size) {
                break;
            }
            match place {
                Kept::Object(path) => remove(&path)?,
                Kept::Record(file, key) => drop(unwanted.entry(file).or_default().insert(key)),
            }
            removed.count(bytes);
            size -= bytes;
        }
        self.records.remove(&unwanted)?;
        removed.too_young = (!fits(size)).then_some(size);
        Ok(removed)
    }
}

/// Where an output is.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Kept {
    /// In this object.
    Object(PathBuf),
    /// In the record of this key in this file.
    Record(PathBuf, ContentHash),
}

/// What is younger may be in the hands of another process.
const LEFTOVER_AGE: Duration = Duration::from_hours(1);

/// Removes what killed processes left half written in an output folder, as far as it can.
pub fn remove_leftovers(folder: &Path) {
    for path in temporary_files_below(folder).unwrap_or_default() {
        let age = fs::metadata(&path).and_then(|metadata| metadata.modified()).map(|at| at.elapsed());
        if matches!(age, Ok(Ok(age)) if age >= LEFTOVER_AGE) {
            let _ = fs::remove_file(&path);
        }
    }
}

/// Removes these files of a folder, and the folder if nothing else is in it; that they are not there is no error.
///
/// # Errors
/// When one is there and cannot be removed.
pub fn remove_files(folder: &Path, names: &[&str]) -> Result<()> {
    names.iter().try_for_each(|name| remove(&folder.join(name)))?;
    // It stays where somebody else's files are in it.
    let _ = fs::remove_dir(folder);
    Ok(())
}

/// Removes a file; that it is not there is no error.
fn remove(path: &Path) -> Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(write_error(error, path)),
        _ => Ok(()),
    }
}

/// The content of an artifact as it was read, if it has its hash.
fn verified(bytes: std::io::Result<Vec<u8>>, hash: ContentHash) -> Result<Vec<u8>> {
    let bytes = bytes.with_context(|| format!("cannot read artifact {hash}"))?;
    anyhow::ensure!(
        ContentHash::of(&bytes) == hash,
        "artifact {hash} is damaged: its content has another hash"
    );
    Ok(bytes)
}

fn read_run(path: &Path) -> Option<RunRecord> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

/// The path without links as far as it exists.
fn resolved(path: &Path) -> PathBuf {
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    for ancestor in whole.ancestors() {
        if let (Ok(real), Ok(rest)) = (ancestor.canonicalize(), whole.strip_prefix(ancestor)) {
            // Joining nothing would add a slash.
            return if rest.as_os_str().is_empty() { real } else { real.join(rest) };
        }
    }
    whole
}

/// What garbage collection removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Removed {
    /// Files.
    pub files: usize,
    /// Their size.
    pub bytes: u64,
    /// Size of what is left, where that is more than the limit and too young to be removed.
    pub too_young: Option<u64>,
}

impl Removed {
    fn count(&mut self, bytes: u64) {
        self.files += 1;
        self.bytes += bytes;
    }
}

/// Which job had which key.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// What was made, as `build scene.setloc`.
    pub name: String,
    /// Keys of the last whole run by job.
    pub jobs: BTreeMap<String, ContentHash>,
    /// Keys of the last run that differed.
    pub previous: BTreeMap<String, ContentHash>,
    /// Keys that runs since then had before they were stopped.
    pub unfinished: BTreeMap<String, ContentHash>,
    /// How the last whole run went.
    pub last: Option<LastRun>,
}

/// How a run went.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LastRun {
    /// When it ended, in seconds since 1970.
    pub ended_unix_s: u64,
    /// Jobs that ran.
    pub ran: usize,
    /// Jobs whose result was stored before.
    pub stored: usize,
    /// Failed jobs and why.
    pub failed: BTreeMap<String, String>,
}

/// Begins the names of files that are being written.
const TEMPORARY: &str = ".writing-";

/// All finished files in the subfolders of a folder, sorted.
fn files_below(folder: &Path) -> Result<Vec<PathBuf>> {
    let shards = entries(folder)?.into_iter().filter(|path| path.is_dir());
    let mut files = shards.map(|shard| entries(&shard)).collect::<Result<Vec<_>>>()?.concat();
    // Others than ours, too, hide what they have not finished (as NFS and editors do).
    files.retain(|path| name_starts_with(path, ".") == Some(false));
    Ok(files)
}

/// All files being written, or left by a killed process, in a folder and its subfolders.
fn temporary_files_below(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in entries(folder)? {
        if path.is_dir() { files.extend(entries(&path)?) } else { files.push(path) }
    }
    files.retain(|path| name_starts_with(path, TEMPORARY) == Some(true));
    Ok(files)
}

fn name_starts_with(path: &Path, prefix: &str) -> Option<bool> {
    Some(path.file_name()?.to_str()?.starts_with(prefix))
}

/// The paths in a folder, sorted; a missing folder is empty.
fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let shown = || format!("cannot list {}", folder.display());
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.with_context(shown)?,
    };
    let mut paths =
        entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>().with_context(shown)?;
    paths.sort();
    Ok(paths)
}

/// Makes a folder and those above it.
///
/// # Errors
/// When it cannot be made, with what to do about it.
pub fn create_folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(|e| write_error(e, path))
}

/// Whether nothing may be written in a folder, be it there or to be made: for its permissions, or as all of its disk.
pub fn refuses_writes(folder: &Path) -> bool {
    let written = fs::create_dir_all(folder)
        .and_then(|()| tempfile::Builder::new().prefix(TEMPORARY).tempfile_in(folder));
    written.is_err_and(|error| is_refusal(error.kind()))
}

fn is_refusal(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem)
}

/// Writes a file so that readers see the old one, or the new one whole, whatever happens.
///
/// # Errors
/// When the disk is full or not writable; nothing is left behind then.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    write_pieces_atomically(path, [bytes])
}

/// The same for a file in pieces, none of them small.
///
/// # Errors
/// As [`write_atomically`].
pub fn write_pieces_atomically<'p>(path: &Path, pieces: impl IntoIterator<Item = &'p [u8]>) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    create_folder(folder)?;
    let write = move || -> std::io::Result<()> {
        let mut file = tempfile::Builder::new().prefix(TEMPORARY).tempfile_in(folder)?;
        for piece in pieces {
            file.write_all(piece)?;
        }
        file.as_file().sync_all()?;
        set_usual_permissions(file.as_file())?;
        file.persist(path).map_err(|e| e.error)?;
        Ok(())
    };
    write().map_err(|e| write_error(e, path))
}

/// Temporary files are private; results are not.
fn set_usual_permissions(file: &File) -> std::io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    file.set_permissions(fs::Permissions::from_mode(0o644))
}

/// An error of a store with the options that name another one, where this one may not be written.
fn with_other_store(error: anyhow::Error) -> anyhow::Error {
    let causes = error.chain().filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    if causes.map(std::io::Error::kind).any(is_refusal) {
        return Hinted::wrap(error, "choose a writable folder with --cache DIR or SETLOC_CACHE");
    }
    error
}

/// An error of writing with what to do about it.
pub fn write_error(error: std::io::Error, path: &Path) -> anyhow::Error {
    let hint = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            "make space and run the same command again: everything finished is kept"
        }
        kind if is_refusal(kind) => "choose a folder that can be written, or make this one so",
        _ => "check that the folder exists and can be written",
    };
    Hinted::wrap(anyhow::Error::new(error).context(format!("cannot write {}", path.display())), hint)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    /// Too long for a record.
    const LARGE: [u8; 9999] = [7; 9999];

    fn fingerprint(version: u32) -> Fingerprint {
        Fingerprint {
            kind: "test".to_owned(),
            version,
            params: serde_json::json!({}),
            inputs: BTreeMap::new(),
        }
    }

    #[test]
    fn finds_by_fingerprint_what_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        assert!(store.lookup(fingerprint(1).key()).is_none());
        let hash = store.write(&fingerprint(1), b"content", 0.5).unwrap();
        assert_eq!(store.lookup(fingerprint(1).key()).unwrap().output, hash);
        assert_eq!(store.read(fingerprint(1).key(), hash).unwrap(), b"content");
        let object = store.write(&fingerprint(2), &LARGE, 0.5).unwrap();
        assert_eq!(store.read(fingerprint(2).key(), object).unwrap(), LARGE);
        assert_eq!(files_below(&folder.path().join("objects")).unwrap(), [store.object_path(object)]);
        let summary = store.summary().unwrap();
        assert_eq!((summary.bytes, summary.orphans), (LARGE.len() as u64 + 7, 0));
        assert_eq!(summary.kinds["test"], (2, LARGE.len() as u64 + 7));
        // The record of what is gone says what it was, and is no result.
        store.discard(object);
        assert_eq!(store.summary().unwrap().kinds["test"], (1, 7));
        assert!(store.record(fingerprint(2).key()).is_some());
    }

    #[test]
    fn damage_is_noticed_on_reading_and_by_verify() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let key = fingerprint(1).key();
        let hash = store.write(&fingerprint(1), &LARGE, 0.0).unwrap();
        let mut damaged = LARGE;
        damaged[9] = 8;
        fs::write(store.object_path(hash), damaged).unwrap();
        assert!(store.read(key, hash).unwrap_err().to_string().contains("damaged"));
        assert_eq!(store.verify().unwrap(), [hash.to_string()]);
        assert!(store.lookup(key).is_none() && store.verify().unwrap().is_empty());
    }

    #[test]
    fn garbage_is_what_no_run_uses() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.write(&fingerprint(1), b"used", 0.0).unwrap();
        store.write(&fingerprint(2), b"unused", 0.0).unwrap();
        let (kept, lost) = (fingerprint(1).key(), fingerprint(2).key());
        let jobs = BTreeMap::from([("job".to_owned(), fingerprint(1).key())]);
        store.remember_run("scene", jobs, LastRun::default()).unwrap();
        let collect = |max| store.collect_garbage(max, Duration::ZERO).unwrap();
        let removed = |files, bytes| Removed { files, bytes, too_young: None };
        assert_eq!(collect(None), removed(1, 6));
        assert!(store.lookup(kept).is_some() && store.lookup(lost).is_none());
        assert_eq!(collect(Some(0)), removed(1, 4));
        assert!(store.lookup(kept).is_none());
        store.write(&fingerprint(1), &LARGE, 0.0).unwrap();
        store.write(&fingerprint(2), &[&LARGE[..], b"unused"].concat(), 0.0).unwrap();
        assert_eq!(collect(None), removed(1, LARGE.len() as u64 + 6));
        assert!(store.lookup(kept).is_some() && store.lookup(lost).is_none());
        assert_eq!(collect(Some(0)), removed(1, LARGE.len() as u64));
    }

    #[test]
    fn garbage_collection_spares_what_is_young_or_of_a_stopped_run() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.write(&fingerprint(1), b"of a stopped run", 0.0).unwrap();
        store.note_unfinished("scene", BTreeMap::from([("job".to_owned(), fingerprint(1).key())])).unwrap();
        store.write(&fingerprint(2), b"of a run that goes on", 0.0).unwrap();
        assert_eq!(store.collect_garbage(None, Duration::from_hours(1)).unwrap(), Removed::default());
        let small = store.collect_garbage(Some(30), Duration::from_hours(1)).unwrap();
        assert_eq!(small, Removed { too_young: Some(37), ..Removed::default() });
        let unused = Removed { files: 1, bytes: 21, too_young: None };
        assert_eq!(store.collect_garbage(None, Duration::ZERO).unwrap(), unused);
        assert!(store.lookup(fingerprint(1).key()).is_some());
    }

    #[test]
    fn files_that_a_killed_process_left_are_counted_and_removed() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.write(&fingerprint(1), b"content", 0.0).unwrap();
        fs::write(folder.path().join("keys/.writing-abc"), b"half").unwrap();
        assert_eq!(store.summary().unwrap().unfinished, 1);
        store.collect_garbage(None, Duration::ZERO).unwrap();
        assert_eq!(store.summary().unwrap().unfinished, 0);
    }

    #[test]
    fn runs_are_named_by_the_place_of_their_output_beside_the_store() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::at(&folder.path().join("store"));
        let name = |output: &str| store.name_of("build", &folder.path().join(output));
        assert_eq!(name("a/scene.setloc"), "build a/scene.setloc");
        assert_ne!(store.run_path(&name("a/s")), store.run_path(&name("a_s")));
        assert!(store.name_of("build", Path::new("/elsewhere/s")).contains("/elsewhere/s"));
    }
}
