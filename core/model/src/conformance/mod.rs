//! Conformance suites for plug-ins. Call them from a test of the plug-in's own crate.
//!
//! Each returns a list of findings, one line each; an empty list means that the plug-in passed. They generate their own inputs and need no data, except for
//! readers, which need a tiny dataset.

mod appearance;
mod deformer;
mod density;
mod loss;
mod optimizer;
mod poses;
mod preset;
mod rasterizer;
mod reader;
mod weights;

pub use appearance::appearance;
#[cfg(not(target_arch = "wasm32"))]
pub use cc4dgs_format::conformance::exporter;
pub use cc4dgs_format::conformance::{codec, weight_codec};
pub use deformer::deformer;
pub use density::density;
pub use loss::{loss, loss_of_attributes};
pub use optimizer::optimizer;
pub use poses::poses;
pub use preset::preset;
pub use rasterizer::rasterizer;
pub use reader::reader;

use crate::{Plugin, Result, Seed, config};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_format::conformance::{settings_are_read, uniform};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// A check with its name; it returns a finding, if any.
type Check<'a> = (&'static str, Box<dyn Fn() -> Result<Option<String>> + 'a>);

/// Runs all checks of `subject`; errors and panics are findings too.
fn guarded(subject: &str, checks: Vec<Check>) -> Vec<String> {
    let mut findings = Vec::new();
    for (name, check) in checks {
        let finding = match catch_unwind(AssertUnwindSafe(check)) {
            Ok(Ok(None)) => continue,
            Ok(Ok(Some(finding))) => finding,
            Ok(Err(e)) => e.to_string(),
            Err(_) => "it panics".to_string(),
        };
        findings.push(format!("{subject}, {name}: {finding}"));
    }
    findings
}

/// What is wrong with the settings of a plug-in that has a section in `config.toml`, if anything is: see [`settings_are_read`]. The section is completed from
/// the schema, so that the schema's settings must do what no settings do. `observed` builds the plug-in with settings and returns what it does.
fn settings_are_defaults<T: PartialEq>(
    kind: &str,
    info: &Plugin,
    settings: &toml::Table,
    observed: impl Fn(&toml::Table) -> Result<T>,
) -> Result<Option<String>> {
    if let Some(finding) = settings_are_read(kind, info, settings, |settings| observed(settings).map(drop))? {
        return Ok(Some(finding));
    }
    let stated = config::parse_table(&format!("schema of {kind} {}", info.name), info.schema)?;
    let differs = observed(&toml::Table::new())? != observed(&stated)?;
    Ok(differs.then(|| "with the settings that its schema states it does something else than with none".into()))
}

/// Whether `value` is at most `most` away from 0; a value that is no number is not.
fn within(value: f64, most: f64) -> bool {
    value.abs() <= most
}

/// A tensor `[rows, width]` of uniform random numbers in -1..1.
fn matrix(seed: Seed, rows: usize, width: usize, device: &Device) -> Tensor<2> {
    let values: Vec<f32> = (0..rows * width).map(|k| uniform(seed, k)).collect();
    Tensor::from_data(TensorData::new(values, [rows, width]), device)
}
