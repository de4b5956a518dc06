//! Puts the results of a sweep together: checks that every cell is there exactly once, and makes the tables.

use super::folder::SweepFolder;
use super::lines::write_lines;
use super::plan::Plan;
use super::read::RESULTS;
use super::result::{Axes, CellResult, KIND};
use super::table::{CSV_START, NOTE, csv, markdown};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::{Error, Result, plural};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Most missing cells that an error names.
const NAMED: usize = 8;

/// A cell without a result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Missing {
    /// The cell.
    pub cell: String,
    /// Its values on the axes of the grid.
    pub axes: String,
    /// Why it is missing.
    pub reason: String,
}

/// How complete a sweep is.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Collection {
    /// Results of the plan's cells, in its order.
    #[serde(skip)]
    pub results: Vec<CellResult>,
    /// Number of results.
    pub finished: usize,
    /// Cells of the plan.
    pub planned: usize,
    /// Cells without a result.
    pub missing: Vec<Missing>,
    /// Files in the folder of results that are of no cell of the plan, by name.
    pub foreign: Vec<String>,
}

/// What [`write_tables`] wrote.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Tables {
    /// All results of the sweep, one per line, as `docs/results.md` describes.
    pub results: PathBuf,
    /// Markdown.
    pub markdown: PathBuf,
    /// CSV.
    pub csv: PathBuf,
}

/// Looks for the result of every cell of `plan`. Names of the grid are no part of a cell: results of an earlier plan get those of this one, in their files as
/// well.
///
/// # Errors
/// [`Error::Io`].
pub fn collect(folder: &SweepFolder, plan: &Plan) -> Result<Collection> {
    let trainings: BTreeMap<&str, _> = plan.trainings.iter().map(|t| (t.id.as_str(), t)).collect();
    let (mut results, mut missing) = (Vec::new(), Vec::new());
    let mut states: BTreeMap<&str, String> = BTreeMap::new();
    for cell in &plan.cells {
        match folder.finished(cell) {
            Some(mut result) => {
                if let Some(training) = trainings.get(cell.training.as_str()) {
                    let (scene, method, setting) = (training.scene.clone(), training.method.clone(), training.setting.clone());
                    let axes = Axes { scene, method, setting, codec: cell.codec.clone(), seed: training.seed };
                    if result.axes != axes || result.sweep != plan.name {
                        (result.axes, result.sweep) = (axes, plan.name.clone());
                        result.write(&folder.result(&cell.id))?;
                    }
                }
                results.push(result);
            }
            None => {
                let state = states.entry(&cell.training).or_insert_with(|| folder.state(&cell.training));
                let damaged = if folder.result(&cell.id).exists() { "its file is damaged; " } else { "" };
                let axes = trainings.get(cell.training.as_str()).map_or_else(String::new, |t| format!("{} {}", t.label(), cell.codec));
                missing.push(Missing { cell: cell.id.clone(), axes, reason: format!("{damaged}{state}") });
            }
        }
    }
    let own: BTreeSet<String> = plan.cells.iter().map(|cell| format!("{}.json", cell.id)).collect();
    let inner = folder.root().join(RESULTS);
    let mut foreign = Vec::new();
    if inner.is_dir() {
        for entry in std::fs::read_dir(&inner).map_err(|e| Error::io(&inner, e))? {
            let name = entry.map_err(|e| Error::io(&inner, e))?.file_name().to_string_lossy().into_owned();
            // Hidden files are writes that were cut off.
            if !own.contains(&name) && !name.starts_with('.') {
                foreign.push(name);
            }
        }
    }
    foreign.sort();
    Ok(Collection { finished: results.len(), planned: plan.cells.len(), results, missing, foreign })
}

impl Collection {
    /// What tables of an incomplete sweep say about it; `None` of a complete one.
    pub fn gap(&self) -> Option<String> {
        let named: Vec<&str> = self.missing.iter().take(NAMED).map(|m| m.axes.as_str()).collect();
        let more = self.missing.len().saturating_sub(NAMED);
        let rest = if more > 0 { format!("; and {more} more") } else { String::new() };
        let (count, are) = (self.missing.len(), plural(self.missing.len(), "is", "are"));
        (count > 0).then(|| format!("{count} of {} cells of the sweep {are} missing: {}{rest}.", self.planned, named.join("; ")))
    }
    /// Refuses a sweep that is not complete.
    ///
    /// # Errors
    /// [`Error::Data`] that names missing cells and why they are missing.
    pub fn check_complete(&self, folder: &SweepFolder) -> Result<()> {
        if self.missing.is_empty() {
            return Ok(());
        }
        let named: Vec<String> = self.missing.iter().take(NAMED).map(|m| format!("{} ({}): {}", m.cell, m.axes, m.reason)).collect();
        let more = self.missing.len().saturating_sub(NAMED);
        let rest = if more > 0 { format!("; and {more} more") } else { String::new() };
        let (count, are) = (self.missing.len(), plural(self.missing.len(), "is", "are"));
        let problem = format!("{count} of {} cells {are} missing: {}{rest}", self.planned, named.join("; "));
        let remedy = "Run it again: cc4dgs sweep run DIR does what is missing and nothing else; --partial makes tables of what is there";
        Err(Error::data(format!("sweep {}", folder.root().display()), problem, remedy))
    }
}

/// Writes all `results` (one file, a line each) and the tables of those that are `shown` into the sweep's folder; `gap` is what the Markdown says is missing
/// ([`Collection::gap`]). Earlier files of these kinds are replaced, others are not.
///
/// # Errors
/// As [`markdown`], and [`Error::Io`]; [`Error::Parameter`] where a file of another kind has one of the names.
pub fn write_tables(folder: &SweepFolder, results: &[CellResult], shown: &[CellResult], gap: Option<&str>) -> Result<Tables> {
    let at = |name: &str| folder.root().join(name);
    let tables = Tables { results: at("results.jsonl"), markdown: at("table.md"), csv: at("table.csv") };
    let kind = format!("{{\"kind\":\"{KIND}\"");
    refuse_other_content(&tables.results, "a file of results", |head| head.starts_with(kind.as_bytes()))?;
    refuse_other_content(&tables.markdown, "the table of a sweep", |head| String::from_utf8_lossy(head).contains(NOTE))?;
    refuse_other_content(&tables.csv, "the table of a sweep", |head| head.starts_with(CSV_START.as_bytes()))?;
    // Results are written even where they do not belong into one table.
    write_atomically(&tables.results, write_lines(results)?.as_bytes())?;
    let (mut table, comma_separated) = (markdown(shown)?, csv(shown)?);
    if let Some(gap) = gap {
        table = table.replacen("\n\n", &format!("\n\n{gap}\n\n"), 1);
    }
    write_atomically(&tables.markdown, table.as_bytes())?;
    write_atomically(&tables.csv, comma_separated.as_bytes())?;
    Ok(tables)
}

/// The keys that [`select`] knows.
const KEYS: [&str; 10] = ["scene", "method", "setting", "codec", "seed", "device", "adapter", "processor", "threads", "split"];

/// The results that `conditions` ask for, each `KEY=VALUE` with one of the keys scene, method, setting, codec, seed, device, adapter, processor, threads and
/// split. Several values of one key are alternatives; all keys must hold.
///
/// # Errors
/// [`Error::Parameter`] for other keys, and for conditions that no result meets.
pub fn select(results: Vec<CellResult>, conditions: &[String]) -> Result<Vec<CellResult>> {
    let mut wanted: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for condition in conditions {
        let pair = condition.split_once('=').filter(|(key, _)| KEYS.contains(key));
        let remedy = || format!("Write KEY=VALUE with one of the keys {}", KEYS.join(", "));
        let (key, value) = pair.ok_or_else(|| Error::parameter("--where", format!("'{condition}' is no condition"), remedy()))?;
        wanted.entry(key).or_default().push(value);
    }
    let of = |r: &CellResult, key: &str| match key {
        "scene" => r.axes.scene.clone(),
        "method" => r.axes.method.clone(),
        "setting" => r.axes.setting.clone(),
        "codec" => r.axes.codec.clone(),
        "seed" => r.axes.seed.to_string(),
        "device" => r.provenance.device.name.clone(),
        "adapter" => r.provenance.device.adapter.clone().unwrap_or_default(),
        "processor" => r.provenance.device.processor.clone(),
        "threads" => r.provenance.device.threads.to_string(),
        _ => format!("{:?}", r.split).to_lowercase(),
    };
    let mut kept = results;
    for (key, values) in wanted {
        let present: BTreeSet<String> = kept.iter().map(|r| of(r, key)).collect();
        kept.retain(|r| values.contains(&of(r, key).as_str()));
        if kept.is_empty() {
            let known = present.into_iter().collect::<Vec<_>>().join(", ");
            return Err(Error::parameter("--where", format!("no result has {key}={}", values.join(" or ")), format!("There are: {known}")));
        }
    }
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::super::plan::tests::example as plan;
    use super::super::read::tests::cell;
    use super::*;

    #[test]
    fn what_is_missing_is_named_with_its_reason() {
        let root = tempfile::tempdir().unwrap();
        let folder = SweepFolder::new(root.path());
        folder.create().unwrap();
        let plan = plan();
        let all: Vec<CellResult> = plan
            .cells
            .iter()
            .map(|planned| {
                cell(&planned.id, |r| {
                    r.training.clone_from(&planned.training);
                    r.axes.codec.clone_from(&planned.codec);
                })
            })
            .collect();
        all[0].write(&folder.result(&all[0].id)).unwrap();
        std::fs::write(folder.result(&all[1].id), "{").unwrap();
        std::fs::write(root.path().join("results/other.json"), "{}").unwrap();
        let partial = collect(&folder, &plan).unwrap();
        assert_eq!((partial.finished, partial.planned, partial.foreign.as_slice()), (1, 2, &["other.json".to_string()][..]));
        let message = partial.check_complete(&folder).unwrap_err().to_string();
        assert!([all[1].id.as_str(), "tiny own base seed 0 half", "damaged", "not begun"].iter().all(|part| message.contains(part)), "{message}");
        let gap = partial.gap().unwrap();
        assert_eq!(gap, "1 of 2 cells of the sweep is missing: tiny own base seed 0 half.");
        let tables = write_tables(&folder, &partial.results, &partial.results, Some(&gap)).unwrap();
        assert!(std::fs::read_to_string(tables.markdown).unwrap().contains(&format!("\n\n{gap}\n\n")));
        all[1].write(&folder.result(&all[1].id)).unwrap();
        let complete = collect(&folder, &plan).unwrap();
        complete.check_complete(&folder).unwrap();
        assert_eq!(complete.gap(), None);
        // Names are those of the plan, also in the files.
        let renamed = |r: &CellResult| (r.id.clone(), r.training.clone(), r.metrics.clone());
        assert_eq!(complete.results.iter().map(renamed).collect::<Vec<_>>(), all.iter().map(renamed).collect::<Vec<_>>());
        assert!(complete.results.iter().all(|r| (r.axes.method.as_str(), r.axes.setting.as_str()) == ("own", "base") && r.sweep == plan.name));
        assert_eq!(collect(&folder, &plan).unwrap(), complete);
        // Tables may be of some results; the file of results has all.
        for (shown, has_first) in [(&complete.results[1..], false), (&complete.results[..], true)] {
            let tables = write_tables(&folder, &complete.results, shown, None).unwrap();
            assert_eq!(super::super::read_results(&tables.results).unwrap().len(), 2);
            let table = std::fs::read_to_string(tables.markdown).unwrap();
            assert!(table.contains("| half |") && table.contains("| raw |") == has_first, "{table}");
        }
    }

    #[test]
    fn tables_replace_tables_only() {
        let root = tempfile::tempdir().unwrap();
        let (folder, results) = (SweepFolder::new(root.path()), [cell("a", |_| ())]);
        // What an incomplete sweep says comes before the note that tells a table.
        let gap = "a missing cell; ".repeat(200);
        let make = || write_tables(&folder, &results, &results, Some(&gap));
        let Tables { results: lines, markdown, csv } = make().unwrap();
        for file in [lines, markdown, csv] {
            let made = std::fs::read(&file).unwrap();
            std::fs::write(&file, "# Mine\n").unwrap();
            let message = make().unwrap_err().to_string();
            assert!(message.contains(&file.display().to_string()) && message.contains("exists already"), "{message}");
            assert_eq!(std::fs::read_to_string(&file).unwrap(), "# Mine\n");
            std::fs::write(&file, made).unwrap();
        }
        make().unwrap();
    }

    #[test]
    fn conditions_select() {
        let results = || vec![cell("a", |r| r.axes.seed = 0), cell("b", |r| r.axes.seed = 7)];
        let of = |conditions: &[&str]| select(results(), &conditions.iter().map(ToString::to_string).collect::<Vec<_>>());
        assert_eq!(of(&[]).unwrap().len(), 2);
        assert_eq!(of(&["seed=7", "device=flex"]).unwrap()[0].id, "b");
        assert_eq!(of(&["seed=7", "seed=0", "split=test", "processor=Example processor"]).unwrap().len(), 2);
        assert!(of(&["threads=97"]).unwrap_err().to_string().contains("threads=97"));
        assert!(of(&["seed=8"]).unwrap_err().to_string().contains("0, 7"));
        assert!(of(&["sead=8"]).unwrap_err().to_string().contains("one of the keys"));
        assert!(of(&["seed"]).unwrap_err().to_string().contains("KEY=VALUE"));
    }
}
