//! From Gaussians to integers: classes, canonical rotations, codes, and rows that are stored exactly.

use super::attributes::Coded;
use super::colors::{Choices, Degree};
use super::geometry::{CODE_LIMIT, Rotation, companded};
use super::joint::Directions;
use super::plan::Plan;
use super::write::APART;
use cc4dgs_format::HostGaussians;
use rayon::prelude::*;

/// The coarsest class.
pub const CLASSES: u8 = 12;
/// What Gaussians of larger weights than that of class 0 add to the squared error of images, as a share of what all others do.
const EXCESS: f64 = 2e-3;
/// Norms of quaternions outside are stored exactly: an absolute step would be wrong for them.
const NORMS: std::ops::Range<f64> = 0.2..5.0;
/// Log-scales and opacity logits of larger magnitude are stored exactly.
pub const LOG_SCALE_LIMIT: f32 = 60.0;
const LOGIT_LIMIT: f32 = 60.0;

/// Everything that is stored, in the order of the Gaussians given.
pub struct Integers<'a> {
    pub plan: &'a Plan,
    pub classes: &'a Classes,
    pub scales: Vec<[i32; 3]>,
    pub rotations: Vec<Rotation>,
    pub opacities: Vec<i32>,
    pub keys: Vec<u64>,
    /// `[N,dims]` per degree.
    pub colors: Vec<Vec<i32>>,
    /// Attributes of plug-ins that are coded; others are stored as they may be.
    pub attributes: Vec<Coded<'a>>,
    /// Rows whose values are stored as float32, by column: means, log-scales, quaternions, opacity logits, then degrees.
    pub exact: Vec<Vec<usize>>,
}

/// Whether a row's axes and the sign and norm of its quaternion are free to choose, because nothing is added to them.
pub fn canonical(gaussians: &HostGaussians, free: &[bool]) -> HostGaussians {
    let mut out = gaussians.clone();
    let rows = out.quaternions.par_chunks_exact_mut(4).zip(out.log_scales.par_chunks_exact_mut(3)).zip(free);
    rows.filter(|(_, free)| **free).for_each(|((q, s), _)| canonical_row(q, s));
    out
}

/// Sorts the scales, largest first, and turns the quaternion to the one of its kind with the largest w.
fn canonical_row(q: &mut [f32], s: &mut [f32]) {
    let norm = q.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
    if !(norm > 1e-12 && norm.is_finite()) {
        return;
    }
    let mut unit: [f64; 4] = std::array::from_fn(|k| f64::from(q[k]) / norm);
    // Exchanging two axes is a quarter turn about the third, up to signs of axes, which do not matter.
    for (a, b) in [(0, 1), (1, 2), (0, 1)] {
        if s[a] < s[b] {
            s.swap(a, b);
            let mut quarter = [std::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0, 0.0];
            quarter[1 + (3 - a - b)] = std::f64::consts::FRAC_1_SQRT_2;
            unit = product(unit, quarter);
        }
    }
    // Half turns about the axes change nothing.
    let halves = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let turned = halves.map(|half| product(unit, half));
    let best = (0..4).max_by(|&a, &b| turned[a][0].abs().total_cmp(&turned[b][0].abs())).unwrap_or(0);
    let sign = if turned[best][0] < 0.0 { -1.0 } else { 1.0 };
    q.iter_mut().zip(turned[best]).for_each(|(q, v)| *q = (sign * v) as f32);
}

/// Hamilton's product of (w,x,y,z).
fn product(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// Classes of Gaussians.
#[derive(Clone)]
pub struct Classes {
    /// Of colours.
    pub colors: Vec<u8>,
    /// Of everything else; at most [`APART`] from those of colours.
    pub shapes: Vec<u8>,
    /// The weight of class 0.
    pub top: f64,
}

/// Classes by the weights of colours and of shapes.
pub fn classify(colors: &[f64], shapes: &[f64], adaptive: bool) -> Classes {
    let (colors, top) = octaves(colors, None, adaptive);
    let apart = |(&shape, &color): (&u8, &u8)| shape.clamp(color.saturating_sub(APART), color + APART).min(CLASSES);
    let shapes = octaves(shapes, Some(top), adaptive).0.iter().zip(&colors).map(apart).collect();
    Classes { colors, shapes, top }
}

/// Octaves of each weight below the top one.
fn octaves(weights: &[f64], top: Option<f64>, adaptive: bool) -> (Vec<u8>, f64) {
    let mut sorted: Vec<f64> = weights.iter().copied().filter(|w| *w > 0.0 && w.is_finite()).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    if sorted.is_empty() {
        return (vec![0; weights.len()], 1.0);
    }
    if !adaptive {
        // One step for all that costs as much error as steps of their own would.
        return (vec![0; weights.len()], (sorted.iter().map(|w| w * w).sum::<f64>() / sorted.len() as f64).sqrt());
    }
    let top = top.unwrap_or_else(|| {
        // A few Gaussians may matter a hundred times as much as others, such as those right before a camera.
        let mut larger = 0.0;
        let allowed = sorted.iter().rev().take_while(|&&w| {
            let fits = larger <= EXCESS * sorted.len() as f64 * w * w;
            larger += w * w;
            fits
        });
        allowed.last().copied().unwrap_or(sorted[sorted.len() - 1])
    });
    let class = |w: &f64| if *w > 0.0 { libm::log2(top / w).round().clamp(0.0, f64::from(CLASSES)) as u8 } else { CLASSES };
    (weights.iter().map(class).collect(), top)
}

impl Plan {
    /// The integers of canonical Gaussians, as many as those that were planned for. With `directions`, colours are rounded together if they may be.
    pub fn quantise<'a>(&'a self, gaussians: &HostGaussians, free: &[bool], classes: &'a Classes, directions: Option<&Directions>) -> Integers<'a> {
        let (geometry, shapes, n) = (&self.geometry, &classes.shapes, gaussians.len());
        let (scales, exact_scales) = each(n, |i| {
            let (values, step) = (&gaussians.log_scales[3 * i..3 * i + 3], geometry.scale_step_of(shapes[i]));
            let found: [Option<i32>; 3] = std::array::from_fn(|k| code((f64::from(values[k]) - f64::from(geometry.scale_origin)) / step));
            match found {
                [Some(a), Some(b), Some(c)] if self.rounds[1] && values.iter().all(|v| v.abs() < LOG_SCALE_LIMIT) => Some([a, b, c]),
                _ => None,
            }
        });
        let (keys, exact_means) = each(n, |i| {
            let mean = &gaussians.means[3 * i..3 * i + 3];
            geometry.key(mean, geometry.position_shift(scales[i], shapes[i])).filter(|_| self.rounds[0])
        });
        let (rotations, exact_rotations) = each(n, |i| {
            let q = &gaussians.quaternions[4 * i..4 * i + 4];
            let norm = q.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
            let step = geometry.rotation(geometry.rotation_shift(scales[i], shapes[i]));
            Some(norm).filter(|norm| self.rounds[2] && NORMS.contains(norm)).and_then(|norm| Rotation::of(q, norm, step, free[i]))
        });
        let (opacities, exact_opacities) = each(n, |i| {
            let logit = gaussians.opacity_logits[i];
            code(companded(logit) / geometry.opacity_step_of(shapes[i])).filter(|_| self.rounds[3] && logit.abs() < LOGIT_LIMIT)
        });
        let mut exact = vec![exact_means, exact_scales, exact_rotations, exact_opacities];
        let rounds: Vec<bool> = (0..self.degrees.len()).map(|degree| self.rounds[if degree == 0 { 4 } else { 5 }]).collect();
        let choices_of = |degree: usize| Choices { rate_weight: if degree == 0 { 0.0 } else { self.choices.rate_weight }, ..self.choices };
        let choices: Vec<Choices> = (0..self.degrees.len()).map(choices_of).collect();
        let alone = |(degree, plan): (usize, &Degree)| plan.quantise(&coefficients(gaussians, degree), &classes.colors, &choices[degree]);
        let found = match directions.filter(|_| self.joint) {
            Some(directions) => directions.quantise(&self.degrees, gaussians, &classes.colors, &rounds, &choices),
            None => self.degrees.iter().enumerate().map(alone).collect(),
        };
        let mut colors = Vec::new();
        for ((plan, rows), rounds) in self.degrees.iter().zip(found).zip(rounds) {
            let mut missing = Vec::new();
            let mut codes = vec![0; n * plan.dims];
            for (i, (row, out)) in rows.into_iter().zip(codes.chunks_exact_mut(plan.dims)).enumerate() {
                match row.filter(|_| rounds) {
                    Some(row) => out.copy_from_slice(&row),
                    None => missing.push(i),
                }
            }
            exact.push(missing);
            colors.push(codes);
        }
        let attributes = self.attributes.iter().filter_map(|(coding, rows)| Coded::new(coding, rows, gaussians, geometry, &scales, shapes)).collect();
        Integers { plan: self, classes, scales, rotations, opacities, keys, colors, attributes, exact }
    }
}

/// The codes of `n` rows, and the rows that have none.
fn each<T: Default + Send>(n: usize, code: impl Fn(usize) -> Option<T> + Send + Sync) -> (Vec<T>, Vec<usize>) {
    let found: Vec<Option<T>> = (0..n).into_par_iter().map(code).collect();
    let missing = found.iter().enumerate().filter(|(_, code)| code.is_none()).map(|(i, _)| i).collect();
    (found.into_iter().map(Option::unwrap_or_default).collect(), missing)
}

fn code(steps: f64) -> Option<i32> {
    let code = steps.round();
    (code.abs() < CODE_LIMIT as f64).then_some(code as i32)
}

/// The coefficients of one degree `[N, 3 (2 degree + 1)]`.
pub fn coefficients(gaussians: &HostGaussians, degree: usize) -> Vec<f32> {
    if degree == 0 {
        return gaussians.sh_dc.clone();
    }
    let width = 3 * cc4dgs_format::gaussians::sh_rest_len(gaussians.sh_degree);
    let (from, to) = (3 * (degree * degree - 1), 3 * ((degree + 1) * (degree + 1) - 1));
    let mut out = Vec::with_capacity(gaussians.len() * (to - from));
    gaussians.sh_rest.chunks_exact(width).for_each(|row| out.extend_from_slice(&row[from..to]));
    out
}
