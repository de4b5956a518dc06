//! Density controls: they add, move and remove Gaussians during training.

mod clone_split;
mod none;
