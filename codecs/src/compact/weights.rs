//! The weight codec `compact`: integers of few bits with a step per array, entropy coded.
//!
//! Where it is known how much images depend on each weight, rows of 16 weights have steps of their own: that of their array times a power of two. A file of a
//! given size has the smallest error where errors of all weights cost the same, that is, where steps are inversely proportional to the root of a weight's
//! importance.

use super::entropy::{Coder, Decoder, Encoder, LANES, Lanes, Tables, symbol_of, symmetric};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{StreamSet, read_shapes, value_count, write_shapes};
use cc4dgs_format::{CodecContext, Error, Plugin, Result, Stream, WeightArray, WeightCodec, WeightCodecPlugin, WeightSteps, config, inventory};
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
/// A row's step is that of its array times two to the power of its shift; symbols are shifts less the least.
const SHIFTS: std::ops::RangeInclusive<i32> = -4..=11;
/// Of an array whose rows have shifts, added to its quarters of bits.
const SHIFTED: u8 = 0x80;
/// Rows whose mean magnitude is less than so many steps are estimated as if it were this: the size of zeros among zeros has no derivative.
const LEAST_MAGNITUDE: f64 = 0.05;
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
    /// Largest magnitude of a value, of those of a row over two to the power of its shift where that is positive.
    largest: f32,
    /// Whether rows have shifts.
    shifted: bool,
}

impl Form {
    /// Largest code.
    fn peak(self) -> f64 {
        libm::exp2(f64::from(self.quarter_bits) / QUARTERS - 1.0) - 1.0
    }
    fn step(self) -> f64 {
        f64::from(self.largest) / self.peak()
    }
    /// Low bits of a row that are stored as they are.
    fn low_bits(self, shift: i32) -> u32 {
        (libm::log2((self.peak() + 1.0) / SYMBOL_LIMIT).ceil() - f64::from(shift)).max(0.0) as u32
    }
    fn write(self, out: &mut Vec<u8>) {
        out.push(self.quarter_bits | if self.shifted { SHIFTED } else { 0 });
        out.extend(self.largest.to_le_bytes());
    }
    fn read(reader: &mut ByteReader) -> Result<Self> {
        let (byte, largest) = (reader.u8()?, reader.f32()?);
        let (quarter_bits, shifted) = (byte & !SHIFTED, byte & SHIFTED != 0);
        if !RANGE.contains(&(f64::from(quarter_bits) / QUARTERS)) || largest < 0.0 {
            return Err(reader.error(format!("an array of {} bits with values up to {largest} is impossible", f64::from(quarter_bits) / QUARTERS)));
        }
        Ok(Self { quarter_bits, largest, shifted })
    }
}

/// Contexts of shifts by the shift before, if there are any, lie behind those of the arrays.
fn contexts(forms: &[Form]) -> usize {
    2 * SIZES * forms.len().min(ARRAYS) + if forms.iter().any(|f| f.shifted) { SHIFTS.count() } else { 0 }
}

/// Shifts of the rows of an array whose weights have this `importance`.
fn shifts_of(importance: &[f32]) -> Vec<i32> {
    let mean = |values: &[f32]| values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len().max(1) as f64;
    let all = mean(importance);
    if !all.is_finite() {
        return Vec::new();
    }
    let shift = |row: &[f32]| {
        let octaves = -0.5 * libm::log2(mean(row) / all);
        if octaves.is_nan() { 0 } else { libm::round(octaves).clamp(f64::from(*SHIFTS.start()), f64::from(*SHIFTS.end())) as i32 }
    };
    importance.chunks(ROW).map(shift).collect()
}

/// Codes the array `index` of so many. Rows have sizes: the symbol of the largest code. `shifts` are those of the rows, where they have some and are written.
fn code<C: Coder>(coder: &mut C, (index, arrays): (usize, usize), form: Form, shifts: &[i32], values: &mut [f32]) -> Result<()> {
    if form.largest == 0.0 {
        values.fill(0.0);
        return Ok(());
    }
    let first = 2 * SIZES * index.min(ARRAYS - 1);
    let of_shifts = 2 * SIZES * arrays.min(ARRAYS);
    let mut sizes = [0; LANES];
    let mut befores = [-SHIFTS.start() as usize; LANES];
    for (lane, row) in Lanes::of(values.len().div_ceil(ROW)).turns() {
        let mut shift = 0;
        if form.shifted {
            let symbol = (shifts.get(row).copied().unwrap_or(0) - SHIFTS.start()) as usize;
            befores[lane] = coder.symbol(lane, of_shifts + befores[lane], symbol)? % SHIFTS.count();
            shift = befores[lane] as i32 + SHIFTS.start();
        }
        let (step, low_bits) = (libm::exp2(f64::from(shift)) * form.step(), form.low_bits(shift));
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

/// A coder that codes nothing: it returns every value that it is given.
struct Uncoded;

impl Coder for Uncoded {
    const WRITES: bool = true;
    #[inline(always)]
    fn symbol(&mut self, _: usize, _: usize, symbol: usize) -> Result<usize> {
        Ok(symbol)
    }
    #[inline(always)]
    fn bits(&mut self, count: u32, value: u64) -> Result<u64> {
        Ok(value & ((1 << count) - 1))
    }
}

/// Derivatives of the estimated bits of a row by its values, in steps: for distributions that fall by the factor ρ from one magnitude to the next, each is
/// -log2 ρ.
fn bit_slopes(row: &[f32], step: f64) -> impl Iterator<Item = f32> {
    let mean = (row.iter().map(|v| f64::from(v.abs())).sum::<f64>() / (row.len().max(1) as f64 * step)).max(LEAST_MAGNITUDE);
    let slope = -libm::log2(((1.0 + mean * mean).sqrt() - 1.0) / mean);
    row.iter().map(move |v| (slope * (f64::from(*v) / step).clamp(-1.0, 1.0)) as f32)
}

impl Weights {
    /// How the array `index` is coded, and the shifts of its rows.
    fn form(&self, index: usize, array: &WeightArray, context: &CodecContext) -> (Form, Vec<i32>) {
        let importance = context.weight_importance.and_then(|all| all.get(index)).filter(|found| found.len() == array.values.len());
        let shifts = importance.map(|found| shifts_of(found)).unwrap_or_default();
        // Values of rows with larger steps have as many codes fewer, and must not enlarge the steps of others.
        let scale = |row: usize| libm::exp2f(-shifts.get(row).copied().unwrap_or(0).max(0) as f32);
        let largest = array.values.chunks(ROW).enumerate().flat_map(|(row, values)| values.iter().map(move |v| scale(row) * v.abs())).fold(0.0f32, f32::max);
        (Form { quarter_bits: self.quarter_bits(index), largest, shifted: shifts.iter().any(|shift| *shift != 0) }, shifts)
    }
    /// Bits of the array `index`, in quarters.
    fn quarter_bits(&self, index: usize) -> u8 {
        (QUARTERS * self.array_bits.get(index).copied().unwrap_or(self.bits)).round() as u8
    }
}

impl WeightCodec for Weights {
    fn encode(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        let (mut shapes, mut coder, mut forms) = (Vec::new(), Encoder::default(), Vec::with_capacity(weights.len()));
        write_shapes(weights, &mut shapes)?;
        for (index, array) in weights.iter().enumerate() {
            let (form, shifts) = self.form(index, array, context);
            form.write(&mut shapes);
            code(&mut coder, (index, weights.len()), form, &shifts, &mut array.values.clone())?;
            forms.push(form);
        }
        let (tables, mut values) = Tables::fit(contexts(&forms), std::slice::from_ref(&coder));
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
        let tables = Tables::read(object, contexts(&forms), values.take(length)?)?;
        let mut coder = Decoder::new(object, &tables, values.rest())?;
        let count = arrays.len();
        for (index, (array, form)) in arrays.iter_mut().zip(forms).enumerate() {
            array.values = vec![0.0; value_count(&array.shape).unwrap_or(0)];
            code(&mut coder, (index, count), form, &[], &mut array.values)?;
        }
        coder.finish()?;
        Ok(arrays)
    }
    fn round(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Vec<WeightArray>> {
        // For the errors of `encode`.
        write_shapes(weights, &mut Vec::new())?;
        let mut rounded = weights.to_vec();
        for (index, (array, found)) in weights.iter().zip(&mut rounded).enumerate() {
            let (form, shifts) = self.form(index, array, context);
            code(&mut Uncoded, (index, weights.len()), form, &shifts, &mut found.values)?;
        }
        Ok(rounded)
    }
    fn steps(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Option<WeightSteps>> {
        let mut out = WeightSteps::default();
        for (index, array) in weights.iter().enumerate() {
            let (form, shifts) = self.form(index, array, context);
            let (mut steps, mut slopes) = (Vec::with_capacity(array.values.len()), Vec::with_capacity(array.values.len()));
            for (row, values) in array.values.chunks(ROW).enumerate() {
                let step = libm::exp2(f64::from(shifts.get(row).copied().unwrap_or(0))) * form.step();
                steps.extend(values.iter().map(|_| step as f32));
                slopes.extend(bit_slopes(values, step.max(f64::MIN_POSITIVE)));
            }
            out.steps.push(steps);
            out.bit_slopes.push(slopes);
        }
        Ok(Some(out))
    }
    fn loss(&self) -> f64 {
        // Arrays beyond the list have `bits`: the index behind the last one stands for them.
        let least = (0..=self.array_bits.len()).map(|index| self.quarter_bits(index)).min().unwrap_or(0);
        0.5 / Form { quarter_bits: least, largest: 1.0, shifted: false }.peak() + 1e-6
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

/// Builds the codec. [`crate::link`] refers to it too.
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
            version: "3",
            summary: "integers of few bits, entropy coded; one step per array, with a scene one per row of 16 values",
            paper: "uniform symmetric quantisation; asymmetric numeral systems (constriction)",
            schema: "\
bits = 12.0              # of the largest weight of an array, 3 to 16 in quarters, before entropy coding; one less doubles the error of weights
array_bits = []          # of each array in turn, in place of bits; max-drop chooses them. With --scene, weights on which images depend less have larger steps
",
            capabilities: &["lossy", "bits=3..16", "importance"],
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
    fn what_images_do_not_depend_on_takes_few_bytes() {
        let codec = Weights { bits: 10.0, array_bits: Vec::new() };
        let count = 512 * ROW;
        let weights = [WeightArray { name: "net".into(), shape: vec![count], values: (0..count).map(|k| ((k * k) as f32 * 0.37).sin()).collect() }];
        // Three rows of four matter little, or not at all.
        let importance = [(0..count).map(|k| [1.0, 0.0, 1e-3, 1e-6][k / ROW % 4]).collect::<Vec<f32>>()];
        let plain = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
        let context = CodecContext { weight_importance: Some(&importance), ..plain };
        let plain = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
        let bytes = |context: &CodecContext| codec.encode(&weights, context).unwrap().iter().map(|s| s.bytes.len()).sum::<usize>();
        assert!(bytes(&context) < bytes(&plain) * 6 / 10, "{} and {} bytes", bytes(&context), bytes(&plain));
        let found = codec.decode(&codec.encode(&weights, &context).unwrap(), &plain).unwrap();
        let worst = |kind: usize| (0..count).filter(|k| k / ROW % 4 == kind).map(|k| (found[0].values[k] - weights[0].values[k]).abs()).fold(0.0f32, f32::max);
        assert!(worst(0) < 0.001 && worst(2) > 4.0 * worst(0) && worst(3) > 4.0 * worst(2) && worst(1) > 0.9, "{:?}", [0, 1, 2, 3].map(worst));
        // Importance that is constant, not finite or of another length changes nothing.
        for odd in [vec![1.0; count], vec![0.0; count], vec![f32::NAN; count], vec![f32::INFINITY; count], vec![1.0; 3]] {
            let importance = [odd];
            let context = CodecContext { weight_importance: Some(&importance), ..CodecContext::new(Seed::root(1), Limits::default(), &Silent) };
            assert!(codec.encode(&weights, &context).unwrap() == codec.encode(&weights, &plain).unwrap());
        }
    }

    #[test]
    fn slopes_are_those_of_the_size() {
        // Of a geometric distribution with ratio 1/2 from one magnitude to the next, each step costs a bit.
        let row: Vec<f32> =
            [(0.0, 8), (1.0, 8), (2.0, 4), (3.0, 2), (4.0, 1), (5.0, 1)].iter().flat_map(|&(size, count)| vec![[size, -size]; count]).flatten().collect();
        let slopes: Vec<f32> = bit_slopes(&row, 1.0).collect();
        assert!(slopes[0] == 0.0 && (slopes[16] - 1.0).abs() < 0.05 && slopes[17] == -slopes[16], "{slopes:?}");
        assert!(bit_slopes(&[0.0; 16], 1.0).all(|slope| slope == 0.0));
    }

    #[test]
    fn the_declared_loss_holds_for_arrays_beyond_the_list_of_bits() {
        let codec = Weights { bits: 3.0, array_bits: vec![16.0] };
        let context = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
        let values: Vec<f32> = (0..64).map(|k| (k as f32 * 0.37).sin()).collect();
        let weights = ["first", "second"].map(|name| WeightArray { name: name.into(), shape: vec![64], values: values.clone() });
        let found = codec.decode(&codec.encode(&weights, &context).unwrap(), &context).unwrap();
        for (before, after) in weights.iter().zip(&found) {
            let worst = before.values.iter().zip(&after.values).map(|(a, b)| f64::from(a - b).abs()).fold(0.0, f64::max);
            let largest = before.values.iter().fold(0.0, |most: f64, v| most.max(f64::from(*v).abs()));
            assert!(worst <= codec.loss() * largest, "{}: {worst} of {largest}", before.name);
        }
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
