//! The HTML page: style, the script of the sliders, and the facts about how the results were made.

use super::text::html;
use crate::sweep::{CellResult, TrainingDevices};
use cc4dgs_core::plural;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// The page around `body`. Nothing is loaded from anywhere: the content security policy forbids it.
pub fn page(title: &str, body: &str) -> String {
    let title = html(title);
    format!("{START}<title>{title}</title>\n<style>\n{STYLE}</style></head><body>\n<h1>{title}</h1>\n{body}<script>\n{SCRIPT}</script>\n</body></html>\n")
}

/// What every page begins with.
pub const START: &str = "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'\">\n";

const STYLE: &str = concat!(include_str!("page.css"), include_str!("plot.css"));
const SCRIPT: &str = include_str!("page.js");

/// A line of contents.
pub fn contents(entries: &[(String, String)]) -> String {
    let links: Vec<String> = entries.iter().map(|(anchor, name)| format!("<a href=\"#{}\">{}</a>", html(anchor), html(name))).collect();
    format!("<nav>{}</nav>\n", links.join(" · "))
}

/// How the results were made: program, device, data, protocols.
pub fn facts(results: &[CellResult]) -> String {
    let set = |value: &dyn Fn(&CellResult) -> String| {
        let values: BTreeSet<String> = results.iter().map(value).collect();
        values.into_iter().collect::<Vec<_>>().join("; ")
    };
    let trainings: BTreeSet<&str> = results.iter().map(|r| r.training.as_str()).collect();
    let seeds: BTreeSet<u64> = results.iter().map(|r| r.axes.seed).collect();
    let commit = |r: &CellResult| if r.provenance.commit.is_empty() { "unknown".to_string() } else { r.provenance.commit.clone() };
    let device = |r: &CellResult| {
        let d = &r.provenance.device;
        let adapter = d.adapter.as_ref().map_or_else(String::new, |name| format!(" on {name}, driver {}", d.driver.as_deref().unwrap_or("unknown")));
        let (processor, threads) = (if d.processor.is_empty() { "unknown processor" } else { &d.processor }, plural(d.threads, "thread", "threads"));
        format!("{}{adapter}; {processor}, {} {threads}, {}", d.name, d.threads, d.system)
    };
    let data = |r: &CellResult| {
        let (data, frames) = (&r.provenance.data, plural(r.frames, "frame", "frames"));
        format!("{}: {} (xxh3 {}), {}, {} {frames}", r.axes.scene, data.path, data.hash, r.image_sizes(), r.frames)
    };
    let [cells, of] = [plural(results.len(), "cell", "cells"), plural(trainings.len(), "training", "trainings")];
    let mut rows = vec![
        ("sweep", set(&|r| r.sweep.clone())),
        (
            "results",
            format!("{} {cells} of {} {of}, seeds {}", results.len(), trainings.len(), seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", ")),
        ),
        ("program", set(&|r| format!("cc4dgs {}, commit {}", r.provenance.version, commit(r)))),
        ("device", set(&device)),
        ("scored", scored(results)),
        ("data", set(&data)),
    ];
    let trained = TrainingDevices::of(results).sentence();
    if !trained.is_empty() {
        rows.insert(4, ("training", trained));
    }
    let mut out = String::from("<table class=\"facts\">\n");
    for (name, value) in rows {
        _ = writeln!(out, "<tr><th>{name}</th><td>{}</td></tr>", html(&value));
    }
    out + "</table>\n"
}

/// Which images are scored: the side of the split, and of each scene how many of its images.
pub fn scored(results: &[CellResult]) -> String {
    let all = |r: &CellResult| r.metrics.values().find_map(|score| score.protocol.get("frames")?.get("of")?.as_u64());
    let of_scene = |r: &CellResult| {
        let (all, scored) = (all(r), r.images.len() as u64);
        let of = all.map_or_else(String::new, |count| format!(" of {count}"));
        format!("{} {scored}{of} {}", r.axes.scene, plural(all.unwrap_or(scored), "image", "images"))
    };
    let scenes: BTreeSet<String> = results.iter().map(of_scene).collect();
    let split = results.first().map_or_else(String::new, |r| format!("{:?}", r.split).to_lowercase());
    format!("{split} views: {}", scenes.into_iter().collect::<Vec<_>>().join("; "))
}

/// The protocol of every metric, from the results themselves.
pub fn protocols(results: &[CellResult]) -> String {
    let mut metrics: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    for (name, score) in results.iter().flat_map(|r| &r.metrics) {
        let stated = score.protocol.iter().filter(|(key, _)| *key != "frames");
        // Of the images only what is behind them: how many there are differs between scenes.
        let behind = score.protocol.get("frames").and_then(|frames| frames.get("background")).map(|value| ("background", value));
        let entries = stated.map(|(key, value)| (key.as_str(), value)).chain(behind).filter(|(_, value)| !value.is_null()).map(|(key, value)| {
            let text = value.as_str().map_or_else(|| value.to_string(), str::to_string);
            format!("{} {text}", key.replace('_', " "))
        });
        metrics.entry(name).or_default().insert(entries.collect::<Vec<_>>().join(", "));
    }
    let rows: String = metrics
        .iter()
        .map(|(name, texts)| format!("<tr><th>{}</th><td>{}</td></tr>\n", html(name), html(&texts.iter().cloned().collect::<Vec<_>>().join("; "))))
        .collect();
    format!(
        "<table class=\"facts\">\n{rows}</table>\n<p class=\"note\">MB are 10⁶ bytes of the archive on disk. Times are wall times on the device above, those of trainings on the devices stated for them, synchronised; a frame is the mean of all frames but the first. ↑ high is better, ↓ low is better; ± is the sample standard deviation over seeds.</p>\n"
    )
}
