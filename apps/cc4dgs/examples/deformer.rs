//! A deformer of one's own: every Gaussian learns where it swings to. What is learned belongs to the Gaussians (attributes), not to a network.
//!
//! `cargo run --release --example deformer -- [ITERATIONS]`.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::core::burn::tensor::{Device, Tensor};
use cc4dgs::core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Offsets, Parameter, ParameterGroup, Plugin, SpatialFeatures, SpatialInput,
    conformance, inventory, toml,
};
use cc4dgs::{Error, Result, Session, Split};
use std::sync::Arc;

/// offset(t) = swing * sin(2 pi t) + drift * t, with a swing and a drift per Gaussian.
struct Swing;

impl Deformer for Swing {
    fn attributes(&self) -> Vec<AttributeSpec> {
        ["swing", "drift"].map(|name| AttributeSpec { times_extent: true, ..AttributeSpec::new(name, 3, 0.0, 1e-3) }).to_vec()
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("swing", &self.attributes())?;
        let work = DeformerWork { gaussians: input.len() as u64, ..Default::default() };
        Ok(SpatialFeatures { values: Tensor::cat(input.attributes.clone(), 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer swing", format!("the time {time_norm} is not a number"), "Use a time in 0..1"));
        }
        let (swing, drift) = (features.clone().narrow(1, 0, 3), features.narrow(1, 3, 3));
        let means = swing * (std::f32::consts::TAU * time_norm).sin() + drift * time_norm;
        Ok(Offsets { means: Some(means), ..Default::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
}

fn build(settings: &toml::Table, _: &DeformerContext, _: &Device) -> Result<Box<dyn Deformer>> {
    match settings.keys().next() {
        None => Ok(Box::new(Swing)),
        Some(key) => Err(Error::parameter(format!("deformer.{key}"), "there is no such setting", "Remove it")),
    }
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "swing", version: "1", summary: "a swing and a drift per Gaussian", paper: "an example",
            schema: "# no settings\n", capabilities: &["differentiable", "starts-as-identity", "per-gaussian-attributes"],
        },
        build,
    }
}

fn main() -> Result<()> {
    let iterations = std::env::args().nth(1).unwrap_or_else(|| "600".into());
    let session = Session::new()?;
    // The suite that every deformer of this project passes: an empty list is a pass.
    let findings = conformance::deformer(session.registry().deformer("swing")?, &toml::Table::new(), session.device());
    if !findings.is_empty() {
        return Err(Error::backend("deformer swing", findings.join("\n"), "Correct it"));
    }

    let config = session.config("demo", &["deformer.kind=swing", "train.dynamic=all", &format!("train.iterations={iterations}")])?;
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene)?);
    let model = session.train(&config, scene.clone(), None)?;
    println!("{:.2} dB on the held-out camera", session.evaluate(&model, &scene, Split::Test)?.psnr_db);
    Ok(())
}
