//! Gaussians as they will be decoded, and what their values cost, without coding them. Fine-tuning asks for both in every iteration.

use super::colors::slope;
use super::encode::{Classes, Integers, coefficients};
use super::geometry::companded;
use super::plan::Plan;
use super::predict::{Known, Linear};
use super::write::{known_classes, known_scales};
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::{HostGaussians, Result, Rounding};
use rayon::prelude::*;

/// Largest step of a unit quaternion's component that [`Rounding::steps`] tells: with larger ones all rotations are rounded alike.
const LARGEST_TURN: f64 = 0.25;

/// The rounding of a plan; rows whose rotations are `free` are in canonical form.
pub struct Rounder<'a> {
    pub plan: &'a Plan,
    pub free: &'a [bool],
    pub classes: &'a Classes,
}

impl Rounding for Rounder<'_> {
    fn round(&self, gaussians: &HostGaussians) -> Result<HostGaussians> {
        Ok(restored(&self.plan.quantise(gaussians, self.free, self.classes, None), gaussians))
    }
    fn steps(&self, gaussians: &HostGaussians) -> Result<HostGaussians> {
        let codes = self.plan.quantise(gaussians, self.free, self.classes, None);
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let mut out = zeros_like(gaussians);
        for (i, &shape) in shapes.iter().enumerate() {
            let step = geometry.cell * f64::from(1u32 << geometry.position_shift(codes.scales[i], shape));
            out.means[3 * i..3 * i + 3].fill(step as f32);
            out.log_scales[3 * i..3 * i + 3].fill(geometry.scale_step_of(shape) as f32);
            let norm = gaussians.quaternions[4 * i..4 * i + 4].iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
            let step = norm * geometry.rotation(geometry.rotation_shift(codes.scales[i], shape)).min(LARGEST_TURN);
            out.quaternions[4 * i..4 * i + 4].fill(step as f32);
            out.opacity_logits[i] = (geometry.opacity_step_of(shape) * (1.0 + f64::from(gaussians.opacity_logits[i]).max(0.0))) as f32;
        }
        for (degree, plan) in self.plan.degrees.iter().enumerate() {
            let steps: Vec<f32> = self.classes.colors.iter().flat_map(|&class| std::iter::repeat_n(plan.step_of(class) as f32, plan.dims)).collect();
            set_coefficients(&mut out, degree, &steps);
        }
        keep_exact(&codes, &zeros_like(gaussians), &mut out);
        out.extra = codes.attributes.iter().map(|coded| (coded.coding.name.clone(), coded.steps())).collect();
        Ok(out)
    }
    fn bit_slopes(&self, gaussians: &HostGaussians) -> Result<HostGaussians> {
        let codes = self.plan.quantise(gaussians, self.free, self.classes, None);
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let mut out = zeros_like(gaussians);
        for (i, &shape) in shapes.iter().enumerate() {
            // The largest component is not stored.
            let q: [f64; 4] = std::array::from_fn(|k| f64::from(gaussians.quaternions[4 * i + k]));
            let step = q.iter().map(|v| v * v).sum::<f64>().sqrt() * geometry.rotation(geometry.rotation_shift(codes.scales[i], shape));
            for k in (0..4).filter(|&k| k != usize::from(codes.rotations[i].form / 2)) {
                out.quaternions[4 * i + k] = (slope(q[k] / step) / step) as f32;
            }
        }
        let order = by_key(&codes);
        let guesses = self.guesses(&codes, &order);
        for (i, &shape) in shapes.iter().enumerate() {
            let (step, origin) = (geometry.scale_step_of(shape), f64::from(geometry.scale_origin));
            for k in 3 * i..3 * i + 3 {
                out.log_scales[k] = (slope((f64::from(gaussians.log_scales[k]) - origin) / step - guesses.scales[k]) / step) as f32;
            }
            let (step, logit) = (geometry.opacity_step_of(shape), gaussians.opacity_logits[i]);
            let stretched = step * (1.0 + f64::from(logit).max(0.0));
            out.opacity_logits[i] = (slope(companded(logit) / step - guesses.opacities[i]) / stretched) as f32;
        }
        for (degree, plan) in self.plan.degrees.iter().enumerate() {
            let guesses = (degree == 0).then_some(guesses.colors.as_slice());
            set_coefficients(&mut out, degree, &plan.bit_slopes(&coefficients(gaussians, degree), &self.classes.colors, guesses));
        }
        keep_exact(&codes, &zeros_like(gaussians), &mut out);
        for coded in &codes.attributes {
            if let Some(attribute) = gaussians.extra.get(&coded.coding.name) {
                out.extra.insert(coded.coding.name.clone(), coded.bit_slopes(&attribute.values, &order, self.classes));
            }
        }
        Ok(out)
    }
}

/// Predictions of a row by the rows before it, in steps, in the order of the Gaussians.
struct Guesses {
    /// `[N,3]`.
    scales: Vec<f64>,
    opacities: Vec<f64>,
    /// Of degree 0 `[N,3]`.
    colors: Vec<f64>,
}

impl Rounder<'_> {
    /// The predictions of `codes`, whose rows are coded in `order`.
    fn guesses(&self, codes: &Integers, order: &[usize]) -> Guesses {
        let (geometry, classes) = (&self.plan.geometry, self.classes);
        let guesses = |dims: usize, values: &[i32], known: &dyn Fn(usize) -> Known| {
            let sorted: Vec<i32> = order.iter().flat_map(|&i| &values[i * dims..(i + 1) * dims]).copied().collect();
            let known: Vec<Known> = order.iter().map(|&i| known(i)).collect();
            let found = Linear::fit(dims, &sorted, &known).guesses(&sorted, &known);
            let mut out = vec![0.0; values.len()];
            order.iter().zip(found.chunks_exact(dims)).for_each(|(&i, row)| out[i * dims..(i + 1) * dims].copy_from_slice(row));
            out
        };
        let of = |i: usize| (classes.colors[i], classes.shapes[i]);
        Guesses {
            scales: guesses(3, codes.scales.as_flattened(), &|i| known_classes(of(i).0, of(i).1, false, geometry.scale_limit)),
            opacities: guesses(1, &codes.opacities, &|i| known_scales(of(i).0, of(i).1, &codes.scales[i], geometry.scale_limit, geometry.opacity_limit)),
            colors: guesses(3, &codes.colors[0], &|i| known_classes(of(i).0, of(i).1, true, 15)),
        }
    }
}

/// Rows in the order of their keys.
fn by_key(codes: &Integers) -> Vec<usize> {
    let mut order: Vec<usize> = (0..codes.keys.len()).collect();
    order.sort_by_key(|&i| (codes.keys[i], i));
    order
}

/// What the integers of `gaussians` stand for, in the same order.
pub fn restored(codes: &Integers, gaussians: &HostGaussians) -> HostGaussians {
    let (plan, classes) = (codes.plan, codes.classes);
    let (geometry, shapes) = (&plan.geometry, &classes.shapes);
    let mut out = gaussians.clone();
    let centres = out.means.par_chunks_exact_mut(3).zip(out.log_scales.par_chunks_exact_mut(3));
    let rows = centres.zip(out.quaternions.par_chunks_exact_mut(4)).zip(out.opacity_logits.par_iter_mut()).enumerate();
    rows.for_each(|(i, (((mean, log_scales), quaternion), opacity))| {
        let (scales, shape) = (codes.scales[i], shapes[i]);
        log_scales.iter_mut().zip(scales).for_each(|(out, code)| *out = geometry.scale(code, shape));
        mean.copy_from_slice(&geometry.centre(codes.keys[i], geometry.position_shift(scales, shape)));
        quaternion.copy_from_slice(&codes.rotations[i].quaternion(geometry.rotation(geometry.rotation_shift(scales, shape))));
        *opacity = geometry.opacity(codes.opacities[i], shape);
    });
    for (degree, (plan, codes)) in plan.degrees.iter().zip(&codes.colors).enumerate() {
        let basis = plan.scaled_basis();
        let mut rows = vec![0.0; codes.len()];
        let each = rows.par_chunks_exact_mut(plan.dims).zip(codes.par_chunks_exact(plan.dims)).zip(&classes.colors);
        each.for_each(|((row, codes), &class)| plan.restore(&basis, codes, class, row));
        set_coefficients(&mut out, degree, &rows);
    }
    keep_exact(codes, gaussians, &mut out);
    out.extra.extend(codes.attributes.iter().map(|coded| (coded.coding.name.clone(), coded.restored())));
    out
}

/// Zeros in the shape of `gaussians`, without attributes of plug-ins.
fn zeros_like(gaussians: &HostGaussians) -> HostGaussians {
    let mut out = HostGaussians { extra: Default::default(), ..gaussians.clone() };
    out.columns_mut().into_iter().for_each(|(_, _, values)| values.fill(0.0));
    out
}

/// Puts the coefficients of one degree `[N,dims]` where they belong.
fn set_coefficients(gaussians: &mut HostGaussians, degree: usize, rows: &[f32]) {
    if degree == 0 {
        gaussians.sh_dc.copy_from_slice(rows);
        return;
    }
    let (width, at, dims) = (3 * sh_rest_len(gaussians.sh_degree), 3 * (degree * degree - 1), 3 * (2 * degree + 1));
    for (out, row) in gaussians.sh_rest.chunks_exact_mut(width).zip(rows.chunks_exact(dims)) {
        out[at..at + dims].copy_from_slice(row);
    }
}

/// Copies what is stored exactly from `from`.
fn keep_exact(codes: &Integers, from: &HostGaussians, to: &mut HostGaussians) {
    let rest = 3 * sh_rest_len(from.sh_degree);
    let copy = |rows: &[usize], width: usize, at: std::ops::Range<usize>, from: &[f32], to: &mut [f32]| {
        for row in rows {
            let range = row * width + at.start..row * width + at.end;
            to[range.clone()].copy_from_slice(&from[range]);
        }
    };
    copy(&codes.exact[0], 3, 0..3, &from.means, &mut to.means);
    copy(&codes.exact[1], 3, 0..3, &from.log_scales, &mut to.log_scales);
    copy(&codes.exact[2], 4, 0..4, &from.quaternions, &mut to.quaternions);
    copy(&codes.exact[3], 1, 0..1, &from.opacity_logits, &mut to.opacity_logits);
    copy(&codes.exact[4], 3, 0..3, &from.sh_dc, &mut to.sh_dc);
    for (degree, rows) in codes.exact.iter().skip(5).enumerate().map(|(d, rows)| (d + 1, rows)) {
        copy(rows, rest, 3 * (degree * degree - 1)..3 * ((degree + 1) * (degree + 1) - 1), &from.sh_rest, &mut to.sh_rest);
    }
}

#[cfg(test)]
mod tests {
    use super::super::encode::{canonical, classify};
    use super::super::plan::{Bounds, Planner};
    use super::super::sensitivity::{Growth, Sensitivity};
    use super::super::{Choices, Job, Motion, importance, layers, read};
    use super::*;
    use cc4dgs_format::{CodecContext, ExtraAttribute, Limits, Seed, Silent};
    use std::cell::Cell;

    fn scene(n: usize) -> HostGaussians {
        let draw = |i: usize, k: usize| (Seed::root(5).index(i as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
        let mut g = HostGaussians { sh_degree: 2, opacity_logits: vec![0.0; n], ..Default::default() };
        for (column, (name, width, values)) in g.columns_mut().into_iter().enumerate() {
            let shift = if name == "log_scales" { -3.0 } else { 0.0 };
            *values = (0..n * width).map(|k| shift + draw(k, column)).collect();
        }
        g.extra.insert("a".into(), ExtraAttribute::exact(2, (0..2 * n).map(|k| draw(k, 99)).collect()));
        // Rows that no step can hold.
        g.quaternions[..4].fill(100.0);
        g.log_scales[7] = 80.0;
        g
    }

    #[test]
    fn rounded_values_are_those_that_are_decoded() {
        let limits = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
        for free in [false, true] {
            let free = vec![free; 300];
            let g = canonical(&scene(300), &free);
            let mut importance = importance::estimate(&g, &limits);
            importance.attributes = vec![Sensitivity { name: "a".into(), growth: Growth::None, weight: 30.0 }];
            let classes = classify(&importance.weights, &importance.shapes, true);
            let motion = Motion { free: u8::from(free[0]), moving: None, levels: [0.0; 2] };
            let layers = layers::assign(&importance.weights, 2);
            let choices = Choices { transform: true, rate_weight: 0.0 };
            let planner = Planner::new(&g, &importance, &classes, choices);
            let job = Job { planner, free, directions: None, layers, motion, factors: [1.0; 6], joint: Cell::new(true) };
            let plan = job.planner.plan(0.02, &[1.0; 6], &Bounds::NONE);
            let order = job.order(&job.quantise(&g, &plan));
            let decoded = read::read(&job.streams(&g, &plan).unwrap(), &limits, true).unwrap();
            let rounder = Rounder { plan: &plan, free: &job.free, classes: &classes };
            let rounded = rounder.round(&g).unwrap();
            let (found, steps) = (rounded.select(&order), rounder.steps(&g).unwrap());
            for ((name, _, a), (_, _, b)) in found.columns().into_iter().zip(decoded.columns()).filter(|c| c.0.0 != "dynamic_scores") {
                assert!(a == b, "{name} differ");
            }
            assert_eq!(found.extra, decoded.extra);
            assert!(rounded.extra["a"] != g.extra["a"] && steps.extra["a"].values.iter().all(|s| *s > 0.0));
            // Free quaternions have the norm 1 in canonical form, which can be rounded.
            assert_eq!((steps.quaternions[0] == 0.0, steps.log_scales[7]), (!job.free[0], 0.0), "rows that are stored exactly");
            // Nothing moves by much more than half a step; norms of quaternions are rounded apart.
            for ((name, _, step), ((_, _, a), (_, _, b))) in steps.columns().into_iter().zip(g.columns().into_iter().zip(rounded.columns())) {
                let worst = a.iter().zip(b).zip(step).filter(|(_, s)| **s > 0.0).map(|((a, b), s)| (a - b).abs() / s).fold(0.0, f32::max);
                let most = if name.starts_with("sh") { 3.0 } else { 0.9 };
                assert!(worst <= most || name == "quaternions", "{name}: {worst} steps");
            }
        }
    }

    #[test]
    fn slopes_are_derivatives_of_bits() {
        let g = scene(40);
        let (rows, classes) = (coefficients(&g, 2), vec![1u8; 40]);
        let plan = super::super::colors::Degree::plan(
            &super::super::colors::Transform::of(&rows, 15, &[1.0; 40], &Choices { transform: true, rate_weight: 0.0 }),
            0.2,
        );
        let guesses: Vec<f64> = (0..rows.len()).map(|k| (k as f64 * 0.7).sin()).collect();
        let slopes = plan.bit_slopes(&rows, &classes, Some(&guesses));
        for k in [0, 7, 100, 599] {
            let bits = |by: f32| {
                let mut rows = rows.clone();
                rows[k] += by;
                plan.bits(&rows, &classes, Some(&guesses))
            };
            let measured = (bits(1e-3) - bits(-1e-3)) / 2e-3;
            assert!((measured - f64::from(slopes[k])).abs() < 1e-2 * measured.abs().max(0.1), "value {k}: {} and {measured}", slopes[k]);
        }
    }
}
