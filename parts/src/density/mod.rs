//! Density controls: they add, move and remove Gaussians during training.

mod clone_split;
mod halves;
mod mcmc;
mod none;
mod statistics;
