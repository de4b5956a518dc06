//! The `.cc4d` archive.
