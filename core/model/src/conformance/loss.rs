//! What a loss term must keep to.

use super::{matrix, uniform};
use crate::gaussians::{sh_rest_len, to_vec};
use crate::{Gaussians, HostGaussians, LossInput, LossPlugin, LossTerm, Result, Schedule, Seed, config};
use burn::tensor::{Device, Int, Tensor, TensorData};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Image height and width: larger than the windows of structural similarity.
const SIZE: [usize; 2] = [18, 22];
const GAUSSIANS: usize = 24;
const SH_DEGREE: usize = 1;
/// Step of the finite differences along a random direction.
const STEP: f64 = 2e-3;
/// Largest difference of the slope from the gradient, as a share of the larger of the two.
const TOLERANCE: f64 = 0.05;

/// Holds a loss term to its promises on `device`:
/// - unknown settings are refused, and the schema builds what no settings build;
/// - the value is one finite number, the same at every call, and 0 Gaussians are answered;
/// - its gradients with respect to the planes and to every attribute of the Gaussians agree with finite differences.
///
/// `settings` is the `[[loss]]` section without `kind` and `weight`. Each finding is a line; an empty list is a pass.
pub fn loss(plugin: &LossPlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let checks: [(&str, &Check); 4] = [
        ("settings", &|| refuses_unknown_settings(plugin, settings)),
        ("schema", &|| schema_states_the_defaults(plugin, device)),
        ("value", &|| values_are_sound((plugin.build)(settings)?.as_ref(), device)),
        ("gradients", &|| gradients_are_slopes((plugin.build)(settings)?.as_ref(), device)),
    ];
    let found = checks.into_iter().filter_map(|(name, check)| {
        let finding = match catch_unwind(AssertUnwindSafe(check)) {
            Ok(Ok(finding)) => finding?,
            Ok(Err(e)) => e.to_string(),
            Err(_) => "it panics".to_string(),
        };
        Some(format!("{} on {device:?}, {name}: {finding}", plugin.info.name))
    });
    found.collect()
}

/// One check: what it found, if anything.
type Check<'a> = dyn Fn() -> Result<Option<String>> + 'a;

fn refuses_unknown_settings(plugin: &LossPlugin, settings: &toml::Table) -> Result<Option<String>> {
    let mut settings = settings.clone();
    settings.insert("no_such_setting".into(), 1.into());
    Ok(match (plugin.build)(&settings) {
        Ok(_) => Some("an unknown setting was accepted".into()),
        Err(e) if !e.to_string().contains("no_such_setting") => Some(format!("the error does not name the unknown setting: {e}")),
        Err(_) => None,
    })
}

/// `config.toml` is written in full from the schema, so that it must build what no settings build.
fn schema_states_the_defaults(plugin: &LossPlugin, device: &Device) -> Result<Option<String>> {
    let stated = config::parse_table(&format!("schema of loss {}", plugin.info.name), plugin.info.schema)?;
    let sample = Sample::new(GAUSSIANS, device);
    let [plain, full] = [toml::Table::new(), stated].map(|settings| sample.value((plugin.build)(&settings)?.as_ref()));
    let (plain, full) = (plain?, full?);
    Ok((plain != full).then(|| format!("the settings it states give the value {full:?}, no settings {plain:?}")))
}

fn values_are_sound(term: &dyn LossTerm, device: &Device) -> Result<Option<String>> {
    let sample = Sample::new(GAUSSIANS, device);
    if let Some(value) = sample.tensor(term)?
        && value.dims() != [1]
    {
        return Ok(Some(format!("the value has shape {:?} in place of [1]", value.dims())));
    }
    let (first, second) = (sample.value(term)?, sample.value(term)?);
    if first.is_some_and(|v| !v.is_finite()) {
        return Ok(Some(format!("the value is {first:?}")));
    }
    if first != second {
        return Ok(Some(format!("it is {first:?} at first and then {second:?}")));
    }
    let empty = Sample::new(0, device).value(term)?;
    Ok(empty.is_some_and(|v| !v.is_finite()).then(|| format!("without Gaussians the value is {empty:?}")))
}

fn gradients_are_slopes(term: &dyn LossTerm, device: &Device) -> Result<Option<String>> {
    let device = device.clone().autodiff();
    let plain = Sample::new(GAUSSIANS, &device);
    let tracked = plain.tracked();
    let Some(value) = tracked.tensor(term)? else { return Ok(None) };
    let size = f64::from(to_vec(value.clone(), "value")?[0].abs());
    let gradients = value.backward();
    for (index, (name, _)) in plain.inputs.iter().enumerate() {
        let (start, tracked) = (&plain.inputs[index].1, &tracked.inputs[index].1);
        let seed = Seed::root(31).index(index as u64);
        let [rows, width] = start.dims();
        if rows * width == 0 {
            continue;
        }
        let direction = matrix(seed, rows, width, &device);
        let along = match tracked.grad(&gradients) {
            None => 0.0,
            Some(gradient) => f64::from(to_vec((gradient * direction.clone().inner()).sum(), name)?[0]),
        };
        let moved =
            |step: f64| -> Result<f64> { Ok(f64::from(plain.with(index, start.clone() + direction.clone() * step as f32).value(term)?.unwrap_or(0.0))) };
        let slope = (moved(STEP)? - moved(-STEP)?) / (2.0 * STEP);
        // A value of this size is known to some 1e-6 of itself.
        let rounding = 4e-6 * size.max(1e-3) / STEP;
        if (along - slope).abs() > TOLERANCE * along.abs().max(slope.abs()) + rounding {
            return Ok(Some(format!("along a direction of {name} the gradient is {along:.5e} and the slope {slope:.5e}")));
        }
    }
    Ok(None)
}

/// One view with Gaussians: the planes [5, H·W] and the attributes, by name.
struct Sample {
    inputs: Vec<(String, Tensor<2>)>,
    target: Tensor<3>,
    radii: Tensor<1, Int>,
}

impl Sample {
    fn new(n: usize, device: &Device) -> Self {
        let random = |index: u64, count: usize, low: f32, high: f32| -> Vec<f32> {
            (0..count).map(|k| low + (high - low) * 0.5 * (1.0 + uniform(Seed::root(30).index(index), k))).collect()
        };
        let [height, width] = SIZE;
        let pixels = height * width;
        let planes = Tensor::<2>::from_data(TensorData::new(random(0, 5 * pixels, 0.05, 0.95), [5, pixels]), device);
        let target = Tensor::<3>::from_data(TensorData::new(random(1, 3 * pixels, 0.05, 0.95), [3, height, width]), device);
        let host = HostGaussians {
            sh_degree: SH_DEGREE,
            means: random(2, 3 * n, -1.0, 1.0),
            log_scales: random(3, 3 * n, -4.0, -1.0),
            quaternions: random(4, 4 * n, -1.0, 1.0),
            opacity_logits: random(5, n, -2.0, 2.0),
            sh_dc: random(6, 3 * n, -1.0, 1.0),
            sh_rest: random(7, 3 * n * sh_rest_len(SH_DEGREE), -0.3, 0.3),
            dynamic_scores: random(8, n, 0.0, 1.0),
            ..Default::default()
        };
        let gaussians = Gaussians::from_host(&host, device);
        let attributes = gaussians.attribute_names().into_iter().filter_map(|name| Some((name.clone(), gaussians.attribute(&name)?)));
        // Every fourth Gaussian is culled.
        let radii: Vec<i64> = (0..n).map(|i| if i % 4 == 3 { 0 } else { 3 + i as i64 % 5 }).collect();
        let radii = Tensor::from_data(TensorData::new(radii, [n]), device);
        Self { inputs: [("the planes".to_string(), planes)].into_iter().chain(attributes).collect(), target, radii }
    }
    fn tracked(&self) -> Self {
        let track = |(name, t): &(String, Tensor<2>)| (name.clone(), Tensor::<2>::from_inner(t.clone().inner()).require_grad());
        Self { inputs: self.inputs.iter().map(track).collect(), target: self.target.clone(), radii: self.radii.clone() }
    }
    /// The same sample with another input at `index`.
    fn with(&self, index: usize, value: Tensor<2>) -> Self {
        let mut inputs = self.inputs.clone();
        inputs[index].1 = value;
        Self { inputs, target: self.target.clone(), radii: self.radii.clone() }
    }
    fn tensor(&self, term: &dyn LossTerm) -> Result<Option<Tensor<1>>> {
        let planes = self.inputs[0].1.clone().reshape([5, SIZE[0], SIZE[1]]);
        let gaussians = Gaussians::from_attributes(SH_DEGREE, self.inputs[1..].iter().cloned())?;
        let schedule = Schedule::main(100);
        term.value(&LossInput { planes: &planes, target: &self.target, gaussians: &gaussians, radii: &self.radii, time_norm: 0.43, schedule: &schedule })
    }
    fn value(&self, term: &dyn LossTerm) -> Result<Option<f32>> {
        self.tensor(term)?.map(|value| Ok(to_vec(value, "loss value")?.first().copied().unwrap_or(f32::NAN))).transpose()
    }
}
