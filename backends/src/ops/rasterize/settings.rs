//! What all devices share: the numbers of a render, the size of a tile, the columns of a record.

use cc4dgs_core::{ParameterSpace, Rules};

/// Pixels along the side of a tile.
pub const TILE: usize = 16;
/// Pixels of a tile.
pub const TILE_PIXELS: usize = TILE * TILE;
/// Upper bound on the (Gaussian, tile) pairs of one render. Processors count all tiles of bounding boxes, GPUs those that a footprint comes near. A CPU needs
/// at least 24 bytes of working memory per pair to draw (3.2 GB in all), 64 with the backward pass (8.6 GB), and 76 with largest weights and absolute gradients
/// (10.2 GB).
pub const MAX_TILE_PAIRS: u64 = 1 << 27;

/// Columns of a screen record: what a pixel reads of a Gaussian. Gradient records have the same columns.
///
/// The exponent at an offset (dx, dy) from the centre is sigma = u^2 + t^2 with u = l1 dx + l2 dy and t = l3 dy. The reference writes it as
/// (A dx^2 + C dy^2) / 2 + B dx dy instead: its records have the conic (A,B,C) in the columns of l1, l2 and l3.
pub const RECORD: usize = 10;
/// Column of the centre's x in pixels.
pub const AT_X: usize = 0;
/// Column of the centre's y in pixels.
pub const AT_Y: usize = 1;
/// Column of l1. In gradient records: sum of d loss / d sigma times u^2; until the records of a Gaussian are summed, with the opposite sign.
pub const AT_A: usize = 2;
/// Column of l2. In gradient records, likewise: u t.
pub const AT_B: usize = 3;
/// Column of l3. In gradient records, likewise: t^2.
pub const AT_C: usize = 4;
/// Column of the opacity, compensation included.
pub const AT_OPACITY: usize = 5;
/// First of the three columns of the colour.
pub const AT_COLOR: usize = 6;
/// Column of the camera depth.
pub const AT_DEPTH: usize = 9;

/// Everything a render needs besides the Gaussians; plain numbers, the same for every device.
#[derive(Clone, Debug, PartialEq)]
pub struct RasterSettings {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point x in pixels.
    pub cx: f64,
    /// Principal point y in pixels.
    pub cy: f64,
    /// World to camera, row-major, OpenCV axes.
    pub world_to_camera: [[f64; 4]; 4],
    /// Corner-case rules.
    pub rules: Rules,
    /// Smallest camera depth drawn, world units; `None` leaves it to the rules.
    pub near: Option<f32>,
    /// Multiply opacity by the compensation of the pixel blur.
    pub antialiased: bool,
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels; positive.
    pub blur: f64,
    /// Whether scales and opacities still need their activations.
    pub space: ParameterSpace,
    /// Degree of the spherical harmonics, or `None` for colours blended as they are.
    pub sh_degree: Option<usize>,
    /// Find the largest blending weight of every Gaussian.
    pub max_weights: bool,
    /// Sum the absolute values of every pixel's gradient of the projected centres in the backward pass. [`super::rasterize`] sets it where a probe asks.
    pub absolute_centers: bool,
    /// Capacity in (Gaussian, tile) pairs, where reading their number back would stall the device; `None` allocates for all.
    pub pair_capacity: Option<usize>,
    /// What is skipped.
    pub shortcuts: Shortcuts,
}

/// Shortcuts of the tile rasterizer on processors. They change no bit of images and of the Gaussians' gradients (the order in which the gradient of the
/// camera's pose is summed may change); they are switched off only to measure what they save. Kernels for GPUs always take both, and refuse other settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shortcuts {
    /// Footprints end where alpha falls below 1/255, rather than at 3.33 sigma.
    pub opacity: bool,
    /// Rows and tiles end when all of their pixels have stopped.
    pub transmittance: bool,
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { opacity: true, transmittance: true }
    }
}

/// Which gradients are wanted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GradientRequest {
    /// Of the centres.
    pub means: bool,
    /// Of the (log-)scales.
    pub scales: bool,
    /// Of the raw quaternions.
    pub quaternions: bool,
    /// Of the opacities (logits).
    pub opacities: bool,
    /// Of the degree-0 coefficients or colours.
    pub colors: bool,
    /// Of the higher coefficients.
    pub sh_rest: bool,
    /// Of the background.
    pub background: bool,
    /// Of the projected centres in pixels.
    pub screen: bool,
    /// The same, absolute values summed over pixels.
    pub absolute_screen: bool,
    /// Of world_to_camera.
    pub camera: bool,
}
