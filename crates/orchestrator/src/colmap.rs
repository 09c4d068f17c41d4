//! How COLMAP's models are laid out on disk, for export and import.

use anyhow::{Context, Result};

/// The parts of a model, a file each.
pub(crate) const PARTS: [&str; 3] = ["cameras", "images", "points3D"];
/// Further parts that COLMAP 4 writes, and does without.
pub(crate) const FURTHER_PARTS: [&str; 2] = ["rigs", "frames"];
/// Bytes of a 2D point in binary files: its place and the number of its 3D point.
pub(crate) const BYTES_OF_POINT_2D: usize = 24;
/// Stands for the 3D point of a 2D point that has none.
pub(crate) const NO_POINT: u64 = u64::MAX;

/// How a COLMAP model is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ColmapFormat {
    /// Little-endian numbers one after the other.
    Binary,
    /// Lines of fields parted by blanks; COLMAP reads no blanks in names of images there.
    Text,
}

impl ColmapFormat {
    /// The file of a part of a model.
    pub(crate) fn file(self, part: &str) -> String {
        let extension = match self {
            Self::Binary => "bin",
            Self::Text => "txt",
        };
        format!("{part}.{extension}")
    }
}

/// What is left to read of a binary file.
pub(crate) struct Bytes<'f> {
    pub(crate) left: &'f [u8],
}

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let (taken, left) = self.left.split_first_chunk().context("the file ends here: it is cut off")?;
        self.left = left;
        Ok(*taken)
    }

    pub(crate) fn skip(&mut self, count: u64) -> Result<()> {
        let left = usize::try_from(count).ok().and_then(|count| self.left.get(count..));
        self.left = left.with_context(|| format!("{count} bytes ought to follow: the file is cut off"))?;
        Ok(())
    }

    /// Up to the next zero.
    pub(crate) fn text(&mut self) -> Result<String> {
        let end = self.left.iter().position(|byte| *byte == 0).context("a name without an end")?;
        let text = String::from_utf8(self.left[..end].to_vec()).context("a name is not UTF-8")?;
        self.left = &self.left[end + 1..];
        Ok(text)
    }

    pub(crate) fn u64(&mut self) -> Result<u64> {
        self.take().map(u64::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Result<u32> {
        self.take().map(u32::from_le_bytes)
    }

    pub(crate) fn i32(&mut self) -> Result<i32> {
        self.take().map(i32::from_le_bytes)
    }

    pub(crate) fn f64(&mut self) -> Result<f64> {
        self.take().map(f64::from_le_bytes)
    }
}
