//! The field as a playback layer.

use super::{BasisPlan, Rotation, SpaceKind, TemporalFunctions, VERSION};
use crate::forward::network;
use crate::heads::Head;
use crate::networks::weights_of_chain;
use crate::settings::RATE_KEYS;
use cc4dgs_format::playback::Head as LayerHead;
use cc4dgs_format::playback::{ComputedMotion, MAX_FUNCTIONS, MAX_SAMPLES, MotionPlugin, MotionSource, Track, frame_time};
use cc4dgs_format::{DeformerContext, HostGaussians, Plugin, Result, inventory, toml};
use rayon::prelude::*;

/// Upper bound on the memory, in floats: 256 MB.
const MOST_FLOATS: u64 = 64 << 20;
/// Memory of a vertex besides its features, in floats: for the list and the ordered map of vertices. Memory of a Gaussian, for its centre in the box and the
/// corners of its cell.
pub(super) const FLOATS_OF_VERTEX: u64 = 12;
pub(super) const FLOATS_OF_GAUSSIAN: u64 = 16;
/// Upper bound on multiplications: some ten seconds in a browser, and a second or two on a desktop.
const MOST_MULTIPLICATIONS: u64 = 20_000_000_000;
/// Gaussians whose coefficients are computed at a time.
const BLOCK: usize = 1024;
/// Samples per cycle of the fastest band: straight lines between them are off by at most half a percent of its amplitude.
const SAMPLES_PER_CYCLE: f64 = 32.0;
/// Samples per spline.
const SAMPLES_PER_SPLINE: usize = 16;

/// What a head changes in a layer; `None` for a head that is not linear there.
fn layer_head(head: Head, rotation: Rotation) -> Option<LayerHead> {
    match head {
        Head::Means => Some(LayerHead::Means),
        Head::LogScales => Some(LayerHead::LogScales),
        Head::Quaternions if rotation == Rotation::Additive => Some(LayerHead::Rotations),
        Head::Sh => Some(LayerHead::Colors),
        // Offsets of rotation vectors and of opacity logits are not linear in a layer.
        Head::Quaternions | Head::Opacity => None,
    }
}

pub(crate) fn computed(source: &MotionSource) -> Result<Option<ComputedMotion>> {
    motion(SpaceKind::Computed, source)
}

pub(crate) fn stored(source: &MotionSource) -> Result<Option<ComputedMotion>> {
    motion(SpaceKind::Stored, source)
}

/// The plan of a deformer; `None` for settings that are unknown here, which may be those of a layer around it. Baking builds both and reports wrong settings.
fn plan_of(kind: SpaceKind, settings: &toml::Table, context: &DeformerContext) -> Option<BasisPlan> {
    let mut section = settings.clone();
    RATE_KEYS.iter().for_each(|key| _ = section.remove(*key));
    BasisPlan::new(kind, &section, context).ok()
}

fn weights(kind: SpaceKind, settings: &toml::Table, context: &DeformerContext) -> Option<u64> {
    let count = plan_of(kind, settings, context)?.parameter_count().ok()? as u64;
    (count <= MOST_FLOATS).then_some(count)
}

fn motion(kind: SpaceKind, source: &MotionSource) -> Result<Option<ComputedMotion>> {
    let Some(plan) = plan_of(kind, source.settings, source.context) else { return Ok(None) };
    let heads: Option<Vec<LayerHead>> = plan.settings.heads.iter().map(|&head| layer_head(head, plan.settings.rotation)).collect();
    let (Some(heads), m) = (heads, source.gaussians.len()) else { return Ok(None) };
    let per_gaussian: usize = plan.groups.iter().map(|(values, own)| values * own).sum();
    let coefficients = per_gaussian.saturating_mul(m);
    let samples = source.least_samples.max(samples_for(&plan.functions));
    let many = samples > MAX_SAMPLES || plan.kept.iter().any(|own| own.len() > MAX_FUNCTIONS) || coefficients > source.most_coefficients;
    if many || too_much(&plan, m, samples)? {
        return Ok(None);
    }

    let of_functions = match &plan.functions.network {
        Some(shape) => source.weights("net.functions", shape.parameter_count())?,
        None => &[],
    };
    let times: Vec<f32> = (0..samples).map(|k| frame_time(k, samples)).collect();
    let functions = plan.functions.at(&times, of_functions);

    let features = plan.space.features(source)?;
    let weights = coefficient_weights(&plan, source)?;
    let width = plan.coefficients.input;
    let blocks: Vec<Vec<Vec<f32>>> = features.par_chunks(BLOCK * width).map(|features| network(&plan.coefficients, &weights, features)).collect();

    let track = |(index, &head): (usize, &LayerHead)| {
        let ((values, own), kept) = (plan.groups[index], &plan.kept[index]);
        let mut coefficients = Vec::with_capacity(m * values * own);
        let rows = blocks.iter().flat_map(|block| block[index].chunks_exact(values * own));
        for (row, gaussian) in rows.zip(0..) {
            let factor = factor(head, source.gaussians, gaussian);
            // From [values, functions] to [functions, values].
            coefficients.extend((0..own).flat_map(|f| (0..values).map(move |v| factor * row[v * own + f])));
        }
        let ranks = vec![own as u8; m];
        let functions = kept.iter().flat_map(|&f| functions.iter().map(move |at| at[f])).collect();
        Track { head, functions, starts: Track::starts_of(&ranks), ranks, coefficients }
    };
    Ok(Some(ComputedMotion { samples, tracks: heads.iter().enumerate().map(track).collect() }))
}

/// Samples of time between which straight lines follow the fastest function.
fn samples_for(functions: &TemporalFunctions) -> usize {
    let fastest = if functions.bands == 0 { 0.0 } else { f64::from(functions.cycles) * (functions.bands as f64 - 1.0).exp2() };
    let of_bands = (SAMPLES_PER_CYCLE * fastest).ceil() as usize;
    // 24 bands of 16 cycles need 2^32, which 32 bits do not hold.
    of_bands.max(SAMPLES_PER_SPLINE * functions.splines).saturating_add(1)
}

/// Whether features or multiplications for `m` Gaussians and `samples` of time are more than a player should spend.
fn too_much(plan: &BasisPlan, m: usize, samples: usize) -> Result<bool> {
    let (floats, of_space) = plan.space.work(m as u64)?;
    let of_gaussians = (m as u64).saturating_mul(plan.coefficients.parameter_count() as u64);
    let of_functions = plan.functions.network.as_ref().map_or(0, |shape| (samples as u64).saturating_mul(shape.parameter_count() as u64));
    Ok(floats > MOST_FLOATS || of_space.saturating_add(of_gaussians).saturating_add(of_functions) > MOST_MULTIPLICATIONS)
}

/// The weights of trunk and heads, one after the other.
fn coefficient_weights(plan: &BasisPlan, source: &MotionSource) -> Result<Vec<f32>> {
    let shape = &plan.coefficients;
    let mut weights = source.weights("net.trunk", weights_of_chain(shape.input, &shape.trunk))?.to_vec();
    for (head, layers) in plan.settings.heads.iter().zip(&shape.heads) {
        weights.extend(source.weights(&format!("net.head.{}", head.name()), weights_of_chain(plan.width(), layers))?);
    }
    Ok(weights)
}

/// Largest factor of rotations. Beyond it, changes would exceed what layers may hold; far below it, the added quaternion already determines the rotation.
const MOST_FACTOR: f64 = 1e15;

/// The factor of the coefficients. Layers add to normalised quaternions.
fn factor(head: LayerHead, gaussians: &HostGaussians, gaussian: usize) -> f32 {
    if head != LayerHead::Rotations {
        return 1.0;
    }
    // In float64, where squares of all float32 are neither infinite nor zero.
    let norm = gaussians.quaternions[4 * gaussian..4 * gaussian + 4].iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    // What is added to a quaternion of norm 0 is the whole rotation, of which only the direction counts.
    if norm > 0.0 { (1.0 / norm).min(MOST_FACTOR) as f32 } else { 1.0 }
}

inventory::submit! {
    MotionPlugin {
        info: Plugin {
            name: SpaceKind::Computed.name(),
            version: VERSION,
            summary: "plays cdf-basis without the deformer: coefficients are computed from its weights when a file is opened",
            paper: "this project",
            schema: "",
            capabilities: &[],
        },
        weights: |settings, context| weights(SpaceKind::Computed, settings, context),
        motion: computed,
    }
}

inventory::submit! {
    MotionPlugin {
        info: Plugin {
            name: SpaceKind::Stored.name(),
            version: VERSION,
            summary: "plays hash-basis without the deformer: coefficients are computed from its weights when a file is opened",
            paper: "this project",
            schema: "",
            capabilities: &[],
        },
        weights: |settings, context| weights(SpaceKind::Stored, settings, context),
        motion: stored,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_change_whatever_the_norm_of_their_quaternion() {
        for (length, expected) in [(0.0, 1.0), (1e-40, 1e15), (1e-20, 1e15), (0.5, 2.0), (1.0, 1.0), (1e25, 1e-25), (3e38, 1.0 / 3e38)] {
            let gaussians = HostGaussians { quaternions: vec![1.0, 0.0, 0.0, 0.0, 0.0, 0.0, length, 0.0], ..Default::default() };
            let found = factor(LayerHead::Rotations, &gaussians, 1);
            assert!((found / expected - 1.0).abs() < 1e-3, "{length}: {found}");
            assert_eq!(factor(LayerHead::Means, &gaussians, 1), 1.0);
        }
    }
}
