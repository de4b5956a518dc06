//! The playback layer: motion that a player can evaluate without the deformer.
//!
//! The offsets of a Gaussian are linear in functions of time that all Gaussians share: offsets(t) = C φ(t). φ is sampled at even times over the sequence and
//! interpolated linearly in between. Each Gaussian uses only as many of the functions as it needs, so one that drifts costs one coefficient per number, and one
//! that dances costs more. A deformer that is linear in its functions (`cdf-basis`, `hash-basis`) is represented exactly by as many functions as it has; all
//! others by a truncated singular value decomposition over the samples. Where motion is large, the sequence is divided into segments with functions and
//! coefficients of their own; neighbours share the sample between them.
//!
//! Layers of deformers that are linear can be computed from their weights when a model is opened ([`PlaybackLayer::computed`]): such files need none.
//!
//! `cc4dgs bake` writes the layer into an archive, beside the Gaussians that it moves. [`PlaybackLayer::apply`] is the reference for players.

mod checks;
mod computed;
mod layer;
mod max_error;
mod sizes;
mod streams;

pub use computed::{ComputedMotion, MotionPlugin, MotionSource};
pub use layer::{Head, MAX_FUNCTIONS, MAX_SAMPLES, MAX_SEGMENTS, PlaybackLayer, Segment, TimeWeights, Track};
pub use max_error::MaxError;
pub use streams::{CodedTrack, exponent_step};

/// Normalised time of frame `frame` of `frames`: 0 for the first, 1 for the last.
pub fn frame_time(frame: usize, frames: usize) -> f32 {
    (frame as f64 / frames.saturating_sub(1).max(1) as f64) as f32
}
