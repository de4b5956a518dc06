//! Which Gaussians are added, moved and removed during training.

mod clone_split;
mod none;
