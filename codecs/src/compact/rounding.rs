//! Gaussians as they will be decoded, and estimates of their bits, without coding them. Fine-tuning needs both in every iteration.

use super::colors::slope;
use super::columns::Columns;
use super::encode::{Classes, Integers};
use super::geometry::companded;
use super::plan::Plan;
use super::predict::{Known, Linear};
use super::restore::restored;
use super::write::{known_classes, known_scales};
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::{HostGaussians, Result, Rounding};
use std::ops::Range;

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
        Ok(restored(&self.codes(gaussians), gaussians.into(), None))
    }
    fn steps(&self, gaussians: &HostGaussians) -> Result<HostGaussians> {
        let codes = self.codes(gaussians);
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let mut out = zeros_like(gaussians);
        for (i, &shape) in shapes.iter().enumerate() {
            let step = geometry.cell * f64::from(1u32 << geometry.position_shift(codes.scales[i], shape));
            out.means[3 * i..3 * i + 3].fill(step as f32);
            out.log_scales[3 * i..3 * i + 3].fill(geometry.scale_step_of(shape) as f32);
            let norm = gaussians.quaternions[4 * i..4 * i + 4].iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
            let step = norm * geometry.rotation_step_of(geometry.rotation_shift(codes.scales[i], shape)).min(LARGEST_TURN);
            out.quaternions[4 * i..4 * i + 4].fill(step as f32);
            out.opacity_logits[i] = (geometry.opacity_step_of(shape) * (1.0 + f64::from(gaussians.opacity_logits[i]).max(0.0))) as f32;
        }
        for (degree, plan) in self.plan.degrees.iter().enumerate() {
            let steps: Vec<f32> = self.classes.colors.iter().flat_map(|&class| std::iter::repeat_n(plan.step_of(class) as f32, plan.dims)).collect();
            set_coefficients(&mut out, degree, &steps);
        }
        clear_exact(&codes, &mut out);
        out.extra = codes.attributes.iter().map(|coded| (coded.coding.name.clone(), coded.steps())).collect();
        Ok(out)
    }
    fn bit_slopes(&self, gaussians: &HostGaussians) -> Result<HostGaussians> {
        let codes = self.codes(gaussians);
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let mut out = zeros_like(gaussians);
        for (i, &shape) in shapes.iter().enumerate() {
            // The largest component is not stored.
            let q: [f64; 4] = std::array::from_fn(|k| f64::from(gaussians.quaternions[4 * i + k]));
            let step = q.iter().map(|v| v * v).sum::<f64>().sqrt() * geometry.rotation_step_of(geometry.rotation_shift(codes.scales[i], shape));
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
            set_coefficients(&mut out, degree, &plan.bit_slopes(Columns::from(gaussians).coefficients(degree), &self.classes.colors, guesses));
        }
        clear_exact(&codes, &mut out);
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
    fn codes(&self, gaussians: &HostGaussians) -> Integers<'_> {
        let colors = self.plan.color_codes(gaussians.into(), self.classes, None, None);
        self.plan.quantise(gaussians.into(), self.free, self.classes, colors)
    }
    /// The predictions of `codes`, whose rows are coded in `order`.
    fn guesses(&self, codes: &Integers, order: &[usize]) -> Guesses {
        let (geometry, classes) = (&self.plan.geometry, self.classes);
        let guesses = |dims: usize, values: &[i32], known: &(dyn Fn(usize) -> Known + Sync)| {
            let sorted: Vec<i32> = order.iter().flat_map(|&i| &values[i * dims..(i + 1) * dims]).copied().collect();
            let known = |row: usize| known(order[row]);
            let found = Linear::fit(dims, &sorted, known).guesses(&sorted, known);
            let mut out = vec![0.0; values.len()];
            order.iter().zip(found.chunks_exact(dims)).for_each(|(&i, row)| out[i * dims..(i + 1) * dims].copy_from_slice(row));
            out
        };
        let of = |i: usize| (classes.colors[i], classes.shapes[i]);
        Guesses {
            scales: guesses(3, codes.scales.as_flattened(), &|i| known_classes(of(i).0, of(i).1, false, geometry.scale_limit)),
            opacities: guesses(1, &codes.opacities, &|i| known_scales(of(i).0, of(i).1, &codes.scales[i], geometry.scale_limit, geometry.opacity_limit)),
            colors: guesses(3, &codes.colors[0].values, &|i| known_classes(of(i).0, of(i).1, true, 15)),
        }
    }
}

/// Rows in the order of their keys.
fn by_key(codes: &Integers) -> Vec<usize> {
    let mut order: Vec<usize> = (0..codes.keys.len()).collect();
    order.sort_by_key(|&i| (codes.keys[i], i));
    order
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

/// Zeros where values are stored exactly.
fn clear_exact(codes: &Integers, out: &mut HostGaussians) {
    let rest = 3 * sh_rest_len(out.sh_degree);
    let clear = |rows: &[usize], width: usize, at: Range<usize>, values: &mut [f32]| {
        rows.iter().for_each(|row| values[row * width + at.start..row * width + at.end].fill(0.0));
    };
    clear(&codes.exact[0], 3, 0..3, &mut out.means);
    clear(&codes.exact[1], 3, 0..3, &mut out.log_scales);
    clear(&codes.exact[2], 4, 0..4, &mut out.quaternions);
    clear(&codes.exact[3], 1, 0..1, &mut out.opacity_logits);
    clear(&codes.colors[0].missing, 3, 0..3, &mut out.sh_dc);
    for (degree, codes) in codes.colors.iter().enumerate().skip(1) {
        clear(&codes.missing, rest, 3 * sh_rest_len(degree - 1)..3 * sh_rest_len(degree), &mut out.sh_rest);
    }
}

#[cfg(test)]
mod tests {
    use super::super::colors::{Degree, Transform};
    use super::super::columns::Rows;
    use super::super::encode::{classify, make_canonical};
    use super::super::plan::{Bounds, Planner};
    use super::super::sensitivity::{Growth, Sensitivity};
    use super::super::{Choices, Job, Motion, importance, layers, read};
    use super::*;
    use cc4dgs_format::conformance::uniform;
    use cc4dgs_format::{CodecContext, ExtraAttribute, Limits, Seed, Silent};
    use std::cell::Cell;

    fn scene(n: usize) -> HostGaussians {
        let draw = |i: usize, k: usize| uniform(Seed::root(5).index(i as u64), k);
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
            let mut g = scene(300);
            make_canonical(&mut g.log_scales, &mut g.quaternions, &free);
            let mut importance = importance::estimate(&g, &limits);
            importance.attributes = vec![Sensitivity { name: "a".into(), growth: Growth::None, weight: 30.0 }];
            let classes = classify(&importance.weights, &importance.shapes, true);
            let motion = Motion { free: u8::from(free[0]), moving: None, levels: [0.0; 2] };
            let layers = layers::assign(&importance.weights, 2);
            let choices = Choices { transform: true, rate_weight: 0.0 };
            let columns = Columns::from(&g);
            let planner = Planner::new(columns, &importance, &classes, choices);
            let job = Job { planner, free, directions: None, layers, motion, factors: [1.0; 6], joint: Cell::new(true) };
            let plan = job.planner.plan(0.02, &[1.0; 6], &Bounds::NONE);
            let order = job.order(&job.quantise(columns, &plan, None));
            let decoded = read::read(&job.streams(columns, &plan).unwrap(), &limits, true).unwrap();
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
        let (rows, classes): (Vec<f32>, _) = (Columns::from(&g).coefficients(2).iter().flatten().copied().collect(), vec![1u8; 40]);
        let plan = Degree::plan(&Transform::of(Rows::of(&rows, 15), &[1.0; 40], &Choices { transform: true, rate_weight: 0.0 }), 0.2);
        let guesses: Vec<f64> = (0..rows.len()).map(|k| (k as f64 * 0.7).sin()).collect();
        let slopes = plan.bit_slopes(Rows::of(&rows, 15), &classes, Some(&guesses));
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
