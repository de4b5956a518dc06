//! From Gaussians to integers: classes, canonical rotations, steps, order, and rows that are stored exactly.

use super::attributes::{Coded, Coding};
use super::colors::{Choices, Degree};
use super::geometry::{CODE_LIMIT, GRID_BITS, Geometry, Rotation, companded};
use super::importance::{Importance, median};
use super::joint::Directions;
use super::write::APART;
use cc4dgs_format::HostGaussians;
use rayon::prelude::*;

/// The coarsest class.
pub const CLASSES: u8 = 12;
/// What Gaussians of larger weights than that of class 0 add to the squared error of images, as a share of what all others do.
const EXCESS: f64 = 2e-3;
/// Largest step of a centre, in middle scales.
const LARGEST_STEP: f64 = 1.0;
/// Largest steps of log-scales and companded opacities.
const LARGEST_SCALE_STEP: f64 = 0.7;
const LARGEST_OPACITY_STEP: f64 = 1.0;
/// Norms of quaternions outside are stored exactly: an absolute step would be wrong for them.
const NORMS: std::ops::Range<f64> = 0.2..5.0;
/// Log-scales and opacity logits of larger magnitude are stored exactly.
const LOG_SCALE_LIMIT: f32 = 60.0;
const LOGIT_LIMIT: f32 = 60.0;
/// Shares of the centres at either end of an axis that may lie outside of the grid, where they are stored exactly, and how many times coarser a grid with fewer
/// outside may be.
const OUTSIDE: [(f64, f64); 4] = [(0.0, 1.0), (5e-4, 1.0), (5e-3, 2.0), (5e-2, 4.0)];

/// Steps, grid and transforms: everything that decides how values are rounded.
pub struct Plan {
    pub geometry: Geometry,
    pub degrees: Vec<Degree>,
    /// Attributes of plug-ins, and the rows of each that are stored.
    attributes: Vec<(Coding, Vec<bool>)>,
    /// Whether means, log-scales, quaternions, opacity logits, degree 0 and higher degrees are rounded; else they are stored exactly.
    rounds: [bool; 6],
    choices: Choices,
}

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
    top: f64,
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

/// Factors of the steps of the columns means, log-scales, quaternions, opacity logits, degree 0 and higher degrees.
pub type Factors = [f64; 6];

impl Plan {
    /// Plans the storage of canonical Gaussians with the step `quality` / weight for colours. A column whose factor is 0 is stored exactly.
    pub fn new(gaussians: &HostGaussians, importance: &Importance, classes: &Classes, quality: f64, factors: &Factors, choices: &Choices) -> Self {
        let (base, steps) = (quality / classes.top, importance.steps);
        let positive = |v: f64| (v as f32).clamp(1e-18, 1e18);
        let finite: Vec<f64> = gaussians.log_scales.iter().filter(|v| v.abs() < LOG_SCALE_LIMIT).map(|&v| f64::from(v)).collect();
        let mut geometry = Geometry {
            scale_origin: (finite.iter().sum::<f64>() / finite.len().max(1) as f64) as f32,
            scale_step: positive((base * steps.log_scales * factors[1]).min(LARGEST_SCALE_STEP)),
            rotation_step: positive(base * steps.quaternions * factors[2]),
            opacity_step: positive((base * steps.opacity_logits * factors[3]).min(LARGEST_OPACITY_STEP)),
            corner: [0.0; 3],
            cell: 1.0,
            size_floor: 0,
            class_limit: 0,
            scale_limit: 0,
            opacity_limit: 0,
        };
        let limit = |step: f32, largest: f64| libm::log2(largest / f64::from(step)).clamp(0.0, 15.0) as u8;
        geometry.scale_limit = limit(geometry.scale_step, LARGEST_SCALE_STEP);
        geometry.opacity_limit = limit(geometry.opacity_step, LARGEST_OPACITY_STEP);
        grid(&mut geometry, gaussians, importance, base * steps.means * factors[0]);
        let squared: Vec<f64> = importance.weights.iter().map(|w| w * w).collect();
        let degree = |degree: usize| {
            let dims = 3 * (2 * degree + 1);
            let (relative, factor) = if degree == 0 { (1.0, factors[4]) } else { (steps.sh_rest[degree - 1], factors[5]) };
            Degree::plan(&coefficients(gaussians, degree), dims, &classes.colors, &squared, positive(base * relative * factor), choices)
        };
        let attributes = importance.attributes.iter().filter_map(|of| Coding::plan(gaussians, of, &geometry, quality)).collect();
        Self { degrees: (0..=gaussians.sh_degree).map(degree).collect(), attributes, geometry, rounds: factors.map(|f| f > 0.0), choices: *choices }
    }
    /// The integers of canonical Gaussians, as many as those that were planned for. With `directions`, colours are rounded together.
    pub fn quantise<'a>(&'a self, gaussians: &HostGaussians, free: &[bool], classes: &'a Classes, directions: Option<&Directions>) -> Integers<'a> {
        let (geometry, shapes, n) = (&self.geometry, &classes.shapes, gaussians.len());
        let mut exact = vec![Vec::new(); 4];
        let mut scales = vec![[0i32; 3]; n];
        for (i, (codes, values)) in scales.iter_mut().zip(gaussians.log_scales.chunks_exact(3)).enumerate() {
            let step = geometry.scale_step_of(shapes[i]);
            let found: [Option<i32>; 3] = std::array::from_fn(|k| code((f64::from(values[k]) - f64::from(geometry.scale_origin)) / step));
            match found {
                [Some(a), Some(b), Some(c)] if self.rounds[1] && values.iter().all(|v| v.abs() < LOG_SCALE_LIMIT) => *codes = [a, b, c],
                _ => exact[1].push(i),
            }
        }
        let mut keys = vec![0u64; n];
        for (i, (key, mean)) in keys.iter_mut().zip(gaussians.means.chunks_exact(3)).enumerate() {
            match geometry.key(mean, geometry.position_shift(scales[i], shapes[i])).filter(|_| self.rounds[0]) {
                Some(found) => *key = found,
                None => exact[0].push(i),
            }
        }
        let mut rotations = vec![Rotation::default(); n];
        for (i, (codes, q)) in rotations.iter_mut().zip(gaussians.quaternions.chunks_exact(4)).enumerate() {
            let norm = q.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
            let step = geometry.rotation(geometry.rotation_shift(scales[i], shapes[i]));
            match Some(norm).filter(|norm| self.rounds[2] && NORMS.contains(norm)).and_then(|norm| Rotation::of(q, norm, step, free[i])) {
                Some(found) => *codes = found,
                None => exact[2].push(i),
            }
        }
        let mut opacities = vec![0i32; n];
        for (i, (out, &logit)) in opacities.iter_mut().zip(&gaussians.opacity_logits).enumerate() {
            match code(companded(logit) / geometry.opacity_step_of(shapes[i])).filter(|_| self.rounds[3] && logit.abs() < LOGIT_LIMIT) {
                Some(found) => *out = found,
                None => exact[3].push(i),
            }
        }
        let rounds: Vec<bool> = (0..self.degrees.len()).map(|degree| self.rounds[if degree == 0 { 4 } else { 5 }]).collect();
        let choices_of = |degree: usize| Choices { rate_weight: if degree == 0 { 0.0 } else { self.choices.rate_weight }, ..self.choices };
        let choices: Vec<Choices> = (0..self.degrees.len()).map(choices_of).collect();
        let each = |(degree, plan): (usize, &Degree)| plan.quantise(&coefficients(gaussians, degree), &classes.colors, &choices[degree]);
        let found = match directions {
            Some(directions) => directions.quantise(&self.degrees, gaussians, &classes.colors, &rounds, &choices),
            None => self.degrees.iter().enumerate().map(each).collect(),
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
    gaussians.sh_rest.chunks_exact(width).flat_map(|row| &row[from..to]).copied().collect()
}

/// Chooses the grid of the centres: `relative` is the step of class 0 over the middle scale. A grid of so many cells may be too small for them; then some are
/// left out, or cells are larger than wanted, and steps of larger Gaussians and coarser classes are doubled less often.
fn grid(geometry: &mut Geometry, gaussians: &HostGaussians, importance: &Importance, relative: f64) {
    let relative = relative.clamp(1e-9, 0.5);
    let middle: Vec<f64> = gaussians.log_scales.chunks_exact(3).map(|s| f64::from(s[0].min(s[1]).max(s[0].max(s[1]).min(s[2])))).collect();
    // Below half a pixel all Gaussians look alike.
    let pixel = if importance.pixels_per_unit > 0.0 { libm::log(0.5 / importance.pixels_per_unit) } else { -60.0 };
    let floor = pixel.max(median(&middle) - 6.0).clamp(-60.0, 60.0);
    let (cell, cells) = ((relative * libm::exp(floor)).max(1e-30), f64::from(1u32 << GRID_BITS));
    let mut axes: [Vec<f64>; 3] = std::array::from_fn(|k| gaussians.means.iter().skip(k).step_by(3).map(|&v| f64::from(v)).collect());
    axes.iter_mut().for_each(|axis| axis.sort_unstable_by(f64::total_cmp));
    let mut best = f64::INFINITY;
    for (cut, cost) in OUTSIDE {
        let spans = axes.each_ref().map(|axis| span(axis, cut));
        let growth = spans.iter().map(|[low, high]| (high - low) / ((cells - 2.0) * cell)).fold(1.0, f64::max);
        if growth * cost >= best {
            continue;
        }
        best = growth * cost;
        geometry.cell = growth * cell;
        // Beside the middle ones there is room for some of those that may lie outside.
        geometry.corner = spans.map(|[low, high]| if cut > 0.0 { 0.5 * (low + high) - 0.5 * cells * geometry.cell } else { low });
        let octaves = libm::log2(growth);
        geometry.size_floor = ((floor / std::f64::consts::LN_2 + octaves) * 65536.0) as i64;
        geometry.class_limit = (libm::log2(LARGEST_STEP / relative) - octaves).clamp(0.0, 15.0) as u8;
    }
}

/// What is left of sorted values without the share `cut` at either end.
fn span(sorted: &[f64], cut: f64) -> [f64; 2] {
    let last = sorted.len().saturating_sub(1);
    let skip = (cut * sorted.len() as f64).ceil() as usize;
    match sorted.get(skip.min(last)).zip(sorted.get(last.saturating_sub(skip))) {
        Some((&low, &high)) if low <= high => [low, high],
        _ => [0.0; 2],
    }
}

#[cfg(test)]
mod tests {
    use super::super::importance::Steps;
    use super::*;

    /// The grid of Gaussians on the x axis, all with a standard deviation of 1, where a pixel is a hundredth.
    fn grid_of(x: impl Iterator<Item = f32>) -> Geometry {
        let means: Vec<f32> = x.flat_map(|x| [x, 0.0, 0.0]).collect();
        let weights = vec![1.0; means.len() / 3];
        let gaussians = HostGaussians { log_scales: vec![0.0; means.len()], means, ..Default::default() };
        let (shapes, steps) = (weights.clone(), Steps::default());
        let importance = Importance { weights, shapes, samples: 1.0, pixels_per_unit: 100.0, steps, attributes: Vec::new(), directions: None };
        let mut geometry = Geometry {
            scale_origin: 0.0,
            scale_step: std::f32::consts::LN_2,
            rotation_step: 1.0,
            opacity_step: 1.0,
            corner: [0.0; 3],
            cell: 1.0,
            size_floor: 0,
            class_limit: 0,
            scale_limit: 0,
            opacity_limit: 0,
        };
        grid(&mut geometry, &gaussians, &importance, 0.1);
        geometry
    }

    #[test]
    fn a_few_far_away_lie_outside_of_the_grid() {
        let near = || (0..1000).map(|i| 0.02 * i as f32 - 10.0);
        let (usual, found) = (grid_of(near()), grid_of(near().chain([1e6; 4])));
        assert!((usual.corner[0] + 10.0).abs() < 1e-9 && (usual.cell - 5e-4).abs() < 1e-9, "{usual:?}");
        assert_eq!((found.cell, found.size_floor, found.class_limit), (usual.cell, usual.size_floor, usual.class_limit));
        assert!(near().all(|x| found.key(&[x, 0.0, 0.0], 0).is_some()) && found.key(&[1e6, 0.0, 0.0], 0).is_none());
    }

    #[test]
    fn larger_cells_do_not_enlarge_steps_that_are_large_already() {
        let wide = grid_of((0..1000).map(|i| 200.0 * i as f32 - 1e5));
        assert!((0.08..0.11).contains(&wide.cell), "{}", wide.cell);
        for (octave, class) in (-8..=12).flat_map(|octave| (0..=8u8).map(move |class| (octave, class))) {
            let step = wide.cell * f64::from(1u32 << wide.position_shift([octave; 3], class));
            let wanted = 0.1 * libm::exp2(f64::from(octave)).max(0.005) * f64::from(1u32 << class.min(3));
            assert!(step <= wide.cell.max(1.5 * wanted), "octave {octave}, class {class}: {step} instead of {wanted}");
            assert!(class > 0 || octave < 2 || step > wanted / 1.5, "octave {octave}: {step} instead of {wanted}");
        }
    }
}
