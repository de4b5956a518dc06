//! Timing of whole training steps.

mod scene;
mod workload;

pub use scene::{SCENE_CASES, SceneCase, growth, shrunk, synthetic_scene};
pub use workload::{Workload, random_gaussians, step_camera};

use crate::cpu::simd::{Lanes, dispatch};
use crate::ops::adam::{AdamSettings, adam_step};
use crate::ops::photometric::photometric_loss;
use crate::rasterizers::tile::TileRasterizer;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Gaussians, Rasterizer, RenderSettings, Result, Seed, Splats};
use pulp::{Simd, WithSimd};
use std::time::Instant;

/// Share of L1 in the loss.
const LAMBDA: f32 = 0.8;
/// Learning rate; small, so that the scene hardly changes while it is timed.
const LEARNING_RATE: f64 = 1e-6;
/// Float32 operations per (Gaussian, pixel) evaluation, counted in the source of both blending kernels: 32 forwards, 48 backwards.
pub const OPERATIONS_PER_PAIR: f64 = 80.0;

/// Size of one case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct StepCase {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Gaussians.
    pub gaussians: usize,
}

/// The cases for which published CPU timings exist.
pub const STANDARD_CASES: [StepCase; 3] = [
    StepCase { width: 134, height: 239, gaussians: 10_000 },
    StepCase { width: 269, height: 479, gaussians: 10_000 },
    StepCase { width: 134, height: 239, gaussians: 50_000 },
];

/// Times and counts of a case.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct StepTiming {
    /// Which workload.
    pub name: String,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Gaussians.
    pub gaussians: usize,
    /// Whole step (project, rasterize, loss, backward, Adam), median in milliseconds.
    pub median_ms: f64,
    /// Whole step, fastest, milliseconds.
    pub min_ms: f64,
    /// The step without Adam (render, loss, backward), median in milliseconds.
    pub forward_backward_ms: f64,
    /// (Gaussian, pixel) evaluations of the forward pass.
    pub pixel_pairs: u64,
    /// (Gaussian, tile) pairs.
    pub tile_pairs: u64,
    /// Render, median, milliseconds.
    pub forward_ms: f64,
    /// Backward pass of loss and render, median, milliseconds.
    pub backward_ms: f64,
    /// L1 and SSIM with their gradient, median, milliseconds.
    pub loss_ms: f64,
    /// Adam on all parameters, median, milliseconds.
    pub adam_ms: f64,
    /// Evaluated pairs per second of the whole step.
    pub pairs_per_s: f64,
    /// [`OPERATIONS_PER_PAIR`] times `pairs_per_s` over the multiply-add rate measured on all threads (0..1).
    pub peak_share: f64,
}

/// A parameter with its Adam moments.
struct Trained<const D: usize> {
    value: Option<Tensor<D>>,
    m: Option<Tensor<D>>,
    v: Option<Tensor<D>>,
}

impl<const D: usize> Trained<D> {
    fn new(value: Tensor<D>) -> Self {
        Self { m: Some(value.zeros_like()), v: Some(value.zeros_like()), value: Some(value) }
    }
    fn step(&mut self, grad: Option<Tensor<D>>, settings: &AdamSettings) -> Result<()> {
        if let (Some(value), Some(m), Some(v), Some(grad)) = (self.value.take(), self.m.take(), self.v.take(), grad) {
            let moved = adam_step(value, m, v, grad, settings)?;
            (self.value, self.m, self.v) = (Some(moved.param), Some(moved.m), Some(moved.v));
        }
        Ok(())
    }
    /// The value as a leaf of a new graph.
    fn leaf(&self, device: &Device) -> Option<Tensor<D>> {
        self.value.clone().map(|value| if device.is_autodiff() { Tensor::from_inner(value).require_grad() } else { value })
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Waits until an asynchronous device has finished, so that each part of a step is measured by itself.
fn settle(device: &Device) -> Result<()> {
    device.sync().map_err(|e| cc4dgs_core::Error::backend("device", format!("{e:?}"), "Try another device (--device flex)"))
}

/// Times `repetitions` whole training steps of `workload` on `device` after a few that are not counted.
pub fn time_step(workload: &Workload, device: &Device, seed: Seed, repetitions: usize) -> Result<StepTiming> {
    let tracked = device.clone().autodiff();
    let (camera, degree, n) = (&workload.camera, workload.gaussians.sh_degree, workload.gaussians.len());
    let start = Gaussians::from_host(&workload.gaussians, device);
    let pixels = 3 * camera.width as usize * camera.height as usize;
    let target_seed = seed.child("target");
    let target: Vec<f32> = (0..pixels as u64).map(|k| 0.5 + 0.5 * workload::uniform(target_seed, k)).collect();
    let target = Tensor::<3>::from_data(TensorData::new(target, [3, camera.height as usize, camera.width as usize]), &tracked);
    let mut matrices = [start.means, start.log_scales, start.quaternions, start.sh_dc].map(Trained::new);
    let mut opacities = Trained::new(start.opacity_logits);
    let mut rest = Trained::new(start.sh_rest);
    const WARM_UP: usize = 3;
    let mut times: [Vec<f64>; 6] = Default::default();
    let mut work = cc4dgs_core::RenderWork::default();
    for step in 0..repetitions.max(1) + WARM_UP {
        let begin = Instant::now();
        let leaves = matrices.each_ref().map(|p| p.leaf(&tracked));
        let (opacity_leaf, rest_leaf) = (opacities.leaf(&tracked), rest.leaf(&tracked));
        let ([Some(means), Some(scales), Some(quaternions), Some(dc)], Some(opacity), Some(higher)) = (leaves, opacity_leaf, rest_leaf) else { break };
        let splats = Splats {
            means: means.clone(),
            scales: scales.clone(),
            quaternions: quaternions.clone(),
            opacities: opacity.clone(),
            colors: cc4dgs_core::SplatColors::Sh { dc: dc.clone(), rest: higher.clone(), degree },
            space: cc4dgs_core::ParameterSpace::Raw,
            screen_probe: Some(Tensor::zeros([n, 2], &tracked).require_grad()),
            absolute_screen_probe: None,
            camera_probe: None,
        };
        let out = TileRasterizer.render(&splats, camera, &RenderSettings::default())?;
        work = out.stats.work;
        settle(device)?;
        let rendered = Instant::now();
        let loss = photometric_loss(out.planes, target.clone(), LAMBDA)?;
        settle(device)?;
        let judged = Instant::now();
        let mut grads = loss.loss.backward();
        let d_matrices = [&means, &scales, &quaternions, &dc].map(|p| p.grad_remove(&mut grads));
        let (d_opacity, d_rest) = (opacity.grad_remove(&mut grads), higher.grad_remove(&mut grads));
        drop((splats, means, scales, quaternions, dc, opacity, higher, loss.terms, grads));
        settle(device)?;
        let derived = Instant::now();
        let settings = AdamSettings { visible: Some(out.stats.radii.clone()), ..AdamSettings::new(LEARNING_RATE, step as u64 + 1) };
        for (parameter, grad) in matrices.iter_mut().zip(d_matrices) {
            parameter.step(grad, &settings)?;
        }
        opacities.step(d_opacity, &settings)?;
        rest.step(d_rest, &settings)?;
        // Reading one number back makes sure that nothing is still queued on asynchronous devices.
        if let Some(value) = &opacities.value {
            to_vec(value.clone().narrow(0, 0, 1.min(n)), "opacities")?;
        }
        let done = Instant::now();
        if step >= WARM_UP {
            let spans = [(begin, done), (begin, derived), (begin, rendered), (rendered, judged), (judged, derived), (derived, done)];
            for (list, (from, to)) in times.iter_mut().zip(spans) {
                list.push((to - from).as_secs_f64() * 1e3);
            }
        }
    }
    let [mut whole, mut without_adam, mut forward, mut loss, mut backward, mut adam] = times;
    let median_ms = median(&mut whole);
    let pairs_per_s = if median_ms > 0.0 { work.pixel_pairs as f64 / (median_ms * 1e-3) } else { 0.0 };
    Ok(StepTiming {
        name: workload.name.clone(),
        width: camera.width,
        height: camera.height,
        gaussians: n,
        median_ms,
        forward_backward_ms: median(&mut without_adam),
        min_ms: whole.first().copied().unwrap_or(0.0),
        pixel_pairs: work.pixel_pairs,
        tile_pairs: work.tile_pairs,
        forward_ms: median(&mut forward),
        backward_ms: median(&mut backward),
        loss_ms: median(&mut loss),
        adam_ms: median(&mut adam),
        pairs_per_s,
        peak_share: pairs_per_s * OPERATIONS_PER_PAIR / peak_operations_per_s(),
    })
}

/// Float32 operations per second that all threads reach together with nothing but multiply-adds in registers (best of several runs).
pub fn peak_operations_per_s() -> f64 {
    /// Independent chains: enough to hide the latency of the multiply-add units.
    const CHAINS: usize = 12;
    const ROUNDS: usize = 200_000;
    struct Chains;
    impl WithSimd for Chains {
        type Output = (f32, usize);
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> (f32, usize) {
            // Opaque to the optimiser, and bounded: x -> 0.5 x + 0.25.
            let half = Lanes::splat(simd, std::hint::black_box(0.5));
            let quarter = Lanes::splat(simd, std::hint::black_box(0.25));
            let mut chains: [Lanes<S>; CHAINS] = std::array::from_fn(|k| Lanes::splat(simd, k as f32));
            for _ in 0..ROUNDS {
                for chain in &mut chains {
                    *chain = chain.fma(half, quarter);
                }
            }
            (chains.iter().map(|c| c.sum()).sum(), S::F32_LANES)
        }
    }
    let mut best: f64 = 1.0;
    for _ in 0..5 {
        let begin = Instant::now();
        let lanes: usize = rayon::broadcast(|_| std::hint::black_box(dispatch(Chains)).1).into_iter().sum();
        best = best.max((2 * CHAINS * ROUNDS * lanes) as f64 / begin.elapsed().as_secs_f64());
    }
    best
}
