//! A few of many, evenly spread.

pub(crate) use cc4dgs_core::sample::{spread, spread_from_first, spread_views};
