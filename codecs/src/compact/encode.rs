//! From Gaussians to integers: classes, canonical rotations, codes, and rows that are stored exactly.

use super::attributes::Coded;
use super::colors::{Choices, Codes, missing};
use super::columns::Columns;
use super::geometry::{Geometry, Rotation, code_of, companded};
use super::joint::Directions;
use super::plan::Plan;
use super::write::APART;
use rayon::prelude::*;

/// The coarsest class.
const COARSEST_CLASS: u8 = 12;
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
    /// Of each degree.
    pub colors: Vec<Codes>,
    /// Attributes of plug-ins that are coded; others are stored as they may be.
    pub attributes: Vec<Coded<'a>>,
    /// Rows of means, log-scales, quaternions and opacity logits whose values are stored as float32; those of colours are [`Codes::missing`].
    pub exact: [Vec<usize>; 4],
}

impl Integers<'_> {
    /// Rows whose values are stored as float32, by column: means, log-scales, quaternions, opacity logits, then degrees.
    pub fn exact_rows(&self) -> impl Iterator<Item = &[usize]> {
        self.exact.iter().chain(self.colors.iter().map(|codes| &codes.missing)).map(Vec::as_slice)
    }
    /// What does not borrow the plan.
    pub fn into_parts(self) -> Parts {
        let Self { scales, rotations, opacities, keys, colors, exact, .. } = self;
        Parts { scales, rotations, opacities, keys, colors, exact }
    }
}

/// The integers of a plan, which another of the same planner may take over.
#[derive(Default)]
pub struct Parts {
    scales: Vec<[i32; 3]>,
    rotations: Vec<Rotation>,
    opacities: Vec<i32>,
    keys: Vec<u64>,
    /// Of each degree.
    pub colors: Vec<Codes>,
    exact: [Vec<usize>; 4],
}

/// Brings log-scales `[N,3]` and quaternions `[N,4]` into canonical form where they are `free`: nothing is added to them, so the order of the axes and the sign
/// and norm of the quaternion can be chosen.
pub fn make_canonical(log_scales: &mut [f32], quaternions: &mut [f32], free: &[bool]) {
    let rows = quaternions.par_chunks_exact_mut(4).zip(log_scales.par_chunks_exact_mut(3)).zip(free);
    rows.filter(|(_, free)| **free).for_each(|((q, s), _)| canonical_row(q, s));
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
    let apart = |(&shape, &color): (&u8, &u8)| shape.clamp(color.saturating_sub(APART), color + APART).min(COARSEST_CLASS);
    let shapes = octaves(shapes, Some(top), adaptive).0.iter().zip(&colors).map(apart).collect();
    Classes { colors, shapes, top }
}

/// Octaves of each weight below the top one.
fn octaves(weights: &[f64], top: Option<f64>, adaptive: bool) -> (Vec<u8>, f64) {
    let mut sorted: Vec<f64> = weights.iter().copied().filter(|w| *w > 0.0 && w.is_finite()).collect();
    sorted.par_sort_unstable_by(f64::total_cmp);
    if sorted.is_empty() {
        return (vec![0; weights.len()], 1.0);
    }
    if !adaptive {
        // One step for all Gaussians, with the same total error as individual steps.
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
    let coarsest = f64::from(COARSEST_CLASS);
    let class = |w: &f64| if *w > 0.0 { libm::log2(top / w).round().clamp(0.0, coarsest) as u8 } else { COARSEST_CLASS };
    (weights.iter().map(class).collect(), top)
}

impl Plan {
    /// Whether the coefficients of a degree are rounded; else they are stored exactly.
    fn rounds_degree(&self, degree: usize) -> bool {
        self.rounds[if degree == 0 { 4 } else { 5 }]
    }
    fn choices_of(&self, degree: usize) -> Choices {
        Choices { rate_weight: if degree == 0 { 0.0 } else { self.choices.rate_weight }, ..self.choices }
    }
    /// Whether `other`, of the same planner, gives the coefficients of a degree the same codes where degrees are rounded independently.
    fn rounds_alike(&self, other: &Self, degree: usize) -> bool {
        self.degrees.get(degree) == other.degrees.get(degree) && self.rounds_degree(degree) == other.rounds_degree(degree)
    }
    /// `directions` if colours are rounded together, else `None`.
    fn together<'a>(&self, directions: Option<&'a Directions>) -> Option<&'a Directions> {
        directions.filter(|_| self.joint)
    }
    /// Whether the coefficients of each degree have the codes that they have with `before`, a plan of the same planner, and so lose as much.
    pub fn keeps_colors(&self, before: &Self, directions: Option<&Directions>) -> Vec<bool> {
        let together = self.together(directions).is_some();
        let mut keeps: Vec<bool> = (0..self.degrees.len()).map(|degree| self.rounds_alike(before, degree)).collect();
        // Rounded together, a degree compensates for the errors of higher degrees.
        if before.together(directions).is_some() != together || together && keeps.contains(&false) {
            keeps.fill(false);
        }
        keeps
    }
    /// The codes of the colours of canonical Gaussians, by degree. With `directions`, colours are rounded together if they may be. `before` are the codes of
    /// the same Gaussians with another plan of the same planner: they are taken for degrees that are rounded alike.
    pub fn color_codes(&self, gaussians: Columns, classes: &Classes, directions: Option<&Directions>, before: Option<(&Self, Vec<Codes>)>) -> Vec<Codes> {
        let mut known: Vec<Option<Codes>> = self.degrees.iter().map(|_| None).collect();
        if let Some((plan, codes)) = before {
            known = codes.into_iter().zip(self.keeps_colors(plan, directions)).map(|(codes, keeps)| Some(codes).filter(|_| keeps)).collect();
        }
        let exact = |dims: usize| Codes::none(gaussians.len(), dims);
        if let Some(directions) = self.together(directions).filter(|_| known.iter().any(Option::is_none)) {
            drop(known);
            let rounds: Vec<bool> = (0..self.degrees.len()).map(|degree| self.rounds_degree(degree)).collect();
            let choices: Vec<Choices> = (0..self.degrees.len()).map(|degree| self.choices_of(degree)).collect();
            let found = directions.quantise(&self.degrees, gaussians, &classes.colors, &rounds, &choices);
            return found.into_iter().zip(&self.degrees).zip(rounds).map(|((codes, plan), rounds)| if rounds { codes } else { exact(plan.dims) }).collect();
        }
        let alone = |degree: usize| {
            let plan = &self.degrees[degree];
            if !self.rounds_degree(degree) {
                return exact(plan.dims);
            }
            plan.quantise(gaussians.coefficients(degree), &classes.colors, &self.choices_of(degree))
        };
        known.into_iter().enumerate().map(|(degree, known)| known.unwrap_or_else(|| alone(degree))).collect()
    }
    /// Whether means, log-scales, quaternions and opacity logits have the integers that they have with `before`, a plan of the same planner, and so lose as
    /// much.
    pub fn keeps_shapes(&self, before: &Self) -> [bool; 4] {
        let rounds = |column: usize| self.rounds[column] == before.rounds[column];
        let (own, other) = (&self.geometry, &before.geometry);
        let scales = rounds(1) && (own.scale_origin, own.scale_step, own.scale_limit) == (other.scale_origin, other.scale_step, other.scale_limit);
        let grid = |of: &Geometry| (of.corner, of.cell, of.size_floor, of.class_limit);
        // Steps of centres and rotations follow from the codes of scales.
        let means = scales && rounds(0) && grid(own) == grid(other);
        let quaternions = scales && rounds(2) && own.rotation_step == other.rotation_step;
        let opacities = rounds(3) && (own.opacity_step, own.opacity_limit) == (other.opacity_step, other.opacity_limit);
        [means, scales, quaternions, opacities]
    }
    /// The integers of canonical Gaussians, whose number is that of the planned ones and whose `colors` have been rounded.
    pub fn quantise<'a>(&'a self, gaussians: Columns, free: &[bool], classes: &'a Classes, colors: Vec<Codes>) -> Integers<'a> {
        self.quantise_after(gaussians, free, classes, colors, None)
    }
    /// As [`Plan::quantise`], given the integers of another plan of the same planner: those that it keeps ([`Plan::keeps_shapes`]) are not rounded again.
    pub fn quantise_after<'a>(
        &'a self,
        gaussians: Columns,
        free: &[bool],
        classes: &'a Classes,
        colors: Vec<Codes>,
        before: Option<(Self, Parts)>,
    ) -> Integers<'a> {
        let (geometry, shapes, n) = (&self.geometry, &classes.shapes, gaussians.len());
        let (keeps, known) = before.map_or_else(Default::default, |(plan, parts)| (self.keeps_shapes(&plan), parts));
        let [known_means, known_scales, known_rotations, known_opacities] = known.exact;
        let (scales, exact_scales) = or_each(keeps[1].then_some((known.scales, known_scales)), n, |i| {
            let (values, step) = (&gaussians.log_scales[3 * i..3 * i + 3], geometry.scale_step_of(shapes[i]));
            let found: [Option<i32>; 3] = std::array::from_fn(|k| code_of((f64::from(values[k]) - f64::from(geometry.scale_origin)) / step));
            match found {
                [Some(a), Some(b), Some(c)] if self.rounds[1] && values.iter().all(|v| v.abs() < LOG_SCALE_LIMIT) => Some([a, b, c]),
                _ => None,
            }
        });
        let (keys, exact_means) = or_each(keeps[0].then_some((known.keys, known_means)), n, |i| {
            let mean = &gaussians.means[3 * i..3 * i + 3];
            geometry.key(mean, geometry.position_shift(scales[i], shapes[i])).filter(|_| self.rounds[0])
        });
        let (rotations, exact_rotations) = or_each(keeps[2].then_some((known.rotations, known_rotations)), n, |i| {
            let q = &gaussians.quaternions[4 * i..4 * i + 4];
            let norm = q.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
            let step = geometry.rotation_step_of(geometry.rotation_shift(scales[i], shapes[i]));
            Some(norm).filter(|norm| self.rounds[2] && NORMS.contains(norm)).and_then(|norm| Rotation::of(q, norm, step, free[i]))
        });
        let (opacities, exact_opacities) = or_each(keeps[3].then_some((known.opacities, known_opacities)), n, |i| {
            let logit = gaussians.opacity_logits[i];
            code_of(companded(logit) / geometry.opacity_step_of(shapes[i])).filter(|_| self.rounds[3] && logit.abs() < LOGIT_LIMIT)
        });
        let attributes = self.attributes.iter().filter_map(|(coding, rows)| Coded::new(coding, rows, gaussians, geometry, &scales, shapes)).collect();
        let exact = [exact_means, exact_scales, exact_rotations, exact_opacities];
        Integers { plan: self, classes, scales, rotations, opacities, keys, colors, attributes, exact }
    }
}

/// The codes of `n` rows, and the rows that have none: those that are `known`, or what `code` says of each row.
fn or_each<T: Default + Send>(known: Option<(Vec<T>, Vec<usize>)>, n: usize, code: impl Fn(usize) -> Option<T> + Send + Sync) -> (Vec<T>, Vec<usize>) {
    if let Some(known) = known {
        return known;
    }
    let (mut codes, mut coded) = (Vec::new(), Vec::new());
    let row = |i: usize| code(i).map_or_else(|| (T::default(), false), |code| (code, true));
    (0..n).into_par_iter().map(row).unzip_into_vecs(&mut codes, &mut coded);
    (codes, missing(&coded))
}

#[cfg(test)]
mod tests {
    use super::super::plan::{Bounds, Planner};
    use super::super::{importance, random_gaussians};
    use super::*;
    use cc4dgs_format::{CodecContext, Limits, Seed, Silent};

    #[test]
    fn codes_are_kept_where_a_plan_rounds_colours_as_the_one_before() {
        let g = random_gaussians(80, 2);
        let columns = Columns::from(&g);
        let importance = importance::estimate(&g, &CodecContext::new(Seed::root(1), Limits::default(), &Silent));
        let classes = classify(&importance.weights, &importance.shapes, true);
        let planner = Planner::new(columns, &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
        let directions = Directions::new(80, 2).factored();
        let plan = |largest: [f64; 6], joint: bool| planner.plan(0.02, &[1.0; 6], &Bounds { largest, joint });
        let (all, centres, harmonics) = ([1.0; 6], [0.5, 1.0, 1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0, 1.0, 0.5]);
        let kept = |directions: Option<&Directions>, largest: [f64; 6], joint: bool| -> Vec<bool> {
            let before = plan(all, true);
            let mut codes = before.color_codes(columns, &classes, directions, None);
            // Marks the known codes, so that kept ones differ from those that are rounded again.
            codes.iter_mut().for_each(|codes| codes.values[0] += 1000);
            let wanted: Vec<i32> = codes.iter().map(|codes| codes.values[0]).collect();
            let next = plan(largest, joint);
            let keeps = next.keeps_colors(&before, directions);
            let found = next.color_codes(columns, &classes, directions, Some((&before, codes)));
            let afresh = next.color_codes(columns, &classes, directions, None);
            let kept: Vec<bool> = found.iter().zip(wanted).map(|(found, wanted)| found.values[0] == wanted).collect();
            assert!(kept.iter().zip(found.iter().zip(&afresh)).all(|(kept, (found, afresh))| *kept || found == afresh));
            assert_eq!(keeps, kept);
            kept
        };
        assert_eq!(kept(None, centres, true), [true; 3]);
        assert_eq!(kept(None, harmonics, true), [true, false, false]);
        assert_eq!(kept(None, [0.0; 6], true), [false; 3], "stored exactly");
        // Together, each depends on those above it.
        assert_eq!(kept(Some(&directions), centres, true), [true; 3]);
        assert_eq!(kept(Some(&directions), harmonics, true), [false; 3]);
        assert_eq!(kept(Some(&directions), centres, false), [false; 3], "apart");
    }

    #[test]
    fn shapes_are_kept_where_a_plan_rounds_them_as_the_one_before() {
        let mut g = random_gaussians(80, 0);
        // Rows with values that no step can represent.
        (g.means[4], g.log_scales[7], g.opacity_logits[9]) = (f32::MAX, 80.0, 70.0);
        g.quaternions[..4].fill(100.0);
        let columns = Columns::from(&g);
        let mut importance = importance::estimate(&g, &CodecContext::new(Seed::root(1), Limits::default(), &Silent));
        // Some classes have the largest steps.
        importance.shapes.iter_mut().enumerate().filter(|(k, _)| k % 3 > 0).for_each(|(_, w)| *w *= 1e-2);
        let classes = classify(&importance.weights, &importance.shapes, true);
        let planner = Planner::new(columns, &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
        let plan = |largest: [f64; 6]| planner.plan(0.5, &[1.0; 6], &Bounds { largest, joint: false });
        let integers = |of: &Integers| {
            let rotations: Vec<([i32; 3], u8, i32)> = of.rotations.iter().map(|r| (r.codes, r.form, r.norm)).collect();
            (of.keys.clone(), of.scales.clone(), rotations, of.opacities.clone(), of.exact.clone())
        };
        let kept = |largest: [f64; 6]| -> [bool; 4] {
            let (before, next) = (plan([1.0; 6]), plan(largest));
            let mut parts = before.quantise(columns, &[false; 80], &classes, Vec::new()).into_parts();
            let keeps = next.keeps_shapes(&before);
            let found = next.quantise_after(columns, &[false; 80], &classes, Vec::new(), Some((plan([1.0; 6]), parts)));
            let afresh = next.quantise(columns, &[false; 80], &classes, Vec::new());
            assert!(integers(&found) == integers(&afresh), "{largest:?}");
            // Marks the known codes, so that kept ones differ from those that are rounded again.
            parts = found.into_parts();
            (parts.keys[0], parts.scales[0][0], parts.rotations[0].norm, parts.opacities[0]) = (u64::MAX, 1234, 1234, 1234);
            let found = next.quantise_after(columns, &[false; 80], &classes, Vec::new(), Some((before, parts)));
            let marks = [found.keys[0] == u64::MAX, found.scales[0][0] == 1234, found.rotations[0].norm == 1234, found.opacities[0] == 1234];
            assert_eq!(marks, keeps);
            keeps
        };
        assert_eq!(kept([1.0; 6]), [true; 4]);
        assert_eq!(kept([0.1, 1.0, 1.0, 1.0, 1.0, 1.0]), [false, true, true, true]);
        assert_eq!(kept([1.0, 0.1, 1.0, 1.0, 1.0, 1.0]), [false, false, false, true]);
        assert_eq!(kept([1.0, 1.0, 0.1, 0.0, 0.1, 0.1]), [true, true, false, false]);
    }
}
