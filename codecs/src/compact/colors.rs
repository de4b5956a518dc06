//! Colour coefficients: per spherical-harmonics degree a transform, and coordinates in steps that grow with the class.

use super::entropy::{Coder, symmetric};
use super::transform::{Basis, analysis, basis, identity, scaled};
use cc4dgs_format::Result;
use cc4dgs_format::archive::ByteReader;

/// Contexts by expected size, in half octaves.
const LEVELS: i32 = 40;
/// Half octaves below a step at which the contexts start.
const LOWEST: i32 = 16;
/// Contexts of [`Degree::code`]: whether a row has anything, and sizes after a zero and after something else.
pub const CONTEXTS: usize = 3 * LEVELS as usize;
/// The value of a spread that stands for one step.
const ONE_STEP: i32 = 128;
/// Bits behind the point of expected magnitudes.
const POINT: u32 = 4;
/// Earlier rows count as much as one such share of a row.
const EARLIER: u32 = 4;
/// Mean magnitude of a coordinate over its root mean square.
const MEAN: f64 = 0.7;
/// What a bit costs, in squared steps, at the rate where less of either is worth the same: (ln 2)/6.
const BIT: f64 = 0.1155;
/// Largest share of a step by which a coordinate is rounded towards zero.
const FARTHEST: f64 = 0.4;

/// How large the coordinates of a row were so far, and how large they were expected to be; in the steps of class 0.
#[derive(Clone, Copy, Default)]
pub struct Activity {
    found: u64,
    expected: u64,
}

/// The coefficients of one degree, all channels.
pub struct Degree {
    /// Number of coefficients times channels.
    pub dims: usize,
    mean: Vec<f32>,
    basis: Basis,
    /// Step of class 0.
    step: f32,
    /// Root-mean-square coordinate over the step of class 0, in half octaves, plus 128.
    spread: Vec<u8>,
}

/// What the encoder may choose.
#[derive(Clone, Copy)]
pub struct Choices {
    /// Transform the coefficients.
    pub transform: bool,
    /// How much bits count when coordinates are rounded; 0 rounds to the nearest.
    pub rate_weight: f64,
}

impl Degree {
    /// Plans the storage of `rows` `[N,dims]` in steps of `step` for class 0; `weights` `[N]` say how visible each is.
    pub fn plan(rows: &[f32], dims: usize, classes: &[u8], weights: &[f64], step: f32, choices: &Choices) -> Self {
        let n = classes.len().max(1) as f64;
        let mean: Vec<f32> = (0..dims).map(|c| (rows.iter().skip(c).step_by(dims).map(|&v| f64::from(v)).sum::<f64>() / n) as f32).collect();
        let centred: Vec<f64> = rows.iter().enumerate().map(|(k, &v)| f64::from(v) - f64::from(mean[k % dims])).collect();
        let mut out = Self { dims, mean, basis: identity(dims), step, spread: vec![ONE_STEP as u8; dims] };
        if choices.transform {
            let found = basis(&centred, dims, weights);
            if analysis(&found, dims).is_some() {
                out.basis = found;
            }
        }
        let Some(analysis) = analysis(&out.basis, dims) else { return out };
        let mut energy = vec![0.0; dims];
        for row in centred.chunks_exact(dims) {
            for (c, energy) in energy.iter_mut().enumerate() {
                *energy += project(&analysis[c * dims..(c + 1) * dims], row).powi(2);
            }
        }
        for (spread, energy) in out.spread.iter_mut().zip(energy) {
            let relative = (energy / n).sqrt() / f64::from(step);
            *spread = if relative > 0.0 { (2.0 * libm::log2(relative) + 128.0).round().clamp(0.0, 255.0) as u8 } else { 0 };
        }
        out
    }
    /// Codes `[N,dims]` of `rows`; `None` for a row that is out of range.
    pub fn quantise(&self, rows: &[f32], classes: &[u8], choices: &Choices) -> Vec<Option<Vec<i32>>> {
        let Some(analysis) = analysis(&self.basis, self.dims) else { return vec![None; classes.len()] };
        let quantise = |(row, &class): (&[f32], &u8)| {
            let step = self.step_of(class);
            let row: Vec<f64> = row.iter().zip(&self.mean).map(|(&v, &m)| f64::from(v) - f64::from(m)).collect();
            let code = |c: usize| {
                let steps = project(&analysis[c * self.dims..(c + 1) * self.dims], &row) / step;
                let code = libm::copysign(self.rounded(steps.abs(), c, class, choices.rate_weight), steps);
                (code.abs() < f64::from(1 << 24)).then_some(code as i32)
            };
            (0..self.dims).map(code).collect()
        };
        rows.chunks_exact(self.dims).zip(classes).map(quantise).collect()
    }
    fn step_of(&self, class: u8) -> f64 {
        f64::from(self.step) * f64::from(1u32 << class)
    }
    /// A magnitude in steps, rounded down where that costs less than the bits it saves: coordinates are thought to have a Laplace distribution.
    fn rounded(&self, steps: f64, c: usize, class: u8, rate_weight: f64) -> f64 {
        let down = libm::floor(steps);
        let mean = (MEAN * libm::exp2(0.5 * f64::from(i32::from(self.spread[c]) - ONE_STEP) - f64::from(class))).max(0.05);
        // From one code to the next the logarithm of the probability falls by 1 / mean; the first one has a sign.
        let bits = std::f64::consts::LOG2_E / mean + f64::from(u8::from(down == 0.0));
        let farther = (0.5 * BIT * bits * rate_weight).min(FARTHEST);
        if steps - down < 0.5 + farther { down } else { down + 1.0 }
    }
    /// What [`Degree::restore`] needs beside the codes.
    pub fn scaled_basis(&self) -> Vec<f32> {
        scaled(&self.basis)
    }
    /// Adds the values of `codes` to the mean: `[dims]`. In single precision and a fixed order, which is the same on all machines.
    #[inline]
    pub fn restore(&self, basis: &[f32], codes: &[i32], class: u8, out: &mut [f32]) {
        out.copy_from_slice(&self.mean);
        let step = self.step * (1u32 << class) as f32;
        match self.dims {
            3 => add::<3>(basis, codes, step, out),
            9 => add::<9>(basis, codes, step, out),
            15 => add::<15>(basis, codes, step, out),
            21 => add::<21>(basis, codes, step, out),
            _ => add::<27>(basis, codes, step, out),
        }
    }
    pub fn write(&self, meta: &mut Vec<u8>) {
        meta.extend(self.step.to_le_bytes());
        self.mean.iter().for_each(|v| meta.extend(v.to_le_bytes()));
        meta.extend(&self.spread);
        meta.extend(self.basis.iter().map(|&b| b as u8));
    }
    pub fn read(meta: &mut ByteReader, dims: usize) -> Result<Self> {
        let (step, mean) = (meta.f32()?, meta.f32s(dims)?);
        let spread = meta.take(dims)?.to_vec();
        Ok(Self { dims, mean, step, spread, basis: meta.take(dims * dims)?.iter().map(|&b| b as i8).collect() })
    }
    /// Adds a row of this degree to the activity, as [`Degree::code`] does.
    pub fn note(&self, codes: &[i32], class: u8, activity: &mut Activity) {
        activity.found += codes.iter().map(|&code| found_in(code, class)).sum::<u64>();
        activity.expected += self.spread.iter().map(|&s| magnitude(i32::from(s))).sum::<u64>();
    }
    /// Codes the coordinates `[N,dims]` of a block. Many are zero, and often all of a row. What a row has in earlier degrees is in `activity`.
    pub fn code<C: Coder>(&self, coder: &mut C, codes: &mut [i32], classes: &[u8], activity: &mut [Activity]) -> Result<()> {
        let expected: Vec<u64> = self.spread.iter().map(|&s| magnitude(i32::from(s))).collect();
        let whole = expected.iter().sum::<u64>();
        let levels: Vec<i32> = self.spread.iter().map(|&s| 2 * (i32::from(s) - ONE_STEP + LOWEST)).collect();
        let mut earlier = Activity::default();
        for ((row, &class), activity) in codes.chunks_exact_mut(self.dims).zip(classes).zip(activity) {
            let class = class.min(15);
            let mut now = Activity { found: activity.found + (earlier.found >> EARLIER) + 1, expected: activity.expected + (earlier.expected >> EARLIER) + 1 };
            let any = coder.symbol(level(levels[0], &now, class), usize::from(row.iter().any(|&v| v != 0)))?;
            if any == 0 {
                row.fill(0);
            } else {
                let mut after = LEVELS as usize;
                for (c, code) in row.iter_mut().enumerate() {
                    let context = after + level(levels[c], &now, class);
                    *code = symmetric(coder, context, i64::from(*code))?.clamp(-LIMIT, LIMIT) as i32;
                    now.found += found_in(*code, class);
                    now.expected += expected[c];
                    after = LEVELS as usize * (1 + usize::from(*code != 0));
                }
            }
            let sum: u64 = row.iter().map(|&code| found_in(code, class)).sum();
            activity.found += sum;
            activity.expected += whole;
            earlier.found = earlier.found - (earlier.found >> 3) + sum;
            earlier.expected = earlier.expected - (earlier.expected >> 3) + whole;
        }
        Ok(())
    }
}

/// Adds `codes` times `step` times the vectors of `basis` to `out`, all of `DIMS` components.
#[inline]
fn add<const DIMS: usize>(basis: &[f32], codes: &[i32], step: f32, out: &mut [f32]) {
    let Some(out) = out.first_chunk_mut::<DIMS>() else { return };
    for (vector, &code) in basis.as_chunks::<DIMS>().0.iter().zip(codes).filter(|(_, code)| **code != 0) {
        let coordinate = code as f32 * step;
        for (o, b) in out.iter_mut().zip(vector) {
            *o += coordinate * b;
        }
    }
    for o in out {
        *o = o.clamp(f32::MIN, f32::MAX);
    }
}

/// What a code adds to the activity of a row.
#[inline]
fn found_in(code: i32, class: u8) -> u64 {
    u64::from(code.unsigned_abs()) << (u32::from(class.min(15)) + POINT)
}

/// Codes are smaller or equal in magnitude.
const LIMIT: i64 = 1 << 24;

/// The magnitude that a spread stands for.
fn magnitude(spread: i32) -> u64 {
    let half_octaves = (spread - ONE_STEP + 2 * POINT as i32).clamp(0, 48) as u32;
    (if half_octaves.is_multiple_of(2) { 2 } else { 3 }) << (half_octaves / 2) >> 1
}

/// The level of a coordinate that is usually `quarters` quarter octaves large, in a row of this activity.
#[inline]
fn level(quarters: i32, activity: &Activity, class: u8) -> usize {
    let ratio = octaves(activity.found) - octaves(activity.expected);
    ((quarters + ratio - 4 * i32::from(class)) >> 1).clamp(0, LEVELS - 1) as usize
}

/// Quarter octaves of a number above 0.
#[inline]
fn octaves(value: u64) -> i32 {
    let octave = value.ilog2();
    // Below 2^53, as sums of codes are.
    4 * octave as i32 + (value << 2 >> octave & 3) as i32
}

fn project(analysis: &[f64], row: &[f64]) -> f64 {
    analysis.iter().zip(row).map(|(a, v)| a * v).sum()
}

/// Contexts of [`code_small`].
pub const SMALL_CONTEXTS: usize = 16 * 3;

/// Codes numbers below 16 that resemble those before.
pub fn code_small<C: Coder>(coder: &mut C, values: &mut [u8]) -> Result<()> {
    let (mut last, mut before) = (0u8, 0u8);
    for value in values {
        let trend = usize::from(last > before) + 2 * usize::from(last < before);
        let found = coder.symbol(usize::from(last & 15) * 3 + trend, usize::from(*value))? as u8;
        (before, last, *value) = (last, found, found);
    }
    Ok(())
}
