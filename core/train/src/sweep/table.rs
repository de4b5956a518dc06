//! Tables of results: mean and spread over seeds, as Markdown and CSV.

use super::mixture;
use super::read::check_comparable;
use super::result::{CellResult, Outcome};
use super::trained::{TrainingDevices, interrupted, trained_on};
use cc4dgs_core::{Error, Result, plural};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// Metrics that the Markdown table shows where they are measured, with their headings and decimals; the CSV table has all.
const SHOWN: [(&str, &str, usize); 6] = [
    ("psnr_db", "PSNR dB", 2),
    ("psnr_dynamic_db", "moving pixels dB", 2),
    ("ssim", "SSIM", 4),
    ("ms_ssim", "MS-SSIM", 4),
    ("lpips", "LPIPS", 4),
    ("flip", "FLIP", 4),
];

/// Near the beginning of the Markdown table, and at that of the CSV table.
pub(super) const NOTE: &str = "Mean and sample standard deviation over seeds.";
pub(super) const CSV_START: &str = "scene,method,setting,codec,seeds,";

/// A number of a result, where it has it.
type Number = fn(&CellResult) -> Option<f64>;

/// Values over seeds: mean, sample standard deviation, least and largest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation; `None` of one value.
    pub deviation: Option<f64>,
    /// The least value.
    pub low: f64,
    /// The largest value.
    pub high: f64,
}

impl Spread {
    /// Of `values`; `None` where there are none.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let values: Vec<f64> = values.into_iter().collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        (!values.is_empty()).then(|| Self { mean, deviation: (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt()), low, high })
    }
    /// `mean ± deviation` with so many decimals.
    pub fn text(&self, decimals: usize) -> String {
        match self.deviation {
            Some(deviation) => format!("{:.decimals$} ± {deviation:.decimals$}", self.mean),
            None => format!("{:.decimals$}", self.mean),
        }
    }
}

/// Results of one scene, method, setting and codec, over seeds.
struct Row<'a> {
    axes: [&'a str; 4],
    results: Vec<&'a CellResult>,
}

impl Row<'_> {
    /// Absent where a result lacks the number: a mean over some seeds would stand beside means over all.
    fn spread(&self, value: impl Fn(&CellResult) -> Option<f64>) -> Option<Spread> {
        Spread::of(self.results.iter().map(|r| value(r)).collect::<Option<Vec<f64>>>()?)
    }
}

fn rows(results: &[CellResult]) -> Result<Vec<Row<'_>>> {
    check_comparable(results)?;
    let mut rows: BTreeMap<[&str; 4], Vec<&CellResult>> = BTreeMap::new();
    for result in results {
        let a = &result.axes;
        let same = rows.entry([&a.scene, &a.method, &a.setting, &a.codec]).or_default();
        if let Some(other) = same.iter().find(|other| other.axes.seed == a.seed) {
            let axes = format!("{} {} {} {} seed {}", a.scene, a.method, a.setting, a.codec, a.seed);
            let problem = format!("the cells {} and {} have the same values on all axes of a grid ({axes})", other.id, result.id);
            return Err(Error::data("table of results", problem, "Make a table of each sweep or version of the program"));
        }
        same.push(result);
    }
    Ok(rows.into_iter().map(|(axes, results)| Row { axes, results }).collect())
}

/// A Markdown table per scene, and the conditions under which they were measured. Where trainings ran on different devices, their times are marked.
///
/// # Errors
/// As [`check_comparable`], and [`Error::Data`] for two results with the same values on all axes of a grid.
pub fn markdown(results: &[CellResult]) -> Result<String> {
    let rows = rows(results)?;
    let Some(first) = results.first() else { return Ok(String::new()) };
    let metrics: Vec<_> = SHOWN.into_iter().filter(|(name, ..)| results.iter().any(|r| r.metrics.contains_key(*name))).collect();
    let mut text = format!("# {}\n\n", first.sweep);
    let trained = TrainingDevices::of(results);
    let sentence = trained.sentence();
    let device = &first.provenance.device;
    let adapter = device.adapter.as_ref().map_or_else(String::new, |adapter| format!(" on {adapter}"));
    let commits: BTreeSet<&str> = results.iter().map(|r| r.provenance.commit.as_str()).collect();
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "{NOTE} Device {}{adapter}, {}, {} {}, {}. Commit {}. Scored on {} views, images rounded to 8 bits. \
         Seconds and milliseconds are wall time on that machine; MB are 10^6 bytes.{}{sentence}",
        device.name,
        if device.processor.is_empty() { "unknown processor" } else { &device.processor },
        device.threads,
        plural(device.threads, "thread", "threads"),
        device.system,
        commits.into_iter().collect::<Vec<_>>().join(", "),
        format!("{:?}", first.split).to_lowercase(),
        if sentence.is_empty() { "" } else { " " },
    );
    let scenes: BTreeSet<&str> = rows.iter().map(|row| row.axes[0]).collect();
    for scene in scenes {
        let of_scene: Vec<&Row> = rows.iter().filter(|row| row.axes[0] == scene).collect();
        let one = of_scene[0].results[0];
        let images = plural(one.images.len(), "image", "images");
        let _ = writeln!(text, "\n## {scene}\n\n{} {images} of {}.\n", one.images.len(), one.image_sizes());
        let mut headings = vec!["method", "setting", "codec", "seeds"];
        headings.extend(metrics.iter().map(|m| m.1));
        headings.extend(["MB", "Gaussians", "training s", "encode s", "decode s", "frame ms", ""]);
        let _ = writeln!(text, "| {} |\n|{}", headings.join(" | "), " --- |".repeat(headings.len()));
        for row in &of_scene {
            let shown = |spread: Option<Spread>, decimals| spread.map_or_else(|| "-".to_string(), |s| s.text(decimals));
            let mut cells: Vec<String> = row.axes[1..].iter().map(ToString::to_string).collect();
            cells.push(row.results.len().to_string());
            cells.extend(metrics.iter().map(|(name, _, decimals)| shown(row.spread(|r| r.metrics.get(*name).map(|s| s.value)), *decimals)));
            cells.push(shown(row.spread(|r| Some(r.size_mb())), 3));
            cells.push(shown(row.spread(|r| Some(r.gaussians as f64)), 0));
            cells.push(shown(row.spread(|r| Some(r.cost.training_seconds)), 1) + &trained.mark(&row.results));
            cells.push(shown(row.spread(|r| Some(r.cost.encode_seconds)), 2));
            cells.push(shown(row.spread(|r| Some(r.cost.decode_seconds)), 2));
            cells.push(shown(row.spread(|r| Some(r.cost.frame_ms.mean)), 2));
            let hopeless = row.results.iter().filter(|r| r.outcome == Outcome::Hopeless).count();
            cells.push(if hopeless > 0 { format!("{hopeless} hopeless") } else { String::new() });
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        }
        let named = || of_scene.iter().map(|row| (format!("{} {}", row.axes[1], row.axes[2]), row.results.as_slice()));
        for note in mixture::notes(named()).into_iter().chain(mixture::kept_out(named())).chain(interrupted(named())) {
            let _ = writeln!(text, "\n{note}");
        }
    }
    Ok(text)
}

/// One CSV table of all results: mean and deviation over seeds of every metric, and what the trainings ran on.
///
/// # Errors
/// As [`markdown`].
pub fn csv(results: &[CellResult]) -> Result<String> {
    type Value = dyn Fn(&CellResult) -> Option<f64>;
    let rows = rows(results)?;
    let metrics: BTreeSet<&String> = results.iter().flat_map(|r| r.metrics.keys()).collect();
    let mut columns: Vec<(String, Box<Value>)> = Vec::new();
    for name in metrics {
        let key = name.clone();
        columns.push((name.clone(), Box::new(move |r: &CellResult| r.metrics.get(&key).map(|s| s.value))));
    }
    let fixed: [(&str, Number); 15] = [
        ("worst_block_psnr_db", |r| r.blocks.map(|b| b.worst_psnr_db)),
        ("lost_blocks", |r| r.blocks.map(|b| b.lost)),
        ("size_mb", |r| Some(r.size_mb())),
        ("deform_mb", |r| Some(r.storage.deform_bytes as f64 / 1e6)),
        ("point_cloud_mb", |r| Some(r.storage.point_cloud_bytes as f64 / 1e6)),
        ("gaussians", |r| Some(r.gaussians as f64)),
        ("dynamic_gaussians", |r| Some(r.dynamic_gaussians as f64)),
        ("iterations", |r| Some(r.iterations as f64)),
        ("training_seconds", |r| Some(r.cost.training_seconds)),
        ("encode_seconds", |r| Some(r.cost.encode_seconds)),
        ("decode_seconds", |r| Some(r.cost.decode_seconds)),
        ("frame_ms", |r| Some(r.cost.frame_ms.mean)),
        ("training_peak_memory_mb", |r| r.cost.training_peak_memory_mb),
        ("cell_peak_memory_mb", |r| r.cost.cell_peak_memory_mb),
        ("hopeless", |r| Some(f64::from(u8::from(r.outcome == Outcome::Hopeless)))),
    ];
    columns.extend(fixed.into_iter().map(|(name, value)| (name.to_string(), Box::new(value) as Box<Value>)));
    let names = columns.iter().map(|(name, _)| format!("{name},{name}_sd"));
    let mut text = format!("{CSV_START}{},training_devices\n", names.collect::<Vec<_>>().join(","));
    for row in rows {
        let number = |value: Option<f64>| value.map_or_else(String::new, |v| format!("{v}"));
        let values = columns.iter().map(|(_, value)| {
            let spread = row.spread(value);
            format!("{},{}", number(spread.map(|s| s.mean)), number(spread.and_then(|s| s.deviation)))
        });
        let (axes, devices) = (row.axes.map(csv_field).join(","), csv_field(&trained_on(&row.results)));
        let _ = writeln!(text, "{axes},{},{},{devices}", row.results.len(), values.collect::<Vec<_>>().join(","));
    }
    Ok(text)
}

/// A field of a CSV table. Text that a spreadsheet would compute (it begins with `=`, `+`, `-` or `@` and is no number) gets an apostrophe.
pub(crate) fn csv_field(text: &str) -> String {
    let formula = text.starts_with(['=', '+', '-', '@', '\t', '\r']) && text.parse::<f64>().is_err();
    let text = if formula { format!("'{text}") } else { text.to_string() };
    if text.contains(['"', ',', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text }
}

#[cfg(test)]
mod tests {
    use super::super::read::tests::cell;
    use super::*;

    fn two_seeds() -> Vec<CellResult> {
        let with = |id: &str, seed, psnr: f64| {
            cell(id, |r| {
                r.axes.seed = seed;
                r.metrics.get_mut("psnr_db").unwrap().value = psnr;
            })
        };
        vec![with("a", 0, 30.0), with("b", 1, 32.0), cell("c", |r| (r.axes.codec, r.outcome) = ("raw".into(), Outcome::Hopeless))]
    }

    #[test]
    fn spreads_are_sample_deviations() {
        assert_eq!(Spread::of([]), None);
        assert_eq!(Spread::of([3.0]), Some(Spread { mean: 3.0, deviation: None, low: 3.0, high: 3.0 }));
        let spread = Spread::of([1.0, 2.0, 3.0, 6.0]).unwrap();
        assert_eq!((spread.mean, spread.low, spread.high), (3.0, 1.0, 6.0));
        assert!((spread.deviation.unwrap() - (14.0f64 / 3.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn tables_join_seeds() {
        let results = two_seeds();
        let table = markdown(&results).unwrap();
        assert!(table.contains("| cdf | base | cca | 2 | 31.00 ± 1.41 |") && table.contains("| cdf | base | raw | 1 | 31.25 |"), "{table}");
        assert!(table.contains("1 hopeless") && table.contains("flex") && table.contains("1 image of 400x400"), "{table}");
        assert!(!table.contains("LPIPS"), "no result has it: {table}");
        let various: Vec<CellResult> = results.iter().cloned().map(|r| CellResult { sizes_differ: true, ..r }).collect();
        assert!(markdown(&various).unwrap().contains("1 image of various sizes."));
        let csv = csv(&results).unwrap();
        let lines: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
        assert!(lines.len() == 3 && lines.iter().all(|line| line.len() == lines[0].len()), "{csv}");
        let psnr = lines[0].iter().position(|name| *name == "psnr_db").unwrap();
        assert_eq!((lines[1][4], lines[1][psnr], lines[2][psnr + 1]), ("2", "31", ""));
        // One of two seeds lacks a metric: the mean of the other is not the row's.
        let mut gap = results;
        gap[1].metrics.remove("ssim");
        assert!(markdown(&gap).unwrap().contains("| cdf | base | cca | 2 | 31.00 ± 1.41 | - |"));
    }

    #[test]
    fn trainings_on_other_devices_are_stated() {
        let mut results = two_seeds();
        assert!(!markdown(&results).unwrap().contains("Training times"), "all ran where they were scored");
        results[1].cost.training_devices.clear();
        assert!(!markdown(&results).unwrap().contains("Training times"), "older results do not say");
        (results[0].training, results[0].cost.training_devices[0].device.threads) = ("other".into(), 8);
        let table = markdown(&results).unwrap();
        assert!(table.contains("Training times are wall times on [1] flex, Example processor, 1 thread, linux x86_64, host node-1 (trainings: 1)"), "{table}");
        assert!(table.contains("; [2] flex, Example processor, 8 threads, linux x86_64, host node-1 (trainings: 1);"), "{table}");
        // Of the two seeds of one row, one does not say.
        assert!(table.contains("| 180.2 ± 0.0 [2, ?] |") && table.contains("| 180.2 [1] |"), "{table}");
        assert!(csv(&results).unwrap().lines().nth(1).unwrap().ends_with(",flex; Example processor; 8 threads; linux x86_64"));
    }

    #[test]
    fn interruptions_and_views_that_were_kept_out_are_stated() {
        let mut results = two_seeds();
        let table = markdown(&results).unwrap();
        assert!(!table.contains("interrupted") && !table.contains("train.validation"), "{table}");
        results[2].axes.method = "hexplane".into();
        results[2].cost.resumed = 2;
        results[2].provenance.configuration = serde_json::json!({ "train": { "validation": 12 } });
        let table = markdown(&results).unwrap();
        assert!(table.contains("\n\nTraining times of trainings that were interrupted") && table.contains(": hexplane base (2 interruptions)."), "{table}");
        assert!(table.contains("; hexplane base 12."), "{table}");
    }

    #[test]
    fn fields_of_csv_end_where_they_should() {
        assert_eq!(
            ["a,b", "say \"x\"", "=1+1", "-3.5", "plain"].map(csv_field),
            ["\"a,b\"", "\"say \"\"x\"\"\"", "'=1+1", "-3.5", "plain"].map(str::to_string)
        );
    }

    #[test]
    fn mixtures_have_no_table() {
        let mut results = two_seeds();
        results[1].provenance.device.name = "wgpu".into();
        assert!(markdown(&results).unwrap_err().to_string().contains("devices") && csv(&results).is_err());
        let mut results = two_seeds();
        results[1].axes.seed = 0;
        assert!(markdown(&results).unwrap_err().to_string().contains("same values"));
    }
}
