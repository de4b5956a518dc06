//! ReLU, and Mish and its derivative.

use crate::cube::tensor::is_number;
use cubecl::prelude::*;

/// Whether a ReLU turns `value` into 0, and passes no gradient where it did. NaN stays and passes its gradient: it has to reach the loss, where the watchdog of
/// a training finds it.
#[cube]
pub fn relu_is_zero(value: f32) -> bool {
    let number = is_number(value);
    value <= 0.0 && number
}

/// e^x - 1 cannot cancel here: with w = e^x, tanh(ln(1 + w)) = (w^2 + 2 w) / (w^2 + 2 w + 2).
#[cube]
pub fn mish(x: f32) -> f32 {
    // Beyond 20 the factor is 1 to float32.
    let w = select(x < 20.0, x, 20.0f32).exp();
    let n = w * (w + 2.0);
    x * (n / (n + 2.0))
}

/// Derivative of [`mish`].
#[cube]
pub fn mish_derivative(x: f32) -> f32 {
    let w = select(x < 20.0, x, 20.0f32).exp();
    let n = w * (w + 2.0);
    let t = n / (n + 2.0);
    // d tanh(softplus) = (1 - t^2) sigmoid; 1 - t^2 = 4 (n + 1) / (n + 2)^2.
    let slope = 4.0 * (n + 1.0) / ((n + 2.0) * (n + 2.0)) * (w / (1.0 + w));
    t + x * select(x < 20.0, slope, 0.0f32)
}
