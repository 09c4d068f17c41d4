use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::{Digest, ImageRow, Standing};
use crate::html::{cell, page, table};
use crate::plot::{bars, escape};
use crate::text::add;

impl Digest {
    /// For a terminal.
    pub fn to_text(&self) -> String {
        let mut text = format!("{}\n{}\n", self.title, self.headline);
        for image in &self.images {
            let mark = if image.is_target { " (target)" } else { "" };
            add(&mut text, format_args!("{}{mark}\t{}\t{}", image.name, image.verdict, image.evidence));
            if !image.reasons.is_empty() {
                add(&mut text, format_args!("\t{}", image.reasons.join("; ")));
            }
            text.push('\n');
        }
        for (word, lines) in [("warning", &self.warnings), ("note", &self.notes), ("advice", &self.advice)] {
            for line in lines {
                add(&mut text, format_args!("{word}: {line}\n"));
            }
        }
        for skipped in &self.skipped {
            add(&mut text, format_args!("skipped {}: {}\n", skipped.name, skipped.reason));
        }
        text
    }

    /// One page without anything outside it.
    pub fn to_html(&self) -> String {
        let mut body = format!("<p><b>{}</b></p>\n", escape(&self.headline));
        for (title, lines) in [("Warnings", &self.warnings), ("Notes", &self.notes), ("Advice", &self.advice)]
        {
            if !lines.is_empty() {
                add(&mut body, format_args!("<h2>{title}</h2>\n<ul>"));
                for line in lines {
                    add(&mut body, format_args!("<li>{}</li>\n", escape(line)));
                }
                body += "</ul>\n";
            }
        }
        if let Some(png) = &self.top_view {
            add(
                &mut body,
                format_args!(
                    "<h2>From above</h2>\n<p>Blue: the scene's images. Green: photos that it has grown by. Orange: photos. Red: the target. Violet: photos whose poses are uncertain. What is in a component with a frame of its own is not shown.</p><img alt='top view' src='data:image/png;base64,{}'>\n",
                    STANDARD.encode(png)
                ),
            );
        }
        body += "<h2>Images</h2>\n";
        body += &table(&["image", "verdict", "evidence", "why"], self.images.iter().map(row));
        if !self.skipped.is_empty() {
            body += "<h2>Skipped</h2>\n";
            let rows = self.skipped.iter().map(|skipped| vec![cell(&skipped.name), cell(&skipped.reason)]);
            body += &table(&["image", "reason"], rows);
        }
        let stages: Vec<(String, f64)> =
            self.stages.iter().map(|stage| (stage.name.clone(), stage.cpu_s)).collect();
        body += &bars("CPU time by stage", "s", &stages);
        page(&self.title, &body)
    }
}

fn row(image: &ImageRow) -> Vec<String> {
    let class = match image.standing {
        Standing::Good => "good",
        Standing::Weak => "weak",
        Standing::Bad => "bad",
    };
    let name = if image.is_target { format!("{} (target)", image.name) } else { image.name.clone() };
    let verdict = format!("<td class='{class}'>{}</td>", escape(&image.verdict));
    vec![cell(&name), verdict, cell(&image.evidence), cell(&image.reasons.join("; "))]
}
