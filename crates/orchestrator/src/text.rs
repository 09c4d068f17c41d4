//! Text read from files, and put together piece by piece.

use std::fmt::{Arguments, Write};
use std::path::Path;

use anyhow::{Context, Result};

use crate::error::Hinted;

/// The text of a file, without the byte order mark that some programs begin it with.
///
/// # Errors
/// With the file, when it cannot be read, or is a folder or no text.
pub fn read_text(path: &Path) -> Result<String> {
    let shown = path.display();
    if path.is_dir() {
        return Err(Hinted::error(
            format!("{shown} is a folder, and a file is to be read"),
            "name a file in it",
        ));
    }
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {shown}"))?;
    match String::from_utf8(bytes) {
        Ok(text) if !text.contains('\0') => Ok(match text.strip_prefix('\u{feff}') {
            Some(rest) => rest.to_owned(),
            None => text,
        }),
        _ => Err(Hinted::error(format!("{shown} is no text in UTF-8"), "save it as UTF-8")),
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_text_in_utf_8_is_read_with_or_without_its_mark() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("geo.csv");
        let read = |bytes: &[u8]| {
            std::fs::write(&file, bytes).unwrap();
            read_text(&file)
        };
        assert_eq!(read("\u{feff}gr\u{fc}n".as_bytes()).unwrap(), "gr\u{fc}n");
        assert_eq!(read(b"a").unwrap(), "a");
        // Latin-1, UTF-16 with its mark, and without.
        for other in [&b"gr\xfcn"[..], b"\xff\xfea\0", b"a\0"] {
            let error = read(other).unwrap_err();
            assert!(error.to_string().ends_with("geo.csv is no text in UTF-8"), "{error}");
            assert_eq!(error.downcast_ref::<Hinted>().unwrap().hint(), "save it as UTF-8");
        }
        let error = read_text(folder.path()).unwrap_err();
        assert!(error.to_string().ends_with("is a folder, and a file is to be read"), "{error}");
    }
}
