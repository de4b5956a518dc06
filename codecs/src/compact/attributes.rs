//! Attributes of plug-ins. Where the model can be rendered, their steps follow from what errors of them change in images, and they are predicted and coded
//! like other columns. Elsewhere they are stored as the plug-in allows ([`extra_streams`]).

use super::blocks::{self, Blocks};
use super::colors::{SMALL_CONTEXTS, code_small, slope};
use super::columns::Columns;
use super::encode::Classes;
use super::geometry::{CODE_LIMIT, Geometry};
use super::predict::{GIVEN, Known, Linear};
use super::sensitivity::{Growth, LARGEST, Sensitivity, moments, needed};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{Attributes, Shape, StreamSet, extra_streams};
use cc4dgs_format::{ExtraAttribute, HostGaussians, Result, Stream};
use std::slice;

/// The stream that says how each attribute is coded; those of an attribute are called `coded.NAME.COLUMN` and `coded.NAME.rows`.
pub const CODED: &str = "coded";
/// Largest step over the tolerance of a plug-in; a little is left for float32.
const STEP_OF_TOLERANCE: f64 = 1.99;
/// Largest step over what is left of a tolerance once values are rounded to float32; steps are rounded themselves.
const STEP_OF_REST: f64 = 1.999_999;
/// Largest error of a number that is rounded to float32, over the number.
const ROUNDING: f64 = 1.0 / (1u64 << 24) as f64;
/// Upper bound on shifts: how many times the step of a row is doubled.
const MOST_SHIFT: u8 = 15;

/// How an attribute is coded.
pub struct Coding {
    pub name: String,
    growth: Growth,
    /// Upper bound on the shifts of this attribute.
    limit: u8,
    /// Step of rows whose shift is 0.
    step: f32,
    /// Value of rows that are not stored.
    start: f32,
    /// Values whose code is 0, by column.
    origins: Vec<f32>,
}

impl Coding {
    /// Plans the storage of an attribute, and says which rows are stored.
    pub fn plan(gaussians: Columns, of: &Sensitivity, geometry: &Geometry, quality: f64) -> Option<(Self, Vec<bool>)> {
        let attribute = gaussians.extra.get(&of.name)?;
        let rows = needed(attribute, gaussians.len());
        let (origins, spread) = moments(attribute, &rows);
        let unit = if of.growth == Growth::Size { libm::exp2(geometry.size_floor as f64 / 65536.0) } else { 1.0 };
        let tolerance = attribute.tolerance.map_or(f64::INFINITY, |t| largest_step(attribute, &rows, f64::from(t)));
        let largest = (LARGEST * spread).min(tolerance);
        if !(spread.is_finite() && tolerance > 0.0) {
            return None;
        }
        // A constant has no step.
        let largest = if largest > 0.0 { largest.clamp(1e-30, 1e30) } else { 1.0 };
        let step = (quality / of.weight.max(1e-300) * unit).clamp(1e-30, largest);
        let limit = libm::log2(largest / step).clamp(0.0, f64::from(MOST_SHIFT)) as u8;
        let start = attribute.needed.as_ref().map_or(0.0, |needed| needed.start);
        Some((Self { name: of.name.clone(), growth: of.growth, limit, step: step as f32, start, origins }, rows))
    }
    /// How many times the step of a row is doubled.
    fn shift(&self, geometry: &Geometry, scales: [i32; 3], shape: u8) -> u8 {
        let shift = match self.growth {
            Growth::None => 0,
            Growth::Class => shape,
            Growth::Size => geometry.position_shift(scales, shape).min(u32::from(MOST_SHIFT)) as u8,
        };
        shift.min(self.limit)
    }
    fn step_of(&self, shift: u8) -> f64 {
        f64::from(self.step) * f64::from(1u32 << shift)
    }
    fn value(&self, column: usize, code: i32, shift: u8) -> f32 {
        (f64::from(self.origins[column]) + f64::from(code) * self.step_of(shift)) as f32
    }
    /// Codes `[N,width]` of the stored rows; `None` if one is out of range.
    pub fn quantise(&self, values: &[f32], rows: &[bool], shifts: &[u8]) -> Option<Vec<i32>> {
        let width = self.origins.len();
        let mut out = vec![0; values.len()];
        for (i, (codes, values)) in out.chunks_exact_mut(width).zip(values.chunks_exact(width)).enumerate().filter(|(i, _)| rows[*i]) {
            for (code, (&value, &origin)) in codes.iter_mut().zip(values.iter().zip(&self.origins)) {
                let steps = ((f64::from(value) - f64::from(origin)) / self.step_of(shifts[i])).round();
                *code = (steps.abs() < CODE_LIMIT as f64).then_some(steps as i32)?;
            }
        }
        Some(out)
    }
    /// Values `[N,width]` of the codes.
    fn restored(&self, codes: &[i32], rows: &[bool], shifts: &[u8]) -> Vec<f32> {
        let of_row = |(i, codes): (usize, &[i32])| -> Vec<f32> {
            codes.iter().enumerate().map(|(k, &code)| if rows[i] { self.value(k, code, shifts[i]) } else { self.start }).collect()
        };
        codes.chunks_exact(self.origins.len()).enumerate().flat_map(of_row).collect()
    }
    fn write(&self, kind: u8, out: &mut Vec<u8>) {
        out.extend([self.growth as u8, self.limit, kind]);
        [self.step, self.start].iter().chain(&self.origins).for_each(|v| out.extend(v.to_le_bytes()));
    }
    fn read(name: &str, width: usize, from: &mut ByteReader) -> Result<(Self, u8)> {
        let (growth, limit, kind) = (usize::from(from.u8()?), from.u8()?, from.u8()?);
        let (head, origins) = (from.f32s(2)?, from.f32s(width)?);
        match Growth::ALL.get(growth) {
            Some(&growth) if limit <= MOST_SHIFT && kind <= MASK && head[0] > 0.0 => {
                Ok((Self { name: name.into(), growth, limit, step: head[0], start: head[1], origins }, kind))
            }
            _ => Err(from.error(format!("attribute '{name}': growth {growth}, limit {limit}, rows {kind} or step {} is impossible", head[0]))),
        }
    }
    fn stream(&self, part: impl std::fmt::Display) -> String {
        format!("{CODED}.{}.{part}", self.name)
    }
}

/// Which rows are stored.
const ALL: u8 = 0;
const MOVING: u8 = 1;
const MASK: u8 = 2;

/// An attribute in integers, in the order of the Gaussians.
pub struct Coded<'a> {
    pub coding: &'a Coding,
    pub rows: &'a [bool],
    pub shifts: Vec<u8>,
    /// `[N,width]`.
    pub codes: Vec<i32>,
}

impl<'a> Coded<'a> {
    pub fn new(coding: &'a Coding, rows: &'a [bool], gaussians: Columns, geometry: &Geometry, scales: &[[i32; 3]], shapes: &[u8]) -> Option<Self> {
        let shifts: Vec<u8> = scales.iter().zip(shapes).map(|(&scales, &shape)| coding.shift(geometry, scales, shape)).collect();
        let codes = coding.quantise(&gaussians.extra.get(&coding.name)?.values, rows, &shifts)?;
        Some(Self { coding, rows, shifts, codes })
    }
    fn width(&self) -> usize {
        self.coding.origins.len()
    }
    /// What the codes stand for.
    pub fn restored(&self) -> ExtraAttribute {
        ExtraAttribute::exact(self.width(), self.coding.restored(&self.codes, self.rows, &self.shifts))
    }
    /// The step of each value; 0 in rows that are not stored.
    pub fn steps(&self) -> ExtraAttribute {
        let of_row = |(&shift, &stored): (&u8, &bool)| std::iter::repeat_n(if stored { self.coding.step_of(shift) as f32 } else { 0.0 }, self.width());
        ExtraAttribute::exact(self.width(), self.shifts.iter().zip(self.rows).flat_map(of_row).collect())
    }
    /// The stored rows among `order`.
    fn stored(&self, order: &[usize]) -> Vec<usize> {
        order.iter().copied().filter(|&i| self.rows[i]).collect()
    }
    /// Codes of a column of the rows `stored`, and what is known about each.
    fn column(&self, column: usize, stored: &[usize], classes: &Classes) -> (Vec<i32>, Vec<Known>) {
        let width = self.width();
        let before = |i: usize, k: usize| self.codes[i * width + k];
        let known = |&i: &usize| known(classes.colors[i], classes.shapes[i], self.shifts[i], column, |k| before(i, k));
        (stored.iter().map(|&i| before(i, column)).collect(), stored.iter().map(known).collect())
    }
    /// Derivatives of the estimated bits by the values.
    pub fn bit_slopes(&self, values: &[f32], order: &[usize], classes: &Classes) -> ExtraAttribute {
        let (width, stored) = (self.width(), self.stored(order));
        let mut out = vec![0.0; values.len()];
        for column in 0..width {
            let (codes, known) = self.column(column, &stored, classes);
            let guesses = Linear::fit(1, &codes, |i| known[i]).guesses(&codes, |i| known[i]);
            for (&i, guess) in stored.iter().zip(guesses) {
                let (step, at) = (self.coding.step_of(self.shifts[i]), i * width + column);
                out[at] = (slope((f64::from(values[at]) - f64::from(self.coding.origins[column])) / step - guess) / step) as f32;
            }
        }
        ExtraAttribute::exact(width, out)
    }
}

/// The largest step with which the stored rows of an attribute are within `tolerance`; 0 or less if there is none, because rounding to float32 alone changes
/// large values by as much.
fn largest_step(attribute: &ExtraAttribute, rows: &[bool], tolerance: f64) -> f64 {
    let stored = attribute.values.chunks_exact(attribute.width.max(1)).zip(rows).filter(|(_, stored)| **stored);
    let largest = stored.flat_map(|(row, _)| row).fold(0.0f32, |largest, v| largest.max(v.abs()));
    let rounding = (f64::from(largest) + tolerance) * ROUNDING;
    (STEP_OF_TOLERANCE * tolerance).min(STEP_OF_REST * (tolerance - rounding))
}

/// The inputs of the prediction of a column of a row: its classes, and the earlier columns.
fn known(color: u8, shape: u8, shift: u8, column: usize, before: impl Fn(usize) -> i32) -> Known {
    let mut out = Known { classes: [color, shape], class: shape, shift, ..Default::default() };
    for (given, k) in out.given.iter_mut().zip((column.saturating_sub(GIVEN)..column).rev()) {
        *given = i64::from(before(k)) << shift;
    }
    out
}

/// The streams of all attributes of `gaussians`, of which some are `coded`, with rows in this `order`; `moving` is 0 or 1 per row in that order, where the file
/// has it.
pub fn write(gaussians: Columns, coded: &[Coded], classes: &Classes, order: &[usize], moving: Option<&[u8]>) -> Result<Vec<Stream>> {
    let (mut plain, mut plans, mut columns) = (HostGaussians::default(), Vec::new(), Vec::new());
    for (name, attribute) in gaussians.extra {
        let Some(coded) = coded.iter().find(|coded| coded.coding.name == *name) else {
            plans.push(0);
            plain.extra.insert(name.clone(), attribute.select(order));
            continue;
        };
        let flags: Vec<u8> = order.iter().map(|&i| u8::from(coded.rows[i])).collect();
        let kind = if !flags.contains(&0) {
            ALL
        } else if moving == Some(flags.as_slice()) {
            MOVING
        } else {
            MASK
        };
        plans.push(1);
        coded.coding.write(kind, &mut plans);
        if kind == MASK {
            let all = 0..order.len();
            columns.extend(blocks::encode(&coded.coding.stream("rows"), SMALL_CONTEXTS, slice::from_ref(&all), |coder, range| {
                code_small(coder, &mut flags[range].to_vec())
            })?);
        }
        let stored = coded.stored(order);
        let rows = 0..stored.len();
        for column in 0..coded.width() {
            let (codes, known) = coded.column(column, &stored, classes);
            let plan = Linear::fit(1, &codes, |i| known[i]);
            plan.write(&mut plans);
            columns.extend(blocks::encode(&coded.coding.stream(column), Linear::contexts(1), slice::from_ref(&rows), |coder, range| {
                plan.code(coder, &mut codes[range.clone()].to_vec(), &known[range])
            })?);
        }
    }
    let mut out: Vec<Stream> = extra_streams(&plain, Attributes::AsAllowed).collect();
    if !columns.is_empty() {
        out.push(Stream { name: CODED.into(), bytes: plans });
        out.extend(columns);
    }
    Ok(out)
}

/// Whether the streams of all attributes are there.
pub fn complete(set: &StreamSet, shape: &Shape) -> bool {
    let plain = |attribute: &(String, usize)| Shape { extra: vec![attribute.clone()], ..shape.clone() }.has_extra(set);
    // Streams arrive in their order.
    let coded = |(name, width): &(String, usize)| set.has(CODED) && set.has(&format!("{CODED}.{name}.{}", width - 1));
    shape.extra.iter().all(|attribute| plain(attribute) || coded(attribute))
}

/// Facts about the rows, on which the decoding of attributes depends.
pub struct RowFacts<'a> {
    pub geometry: &'a Geometry,
    pub classes: &'a [u8],
    pub shapes: &'a [u8],
    pub moving: &'a [u8],
    pub scales: &'a [[i32; 3]],
}

/// Reads the attributes of `shape` into `out`.
pub fn read(set: &StreamSet, shape: &Shape, rows: &RowFacts, out: &mut HostGaussians) -> Result<()> {
    if !set.has(CODED) {
        return shape.read_extra(set, out);
    }
    let mut plans = set.reader(CODED)?;
    for (name, width) in &shape.extra {
        match plans.u8()? {
            0 => Shape { extra: vec![(name.clone(), *width)], ..shape.clone() }.read_extra(set, out)?,
            1 => {
                let (coding, kind) = Coding::read(name, *width, &mut plans)?;
                let values = read_coded(set, &coding, kind, rows, &mut plans)?;
                out.extra.insert(name.clone(), ExtraAttribute::exact(*width, values));
            }
            other => return Err(plans.error(format!("attribute '{name}' is stored in an unknown way, {other}"))),
        }
    }
    plans.finish()
}

fn read_coded(set: &StreamSet, coding: &Coding, kind: u8, rows: &RowFacts, plans: &mut ByteReader) -> Result<Vec<f32>> {
    let (n, width) = (rows.classes.len(), coding.origins.len());
    let flags: Vec<bool> = match kind {
        ALL => vec![true; n],
        MOVING if rows.moving.len() == n => rows.moving.iter().map(|m| *m == 1).collect(),
        MASK => {
            let (all, mut flags) = (0..n, vec![0; n]);
            let blocks = Blocks::read(set, &coding.stream("rows"), SMALL_CONTEXTS, slice::from_ref(&all))?;
            blocks.decode_into(&mut flags, 1, |coder, _, flags| code_small(coder, flags))?;
            flags.iter().map(|f| *f != 0).collect()
        }
        _ => return Err(plans.error(format!("attribute '{}' has values where something moves, and that is not known", coding.name))),
    };
    let stored: Vec<usize> = (0..n).filter(|&i| flags[i]).collect();
    let shifts: Vec<u8> = rows.scales.iter().zip(rows.shapes).map(|(&scales, &shape)| coding.shift(rows.geometry, scales, shape)).collect();
    let (mut codes, all) = (vec![0; n * width], 0..stored.len());
    for column in 0..width {
        let plan = Linear::read(1, plans)?;
        let mut found = vec![0; stored.len()];
        let before = &codes;
        Blocks::read(set, &coding.stream(column), Linear::contexts(1), slice::from_ref(&all))?.decode_into(&mut found, 1, |coder, range, found| {
            let known = |&i: &usize| known(rows.classes[i], rows.shapes[i], shifts[i], column, |k| before[i * width + k]);
            plan.code(coder, found, &stored[range].iter().map(known).collect::<Vec<Known>>())
        })?;
        stored.iter().zip(found).for_each(|(&i, code)| codes[i * width + column] = code);
    }
    Ok(coding.restored(&codes, &flags, &shifts))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::Seed;
    use cc4dgs_format::conformance::uniform;

    /// The largest error of values from `middle` - 1 to `middle` + 1 that may have one of `tolerance`; `None` where they are not coded.
    fn worst(middle: f32, tolerance: f32) -> Option<f32> {
        let count = 4000;
        let mut g = HostGaussians { opacity_logits: vec![0.0; count], ..Default::default() };
        g.extra.insert("a".into(), ExtraAttribute::exact(1, (0..count).map(|k| middle + uniform(Seed::root(5), k)).collect()).within(tolerance));
        let (columns, geometry) = (Columns::from(&g), Geometry::new(0.0, 1.0, 1.0, 1.0));
        // Images say that steps may be as large as they like.
        let sensitivity = Sensitivity { name: "a".into(), growth: Growth::None, weight: 1e-9 };
        let (coding, rows) = Coding::plan(columns, &sensitivity, &geometry, 1.0)?;
        let coded = Coded::new(&coding, &rows, columns, &geometry, &vec![[0; 3]; count], &vec![0; count])?;
        let restored = coded.restored();
        Some(g.extra["a"].values.iter().zip(&restored.values).fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs())))
    }

    #[test]
    fn large_values_are_within_the_tolerance() {
        // From 512 to 1024, neighbouring numbers are 2^-14 apart.
        let apart = 1.0 / f32::from(1u16 << 14);
        for (middle, tolerance) in [(0.0, 1e-3), (30.0, 1e-4), (1000.0, 2.4 * apart), (1000.0, 3.9 * apart), (1000.0, 8.9 * apart)] {
            let found = worst(middle, tolerance).unwrap();
            assert!(found <= tolerance && found > 0.3 * tolerance, "{found} around {middle}, {tolerance} is allowed");
        }
        assert!(worst(1000.0, 0.9 * apart).is_none(), "no step is small enough");
    }
}
