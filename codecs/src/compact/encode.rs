//! From Gaussians to integers: classes, canonical rotations, steps, order, and rows that are stored exactly.

use super::attributes::{Coded, Coding};
use super::colors::{Choices, Degree, Transform};
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
/// Largest step of a centre, in middle scales, if no [`Bounds`] are set.
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
    /// Whether colours may be rounded together.
    joint: bool,
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

/// What keeps the declared loss, where steps alone do not.
#[derive(Clone, Copy)]
pub struct Bounds {
    /// Factors of the largest step of each column; of all steps of those that have none. A column whose factor is 0 is stored exactly.
    pub largest: Factors,
    /// Whether colours may be rounded together.
    pub joint: bool,
}

impl Bounds {
    pub const NONE: Self = Self { largest: [1.0; 6], joint: true };
}

/// Plans for canonical Gaussians, and what all of them share.
pub struct Planner<'a> {
    pub gaussians: &'a HostGaussians,
    pub importance: &'a Importance,
    pub classes: &'a Classes,
    choices: Choices,
    /// Mean log-scale.
    scale_origin: f32,
    /// Median of the middle log-scales.
    middle: f64,
    /// Sorted coordinates of the centres.
    axes: [Vec<f64>; 3],
    /// Of each degree.
    transforms: Vec<Transform>,
}

impl<'a> Planner<'a> {
    pub fn new(gaussians: &'a HostGaussians, importance: &'a Importance, classes: &'a Classes, choices: Choices) -> Self {
        let finite: Vec<f64> = gaussians.log_scales.iter().filter(|v| v.abs() < LOG_SCALE_LIMIT).map(|&v| f64::from(v)).collect();
        let middle: Vec<f64> = gaussians.log_scales.chunks_exact(3).map(|s| f64::from(s[0].min(s[1]).max(s[0].max(s[1]).min(s[2])))).collect();
        let squared: Vec<f64> = importance.weights.iter().map(|w| w * w).collect();
        let transform = |degree: usize| Transform::of(&coefficients(gaussians, degree), 3 * (2 * degree + 1), &squared, &choices);
        Self {
            gaussians,
            importance,
            classes,
            choices,
            scale_origin: (finite.iter().sum::<f64>() / finite.len().max(1) as f64) as f32,
            middle: median(&middle),
            axes: sorted_axes(&gaussians.means),
            transforms: (0..=gaussians.sh_degree).map(transform).collect(),
        }
    }
    /// Plans for other Gaussians of the same importance.
    pub fn of<'b>(&self, gaussians: &'b HostGaussians) -> Planner<'b>
    where
        'a: 'b,
    {
        Planner::new(gaussians, self.importance, self.classes, self.choices)
    }
    /// Plans the storage with the step `quality` / weight for colours.
    pub fn plan(&self, quality: f64, factors: &Factors, bounds: &Bounds) -> Plan {
        let (base, steps, largest) = (quality / self.classes.top, self.importance.steps, bounds.largest);
        let (largest_scale, largest_opacity) = (LARGEST_SCALE_STEP * largest[1], LARGEST_OPACITY_STEP * largest[3]);
        let positive = |v: f64| (v as f32).clamp(1e-18, 1e18);
        let mut geometry = Geometry {
            scale_origin: self.scale_origin,
            scale_step: positive((base * steps.log_scales * factors[1]).min(largest_scale)),
            rotation_step: positive(base * steps.quaternions * factors[2] * largest[2]),
            opacity_step: positive((base * steps.opacity_logits * factors[3]).min(largest_opacity)),
            corner: [0.0; 3],
            cell: 1.0,
            size_floor: 0,
            class_limit: 0,
            scale_limit: 0,
            opacity_limit: 0,
        };
        let limit = |step: f32, largest: f64| libm::log2(largest / f64::from(step)).clamp(0.0, 15.0) as u8;
        geometry.scale_limit = limit(geometry.scale_step, largest_scale);
        geometry.opacity_limit = limit(geometry.opacity_step, largest_opacity);
        let means = (base * steps.means * factors[0], LARGEST_STEP * largest[0]);
        grid(&mut geometry, &self.axes, self.middle, self.importance.pixels_per_unit, means);
        let degree = |(degree, transform): (usize, &Transform)| {
            let (relative, factor) = if degree == 0 { (1.0, factors[4] * largest[4]) } else { (steps.sh_rest[degree - 1], factors[5] * largest[5]) };
            Degree::plan(transform, positive(base * relative * factor))
        };
        Plan {
            degrees: self.transforms.iter().enumerate().map(degree).collect(),
            attributes: self.importance.attributes.iter().filter_map(|of| Coding::plan(self.gaussians, of, &geometry, quality)).collect(),
            geometry,
            rounds: largest.map(|factor| factor > 0.0),
            joint: bounds.joint,
            choices: self.choices,
        }
    }
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

/// The coordinates of centres `[N,3]`, sorted along each axis.
fn sorted_axes(means: &[f32]) -> [Vec<f64>; 3] {
    let mut axes: [Vec<f64>; 3] = std::array::from_fn(|k| means.iter().skip(k).step_by(3).map(|&v| f64::from(v)).collect());
    axes.iter_mut().for_each(|axis| axis.par_sort_unstable_by(f64::total_cmp));
    axes
}

/// Chooses the grid of the centres, whose sorted coordinates are `axes`: `relative` is the step of class 0 over the middle scale, `largest` that of the coarsest
/// class; the logarithm of the middle scale has the median `middle`. A grid of so many cells may be too small for them; then some are left out, or cells are larger than wanted, and steps of larger Gaussians and
/// coarser classes are doubled less often.
fn grid(geometry: &mut Geometry, axes: &[Vec<f64>; 3], middle: f64, pixels_per_unit: f64, (relative, largest): (f64, f64)) {
    let relative = relative.min(0.5).min(largest).max(1e-9);
    // Below half a pixel all Gaussians look alike.
    let pixel = if pixels_per_unit > 0.0 { libm::log(0.5 / pixels_per_unit) } else { -60.0 };
    let floor = pixel.max(middle - 6.0).clamp(-60.0, 60.0);
    let (cell, cells) = ((relative * libm::exp(floor)).max(1e-30), f64::from(1u32 << GRID_BITS));
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
        geometry.class_limit = (libm::log2(largest / relative) - octaves).clamp(0.0, 15.0) as u8;
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
    use super::*;

    /// The grid of Gaussians on the x axis, all with a standard deviation of 1, where a pixel is a hundredth.
    fn grid_of(x: impl Iterator<Item = f32>) -> Geometry {
        let means: Vec<f32> = x.flat_map(|x| [x, 0.0, 0.0]).collect();
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
        grid(&mut geometry, &sorted_axes(&means), 0.0, 100.0, (0.1, LARGEST_STEP));
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
