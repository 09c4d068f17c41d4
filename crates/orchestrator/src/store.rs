//! The content-addressed store: results of jobs, found again by fingerprint.
//!
//! `objects/ab/<hash>` holds artifact files by the hash of their content, `keys/ab/<key>.json` the readable
//! fingerprint of a job with the hash of its output, `runs/<name>.json` which job had which key in the last run.
//! Every file is written beside its place, synced and renamed, so a reader sees a whole file or none, two processes
//! at once at worst do the same work twice, and nothing has to be locked.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

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
    pub kinds: std::collections::BTreeMap<String, (usize, u64)>,
    /// Objects that no key refers to.
    pub orphans: usize,
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
        let path = self.object_path(output);
        let whole = fs::read(&path).is_ok_and(|old| old == file);
        if !whole {
            write_atomically(&path, file)?;
        }
        let record =
            KeyRecord { fingerprint: fingerprint.clone(), output, bytes: file.len() as u64, cpu_secs };
        write_atomically(
            &self.key_path(fingerprint.key()),
            serde_json::to_string_pretty(&record)?.as_bytes(),
        )?;
        Ok(output)
    }

    /// Removes an artifact, as when it was found damaged.
    pub fn discard(&self, hash: ContentHash) {
        // A file that cannot be removed is replaced by the next write.
        let _ = fs::remove_file(self.object_path(hash));
    }

    /// Which job had which key when `name` was made last; empty when it never was.
    pub fn run(&self, name: &str) -> RunRecord {
        let read = || serde_json::from_slice(&fs::read(self.run_path(name)).ok()?).ok();
        read().unwrap_or_default()
    }

    /// Remembers the keys of a run; the run before becomes `previous` when something changed.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn remember_run(
        &self,
        name: &str,
        jobs: std::collections::BTreeMap<String, ContentHash>,
    ) -> Result<()> {
        let last = self.run(name);
        if last.jobs == jobs {
            return Ok(());
        }
        let record = RunRecord { jobs, previous: last.jobs };
        write_atomically(&self.run_path(name), serde_json::to_string_pretty(&record)?.as_bytes())
    }

    /// Names of all remembered runs.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn runs(&self) -> Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in fs::read_dir(self.root.join("runs"))? {
            if let Some(name) = entry?.file_name().to_str().and_then(|name| name.strip_suffix(".json")) {
                names.push(name.to_owned());
            }
        }
        names.sort();
        Ok(names)
    }

    fn run_path(&self, name: &str) -> PathBuf {
        let name: String =
            name.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' }).collect();
        self.root.join("runs").join(format!("{name}.json"))
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
        for path in files_below(&self.root.join("objects"))? {
            summary.bytes += fs::metadata(&path)?.len();
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
                fs::remove_file(&path).map_err(|e| write_error(e, &path))?;
                damaged.push(name);
            }
        }
        Ok(damaged)
    }

    /// Removes what the remembered runs do not use, then, oldest first, until at most `max_bytes` are left.
    ///
    /// Returns the number of removed objects and their bytes.
    ///
    /// # Errors
    /// When the folders cannot be listed or changed.
    pub fn collect_garbage(&self, max_bytes: Option<u64>) -> Result<(usize, u64)> {
        let mut live = BTreeSet::new();
        for name in self.runs()? {
            live.extend(self.run(&name).jobs.into_values());
        }
        let mut used = BTreeSet::new();
        for (path, record) in self.records()? {
            if live.contains(&record.fingerprint.key()) {
                used.insert(record.output.to_string());
            } else {
                fs::remove_file(&path).map_err(|e| write_error(e, &path))?;
            }
        }
        let mut kept = Vec::new();
        let (mut count, mut bytes) = (0, 0);
        let mut remove = |path: &Path, length: u64| {
            count += 1;
            bytes += length;
            fs::remove_file(path).map_err(|e| write_error(e, path))
        };
        for path in files_below(&self.root.join("objects"))? {
            let metadata = fs::metadata(&path)?;
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if used.contains(name) {
                kept.push((metadata.modified()?, path, metadata.len()));
            } else {
                remove(&path, metadata.len())?;
            }
        }
        kept.sort();
        let mut size: u64 = kept.iter().map(|(_, _, length)| length).sum();
        for (_, path, length) in &kept {
            if max_bytes.is_none_or(|limit| size <= limit) {
                break;
            }
            remove(path, *length)?;
            size -= length;
        }
        Ok((count, bytes))
    }
}

/// Which job had which key.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Keys of the last run by job.
    pub jobs: std::collections::BTreeMap<String, ContentHash>,
    /// Keys of the last run that differed.
    #[serde(default)]
    pub previous: std::collections::BTreeMap<String, ContentHash>,
}

/// All finished files below a folder, sorted; files being written are left out.
fn files_below(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for shard in fs::read_dir(folder).with_context(|| format!("cannot list {}", folder.display()))? {
        let shard = shard?.path();
        if shard.is_dir() {
            for entry in fs::read_dir(&shard)? {
                let path = entry?.path();
                let hidden =
                    path.file_name().and_then(|name| name.to_str()).is_none_or(|name| name.starts_with('.'));
                if !hidden {
                    files.push(path);
                }
            }
        }
    }
    files.sort();
    Ok(files)
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
        let mut file = tempfile::Builder::new().prefix(".writing-").tempfile_in(folder)?;
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
fn write_error(error: std::io::Error, path: &Path) -> anyhow::Error {
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
        store.remember_run("scene", BTreeMap::from([("job".to_owned(), fingerprint(1).key())])).unwrap();
        assert_eq!(store.collect_garbage(None).unwrap(), (1, 6));
        assert!(store.read(kept).is_ok() && store.read(lost).is_err());
        assert_eq!(store.collect_garbage(Some(0)).unwrap(), (1, 4));
    }
}
