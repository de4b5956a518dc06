//! The tensor operations burn lacks. Each is a `backend_extension` trait with an implementation per device and a hand-written backward.

pub mod adam;
pub mod basis;
pub mod corners;
pub mod field;
pub mod lookup;
pub mod photometric;
pub mod picture;
pub mod rasterize;
pub mod sort;
