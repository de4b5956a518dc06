//! Entropy coding of the codes of a degree: sizes of rows, then the symbols of their coordinates, then low bits and signs.

use super::super::entropy::{Coder, LANES, Lanes, behind, symbol_of};
use super::Degree;
use cc4dgs_format::Result;
use rayon::prelude::*;

/// Contexts of the size of a row: four per octave of the size expected.
const SIZES: usize = 32;
/// Contexts of a coordinate: octaves below the coordinate with the largest spread, the size of the row, whether the size was reached before, and whether the
/// coordinate before is zero.
const LEVELS: usize = 12;
const ROW_SIZES: usize = 10;
const STATES: usize = 4;
/// Contexts of [`Degree::code`].
pub const CONTEXTS: usize = SIZES + LEVELS * ROW_SIZES * STATES;
/// The size of a row of zeros, in half octaves: one less than that of a row with a 1.
const NOTHING: i32 = -1;

impl Degree {
    /// The sizes of the rows `[N,dims]`, as [`Degree::code`] leaves them.
    pub fn note(&self, codes: &[i32], classes: &[u8], sizes: &mut [i32]) {
        let rows = codes.par_chunks_exact(self.dims).zip(classes).zip(sizes);
        rows.for_each(|((codes, &class), size)| *size = size_of(largest_symbol(codes), class));
    }
    /// Codes the coordinates `[N,dims]` of a block. `sizes` are the sizes of the rows in the degree before, 0 if this is the first, and become those in this
    /// one: the symbol of the largest magnitude plus twice the class, in half octaves. Sizes of all rows come first; then rows of zeros are known.
    pub fn code<C: Coder>(&self, coder: &mut C, codes: &mut [i32], classes: &[u8], sizes: &mut [i32], first: bool) -> Result<()> {
        let (dims, rows) = (self.dims, classes.len().min(sizes.len()).min(codes.len() / self.dims.max(1)));
        let (codes, classes, sizes) = (&mut codes[..rows * dims], &classes[..rows], &mut sizes[..rows]);
        // Running means of sizes, times 8.
        let mut means = [0i32; LANES];
        let mut filled = Vec::with_capacity(rows);
        for (lane, row) in Lanes::of(rows).turns() {
            let class = i32::from(classes[row].min(15));
            // Twice the degree before and once the rows before, or these alone, times 2.
            let expected = if first { means[lane] / 4 } else { (16 * sizes[row] + means[lane]) / 12 };
            let context = (expected - 4 * class + 4).clamp(0, SIZES as i32 - 1);
            let wanted = if C::WRITES { largest_symbol(&codes[row * dims..(row + 1) * dims]) } else { 0 };
            let symbol = coder.symbol(lane, context as usize, wanted)?;
            sizes[row] = size_of(symbol, classes[row]);
            means[lane] += sizes[row] - means[lane] / 8;
            if symbol == 0 {
                codes[row * dims..(row + 1) * dims].fill(0);
            } else {
                filled.push((row as u32, symbol as u8));
            }
        }
        let largest = self.spread.iter().copied().max().unwrap_or(0);
        let levels: Vec<usize> = self.spread.iter().map(|&s| usize::from((largest - s) / 2).min(LEVELS - 1)).collect();
        // Symbols first: contexts depend on symbols alone, so that decoding a symbol need not wait for low bits and signs.
        let mut symbols = vec![0u8; filled.len() * dims];
        if C::WRITES {
            for (symbols, &(row, _)) in symbols.chunks_exact_mut(dims).zip(&filled) {
                symbols.iter_mut().zip(&codes[row as usize * dims..]).for_each(|(symbol, code)| *symbol = symbol_of(u64::from(code.unsigned_abs())) as u8);
            }
        }
        let lanes = Lanes::of(filled.len());
        for step in 0..lanes.steps() {
            // Short lanes have no last row.
            let mut rows: [Row; LANES] = std::array::from_fn(|lane| match lanes.row(lane, step) {
                Some(k) => {
                    let size = usize::from(filled[k].1);
                    Row { context: SIZES + (size.min(ROW_SIZES) - 1) * STATES, first: k * dims, size, state: 0 }
                }
                None => Row { context: SIZES, first: symbols.len(), size: 1, state: 0 },
            });
            let [a, b, c, d] = &mut rows;
            for (k, level) in levels.iter().enumerate() {
                // Written out, so that the lanes' coders stay in registers.
                a.code(coder, 0, level * ROW_SIZES * STATES, k, &mut symbols)?;
                b.code(coder, 1, level * ROW_SIZES * STATES, k, &mut symbols)?;
                c.code(coder, 2, level * ROW_SIZES * STATES, k, &mut symbols)?;
                d.code(coder, 3, level * ROW_SIZES * STATES, k, &mut symbols)?;
            }
        }
        for (&(row, _), symbols) in filled.iter().zip(symbols.chunks_exact(dims)) {
            for (code, &symbol) in codes[row as usize * dims..][..dims].iter_mut().zip(symbols) {
                *code = behind(coder, usize::from(symbol), i64::from(*code))? as i32;
            }
        }
        Ok(())
    }
}

/// The row of a lane whose symbols are being coded.
struct Row {
    /// Its context without level and state.
    context: usize,
    /// Index of its first symbol.
    first: usize,
    size: usize,
    /// 1 if the coordinate before is not zero, plus 2 if one had the size of the row.
    state: usize,
}

impl Row {
    /// Codes its symbol `k`, whose level starts `level` contexts after the first.
    #[inline(always)]
    fn code<C: Coder>(&mut self, coder: &mut C, lane: usize, level: usize, k: usize, symbols: &mut [u8]) -> Result<()> {
        let Some(symbol) = symbols.get_mut(self.first + k) else { return Ok(()) };
        let found = coder.symbol(lane, self.context + level + self.state, usize::from(*symbol))?;
        *symbol = found as u8;
        self.state = (self.state & 2) | usize::from(found >= self.size) << 1 | usize::from(found > 0);
        Ok(())
    }
}

/// The symbol of the largest magnitude.
fn largest_symbol(codes: &[i32]) -> usize {
    symbol_of(u64::from(codes.iter().map(|v| v.unsigned_abs()).max().unwrap_or(0)))
}

/// The size of a row whose largest magnitude has this symbol.
fn size_of(symbol: usize, class: u8) -> i32 {
    2 * i32::from(class.min(15)) + if symbol == 0 { NOTHING } else { symbol as i32 }
}
