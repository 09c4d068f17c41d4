//! Plots as inline SVG: self-contained, no script, readable in print.

use crate::text::add;

/// Width of every plot in pixels.
const WIDTH: f64 = 560.0;
/// Height of plots with axes.
const HEIGHT: f64 = 300.0;
/// Space for the labels at the left.
const LEFT: f64 = 70.0;
/// Space at the other sides.
const MARGIN: f64 = 34.0;
/// Colours that colour-blind readers can tell apart (Okabe and Ito), in the order of the series.
const COLORS: [&str; 5] = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#666666"];

/// Text for HTML and SVG.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            c => out.push(c),
        }
    }
    out
}

/// Errors whose distribution is drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Recall {
    /// Name in the legend.
    pub label: String,
    /// Errors of those that have one.
    pub errors: Vec<f64>,
    /// How many there are in all.
    pub total: usize,
}

/// Shares of images whose error is at most x, over a logarithmic x axis.
pub fn recall_curves(title: &str, unit: &str, curves: &[Recall]) -> String {
    let all = curves.iter().flat_map(|curve| curve.errors.iter().copied());
    let Some(x) = Decades::around(all) else { return String::new() };
    let mut body = String::new();
    axes(&mut body, &x, unit, true);
    let y = |share: f64| HEIGHT - MARGIN - share * (HEIGHT - 2.0 * MARGIN);
    for percent in [0.0, 25.0, 50.0, 75.0, 100.0] {
        grid_line(&mut body, y(percent / 100.0), &format!("{percent} %"));
    }
    for (curve, color) in curves.iter().zip(COLORS.iter().cycle()) {
        let mut errors = curve.errors.clone();
        errors.sort_by(f64::total_cmp);
        let mut path = format!("M{:.1} {:.1}", x.low_px(), y(0.0));
        for (at, error) in errors.iter().enumerate() {
            let share = (at + 1) as f64 / curve.total.max(1) as f64;
            add(&mut path, format_args!("H{:.1}V{:.1}", x.px(*error), y(share)));
        }
        add(&mut path, format_args!("H{:.1}", x.high_px()));
        let label = escape(&curve.label);
        add(
            &mut body,
            format_args!(
                "<path d='{path}' fill='none' stroke='{color}' stroke-width='2'><title>{label}</title></path>"
            ),
        );
    }
    legend(&mut body, curves.iter().map(|curve| curve.label.as_str()));
    svg(title, HEIGHT, &body)
}

/// Values of one method, by item.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub label: String,
    /// A value for each item that has one.
    pub values: Vec<Option<f64>>,
}

/// A dot for each item and series, over a logarithmic y axis; items without a value have a cross at the top.
pub fn dots(title: &str, unit: &str, items: &[String], series: &[Series]) -> String {
    let all = series.iter().flat_map(|series| series.values.iter().flatten().copied());
    let Some(y) = Decades::around(all).map(|axis| axis.upright()) else { return String::new() };
    let mut body = String::new();
    axes(&mut body, &y, unit, false);
    let step = (WIDTH - LEFT - MARGIN) / items.len().max(1) as f64;
    for (number, (series, color)) in series.iter().zip(COLORS.iter().cycle()).enumerate() {
        for (at, (item, value)) in items.iter().zip(&series.values).enumerate() {
            let x = LEFT + (at as f64 + 0.3 + 0.2 * number as f64) * step;
            let (item, label) = (escape(item), escape(&series.label));
            match value {
                Some(value) => add(
                    &mut body,
                    format_args!(
                        "<circle cx='{x:.1}' cy='{:.1}' r='3.5' fill='{color}'><title>{item}, {label}: {value:.4} {unit}</title></circle>",
                        y.px(*value)
                    ),
                ),
                None => add(
                    &mut body,
                    format_args!(
                        "<text x='{x:.1}' y='{:.1}' fill='{color}' text-anchor='middle'>×<title>{item}, {label}: none</title></text>",
                        MARGIN - 4.0
                    ),
                ),
            }
        }
    }
    for at in (0..items.len()).step_by(items.len().div_ceil(20).max(1)) {
        let x = LEFT + (at as f64 + 0.5) * step;
        add(
            &mut body,
            format_args!(
                "<text x='{x:.1}' y='{:.1}' text-anchor='middle'>{at}</text>",
                HEIGHT - MARGIN + 15.0
            ),
        );
    }
    legend(&mut body, series.iter().map(|series| series.label.as_str()));
    svg(title, HEIGHT, &body)
}

/// A horizontal bar for each value.
pub fn bars(title: &str, unit: &str, values: &[(String, f64)]) -> String {
    let most = values.iter().map(|(_, value)| *value).fold(0.0, f64::max);
    if !(most > 0.0) {
        return String::new();
    }
    let mut body = String::new();
    for (at, (label, value)) in values.iter().enumerate() {
        let y = MARGIN + 22.0 * at as f64;
        let length = value / most * (WIDTH - 110.0 - 90.0);
        add(
            &mut body,
            format_args!(
                "<text x='102' y='{:.1}' text-anchor='end'>{}</text><rect x='108' y='{y:.1}' width='{length:.1}' height='16' fill='{}'/><text x='{:.1}' y='{:.1}'>{value:.2} {unit}</text>",
                y + 12.5,
                escape(label),
                COLORS[0],
                114.0 + length,
                y + 12.5
            ),
        );
    }
    svg(title, MARGIN + 22.0 * values.len() as f64 + 6.0, &body)
}

/// A logarithmic axis over whole decades.
struct Decades {
    low: i32,
    high: i32,
    from_px: f64,
    to_px: f64,
}

impl Decades {
    /// A horizontal axis around all positive values, `None` without one.
    fn around(values: impl Iterator<Item = f64>) -> Option<Self> {
        let positive = values.filter(|value| *value > 0.0 && value.is_finite());
        let (low, high) = positive
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        let low = low.is_finite().then(|| low.log10().floor() as i32)?;
        let high = (high.log10().ceil() as i32).max(low + 1);
        Some(Self { low, high, from_px: LEFT, to_px: WIDTH - MARGIN })
    }

    /// The same axis upwards.
    fn upright(&self) -> Self {
        Self { from_px: HEIGHT - MARGIN, to_px: MARGIN, ..*self }
    }

    fn px(&self, value: f64) -> f64 {
        let low = f64::from(self.low);
        let share = (value.max(f64::MIN_POSITIVE).log10() - low) / (f64::from(self.high) - low);
        self.from_px + share.clamp(0.0, 1.0) * (self.to_px - self.from_px)
    }

    fn low_px(&self) -> f64 {
        self.from_px
    }

    fn high_px(&self) -> f64 {
        self.to_px
    }
}

/// Lines and labels at each decade, along x or up y.
fn axes(body: &mut String, axis: &Decades, unit: &str, horizontal: bool) {
    for exponent in axis.low..=axis.high {
        let value = 10_f64.powi(exponent);
        let at = axis.px(value);
        if horizontal {
            let bottom = HEIGHT - MARGIN;
            add(
                body,
                format_args!(
                    "<line x1='{at:.1}' y1='{MARGIN}' x2='{at:.1}' y2='{bottom}' stroke='#ddd'/><text x='{at:.1}' y='{:.1}' text-anchor='middle'>{value} {unit}</text>",
                    bottom + 15.0
                ),
            );
        } else {
            grid_line(body, at, &format!("{value} {unit}"));
        }
    }
}

fn grid_line(body: &mut String, y: f64, label: &str) {
    add(
        body,
        format_args!(
            "<line x1='{LEFT}' y1='{y:.1}' x2='{:.1}' y2='{y:.1}' stroke='#ddd'/><text x='{:.1}' y='{:.1}' text-anchor='end'>{}</text>",
            WIDTH - MARGIN,
            LEFT - 5.0,
            y + 4.0,
            escape(label)
        ),
    );
}

fn legend<'l>(body: &mut String, labels: impl Iterator<Item = &'l str>) {
    let mut x = LEFT;
    for (label, color) in labels.zip(COLORS.iter().cycle()) {
        add(
            body,
            format_args!(
                "<rect x='{x:.1}' y='{:.1}' width='10' height='10' fill='{color}'/><text x='{:.1}' y='{:.1}'>{}</text>",
                HEIGHT - 11.0,
                x + 14.0,
                HEIGHT - 2.0,
                escape(label)
            ),
        );
        x += 30.0 + 7.0 * label.chars().count() as f64;
    }
}

fn svg(title: &str, height: f64, body: &str) -> String {
    format!(
        "<svg viewBox='0 0 {WIDTH} {height}' width='{WIDTH}' height='{height}' role='img' font-family='sans-serif' font-size='11'><text x='{LEFT}' y='14' font-size='13' font-weight='bold'>{}</text>{body}</svg>\n",
        escape(title)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_break_out_of_the_page() {
        let curve = Recall { label: "<script>'\"&".to_owned(), errors: vec![0.1], total: 1 };
        let plot = recall_curves("a < b", "m", &[curve]);
        assert!(!plot.contains("<script") && plot.contains("a &lt; b"), "{plot}");
    }

    #[test]
    fn a_recall_curve_ends_at_the_share_of_those_that_have_an_error() {
        let curve = Recall { label: "half".to_owned(), errors: vec![0.5, 0.05], total: 4 };
        let plot = recall_curves("recall", "m", &[curve]);
        let half = HEIGHT - MARGIN - 0.5 * (HEIGHT - 2.0 * MARGIN);
        assert!(plot.contains(&format!("V{half:.1}H{:.1}", WIDTH - MARGIN)), "{plot}");
    }

    #[test]
    fn nothing_to_show_is_no_plot() {
        assert!(recall_curves("t", "m", &[]).is_empty());
        assert!(dots("t", "m", &[], &[]).is_empty());
        assert!(bars("t", "s", &[("a".to_owned(), 0.0)]).is_empty());
    }

    #[test]
    fn decades_span_the_values() {
        let axis = Decades::around([0.02, 3.0, f64::NAN, 0.0].into_iter()).unwrap();
        assert_eq!((axis.low, axis.high), (-2, 1));
        assert!(axis.px(0.02) < axis.px(3.0) && axis.px(1e9) == axis.high_px());
        assert!(axis.upright().px(0.02) > axis.upright().px(3.0));
    }
}
