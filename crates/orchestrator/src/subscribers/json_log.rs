use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use anyhow::Result;

use crate::graph::{Event, Observer};
use crate::store::write_error;

/// One JSON object a line for each event, written at once: a killed run leaves its log, and two runs at once leave whole lines.
pub struct JsonLog(Mutex<File>);

impl JsonLog {
    /// Begins a log in a new file.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: &Path) -> Result<Self> {
        let begin = || -> std::io::Result<File> {
            let file = OpenOptions::new().create(true).append(true).open(path)?;
            file.set_len(0)?;
            Ok(file)
        };
        Ok(Self(Mutex::new(begin().map_err(|error| write_error(error, path))?)))
    }
}

impl Observer for JsonLog {
    fn notice(&self, event: &Event) {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // The log is for people; a full disk shows where results are written.
        if let Ok(line) = serde_json::to_string(event) {
            let _ = file.write_all((line + "\n").as_bytes());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_two_runs_at_once_are_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.jsonl");
        std::fs::write(&path, "of an earlier run").unwrap();
        let logs = [JsonLog::create(&path).unwrap(), JsonLog::create(&path).unwrap()];
        for at in 0..20 {
            logs[at % 2].notice(&Event::Note { text: "a".repeat(at) });
        }
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().count(), 20);
        assert!(text.lines().all(|line| serde_json::from_str::<serde_json::Value>(line).is_ok()), "{text}");
    }
}
