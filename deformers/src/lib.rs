//! Deformation fields. Each registers itself; link this crate and name one in the configuration.

pub mod basis;
pub mod cdf;
pub mod none;
pub mod parts;
