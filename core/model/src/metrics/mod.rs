//! Image metrics, each with its protocol spelled out.
