//! The heads of deformers: names and widths.

use cc4dgs_format::{Error, Result};
use serde::Deserialize;

/// An output of a deformer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Head {
    /// Centres, world units.
    Means,
    /// Log-scales.
    LogScales,
    /// Raw quaternions.
    Quaternions,
    /// Opacity logits.
    Opacity,
    /// Spherical-harmonics coefficients.
    Sh,
}

impl Head {
    /// Its name in settings and weights.
    pub fn name(self) -> &'static str {
        match self {
            Self::Means => "means",
            Self::LogScales => "log_scales",
            Self::Quaternions => "quaternions",
            Self::Opacity => "opacity",
            Self::Sh => "sh",
        }
    }
    /// Values per Gaussian, for spherical harmonics of `sh_degree`.
    pub fn width(self, sh_degree: usize) -> usize {
        match self {
            Self::Means | Self::LogScales => 3,
            Self::Quaternions => 4,
            Self::Opacity => 1,
            Self::Sh => 3 * (sh_degree + 1) * (sh_degree + 1),
        }
    }
}

/// Refuses an empty list and a head named twice.
///
/// # Errors
/// [`Error::Parameter`].
pub fn check(heads: &[Head]) -> Result<()> {
    if heads.is_empty() {
        return Err(Error::parameter("deformer.heads", "the list is empty", "Name at least one head, or use deformer kind = \"none\""));
    }
    if let Some((i, head)) = heads.iter().enumerate().find(|(i, h)| heads[..*i].contains(h)) {
        return Err(Error::parameter("deformer.heads", format!("'{}' appears again at index {}", head.name(), i), "Name each head once"));
    }
    Ok(())
}
