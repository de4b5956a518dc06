//! The computational field forwards and backwards, against the same field in burn's primitives.

use super::{Spread, timed};
use crate::args::BenchField;
use crate::commands::Context;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, DeformerContext, DeformerWork, Error, Result, Seed, SpatialInput, config, parse_device, plural, resolved_device};
use cc4dgs_deformers::cdf::{Cdf, CdfConfig, Formulas};
use rand::Rng;
use serde::Serialize;

/// Blobs the points lie in, so that neighbours share voxels as those of a body do.
const BLOBS: usize = 12;
/// A time at which no band of the encoding is zero.
const TIME: f32 = 0.43;

#[derive(Serialize)]
struct FieldReport<'a> {
    version: &'static str,
    device: &'a str,
    threads: usize,
    seed: u64,
    gaussians: usize,
    /// Vertices asked for and decoded.
    work: DeformerWork,
    parameters: usize,
    /// Spatial features.
    spatial: Spread,
    /// Offsets from cached features at one time.
    deform: Spread,
    /// Everything forwards and backwards, with the gradient of all weights.
    forward_backward: Spread,
    /// The same in burn's primitives.
    primitives: Spread,
    /// Medians.
    speedup: f64,
    /// Relative differences between the two.
    offset_difference: f64,
    gradient_difference: f64,
}

/// Times the field.
pub fn field(context: &Context, args: &BenchField) -> Result<()> {
    let device = parse_device(&args.device)?;
    let mut table = toml::Table::new();
    config::set_all(&mut table, &args.set)?;
    let scene = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 300, sh_degree: 3, seed: Seed::root(args.seed).child("field") };
    let mut field = Cdf::new(config::parse_section::<CdfConfig>("deformer cdf", &table)?, &scene, &device)?;
    stir(&mut field, Seed::root(args.seed).child("weights"), &device)?;
    let means_world = blobs(args.gaussians as usize, Seed::root(args.seed).child("points"), &device);

    let cached = field.spatial(&SpatialInput::new(means_world.clone()))?;
    let repeats = args.repeats as usize;
    let spatial = timed(repeats, || first(field.spatial(&SpatialInput::new(means_world.clone()))?.values))?;
    let deform = timed(repeats, || match field.deform(cached.values.clone(), TIME)?.concatenated() {
        Some(offsets) => first(offsets),
        None => Ok(()),
    })?;
    for parameter in field.parameters_mut() {
        parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
    }
    let tracked = Tensor::<2>::from_inner(means_world.clone());
    let fused = || -> Result<Tensor<2>> {
        let offsets = field.deform(field.spatial(&SpatialInput::new(tracked.clone()))?.values, TIME)?.concatenated();
        offsets.ok_or_else(|| Error::parameter("heads", "none is on", "Turn one on"))
    };
    let primitive = || Formulas(&field).offsets(tracked.clone(), TIME);
    let [ours, theirs] = [gradients(&field, fused()?)?, gradients(&field, primitive()?)?];
    let offset_difference = relative(&to_vec(fused()?.inner(), "offsets")?, &to_vec(primitive()?.inner(), "offsets")?);
    let gradient_difference = ours.iter().zip(&theirs).map(|(a, b)| relative(a, b)).fold(0.0, f64::max);
    let forward_backward = timed(repeats, || gradients(&field, fused()?).map(|_| ()))?;
    let primitives = timed(repeats.min(5), || gradients(&field, primitive()?).map(|_| ()))?;
    let report = FieldReport {
        version: env!("CARGO_PKG_VERSION"),
        device: resolved_device(&args.device),
        threads: rayon::current_num_threads(),
        seed: args.seed,
        gaussians: args.gaussians as usize,
        work: cached.work,
        parameters: field.parameters().iter().map(|p| p.shape.iter().product::<usize>()).sum(),
        spatial,
        deform,
        forward_backward,
        primitives,
        speedup: primitives.median_ms / forward_backward.median_ms.max(1e-9),
        offset_difference,
        gradient_difference,
    };
    context.output.result(&report, || text(&report))
}

/// Points of a moving body.
fn blobs(count: usize, seed: Seed, device: &Device) -> Tensor<2> {
    let mut random = seed.rng();
    let centres: Vec<[f32; 3]> = (0..BLOBS).map(|_| std::array::from_fn(|_| random.random_range(-0.7..0.7))).collect();
    let values: Vec<f32> = (0..count).flat_map(|i| centres[i % BLOBS].map(|c| c + random.random_range(-0.2f32..0.2))).collect();
    Tensor::from_data(TensorData::new(values, [count, 3]), device)
}

/// Moves every weight a little, so that no head is zero.
fn stir(field: &mut Cdf, seed: Seed, device: &Device) -> Result<()> {
    let mut random = seed.rng();
    for parameter in field.parameters_mut() {
        let values = to_vec(parameter.value.clone(), &parameter.name)?;
        let moved: Vec<f32> = values.into_iter().map(|v| v + random.random_range(-0.02f32..0.02)).collect();
        let len = moved.len();
        parameter.value = Tensor::from_data(TensorData::new(moved, [len]), device);
    }
    Ok(())
}

/// Reads one number back, which says that everything before it is done.
fn first(values: Tensor<2>) -> Result<()> {
    to_vec(values.narrow(0, 0, 1), "one row").map(|_| ())
}

/// The gradients of all weights for an upstream gradient of ones, read back.
fn gradients(field: &Cdf, offsets: Tensor<2>) -> Result<Vec<Vec<f32>>> {
    let gradients = offsets.sum().backward();
    field.parameters().into_iter().filter_map(|p| p.value.grad(&gradients).map(|g| to_vec(g, &p.name))).collect()
}

fn relative(found: &[f32], truth: &[f32]) -> f64 {
    let error: f64 = found.iter().zip(truth).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    let norm: f64 = truth.iter().map(|v| f64::from(*v).powi(2)).sum();
    (error / norm.max(f64::MIN_POSITIVE)).sqrt()
}

fn text(r: &FieldReport) -> String {
    let saved = 100.0 * (1.0 - r.work.vertices_decoded as f64 / r.work.vertices_queried.max(1) as f64);
    [
        format!(
            "cdf on {}, {} {}: {} Gaussians, {} weights, {} vertices decoded ({saved:.0} % reused)",
            r.device,
            r.threads,
            plural(r.threads, "thread", "threads"),
            r.gaussians,
            r.parameters,
            r.work.vertices_decoded
        ),
        format!("  spatial features           {:>9.2} ms", r.spatial.median_ms),
        format!("  offsets, features cached   {:>9.2} ms", r.deform.median_ms),
        format!("  forwards and backwards     {:>9.2} ms", r.forward_backward.median_ms),
        format!("  the same, burn primitives  {:>9.2} ms, {:.1} times as long", r.primitives.median_ms, r.speedup),
        format!("  offsets within {:.1e}, gradients within {:.1e} of the primitives'", r.offset_difference, r.gradient_difference),
    ]
    .join("\n")
}
