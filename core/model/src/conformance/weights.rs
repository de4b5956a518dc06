//! What the suites of models with weights share: reading weights, changing them, and comparing gradients with finite differences.

use super::within;
use crate::gaussians::to_vec;
use crate::{Parameter, Result};
use burn::tensor::{Device, Gradients, Tensor, TensorData};

/// Largest difference between a finite difference and the gradient's component along it, as a share of the gradient's norm.
const SLOPE_TOLERANCE: f64 = 0.02;
/// The most numbers of an array by which single finite differences are taken.
const NUMBERS: usize = 24;

/// Name, shape and values of an array.
type Array = (String, Vec<usize>, Vec<f32>);

/// The arrays of a model.
pub(super) fn values(parameters: &[&Parameter]) -> Result<Vec<Array>> {
    parameters.iter().map(|p| Ok((p.name.clone(), p.shape.clone(), to_vec(p.value.clone(), &p.name)?))).collect()
}

/// Adds `change`, a function of the array and the number in it, to all weights. They are tracked where `device` tracks.
pub(super) fn change(parameters: Vec<&mut Parameter>, device: &Device, change: impl Fn(usize, usize) -> f32) -> Result<()> {
    for (index, parameter) in parameters.into_iter().enumerate() {
        let moved: Vec<f32> = to_vec(parameter.value.clone(), "weights")?.iter().enumerate().map(|(k, v)| v + change(index, k)).collect();
        let value = of(moved, device);
        parameter.value = if value.is_autodiff() { value.require_grad() } else { value };
    }
    Ok(())
}

fn of(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count]), device)
}

/// Compares the `gradients` of the weights of `model` with finite differences of `measure` with steps of size `step`: along each array's gradient, which shows
/// errors of its size, and by single numbers, which shows those that are missing in it. Returns a finding, if any.
pub(super) fn slopes<M: ?Sized>(
    model: &mut M,
    parameters: impl for<'a> Fn(&'a M) -> Vec<&'a Parameter>,
    parameters_mut: impl for<'a> Fn(&'a mut M) -> Vec<&'a mut Parameter>,
    (gradients, step): (&Gradients, f64),
    measure: impl Fn(&M) -> Result<f64>,
) -> Result<Option<String>> {
    for index in 0..parameters(model).len() {
        let (name, start, gradient, device) = {
            let p = parameters(model)[index];
            let Some(gradient) = p.value.grad(gradients) else { return Ok(Some(format!("no gradient reaches {}", p.name))) };
            (p.name.clone(), to_vec(p.value.clone(), "weights")?, to_vec(gradient, "gradient")?, p.value.device())
        };
        let norm = gradient.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        let count = start.len();
        let along: Vec<f64> = gradient.iter().map(|g| f64::from(*g) / norm).collect();
        let single = (0..count).step_by(count.div_ceil(NUMBERS).max(1)).map(|number| (0..count).map(|k| f64::from(u8::from(k == number))).collect());
        for direction in std::iter::once(along).chain(single) {
            let mut ends = [0.0; 2];
            for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                let moved = start.iter().zip(&direction).map(|(s, d)| s + (sign * step * d) as f32).collect();
                parameters_mut(model)[index].value = of(moved, &device);
                *end = measure(model)?;
            }
            parameters_mut(model)[index].value = of(start.clone(), &device);
            let found = (ends[0] - ends[1]) / (2.0 * step);
            let expected: f64 = gradient.iter().zip(&direction).map(|(g, d)| f64::from(*g) * d).sum();
            if norm == 0.0 || !within((found - expected) / norm, SLOPE_TOLERANCE) {
                let said = format!("{name}: the loss rises by {found:.5} per unit along a direction where its gradient of norm {norm:.5} says {expected:.5}");
                return Ok(Some(said));
            }
        }
    }
    Ok(None)
}
