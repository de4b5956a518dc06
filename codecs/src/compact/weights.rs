//! The weight codec `compact`: integers of few bits with a scale per row, entropy coded.

use super::entropy::{Coder, Decoder, Encoder, Tables, signed, symmetric};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{StreamSet, read_shapes, value_count, write_shapes};
use cc4dgs_format::{CodecContext, Error, Plugin, Result, Stream, WeightArray, WeightCodec, WeightCodecPlugin, config, inventory};
use serde::Deserialize;

/// Values per scale.
const ROW: usize = 64;
/// Bits of a code, and how many there may be.
const BITS: u32 = 10;
const RANGE: std::ops::RangeInclusive<u32> = 3..=12;
/// Arrays with distributions of their own.
const ARRAYS: usize = 1000;
/// Largest exponent of a scale in magnitude: those of the smallest and the largest floats fit.
const EXPONENT_LIMIT: i64 = 1300;
/// Scales are powers of 2^(1/8).
const PER_OCTAVE: f64 = 8.0;
/// Exponent of rows of zeros, below that of every other row.
const ZERO: i64 = -10_000;
const SHAPES: &str = "shapes";
const VALUES: &str = "values";
/// Values per byte of the stream that a decoder believes.
const PER_BYTE: usize = 4096;

struct Weights {
    /// Largest code.
    peak: f64,
}

fn contexts(arrays: usize) -> usize {
    3 * arrays.min(ARRAYS)
}

/// Codes the array `index`, whose largest code is `peak`; each has distributions of its own, because their values differ.
fn code<C: Coder>(coder: &mut C, index: usize, peak: f64, values: &mut [f32]) -> Result<()> {
    let size = 3 * index.min(ARRAYS - 1);
    let (exponents, sign) = (size + 1, size + 2);
    let mut last = 0;
    for row in values.chunks_mut(ROW) {
        let largest = row.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let wanted = if largest > 0.0 { libm::ceil(PER_OCTAVE * libm::log2(f64::from(largest) / peak)) as i64 } else { ZERO };
        let exponent = last + signed(coder, exponents, sign, wanted - last)?;
        if exponent == ZERO {
            row.fill(0.0);
            continue;
        }
        last = exponent;
        if exponent.abs() > EXPONENT_LIMIT {
            return Err(Error::data("compact weights", format!("a row has the exponent {exponent}"), "The file is damaged; fetch or write it again"));
        }
        let scale = libm::exp2(exponent as f64 / PER_OCTAVE);
        for value in row {
            let found = symmetric(coder, size, (f64::from(*value) / scale).round() as i64)?;
            *value = ((found as f64 * scale) as f32).clamp(f32::MIN, f32::MAX);
        }
    }
    Ok(())
}

impl WeightCodec for Weights {
    fn encode(&self, weights: &[WeightArray], _: &CodecContext) -> Result<Vec<Stream>> {
        let (mut shapes, mut coder) = (Vec::new(), Encoder::default());
        write_shapes(weights, &mut shapes)?;
        weights.iter().enumerate().try_for_each(|(k, array)| code(&mut coder, k, self.peak, &mut array.values.clone()))?;
        let (tables, mut values) = Tables::fit(contexts(weights.len()), std::slice::from_ref(&coder));
        let mut bytes = (values.len() as u32).to_le_bytes().to_vec();
        bytes.append(&mut values);
        bytes.extend(coder.finish(&tables)?);
        Ok(vec![Stream { name: SHAPES.into(), bytes: shapes }, Stream { name: VALUES.into(), bytes }])
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>> {
        let set = StreamSet::new("compact", streams);
        let (mut shapes, mut values): (ByteReader, ByteReader) = (set.reader(SHAPES)?, set.reader(VALUES)?);
        let mut arrays = read_shapes(&mut shapes)?;
        let most = values.remaining().saturating_mul(PER_BYTE);
        let total = arrays.iter().try_fold(0usize, |sum, a| sum.checked_add(value_count(&a.shape)?)).filter(|total| *total <= most);
        let Some(total) = total else { return Err(shapes.error(format!("the arrays do not fit the {} bytes of values", values.remaining()))) };
        shapes.finish()?;
        context.limits.check_bytes("deformer weights", 4 * total as u64)?;
        let (object, length) = ("compact stream 'values'", values.u32()? as usize);
        let tables = Tables::read(object, contexts(arrays.len()), values.take(length)?)?;
        let mut coder = Decoder::new(object, &tables, values.rest())?;
        for (k, array) in arrays.iter_mut().enumerate() {
            array.values = vec![0.0; value_count(&array.shape).unwrap_or(0)];
            code(&mut coder, k, self.peak, &mut array.values)?;
        }
        coder.finish()?;
        Ok(arrays)
    }
    fn loss(&self) -> f64 {
        // Half a step of a scale that is up to an eighth of an octave too large.
        0.5 * 1.0906 / self.peak + 1e-5
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    bits: u32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bits: BITS }
    }
}

/// Keeps the plug-in in the program; see [`crate::link`].
pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
    let Settings { bits } = config::parse_section("weight-codec compact", settings)?;
    if !RANGE.contains(&bits) {
        return Err(Error::parameter("weight-codec compact.bits", bits.to_string(), format!("Choose {} to {}", RANGE.start(), RANGE.end())));
    }
    Ok(Box::new(Weights { peak: f64::from((1u32 << (bits - 1)) - 1) }))
}

inventory::submit! {
    WeightCodecPlugin {
        info: Plugin {
            name: "compact",
            version: "1",
            summary: "integers of few bits with a scale per 64 values, entropy coded",
            paper: "row-wise symmetric quantisation; asymmetric numeral systems (constriction)",
            schema: "bits = 10                # of a weight, 3 to 12, before entropy coding; one less doubles the error of weights\n",
            capabilities: &["lossy"],
        },
        build,
    }
}
