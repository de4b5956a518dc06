//! Suites that every plug-in passes, ours and anyone's: call them from a test of your own crate.
//!
//! Each returns what it found wrong, one line per finding; an empty list is a pass. They draw their own inputs and need no data, but for readers, which need a tiny dataset.

mod deformer;
mod density;
mod loss;
mod preset;
mod rasterizer;
mod reader;

pub use cc4dgs_format::conformance::{codec, weight_codec};
pub use deformer::deformer;
pub use density::density;
pub use loss::loss;
pub use preset::preset;
pub use rasterizer::rasterizer;
pub use reader::reader;

use crate::Seed;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_format::conformance::uniform;

/// [rows, width] uniform in -1..1.
fn matrix(seed: Seed, rows: usize, width: usize, device: &Device) -> Tensor<2> {
    let values: Vec<f32> = (0..rows * width).map(|k| uniform(seed, k)).collect();
    Tensor::from_data(TensorData::new(values, [rows, width]), device)
}
