//! Dataset readers: each on a tiny scene written by the test, on untrusted bytes, and on real scenes if they are present.

mod common;
mod conformance;
mod formats;
mod golden;
mod hostile;
mod invariance;
mod procedural;
mod real;
mod selection;
mod videos;
