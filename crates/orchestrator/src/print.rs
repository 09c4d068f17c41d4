//! The only place that writes to the terminal: data to standard output, words for people to standard error.

use std::io::{ErrorKind, Write};

use anyhow::Result;

use crate::error::Hinted;

/// A line of data.
///
/// # Errors
/// When it cannot be written, as where standard output is a file on a full disk. A closed pipe, as of `setloc … | head`, is
/// none: who reads has enough.
pub fn data(text: &str) -> Result<()> {
    let mut output = std::io::stdout().lock();
    match writeln!(output, "{text}").and_then(|()| output.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            let error = anyhow::Error::new(error).context("cannot write to standard output");
            Err(Hinted::wrap(error, "what is printed is incomplete: print it to where there is space"))
        }
        _ => Ok(()),
    }
}

/// A line for people; names in it may have characters that would command their terminal, and are shown without.
pub fn note(text: &str) {
    let commands = |c: char| c.is_control() && c != '\n' && c != '\t';
    let _ = writeln!(std::io::stderr().lock(), "{}", text.replace(commands, "_"));
}
