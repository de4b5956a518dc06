//! Steps, the grid of the centres and transforms: everything that decides how values are rounded.

use super::attributes::Coding;
use super::colors::{Choices, Degree, Transform};
use super::columns::Columns;
use super::encode::{Classes, LOG_SCALE_LIMIT};
use super::geometry::{GRID_BITS, Geometry};
use super::importance::{Importance, median, middle_log_scale};
use super::restore::Losses;
use rayon::prelude::*;

/// Largest step of a centre, in middle scales, if no [`Bounds`] are set.
const LARGEST_STEP: f64 = 1.0;
/// Largest steps of log-scales and companded opacities.
const LARGEST_SCALE_STEP: f64 = 0.7;
const LARGEST_OPACITY_STEP: f64 = 1.0;
/// Shares of the centres at either end of an axis that may lie outside of the grid, where they are stored exactly, and how many times coarser a grid with fewer
/// outside may be.
const OUTSIDE: [(f64, f64); 4] = [(0.0, 1.0), (5e-4, 1.0), (5e-3, 2.0), (5e-2, 4.0)];

/// How the values of a model are rounded, in the steps of one quality.
pub struct Plan {
    pub geometry: Geometry,
    pub degrees: Vec<Degree>,
    /// Attributes of plug-ins, and the rows of each that are stored.
    pub attributes: Vec<(Coding, Vec<bool>)>,
    /// Whether means, log-scales, quaternions, opacity logits, degree 0 and higher degrees are rounded; else they are stored exactly.
    pub rounds: [bool; 6],
    /// Whether colours may be rounded together.
    pub joint: bool,
    pub choices: Choices,
}

/// Factors of the steps of the columns means, log-scales, quaternions, opacity logits, degree 0 and higher degrees.
pub type Factors = [f64; 6];

/// Changes to a plan that keep the declared loss.
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
    pub gaussians: Columns<'a>,
    pub importance: &'a Importance,
    pub classes: &'a Classes,
    choices: Choices,
    /// Mean log-scale.
    scale_origin: f32,
    /// Median of the middle log-scales.
    middle: f64,
    /// Sorted coordinates of the centres.
    axes: [Vec<f32>; 3],
    /// Of each degree.
    transforms: Vec<Transform>,
    /// The part of the columns' losses that does not depend on rounding.
    pub losses: Losses,
}

impl<'a> Planner<'a> {
    pub fn new(gaussians: Columns<'a>, importance: &'a Importance, classes: &'a Classes, choices: Choices) -> Self {
        let finite = || gaussians.log_scales.iter().filter(|v| v.abs() < LOG_SCALE_LIMIT).map(|&v| f64::from(v));
        let middles = gaussians.log_scales.chunks_exact(3).map(middle_log_scale);
        let middle = median(&middles.collect::<Vec<f64>>());
        let squared: Vec<f64> = importance.weights.iter().map(|w| w * w).collect();
        let transform = |degree: usize| Transform::of(gaussians.coefficients(degree), &squared, &choices);
        let (transforms, losses) = rayon::join(|| (0..=gaussians.sh_degree).into_par_iter().map(transform).collect(), || Losses::new(gaussians));
        Self {
            gaussians,
            importance,
            classes,
            choices,
            scale_origin: (finite().sum::<f64>() / finite().count().max(1) as f64) as f32,
            middle,
            axes: sorted_axes(gaussians.means),
            transforms,
            losses,
        }
    }
    /// Plans for other Gaussians of the same importance.
    pub fn of<'b>(&self, gaussians: Columns<'b>) -> Planner<'b>
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
        let scale_step = positive((base * steps.log_scales * factors[1]).min(largest_scale));
        let rotation_step = positive(base * steps.quaternions * factors[2] * largest[2]);
        let opacity_step = positive((base * steps.opacity_logits * factors[3]).min(largest_opacity));
        let mut geometry = Geometry::new(self.scale_origin, scale_step, rotation_step, opacity_step);
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

/// The coordinates of centres `[N,3]`, sorted along each axis.
fn sorted_axes(means: &[f32]) -> [Vec<f32>; 3] {
    let mut axes: [Vec<f32>; 3] = std::array::from_fn(|k| means.iter().skip(k).step_by(3).copied().collect());
    axes.iter_mut().for_each(|axis| axis.par_sort_unstable_by(f32::total_cmp));
    axes
}

/// Chooses the grid of the centres, whose sorted coordinates are `axes`: `relative` is the step of class 0 over the middle scale, `largest` that of the
/// coarsest class; the logarithm of the middle scale has the median `middle`. A grid of so many cells may be too small for them; then some are left out, or
/// cells are larger than wanted, and steps of larger Gaussians and coarser classes are doubled less often.
fn grid(geometry: &mut Geometry, axes: &[Vec<f32>; 3], middle: f64, pixels_per_unit: f64, (relative, largest): (f64, f64)) {
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
        // The grid is centred on the centres that are not cut off, and often holds some of those that are.
        geometry.corner = spans.map(|[low, high]| if cut > 0.0 { 0.5 * (low + high) - 0.5 * cells * geometry.cell } else { low });
        let octaves = libm::log2(growth);
        geometry.size_floor = ((floor / std::f64::consts::LN_2 + octaves) * 65536.0) as i64;
        geometry.class_limit = (libm::log2(largest / relative) - octaves).clamp(0.0, 15.0) as u8;
    }
}

/// Least and largest of sorted values without the share `cut` at either end.
fn span(sorted: &[f32], cut: f64) -> [f64; 2] {
    let last = sorted.len().saturating_sub(1);
    let skip = (cut * sorted.len() as f64).ceil() as usize;
    match sorted.get(skip.min(last)).zip(sorted.get(last.saturating_sub(skip))) {
        Some((&low, &high)) if low <= high => [f64::from(low), f64::from(high)],
        _ => [0.0; 2],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The grid of Gaussians on the x axis, all with a standard deviation of 1, where a pixel is a hundredth.
    fn grid_of(x: impl Iterator<Item = f32>) -> Geometry {
        let means: Vec<f32> = x.flat_map(|x| [x, 0.0, 0.0]).collect();
        let mut geometry = Geometry::new(0.0, std::f32::consts::LN_2, 1.0, 1.0);
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
