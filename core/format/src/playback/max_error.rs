//! How far a playback layer may be off.

use crate::{Error, Result};
use serde::Serialize;
use std::fmt;
use std::str::FromStr;

/// The bound on errors of a layer: how far any point within three standard deviations of a Gaussian may lie from where the deformer puts it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaxError {
    /// Pixels in the nearest camera that sees the Gaussian.
    Pixels(f32),
    /// A length in units of the model.
    Length(f32),
}

impl MaxError {
    /// Refuses bounds that are not positive and finite.
    ///
    /// # Errors
    /// [`Error::Parameter`].
    pub fn check(self) -> Result<()> {
        let (Self::Pixels(value) | Self::Length(value)) = self;
        if value.is_finite() && value > 0.0 {
            return Ok(());
        }
        Err(Error::parameter("--max-error", format!("{value} is not a positive number"), "Give pixels, such as 0.1px, or a length, such as 0.002"))
    }
}

impl fmt::Display for MaxError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pixels(value) => write!(f, "{value}px"),
            Self::Length(value) => write!(f, "{value}"),
        }
    }
}

impl FromStr for MaxError {
    type Err = Error;
    /// `0.1px`, or a length in units of the model such as `0.002`.
    fn from_str(text: &str) -> Result<Self> {
        let (number, pixels) = text.strip_suffix("px").map_or((text, false), |number| (number, true));
        let value = number.trim().parse::<f32>();
        let value = value.map_err(|_| Error::parameter("--max-error", format!("'{text}' is no error bound"), "Write pixels, 0.1px, or a length, 0.002"))?;
        let parsed = if pixels { Self::Pixels(value) } else { Self::Length(value) };
        parsed.check()?;
        Ok(parsed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_read_strictly() {
        assert_eq!("0.1px".parse::<MaxError>().unwrap(), MaxError::Pixels(0.1));
        assert_eq!("0.002".parse::<MaxError>().unwrap(), MaxError::Length(0.002));
        assert_eq!(MaxError::Pixels(0.1).to_string(), "0.1px");
        for bad in ["", "px", "-1px", "0", "nan", "inf", "1cm"] {
            assert!(bad.parse::<MaxError>().is_err(), "{bad}");
        }
    }
}
