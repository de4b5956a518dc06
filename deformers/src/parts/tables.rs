//! Features of canonical centres from stored tables (Müller et al. 2022).

use super::centres::{check_box, in_box};
use super::voxels::parameter;
use super::weights;
use burn::tensor::{Device, Tensor};
use cc4dgs_backends::ops::lookup::{GridShape, lookup};
use cc4dgs_core::{DeformerContext, DeformerWork, Parameter, Part, Result};
use cc4dgs_fields::tables::TableSettings;
use std::sync::Arc;

/// Initial entries are uniform in ± this.
const TABLE: f32 = 1e-4;

/// A multi-resolution hash grid over a scene's box. Its table is a [`Parameter`] of the deformer that owns the grid.
#[derive(Clone, Debug)]
pub struct Tables {
    context: DeformerContext,
    grid: Arc<GridShape>,
}

impl Tables {
    /// A grid for the scene of `context` and its initial table, in optimizer group `group`.
    ///
    /// # Errors
    /// [`cc4dgs_core::Error::Parameter`] for sizes out of range and a box that is not finite.
    pub fn new(settings: &TableSettings, context: &DeformerContext, group: usize, device: &Device) -> Result<(Self, Parameter)> {
        check_box(context)?;
        let grid = settings.shape()?;
        let table = weights::uniform(context.seed.child("table"), grid.parameter_count(), TABLE);
        let table = parameter("grid.table".into(), Part::Grid, group, table, device);
        Ok((Self { context: context.clone(), grid: Arc::new(grid) }, table))
    }
    /// Features `[M, width]` of `means_world` `[M,3]` (M > 0) from its table, and the work done.
    ///
    /// # Errors
    /// What [`lookup`] reports.
    pub fn features(&self, table: &Parameter, means_world: Tensor<2>) -> Result<(Tensor<2>, DeformerWork)> {
        let work = DeformerWork { gaussians: means_world.dims()[0] as u64, ..DeformerWork::default() };
        Ok((lookup(table.value.clone(), in_box(means_world, &self.context), &self.grid)?, work))
    }
}
