//! Features of centres without stored tables (CC-4DGS, Section IV-B): sizes of the grid and its decoders, and their evaluation.

use crate::forward::decode;
use crate::hash::LevelHash;
use crate::networks::MishShape;
use crate::settings::{Capacity, bounded, within};
use cc4dgs_format::{DeformerContext, Error, Result};
use rayon::prelude::*;
use serde::Deserialize;
use std::collections::BTreeMap;

/// Upper bound on the cells per axis; (cells + 1)^3 keys then fit in 32 bits.
pub const MAX_RESOLUTION: u32 = 1600;
/// Vertices that are decoded at a time.
const BLOCK: usize = 256;

/// Settings of the grid and its decoders.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VoxelSettings {
    /// Defaults of the sizes below.
    pub capacity: Capacity,
    /// Grid levels.
    pub levels: Option<usize>,
    /// Cells per axis of each level.
    pub resolutions: Option<Vec<u32>>,
    /// Widths of the decoders' hidden layers.
    pub hidden: Option<Vec<usize>>,
    /// Features per level.
    pub features: Option<usize>,
    /// Hash functions per vertex.
    pub hashes: usize,
    /// m of the hash functions.
    pub modulus: u32,
    /// Whether a vertex that several centres share is decoded once.
    pub vertex_reuse: bool,
}

impl Default for VoxelSettings {
    fn default() -> Self {
        Self { capacity: Capacity::Default, levels: None, resolutions: None, hidden: None, features: None, hashes: 128, modulus: 1_000_000, vertex_reuse: true }
    }
}

/// The sizes of grid and decoders.
#[derive(Clone, Debug, PartialEq)]
pub struct VoxelSizes {
    /// Cells per axis of each level.
    pub resolutions: Vec<u32>,
    /// The decoder of every level.
    pub decoder: MishShape,
}

impl VoxelSizes {
    /// Features per centre: those of all levels together.
    pub fn width(&self) -> usize {
        self.resolutions.len() * self.decoder.output
    }
    /// Weights of all decoders.
    pub fn parameter_count(&self) -> usize {
        self.resolutions.len().saturating_mul(self.decoder.parameter_count())
    }
}

impl VoxelSettings {
    /// The keys of these settings in a `[deformer]` section.
    pub const KEYS: [&'static str; 8] = ["capacity", "levels", "resolutions", "hidden", "features", "hashes", "modulus", "vertex_reuse"];

    /// Computes the sizes.
    ///
    /// # Errors
    /// [`Error::Parameter`] for sizes out of range.
    pub fn sizes(&self) -> Result<VoxelSizes> {
        let (levels, hidden, features) = match self.capacity {
            Capacity::Small => (4, vec![64, 64], 16),
            Capacity::Mid => (5, vec![96, 96], 32),
            Capacity::Default => (5, vec![128, 128], 32),
        };
        let levels = self.levels.or(self.resolutions.as_ref().map(Vec::len)).unwrap_or(levels);
        within("levels", levels, 1, 16)?;
        let doubling = || (0..levels).map(|l| 16u32.checked_shl(l as u32).unwrap_or(u32::MAX)).collect();
        let resolutions: Vec<u32> = self.resolutions.clone().unwrap_or_else(doubling);
        if resolutions.len() != levels {
            return Err(Error::parameter("deformer.resolutions", format!("{} entries for {levels} levels", resolutions.len()), "Give one per level"));
        }
        if let (None, Some(&finest)) = (&self.resolutions, resolutions.last())
            && finest > MAX_RESOLUTION
        {
            let problem = format!("{levels} levels that double from 16 cells per axis end at {finest}, over {MAX_RESOLUTION}");
            return Err(Error::parameter("deformer.levels", problem, "Give at most 7 levels, or the cells of each level as deformer.resolutions"));
        }
        for &r in &resolutions {
            within("resolutions", r as usize, 1, MAX_RESOLUTION as usize)?;
        }
        let hidden = self.hidden.clone().unwrap_or(hidden);
        within("hidden (layers)", hidden.len(), 0, 8)?;
        let features = self.features.unwrap_or(features);
        for (name, value) in hidden.iter().map(|&h| ("hidden", h)).chain([("features", features), ("hashes", self.hashes)]) {
            within(name, value, 1, 4096)?;
        }
        within("modulus", self.modulus as usize, 2, 1 << 24)?;
        let decoder = MishShape { input: self.hashes, hidden, output: features };
        bounded(resolutions.iter().map(|_| decoder.parameter_count()))?;
        Ok(VoxelSizes { resolutions, decoder })
    }
}

impl VoxelSettings {
    /// The hash functions of a level of the scene of `context`.
    pub fn hash(&self, context: &DeformerContext, level: usize) -> LevelHash {
        LevelHash::new(context.seed.child("level").index(level as u64).child("hash"), self.hashes, self.modulus)
    }
}

/// The features `[M, width]` of `means` `[M,3]` on the grid of `settings` over the box of `context`. `weights` gives the decoder of each level by its index.
///
/// # Errors
/// As [`VoxelSettings::sizes`], and what `weights` reports.
pub fn features<'w>(settings: &VoxelSettings, context: &DeformerContext, means: &[f32], weights: impl Fn(usize) -> Result<&'w [f32]>) -> Result<Vec<f32>> {
    let sizes = settings.sizes()?;
    let (width, own) = (sizes.width(), sizes.decoder.output);
    let mut out = vec![0.0; means.len() / 3 * width];
    for (level, &resolution) in sizes.resolutions.iter().enumerate() {
        let weights = weights(level)?;
        let hash = settings.hash(context, level);
        let cells: Vec<Cell> = means.as_chunks::<3>().0.iter().map(|mean| Cell::of(mean, context, resolution)).collect();
        let mut rows: BTreeMap<[u32; 3], usize> = cells.iter().flat_map(Cell::corners).map(|(vertex, _)| (vertex, 0)).collect();
        rows.values_mut().enumerate().for_each(|(row, at)| *at = row);
        let vertices: Vec<[u32; 3]> = rows.keys().copied().collect();
        let mut decoded = vec![0.0; vertices.len() * own];
        decoded.par_chunks_mut(BLOCK * own).zip(vertices.par_chunks(BLOCK)).for_each(|(decoded, vertices)| {
            let mut signatures = vec![0.0; vertices.len() * hash.len()];
            hash.signatures(vertices, &mut signatures);
            decoded.copy_from_slice(&decode(&sizes.decoder, weights, signatures));
        });
        out.par_chunks_exact_mut(width).zip(&cells).for_each(|(out, cell)| {
            let out = &mut out[level * own..(level + 1) * own];
            for (vertex, weight) in cell.corners() {
                let row = rows.get(&vertex).copied().unwrap_or(0);
                out.iter_mut().zip(&decoded[row * own..]).for_each(|(o, v)| *o += weight * v);
            }
        });
    }
    Ok(out)
}

/// Where a centre lies in a grid.
struct Cell {
    cell: [u32; 3],
    part: [f32; 3],
}

impl Cell {
    /// Points outside of the box are moved to its nearest face, what is no number to the lower one.
    fn of(mean: &[f32; 3], context: &DeformerContext, resolution: u32) -> Self {
        let at: [f32; 3] = std::array::from_fn(|d| {
            let (low, high) = (context.box_min[d], context.box_max[d]);
            let scale = if high > low { resolution as f32 / (high - low) } else { 0.0 };
            ((mean[d] - low) * scale).max(0.0).min(resolution as f32)
        });
        let cell = at.map(|at| (at as u32).min(resolution - 1));
        Self { cell, part: std::array::from_fn(|d| at[d] - cell[d] as f32) }
    }
    /// The eight corners with their trilinear weights.
    fn corners(&self) -> impl Iterator<Item = ([u32; 3], f32)> {
        (0..8u32).map(|corner| {
            let upper = |d: usize| corner >> d & 1;
            let weight = (0..3).map(|d| if upper(d) == 1 { self.part[d] } else { 1.0 - self.part[d] }).product();
            (std::array::from_fn(|d| self.cell[d] + upper(d)), weight)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_that_double_past_the_largest_grid_are_named() {
        let of = |levels: usize, resolutions: Option<Vec<u32>>| VoxelSettings { levels: Some(levels), resolutions, ..Default::default() }.sizes();
        assert_eq!(of(7, None).unwrap().resolutions.last(), Some(&1024));
        for levels in [8, 16] {
            let error = of(levels, None).unwrap_err().to_string();
            assert!(error.contains("deformer.levels") && error.contains("at most 7") && error.contains("resolutions"), "{error}");
        }
        assert!(of(8, Some(vec![8; 8])).is_ok());
    }
}
