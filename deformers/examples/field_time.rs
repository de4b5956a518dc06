//! Prints what vertex reuse and caching save, and how the fused decoder compares with the same layers in burn primitives.
//! `cargo run --release -p cc4dgs-deformers --example field_time [GAUSSIANS]`
#![allow(clippy::print_stdout, reason = "a program for people")]

use burn::tensor::activation::mish;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{Decoder, GridBox, LevelHash, MishShape, VoxelCorners};
use cc4dgs_core::{DeformationField, FieldContext, Seed, config};
use cc4dgs_deformers::cdf::{Cdf, CdfConfig};
use rand::Rng;
use std::sync::Arc;
use std::time::Instant;

/// The fastest of `times` runs, in milliseconds.
fn fastest(times: usize, mut run: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..times {
        let start = Instant::now();
        run();
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
    }
    best
}

/// Points of a moving body: a few blobs, so that neighbours share voxels.
fn points(n: usize, seed: Seed, device: &Device) -> Tensor<2> {
    let mut random = seed.rng();
    let centres: Vec<[f32; 3]> = (0..12).map(|_| std::array::from_fn(|_| random.random_range(-0.7..0.7))).collect();
    let values: Vec<f32> = (0..n).flat_map(|i| centres[i % 12].map(|c| c + random.random_range(-0.2f32..0.2))).collect();
    Tensor::from_data(TensorData::new(values, [n, 3]), device)
}

fn field_times(n: usize, capacity: &str, device: &Device) -> cc4dgs_core::Result<()> {
    let context = FieldContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 100, sh_degree: 3, seed: Seed::root(1) };
    let build = |reuse: bool| -> cc4dgs_core::Result<Cdf> {
        let table = config::parse_table("example", &format!("capacity = \"{capacity}\"\nvertex_reuse = {reuse}"))?;
        Cdf::new(config::parse_section::<CdfConfig>("example", &table)?, &context, device)
    };
    let (reuse, plain) = (build(true)?, build(false)?);
    let means = points(n, Seed::root(2), device);
    let cached = reuse.spatial(means.clone())?;
    let spatial_reuse = fastest(20, || drop(reuse.spatial(means.clone())));
    let spatial_plain = fastest(10, || drop(plain.spatial(means.clone())));
    let deform = fastest(30, || drop(reuse.deform(cached.values.clone(), 0.4)));
    let work = cached.work;
    println!("{capacity}: {n} Gaussians, {} of {} corners decoded with reuse", work.vertices_decoded, work.vertices_queried);
    println!("  cache + reuse, steady state {deform:8.2} ms");
    println!("  reuse only                  {:8.2} ms", spatial_reuse + deform);
    println!("  neither                     {:8.2} ms, {:.1} times the first", spatial_plain + deform, (spatial_plain + deform) / deform);
    Ok(())
}

/// The decoder's layers in burn primitives, from signatures.
fn primitive_decoder(x: Tensor<2>, weights: &Tensor<1>, shape: &MishShape) -> Tensor<2> {
    let mut x = x;
    for layer in shape.layers() {
        let take = |range: std::ops::Range<usize>, rows: usize| weights.clone().narrow(0, range.start, range.len()).reshape([rows, range.len() / rows]);
        x = x.matmul(take(layer.weight, layer.input)) + take(layer.bias, 1);
        if let (Some(gain), Some(shift)) = (layer.gain, layer.shift) {
            let centred = x.clone() - x.mean_dim(1);
            let deviation = (centred.clone().powi_scalar(2).mean_dim(1) + 1e-5).sqrt();
            x = mish(centred / deviation * take(gain, 1) + take(shift, 1));
        }
    }
    x
}

fn decoder_times(n: usize, device: &Device) -> cc4dgs_core::Result<()> {
    let shape = MishShape { input: 128, hidden: vec![128, 128], output: 32 };
    let decoder = Arc::new(Decoder { hash: LevelHash::new(Seed::root(3), 128, 1_000_000), shape: shape.clone() });
    let grid = GridBox { min: [-1.0; 3], max: [1.0; 3], resolution: 128 };
    let corners = VoxelCorners::find(points(n, Seed::root(2), device), grid, true)?;
    let vertices: Vec<[u32; 3]> =
        corners.vertices.clone().into_data().iter::<i64>().collect::<Vec<_>>().chunks_exact(3).map(|v| [v[0] as u32, v[1] as u32, v[2] as u32]).collect();
    let mut signatures = vec![0.0; vertices.len() * 128];
    let hashing = fastest(10, || decoder.hash.signatures(&vertices, &mut signatures));
    let mut random = Seed::root(4).rng();
    let weights: Vec<f32> = (0..shape.parameter_count()).map(|_| random.random_range(-0.08f32..0.08)).collect();
    let tracked = device.clone().autodiff();
    let weights = Tensor::<1>::from_data(TensorData::new(weights, [shape.parameter_count()]), &tracked).require_grad();
    let x = Tensor::<2>::from_data(TensorData::new(signatures, [vertices.len(), 128]), &tracked);
    let fused = fastest(20, || drop(corners.decode(weights.clone(), &decoder).map(|y| y.sum().backward())));
    let primitive = fastest(5, || drop(primitive_decoder(x.clone(), &weights, &shape).sum().backward()));
    let flops = 3.0 * 2.0 * 37_000.0 * vertices.len() as f64;
    println!("decoder, {} vertices, forward + backward:", vertices.len());
    println!("  fused with hashing {fused:8.2} ms ({:.0} GFLOP/s); hashing alone on one thread {hashing:.2} ms", flops / fused / 1e6);
    println!("  burn primitives    {primitive:8.2} ms ({:.0} GFLOP/s), {:.1} times the fused", flops / primitive / 1e6, primitive / fused);
    Ok(())
}

fn main() -> cc4dgs_core::Result<()> {
    let n = std::env::args().nth(1).and_then(|n| n.parse().ok()).unwrap_or(5_000);
    for name in ["flex", "ndarray"] {
        let device = cc4dgs_core::parse_device(name)?;
        println!("[{name}]");
        for capacity in ["default", "small"] {
            field_times(n, capacity, &device)?;
        }
        decoder_times(n, &device)?;
    }
    Ok(())
}
