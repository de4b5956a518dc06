//! `cc4dgs doctor`: what this machine offers, and whether images come out right on it.

use super::Context;
use burn::tensor::Device;
use cc4dgs::exporters::web::{Page, page_paths};
use cc4dgs::video;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::metrics::{WeightsId, installed_lpips, lpips_paths};
use cc4dgs_core::{
    Adapter, Camera, DEVICE_NAMES, Error, Gaussians, HostGaussians, RenderSettings, Result, Splats, adapters, auto_device, parse_device, plural,
};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// The reference rasterizer: slow, in float64.
const ORACLE: &str = "reference";
/// Half a level of an 8-bit image: what float32 may cost. Two correct rasterizers differ by more only where a Gaussian is just at the cut-off.
const TOLERANCE: f32 = 0.5 / 255.0;
/// Relative, of the whole gradient of the centres.
const GRADIENT_TOLERANCE: f32 = 1e-3;

#[derive(Serialize)]
struct Report {
    version: &'static str,
    os: &'static str,
    architecture: &'static str,
    cpu_features: Vec<&'static str>,
    threads: usize,
    devices: Vec<DeviceReport>,
    adapters: &'static [Adapter],
    auto: &'static str,
    auto_reason: String,
    ffmpeg: Option<String>,
    lpips: LpipsReport,
    page: PageReport,
    self_check: Vec<Check>,
    healthy: bool,
}

/// The weights of LPIPS, which are not part of the program.
#[derive(Serialize)]
struct LpipsReport {
    /// The file in use, or `built in`.
    source: Option<String>,
    weights: Option<&'static WeightsId>,
    /// Why there are none.
    absent: Option<&'static str>,
    /// The files that are looked at, in order.
    paths: Vec<PathBuf>,
}

fn lpips() -> LpipsReport {
    let found = installed_lpips();
    LpipsReport { source: found.map(|f| f.source.clone()).ok(), weights: found.map(|f| f.network.id()).ok(), absent: found.err(), paths: lpips_paths() }
}

/// The page of the player, which `export web` needs.
#[derive(Serialize)]
struct PageReport {
    /// The folder in use, or `this program`.
    source: Option<String>,
    /// Why there is none.
    absent: Option<String>,
    /// The folders that are looked at, in order.
    paths: Vec<PathBuf>,
}

fn page() -> PageReport {
    let found = Page::find();
    PageReport { source: found.as_ref().map(|p| p.origin.clone()).ok(), absent: found.err().map(|e| e.to_string()), paths: page_paths() }
}

#[derive(Serialize)]
struct DeviceReport {
    name: &'static str,
    available: bool,
    note: String,
}

#[derive(Serialize)]
struct Check {
    device: &'static str,
    rasterizer: String,
    /// Largest difference of a pixel from the reference, 0..1.
    max_difference: Option<f32>,
    /// Relative difference of the gradient of the centres from the reference's.
    gradient_difference: Option<f32>,
    /// Wall milliseconds of image and gradient, kernels compiled on the way.
    ms: f64,
    problem: Option<String>,
}

pub fn run(context: &Context) -> Result<()> {
    let truth = draw(context, ORACLE, &Device::flex())?;
    let mut devices = Vec::new();
    let mut self_check = Vec::new();
    for name in DEVICE_NAMES.into_iter().filter(|n| *n != "auto") {
        let device = parse_device(name);
        if let Ok(device) = &device {
            self_check.extend(check_device(context, name, device, &truth));
        }
        let note = match &device {
            Err(e) => e.to_string(),
            Ok(_) if name == "wgpu" => match adapters().first() {
                Some(adapter) => format!("computes on {} ({})", adapter.name, adapter.api),
                None => "computes on an adapter that this program cannot list".to_string(),
            },
            Ok(_) => "computes on the processor".to_string(),
        };
        devices.push(DeviceReport { name, available: device.is_ok(), note });
    }
    let healthy = !self_check.is_empty() && self_check.iter().all(|c| c.problem.is_none());
    let (auto, auto_reason) = auto_device();
    let report = Report {
        version: env!("CARGO_PKG_VERSION"),
        os: std::env::consts::OS,
        architecture: std::env::consts::ARCH,
        cpu_features: cpu_features(),
        threads: rayon::current_num_threads(),
        devices,
        adapters: adapters(),
        auto,
        auto_reason,
        ffmpeg: video::ffmpeg_version().ok(),
        lpips: lpips(),
        page: page(),
        self_check,
        healthy,
    };
    context.output.result(&report, || text(&report))?;
    if healthy { Ok(()) } else { Err(Error::backend("self-check", "a rasterizer disagrees with the reference or fails", "Report this with the output above")) }
}

fn text(r: &Report) -> String {
    let mut lines = vec![
        format!("cc4dgs {} on {} {}, {} {}", r.version, r.os, r.architecture, r.threads, plural(r.threads, "thread", "threads")),
        format!("processor: {}", if r.cpu_features.is_empty() { "no vector extension known here".to_string() } else { r.cpu_features.join(" ") }),
    ];
    lines.extend(r.devices.iter().map(|d| format!("device {:<8} {:<4} {}", d.name, if d.available { "yes" } else { "no" }, d.note)));
    lines.extend(r.adapters.iter().enumerate().map(|(i, a)| adapter_text(i, a)));
    lines.push(format!("device auto     takes {}: {}", r.auto, r.auto_reason));
    lines.push(format!("ffmpeg: {}", r.ffmpeg.as_deref().unwrap_or("not found (needed only for videos)")));
    lines.push(match (&r.lpips.source, r.lpips.weights) {
        (Some(source), Some(weights)) => format!("LPIPS: weights {source} ({} v{}, xxh3 {})", weights.network, weights.version, weights.xxh3),
        _ => r.lpips.absent.unwrap_or_default().to_string(),
    });
    lines.push(match (&r.page.source, &r.page.absent) {
        (Some(source), _) => format!("page of the player: {source}"),
        (None, absent) => absent.clone().unwrap_or_default(),
    });
    lines.extend(r.self_check.iter().map(|c| {
        let result = match (&c.problem, c.max_difference) {
            (Some(problem), _) => format!("FAILED: {problem}"),
            (None, difference) => {
                format!("ok, within {:.1e} of the reference, gradient within {:.1e}", difference.unwrap_or_default(), c.gradient_difference.unwrap_or_default())
            }
        };
        format!("self-check {} on {}: {result} ({:.0} ms)", c.rasterizer, c.device, c.ms)
    }));
    lines.join("\n")
}

fn adapter_text(index: usize, a: &Adapter) -> String {
    let mib = |bytes: u64| bytes >> 20;
    let subgroups = a.subgroup_threads.map_or_else(|| "no subgroups".to_string(), |[low, high]| format!("subgroups of {low} to {high}"));
    format!(
        "adapter wgpu:{index}  {} ({:?}, {}, {})\n    bindings to {} MiB, buffers to {} MiB, {} KiB per workgroup of {} threads, {} buffers per kernel, {subgroups}",
        a.name,
        a.kind,
        a.api,
        a.driver,
        mib(a.max_binding_bytes),
        mib(a.max_buffer_bytes),
        a.workgroup_memory_bytes >> 10,
        a.max_workgroup_threads,
        a.max_storage_buffers,
    )
}

/// An image, and the gradient of its sum of squares with respect to the centres.
struct Drawn {
    image: Vec<f32>,
    gradient: Vec<f32>,
}

/// Draws one image with every rasterizer and compares it, and its gradient, with the reference's.
fn check_device(context: &Context, device_name: &'static str, device: &Device, truth: &Drawn) -> Vec<Check> {
    let names = context.registry.plugins().into_iter().filter(|(kind, p)| *kind == "rasterizer" && p.name != ORACLE).map(|(_, p)| p.name);
    names
        .map(|name| {
            let began = Instant::now();
            let drawn = draw(context, name, device);
            let ms = began.elapsed().as_secs_f64() * 1e3;
            let (max, gradient, problem) = match &drawn {
                Err(e) => (None, None, Some(e.to_string())),
                Ok(drawn) => {
                    let max = largest_difference(&truth.image, &drawn.image);
                    let gradient = relative(&truth.gradient, &drawn.gradient);
                    let close = max <= TOLERANCE && gradient <= GRADIENT_TOLERANCE;
                    let problem = || format!("a pixel differs by {max} ({TOLERANCE} is allowed), the gradient by {gradient} ({GRADIENT_TOLERANCE})");
                    (Some(max), Some(gradient), (!close).then(problem))
                }
            };
            let finite = |value: Option<f32>| value.filter(|v| v.is_finite());
            Check { device: device_name, rasterizer: name.to_string(), max_difference: finite(max), gradient_difference: finite(gradient), ms, problem }
        })
        .collect()
}

/// NaN where a difference is no number, wherever it is: this must fail, and `f32::max` would drop it.
fn largest_difference(truth: &[f32], found: &[f32]) -> f32 {
    truth.iter().zip(found).map(|(a, b)| (a - b).abs()).max_by(f32::total_cmp).unwrap_or(0.0)
}

fn relative(truth: &[f32], found: &[f32]) -> f32 {
    let norm = |values: &mut dyn Iterator<Item = f32>| values.map(|v| v * v).sum::<f32>().sqrt();
    norm(&mut truth.iter().zip(found).map(|(a, b)| a - b)) / norm(&mut truth.iter().copied()).max(f32::MIN_POSITIVE)
}

fn draw(context: &Context, rasterizer: &str, device: &Device) -> Result<Drawn> {
    let section = toml::Table::from_iter([("kind".to_string(), toml::Value::from(rasterizer))]);
    let camera = Camera::look_at("doctor", (96, 64), 0.9, [0.4, -3.0, 0.8], [0.0; 3], [0.0, 0.0, 1.0]);
    let gaussians = Gaussians::from_host(&spiral(), &device.clone().autodiff());
    let mut splats = Splats::from_gaussians(&gaussians, 1);
    let means = splats.means.clone().require_grad();
    splats.means = means.clone();
    let output = context.registry.build_rasterizer(&section)?.render(&splats, &camera, &RenderSettings::default())?;
    let image = output.image();
    let gradients = (image.clone() * image.clone()).sum().backward();
    let gradient = means.grad(&gradients).ok_or_else(|| Error::backend("self-check", "the centres have no gradient", "Report this"))?;
    Ok(Drawn { image: to_vec(image.inner(), "self-check image")?, gradient: to_vec(gradient, "self-check gradient")? })
}

/// Coloured Gaussians on a spiral around a ball: every size, direction and opacity occurs, and no random number is needed.
fn spiral() -> HostGaussians {
    let mut g = HostGaussians { sh_degree: 1, ..Default::default() };
    let count = 120;
    for i in 0..count {
        let t = (i as f32 + 0.5) / count as f32;
        let (z, turn) = (1.0 - 2.0 * t, 2.399_963 * i as f32);
        let r = (1.0 - z * z).sqrt();
        g.means.extend([r * turn.cos(), r * turn.sin(), z]);
        g.log_scales.extend([-3.5 + 1.5 * t, -2.6, -3.0 - t]);
        g.quaternions.extend([1.0, turn.sin(), t, turn.cos()]);
        g.opacity_logits.push(-1.0 + 4.0 * t);
        g.sh_dc.extend([turn.sin(), turn.cos(), 1.0 - 2.0 * t]);
        g.sh_rest.extend((0..9).map(|k| 0.2 * (turn + k as f32).sin()));
        g.dynamic_scores.push(0.0);
    }
    g
}

/// Vector extensions of the processor that kernels may choose from.
#[cfg(target_arch = "x86_64")]
pub fn cpu_features() -> Vec<&'static str> {
    let known = [
        ("sse4.2", std::arch::is_x86_feature_detected!("sse4.2")),
        ("avx", std::arch::is_x86_feature_detected!("avx")),
        ("avx2", std::arch::is_x86_feature_detected!("avx2")),
        ("fma", std::arch::is_x86_feature_detected!("fma")),
        ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
        ("avx512bw", std::arch::is_x86_feature_detected!("avx512bw")),
        ("avx512dq", std::arch::is_x86_feature_detected!("avx512dq")),
        ("avx512vl", std::arch::is_x86_feature_detected!("avx512vl")),
    ];
    known.into_iter().filter(|(_, present)| *present).map(|(name, _)| name).collect()
}

#[cfg(target_arch = "aarch64")]
pub fn cpu_features() -> Vec<&'static str> {
    if std::arch::is_aarch64_feature_detected!("neon") { vec!["neon"] } else { Vec::new() }
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
pub fn cpu_features() -> Vec<&'static str> {
    Vec::new()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_that_are_no_numbers_fail_wherever_they_are() {
        assert_eq!(largest_difference(&[0.5, 0.5, 0.5], &[0.5, 0.25, 0.375]), 0.25);
        for at in 0..3 {
            let mut found = [0.5, 0.25, 0.5];
            found[at] = f32::NAN;
            assert!(largest_difference(&[0.5; 3], &found).is_nan(), "pixel {at}");
        }
    }
}
