//! Density controls: they add, move and remove Gaussians during training.

mod clone_split;
mod halves;
mod mcmc;
mod none;
mod statistics;

/// Statistics of a view of 8x8 pixels in which Gaussians have these radii.
#[cfg(test)]
fn seen(radii: &[i64], device: &burn::tensor::Device) -> cc4dgs_core::ViewStatistics {
    use burn::tensor::{Int, Tensor, TensorData};
    use cc4dgs_core::{Camera, Split, View, ViewStatistics};
    let camera = Camera::look_at("test", (8, 8), 1.0, [0.0, -4.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]);
    let view = View { camera: 0, frame: 0, time_norm: 0.0, split: Split::Train };
    ViewStatistics::new(camera, view, Tensor::<1, Int>::from_data(TensorData::new(radii.to_vec(), [radii.len()]), device))
}
