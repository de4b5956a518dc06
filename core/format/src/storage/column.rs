//! Storage of a column of numbers in few bits: constant, uniform, mu-law or exact.
//!
//! Uniform quantisers span percentiles of the values, a little widened; the few values outside are stored exactly in a list of escapes, so that
//! an outlier neither widens the steps of the others nor is clamped. If the error is over the allowed loss, more bits are used.

use super::loss::{central_loss, relative_rms};
use super::mulaw;
use crate::Result;
use crate::archive::ByteReader;
use std::cell::LazyCell;

/// Share of the values at either end that [`encode_within`] may store as escapes.
const TAIL_WITHIN: f64 = 1e-3;

/// How the codes of a column are decoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Form {
    /// All values are equal; there are no codes.
    Constant(f32),
    /// `2^bits` levels at equal distances from `low` to `high`.
    Uniform {
        /// Value of code 0.
        low: f32,
        /// Value of the largest code.
        high: f32,
        /// Bits per code, 2 to 16.
        bits: u8,
    },
    /// Signed mu-law codes of value / `peak`.
    MuLaw {
        /// Largest magnitude.
        peak: f32,
        /// Bits per code, 2 to 16.
        bits: u8,
    },
    /// float32.
    Exact,
}

/// A column as it is stored.
pub struct Column {
    /// How to read the codes.
    pub form: Form,
    /// One or two bytes per value; four for [`Form::Exact`], none for [`Form::Constant`].
    pub codes: Vec<u8>,
    /// Values outside the range of the codes: (row, value), rows ascending.
    pub escapes: Vec<(u32, f32)>,
}

/// The form to try first and the largest loss (root-mean-square error over standard deviation).
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Bits per code, 2 to 16.
    pub bits: u8,
    /// Mu-law instead of uniform levels.
    pub mu_law: bool,
    /// Largest root-mean-square error over the standard deviation.
    pub loss: f64,
    /// Share of the values at either end that may be escapes.
    pub tail: f64,
}

/// Encodes `values` (all finite) in the first form whose error is within the loss of `target`: the target's form, then 16 uniform bits, then exact.
pub fn encode(values: &[f32], target: Target) -> Column {
    if let Some(column) = constant(values) {
        return column;
    }
    // One for both widths, and none where mu-law is good enough.
    let found = LazyCell::new(|| range(values, target.tail));
    let uniform = |bits: u8| {
        let (low, high) = *found;
        Form::Uniform { low, high, bits }
    };
    for first in [true, false] {
        let form = match (first, target.mu_law) {
            (true, true) => Form::MuLaw { peak: values.iter().fold(0.0, |a, v| a.max(v.abs())), bits: target.bits },
            (true, false) => uniform(target.bits),
            (false, _) => uniform(16),
        };
        let column = quantise(values, form);
        let decoded = dequantise(&column, values.len());
        if relative_rms(values, &decoded) <= target.loss && central_loss(values, &decoded, 1) <= target.loss {
            return column;
        }
    }
    quantise(values, Form::Exact)
}

/// Encodes `values` (all finite) with an absolute error of at most `tolerance`: in the fewest bits that suffice, else exactly.
pub fn encode_within(values: &[f32], tolerance: f32) -> Column {
    if let Some(column) = constant(values) {
        return column;
    }
    let (low, high) = range(values, TAIL_WITHIN);
    let steps = (f64::from(high) - f64::from(low)) / (2.0 * f64::from(tolerance));
    let bits = (2..=16u8).find(|&bits| f64::from((1u32 << bits) - 1) >= steps).unwrap_or(16);
    // Rounding to float32 may exceed the tolerance; then one more bit is used.
    for bits in [bits, (bits + 1).min(16)] {
        let column = quantise(values, Form::Uniform { low, high, bits });
        let decoded = dequantise(&column, values.len());
        if values.iter().zip(&decoded).all(|(a, b)| (f64::from(*a) - f64::from(*b)).abs() <= f64::from(tolerance)) {
            return column;
        }
    }
    quantise(values, Form::Exact)
}

/// Encodes `values` without loss, bit for bit.
pub fn encode_exact(values: &[f32]) -> Column {
    // 0 and -0 are equal, and have different bits.
    let same = values.iter().all(|v| v.to_bits() == values[0].to_bits());
    constant(values).filter(|_| same).unwrap_or_else(|| quantise(values, Form::Exact))
}

fn constant(values: &[f32]) -> Option<Column> {
    let first = values.first().copied().unwrap_or(0.0);
    values.iter().all(|&v| v == first).then(|| Column { form: Form::Constant(first), codes: Vec::new(), escapes: Vec::new() })
}

/// The lowest and highest value of a uniform quantiser of `values` (at least one): the `tail` and 1 - `tail` quantiles, a tenth farther apart but never beyond
/// the extremes.
fn range(values: &[f32], tail: f64) -> (f32, f32) {
    let mut ordered = values.to_vec();
    let last = ordered.len() - 1;
    // Of few values, up to two at either end may be outliers.
    let cut = ((tail * ordered.len() as f64) as usize).max(2.min(ordered.len() / 8));
    // Selecting takes less time than sorting.
    let [least, inner_low, inner_high, most] = [0, cut, last - cut, last].map(|k| f64::from(*ordered.select_nth_unstable_by(k, f32::total_cmp).1));
    let margin = 0.1 * (inner_high - inner_low);
    ((inner_low - margin).max(least) as f32, (inner_high + margin).min(most) as f32)
}

fn quantise(values: &[f32], form: Form) -> Column {
    let mut column = Column { form, codes: Vec::new(), escapes: Vec::new() };
    match form {
        Form::Constant(_) => {}
        Form::Exact => column.codes.extend(values.iter().flat_map(|v| v.to_le_bytes())),
        Form::Uniform { low, high, bits } => {
            let levels = f64::from((1u32 << bits) - 1);
            let width = f64::from(high) - f64::from(low);
            let scale = if width > 0.0 { levels / width } else { 0.0 };
            for (i, &v) in values.iter().enumerate() {
                if v < low || v > high {
                    column.escapes.push((i as u32, v));
                }
                push_code(&mut column.codes, ((f64::from(v) - f64::from(low)) * scale).round().clamp(0.0, levels) as u16, bits);
            }
        }
        Form::MuLaw { peak, bits } => {
            let zero = mulaw::peak_code(bits);
            for &v in values {
                push_code(&mut column.codes, (mulaw::encode(f64::from(v) / f64::from(peak), bits) + zero) as u16, bits);
            }
        }
    }
    column
}

fn push_code(codes: &mut Vec<u8>, code: u16, bits: u8) {
    if bits > 8 { codes.extend(code.to_le_bytes()) } else { codes.push(code as u8) }
}

/// The `count` values that [`read`] decodes from a column.
pub fn dequantise(column: &Column, count: usize) -> Vec<f32> {
    // The codes were written by `quantise`, so there are enough of them.
    let mut reader = ByteReader::new("column", &column.codes);
    read(&mut reader, column.form, count, &column.escapes).unwrap_or_default()
}

impl Form {
    /// Appends the form to a meta stream.
    pub fn write(&self, out: &mut Vec<u8>) {
        match *self {
            Self::Constant(value) => {
                out.push(0);
                out.extend(value.to_le_bytes());
            }
            Self::Uniform { low, high, bits } => {
                out.extend([1, bits]);
                out.extend(low.to_le_bytes());
                out.extend(high.to_le_bytes());
            }
            Self::MuLaw { peak, bits } => {
                out.extend([2, bits]);
                out.extend(peak.to_le_bytes());
            }
            Self::Exact => out.push(3),
        }
    }
    /// Reads a form and checks its numbers.
    pub fn read(reader: &mut ByteReader) -> Result<Self> {
        let kind = reader.u8()?;
        let form = match kind {
            0 => Self::Constant(reader.f32()?),
            1 => {
                let bits = reader.u8()?;
                Self::Uniform { low: reader.f32()?, high: reader.f32()?, bits }
            }
            2 => {
                let bits = reader.u8()?;
                Self::MuLaw { peak: reader.f32()?, bits }
            }
            3 => Self::Exact,
            _ => return Err(reader.error(format!("unknown form {kind} of a column"))),
        };
        match form {
            Self::Uniform { low, high, bits } if !(2..=16).contains(&bits) || low > high => {
                Err(reader.error(format!("a quantiser of {bits} bits from {low} to {high} is impossible")))
            }
            Self::MuLaw { peak, bits } if !(2..=16).contains(&bits) || peak <= 0.0 => {
                Err(reader.error(format!("a mu-law quantiser of {bits} bits up to {peak} is impossible")))
            }
            form => Ok(form),
        }
    }
    /// Bytes of one value in the code stream.
    fn bytes_per_code(&self) -> usize {
        match *self {
            Self::Constant(_) => 0,
            Self::Uniform { bits, .. } | Self::MuLaw { bits, .. } => 1 + usize::from(bits > 8),
            Self::Exact => 4,
        }
    }
}

/// Bytes per code of the next `count` columns that `meta` describes.
pub fn widths(mut meta: ByteReader, count: usize) -> Result<Vec<usize>> {
    (0..count).map(|_| Ok(Form::read(&mut meta)?.bytes_per_code())).collect()
}

/// Decodes `count` values of `form` from `reader`. Encoder and decoder both call this, so that they get the same bits.
pub fn read(reader: &mut ByteReader, form: Form, count: usize, escapes: &[(u32, f32)]) -> Result<Vec<f32>> {
    if let Form::Exact = form {
        return reader.f32s(count);
    }
    let width = form.bytes_per_code();
    let bytes = reader.take(count.saturating_mul(width))?;
    let codes = |bits: u8| -> Result<Vec<u16>> {
        let codes: Vec<u16> =
            if width == 2 { bytes.chunks_exact(2).map(|c| u16::from_le_bytes([c[0], c[1]])).collect() } else { bytes.iter().map(|&b| u16::from(b)).collect() };
        match codes.iter().find(|&&c| u32::from(c) >= 1 << bits) {
            Some(c) => Err(reader.error(format!("code {c} does not fit {bits} bits"))),
            None => Ok(codes),
        }
    };
    let mut values: Vec<f32> = match form {
        Form::Constant(value) => vec![value; count],
        Form::Uniform { low, high, bits } => {
            let (low, levels) = (f64::from(low), f64::from((1u32 << bits) - 1));
            let step = (f64::from(high) - low) / levels;
            codes(bits)?.into_iter().map(|c| (low + f64::from(c) * step) as f32).map(|v| v.min(high)).collect()
        }
        Form::MuLaw { peak, bits } => {
            let zero = mulaw::peak_code(bits);
            let value = |c: u16| ((f64::from(peak) * mulaw::decode((i32::from(c) - zero).min(zero), bits)) as f32).clamp(-peak, peak);
            let codes = codes(bits)?;
            if count > 1 << bits {
                // More values than codes: a table avoids most of the exponentials.
                let table: Vec<f32> = (0..=u16::MAX >> (16 - bits)).map(value).collect();
                codes.into_iter().map(|c| table[usize::from(c)]).collect()
            } else {
                codes.into_iter().map(value).collect()
            }
        }
        Form::Exact => Vec::new(),
    };
    for &(row, value) in escapes {
        match values.get_mut(row as usize) {
            Some(v) => *v = value,
            None => return Err(reader.error(format!("an escape refers to row {row} of {count}"))),
        }
    }
    Ok(values)
}

/// Appends an escape list to the escape stream: u32 count, rows, values.
pub fn write_escapes(escapes: &[(u32, f32)], out: &mut Vec<u8>) {
    out.extend((escapes.len() as u32).to_le_bytes());
    escapes.iter().for_each(|(row, _)| out.extend(row.to_le_bytes()));
    escapes.iter().for_each(|(_, value)| out.extend(value.to_le_bytes()));
}

/// Reads what [`write_escapes`] wrote.
pub fn read_escapes(reader: &mut ByteReader) -> Result<Vec<(u32, f32)>> {
    let count = reader.u32()? as usize;
    let rows: Vec<u32> = reader.take(count.saturating_mul(4))?.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect();
    let values = reader.f32s(count)?;
    Ok(rows.into_iter().zip(values).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGET: Target = Target { bits: 8, mu_law: false, loss: 0.05, tail: 5e-4 };

    fn wave(n: usize) -> Vec<f32> {
        (0..n).map(|i| (i as f32 * 0.37).sin()).collect()
    }

    #[test]
    fn an_outlier_is_kept_and_does_not_widen_the_steps() {
        let mut values = wave(10_000);
        values[77] = 1e30;
        let column = encode(&values, TARGET);
        assert!(matches!(column.form, Form::Uniform { bits: 8, high, .. } if high < 2.0), "{:?}", column.form);
        let decoded = dequantise(&column, values.len());
        assert_eq!(decoded[77], 1e30);
        assert!(values.iter().zip(&decoded).all(|(a, b)| (a - b).abs() <= 1.1 / 255.0));
    }

    #[test]
    fn ranges_are_those_of_sorted_values() {
        for count in [1usize, 2, 7, 16, 300, 5000] {
            let values: Vec<f32> = (0..count).map(|i| (i as f32 * 0.37).sin() * if i % 41 == 3 { 1e6 } else { 1.0 }).collect();
            let mut sorted = values.clone();
            sorted.sort_unstable_by(f32::total_cmp);
            let (last, cut) = (count - 1, ((1e-3 * count as f64) as usize).max(2.min(count / 8)));
            let (low, high) = (f64::from(sorted[cut]), f64::from(sorted[last - cut]));
            let margin = 0.1 * (high - low);
            let expected = ((low - margin).max(f64::from(sorted[0])) as f32, (high + margin).min(f64::from(sorted[last])) as f32);
            assert_eq!(range(&values, 1e-3), expected, "{count} values");
        }
    }

    #[test]
    fn a_column_that_would_lose_too_much_takes_more_bits() {
        assert_eq!(encode(&wave(1000), Target { loss: 1e-7, ..TARGET }).form, Form::Exact);
        assert!(matches!(encode(&wave(1000), Target { loss: 1e-3, ..TARGET }).form, Form::Uniform { bits: 16, .. }));
        assert!(matches!(encode(&wave(1000), TARGET).form, Form::Uniform { bits: 8, .. }));
    }

    #[test]
    fn outliers_too_many_to_escape_do_not_swallow_the_rest() {
        // Two of a hundred values are 10^4: relative to the whole standard deviation 8 bits look sufficient, but 0 to 6 would all become 0.
        let values: Vec<f32> = (0..1000).map(|i| if i % 50 == 0 { 1e4 } else { (i % 7) as f32 }).collect();
        let decoded = dequantise(&encode(&values, TARGET), values.len());
        assert!(values.iter().zip(&decoded).all(|(a, b)| (a - b).abs() < 0.2));
    }

    #[test]
    fn exact_columns_keep_the_sign_of_zero() {
        for values in [vec![0.0f32, -0.0, 0.0], vec![-0.0; 3], vec![]] {
            let decoded = dequantise(&encode_exact(&values), values.len());
            assert!(decoded.len() == values.len() && decoded.iter().zip(&values).all(|(a, b)| a.to_bits() == b.to_bits()), "{values:?}: {decoded:?}");
        }
        assert!(encode_exact(&[-0.0; 3]).codes.is_empty());
    }

    #[test]
    fn degenerate_columns_are_exact() {
        for values in [vec![], vec![4.5f32], vec![-1e-40f32; 9], vec![0.0; 5]] {
            let column = encode(&values, TARGET);
            assert!(column.codes.is_empty());
            assert_eq!(dequantise(&column, values.len()), values);
        }
        let extremes = vec![f32::MAX, f32::MIN, 0.0, 1.0];
        assert!(dequantise(&encode(&extremes, TARGET), 4).iter().all(|v| v.is_finite()));
    }
}
