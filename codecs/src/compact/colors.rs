//! Colour coefficients: per spherical-harmonics degree a transform, and coordinates in steps that grow with the class.

mod coding;

pub use coding::CONTEXTS;

use super::blocks::ROWS;
use super::columns::Rows;
use super::entropy::{Coder, LANES, Lanes};
use super::geometry::{CODE_LIMIT, NEAREST_LIMIT, nearest};
use super::transform::{Basis, Moments, analysis, identity, scaled};
use crate::jacobi;
use cc4dgs_format::Result;
use cc4dgs_format::archive::ByteReader;
use rayon::prelude::*;

/// The value of a spread that stands for one step.
const ONE_STEP: i32 = 128;
/// Mean magnitude of a coordinate over its root mean square.
const MEAN: f64 = 0.7;
/// The price of a bit in squared steps, at the rate where error and bits are in balance: (ln 2)/6.
const BIT: f64 = 0.1155;
/// Largest share of a step by which a coordinate is rounded towards zero.
const FARTHEST: f64 = 0.4;

/// The coefficients of one degree, all channels.
#[derive(PartialEq)]
pub struct Degree {
    /// Number of coefficients times channels.
    pub dims: usize,
    mean: Vec<f32>,
    basis: Basis,
    /// Step of class 0.
    step: f32,
    /// Root-mean-square coordinate over the step of class 0, in half octaves, plus [`ONE_STEP`].
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

/// What all plans of the same coefficients share, whatever their step.
pub struct Transform {
    dims: usize,
    mean: Vec<f32>,
    basis: Basis,
    /// Root-mean-square coordinates.
    spread: Vec<f64>,
}

impl Transform {
    /// Of `rows`; `weights` `[N]` say how visible each is.
    pub fn of(rows: Rows, weights: &[f64], choices: &Choices) -> Self {
        let (dims, n) = (rows.dims, rows.count().max(1) as f64);
        // A sum of nothing has the sign of zero that sums of iterators start with.
        let mut sums: Vec<f64> = vec![std::iter::empty::<f64>().sum(); dims];
        rows.iter().for_each(|row| sums.iter_mut().zip(row).for_each(|(sum, &v)| *sum += f64::from(v)));
        let mean: Vec<f32> = sums.iter().map(|sum| (sum / n) as f32).collect();
        let of_axes = || {
            let mut moments = Moments::new(dims);
            centred(rows, &mean, |first, block| moments.add(block, &weights[first..]));
            let basis = moments.basis();
            Some((analysis(&basis, dims)?, basis))
        };
        let found = if choices.transform { of_axes() } else { None };
        let (vectors, basis) = found.unwrap_or_else(|| (jacobi::identity(dims), identity(dims)));
        let mut energies = vec![0.0; dims];
        centred(rows, &mean, |_, block| {
            let axes = energies.par_iter_mut().zip(vectors.par_chunks_exact(dims));
            axes.for_each(|(energy, vector)| block.chunks_exact(dims).for_each(|row| *energy += project(vector, row).powi(2)));
        });
        let spread = energies.iter().map(|energy| (energy / n).sqrt()).collect();
        Self { dims, mean, basis, spread }
    }
}

/// Calls `work` with the index of the first row and the values `[M,dims]` of each block of rows, less their mean.
fn centred(rows: Rows, mean: &[f32], mut work: impl FnMut(usize, &[f64])) {
    let mut block = Vec::with_capacity(rows.count().min(ROWS) * rows.dims);
    for first in (0..rows.count()).step_by(ROWS) {
        block.clear();
        for index in first..rows.count().min(first + ROWS) {
            block.extend(rows.row(index).iter().zip(mean).map(|(&v, &m)| f64::from(v) - f64::from(m)));
        }
        work(first, &block);
    }
}

/// Codes of the rows of a degree.
#[derive(Debug, PartialEq)]
pub struct Codes {
    /// `[N,dims]`; zeros in rows that have none.
    pub values: Vec<i32>,
    /// The rows that have none, because one would be out of range or all are stored exactly.
    pub missing: Vec<usize>,
}

impl Codes {
    /// Of `count` rows, none of which has codes.
    pub fn none(count: usize, dims: usize) -> Self {
        Self { values: vec![0; count * dims], missing: (0..count).collect() }
    }
}

/// The rows that are not `coded`.
pub fn missing(coded: &[bool]) -> Vec<usize> {
    // Nearly always none is missing. A fold that reads all rows is vectorised; `all`, which stops early, is not.
    if coded.iter().fold(true, |all, coded| all & coded) {
        return Vec::new();
    }
    coded.iter().enumerate().filter(|(_, coded)| !**coded).map(|(row, _)| row).collect()
}

impl Degree {
    /// Plans the storage of the coefficients of `transform` in steps of `step` for class 0.
    pub fn plan(transform: &Transform, step: f32) -> Self {
        let octaves = |spread: &f64| {
            let relative = spread / f64::from(step);
            if relative > 0.0 { (2.0 * libm::log2(relative) + f64::from(ONE_STEP)).round().clamp(0.0, 255.0) as u8 } else { 0 }
        };
        let Transform { dims, mean, basis, spread } = transform;
        Self { dims: *dims, mean: mean.clone(), basis: basis.clone(), step, spread: spread.iter().map(octaves).collect() }
    }
    /// Codes of `rows`.
    pub fn quantise(&self, rows: Rows, classes: &[u8], choices: &Choices) -> Codes {
        let Some(analysis) = analysis(&self.basis, self.dims) else { return Codes::none(classes.len(), self.dims) };
        let columns: Vec<f64> = (0..analysis.len()).map(|k| analysis[k % self.dims * self.dims + k / self.dims]).collect();
        let mut values = vec![0; classes.len() * self.dims];
        let each = values.par_chunks_exact_mut(self.dims).zip(classes).enumerate();
        let quantise = |(index, (codes, &class)): (usize, (&mut [i32], &u8))| {
            let coded = self.quantise_row(&columns, rows.row(index), class, choices.rate_weight, codes);
            if !coded {
                codes.fill(0);
            }
            coded
        };
        let coded: Vec<bool> = each.map(quantise).collect();
        Codes { values, missing: missing(&coded) }
    }
    /// Puts the codes of a row into `codes`; whether all are in range. `columns` are those of the analysis.
    fn quantise_row(&self, columns: &[f64], row: &[f32], class: u8, rate_weight: f64, codes: &mut [i32]) -> bool {
        match self.dims {
            3 => self.quantise_dims::<3>(columns, row, class, rate_weight, codes),
            9 => self.quantise_dims::<9>(columns, row, class, rate_weight, codes),
            15 => self.quantise_dims::<15>(columns, row, class, rate_weight, codes),
            21 => self.quantise_dims::<21>(columns, row, class, rate_weight, codes),
            _ => self.quantise_dims::<27>(columns, row, class, rate_weight, codes),
        }
    }
    #[inline]
    fn quantise_dims<const DIMS: usize>(&self, columns: &[f64], row: &[f32], class: u8, rate_weight: f64, codes: &mut [i32]) -> bool {
        let step = self.step_of(class);
        let steps = project_all::<DIMS>(columns, row, &self.mean).map(|coordinate| coordinate / step);
        if rate_weight == 0.0 {
            // All are compared before one is rounded, so that neither loop stops early and both are vectorised. Few rows are out of range.
            let in_range = steps.iter().fold(true, |all, steps| all & (steps.abs() < NEAREST_LIMIT));
            if in_range {
                codes.iter_mut().zip(steps).for_each(|(code, steps)| *code = nearest(steps));
            }
            return in_range;
        }
        codes.iter_mut().zip(steps).enumerate().all(|(c, (out, steps))| {
            let code = libm::copysign(self.rounded_down(steps.abs(), c, class, rate_weight), steps);
            *out = code as i32;
            code.abs() < CODE_LIMIT as f64
        })
    }
    /// The derivative `[N,dims]` of the estimated bits of all coordinates by each of the values `rows`; `guesses` `[N,dims]` are predictions in steps.
    pub fn bit_slopes(&self, rows: Rows, classes: &[u8], guesses: Option<&[f64]>) -> Vec<f32> {
        let mut out = vec![0.0; rows.count() * self.dims];
        let Some(analysis) = analysis(&self.basis, self.dims) else { return out };
        for (i, ((out, row), &class)) in out.chunks_exact_mut(self.dims).zip(rows.iter()).zip(classes).enumerate() {
            let step = self.step_of(class);
            let row: Vec<f64> = row.iter().zip(&self.mean).map(|(&v, &m)| f64::from(v) - f64::from(m)).collect();
            let mut sums = vec![0.0; self.dims];
            for (c, vector) in analysis.chunks_exact(self.dims).enumerate() {
                let guess = guesses.map_or(0.0, |all| all[i * self.dims + c]);
                let slope = slope(project(vector, &row) / step - guess) / step;
                sums.iter_mut().zip(vector).for_each(|(sum, v)| *sum += slope * v);
            }
            out.iter_mut().zip(sums).for_each(|(out, sum)| *out = sum as f32);
        }
        out
    }
    /// The estimated bits of which [`Degree::bit_slopes`] are the derivatives.
    #[cfg(test)]
    pub fn bits(&self, rows: &[f32], classes: &[u8], guesses: Option<&[f64]>) -> f64 {
        let Some(analysis) = analysis(&self.basis, self.dims) else { return 0.0 };
        let mut sum = 0.0;
        for (i, (row, &class)) in rows.chunks_exact(self.dims).zip(classes).enumerate() {
            let row: Vec<f64> = row.iter().zip(&self.mean).map(|(&v, &m)| f64::from(v) - f64::from(m)).collect();
            for (c, vector) in analysis.chunks_exact(self.dims).enumerate() {
                let steps = project(vector, &row) / self.step_of(class) - guesses.map_or(0.0, |all| all[i * self.dims + c]);
                sum += 0.5 * libm::log2(1.0 + steps * steps);
            }
        }
        sum
    }
    /// Step of a coordinate.
    pub fn step_of(&self, class: u8) -> f64 {
        f64::from(self.step) * f64::from(1u32 << class)
    }
    /// A magnitude in steps, rounded down where that costs less than the bits it saves: coordinates are thought to have a Laplace distribution.
    fn rounded_down(&self, steps: f64, c: usize, class: u8, rate_weight: f64) -> f64 {
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
        if codes.iter().all(|code| *code == 0) {
            return;
        }
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
}

/// Adds `codes` times `step` times the vectors of `basis` to `out`, all of `DIMS` components.
#[inline]
fn add<const DIMS: usize>(basis: &[f32], codes: &[i32], step: f32, out: &mut [f32]) {
    let Some(out) = out.first_chunk_mut::<DIMS>() else { return };
    let mut sums = *out;
    for (vector, &code) in basis.as_chunks::<DIMS>().0.iter().zip(codes) {
        let coordinate = code as f32 * step;
        for (o, b) in sums.iter_mut().zip(vector) {
            *o += coordinate * b;
        }
    }
    *out = sums.map(|o| o.clamp(f32::MIN, f32::MAX));
}

/// The derivative of the estimated bits of a number by its magnitude in steps: they are the logarithm of the magnitude, flat below a step.
pub fn slope(steps: f64) -> f64 {
    steps / (1.0 + steps * steps) * std::f64::consts::LOG2_E
}

fn project(analysis: &[f64], row: &[f64]) -> f64 {
    analysis.iter().zip(row).map(|(a, v)| a * v).sum()
}

/// All coordinates of `row` less `mean`, each summed up in the order of [`project`], but side by side: sums do not wait for each other.
#[inline]
fn project_all<const DIMS: usize>(columns: &[f64], row: &[f32], mean: &[f32]) -> [f64; DIMS] {
    let mut sums = [0.0; DIMS];
    for (column, (&value, &mean)) in columns.as_chunks::<DIMS>().0.iter().zip(row.iter().zip(mean)) {
        let value = f64::from(value) - f64::from(mean);
        sums.iter_mut().zip(column).for_each(|(sum, a)| *sum += a * value);
    }
    sums
}

/// Contexts of [`code_small`].
pub const SMALL_CONTEXTS: usize = 16 * 3;

/// Codes the numbers below 16 of a block, which resemble those before.
pub fn code_small<C: Coder>(coder: &mut C, values: &mut [u8]) -> Result<()> {
    let mut states = [(0u8, 0u8); LANES];
    for (lane, row) in Lanes::of(values.len()).turns() {
        let (last, before) = states[lane];
        let trend = usize::from(last > before) + 2 * usize::from(last < before);
        values[row] = coder.symbol(lane, usize::from(last & 15) * 3 + trend, usize::from(values[row]))? as u8;
        states[lane] = (values[row], last);
    }
    Ok(())
}
