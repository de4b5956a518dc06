//! The weight codec `compact`: integers of few bits with a step per array, entropy coded.

use super::entropy::{Coder, Decoder, Encoder, LANES, Lanes, Tables, symbol_of, symmetric};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{StreamSet, read_shapes, value_count, write_shapes};
use cc4dgs_format::{CodecContext, Error, Plugin, Result, Stream, WeightArray, WeightCodec, WeightCodecPlugin, config, inventory};
use serde::Deserialize;

/// Values of a row, which has a size.
const ROW: usize = 16;
/// Bits of a code, and how many there may be.
const BITS: f64 = 12.0;
const RANGE: std::ops::RangeInclusive<f64> = 3.0..=16.0;
/// Bits are stored in quarters.
const QUARTERS: f64 = 4.0;
/// Arrays with distributions of their own.
const ARRAYS: usize = 64;
/// Contexts of sizes of rows, by the size before.
const SIZES: usize = 16;
/// Codes are shifted until they are below this; what is shifted out is stored as it is.
const SYMBOL_LIMIT: f64 = 192.0;
const SHAPES: &str = "shapes";
const VALUES: &str = "values";

struct Weights {
    bits: f64,
    /// Bits of the arrays in turn, in place of `bits` where there are any.
    array_bits: Vec<f64>,
}

/// How the codes of an array are made.
#[derive(Clone, Copy)]
struct Form {
    quarter_bits: u8,
    /// Largest magnitude of a value.
    largest: f32,
}

impl Form {
    /// Largest code.
    fn peak(self) -> f64 {
        libm::exp2(f64::from(self.quarter_bits) / QUARTERS - 1.0) - 1.0
    }
    fn step(self) -> f64 {
        f64::from(self.largest) / self.peak()
    }
    /// Low bits that are stored as they are.
    fn low_bits(self) -> u32 {
        libm::log2((self.peak() + 1.0) / SYMBOL_LIMIT).ceil().max(0.0) as u32
    }
    fn write(self, out: &mut Vec<u8>) {
        out.push(self.quarter_bits);
        out.extend(self.largest.to_le_bytes());
    }
    fn read(reader: &mut ByteReader) -> Result<Self> {
        let (quarter_bits, largest) = (reader.u8()?, reader.f32()?);
        if !RANGE.contains(&(f64::from(quarter_bits) / QUARTERS)) || largest < 0.0 {
            return Err(reader.error(format!("an array of {} bits with values up to {largest} is impossible", f64::from(quarter_bits) / QUARTERS)));
        }
        Ok(Self { quarter_bits, largest })
    }
}

fn contexts(arrays: usize) -> usize {
    2 * SIZES * arrays.min(ARRAYS)
}

/// Codes the array `index`. Rows have sizes: the symbol of the largest code.
fn code<C: Coder>(coder: &mut C, index: usize, form: Form, values: &mut [f32]) -> Result<()> {
    if form.largest == 0.0 {
        values.fill(0.0);
        return Ok(());
    }
    let first = 2 * SIZES * index.min(ARRAYS - 1);
    let (step, low_bits) = (form.step(), form.low_bits());
    let mut sizes = [0; LANES];
    for (lane, row) in Lanes::of(values.len().div_ceil(ROW)).turns() {
        let end = values.len().min((row + 1) * ROW);
        let row = &mut values[row * ROW..end];
        let mut codes = [0i64; ROW];
        if C::WRITES {
            codes.iter_mut().zip(row.iter()).for_each(|(code, value)| *code = libm::round(f64::from(*value) / step) as i64);
        }
        let largest = codes.iter().map(|code| (code >> low_bits).unsigned_abs()).max().unwrap_or(0);
        let size = coder.symbol(lane, first + sizes[lane], symbol_of(largest))?;
        sizes[lane] = size % SIZES;
        for (value, code) in row.iter_mut().zip(codes) {
            let high = symmetric(coder, lane, first + SIZES + sizes[lane], code >> low_bits)?;
            let found = high << low_bits | coder.bits(low_bits, code as u64)? as i64;
            *value = ((found as f64 * step) as f32).clamp(f32::MIN, f32::MAX);
        }
    }
    Ok(())
}

impl Weights {
    /// Bits of the array `index`, in quarters.
    fn quarter_bits(&self, index: usize) -> u8 {
        (QUARTERS * self.array_bits.get(index).copied().unwrap_or(self.bits)).round() as u8
    }
}

impl WeightCodec for Weights {
    fn encode(&self, weights: &[WeightArray], _: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        let (mut shapes, mut coder) = (Vec::new(), Encoder::default());
        write_shapes(weights, &mut shapes)?;
        for (index, array) in weights.iter().enumerate() {
            let form = Form { quarter_bits: self.quarter_bits(index), largest: array.values.iter().fold(0.0f32, |m, v| m.max(v.abs())) };
            form.write(&mut shapes);
            code(&mut coder, index, form, &mut array.values.clone())?;
        }
        let (tables, mut values) = Tables::fit(contexts(weights.len()), std::slice::from_ref(&coder));
        let mut bytes = (values.len() as u32).to_le_bytes().to_vec();
        bytes.append(&mut values);
        bytes.extend(coder.finish(&tables)?);
        Ok(vec![Stream { name: SHAPES.into(), bytes: shapes }, Stream { name: VALUES.into(), bytes }])
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>> {
        let set = StreamSet::new("compact", streams);
        let (mut shapes, mut values): (ByteReader, ByteReader) = (set.reader(SHAPES)?, set.reader(VALUES)?);
        let mut arrays = read_shapes(&mut shapes, &context.limits)?;
        let forms = arrays.iter().map(|_| Form::read(&mut shapes)).collect::<Result<Vec<Form>>>()?;
        shapes.finish()?;
        let (object, length) = ("compact stream 'values'", values.u32()? as usize);
        let tables = Tables::read(object, contexts(arrays.len()), values.take(length)?)?;
        let mut coder = Decoder::new(object, &tables, values.rest())?;
        for (index, (array, form)) in arrays.iter_mut().zip(forms).enumerate() {
            array.values = vec![0.0; value_count(&array.shape).unwrap_or(0)];
            code(&mut coder, index, form, &mut array.values)?;
        }
        coder.finish()?;
        Ok(arrays)
    }
    fn loss(&self) -> f64 {
        let least = (0..self.array_bits.len().max(1)).map(|index| self.quarter_bits(index)).min().unwrap_or(0);
        0.5 / Form { quarter_bits: least, largest: 1.0 }.peak() + 1e-6
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    bits: f64,
    array_bits: Vec<f64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bits: BITS, array_bits: Vec::new() }
    }
}

/// Keeps the plug-in in the program; see [`crate::link`].
pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
    let Settings { bits, array_bits } = config::parse_section("weight-codec compact", settings)?;
    if let Some(odd) = array_bits.iter().chain([&bits]).find(|bits| !RANGE.contains(bits)) {
        return Err(Error::parameter("weight-codec compact.bits", odd.to_string(), format!("Choose {} to {}", RANGE.start(), RANGE.end())));
    }
    Ok(Box::new(Weights { bits, array_bits }))
}

inventory::submit! {
    WeightCodecPlugin {
        info: Plugin {
            name: "compact",
            version: "2",
            summary: "integers of few bits with a step per array, entropy coded",
            paper: "uniform symmetric quantisation; asymmetric numeral systems (constriction)",
            schema: "\
bits = 12.0              # of the largest weight of an array, 3 to 16 in quarters, before entropy coding; one less doubles the error of weights
array_bits = []          # of each array in turn, in place of bits; max-drop chooses them
",
            capabilities: &["lossy", "bits=3..16"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::{Limits, Seed, Silent};

    #[test]
    fn many_zeros_come_back_within_the_limits() {
        let context = |limits: Limits| CodecContext::new(Seed::root(1), limits, &Silent);
        let codec = Weights { bits: BITS, array_bits: Vec::new() };
        let weights = [WeightArray { name: "grid".into(), shape: vec![1 << 18, 2], values: vec![0.0; 1 << 19] }];
        let streams = codec.encode(&weights, &context(Limits::default())).unwrap();
        assert!(codec.decode(&streams, &context(Limits::default())).unwrap() == weights);
        let message = codec.decode(&streams, &context(Limits { max_bytes: 1 << 20, ..Limits::default() })).unwrap_err().to_string();
        assert!(message.contains("max_bytes"), "{message}");
    }

    #[test]
    fn an_array_with_one_value_comes_back() {
        let context = |limits: Limits| CodecContext::new(Seed::root(1), limits, &Silent);
        let codec = Weights { bits: 8.0, array_bits: Vec::new() };
        let mut weights = [WeightArray { name: "grid".into(), shape: vec![1 << 20], values: vec![0.0; 1 << 20] }];
        weights[0].values[70_000] = 0.5;
        let streams = codec.encode(&weights, &context(Limits::default())).unwrap();
        let bytes: usize = streams.iter().map(|s| s.bytes.len()).sum();
        assert!(bytes < (1 << 20) / 4096, "{bytes} bytes");
        assert!(codec.decode(&streams, &context(Limits::default())).unwrap() == weights);
        // A bound of what is decoded, not of the bytes.
        assert!(codec.decode(&streams, &context(Limits { max_bytes: 4 << 20, ..Limits::default() })).is_ok());
        let message = codec.decode(&streams, &context(Limits { max_bytes: (4 << 20) - 1, ..Limits::default() })).unwrap_err().to_string();
        assert!(message.contains("max_bytes"), "{message}");
    }
}
