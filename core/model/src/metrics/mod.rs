//! Image metrics. A score depends on its protocol, so a [`Metric`] carries its [`Protocol`].
//!
//! Low-level functions ([`psnr`], [`ssim`], [`ms_ssim`]) take [`Planes`] in float64; [`Metric::score`] takes float32 planes as rasterizers
//! return them and applies the protocol (rounding, mask) first. All sums run in a fixed order, so a score does not depend
//! on the number of threads.

mod ms_ssim;
mod planes;
mod protocol;
mod psnr;
mod ssim;

pub use ms_ssim::{MS_SSIM_WEIGHTS, ms_ssim};
pub use planes::Planes;
pub use protocol::{FrameSet, MaskRule, Metric, MetricKind, Padding, Protocol, Rounding, Window};
pub use psnr::{PSNR_CEILING_DB, mean_absolute_error, mean_squared_error, psnr};
pub use ssim::{SsimConvention, ssim};
