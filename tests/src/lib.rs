//! cc4dgs-tests
