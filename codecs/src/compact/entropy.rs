//! Entropy coding of integers: static distributions that are stored with the data, and asymmetric numeral systems (constriction's).
//!
//! Encoder and decoder share their modelling code through [`Coder`]: the encoder notes the value it is given, the decoder ignores it and returns the one it
//! reads. Contexts and distributions are integers, so that every machine reads the same values.
//!
//! A value depends on the one before, in its context and in the state of the coder, so a processor waits for most of the time. Rows are therefore coded in
//! [`LANES`] that take turns, each with a coder of its own.

mod integers;

pub use integers::{behind, signed, symbol_of, symmetric};

use super::bits::{BitReader, BitWriter};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Error, Result};
use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::stack::AnsCoder;
use constriction::stream::{Code, Decode, Encode};
use rayon::prelude::*;
use std::borrow::Borrow;
use std::num::NonZeroU32;

/// Symbols of a distribution.
pub const SYMBOLS: usize = 16;
/// Contexts that a stream may have.
pub const CONTEXTS: usize = 4096;
/// Bits of a probability.
const PRECISION: usize = 15;
const ONE: u32 = 1 << PRECISION;
/// Probabilities are stored as quarter octaves above 2^-15, from 1; 0 is impossible.
const MOST_LIKELY: u32 = 61;
/// 2^10 times the quarter octaves of an octave.
const QUARTERS: [u64; 4] = [1024, 1218, 1448, 1722];
/// Low bits of a difference of probabilities that are stored as they are.
const RICE: u32 = 2;

/// A distribution of 16 symbols: where the interval of each ends, and where it starts.
#[derive(Clone)]
#[repr(align(64))]
pub struct Table {
    ends: [u16; SYMBOLS],
    starts: [u16; SYMBOLS],
}

impl Default for Table {
    fn default() -> Self {
        Self::from_shares([i64::from(ONE) / SYMBOLS as i64; SYMBOLS])
    }
}

impl Table {
    /// The distribution of stored probabilities; `None` if no symbol is possible.
    fn from_levels(levels: &[u32; SYMBOLS]) -> Option<Self> {
        let weight = |level: u32| if level == 0 { 0 } else { QUARTERS[(level as usize - 1) % 4] << ((level - 1) / 4) };
        let total: u64 = levels.iter().map(|&l| weight(l)).sum();
        if total == 0 {
            return None;
        }
        let mut shares = levels.map(|l| if l == 0 { 0 } else { ((weight(l) << PRECISION) / total).max(1) as i64 });
        let largest = (0..SYMBOLS).max_by_key(|&s| (shares[s], std::cmp::Reverse(s)))?;
        shares[largest] += i64::from(ONE) - shares.iter().sum::<i64>();
        Some(Self::from_shares(shares))
    }
    /// The distribution of shares that add up to 2^15.
    fn from_shares(shares: [i64; SYMBOLS]) -> Self {
        let mut out = Self { ends: [0; SYMBOLS], starts: [0; SYMBOLS] };
        let mut below = 0;
        for (symbol, share) in shares.into_iter().enumerate() {
            out.starts[symbol] = below as u16;
            below += share;
            out.ends[symbol] = below as u16;
        }
        out
    }
    /// Start and width of a symbol's interval.
    #[inline(always)]
    fn interval(&self, symbol: usize) -> (u32, u32) {
        let (start, end) = (self.starts[symbol % SYMBOLS], self.ends[symbol % SYMBOLS]);
        (u32::from(start), u32::from(end.wrapping_sub(start)))
    }
}

impl EntropyModel<PRECISION> for Table {
    type Symbol = usize;
    type Probability = u32;
}

impl EncoderModel<PRECISION> for Table {
    fn left_cumulative_and_probability(&self, symbol: impl Borrow<usize>) -> Option<(u32, NonZeroU32)> {
        let (start, width) = self.interval((*symbol.borrow()).min(SYMBOLS - 1));
        Some((start, NonZeroU32::new(width)?))
    }
}

impl DecoderModel<PRECISION> for Table {
    #[inline(always)]
    fn quantile_function(&self, quantile: u32) -> (usize, u32, NonZeroU32) {
        // Bisection without branches: four of them in a row cost less than one that is mispredicted.
        let (quantile_16, ends) = (quantile as u16, &self.ends);
        let mut symbol = 8 * usize::from(ends[7] <= quantile_16);
        symbol += 4 * usize::from(ends[(symbol + 3) % SYMBOLS] <= quantile_16);
        symbol += 2 * usize::from(ends[(symbol + 1) % SYMBOLS] <= quantile_16);
        symbol += usize::from(ends[symbol % SYMBOLS] <= quantile_16);
        let (start, width) = self.interval(symbol);
        (symbol, start, NonZeroU32::new(width).unwrap_or(NonZeroU32::MIN))
    }
}

/// Distributions of all contexts of a stream, stored with quarter octaves of probability: exact ones would save 0.002 bits per symbol.
pub struct Tables(Vec<Table>);

impl Tables {
    /// The distributions of what the encoders hold, and their bytes.
    pub fn fit(contexts: usize, encoders: &[Encoder]) -> (Self, Vec<u8>) {
        let none = || vec![[0u32; SYMBOLS]; contexts];
        let count = |encoder: &Encoder| {
            let mut counts = none();
            for &note in encoder.symbols.iter().flatten() {
                if let Some(counts) = counts.get_mut(usize::from(note) / SYMBOLS) {
                    counts[usize::from(note) % SYMBOLS] += 1;
                }
            }
            counts
        };
        let add = |mut sums: Vec<[u32; SYMBOLS]>, counts: Vec<[u32; SYMBOLS]>| {
            sums.iter_mut().flatten().zip(counts.iter().flatten()).for_each(|(sum, count)| *sum += count);
            sums
        };
        let counts = encoders.par_iter().map(count).reduce(none, add);
        let (mut bits, mut tables) = (BitWriter::default(), Vec::with_capacity(contexts));
        for counts in counts {
            let total: u32 = counts.iter().sum();
            let level = |count: u32| {
                let octaves = libm::log2(f64::from(count) / f64::from(total)) + PRECISION as f64;
                if count == 0 { 0 } else { (4.0 * octaves + 1.0).round().clamp(1.0, f64::from(MOST_LIKELY)) as u32 }
            };
            let levels = counts.map(level);
            let found = Table::from_levels(&levels);
            bits.put(1, u64::from(found.is_some()));
            if found.is_some() {
                write_levels(&mut bits, &levels);
            }
            tables.push(found.unwrap_or_default());
        }
        (Self(tables), bits.finish())
    }
    /// Reads the bytes of [`Tables::fit`].
    pub fn read(object: &str, contexts: usize, bytes: &[u8]) -> Result<Self> {
        let damaged = || Error::data(object, "its distributions are impossible", "The file is damaged; fetch or write it again");
        let mut bits = BitReader::new(bytes);
        let mut tables = Vec::with_capacity(contexts);
        for _ in 0..contexts {
            let table = match bits.take(1).ok_or_else(damaged)? {
                0 => Table::default(),
                _ => read_levels(&mut bits).and_then(|levels| Table::from_levels(&levels)).ok_or_else(damaged)?,
            };
            tables.push(table);
        }
        if bits.is_done() { Ok(Self(tables)) } else { Err(damaged()) }
    }
}

fn write_levels(bits: &mut BitWriter, levels: &[u32; SYMBOLS]) {
    let count = levels.iter().rposition(|&l| l > 0).map_or(1, |last| last + 1);
    bits.put(4, count as u64 - 1);
    let mut last = MOST_LIKELY;
    for &level in &levels[..count] {
        let difference = i64::from(level) - i64::from(last);
        let folded = if difference < 0 { -2 * difference - 1 } else { 2 * difference } as u64;
        bits.put((folded >> RICE) as u32 + 1, 1 << (folded >> RICE));
        bits.put(RICE, folded);
        last = level;
    }
}

fn read_levels(bits: &mut BitReader) -> Option<[u32; SYMBOLS]> {
    let count = bits.take(4)? as usize + 1;
    let (mut levels, mut last) = ([0; SYMBOLS], i64::from(MOST_LIKELY));
    for level in &mut levels[..count] {
        let mut folded = 0i64;
        while bits.take(1)? == 0 {
            folded += 1 << RICE;
            if folded > 4 * i64::from(MOST_LIKELY) {
                return None;
            }
        }
        folded += bits.take(RICE)? as i64;
        last += if folded & 1 == 1 { -(folded + 1) / 2 } else { folded / 2 };
        *level = u32::try_from(last).ok().filter(|l| *l <= MOST_LIKELY)?;
    }
    Some(levels)
}

/// Independent coders that take turns.
pub const LANES: usize = 4;

/// The rows of a block by lane: each has one run of rows.
#[derive(Clone, Copy)]
pub struct Lanes {
    count: usize,
    each: usize,
}

impl Lanes {
    /// The lanes of `count` rows.
    pub fn of(count: usize) -> Self {
        Self { count, each: count.div_ceil(LANES) }
    }
    /// Rows of the longest lane.
    pub fn steps(&self) -> usize {
        self.each
    }
    /// All rows in the order in which they are coded, each with its lane.
    pub fn turns(self) -> impl Iterator<Item = (usize, usize)> {
        (0..self.each).flat_map(move |step| (0..LANES).filter_map(move |lane| Some((lane, self.row(lane, step)?))))
    }
    /// The row of a lane at a step; `None` where the lane is at its end.
    #[inline(always)]
    pub fn row(&self, lane: usize, step: usize) -> Option<usize> {
        let row = lane * self.each + step;
        (row < self.count).then_some(row)
    }
}

/// An encoder or a decoder.
pub trait Coder {
    /// Whether it is given values to write.
    const WRITES: bool;
    /// Codes `symbol` (0 to 15) in a context with the coder of a lane.
    fn symbol(&mut self, lane: usize, context: usize, symbol: usize) -> Result<usize>;
    /// Codes the low `count` (at most 56) bits of `value`, which are thought to be random.
    fn bits(&mut self, count: u32, value: u64) -> Result<u64>;
}

/// Notes symbols and bits, which are coded once the distributions are known.
#[derive(Default)]
pub struct Encoder {
    /// Contexts times 16, plus symbols, of each lane.
    symbols: [Vec<u16>; LANES],
    bits: BitWriter,
}

impl Encoder {
    /// The bytes: the number of words of each lane (seven bits per byte, the lowest first; the upper bit says that more follow), their words, then the bits.
    pub fn finish(self, tables: &Tables) -> Result<Vec<u8>> {
        let failed = || Error::backend("entropy coder", "a symbol has no probability", "Report this");
        let (mut out, mut bytes) = (Vec::new(), Vec::new());
        for notes in &self.symbols {
            let mut coder = AnsCoder::<u32, u64>::new();
            for &note in notes.iter().rev() {
                let table = tables.0.get(usize::from(note) / SYMBOLS).ok_or_else(failed)?;
                coder.encode_symbol(usize::from(note) % SYMBOLS, table).map_err(|_| failed())?;
            }
            let words: Vec<u32> = coder.into_compressed().map_err(|_| failed())?;
            let mut count = words.len();
            while count > 0x7f {
                out.push(count as u8 | 0x80);
                count >>= 7;
            }
            out.push(count as u8);
            bytes.extend(words.iter().flat_map(|w| w.to_le_bytes()));
        }
        out.extend(bytes);
        out.extend(self.bits.finish());
        Ok(out)
    }
}

impl Coder for Encoder {
    const WRITES: bool = true;
    #[inline]
    fn symbol(&mut self, lane: usize, context: usize, symbol: usize) -> Result<usize> {
        if context >= CONTEXTS || symbol >= SYMBOLS {
            return Err(Error::backend("entropy coder", format!("symbol {symbol} of context {context}"), "Report this"));
        }
        self.symbols[lane % LANES].push((context * SYMBOLS + symbol) as u16);
        Ok(symbol)
    }
    #[inline]
    fn bits(&mut self, count: u32, value: u64) -> Result<u64> {
        Ok(self.bits.put(count, value))
    }
}

/// Reads what [`Encoder`] wrote.
pub struct Decoder<'a> {
    coders: [AnsCoder<u32, u64>; LANES],
    tables: &'a Tables,
    bits: BitReader<'a>,
    object: &'a str,
}

impl<'a> Decoder<'a> {
    /// A decoder of `bytes`; `object` names them in errors.
    pub fn new(object: &'a str, tables: &'a Tables, bytes: &'a [u8]) -> Result<Self> {
        let mut reader = ByteReader::new(object, bytes);
        let mut counts = [0usize; LANES];
        for count in &mut counts {
            // Of 32 bits, which are all that numbers of memory have on some machines, the fifth byte has four.
            for shift in (0..).step_by(7) {
                let byte = reader.u8()?;
                if shift == 28 && byte > 0x0f {
                    return Err(reader.error("a number of words is too long"));
                }
                *count |= usize::from(byte & 0x7f) << shift;
                if byte < 0x80 {
                    break;
                }
            }
        }
        let mut coders: [AnsCoder<u32, u64>; LANES] = std::array::from_fn(|_| AnsCoder::new());
        for (coder, count) in coders.iter_mut().zip(counts) {
            let words = reader.take(count.saturating_mul(4))?.as_chunks::<4>().0.iter().map(|w| u32::from_le_bytes(*w)).collect::<Vec<u32>>();
            *coder = AnsCoder::from_compressed(words).map_err(|_| reader.error("the last word of a lane is zero"))?;
        }
        Ok(Self { coders, tables, bits: BitReader::new(reader.rest()), object })
    }
    #[cold]
    fn damaged(&self, problem: &str) -> Error {
        Error::data(self.object, problem, "The file is damaged; fetch or write it again")
    }
    /// Refuses data that was not read.
    pub fn finish(self) -> Result<()> {
        if !self.bits.is_done() || !self.coders.iter().all(|c| c.decoder_maybe_exhausted::<PRECISION>()) {
            return Err(self.damaged("data follow the last value"));
        }
        Ok(())
    }
}

impl Coder for Decoder<'_> {
    const WRITES: bool = false;
    #[inline(always)]
    fn symbol(&mut self, lane: usize, context: usize, _: usize) -> Result<usize> {
        let Some(table) = self.tables.0.get(context) else { return Err(self.damaged("a value has no distribution")) };
        self.coders[lane % LANES].decode_symbol(table).map_err(|_| Error::backend("entropy coder", "its words cannot be read", "Report this"))
    }
    #[inline(always)]
    fn bits(&mut self, count: u32, _: u64) -> Result<u64> {
        match self.bits.take(count) {
            Some(bits) => Ok(bits),
            None => Err(self.damaged("it ends within a value")),
        }
    }
}

#[cfg(test)]
mod tests;
