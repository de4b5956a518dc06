//! The streams of quantised Gaussians, and back.

use super::colors::{Degree, code_classes};
use super::encode::{Integers, coefficients};
use super::geometry::{Geometry, code_keys, code_opacities, code_rotations, code_scales};
use super::{PREDICTED, VERSION, blocks};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::storage::column::{self, Form, Target};
use cc4dgs_format::storage::{Attributes, META, Shape, extra_streams, open};
use cc4dgs_format::{CodecContext, Error, HostGaussians, Result, Stream};
use rayon::prelude::*;

const CLASSES: &str = "classes";
const SCALES: &str = "log_scales";
const MEANS: &str = "means";
const ROTATIONS: &str = "quaternions";
const OPACITIES: &str = "opacity_logits";
const MOVING: &str = "moving";
const SCORES: &str = "dynamic_scores";
const EXACT: &str = "exact";
/// Gaussians per byte of all streams that a decoder believes. A Gaussian takes some ten symbols of at least 0.0007 bits.
const PER_BYTE: u64 = 4096;
/// Without a threshold, scores are stored as numbers.
const SCORE: Target = Target { bits: 10, mu_law: true, loss: 0.05, tail: 1e-3 };

/// Which rows have rotations of three components, and how scores are stored.
pub struct Motion {
    /// 0: none, 1: all, 2: those that do not move.
    pub free: u8,
    /// Whether each Gaussian moves; `None` if the threshold is unknown.
    pub moving: Option<Vec<bool>>,
    /// Scores of Gaussians that stay and that move.
    pub levels: [f32; 2],
}

impl Motion {
    fn width(&self, row: usize, moving: &[u8]) -> usize {
        match self.free {
            0 => 4,
            1 => 3,
            _ => 3 + usize::from(moving[row] != 0),
        }
    }
}

/// All streams; `order` sorts the rows by their keys.
pub fn write(gaussians: &HostGaussians, of: &Integers, motion: &Motion, order: &[usize]) -> Result<Vec<Stream>> {
    let n = order.len();
    let sorted = gaussians.select(order);
    let classes: Vec<u8> = order.iter().map(|&i| of.classes[i]).collect();
    let scales: Vec<[i32; 3]> = order.iter().map(|&i| of.scales[i]).collect();
    let moving: Vec<u8> = order.iter().map(|&i| motion.moving.as_ref().map_or(0, |m| u8::from(m[i]))).collect();
    let mut meta = vec![VERSION];
    Shape::of(&sorted).write(&mut meta)?;
    of.geometry.write(&mut meta);
    meta.extend([motion.free, u8::from(motion.moving.is_some())]);
    motion.levels.iter().for_each(|v| meta.extend(v.to_le_bytes()));
    of.degrees.iter().for_each(|d| d.write(&mut meta));

    let mut streams = vec![Stream { name: META.into(), bytes: meta }, Stream { name: EXACT.into(), bytes: write_exact(&sorted, of, order) }];
    streams.push(blocks::encode(CLASSES, n, |coder, range| code_classes(coder, &mut classes[range].to_vec()))?);
    streams.push(match motion.moving {
        Some(_) => blocks::encode(MOVING, n, |coder, range| code_classes(coder, &mut moving[range].to_vec()))?,
        None => {
            let column = column::encode(&sorted.dynamic_scores, SCORE);
            let mut bytes = Vec::new();
            column.form.write(&mut bytes);
            column::write_escapes(&column.escapes, &mut bytes);
            bytes.extend(column.codes);
            Stream { name: SCORES.into(), bytes }
        }
    });
    streams.push(blocks::encode(SCALES, n, |coder, range| code_scales(coder, &mut scales[range.clone()].to_vec(), &classes[range], of.geometry.scale_limit))?);
    let keys: Vec<u64> = order.iter().map(|&i| of.keys[i]).collect();
    streams.push(blocks::encode(MEANS, n, |coder, range| {
        code_keys(coder, &mut keys[range.clone()].to_vec(), range.map(|i| of.geometry.position_shift(scales[i], classes[i])))
    })?);
    let rotations: Vec<[i32; 4]> = order.iter().map(|&i| of.rotations[i]).collect();
    streams.push(blocks::encode(ROTATIONS, n, |coder, range| {
        let shifts = range.clone().map(|i| (of.geometry.rotation_shift(scales[i], classes[i]), motion.width(i, &moving)));
        code_rotations(coder, &mut rotations[range].to_vec(), shifts)
    })?);
    let opacities: Vec<i32> = order.iter().map(|&i| of.opacities[i]).collect();
    streams.push(blocks::encode(OPACITIES, n, |coder, range| code_opacities(coder, &mut opacities[range.clone()].to_vec(), &classes[range]))?);
    for (degree, (plan, codes)) in of.degrees.iter().zip(&of.colors).enumerate() {
        let codes: Vec<i32> = order.iter().flat_map(|&i| &codes[i * plan.dims..(i + 1) * plan.dims]).copied().collect();
        streams.push(plan.encode(&color_name(degree), &codes, &classes, degree == PREDICTED)?);
    }
    streams.extend(extra_streams(&sorted, Attributes::AsAllowed));
    Ok(streams)
}

fn color_name(degree: usize) -> String {
    format!("sh.{degree}")
}

/// Columns of `gaussians` in the order of [`Integers::exact`].
fn exact_columns(gaussians: &HostGaussians) -> Vec<(usize, Vec<f32>)> {
    let plain = [&gaussians.means, &gaussians.log_scales, &gaussians.quaternions, &gaussians.opacity_logits];
    let degrees = (0..=gaussians.sh_degree).map(|d| (3 * (2 * d + 1), coefficients(gaussians, d)));
    plain.into_iter().zip([3, 3, 4, 1]).map(|(values, width)| (width, values.clone())).chain(degrees).collect()
}

fn write_exact(sorted: &HostGaussians, of: &Integers, order: &[usize]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut place = vec![0u32; order.len()];
    order.iter().enumerate().for_each(|(at, &i)| place[i] = at as u32);
    for (rows, (width, values)) in of.exact.iter().zip(exact_columns(sorted)) {
        let mut rows: Vec<u32> = rows.iter().map(|&i| place[i]).collect();
        rows.sort_unstable();
        out.extend((rows.len() as u32).to_le_bytes());
        if rows.len() < order.len() {
            rows.iter().for_each(|row| out.extend(row.to_le_bytes()));
        }
        rows.iter().flat_map(|&row| &values[row as usize * width..(row as usize + 1) * width]).for_each(|v| out.extend(v.to_le_bytes()));
    }
    out
}

/// Decodes what [`write`] wrote.
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
    let degrees = (0..=shape.sh_degree).map(|d| Degree::read(&mut meta, 3 * (2 * d + 1))).collect::<Result<Vec<Degree>>>()?;
    meta.finish()?;
    let coded = |name: &'static str| Ok::<_, Error>((name, set.reader(name)?));
    let small = |(name, stream): (&str, ByteReader), most: u8| {
        let read = blocks::decode(name, stream, n, |coder, range| {
            let mut values = vec![0; range.len()];
            code_classes(coder, &mut values)?;
            Ok(values)
        });
        let values = read?.concat();
        match values.iter().find(|v| **v > most) {
            Some(v) => Err(Error::data(format!("compact stream '{name}'"), format!("{v} is over {most}"), "The file is damaged")),
            None => Ok(values),
        }
    };
    let classes = small(coded(CLASSES)?, 15)?;
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    let moving = if scored == 1 { small(coded(MOVING)?, 1)? } else { Vec::new() };
    out.dynamic_scores = if scored == 1 { moving.iter().map(|&m| levels[usize::from(m)]).collect() } else { read_scores(set.reader(SCORES)?, n)? };
    let motion = Motion { free, moving: None, levels };
    let (name, stream) = coded(SCALES)?;
    let scales = blocks::decode(name, stream, n, |coder, range| {
        let mut codes = vec![[0; 3]; range.len()];
        code_scales(coder, &mut codes, &classes[range], geometry.scale_limit)?;
        Ok(codes)
    })?;
    let scales: Vec<[i32; 3]> = scales.concat();

    // The others depend on classes and scales alone.
    let (means, rotations, opacities) = (coded(MEANS)?, coded(ROTATIONS)?, coded(OPACITIES)?);
    let means = || -> Result<Vec<f32>> {
        let read = blocks::decode(means.0, means.1, n, |coder, range| {
            let mut keys = vec![0; range.len()];
            let shifts: Vec<u32> = range.map(|i| geometry.position_shift(scales[i], classes[i])).collect();
            code_keys(coder, &mut keys, shifts.iter().copied())?;
            Ok(keys.into_iter().zip(shifts).flat_map(|(key, shift)| geometry.centre(key, shift)).collect::<Vec<f32>>())
        });
        Ok(read?.concat())
    };
    let quaternions = || -> Result<Vec<f32>> {
        let read = blocks::decode(rotations.0, rotations.1, n, |coder, range| {
            let mut codes = vec![[0; 4]; range.len()];
            let shifts: Vec<(i32, usize)> = range.map(|i| (geometry.rotation_shift(scales[i], classes[i]), motion.width(i, &moving))).collect();
            code_rotations(coder, &mut codes, shifts.iter().copied())?;
            Ok(codes.into_iter().zip(shifts).flat_map(|(codes, (shift, width))| quaternion(codes, geometry.rotation(shift), width)).collect::<Vec<f32>>())
        });
        Ok(read?.concat())
    };
    let logits = || -> Result<Vec<f32>> {
        let read = blocks::decode(opacities.0, opacities.1, n, |coder, range| {
            let mut codes = vec![0; range.len()];
            code_opacities(coder, &mut codes, &classes[range.clone()])?;
            Ok(codes.into_iter().zip(&classes[range]).map(|(code, &class)| geometry.opacity(code, class)).collect::<Vec<f32>>())
        });
        Ok(read?.concat())
    };
    let colors = || {
        let read = |(d, plan): (usize, &Degree)| {
            let name = color_name(d);
            plan.decode(&name, set.reader(&name)?, &classes, d == PREDICTED)
        };
        degrees.par_iter().enumerate().map(read).collect::<Result<Vec<Vec<f32>>>>()
    };
    let (shapes, colors) = rayon::join(|| -> Result<_> { Ok((means()?, quaternions()?, logits()?)) }, colors);
    let mut colors = colors?;
    (out.means, out.quaternions, out.opacity_logits) = shapes?;
    out.log_scales = scales.iter().zip(&classes).flat_map(|(codes, &class)| codes.map(|code| geometry.scale(code, class))).collect();
    let mut exact = set.reader(EXACT)?;
    let columns = [(3, &mut out.means), (3, &mut out.log_scales), (4, &mut out.quaternions), (1, &mut out.opacity_logits)];
    for (width, values) in columns.into_iter().chain(degrees.iter().map(|d| d.dims).zip(&mut colors)) {
        read_exact(&mut exact, width, values)?;
    }
    exact.finish()?;
    out.sh_dc = colors.remove(0);
    out.sh_rest = vec![0.0; n * 3 * sh_rest_len(shape.sh_degree)];
    let width = 3 * sh_rest_len(shape.sh_degree);
    let mut at = 0;
    for (values, degree) in colors.iter().zip(&degrees[1..]) {
        let rows = out.sh_rest.chunks_exact_mut(width).zip(values.chunks_exact(degree.dims));
        rows.for_each(|(row, values)| row[at..at + degree.dims].copy_from_slice(values));
        at += degree.dims;
    }
    shape.read_extra(&set, &mut out)?;
    out.validate("decoded Gaussians", &context.limits)?;
    Ok(out)
}

fn quaternion(codes: [i32; 4], step: f64, width: usize) -> [f32; 4] {
    let v = codes.map(|code| f64::from(code) * step);
    if width == 4 {
        return v.map(|v| (v as f32).clamp(f32::MIN, f32::MAX));
    }
    let squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    // Rounded outwards, w may have no room left.
    let scale = if squared > 0.999 { (0.999 / squared).sqrt() } else { 1.0 };
    let w = (1.0 - squared * scale * scale).max(0.0).sqrt();
    [w as f32, (scale * v[0]) as f32, (scale * v[1]) as f32, (scale * v[2]) as f32]
}

fn read_scores(mut stream: ByteReader, count: usize) -> Result<Vec<f32>> {
    let form = Form::read(&mut stream)?;
    let escapes = column::read_escapes(&mut stream)?;
    let values = column::read(&mut stream, form, count, &escapes)?;
    stream.finish()?;
    Ok(values)
}

fn read_exact(stream: &mut ByteReader, width: usize, values: &mut [f32]) -> Result<()> {
    let count = stream.u32()? as usize;
    let rows: Vec<usize> = if count * width == values.len() {
        (0..count).collect()
    } else {
        stream.take(count.saturating_mul(4))?.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b) as usize).collect()
    };
    let exact = stream.f32s(count.saturating_mul(width))?;
    for (row, exact) in rows.into_iter().zip(exact.chunks_exact(width)) {
        match values.get_mut(row * width..(row + 1) * width) {
            Some(values) => values.copy_from_slice(exact),
            None => return Err(stream.error(format!("an exact value of row {row} of {}", values.len() / width))),
        }
    }
    Ok(())
}
