//! The rules of projection and blending that a model was trained with.

use serde::{Deserialize, Serialize};

/// The blur of 3D Gaussian splatting: what a pixel adds to both diagonal entries of the projected covariance, square pixels. A square pixel by itself has 1/12.
pub const BLUR: f64 = 0.3;

/// The blurs that can be drawn, square pixels: with less the smallest footprints fall between pixels, with more images are no longer of use.
pub const BLUR_RANGE: std::ops::RangeInclusive<f64> = 0.01..=100.0;

/// The blur of a camera with focal lengths `fx` and `fy`, in pixels, for a model that was trained with `blur` on images with focal lengths up to `focal`: a
/// longer one magnifies what training has blurred. Shorter ones, and an unknown `focal`, leave `blur` as it is.
pub fn blur_at(blur: f64, focal: Option<f64>, fx: f64, fy: f64) -> f64 {
    let magnified = focal.map_or(1.0, |focal| (fx * fy / (focal * focal)).max(1.0));
    (blur * magnified).min(*BLUR_RANGE.end())
}

/// Which reference implementation's rules decide the corner cases of projection and blending.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rules {
    /// gsplat 1.6: near 0.01, 3.33 sigma per axis, alpha cap 0.99 with zero gradient above it.
    #[default]
    Gsplat099,
    /// gsplat up to 1.5.3: as above with the cap at 0.999.
    Gsplat0999,
    /// Inria: near 0.2, square of 3 sigma of the major axis, alpha cap 0.99 that passes the gradient on.
    Inria,
}

impl Rules {
    /// Smallest camera depth drawn where a model does not say otherwise.
    pub fn near(self) -> f32 {
        match self {
            Self::Gsplat099 | Self::Gsplat0999 => 0.01,
            Self::Inria => 0.2,
        }
    }
}
