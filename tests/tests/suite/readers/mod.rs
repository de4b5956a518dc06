//! Dataset readers: each on a tiny scene written by the test, on untrusted bytes, and on real scenes if they are present.

mod captures;
mod clouds;
mod colmap;
pub mod common;
mod conformance;
mod course;
mod damaged_videos;
mod depth;
mod first_points;
mod formats;
mod golden;
mod hostile;
mod invariance;
mod procedural;
mod real;
mod recordings;
mod rigs;
mod selection;
mod videos;
