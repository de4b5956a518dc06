//! The conformance suite of loss terms.

use super::{guarded, settings_are_defaults, uniform, within};
use crate::gaussians::to_vec;
use crate::{Gaussians, HostGaussians, LossInput, LossPlugin, LossTerm, Registry, Result, Schedule, Seed};
use burn::tensor::{Device, Int, Tensor, TensorData};

/// Image size of the suite.
const SIZE: [usize; 2] = [17, 23];
/// Gaussians of the suite.
const COUNT: usize = 6;
/// Largest relative difference between a finite difference along the gradient and the gradient's norm.
const SLOPE_TOLERANCE: f64 = 0.05;
/// By how much values change that have no gradient, and the largest relative change of the loss then.
const MOVE: f32 = 0.01;
const UNMOVED: f64 = 1e-5;
/// Largest relative difference between a fused term and the sum of its parts.
const FUSED_TOLERANCE: f64 = 1e-4;

/// Tests a loss term on `device`. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused; nothing panics.
/// - The value is one finite number and repeats bit for bit.
/// - Gradients of the planes and of the Gaussians agree with finite differences.
/// - Images of one pixel and sets without Gaussians give a value or an error.
/// - A fused term is the weighted sum of the terms it replaces, which are looked up in `registry`.
pub fn loss(plugin: &LossPlugin, settings: &toml::Table, registry: &Registry, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, registry, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.settings_are_read())),
            ("value", Box::new(|| suite.value_is_a_number())),
            ("gradients", Box::new(|| suite.gradients_are_slopes())),
            ("odd inputs", Box::new(|| suite.odd_inputs_are_answered())),
            ("fusion", Box::new(|| suite.fused_is_the_sum())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a LossPlugin,
    settings: &'a toml::Table,
    registry: &'a Registry,
    device: &'a Device,
}

/// Values of one input, row-major.
#[derive(Clone)]
struct Inputs {
    /// `[5,H,W]`.
    planes: Vec<f32>,
    /// `[3,H,W]`.
    target: Vec<f32>,
    gaussians: HostGaussians,
    size: [usize; 2],
}

fn inputs(size: [usize; 2], count: usize) -> Inputs {
    let (seed, pixels) = (Seed::root(51), size[0] * size[1]);
    let draw = |shift: usize, k: usize| 0.5 + 0.45 * uniform(seed, 1_000_000 * shift + k);
    let columns = |width: usize, shift: usize, centre: f32| (0..count * width).map(|k| centre + uniform(seed, 2_000_000 * shift + k)).collect::<Vec<f32>>();
    Inputs {
        planes: (0..5 * pixels).map(|k| draw(1, k)).collect(),
        target: (0..3 * pixels).map(|k| draw(2, k)).collect(),
        gaussians: HostGaussians {
            sh_degree: 1,
            means: columns(3, 3, 0.0),
            log_scales: columns(3, 4, -2.0),
            quaternions: columns(4, 5, 1.5),
            opacity_logits: columns(1, 6, 0.0),
            sh_dc: columns(3, 7, 0.0),
            sh_rest: columns(9, 8, 0.0),
            dynamic_scores: columns(1, 9, 0.0),
            ..Default::default()
        },
        size,
    }
}

impl Suite<'_> {
    fn settings_are_read(&self) -> Result<Option<String>> {
        let value = |settings: &toml::Table| self.number((self.plugin.build)(settings)?.as_ref(), &inputs(SIZE, COUNT));
        settings_are_defaults("loss", &self.plugin.info, self.settings, value)
    }
    fn term(&self) -> Result<Box<dyn LossTerm>> {
        (self.plugin.build)(self.settings)
    }
    /// The value and its inputs, planes and Gaussians; they track gradients if `track` is set.
    fn value(&self, term: &dyn LossTerm, inputs: &Inputs, track: bool) -> Result<(Option<Tensor<1>>, Tensor<3>, Gaussians)> {
        let device = self.device.clone().autodiff();
        let [h, w] = inputs.size;
        let leaf = |values: &[f32], shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values.to_vec(), shape), &device);
        let (mut planes, target) = (leaf(&inputs.planes, [5, h, w]), Tensor::<3>::from_inner(leaf(&inputs.target, [3, h, w]).inner()));
        let mut g = Gaussians::from_host(&inputs.gaussians, &device);
        if track {
            planes = planes.require_grad();
            g.means = g.means.require_grad();
            g.log_scales = g.log_scales.require_grad();
            g.quaternions = g.quaternions.require_grad();
            g.opacity_logits = g.opacity_logits.require_grad();
            g.sh_dc = g.sh_dc.require_grad();
            g.sh_rest = g.sh_rest.require_grad();
        }
        let radii = Tensor::<1, Int>::ones([inputs.gaussians.len()], self.device);
        let schedule = Schedule::main(100);
        let input = LossInput { planes: &planes, target: &target, gaussians: &g, radii: &radii, time_norm: 0.4, schedule: &schedule };
        Ok((term.value(&input)?, planes, g))
    }
    fn number(&self, term: &dyn LossTerm, inputs: &Inputs) -> Result<f64> {
        let value = self.value(term, inputs, false)?.0;
        Ok(value.map_or(Ok(vec![0.0]), |v| to_vec(v, "value"))?.first().map_or(f64::NAN, |v| f64::from(*v)))
    }
    fn value_is_a_number(&self) -> Result<Option<String>> {
        let (term, inputs) = (self.term()?, inputs(SIZE, COUNT));
        let Some(value) = self.value(term.as_ref(), &inputs, true)?.0 else { return Ok(Some("it returns no value for an ordinary view".into())) };
        if value.dims() != [1] {
            return Ok(Some(format!("its value has shape {:?}, expected [1]", value.dims())));
        }
        let (first, second) = (self.number(term.as_ref(), &inputs)?, self.number(term.as_ref(), &inputs)?);
        Ok((!first.is_finite() || first != second).then(|| format!("two values of one input are {first} and {second}")))
    }
    fn gradients_are_slopes(&self) -> Result<Option<String>> {
        let (term, inputs) = (self.term()?, inputs(SIZE, COUNT));
        let (value, planes, g) = self.value(term.as_ref(), &inputs, true)?;
        let Some(value) = value else { return Ok(None) };
        let gradients = value.backward();
        let flat = |t: Option<Tensor<2>>| t.map(|t| to_vec(t, "gradient")).transpose();
        type Slot = fn(&mut Inputs) -> &mut Vec<f32>;
        let found: [(&str, Option<Vec<f32>>, Slot); 7] = [
            ("planes", planes.grad(&gradients).map(|t| to_vec(t, "gradient")).transpose()?, |i| &mut i.planes),
            ("means", flat(g.means.grad(&gradients))?, |i| &mut i.gaussians.means),
            ("log_scales", flat(g.log_scales.grad(&gradients))?, |i| &mut i.gaussians.log_scales),
            ("quaternions", flat(g.quaternions.grad(&gradients))?, |i| &mut i.gaussians.quaternions),
            ("opacity_logits", g.opacity_logits.grad(&gradients).map(|t| to_vec(t, "gradient")).transpose()?, |i| &mut i.gaussians.opacity_logits),
            ("sh_dc", flat(g.sh_dc.grad(&gradients))?, |i| &mut i.gaussians.sh_dc),
            ("sh_rest", g.sh_rest.grad(&gradients).map(|t| to_vec(t, "gradient")).transpose()?, |i| &mut i.gaussians.sh_rest),
        ];
        let mut reached = 0;
        for (name, gradient, slot) in found {
            // Terms may leave the graph on purpose, but not for the planes.
            let Some(gradient) = gradient.or_else(|| (name == "planes").then(Vec::new)) else { continue };
            let norm = gradient.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            if !norm.is_finite() {
                return Ok(Some(format!("the gradient of {name} has norm {norm}")));
            }
            if norm == 0.0 {
                let mut moved = inputs.clone();
                slot(&mut moved).iter_mut().enumerate().for_each(|(k, v)| *v += MOVE * uniform(Seed::root(57), k));
                let (before, after) = (self.number(term.as_ref(), &inputs)?, self.number(term.as_ref(), &moved)?);
                if !within(before - after, UNMOVED * before.abs().max(1.0)) {
                    return Ok(Some(format!("no gradient reaches {name}, but a change of it takes the loss from {before:.6e} to {after:.6e}")));
                }
                continue;
            }
            reached += 1;
            // The first steps may be below the rounding error, the last may cross kinks.
            let mut slopes = Vec::new();
            for step in [3e-3, 1e-2, 3e-2] {
                let mut ends = [0.0; 2];
                for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                    let mut moved = inputs.clone();
                    slot(&mut moved).iter_mut().zip(&gradient).for_each(|(v, d)| *v += (sign * step * f64::from(*d) / norm) as f32);
                    *end = self.number(term.as_ref(), &moved)?;
                }
                slopes.push((ends[0] - ends[1]) / (2.0 * step));
            }
            if !slopes.iter().any(|slope| (slope / norm - 1.0).abs() <= SLOPE_TOLERANCE) {
                return Ok(Some(format!("{name}: the loss rises by {slopes:.6?} per unit along its gradient of norm {norm:.6}")));
            }
        }
        Ok((reached == 0).then(|| "no gradient reaches the planes or the Gaussians".into()))
    }
    fn odd_inputs_are_answered(&self) -> Result<Option<String>> {
        let term = self.term()?;
        for (what, inputs) in [("one pixel", inputs([1, 1], COUNT)), ("no Gaussians", inputs(SIZE, 0)), ("one row", inputs([1, 30], 1))] {
            let value = self.number(term.as_ref(), &inputs)?;
            if !value.is_finite() {
                return Ok(Some(format!("with {what} the value is {value}")));
            }
        }
        Ok(None)
    }
    fn fused_is_the_sum(&self) -> Result<Option<String>> {
        let Some(fusion) = &self.plugin.fuses else { return Ok(None) };
        let inputs = inputs(SIZE, COUNT);
        let weights: Vec<f64> = (0..fusion.kinds.len()).map(|k| 0.3 + 0.9 * k as f64).collect();
        let fused = self.number((fusion.build)(&weights)?.as_ref(), &inputs)?;
        let mut sum = 0.0;
        for (kind, weight) in fusion.kinds.iter().zip(&weights) {
            sum += weight * self.number((self.registry.loss(kind)?.build)(&toml::Table::new())?.as_ref(), &inputs)?;
        }
        Ok((!within(fused - sum, FUSED_TOLERANCE * sum.abs())).then(|| format!("with weights {weights:?} it is {fused}, the sum of its terms is {sum}")))
    }
}
