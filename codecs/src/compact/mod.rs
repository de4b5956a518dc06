//! `compact`: quantised by what is seen, transformed, predicted, and entropy coded.
//!
//! The step of every value follows from how much its error changes rendered images. Gaussians fall into classes; the steps of one class are twice those of
//! the class before. Weights come from derivatives of renders on the training views, or from sizes and opacities. Streams, in the order in which a player
//! needs them: of each layer classes, scales, centres, rotations, opacities and degree-0 colours, then the higher degrees one by one. Layers are sets of
//! Gaussians by falling weight. Attributes of plug-ins follow the layers.

mod allocate;
mod attributes;
mod bits;
mod blocks;
mod colors;
mod encode;
mod entropy;
mod geometry;
mod importance;
mod joint;
mod layers;
mod predict;
mod read;
mod rounding;
mod search;
mod sensitivity;
mod settings;
mod transform;
mod tune;
mod weights;
mod write;

pub(crate) use weights::build as build_weights;

use cc4dgs_format::storage::column_loss;
use cc4dgs_format::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, HostGaussians, Plugin, Result, Stream, StreamStage, inventory};
use colors::Choices;
use encode::{Classes, Factors, Plan};
use importance::Importance;
use joint::Directions;
use settings::Settings;
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
/// Halvings of a column's step until its loss is allowed; then the whole column is stored exactly.
const HALVINGS: usize = 12;
/// Times at which the deformer is asked what it changes.
const TIMES: [f32; 3] = [0.0, 0.37, 1.0];

struct Compact {
    settings: Settings,
}

/// What does not change from one attempt to the next.
struct Job<'a> {
    gaussians: &'a HostGaussians,
    free: Vec<bool>,
    importance: &'a Importance,
    /// From where Gaussians are seen, where colours are rounded together.
    directions: Option<&'a Directions>,
    classes: Classes,
    /// The layer of each Gaussian, and how many each layer has.
    layers: (Vec<u8>, Vec<usize>),
    motion: Motion,
    choices: Choices,
    /// Of the columns, to start with.
    factors: Factors,
    limits: &'a CodecContext<'a>,
}

/// Streams of a quality.
struct Attempt {
    quality: f64,
    bytes: usize,
    streams: Vec<Stream>,
    /// What they decode to.
    decoded: HostGaussians,
    /// How the values were rounded.
    plan: Plan,
}

impl Job<'_> {
    fn attempt(&self, quality: f64) -> Result<Attempt> {
        self.attempt_with(self.gaussians, quality, &self.factors)
    }
    /// The streams of canonical Gaussians, in steps that keep the declared loss.
    fn attempt_with(&self, gaussians: &HostGaussians, quality: f64, factors: &Factors) -> Result<Attempt> {
        let mut factors = *factors;
        for halvings in 0.. {
            let plan = Plan::new(gaussians, self.importance, &self.classes, quality, &factors, &self.choices);
            let (attempt, order) = self.attempt_planned(gaussians, plan, quality)?;
            let expected = gaussians.select(&order);
            let mut kept = true;
            for (((name, width, before), (_, _, after)), factor) in expected.columns().into_iter().zip(attempt.decoded.columns()).zip(&mut factors) {
                let allowed = LOSSES.iter().find(|l| l.0 == name).map_or(0.0, |l| l.1);
                let lost = column_loss(name, before, after, width);
                // A small part of it is left for what rounding adds.
                if lost.is_nan() || lost > 0.999 * allowed {
                    *factor *= if halvings < HALVINGS { 0.5 } else { 0.0 };
                    kept = false;
                }
            }
            if kept || halvings > HALVINGS {
                return Ok(attempt);
            }
        }
        Err(Error::backend("codec compact", "no step keeps the declared loss", "Report this"))
    }
    /// The streams of canonical Gaussians as `plan` rounds them, and the order of their rows.
    fn attempt_planned(&self, gaussians: &HostGaussians, plan: Plan, quality: f64) -> Result<(Attempt, Vec<usize>)> {
        let of = plan.quantise(gaussians, &self.free, &self.classes, self.directions);
        let mut order: Vec<usize> = (0..gaussians.len()).collect();
        order.sort_by_key(|&i| (self.layers.0[i], of.keys[i], i));
        let streams = write::write(gaussians, &of, &self.motion, &order, &self.layers.1)?;
        let decoded = read::read(&streams, &CodecContext::new(self.limits.seed, self.limits.limits, self.limits.events), true)?;
        Ok((Attempt { quality, bytes: streams.iter().map(|s| s.bytes.len()).sum(), streams, decoded, plan }, order))
    }
}

impl Compact {
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
        let measured = if self.settings.measured {
            importance::measure(gaussians, context, self.settings.adaptive && self.settings.shapes, self.settings.joint)?
        } else {
            None
        };
        let mut importance = measured.unwrap_or_else(|| importance::estimate(gaussians, context));
        let (motion, free) = self.motion(gaussians, context)?;
        let canonical = encode::canonical(gaussians, &free);
        let classes = encode::classify(&importance.weights, &importance.shapes, self.settings.adaptive);
        if self.settings.measured {
            importance.attributes = sensitivity::measure(&canonical, &classes, context, search::estimate(self.settings.psnr_db, &importance))?;
        }
        let choices = Choices { transform: self.settings.transform, rate_weight: self.settings.rate_weight };
        let layers = layers::assign(&importance.weights, layers::number(self.settings.layers, gaussians.len()));
        let directions = importance.directions.as_ref();
        let mut job =
            Job { gaussians: &canonical, free, importance: &importance, directions, classes, layers, motion, choices, factors: [1.0; 6], limits: context };
        Ok(search::search(&mut job, &self.settings, context)?.streams)
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
            summary: "steps by what is seen, transformed colours, entropy coding: the smallest files",
            paper: "rate-distortion allocation; octave classes; Karhunen-Loève transform; asymmetric numeral systems (constriction)",
            schema: settings::SCHEMA,
            capabilities: &["lossy", "reorders"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stored_version_is_that_of_the_plug_in() {
        let plugin = cc4dgs_format::Entries::<CodecPlugin>::collect().and_then(|all| all.get("compact")).map(|p| p.info.version);
        assert_eq!(plugin.ok(), Some(VERSION.to_string().as_str()));
    }

    #[test]
    fn other_versions_are_refused_by_number() {
        let streams = [Stream { name: "meta".into(), bytes: vec![2; 40] }];
        let context = CodecContext::new(cc4dgs_format::Seed::root(1), Default::default(), &cc4dgs_format::Silent);
        let message = read::read(&streams, &context, true).map(|_| ()).expect_err("version 2").to_string();
        assert!(message.contains("version 2 is not 4"), "{message}");
    }
}
