use std::fs::File;
use std::io::{LineWriter, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use anyhow::Result;

use crate::graph::{Event, Observer};
use crate::store::write_error;

/// One JSON object a line for each event, written at once: a killed run leaves its log.
pub struct JsonLog(Mutex<LineWriter<File>>);

impl JsonLog {
    /// Begins a log in a new file.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).map_err(|error| write_error(error, path))?;
        Ok(Self(Mutex::new(LineWriter::new(file))))
    }
}

impl Observer for JsonLog {
    fn notice(&self, event: &Event) {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // The log is for people; a full disk shows where results are written.
        if let Ok(line) = serde_json::to_string(event) {
            let _ = writeln!(file, "{line}");
        }
    }
}
