//! Sweeps: a grid of scenes, methods, settings, codecs and seeds, its results, and their tables.

mod read;
mod result;

pub use read::{RESULTS, check_comparable, read_results};
pub use result::{
    Axes, Blocks, CellResult, CodecChoice, Cost, Curve, DataFingerprint, DeviceFacts, FrameMs, ImageResult, KIND, Outcome, ResultProvenance, SCHEMA, Score,
    Storage, StreamBytes,
};
