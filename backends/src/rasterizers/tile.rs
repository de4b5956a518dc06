//! The rasterizer `tile`: 16x16 tiles, hand-written derivative.

use super::settings::{no_settings, raster_settings};
use crate::ops::rasterize::{Method, RasterInputs, rasterize};
use cc4dgs_core::{Camera, Plugin, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, Result, SplatColors, Splats, inventory};

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
