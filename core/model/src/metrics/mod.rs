//! Image metrics. A score depends on its protocol, so a [`Metric`] carries its [`Protocol`].
//!
//! Low-level functions ([`psnr`], [`ssim`], [`ms_ssim`], [`flip`], [`Lpips::distance`]) take [`Planes`] in float64; [`Metric::score`] takes float32 planes as
//! rasterizers return them and applies the protocol (rounding, mask) first. All sums run in a fixed order, so a score does not depend on the number of threads.

mod flip;
#[cfg(test)]
mod golden;
mod lpips;
mod ms_ssim;
mod planes;
mod protocol;
mod psnr;
mod ssim;

pub use flip::{FLIP_PIXELS_PER_DEGREE, flip, flip_map};
pub use lpips::{InstalledLpips, LPIPS_FILE, LPIPS_SMALLEST_SIDE, LPIPS_VARIABLE, Lpips, WeightsId, installed_lpips, lpips_paths};
pub use ms_ssim::{MS_SSIM_WEIGHTS, ms_ssim};
pub use planes::Planes;
pub use protocol::{FrameSet, MaskRule, Metric, MetricKind, Padding, Protocol, Rounding, Window};
pub use psnr::{PSNR_CEILING_DB, mean_absolute_error, mean_squared_error, psnr, psnr_of_mean_squared_error};
pub use ssim::{SsimConvention, ssim};
