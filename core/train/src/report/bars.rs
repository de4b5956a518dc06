//! Bars of parts that add up, and strips of single values, one line per name.

use super::plot::{COLOURS, Scale, footnote, marker, open_svg};
use super::text::{html, short};
use std::fmt::Write;

const WIDTH: f64 = 640.0;
const LABEL: f64 = 250.0;
const LINE: f64 = 22.0;
const BOTTOM: f64 = 44.0;
const TOP: f64 = 8.0;
/// Characters of a label that fit beside its bar.
const LABEL_CHARACTERS: usize = 38;

/// Stacked bars.
#[derive(Clone, Debug)]
pub struct Bars {
    /// What it says.
    pub title: String,
    /// What the axis shows, with the unit.
    pub axis: String,
    /// Names of the parts, in the order of the stack.
    pub parts: Vec<String>,
    /// A name and one value per part; no value is below 0.
    pub lines: Vec<(String, Vec<f64>)>,
    /// Below it; may be empty.
    pub note: String,
}

/// Values of equal kind as points on a line each, with their mean.
#[derive(Clone, Debug)]
pub struct Strips {
    /// What it says.
    pub title: String,
    /// What the axis shows, with the unit.
    pub axis: String,
    /// A name, a colour, and values.
    pub lines: Vec<(String, usize, Vec<f64>)>,
}

impl Bars {
    /// A figure with the drawing and its legend.
    pub fn figure(&self) -> String {
        let total = |values: &[f64]| values.iter().sum::<f64>();
        let largest = self.lines.iter().map(|(_, values)| total(values)).fold(0.0, f64::max);
        let scale = Scale::new([0.0, largest].into_iter(), false, LABEL, WIDTH - 60.0);
        let height = TOP + LINE * self.lines.len() as f64 + BOTTOM;
        let mut svg = open_svg(WIDTH, height, &format!("{}: {}", self.title, self.axis));
        axis(&mut svg, &scale, height, &self.axis);
        for (line, (name, values)) in self.lines.iter().enumerate() {
            let y = TOP + LINE * line as f64;
            label(&mut svg, y, name);
            let mut from = 0.0;
            for (part, value) in values.iter().enumerate() {
                let (left, right) = (scale.at(from), scale.at(from + value));
                let hint = format!("{name}: {} {}", self.parts.get(part).map_or("", String::as_str), precise(*value));
                _ = write!(
                    svg,
                    "<rect x=\"{left:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"15\" fill=\"{}\"><title>{}</title></rect>",
                    y + 3.0,
                    (right - left).max(0.0),
                    COLOURS[part % COLOURS.len()],
                    html(&hint)
                );
                from += value;
            }
            _ = write!(svg, "<text x=\"{:.1}\" y=\"{:.1}\">{}</text>", scale.at(from) + 5.0, y + 15.0, precise(total(values)));
        }
        let legend: String = self.parts.iter().enumerate().map(|(i, name)| swatch(COLOURS[i % COLOURS.len()], name)).collect();
        let (title, note) = (html(&self.title), footnote(&self.note));
        format!("<figure class=\"wide\"><figcaption>{title}</figcaption><p class=\"legend\">{legend}</p>{svg}</svg>{note}</figure>\n")
    }
}

impl Strips {
    /// A figure with the drawing.
    pub fn figure(&self) -> String {
        let scale = Scale::new(self.lines.iter().flat_map(|(_, _, values)| values.iter().copied()), false, LABEL, WIDTH - 60.0);
        let height = TOP + LINE * self.lines.len() as f64 + BOTTOM;
        let mut svg = open_svg(WIDTH, height, &format!("{}: {}", self.title, self.axis));
        axis(&mut svg, &scale, height, &self.axis);
        for (line, (name, colour, values)) in self.lines.iter().enumerate() {
            let y = TOP + LINE * line as f64;
            label(&mut svg, y, name);
            for value in values {
                let hint = format!("{name}: {}", precise(*value));
                _ = write!(svg, "<g><title>{}</title>{}</g>", html(&hint), marker(7, scale.at(*value), y + 11.0, COLOURS[colour % COLOURS.len()]));
            }
            if values.len() > 1 {
                let mean = scale.at(values.iter().sum::<f64>() / values.len() as f64);
                _ = write!(svg, "<path class=\"mean\" d=\"M{mean:.1} {:.1}v16\"/>", y + 3.0);
            }
        }
        format!("<figure class=\"wide\"><figcaption>{}</figcaption>{svg}</svg></figure>\n", html(&self.title))
    }
}

/// Three significant digits.
fn precise(value: f64) -> String {
    let digits = if value == 0.0 { 0.0 } else { 2.0 - value.abs().log10().floor() };
    short(value, digits.clamp(0.0, 6.0) as usize)
}

/// A coloured square with a name.
fn swatch(colour: &str, name: &str) -> String {
    format!("<span><svg viewBox=\"0 0 12 12\" class=\"swatch\"><rect width=\"12\" height=\"12\" fill=\"{colour}\"/></svg>{}</span> ", html(name))
}

/// `name` in at most [`LABEL_CHARACTERS`]: of a longer one the beginning and the end, where its codec is.
fn shortened(name: &str) -> String {
    let letters: Vec<char> = name.chars().collect();
    if letters.len() <= LABEL_CHARACTERS {
        return name.to_string();
    }
    let first = LABEL_CHARACTERS / 2;
    let last = letters.len() - (LABEL_CHARACTERS - 1 - first);
    letters[..first].iter().chain(&['…']).chain(&letters[last..]).collect()
}

fn label(svg: &mut String, y: f64, name: &str) {
    let short = shortened(name);
    _ = write!(svg, "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\"><title>{}</title>{}</text>", LABEL - 8.0, y + 15.0, html(name), html(&short));
}

fn axis(svg: &mut String, scale: &Scale, height: f64, title: &str) {
    let bottom = height - BOTTOM;
    for (value, label) in scale.ticks() {
        let at = scale.at(value);
        _ = write!(
            svg,
            "<path class=\"grid\" d=\"M{at:.1} {TOP}V{bottom:.1}\"/><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>",
            bottom + 16.0
        );
    }
    _ = write!(svg, "<path class=\"axis\" d=\"M{LABEL} {bottom:.1}H{:.1}\"/>", WIDTH - 60.0);
    _ = write!(svg, "<text class=\"title\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>", (LABEL + WIDTH - 60.0) / 2.0, height - 8.0, html(title));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_stand_one_after_the_other() {
        let (parts, lines) = (vec!["a".into(), "b".into()], vec![("<x>".into(), vec![1.0, 3.0])]);
        let bars = Bars { title: "storage".into(), axis: "MB".into(), parts, lines, note: String::new() };
        let svg = bars.figure();
        let edges: Vec<(f64, f64)> = svg
            .match_indices("<rect x=\"")
            .map(|(at, found)| {
                let number = |from: usize| svg[from..].split('"').next().unwrap().parse::<f64>().unwrap();
                let width = at + svg[at..].find("width=\"").unwrap() + 7;
                (number(at + found.len()), number(width))
            })
            .collect();
        assert_eq!(edges.len(), 2);
        assert!((edges[0].0 + edges[0].1 - edges[1].0).abs() < 0.11 && (edges[1].1 / edges[0].1 - 3.0).abs() < 0.01, "{edges:?}");
        assert!(svg.contains("&lt;x&gt;") && svg.contains(">4</text>"));
        assert_eq!((precise(0.0), precise(0.012_345), precise(123.4), precise(9.999)), ("0".into(), "0.0123".into(), "123".into(), "10".into()));
    }

    #[test]
    fn long_labels_keep_their_codec() {
        let name = |codec: &str| format!("{}, {} / {codec}", "hexplane-".repeat(4), "setting-".repeat(4));
        let labels = ["cca-default", "cca-low"].map(|codec| shortened(&name(codec)));
        assert!(labels[0].ends_with(" / cca-default") && labels[1].ends_with(" / cca-low") && labels[0].starts_with("hexplane-hexplane"), "{labels:?}");
        assert!(labels.iter().all(|label| label.chars().count() == LABEL_CHARACTERS), "{labels:?}");
        assert_eq!(shortened("cdf / cca"), "cdf / cca");
    }

    #[test]
    fn an_empty_chart_is_still_a_chart() {
        let svg = Strips { title: "seeds".into(), axis: "dB".into(), lines: vec![("one".into(), 3, vec![30.0])] }.figure();
        assert!(svg.contains("<path d=") && !svg.contains("class=\"mean\"") && !svg.contains("NaN"));
        assert!(!Bars { title: String::new(), axis: String::new(), parts: vec![], lines: vec![], note: String::new() }.figure().contains("NaN"));
    }
}
