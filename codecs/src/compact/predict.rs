//! Integers of rows that are predicted by a linear function of earlier rows and of what is known about the row, with weights that the encoder fits.

use super::entropy::{Coder, LANES, Lanes, behind, symbol_of};
use super::geometry::checked;
use cc4dgs_format::Result;
use cc4dgs_format::archive::ByteReader;
use rayon::prelude::*;

/// Contexts by expected magnitude, in half octaves.
const LEVELS: usize = 32;
/// Components of a row, at most.
const DIMS: usize = 3;
/// Known numbers of a row, beside its classes.
pub const GIVEN: usize = 3;
const INPUTS: usize = 2 + DIMS + 2 + GIVEN + 1;
/// What an octave of a class counts in predictions.
const OCTAVE: i64 = 512;
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

/// What is known about a row.
#[derive(Clone, Copy, Default)]
pub struct Known {
    /// The classes of its colours and of the rest.
    pub classes: [u8; 2],
    /// The class of what is coded, which is one of the two.
    pub class: u8,
    /// The shift of the steps of what is coded.
    pub shift: u8,
    /// Numbers in the steps of class 0, which predict rows of one component; [`Linear::fit`] and [`Linear::code`] ignore them in others.
    pub given: [i64; GIVEN],
}

impl Known {
    /// What its classes count as inputs.
    fn octaves(&self) -> [i64; 2] {
        self.classes.map(|class| i64::from(class) * OCTAVE)
    }
}

/// The weights `[dims, inputs]` of the components.
#[derive(Clone)]
pub struct Linear {
    dims: usize,
    weights: Vec<i16>,
}

/// The state of a lane.
struct State {
    history: History,
    /// Components of the row that is being coded.
    row: [i64; DIMS],
    /// Magnitudes of differences: per component and class over the last rows of the class, and per component over the very last rows.
    sizes: [[u64; 16]; DIMS],
    recent: [u64; DIMS],
    /// Prediction, context and symbol of the component that is being coded.
    guess: i64,
    context: usize,
    symbol: usize,
}

impl State {
    fn new() -> Self {
        Self { history: History::new(), row: [0; DIMS], sizes: [[0; 16]; DIMS], recent: [0; DIMS], guess: 0, context: 0, symbol: 0 }
    }
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
    /// Means of the component `c` over the last two rows, and over all that are remembered.
    #[inline(always)]
    fn means(&self, c: usize) -> [i64; 2] {
        let last = |k: usize| self.rows[(self.count + MEMORY - k) % MEMORY][c];
        // A division by a constant is fast, and the usual one. The other is a function of its own because rustc 1.95 divided by `count` in both branches of
        // some builds.
        let all = if self.count < MEMORY { self.early_mean(c) } else { self.sums[c] / MEMORY as i64 };
        [(last(1) + last(2)) / 2, all]
    }
    /// The mean over all rows where there are fewer than are remembered.
    #[cold]
    #[inline(never)]
    fn early_mean(&self, c: usize) -> i64 {
        self.sums[c] / self.count.max(1) as i64
    }
    /// Inputs of the component `c` of a row whose components before are `row`.
    #[inline]
    fn inputs(&self, c: usize, row: &[i64; DIMS], known: &Known) -> [i64; INPUTS] {
        let mut out = [0; INPUTS];
        [out[0], out[1]] = self.means(c);
        out[2..2 + c].copy_from_slice(&row[..c]);
        out[2 + DIMS..4 + DIMS].copy_from_slice(&known.octaves());
        out[4 + DIMS..4 + DIMS + GIVEN].copy_from_slice(&known.given);
        out[INPUTS - 1] = CONSTANT;
        out
    }
    /// The `K` inputs of the component `C` that can differ from 0, in the same order: the numbers given are among them if `K` counts them.
    #[inline(always)]
    fn used_inputs<const C: usize, const K: usize>(&self, row: &[i64; DIMS], known: &Known) -> [f64; K] {
        let mut out = [0; K];
        [out[0], out[1]] = self.means(C);
        out[2..2 + C].copy_from_slice(&row[..C]);
        out[2 + C..4 + C].copy_from_slice(&known.octaves());
        // All numbers given, or none of them.
        out[4 + C..K - 1].copy_from_slice(&known.given[..K - 5 - C]);
        out[K - 1] = CONSTANT;
        out.map(|v| v as f64)
    }
}

impl Linear {
    /// Contexts of rows of `dims` components.
    pub const fn contexts(dims: usize) -> usize {
        dims * LEVELS
    }
    /// Fits the weights to the rows `codes` `[N,dims]`; `known` gives what is known about each. Blocks start where they would in one layer; that
    /// layers and lanes start anew is ignored, because it matters little.
    pub fn fit(dims: usize, codes: &[i32], known: impl Fn(usize) -> Known + Sync) -> Self {
        // Components are fitted in parallel: the codes of all of them are known.
        let component = |c: usize| match (dims, c) {
            (1, _) => fit_component::<0, { 5 + GIVEN }>(dims, codes, &known),
            (_, 0) => fit_component::<0, 5>(dims, codes, &known),
            (_, 1) => fit_component::<1, 6>(dims, codes, &known),
            _ => fit_component::<2, 7>(dims, codes, &known),
        };
        let fitted: Vec<[f64; INPUTS]> = (0..dims).into_par_iter().map(component).collect();
        let round = |w: f64| libm::round(w * f64::from(1u32 << POINT)).clamp(-32767.0, 32767.0) as i16;
        Self { dims, weights: fitted.into_iter().flatten().map(round).collect() }
    }
    /// Predictions of the rows `codes` `[N,dims]`, in the steps of each row. Lanes, in which coders start anew, are left out.
    pub fn guesses(&self, codes: &[i32], known: impl Fn(usize) -> Known) -> Vec<f64> {
        let (mut out, mut history) = (Vec::with_capacity(codes.len()), History::new());
        for (i, codes) in codes.chunks_exact(self.dims).enumerate() {
            if i % super::blocks::ROWS == 0 {
                history = History::new();
            }
            let (mut row, known) = ([0; DIMS], known(i));
            for (c, (&code, weights)) in codes.iter().zip(self.weights.chunks_exact(INPUTS)).enumerate() {
                let sum: f64 = history.inputs(c, &row, &known).into_iter().zip(weights).map(|(x, &w)| x as f64 * f64::from(w)).sum();
                out.push(sum / f64::from(1u32 << POINT) / f64::from(1u32 << known.shift.min(15)));
                row[c] = i64::from(code) << known.shift;
            }
            history.push(row);
        }
        out
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
        match self.dims {
            1 => self.code_dims::<C, 1>(coder, codes, known),
            _ => self.code_dims::<C, DIMS>(coder, codes, known),
        }
    }
    fn code_dims<C: Coder, const D: usize>(&self, coder: &mut C, codes: &mut [i32], known: &[Known]) -> Result<()> {
        let codes = codes.as_chunks_mut::<D>().0;
        let lanes = Lanes::of(codes.len().min(known.len()));
        let weights: [[i64; INPUTS]; D] = std::array::from_fn(|c| std::array::from_fn(|k| i64::from(self.weights[c * INPUTS + k])));
        let mut states: [State; LANES] = std::array::from_fn(|_| State::new());
        // The contribution of each pair of classes, and of the constant.
        let of_classes = |weights: &[i64; INPUTS], k: usize| {
            let known = Known { classes: [(k / 16) as u8, (k % 16) as u8], ..Default::default() };
            weights[2 + DIMS..].iter().zip(known.octaves()).map(|(w, x)| w * x).sum::<i64>() + weights[INPUTS - 1] * CONSTANT
        };
        let of_classes: [[i64; 256]; D] = std::array::from_fn(|c| std::array::from_fn(|k| of_classes(&weights[c], k)));
        for step in 0..lanes.steps() {
            for c in 0..D {
                // In three passes, so that the lanes' symbols follow each other closely.
                for (lane, state) in states.iter_mut().enumerate() {
                    let Some(row) = lanes.row(lane, step) else { continue };
                    let (known, weights) = (&known[row], &weights[c]);
                    let [short, long] = state.history.means(c);
                    let mut sum =
                        of_classes[c][usize::from(known.classes[0] & 15) * 16 + usize::from(known.classes[1] & 15)] + weights[0] * short + weights[1] * long;
                    sum += weights[2..2 + c].iter().zip(&state.row).map(|(w, x)| w * x).sum::<i64>();
                    if D == 1 {
                        sum += weights[4 + DIMS..].iter().zip(known.given).map(|(w, x)| w * x).sum::<i64>();
                    }
                    let shift = u32::from(known.shift.min(15));
                    state.guess = rounded((sum >> POINT).clamp(-LIMIT, LIMIT), shift);
                    let (size, recent) = (state.sizes[c][usize::from(known.class & 15)], state.recent[c]);
                    let expected = if size == 0 { recent } else { (size + recent) / 2 };
                    state.context = c * LEVELS + level(expected >> shift);
                }
                for (lane, state) in states.iter_mut().enumerate() {
                    let Some(row) = lanes.row(lane, step) else { continue };
                    let wanted = if C::WRITES { symbol_of((i64::from(codes[row][c]) - state.guess).unsigned_abs()) } else { 0 };
                    state.symbol = coder.symbol(lane, state.context, wanted)?;
                }
                for (lane, state) in states.iter_mut().enumerate() {
                    let Some(row) = lanes.row(lane, step) else { continue };
                    let (code, known) = (&mut codes[row][c], &known[row]);
                    let shift = u32::from(known.shift.min(15));
                    let difference = behind(coder, state.symbol, i64::from(*code) - state.guess)?;
                    *code = checked(state.guess + difference)?;
                    state.row[c] = i64::from(*code) << shift;
                    let magnitude = difference.unsigned_abs() << shift;
                    let (size, recent) = (&mut state.sizes[c][usize::from(known.class & 15)], &mut state.recent[c]);
                    *size = if *size == 0 { 16 * magnitude } else { *size - *size / 16 + magnitude };
                    *recent = *recent - *recent / 4 + 4 * magnitude;
                }
            }
            for state in &mut states {
                // A lane at its end has no more rows to predict.
                state.history.push(state.row);
                state.row = [0; DIMS];
            }
        }
        Ok(())
    }
}

/// The weights of the component `C` of the rows `codes` `[N,dims]`, fitted to its [`History::used_inputs`]; those of the other inputs are 0.
fn fit_component<const C: usize, const K: usize>(dims: usize, codes: &[i32], known: impl Fn(usize) -> Known) -> [f64; INPUTS] {
    let (mut weights, mut spread) = ([0.0; INPUTS], 0.0);
    for pass in 0..PASSES {
        let fitted: [f64; K] = std::array::from_fn(|k| weights[input_of::<C, K>(k)]);
        let (mut sums, mut targets, mut errors) = ([[0.0f64; K]; K], [0.0f64; K], 0.0);
        let mut history = History::new();
        for (i, codes) in codes.chunks_exact(dims).enumerate() {
            if i % super::blocks::ROWS == 0 {
                history = History::new();
            }
            let (mut row, known) = ([0; DIMS], known(i));
            row.iter_mut().zip(codes).for_each(|(row, &code)| *row = i64::from(code) << known.shift);
            let (inputs, target) = (history.used_inputs::<C, K>(&row, &known), row[C] as f64);
            let error = (target - fitted.iter().zip(inputs).map(|(w, x)| w * x).sum::<f64>()).abs();
            errors += error;
            let weight = if pass == 0 { 1.0 } else { 1.0 / (error + spread).max(1e-9) };
            for (k, (sums, x)) in sums.iter_mut().zip(inputs).enumerate() {
                sums.iter_mut().zip(inputs).for_each(|(sum, y)| *sum += weight * x * y);
                targets[k] += weight * x * target;
            }
            history.push(row);
        }
        spread = 0.5 * errors / (codes.len() / dims).max(1) as f64;
        let (mut matrix, mut vector) = ([[0.0; INPUTS]; INPUTS], [0.0; INPUTS]);
        for (k, (sums, target)) in sums.iter().zip(targets).enumerate() {
            let input = input_of::<C, K>(k);
            vector[input] = target;
            sums.iter().enumerate().for_each(|(other, sum)| matrix[input][input_of::<C, K>(other)] = *sum);
        }
        weights = solve(matrix, vector);
    }
    weights
}

/// Which of all inputs the used input `k` of the component `C` is.
const fn input_of<const C: usize, const K: usize>(k: usize) -> usize {
    if k + 1 == K {
        INPUTS - 1
    } else if k < 2 + C {
        k
    } else {
        k + DIMS - C
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
        let known: Vec<Known> = (0..3000i64).map(|i| Known { classes: [(i % 7) as u8, 0], given: [i * i % 977, i % 13, 0], ..Default::default() }).collect();
        let codes: Vec<i32> = known.iter().map(|k| (3 * k.given[0] - 7 * k.given[1]) as i32 + 5 * i32::from(k.classes[0])).collect();
        let linear = Linear::fit(1, &codes, |i| known[i]);
        let mut encoder = super::super::entropy::Encoder::default();
        linear.code(&mut encoder, &mut codes.clone(), &known).unwrap();
        let (tables, stored) = super::super::entropy::Tables::fit(Linear::contexts(1), std::slice::from_ref(&encoder));
        let bytes = encoder.finish(&tables).unwrap();
        assert!(stored.len() + bytes.len() < 750, "{} bytes for 3000 values", bytes.len());
        let mut decoder = super::super::entropy::Decoder::new("test", &tables, &bytes).unwrap();
        let mut found = vec![0; codes.len()];
        linear.code(&mut decoder, &mut found, &known).unwrap();
        assert_eq!(found, codes);
    }

    #[test]
    fn inputs_that_are_always_zero_change_no_weight() {
        // All sums of all inputs, row after row.
        let plain = |dims: usize, codes: &[i32], known: &[Known]| -> Vec<i16> {
            let (mut fitted, mut spread) = (vec![[0.0; INPUTS]; dims], [0.0; DIMS]);
            for pass in 0..PASSES {
                let mut sums = vec![([[0.0f64; INPUTS]; INPUTS], [0.0f64; INPUTS]); dims];
                let (mut errors, mut history) = ([0.0; DIMS], History::new());
                for (codes, known) in codes.chunks_exact(dims).zip(known) {
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
                spread = errors.map(|e| 0.5 * e / known.len() as f64);
                sums.into_iter().zip(&mut fitted).for_each(|((matrix, vector), fitted)| *fitted = solve(matrix, vector));
            }
            let round = |w: f64| libm::round(w * f64::from(1u32 << POINT)).clamp(-32767.0, 32767.0) as i16;
            fitted.into_iter().flatten().map(round).collect()
        };
        for dims in [1, DIMS] {
            let given = |i: i64| if dims == 1 { [i * i % 977 - 400, i % 13, 0] } else { [0; GIVEN] };
            let classes = |i: i64| [(i * 5 % 9) as u8, (i * i % 7) as u8];
            let row = |i: i64| Known { classes: classes(i), class: classes(i)[0], shift: (i % 4) as u8, given: given(i) };
            let known: Vec<Known> = (0..2000).map(row).collect();
            let code = |k: i32| (60.0 * (f64::from(k) * 0.013).sin()) as i32 / (1 + k % 3) + k * k % 31;
            let codes: Vec<i32> = (0..2000 * dims as i32).map(code).collect();
            let weights = Linear::fit(dims, &codes, |i| known[i]).weights;
            assert_eq!(weights, plain(dims, &codes, &known), "{dims} components");
            assert!(weights.chunks_exact(INPUTS).all(|weights| weights.iter().any(|w| *w != 0)), "{weights:?}");
        }
    }
}
