//! Errors that say what to try next.

use std::fmt;
use std::io::{self, ErrorKind};

/// An error with the next thing to try.
#[derive(Debug)]
pub struct Hinted {
    error: anyhow::Error,
    hint: String,
}

impl Hinted {
    /// Adds a hint to an error.
    pub fn wrap(error: anyhow::Error, hint: impl Into<String>) -> anyhow::Error {
        anyhow::Error::new(Self { error, hint: hint.into() })
    }

    /// A new error with a hint.
    pub fn error(
        message: impl fmt::Display + fmt::Debug + Send + Sync + 'static,
        hint: impl Into<String>,
    ) -> anyhow::Error {
        Self::wrap(anyhow::Error::msg(message), hint)
    }

    /// What to try next.
    pub fn hint(&self) -> &str {
        &self.hint
    }
}

impl fmt::Display for Hinted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.error.fmt(f)
    }
}

impl std::error::Error for Hinted {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.error.source()
    }
}

/// Whether an error will meet every other job too: the disk is full or cannot be written.
pub fn concerns_the_disk(error: &anyhow::Error) -> bool {
    error.chain().filter_map(|cause| cause.downcast_ref::<io::Error>()).any(|cause| {
        matches!(
            cause.kind(),
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::ReadOnlyFilesystem
        )
    })
}

/// The user stopped the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped; everything finished is kept, the same command continues")]
pub struct Interrupted;
