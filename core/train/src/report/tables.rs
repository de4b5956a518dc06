//! Tables of results as HTML, Markdown, LaTeX and CSV.

use super::rows::{Better, QUANTITIES, Quantity, Row, TRAINING};
use super::text;
use crate::sweep::{TrainingDevices, csv_field, interrupted, kept_out, mixture_notes, trained_on};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// One cell.
#[derive(Clone, Debug)]
pub struct Cell {
    /// As shown.
    pub text: String,
    /// Whether it is the best of its column.
    pub best: bool,
}

impl Cell {
    /// A cell that is not marked.
    pub fn plain(text: String) -> Self {
        Self { text, best: false }
    }
}

/// A table.
#[derive(Clone, Debug)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// Names of the columns.
    pub head: Vec<String>,
    /// Columns of text; the others are aligned as numbers.
    pub text_columns: Vec<usize>,
    /// As long as `head`.
    pub rows: Vec<Vec<Cell>>,
    /// Below it.
    pub notes: Vec<String>,
}

/// The rows of a scene with every one of `quantities` that one of them has: mean and sample standard deviation over seeds. The best mean of a column is marked
/// where means of trainings that did not fail differ in the digits shown; trainings that failed are never the best. Times of trainings that ran on different
/// devices state these, and none is the best. Notes state why values of these quantities are missing, every reason once, which trainings were interrupted, and
/// which learned from fewer views.
pub(super) fn summary(scene: &str, rows: &[Row], quantities: &[&Quantity], trained: &TrainingDevices) -> Table {
    let settings = rows.iter().any(|row| row.setting != "base");
    let mut head: Vec<String> = ["method", "setting", "codec", "seeds"].map(str::to_string).to_vec();
    if !settings {
        head.remove(1);
    }
    let text_columns = (0..head.len() - 1).collect();
    let mut lines: Vec<Vec<Cell>> = rows
        .iter()
        .map(|row| {
            let mark = if row.hopeless() { " †" } else { "" };
            let mut line = vec![format!("{}{mark}", row.method), row.setting.to_string(), row.codec.to_string(), row.cells.len().to_string()];
            if !settings {
                line.remove(1);
            }
            line.into_iter().map(Cell::plain).collect()
        })
        .collect();
    let (mut notes, mut absent) = (Vec::new(), Vec::new());
    let named = || rows.iter().map(|row| (row.training(), row.cells.as_slice()));
    for quantity in quantities {
        let spreads: Vec<_> = rows.iter().map(|row| row.spread(quantity)).collect();
        let has_column = spreads.iter().any(Option::is_some);
        let reasons: BTreeSet<&str> = rows.iter().flat_map(|row| &row.cells).filter_map(|cell| cell.absent.get(quantity.key)).map(String::as_str).collect();
        if !reasons.is_empty() {
            let said = if has_column { "is missing where it says –" } else { "is not in this table" };
            absent.push(format!("{} {said}: {}", quantity.name, reasons.into_iter().collect::<Vec<_>>().join("; ")));
        }
        if !has_column {
            continue;
        }
        let arrow = match quantity.better {
            Better::Higher => " ↑",
            Better::Lower => " ↓",
            Better::Neither => "",
        };
        head.push(format!("{}{arrow}", quantity.title()));
        let rounded = |mean: f64| format!("{mean:.*}", quantity.digits);
        let mixed = quantity.key == TRAINING.key && trained.differ();
        let means: Vec<f64> = spreads.iter().zip(rows).filter(|(_, row)| !row.hopeless()).filter_map(|(spread, _)| spread.map(|s| s.mean)).collect();
        let differ = means.iter().map(|mean| rounded(*mean)).collect::<BTreeSet<_>>().len() > 1;
        let best = if differ && !mixed { best(quantity, means.into_iter()).map(rounded) } else { None };
        if mixed {
            notes.push(trained.sentence());
        }
        if quantity.key == TRAINING.key {
            notes.extend(interrupted(named()));
        }
        for ((line, spread), row) in lines.iter_mut().zip(&spreads).zip(rows) {
            let mark = if mixed { trained.mark(&row.cells) } else { String::new() };
            let text = spread.map_or_else(|| "–".to_string(), |s| s.text(quantity.digits) + &mark);
            let is_best = !row.hopeless() && spread.is_some_and(|s| Some(rounded(s.mean)) == best);
            line.push(Cell { text, best: is_best });
        }
    }
    notes.extend(mixture_notes(named()));
    notes.extend(kept_out(named()));
    let hopeless: Vec<String> = rows
        .iter()
        .filter(|row| row.hopeless())
        .map(|row| {
            let why = row.cells.iter().find_map(|cell| cell.message.clone()).unwrap_or_else(|| "below simple baselines".into());
            format!("† {}: {why}", row.training())
        })
        .collect();
    notes.extend(hopeless.into_iter().collect::<BTreeSet<_>>());
    notes.extend(absent);
    Table { title: scene.to_string(), head, text_columns, rows: lines, notes }
}

fn best(quantity: &Quantity, means: impl Iterator<Item = f64>) -> Option<f64> {
    match quantity.better {
        Better::Higher => means.max_by(f64::total_cmp),
        Better::Lower => means.min_by(f64::total_cmp),
        Better::Neither => None,
    }
}

impl Table {
    /// As HTML.
    pub fn html(&self) -> String {
        let class = |column: usize| if self.text_columns.contains(&column) { " class=\"text\"" } else { "" };
        let head: String = self
            .head
            .iter()
            .enumerate()
            .map(|(i, name)| format!("<th{}>{}</th>", class(i), text::html(&name.replace(" ↑", "\u{a0}↑").replace(" ↓", "\u{a0}↓"))))
            .collect();
        let mut out = format!("<div class=\"table\"><table><thead><tr>{head}</tr></thead><tbody>\n");
        for row in &self.rows {
            let cells: String = row
                .iter()
                .enumerate()
                .map(|(i, cell)| {
                    // A narrow column breaks before the deviation, not within.
                    let content = text::html(&cell.text.replace("± ", "±\u{a0}"));
                    let content = if cell.best { format!("<b>{content}</b>") } else { content };
                    format!("<td{}>{content}</td>", class(i))
                })
                .collect();
            _ = writeln!(out, "<tr>{cells}</tr>");
        }
        out.push_str("</tbody></table></div>\n");
        for note in &self.notes {
            _ = writeln!(out, "<p class=\"note\">{}</p>", text::html(note));
        }
        out
    }
    /// As Markdown.
    pub fn markdown(&self) -> String {
        let line = |cells: &mut dyn Iterator<Item = String>| format!("| {} |\n", cells.collect::<Vec<_>>().join(" | "));
        let mut out = format!("## {}\n\n", text::markdown(&self.title));
        out += &line(&mut self.head.iter().map(|name| text::markdown(name)));
        out += &line(&mut (0..self.head.len()).map(|i| if self.text_columns.contains(&i) { "---".into() } else { "---:".into() }));
        for row in &self.rows {
            out += &line(&mut row.iter().map(|cell| {
                let content = text::markdown(&cell.text);
                if cell.best { format!("**{content}**") } else { content }
            }));
        }
        for note in &self.notes {
            _ = write!(out, "\n{}\n", text::markdown(note));
        }
        out + "\n"
    }
    /// As a LaTeX table; it needs no packages.
    pub fn latex(&self) -> String {
        let columns: String = (0..self.head.len()).map(|i| if self.text_columns.contains(&i) { 'l' } else { 'r' }).collect();
        let mut out = format!("\\begin{{table}}\n\\centering\n\\caption{{{}}}\n\\begin{{tabular}}{{{columns}}}\n\\hline\n", text::latex(&self.title));
        let line = |cells: &mut dyn Iterator<Item = String>| {
            let row = cells.collect::<Vec<_>>().join(" & ");
            // The end of the row before would take these as its arguments.
            let guard = if row.starts_with(['[', '*']) { "{}" } else { "" };
            format!("{guard}{row} \\\\\n")
        };
        out += &line(&mut self.head.iter().map(|name| text::latex(name)));
        out += "\\hline\n";
        for row in &self.rows {
            out += &line(&mut row.iter().map(|cell| {
                let content = text::latex(&cell.text);
                if cell.best { format!("\\textbf{{{content}}}") } else { content }
            }));
        }
        out += "\\hline\n\\end{tabular}\n";
        for note in &self.notes {
            _ = write!(out, "\n{}\n", text::latex(note));
        }
        out + "\\end{table}\n\n"
    }
}

/// The first columns of the CSV table.
pub const CSV_START: &str = "scene,method,setting,codec,outcome,seeds";

/// All rows of all scenes as CSV: the axes, the number of seeds, then mean, sample standard deviation, least and largest value of every quantity, and
/// what the trainings ran on. Missing values are empty.
pub fn csv(scenes: &BTreeMap<&str, Vec<Row>>) -> String {
    let mut head: Vec<String> = CSV_START.split(',').map(str::to_string).collect();
    head.extend(QUANTITIES.iter().flat_map(|q| ["mean", "deviation", "low", "high"].map(|part| format!("{}_{part}", q.key))));
    head.push("training_devices".into());
    let mut out = head.join(",") + "\n";
    for row in scenes.values().flatten() {
        let outcome = if row.hopeless() { "hopeless" } else { "done" };
        let mut fields: Vec<String> = [row.scene, row.method, row.setting, row.codec, outcome].map(csv_field).to_vec();
        fields.push(row.cells.len().to_string());
        for quantity in QUANTITIES {
            let spread = row.spread(quantity);
            let part = |f: &dyn Fn(&crate::sweep::Spread) -> Option<f64>| spread.as_ref().and_then(f).map_or_else(String::new, |v| v.to_string());
            fields.extend([part(&|s| Some(s.mean)), part(&|s| s.deviation), part(&|s| Some(s.low)), part(&|s| Some(s.high))]);
        }
        fields.push(csv_field(&trained_on(&row.cells)));
        out += &(fields.join(",") + "\n");
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::rows::{LPIPS, PSNR, rows};
    use super::*;
    use crate::sweep::CellResult;

    #[test]
    fn rows_of_latex_are_no_arguments_of_the_row_before() {
        let rows = ["[1] a", "*", "b"].map(|text| vec![Cell::plain(text.into())]).to_vec();
        let table = Table { title: "t".into(), head: vec!["h".into()], text_columns: vec![0], rows, notes: Vec::new() };
        assert!(table.latex().contains("\nh \\\\\n\\hline\n{}[1] a \\\\\n{}* \\\\\nb \\\\\n\\hline"), "{}", table.latex());
    }

    #[test]
    fn reasons_are_those_of_the_columns_and_all_of_them() {
        let text = include_str!("../../../../docs/results.md");
        let json = text.split("```json\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        let cell = |id: &str, why: &str| {
            let mut cell = CellResult::from_json("docs/results.md", json).unwrap();
            (cell.id, cell.axes.method) = (id.into(), id.into());
            cell.absent = ["lpips", "ssim_dynamic"].map(|name| (name.to_string(), why.to_string())).into();
            cell
        };
        let notes = |cells: &[CellResult], quantities: &[&Quantity]| {
            let scenes = rows(cells).unwrap();
            summary("mutant", &scenes["mutant"], quantities, &TrainingDevices::of(cells)).notes
        };
        let mut cells = vec![cell("a", "too small"), cell("b", "no weights"), cell("c", "no weights")];
        assert_eq!(notes(&cells, &[&PSNR, &LPIPS]), ["LPIPS is not in this table: no weights; too small"]);
        assert!(notes(&cells, &[&PSNR]).is_empty(), "no column of it was asked for");
        let score = cells[1].metrics["psnr_db"].clone();
        cells[1].metrics.insert("lpips".into(), score);
        cells[1].absent.clear();
        assert_eq!(notes(&cells, &[&PSNR, &LPIPS]), ["LPIPS is missing where it says –: no weights; too small"]);
    }
}
