//! The rasterizer `tile`: 16x16 tiles, hand-written derivative.

use super::settings::{no_settings, raster_settings};
use crate::ops::image::{image_planes, read_image};
use crate::ops::rasterize::{Method, RasterInputs, rasterize};
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{Camera, Image8, Plugin, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, Result, SplatColors, Splats, inventory};
use std::sync::Arc;

/// Draws with the operation of [`crate::ops::rasterize`].
#[derive(Clone, Copy, Debug, Default)]
pub struct TileRasterizer;

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
        rasterize(raster_inputs(splats, settings), raster_settings(splats, camera, settings)?, Method::Tiles)
    }
    fn upload(&self, image: &Arc<Image8>, background: [f32; 3], device: &Device) -> Tensor<3> {
        image_planes(image, background, device)
    }
    fn download(&self, planes: Tensor<3>) -> Result<Image8> {
        read_image(planes)
    }
}

inventory::submit! {
    RasterizerPlugin {
        info: Plugin {
            name: "tile",
            version: "1",
            summary: "EWA splatting in 16x16 tiles, depth-ordered blending, hand-written gradients; SIMD on the CPU",
            paper: "Kerbl et al. 2023 (3DGS); Ye et al. 2024 (gsplat)",
            schema: "",
            capabilities: &["differentiable", "antialiased", "max-weights", "rules=gsplat099,gsplat0999,inria"],
        },
        build: |table| {
            no_settings("tile", table)?;
            Ok(Box::new(TileRasterizer))
        },
    }
}
