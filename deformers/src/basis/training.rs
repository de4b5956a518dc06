//! Offsets at the times of an iteration, without the coefficients of all functions of time.
//!
//! The last layer of a head is linear, and so is the sum over functions behind it: C(f) φ(t) = (h(f) W + b) φ(t) = h(f) (W φ(t)) + b φ(t). Combined first, the
//! layer has an output per offset and time in place of one per offset and function. A head has some 30 functions, and an iteration one to eight times.

use super::Basis;
use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_backends::ops::field::{mlp_relu_flat, split_times};
use cc4dgs_core::Result;
use std::sync::Arc;

impl Basis {
    /// The outputs `[M, width]` of every head at each of `times_norm`, for features of space `[M,S]`, M > 0.
    pub(super) fn outputs_at(&self, features: Tensor<2>, times_norm: &[f32]) -> Result<Vec<Vec<Tensor<2>>>> {
        let ([m, _], device, times) = (features.dims(), features.device(), times_norm.len());
        let functions = self.functions_at(times_norm, &device)?;
        let own = &self.parameters[self.space.parameters() + usize::from(self.functions.network.is_some())..];
        let (mut shape, mut weights) = ((*self.coefficients).clone(), vec![own[0].value.clone()]);
        let trunk = shape.trunk.last().copied().unwrap_or(shape.input);
        for (head, (layers, (kept, &(values, count)))) in own[1..].iter().zip(shape.heads.iter_mut().zip(self.kept.iter().zip(&self.shape.groups))) {
            let input = layers.iter().rev().nth(1).copied().unwrap_or(trunk);
            // W `[input, values x count]` of the last layer, and b as one more row.
            let (rows, last) = ((input + 1) * values, (input + 1) * values * count);
            let hidden = head.value.dims()[0] - last;
            if hidden > 0 {
                weights.push(head.value.clone().narrow(0, 0, hidden));
            }
            let indices: Vec<i64> = kept.iter().map(|&f| f as i64).collect();
            let at_times = functions.clone().select(1, Tensor::<1, Int>::from_data(TensorData::new(indices, [count]), &device));
            let combined = head.value.clone().narrow(0, hidden, last).reshape([rows, count]).matmul(at_times.transpose());
            weights.push(combined.reshape([input + 1, values, times]).swap_dims(1, 2).reshape([rows * times]));
            if let Some(outputs) = layers.last_mut() {
                *outputs = times * values;
            }
        }
        let flat = mlp_relu_flat(features, Tensor::cat(weights, 0), &Arc::new(shape))?;
        Ok(split_times(flat, m, &self.shape.widths(), times))
    }
}
