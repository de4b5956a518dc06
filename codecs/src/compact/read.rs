//! Gaussians from streams.

use super::VERSION;
use super::blocks::{Blocks, ROWS};
use super::colors::{self, Degree, SMALL_CONTEXTS, code_small};
use super::geometry::{Geometry, KEY_CONTEXTS, ROTATION_CONTEXTS, Rotation, code_keys, code_rotations};
use super::predict::{Known, Linear};
use super::write::{APART, CLASSES, EXACT, MEANS, MOVING, Motion, OPACITIES, ROTATIONS, SCALES, SCORES, SHAPES, color_name, known_classes, known_scales};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::storage::column::{self, Form};
use cc4dgs_format::storage::{StreamSet, open};
use cc4dgs_format::{CodecContext, Error, HostGaussians, Result, Stream};
use rayon::prelude::*;
use std::ops::Range;

/// Gaussians per byte of all streams that a decoder believes: a block of 2^14 takes eight bytes or more in each of eight streams.
const PER_BYTE: u64 = 512;

/// What all columns depend on.
struct Rows {
    geometry: Geometry,
    motion: Motion,
    classes: Vec<u8>,
    shapes: Vec<u8>,
    moving: Vec<u8>,
    scales: Vec<[i32; 3]>,
}

/// Decodes what [`super::write::write`] wrote.
pub fn read(streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
    let (set, mut meta, shape) = open("compact", streams, VERSION, &context.limits)?;
    let (n, bytes) = (shape.count, streams.iter().map(|s| s.bytes.len() as u64).sum::<u64>());
    if n as u64 > PER_BYTE.saturating_mul(bytes) {
        return Err(meta.error(format!("{n} Gaussians in {bytes} bytes are more than there can be")));
    }
    let geometry = Geometry::read(&mut meta)?;
    let (free, scored) = (meta.u8()?, meta.u8()?);
    let levels = [meta.f32()?, meta.f32()?];
    if free > 2 || scored > 1 || free == 2 && scored == 0 {
        return Err(meta.error(format!("rotations of kind {free} and scores of kind {scored} are impossible")));
    }
    let (scale_plan, opacity_plan, color_plan) = (Linear::read(3, &mut meta)?, Linear::read(1, &mut meta)?, Linear::read(3, &mut meta)?);
    let degrees = (0..=shape.sh_degree).map(|d| Degree::read(&mut meta, 3 * (2 * d + 1))).collect::<Result<Vec<Degree>>>()?;
    meta.finish()?;
    let coded = |name: &str, contexts: usize| Blocks::read(name, set.reader(name)?, contexts, n);

    let classes = small(&set, CLASSES, n, 15)?;
    let mut shapes = small(&set, SHAPES, n, 15)?;
    for (shape, &color) in shapes.iter_mut().zip(&classes) {
        *shape = (color + *shape).checked_sub(APART).filter(|s| *s < 16).ok_or_else(|| impossible(SHAPES, "a class is below 0 or above 15"))?;
    }
    let moving = if scored == 1 { small(&set, MOVING, n, 1)? } else { Vec::new() };
    let mut rows = Rows { geometry, motion: Motion { free, moving: None, levels }, classes, shapes, moving, scales: Vec::new() };
    rows.scales = rows.read_scales(&coded(SCALES, Linear::contexts(3))?, &scale_plan)?;
    let rows = &rows;

    // The others depend on classes and scales alone.
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    out.dynamic_scores = if scored == 1 { rows.moving.iter().map(|&m| levels[usize::from(m)]).collect() } else { read_scores(set.reader(SCORES)?, n)? };
    let (means, rotations) = (coded(MEANS, KEY_CONTEXTS)?, coded(ROTATIONS, ROTATION_CONTEXTS)?);
    let (opacities, base) = (coded(OPACITIES, Linear::contexts(1))?, coded(&color_name(0), Linear::contexts(3))?);
    let (first, higher) = degrees.split_at(1);
    let names = (1..=shape.sh_degree).map(color_name);
    let higher: Vec<(&Degree, Blocks)> = higher.iter().zip(names).map(|(plan, name)| Ok((plan, coded(&name, colors::CONTEXTS)?))).collect::<Result<_>>()?;
    let (geometry, appearance) = rayon::join(
        || rayon::join(|| rows.means(&means), || rows.quaternions(&rotations)),
        || rayon::join(|| Ok::<_, Error>((rows.opacities(&opacities, &opacity_plan)?, rows.base(&base, &color_plan, &first[0])?)), || rows.rest(&higher)),
    );
    (out.means, out.quaternions) = (geometry.0?, geometry.1?);
    (out.opacity_logits, out.sh_dc) = appearance.0?;
    out.sh_rest = appearance.1?;
    out.log_scales = rows.log_scales();

    let mut exact = set.reader(EXACT)?;
    let columns = [(3, &mut out.means), (3, &mut out.log_scales), (4, &mut out.quaternions), (1, &mut out.opacity_logits), (3, &mut out.sh_dc)];
    for (width, values) in columns {
        read_exact(&mut exact, (width, 0..width), n, values)?;
    }
    let width = 3 * sh_rest_len(shape.sh_degree);
    let mut at = 0;
    for (plan, _) in &higher {
        read_exact(&mut exact, (width, at..at + plan.dims), n, &mut out.sh_rest)?;
        at += plan.dims;
    }
    exact.finish()?;
    shape.read_extra(&set, &mut out)?;
    out.validate("decoded Gaussians", &context.limits)?;
    Ok(out)
}

impl Rows {
    fn len(&self) -> usize {
        self.classes.len()
    }
    fn read_scales(&self, blocks: &Blocks, plan: &Linear) -> Result<Vec<[i32; 3]>> {
        let mut out = vec![[0; 3]; self.len()];
        let limit = self.geometry.scale_limit;
        blocks.decode_into(&mut out, 1, |coder, range, codes| {
            let known: Vec<Known> = range.map(|i| known_classes(self.classes[i], self.shapes[i], false, limit)).collect();
            plan.code(coder, codes.as_flattened_mut(), &known)
        })?;
        Ok(out)
    }
    fn log_scales(&self) -> Vec<f32> {
        let mut out = vec![0.0; 3 * self.len()];
        let rows = out.par_chunks_exact_mut(3).with_min_len(ROWS).zip(&self.scales).zip(&self.shapes);
        rows.for_each(|((out, codes), &class)| out.iter_mut().zip(codes).for_each(|(o, &code)| *o = self.geometry.scale(code, class)));
        out
    }
    fn means(&self, blocks: &Blocks) -> Result<Vec<f32>> {
        let mut out = vec![0.0; 3 * self.len()];
        blocks.decode_into(&mut out, 3, |coder, range, out| {
            let mut keys = vec![0; range.len()];
            let shifts: Vec<u32> = range.map(|i| self.geometry.position_shift(self.scales[i], self.shapes[i])).collect();
            code_keys(coder, &mut keys, &shifts)?;
            let rows = out.as_chunks_mut::<3>().0.iter_mut().zip(keys).zip(shifts);
            rows.for_each(|((out, key), shift)| *out = self.geometry.centre(key, shift));
            Ok(())
        })?;
        Ok(out)
    }
    fn quaternions(&self, blocks: &Blocks) -> Result<Vec<f32>> {
        let mut out = vec![0.0; 4 * self.len()];
        blocks.decode_into(&mut out, 4, |coder, range, out| {
            let mut codes = vec![Rotation::default(); range.len()];
            let shifts: Vec<(i32, bool)> =
                range.map(|i| (self.geometry.rotation_shift(self.scales[i], self.shapes[i]), self.motion.is_free(i, &self.moving))).collect();
            code_rotations(coder, &mut codes, &shifts)?;
            let rows = out.as_chunks_mut::<4>().0.iter_mut().zip(codes).zip(shifts);
            rows.for_each(|((out, codes), (shift, _))| *out = codes.quaternion(self.geometry.rotation(shift)));
            Ok(())
        })?;
        Ok(out)
    }
    fn opacities(&self, blocks: &Blocks, plan: &Linear) -> Result<Vec<f32>> {
        let mut out = vec![0.0; self.len()];
        let (scale_limit, limit) = (self.geometry.scale_limit, self.geometry.opacity_limit);
        blocks.decode_into(&mut out, 1, |coder, range, out| {
            let mut codes = vec![0; range.len()];
            let known = |i: usize| known_scales(self.classes[i], self.shapes[i], &self.scales[i], scale_limit, limit);
            plan.code(coder, &mut codes, &range.clone().map(known).collect::<Vec<Known>>())?;
            let rows = out.iter_mut().zip(codes).zip(&self.shapes[range]);
            rows.for_each(|((out, code), &class)| *out = self.geometry.opacity(code, class));
            Ok(())
        })?;
        Ok(out)
    }
    fn base(&self, blocks: &Blocks, plan: &Linear, degree: &Degree) -> Result<Vec<f32>> {
        let mut out = vec![0.0; 3 * self.len()];
        let basis = degree.scaled_basis();
        blocks.decode_into(&mut out, 3, |coder, range, out| {
            let mut codes = vec![0; out.len()];
            let known: Vec<Known> = range.clone().map(|i| known_classes(self.classes[i], self.shapes[i], true, 15)).collect();
            plan.code(coder, &mut codes, &known)?;
            let rows = out.chunks_exact_mut(3).zip(codes.chunks_exact(3)).zip(&self.classes[range]);
            rows.for_each(|((out, codes), &class)| degree.restore(&basis, codes, class, out));
            Ok(())
        })?;
        Ok(out)
    }
    /// The higher degrees `[N, width]`. Those of a block follow each other, because the larger ones are predicted by the smaller ones.
    fn rest(&self, degrees: &[(&Degree, Blocks)]) -> Result<Vec<f32>> {
        let width: usize = degrees.iter().map(|d| d.0.dims).sum();
        let mut out = vec![0.0; width * self.len()];
        if width == 0 {
            return Ok(out);
        }
        let bases: Vec<Vec<f32>> = degrees.iter().map(|d| d.0.scaled_basis()).collect();
        out.par_chunks_mut(ROWS * width).enumerate().try_for_each(|(index, out)| {
            let range: Range<usize> = index * ROWS..index * ROWS + out.len() / width;
            let mut sizes = vec![0; range.len()];
            let mut at = 0;
            for (index_of_degree, ((degree, blocks), basis)) in degrees.iter().zip(&bases).enumerate() {
                let mut codes = vec![0; range.len() * degree.dims];
                blocks.decode(index, |coder| degree.code(coder, &mut codes, &self.classes[range.clone()], &mut sizes, index_of_degree == 0))?;
                let rows = out.chunks_exact_mut(width).zip(codes.chunks_exact(degree.dims)).zip(&self.classes[range.clone()]);
                rows.for_each(|((out, codes), &class)| degree.restore(basis, codes, class, &mut out[at..at + degree.dims]));
                at += degree.dims;
            }
            Ok::<_, Error>(())
        })?;
        Ok(out)
    }
}

fn impossible(name: &str, problem: impl Into<String>) -> Error {
    Error::data(format!("compact stream '{name}'"), problem, "The file is damaged; fetch or write it again")
}

/// A stream of numbers up to `most`, which is below 16.
fn small(set: &StreamSet, name: &str, count: usize, most: u8) -> Result<Vec<u8>> {
    let mut values = vec![0; count];
    Blocks::read(name, set.reader(name)?, SMALL_CONTEXTS, count)?.decode_into(&mut values, 1, |coder, _, values| code_small(coder, values))?;
    match values.iter().find(|v| **v > most) {
        Some(v) => Err(impossible(name, format!("{v} is over {most}"))),
        None => Ok(values),
    }
}

fn read_scores(mut stream: ByteReader, count: usize) -> Result<Vec<f32>> {
    let form = Form::read(&mut stream)?;
    let escapes = column::read_escapes(&mut stream)?;
    let values = column::read(&mut stream, form, count, &escapes)?;
    stream.finish()?;
    Ok(values)
}

/// Reads rows that are stored as they are into the columns `at` of `values` `[N,width]`: their number, their indices unless it is all, and their values.
fn read_exact(stream: &mut ByteReader, (width, at): (usize, Range<usize>), n: usize, values: &mut [f32]) -> Result<()> {
    let count = stream.u32()? as usize;
    if count > n {
        return Err(stream.error(format!("{count} exact values of {n} Gaussians")));
    }
    let indices = if count == n { &[] } else { stream.take(count.saturating_mul(4))?.as_chunks::<4>().0 };
    let exact = stream.f32s(count.saturating_mul(at.len()))?;
    for (k, exact) in exact.chunks_exact(at.len()).enumerate() {
        let row = indices.get(k).map_or(k, |b| u32::from_le_bytes(*b) as usize);
        if row >= n {
            return Err(stream.error(format!("an exact value of row {row} of {n}")));
        }
        values[row * width + at.start..row * width + at.end].copy_from_slice(exact);
    }
    Ok(())
}
