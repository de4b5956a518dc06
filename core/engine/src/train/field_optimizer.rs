//! A deformation field under optimisation: Adam moments per weight array, group schedules, gradient clipping.

use crate::columns::log_linear;
use burn::tensor::{Gradients, Tensor};
use cc4dgs_backends::ops::adam::{AdamSettings, adam_step};
use cc4dgs_core::{Deformer, DeformerContext, Result};

/// A field with everything its optimizer keeps.
pub struct FieldOptimizer {
    /// The field.
    pub field: Box<dyn Deformer>,
    /// Its `[deformer]` section.
    pub section: toml::Table,
    /// What it was built with.
    pub context: DeformerContext,
    /// First and second moments, in the order of the parameters.
    pub moments: Vec<[Tensor<1>; 2]>,
    /// Steps taken.
    pub step: u64,
}

impl FieldOptimizer {
    /// Zero moments.
    pub fn new(field: Box<dyn Deformer>, section: toml::Table, context: DeformerContext) -> Self {
        let moments = field.parameters().iter().map(|p| [p.value.zeros_like(), p.value.zeros_like()]).collect();
        Self { field, section, context, moments, step: 0 }
    }
    /// Makes the weights leaves of the coming step; [`FieldOptimizer::update`] undoes it.
    pub fn track(&mut self) {
        for parameter in self.field.parameters_mut() {
            parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
        }
    }
    /// Takes the gradients of the tracked weights, clips them per group and steps. `progress` in 0..1 of the stage.
    pub fn update(&mut self, gradients: &Gradients, progress: f64, extent: f64) -> Result<()> {
        self.step += 1;
        let groups = self.field.groups();
        let step = self.step;
        let mut gradient_of: Vec<Option<Tensor<1>>> = self.field.parameters().iter().map(|p| p.value.grad(gradients)).collect();
        for (g, group) in groups.iter().enumerate() {
            if group.clip_norm <= 0.0 {
                continue;
            }
            let members: Vec<usize> = self.field.parameters().iter().enumerate().filter(|(_, p)| p.group == g).map(|(i, _)| i).collect();
            let squares = members.iter().filter_map(|&i| gradient_of[i].clone()).map(|t| (t.clone() * t).sum());
            let Some(total) = squares.reduce(|a, b| a + b) else { continue };
            // clip / max(norm, clip): one number on the device, no read-back.
            let scale = total.sqrt().clamp_min(group.clip_norm).recip().mul_scalar(group.clip_norm);
            for &i in &members {
                gradient_of[i] = gradient_of[i].take().map(|t| t * scale.clone());
            }
        }
        for ((parameter, moments), gradient) in self.field.parameters_mut().into_iter().zip(&mut self.moments).zip(gradient_of) {
            let device = moments[0].device();
            let value = std::mem::replace(&mut parameter.value, Tensor::empty([0], &device)).inner();
            let Some(gradient) = gradient else {
                parameter.value = value;
                continue;
            };
            let group = &groups[parameter.group];
            let warm = if group.warmup > 0.0 { (progress / group.warmup).min(1.0) } else { 1.0 };
            let lr = log_linear(group.lr_start, group.lr_end, progress) * warm * if group.times_extent { extent } else { 1.0 };
            let settings = AdamSettings { epsilon: group.epsilon, ..AdamSettings::new(lr, step) };
            let [first, second] = std::array::from_fn(|k| std::mem::replace(&mut moments[k], Tensor::empty([0], &device)));
            let stepped = adam_step(value, first, second, gradient, &settings)?;
            parameter.value = stepped.param;
            *moments = [stepped.m, stepped.v];
        }
        Ok(())
    }
}
