//! The weight codec `compact`: 8-bit integers with a scale per row, entropy coded.

use super::entropy::{Coder, Decoder, Encoder, Model, signed, symmetric};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{StreamSet, read_shapes, value_count, write_shapes};
use cc4dgs_format::{CodecContext, Error, Plugin, Result, Stream, WeightArray, WeightCodec, WeightCodecPlugin, config, inventory};
use serde::Deserialize;

/// Values per scale.
const ROW: usize = 64;
/// Largest code.
const PEAK: f64 = 127.0;
/// Scales are powers of 2^(1/8).
const PER_OCTAVE: f64 = 8.0;
/// Exponent of rows of zeros, below that of every other row.
const ZERO: i64 = -10_000;
const SHAPES: &str = "shapes";
const VALUES: &str = "values";
/// Values per byte of the stream that a decoder believes.
const PER_BYTE: usize = 4096;

struct Weights;

/// Codes the arrays in turn; each has models of its own, because their values differ.
fn code<C: Coder>(coder: &mut C, values: &mut [f32]) -> Result<()> {
    let (mut size, mut exponents, mut sign) = (Model::default(), Model::default(), Model::default());
    let mut last = 0;
    for row in values.chunks_mut(ROW) {
        let largest = row.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let wanted = if largest > 0.0 { libm::ceil(PER_OCTAVE * libm::log2(f64::from(largest) / PEAK)) as i64 } else { ZERO };
        let exponent = last + signed(coder, &mut exponents, &mut sign, wanted - last)?;
        if exponent == ZERO {
            row.fill(0.0);
            continue;
        }
        last = exponent;
        if exponent.abs() > 1200 {
            return Err(Error::data("compact weights", format!("a row has the exponent {exponent}"), "The file is damaged; fetch or write it again"));
        }
        let scale = libm::exp2(exponent as f64 / PER_OCTAVE);
        for value in row {
            let found = symmetric(coder, &mut size, (f64::from(*value) / scale).round() as i64)?;
            *value = ((found as f64 * scale) as f32).clamp(f32::MIN, f32::MAX);
        }
    }
    Ok(())
}

impl WeightCodec for Weights {
    fn encode(&self, weights: &[WeightArray], _: &CodecContext) -> Result<Vec<Stream>> {
        let (mut shapes, mut coder) = (Vec::new(), Encoder::default());
        write_shapes(weights, &mut shapes)?;
        weights.iter().try_for_each(|array| code(&mut coder, &mut array.values.clone()))?;
        Ok(vec![Stream { name: SHAPES.into(), bytes: shapes }, Stream { name: VALUES.into(), bytes: coder.finish() }])
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>> {
        let set = StreamSet::new("compact", streams);
        let (mut shapes, values): (ByteReader, ByteReader) = (set.reader(SHAPES)?, set.reader(VALUES)?);
        let mut arrays = read_shapes(&mut shapes)?;
        let most = values.remaining().saturating_mul(PER_BYTE);
        let total = arrays.iter().try_fold(0usize, |sum, a| sum.checked_add(value_count(&a.shape)?)).filter(|total| *total <= most);
        let Some(total) = total else { return Err(shapes.error(format!("the arrays do not fit the {} bytes of values", values.remaining()))) };
        shapes.finish()?;
        context.limits.check_bytes("deformer weights", 4 * total as u64)?;
        let mut coder = Decoder::new("compact stream 'values'", values.rest())?;
        for array in &mut arrays {
            array.values = vec![0.0; value_count(&array.shape).unwrap_or(0)];
            code(&mut coder, &mut array.values)?;
        }
        coder.finish()?;
        Ok(arrays)
    }
    fn loss(&self) -> f64 {
        // Half a step of a scale that is up to an eighth of an octave too large.
        0.5 * 1.0906 / PEAK + 1e-5
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {}

/// Keeps the plug-in in the program; see [`crate::link`].
pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
    let Settings {} = config::parse_section("weight-codec compact", settings)?;
    Ok(Box::new(Weights))
}

inventory::submit! {
    WeightCodecPlugin {
        info: Plugin {
            name: "compact",
            version: "1",
            summary: "8-bit integers with a scale per 64 values, entropy coded",
            paper: "row-wise symmetric quantisation; adaptive range coding (constriction)",
            schema: "# no settings\n",
            capabilities: &["lossy"],
        },
        build,
    }
}
