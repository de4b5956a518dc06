//! Weights of plug-ins under optimisation: group schedules, gradient clipping, one optimizer step.

use super::rounded::{ExactWeights, WeightScale};
use crate::gaussian_set::log_linear;
use burn::tensor::{Gradients, Tensor};
use cc4dgs_core::{AttributeSpec, Optimizer, Parameter, ParameterGroup, Result, StepSettings, ordered_sum};

/// The learning rate of `group` at `progress` in 0..1 of the stage; `extent` is that of the cameras in the normalised frame.
pub(crate) fn rate(group: &ParameterGroup, progress: f64, extent: f64) -> f64 {
    let warm = if group.warmup > 0.0 { (progress / group.warmup).min(1.0) } else { 1.0 };
    log_linear(group.lr_start, group.lr_end, progress) * warm * if group.times_extent { extent } else { 1.0 }
}

/// The learning rate of an `attribute` of a deformer, as [`rate`].
pub(crate) fn attribute_rate(attribute: &AttributeSpec, progress: f64, extent: f64) -> f64 {
    let AttributeSpec { lr, lr_end, times_extent, .. } = *attribute;
    lr_end.map_or(lr, |lr_end| log_linear(lr, lr_end, progress)) * if times_extent { extent } else { 1.0 }
}

/// Makes the weights leaves of the coming step; [`update`] undoes it.
pub(crate) fn track(parameters: Vec<&mut Parameter>) {
    for parameter in parameters {
        parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
    }
}

/// Takes the gradients of tracked weights, clips them per group and steps. Weights are known to the optimizer as `prefix` and their name; `rate` gives the
/// learning rate of a group. Where there are `exact` values, the tracked ones were rounded from them, and they are stepped instead. Arrays that have steps are
/// stepped in these, at the rate of [`ExactWeights`], with the size's derivatives added after clipping.
pub(crate) fn update(
    prefix: &str,
    mut parameters: Vec<&mut Parameter>,
    exact: ExactWeights,
    groups: &[ParameterGroup],
    gradients: &Gradients,
    optimizer: &mut dyn Optimizer,
    rate: impl Fn(&ParameterGroup) -> f64,
) -> Result<()> {
    let mut gradient_of: Vec<Option<Tensor<1>>> = parameters.iter().map(|p| p.value.grad(gradients)).collect();
    for (g, group) in groups.iter().enumerate().filter(|(_, group)| group.clip_norm > 0.0) {
        let members: Vec<usize> = parameters.iter().enumerate().filter(|(_, p)| p.group == g).map(|(i, _)| i).collect();
        let squares = members.iter().filter_map(|&i| gradient_of[i].clone()).map(|t| ordered_sum(t.clone() * t));
        let Some(total) = squares.reduce(|a, b| a + b) else { continue };
        // clip / max(norm, clip): one number on the device, no read-back.
        let scale = total.sqrt().clamp_min(group.clip_norm).recip().mul_scalar(group.clip_norm);
        for &i in &members {
            gradient_of[i] = gradient_of[i].take().map(|t| t * scale.clone());
        }
    }
    let ExactWeights { values, scales, rate: rate_in_steps } = exact;
    let (mut exact, mut scales) = (values.into_iter(), scales.into_iter().flatten());
    for (parameter, gradient) in parameters.iter_mut().zip(gradient_of) {
        let scale = scales.next().flatten();
        let device = parameter.value.device();
        // Moved out, so that the optimizer holds the only reference and works in place.
        let tracked = std::mem::replace(&mut parameter.value, Tensor::empty([0], &device));
        let value = exact.next().unwrap_or_else(|| tracked.inner());
        let Some(gradient) = gradient else {
            parameter.value = value;
            continue;
        };
        let group = &groups[parameter.group];
        let count = value.dims()[0];
        let name = format!("{prefix}{}", parameter.name);
        if let Some(WeightScale { steps, size }) = scale {
            let gradient = (gradient * steps.clone() + size).reshape([count, 1]);
            let moved = optimizer.step(&name, gradient.zeros_like(), gradient, &StepSettings::new(rate_in_steps))?;
            parameter.value = value + moved.reshape([count]) * steps;
            continue;
        }
        let settings = StepSettings { epsilon: group.epsilon, ..StepSettings::new(rate(group)) };
        parameter.value = optimizer.step(&name, value.reshape([count, 1]), gradient.reshape([count, 1]), &settings)?.reshape([count]);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_of_attributes_fall_as_those_of_weights_or_not_at_all() {
        let constant = AttributeSpec { times_extent: true, ..AttributeSpec::new("velocity", 3, 0.0, 1.6e-3) };
        let falling = AttributeSpec { lr_end: Some(1.6e-5), ..constant.clone() };
        let group = ParameterGroup { times_extent: true, ..ParameterGroup::plain("velocity", 1.6e-3, 1.6e-5) };
        for progress in [0.0, 1e-4, 0.3, 0.5, 1.0] {
            assert_eq!(attribute_rate(&constant, progress, 2.5), 1.6e-3 * 2.5);
            assert_eq!(attribute_rate(&falling, progress, 2.5), rate(&group, progress, 2.5));
        }
        assert!((attribute_rate(&falling, 0.5, 1.0) - 1.6e-4).abs() < 1e-12 && (attribute_rate(&falling, 1.0, 2.0) - 3.2e-5).abs() < 1e-12);
        assert_eq!(attribute_rate(&AttributeSpec { times_extent: false, ..constant }, 0.5, 2.5), 1.6e-3);
    }
}
