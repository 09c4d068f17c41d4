//! Pages that need nothing outside themselves.

use crate::plot::escape;

const STYLE: &str = "body{font:15px/1.5 sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#222}\
table{border-collapse:collapse;margin:.6em 0}td,th{border:1px solid #ccc;padding:.2em .6em;text-align:left;\
vertical-align:top}th{background:#f3f3f3}.good{background:#dff3e4}.bad{background:#fbdcdc}.weak{background:#fdf1d0}\
svg,img{max-width:100%;height:auto;margin:.4em 1em .4em 0}summary{cursor:pointer}";

/// A page of this title around HTML.
pub fn page(title: &str, body: &str) -> String {
    let title = escape(title);
    format!(
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'><title>{title}</title><style>{STYLE}</style></head>\n<body><h1>{title}</h1>\n{body}\n</body></html>\n"
    )
}

/// A cell of a table.
pub fn cell(text: &str) -> String {
    format!("<td>{}</td>", escape(text))
}

/// A table of cells that are HTML already.
pub fn table(head: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let mut text = String::from("<table><tr>");
    for name in head {
        text += "<th>";
        text += &escape(name);
        text += "</th>";
    }
    text += "</tr>\n";
    for cells in rows {
        text += "<tr>";
        text += &cells.concat();
        text += "</tr>\n";
    }
    text + "</table>\n"
}
