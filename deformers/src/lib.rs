//! Deformers (deformation fields). Each registers itself; link this crate and name one in the configuration.

pub mod basis;
pub mod cdf;
pub mod deform_mlp;
pub mod embedding;
pub mod free_time;
pub mod grid4d;
pub mod hexplane;
pub mod life;
pub mod native4d;
pub mod none;
pub mod parts;
pub mod swift4d;
