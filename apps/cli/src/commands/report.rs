//! `cc4dgs report`.

use super::{Context, megabytes};
use crate::args::{ImagesArg, Report};
use cc4dgs_core::Result;
use cc4dgs_train::report::{ImageChoice, ReportOptions, write_report};

pub fn run(context: &Context, args: &Report) -> Result<()> {
    let images = match args.images {
        ImagesArg::None => ImageChoice::None,
        ImagesArg::BuiltIn => ImageChoice::BuiltIn,
        ImagesArg::All => ImageChoice::All,
    };
    let options = ReportOptions {
        title: args.title.clone(),
        images,
        views: usize::from(args.views),
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
        format!("{} ({:.2} MB) from {} results; tables: {tables}{gap}", files.html.display(), megabytes(files.html_bytes as u64), files.cells)
    })
}
