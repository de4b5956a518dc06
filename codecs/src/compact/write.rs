//! The streams of quantised Gaussians.

use super::colors::{self, SMALL_CONTEXTS, code_small};
use super::columns::{Columns, sorted};
use super::encode::Integers;
use super::geometry::{KEY_CONTEXTS, ROTATION_CONTEXTS, code_keys, code_rotations};
use super::predict::{Known, Linear};
use super::{VERSION, attributes, blocks, layers};
use cc4dgs_format::storage::META;
use cc4dgs_format::storage::column::{self, Target};
use cc4dgs_format::{Result, Stream};
use std::ops::Range;
use std::slice;

pub(super) const CLASSES: &str = "classes";
pub(super) const SHAPES: &str = "shapes";
pub(super) const SCALES: &str = "log_scales";
pub(super) const MEANS: &str = "means";
pub(super) const ROTATIONS: &str = "quaternions";
pub(super) const OPACITIES: &str = "opacity_logits";
pub(super) const MOVING: &str = "moving";
pub(super) const SCORES: &str = "dynamic_scores";
pub(super) const EXACT: &str = "exact";
/// Largest distance of the two classes of a Gaussian.
pub const APART: u8 = 7;
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
    /// Whether the rotation of a row is free; `moving` is 0 or 1 per row, or empty.
    pub fn is_free(&self, row: usize, moving: &[u8]) -> bool {
        match self.free {
            0 => false,
            1 => true,
            _ => moving.get(row) == Some(&0),
        }
    }
}

/// The inputs of the prediction of scales and colours of a row.
pub fn known_classes(color: u8, shape: u8, for_color: bool, limit: u8) -> Known {
    let class = if for_color { color } else { shape };
    Known { classes: [color, shape], class, shift: class.min(limit), ..Default::default() }
}

/// The inputs of the prediction of the opacity of a row: its classes and its scales, in the steps of class 0.
pub fn known_scales(color: u8, shape: u8, scales: &[i32; 3], scale_limit: u8, limit: u8) -> Known {
    let mut out = known_classes(color, shape, false, limit);
    for (given, &code) in out.given.iter_mut().zip(scales) {
        *given = i64::from(code) << shape.min(scale_limit);
    }
    out
}

/// All streams; `order` sorts the rows by layer, of `sizes` rows each, and then by their keys. Integers are put into that order column by column, and given up
/// once they are coded.
pub fn write(gaussians: Columns, of: Integers, motion: &Motion, order: &[usize], sizes: &[usize]) -> Result<Vec<Stream>> {
    let (n, ranges) = (order.len(), layers::ranges(sizes));
    let exact = write_exact(gaussians, &of, order);
    let Integers { plan, classes: given, scales, rotations, opacities, keys, colors, attributes, .. } = of;
    let pick = |values: &[u8]| order.iter().map(|&i| values[i]).collect::<Vec<u8>>();
    let (classes, shapes) = (pick(&given.colors), pick(&given.shapes));
    let moving: Vec<u8> = order.iter().map(|&i| motion.moving.as_ref().map_or(0, |m| u8::from(m[i]))).collect();
    let (scales, opacities) = (sorted(scales, 1, order), sorted(opacities, 1, order));
    let mut colors = colors.into_iter().map(|codes| codes.values);
    let base = sorted(colors.next().unwrap_or_default(), 3, order);
    let geometry = &plan.geometry;
    let for_scales = |i: usize| known_classes(classes[i], shapes[i], false, geometry.scale_limit);
    let for_opacities = |i: usize| known_scales(classes[i], shapes[i], &scales[i], geometry.scale_limit, geometry.opacity_limit);
    let for_colors = |i: usize| known_classes(classes[i], shapes[i], true, 15);
    // A fit reads its rows one after the other.
    let (scale_plan, (opacity_plan, color_plan)) = rayon::join(
        || Linear::fit(3, scales.as_flattened(), for_scales),
        || rayon::join(|| Linear::fit(1, &opacities, for_opacities), || Linear::fit(3, &base, for_colors)),
    );

    let mut meta = vec![VERSION];
    gaussians.shape().write(&mut meta)?;
    geometry.write(&mut meta);
    meta.extend([motion.free, u8::from(motion.moving.is_some())]);
    motion.levels.iter().for_each(|v| meta.extend(v.to_le_bytes()));
    layers::write(sizes, &mut meta);
    [&scale_plan, &opacity_plan, &color_plan].iter().for_each(|plan| plan.write(&mut meta));
    plan.degrees.iter().for_each(|d| d.write(&mut meta));

    let small = |name: &str, values: &[u8]| blocks::encode(name, SMALL_CONTEXTS, &ranges, |coder, range| code_small(coder, &mut values[range].to_vec()));
    let apart: Vec<u8> = classes.iter().zip(&shapes).map(|(&c, &s)| s + APART - c).collect();
    let mut streams = vec![Stream { name: META.into(), bytes: meta }, Stream { name: EXACT.into(), bytes: exact }];
    let mut columns = vec![small(CLASSES, &classes)?, small(SHAPES, &apart)?];
    if motion.moving.is_some() {
        columns.push(small(MOVING, &moving)?);
    } else {
        let column = column::encode(&sorted(gaussians.dynamic_scores.to_vec(), 1, order), SCORE);
        let mut bytes = Vec::new();
        column.form.write(&mut bytes);
        column::write_escapes(&column.escapes, &mut bytes);
        bytes.extend(column.codes);
        streams.push(Stream { name: SCORES.into(), bytes });
    }
    columns.push(predicted(SCALES, 3, &ranges, &scale_plan, scales.as_flattened(), for_scales)?);
    let keys = sorted(keys, 1, order);
    columns.push(blocks::encode(MEANS, KEY_CONTEXTS, &ranges, |coder, range| {
        let shifts: Vec<u32> = range.clone().map(|i| geometry.position_shift(scales[i], shapes[i])).collect();
        code_keys(coder, &mut keys[range].to_vec(), &shifts)
    })?);
    drop(keys);
    let rotations = sorted(rotations, 1, order);
    columns.push(blocks::encode(ROTATIONS, ROTATION_CONTEXTS, &ranges, |coder, range| {
        let shifts: Vec<(i32, bool)> = range.clone().map(|i| (geometry.rotation_shift(scales[i], shapes[i]), motion.is_free(i, &moving))).collect();
        code_rotations(coder, &mut rotations[range].to_vec(), &shifts)
    })?);
    drop(rotations);
    columns.push(predicted(OPACITIES, 1, &ranges, &opacity_plan, &opacities, for_opacities)?);
    columns.push(predicted(&color_name(0), 3, &ranges, &color_plan, &base, for_colors)?);
    let mut columns: Vec<_> = columns.into_iter().map(Vec::into_iter).collect();
    ranges.iter().for_each(|_| streams.extend(columns.iter_mut().filter_map(Iterator::next)));
    streams.extend(attributes::write(gaussians, &attributes, given, order, motion.moving.is_some().then_some(moving.as_slice()))?);
    let (all, mut sizes) = (0..n, vec![0; n]);
    for ((degree, plan), codes) in plan.degrees.iter().enumerate().skip(1).zip(colors) {
        let codes = sorted(codes, plan.dims, order);
        streams.extend(blocks::encode(&color_name(degree), colors::CONTEXTS, slice::from_ref(&all), |coder, range| {
            let mut values = codes[range.start * plan.dims..range.end * plan.dims].to_vec();
            plan.code(coder, &mut values, &classes[range.clone()], &mut sizes[range].to_vec(), degree == 1)
        })?);
        plan.note(&codes, &classes, &mut sizes);
    }
    Ok(streams)
}

/// The streams of rows `codes` `[N,dims]` that `plan` predicts from what is `known` about each.
fn predicted(name: &str, dims: usize, ranges: &[Range<usize>], plan: &Linear, codes: &[i32], known: impl Fn(usize) -> Known + Sync) -> Result<Vec<Stream>> {
    blocks::encode(name, Linear::contexts(dims), ranges, |coder, range| {
        let known: Vec<Known> = range.clone().map(&known).collect();
        plan.code(coder, &mut codes[range.start * dims..range.end * dims].to_vec(), &known)
    })
}

/// The stream of a degree's coefficients.
pub fn color_name(degree: usize) -> String {
    format!("sh.{degree}")
}

fn write_exact(gaussians: Columns, of: &Integers, order: &[usize]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut position = vec![0u32; order.len()];
    order.iter().enumerate().for_each(|(at, &i)| position[i] = at as u32);
    for (rows, values) in of.exact_rows().zip(gaussians.all_rows()) {
        let mut rows: Vec<u32> = rows.iter().map(|&i| position[i]).collect();
        rows.sort_unstable();
        out.extend((rows.len() as u32).to_le_bytes());
        if rows.len() < order.len() {
            rows.iter().for_each(|row| out.extend(row.to_le_bytes()));
        }
        rows.iter().flat_map(|&row| values.row(order[row as usize])).for_each(|v| out.extend(v.to_le_bytes()));
    }
    out
}
