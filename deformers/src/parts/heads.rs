//! The heads of deformers, and their conversion to offsets.

pub use cc4dgs_fields::heads::{Head, check};

use burn::tensor::Tensor;
use cc4dgs_core::Offsets;

/// Offsets from one output `[M, width]` per head.
pub fn offsets(heads: &[Head], outputs: Vec<Tensor<2>>, sh_degree: usize) -> Offsets {
    let mut offsets = Offsets::default();
    for (head, out) in heads.iter().zip(outputs) {
        let [m, _] = out.dims();
        match head {
            Head::Means => offsets.means = Some(out),
            Head::LogScales => offsets.log_scales = Some(out),
            Head::Quaternions => offsets.quaternions = Some(out),
            Head::Opacity => offsets.opacity_logits = Some(out.reshape([m])),
            Head::Sh => offsets.sh = Some(out.reshape([m, (sh_degree + 1).pow(2), 3])),
        }
    }
    offsets
}
