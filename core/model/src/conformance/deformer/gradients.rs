//! Gradients of weights and attributes against finite differences.

use super::super::{uniform, within};
use super::{CENTRES, SHAKE, Suite, no_heads};
use crate::gaussians::to_vec;
use crate::{Deformer, Result, Seed, SpatialInput};
use burn::tensor::{Device, Tensor, TensorData};

/// Largest relative difference between a finite difference along the gradient and the gradient's norm.
const SLOPE_TOLERANCE: f64 = 0.05;
/// Step along the gradient's direction: short enough to cross few ReLU kinks, long enough to be above the rounding error.
const STEP: f64 = 5e-4;
/// Largest change of a value, as a share of it, when an array changes that has no gradient: sums may run in another order.
const NOISE: f64 = 1e-5;
/// Time at which gradients of regularizers are taken.
const TIME: f32 = 0.43;
/// Times of the offsets whose gradients are taken together.
const TIMES: [f32; 2] = [TIME, 0.87];

/// A scalar function of a deformer and its input.
type Scalar<'a> = dyn Fn(&dyn Deformer, &SpatialInput) -> Result<Option<Tensor<1>>> + 'a;

impl Suite<'_> {
    pub(super) fn gradients_are_slopes(&self) -> Result<Option<String>> {
        if self.fresh(self.device)?.is_static() {
            return Ok(None);
        }
        let weighted = |built: &dyn Deformer, input: &SpatialInput| {
            let all = built.deform_all(built.spatial(input)?.values, &TIMES)?.into_iter();
            let all: Vec<Tensor<2>> = all.map(|offsets| offsets.concatenated().ok_or_else(no_heads)).collect::<Result<_>>()?;
            if all.is_empty() {
                return Err(no_heads());
            }
            let offsets = Tensor::cat(all, 1);
            let [n, width] = offsets.dims();
            let weights: Vec<f32> = (0..n * width).map(|k| 1.0 + 0.5 * uniform(Seed::root(8), k)).collect();
            let weights = Tensor::<2>::from_inner(Tensor::from_data(TensorData::new(weights, [n, width]), self.device));
            Ok(Some((offsets * weights).sum()))
        };
        self.slopes(&weighted, true)
    }
    pub(super) fn regularizer_is_sound(&self) -> Result<Option<String>> {
        for progress in [0.0, 1.0] {
            let term = |built: &dyn Deformer, input: &SpatialInput| built.regularizer(input, TIME, progress);
            if let Some(finding) = self.slopes(&term, false)? {
                return Ok(Some(format!("at progress {progress}: {finding}")));
            }
        }
        Ok(None)
    }
    /// Compares the gradient of every weight array and attribute with the slope of `scalar` along it. With `all`, each must have a gradient; otherwise `scalar`
    /// must not depend on an array without one.
    fn slopes(&self, scalar: &Scalar, all: bool) -> Result<Option<String>> {
        let device = self.device.clone().autodiff();
        let mut built = self.shaken(&device)?;
        let plain = self.input(built.as_ref(), CENTRES, &device);
        let track = |t: &Tensor<2>| Tensor::<2>::from_inner(t.clone().inner()).require_grad();
        let tracked = SpatialInput { means_world: plain.means_world.clone(), attributes: plain.attributes.iter().map(track).collect() };
        let Some(value) = scalar(built.as_ref(), &tracked)? else { return Ok(None) };
        if value.dims() != [1] {
            return Ok(Some(format!("the value has shape {:?}, expected [1]", value.dims())));
        }
        let size = f64::from(to_vec(value.clone(), "value")?[0]);
        if !size.is_finite() {
            return Ok(Some(format!("the value is {size}")));
        }
        let gradients = value.backward();
        let measure = |built: &dyn Deformer, input: &SpatialInput| -> Result<f64> {
            Ok(scalar(built, input)?.map_or(Ok(vec![0.0]), |t| to_vec(t, "value"))?.first().map_or(0.0, |v| f64::from(*v)))
        };
        for index in 0..built.parameters().len() {
            let (name, start, gradient) = {
                let p = built.parameters()[index];
                (p.name.clone(), to_vec(p.value.clone(), "weights")?, p.value.grad(&gradients).map(|g| to_vec(g, "gradient")).transpose()?)
            };
            let finding = compare(&name, &start, gradient.as_deref(), size, all, |values| {
                built.parameters_mut()[index].value = upload1(values, &device);
                measure(built.as_ref(), &plain)
            })?;
            built.parameters_mut()[index].value = upload1(start, &device);
            if finding.is_some() {
                return Ok(finding);
            }
        }
        for (index, spec) in built.attributes().into_iter().enumerate() {
            let name = format!("attribute {}", spec.name);
            let start = to_vec(plain.attributes[index].clone(), &name)?;
            let gradient = tracked.attributes[index].grad(&gradients).map(|g| to_vec(g, "gradient")).transpose()?;
            let finding = compare(&name, &start, gradient.as_deref(), size, all, |values| {
                let mut input = plain.clone();
                input.attributes[index] = Tensor::from_data(TensorData::new(values, [CENTRES, spec.width]), &device);
                measure(built.as_ref(), &input)
            })?;
            if finding.is_some() {
                return Ok(finding);
            }
        }
        Ok(None)
    }
}

fn upload1(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let n = values.len();
    Tensor::from_data(TensorData::new(values, [n]), device)
}

/// Compares the slope of `measure` along `gradient` at `start`, where it is `size`, with the gradient's norm. Without a gradient, `measure` must not change.
/// With `needed`, no gradient and a gradient of zero are findings.
fn compare(
    name: &str,
    start: &[f32],
    gradient: Option<&[f32]>,
    size: f64,
    needed: bool,
    mut measure: impl FnMut(Vec<f32>) -> Result<f64>,
) -> Result<Option<String>> {
    let Some(gradient) = gradient else {
        if needed {
            return Ok(Some(format!("no gradient reaches {name}")));
        }
        let found = measure(start.iter().enumerate().map(|(k, v)| v + SHAKE * uniform(Seed::root(13), k)).collect())?;
        let same = (found - size).abs() <= NOISE * size.abs();
        return Ok((!same).then(|| format!("no gradient reaches {name}, but a change of it takes the value from {size:.5e} to {found:.5e}")));
    };
    let norm = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
    if !norm.is_finite() || (norm == 0.0 && needed) {
        return Ok(Some(format!("the gradient of {name} has norm {norm}")));
    }
    if norm == 0.0 {
        return Ok(None);
    }
    // The slope along a gradient that lacks some entries is its norm, too. So those without a gradient must not change the value.
    let of_entry = |(k, g): (usize, &f32)| if *g == 0.0 { uniform(Seed::root(17), k).signum() } else { 0.0 };
    let without: Vec<f32> = gradient.iter().enumerate().map(of_entry).collect();
    if without.iter().any(|direction| *direction != 0.0) {
        let mut at = |step: f64| measure(start.iter().zip(&without).map(|(s, d)| s + (step * f64::from(*d)) as f32).collect());
        let (slope, noise) = ((at(STEP)? - at(-STEP)?) / (2.0 * STEP), NOISE * size.abs() / STEP);
        if !within(slope, SLOPE_TOLERANCE * norm + noise) {
            return Ok(Some(format!(
                "{name}: the value changes with entries that have no gradient, by {slope:.3e} per unit, where the gradient has norm {norm:.3e}"
            )));
        }
    }
    // The change must be above the rounding error of the value itself.
    let step = (1e-3 * size.abs() / norm).clamp(STEP, 20.0 * STEP);
    // A short and a long step: the short one may be below the rounding error, the long one may cross kinks.
    let mut slopes = Vec::new();
    for step in [STEP, step] {
        let mut ends = [0.0; 2];
        for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
            *end = measure(start.iter().zip(gradient).map(|(s, g)| s + (sign * step * f64::from(*g) / norm) as f32).collect())?;
        }
        slopes.push((ends[0] - ends[1]) / (2.0 * step));
        if (slopes[slopes.len() - 1] / norm - 1.0).abs() <= SLOPE_TOLERANCE {
            return Ok(None);
        }
    }
    Ok(Some(format!("{name}: the value rises by {slopes:.5?} per unit along its gradient of norm {norm:.5}")))
}
