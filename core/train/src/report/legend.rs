//! Legends of plots as files, and what tells trainings of one colour apart: dots below their markers and between the dashes of their lines.

use super::plot::{COLOURS, marker};
use super::text::html;
use std::fmt::Write;

/// Height of a line of text, and the width of a character there at most, pixels.
pub(super) const LINE: f64 = 18.0;
pub(super) const CHARACTER: f64 = 7.0;
/// From the left edge of an entry to its text, and the width of an entry beside its characters.
const TEXT: f64 = 17.0;
const PADDING: f64 = 24.0;
/// So many trainings of one colour differ in their dots; with more the dots repeat, too.
const ROUNDS: usize = 4;

/// An entry of a legend.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Index of a training, which gives colour and dots; grey where absent.
    pub colour: Option<usize>,
    /// Index of the [`marker`]; a square where absent.
    pub marker: Option<usize>,
    pub name: String,
}

/// How many dots the training with this index has.
fn dot_count(training: usize) -> usize {
    training / COLOURS.len() % ROUNDS
}

/// The attribute for the line of the training with this index: a solid line, or dashes with the dots of the training between them.
pub(super) fn dashes(training: usize) -> String {
    match dot_count(training) {
        0 => String::new(),
        count => format!(" stroke-dasharray=\"9 3{}\"", " 2 3".repeat(count)),
    }
}

/// The dots of the training with this index, in a row with the centre `[x, y]`.
pub(super) fn dots(training: usize, x: f64, y: f64) -> String {
    let count = dot_count(training);
    if count == 0 {
        return String::new();
    }
    let (left, colour) = (x - (2 * count - 1) as f64, COLOURS[training % COLOURS.len()]);
    format!("<path d=\"M{left:.1} {y:.1}h2{}\" stroke=\"{colour}\" stroke-width=\"2\"/>", "m2 0h2".repeat(count - 1))
}

/// A square of 12 by 12 pixels with colour and dots of the training with this index.
fn square(training: usize, x: f64, y: f64) -> String {
    let (height, colour) = (if dot_count(training) > 0 { 8 } else { 12 }, COLOURS[training % COLOURS.len()]);
    format!("<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"12\" height=\"{height}\" fill=\"{colour}\"/>{}", dots(training, x + 6.0, y + 10.5))
}

/// The square of a training with its name, in HTML.
pub(super) fn training_swatch(training: usize, name: &str) -> String {
    format!("<span><svg viewBox=\"0 0 12 12\" class=\"swatch\">{}</svg>{}</span> ", square(training, 0.0, 0.0), html(name))
}

/// `text` in lines of at most `most` characters, broken between words where that is possible.
pub(super) fn wrapped(text: &str, most: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        let letters: Vec<char> = word.chars().collect();
        for piece in letters.chunks(most) {
            match lines.last_mut().filter(|line| line.chars().count() + 1 + piece.len() <= most) {
                Some(line) => {
                    line.push(' ');
                    line.extend(piece);
                }
                None => lines.push(piece.iter().collect()),
            }
        }
    }
    lines
}

/// The entries between `left` and `right`, the first line at the height `top`, and how far below it the last line is. A name that is too long for a line has
/// several, and no other entry beside it.
pub(super) fn drawn(entries: &[Entry], [left, right]: [f64; 2], top: f64) -> (String, f64) {
    let most = ((right - left - PADDING) / CHARACTER).max(1.0) as usize;
    let (mut svg, mut x, mut y) = (String::new(), left, 0.0);
    for entry in entries {
        let lines = wrapped(&entry.name, most);
        let width = PADDING + CHARACTER * lines.iter().map(|line| line.chars().count()).max().unwrap_or(0) as f64;
        if x > left && (x + width > right || lines.len() > 1) {
            (x, y) = (left, y + LINE);
        }
        let at = top + y;
        svg += &match (entry.marker, entry.colour) {
            (Some(kind), training) => marker(kind, x + 6.0, at, training.map_or("#333", |training| COLOURS[training % COLOURS.len()])),
            (None, Some(training)) => square(training, x, at - 6.0),
            (None, None) => format!("<rect x=\"{x:.1}\" y=\"{:.1}\" width=\"12\" height=\"12\" fill=\"#333\"/>", at - 6.0),
        };
        for (i, line) in lines.iter().enumerate() {
            // Writing to a string cannot fail.
            _ = write!(svg, "<text x=\"{:.1}\" y=\"{:.1}\">{}</text>", x + TEXT, at + 4.0 + LINE * i as f64, html(line));
        }
        (x, y) = if lines.len() > 1 { (right, y + LINE * (lines.len() - 1) as f64) } else { (x + width, y) };
    }
    (svg, y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_note_are_no_longer_than_allowed() {
        assert_eq!(wrapped("one two  three abcdefghij k", 7), ["one two", "three", "abcdefg", "hij k"]);
        assert!(wrapped(" ", 7).is_empty());
    }

    #[test]
    fn long_names_stay_within_a_legend() {
        let names = ["short".to_string(), "method-".repeat(14) + ", " + &"setting-".repeat(12), "two words".into(), "x".repeat(100), "last".into()];
        let entry = |(i, name): (usize, &String)| Entry { colour: Some(i), marker: None, name: name.clone() };
        let entries: Vec<Entry> = names.iter().enumerate().map(entry).collect();
        let (svg, height) = drawn(&entries, [62.0, 430.0], 100.0);
        let mut texts: Vec<(f64, f64, String)> = Vec::new();
        for part in svg.split("<text x=\"").skip(1) {
            let (x, rest) = part.split_once("\" y=\"").unwrap();
            let (y, rest) = rest.split_once("\">").unwrap();
            texts.push((x.parse().unwrap(), y.parse().unwrap(), rest.split('<').next().unwrap().to_string()));
        }
        assert!(texts.iter().all(|(x, _, text)| x + CHARACTER * text.chars().count() as f64 <= 430.0), "{texts:?}");
        assert!(texts.iter().all(|(_, y, _)| *y <= 100.0 + height + 4.0), "{texts:?}");
        let letters = |text: &str| text.replace(' ', "");
        assert_eq!(letters(&texts.iter().map(|(.., text)| text.as_str()).collect::<String>()), letters(&names.concat()));
        // No two texts are in one line and over each other.
        for (i, (x, y, _)) in texts.iter().enumerate() {
            assert!(
                texts[..i].iter().all(|(left, other, text)| y > other || (y == other && left + CHARACTER * text.chars().count() as f64 <= *x)),
                "{texts:?}"
            );
        }
    }

    #[test]
    fn trainings_of_one_colour_differ() {
        let count = COLOURS.len();
        assert_eq!((dashes(0), dots(0, 1.0, 1.0)), (String::new(), String::new()));
        let all: std::collections::BTreeSet<[String; 3]> =
            (0..ROUNDS * count).map(|i| [dashes(i) + COLOURS[i % count], dots(i, 5.0, 5.0) + COLOURS[i % count], training_swatch(i, "a")]).collect();
        assert_eq!(all.len(), ROUNDS * count);
        let parts: [std::collections::BTreeSet<&String>; 3] = std::array::from_fn(|part| all.iter().map(|texts| &texts[part]).collect());
        assert!(parts.iter().all(|texts| texts.len() == ROUNDS * count), "each of the three tells them apart");
        // The dots stay within the square of a legend.
        assert!(training_swatch(3 * count, "a").contains("M1.0 10.5h2m2 0h2m2 0h2"), "{}", training_swatch(3 * count, "a"));
    }
}
