//! Sorting and the photometric loss by themselves, over growing sizes.

use super::{Spread, timed};
use crate::args::{BenchLoss, BenchSort};
use crate::commands::Context;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_backends::ops::photometric::photometric_loss;
use cc4dgs_backends::ops::sort::sort_order;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Result, Seed, parse_device, plural, resolved_device};
use rand::Rng;
use serde::Serialize;

#[derive(Serialize)]
struct SortReport<'a> {
    version: &'static str,
    device: &'a str,
    threads: usize,
    seed: u64,
    cases: Vec<SortCase>,
}

#[derive(Serialize)]
struct SortCase {
    pairs: usize,
    bits: u32,
    time: Spread,
    million_pairs_per_s: f64,
    /// Bytes that must move at least, once in and once out, over the time.
    gigabytes_per_s: f64,
}

/// Times the sort of (tile or depth, index) pairs.
pub fn sort(context: &Context, args: &BenchSort) -> Result<()> {
    let device = parse_device(&args.device)?;
    let mut random = Seed::root(args.seed).child("sort").rng();
    let mut cases = Vec::new();
    for pairs in args.pairs.iter().map(|&pairs| pairs as usize) {
        // Random keys of as many bits as depths have, and of as many as tiles of an image have.
        for bits in [32, 13] {
            let keys: Vec<i32> = (0..pairs).map(|_| (random.random::<u32>() >> (32 - bits)) as i32).collect();
            let keys = Tensor::<1, burn::tensor::Int>::from_data(TensorData::new(keys, [pairs]), &device);
            let time = timed(args.repeats as usize, || {
                // One number read back says that everything before it is done.
                sort_order(keys.clone(), bits)?.narrow(0, 0, 1).into_scalar::<i64>();
                Ok(())
            })?;
            let per_s = pairs as f64 / (time.median_ms * 1e-3).max(1e-9);
            cases.push(SortCase { pairs, bits, time, million_pairs_per_s: per_s * 1e-6, gigabytes_per_s: 16.0 * per_s * 1e-9 });
        }
    }
    let report =
        SortReport { version: env!("CARGO_PKG_VERSION"), device: resolved_device(&args.device), threads: rayon::current_num_threads(), seed: args.seed, cases };
    context.output.result(&report, || {
        let threads = plural(report.threads, "thread", "threads");
        let mut lines = vec![format!("sort on {}, {} {threads}", report.device, report.threads), "     pairs  bits  median ms   Mpairs/s     GB/s".to_string()];
        lines.extend(
            report
                .cases
                .iter()
                .map(|c| format!("{:>10} {:>5} {:>10.3} {:>10.1} {:>8.2}", c.pairs, c.bits, c.time.median_ms, c.million_pairs_per_s, c.gigabytes_per_s)),
        );
        lines.join("\n")
    })
}

#[derive(Serialize)]
struct LossReport<'a> {
    version: &'static str,
    device: &'a str,
    threads: usize,
    seed: u64,
    cases: Vec<LossCase>,
}

#[derive(Serialize)]
struct LossCase {
    width: usize,
    height: usize,
    forward: Spread,
    forward_backward: Spread,
    /// Two images in and a gradient out, over the time of both passes.
    gigabytes_per_s: f64,
}

/// Times L1 and SSIM with their gradient.
pub fn loss(context: &Context, args: &BenchLoss) -> Result<()> {
    let device = parse_device(&args.device)?;
    let tracked = device.clone().autodiff();
    let mut random = Seed::root(args.seed).child("loss").rng();
    let mut cases = Vec::new();
    for &megapixels in &args.megapixels {
        let width = ((megapixels * 1e6 * 4.0 / 3.0).sqrt().round() as usize).max(16);
        let height = ((megapixels * 1e6 / width as f64).round() as usize).max(16);
        let mut image = |planes: usize| {
            let values: Vec<f32> = (0..planes * width * height).map(|_| random.random()).collect();
            Tensor::<3>::from_data(TensorData::new(values, [planes, height, width]), &tracked)
        };
        let (render, target) = (image(5).require_grad(), image(3));
        let forward = timed(args.repeats as usize, || to_vec(photometric_loss(render.clone(), target.clone(), 0.8)?.loss.inner(), "loss").map(|_| ()))?;
        let forward_backward = timed(args.repeats as usize, || {
            let gradients = photometric_loss(render.clone(), target.clone(), 0.8)?.loss.backward();
            match render.grad(&gradients) {
                Some(gradient) => to_vec(gradient.narrow(0, 0, 1).narrow(1, 0, 1), "gradient").map(|_| ()),
                None => Ok(()),
            }
        })?;
        let bytes = 4.0 * (5 + 3 + 5) as f64 * (width * height) as f64;
        cases.push(LossCase { width, height, forward, forward_backward, gigabytes_per_s: bytes / (forward_backward.median_ms * 1e6).max(1e-9) });
    }
    let report =
        LossReport { version: env!("CARGO_PKG_VERSION"), device: resolved_device(&args.device), threads: rayon::current_num_threads(), seed: args.seed, cases };
    context.output.result(&report, || {
        let threads = plural(report.threads, "thread", "threads");
        let mut lines =
            vec![format!("L1 and SSIM on {}, {} {threads}", report.device, report.threads), "     image  forward ms  with gradient ms     GB/s".to_string()];
        lines.extend(report.cases.iter().map(|c| {
            format!("{:>5}x{:<5} {:>10.3} {:>17.3} {:>8.2}", c.width, c.height, c.forward.median_ms, c.forward_backward.median_ms, c.gigabytes_per_s)
        }));
        lines.join("\n")
    })
}
