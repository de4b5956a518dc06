//! A metric and everything that its score depends on.

use super::{Lpips, Planes, SsimConvention, WeightsId, flip, ms_ssim, psnr, ssim};
use crate::{Error, Image8, Result, Split};
use serde::{Deserialize, Serialize, Serializer};
use std::sync::Arc;

/// Which formula.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MetricKind {
    /// Peak signal-to-noise ratio in dB, MSE over all channels and pixels of an image, mean over images.
    Psnr,
    /// Structural similarity.
    Ssim,
    /// Multi-scale structural similarity (pytorch-msssim, float64 window).
    MsSsim,
    /// The learned perceptual distance, version 0.1 on AlexNet: lower is better.
    Lpips,
    /// The visible difference on flipping between the images, mean over pixels: lower is better.
    Flip,
}

/// Rounding of pixel values before they are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rounding {
    /// Both images are compared without rounding.
    Float,
    /// Both are clamped to 0..1 and rounded to 256 levels, as if saved as PNG (the protocol of published tables).
    EightBit,
}

/// The Gaussian window of SSIM and MS-SSIM, weights in float64.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Window {
    /// Taps per axis.
    pub taps: usize,
    /// Standard deviation in pixels.
    pub sigma: f64,
}

/// Values of a window beyond the border.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Padding {
    /// None: only windows inside the image count.
    Valid,
    /// Zeros: every pixel is the centre of a window.
    Zero,
}

/// Which pixels count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaskRule {
    /// All pixels.
    Whole,
    /// Pixels set in a mask (for SSIM: windows centred on them).
    Masked,
}

/// The images of a scene that a mean is over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameSet {
    /// The side of the split.
    pub split: Split,
    /// Number of images that are scored, evenly spread. The mean of a masked metric is over those of them in which the mask has a pixel.
    pub count: usize,
    /// Number of images of the split.
    pub of: usize,
    /// Background behind transparent pixels, RGB in 0..1; it changes the scores of contours.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub background: Option<[f32; 3]>,
}

/// Everything that a score depends on besides the images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Protocol {
    /// The formula.
    pub metric: MetricKind,
    /// The convention, if several are in use.
    pub convention: Option<SsimConvention>,
    /// The span from black to white.
    pub data_range: f64,
    /// Rounding before the comparison.
    pub rounding: Rounding,
    /// The window, for windowed metrics.
    pub window: Option<Window>,
    /// Its border rule.
    pub padding: Option<Padding>,
    /// Which pixels count.
    pub mask: MaskRule,
    /// The images that the mean is over, once known.
    pub frames: Option<FrameSet>,
    /// The network, for learned metrics.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<WeightsId>,
    /// How much of the image the eye sees, for metrics with a viewing distance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixels_per_degree: Option<f64>,
}

/// A metric with its [`Protocol`]. Only the constructors below create one, so the protocol always states what is computed.
#[derive(Clone, Debug)]
pub struct Metric {
    protocol: Protocol,
    /// Of LPIPS.
    network: Option<Arc<Lpips>>,
}

impl PartialEq for Metric {
    fn eq(&self, other: &Self) -> bool {
        self.protocol == other.protocol
    }
}

impl Serialize for Metric {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        self.protocol.serialize(serializer)
    }
}

impl Metric {
    /// PSNR of data range 1.
    pub fn psnr(rounding: Rounding) -> Self {
        Self::new(MetricKind::Psnr, None, rounding, None, None)
    }
    /// SSIM of data range 1.
    pub fn ssim(convention: SsimConvention, rounding: Rounding) -> Self {
        Self::new(MetricKind::Ssim, Some(convention), rounding, Some(convention.window()), Some(convention.padding()))
    }
    /// MS-SSIM of data range 1.
    pub fn ms_ssim(rounding: Rounding) -> Self {
        Self::new(MetricKind::MsSsim, None, rounding, Some(SsimConvention::Skimage.window()), Some(Padding::Valid))
    }
    /// LPIPS of colours in 0..1, which the network sees in -1..1.
    pub fn lpips(network: Arc<Lpips>, rounding: Rounding) -> Self {
        let mut metric = Self::new(MetricKind::Lpips, None, rounding, None, None);
        metric.protocol.weights = Some(network.id().clone());
        Self { network: Some(network), ..metric }
    }
    /// FLIP of images in sRGB, seen with `pixels_per_degree` (usually [`super::FLIP_PIXELS_PER_DEGREE`]).
    pub fn flip(pixels_per_degree: f64, rounding: Rounding) -> Self {
        let mut metric = Self::new(MetricKind::Flip, None, rounding, None, None);
        metric.protocol.pixels_per_degree = Some(pixels_per_degree);
        metric
    }
    /// The same metric over masked pixels only.
    pub fn masked(mut self) -> Self {
        self.protocol.mask = MaskRule::Masked;
        self
    }
    /// The same metric, recording the images that its mean is over.
    pub fn over(mut self, frames: FrameSet) -> Self {
        self.protocol.frames = Some(frames);
        self
    }
    /// What the score depends on.
    pub fn protocol(&self) -> &Protocol {
        &self.protocol
    }
    /// The score of `render` against `reference`, both planes `[channels, height, width]` in 0..1. A masked metric needs a mask `[H,W]`, others must not get
    /// one.
    ///
    /// # Errors
    /// [`Error::Parameter`] for shapes and masks that do not match, [`Error::Data`] for values that are not finite, [`Error::Unsupported`] for MS-SSIM with a
    /// mask.
    pub fn score(&self, reference: &[f32], render: &[f32], shape: [usize; 3], mask: Option<&[bool]>) -> Result<f64> {
        let [channels, height, width] = shape;
        let planes = |values: &[f32]| match self.protocol.rounding {
            Rounding::Float => Planes::from_f32(values, channels, height, width),
            Rounding::EightBit => Planes::from_f32_rounded(values, channels, height, width),
        };
        if mask.is_some() != (self.protocol.mask == MaskRule::Masked) {
            return Err(Error::parameter(
                "metric mask",
                "a mask was given for an unmasked metric, or is missing for a masked one",
                "Use Metric::masked() if and only if a mask is passed",
            ));
        }
        self.compute(&planes(reference)?, &planes(render)?, mask)
    }
    /// The score of two 8-bit images, which are rounded already; alpha channels are ignored. Refuses masked metrics.
    ///
    /// # Errors
    /// As [`Metric::score`].
    pub fn score_images(&self, reference: &Image8, render: &Image8) -> Result<f64> {
        if self.protocol.mask == MaskRule::Masked {
            return Err(Error::parameter("metric mask", "a masked metric needs a mask", "Use Metric::score"));
        }
        self.compute(&Planes::from_image8(reference)?, &Planes::from_image8(render)?, None)
    }
    fn compute(&self, reference: &Planes, render: &Planes, mask: Option<&[bool]>) -> Result<f64> {
        match self.protocol.metric {
            MetricKind::Psnr => psnr(reference, render, mask),
            MetricKind::Ssim => ssim(reference, render, self.protocol.convention.unwrap_or(SsimConvention::Skimage), mask),
            kind if mask.is_some() => {
                Err(Error::unsupported(format!("{kind:?} with a mask"), "there is no established definition of it", "Use SSIM for masked pixels"))
            }
            MetricKind::MsSsim => ms_ssim(reference, render),
            MetricKind::Lpips => match &self.network {
                Some(network) => network.distance(reference, render),
                None => Err(Error::parameter("LPIPS", "the metric has no network", "Make it with Metric::lpips")),
            },
            MetricKind::Flip => flip(reference, render, self.protocol.pixels_per_degree.unwrap_or(super::FLIP_PIXELS_PER_DEGREE)),
        }
    }
    fn new(metric: MetricKind, convention: Option<SsimConvention>, rounding: Rounding, window: Option<Window>, padding: Option<Padding>) -> Self {
        let protocol = Protocol {
            metric,
            convention,
            data_range: 1.0,
            rounding,
            window,
            padding,
            mask: MaskRule::Whole,
            frames: None,
            weights: None,
            pixels_per_degree: None,
        };
        Self { protocol, network: None }
    }
}
