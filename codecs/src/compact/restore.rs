//! Columns as they will be decoded from integers, and their losses. Rows that are stored exactly are those of the given columns.

use super::blocks::ROWS;
use super::columns::{Columns, sorted};
use super::encode::Integers;
use cc4dgs_format::storage::{ColumnLoss, PartialLoss};
use cc4dgs_format::{ExtraAttribute, HostGaussians};
use rayon::prelude::*;

/// The row of the given columns at each index of the result; `None`: the same index.
type Order<'a> = Option<&'a [usize]>;

/// The Gaussians that the integers of `given` decode to, with the rows in this `order` `[N]`, or in that of `given`.
pub fn restored(of: &Integers, given: Columns, order: Option<&[usize]>) -> HostGaussians {
    let mut sh_rest = vec![0.0; given.sh_rest.len()];
    of.rest(given.sh_rest, |index| order.map_or(index, |order| order[index]), &mut sh_rest);
    let in_order = |attribute: &ExtraAttribute| order.map_or_else(|| attribute.clone(), |order| attribute.select(order));
    let extra = |(name, attribute): (&String, &ExtraAttribute)| {
        let coded = of.attributes.iter().find(|coded| coded.coding.name == *name);
        (name.clone(), coded.map_or_else(|| in_order(attribute), |coded| in_order(&coded.restored())))
    };
    HostGaussians {
        sh_degree: given.sh_degree,
        means: of.means(given.means, order),
        log_scales: of.log_scales(given.log_scales, order),
        quaternions: of.quaternions(given.quaternions, order),
        opacity_logits: of.opacity_logits(given.opacity_logits, order),
        sh_dc: of.sh_dc(given.sh_dc, order),
        sh_rest,
        dynamic_scores: order.map_or_else(|| given.dynamic_scores.to_vec(), |order| sorted(given.dynamic_scores.to_vec(), 1, order)),
        extra: given.extra.iter().map(extra).collect(),
    }
}

/// Losses of means, log-scales, quaternions, opacity logits, degree 0 and higher degrees ([`column_loss`](cc4dgs_format::storage::column_loss)). Each thread
/// has one of these columns in memory, and of the higher degrees a block of rows. Losses that are `known` are not computed again.
pub fn losses(of: &Integers, given: Columns, before: &Losses, known: [Option<f64>; 6]) -> Vec<f64> {
    let loss = |column: usize| {
        if let Some(loss) = known[column] {
            return loss;
        }
        let (values, decoded) = match column {
            0 => (given.means, of.means(given.means, None)),
            1 => (given.log_scales, of.log_scales(given.log_scales, None)),
            2 => (given.quaternions, of.quaternions(given.quaternions, None)),
            3 => (given.opacity_logits, of.opacity_logits(given.opacity_logits, None)),
            4 => (given.sh_dc, of.sh_dc(given.sh_dc, None)),
            _ => return of.rest_loss(given.sh_rest, before.rest),
        };
        before.columns[column].of(values, &decoded)
    };
    (0..6).into_par_iter().map(loss).collect()
}

/// The part of the [`losses`] of columns that does not depend on decoded values.
pub struct Losses {
    /// Means, log-scales, quaternions, opacity logits, degree 0.
    columns: [ColumnLoss; 5],
    rest: PartialLoss,
}

impl Losses {
    /// Of the columns `given`.
    pub fn new(given: Columns) -> Self {
        let columns = [
            ("means", given.means, 3),
            ("log_scales", given.log_scales, 3),
            ("quaternions", given.quaternions, 4),
            ("opacity_logits", given.opacity_logits, 1),
            ("sh_dc", given.sh_dc, 3),
        ];
        // The higher degrees take as long as all others.
        let (rest, columns) = rayon::join(|| PartialLoss::new(given.sh_rest), || columns.map(|(name, values, width)| ColumnLoss::new(name, values, width)));
        Self { columns, rest }
    }
}

/// A column `[N,width]` in this `order`, whose rows `restore` fills, except those that are stored `exact` (ascending), which are those of `given`.
fn column(given: &[f32], width: usize, exact: &[usize], order: Order, restore: impl Fn(usize, &mut [f32]) + Sync) -> Vec<f32> {
    let mut out = vec![0.0; given.len()];
    out.par_chunks_exact_mut(width).enumerate().for_each(|(index, values)| {
        let row = order.map_or(index, |order| order[index]);
        if exact.binary_search(&row).is_ok() {
            values.copy_from_slice(&given[row * width..(row + 1) * width]);
        } else {
            restore(row, values);
        }
    });
    out
}

impl Integers<'_> {
    fn means(&self, given: &[f32], order: Order) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let shift = |i: usize| geometry.position_shift(self.scales[i], shapes[i]);
        column(given, 3, &self.exact[0], order, |i, out| out.copy_from_slice(&geometry.centre(self.keys[i], shift(i))))
    }
    fn log_scales(&self, given: &[f32], order: Order) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let restore = |i: usize, out: &mut [f32]| out.iter_mut().zip(self.scales[i]).for_each(|(out, code)| *out = geometry.scale(code, shapes[i]));
        column(given, 3, &self.exact[1], order, restore)
    }
    fn quaternions(&self, given: &[f32], order: Order) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        let step = |i: usize| geometry.rotation_step_of(geometry.rotation_shift(self.scales[i], shapes[i]));
        column(given, 4, &self.exact[2], order, |i, out| out.copy_from_slice(&self.rotations[i].quaternion(step(i))))
    }
    fn opacity_logits(&self, given: &[f32], order: Order) -> Vec<f32> {
        let (geometry, shapes) = (&self.plan.geometry, &self.classes.shapes);
        column(given, 1, &self.exact[3], order, |i, out| out.fill(geometry.opacity(self.opacities[i], shapes[i])))
    }
    fn sh_dc(&self, given: &[f32], order: Order) -> Vec<f32> {
        let (plan, codes) = (&self.plan.degrees[0], &self.colors[0]);
        let basis = plan.scaled_basis();
        let codes_of = |i: usize| &codes.values[i * plan.dims..(i + 1) * plan.dims];
        column(given, plan.dims, &codes.missing, order, |i, out| plan.restore(&basis, codes_of(i), self.classes.colors[i], out))
    }
    /// Fills `out` `[M,width]` with the higher degrees: at each index those of the row that `row_at` names; `given` are those of all rows.
    fn rest(&self, given: &[f32], row_at: impl Fn(usize) -> usize + Sync, out: &mut [f32]) {
        let higher = || self.plan.degrees.iter().zip(&self.colors).skip(1);
        let width = higher().map(|(plan, _)| plan.dims).sum::<usize>();
        if out.is_empty() {
            return;
        }
        let bases: Vec<Vec<f32>> = higher().map(|(plan, _)| plan.scaled_basis()).collect();
        out.par_chunks_exact_mut(width).enumerate().for_each(|(index, values)| {
            let (row, mut at) = (row_at(index), 0);
            for ((plan, codes), basis) in higher().zip(&bases) {
                let values = &mut values[at..at + plan.dims];
                if codes.missing.binary_search(&row).is_ok() {
                    values.copy_from_slice(&given[row * width + at..row * width + at + plan.dims]);
                } else {
                    plan.restore(basis, &codes.values[row * plan.dims..(row + 1) * plan.dims], self.classes.colors[row], values);
                }
                at += plan.dims;
            }
        });
    }
    /// The `loss` of the higher degrees, which are restored block by block.
    fn rest_loss(&self, given: &[f32], loss: PartialLoss) -> f64 {
        self.loss_by_blocks(given, loss, ROWS)
    }
    /// The same with blocks of so many `rows`. A block is restored while that before it is added up, one value after the other.
    fn loss_by_blocks(&self, given: &[f32], mut loss: PartialLoss, rows: usize) -> f64 {
        let size = (rows * self.plan.degrees.iter().skip(1).map(|plan| plan.dims).sum::<usize>()).max(1);
        let restore = |k: usize, block: &mut Vec<f32>| {
            block.resize(size.min(given.len().saturating_sub(k * size)), 0.0);
            self.rest(given, |index| k * rows + index, block);
        };
        let (mut block, mut next) = (Vec::new(), Vec::new());
        restore(0, &mut block);
        for (k, values) in given.chunks(size).enumerate() {
            rayon::join(|| loss.add(values, &block), || restore(k + 1, &mut next));
            std::mem::swap(&mut block, &mut next);
        }
        loss.loss()
    }
}

#[cfg(test)]
mod tests {
    use super::super::encode::classify;
    use super::super::plan::{Bounds, Planner};
    use super::super::{Choices, importance, random_gaussians};
    use super::*;
    use cc4dgs_format::storage::column_loss;
    use cc4dgs_format::{CodecContext, Limits, Seed, Silent};

    #[test]
    fn parts_and_losses_are_those_of_the_whole() {
        let g = random_gaussians(300, 2);
        let (columns, context) = (Columns::from(&g), CodecContext::new(Seed::root(1), Limits::default(), &Silent));
        let importance = importance::estimate(&g, &context);
        let classes = classify(&importance.weights, &importance.shapes, true);
        let planner = Planner::new(columns, &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
        let plan = planner.plan(0.5, &[1.0; 6], &Bounds::NONE);
        let mut of = plan.quantise(columns, &[false; 300], &classes, plan.color_codes(columns, &classes, None, None));
        // Rows of degree 2 that are stored exactly.
        of.colors[2].missing = vec![3, 200];
        let whole = restored(&of, columns, None);
        let of_degree = |g: &HostGaussians, row: usize| g.sh_rest[24 * row + 9..24 * (row + 1)].to_vec();
        assert_eq!([3, 4, 200].map(|row| of_degree(&whole, row) == of_degree(&g, row)), [true, false, true]);
        for (first, rows) in [(0, 300), (0, 4), (3, 1), (4, 196), (199, 2), (201, 99)] {
            let mut part = vec![0.0; 24 * rows];
            of.rest(&g.sh_rest, |index| first + index, &mut part);
            assert!(part == whole.sh_rest[24 * first..24 * (first + rows)], "{rows} rows from {first} on");
        }
        let found = losses(&of, columns, &planner.losses, [None; 6]);
        for (((name, width, given), (_, _, decoded)), lost) in g.columns().into_iter().zip(whole.columns()).zip(&found) {
            assert!(*lost > 0.0 && lost.to_bits() == column_loss(name, given, decoded, width).to_bits(), "{name}: {lost}");
        }
        for rows in [1, 7, 299, 300, 301] {
            assert_eq!(of.loss_by_blocks(&g.sh_rest, planner.losses.rest, rows).to_bits(), found[5].to_bits(), "blocks of {rows}");
        }
        let known = [None, None, None, None, Some(0.25), Some(0.5)];
        assert_eq!(losses(&of, columns, &planner.losses, known), [&found[..4], &[0.25, 0.5][..]].concat());
        // Rows that are stored exactly are exact wherever they are.
        of.exact = [vec![7], vec![0, 8], vec![150], vec![299]];
        of.colors[0].missing = vec![11];
        let extra = [("velocity".to_string(), ExtraAttribute::exact(1, (0..300).map(|row| row as f32).collect()))].into();
        let columns = Columns { extra: &extra, ..columns };
        let (own, order) = (restored(&of, columns, None), (0..300).map(|index| index * 7 % 300).collect::<Vec<usize>>());
        assert!(own.means[21..24] == g.means[21..24] && own.sh_dc[33..36] == g.sh_dc[33..36] && own.means != whole.means);
        assert!(restored(&of, columns, Some(&order)) == own.select(&order));
    }
}
