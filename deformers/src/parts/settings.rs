//! Settings that several deformers share. They are taken out of a `[deformer]` section before the deformer parses the rest.

pub use cc4dgs_fields::settings::{Capacity, RATE_KEYS, bounded, refuse_unknown, take, within};

use cc4dgs_core::{Error, ParameterGroup, Result};
use serde::Deserialize;

/// How the weights are optimised.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rates {
    /// First learning rate.
    pub lr_start: f64,
    /// Last learning rate.
    pub lr_end: f64,
    /// Share of the stage spent warming up.
    pub warmup: f64,
    /// Gradient-norm clip per group; 0 is off.
    pub clip_norm: f64,
}

impl Default for Rates {
    fn default() -> Self {
        Self { lr_start: 1e-3, lr_end: 1e-5, warmup: 500.0 / 20_000.0, clip_norm: 1.0 }
    }
}

/// Refuses learning rates and weights of losses that are negative or not finite in float32.
///
/// # Errors
/// [`Error::Parameter`] for `deformer.NAME`.
pub fn not_negative(values: &[(&str, f64)]) -> Result<()> {
    match values.iter().find(|(_, value)| !(0.0..=f64::from(f32::MAX)).contains(value)) {
        Some((name, value)) => {
            Err(Error::parameter(format!("deformer.{name}"), format!("{value} is negative or not finite"), "Give a finite number of 0 or more"))
        }
        None => Ok(()),
    }
}

impl Rates {
    /// The keys of these settings in a `[deformer]` section.
    pub const KEYS: [&'static str; 4] = RATE_KEYS;
    /// Refuses rates that are negative or not finite, and a warm-up outside 0..1.
    ///
    /// # Errors
    /// [`Error::Parameter`].
    pub fn check(&self) -> Result<()> {
        not_negative(&[("lr_start", self.lr_start), ("lr_end", self.lr_end), ("clip_norm", self.clip_norm)])?;
        if !(0.0..=1.0).contains(&self.warmup) {
            return Err(Error::parameter("deformer.warmup", format!("{} is not in 0..1", self.warmup), "Give a share from 0 to 1"));
        }
        Ok(())
    }
    /// An optimizer group at these rates.
    pub fn group(&self, name: &str) -> ParameterGroup {
        ParameterGroup {
            name: name.into(),
            lr_start: self.lr_start,
            lr_end: self.lr_end,
            warmup: self.warmup,
            times_extent: false,
            epsilon: 1e-15,
            clip_norm: self.clip_norm,
        }
    }
}
