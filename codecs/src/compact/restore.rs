//! What integers stand for: columns as they will be decoded, and what these lose. Rows that are stored exactly are those given.

use super::blocks::ROWS;
use super::columns::Columns;
use super::encode::Integers;
use cc4dgs_format::HostGaussians;
use cc4dgs_format::storage::{PartialLoss, column_loss, relative_rms};
use rayon::prelude::*;

/// What the integers of `given` stand for, in the same order.
pub fn restored(of: &Integers, given: Columns) -> HostGaussians {
    let mut sh_rest = vec![0.0; given.sh_rest.len()];
    of.rest(given.sh_rest, 0, &mut sh_rest);
    let mut extra = given.extra.clone();
    extra.extend(of.attributes.iter().map(|coded| (coded.coding.name.clone(), coded.restored())));
    HostGaussians {
        sh_degree: given.sh_degree,
        means: of.means(given.means),
        log_scales: of.log_scales(given.log_scales),
        quaternions: of.quaternions(given.quaternions),
        opacity_logits: of.opacity_logits(given.opacity_logits),
        sh_dc: of.sh_dc(given.sh_dc),
        sh_rest,
        dynamic_scores: given.dynamic_scores.to_vec(),
        extra,
    }
}

/// What means, log-scales, quaternions, opacity logits, degree 0 and higher degrees lose ([`column_loss`]). Each thread has one of them in memory, and of the
/// higher degrees a block of rows; `rest` is the loss of these before any is decoded.
pub fn losses(of: &Integers, given: Columns, rest: PartialLoss) -> Vec<f64> {
    let loss = |column: usize| match column {
        0 => column_loss("means", given.means, &of.means(given.means), 3),
        1 => relative_rms(given.log_scales, &of.log_scales(given.log_scales)),
        2 => relative_rms(given.quaternions, &of.quaternions(given.quaternions)),
        3 => relative_rms(given.opacity_logits, &of.opacity_logits(given.opacity_logits)),
        4 => relative_rms(given.sh_dc, &of.sh_dc(given.sh_dc)),
        _ => of.rest_loss(given.sh_rest, rest),
    };
    (0..6).into_par_iter().map(loss).collect()
}

/// A column `[N,width]` whose rows `restore` fills, except those that are stored `exact`, which are those of `given`.
fn column(given: &[f32], width: usize, exact: &[usize], restore: impl Fn(usize, &mut [f32]) + Sync) -> Vec<f32> {
    let mut out = vec![0.0; given.len()];
    out.par_chunks_exact_mut(width).enumerate().for_each(|(row, values)| restore(row, values));
    for row in exact {
        let values = row * width..(row + 1) * width;
        out[values.clone()].copy_from_slice(&given[values]);
    }
    out
}

impl Integers<'_> {
    fn means(&self, given: &[f32]) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let shift = |i: usize| geometry.position_shift(self.scales[i], shapes[i]);
        column(given, 3, &self.exact[0], |i, out| out.copy_from_slice(&geometry.centre(self.keys[i], shift(i))))
    }
    fn log_scales(&self, given: &[f32]) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let restore = |i: usize, out: &mut [f32]| out.iter_mut().zip(self.scales[i]).for_each(|(out, code)| *out = geometry.scale(code, shapes[i]));
        column(given, 3, &self.exact[1], restore)
    }
    fn quaternions(&self, given: &[f32]) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let step = |i: usize| geometry.rotation(geometry.rotation_shift(self.scales[i], shapes[i]));
        column(given, 4, &self.exact[2], |i, out| out.copy_from_slice(&self.rotations[i].quaternion(step(i))))
    }
    fn opacity_logits(&self, given: &[f32]) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        column(given, 1, &self.exact[3], |i, out| out.fill(geometry.opacity(self.opacities[i], shapes[i])))
    }
    fn sh_dc(&self, given: &[f32]) -> Vec<f32> {
        let (plan, codes) = (&self.plan.degrees[0], &self.colors[0]);
        let basis = plan.scaled_basis();
        let codes_of = |i: usize| &codes.values[i * plan.dims..(i + 1) * plan.dims];
        column(given, plan.dims, &codes.missing, |i, out| plan.restore(&basis, codes_of(i), self.classes.colors[i], out))
    }
    /// Fills `out` `[M,width]` with the higher degrees of the rows from `first` on; `given` are those of all rows.
    fn rest(&self, given: &[f32], first: usize, out: &mut [f32]) {
        let higher = || self.plan.degrees.iter().zip(&self.colors).skip(1);
        let width = higher().map(|(plan, _)| plan.dims).sum::<usize>();
        if out.is_empty() {
            return;
        }
        let bases: Vec<Vec<f32>> = higher().map(|(plan, _)| plan.scaled_basis()).collect();
        out.par_chunks_exact_mut(width).enumerate().for_each(|(k, values)| {
            let (row, mut at) = (first + k, 0);
            for ((plan, codes), basis) in higher().zip(&bases) {
                let codes = &codes.values[row * plan.dims..(row + 1) * plan.dims];
                plan.restore(basis, codes, self.classes.colors[row], &mut values[at..at + plan.dims]);
                at += plan.dims;
            }
        });
        let (end, mut at) = (first + out.len() / width, 0);
        for (plan, codes) in higher() {
            let from = codes.missing.partition_point(|row| *row < first);
            for row in codes.missing[from..].iter().take_while(|row| **row < end) {
                let (to, from) = ((row - first) * width + at, row * width + at);
                out[to..to + plan.dims].copy_from_slice(&given[from..from + plan.dims]);
            }
            at += plan.dims;
        }
    }
    /// The `loss` of the higher degrees, which are restored block by block.
    fn rest_loss(&self, given: &[f32], mut loss: PartialLoss) -> f64 {
        let size = ROWS * self.plan.degrees.iter().skip(1).map(|plan| plan.dims).sum::<usize>();
        let mut block = vec![0.0; size.min(given.len())];
        for (k, values) in given.chunks(size.max(1)).enumerate() {
            let restored = &mut block[..values.len()];
            self.rest(given, k * ROWS, restored);
            loss.add(values, restored);
        }
        loss.loss()
    }
}

#[cfg(test)]
mod tests {
    use super::super::encode::classify;
    use super::super::plan::{Bounds, Planner};
    use super::super::{Choices, importance};
    use super::*;
    use cc4dgs_format::{CodecContext, Limits, Seed, Silent};

    #[test]
    fn parts_and_losses_are_those_of_the_whole() {
        let draw = |k: usize, column: usize| (Seed::root(column as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
        let mut g = HostGaussians { sh_degree: 2, opacity_logits: vec![0.0; 300], ..Default::default() };
        for (column, (_, width, values)) in g.columns_mut().into_iter().enumerate() {
            *values = (0..300 * width).map(|k| draw(k, column)).collect();
        }
        let (columns, context) = (Columns::from(&g), CodecContext::new(Seed::root(1), Limits::default(), &Silent));
        let importance = importance::estimate(&g, &context);
        let classes = classify(&importance.weights, &importance.shapes, true);
        let planner = Planner::new(columns, &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
        let plan = planner.plan(0.5, &[1.0; 6], &Bounds::NONE);
        let mut of = plan.quantise(columns, &[false; 300], &classes, plan.color_codes(columns, &classes, None, None));
        // Rows of degree 2 that are stored exactly.
        of.colors[2].missing = vec![3, 200];
        let whole = restored(&of, columns);
        let of_degree = |g: &HostGaussians, row: usize| g.sh_rest[24 * row + 9..24 * (row + 1)].to_vec();
        assert_eq!([3, 4, 200].map(|row| of_degree(&whole, row) == of_degree(&g, row)), [true, false, true]);
        for (first, rows) in [(0, 300), (0, 4), (3, 1), (4, 196), (199, 2), (201, 99)] {
            let mut part = vec![0.0; 24 * rows];
            of.rest(&g.sh_rest, first, &mut part);
            assert!(part == whole.sh_rest[24 * first..24 * (first + rows)], "{rows} rows from {first} on");
        }
        let found = losses(&of, columns, planner.rest);
        for (((name, width, given), (_, _, decoded)), lost) in g.columns().into_iter().zip(whole.columns()).zip(&found) {
            assert!(*lost > 0.0 && lost.to_bits() == column_loss(name, given, decoded, width).to_bits(), "{name}: {lost}");
        }
        assert_eq!(found.len(), 6);
    }
}
