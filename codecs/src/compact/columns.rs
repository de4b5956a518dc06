//! Borrowed columns of Gaussians: an encoder changes few of them, and copies of the others would take most of its memory.

use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::storage::Shape;
use cc4dgs_format::{ExtraAttribute, HostGaussians};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// The columns of [`HostGaussians`], borrowed; they may belong to different values.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    pub sh_degree: usize,
    pub means: &'a [f32],
    pub log_scales: &'a [f32],
    pub quaternions: &'a [f32],
    pub opacity_logits: &'a [f32],
    pub sh_dc: &'a [f32],
    pub sh_rest: &'a [f32],
    pub dynamic_scores: &'a [f32],
    pub extra: &'a BTreeMap<String, ExtraAttribute>,
}

impl<'a> From<&'a HostGaussians> for Columns<'a> {
    fn from(of: &'a HostGaussians) -> Self {
        Self {
            sh_degree: of.sh_degree,
            means: &of.means,
            log_scales: &of.log_scales,
            quaternions: &of.quaternions,
            opacity_logits: &of.opacity_logits,
            sh_dc: &of.sh_dc,
            sh_rest: &of.sh_rest,
            dynamic_scores: &of.dynamic_scores,
            extra: &of.extra,
        }
    }
}

impl<'a> Columns<'a> {
    pub fn len(self) -> usize {
        self.opacity_logits.len()
    }
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }
    pub fn shape(self) -> Shape {
        Shape { count: self.len(), sh_degree: self.sh_degree, extra: self.extra.iter().map(|(name, a)| (name.clone(), a.width)).collect() }
    }
    /// The coefficients of one degree, all channels: 3 (2 degree + 1) per row.
    pub fn coefficients(self, degree: usize) -> Rows<'a> {
        if degree == 0 {
            return Rows::of(self.sh_dc, 3);
        }
        Rows { column: self.sh_rest, width: 3 * sh_rest_len(self.sh_degree), first: 3 * sh_rest_len(degree - 1), dims: 3 * (2 * degree + 1) }
    }
    /// Means, log-scales, quaternions, opacity logits, then the coefficients of each degree.
    pub fn all_rows(self) -> impl Iterator<Item = Rows<'a>> {
        let shapes = [(self.means, 3), (self.log_scales, 3), (self.quaternions, 4), (self.opacity_logits, 1)];
        shapes.into_iter().map(|(values, width)| Rows::of(values, width)).chain((0..=self.sh_degree).map(move |degree| self.coefficients(degree)))
    }
    /// A copy as `HostGaussians`.
    pub fn to_host(self) -> HostGaussians {
        HostGaussians {
            sh_degree: self.sh_degree,
            means: self.means.to_vec(),
            log_scales: self.log_scales.to_vec(),
            quaternions: self.quaternions.to_vec(),
            opacity_logits: self.opacity_logits.to_vec(),
            sh_dc: self.sh_dc.to_vec(),
            sh_rest: self.sh_rest.to_vec(),
            dynamic_scores: self.dynamic_scores.to_vec(),
            extra: self.extra.clone(),
        }
    }
}

/// Rows of values that may lie in wider rows of a column.
#[derive(Clone, Copy)]
pub struct Rows<'a> {
    column: &'a [f32],
    /// Distance from one row of the column to the next, and offset of the values within it.
    width: usize,
    first: usize,
    /// Values of a row.
    pub dims: usize,
}

impl<'a> Rows<'a> {
    /// The rows `[N,dims]` of `values`.
    pub fn of(values: &'a [f32], dims: usize) -> Self {
        Self { column: values, width: dims, first: 0, dims }
    }
    pub fn count(self) -> usize {
        self.column.len() / self.width
    }
    #[inline]
    pub fn row(self, index: usize) -> &'a [f32] {
        let start = index * self.width + self.first;
        &self.column[start..start + self.dims]
    }
    pub fn iter(self) -> impl Iterator<Item = &'a [f32]> {
        (0..self.count()).map(move |index| self.row(index))
    }
}

/// The rows `[N,width]` of `values` in another order.
pub fn sorted<T: Copy + Default + Send + Sync>(values: Vec<T>, width: usize, order: &[usize]) -> Vec<T> {
    let mut out = vec![T::default(); order.len() * width];
    out.par_chunks_exact_mut(width).zip(order).for_each(|(row, &i)| row.copy_from_slice(&values[i * width..(i + 1) * width]));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degrees_lie_side_by_side() {
        let mut g = HostGaussians { sh_degree: 2, opacity_logits: vec![0.0; 2], ..Default::default() };
        g.columns_mut().into_iter().for_each(|(_, width, values)| *values = (0..2 * width).map(|k| k as f32).collect());
        let columns = Columns::from(&g);
        assert_eq!(columns.to_host(), g);
        for (degree, first, dims) in [(1, 0, 9), (2, 9, 15)] {
            let rows = columns.coefficients(degree);
            assert_eq!((rows.count(), rows.row(1)), (2, &g.sh_rest[24 + first..24 + first + dims]));
            assert_eq!(rows.iter().collect::<Vec<_>>().concat(), [rows.row(0), rows.row(1)].concat());
        }
        assert_eq!(columns.all_rows().map(|rows| rows.dims).collect::<Vec<_>>(), [3, 3, 4, 1, 3, 9, 15]);
        assert_eq!(sorted(vec![1, 2, 3, 4], 2, &[1, 0]), [3, 4, 1, 2]);
    }
}
