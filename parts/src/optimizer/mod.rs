//! Optimizers: from gradients to new values.

mod adam;
