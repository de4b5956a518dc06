//! The features of space of a [`super::Basis`] and their weights, which come first among its parameters.

use crate::parts::tables::Tables;
use crate::parts::voxels::Voxels;
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{DeformerContext, DeformerWork, Parameter, Result};
use cc4dgs_fields::basis::Space;

/// Where the features come from.
pub(super) enum SpaceFeatures {
    /// Decoders of hash signatures, one parameter per level.
    Computed(Voxels),
    /// A hash grid, one parameter.
    Stored(Tables),
}

impl SpaceFeatures {
    /// The features that `settings` describe, and their initial weights in optimizer group `group`.
    pub fn new(settings: &Space, context: &DeformerContext, group: usize, device: &Device) -> Result<(Self, Vec<Parameter>)> {
        Ok(match settings {
            Space::Computed(settings) => {
                let (voxels, parameters) = Voxels::new(settings, context, group, device)?;
                (Self::Computed(voxels), parameters)
            }
            Space::Stored(settings) => {
                let (tables, table) = Tables::new(settings, context, group, device)?;
                (Self::Stored(tables), vec![table])
            }
        })
    }
    /// The number of parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Computed(voxels) => voxels.levels(),
            Self::Stored(_) => 1,
        }
    }
    /// Features `[M, width]` of `means_world` `[M,3]` (M > 0) by the first of `parameters`, and the work done.
    pub fn features(&self, parameters: &[Parameter], means_world: Tensor<2>) -> Result<(Tensor<2>, DeformerWork)> {
        match self {
            Self::Computed(voxels) => voxels.features(parameters, means_world),
            Self::Stored(tables) => tables.features(&parameters[0], means_world),
        }
    }
}
