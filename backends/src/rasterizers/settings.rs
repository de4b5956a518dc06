//! Checks the inputs of a render and converts them to the form of the operation.

use crate::ops::rasterize::{RasterSettings, TILE};
use cc4dgs_core::{BLUR_RANGE, Camera, Error, RenderSettings, Result, SplatColors, Splats, blur_at};

/// Pixels of the largest image drawn.
const MAX_PIXELS: u64 = 1 << 28;
/// Pixels of the longest side: kernels for GPUs pack ranges of tiles in 16 bits.
const MAX_SIDE: u64 = u16::MAX as u64 * TILE as u64;

/// Checks shapes, camera and degree, and gathers the numbers of a render.
pub fn raster_settings(splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RasterSettings> {
    camera.validate()?;
    let pixels = u64::from(camera.width) * u64::from(camera.height);
    if pixels > MAX_PIXELS {
        return Err(Error::limit(format!("image of camera {}", camera.name), pixels, MAX_PIXELS, "Render a smaller image"));
    }
    let side = u64::from(camera.width.max(camera.height));
    if side > MAX_SIDE {
        return Err(Error::limit(format!("longest side of the image of camera {}", camera.name), side, MAX_SIDE, "Render a smaller image"));
    }
    let [n, _] = splats.means.dims();
    let shape = |name: &str, seen: &[usize], wanted: &[usize]| {
        if seen == wanted {
            return Ok(());
        }
        Err(Error::parameter(format!("splats.{name}"), format!("shape {seen:?} where {wanted:?} is needed"), "Give every attribute one row per Gaussian"))
    };
    shape("means", &splats.means.dims(), &[n, 3])?;
    shape("scales", &splats.scales.dims(), &[n, 3])?;
    shape("quaternions", &splats.quaternions.dims(), &[n, 4])?;
    shape("opacities", &splats.opacities.dims(), &[n])?;
    let sh_degree = match &splats.colors {
        SplatColors::Direct(colors) => {
            shape("colors", &colors.dims(), &[n, 3])?;
            None
        }
        SplatColors::Sh { dc, rest, degree } => {
            shape("colors.dc", &dc.dims(), &[n, 3])?;
            let [rows, stored, channels] = rest.dims();
            shape("colors.rest", &[rows, channels], &[n, 3])?;
            let needed = (degree + 1) * (degree + 1) - 1;
            if *degree > 4 || stored < needed {
                let problem = format!("degree {degree} with {stored} coefficients per channel stored above degree 0");
                return Err(Error::parameter("splats.colors", problem, "Use a degree of 0 to 4 that the coefficients cover"));
            }
            Some(*degree)
        }
    };
    if let Some(probe) = &splats.screen_probe {
        shape("screen_probe", &probe.dims(), &[n, 2])?;
    }
    if let Some(probe) = &splats.absolute_screen_probe {
        shape("absolute_screen_probe", &probe.dims(), &[n, 2])?;
    }
    if let Some(probe) = &splats.camera_probe {
        shape("camera_probe", &probe.dims(), &[4, 4])?;
    }
    if let Some(near) = settings.near.filter(|near| !near.is_finite() || *near < 0.0) {
        return Err(Error::parameter("render.near", format!("{near} is not a depth"), "Give a finite depth of 0 or more, in world units"));
    }
    if !BLUR_RANGE.contains(&settings.blur) {
        let problem = format!("{} is not between {} and {}", settings.blur, BLUR_RANGE.start(), BLUR_RANGE.end());
        return Err(Error::parameter("render.blur", problem, "Give a variance in square pixels, such as 0.3 or 0.1"));
    }
    if let Some(focal) = settings.focal.filter(|focal| !focal.is_finite() || *focal <= 0.0) {
        return Err(Error::parameter("render.focal", format!("{focal} is not a focal length"), "Give the longest one of the training images, in pixels"));
    }
    if let Some(background) = &settings.background {
        shape("background", &background.dims(), &[3])?;
    }
    Ok(RasterSettings {
        width: camera.width as usize,
        height: camera.height as usize,
        fx: camera.fx,
        fy: camera.fy,
        cx: camera.cx,
        cy: camera.cy,
        world_to_camera: camera.world_to_camera,
        rules: settings.rules,
        near: settings.near,
        antialiased: settings.antialiased,
        blur: blur_at(settings.blur, settings.focal, camera.fx, camera.fy),
        space: splats.space,
        sh_degree,
        max_weights: settings.max_weights,
        absolute_centers: splats.absolute_screen_probe.is_some(),
        pair_capacity: settings.pair_capacity,
        shortcuts: Default::default(),
    })
}
