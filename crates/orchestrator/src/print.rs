//! The only place that writes to the terminal: data to standard output, words for people to standard error.

use std::io::Write;

/// A line of data.
pub fn data(text: &str) {
    // A closed pipe, as of `setloc … | head`, is no error of ours.
    let _ = writeln!(std::io::stdout().lock(), "{text}");
}

/// A line for people.
pub fn note(text: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}
