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

/// Most names in a line of images.
pub const MOST_NAMED: usize = 20;

/// The first of some names in a line, and how many more there are.
pub fn listed(names: &[impl AsRef<str>], most: usize) -> String {
    let (named, rest) = names.split_at(names.len().min(most));
    let named: Vec<&str> = named.iter().map(AsRef::as_ref).collect();
    let others = match rest.len() {
        0 => String::new(),
        1 => " and 1 other".to_owned(),
        more => format!(" and {more} others"),
    };
    named.join(", ") + &others
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_of_names_are_cut() {
        let names: Vec<String> = (0..23).map(|number| format!("{number}.jpg")).collect();
        assert_eq!(listed(&names[..2], MOST_NAMED), "0.jpg, 1.jpg");
        assert_eq!(listed(&names[..3], 2), "0.jpg, 1.jpg and 1 other");
        assert!(listed(&names, MOST_NAMED).ends_with("18.jpg, 19.jpg and 3 others"));
    }
}
