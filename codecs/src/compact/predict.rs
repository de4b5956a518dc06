//! Integers of rows that are predicted by a linear function of earlier rows and of what is known about the row, with weights that the encoder fits.

use super::entropy::{Coder, symmetric};
use super::geometry::checked;
use cc4dgs_format::Result;
use cc4dgs_format::archive::ByteReader;

/// Contexts by expected magnitude, in half octaves.
const LEVELS: usize = 32;
/// Components of a row, at most.
const DIMS: usize = 3;
/// Known numbers of a row, at most.
pub const GIVEN: usize = 5;
const INPUTS: usize = 2 + DIMS + GIVEN + 1;
/// Rows that are remembered.
const MEMORY: usize = 8;
/// Bits behind the point of weights.
const POINT: u32 = 9;
/// The input that is the same for all rows.
const CONSTANT: i64 = 4096;
/// Predictions are smaller in magnitude; inputs are, because codes are below 2^24 and shifts at most 15.
const LIMIT: i64 = 1 << 40;
/// Passes of the fit; each weighs rows by the inverse error of the one before, so that the sum of magnitudes falls.
const PASSES: usize = 3;

/// What is known about a row: numbers in the steps of class 0, and the shift of its steps.
#[derive(Clone, Copy, Default)]
pub struct Known {
    pub class: u8,
    pub shift: u8,
    pub given: [i64; GIVEN],
}

/// The weights `[dims, inputs]` of the components.
#[derive(Clone)]
pub struct Linear {
    dims: usize,
    weights: Vec<i16>,
}

/// Rows before.
struct History {
    rows: [[i64; DIMS]; MEMORY],
    sums: [i64; DIMS],
    count: usize,
}

impl History {
    fn new() -> Self {
        Self { rows: [[0; DIMS]; MEMORY], sums: [0; DIMS], count: 0 }
    }
    fn push(&mut self, row: [i64; DIMS]) {
        let slot = &mut self.rows[self.count % MEMORY];
        for (sum, (new, old)) in self.sums.iter_mut().zip(row.iter().zip(slot.iter())) {
            *sum += new - old;
        }
        *slot = row;
        self.count += 1;
    }
    /// Inputs of the component `c` of a row whose components before are `row`.
    #[inline]
    fn inputs(&self, c: usize, row: &[i64; DIMS], known: &Known) -> [i64; INPUTS] {
        let mut out = [0; INPUTS];
        let last = |k: usize| self.rows[(self.count + MEMORY - k) % MEMORY][c];
        out[0] = (last(1) + last(2)) / 2;
        out[1] = self.sums[c] / self.count.clamp(1, MEMORY) as i64;
        out[2..2 + c].copy_from_slice(&row[..c]);
        out[2 + DIMS..2 + DIMS + GIVEN].copy_from_slice(&known.given);
        out[INPUTS - 1] = CONSTANT;
        out
    }
}

impl Linear {
    /// Contexts of rows of `dims` components.
    pub const fn contexts(dims: usize) -> usize {
        dims * LEVELS
    }
    /// Fits the weights to the rows `codes` `[N,dims]`; blocks start where [`super::blocks`] starts them.
    pub fn fit(dims: usize, codes: &[i32], known: &[Known]) -> Self {
        let mut fitted = vec![[0.0; INPUTS]; dims];
        let mut spread = [0.0; DIMS];
        for pass in 0..PASSES {
            let mut sums = vec![([[0.0f64; INPUTS]; INPUTS], [0.0f64; INPUTS]); dims];
            let (mut errors, mut history) = ([0.0; DIMS], History::new());
            for (i, (codes, known)) in codes.chunks_exact(dims).zip(known).enumerate() {
                if i % super::blocks::ROWS == 0 {
                    history = History::new();
                }
                let mut row = [0; DIMS];
                for (c, &code) in codes.iter().enumerate() {
                    let inputs = history.inputs(c, &row, known).map(|v| v as f64);
                    row[c] = i64::from(code) << known.shift;
                    let target = row[c] as f64;
                    let error = (target - fitted[c].iter().zip(inputs).map(|(w, x)| w * x).sum::<f64>()).abs();
                    errors[c] += error;
                    let weight = if pass == 0 { 1.0 } else { 1.0 / (error + spread[c]).max(1e-9) };
                    let (matrix, vector) = &mut sums[c];
                    for (a, &x) in inputs.iter().enumerate().filter(|(_, x)| **x != 0.0) {
                        matrix[a].iter_mut().zip(&inputs).for_each(|(m, y)| *m += weight * x * y);
                        vector[a] += weight * x * target;
                    }
                }
                history.push(row);
            }
            spread = errors.map(|e| 0.5 * e / known.len().max(1) as f64);
            for ((matrix, vector), fitted) in sums.into_iter().zip(&mut fitted) {
                *fitted = solve(matrix, vector);
            }
        }
        let round = |w: f64| libm::round(w * f64::from(1u32 << POINT)).clamp(-32767.0, 32767.0) as i16;
        Self { dims, weights: fitted.into_iter().flatten().map(round).collect() }
    }
    pub fn write(&self, out: &mut Vec<u8>) {
        self.weights.iter().for_each(|w| out.extend(w.to_le_bytes()));
    }
    pub fn read(dims: usize, meta: &mut ByteReader) -> Result<Self> {
        let weights = (0..dims * INPUTS).map(|_| Ok(meta.u16()? as i16)).collect::<Result<Vec<i16>>>()?;
        Ok(Self { dims, weights })
    }
    /// Codes the rows `codes` `[N,dims]` of a block.
    pub fn code<C: Coder>(&self, coder: &mut C, codes: &mut [i32], known: &[Known]) -> Result<()> {
        let mut history = History::new();
        let mut sizes = [[0u64; 16]; DIMS];
        let mut recent = [0u64; DIMS];
        for (codes, known) in codes.chunks_exact_mut(self.dims).zip(known) {
            let mut row = [0; DIMS];
            for (c, code) in codes.iter_mut().enumerate() {
                let inputs = history.inputs(c, &row, known);
                let sum: i64 = self.weights[c * INPUTS..(c + 1) * INPUTS].iter().zip(inputs).map(|(&w, x)| i64::from(w) * x).sum();
                let shift = u32::from(known.shift.min(15));
                let guess = rounded((sum >> POINT).clamp(-LIMIT, LIMIT), shift);
                let size = &mut sizes[c][usize::from(known.class & 15)];
                let expected = if *size == 0 { recent[c] } else { (*size + recent[c]) / 2 };
                let context = c * LEVELS + level(expected >> shift);
                let difference = symmetric(coder, context, i64::from(*code) - guess)?;
                *code = checked(guess + difference)?;
                row[c] = i64::from(*code) << shift;
                let magnitude = difference.unsigned_abs() << shift;
                *size = if *size == 0 { 16 * magnitude } else { *size - *size / 16 + magnitude };
                recent[c] = recent[c] - recent[c] / 4 + 4 * magnitude;
            }
            history.push(row);
        }
        Ok(())
    }
}

fn rounded(value: i64, shift: u32) -> i64 {
    if shift == 0 { value } else { (value + (1 << (shift - 1))) >> shift }
}

/// Half octaves of a size, 0 to 31.
#[inline]
fn level(size: u64) -> usize {
    if size < 4 {
        return size as usize;
    }
    let octave = size.ilog2();
    ((2 * octave + (size >> (octave - 1) & 1) as u32) as usize).min(LEVELS - 1)
}

/// The solution of a symmetric system, slightly regularised; inputs that say nothing have the weight 0.
fn solve(mut matrix: [[f64; INPUTS]; INPUTS], mut vector: [f64; INPUTS]) -> [f64; INPUTS] {
    let mut skipped = [false; INPUTS];
    for k in 0..INPUTS {
        skipped[k] = matrix[k][k] <= 0.0;
        matrix[k][k] *= 1.0 + 1e-6;
    }
    for k in 0..INPUTS {
        let pivot = matrix[k];
        if skipped[k] || pivot[k].is_nan() || pivot[k] <= 0.0 {
            skipped[k] = true;
            continue;
        }
        for other in (0..INPUTS).filter(|&o| o != k) {
            let factor = matrix[other][k] / pivot[k];
            matrix[other].iter_mut().zip(pivot).for_each(|(m, p)| *m -= factor * p);
            vector[other] -= factor * vector[k];
        }
    }
    std::array::from_fn(|k| if skipped[k] || !(vector[k] / matrix[k][k]).is_finite() { 0.0 } else { vector[k] / matrix[k][k] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_from_the_rest_has_no_error() {
        let known: Vec<Known> = (0..3000i64).map(|i| Known { class: 0, shift: 0, given: [i * i % 977, i % 13, 0, 0, 0] }).collect();
        let codes: Vec<i32> = known.iter().flat_map(|k| [(3 * k.given[0] - 7 * k.given[1]) as i32, (k.given[0] / 2) as i32]).collect();
        let linear = Linear::fit(2, &codes, &known);
        let mut encoder = super::super::entropy::Encoder::default();
        linear.code(&mut encoder, &mut codes.clone(), &known).unwrap();
        let (tables, stored) = super::super::entropy::Tables::fit(Linear::contexts(2), std::slice::from_ref(&encoder));
        let bytes = encoder.finish(&tables).unwrap();
        assert!(stored.len() + bytes.len() < 1500, "{} bytes for 6000 values", bytes.len());
        let mut decoder = super::super::entropy::Decoder::new("test", &tables, &bytes).unwrap();
        let mut found = vec![0; codes.len()];
        linear.code(&mut decoder, &mut found, &known).unwrap();
        assert_eq!(found, codes);
    }
}
