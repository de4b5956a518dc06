//! Deformers, the optimizer, weight codecs and loss terms.

use super::exact::losses::LossValues;
use super::exact::{Exact, losses};
use super::{Compared, FLOAT64, StressCase, StressJob, case};
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::format::conformance::uniform;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    AttributeSpec, Camera, CodecContext, Deformer, DeformerContext, Gaussians, HostGaussians, Limits, LossInput, Registry, Result, Schedule, Seed, Silent,
    SpatialInput, Split, StepSettings, View, WeightArray, toml,
};

/// Centres per deformer.
const POINTS: usize = 120;
/// Values per optimizer run.
const VALUES: usize = 64;

/// A condition, whether its centres are ordinary, and the centre with an index.
type Centres = (&'static str, bool, fn(usize) -> [f32; 3]);

pub fn run(job: &StressJob, note: &mut dyn FnMut(StressCase)) -> Result<()> {
    for (kind, plugin) in job.registry.plugins() {
        match kind {
            "deformer" => deformer(job, plugin.name, note)?,
            "weight-codec" => weight_codec(job, plugin.name, note),
            "loss" => loss(job, plugin.name, note),
            _ => {}
        }
    }
    for (level, decay) in [("constant 1e-3", 1.0f64), ("vanishing", 0.999), ("1e-30", f64::NAN)] {
        let steps = case(&format!("optimizer {}", job.optimizer), &format!("{} steps", job.steps), level, || optimizer(job, decay));
        note(steps.required_if(decay == 1.0));
    }
    Ok(())
}

/// Times at the ends and beyond, and centres in the box, on the faces of voxels, in the corners of the box, and outside.
fn deformer(job: &StressJob, name: &str, note: &mut dyn FnMut(StressCase)) -> Result<()> {
    let (context, settings) = (context(), toml::Table::new());
    let part = format!("deformer {name}");
    let conditions: [Centres; 5] = [
        ("centres in the box", true, |i| [0, 1, 2].map(|k| 0.9 * uniform(Seed::root(3).index(i as u64), k))),
        // Multiples of 1/64 lie on the faces of grids of any power of two.
        ("centres on the faces of voxels", true, |i| [i % 9, i / 9 % 9, i / 81].map(|k| k as f32 / 4.0 - 1.0)),
        ("centres at the box", true, |i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|k| if k == 0 { -1.0 } else { 1.0 })),
        ("centres outside the box", false, |i| [0, 1, 2].map(|k| 50.0 * uniform(Seed::root(4).index(i as u64), k))),
        ("centres far outside the box", false, |i| [0, 1, 2].map(|k| 1e30 * uniform(Seed::root(5).index(i as u64), k))),
    ];
    for (condition, ordinary, centre) in conditions {
        let means: Vec<f32> = (0..POINTS).flat_map(centre).collect();
        let exact = if Exact::knows(name) {
            let deformer = shaken(job.registry, name, &settings, &context, job.host)?;
            let columns = attribute_values(deformer.as_ref());
            let row = |i: usize| columns.iter().flat_map(|(width, values)| values[i * width..(i + 1) * width].to_vec()).collect();
            Some(Exact::new(name, &settings, deformer.as_ref(), &context, &means, &(0..POINTS).map(row).collect::<Vec<_>>())?)
        } else {
            None
        };
        // Both ends and NaN come first, so that devices with fewer levels try them, too.
        for time in [0.0f32, 1.0, f32::NAN, 2.0, 0.5, 1.0f32.next_up(), -1.0, 1e6].into_iter().take(job.deformer_levels) {
            let values = |device: &Device| -> Result<Vec<f32>> {
                let deformer = shaken(job.registry, name, &settings, &context, device)?;
                let tensor = |values: Vec<f32>, width: usize| Tensor::<2>::from_data(TensorData::new(values, [POINTS, width]), device);
                let attributes = attribute_values(deformer.as_ref()).into_iter().map(|(width, values)| tensor(values, width)).collect();
                let input = SpatialInput { means_world: tensor(means.clone(), 3), attributes };
                let offsets = deformer.deform(deformer.spatial(&input)?.values, time)?;
                offsets.concatenated().map_or(Ok(Vec::new()), |all| to_vec(all, "offsets"))
            };
            let exact = || exact.as_ref().map(|exact| exact.at(time)).transpose();
            let tried = case(&part, condition, format!("time {time}"), || compared(job, values, exact));
            note(tried.required_if(ordinary && (0.0..=1.0).contains(&time)));
        }
    }
    Ok(())
}

/// Values on the device under test, and those to compare them with: `exact` ones or, where there are none and the host has other kernels, those on the host.
fn compared(job: &StressJob, values: impl Fn(&Device) -> Result<Vec<f32>>, exact: impl FnOnce() -> Result<Option<Vec<f32>>>) -> Result<Compared> {
    let found = values(job.device)?;
    let oracle = match exact()? {
        Some(exact) => Some((FLOAT64, exact)),
        None if job.other_kernels => Some(("float32 on the host", values(job.host)?)),
        None => None,
    };
    Ok((found, oracle))
}

/// What deformers are built for.
fn context() -> DeformerContext {
    DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 10, sh_degree: 1, seed: Seed::root(2) }
}

/// The deformer called `name` with these `settings`. Fresh ones are the identity, whatever they are asked, so noise is added to all weights.
fn shaken(registry: &Registry, name: &str, settings: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    let mut deformer = (registry.deformer(name)?.build)(settings, context, device)?;
    for (index, parameter) in deformer.parameters_mut().into_iter().enumerate() {
        let count = parameter.value.dims()[0];
        let noise: Vec<f32> = (0..count).map(|k| 0.1 * uniform(Seed::root(13).index(index as u64), k)).collect();
        parameter.value = parameter.value.clone() + Tensor::from_data(TensorData::new(noise, [count]), device);
    }
    Ok(deformer)
}

/// Width and values `[POINTS, width]` of every attribute: its start and noise.
fn attribute_values(deformer: &dyn Deformer) -> Vec<(usize, Vec<f32>)> {
    let values = |(index, spec): (usize, &AttributeSpec)| {
        let noise = |k: usize| spec.start + 0.1 * uniform(Seed::root(14).index(index as u64), k);
        (spec.width, (0..POINTS * spec.width).map(noise).collect())
    };
    deformer.attributes().iter().enumerate().map(values).collect()
}

/// Many steps with gradients that vanish, against float64.
fn optimizer(job: &StressJob, decay: f64) -> Result<Compared> {
    let section = toml::Table::from_iter([("kind".into(), job.optimizer.into())]);
    let mut optimizer = job.registry.build_optimizer(&section)?;
    let first: Vec<f32> = (0..VALUES).map(|k| 1e-3 * uniform(Seed::root(9), k)).collect();
    let start: Vec<f32> = (0..VALUES).map(|k| uniform(Seed::root(10), k)).collect();
    let settings = StepSettings::new(1e-4);
    let tensor = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [VALUES, 1]), job.device);
    let at = |step: usize, k: usize| -> f32 { if decay.is_nan() { 1e-30 } else { (f64::from(first[k]) * decay.powi(step.min(100_000) as i32)) as f32 } };
    let mut value = tensor(start.clone());
    let (mut exact, mut m, mut v) = (start.iter().map(|x| f64::from(*x)).collect::<Vec<_>>(), vec![0.0f64; VALUES], vec![0.0f64; VALUES]);
    let (beta1, beta2) = (0.9f64, 0.999f64);
    for step in 1..=job.steps {
        let gradient: Vec<f32> = (0..VALUES).map(|k| at(step - 1, k)).collect();
        for (k, g) in gradient.iter().enumerate() {
            let g = f64::from(*g);
            m[k] = beta1 * m[k] + (1.0 - beta1) * g;
            v[k] = beta2 * v[k] + (1.0 - beta2) * g * g;
            let (m_hat, v_hat) = (m[k] / (1.0 - beta1.powi(step as i32)), v[k] / (1.0 - beta2.powi(step as i32)));
            exact[k] -= settings.lr * m_hat / (v_hat.sqrt() + settings.epsilon);
        }
        value = optimizer.step("stress", value, tensor(gradient), &settings)?;
    }
    Ok((to_vec(value, "values")?, Some((FLOAT64, exact.into_iter().map(|x| x as f32).collect()))))
}

/// Weights at the limits of half precision.
fn weight_codec(job: &StressJob, name: &str, note: &mut dyn FnMut(StressCase)) {
    for (level, scale) in [("1e-30", 1e-30f32), ("1e-8", 1e-8), ("1e-4", 1e-4), ("1", 1.0), ("6e4", 6e4), ("1e6", 1e6), ("1e30", 1e30)] {
        let sized = case(&format!("weight codec {name}"), "size of the weights", level, || {
            let codec = job.registry.build_weight_codec(name, &toml::Table::new())?;
            let values: Vec<f32> = (0..500).map(|k| scale * uniform(Seed::root(12), k)).collect();
            let context = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
            let streams = codec.encode(&[WeightArray { name: "w".into(), shape: vec![500], values: values.clone() }], &context)?;
            let found = codec.decode(&streams, &context)?.into_iter().flat_map(|array| array.values).collect();
            // The oracle is the weights themselves: all differences are losses of the codec.
            Ok((found, Some(("the weights", values))))
        });
        note(sized.required_if(scale == 1.0));
    }
}

/// Images with ever larger values. A loss must not panic, and must be finite where float32 can represent it; in training the watchdog catches other values.
fn loss(job: &StressJob, name: &str, note: &mut dyn FnMut(StressCase)) {
    const SIZE: [usize; 2] = [17, 23];
    let pixels = SIZE[0] * SIZE[1];
    let draw = |seed: u64, count: usize| -> Vec<f32> { (0..count).map(|k| 0.5 + 0.5 * uniform(Seed::root(seed), k)).collect() };
    let target = draw(2, 3 * pixels);
    // Every fifth pixel is unknown.
    let depth: Vec<f32> = draw(3, pixels).into_iter().enumerate().map(|(k, z)| if k.is_multiple_of(5) { 0.0 } else { 0.5 + z }).collect();
    let host = HostGaussians {
        means: vec![0.0; 3],
        log_scales: vec![-2.0; 3],
        quaternions: vec![1.0, 0.0, 0.0, 0.0],
        opacity_logits: vec![0.0],
        sh_dc: vec![0.0; 3],
        dynamic_scores: vec![0.0],
        ..Default::default()
    };
    let camera = Camera::look_at("stress", (SIZE[1] as u32, SIZE[0] as u32), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let (view, schedule) = (View { camera: 0, frame: 0, time_norm: 0.5, split: Split::Train }, Schedule::main(100));
    for level in [0.0f32, 1.0, 1e4, 1e10, 1e18] {
        let planes: Vec<f32> = draw(1, 5 * pixels).into_iter().map(|v| level * v).collect();
        let values = |device: &Device| -> Result<Vec<f32>> {
            let term = (job.registry.loss(name)?.build)(&toml::Table::new())?;
            let tensor = |values: &[f32]| Tensor::<3>::from_data(TensorData::new(values.to_vec(), [values.len() / pixels, SIZE[0], SIZE[1]]), device);
            let (planes, target, depth) = (tensor(&planes), tensor(&target), tensor(&depth));
            let gaussians = Gaussians::from_host(&host, device);
            let radii = Tensor::<1, Int>::from_data(TensorData::new(vec![3i64], [1]), device);
            let input = LossInput::new(&camera, &view, &planes, &target, &gaussians, &radii, &schedule);
            term.value(&input.with_depth(Some(&depth)))?.map_or(Ok(vec![0.0]), |value| to_vec(value, "loss"))
        };
        let exact = || -> Result<Option<Vec<f32>>> {
            let input = LossValues { planes: &planes, target: &target, depth: &depth, size: SIZE, gaussians: &host, extent: schedule.extent };
            Ok(losses::value(name, &input).map(|value| vec![value as f32]))
        };
        let exploded = case(&format!("loss {name}"), "exploding images", format!("{level:e}"), || compared(job, values, exact));
        note(exploded.required_if(level == 1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_follow_the_settings_of_the_bands_of_time() {
        let (registry, device, context) = (Registry::collect().unwrap(), Device::flex(), context());
        let means: Vec<f32> = (0..3 * 12).map(|k| 0.9 * uniform(Seed::root(3), k)).collect();
        // No default: `cdf` has one cycle without falloff, the others one cycle with a falloff of 1.
        for (name, settings) in
            [("cdf", "cycles = 0.5\nfalloff = 1.0"), ("cdf-basis", "cycles = 0.5\nfalloff = 0.5"), ("hash-basis", "cycles = 2.0\nfalloff = 0.0")]
        {
            let settings: toml::Table = settings.parse().unwrap();
            let deformer = shaken(&registry, name, &settings, &context, &device).unwrap();
            let points = Tensor::<2>::from_data(TensorData::new(means.clone(), [12, 3]), &device);
            let features = deformer.spatial(&SpatialInput::new(points)).unwrap().values;
            let formulas = |settings: &toml::Table| Exact::new(name, settings, deformer.as_ref(), &context, &means, &[]).unwrap();
            let (exact, of_defaults) = (formulas(&settings), formulas(&toml::Table::new()));
            for time in [0.3, 0.85] {
                let found = to_vec(deformer.deform(features.clone(), time).unwrap().concatenated().unwrap(), "offsets").unwrap();
                let error = |exact: &Exact| case(name, "", "", || Ok((found.clone(), Some((FLOAT64, exact.at(time)?))))).error.unwrap();
                assert!((1e-12..1e-4).contains(&error(&exact)), "{name} at {time}: {:e}", error(&exact));
                assert!(error(&of_defaults) > 1e-3, "{name} at {time}: the settings change nothing, {:e}", error(&of_defaults));
            }
        }
    }

    #[test]
    fn settings_that_formulas_do_not_read_are_refused() {
        let (registry, device, context) = (Registry::collect().unwrap(), Device::flex(), context());
        for (name, settings, key) in [("cdf", "cycles = 0.5\nlevels = 2", "levels"), ("deform-mlp", "cycles = 0.5", "cycles")] {
            let deformer = shaken(&registry, name, &toml::Table::new(), &context, &device).unwrap();
            let refused = Exact::new(name, &settings.parse().unwrap(), deformer.as_ref(), &context, &[], &[]).err().unwrap().to_string();
            assert!(refused.contains(name) && refused.contains(&format!("setting {key}")), "{refused}");
        }
    }
}
