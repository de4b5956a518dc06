//! Whether devices draw the same images.

use crate::args::BenchAgree;
use crate::commands::Context;
use crate::models::load_model;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::sample::spread_views;
use cc4dgs_core::{Error, Result};
use cc4dgs_train::agreement::{Agreement, agreement};
use serde::Serialize;

#[derive(Serialize)]
struct AgreeReport {
    version: &'static str,
    model: String,
    scene: String,
    devices: Vec<Agreement>,
}

/// Draws the views of a split on several devices and compares the images.
pub fn agree(context: &Context, args: &BenchAgree) -> Result<()> {
    if args.devices.len() < 2 {
        let object = format!("--devices {}", args.devices.join(","));
        return Err(Error::parameter(object, "one device has nothing to be compared with", "Give at least two, such as flex,wgpu or flex,flex/reference"));
    }
    let events = context.listeners(None)?;
    let mut models = Vec::new();
    for name in &args.devices {
        let (device, rasterizer) = name.split_once('/').map_or((name.as_str(), None), |(device, rasterizer)| (device, Some(rasterizer)));
        let mut loaded = load_model(&args.views.model, device, &context.registry, &context.limits, &events)?;
        if let Some(rasterizer) = rasterizer {
            loaded.model.rasterizer = toml::Table::from_iter([("kind".to_string(), toml::Value::from(rasterizer))]);
            loaded.device_name = name.clone();
        }
        models.push((loaded.device_name, loaded.device, loaded.model));
    }
    let Some((_, _, first)) = models.first() else {
        return Err(Error::parameter("--devices", "none is named", "Give at least two, such as flex,wgpu"));
    };
    let scene = open_as_trained(&args.views.scene, first, &args.views.sets, &context.registry, &context.limits)?;
    let views = scene.split(args.views.split.into());
    if views.is_empty() {
        return Err(Error::parameter("--split", format!("{} has no such view", scene.name), "Compare the views of the other split"));
    }
    let wanted = if args.max_views == 0 { views.len() } else { args.max_views };
    let views = spread_views(&scene, &views, wanted);
    let devices = agreement(&models, &scene, &views, &context.registry, &events)?;
    let report = AgreeReport { version: env!("CARGO_PKG_VERSION"), model: args.views.model.display().to_string(), scene: scene.name.clone(), devices };
    context.output.result(&report, || text(&report))
}

fn text(report: &AgreeReport) -> String {
    let mut lines = vec![format!("{} on {}: differences in levels of 1/255 from the first device", report.model, report.scene)];
    lines.push("device     views    PSNR dB  difference dB        max       mean     median       99 %    99.99 %  99.9999 %   over 1".into());
    let level = |v: f32| v * 255.0;
    lines.extend(report.devices.iter().map(|d| {
        let [a, b, c, e] = d.quantiles.map(level);
        format!(
            "{:<10} {:>5} {:>10.4} {:>14.5} {:>10.4} {:>10.6} {a:>10.2} {b:>10.2} {c:>10.2} {e:>10.2} {:>8}",
            d.device,
            d.views,
            d.psnr_db,
            d.psnr_difference_db,
            level(d.max_difference),
            d.mean_difference * 255.0,
            d.over_one_level
        )
    }));
    lines.join("\n")
}
