//! The third seam: rasterizers.

use crate::Plugin;
use crate::{Camera, Gaussians, Result, Rules};
use burn::tensor::{Int, Tensor};
use serde::{Deserialize, Serialize};

/// Whether the parameters of [`Splats`] still want their activations.
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
        /// Degree 0 [N,3].
        dc: Tensor<2>,
        /// Degree 1 and up [N,K,3]; K may exceed what `degree` uses.
        rest: Tensor<3>,
        /// The degree evaluated now.
        degree: usize,
    },
    /// Three numbers blended as they are [N,3] (dynamic scores, labels).
    Direct(Tensor<2>),
}

/// Inputs of one render. Any tensor may carry a gradient.
#[derive(Clone, Debug)]
pub struct Splats {
    /// Centres in world units [N,3].
    pub means: Tensor<2>,
    /// Log-scales, or scales when `space` is activated [N,3].
    pub scales: Tensor<2>,
    /// Quaternions (w,x,y,z), normalised by the rasterizer [N,4].
    pub quaternions: Tensor<2>,
    /// Opacity logits, or opacities when `space` is activated [N].
    pub opacities: Tensor<1>,
    /// Colours.
    pub colors: SplatColors,
    /// What the numbers are.
    pub space: ParameterSpace,
    /// A tensor of zeros [N,2] whose gradient becomes d loss / d projected centre in pixels (densification reads it).
    pub screen_probe: Option<Tensor<2>>,
    /// A tensor of zeros [4,4] whose gradient becomes d loss / d world_to_camera.
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
    /// Smallest camera depth drawn, world units; `None` leaves it to the rules.
    pub near: Option<f32>,
    /// Colour behind everything, linear RGB in 0..1 [3]; may carry a gradient. `None` is black.
    pub background: Option<Tensor<1>>,
    /// Collect the largest blending weight of every Gaussian (weight pruning).
    pub max_weights: bool,
    /// Room for so many (Gaussian, tile) pairs, for playback on devices that would otherwise wait for the count of every frame. What does not fit is not
    /// drawn, farthest Gaussians first; [`RenderStats::pair_count`] tells afterwards. Not for gradients. `None` makes room for all.
    pub pair_room: Option<usize>,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self { rules: Rules::Gsplat099, antialiased: false, near: None, background: None, max_weights: false, pair_room: None }
    }
}

/// One rendered view.
#[derive(Clone, Debug)]
pub struct RenderOutput {
    /// Planes [5, H, W]: red, green, blue (background included), alpha, depth (sum of weight times z, not normalised).
    /// Kept in one tensor so that a loss can read its planes without a copy.
    pub planes: Tensor<3>,
    /// Statistics without gradient.
    pub stats: RenderStats,
}

impl RenderOutput {
    /// Red, green, blue [3,H,W].
    pub fn image(&self) -> Tensor<3> {
        self.planes.clone().narrow(0, 0, 3)
    }
    /// Coverage [1,H,W].
    pub fn alpha(&self) -> Tensor<3> {
        self.planes.clone().narrow(0, 3, 1)
    }
    /// Accumulated depth in world units [1,H,W].
    pub fn depth(&self) -> Tensor<3> {
        self.planes.clone().narrow(0, 4, 1)
    }
}

/// Statistics of one render.
#[derive(Clone, Debug)]
pub struct RenderStats {
    /// Screen radius in pixels; 0 where the Gaussian was culled [N].
    pub radii: Tensor<1, Int>,
    /// Largest blending weight of each Gaussian over the image [N], when asked for.
    pub max_weights: Option<Tensor<1>>,
    /// (Gaussian, tile) pairs there were [1], still on the device; `None` where a rasterizer has no such thing.
    pub pair_count: Option<Tensor<1, Int>>,
    /// Counts of work done.
    pub work: RenderWork,
}

/// Work counted during one render. Zero where a device does not read its counters back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RenderWork {
    /// Gaussians that survived culling.
    pub visible: u64,
    /// (Gaussian, tile) pairs.
    pub tile_pairs: u64,
    /// (Gaussian, pixel) evaluations.
    pub pixel_pairs: u64,
}

/// Draws Gaussians, differentiably.
pub trait Rasterizer: Send + Sync {
    /// Renders `splats` through `camera`. Non-finite Gaussians are culled, never drawn.
    fn render(&self, splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput>;
}

/// A rasterizer in the registry.
pub struct RasterizerPlugin {
    /// Facts for people, tables and checks.
    pub info: Plugin,
    /// Builds the rasterizer from the `[rasterizer]` section without `kind`.
    pub build: fn(&toml::Table) -> Result<Box<dyn Rasterizer>>,
}
crate::plugin_kind!(RasterizerPlugin, "rasterizer");
