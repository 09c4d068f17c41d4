//! The content-addressed store: results of jobs, found again by fingerprint.
//!
//! `objects/ab/<hash>` holds artifact files by the hash of their content, `keys/ab/<key>.json` the readable
//! fingerprint of a job with the hash of its output, `runs/<name>.json` which job had which key in the last run of
//! that name.
//! Every file is written beside its place, synced and renamed, so a reader sees a whole file or none, two processes
//! at once at worst do the same work twice, and nothing has to be locked.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::error::Hinted;
use crate::fingerprint::{ContentHash, Fingerprint};

/// What is known of a finished job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeyRecord {
    /// What the output is a function of.
    pub fingerprint: Fingerprint,
    /// Hash of the output's file.
    pub output: ContentHash,
    /// Size of the output's file in bytes.
    pub bytes: u64,
    /// CPU seconds that making it took.
    pub cpu_secs: f64,
}

/// Size and contents of a store.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StoreSummary {
    /// Per job kind: count and bytes of outputs.
    pub kinds: BTreeMap<String, (usize, u64)>,
    /// Objects that no key refers to.
    pub orphans: usize,
    /// Files that a killed process left half written.
    pub unfinished: usize,
    /// Bytes of all objects.
    pub bytes: u64,
}

/// A folder of results.
#[derive(Debug, Clone)]
pub struct Store {
    root: PathBuf,
}

impl Store {
    /// Opens the store in `root`, making the folder when it is missing.
    ///
    /// # Errors
    /// When the folders cannot be made.
    pub fn open(root: &Path) -> Result<Self> {
        for folder in ["objects", "keys", "runs"] {
            create_folder(&root.join(folder))?;
        }
        Ok(Self { root: root.to_owned() })
    }

    /// The store in `root` as it is; nothing is made. A missing folder is an empty store.
    pub fn at(root: &Path) -> Self {
        Self { root: root.to_owned() }
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

    fn key_path(&self, key: ContentHash) -> PathBuf {
        let name = key.to_string();
        self.root.join("keys").join(&name[..2]).join(format!("{name}.json"))
    }

    /// The record of a finished job whose output is still here in full length; a damaged record counts as none.
    pub fn lookup(&self, key: ContentHash) -> Option<KeyRecord> {
        let record: KeyRecord = serde_json::from_slice(&fs::read(self.key_path(key)).ok()?).ok()?;
        let length = fs::metadata(self.object_path(record.output)).ok()?.len();
        (record.fingerprint.key() == key && length == record.bytes).then_some(record)
    }

    /// The record of a key whether or not its output is still here.
    pub fn record(&self, key: ContentHash) -> Option<KeyRecord> {
        serde_json::from_slice(&fs::read(self.key_path(key)).ok()?).ok()
    }

    /// The file of an artifact, its hash verified.
    ///
    /// # Errors
    /// When it is missing, unreadable or damaged.
    pub fn read(&self, hash: ContentHash) -> Result<Vec<u8>> {
        let path = self.object_path(hash);
        let bytes = fs::read(&path).with_context(|| format!("cannot read artifact {hash}"))?;
        anyhow::ensure!(
            ContentHash::of(&bytes) == hash,
            "artifact {hash} is damaged: its content has another hash"
        );
        Ok(bytes)
    }

    /// Stores an artifact file and what it was made from; returns its content hash.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn write(&self, fingerprint: &Fingerprint, file: &[u8], cpu_secs: f64) -> Result<ContentHash> {
        let output = ContentHash::of(file);
        self.keep(fingerprint, output, file, cpu_secs)?;
        Ok(output)
    }

    /// As [`Store::write`], with the hash of the file.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn keep(
        &self,
        fingerprint: &Fingerprint,
        output: ContentHash,
        file: &[u8],
        cpu_secs: f64,
    ) -> Result<()> {
        let path = self.object_path(output);
        let whole = fs::read(&path).is_ok_and(|old| old == file);
        if !whole {
            write_atomically(&path, file)?;
        }
        let record =
            KeyRecord { fingerprint: fingerprint.clone(), output, bytes: file.len() as u64, cpu_secs };
        write_atomically(&self.key_path(fingerprint.key()), serde_json::to_string_pretty(&record)?.as_bytes())
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

    /// All records.
    fn records(&self) -> Result<Vec<(PathBuf, KeyRecord)>> {
        let mut records = Vec::new();
        for path in files_below(&self.root.join("keys"))? {
            if let Some(record) = fs::read(&path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()) {
                records.push((path, record));
            }
        }
        Ok(records)
    }

    /// Counts what is here.
    ///
    /// # Errors
    /// When the folders cannot be listed.
    pub fn summary(&self) -> Result<StoreSummary> {
        let mut summary = StoreSummary::default();
        let mut used = BTreeSet::new();
        for (_, record) in self.records()? {
            let entry = summary.kinds.entry(record.fingerprint.kind).or_default();
            entry.0 += 1;
            entry.1 += record.bytes;
            used.insert(record.output.to_string());
        }
        for folder in ["objects", "keys", "runs"] {
            summary.unfinished += temporary_files_below(&self.root.join(folder))?.len();
        }
        for path in files_below(&self.root.join("objects"))? {
            summary.bytes += fs::metadata(&path).map_or(0, |metadata| metadata.len());
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            summary.orphans += usize::from(!used.contains(name));
        }
        Ok(summary)
    }

    /// Hashes every object; removes damaged ones and returns their names.
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
        Ok(damaged)
    }

    /// Removes what the remembered runs do not use, then, oldest first, until at most `max_bytes` are left.
    ///
    /// What is younger than `min_age` may belong to a run that goes on at this moment, and is left alone unless the
    /// size demands it.
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
        let mut used = BTreeSet::new();
        for (path, record) in self.records()? {
            let young = fs::metadata(&path).is_ok_and(|metadata| age(&metadata) < min_age);
            if young || live.contains(&record.fingerprint.key()) {
                used.insert(record.output.to_string());
            } else {
                remove(&path)?;
            }
        }
        let mut removed = Removed::default();
        for folder in ["objects", "keys", "runs"] {
            for path in temporary_files_below(&self.root.join(folder))? {
                let Ok(metadata) = fs::metadata(&path) else { continue };
                if age(&metadata) >= min_age {
                    remove(&path)?;
                    removed.count(metadata.len());
                }
            }
        }
        let mut kept = Vec::new();
        for path in files_below(&self.root.join("objects"))? {
            let Ok(metadata) = fs::metadata(&path) else { continue };
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if used.contains(name) || age(&metadata) < min_age {
                kept.push((metadata.modified()?, path, metadata.len()));
            } else {
                remove(&path)?;
                removed.count(metadata.len());
            }
        }
        kept.sort();
        let mut size: u64 = kept.iter().map(|(_, _, length)| length).sum();
        for (_, path, length) in &kept {
            if max_bytes.is_none_or(|limit| size <= limit) {
                break;
            }
            remove(path)?;
            removed.count(*length);
            size -= length;
        }
        Ok(removed)
    }
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

/// Removes a file; that another process did it before is no error.
fn remove(path: &Path) -> Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(write_error(error, path)),
        _ => Ok(()),
    }
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

/// Writes a file so that readers see the old one, or the new one whole, whatever happens.
///
/// # Errors
/// When the disk is full or not writable; nothing is left behind then.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    create_folder(folder)?;
    let write = || -> std::io::Result<()> {
        let mut file = tempfile::Builder::new().prefix(TEMPORARY).tempfile_in(folder)?;
        file.write_all(bytes)?;
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

/// An error of writing with what to do about it.
pub fn write_error(error: std::io::Error, path: &Path) -> anyhow::Error {
    let hint = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            "make space and run the same command again: everything finished is kept"
        }
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
            "choose a writable folder with --cache DIR or SETLOC_CACHE, or another -o"
        }
        _ => "check that the folder exists and can be written",
    };
    Hinted::wrap(anyhow::Error::new(error).context(format!("cannot write {}", path.display())), hint)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

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
        assert_eq!(store.read(hash).unwrap(), b"content");
    }

    #[test]
    fn damage_is_noticed_on_reading_and_by_verify() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let hash = store.write(&fingerprint(1), b"content", 0.0).unwrap();
        fs::write(store.object_path(hash), b"c0ntent").unwrap();
        assert!(store.read(hash).unwrap_err().to_string().contains("damaged"));
        assert_eq!(store.verify().unwrap(), [hash.to_string()]);
        assert!(store.lookup(fingerprint(1).key()).is_none());
    }

    #[test]
    fn garbage_is_what_no_run_uses() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let kept = store.write(&fingerprint(1), b"used", 0.0).unwrap();
        let lost = store.write(&fingerprint(2), b"unused", 0.0).unwrap();
        let jobs = BTreeMap::from([("job".to_owned(), fingerprint(1).key())]);
        store.remember_run("scene", jobs, LastRun::default()).unwrap();
        let collect = |max| store.collect_garbage(max, Duration::ZERO).unwrap();
        assert_eq!(collect(None), Removed { files: 1, bytes: 6 });
        assert!(store.read(kept).is_ok() && store.read(lost).is_err());
        assert_eq!(collect(Some(0)), Removed { files: 1, bytes: 4 });
    }

    #[test]
    fn garbage_collection_spares_what_is_young_or_of_a_stopped_run() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let hash = store.write(&fingerprint(1), b"of a stopped run", 0.0).unwrap();
        store.note_unfinished("scene", BTreeMap::from([("job".to_owned(), fingerprint(1).key())])).unwrap();
        store.write(&fingerprint(2), b"of a run that goes on", 0.0).unwrap();
        assert_eq!(store.collect_garbage(None, Duration::from_hours(1)).unwrap(), Removed::default());
        assert_eq!(store.collect_garbage(None, Duration::ZERO).unwrap(), Removed { files: 1, bytes: 21 });
        assert!(store.read(hash).is_ok());
    }

    #[test]
    fn files_that_a_killed_process_left_are_counted_and_removed() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        store.write(&fingerprint(1), b"content", 0.0).unwrap();
        let shard = entries(&folder.path().join("objects")).unwrap().remove(0);
        fs::write(shard.join(".writing-abc"), b"half").unwrap();
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
