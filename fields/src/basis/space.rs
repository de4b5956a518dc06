//! Features of space, from which coefficients are computed: by decoders, or from tables.

use super::layer::{FLOATS_OF_GAUSSIAN, FLOATS_OF_VERTEX};
use crate::settings::{Capacity, take};
use crate::tables::TableSettings;
use crate::voxels::{VoxelSettings, features};
use cc4dgs_format::Result;
use cc4dgs_format::playback::MotionSource;

/// The kinds of features of space: one plug-in each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SpaceKind {
    /// Computed by decoders from hash signatures of vertices: `cdf-basis`.
    Computed,
    /// Stored in a multi-resolution hash grid: `hash-basis`.
    Stored,
}

impl SpaceKind {
    /// The name of the plug-in.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Computed => "cdf-basis",
            Self::Stored => "hash-basis",
        }
    }
    /// The keys of its settings in a `[deformer]` section.
    pub fn keys(self) -> &'static [&'static str] {
        match self {
            Self::Computed => &VoxelSettings::KEYS,
            Self::Stored => &TableSettings::KEYS,
        }
    }
    /// Moves its settings out of `section`.
    ///
    /// # Errors
    /// [`cc4dgs_format::Error::Parameter`] for values of wrong types.
    pub fn take(self, section: &mut toml::Table) -> Result<Space> {
        Ok(match self {
            Self::Computed => Space::Computed(take(section, self.keys())?),
            Self::Stored => Space::Stored(take(section, self.keys())?),
        })
    }
}

/// The settings of the features of space.
#[derive(Clone, Debug)]
pub enum Space {
    /// See [`SpaceKind::Computed`].
    Computed(VoxelSettings),
    /// See [`SpaceKind::Stored`].
    Stored(TableSettings),
}

impl Space {
    /// Features per centre.
    ///
    /// # Errors
    /// [`cc4dgs_format::Error::Parameter`] for sizes out of range.
    pub fn width(&self) -> Result<usize> {
        Ok(match self {
            Self::Computed(settings) => settings.sizes()?.width(),
            Self::Stored(settings) => settings.shape()?.width(),
        })
    }
    /// The number of weights.
    ///
    /// # Errors
    /// As [`Space::width`].
    pub fn parameter_count(&self) -> Result<usize> {
        Ok(match self {
            Self::Computed(settings) => settings.sizes()?.parameter_count(),
            Self::Stored(settings) => settings.shape()?.parameter_count(),
        })
    }
    /// Width and hidden layers of the coefficient network where settings state none. Stored features are weights themselves, so that one narrow layer is
    /// enough.
    pub(super) fn network(&self) -> (usize, usize) {
        match self {
            Self::Computed(settings) => (settings.capacity.width(), 2),
            Self::Stored(_) => (Capacity::Small.width(), 1),
        }
    }
    /// The features `[M, width]` of the centres of `source`.
    ///
    /// # Errors
    /// As [`Space::width`], and for weights that are missing.
    pub(super) fn features(&self, source: &MotionSource) -> Result<Vec<f32>> {
        let means = &source.gaussians.means;
        match self {
            Self::Computed(settings) => {
                let decoder = settings.sizes()?.decoder.parameter_count();
                features(settings, source.context, means, |level| source.weights(&format!("grid.level{level}"), decoder))
            }
            Self::Stored(settings) => settings.features(source.context, means, source.weights("grid.table", self.parameter_count()?)?),
        }
    }
    /// Floats of memory, and multiplications, that the features of `m` centres take beside the weights.
    pub(super) fn work(&self, m: u64) -> Result<(u64, u64)> {
        let floats = m.saturating_mul(self.width()? as u64 + FLOATS_OF_GAUSSIAN);
        Ok(match self {
            Self::Computed(settings) => {
                let sizes = settings.sizes()?;
                let vertices = |resolution: &u32| (u64::from(*resolution) + 1).pow(3).min(8 * m);
                let vertices: u64 = sizes.resolutions.iter().map(vertices).sum();
                let of_vertices = vertices.saturating_mul(sizes.decoder.output as u64 + FLOATS_OF_VERTEX);
                (floats.saturating_add(of_vertices), vertices.saturating_mul(sizes.decoder.parameter_count() as u64))
            }
            Self::Stored(_) => (floats, m.saturating_mul(8 * self.width()? as u64)),
        })
    }
}
