//! Settings that several fields share.

use cc4dgs_format::{Error, Result, config, unknown_name};
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

/// Refuses one of `given` that is in none of the `parts`. For sections that are read in parts, so that the error lists the settings of all.
///
/// # Errors
/// [`Error::Parameter`] with the most similar names, and all.
pub fn refuse_unknown<'k>(mut given: impl Iterator<Item = &'k String>, parts: &[&[&str]]) -> Result<()> {
    let known = || parts.iter().flat_map(|part| part.iter().copied());
    match given.find(|key| known().all(|name| name != key.as_str())) {
        Some(key) => Err(unknown_name("setting of the deformer", key, known())),
        None => Ok(()),
    }
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

/// Parameters of a deformer at most: 1 GiB of float32. The largest published one, `grid4d` at its full size, has a quarter of that.
const MOST_PARAMETERS: usize = 1 << 28;

/// Refuses arrays of more parameters together than a deformer may have. Call it before they are allocated: sizes may come from a file.
///
/// # Errors
/// [`Error::Limit`].
pub fn bounded(counts: impl IntoIterator<Item = usize>) -> Result<()> {
    let total = counts.into_iter().fold(0usize, usize::saturating_add);
    if total <= MOST_PARAMETERS {
        return Ok(());
    }
    Err(Error::limit("parameters of the deformer", total as u64, MOST_PARAMETERS as u64, "Choose smaller sizes in the [deformer] section"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_sizes_are_bounded() {
        assert!(bounded([]).is_ok() && bounded([MOST_PARAMETERS / 2, MOST_PARAMETERS / 2]).is_ok());
        assert!(bounded([MOST_PARAMETERS, 1]).is_err() && bounded([usize::MAX, usize::MAX]).is_err());
    }
}
