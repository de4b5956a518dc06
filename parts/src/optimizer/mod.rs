//! From gradients to new values.

mod adam;
