//! The baselines' lookups forwards and backwards, against the same in burn's primitives.

use super::{Spread, timed};
use crate::args::BenchLookup;
use crate::commands::Context;
use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_backends::cpu::lookup::corners;
use cc4dgs_backends::ops::lookup::{GridShape, Outside, lookup as look_up};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Result, Seed, parse_device, plural, resolved_device};
use rand::Rng;
use serde::Serialize;
use std::sync::Arc;

#[derive(Serialize)]
struct LookupReport<'a> {
    version: &'static str,
    device: &'a str,
    threads: usize,
    seed: u64,
    gaussians: usize,
    cases: Vec<LookupCase>,
}

#[derive(Serialize)]
struct LookupCase {
    name: &'static str,
    /// Rows read per run: points times levels times corners.
    rows_read: u64,
    parameters: usize,
    /// Features, and the gradient of the table.
    fused: Spread,
    /// The same in burn's primitives, which are given rows and weights for nothing.
    primitives: Spread,
    speedup: f64,
    gradient_difference: f64,
}

/// The grids of Swift4D, Grid4D (space; space and time) and 4DGS (a plane with time).
fn grids() -> Vec<(&'static str, GridShape)> {
    let hash = |dims, features, stagger, smooth| GridShape { dims, features, levels: Vec::new(), stagger, smooth, clamps: false, outside: Outside::Zero };
    let mut swift = hash(4, 4, 0.5, false);
    (0..16).for_each(|l| swift.push(&[16 << l; 4], &[(16 << l) as f32 - 1.0; 4], 1 << 15));
    let mut space = hash(3, 2, 0.0, true);
    (0..16).map(|l| 16.0 * 128f32.powf(l as f32 / 15.0)).for_each(|v| space.push(&[v.ceil() as u32; 3], &[v - 1.0; 3], 1 << 19));
    let mut time = hash(3, 2, 0.0, true);
    (0..32).map(|l| 8.0 * 4f32.powf(l as f32 / 31.0)).for_each(|v| time.push(&[v.ceil() as u32; 3], &[v - 1.0; 3], 1 << 19));
    let mut plane = GridShape { dims: 2, features: 16, levels: Vec::new(), stagger: 0.0, smooth: false, clamps: true, outside: Outside::Clamp };
    [64u32, 128].into_iter().for_each(|v| plane.push(&[v, 150], &[v as f32 - 1.0, 149.0], usize::MAX));
    vec![("swift4d-hash", swift), ("grid4d space", space), ("grid4d time", time), ("hexplane", plane)]
}

/// Times the lookups.
pub fn lookup(context: &Context, args: &BenchLookup) -> Result<()> {
    let device = parse_device(&args.device)?;
    let tracked = device.clone().autodiff();
    let m = args.gaussians as usize;
    let mut random = Seed::root(args.seed).child("lookup").rng();
    let mut cases = Vec::new();
    for (name, shape) in grids() {
        let points: Vec<f32> = (0..m * shape.dims).map(|_| random.random()).collect();
        let values: Vec<f32> = (0..shape.parameter_count()).map(|_| random.random_range(-1.0f32..1.0)).collect();
        let table = Tensor::<1>::from_data(TensorData::new(values, [shape.parameter_count()]), &tracked).require_grad();
        let corner_count = 1 << shape.dims;
        let found: Vec<(Tensor<1, Int>, Tensor<2>)> = shape
            .levels
            .iter()
            .map(|level| {
                let (rows, weights) = corners(&shape, level, &points);
                let count = rows.len();
                (Tensor::from_data(TensorData::new(rows, [count]), &tracked), Tensor::from_data(TensorData::new(weights, [count, 1]), &tracked))
            })
            .collect();
        let points = Tensor::<2>::from_data(TensorData::new(points, [m, shape.dims]), &tracked);
        let shape = Arc::new(shape);
        let (rows, features) = (shape.rows(), shape.features);
        let fused = || look_up(table.clone(), points.clone(), &shape);
        let primitive = || -> Result<Tensor<2>> {
            let table = table.clone().reshape([rows, features]);
            let level = |(rows, weights): &(Tensor<1, Int>, Tensor<2>)| {
                (table.clone().select(0, rows.clone()) * weights.clone()).reshape([m, corner_count, features]).sum_dim(1).reshape([m, features])
            };
            Ok(Tensor::cat(found.iter().map(level).collect(), 1))
        };
        // Of a timed run one number is read back, which says that everything before it is done.
        let gradient = |out: Tensor<2>, all: bool| -> Result<Vec<f32>> {
            let gradients = out.sum().backward();
            table.grad(&gradients).map_or(Ok(Vec::new()), |g| to_vec(if all { g } else { g.narrow(0, 0, 1) }, "gradient"))
        };
        let (ours, theirs) = (gradient(fused()?, true)?, gradient(primitive()?, true)?);
        let error: f64 = ours.iter().zip(&theirs).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        let norm: f64 = theirs.iter().map(|v| f64::from(*v).powi(2)).sum();
        let repeats = args.repeats as usize;
        let fused = timed(repeats, || gradient(fused()?, false).map(|_| ()))?;
        let primitives = timed(repeats.min(3), || gradient(primitive()?, false).map(|_| ()))?;
        cases.push(LookupCase {
            name,
            rows_read: (m * shape.levels.len() * corner_count) as u64,
            parameters: shape.parameter_count(),
            fused,
            primitives,
            speedup: primitives.median_ms / fused.median_ms.max(1e-9),
            gradient_difference: (error / norm.max(f64::MIN_POSITIVE)).sqrt(),
        });
    }
    let report = LookupReport {
        version: env!("CARGO_PKG_VERSION"),
        device: resolved_device(&args.device),
        threads: rayon::current_num_threads(),
        seed: args.seed,
        gaussians: m,
        cases,
    };
    context.output.result(&report, || {
        let threads = plural(report.threads, "thread", "threads");
        let mut lines = vec![
            format!("lookups forwards and backwards on {}, {} {threads}, {} Gaussians", report.device, report.threads, report.gaussians),
            "grid            parameters   rows read   fused ms  primitives ms  speedup  gradients differ by".to_string(),
        ];
        lines.extend(report.cases.iter().map(|c| {
            format!(
                "{:<14} {:>11} {:>11} {:>10.2} {:>14.2} {:>7.1}x {:>20.1e}",
                c.name, c.parameters, c.rows_read, c.fused.median_ms, c.primitives.median_ms, c.speedup, c.gradient_difference
            )
        }));
        lines.join("\n")
    })
}
