//! Gaussians from streams.

use super::VERSION;
use super::attributes::{self, RowFacts};
use super::blocks::{Blocks, ROWS};
use super::colors::{self, Degree, SMALL_CONTEXTS, code_small};
use super::geometry::{Geometry, KEY_CONTEXTS, ROTATION_CONTEXTS, Rotation, code_keys, code_rotations};
use super::layers;
use super::predict::{Known, Linear};
use super::write::{APART, CLASSES, EXACT, MEANS, MOVING, Motion, OPACITIES, ROTATIONS, SCALES, SCORES, SHAPES, color_name, known_classes, known_scales};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::storage::column::{self, Form};
use cc4dgs_format::storage::{StreamSet, open};
use cc4dgs_format::{CodecContext, Error, HostGaussians, Result, Stream};
use rayon::prelude::*;
use std::ops::Range;
use std::slice;

/// Upper bound on Gaussians per byte of all streams: a block of 2^14 takes eight bytes or more in each of eight streams.
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

/// Decodes what [`super::write::write`] wrote: all of it, or where it is not `whole` the layers that are there, and where all are the degrees that are there.
pub fn read(streams: &[Stream], context: &CodecContext, whole: bool) -> Result<HostGaussians> {
    let (set, mut meta, shape) = open("compact", streams, VERSION, &context.limits)?;
    let geometry = Geometry::read(&mut meta)?;
    let (free, scored) = (meta.u8()?, meta.u8()?);
    let levels = [meta.f32()?, meta.f32()?];
    if free > 2 || scored > 1 || free == 2 && scored == 0 {
        return Err(meta.error(format!("rotations of kind {free} and scores of kind {scored} are impossible")));
    }
    let sizes = layers::read(&mut meta, shape.count)?;
    let (scale_plan, opacity_plan, color_plan) = (Linear::read(3, &mut meta)?, Linear::read(1, &mut meta)?, Linear::read(3, &mut meta)?);
    let degrees = (0..=shape.sh_degree).map(|d| Degree::read(&mut meta, 3 * (2 * d + 1))).collect::<Result<Vec<Degree>>>()?;
    let complete = |layer: &usize| set.has(&layers::stream(&color_name(0), *layer));
    let layer_count = if whole { sizes.len() } else { (0..sizes.len()).take_while(complete).count().max(1) };
    let layers = layers::ranges(&sizes[..layer_count]);
    let (n, all) = (sizes[..layer_count].iter().sum::<usize>(), layer_count == sizes.len());
    let arrived = |degree: &usize| all && set.has(&color_name(*degree));
    let highest = if whole { shape.sh_degree } else { (1..=shape.sh_degree).take_while(arrived).count() };
    let bytes = streams.iter().map(|s| s.bytes.len() as u64).sum::<u64>();
    if n as u64 > PER_BYTE.saturating_mul(bytes) {
        return Err(meta.error(format!("{n} Gaussians in {bytes} bytes are more than there can be")));
    }
    meta.finish()?;
    let coded = |name: &str, contexts: usize| Blocks::read(&set, name, contexts, &layers);

    let classes = small(&set, CLASSES, &layers, 15)?;
    let mut shapes = small(&set, SHAPES, &layers, 15)?;
    for (shape, &color) in shapes.iter_mut().zip(&classes) {
        *shape = (color + *shape).checked_sub(APART).filter(|s| *s < 16).ok_or_else(|| impossible(SHAPES, "a class is below 0 or above 15"))?;
    }
    let moving = if scored == 1 { small(&set, MOVING, &layers, 1)? } else { Vec::new() };
    let mut rows = Rows { geometry, motion: Motion { free, moving: None, levels }, classes, shapes, moving, scales: Vec::new() };
    rows.scales = rows.read_scales(&coded(SCALES, Linear::contexts(3))?, &scale_plan)?;
    let rows = &rows;

    // The other columns depend on classes and scales alone.
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    out.dynamic_scores =
        if scored == 1 { rows.moving.iter().map(|&m| levels[usize::from(m)]).collect() } else { read_scores(set.reader(SCORES)?, shape.count, n)? };
    let (means, rotations) = (coded(MEANS, KEY_CONTEXTS)?, coded(ROTATIONS, ROTATION_CONTEXTS)?);
    let (opacities, base) = (coded(OPACITIES, Linear::contexts(1))?, coded(&color_name(0), Linear::contexts(3))?);
    let (first, higher) = degrees.split_at(1);
    let rows_of_all = 0..n;
    let coded_higher = |(plan, degree)| Ok((plan, Blocks::read(&set, &color_name(degree), colors::CONTEXTS, slice::from_ref(&rows_of_all))?));
    let higher: Vec<(&Degree, Blocks)> = higher[..highest].iter().zip(1..).map(coded_higher).collect::<Result<_>>()?;
    let width = 3 * sh_rest_len(shape.sh_degree);
    let (geometry, appearance) = rayon::join(
        || rayon::join(|| rows.means(&means), || rows.quaternions(&rotations)),
        || {
            rayon::join(
                || Ok::<_, Error>((rows.opacities(&opacities, &opacity_plan)?, rows.base(&base, &color_plan, &first[0])?)),
                || rows.rest(&higher, width),
            )
        },
    );
    (out.means, out.quaternions) = (geometry.0?, geometry.1?);
    (out.opacity_logits, out.sh_dc) = appearance.0?;
    out.sh_rest = appearance.1?;
    out.log_scales = rows.log_scales();

    let mut exact = set.reader(EXACT)?;
    let columns = [(3, &mut out.means), (3, &mut out.log_scales), (4, &mut out.quaternions), (1, &mut out.opacity_logits), (3, &mut out.sh_dc)];
    for (width, values) in columns {
        read_exact(&mut exact, (width, 0..width), shape.count, values)?;
    }
    let mut at = 0;
    for (plan, _) in &higher {
        read_exact(&mut exact, (width, at..at + plan.dims), shape.count, &mut out.sh_rest)?;
        at += plan.dims;
    }
    if highest == shape.sh_degree {
        exact.finish()?;
    }
    if whole || all && attributes::complete(&set, &shape) {
        let Rows { geometry, classes, shapes, moving, scales, .. } = rows;
        attributes::read(&set, &shape, &RowFacts { geometry, classes, shapes, moving, scales }, &mut out)?;
    }
    out.validate_read("decoded Gaussians", &context.limits)?;
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
            rows.for_each(|((out, codes), (shift, _))| *out = codes.quaternion(self.geometry.rotation_step_of(shift)));
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
    /// The higher degrees `[N, width]`; those that are not among `degrees` are 0. Those of a block follow each other, because the larger ones are predicted by
    /// the smaller ones.
    fn rest(&self, degrees: &[(&Degree, Blocks)], width: usize) -> Result<Vec<f32>> {
        let mut out = vec![0.0; width * self.len()];
        if degrees.is_empty() {
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

/// Numbers up to `most`, which is below 16.
fn small(set: &StreamSet, name: &str, layers: &[Range<usize>], most: u8) -> Result<Vec<u8>> {
    let mut values = vec![0; layers.last().map_or(0, |l| l.end)];
    Blocks::read(set, name, SMALL_CONTEXTS, layers)?.decode_into(&mut values, 1, |coder, _, values| code_small(coder, values))?;
    match values.iter().find(|v| **v > most) {
        Some(v) => Err(impossible(name, format!("{v} is over {most}"))),
        None => Ok(values),
    }
}

/// The scores of the first `n` of `count` Gaussians.
fn read_scores(mut stream: ByteReader, count: usize, n: usize) -> Result<Vec<f32>> {
    let form = Form::read(&mut stream)?;
    let escapes = column::read_escapes(&mut stream)?;
    let mut values = column::read(&mut stream, form, count, &escapes)?;
    stream.finish()?;
    values.truncate(n);
    Ok(values)
}

/// Reads rows that are stored as they are into the columns `at` of `values` `[N,width]`, which may have the first rows only: their number, their indices
/// unless it is all, and their values.
fn read_exact(stream: &mut ByteReader, (width, at): (usize, Range<usize>), count: usize, values: &mut [f32]) -> Result<()> {
    let stored = stream.u32()? as usize;
    if stored > count {
        return Err(stream.error(format!("{stored} exact values of {count} Gaussians")));
    }
    let indices = if stored == count { &[] } else { stream.take(stored.saturating_mul(4))?.as_chunks::<4>().0 };
    let exact = stream.f32s(stored.saturating_mul(at.len()))?;
    for (k, exact) in exact.chunks_exact(at.len()).enumerate() {
        let row = indices.get(k).map_or(k, |b| u32::from_le_bytes(*b) as usize);
        if row >= count {
            return Err(stream.error(format!("an exact value of row {row} of {count}")));
        }
        if let Some(values) = values.get_mut(row * width + at.start..row * width + at.end) {
            values.copy_from_slice(exact);
        }
    }
    Ok(())
}
