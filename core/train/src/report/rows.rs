//! Results grouped into rows: one per scene, method, setting and codec, with the seeds as its spread.

use crate::sweep::{CellResult, Spread};
use cc4dgs_core::{Error, Result};
use std::collections::BTreeMap;

/// Which values of a quantity are better.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Better {
    /// High ones.
    Higher,
    /// Low ones.
    Lower,
    /// Neither.
    Neither,
}

/// A number that every result may have.
#[derive(Clone, Copy)]
pub struct Quantity {
    /// Its name in machine-readable tables.
    pub key: &'static str,
    /// Its name for people.
    pub name: &'static str,
    /// Its unit; empty for numbers without one.
    pub unit: &'static str,
    /// Decimals in tables.
    pub digits: usize,
    /// Which values are better.
    pub better: Better,
    value: fn(&CellResult) -> Option<f64>,
}

fn metric(cell: &CellResult, name: &str) -> Option<f64> {
    cell.metrics.get(name).map(|score| score.value)
}

macro_rules! quantities {
    ($($id:ident: $key:literal, $name:literal, $unit:literal, $digits:literal, $better:ident, $value:expr;)*) => {
        $(#[doc = $name] pub const $id: Quantity = Quantity { key: $key, name: $name, unit: $unit, digits: $digits, better: Better::$better, value: $value };)*
        /// All quantities, in the order of table columns.
        pub const QUANTITIES: &[Quantity] = &[$($id),*];
    };
}

quantities! {
    PSNR: "psnr_db", "PSNR", "dB", 2, Higher, |c| metric(c, "psnr_db");
    PSNR_DYNAMIC: "psnr_dynamic_db", "PSNR, moving pixels", "dB", 2, Higher, |c| metric(c, "psnr_dynamic_db");
    SSIM: "ssim", "SSIM", "", 4, Higher, |c| metric(c, "ssim");
    MS_SSIM: "ms_ssim", "MS-SSIM", "", 4, Higher, |c| metric(c, "ms_ssim");
    LPIPS: "lpips", "LPIPS", "", 4, Lower, |c| metric(c, "lpips");
    FLIP: "flip", "FLIP", "", 4, Lower, |c| metric(c, "flip");
    SIZE: "size_mb", "size", "MB", 3, Lower, |c| Some(c.size_mb());
    GAUSSIAN_BYTES: "bytes_per_gaussian", "bytes per Gaussian", "", 1, Lower, |c| (c.gaussians > 0).then(|| c.storage.point_cloud_bytes as f64 / c.gaussians as f64);
    FRAME: "frame_ms", "frame time", "ms", 2, Lower, |c| Some(c.cost.frame_ms.mean);
    TRAINING: "training_minutes", "training time", "min", 2, Lower, |c| Some(c.cost.training_seconds / 60.0);
    ENCODE: "encode_s", "encoding time", "s", 2, Lower, |c| Some(c.cost.encode_seconds);
    DECODE: "decode_s", "decoding time", "s", 2, Lower, |c| Some(c.cost.decode_seconds);
    TRAINING_MEMORY: "training_peak_memory_mb", "peak memory of the training", "MB", 0, Lower, |c| c.cost.training_peak_memory_mb;
    CELL_MEMORY: "cell_peak_memory_mb", "peak memory of codec and scoring", "MB", 0, Lower, |c| c.cost.cell_peak_memory_mb;
    GAUSSIANS: "gaussians", "Gaussians", "", 0, Neither, |c| Some(c.gaussians as f64);
    MOVING: "dynamic_gaussians", "moving Gaussians", "", 0, Neither, |c| Some(c.dynamic_gaussians as f64);
    ITERATIONS: "iterations", "iterations", "", 0, Neither, |c| Some(c.iterations as f64);
}

/// Larger numbers than any measurement has: what lies beyond is damage.
const MOST: f64 = 1e12;

impl Quantity {
    /// The value of one result, if it has one.
    pub fn of(&self, cell: &CellResult) -> Option<f64> {
        (self.value)(cell)
    }
    /// Name and unit, such as `PSNR (dB)`.
    pub fn title(&self) -> String {
        if self.unit.is_empty() { self.name.to_string() } else { format!("{} ({})", self.name, self.unit) }
    }
}

/// A codec at one rate, or at all of its rates.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Rates<'a> {
    /// `NAME[:PROFILE]`.
    One(&'a str),
    /// The name, and the key that states the rate (`max-drop` of `compact:max-drop=0.05dB`); empty for profiles with a name alone.
    All(&'a str, &'a str),
}

impl<'a> Rates<'a> {
    /// All rates of `codec` (`NAME[:PROFILE]`). Only numbers are rates: a codec with another value in its profile is joined with no other.
    fn all(codec: &'a str) -> Self {
        let (name, profile) = codec.split_once(':').unwrap_or((codec, ""));
        match profile.split_once('=') {
            None => Self::All(name, ""),
            Some((key, value)) if value.starts_with(|c: char| c.is_ascii_digit() || c == '.') => Self::All(name, key),
            Some(_) => Self::All(codec, ""),
        }
    }
}

/// What the points of one line of rate and distortion have in common: everything but the rate of one codec, or but the setting.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct RateCurve<'a> {
    method: &'a str,
    /// None where the line joins settings.
    setting: Option<&'a str>,
    /// The codec of the Gaussians.
    gaussians: Rates<'a>,
    /// What was set beside its profile.
    settings: String,
    /// The weight codec.
    weights: Rates<'a>,
}

/// The results that differ in their seed alone.
#[derive(Clone, Debug)]
pub struct Row<'a> {
    /// The dataset.
    pub scene: &'a str,
    /// How it was trained.
    pub method: &'a str,
    /// Changes of the method.
    pub setting: &'a str,
    /// How it is stored.
    pub codec: &'a str,
    /// In the order of their seeds; at least one.
    pub cells: Vec<&'a CellResult>,
}

impl<'a> Row<'a> {
    /// The quantity over seeds; absent where a result lacks it, so that no mean hides a gap.
    pub fn spread(&self, quantity: &Quantity) -> Option<Spread> {
        let values: Option<Vec<f64>> = self.cells.iter().map(|cell| quantity.of(cell)).collect();
        Spread::of(values?)
    }
    /// Method, and setting where it is not the base.
    pub fn training(&self) -> String {
        if self.setting == "base" { self.method.to_string() } else { format!("{}, {}", self.method, self.setting) }
    }
    /// Training and codec.
    pub fn name(&self) -> String {
        format!("{} / {}", self.training(), self.codec)
    }
    /// The lines that this row may be a point of: along the rate of the codec of its Gaussians, and along that of its weight codec. The grid's name of the
    /// codec may be anything.
    pub(super) fn rate_curves(&self) -> [RateCurve<'a>; 2] {
        let choice = &self.cells[0].provenance.codec;
        let curve =
            |gaussians, weights| RateCurve { method: self.method, setting: Some(self.setting), gaussians, settings: choice.settings.to_string(), weights };
        [curve(Rates::all(&choice.codec), Rates::One(&choice.field_weights)), curve(Rates::One(&choice.codec), Rates::all(&choice.field_weights))]
    }
    /// The line along the settings of the method, such as sizes of its deformer, stored as this row is.
    pub(super) fn setting_curve(&self) -> RateCurve<'a> {
        let choice = &self.cells[0].provenance.codec;
        let (gaussians, weights) = (Rates::One(&choice.codec), Rates::One(&choice.field_weights));
        RateCurve { method: self.method, setting: None, gaussians, settings: choice.settings.to_string(), weights }
    }
    /// The rows that share a training with this one have equal keys.
    pub fn training_key(&self) -> (&'a str, &'a str) {
        (self.method, self.setting)
    }
    /// Whether a training ended below simple baselines.
    pub fn hopeless(&self) -> bool {
        self.cells.iter().any(|cell| cell.outcome == crate::sweep::Outcome::Hopeless)
    }
}

/// Groups results by scene, in the order of their axes.
///
/// # Errors
/// [`Error::Data`] for two results of the same axes, and for numbers that no measurement gives.
pub fn rows(results: &[CellResult]) -> Result<BTreeMap<&str, Vec<Row<'_>>>> {
    let mut ordered: Vec<&CellResult> = results.iter().collect();
    ordered.sort_by(|a, b| a.axes.cmp(&b.axes).then_with(|| a.id.cmp(&b.id)));
    if let Some(pair) = ordered.windows(2).find(|pair| pair[0].axes == pair[1].axes) {
        let a = &pair[0].axes;
        return Err(Error::data(
            format!("{} {} {} {} seed {}", a.scene, a.method, a.setting, a.codec, a.seed),
            format!("two results, {} of commit {:?} and {} of commit {:?}", pair[0].id, pair[0].provenance.commit, pair[1].id, pair[1].provenance.commit),
            "Keep the results of one program and one configuration in a folder",
        ));
    }
    let mut scenes: BTreeMap<&str, Vec<Row>> = BTreeMap::new();
    for cell in ordered {
        check(cell)?;
        let axes = &cell.axes;
        let rows = scenes.entry(&axes.scene).or_default();
        match rows.last_mut().filter(|r| (r.method, r.setting, r.codec) == (axes.method.as_str(), axes.setting.as_str(), axes.codec.as_str())) {
            Some(row) => row.cells.push(cell),
            None => rows.push(Row { scene: &axes.scene, method: &axes.method, setting: &axes.setting, codec: &axes.codec, cells: vec![cell] }),
        }
    }
    Ok(scenes)
}

fn check(cell: &CellResult) -> Result<()> {
    let named = QUANTITIES.iter().filter_map(|q| Some((q.key, q.of(cell)?)));
    let frame = &cell.cost.frame_ms;
    let others = [frame.field, frame.raster, frame.field_first, frame.raster_first].into_iter().map(|v| ("frame_ms", v));
    let stages = cell.cost.stage_seconds.values().map(|v| ("stage_seconds", *v));
    let curve = cell.curve.psnr_db.iter().chain(&cell.cost.curve_seconds).map(|v| ("curve", *v));
    let validation = cell.validation_curve.psnr_db.iter().chain(&cell.cost.validation_seconds).map(|v| ("validation_curve", *v));
    let images = cell.images.iter().flat_map(|image| image.scores.values()).map(|v| ("images", *v));
    let mut all = named.chain(others).chain(stages).chain(curve).chain(validation).chain(images);
    match all.find(|(_, v)| !v.is_finite() || v.abs() > MOST) {
        Some((key, value)) => Err(Error::data(format!("result {}", cell.id), format!("{key} is {value:e}"), "Remove the file and run the cell again")),
        None => Ok(()),
    }
}
