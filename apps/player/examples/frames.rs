//! Times the player's renderer without a window, on the graphics adapter that the window would take: prints JSON.
//!
//! `cargo run --release -p cc4dgs-player --example frames -- MODEL [--size WIDTHxHEIGHT] [--frames N]`.
//!
//! It looks from where the window would begin. Of N frames at times from start to end, the milliseconds of each are those from its commands until the device is
//! idle; frames per second are those of N frames sent without waiting. The first frame counts from the bytes in memory.

#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs_format::{Error, Limits, Result};
use cc4dgs_player::{Content, Navigator, Renderer, View, request_device};
use std::time::Instant;

struct Arguments {
    model: String,
    size: (u32, u32),
    frames: usize,
}

fn arguments() -> Result<Arguments> {
    let usage = || Error::parameter("arguments", "they are not understood", "Write MODEL [--size WIDTHxHEIGHT] [--frames N]");
    let mut all = std::env::args().skip(1);
    let mut found = Arguments { model: all.next().ok_or_else(usage)?, size: (1352, 1014), frames: 20 };
    while let Some(name) = all.next() {
        let value = all.next().ok_or_else(usage)?;
        match name.as_str() {
            "--size" => found.size = value.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?))).ok_or_else(usage)?,
            "--frames" => found.frames = value.parse().ok().filter(|n| *n > 0).ok_or_else(usage)?,
            _ => return Err(usage()),
        }
    }
    Ok(found)
}

fn main() -> Result<()> {
    let arguments = arguments()?;
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let (adapter, device, queue) = pollster::block_on(request_device(&instance, None))?;
    let format = wgpu::TextureFormat::Rgba8Unorm;
    let mut renderer = Renderer::new(device.clone(), queue, format);

    let bytes = std::fs::read(&arguments.model).map_err(|e| Error::io(&arguments.model, e))?;
    let began = Instant::now();
    let content = Content::read(&arguments.model, bytes, &Limits::default())?;
    let [lower, upper] = content.scene.bounds;
    let camera = Navigator::new(&content.presentation, lower, upper).camera(arguments.size.0, arguments.size.1);
    renderer.load(content.scene)?;
    let size = wgpu::Extent3d { width: camera.width, height: camera.height, depth_or_array_layers: 1 };
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("frames"),
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    });
    let out = texture.create_view(&wgpu::TextureViewDescriptor::default());
    let wait = || device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| Error::backend("graphics device", e.to_string(), "Choose another adapter"));
    let times = (0..arguments.frames).map(|i| i as f32 / arguments.frames as f32);

    renderer.draw(&View::new(camera.clone(), 0.0), &out);
    wait()?;
    let first = milliseconds(began);
    let mut each = Vec::with_capacity(arguments.frames);
    for time in times.clone() {
        let began = Instant::now();
        renderer.draw(&View::new(camera.clone(), time), &out);
        wait()?;
        each.push(milliseconds(began));
    }
    let began = Instant::now();
    for time in times {
        renderer.draw(&View::new(camera.clone(), time), &out);
    }
    wait()?;
    let per_second = 1e3 * arguments.frames as f64 / milliseconds(began);
    each.sort_by(f64::total_cmp);
    let info = adapter.get_info();
    let (gaussians, moving) = renderer.scene().map_or((0, 0), |scene| (scene.count, scene.moving));
    let report = serde_json::json!({
        "adapter": info.name, "driver": format!("{} {}", info.driver, info.driver_info), "size": format!("{}x{}", camera.width, camera.height),
        "gaussians": gaussians, "moving": moving, "frames": arguments.frames, "first_frame_ms": first, "median_ms": each[each.len() / 2], "fastest_ms": each[0],
        "slowest_ms": each[each.len() - 1], "frames_per_second": per_second,
    });
    println!("{report}");
    Ok(())
}

fn milliseconds(began: Instant) -> f64 {
    began.elapsed().as_secs_f64() * 1e3
}
