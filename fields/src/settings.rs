//! Settings that several fields share.

use cc4dgs_format::{Error, Result, config};
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// Keys of a `[deformer]` section that say how it is trained, and nothing about its values.
pub const RATE_KEYS: [&str; 4] = ["lr_start", "lr_end", "warmup", "clip_norm"];

/// Named sizes of the rate-distortion curve.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Capacity {
    /// 4 levels, decoders 128-64-64-16, network 64 wide.
    Small,
    /// 5 levels, decoders 128-96-96-32, network 96 wide.
    Mid,
    /// 5 levels, decoders 128-128-128-32, network 128 wide (the paper's).
    #[default]
    Default,
}

impl Capacity {
    /// Width of the networks behind the voxel features.
    pub fn width(self) -> usize {
        match self {
            Self::Small => 64,
            Self::Mid => 96,
            Self::Default => 128,
        }
    }
}

/// Moves `keys` out of `section` and parses them.
///
/// # Errors
/// [`Error::Parameter`] for values of wrong types.
pub fn take<T: DeserializeOwned>(section: &mut toml::Table, keys: &[&str]) -> Result<T> {
    let own: toml::Table = keys.iter().filter_map(|k| section.remove(*k).map(|v| (k.to_string(), v))).collect();
    config::parse_section("deformer", &own)
}

/// Refuses a size outside `low..=high`.
///
/// # Errors
/// [`Error::Parameter`] for `deformer.NAME`.
pub fn within(name: &str, value: usize, low: usize, high: usize) -> Result<()> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(Error::parameter(format!("deformer.{name}"), format!("{value} is outside {low}..={high}"), "Choose a value in that range"))
}
