//! Dataset readers: each on a tiny scene written by the test, on hostile bytes, and on the real scenes where they are present.

mod common;
mod conformance;
mod formats;
mod golden;
mod hostile;
mod procedural;
mod real;
mod selection;
