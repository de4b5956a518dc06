//! cc4dgs-engine
