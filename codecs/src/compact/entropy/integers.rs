//! Integers as symbols: a magnitude has the symbol of its half octave, and bits behind it.

use super::{Coder, SYMBOLS};
use cc4dgs_format::{Error, Result};

/// The smallest magnitude that is stored behind the last symbol, with its length.
const ESCAPED: u64 = 192;
/// Bits of magnitudes above that, at most.
const LONGEST: u32 = 41;

/// Symbols of a magnitude: 0 to 3 are themselves, 4 to 14 an octave's half, 15 the rest.
#[inline(always)]
pub fn symbol_of(magnitude: u64) -> usize {
    if magnitude < 4 {
        return magnitude as usize;
    }
    let octave = magnitude.ilog2();
    ((2 * octave) as usize + (magnitude >> (octave - 1) & 1) as usize).min(SYMBOLS - 1)
}

/// The smallest magnitude of each symbol.
const SMALLEST: [u64; SYMBOLS] = [0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, ESCAPED];
/// Bits behind each symbol: the low ones of a magnitude, except of the last, whose bits follow.
const LOW_BITS: [u32; SYMBOLS] = [0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 0];

/// Codes the magnitude above [`ESCAPED`].
#[cold]
fn escaped<C: Coder>(coder: &mut C, rest: u64) -> Result<u64> {
    let length = coder.bits(6, u64::from(u64::BITS - rest.leading_zeros()))? as u32;
    if length > LONGEST {
        return Err(Error::data("entropy-coded integer", format!("it has {length} bits, at most {LONGEST} are allowed"), "The file is damaged"));
    }
    Ok(if length == 0 { 0 } else { 1 << (length - 1) | coder.bits(length - 1, rest)? })
}

/// Codes an integer with a magnitude up to 2^41; the sign has a context of its own.
#[inline]
pub fn signed<C: Coder>(coder: &mut C, lane: usize, size: usize, sign: usize, value: i64) -> Result<i64> {
    let magnitude = value.unsigned_abs();
    let symbol = coder.symbol(lane, size, symbol_of(magnitude))? % SYMBOLS;
    let below = magnitude.wrapping_sub(SMALLEST[symbol]);
    let mut found = SMALLEST[symbol] + coder.bits(LOW_BITS[symbol], below)?;
    if symbol == SYMBOLS - 1 {
        found += escaped(coder, below)?;
    }
    if found == 0 {
        return Ok(0);
    }
    Ok(if coder.symbol(lane, sign, usize::from(value < 0))? == 1 { -(found as i64) } else { found as i64 })
}

/// The same with signs that are thought to be random. Without branches but for the last symbol.
#[inline(always)]
pub fn symmetric<C: Coder>(coder: &mut C, lane: usize, size: usize, value: i64) -> Result<i64> {
    let symbol = coder.symbol(lane, size, symbol_of(value.unsigned_abs()))?;
    behind(coder, symbol, value)
}

/// Codes what is behind the symbol of a magnitude: its low bits and the sign.
#[inline(always)]
pub fn behind<C: Coder>(coder: &mut C, symbol: usize, value: i64) -> Result<i64> {
    let symbol = symbol % SYMBOLS;
    let below = value.unsigned_abs().wrapping_sub(SMALLEST[symbol]);
    let bits = coder.bits(LOW_BITS[symbol] + u32::from(symbol > 0), below << 1 | u64::from(value < 0))?;
    let mut found = SMALLEST[symbol] + (bits >> 1);
    if symbol == SYMBOLS - 1 {
        found = ESCAPED + escaped(coder, below)?;
    }
    let sign = -((bits & 1) as i64);
    Ok((found as i64 ^ sign) - sign)
}
