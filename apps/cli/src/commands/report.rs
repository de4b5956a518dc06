//! `cc4dgs report`.

use super::{Context, megabytes};
use crate::args::{ImagesArg, Report};
use crate::ignored::{Stated, refuse_ignored};
use cc4dgs_core::{Result, plural};
use cc4dgs_train::report::{ImageChoice, ReportOptions, write_report};

/// Default of --views.
const VIEWS: u16 = 3;

pub fn run(context: &Context, args: &Report) -> Result<()> {
    let (value, remedy) = (args.views.map(|views| views.to_string()), "Leave it out, or choose other --images".into());
    refuse_ignored("a page without images", [Stated { option: "--views", value, used: args.images != ImagesArg::None, remedy }])?;
    let images = match args.images {
        ImagesArg::None => ImageChoice::None,
        ImagesArg::BuiltIn => ImageChoice::BuiltIn,
        ImagesArg::All => ImageChoice::All,
    };
    let options = ReportOptions {
        title: args.title.clone(),
        images,
        views: usize::from(args.views.unwrap_or(VIEWS)),
        only: args.only.clone(),
        columns: args.columns.clone(),
        figures: args.figures.clone(),
    };
    let out = args.out.clone().unwrap_or_else(|| match args.results.is_dir() {
        true => args.results.join("report.html"),
        false => args.results.with_extension("html"),
    });
    let files = write_report(&args.results, &out, &options)?;
    context.output.result(&files, || {
        let tables = [&files.csv, &files.markdown, &files.latex].map(|file| file.display().to_string()).join(", ");
        let gap = files.gap.as_ref().map_or_else(String::new, |gap| format!("\n{gap}"));
        let results = format!("{} {}", files.cells, plural(files.cells, "result", "results"));
        format!("{} ({:.2} MB) from {results}; tables: {tables}{gap}", files.html.display(), megabytes(files.html_bytes as u64))
    })
}
