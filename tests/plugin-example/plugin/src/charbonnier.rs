//! `charbonnier`: a loss term with a tensor operation of its own. The operation has a kernel for `flex`; other devices take the operations of burn.
#![allow(deprecated, reason = "burn calls its NdArray backend so")]

// The attribute below names `burn`.
use cc4dgs_core::burn;
use cc4dgs_core::burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use cc4dgs_core::burn::backend::autodiff::grads::Gradients;
use cc4dgs_core::burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use cc4dgs_core::burn::backend::flex::FlexTensor;
use cc4dgs_core::burn::backend::tensor::FloatTensor;
use cc4dgs_core::burn::backend::{Autodiff, Backend, Cube, Dispatch, Flex, NdArray, TensorMetadata, backend_extension};
use cc4dgs_core::burn::tensor::{Tensor, TensorData};
use cc4dgs_core::serde::{self, Deserialize};
use cc4dgs_core::{Error, LossInput, LossPlugin, LossTerm, Plugin, Result, config, inventory, ordered_sum, toml};

/// The operation per device. A device that is not listed panics.
#[backend_extension(Flex, NdArray, Cube, Autodiff)]
pub trait CharbonnierOps: Backend {
    /// sqrt(x² + epsilon²) of every number.
    fn charbonnier(x: FloatTensor<Self>, epsilon: f32) -> FloatTensor<Self> {
        let squares = Self::float_mul(x.clone(), x);
        Self::float_sqrt(Self::float_add_scalar(squares, (epsilon * epsilon).into()))
    }
}

impl CharbonnierOps for NdArray {}
/// wgpu and CUDA.
impl CharbonnierOps for Cube {}

impl CharbonnierOps for Flex {
    fn charbonnier(x: FloatTensor<Self>, epsilon: f32) -> FloatTensor<Self> {
        let x = x.to_contiguous();
        let out: Vec<f32> = x.as_slice::<f32>().into_iter().flatten().map(|x| (x * x + epsilon * epsilon).sqrt()).collect();
        FlexTensor::from_data(TensorData::new(out, x.shape()))
    }
}

/// The derivative x / sqrt(x² + epsilon²), which the forward pass has both parts of.
#[derive(Debug)]
struct Derivative;

impl<B: Backend> Backward<B, 1> for Derivative {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let ([parent], (x, value)) = (ops.parents, ops.state);
        if let Some(parent) = parent {
            grads.register::<B>(parent.id, B::float_mul(upstream, B::float_div(x, value)));
        }
    }
}

impl<B: CharbonnierOps, C: CheckpointStrategy> CharbonnierOps for Autodiff<B, C> {
    fn charbonnier(x: FloatTensor<Self>, epsilon: f32) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let value = B::charbonnier(x.clone(), epsilon);
        match Derivative.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((x, value.clone()), value),
            OpsKind::UnTracked(prep) => prep.finish(value),
        }
    }
}

/// sqrt(x² + epsilon²) of every number of `x` `[N]`, N at least 1; epsilon is over 0.
fn charbonnier(x: Tensor<1>, epsilon: f32) -> Tensor<1> {
    Tensor::from_dispatch(<Dispatch as CharbonnierOps>::charbonnier(x.into_dispatch(), epsilon))
}

#[derive(Deserialize)]
#[serde(crate = "self::serde", default, deny_unknown_fields)]
struct Charbonnier {
    epsilon: f32,
}

impl Default for Charbonnier {
    fn default() -> Self {
        Self { epsilon: 1e-3 }
    }
}

impl LossTerm for Charbonnier {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let [channels, height, width] = input.target.dims();
        let count = channels * height * width;
        let difference = input.planes.clone().narrow(0, 0, channels) - input.target.clone();
        Ok((count > 0).then(|| ordered_sum(charbonnier(difference.reshape([count]), self.epsilon)).div_scalar(count as f32)))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let term: Charbonnier = config::parse_section("loss charbonnier", section)?;
    if !(1e-6..=1.0).contains(&term.epsilon) {
        let problem = format!("{} is not from 0.000001 to 1", term.epsilon);
        return Err(Error::parameter("loss charbonnier: epsilon", problem, "Give the difference of colours below which the term is smooth, such as 0.001"));
    }
    Ok(Box::new(term))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "charbonnier",
            version: "1",
            summary: "a smooth l1: the mean of sqrt(difference^2 + epsilon^2)",
            paper: "Charbonnier et al. 1994",
            schema: "epsilon = 0.001          # difference of colours below which it is smooth\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::gaussians::to_vec;
    use cc4dgs_core::parse_device;

    #[test]
    fn values_and_gradients_are_those_of_the_formula() {
        let numbers: Vec<f32> = (-40..=40).map(|k| k as f32 / 8.0).collect();
        let epsilon = 0.25f32;
        let root = |x: f32| (f64::from(x).powi(2) + f64::from(epsilon).powi(2)).sqrt();
        let near = |found: &[f32], wanted: &dyn Fn(f32) -> f64| {
            found.len() == numbers.len() - 1 && found.iter().zip(&numbers[1..]).all(|(found, &x)| (f64::from(*found) - wanted(x)).abs() < 1e-5)
        };
        for name in ["flex", "ndarray", "wgpu"] {
            // The suite of the loss term fails where a device has to be there.
            let Ok(device) = parse_device(name) else { continue };
            let data = TensorData::new(numbers.clone(), [numbers.len()]);
            let x = Tensor::<1>::from_data(data, &device.autodiff()).require_grad();
            // A piece of a longer array.
            let value = charbonnier(x.clone().narrow(0, 1, numbers.len() - 1), epsilon);
            let values = to_vec(value.clone().inner(), "values").unwrap();
            assert!(near(&values, &root), "{name}: {values:?}");
            let gradients = value.mul_scalar(3.0).sum().backward();
            let gradient = to_vec(x.grad(&gradients).unwrap(), "gradient").unwrap();
            assert_eq!(gradient[0], 0.0);
            assert!(near(&gradient[1..], &|x| 3.0 * f64::from(x) / root(x)), "{name}: {gradient:?}");
        }
    }
}
