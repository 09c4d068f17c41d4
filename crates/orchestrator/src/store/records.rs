//! What is known of finished jobs: files of records, many to a file, found by key.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use serde::{Deserialize, Serialize};

use super::{name_starts_with, remove, write_atomically};
use crate::fingerprint::{ContentHash, Fingerprint};

/// What is known of a finished job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeyRecord {
    /// Key of the fingerprint; first in its line, so that a file can be searched without reading all of it.
    key: ContentHash,
    /// What the output is a function of.
    pub fingerprint: Fingerprint,
    /// Hash of the output's file.
    pub output: ContentHash,
    /// Size of the output's file in bytes.
    pub bytes: u64,
    /// CPU seconds that making it took.
    pub cpu_secs: f64,
    /// The output's file itself, when it is small; else it is an object.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    content: Option<Content>,
}

/// Bytes, written as Base64.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
struct Content(Vec<u8>);

impl From<Content> for String {
    fn from(Content(bytes): Content) -> Self {
        BASE64_STANDARD.encode(bytes)
    }
}

impl TryFrom<String> for Content {
    type Error = base64::DecodeError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        BASE64_STANDARD.decode(text).map(Self)
    }
}

/// Largest output, in bytes, that is kept in its record.
const MAX_CONTENT: usize = 4096;

impl KeyRecord {
    /// The record of an output, with it when it is small.
    pub fn new(fingerprint: Fingerprint, output: ContentHash, file: &[u8], cpu_secs: f64) -> Self {
        let content = (file.len() <= MAX_CONTENT).then(|| Content(file.to_vec()));
        let (key, bytes) = (fingerprint.key(), file.len() as u64);
        Self { key, fingerprint, output, bytes, cpu_secs, content }
    }

    /// Key of the job.
    pub fn key(&self) -> ContentHash {
        self.key
    }

    /// The output's file, when it is in the record.
    pub fn content(&self) -> Option<&[u8]> {
        self.content.as_ref().map(|Content(bytes)| &bytes[..])
    }

    /// Whether the record, and the output in it, are what was written.
    fn is_whole(&self) -> bool {
        self.fingerprint.key() == self.key
            && self.content().is_none_or(|content| ContentHash::of(content) == self.output)
    }
}

/// One record's place.
#[derive(Debug, Clone)]
struct Place {
    file: Arc<Path>,
    offset: u64,
    length: usize,
}

#[derive(Debug, Default)]
struct Index {
    files: BTreeSet<Arc<Path>>,
    places: HashMap<ContentHash, Vec<Place>>,
    listed: Option<Instant>,
}

/// All records of a store.
///
/// A file holds the records that were written together, a JSON object a line, and never changes: it appears whole,
/// and is replaced when some of its records are removed.
#[derive(Debug, Clone)]
pub struct Records {
    folder: PathBuf,
    index: Arc<Mutex<Index>>,
}

/// How a line with a record begins.
const LINE_START: &[u8] = br#"{"key":""#;
/// Hexadecimal digits of a key.
const KEY_LEN: usize = 64;
/// How old the list of files may be when a record is missed that another process may have written.
const LIST_AGE: Duration = Duration::from_secs(1);

impl Records {
    /// The records in a folder, which need not be there.
    pub fn at(folder: PathBuf) -> Self {
        Self { folder, index: Arc::default() }
    }

    /// The undamaged record of a key.
    pub fn find(&self, key: ContentHash) -> Option<KeyRecord> {
        self.find_listed(key).or_else(|| {
            let listed = self.lock().listed;
            if listed.is_some_and(|listed| listed.elapsed() < LIST_AGE) {
                return None;
            }
            self.list();
            self.find_listed(key)
        })
    }

    fn find_listed(&self, key: ContentHash) -> Option<KeyRecord> {
        let places = self.lock().places.get(&key).cloned()?;
        // The latest first: it may have replaced a damaged one.
        places.iter().rev().find_map(|place| {
            let mut line = vec![0; place.length];
            File::open(&place.file).ok()?.read_exact_at(&mut line, place.offset).ok()?;
            let record: KeyRecord = serde_json::from_slice(&line).ok()?;
            (record.key == key && record.is_whole()).then_some(record)
        })
    }

    /// Brings the index up to date with the folder.
    fn list(&self) {
        // Locked first: what is written meanwhile would be in the index and not in the list, as if it had been removed.
        let mut index = self.lock();
        let present: BTreeSet<Arc<Path>> =
            self.files().unwrap_or_default().into_iter().map(Arc::from).collect();
        index.listed = Some(Instant::now());
        if !index.files.is_subset(&present) {
            (index.files, index.places) = (BTreeSet::new(), HashMap::new());
        }
        for file in &present {
            if !index.files.contains(file)
                && let Ok(text) = fs::read(file)
            {
                index.add(file, &text);
            }
        }
    }

    /// Writes records in a file of their own.
    ///
    /// # Errors
    /// When the disk is full or not writable.
    pub fn add(&self, records: &[KeyRecord]) -> Result<()> {
        let mut text = Vec::new();
        for record in records {
            serde_json::to_writer(&mut text, record)?;
            text.push(b'\n');
        }
        let file = self.folder.join(format!("{}.jsonl", ContentHash::of(&text)));
        write_atomically(&file, &text)?;
        self.lock().add(&Arc::from(file), &text);
        Ok(())
    }

    /// All undamaged records, by file.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn all(&self) -> Result<Vec<(PathBuf, Vec<KeyRecord>)>> {
        let read = |file: PathBuf| {
            let text = fs::read(&file).ok()?;
            let records = lines(&text).filter_map(Result::ok).collect();
            Some((file, records))
        };
        Ok(self.files()?.into_iter().filter_map(read).collect())
    }

    /// All undamaged records of jobs of these kinds.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn of_kinds(&self, kinds: &[&str]) -> Result<Vec<KeyRecord>> {
        let starts: Vec<String> =
            kinds.iter().map(|kind| format!(r#"","fingerprint":{{"kind":"{kind}","#)).collect();
        // Most records are of other kinds, and not parsed.
        let is_wanted = |line: &&[u8]| {
            let after_key = line.get(LINE_START.len() + KEY_LEN..).unwrap_or_default();
            starts.iter().any(|start| after_key.starts_with(start.as_bytes()))
        };
        let mut records = Vec::new();
        for file in self.files()? {
            let Ok(text) = fs::read(file) else { continue };
            let wanted = text.split(|&byte| byte == b'\n').filter(is_wanted);
            records.extend(wanted.filter_map(|line| record_of(line).ok()));
        }
        Ok(records)
    }

    /// Removes damaged records; returns the keys they seem to have, or the file and line where nothing is legible.
    ///
    /// # Errors
    /// When the folder cannot be listed or changed.
    pub fn remove_damaged(&self) -> Result<Vec<String>> {
        let mut damaged = Vec::new();
        for file in self.files()? {
            let Ok(text) = fs::read(&file) else { continue };
            let (mut whole, mut lost) = (Vec::new(), Vec::new());
            for line in lines(&text) {
                match line {
                    Ok(record) => whole.push(record),
                    Err(line) => lost.push(key_of(line).map_or_else(
                        || format!("a record in {}", file.display()),
                        |key| format!("the record of {key}"),
                    )),
                }
            }
            if !lost.is_empty() {
                self.replace(&file, &whole)?;
                damaged.append(&mut lost);
            }
        }
        Ok(damaged)
    }

    /// Removes the records of these keys, by file.
    ///
    /// # Errors
    /// When the folder cannot be changed.
    pub fn remove(&self, unwanted: &BTreeMap<PathBuf, BTreeSet<ContentHash>>) -> Result<()> {
        for (file, keys) in unwanted {
            let Ok(text) = fs::read(file) else { continue };
            let mut left: Vec<KeyRecord> = lines(&text).filter_map(Result::ok).collect();
            left.retain(|record| !keys.contains(&record.key));
            self.replace(file, &left)?;
        }
        Ok(())
    }

    /// Puts records in the place of a file.
    fn replace(&self, file: &Path, records: &[KeyRecord]) -> Result<()> {
        if !records.is_empty() {
            self.add(records)?;
        }
        remove(file)
    }

    fn files(&self) -> Result<Vec<PathBuf>> {
        let mut files = super::entries(&self.folder)?;
        // Others than ours, too, hide what they have not finished (as NFS and editors do).
        files.retain(|path| name_starts_with(path, ".") == Some(false));
        Ok(files)
    }

    fn lock(&self) -> MutexGuard<'_, Index> {
        // At worst a record is missed, and a job done again.
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Index {
    /// Notes where the records of a file are.
    fn add(&mut self, file: &Arc<Path>, text: &[u8]) {
        self.files.insert(Arc::clone(file));
        let mut offset = 0;
        for line in text.split_inclusive(|&byte| byte == b'\n') {
            if let Some(key) = key_of(line) {
                let place = Place { file: Arc::clone(file), offset, length: line.len() };
                self.places.entry(key).or_default().push(place);
            }
            offset += line.len() as u64;
        }
    }
}

/// The key that a line begins with.
fn key_of(line: &[u8]) -> Option<ContentHash> {
    let digits = line.strip_prefix(LINE_START)?.get(..KEY_LEN)?;
    ContentHash::try_from(String::from_utf8(digits.to_vec()).ok()?).ok()
}

/// The records of a file; a damaged one as its line.
fn lines(text: &[u8]) -> impl Iterator<Item = Result<KeyRecord, &[u8]>> {
    let lines = text.split(|&byte| byte == b'\n').filter(|line| !line.is_empty());
    lines.map(record_of)
}

/// The record of a line; a damaged one as the line.
fn record_of(line: &[u8]) -> Result<KeyRecord, &[u8]> {
    match serde_json::from_slice::<KeyRecord>(line) {
        Ok(record) if record.is_whole() => Ok(record),
        _ => Err(line),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(version: u32, file: &[u8]) -> KeyRecord {
        let (kind, params) = ("test".to_owned(), serde_json::json!({ "text": "a\nb" }));
        let fingerprint = Fingerprint { kind, version, params, inputs: BTreeMap::new() };
        KeyRecord::new(fingerprint, ContentHash::of(file), file, 0.5)
    }

    #[test]
    fn what_was_written_is_found_while_others_list_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let records = Records::at(folder.path().to_owned());
        let is_done = std::sync::atomic::AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !is_done.load(std::sync::atomic::Ordering::Relaxed) {
                    records.list();
                    std::thread::sleep(Duration::from_micros(100));
                }
            });
            let lost = (0..100).filter(|&version| {
                let written = record(version, b"small");
                records.add(std::slice::from_ref(&written)).unwrap();
                (0..20).any(|_| records.find_listed(written.key).is_none())
            });
            let lost = lost.count();
            is_done.store(true, std::sync::atomic::Ordering::Relaxed);
            assert_eq!(lost, 0);
        });
    }

    #[test]
    fn records_are_found_by_all_who_look_at_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let (here, there) = (Records::at(folder.path().to_owned()), Records::at(folder.path().to_owned()));
        let (small, large) = (record(1, b"small"), record(2, &[7; MAX_CONTENT + 1]));
        assert!(there.find(small.key).is_none());
        here.add(&[small.clone(), large.clone()]).unwrap();
        for records in [&here, &Records::at(folder.path().to_owned())] {
            assert_eq!(records.find(small.key).unwrap().content(), Some(&b"small"[..]));
            assert_eq!(records.find(large.key), Some(large.clone()));
        }
        // The list is young: the miss is not looked up again at once, but later.
        std::thread::sleep(LIST_AGE);
        assert_eq!(there.find(small.key), Some(small));
    }

    #[test]
    fn records_are_found_by_their_kind() {
        let folder = tempfile::tempdir().unwrap();
        let records = Records::at(folder.path().join("keys"));
        assert!(records.of_kinds(&["test"]).unwrap().is_empty());
        let (first, second) = (record(1, b"small"), record(2, &[7; MAX_CONTENT + 1]));
        records.add(&[first.clone(), second.clone()]).unwrap();
        assert_eq!(records.of_kinds(&["other", "test"]).unwrap(), [first, second]);
        assert!(records.of_kinds(&["other", "tes"]).unwrap().is_empty());
    }

    #[test]
    fn a_damaged_record_is_none_and_takes_no_other_along() {
        let folder = tempfile::tempdir().unwrap();
        let records = Records::at(folder.path().to_owned());
        let all: Vec<KeyRecord> = (0..3).map(|version| record(version, &[version as u8; 9])).collect();
        records.add(&all).unwrap();
        let file = records.files().unwrap().remove(0);
        let whole = fs::read(&file).unwrap();
        let second = whole.iter().position(|&byte| byte == b'\n').unwrap() + 1;
        for at in [second + 1, second + 20, second + 120, whole.len() / 2] {
            let mut damaged = whole.clone();
            damaged[at] ^= 1;
            fs::write(&file, damaged).unwrap();
            let again = Records::at(folder.path().to_owned());
            let found: Vec<bool> = all.iter().map(|record| again.find(record.key).is_some()).collect();
            assert_eq!(found, [true, false, true], "byte {at}");
        }
        assert_eq!(records.remove_damaged().unwrap().len(), 1);
        assert!(records.remove_damaged().unwrap().is_empty());
        let left: Vec<KeyRecord> =
            records.all().unwrap().into_iter().flat_map(|(_, records)| records).collect();
        assert_eq!(left, [all[0].clone(), all[2].clone()]);
        records.add(&all[1..2]).unwrap();
        assert_eq!(records.find(all[1].key).as_ref(), Some(&all[1]));
    }
}
