//! Would storing the coefficients of `cdf-basis` per Gaussian be smaller than storing the networks that compute them?
//!
//! Coefficients are rounded to steps that are a share of the root-mean-square of them all, and every column is charged its entropy: of its values, or of the
//! differences between neighbours along the Morton curve, whichever is less. The image is scored with the rounded ones.
//!
//! `cargo run --release --example stored_coefficients -- MODEL SCENE [VIEWS]`

#![allow(clippy::print_stdout)] // its output is what it is for

use cc4dgs::core::burn::tensor::{Tensor, TensorData};
use cc4dgs::core::gaussians::to_vec;
use cc4dgs::core::{Deformer, Error, Limits, Offsets, Parameter, ParameterGroup, Registry, Result, Silent, SpatialFeatures, SpatialInput, Split, parse_device};
use cc4dgs::play::Model;
use cc4dgs::scenes::open_as_trained;
use cc4dgs::train::eval::{Scored, evaluate};
use std::collections::HashMap;
use std::sync::{Arc, Mutex};

/// A field whose spatial features were rounded.
struct Rounded {
    inner: Box<dyn Deformer>,
    /// Steps as a share of the root-mean-square of all features.
    step: f32,
    /// Bits of all features.
    bits: Arc<Mutex<f64>>,
}

impl Deformer for Rounded {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = &input.means_world;
        let (device, [m, _]) = (means_world.device(), means_world.dims());
        let order = cc4dgs::codecs::morton::order(&to_vec(means_world.clone(), "means")?);
        let spatial = self.inner.spatial(input)?;
        // Packed features are a Gaussian per row and a coefficient per column, wherever they lie.
        let mut values = to_vec(self.inner.packed(spatial.values), "features")?;
        let columns = values.len() / m.max(1);
        let rms = (values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / values.len().max(1) as f64).sqrt();
        let step = self.step * rms as f32;
        let mut bits = 0.0;
        for c in 0..columns {
            let column: Vec<i64> = order.iter().map(|&row| (values[row * columns + c] / step).round() as i64).collect();
            let differences = column.iter().scan(0, |last, &v| Some(v - std::mem::replace(last, v))).collect::<Vec<_>>();
            bits += entropy(&column).min(entropy(&differences));
        }
        values.iter_mut().for_each(|v| *v = (*v / step).round() * step);
        let by_columns: Vec<f32> = (0..columns).flat_map(|c| values.iter().skip(c).step_by(columns).copied()).collect();
        *self.bits.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = bits;
        Ok(SpatialFeatures { values: Tensor::<2>::from_data(TensorData::new(by_columns, [columns, m]), &device).transpose(), work: spatial.work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        self.inner.deform(features, time_norm)
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.inner.parameters()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.inner.parameters_mut()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        self.inner.groups()
    }
}

/// Bits of `values` by the frequencies of their symbols.
fn entropy(values: &[i64]) -> f64 {
    let mut counts: HashMap<i64, u64> = HashMap::new();
    values.iter().for_each(|v| *counts.entry(*v).or_default() += 1);
    let n = values.len() as f64;
    counts.values().map(|&c| -(c as f64) * (c as f64 / n).log2()).sum()
}

fn main() -> Result<()> {
    let mut args = std::env::args().skip(1);
    let (model, scene) = (args.next().unwrap_or_default(), args.next().unwrap_or_default());
    let views = match args.next() {
        Some(n) => n.parse::<usize>().map_err(|_| Error::parameter("VIEWS", format!("'{n}' is no number"), "Give a whole number, such as 20"))?,
        None => 20,
    };
    let (registry, limits, device) = (Registry::collect()?, Limits::default(), parse_device("flex")?);
    let load = || Model::open(model.as_ref(), &registry, &device, &limits, &Silent);
    let plain = load()?;
    let scene = open_as_trained(scene.as_ref(), &plain, &[], &registry, &limits)?;
    let score =
        |model: &Model| evaluate(model, &scene, Scored { max_views: views, ..Scored::all(Split::Test) }, &registry, &device, &Silent, &mut |_, _, _, _| Ok(()));
    let before = score(&plain)?;
    println!("{} moving Gaussians, field {} bytes as float32, {:.3} dB", before.dynamic_gaussians, plain.size.deform, before.psnr_db);
    for step in [0.02, 0.05, 0.1, 0.2, 0.5, 1.0] {
        let mut model = load()?;
        let bits = Arc::new(Mutex::new(0.0));
        if let Some(own) = model.field.take() {
            let field = Box::new(Rounded { inner: own.field, step, bits: bits.clone() });
            model.field = Some(cc4dgs::play::model::ModelDeformer { field, ..own });
        }
        let report = score(&model)?;
        let bytes = *bits.lock().unwrap_or_else(std::sync::PoisonError::into_inner) / 8.0;
        println!("step {step}: {:.3} dB, {bytes:.0} bytes, {:.1} per Gaussian", report.psnr_db, bytes / report.dynamic_gaussians.max(1) as f64);
    }
    Ok(())
}
