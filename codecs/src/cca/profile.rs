//! Bit budgets (paper, table of the CCA bitrate sweep) and the encoder's effort.

use cc4dgs_format::{Error, Result, config, unknown_name};
use serde::Deserialize;

/// Bits per quantised value, codebook size, and the largest loss of each attribute.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    /// The profile's name, as in `cca:NAME`.
    pub name: &'static str,
    /// Bits of an autoencoder latent.
    pub latent_bits: u8,
    /// Entries of the residual codebook.
    pub codebook: usize,
    /// Bits of log-scales, opacity logits and quaternion components.
    pub scalar_bits: u8,
    /// Bits of a dynamic score.
    pub dynamic_bits: u8,
    /// Largest root-mean-square error of log-scales, opacity logits and quaternions, over their standard deviation.
    pub scalar_loss: f64,
    /// The same for dynamic scores.
    pub dynamic_loss: f64,
    /// The same for colour coefficients. Of white noise, 24 latents represent 24 of 45 dimensions: an error of sqrt(21/45) = 0.68
    /// before the codebook. A scene with a larger error than this limit is stored without the autoencoder.
    pub appearance_loss: f64,
}

/// The profiles, the default first.
const PROFILES: [Profile; 3] = [
    Profile {
        name: "default",
        latent_bits: 14,
        codebook: 256,
        scalar_bits: 12,
        dynamic_bits: 16,
        scalar_loss: 0.004,
        dynamic_loss: 0.002,
        appearance_loss: 0.65,
    },
    Profile { name: "mid", latent_bits: 12, codebook: 128, scalar_bits: 10, dynamic_bits: 12, scalar_loss: 0.015, dynamic_loss: 0.02, appearance_loss: 0.65 },
    Profile { name: "low", latent_bits: 10, codebook: 64, scalar_bits: 8, dynamic_bits: 10, scalar_loss: 0.06, dynamic_loss: 0.05, appearance_loss: 0.65 },
];

impl Profile {
    /// The profile called `name`; empty is the default one.
    pub fn named(name: &str) -> Result<Self> {
        let wanted = if name.is_empty() { PROFILES[0].name } else { name };
        PROFILES.into_iter().find(|p| p.name == wanted).ok_or_else(|| unknown_name("profile of codec cca", name, PROFILES.iter().map(|p| p.name)))
    }
}

/// Settings with their defaults, as shown to users.
pub(super) const SCHEMA: &str = "\
epochs = 60              # upper bound on the passes of autoencoder training over the Gaussians
sample_budget = 3000000  # upper bound on the training samples in total; bounds the encoding time
";

/// How long the autoencoder is trained. Decoding does not depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Upper bound on the passes over the Gaussians.
    pub epochs: usize,
    /// Upper bound on the training samples in total.
    pub sample_budget: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { epochs: 60, sample_budget: 3_000_000 }
    }
}

impl Settings {
    /// Reads a configuration table; unknown keys and values out of range are errors.
    pub fn parse(table: &toml::Table) -> Result<Self> {
        let settings: Self = config::parse_section("codec cca", table)?;
        if !(1..=100_000).contains(&settings.epochs) || !(1..=10_000_000_000).contains(&(settings.sample_budget as u64)) {
            return Err(Error::parameter(
                "codec cca",
                format!("epochs {} or sample_budget {} is out of range", settings.epochs, settings.sample_budget),
                "Choose epochs from 1 to 100000 and sample_budget from 1 to 10000000000",
            ));
        }
        Ok(settings)
    }
}
