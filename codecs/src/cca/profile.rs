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

/// Bits that a quantised value may have, and the most entries of a codebook: labels are bytes.
const BITS: std::ops::RangeInclusive<u8> = 4..=16;
const LARGEST_CODEBOOK: usize = 256;

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
    /// The profile with the bit budgets that `settings` state in place of its own. Each may lose what the most generous profile of no more bits may lose, and
    /// below all profiles twice as much for every bit less; otherwise a column would take more bits than it was given.
    pub fn with(self, settings: &Settings) -> Self {
        let scalar = |bits| loss_of(bits, PROFILES.map(|p| (p.scalar_bits, p.scalar_loss)));
        let dynamic = |bits| loss_of(bits, PROFILES.map(|p| (p.dynamic_bits, p.dynamic_loss)));
        Self {
            latent_bits: settings.latent_bits.unwrap_or(self.latent_bits),
            codebook: settings.codebook.unwrap_or(self.codebook),
            scalar_bits: settings.scalar_bits.unwrap_or(self.scalar_bits),
            scalar_loss: settings.scalar_bits.map_or(self.scalar_loss, scalar),
            dynamic_bits: settings.dynamic_bits.unwrap_or(self.dynamic_bits),
            dynamic_loss: settings.dynamic_bits.map_or(self.dynamic_loss, dynamic),
            ..self
        }
    }
}

/// The loss of `bits`, from those of the profiles, the most bits first.
fn loss_of(bits: u8, profiles: [(u8, f64); 3]) -> f64 {
    let (least, most) = profiles[2];
    profiles.into_iter().find(|(own, _)| *own <= bits).map_or(most * f64::from(least - bits.min(least)).exp2(), |(_, loss)| loss)
}

/// Settings with their defaults, as shown to users.
pub(super) const SCHEMA: &str = "\
epochs = 60              # upper bound on the passes of autoencoder training over the Gaussians
sample_budget = 3000000  # upper bound on the training samples in total; bounds the encoding time
# latent_bits = 14       # bits of an autoencoder latent, 4 to 16; the profile's unless given (mid: 12; low: 10)
# codebook = 256         # entries of the residual codebook, 1 to 256 (mid: 128; low: 64)
# scalar_bits = 12       # bits of log-scales, opacity logits and quaternion components, 4 to 16 (mid: 10; low: 8)
# dynamic_bits = 16      # bits of a dynamic score, 4 to 16 (mid: 12; low: 10)
";

/// How long the autoencoder is trained, and bit budgets in place of the profile's. Decoding depends on neither.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Upper bound on the passes over the Gaussians.
    pub epochs: usize,
    /// Upper bound on the training samples in total.
    pub sample_budget: u64,
    /// In place of [`Profile::latent_bits`].
    pub latent_bits: Option<u8>,
    /// In place of [`Profile::codebook`].
    pub codebook: Option<usize>,
    /// In place of [`Profile::scalar_bits`].
    pub scalar_bits: Option<u8>,
    /// In place of [`Profile::dynamic_bits`].
    pub dynamic_bits: Option<u8>,
}

impl Default for Settings {
    fn default() -> Self {
        Self { epochs: 60, sample_budget: 3_000_000, latent_bits: None, codebook: None, scalar_bits: None, dynamic_bits: None }
    }
}

impl Settings {
    /// Reads a configuration table; unknown keys and values out of range are errors.
    pub fn parse(table: &toml::Table) -> Result<Self> {
        let settings: Self = config::parse_section("codec cca", table)?;
        if !(1..=100_000).contains(&settings.epochs) || !(1..=10_000_000_000).contains(&settings.sample_budget) {
            return Err(Error::parameter(
                "codec cca",
                format!("epochs {} or sample_budget {} is out of range", settings.epochs, settings.sample_budget),
                "Choose epochs from 1 to 100000 and sample_budget from 1 to 10000000000",
            ));
        }
        let bits = [("latent_bits", settings.latent_bits), ("scalar_bits", settings.scalar_bits), ("dynamic_bits", settings.dynamic_bits)];
        if let Some((name, Some(bits))) = bits.into_iter().find(|(_, bits)| bits.is_some_and(|bits| !BITS.contains(&bits))) {
            return Err(Error::parameter(format!("codec cca.{name}"), format!("{bits} bits"), "Choose 4 to 16, or leave it to the profile"));
        }
        if let Some(entries) = settings.codebook.filter(|entries| !(1..=LARGEST_CODEBOOK).contains(entries)) {
            return Err(Error::parameter("codec cca.codebook", format!("{entries} entries"), "Choose 1 to 256, or leave it to the profile"));
        }
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sample_budgets_over_32_bits_are_read_on_every_target() {
        // A type of 64 bits: pages read the settings of archives, too.
        let budget = |text: &str| -> Result<u64> { Ok(Settings::parse(&text.parse().unwrap())?.sample_budget) };
        assert_eq!(budget("sample_budget = 10000000000").unwrap(), 10_000_000_000);
        assert!(budget("sample_budget = 10000000001").is_err() && budget("sample_budget = 0").is_err());
    }

    #[test]
    fn a_budget_is_varied_alone() {
        let parse = |text: &str| Settings::parse(&text.parse().unwrap());
        let profile = Profile::named("").unwrap();
        let with = |text: &str| profile.with(&parse(text).unwrap());
        assert_eq!(with(""), profile);
        assert_eq!(with("latent_bits = 12"), Profile { latent_bits: 12, ..profile });
        assert_eq!(with("codebook = 64"), Profile { codebook: 64, ..profile });
        assert_eq!(with("scalar_bits = 8"), Profile { scalar_bits: 8, scalar_loss: 0.06, ..profile });
        assert_eq!(with("dynamic_bits = 11"), Profile { dynamic_bits: 11, dynamic_loss: 0.05, ..profile });
        // All budgets of a profile are that profile.
        let low = Profile::named("low").unwrap();
        assert_eq!(Profile { name: "low", ..with("latent_bits = 10\ncodebook = 64\nscalar_bits = 8\ndynamic_bits = 10") }, low);
        assert_eq!(with("scalar_bits = 5").scalar_loss, 0.48);
        for (text, key) in
            [("latent_bits = 3", "latent_bits"), ("scalar_bits = 17", "scalar_bits"), ("codebook = 257", "codebook"), ("dynamic_bits = 0", "dynamic")]
        {
            let message = parse(text).unwrap_err().to_string();
            assert!(message.contains(key) && message.contains("profile"), "{message}");
        }
    }
}
