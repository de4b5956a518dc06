//! The rasterizers made of the operations.
