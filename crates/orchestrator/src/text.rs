//! Text put together piece by piece.

use std::fmt::{Arguments, Write};

/// Adds a formatted piece; writing to a string cannot fail.
pub fn add(text: &mut String, piece: Arguments<'_>) {
    let _ = text.write_fmt(piece);
}

/// Where a pose is that is not in the frame of the largest component; components count from 1.
pub fn apart(component: usize) -> String {
    format!("in component {}, apart from the largest: its frame is its own", component + 1)
}

/// So many of a list are named, the others are counted.
const NAMED: usize = 3;

/// The first of a list, and how many more there are.
pub fn some_of(list: &[String], nouns: &str) -> String {
    let named = list[..list.len().min(NAMED)].join("; ");
    match list.len().saturating_sub(NAMED) {
        0 => named,
        more => format!("{named}; {more} more {nouns}"),
    }
}
