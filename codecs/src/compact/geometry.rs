//! Scales, rotations, opacities and centres: their steps, and the coding of their integers.
//!
//! All steps double with each class. Rotations have finer steps where scales differ more, and centres where the Gaussian is smaller. Both are computed in
//! integers from scales that are already decoded, so that every machine finds the same steps.

use super::entropy::{Coder, LANES, Lanes, signed, symmetric};
use crate::morton::{gather, spread};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Error, Result};

/// Bits per axis of the grid of the centres.
pub const GRID_BITS: u32 = 21;
/// Codes are smaller in magnitude.
pub const CODE_LIMIT: i64 = 1 << 24;
/// How many times the step of a rotation is halved, or doubled if negative, where largest and smallest scale are about 0, 1, 2, and 3 or more octaves apart.
const FINER: [i32; 4] = [-2, 1, 2, 3];
/// Steps of rotations that have contexts of their own, and minus the exponent of the finest.
const ROTATION_STEPS: usize = 20;
const ROTATION_FINEST: i32 = 4;
/// Step of the logarithm of a quaternion's norm. Only offsets of deformers depend on it.
const NORM_STEP: f64 = 1.0 / 16.0;
/// Forms of a rotation: which component is the largest, and its sign.
const FORMS: u8 = 8;
/// Largest magnitude of the code of a norm.
const NORM_LIMIT: i64 = 256;

/// Steps and origins.
#[derive(Clone, Debug)]
pub struct Geometry {
    /// Mean log-scale.
    pub scale_origin: f32,
    /// Step of log-scales of class 0.
    pub scale_step: f32,
    /// Step of quaternion components of class 0, before [`FINER`] changes it.
    pub rotation_step: f32,
    /// Step of companded opacities of class 0.
    pub opacity_step: f32,
    /// Lower corner of the grid of the centres.
    pub corner: [f64; 3],
    /// Edge of a cell of the grid.
    pub cell: f64,
    /// Size of a Gaussian, in octaves times 2^16, at which a centre of class 0 has one cell; smaller ones have no finer steps.
    pub size_floor: i64,
    /// Centres of coarser classes have the steps of this one.
    pub class_limit: u8,
    /// Log-scales of coarser classes have the steps of this one: a Gaussian that is hardly seen must not become a large one.
    pub scale_limit: u8,
    /// Opacities of coarser classes have the steps of this one.
    pub opacity_limit: u8,
}

impl Geometry {
    /// With these steps of class 0, in log-scales from `scale_origin` on. Grid and limits are still to be chosen.
    pub fn new(scale_origin: f32, scale_step: f32, rotation_step: f32, opacity_step: f32) -> Self {
        Self {
            scale_origin,
            scale_step,
            rotation_step,
            opacity_step,
            corner: [0.0; 3],
            cell: 1.0,
            size_floor: 0,
            class_limit: 0,
            scale_limit: 0,
            opacity_limit: 0,
        }
    }
    /// Octaves per step of a log-scale of class 0, times 2^16.
    fn octave(&self) -> i64 {
        (f64::from(self.scale_step) / std::f64::consts::LN_2 * 65536.0) as i64
    }
    fn size_origin(&self) -> i64 {
        (f64::from(self.scale_origin) / std::f64::consts::LN_2 * 65536.0) as i64
    }
    /// The middle scale (octaves times 2^16), and the octaves between largest and smallest.
    fn size(&self, codes: [i32; 3], class: u8) -> (i64, usize) {
        let [low, middle, high] = sorted(codes).map(|c| (i64::from(c) << class.min(self.scale_limit)).clamp(-(1 << 36), 1 << 36));
        let octaves = |steps: i64| steps.saturating_mul(self.octave().min(1 << 20));
        (self.size_origin().saturating_add(octaves(middle)), ((octaves(high - low) + 32768) >> 16).clamp(0, 3) as usize)
    }
    /// How many times the step of a centre is doubled.
    pub fn position_shift(&self, scales: [i32; 3], class: u8) -> u32 {
        let larger = self.size(scales, class).0.saturating_sub(self.size_floor).max(0).saturating_add(32768);
        (i64::from(class.min(self.class_limit)) + (larger >> 16)).min(i64::from(GRID_BITS)) as u32
    }
    /// How many times the step of a rotation is doubled, or halved if negative.
    pub fn rotation_shift(&self, scales: [i32; 3], class: u8) -> i32 {
        i32::from(class) - FINER[self.size(scales, class).1]
    }
    pub fn write(&self, meta: &mut Vec<u8>) {
        [self.scale_origin, self.scale_step, self.rotation_step, self.opacity_step].iter().for_each(|v| meta.extend(v.to_le_bytes()));
        self.corner.iter().chain([&self.cell]).for_each(|v| meta.extend(v.to_le_bytes()));
        meta.extend(self.size_floor.to_le_bytes());
        meta.extend([self.class_limit, self.scale_limit, self.opacity_limit]);
    }
    pub fn read(meta: &mut ByteReader) -> Result<Self> {
        let floats = meta.f32s(4)?;
        let doubles = (0..4).map(|_| Ok(f64::from_bits(meta.u64()?))).collect::<Result<Vec<f64>>>()?;
        let (size_floor, class_limit, scale_limit, opacity_limit) = (meta.u64()? as i64, meta.u8()?, meta.u8()?, meta.u8()?);
        if doubles.iter().any(|v| !v.is_finite())
            || floats[1..].iter().any(|v| *v <= 0.0)
            || doubles[3] <= 0.0
            || [class_limit, scale_limit, opacity_limit].iter().any(|l| *l > 15)
        {
            return Err(meta.error("a step or an origin is impossible"));
        }
        Ok(Self {
            scale_origin: floats[0],
            scale_step: floats[1],
            rotation_step: floats[2],
            opacity_step: floats[3],
            corner: [doubles[0], doubles[1], doubles[2]],
            cell: doubles[3],
            size_floor,
            class_limit,
            scale_limit,
            opacity_limit,
        })
    }
    /// Step of a log-scale.
    pub fn scale_step_of(&self, class: u8) -> f64 {
        f64::from(self.scale_step) * f64::from(1u32 << class.min(self.scale_limit))
    }
    /// Step of a companded opacity.
    pub fn opacity_step_of(&self, class: u8) -> f64 {
        f64::from(self.opacity_step) * f64::from(1u32 << class.min(self.opacity_limit))
    }
    pub fn scale(&self, code: i32, class: u8) -> f32 {
        (f64::from(self.scale_origin) + f64::from(code) * self.scale_step_of(class)) as f32
    }
    pub fn opacity(&self, code: i32, class: u8) -> f32 {
        let value = f64::from(code) * self.opacity_step_of(class);
        (if value < 0.0 { value } else { libm::expm1(value) } as f32).clamp(f32::MIN, f32::MAX)
    }
    /// Step of a rotation, for its [`Geometry::rotation_shift`].
    pub fn rotation_step_of(&self, shift: i32) -> f64 {
        f64::from(self.rotation_step) * doubled(shift)
    }
    /// The centre of a cell that was enlarged `shift` times.
    pub fn centre(&self, key: u64, shift: u32) -> [f32; 3] {
        let half = if shift == 0 { 0.5 } else { f64::from(1u32 << (shift - 1)) };
        std::array::from_fn(|axis| ((self.corner[axis] + (gather(key >> axis) as f64 + half) * self.cell) as f32).clamp(f32::MIN, f32::MAX))
    }
    /// The key of a centre: its cell, interleaved bit by bit, without the bits below its step. `None` outside the grid.
    pub fn key(&self, mean: &[f32], shift: u32) -> Option<u64> {
        let mut key = 0;
        for (axis, (&value, corner)) in mean.iter().zip(self.corner).enumerate() {
            let cells = (f64::from(value) - corner) / self.cell;
            if !(0.0..f64::from(1u32 << GRID_BITS)).contains(&cells) {
                return None;
            }
            key |= spread(cells as u64 >> shift << shift) << axis;
        }
        Some(key)
    }
}

/// 1, doubled `shift` times, or halved if negative.
fn doubled(shift: i32) -> f64 {
    if shift < 0 { 1.0 / f64::from(1u32 << -shift) } else { f64::from(1u32 << shift) }
}

/// How many times finer the step of a rotation is where largest and smallest scale are so many octaves apart.
pub fn rotation_fineness(octaves: usize) -> f64 {
    doubled(FINER[octaves.min(FINER.len() - 1)])
}

/// The integer nearest to a number whose magnitude is below 2^31 - 0.5; of two, the one farther from zero, as of [`f64::round`]. It has no branches, which
/// would be mispredicted, and calls no function, so that loops of it are vectorised.
#[inline(always)]
pub fn nearest(value: f64) -> i32 {
    /// Neighbours of numbers of this size are 1 apart.
    const WHOLE: f64 = (1u64 << 52) as f64;
    let magnitude = value.abs();
    let shifted = magnitude + WHOLE;
    // The addition has rounded halves to even.
    let up = if magnitude - (shifted - WHOLE) >= 0.5 { 1.0 } else { 0.0 };
    // The low bits of the mantissa.
    let code = (shifted + up).to_bits() as i32;
    if value < 0.0 { -code } else { code }
}

/// Numbers of steps of a smaller magnitude have codes in range; NaN has none.
pub const NEAREST_LIMIT: f64 = CODE_LIMIT as f64 - 0.5;

/// The code of a number of steps; `None` where it is out of range.
#[inline(always)]
pub fn code_of(steps: f64) -> Option<i32> {
    if steps.abs() < NEAREST_LIMIT { Some(nearest(steps)) } else { None }
}

fn sorted([a, b, c]: [i32; 3]) -> [i32; 3] {
    let (low, high) = (a.min(b), a.max(b));
    [low.min(c), low.max(high.min(c)), high.max(c)]
}

/// The opacity logit on the scale on which it is quantised: errors of opaque Gaussians matter less.
pub fn companded(logit: f32) -> f64 {
    if logit < 0.0 { f64::from(logit) } else { libm::log1p(f64::from(logit)) }
}

/// A rotation: the three components of the unit quaternion beside the largest, the index of the largest times two plus its sign, and the norm.
#[derive(Clone, Copy, Default)]
pub struct Rotation {
    pub codes: [i32; 3],
    pub form: u8,
    pub norm: i32,
}

impl Rotation {
    /// The codes of a quaternion (w,x,y,z) for a step; those of one that is `free` have a positive w, the largest component, and the norm 1.
    pub fn of(q: &[f32], norm: f64, step: f64, free: bool) -> Option<Self> {
        // A quaternion and its negative are the same rotation; that of a free one has no sign.
        let norm = if free && q[0] < 0.0 { -norm } else { norm };
        let unit: [f64; 4] = std::array::from_fn(|k| f64::from(q[k]) / norm);
        let index = if free { 0 } else { (0..4).max_by(|&a, &b| unit[a].abs().total_cmp(&unit[b].abs())).unwrap_or(0) };
        let mut out =
            Self { form: 2 * index as u8 + u8::from(unit[index] < 0.0), norm: libm::round(libm::log(norm.abs()) / NORM_STEP) as i32, ..Default::default() };
        for (code, k) in out.codes.iter_mut().zip((0..4).filter(|k| *k != index)) {
            *code = code_of(unit[k] / step)?;
        }
        Some(out)
    }
    /// The quaternion.
    #[inline]
    pub fn quaternion(&self, step: f64) -> [f32; 4] {
        let v = self.codes.map(|code| f64::from(code) * step);
        let squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
        // The rounded components may leave nothing for the largest one.
        let scale = if squared > 0.999 { (0.999 / squared).sqrt() } else { 1.0 };
        let largest = (1.0 - squared * scale * scale).max(0.0).sqrt();
        let norm = if self.norm == 0 { 1.0 } else { libm::exp(f64::from(self.norm) * NORM_STEP) };
        let (index, sign) = (usize::from(self.form / 2) & 3, if self.form & 1 == 1 { -1.0 } else { 1.0 });
        let mut rest = v.into_iter().map(|v| scale * v);
        std::array::from_fn(|k| (norm * if k == index { sign * largest } else { rest.next().unwrap_or(0.0) }) as f32)
    }
}

/// Contexts of [`code_rotations`]: three components of each step, the form, the norm and its sign.
pub const ROTATION_CONTEXTS: usize = 3 * ROTATION_STEPS + 3;

/// Codes the rotations of a block; `shifts` are the exponents of their steps, and whether each is free.
pub fn code_rotations<C: Coder>(coder: &mut C, rows: &mut [Rotation], shifts: &[(i32, bool)]) -> Result<()> {
    const FORM: usize = 3 * ROTATION_STEPS;
    let lanes = Lanes::of(rows.len().min(shifts.len()));
    for (lane, index) in lanes.turns() {
        let (row, (shift, free)) = (&mut rows[index], shifts[index]);
        if !free {
            row.form = coder.symbol(lane, FORM, usize::from(row.form))? as u8;
            let norm = signed(coder, lane, FORM + 1, FORM + 2, i64::from(row.norm))?;
            if row.form >= FORMS || norm.abs() > NORM_LIMIT {
                let problem = format!("form {} (below {FORMS}) with the norm code {norm} (at most {NORM_LIMIT} in magnitude)", row.form);
                return Err(Error::data("entropy-coded rotation", problem, "The file is damaged; fetch or write it again"));
            }
            row.norm = norm as i32;
        }
        let context = (shift + ROTATION_FINEST).clamp(0, ROTATION_STEPS as i32 - 1) as usize;
        for (k, code) in row.codes.iter_mut().enumerate() {
            *code = checked(symmetric(coder, lane, k * ROTATION_STEPS + context, i64::from(*code))?)?;
        }
    }
    Ok(())
}

/// Contexts of [`code_keys`].
pub const KEY_CONTEXTS: usize = 32 + 48 + 64;

/// Codes the keys of a block, which ascend: the difference to the one before in the lane, in the step of each row.
pub fn code_keys<C: Coder>(coder: &mut C, keys: &mut [u64], shifts: &[u32]) -> Result<()> {
    const LENGTHS: usize = 32;
    const TOP: usize = LENGTHS + 48;
    let lanes = Lanes::of(keys.len().min(shifts.len()));
    let mut states = [(0u64, [0u32; 2]); LANES];
    for (lane, row) in lanes.turns() {
        let (key, shift) = (&mut keys[row], shifts[row]);
        let (last, before) = &mut states[lane];
        let start = *last >> (3 * shift);
        let step = (*key >> (3 * shift)).saturating_sub(start);
        let wanted = u64::BITS - step.leading_zeros();
        // Steps that are likely now, from the cells of those before.
        let expected = ((before[0] + before[1]) / 2).saturating_sub(3 * shift);
        let quarter = coder.symbol(lane, (expected / 2) as usize & 31, wanted as usize >> 2)?;
        let trend = (expected as usize >> 2).cmp(&quarter) as i8 + 1;
        let length = (quarter << 2 | coder.symbol(lane, LENGTHS + quarter * 3 + trend as usize, wanted as usize & 3)? & 3) as u32;
        let mut found = u64::from(length > 0);
        if length > 1 {
            let high = (length - 1).min(3);
            let shown =
                coder.symbol(lane, TOP + (length as usize & 63), (step >> (length - 1 - high)) as usize & ((1 << high) - 1))? as u64 & ((1 << high) - 1);
            found = found << high | shown;
            let rest = length - 1 - high;
            let upper = rest.saturating_sub(32);
            found = found << upper | coder.bits(upper, step.checked_shr(32).unwrap_or(0))?;
            found = found << (rest - upper) | coder.bits(rest - upper, step)?;
        }
        let next = start.checked_add(found).filter(|v| *v < 1 << (3 * GRID_BITS - 3 * shift));
        *key = next.ok_or_else(|| Error::data("entropy-coded centres", "a cell is outside of the grid", "The file is damaged"))? << (3 * shift);
        *last = *key;
        *before = [length + 3 * shift, before[0]];
    }
    Ok(())
}

/// `code`, unless it is out of range.
#[inline]
pub fn checked(code: i64) -> Result<i32> {
    if code.abs() < CODE_LIMIT { Ok(code as i32) } else { Err(Error::data("entropy-coded integer", format!("{code} is out of range"), "The file is damaged")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_those_of_rounding() {
        let halves = [0.0, 0.49999999999999994, 0.5, 0.5000000000000001, 1.0, 1.4999999999999998, 1.5, 2.5, 3.5, 1e-300, 4095.5, 16_777_214.5, 16_777_215.0];
        let drawn = (0..2000).map(|k| f64::from(k) * 0.37 + (f64::from(k) * 7.3).sin());
        for steps in halves.into_iter().chain(drawn).flat_map(|v| [v, -v]) {
            assert_eq!(code_of(steps), Some(steps.round() as i32), "{steps}");
        }
        for steps in [16_777_215.5, -16_777_216.0, 1e300, f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
            assert_eq!(code_of(steps), None, "{steps}");
        }
    }

    #[test]
    fn centres_outside_of_the_grid_have_no_key() {
        let geometry = Geometry { cell: 0.25, ..Geometry::new(0.0, 1.0, 1.0, 1.0) };
        let end = 0.25 * (1u32 << GRID_BITS) as f32;
        assert_eq!(geometry.key(&[0.9, -0.0, 0.25], 0), Some(spread(3) | spread(1) << 2));
        assert_eq!(geometry.key(&[0.9, 0.0, 0.25], 1), Some(spread(2)));
        for outside in [-1e-9, end, f32::NAN, f32::INFINITY] {
            assert_eq!(geometry.key(&[0.0, outside, 0.0], 0), None, "{outside}");
        }
    }
}
