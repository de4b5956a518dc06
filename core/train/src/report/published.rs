//! Numbers that papers report (`published.toml`). They are shown beside results and never ranked with them.

use super::tables::{Cell, Table};
use cc4dgs_core::{Error, Result};
use serde::Deserialize;

const TEXT: &str = include_str!("published.toml");

/// Said above the numbers of papers, wherever they are shown.
pub const NOTICE: &str = "Reported, not run: numbers of papers with resolution, hardware, frames and definitions of their own. This program did not compute them, and they are not comparable with the tables above, nor with each other across sources.";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    table: Vec<Source>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Source {
    dataset: String,
    source: String,
    rows: Vec<Reported>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Reported {
    method: String,
    #[serde(default)]
    psnr: String,
    #[serde(default)]
    ssim: String,
    #[serde(default)]
    lpips: String,
    #[serde(default)]
    size: String,
    #[serde(default)]
    fps: String,
    #[serde(default)]
    training: String,
}

/// One table per dataset, with the source of every row.
///
/// # Errors
/// [`Error::Backend`] if the file that was built in is damaged.
pub fn tables() -> Result<Vec<Table>> {
    let file: File = toml::from_str(TEXT).map_err(|e| Error::backend("published.toml", e.to_string(), "Report this"))?;
    let mut tables: Vec<Table> = Vec::new();
    for source in file.table {
        let title = format!("{} (reported, not run)", source.dataset);
        if tables.last().is_none_or(|t| t.title != title) {
            let head = ["method", "PSNR (dB)", "SSIM", "LPIPS", "size (MB)", "frames/s", "training", "source"];
            tables.push(Table { title, head: head.map(str::to_string).to_vec(), text_columns: vec![0, 7], rows: Vec::new(), notes: Vec::new() });
        }
        let Some(table) = tables.last_mut() else { continue };
        for row in source.rows {
            let numbers =
                [row.psnr, row.ssim, row.lpips, row.size, row.fps, row.training].map(|text| Cell::plain(if text.is_empty() { "–".into() } else { text }));
            table.rows.push([vec![Cell::plain(row.method)], numbers.into(), vec![Cell::plain(source.source.clone())]].concat());
        }
    }
    Ok(tables)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_has_a_source_and_is_marked() {
        let tables = tables().unwrap();
        assert!(tables.len() >= 5);
        for table in &tables {
            assert!(table.title.ends_with("(reported, not run)") && !table.rows.is_empty());
            assert!(table.rows.iter().all(|row| row.len() == table.head.len() && row.last().unwrap().text.len() > 10 && row.iter().all(|c| !c.best)));
        }
        let text = format!("{tables:?}");
        assert!(text.contains("CC-4DGS (CDF + CCA)") && text.contains("29.67"));
    }
}
