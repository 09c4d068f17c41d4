//! Text put together piece by piece.

use std::fmt::{Arguments, Write};

/// Adds a formatted piece; writing to a string cannot fail.
pub fn add(text: &mut String, piece: Arguments<'_>) {
    let _ = text.write_fmt(piece);
}
