//! The rasterizer `tile`: 16x16 tiles, hand-written derivative.

use super::settings::raster_settings;
use crate::ops::image::{image_planes, read_image};
use crate::ops::rasterize::{Method, RasterInputs, RasterSettings, Shortcuts, rasterize};
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{Camera, Image8, Plugin, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, Result, SplatColors, Splats, config, inventory};
use std::sync::Arc;

/// Draws with the operation of [`crate::ops::rasterize`].
#[derive(Clone, Copy, Debug, Default)]
pub struct TileRasterizer;

/// [`TileRasterizer`] with some of its shortcuts switched off.
#[derive(Clone, Copy, Debug)]
struct Measured(Shortcuts);

/// Settings of the plug-in.
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    opacity_shortcut: bool,
    transmittance_shortcut: bool,
}

impl Default for Settings {
    fn default() -> Self {
        let Shortcuts { opacity, transmittance } = Shortcuts::default();
        Self { opacity_shortcut: opacity, transmittance_shortcut: transmittance }
    }
}

/// The tensors of a render as the operation takes them.
pub(crate) fn raster_inputs(splats: &Splats, settings: &RenderSettings) -> RasterInputs {
    let (colors, sh_rest) = match &splats.colors {
        SplatColors::Sh { dc, rest, .. } => (dc.clone(), Some(rest.clone())),
        SplatColors::Direct(colors) => (colors.clone(), None),
    };
    RasterInputs {
        means: splats.means.clone(),
        scales: splats.scales.clone(),
        quaternions: splats.quaternions.clone(),
        opacities: splats.opacities.clone(),
        colors,
        sh_rest,
        screen_probe: splats.screen_probe.clone(),
        absolute_screen_probe: splats.absolute_screen_probe.clone(),
        camera_probe: splats.camera_probe.clone(),
        background: settings.background.clone(),
    }
}

impl Rasterizer for TileRasterizer {
    fn render(&self, splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput> {
        Measured(Shortcuts::default()).render(splats, camera, settings)
    }
    fn upload(&self, image: &Arc<Image8>, background: [f32; 3], device: &Device) -> Tensor<3> {
        image_planes(image, background, device)
    }
    fn download(&self, planes: Tensor<3>) -> Result<Image8> {
        read_image(planes)
    }
}

impl Rasterizer for Measured {
    fn render(&self, splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput> {
        let numbers = RasterSettings { shortcuts: self.0, ..raster_settings(splats, camera, settings)? };
        rasterize(raster_inputs(splats, settings), numbers, Method::Tiles)
    }
    fn upload(&self, image: &Arc<Image8>, background: [f32; 3], device: &Device) -> Tensor<3> {
        TileRasterizer.upload(image, background, device)
    }
    fn download(&self, planes: Tensor<3>) -> Result<Image8> {
        TileRasterizer.download(planes)
    }
}

inventory::submit! {
    RasterizerPlugin {
        info: Plugin {
            name: "tile",
            version: "1",
            summary: "EWA splatting in 16x16 tiles, depth-ordered blending, hand-written gradients; SIMD on the CPU",
            paper: "Kerbl et al. 2023 (3DGS); Ye et al. 2024 (gsplat)",
            schema: "# the same images without them; processors can do without, to measure what they save\nopacity_shortcut = true         # footprints end where alpha falls below 1/255\ntransmittance_shortcut = true   # rows and tiles end when their pixels have stopped\n",
            capabilities: &["differentiable", "antialiased", "max-weights", "shortcuts", "rules=gsplat099,gsplat0999,inria"],
        },
        build: |table| {
            let settings: Settings = config::parse_section("rasterizer tile", table)?;
            Ok(Box::new(Measured(Shortcuts { opacity: settings.opacity_shortcut, transmittance: settings.transmittance_shortcut })))
        },
    }
}
