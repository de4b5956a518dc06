//! The plots of a scene, made from its rows.

use super::bars::{Bars, Strips};
use super::legend::{Entry, training_swatch};
use super::pareto::front;
use super::plot::{Axis, COLOURS, Plot, Point, Series, marker};
use super::rows::{Better, DECODE, ENCODE, FRAME, LPIPS, PSNR, Quantity, RateCurve, Row, SIZE, SSIM, TRAINING};
use super::text::html;
use crate::sweep::{CellResult, TrainingDevices, interrupted};
use std::collections::{BTreeMap, BTreeSet};

/// One colour per training, with dots where there are more trainings than colours, and one marker per codec, the same in all plots of a report.
#[derive(Debug)]
pub struct Key {
    trainings: Vec<String>,
    codecs: Vec<String>,
}

impl Key {
    /// Of all rows of a report.
    pub fn of<'a>(rows: impl Iterator<Item = &'a Row<'a>>) -> Self {
        let (trainings, codecs): (BTreeSet<String>, BTreeSet<String>) = rows.map(|row| (row.training(), row.codec.to_string())).unzip();
        Self { trainings: trainings.into_iter().collect(), codecs: codecs.into_iter().collect() }
    }
    /// Index of the colour of a training.
    pub fn colour(&self, row: &Row) -> usize {
        self.trainings.iter().position(|name| *name == row.training()).unwrap_or(0)
    }
    fn marker(&self, row: &Row) -> usize {
        self.codecs.iter().position(|name| name == row.codec).unwrap_or(0)
    }
    /// The trainings with their indices and names; those that failed on the scene of `rows` say so.
    fn named(&self, rows: &[Row]) -> Vec<(usize, String)> {
        let failed: BTreeSet<usize> = rows.iter().filter(|row| row.hopeless()).map(|row| self.colour(row)).collect();
        let named = |(i, name): (usize, &String)| (i, if failed.contains(&i) { format!("{name} (failed)") } else { name.clone() });
        self.trainings.iter().enumerate().map(named).collect()
    }
    /// What the colours of a plot of `rows` mean.
    fn colours(&self, plot: &Plot, rows: &[Row]) -> Vec<Entry> {
        let shown = self.named(rows).into_iter().filter(|(i, _)| shows(plot, |s| s.colour == *i));
        shown.map(|(i, name)| Entry { colour: Some(i), marker: None, name }).collect()
    }
    /// What the markers of a plot mean.
    fn markers(&self, plot: &Plot) -> Vec<Entry> {
        let entry = |(i, name): (usize, &String)| Entry { colour: None, marker: Some(i), name: name.clone() };
        self.codecs.iter().enumerate().filter(|(i, _)| shows(plot, |s| s.marker == Some(*i))).map(entry).collect()
    }
    /// What colours and shapes mean in the plots of `rows`.
    fn legend(&self, rows: &[Row]) -> String {
        let colours: String = self.named(rows).into_iter().map(|(i, name)| training_swatch(i, &name)).collect();
        let shape =
            |i: usize, name: &String| format!("<span><svg viewBox=\"0 0 14 14\" class=\"swatch\">{}</svg>{}</span> ", marker(i, 7.0, 7.0, "#333"), html(name));
        let shapes: String = self.codecs.iter().enumerate().map(|(i, name)| shape(i, name)).collect();
        let repeated = match self.trainings.len() > COLOURS.len() {
            true => "<p class=\"note\">Trainings of one colour differ in the dots below their markers and between the dashes of their lines.</p>",
            false => "",
        };
        format!("<p class=\"legend\"><i>training:</i> {colours}</p><p class=\"legend\"><i>codec:</i> {shapes}</p>{repeated}\n")
    }
}

/// Whether one of the series that `plot` shows is as asked.
fn shows(plot: &Plot, asked: impl Fn(&Series) -> bool) -> bool {
    plot.series.iter().any(|s| !s.points.is_empty() && asked(s))
}

/// The plots of a scene that have something to show.
#[derive(Debug)]
struct Plots {
    rate: Vec<Plot>,
    cost: Vec<Plot>,
    progress: Vec<Plot>,
}

impl Plots {
    fn of(rows: &[Row], key: &Key, trained: &TrainingDevices) -> Self {
        let best: Vec<Row> = best_codecs(rows).into_iter().cloned().collect();
        let costs = |metric| {
            [(&FRAME, rows), (&TRAINING, &best), (&ENCODE, rows), (&DECODE, rows), (&SIZE, rows)].map(|(cost, rows)| pareto(rows, cost, metric, key, trained))
        };
        let shown = |plots: &mut dyn Iterator<Item = Plot>| plots.filter(|plot| !plot.is_empty()).collect();
        Self {
            rate: shown(&mut [&PSNR, &SSIM, &LPIPS].into_iter().map(|metric| rate_distortion(rows, metric, key))),
            cost: shown(&mut [&PSNR, &LPIPS].into_iter().flat_map(costs)),
            progress: shown(
                &mut [training_curves(rows, key, None), training_curves(rows, key, Some(trained)), validation_curves(rows, key, trained), per_frame(rows, key)]
                    .into_iter(),
            ),
        }
    }
}

/// The plots of a scene as SVG files with legends, by name.
pub(super) fn files(scene: &str, rows: &[Row], key: &Key, trained: &TrainingDevices) -> Vec<(String, String)> {
    let plots = Plots::of(rows, key, trained);
    let name = |plot: &Plot| {
        let text = format!("{scene} {}", plot.title).to_lowercase();
        text.split(|c: char| !c.is_alphanumeric()).filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-") + ".svg"
    };
    let of_trainings = |plot: &Plot| key.colours(plot, rows);
    let of_points = |plot: &Plot| [key.colours(plot, rows), key.markers(plot)].concat();
    let file = |plot: &Plot, legend: Vec<Entry>| (name(plot), plot.file(&format!("{scene}: {}", plot.title), &legend));
    let points = plots.rate.iter().chain(&plots.cost).map(|plot| file(plot, of_points(plot)));
    points.chain(plots.progress.iter().map(|plot| file(plot, of_trainings(plot)))).collect()
}

/// All figures of a scene but images, as HTML.
pub(super) fn figures(rows: &[Row], key: &Key, trained: &TrainingDevices) -> String {
    let plots = |plots: &[Plot]| grid("", plots.iter().map(Plot::figure).collect());
    let Plots { rate, cost, progress } = Plots::of(rows, key, trained);
    let note = "A point is the mean over seeds, its whisker the least and the largest seed. A line joins points of one training that differ in the rate of one codec alone: that of the Gaussians, or that of the deformer's weights. Where a method is stored by one codec, a line joins its settings, without trainings that failed.";
    let mut out = heading("Rate and distortion", note) + &key.legend(rows);
    out += &plots(&rate);

    let note = "Ringed points are on the Pareto front: nothing here is better in one of the two without being worse in the other; trainings that failed are left out. Left is cheaper. Training time is shown with the codec of the highest PSNR.";
    out += &(heading("Time and size against error", note) + &key.legend(rows));
    out += &plots(&cost);

    out += &heading("Where time and bytes go", "");
    out += &grid(" bars", [stage_bars(rows, trained), frame_bars(rows), storage_bars(rows)].map(|bars| bars.figure()).concat());
    out += &(heading("Training, frames, seeds", "") + &key.legend(rows));
    out += &plots(&progress);
    if rows.iter().any(|row| row.cells.len() > 1) {
        let values = |row: &Row| row.cells.iter().filter_map(|cell| PSNR.of(cell)).collect();
        let lines = rows.iter().map(|row| (row.name(), key.colour(row), values(row))).collect();
        out += &grid(" bars", Strips { title: "Every seed, and the mean".into(), axis: PSNR.title(), lines }.figure());
    }
    out
}

/// What stands below a plot of times of trainings: the devices where they differ, with the mark of each training, and which trainings were interrupted. Nothing
/// where their times are comparable.
fn times_note(rows: &[Row], trained: &TrainingDevices) -> String {
    let (trainings, mut parts) = (trainings(rows), Vec::new());
    if trained.differ() {
        let marks: Vec<String> = trainings.iter().map(|row| row.training() + &trained.mark(&row.cells)).collect();
        parts.push(format!("{} Here: {}.", trained.sentence(), marks.join("; ")));
    }
    parts.extend(interrupted(trainings.iter().map(|row| (row.training(), row.cells.as_slice()))));
    parts.join(" ")
}

fn heading(title: &str, note: &str) -> String {
    let note = if note.is_empty() { String::new() } else { format!("<p class=\"note\">{note}</p>\n") };
    format!("<h3>{title}</h3>\n{note}")
}

fn grid(class: &str, figures: String) -> String {
    format!("<div class=\"figures{class}\">\n{figures}</div>\n")
}

fn point(row: &Row, cost: &Quantity, metric: &Quantity) -> Option<Point> {
    let (x, y) = (row.spread(cost)?, row.spread(metric)?);
    let failed = if row.hopeless() { " (failed)" } else { "" };
    let hint = format!("{}{failed}: {} {}, {} {}", row.name(), x.text(cost.digits), cost.title(), y.text(metric.digits), metric.title());
    Some(Point { x: x.mean, y: y.mean, y_range: Some((y.low, y.high)), hint })
}

fn points(rows: &[Row], cost: &Quantity, metric: &Quantity, key: &Key) -> Vec<Series> {
    let series = |row: &Row| {
        let points = point(row, cost, metric).into_iter().collect();
        Series { colour: key.colour(row), marker: Some(key.marker(row)), line: false, points }
    };
    rows.iter().map(series).collect()
}

fn metric_axis(metric: &Quantity) -> Axis {
    let arrow = if metric.better == Better::Lower { ", lower is better" } else { "" };
    Axis::linear(format!("{}{arrow}", metric.title()))
}

fn rate_distortion(rows: &[Row], metric: &Quantity, key: &Key) -> Plot {
    let mut curves: BTreeMap<RateCurve, Vec<(usize, Point)>> = BTreeMap::new();
    for row in rows {
        let Some(point) = point(row, &SIZE, metric) else { continue };
        // Settings of a method that is stored in one way are points of a line, too. With several codecs there would be a line for each of them.
        let one_codec = rows.iter().all(|other| other.method != row.method || other.codec == row.codec);
        let setting_curve = (one_codec && !row.hopeless()).then(|| row.setting_curve());
        for curve in row.rate_curves().into_iter().chain(setting_curve) {
            curves.entry(curve).or_default().push((key.colour(row), point.clone()));
        }
    }
    let mut series: Vec<Series> = curves
        .into_values()
        .filter(|points| points.len() > 1)
        .map(|mut points| {
            points.sort_by(|a, b| a.1.x.total_cmp(&b.1.x));
            Series { colour: points[0].0, marker: None, line: true, points: points.into_iter().map(|(_, p)| p).collect() }
        })
        .collect();
    series.extend(points(rows, &SIZE, metric, key));
    Plot {
        title: format!("Rate and distortion: {}", metric.name),
        x: Axis::ranged("archive (MB)"),
        y: metric_axis(metric),
        series,
        front: Vec::new(),
        note: String::new(),
    }
}

/// Trainings that failed are no part of the front. Where the trainings ran on different devices, their times are marked and have no front.
fn pareto(rows: &[Row], cost: &Quantity, metric: &Quantity, key: &Key, trained: &TrainingDevices) -> Plot {
    let means: Vec<(f64, f64)> = rows.iter().filter(|row| !row.hopeless()).filter_map(|row| point(row, cost, metric)).map(|p| (p.x, p.y)).collect();
    let mut best: Vec<(f64, f64)> = front(&means, metric.better == Better::Lower).into_iter().map(|i| means[i]).collect();
    let (mut series, mut note) = (points(rows, cost, metric, key), String::new());
    if cost.key == TRAINING.key {
        note = times_note(rows, trained);
    }
    if cost.key == TRAINING.key && trained.differ() {
        best.clear();
        for (row, own) in rows.iter().zip(&mut series) {
            own.points.iter_mut().for_each(|point| point.hint += &format!(", trained on{}", trained.mark(&row.cells)));
        }
    }
    Plot { title: format!("{} against {}", metric.name, cost.name), x: Axis::ranged(cost.title()), y: metric_axis(metric), series, front: best, note }
}

/// A row per training, with a cell per seed: all codecs share the training, and those of a sweep that is not complete may lack some of its seeds.
fn trainings<'a>(rows: &[Row<'a>]) -> Vec<Row<'a>> {
    let mut found: Vec<Row<'a>> = Vec::new();
    for row in rows {
        match found.iter_mut().find(|other| other.training_key() == row.training_key()) {
            Some(other) => {
                let more = row.cells.iter().filter(|cell| other.cells.iter().all(|known| known.axes.seed != cell.axes.seed));
                let more: Vec<&'a CellResult> = more.copied().collect();
                other.cells.extend(more);
                other.cells.sort_by_key(|cell| cell.axes.seed);
            }
            None => found.push(row.clone()),
        }
    }
    found
}

/// The row of each training with the highest mean PSNR.
pub fn best_codecs<'r, 'a>(rows: &'r [Row<'a>]) -> Vec<&'r Row<'a>> {
    let psnr = |row: &Row| row.spread(&PSNR).map_or(f64::NEG_INFINITY, |s| s.mean);
    let best = |training: Row<'a>| {
        let of_training = rows.iter().filter(|row| row.training_key() == training.training_key());
        of_training.reduce(|best, row| if psnr(row) > psnr(best) { row } else { best })
    };
    trainings(rows).into_iter().filter_map(best).collect()
}

fn mean(row: &Row, value: impl Fn(&CellResult) -> f64) -> f64 {
    row.cells.iter().map(|cell| value(cell).max(0.0)).sum::<f64>() / row.cells.len() as f64
}

fn stage_bars(rows: &[Row], trained: &TrainingDevices) -> Bars {
    let mut stages: Vec<String> = ["coarse", "score", "main"].map(str::to_string).to_vec();
    let named: BTreeSet<&String> = rows.iter().flat_map(|row| &row.cells).flat_map(|cell| cell.cost.stage_seconds.keys()).collect();
    stages.retain(|stage| named.contains(stage));
    let others: Vec<String> = named.into_iter().filter(|stage| !stages.contains(stage)).cloned().collect();
    stages.extend(others);
    let stage_sum = |cell: &CellResult| cell.cost.stage_seconds.values().sum::<f64>();
    let values = |row: &Row| {
        let mut parts: Vec<f64> = stages.iter().map(|stage| mean(row, |cell| cell.cost.stage_seconds.get(stage).copied().unwrap_or(0.0))).collect();
        parts.push(mean(row, |cell| cell.cost.training_seconds - stage_sum(cell)));
        parts
    };
    let lines = trainings(rows).iter().map(|row| (row.training(), values(row))).collect();
    let parts = stages.iter().cloned().chain(["reading, checks, saving".to_string()]).collect();
    Bars { title: "Training by stage, mean over seeds".into(), axis: "wall time (s)".into(), parts, lines, note: times_note(rows, trained) }
}

fn frame_bars(rows: &[Row]) -> Bars {
    let values = |row: &Row| vec![mean(row, |cell| cell.cost.frame_ms.field), mean(row, |cell| cell.cost.frame_ms.raster)];
    let lines = best_codecs(rows).into_iter().map(|row| (row.name(), values(row))).collect();
    let parts = ["deformer", "rasterizer"].map(str::to_string).to_vec();
    Bars { title: "A frame after the first, median; codec with the highest PSNR".into(), axis: "time (ms)".into(), parts, lines, note: String::new() }
}

fn storage_bars(rows: &[Row]) -> Bars {
    let values = |row: &Row| {
        let part = |bytes: fn(&CellResult) -> u64| mean(row, |cell| bytes(cell) as f64 / 1e6);
        let other = |cell: &CellResult| cell.storage.total_bytes.saturating_sub(cell.storage.deform_bytes).saturating_sub(cell.storage.point_cloud_bytes);
        vec![part(|cell| cell.storage.deform_bytes), part(|cell| cell.storage.point_cloud_bytes), part(other)]
    };
    let lines = rows.iter().map(|row| (row.name(), values(row))).collect();
    let parts = ["deformer", "Gaussians", "header and metadata"].map(str::to_string).to_vec();
    Bars { title: "Archive by part, mean over seeds".into(), axis: "size (MB)".into(), parts, lines, note: String::new() }
}

/// By iteration, or by time where `times` says what the trainings ran on.
fn training_curves(rows: &[Row], key: &Key, times: Option<&TrainingDevices>) -> Plot {
    let mut series = Vec::new();
    for row in &trainings(rows) {
        for cell in &row.cells {
            let x = |i: usize| if times.is_some() { cell.cost.curve_seconds[i] / 60.0 } else { cell.curve.iteration[i] as f64 };
            let points = cell.curve.psnr_db.iter().enumerate().map(|(i, y)| Point { x: x(i), y: *y, y_range: None, hint: String::new() }).collect();
            series.push(Series { colour: key.colour(row), marker: None, line: true, points });
        }
    }
    let (title, x) = if times.is_some() {
        ("Training views by time, a line per seed", "wall time (min)")
    } else {
        ("Training views by iteration, a line per seed", "iteration")
    };
    let note = times.map_or_else(String::new, |trained| times_note(rows, trained));
    Plot { title: title.into(), x: Axis::linear(x), y: Axis::linear("PSNR of training views (dB)"), series, front: Vec::new(), note }
}

/// What stands below a plot of validation views where the trainings kept other numbers of views out: their lines are then of other views. Else nothing.
fn views_note(rows: &[Row]) -> String {
    let kept_out = |cell: &&CellResult| cell.provenance.configuration.pointer("/train/validation").map_or_else(|| "?".to_string(), ToString::to_string);
    let of = |row: &Row| -> BTreeSet<String> { row.cells.iter().filter(|cell| !cell.validation_curve.psnr_db.is_empty()).map(kept_out).collect() };
    let counts: Vec<(String, BTreeSet<String>)> = trainings(rows).iter().map(|row| (row.training(), of(row))).filter(|(_, own)| !own.is_empty()).collect();
    if counts.iter().flat_map(|(_, own)| own).collect::<BTreeSet<_>>().len() < 2 {
        return String::new();
    }
    let named: Vec<String> = counts.iter().map(|(name, own)| format!("{name} {}", own.iter().cloned().collect::<Vec<_>>().join(", "))).collect();
    format!("Lines of trainings with other numbers of validation views (train.validation) are of other views and do not compare: {}.", named.join("; "))
}

/// By time: of views that were kept out of the trainings, where some were.
fn validation_curves(rows: &[Row], key: &Key, trained: &TrainingDevices) -> Plot {
    let line = |cell: &CellResult| -> Vec<Point> {
        let columns = cell.cost.validation_seconds.iter().zip(&cell.validation_curve.psnr_db);
        columns.map(|(seconds, psnr)| Point { x: seconds / 60.0, y: *psnr, y_range: None, hint: String::new() }).collect()
    };
    let of = |row: &Row| row.cells.iter().map(|cell| Series { colour: key.colour(row), marker: None, line: true, points: line(cell) }).collect::<Vec<_>>();
    Plot {
        title: "Validation views by time, a line per seed".into(),
        x: Axis::linear("wall time (min)"),
        y: Axis::linear("PSNR of validation views (dB)"),
        series: trainings(rows).iter().flat_map(of).collect(),
        front: Vec::new(),
        note: format!("{} {}", views_note(rows), times_note(rows, trained)).trim().into(),
    }
}

fn per_frame(rows: &[Row], key: &Key) -> Plot {
    let mut series = Vec::new();
    for row in best_codecs(rows) {
        let mut frames: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        for image in row.cells.iter().flat_map(|cell| &cell.images) {
            if let Some(psnr) = image.scores.get(PSNR.key) {
                let (sum, count) = frames.entry(image.frame).or_default();
                (*sum, *count) = (*sum + psnr, *count + 1.0);
            }
        }
        let point = |(frame, (sum, count)): (usize, (f64, f64))| Point { x: frame as f64, y: sum / count, y_range: None, hint: String::new() };
        let points: Vec<Point> = frames.into_iter().map(point).collect();
        if points.len() > 1 {
            series.push(Series { colour: key.colour(row), marker: None, line: true, points });
        }
    }
    let title = "Held-out views over the sequence, mean over cameras and seeds".into();
    Plot { title, x: Axis::linear("frame"), y: Axis::linear(PSNR.title()), series, front: Vec::new(), note: String::new() }
}
