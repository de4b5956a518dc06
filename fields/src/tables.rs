//! Features of centres from stored tables: a multi-resolution hash grid over the box of what moves (Müller et al. 2022).

use crate::lookup::{GridShape, Outside, features as look_up};
use crate::settings::{bounded, within};
use cc4dgs_format::{DeformerContext, Result};
use serde::Deserialize;

/// Settings of the tables.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TableSettings {
    /// Grid levels.
    pub levels: usize,
    /// Vertices per axis of the first level; each level doubles them.
    pub base: u32,
    /// Features per level.
    pub features: usize,
    /// Binary logarithm of the most rows of a level.
    pub log2_rows: u32,
    /// Factor on the learning rates of the tables, in training.
    pub grid_rate: f64,
}

impl Default for TableSettings {
    fn default() -> Self {
        Self { levels: 6, base: 16, features: 4, log2_rows: 15, grid_rate: 10.0 }
    }
}

impl TableSettings {
    /// The keys of these settings in a `[deformer]` section.
    pub const KEYS: [&'static str; 5] = ["levels", "base", "features", "log2_rows", "grid_rate"];

    /// The grid.
    ///
    /// # Errors
    /// [`cc4dgs_format::Error::Parameter`] for sizes out of range.
    pub fn shape(&self) -> Result<GridShape> {
        within("levels", self.levels, 1, 16)?;
        within("base", self.base as usize, 2, 256)?;
        within("features", self.features, 1, 64)?;
        within("log2_rows", self.log2_rows as usize, 4, 24)?;
        let mut shape = GridShape { dims: 3, features: self.features, levels: Vec::new(), stagger: 0.0, smooth: false, clamps: true, outside: Outside::Clamp };
        for level in 0..self.levels {
            let vertices = self.base << level;
            shape.push(&[vertices; 3], &[vertices as f32 - 1.0; 3], 1 << self.log2_rows);
        }
        bounded([shape.parameter_count()])?;
        Ok(shape)
    }
    /// The features `[M, width]` of `means` `[M,3]` from the weights `table`, over the box of `context`. Centres outside have those of its nearest face.
    ///
    /// # Errors
    /// As [`TableSettings::shape`].
    pub fn features(&self, context: &DeformerContext, means: &[f32], table: &[f32]) -> Result<Vec<f32>> {
        let extents = context.box_max.iter().zip(&context.box_min).map(|(high, low)| if high > low { 1.0 / (high - low) } else { 0.0 });
        let inverse: Vec<f32> = extents.collect();
        let points: Vec<f32> = means.iter().enumerate().map(|(i, v)| (v - context.box_min[i % 3]) * inverse[i % 3]).collect();
        Ok(look_up(&self.shape()?, table, &points))
    }
}
