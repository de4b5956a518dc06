//! Rasterizers: the trait, its inputs and outputs.

use crate::gaussians::to_vec;
use crate::{BLUR, Camera, Error, Gaussians, Image8, Plugin, Result, Rules};
use burn::tensor::{Device, Int, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Whether the parameters of [`Splats`] are raw or activated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ParameterSpace {
    /// Log-scales and opacity logits, as stored and optimised.
    #[default]
    Raw,
    /// Linear scales and opacities in 0..1.
    Activated,
}

/// The colour of each Gaussian.
// One value per render: boxing the larger variant would only cost an allocation.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub enum SplatColors {
    /// Spherical harmonics seen from the camera: max(0, SH(direction) + 0.5).
    Sh {
        /// Degree 0 `[N,3]`.
        dc: Tensor<2>,
        /// Degree 1 and up `[N,K,3]`; K may exceed what `degree` uses.
        rest: Tensor<3>,
        /// The degree to evaluate.
        degree: usize,
    },
    /// Three values per Gaussian, blended directly `[N,3]` (dynamic scores, labels).
    Direct(Tensor<2>),
}

/// Inputs of one render. Any tensor may carry a gradient.
#[derive(Clone, Debug)]
pub struct Splats {
    /// Centres in world units `[N,3]`.
    pub means: Tensor<2>,
    /// Log-scales, or scales when `space` is activated `[N,3]`.
    pub scales: Tensor<2>,
    /// Quaternions (w,x,y,z), normalised by the rasterizer `[N,4]`.
    pub quaternions: Tensor<2>,
    /// Opacity logits, or opacities when `space` is activated `[N]`.
    pub opacities: Tensor<1>,
    /// Colours.
    pub colors: SplatColors,
    /// Raw or activated.
    pub space: ParameterSpace,
    /// A tensor of zeros `[N,2]` whose gradient becomes d loss / d projected centre in pixels (densification reads it).
    pub screen_probe: Option<Tensor<2>>,
    /// A tensor of zeros `[N,2]` whose gradient becomes, per axis, the sum over pixels of the absolute value of each pixel's contribution to the gradient of
    /// `screen_probe` (AbsGS, Ye et al. 2024). Computed only if it is given.
    pub absolute_screen_probe: Option<Tensor<2>>,
    /// A tensor of zeros `[4,4]` whose gradient becomes d loss / d world_to_camera.
    pub camera_probe: Option<Tensor<2>>,
}

impl Splats {
    /// The splats of raw `gaussians`, colours evaluated up to `sh_degree`.
    pub fn from_gaussians(gaussians: &Gaussians, sh_degree: usize) -> Self {
        Self {
            means: gaussians.means.clone(),
            scales: gaussians.log_scales.clone(),
            quaternions: gaussians.quaternions.clone(),
            opacities: gaussians.opacity_logits.clone(),
            colors: SplatColors::Sh { dc: gaussians.sh_dc.clone(), rest: gaussians.sh_rest.clone(), degree: sh_degree.min(gaussians.sh_degree) },
            space: ParameterSpace::Raw,
            screen_probe: None,
            absolute_screen_probe: None,
            camera_probe: None,
        }
    }
}

/// How to render.
#[derive(Clone, Debug)]
pub struct RenderSettings {
    /// Corner-case rules.
    pub rules: Rules,
    /// Scale opacity by the share of the footprint the pixel blur added (Mip-Splatting's 2D filter).
    pub antialiased: bool,
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels, 0.01 to 100.
    pub blur: f64,
    /// Longest focal length in pixels of the images that the model was trained on: longer ones blur more ([`blur_at`](crate::blur_at)). `None`: all blur alike.
    pub focal: Option<f64>,
    /// Smallest camera depth drawn, world units; `None` leaves it to the rules.
    pub near: Option<f32>,
    /// Colour behind everything, RGB in 0..1 as in images `[3]`; may carry a gradient. `None` is black.
    pub background: Option<Tensor<1>>,
    /// Collect the largest blending weight of every Gaussian (weight pruning).
    pub max_weights: bool,
    /// Capacity in (Gaussian, tile) pairs, for devices that would otherwise wait until the count of every image was read back. Pairs beyond it are not drawn,
    /// those of the farthest Gaussians first, and gradients are wrong then; [`RenderStats::pair_count`] has the true count. Neither image nor gradients depend
    /// on a capacity that suffices. `None`, or more than the device's limit, draws all pairs.
    pub pair_capacity: Option<usize>,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self { rules: Rules::Gsplat099, antialiased: false, blur: BLUR, focal: None, near: None, background: None, max_weights: false, pair_capacity: None }
    }
}

/// One rendered view.
#[derive(Clone, Debug)]
pub struct RenderOutput {
    /// Planes `[5, H, W]`: red, green, blue (background included), alpha, depth (sum of weight times z, not normalised).
    /// Kept in one tensor so that a loss can read its planes without a copy.
    pub planes: Tensor<3>,
    /// Statistics without gradient.
    pub stats: RenderStats,
}

impl RenderOutput {
    /// Red, green, blue `[3,H,W]`.
    pub fn image(&self) -> Tensor<3> {
        self.planes.clone().narrow(0, 0, 3)
    }
    /// Coverage `[1,H,W]`.
    pub fn alpha(&self) -> Tensor<3> {
        self.planes.clone().narrow(0, 3, 1)
    }
    /// Accumulated depth in world units `[1,H,W]`.
    pub fn depth(&self) -> Tensor<3> {
        self.planes.clone().narrow(0, 4, 1)
    }
}

/// Statistics of one render.
#[derive(Clone, Debug)]
pub struct RenderStats {
    /// Screen radius in pixels; 0 where the Gaussian was culled `[N]`.
    pub radii: Tensor<1, Int>,
    /// Largest blending weight of each Gaussian over the image `[N]`, if [`RenderSettings::max_weights`] is set.
    pub max_weights: Option<Tensor<1>>,
    /// Number of (Gaussian, tile) pairs `[1]`, still on the device; `None` if a rasterizer has no tiles.
    pub pair_count: Option<Tensor<1, Int>>,
    /// Counts of work done.
    pub work: RenderWork,
}

/// Work counted during one render. Zero on devices that do not read their counters back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RenderWork {
    /// Gaussians that survived culling.
    pub visible: u64,
    /// (Gaussian, tile) pairs.
    pub tile_pairs: u64,
    /// (Gaussian, pixel) evaluations.
    pub pixel_pairs: u64,
}

/// Renders Gaussians, differentiably.
pub trait Rasterizer: Send + Sync {
    /// Renders `splats` through `camera`. Non-finite Gaussians are culled, never drawn. Every tensor of `splats` that tracks gradients, the probes included,
    /// receives one in the backward pass. A probe must not change the planes or other gradients. Several views may be drawn at a time by
    /// rayon's threads: hold no lock while a parallel loop runs.
    ///
    /// # Errors
    /// [`Error::Parameter`] for shapes and settings that do not fit, [`Error::Limit`] for sizes that the device cannot hold, [`Error::Unsupported`] for a
    /// device without this rasterizer.
    fn render(&self, splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput>;
    /// Planes `[3,H,W]` in 0..1 of an 8-bit image on `device`, alpha composited over `background` (RGB in 0..1); the same numbers as [`Image8::to_planes`].
    fn upload(&self, image: &Arc<Image8>, background: [f32; 3], device: &Device) -> Tensor<3> {
        let shape = [3, image.height as usize, image.width as usize];
        Tensor::from_data(TensorData::new(image.to_planes(background), shape), device)
    }
    /// The 8-bit RGB image of planes `[C,H,W]` of which the first three are red, green and blue; the same rule as [`Image8::from_planes`].
    ///
    /// # Errors
    /// [`Error::Parameter`] for fewer than three planes and for planes without a pixel, [`Error::Backend`] if the device fails.
    fn download(&self, planes: Tensor<3>) -> Result<Image8> {
        let [channels, height, width] = planes.dims();
        if channels < 3 || height == 0 || width == 0 {
            return Err(Error::parameter(
                "image",
                format!("planes have shape [{channels},{height},{width}]"),
                "Give red, green and blue of at least one pixel",
            ));
        }
        Ok(Image8::from_planes(&to_vec(planes.narrow(0, 0, 3), "planes")?, width as u32, height as u32))
    }
}

/// A rasterizer in the registry.
pub struct RasterizerPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the rasterizer from the `[rasterizer]` section without `kind`.
    pub build: fn(&toml::Table) -> Result<Box<dyn Rasterizer>>,
}
cc4dgs_format::plugin_kind!(RasterizerPlugin, "rasterizer");
