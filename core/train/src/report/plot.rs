//! Plots as SVG, inline or as files: axes with ticks and titles, lines, markers, bands of spread.

use super::legend::{CHARACTER, Entry, LINE, dashes, dots, drawn, wrapped};
use super::text::{html, short};
use std::fmt::Write;

/// Colours that stay apart for colour-blind readers and in print; beyond their number they repeat, with dots (`legend`).
pub const COLOURS: [&str; 12] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#5b3e96", "#8c510a", "#3f3f3f", "#b2182b", "#7a8c00", "#00796b"];

/// Size in pixels of the drawing, which scales with the page.
const WIDTH: f64 = 430.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 62.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 46.0;

/// Height of a line of a file's heading, and the width of a character there at most.
const HEADING_LINE: f64 = 17.0;
const HEADING_CHARACTER: f64 = 8.0;
/// Beside the note of a file.
const MARGIN: f64 = 8.0;
/// From a marker down to the dots of its training.
const TO_DOTS: f64 = 8.5;
const STYLE: &str = include_str!("plot.css");

/// One axis.
#[derive(Clone, Debug)]
pub struct Axis {
    /// What it shows, with the unit.
    pub title: String,
    /// Logarithmic where all values are positive and span more than a factor of eight.
    pub may_be_log: bool,
}

impl Axis {
    /// A linear axis.
    pub fn linear(title: impl Into<String>) -> Self {
        Self { title: title.into(), may_be_log: false }
    }
    /// An axis that is logarithmic where that helps.
    pub fn ranged(title: impl Into<String>) -> Self {
        Self { title: title.into(), may_be_log: true }
    }
}

/// A point with what is said of it.
#[derive(Clone, Debug)]
pub struct Point {
    pub x: f64,
    pub y: f64,
    /// Least and largest y over seeds.
    pub y_range: Option<(f64, f64)>,
    /// Shown when the mouse rests on it.
    pub hint: String,
}

/// Points of one kind.
#[derive(Clone, Debug)]
pub struct Series {
    /// Index of the training, which gives the colour out of [`COLOURS`] and the dots.
    pub colour: usize,
    /// Index of the [`marker`]; none for plain lines.
    pub marker: Option<usize>,
    /// Whether the points are joined.
    pub line: bool,
    pub points: Vec<Point>,
}

/// A plot.
#[derive(Clone, Debug)]
pub struct Plot {
    /// What it says, above it.
    pub title: String,
    pub x: Axis,
    pub y: Axis,
    pub series: Vec<Series>,
    /// Corners of a Pareto front, from left to right.
    pub front: Vec<(f64, f64)>,
    /// Below it; may be empty.
    pub note: String,
}

/// Maps values of an axis to pixels.
#[derive(Debug)]
pub(super) struct Scale {
    low: f64,
    high: f64,
    log: bool,
    from: f64,
    to: f64,
}

impl Scale {
    /// Covers `values` with a margin, between the pixels `from` and `to`.
    pub(super) fn new(values: impl Iterator<Item = f64>, may_be_log: bool, from: f64, to: f64) -> Self {
        let (mut low, mut high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            (low, high) = (0.0, 1.0);
        }
        let log = may_be_log && low > 0.0 && high > 8.0 * low;
        if log {
            let margin = (high / low).powf(0.06);
            (low, high) = (low / margin, high * margin);
        } else {
            let margin = if high > low { 0.06 * (high - low) } else { (0.05 * high.abs()).max(1e-3) };
            // Counts and times do not go below zero.
            let floor = if low >= 0.0 { 0.0 } else { f64::NEG_INFINITY };
            (low, high) = ((low - margin).max(floor), high + margin);
        }
        Self { low, high, log, from, to }
    }
    pub(super) fn at(&self, value: f64) -> f64 {
        let f = |v: f64| if self.log { v.max(f64::MIN_POSITIVE).ln() } else { v };
        self.from + (f(value) - f(self.low)) / (f(self.high) - f(self.low)) * (self.to - self.from)
    }
    /// Ticks with their labels.
    pub(super) fn ticks(&self) -> Vec<(f64, String)> {
        let power = |v: f64| v.abs().log10().floor();
        let label = |v: f64, step: f64| {
            if v == 0.0 || (1e-4..1e6).contains(&v.abs()) {
                return short(v, (-power(step)).clamp(0.0, 6.0) as usize);
            }
            // No more digits than the step has: its multiples are rounded.
            let digits = (power(v) - power(step)).clamp(0.0, 15.0) as usize;
            format!("{v:.digits$e}")
        };
        if !self.log {
            let step = nice_step((self.high - self.low) / 5.0);
            let (first, last) = ((self.low / step).ceil() as i64, (self.high / step).floor() as i64);
            return (first..=last.min(first + 20)).map(|i| (i as f64 * step, label(i as f64 * step, step))).collect();
        }
        // From the power below: a value of it may still lie inside.
        let decades = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        let within = |v: &f64| (self.low..=self.high).contains(v);
        let of = |digits: &[f64]| -> Vec<f64> { decades.clone().flat_map(|d| digits.iter().map(move |k| k * 10f64.powi(d))).filter(within).collect() };
        let mut values = of(&[1.0, 2.0, 5.0]);
        if values.len() > 7 {
            values = of(&[1.0]);
            let every = values.len().div_ceil(7);
            values = values.into_iter().step_by(every).collect();
        }
        values.into_iter().map(|v| (v, label(v, 10f64.powf(power(v))))).collect()
    }
}

/// 1, 2 or 5 times a power of ten, at least `least`.
fn nice_step(least: f64) -> f64 {
    let power = 10f64.powf(least.max(1e-9).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * power).find(|step| *step >= least * 0.999).unwrap_or(10.0 * power)
}

/// The opening tag of a drawing with a name for readers that do not see it.
pub(super) fn open_svg(width: f64, height: f64, name: &str) -> String {
    format!("<svg viewBox=\"0 0 {width:.0} {height:.0}\" role=\"img\" aria-label=\"{}\">", html(name))
}

/// Outlines of markers around their point, and how each is drawn: full, as lines, or hollow.
const SHAPES: [(&str, Drawn); 16] = [
    ("m-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0z", Drawn::Full),
    ("m-4 -4h8v8h-8z", Drawn::Full),
    ("m0 -5.5l5 9h-10z", Drawn::Full),
    ("m0 -5.5l5.5 5.5l-5.5 5.5l-5.5 -5.5z", Drawn::Full),
    ("m0 5.5l5 -9h-10z", Drawn::Full),
    ("m-5 0h10m-5 -5v10", Drawn::Lines),
    ("m-4 -4l8 8m0 -8l-8 8", Drawn::Lines),
    ("m-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0z", Drawn::Hollow),
    ("m-3.5 -3.5h7v7h-7z", Drawn::Hollow),
    ("m0 -4.5l4 7.5h-8z", Drawn::Hollow),
    ("m0 -4.8l4.8 4.8l-4.8 4.8l-4.8 -4.8z", Drawn::Hollow),
    ("m0 4.5l4 -7.5h-8z", Drawn::Hollow),
    ("m5.5 0l-9 5v-10z", Drawn::Full),
    ("m-5.5 0l9 5v-10z", Drawn::Full),
    ("m-5 0h10m-7.5 -4.3l5 8.6m0 -8.6l-5 8.6", Drawn::Lines),
    ("m-4 -4.5h8l-8 9h8z", Drawn::Full),
];

#[derive(Clone, Copy)]
enum Drawn {
    Full,
    Lines,
    Hollow,
}

/// A marker at a point. Beyond the number of shapes they repeat.
pub fn marker(kind: usize, x: f64, y: f64, colour: &str) -> String {
    let (shape, drawn) = SHAPES[kind % SHAPES.len()];
    let style = match drawn {
        Drawn::Full => format!("fill=\"{colour}\""),
        Drawn::Lines => format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"2.2\""),
        Drawn::Hollow => format!("fill=\"#fff\" stroke=\"{colour}\" stroke-width=\"2\""),
    };
    format!("<path d=\"M{x:.1} {y:.1}{shape}\" {style}/>")
}

/// What stands below a figure.
pub(super) fn footnote(note: &str) -> String {
    if note.is_empty() { String::new() } else { format!("<p class=\"note\">{}</p>", html(note)) }
}

impl Plot {
    /// Whether there is anything to draw.
    pub fn is_empty(&self) -> bool {
        self.series.iter().all(|s| s.points.is_empty())
    }
    /// A figure with the drawing.
    pub fn figure(&self) -> String {
        let name = format!("{}: {} against {}", self.title, self.y.title, self.x.title);
        let note = footnote(&self.note);
        format!("<figure><figcaption>{}</figcaption>{}{}</svg>{note}</figure>\n", html(&self.title), open_svg(WIDTH, HEIGHT, &name), self.drawing())
    }
    /// An SVG file with a heading, a legend and the note.
    pub fn file(&self, heading: &str, legend: &[Entry]) -> String {
        let headings = wrapped(heading, ((WIDTH - LEFT - MARGIN) / HEADING_CHARACTER) as usize);
        let above = 24.0 + HEADING_LINE * headings.len().saturating_sub(1) as f64;
        let mut title = String::new();
        for (i, line) in headings.iter().enumerate() {
            _ = write!(title, "<text class=\"title\" x=\"{LEFT}\" y=\"{:.0}\" font-weight=\"600\">{}</text>", 17.0 + HEADING_LINE * i as f64, html(line));
        }
        let (mut entries, mut y) = drawn(legend, [LEFT, WIDTH], above + HEIGHT + 8.0);
        for line in wrapped(&self.note, ((WIDTH - 2.0 * MARGIN) / CHARACTER) as usize) {
            y += LINE;
            _ = write!(entries, "<text x=\"{MARGIN}\" y=\"{:.1}\">{}</text>", above + HEIGHT + y + 12.0, html(&line));
        }
        let height = above + HEIGHT + y + LINE + 4.0;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH:.0} {height:.0}\" width=\"{WIDTH:.0}\" height=\"{height:.0}\" role=\"img\">\n<title>{}</title><style>\n{STYLE}</style>\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>{title}\n<g transform=\"translate(0 {above})\">{}</g>\n{entries}\n</svg>\n",
            html(heading),
            self.drawing()
        )
    }
    /// Everything within the axes, and the axes.
    fn drawing(&self) -> String {
        let points = || self.series.iter().flat_map(|s| &s.points);
        let x = Scale::new(points().map(|p| p.x), self.x.may_be_log, LEFT, WIDTH - RIGHT);
        let heights = points().flat_map(|p| [Some(p.y), p.y_range.map(|r| r.0), p.y_range.map(|r| r.1)]).flatten();
        let y = Scale::new(heights, self.y.may_be_log, HEIGHT - BOTTOM, TOP);
        let mut svg = String::new();
        self.axes(&mut svg, &x, &y);
        if self.front.len() > 1 {
            let corners = self.front.windows(2).map(|w| format!("H{:.1}V{:.1}", x.at(w[1].0), y.at(w[1].1))).collect::<String>();
            let (first_x, first_y) = self.front[0];
            _ = write!(svg, "<path class=\"front\" d=\"M{:.1} {:.1}{corners}\"/>", x.at(first_x), y.at(first_y));
        }
        for series in &self.series {
            draw(&mut svg, series, &x, &y);
        }
        for (at_x, at_y) in &self.front {
            _ = write!(svg, "<circle class=\"onfront\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"8\"/>", x.at(*at_x), y.at(*at_y));
        }
        svg
    }
    fn axes(&self, svg: &mut String, x: &Scale, y: &Scale) {
        let (bottom, right) = (HEIGHT - BOTTOM, WIDTH - RIGHT);
        for (value, label) in x.ticks() {
            let at = x.at(value);
            _ = write!(
                svg,
                "<path class=\"grid\" d=\"M{at:.1} {TOP}V{bottom}\"/><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>",
                bottom + 16.0
            );
        }
        for (value, label) in y.ticks() {
            let at = y.at(value);
            _ = write!(
                svg,
                "<path class=\"grid\" d=\"M{LEFT} {at:.1}H{right}\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>",
                LEFT - 6.0,
                at + 4.0
            );
        }
        _ = write!(svg, "<path class=\"axis\" d=\"M{LEFT} {TOP}V{bottom}H{right}\"/>");
        let log = |scale: &Scale| if scale.log { ", logarithmic" } else { "" };
        _ = write!(
            svg,
            "<text class=\"title\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}{}</text>",
            (LEFT + right) / 2.0,
            HEIGHT - 8.0,
            html(&self.x.title),
            log(x)
        );
        let middle = (TOP + bottom) / 2.0;
        _ = write!(
            svg,
            "<text class=\"title\" x=\"14\" y=\"{middle:.1}\" text-anchor=\"middle\" transform=\"rotate(-90 14 {middle:.1})\">{}{}</text>",
            html(&self.y.title),
            log(y)
        );
    }
}

fn draw(svg: &mut String, series: &Series, x: &Scale, y: &Scale) {
    let colour = COLOURS[series.colour % COLOURS.len()];
    if series.line && series.points.len() > 1 {
        let path: Vec<String> = series.points.iter().map(|p| format!("{:.1} {:.1}", x.at(p.x), y.at(p.y))).collect();
        _ = write!(svg, "<path class=\"line\" stroke=\"{colour}\"{} d=\"M{}\"/>", dashes(series.colour), path.join("L"));
    }
    for p in &series.points {
        let (at_x, at_y) = (x.at(p.x), y.at(p.y));
        let range = p.y_range.filter(|(low, high)| high > low);
        let whisker = range.map(|(low, high)| format!("<path class=\"range\" stroke=\"{colour}\" d=\"M{at_x:.1} {:.1}V{:.1}\"/>", y.at(low), y.at(high)));
        if let Some(kind) = series.marker {
            let shape = marker(kind, at_x, at_y, colour) + &dots(series.colour, at_x, at_y + TO_DOTS);
            _ = write!(svg, "<g><title>{}</title>{}{shape}</g>", html(&p.hint), whisker.unwrap_or_default());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_cover_their_values_and_ticks_lie_inside() {
        for values in [vec![3.0], vec![0.0, 0.0], vec![0.001, 900.0], vec![-5.0, 4.0], vec![1e-9, 1e12], vec![31.24, 31.25], vec![]] {
            for log in [false, true] {
                let scale = Scale::new(values.iter().copied(), log, 10.0, 210.0);
                for v in &values {
                    assert!((10.0..=210.0).contains(&scale.at(*v)), "{v} of {values:?}");
                }
                let ticks = scale.ticks();
                assert!((1..=22).contains(&ticks.len()), "{values:?}: {ticks:?}");
                assert!(ticks.iter().all(|(v, _)| (9.9..=210.1).contains(&scale.at(*v))), "{values:?}: {ticks:?}");
                assert!(ticks.windows(2).all(|w| w[0].1 != w[1].1), "{values:?}: {ticks:?}");
            }
        }
    }

    #[test]
    fn labels_have_the_digits_of_their_step() {
        let labels = |high: f64| Scale::new([0.0, high].into_iter(), false, 0.0, 1.0).ticks().into_iter().map(|(_, label)| label).collect::<Vec<_>>();
        assert_eq!(labels(9e-5), ["0", "2e-5", "4e-5", "6e-5", "8e-5"]);
        assert_eq!(labels(1.2e6), ["0", "500000", "1.0e6"]);
    }

    #[test]
    fn a_plot_names_its_axes_and_escapes_its_hints() {
        let point = Point { x: 1.0, y: 30.0, y_range: Some((29.0, 31.0)), hint: "<b>".into() };
        let series = Series { colour: 0, marker: Some(2), line: true, points: vec![point] };
        let (x, y) = (Axis::ranged("size (MB)"), Axis::linear("PSNR (dB)"));
        let plot = Plot { title: "a & b".into(), x, y, series: vec![series], front: vec![(1.0, 30.0)], note: "of <two> devices ".repeat(9) };
        let svg = plot.figure();
        for part in ["size (MB)", "PSNR (dB)", "a &amp; b", "&lt;b&gt;", "class=\"range\"", "class=\"onfront\""] {
            assert!(svg.contains(part), "{part} in {svg}");
        }
        assert!(!svg.contains("<b>") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        let file = plot.file("a", &[]);
        assert!(svg.contains("</svg><p class=\"note\">of &lt;two&gt;") && file.matches("<text x=\"8\"").count() == 3 && !file.contains("<two>"), "{file}");
    }

    #[test]
    fn trainings_of_one_colour_have_other_lines_and_markers() {
        let plot = |colour: usize, marker: Option<usize>| {
            let point = |x: f64| Point { x, y: 30.0 + x, y_range: None, hint: String::new() };
            let series = Series { colour, marker, line: marker.is_none(), points: vec![point(1.0), point(2.0)] };
            Plot { title: String::new(), x: Axis::linear("x"), y: Axis::linear("y"), series: vec![series], front: Vec::new(), note: String::new() }.figure()
        };
        for marker in [None, Some(0)] {
            assert_ne!(plot(3, marker), plot(3 + COLOURS.len(), marker));
        }
    }

    #[test]
    fn a_long_heading_has_several_lines() {
        let plot = Plot { title: String::new(), x: Axis::linear("x"), y: Axis::linear("y"), series: Vec::new(), front: Vec::new(), note: String::new() };
        let headings = |heading: &str| plot.file(heading, &[]).matches("font-weight=\"600\"").count();
        assert_eq!([headings("short"), headings(&"scene ".repeat(20))], [1, 3]);
    }
}
