//! A deformer that cc4dgs knows nothing of.

mod sway;
