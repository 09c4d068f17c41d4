use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use setloc_features::GeoPosition;

use super::{SourceImage, find_by_name, shared};
use crate::error::Hinted;
use crate::text::{read_text, some_of};

/// Metres above the ellipsoid at which there is anything to be photographed.
const ALTITUDES_M: RangeInclusive<f64> = -1000.0..=100_000.0;

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
    /// Where they were read from.
    file: PathBuf,
    by_image: BTreeMap<String, GeoPosition>,
}

/// Where in a line the fields are, counted from 0.
#[derive(Debug, Clone, Copy)]
struct Columns {
    name: usize,
    lat: usize,
    lon: usize,
    alt: Option<usize>,
}

impl Columns {
    /// Those of a table without a header.
    const UNNAMED: Self = Self { name: 0, lat: 1, lon: 2, alt: Some(3) };

    /// Those that a header names.
    fn named(header: &[&str]) -> Result<Self> {
        let names: Vec<String> = header.iter().map(|name| name.to_lowercase()).collect();
        for (at, name) in names.iter().enumerate() {
            let known = ["name", "lat", "lon", "alt"].contains(&name.as_str());
            anyhow::ensure!(known, "unknown column `{}`", header[at]);
            anyhow::ensure!(!names[..at].contains(name), "two columns `{name}`");
        }
        let place = |wanted: &str| names.iter().position(|name| name == wanted);
        let needed = |wanted: &str| place(wanted).with_context(|| format!("no column `{wanted}`"));
        Ok(Self { name: needed("name")?, lat: needed("lat")?, lon: needed("lon")?, alt: place("alt") })
    }

    /// How many there are.
    fn count(self) -> usize {
        if self.alt.is_some() { 4 } else { 3 }
    }

    /// The image and its position in a line.
    fn read(self, fields: &[&str]) -> Option<(String, GeoPosition)> {
        let field = |at: usize| fields.get(at).copied().unwrap_or_default();
        let number = |at: usize| field(at).parse::<f64>().ok();
        let alt_m = match self.alt {
            Some(at) if !field(at).is_empty() => Some(number(at)?),
            _ => None,
        };
        let place = GeoPosition { lat_deg: number(self.lat)?, lon_deg: number(self.lon)?, alt_m };
        let name = field(self.name);
        let is_plausible = place.is_valid() && alt_m.is_none_or(|alt| ALTITUDES_M.contains(&alt));
        (is_plausible && !name.is_empty()).then(|| (name.to_owned(), place))
    }
}

/// The fields of a line, without the blanks about them; in quotes, which are written twice there, they may have commas (RFC 4180).
/// `None` where a quote has no end, or is followed by anything but a comma.
fn fields_of(line: &str) -> Option<Vec<String>> {
    let (mut fields, mut rest) = (Vec::new(), line);
    loop {
        rest = rest.trim_start();
        let mut field = String::new();
        if let Some(mut quoted) = rest.strip_prefix('"') {
            loop {
                let (part, behind) = quoted.split_once('"')?;
                field += part;
                let Some(further) = behind.strip_prefix('"') else {
                    rest = behind.trim_start();
                    break;
                };
                field.push('"');
                quoted = further;
            }
        } else {
            let end = rest.find(',').unwrap_or(rest.len());
            rest[..end].trim_end().clone_into(&mut field);
            rest = &rest[end..];
        }
        fields.push(field);
        match rest.strip_prefix(',') {
            Some(further) => rest = further,
            None => return rest.is_empty().then_some(fields),
        }
    }
}

impl GeoBook {
    /// Reads a `geo.csv`: one image a line, `name,lat,lon,alt`; `alt` may be missing. A first line of these names, in
    /// any order, tells the columns.
    ///
    /// # Errors
    /// With file and line.
    pub fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = read_text(path)?;
        let mut columns = None;
        let mut by_image: BTreeMap<String, GeoPosition> = BTreeMap::new();
        let mut line_of = BTreeMap::new();
        for (at, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
            let wrong = |what: &str| {
                let message = format!("{shown}, line {}: {what}", at + 1);
                Hinted::error(message, "each line is name,lat,lon,alt in WGS84 degrees and metres")
            };
            let fields = fields_of(line).ok_or_else(|| wrong(&format!("`{line}` has a quote too many")))?;
            let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
            let known = match columns {
                Some(known) => known,
                None if fields.iter().skip(1).any(|field| field.parse::<f64>().is_ok()) => Columns::UNNAMED,
                None => {
                    let header = Columns::named(&fields);
                    let no_header = |error| wrong(&format!("`{line}` is no header: {error}"));
                    columns = Some(header.map_err(no_header)?);
                    continue;
                }
            };
            columns = Some(known);
            if fields.iter().skip(known.count()).any(|field| !field.is_empty()) {
                let (found, count) = (fields.len(), known.count());
                let message =
                    format!("{shown}, line {}: {found} fields in {count} columns: `{line}`", at + 1);
                let hint = "write numbers with a decimal point, and names with commas in quotes";
                return Err(Hinted::error(message, hint));
            }
            let (name, place) =
                known.read(&fields).ok_or_else(|| wrong(&format!("`{line}` is no position")))?;
            let first = *line_of.entry(name.clone()).or_insert(at + 1);
            if by_image.get(&name).is_some_and(|before| *before != place) {
                let message = format!("{shown}: lines {first} and {} place `{name}` differently", at + 1);
                return Err(Hinted::error(message, "leave one of them, or name the folders of two images"));
            }
            by_image.insert(name, place);
        }
        Ok(Self { file: path.to_owned(), by_image })
    }

    /// Checks that no line places several images.
    ///
    /// # Errors
    /// With the file, the line's name and the images.
    pub(super) fn check_one_image_each(&self, images: &[SourceImage]) -> Result<()> {
        let listed = |image: &SourceImage| Some(find_by_name(&self.by_image, &image.name, &image.path)?.0);
        let Some((name, images)) = shared(images, listed).into_iter().next() else { return Ok(()) };
        let message = format!(
            "{}: `{name}` names {} images, which cannot be in one place: {}",
            self.file.display(),
            images.len(),
            some_of(&images, "images")
        );
        Err(Hinted::error(message, format!("name their folders as well, as `{}`", images[0])))
    }

    /// The position of an image, if the table names it.
    pub fn find(&self, name: &str, path: &Path) -> Option<GeoPosition> {
        Some(*find_by_name(&self.by_image, name, path)?.1)
    }

    /// The first image that the table names.
    pub(super) fn first_name(&self) -> Option<&str> {
        self.by_image.keys().next().map(String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<GeoBook> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("geo.csv");
        std::fs::write(&path, text).unwrap();
        GeoBook::read(&path)
    }

    fn place(book: &GeoBook, name: &str) -> (f64, f64, Option<f64>) {
        let place = book.find(name, Path::new(name)).unwrap();
        (place.lat_deg, place.lon_deg, place.alt_m)
    }

    #[test]
    fn columns_are_read_by_the_names_of_the_header() {
        let book = read("\u{feff}Name, lon, lat, alt\r\np/a.png,8.5,47.25,400\r\n\r\np/b.png,8.5,47.5,\r\n")
            .unwrap();
        assert_eq!(place(&book, "p/a.png"), (47.25, 8.5, Some(400.0)));
        assert_eq!(place(&book, "p/b.png"), (47.5, 8.5, None));
        let book = read("lat,lon,name\n47.25,8.5,a.png\n").unwrap();
        assert_eq!(place(&book, "a.png"), (47.25, 8.5, None));
    }

    #[test]
    fn a_table_without_a_header_is_read_from_its_first_line() {
        let book = read("a.png,47.25,8.5,400\nb.png,47.5,8.5\n").unwrap();
        assert_eq!(place(&book, "a.png"), (47.25, 8.5, Some(400.0)));
        assert_eq!(place(&book, "b.png"), (47.5, 8.5, None));
    }

    #[test]
    fn an_image_that_is_placed_twice_is_an_error_with_its_lines() {
        let error = read("name,lat,lon\na.png,47,8\nb.png,47,8\na.png,47.5,8\n").unwrap_err();
        assert!(error.to_string().ends_with("geo.csv: lines 2 and 4 place `a.png` differently"), "{error}");
        assert!(read("a.png,47,8\na.png,47,8\n").is_ok());
    }

    #[test]
    fn what_is_no_header_or_no_number_is_named_with_its_line() {
        let said = |text: &str| read(text).unwrap_err().to_string();
        assert!(
            said("image,latitude,longitude\na,1,2\n").contains("line 1: `image,latitude,longitude` is no")
        );
        assert!(said("name,lat,lon,altitude\na,1,2,3\n").contains("unknown column `altitude`"));
        assert!(said("name,lat,alt\na,1,2\n").contains("no column `lon`"));
        assert!(said("name,lat,lon,lat\na,1,2,1\n").contains("two columns `lat`"));
        for wrong in [
            "a,4x,8,0",
            "a,47,,0",
            "a,47,8,high",
            "a,47",
            "a,47,8,nan",
            "a,91,8,0",
            ",47,8,0",
            "a,47,8,1e300",
            "\"a,47,8,0",
        ] {
            assert!(said(&format!("name,lat,lon,alt\n\n{wrong}\n")).contains("line 3: "), "{wrong}");
        }
        for wrong in ["a,4x,8,0", "a,47,8,high", "7,4x,8"] {
            assert!(said(&format!("{wrong}\n")).contains("line 1: "), "{wrong}");
        }
    }

    #[test]
    fn names_in_quotes_may_have_commas_and_quotes() {
        let book = read("name,lat,lon\n\"p, 1/a \"\"b\"\".png\" , 47.25 ,\"8.5\"\n").unwrap();
        assert_eq!(place(&book, "p, 1/a \"b\".png"), (47.25, 8.5, None));
        assert_eq!(fields_of("a,\"\",").unwrap(), ["a", "", ""]);
        assert_eq!(fields_of("\"a\"b,1"), None);
    }

    #[test]
    fn decimal_commas_are_refused_with_their_line() {
        for text in ["name,lat,lon,alt\na.png,47,25,8,5,400\n", "name,lat,lon\na.png,47,8,5\n"] {
            let error = read(text).unwrap_err();
            assert!(
                error.to_string().contains("geo.csv, line 2: ") && error.to_string().contains(" columns")
            );
            let hint = error.downcast_ref::<Hinted>().unwrap().hint();
            assert!(hint.starts_with("write numbers with a decimal point"), "{hint}");
        }
        // Spreadsheet programs leave empty columns behind.
        assert_eq!(place(&read("a.png,47,8,400,,\n").unwrap(), "a.png"), (47.0, 8.0, Some(400.0)));
    }
}
