//! Entropy coding of integers. Models are adaptive and use integers only, so that every machine writes and reads the same bytes; the range coder is
//! constriction's.
//!
//! Encoder and decoder share their modelling code through [`Coder`]: the encoder writes the value it is given, the decoder ignores it and returns the
//! one it reads.

use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Error, Result};
use constriction::backends::Cursor;
use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::queue::{RangeDecoder, RangeEncoder};
use constriction::stream::{Decode, Encode};
use std::borrow::Borrow;
use std::num::NonZeroU32;

/// Symbols of a model.
pub const SYMBOLS: usize = 16;
/// Bits of a probability.
const PRECISION: usize = 15;
const ONE: i32 = 1 << PRECISION;
/// Shift of the adaptation by the number of symbols before: the n-th symbol has about the weight 1 / (n + 4), later ones 2^-7.
const RATES: [u8; 125] = rates();

const fn rates() -> [u8; 125] {
    let mut out = [2; 125];
    let mut n = 0;
    while n < out.len() {
        out[n] = (n as u32 + 4).ilog2() as u8;
        n += 1;
    }
    out
}

/// An adaptive distribution of 16 symbols.
#[derive(Clone)]
pub struct Model {
    /// Probability of all symbols below each, times 2^15. Strictly increasing, so that no symbol is impossible.
    below: [u16; SYMBOLS],
    seen: u8,
}

impl Default for Model {
    fn default() -> Self {
        Self { below: std::array::from_fn(|i| (i as u16) << (PRECISION - 4)), seen: 0 }
    }
}

impl Model {
    fn end(&self, symbol: usize) -> u32 {
        self.below.get(symbol + 1).map_or(ONE as u32, |&v| u32::from(v))
    }
    /// Moves the distribution towards `symbol`.
    #[inline]
    fn update(&mut self, symbol: usize) {
        let rate = RATES[usize::from(self.seen)];
        // The first entry stays 0: its target is 0 whatever the symbol. Probabilities are below 2^15, so that differences fit 16 bits.
        for (i, below) in self.below.iter_mut().enumerate() {
            let target = i as i16 + if i <= symbol { 0 } else { (ONE - SYMBOLS as i32) as i16 };
            let value = *below as i16;
            *below = (value + ((target - value) >> rate)) as u16;
        }
        self.seen = (self.seen + 1).min(RATES.len() as u8 - 1);
    }
}

impl EntropyModel<PRECISION> for Model {
    type Symbol = usize;
    type Probability = u32;
}

impl EncoderModel<PRECISION> for Model {
    fn left_cumulative_and_probability(&self, symbol: impl Borrow<usize>) -> Option<(u32, NonZeroU32)> {
        let symbol = *symbol.borrow();
        let start = u32::from(*self.below.get(symbol)?);
        Some((start, NonZeroU32::new(self.end(symbol) - start)?))
    }
}

impl DecoderModel<PRECISION> for Model {
    #[inline]
    fn quantile_function(&self, quantile: u32) -> (usize, u32, NonZeroU32) {
        // The first entry is 0, so that there is at least one.
        let symbol = self.below.iter().map(|&below| u16::from(below <= quantile as u16)).sum::<u16>() as usize - 1;
        let start = u32::from(self.below[symbol]);
        (symbol, start, NonZeroU32::new(self.end(symbol) - start).unwrap_or(NonZeroU32::MIN))
    }
}

/// An encoder or a decoder.
pub trait Coder {
    /// Codes `symbol` (0 to 15) and adapts the model.
    fn symbol(&mut self, model: &mut Model, symbol: usize) -> Result<usize>;
    /// Codes the low `count` (at most 57) bits of `value`, which are thought to be random.
    fn bits(&mut self, count: u32, value: u64) -> Result<u64>;
}

/// Writes symbols and bits.
#[derive(Default)]
pub struct Encoder {
    coder: RangeEncoder<u32, u64>,
    bits: Vec<u8>,
    pending: u64,
    filled: u32,
}

impl Encoder {
    /// The bytes: u32 words of the range coder, the words, then the bits.
    pub fn finish(mut self) -> Vec<u8> {
        if self.filled > 0 {
            self.bits.extend(&self.pending.to_le_bytes()[..self.filled.div_ceil(8) as usize]);
        }
        let Ok(words) = self.coder.into_compressed();
        let mut out = Vec::with_capacity(4 + 4 * words.len() + self.bits.len());
        out.extend((words.len() as u32).to_le_bytes());
        out.extend(words.iter().flat_map(|w| w.to_le_bytes()));
        out.extend(self.bits);
        out
    }
}

impl Coder for Encoder {
    fn symbol(&mut self, model: &mut Model, symbol: usize) -> Result<usize> {
        let failed = |_| Error::backend("entropy coder", format!("symbol {symbol} is over 15"), "Report this");
        self.coder.encode_symbol(symbol, &*model).map_err(failed)?;
        model.update(symbol);
        Ok(symbol)
    }
    fn bits(&mut self, count: u32, value: u64) -> Result<u64> {
        let value = value & ((1 << count) - 1);
        self.pending |= value << self.filled;
        self.filled += count;
        while self.filled >= 8 {
            self.bits.push(self.pending as u8);
            self.pending >>= 8;
            self.filled -= 8;
        }
        Ok(value)
    }
}

/// Reads what [`Encoder`] wrote.
pub struct Decoder<'a> {
    coder: RangeDecoder<u32, u64, Cursor<u32, Vec<u32>>>,
    bits: &'a [u8],
    at: usize,
    pending: u64,
    filled: u32,
    object: &'a str,
}

impl<'a> Decoder<'a> {
    /// A decoder of `bytes`; `object` names them in errors.
    pub fn new(object: &'a str, bytes: &'a [u8]) -> Result<Self> {
        let mut reader = ByteReader::new(object, bytes);
        let count = reader.u32()? as usize;
        let words = reader.take(count.saturating_mul(4))?.as_chunks::<4>().0.iter().map(|w| u32::from_le_bytes(*w)).collect::<Vec<u32>>();
        let Ok(coder) = RangeDecoder::from_compressed(words);
        Ok(Self { coder, bits: reader.rest(), at: 0, pending: 0, filled: 0, object })
    }
    fn damaged(&self, problem: &str) -> Error {
        Error::data(self.object, problem, "The file is damaged; fetch or write it again")
    }
    /// Refuses data that was not read.
    pub fn finish(self) -> Result<()> {
        if self.at != self.bits.len() || self.pending != 0 || !self.coder.maybe_exhausted() {
            return Err(self.damaged("data follow the last value"));
        }
        Ok(())
    }
}

impl Coder for Decoder<'_> {
    #[inline]
    fn symbol(&mut self, model: &mut Model, _: usize) -> Result<usize> {
        let symbol = self.coder.decode_symbol(&*model).map_err(|_| self.damaged("no sequence of symbols has this code"))?;
        model.update(symbol);
        Ok(symbol)
    }
    #[inline]
    fn bits(&mut self, count: u32, _: u64) -> Result<u64> {
        while self.filled < count {
            let Some(&byte) = self.bits.get(self.at) else { return Err(self.damaged("it ends within a value")) };
            self.pending |= u64::from(byte) << self.filled;
            self.at += 1;
            self.filled += 8;
        }
        let value = self.pending & ((1 << count) - 1);
        self.pending >>= count;
        self.filled -= count;
        Ok(value)
    }
}

/// The smallest integer that is stored behind the last symbol, with its length.
const ESCAPED: u64 = 192;

/// Codes an integer from 0 to 2^41: symbols 0 to 3 are themselves, 4 to 14 an octave's half and its low bits, 15 the rest.
#[inline]
pub fn unsigned<C: Coder>(coder: &mut C, model: &mut Model, value: u64) -> Result<u64> {
    let symbol = coder.symbol(model, if value < 4 { value as usize } else { half_octave(value) })?;
    match symbol as u64 {
        small @ 0..4 => Ok(small),
        15 => {
            let rest = value.wrapping_sub(ESCAPED);
            let length = coder.bits(6, u64::from(u64::BITS - rest.leading_zeros()))? as u32;
            if length > 41 {
                return Err(Error::data("entropy-coded integer", format!("it has {length} bits, at most 41 are allowed"), "The file is damaged"));
            }
            Ok(ESCAPED + if length == 0 { 0 } else { 1 << (length - 1) | coder.bits(length - 1, rest)? })
        }
        symbol => {
            let octave = symbol as u32 / 2;
            Ok((2 + (symbol & 1)) << (octave - 1) | coder.bits(octave - 1, value)?)
        }
    }
}

fn half_octave(value: u64) -> usize {
    let octave = value.ilog2();
    ((2 * octave) as usize + (value >> (octave - 1) & 1) as usize).min(15)
}

/// Codes an integer with a magnitude up to 2^41; the sign has a model of its own.
#[inline]
pub fn signed<C: Coder>(coder: &mut C, size: &mut Model, sign: &mut Model, value: i64) -> Result<i64> {
    let magnitude = unsigned(coder, size, value.unsigned_abs())? as i64;
    if magnitude == 0 {
        return Ok(0);
    }
    Ok(if coder.symbol(sign, usize::from(value < 0))? == 1 { -magnitude } else { magnitude })
}

/// The same with signs that are thought to be random.
#[inline]
pub fn symmetric<C: Coder>(coder: &mut C, size: &mut Model, value: i64) -> Result<i64> {
    let magnitude = unsigned(coder, size, value.unsigned_abs())? as i64;
    if magnitude == 0 {
        return Ok(0);
    }
    Ok(if coder.bits(1, u64::from(value < 0))? == 1 { -magnitude } else { magnitude })
}

#[cfg(test)]
mod tests;
