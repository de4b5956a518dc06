//! Reports: an HTML page that needs no network, and tables as CSV, Markdown and LaTeX, from results of sweeps. Equal results give equal bytes.

mod bars;
mod charts;
mod images;
mod legend;
mod page;
mod pareto;
mod plot;
mod published;
mod rows;
mod tables;
mod text;

pub use rows::{Better, QUANTITIES, Quantity, Row, rows};
pub use tables::{Cell, Table};

use crate::sweep::{CellResult, PLAN, Plan, RESULTS, SweepFolder, TrainingDevices, check_comparable, collect, read_results, select};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::{Error, Result};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Near the beginning of the Markdown tables, and at that of the LaTeX tables.
const MARKDOWN_NOTE: &str = "Mean ± sample standard deviation over seeds; best of a column in bold.";
const LATEX_NOTE: &str = "% Mean and sample standard deviation over seeds.";

/// Whose images a report shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageChoice {
    /// Nobody's.
    None,
    /// Those of built-in scenes, which may be published.
    BuiltIn,
    /// All that the folder has. Images of third-party datasets stay on the machine.
    All,
}

/// What a report shows.
#[derive(Clone, Debug)]
pub struct ReportOptions {
    /// Heading; the names of the sweeps where absent.
    pub title: Option<String>,
    /// Whose images.
    pub images: ImageChoice,
    /// Views per scene.
    pub views: usize,
    /// `KEY=VALUE`, as [`select`] takes them.
    pub only: Vec<String>,
    /// Keys of [`QUANTITIES`] that the summary tables show, in this order; all where it is empty.
    pub columns: Vec<String>,
    /// Folder for the plots as SVG files.
    pub figures: Option<PathBuf>,
}

impl Default for ReportOptions {
    fn default() -> Self {
        Self { title: None, images: ImageChoice::BuiltIn, views: 3, only: Vec::new(), columns: Vec::new(), figures: None }
    }
}

/// The text of a report's files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Report {
    /// The page.
    pub html: String,
    /// All rows.
    pub csv: String,
    /// The tables of the page.
    pub markdown: String,
    /// The tables of the page.
    pub latex: String,
    /// The plots of the page as SVG files: names and texts.
    pub figures: Vec<(String, String)>,
    /// Results that it is made of.
    pub cells: usize,
    /// Which cells of the sweep are missing, if any.
    pub gap: Option<String>,
}

/// The files of a report.
#[derive(Clone, Debug, Serialize)]
pub struct ReportFiles {
    /// The page.
    pub html: PathBuf,
    /// All rows.
    pub csv: PathBuf,
    /// The tables.
    pub markdown: PathBuf,
    /// The tables.
    pub latex: PathBuf,
    /// The plots.
    pub figures: Vec<PathBuf>,
    /// Results that it is made of.
    pub cells: usize,
    /// Which cells of the sweep are missing, if any.
    pub gap: Option<String>,
    /// Size of the page in bytes.
    pub html_bytes: usize,
}

/// The results of the cells of the plan in `folder`, in the order of [`read_results`], and what is missing.
fn planned_results(folder: &Path) -> Result<(Vec<CellResult>, Option<String>)> {
    let collection = collect(&SweepFolder::new(folder), &Plan::read(folder)?)?;
    let (gap, mut results) = (collection.gap(), collection.results);
    if results.is_empty() {
        return Err(Error::data(folder.display().to_string(), "no result is of a cell of its plan", "Run the sweep first: cc4dgs sweep run DIR"));
    }
    results.sort_by(|a, b| a.axes.cmp(&b.axes).then_with(|| a.id.cmp(&b.id)));
    Ok((results, gap))
}

/// The folder that images are named relative to, which holds a folder `images`: that of the results, or the one around a sweep's folder of results.
fn folder_of_images(path: &Path) -> &Path {
    fn around(path: &Path) -> &Path {
        path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }
    let own = if path.is_file() { around(path) } else { path };
    // The folder of a sweep may be called `results`, too.
    let is_inner = own.file_name().is_some_and(|name| name == RESULTS) && !own.join("images").is_dir();
    if is_inner { around(own) } else { own }
}

/// Makes the report of the results in `path` (see [`read_results`]); of a sweep's folder, those of the cells of its plan. The folder of images is `path`
/// itself, or the folder of a file; if that is called `results` and has no images, the one around it.
///
/// # Errors
/// What reading reports; [`Error::Data`] for results that do not belong into one table, and for damaged images; [`Error::Parameter`] for options.
pub fn report(path: &Path, options: &ReportOptions) -> Result<Report> {
    // Earlier plans leave results in the folder of a sweep, too.
    let is_sweep = path.join(PLAN).is_file() && path.join(RESULTS).is_dir();
    let (results, gap) = if is_sweep { planned_results(path)? } else { (read_results(path)?, None) };
    let results = select(results, &options.only)?;
    check_comparable(&results)?;
    let scenes = rows(&results)?;
    let folder = folder_of_images(path);
    let public = images::built_in(&scenes);
    let key = charts::Key::of(scenes.values().flatten());
    let columns = columns(&options.columns)?;
    let trained = TrainingDevices::of(&results);

    let title = options.title.clone().unwrap_or_else(|| {
        let sweeps: std::collections::BTreeSet<&str> = results.iter().map(|r| r.sweep.as_str()).collect();
        format!("Results: {}", sweeps.into_iter().collect::<Vec<_>>().join(", "))
    });
    let anchors: Vec<(String, String)> = scenes.keys().enumerate().map(|(i, scene)| (format!("scene-{i}"), scene.to_string())).collect();
    let mut links = anchors.clone();
    links.extend([("protocols".to_string(), "protocols".to_string()), ("published".to_string(), "reported by papers".to_string())]);
    let mut body = page::contents(&links) + &page::facts(&results);
    let scored = page::scored(&results);
    let mut markdown = format!("# {}\n\n{MARKDOWN_NOTE} ↑ high is better, ↓ low is better. MB are 10⁶ bytes.\n\n", text::markdown(&title));
    markdown += &format!("Scored on {}.\n\n", text::markdown(&scored));
    let mut latex = format!("{LATEX_NOTE} MB are 10^6 bytes.\n% Scored on {}.\n", text::latex(&scored));
    if let Some(gap) = &gap {
        body += &format!("<p class=\"warning\">{}</p>\n", text::html(gap));
        markdown += &format!("{}\n\n", text::markdown(gap));
        latex += &format!("% {}\n", text::latex(gap));
    }
    for (i, (scene, rows)) in scenes.iter().enumerate() {
        let table = tables::summary(scene, rows, &columns, &trained);
        markdown += &table.markdown();
        latex += &table.latex();
        let class = if i == 0 { " class=\"first\"" } else { "" };
        body += &format!("<h2 id=\"scene-{i}\"{class}>{}</h2>\n", text::html(scene));
        body += &table.html();
        body += &charts::figures(rows, &key, &trained);
        if options.images == ImageChoice::All || (options.images == ImageChoice::BuiltIn && public.contains(scene)) {
            body += &images::gallery(folder, scene, rows, options.views)?;
        }
    }
    body += "<h2 id=\"protocols\">Protocols</h2>\n";
    body += &page::protocols(&results);
    body += &format!("<h2 id=\"published\">Reported by papers</h2>\n<p class=\"warning\">{}</p>\n<div class=\"reported\">\n", text::html(published::NOTICE));
    markdown += &format!("# Reported by papers\n\n{}\n\n", text::markdown(published::NOTICE));
    for table in published::tables()? {
        body += &format!("<h3>{}</h3>\n{}", text::html(&table.title), table.html());
        markdown += &table.markdown();
        latex += &table.latex();
    }
    body += "</div>\n";
    let mut figures: Vec<(String, String)> = scenes.iter().flat_map(|(scene, rows)| charts::files(scene, rows, &key, &trained)).collect();
    number_equals(&mut figures);
    Ok(Report { html: page::page(&title, &body), csv: tables::csv(&scenes), markdown, latex, figures, cells: results.len(), gap })
}

/// Numbers the second and later of equal names: they lack the punctuation and the case of their scenes.
fn number_equals(figures: &mut [(String, String)]) {
    let mut taken = std::collections::BTreeSet::new();
    for (name, _) in figures {
        let stem = name.trim_end_matches(".svg").to_string();
        let mut number = 1;
        while !taken.insert(name.clone()) {
            number += 1;
            *name = format!("{stem}-{number}.svg");
        }
    }
}

/// The quantities with these keys.
fn columns(keys: &[String]) -> Result<Vec<&'static Quantity>> {
    if keys.is_empty() {
        return Ok(QUANTITIES.iter().collect());
    }
    let all = || QUANTITIES.iter().map(|q| q.key).collect::<Vec<_>>().join(", ");
    let found = |key: &String| {
        QUANTITIES.iter().find(|q| q.key == key).ok_or_else(|| Error::parameter("--columns", format!("there is no '{key}'"), format!("Choose from {}", all())))
    };
    keys.iter().map(found).collect()
}

/// Refuses to replace files that are of no report. The tables are written beside the page, where others may lie, such as a README.md.
fn refuse_others(out: &Path) -> Result<()> {
    let starts = |extension: &str, start: &str| {
        refuse_other_content(&out.with_extension(extension), &format!("the .{extension} of a report"), |head| head.starts_with(start.as_bytes()))
    };
    starts("html", page::START)?;
    starts("csv", tables::CSV_START)?;
    starts("tex", LATEX_NOTE)?;
    // Its first line is the title.
    refuse_other_content(&out.with_extension("md"), "the .md of a report", |head| String::from_utf8_lossy(head).contains(MARKDOWN_NOTE))
}

/// Makes a report and writes the page to `out`, and the tables beside it as `.csv`, `.md` and `.tex`. Files of earlier reports are replaced, others are not.
///
/// # Errors
/// As [`report`], and [`Error::Io`]; [`Error::Parameter`] where `out` does not end in `.html`, and where a file exists that is of no report.
pub fn write_report(path: &Path, out: &Path, options: &ReportOptions) -> Result<ReportFiles> {
    if out.extension().is_none_or(|extension| extension != "html") {
        return Err(Error::parameter("--out", format!("{} does not end in .html", out.display()), "Name an HTML file; the tables are written beside it"));
    }
    refuse_others(out)?;
    let report = report(path, options)?;
    if let Some(folder) = &options.figures {
        let is_plot = |head: &[u8]| head.starts_with(b"<svg ");
        report.figures.iter().try_for_each(|(name, _)| refuse_other_content(&folder.join(name), "an SVG image", is_plot))?;
    }
    if let Some(folder) = out.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    }
    let write = |extension: &str, text: &str| {
        let file = out.with_extension(extension);
        write_atomically(&file, text.as_bytes()).map(|()| file)
    };
    let figures = match &options.figures {
        Some(folder) => {
            std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
            let write = |(name, svg): &(String, String)| write_atomically(folder.join(name), svg.as_bytes()).map(|()| folder.join(name));
            report.figures.iter().map(write).collect::<Result<Vec<PathBuf>>>()?
        }
        None => Vec::new(),
    };
    Ok(ReportFiles {
        figures,
        csv: write("csv", &report.csv)?,
        markdown: write("md", &report.markdown)?,
        latex: write("tex", &report.latex)?,
        html: write("html", &report.html)?,
        cells: report.cells,
        gap: report.gap,
        html_bytes: report.html.len(),
    })
}

#[cfg(test)]
mod tests;
