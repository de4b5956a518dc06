//! `quantize`: each component of each attribute quantised separately and uniformly between percentiles. No training; the baseline for lossy codecs.

use crate::morton;
use cc4dgs_format::storage::{
    ESCAPES, HARMONICS, Shape, assemble, close,
    column::{self, Column, Target},
    interleave, load, open, skip, split, stage_of_column, store,
};
use cc4dgs_format::{
    AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, HostGaussians, Plugin, Result, Stream, StreamStage, config, inventory, unknown_name,
};
use serde::Deserialize;

/// Version of the stored form.
const VERSION: u8 = 2;
/// Share of the values at either end that may be stored exactly, as outliers.
const TAIL: f64 = 1e-3;
/// Upper bound on the step, in standard deviations times 2^-bits; a wider step takes more bits. Percentiles of long-tailed values lie some ten deviations
/// apart.
const SPREAD: f64 = 8.0;

pub(crate) const SCHEMA: &str = "\
means = 16               # bits per coordinate of a centre; here and below, 32 stores float32
log_scales = 8
quaternions = 8
opacity_logits = 8
sh_dc = 8
sh_rest = 6
dynamic_scores = 8
";

/// The names of the settings: the columns of [`HostGaussians`].
const COLUMNS: [&str; 7] = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "dynamic_scores"];

/// Bits per component of each attribute.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Bits {
    means: u8,
    log_scales: u8,
    quaternions: u8,
    opacity_logits: u8,
    sh_dc: u8,
    sh_rest: u8,
    dynamic_scores: u8,
}

impl Default for Bits {
    fn default() -> Self {
        Self { means: 16, log_scales: 8, quaternions: 8, opacity_logits: 8, sh_dc: 8, sh_rest: 6, dynamic_scores: 8 }
    }
}

impl Bits {
    /// The bits of a column of [`HostGaussians`], by name.
    fn of(&self, column: &str) -> u8 {
        match column {
            "means" => self.means,
            "log_scales" => self.log_scales,
            "quaternions" => self.quaternions,
            "opacity_logits" => self.opacity_logits,
            "sh_dc" => self.sh_dc,
            "sh_rest" => self.sh_rest,
            _ => self.dynamic_scores,
        }
    }
    /// Encodes one component of the column `name`.
    pub(crate) fn encode(&self, name: &str, values: &[f32]) -> Column {
        match self.of(name) {
            32 => column::encode_exact(values),
            bits => column::encode(values, Target { bits, mu_law: false, loss: loss(bits), tail: TAIL }),
        }
    }
    pub(crate) fn losses(&self) -> Vec<DeclaredLoss> {
        let lossy = COLUMNS.into_iter().filter(|c| self.of(c) != 32);
        lossy.map(|c| DeclaredLoss { attribute: c.into(), relative_rms: loss(self.of(c)) }).collect()
    }
    /// The bits of a profile, overridden by `settings`; `codec` is the name in errors.
    pub(crate) fn from_settings(codec: &str, profile: &str, settings: &toml::Table) -> Result<Self> {
        let base = match profile {
            "" | "default" => Self::default(),
            "high" => Self { means: 16, log_scales: 10, quaternions: 10, opacity_logits: 10, sh_dc: 12, sh_rest: 8, dynamic_scores: 12 },
            _ => return Err(unknown_name(&format!("profile of codec {codec}"), profile, ["default", "high"].into_iter())),
        };
        let mut section = toml::Table::new();
        for column in COLUMNS {
            section.insert(column.into(), i64::from(base.of(column)).into());
        }
        config::merge(&mut section, settings);
        let bits: Self = config::parse_section(&format!("codec {codec}"), &section)?;
        for column in COLUMNS {
            let wanted = bits.of(column);
            if !(4..=16).contains(&wanted) && wanted != 32 {
                return Err(Error::parameter(format!("codec {codec}.{column}"), format!("{wanted} bits"), "Choose 4 to 16, or 32 for float32"));
            }
        }
        Ok(bits)
    }
}

/// Largest root-mean-square error of a column at `bits` bits, over its standard deviation; 32 bits are exact.
fn loss(bits: u8) -> f64 {
    if bits == 32 { 0.0 } else { SPREAD / f64::from(1u32 << bits) }
}

struct Quantize {
    bits: Bits,
}

impl AttributeCodec for Quantize {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        // In Morton order neighbours in the streams are similar, which Zstandard exploits.
        let sorted = gaussians.select(&morton::order(&gaussians.means));
        let (mut meta, mut escapes) = (vec![VERSION], Vec::new());
        Shape::of(&sorted).write(&mut meta)?;
        let mut streams = Vec::new();
        for (name, width, values) in sorted.columns() {
            let columns: Vec<_> = split(values, width).iter().map(|c| self.bits.encode(name, c)).collect();
            streams.push(Stream { name: name.into(), bytes: store(&columns, &mut meta, &mut escapes) });
        }
        Ok(assemble(&sorted, meta, escapes, streams))
    }

    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        decode(streams, context, true)
    }
    fn stage(&self, name: &str) -> StreamStage {
        stage_of_column(name)
    }
    fn decode_stage(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        decode(streams, context, false)
    }

    fn losses(&self) -> Vec<DeclaredLoss> {
        self.bits.losses()
    }
}

/// Without `harmonics`, their streams are not read, and the column is zeros.
fn decode(streams: &[Stream], context: &CodecContext, harmonics: bool) -> Result<HostGaussians> {
    let (set, mut meta, shape) = open("quantize", streams, VERSION, &context.limits)?;
    let mut escapes = set.reader(ESCAPES)?;
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    for (name, width, values) in out.columns_mut() {
        *values = if name == HARMONICS && !harmonics {
            skip(shape.count, width, &mut meta, &mut escapes)?
        } else {
            interleave(&load(set.reader(name)?, shape.count, width, &mut meta, &mut escapes)?, shape.count)
        };
    }
    close(&set, &shape, [meta, escapes], out, &context.limits)
}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    Ok(Box::new(Quantize { bits: Bits::from_settings("quantize", profile, settings)? }))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "quantize",
            version: "2",
            summary: "each component quantised separately to 4 to 16 bits, or float32, no training",
            paper: "uniform quantisation",
            schema: SCHEMA,
            capabilities: &["lossy", "reorders", "profiles=default,high"],
        },
        build,
    }
}
