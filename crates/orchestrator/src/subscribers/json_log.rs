use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use anyhow::{Context, Result};

use crate::graph::{Event, Observer};

/// One JSON object a line for each event.
pub struct JsonLog(Mutex<BufWriter<File>>);

impl JsonLog {
    /// Begins a log in a new file.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self(Mutex::new(BufWriter::new(file))))
    }
}

impl Observer for JsonLog {
    fn notice(&self, event: &Event) {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // The log is for people; a full disk shows where results are written.
        if let Ok(line) = serde_json::to_string(event) {
            let _ = writeln!(file, "{line}");
        }
        if *event == Event::Ended {
            let _ = file.flush();
        }
    }
}
