//! cc4dgs
