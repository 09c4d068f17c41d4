use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use setloc_features::Wgs84;

use super::find_by_name;
use crate::error::Hinted;

/// Where measured positions come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GeoSource {
    /// Nowhere.
    None,
    /// From each image's EXIF.
    Exif,
    /// From a table `name,lat,lon,alt`.
    Table(PathBuf),
}

/// Measured positions by image.
#[derive(Debug, Clone, Default)]
pub struct GeoBook {
    by_image: BTreeMap<String, Wgs84>,
}

impl GeoBook {
    /// Reads a `geo.csv`: a header line `name,lat,lon,alt`, then one image a line; `alt` may be missing.
    ///
    /// # Errors
    /// With file and line.
    pub fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {shown}"))?;
        let mut by_image = BTreeMap::new();
        for (at, line) in text.lines().enumerate().skip(1).filter(|(_, line)| !line.trim().is_empty()) {
            let fields: Vec<&str> = line.split(',').map(str::trim).collect();
            let number = |i: usize| fields.get(i).and_then(|text| text.parse::<f64>().ok());
            let place = match (number(1), number(2)) {
                (Some(lat), Some(lon)) => Wgs84 { lat, lon, alt: number(3).unwrap_or(0.0) },
                _ => Wgs84 { lat: f64::NAN, lon: f64::NAN, alt: 0.0 },
            };
            if !place.is_valid() {
                let message = format!("{shown}, line {}: `{line}` is no position", at + 1);
                return Err(Hinted::error(
                    message,
                    "each line is name,lat,lon,alt in WGS84 degrees and metres",
                ));
            }
            by_image.insert(fields[0].to_owned(), place);
        }
        Ok(Self { by_image })
    }

    /// The position of an image, if the table names it.
    pub fn find(&self, name: &str, path: &Path) -> Option<Wgs84> {
        find_by_name(&self.by_image, name, path).copied()
    }
}
