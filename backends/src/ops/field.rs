//! Operations of computational deformation fields: hash-feature decoders, interpolation and the deformation network.

use super::limits::check_binding;
use crate::cpu::mlp::{mish, relu};
use crate::cpu::tensor::CpuBackend;
use crate::cpu::vertex::hash::signatures;
use crate::cpu::vertex::interpolate;
use crate::ops::autodiff::{differentiate, record};
use crate::ops::split::{self, PieceLayout};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Autodiff, Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{Error, Result};
use rayon::prelude::*;
use std::sync::Arc;

pub use crate::cpu::vertex::index::MAX_RESOLUTION;
pub use crate::ops::corners::{GridBox, VoxelCorners};
pub use cc4dgs_fields::hash::LevelHash;
pub use cc4dgs_fields::networks::{MishShape, ReluShape};

/// One level's decoder: hash functions and layer widths (the input width is the number of functions).
#[derive(Clone, Debug, PartialEq)]
pub struct Decoder {
    /// The hash functions.
    pub hash: LevelHash,
    /// The network behind them.
    pub shape: MishShape,
}

/// The derivatives per device.
pub trait FieldKernels: Backend {
    /// The gradient of the decoder's weights.
    fn decode_backward(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>, grad: FloatTensor<Self>) -> FloatTensor<Self>;
    /// The gradient `[U, F]` of the features.
    fn trilinear_backward(grad: FloatTensor<Self>, weights: FloatTensor<Self>, slots: IntTensor<Self>, starts: IntTensor<Self>) -> FloatTensor<Self>;
    /// The gradients of the input (if `wants_input`) and the weights.
    fn network_backward(
        x: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        shape: Arc<ReluShape>,
        grad: FloatTensor<Self>,
        wants_input: bool,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>);
}

/// The differentiable operations of this module per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait FieldOps: Backend {
    /// Features `[U, F]` of vertices `[U, 3]`; differentiable in the weights.
    fn decode(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>) -> FloatTensor<Self>;
    /// Interpolated features `[M, F]`; differentiable in the features.
    fn trilinear(
        features: FloatTensor<Self>,
        corners: IntTensor<Self>,
        weights: FloatTensor<Self>,
        slots: IntTensor<Self>,
        starts: IntTensor<Self>,
    ) -> FloatTensor<Self>;
    /// Flat outputs of the network for x `[M, in]`; differentiable in both.
    fn network(x: FloatTensor<Self>, weights: FloatTensor<Self>, shape: Arc<ReluShape>) -> FloatTensor<Self>;
}

fn unsigned<B: CpuBackend>(tensor: &IntTensor<B>) -> Vec<u32> {
    B::ints(tensor).par_iter().map(|&v| v as u32).collect()
}

fn triples<B: CpuBackend>(tensor: &IntTensor<B>) -> Vec<[u32; 3]> {
    B::ints(tensor).par_chunks_exact(3).map(|v| [v[0] as u32, v[1] as u32, v[2] as u32]).collect()
}

impl<B: CpuBackend> FieldKernels for B {
    fn decode_backward(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let vertices = triples::<B>(&vertices);
        let width = decoder.hash.len().max(1);
        let rows = |first: usize, out: &mut [f32]| signatures(&decoder.hash, &vertices[first..first + out.len() / width], out);
        let out = mish::backward(&decoder.shape, &B::floats(&weights), vertices.len(), &rows, &B::floats(&grad), None);
        B::from_floats(out, weights.shape())
    }
    fn trilinear_backward(grad: FloatTensor<Self>, weights: FloatTensor<Self>, slots: IntTensor<Self>, starts: IntTensor<Self>) -> FloatTensor<Self> {
        let f = grad.shape()[1];
        let starts = unsigned::<B>(&starts);
        let out = interpolate::backward(&B::floats(&grad), f, &B::floats(&weights), &unsigned::<B>(&slots), &starts);
        B::from_floats(out, [starts.len().saturating_sub(1), f])
    }
    fn network_backward(
        x: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        shape: Arc<ReluShape>,
        grad: FloatTensor<Self>,
        wants_input: bool,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>) {
        let (grad_x, grad_weights) = relu::backward(&shape, &B::floats(&weights), &B::floats(&x), &B::floats(&grad), wants_input);
        (wants_input.then(|| B::from_floats(grad_x, x.shape())), B::from_floats(grad_weights, weights.shape()))
    }
}

impl<B: CpuBackend> FieldOps for B {
    fn decode(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>) -> FloatTensor<Self> {
        let vertices = triples::<Self>(&vertices);
        let width = decoder.hash.len().max(1);
        let rows = |first: usize, out: &mut [f32]| signatures(&decoder.hash, &vertices[first..first + out.len() / width], out);
        let out = mish::forward(&decoder.shape, &Self::floats(&weights), vertices.len(), &rows);
        Self::from_floats(out, [vertices.len(), decoder.shape.output])
    }
    fn trilinear(
        features: FloatTensor<Self>,
        corners: IntTensor<Self>,
        weights: FloatTensor<Self>,
        _slots: IntTensor<Self>,
        _starts: IntTensor<Self>,
    ) -> FloatTensor<Self> {
        let f = features.shape()[1];
        let corners = unsigned::<Self>(&corners);
        let out = interpolate::forward(&Self::floats(&features), f, &corners, &Self::floats(&weights));
        Self::from_floats(out, [corners.len() / 8, f])
    }
    fn network(x: FloatTensor<Self>, weights: FloatTensor<Self>, shape: Arc<ReluShape>) -> FloatTensor<Self> {
        let out = relu::forward(&shape, &Self::floats(&weights), &Self::floats(&x));
        let len = out.len();
        Self::from_floats(out, [len])
    }
}

#[derive(Debug)]
struct Decode;

impl<B: FieldKernels> Backward<B, 1> for Decode {
    type State = (FloatTensor<B>, IntTensor<B>, Arc<Decoder>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(weights, vertices, decoder), upstream, [wanted]| {
            [wanted.then(|| B::decode_backward(weights, vertices, decoder, upstream))]
        });
    }
}

#[derive(Debug)]
struct Interpolate;

impl<B: FieldKernels> Backward<B, 1> for Interpolate {
    type State = (FloatTensor<B>, IntTensor<B>, IntTensor<B>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(weights, slots, starts), upstream, [wanted]| {
            [wanted.then(|| B::trilinear_backward(upstream, weights, slots, starts))]
        });
    }
}

#[derive(Debug)]
struct Network;

impl<B: FieldKernels> Backward<B, 2> for Network {
    type State = (FloatTensor<B>, FloatTensor<B>, Arc<ReluShape>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 2>(ops, grads, |(x, weights, shape), upstream, [wants_input, _]| {
            let (of_input, of_weights) = B::network_backward(x, weights, shape, upstream, wants_input);
            [of_input, Some(of_weights)]
        });
    }
}

impl<B: FieldKernels + FieldOps, C: CheckpointStrategy> FieldOps for Autodiff<B, C> {
    fn decode(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>) -> FloatTensor<Self> {
        let (weights, parent) = weights.into_parts();
        record::<B, C, _, 1>(Decode, [parent], |_| (B::decode(weights.clone(), vertices.clone(), decoder.clone()), (weights, vertices, decoder)))
    }
    fn trilinear(
        features: FloatTensor<Self>,
        corners: IntTensor<Self>,
        weights: FloatTensor<Self>,
        slots: IntTensor<Self>,
        starts: IntTensor<Self>,
    ) -> FloatTensor<Self> {
        let (features, parent) = features.into_parts();
        let weights = weights.into_primitive();
        record::<B, C, _, 1>(Interpolate, [parent], |_| {
            (B::trilinear(features, corners, weights.clone(), slots.clone(), starts.clone()), (weights, slots, starts))
        })
    }
    fn network(x: FloatTensor<Self>, weights: FloatTensor<Self>, shape: Arc<ReluShape>) -> FloatTensor<Self> {
        let ((x, of_input), (weights, of_weights)) = (x.into_parts(), weights.into_parts());
        record::<B, C, _, 2>(Network, [of_input, of_weights], |_| (B::network(x.clone(), weights.clone(), shape.clone()), (x, weights, shape)))
    }
}

impl VoxelCorners {
    /// Features `[U,F]` of the vertices: hash signature, then the decoder's network. `weights` is flat in the order of [`crate::cpu::mlp::mish`];
    /// the gradient goes to it alone.
    pub fn decode(&self, weights: Tensor<1>, decoder: &Arc<Decoder>) -> Result<Tensor<2>> {
        check_weights("decoder", weights.dims()[0], decoder.shape.parameter_count())?;
        if decoder.hash.len() != decoder.shape.input {
            return Err(Error::parameter("decoder", format!("{} hash functions feed {} inputs", decoder.hash.len(), decoder.shape.input), "Make them equal"));
        }
        check_vertices(&weights.device(), decoder, self.vertices.dims()[0])?;
        Ok(Tensor::from_dispatch(<Dispatch as FieldOps>::decode(weights.into_dispatch(), self.vertices.clone().into_dispatch(), decoder.clone())))
    }
    /// Trilinear interpolation of vertex `features` `[U,F]` at the points `[M,F]`.
    pub fn interpolate(&self, features: Tensor<2>) -> Result<Tensor<2>> {
        let ([u, width], [vertices, _], [corners]) = (features.dims(), self.vertices.dims(), self.corners.dims());
        if u != vertices {
            return Err(Error::parameter("interpolation", format!("{u} feature rows for {vertices} vertices"), "Decode the vertices of the same level"));
        }
        check_binding(&features.device(), "interpolation", "vertices", u, width * size_of::<f32>())?;
        check_binding(&features.device(), "interpolation", "points", corners / 8, width * size_of::<f32>())?;
        let [corners, slots, starts] = [&self.corners, &self.slots, &self.starts].map(|t| t.clone().into_dispatch());
        Ok(Tensor::from_dispatch(<Dispatch as FieldOps>::trilinear(features.into_dispatch(), corners, self.weights.clone().into_dispatch(), slots, starts)))
    }
}

/// Runs a trunk-and-heads ReLU network over `x` `[M,in]`; one output `[M,width]` per head (or the trunk's). `weights` is flat in the order of
/// [`crate::cpu::mlp::relu`].
pub fn mlp_relu(x: Tensor<2>, weights: Tensor<1>, shape: &Arc<ReluShape>) -> Result<Vec<Tensor<2>>> {
    let [m, _] = x.dims();
    Ok(split_heads(&mlp_relu_flat(x, weights, shape)?, m, &shape.output_widths()))
}

/// As [`mlp_relu`], with the outputs in one flat tensor, head after head.
pub fn mlp_relu_flat(x: Tensor<2>, weights: Tensor<1>, shape: &Arc<ReluShape>) -> Result<Tensor<1>> {
    let [m, width] = x.dims();
    if !shape.is_sound() || width != shape.input || m == 0 {
        return Err(Error::parameter("network", format!("input [{m},{width}] for layers {shape:?}"), "Give at least one row and widths that fit"));
    }
    check_weights("network", weights.dims()[0], shape.parameter_count())?;
    check_rows(&x.device(), shape, m)?;
    Ok(Tensor::from_dispatch(<Dispatch as FieldOps>::network(x.into_dispatch(), weights.into_dispatch(), shape.clone())))
}

/// The outputs of [`mlp_relu_flat`] where each head `[M, times x width]` has per row its outputs at one time after those at another: time after time, one
/// `[M,width]` per head.
pub fn split_times(flat: Tensor<1>, rows: usize, widths: &[usize], times: usize) -> Vec<Vec<Tensor<2>>> {
    if times == 1 {
        return vec![split_heads(&flat, rows, widths)];
    }
    let pieces = split::split_heads(flat, PieceLayout { rows, widths: widths.to_vec(), times });
    let of_time = |heads: &[Tensor<1>]| heads.iter().zip(widths).map(|(head, &width)| head.clone().reshape([rows, width])).collect();
    pieces.chunks(widths.len().max(1)).map(of_time).collect()
}

/// The heads `[rows, width]` of a flat array that holds one after the other.
pub(super) fn split_heads(flat: &Tensor<1>, rows: usize, widths: &[usize]) -> Vec<Tensor<2>> {
    if let [only] = widths {
        return vec![flat.clone().reshape([rows, *only])];
    }
    let heads = split::split_heads(flat.clone(), PieceLayout { rows, widths: widths.to_vec(), times: 1 });
    heads.into_iter().zip(widths).map(|(head, &width)| head.reshape([rows, width])).collect()
}

/// An error if an array of the network with this many rows is more than one binding of `device` holds.
#[cfg(feature = "cube")]
fn check_rows(device: &Device, shape: &ReluShape, rows: usize) -> Result<()> {
    let plain = device.clone().without_autodiff();
    let burn::backend::DispatchDevice::Cube(own) = plain.as_dispatch() else { return Ok(()) };
    let floats = crate::cube::field::widest_row(shape, crate::cube::tensor::shared_bytes(&own.client()));
    check_binding(device, "network", "points", rows, floats * size_of::<f32>())
}

/// An error if an array is more than one binding of the device holds. Processors have no such limit.
#[cfg(not(feature = "cube"))]
fn check_rows(_: &Device, _: &ReluShape, _: usize) -> Result<()> {
    Ok(())
}

/// An error if an array of the decoder with a row per vertex is more than one binding of `device` holds.
#[cfg(feature = "cube")]
fn check_vertices(device: &Device, decoder: &Decoder, vertices: usize) -> Result<()> {
    let plain = device.clone().without_autodiff();
    let burn::backend::DispatchDevice::Cube(own) = plain.as_dispatch() else { return Ok(()) };
    let floats = crate::cube::field::widest_decoder_row(decoder, crate::cube::tensor::shared_bytes(&own.client()));
    check_binding(device, "decoder", "vertices", vertices, floats * size_of::<f32>())
}

/// An error if an array is more than one binding of the device holds. Processors have no such limit.
#[cfg(not(feature = "cube"))]
fn check_vertices(_: &Device, _: &Decoder, _: usize) -> Result<()> {
    Ok(())
}

fn check_weights(object: &str, got: usize, want: usize) -> Result<()> {
    if got == want {
        return Ok(());
    }
    Err(Error::parameter(object, format!("{got} weights, the layers need {want}"), "Load weights of the same configuration"))
}
