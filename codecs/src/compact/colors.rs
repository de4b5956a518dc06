//! Colour coefficients: per spherical-harmonics degree a transform, and coordinates in steps that grow with the class.

use super::blocks;
use super::entropy::{Coder, Model, signed, symmetric};
use super::transform::{Basis, analysis, basis, identity, synthesise};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Result, Stream};
use std::ops::Range;

/// Contexts by expected size, in half octaves.
const LEVELS: i32 = 26;
/// Half octaves below a step at which the contexts start.
const LOWEST: i32 = 11;
/// Contexts by the coordinates before in the row.
const BEFORE: usize = 3;
/// Earlier rows whose mean predicts degree 0.
const NEIGHBOURS: usize = 4;

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
    /// Share of a step by which values are rounded towards zero.
    pub dead_zone: f64,
}

impl Degree {
    /// Plans the storage of `rows` `[N,dims]` in steps of `step` for class 0; `weights` `[N]` say how visible each is.
    pub fn plan(rows: &[f32], dims: usize, classes: &[u8], weights: &[f64], step: f32, choices: &Choices) -> Self {
        let n = classes.len().max(1) as f64;
        let mean: Vec<f32> = (0..dims).map(|c| (rows.iter().skip(c).step_by(dims).map(|&v| f64::from(v)).sum::<f64>() / n) as f32).collect();
        let centred: Vec<f64> = rows.iter().enumerate().map(|(k, &v)| f64::from(v) - f64::from(mean[k % dims])).collect();
        let mut out = Self { dims, mean, basis: identity(dims), step, spread: vec![128; dims] };
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
                let code = libm::copysign(libm::floor(steps.abs() + 0.5 - choices.dead_zone), steps);
                (code.abs() < f64::from(1 << 24)).then_some(code as i32)
            };
            (0..self.dims).map(code).collect()
        };
        rows.chunks_exact(self.dims).zip(classes).map(quantise).collect()
    }
    fn step_of(&self, class: u8) -> f64 {
        f64::from(self.step) * f64::from(1u32 << class)
    }
    /// Adds the values of `codes` to the mean: `[dims]`.
    pub fn restore(&self, codes: &[i32], class: u8, row: &mut Vec<f64>, out: &mut [f32]) {
        row.clear();
        row.extend(self.mean.iter().map(|&m| f64::from(m)));
        let step = self.step_of(class);
        for (c, &code) in codes.iter().enumerate().filter(|(_, code)| **code != 0) {
            synthesise(&self.basis, c, f64::from(code) * step, row);
        }
        out.iter_mut().zip(row).for_each(|(o, v)| *o = (*v as f32).clamp(f32::MIN, f32::MAX));
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
    /// Context of the coordinate `c` in a class.
    #[inline]
    fn level(&self, c: usize, class: u8) -> usize {
        (i32::from(self.spread[c]) - 128 - 2 * i32::from(class) + LOWEST).clamp(0, LEVELS - 1) as usize
    }
    /// The stream of `codes` `[N,dims]`.
    pub fn encode(&self, name: &str, codes: &[i32], classes: &[u8], predict: bool) -> Result<Stream> {
        blocks::encode(name, classes.len(), |coder, range| {
            let mut values = codes[range.start * self.dims..range.end * self.dims].to_vec();
            self.code(coder, &mut values, &classes[range], predict)
        })
    }
    /// Reads the stream of [`Degree::encode`].
    pub fn decode(&self, object: &str, stream: ByteReader, classes: &[u8], predict: bool) -> Result<Vec<f32>> {
        let read = |coder: &mut super::entropy::Decoder, range: Range<usize>| {
            let mut codes = vec![0; range.len() * self.dims];
            self.code(coder, &mut codes, &classes[range.clone()], predict)?;
            let (mut out, mut row) = (vec![0.0; codes.len()], Vec::new());
            for ((codes, out), &class) in codes.chunks_exact(self.dims).zip(out.chunks_exact_mut(self.dims)).zip(&classes[range]) {
                self.restore(codes, class, &mut row, out);
            }
            Ok(out)
        };
        Ok(blocks::decode(object, stream, classes.len(), read)?.concat())
    }
    fn code<C: Coder>(&self, coder: &mut C, codes: &mut [i32], classes: &[u8], predict: bool) -> Result<()> {
        if predict { self.code_predicted(coder, codes, classes) } else { self.code_sparse(coder, codes, classes) }
    }
    /// Many coordinates are zero, and often all of a row.
    fn code_sparse<C: Coder>(&self, coder: &mut C, codes: &mut [i32], classes: &[u8]) -> Result<()> {
        let mut sizes = vec![Model::default(); LEVELS as usize * BEFORE];
        let mut any = vec![Model::default(); 32];
        let mut last = 1;
        for (row, &class) in codes.chunks_exact_mut(self.dims).zip(classes) {
            last = coder.symbol(&mut any[2 * usize::from(class) + last], usize::from(row.iter().any(|&v| v != 0)))?;
            if last == 0 {
                continue;
            }
            let mut before = 0u32;
            for (c, code) in row.iter_mut().enumerate() {
                let context = self.level(c, class) * BEFORE + before.min(4).div_ceil(2) as usize;
                *code = symmetric(coder, &mut sizes[context], i64::from(*code))?.clamp(-(1 << 24), 1 << 24) as i32;
                before = before / 2 + code.unsigned_abs().min(8);
            }
        }
        Ok(())
    }
    /// Predicted by the mean of earlier rows, which are near in space.
    fn code_predicted<C: Coder>(&self, coder: &mut C, codes: &mut [i32], classes: &[u8]) -> Result<()> {
        let mut sizes = vec![Model::default(); self.dims * 16];
        let mut signs = sizes.clone();
        let mut recent = vec![0i64; NEIGHBOURS * self.dims];
        for (i, (row, &class)) in codes.chunks_exact_mut(self.dims).zip(classes).enumerate() {
            for (c, code) in row.iter_mut().enumerate() {
                let sum: i64 = recent.iter().skip(c).step_by(self.dims).sum();
                let guess = (sum / NEIGHBOURS as i64) >> class;
                let context = c * 16 + usize::from(class.min(15));
                let value = guess + signed(coder, &mut sizes[context], &mut signs[context], i64::from(*code) - guess)?;
                *code = value.clamp(-(1 << 24), 1 << 24) as i32;
                recent[i % NEIGHBOURS * self.dims + c] = i64::from(*code) << class;
            }
        }
        Ok(())
    }
}

fn project(analysis: &[f64], row: &[f64]) -> f64 {
    analysis.iter().zip(row).map(|(a, v)| a * v).sum()
}

/// Codes the classes, or anything below 16 that resembles its neighbours in order.
pub fn code_classes<C: Coder>(coder: &mut C, values: &mut [u8]) -> Result<()> {
    let mut models = vec![Model::default(); 16 * 3];
    let (mut last, mut before) = (0u8, 0u8);
    for value in values {
        let trend = usize::from(last > before) + 2 * usize::from(last < before);
        let found = coder.symbol(&mut models[usize::from(last) * 3 + trend], usize::from(*value))? as u8;
        (before, last, *value) = (last, found, found);
    }
    Ok(())
}
