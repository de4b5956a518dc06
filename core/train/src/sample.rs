//! A few of many, evenly spread.

pub(crate) use cc4dgs_core::sample::{by_group, spread, spread_from_first, spread_views};
