//! `compact`: quantised by the effect on images, transformed, predicted, and entropy coded.
//!
//! The step of every value follows from how much its error changes rendered images. Gaussians fall into classes; the steps of one class are twice those of
//! the class before. Weights come from derivatives of renders in views, or from sizes and opacities. Streams, in the order in which a player
//! needs them: of each layer classes, scales, centres, rotations, opacities and degree-0 colours, then attributes of plug-ins, then the higher degrees one by
//! one. Layers are sets of Gaussians by falling weight.

mod allocate;
mod attributes;
mod bits;
mod blocks;
mod colors;
mod columns;
mod encode;
mod entropy;
mod forecast;
mod geometry;
mod images;
mod importance;
mod job;
mod joint;
mod layers;
mod plan;
mod predict;
mod read;
mod restore;
mod rounding;
mod search;
mod seek;
mod sensitivity;
mod settings;
mod transform;
mod tune;
mod weights;
mod write;

pub(crate) use weights::build as build_weights;

use cc4dgs_format::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, HostGaussians, Plugin, Result, Stream, StreamStage, inventory};
use colors::Choices;
use columns::Columns;
use job::Job;
use plan::Planner;
use settings::Settings;
use std::cell::Cell;
use write::Motion;

/// Version of the stored form.
const VERSION: u8 = 4;
/// Largest losses: column and root-mean-square error over the standard deviation. Gaussians that are hardly seen may lose everything: a colour that becomes
/// the mean has a loss of 1, a rotation that has nothing to do with the true one of 1.4.
const LOSSES: [(&str, f64); 7] = [
    ("means", 0.01),
    ("log_scales", 0.5),
    ("quaternions", 1.5),
    ("opacity_logits", 0.7),
    ("sh_dc", 1.1),
    ("sh_rest", 1.1),
    // One of two levels, each the mean of its scores.
    ("dynamic_scores", 1.0),
];
/// Times at which [`keeps_shapes`] evaluates the deformer.
const TIMES: [f32; 3] = [0.0, 0.37, 1.0];

struct Compact {
    settings: Settings,
}

/// The bytes of all streams.
fn bytes_of(streams: &[Stream]) -> usize {
    streams.iter().map(|stream| stream.bytes.len()).sum()
}

impl Compact {
    /// The streams of valid Gaussians.
    fn streams(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        let measured = if self.settings.measured {
            importance::measure(gaussians, context, self.settings.adaptive && self.settings.shapes, self.settings.joint)?
        } else {
            None
        };
        let mut importance = measured.unwrap_or_else(|| importance::estimate(gaussians, context));
        let (motion, free) = self.motion(gaussians, context)?;
        let (mut log_scales, mut quaternions) = (gaussians.log_scales.clone(), gaussians.quaternions.clone());
        encode::make_canonical(&mut log_scales, &mut quaternions, &free);
        let canonical = Columns { log_scales: &log_scales, quaternions: &quaternions, ..Columns::from(gaussians) };
        let classes = encode::classify(&importance.weights, &importance.shapes, self.settings.adaptive);
        if self.settings.measured {
            importance.attributes = sensitivity::measure(canonical, &classes, context, search::estimate(self.settings.psnr_db, &importance))?;
        }
        let choices = Choices { transform: self.settings.transform, rate_weight: self.settings.rate_weight };
        let layers = layers::assign(&importance.weights, layers::number(self.settings.layers, gaussians.len()));
        let planner = Planner::new(canonical, &importance, &classes, choices);
        let mut job = Job { planner, free, directions: importance.directions.as_ref(), layers, motion, factors: [1.0; 6], joint: Cell::new(true) };
        search::search(&mut job, &self.settings, context)
    }
    fn motion(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<(Motion, Vec<bool>)> {
        let n = gaussians.len();
        let Some(threshold) = context.dynamic_threshold else { return Ok((Motion { free: 0, moving: None, levels: [0.0; 2] }, vec![false; n])) };
        let moving: Vec<bool> = gaussians.dynamic_scores.iter().map(|&s| s > threshold).collect();
        let mean = |moves: bool| {
            let of: Vec<f64> = gaussians.dynamic_scores.iter().zip(&moving).filter(|(_, m)| **m == moves).map(|(&s, _)| f64::from(s)).collect();
            (of.iter().sum::<f64>() / of.len().max(1) as f64) as f32
        };
        // Rounded to float32, a mean may be on the other side of the threshold.
        let finite = threshold.clamp(f32::MIN, f32::MAX);
        let levels = [
            if moving.contains(&false) { mean(false).min(finite) } else { 0.0 },
            if moving.contains(&true) { mean(true).max(finite.next_up().min(f32::MAX)) } else { 0.0 },
        ];
        let free = match (self.settings.canonical, moving.contains(&true)) {
            (false, _) => 0,
            (true, false) => 1,
            (true, true) => {
                if keeps_shapes(gaussians, context)? {
                    1
                } else {
                    2
                }
            }
        };
        let free_rows = moving.iter().map(|m| free == 1 || free == 2 && !m).collect();
        Ok((Motion { free, moving: Some(moving), levels }, free_rows))
    }
}

/// Whether the deformer leaves scales and rotations as they are.
fn keeps_shapes(gaussians: &HostGaussians, context: &CodecContext) -> Result<bool> {
    let Some(deformer) = context.deformer else { return Ok(false) };
    for time in TIMES {
        let moved = deformer.deform(gaussians, time)?;
        if moved.log_scales != gaussians.log_scales || moved.quaternions != gaussians.quaternions {
            return Ok(false);
        }
    }
    Ok(true)
}

impl AttributeCodec for Compact {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let streams = self.streams(gaussians, context)?;
        // Streams that cannot be decoded are an error.
        self.decode(&streams, &CodecContext::new(context.seed, context.limits, context.events))?;
        Ok(streams)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        read::read(streams, context, true)
    }
    fn stage(&self, name: &str) -> StreamStage {
        layers::stage(name)
    }
    fn decode_stage(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        read::read(streams, context, false)
    }
    fn losses(&self) -> Vec<DeclaredLoss> {
        LOSSES.map(|(attribute, relative_rms)| DeclaredLoss { attribute: attribute.into(), relative_rms }).into()
    }
    fn keeps_motion(&self) -> bool {
        true
    }
    fn check_without_scene(&self) -> Result<()> {
        self.settings.check_without_tuner()?;
        self.settings.check_without_views()
    }
    fn most_bytes(&self) -> Option<u64> {
        (self.settings.max_size_mb > 0.0).then_some((1e6 * self.settings.max_size_mb) as u64)
    }
}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    Ok(Box::new(Compact { settings: Settings::parse(profile, settings)? }))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "compact",
            version: "4",
            summary: "the smallest files: values that show less are rounded more, colours are decorrelated, all is entropy coded",
            paper: "rate-distortion allocation, Karhunen-Loève transform, asymmetric numeral systems (constriction)",
            schema: settings::SCHEMA,
            capabilities: &["lossy", "reorders", "views"],
        },
        build,
    }
}

/// `count` Gaussians with values in -1..1.
#[cfg(test)]
fn random_gaussians(count: usize, sh_degree: usize) -> HostGaussians {
    let mut out = HostGaussians { sh_degree, opacity_logits: vec![0.0; count], ..Default::default() };
    for (column, (_, width, values)) in out.columns_mut().into_iter().enumerate() {
        let seed = cc4dgs_format::Seed::root(column as u64);
        *values = (0..count * width).map(|k| cc4dgs_format::conformance::uniform(seed, k)).collect();
    }
    out
}

#[cfg(test)]
mod tests {
    use super::joint::Directions;
    use super::plan::{Bounds, Plan};
    use super::*;
    use cc4dgs_format::storage::column_loss;

    #[test]
    fn the_stored_version_is_that_of_the_plug_in() {
        let plugin = cc4dgs_format::Entries::<CodecPlugin>::collect().and_then(|all| all.get("compact")).map(|p| p.info.version);
        assert_eq!(plugin.ok(), Some(VERSION.to_string().as_str()));
    }

    #[test]
    fn the_declared_loss_is_kept_by_the_steps_of_what_is_hardly_seen() {
        let n = 400;
        let mut g = random_gaussians(n, 2);
        // Large compared with the distances between them, so that steps relative to the size lose much.
        g.log_scales.fill(0.5);
        let context = CodecContext::new(cc4dgs_format::Seed::root(1), Default::default(), &cc4dgs_format::Silent);
        let mut importance = importance::estimate(&g, &context);
        importance.weights.iter_mut().chain(&mut importance.shapes).enumerate().filter(|(k, _)| k % 8 > 0).for_each(|(_, w)| *w *= 1e-4);
        let classes = encode::classify(&importance.weights, &importance.shapes, true);
        let mut directions = Directions::new(n, 2);
        for k in 0..20 {
            let eye = [4.0, (k as f64 * 0.7).sin(), (k as f64 * 1.3).cos()];
            directions.add(&cc4dgs_format::Camera::look_at("t", (8, 8), 1.0, eye, [0.0; 3], [0.0, 0.0, 1.0]), &g.means, &vec![1.0; n]);
        }
        let directions = directions.factored();
        let columns = Columns::from(&g);
        let planner = Planner::new(columns, &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
        let (layers, motion) = (layers::assign(&importance.weights, 1), Motion { free: 0, moving: None, levels: [0.0; 2] });
        let job = Job { planner, free: vec![false; n], directions: Some(&directions), layers, motion, factors: [1.0; 6], joint: Cell::new(true) };
        let wanted = job.planner.plan(0.05, &job.factors, &Bounds::NONE);
        let too_much = |plan: &Plan| {
            let order = job.order(&job.quantise(columns, plan, None));
            let (sorted, rounded) = (g.select(&order), job.restored(columns, plan));
            let losses = sorted.columns().into_iter().zip(rounded.columns()).zip(LOSSES).map(|(((name, width, a), (_, _, b)), loss)| {
                assert_eq!(name, loss.0);
                column_loss(name, a, b, width) > loss.1
            });
            losses.collect::<Vec<bool>>()
        };
        let lost = too_much(&wanted);
        assert!(lost[0] && (lost[4] || lost[5]), "no declared loss is exceeded without bounds: {lost:?}");
        let kept = job.attempt(0.05).unwrap().0.plan;
        assert_eq!(too_much(&kept), [false; 7]);
        // Steps of class 0 are those that were asked for; only those of coarser classes are smaller.
        assert_eq!((kept.geometry.cell, kept.geometry.scale_step), (wanted.geometry.cell, wanted.geometry.scale_step));
        assert!(kept.geometry.class_limit < wanted.geometry.class_limit);
        assert!((0..3).all(|d| kept.degrees[d].step_of(0) == wanted.degrees[d].step_of(0)));
    }

    #[test]
    fn other_versions_are_refused_by_number() {
        let streams = [Stream { name: "meta".into(), bytes: vec![2; 40] }];
        let context = CodecContext::new(cc4dgs_format::Seed::root(1), Default::default(), &cc4dgs_format::Silent);
        let message = read::read(&streams, &context, true).map(|_| ()).expect_err("version 2").to_string();
        assert!(message.contains("version 2 is not 4"), "{message}");
    }
}
