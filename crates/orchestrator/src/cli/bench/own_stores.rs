use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::Result;

use crate::print;
use crate::store::write_error;

/// Begins the names of the folders.
const PREFIX: &str = ".bench-cache-";

/// Stores that a benchmark makes in its output folders for one command.
///
/// They stay where the command ends before its time, and the next one goes on with them. Which ones are in use, locks on their folders
/// tell: the system lifts these with a process, however that ends.
#[derive(Default)]
pub struct OwnStores(Vec<OwnStore>);

struct OwnStore {
    folder: PathBuf,
    _lock: File,
}

impl OwnStores {
    /// The folder of a store in an output folder: one that an earlier command has left there, else a new one.
    ///
    /// # Errors
    /// When none can be made.
    pub fn add(&mut self, output: &Path) -> Result<PathBuf> {
        let mut left = left_in(output).into_iter();
        let store = match left.next() {
            Some(store) => {
                let folder = store.folder.display();
                print::note(&format!(
                    "note: results of a run that came to no end are used ({folder}): times are not those of the whole work"
                ));
                store
            }
            None => new_in(output)?,
        };
        // Of several one is enough.
        left.for_each(OwnStore::remove);
        let folder = store.folder.clone();
        self.0.push(store);
        Ok(folder)
    }

    /// Removes them, as far as that can be done.
    pub fn remove(self) {
        self.0.into_iter().for_each(OwnStore::remove);
    }
}

impl OwnStore {
    /// A folder that no other process uses.
    fn lock(folder: PathBuf) -> Option<Self> {
        let lock = File::open(&folder).ok()?;
        lock.try_lock().ok()?;
        // Who had the lock before may have removed it.
        folder.is_dir().then_some(Self { folder, _lock: lock })
    }

    fn remove(self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

/// The stores in a folder that no process uses; by name.
fn left_in(output: &Path) -> Vec<OwnStore> {
    let entries = std::fs::read_dir(output).into_iter().flatten().flatten();
    let is_store = |path: &PathBuf| {
        path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(PREFIX.as_bytes()))
    };
    let mut folders: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(is_store).collect();
    folders.sort();
    folders.into_iter().filter_map(OwnStore::lock).collect()
}

fn new_in(output: &Path) -> Result<OwnStore> {
    loop {
        let made = tempfile::Builder::new().prefix(PREFIX).tempdir_in(output);
        let folder = made.map_err(|error| write_error(error, output))?.keep();
        let lock = File::open(&folder).map_err(|error| write_error(error, &folder))?;
        // Where the file system knows no locks, or another process was faster and has not found anything in it.
        match lock.try_lock() {
            Err(std::fs::TryLockError::WouldBlock) => {}
            _ if folder.is_dir() => return Ok(OwnStore { folder, _lock: lock }),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stores_in(output: &Path) -> usize {
        std::fs::read_dir(output).unwrap().count()
    }

    #[test]
    fn what_a_stopped_run_leaves_is_used_by_the_next_and_not_by_one_beside() {
        let output = tempfile::tempdir().unwrap();
        let output = output.path();
        let (mut first, mut beside) = (OwnStores::default(), OwnStores::default());
        let left = first.add(output).unwrap();
        assert_ne!(beside.add(output).unwrap(), left);
        drop(first);
        let mut next = OwnStores::default();
        assert_eq!(next.add(output).unwrap(), left);
        assert_eq!(stores_in(output), 2);
        next.remove();
        assert_eq!(stores_in(output), 1);
        beside.remove();
        assert_eq!(stores_in(output), 0);
    }

    #[test]
    fn of_several_that_were_left_one_stays() {
        let output = tempfile::tempdir().unwrap();
        let output = output.path();
        for name in ["a", "b", "c"] {
            std::fs::create_dir_all(output.join(format!("{PREFIX}{name}/objects"))).unwrap();
        }
        let mut stores = OwnStores::default();
        assert_eq!(stores.add(output).unwrap(), output.join(format!("{PREFIX}a")));
        assert_eq!(stores_in(output), 1);
        stores.remove();
        assert_eq!(stores_in(output), 0);
    }
}
