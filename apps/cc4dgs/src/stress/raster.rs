//! The rasterizer, forward and backward, against the one in float64.

use super::scenes::{Drawn, all};
use super::{Compared, FLOAT64, StressCase, StressJob, case};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::format::conformance::uniform;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Gaussians, Rasterizer, RenderSettings, Result, Seed, Splats, split_kind, toml};

/// Gradients of an attribute that are smaller than this share of the largest of all count as zero.
const NEGLIGIBLE: f32 = 1e-5;

pub fn run(job: &StressJob, note: &mut dyn FnMut(StressCase)) -> Result<()> {
    let build = |name: &str| -> Result<Box<dyn Rasterizer>> {
        let (kind, settings) = split_kind("rasterizer", &toml::Table::from_iter([("kind".into(), name.into())]))?;
        (job.registry.rasterizer(&kind)?.build)(&settings)
    };
    let (tested, oracle) = (build(job.rasterizer)?, build(job.oracle)?);
    for hard in all() {
        let compare = |values: fn(&dyn Rasterizer, &Device, &Drawn) -> Result<Vec<f32>>| -> Result<Compared> {
            let exact = values(oracle.as_ref(), job.host, hard.exact.as_ref().unwrap_or(&hard.drawn))?;
            Ok((values(tested.as_ref(), job.device, &hard.drawn)?, Some((FLOAT64, exact))))
        };
        note(case("rasterizer", hard.condition, &hard.level, || compare(planes)).required_if(hard.ordinary));
        note(case("gradients", hard.condition, &hard.level, || compare(gradients)).required_if(hard.ordinary));
    }
    Ok(())
}

/// Planes of the image.
fn planes(rasterizer: &dyn Rasterizer, device: &Device, drawn: &Drawn) -> Result<Vec<f32>> {
    let g = Gaussians::from_host(&drawn.gaussians, device);
    let output = rasterizer.render(&Splats::from_gaussians(&g, 1), &drawn.camera, &RenderSettings::default())?;
    // Without depth, whose scale would hide the colours.
    to_vec(output.planes.narrow(0, 0, 4), "planes")
}

/// Gradients of a weighted sum of the planes with respect to all attributes, each over its largest value, so that all count alike.
fn gradients(rasterizer: &dyn Rasterizer, device: &Device, drawn: &Drawn) -> Result<Vec<f32>> {
    let tracked = device.clone().autodiff();
    let mut g = Gaussians::from_host(&drawn.gaussians, &tracked);
    g.means = g.means.require_grad();
    g.log_scales = g.log_scales.require_grad();
    g.quaternions = g.quaternions.require_grad();
    g.opacity_logits = g.opacity_logits.require_grad();
    g.sh_dc = g.sh_dc.require_grad();
    let output = rasterizer.render(&Splats::from_gaussians(&g, 1), &drawn.camera, &RenderSettings::default())?;
    let [_, height, width] = output.planes.dims();
    let upstream: Vec<f32> = (0..5 * height * width).map(|k| if k < 4 * height * width { uniform(Seed::root(6), k) } else { 0.0 }).collect();
    let weights = Tensor::<3>::from_data(TensorData::new(upstream, [5, height, width]), &tracked);
    let found = (output.planes * weights).sum().backward();
    let one = g.opacity_logits.grad(&found).map(|t| to_vec(t, "gradient"));
    let means = g.means.grad(&found).map(|t| to_vec(t, "gradient"));
    let others = [g.log_scales.grad(&found), g.quaternions.grad(&found), g.sh_dc.grad(&found)].map(|t| t.map(|t| to_vec(t, "gradient")));
    let all = [means, one].into_iter().chain(others).flatten().collect::<Result<Vec<_>>>()?;
    let largest = |gradient: &[f32]| gradient.iter().filter(|v| v.is_finite()).fold(0.0f32, |a, v| a.max(v.abs()));
    // Gradients that are zero but for rounding stay small.
    let least = NEGLIGIBLE * all.iter().map(|gradient| largest(gradient)).fold(f32::MIN_POSITIVE / NEGLIGIBLE, f32::max);
    Ok(all
        .into_iter()
        .flat_map(|gradient| {
            let scale = largest(&gradient).max(least);
            gradient.into_iter().map(move |v| v / scale)
        })
        .collect())
}
