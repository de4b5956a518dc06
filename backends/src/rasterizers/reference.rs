//! The rasterizer `reference`.
