//! What a deformation field must keep to.

use super::{matrix, uniform};
use crate::gaussians::to_vec;
use crate::{Deformer, DeformerContext, DeformerPlugin, Error, Offsets, Result, Seed};
use burn::tensor::{Device, Tensor, TensorData};

/// Largest relative difference between a slope by finite differences and the gradient along itself.
const SLOPE_TOLERANCE: f64 = 0.05;
/// Step along the gradient's direction: short enough to cross few kinks of ReLU, long enough to stand out from rounding.
const STEP: f64 = 5e-4;
/// Largest difference of offsets from packed features, as a share of the largest offset: sums may run in another order.
const PACKED_TOLERANCE: f32 = 1e-5;
/// Size of the random changes that wake heads which start at zero.
const SHAKE: f32 = 0.1;
/// Centres of the suite.
const CENTRES: usize = 48;

/// Holds a deformation field to its promises on `device`: unknown settings are refused; equal seeds give equal weights; offsets have their shapes, the same
/// heads at every time, are finite and repeat bit for bit; a field that declares `starts-as-identity` moves nothing at first; a static one never does; gradients of all weights
/// agree with finite differences; packed features give the same offsets; weights survive being copied to a fresh field, bit for bit; empty, single and non-finite centres are answered.
///
/// `settings` is the `[deformer]` section without `kind`; small sizes make the suite quick.
pub fn deformer<'a>(plugin: &'a DeformerPlugin, settings: &'a toml::Table, device: &'a Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    let checks: [(&str, Check<'a>); 8] = [
        ("settings", Suite::refuses_unknown_settings),
        ("seeds", Suite::equal_seeds_equal_weights),
        ("start", Suite::starts_as_declared),
        ("shapes", Suite::offsets_are_sound),
        ("gradients", Suite::gradients_are_slopes),
        ("weights", Suite::weights_carry_everything),
        ("packed", Suite::packing_changes_nothing),
        ("odd inputs", Suite::odd_inputs_are_answered),
    ];
    checks
        .into_iter()
        .filter_map(|(name, check)| match check(&suite) {
            Ok(None) => None,
            Ok(Some(finding)) => Some(format!("{} on {device:?}, {name}: {finding}", plugin.info.name)),
            Err(e) => Some(format!("{} on {device:?}, {name}: {e}", plugin.info.name)),
        })
        .collect()
}

struct Suite<'a> {
    plugin: &'a DeformerPlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

type Field = Box<dyn Deformer>;
/// One check: what it found, if anything.
type Check<'a> = fn(&Suite<'a>) -> Result<Option<String>>;

impl Suite<'_> {
    fn context(&self) -> DeformerContext {
        DeformerContext { box_min: [-1.0, -0.5, 0.0], box_max: [1.0, 0.5, 2.0], frame_count: 20, sh_degree: 2, seed: Seed::root(11).child("conformance") }
    }
    fn field(&self, device: &Device) -> Result<Field> {
        (self.plugin.build)(self.settings, &self.context(), device)
    }
    /// A field none of whose weights is special.
    fn shaken(&self, device: &Device) -> Result<Field> {
        let mut field = self.field(device)?;
        for (place, parameter) in field.parameters_mut().into_iter().enumerate() {
            let seed = Seed::root(5).index(place as u64);
            let moved: Vec<f32> = to_vec(parameter.value.clone(), "weights")?.iter().enumerate().map(|(k, v)| v + SHAKE * uniform(seed, k)).collect();
            let n = moved.len();
            let value = Tensor::<1>::from_data(TensorData::new(moved, [n]), device);
            parameter.value = if value.is_autodiff() { value.require_grad() } else { value };
        }
        Ok(field)
    }
    /// Centres inside the box and a few outside.
    fn centres(&self, n: usize, device: &Device) -> Tensor<2> {
        let scale = Tensor::<2>::from_data(TensorData::new(vec![1.1f32, 0.55, 1.1], [1, 3]), device);
        let shift = Tensor::<2>::from_data(TensorData::new(vec![0.0f32, 0.0, 1.0], [1, 3]), device);
        matrix(Seed::root(3), n, 3, device) * scale + shift
    }
    fn offsets(&self, field: &Field, n: usize, time_norm: f32, device: &Device) -> Result<Offsets> {
        let features = field.spatial(self.centres(n, device))?.values;
        field.deform(features, time_norm)
    }
    fn values(&self, field: &Field, n: usize, time_norm: f32, device: &Device) -> Result<Vec<f32>> {
        self.offsets(field, n, time_norm, device)?.concatenated().map_or(Ok(Vec::new()), |t| to_vec(t, "offsets"))
    }

    fn refuses_unknown_settings(&self) -> Result<Option<String>> {
        let mut settings = self.settings.clone();
        settings.insert("no_such_setting".into(), 1.into());
        Ok(match (self.plugin.build)(&settings, &self.context(), self.device) {
            Ok(_) => Some("an unknown setting was accepted".into()),
            Err(e) if !e.to_string().contains("no_such_setting") => Some(format!("the error does not name the unknown setting: {e}")),
            Err(_) => None,
        })
    }
    fn equal_seeds_equal_weights(&self) -> Result<Option<String>> {
        let (a, b) = (self.field(self.device)?, self.field(self.device)?);
        for (p, q) in a.parameters().into_iter().zip(b.parameters()) {
            if p.value.dims()[0] != p.shape.iter().product::<usize>() || p.group >= a.groups().len() {
                return Ok(Some(format!("{}: {} weights for shape {:?}, group {} of {}", p.name, p.value.dims()[0], p.shape, p.group, a.groups().len())));
            }
            if to_vec(p.value.clone(), &p.name)? != to_vec(q.value.clone(), &q.name)? {
                return Ok(Some(format!("{}: two fields of one seed differ", p.name)));
            }
        }
        let mut names: Vec<&str> = a.parameters().into_iter().map(|p| p.name.as_str()).collect();
        names.sort_unstable();
        Ok(names.windows(2).find(|w| w[0] == w[1]).map(|w| format!("two parameters are called {}", w[0])))
    }
    fn starts_as_declared(&self) -> Result<Option<String>> {
        let field = self.field(self.device)?;
        let declared = self.plugin.info.capabilities.contains(&"starts-as-identity") || field.is_static();
        let moved = self.values(&field, CENTRES, 0.37, self.device)?.into_iter().any(|v| v != 0.0);
        Ok((declared && moved).then(|| "a fresh field moves Gaussians".into()))
    }
    fn offsets_are_sound(&self) -> Result<Option<String>> {
        let field = self.shaken(self.device)?;
        let offsets = self.offsets(&field, CENTRES, 0.37, self.device)?;
        let k = (self.context().sh_degree + 1).pow(2);
        let shapes = [
            ("means", offsets.means.as_ref().map(|t| t.dims().to_vec()), vec![CENTRES, 3]),
            ("log_scales", offsets.log_scales.as_ref().map(|t| t.dims().to_vec()), vec![CENTRES, 3]),
            ("quaternions", offsets.quaternions.as_ref().map(|t| t.dims().to_vec()), vec![CENTRES, 4]),
            ("opacity_logits", offsets.opacity_logits.as_ref().map(|t| t.dims().to_vec()), vec![CENTRES]),
            ("sh", offsets.sh.as_ref().map(|t| t.dims().to_vec()), vec![CENTRES, k, 3]),
        ];
        if let Some((name, got, want)) = shapes.into_iter().find(|(_, got, want)| got.as_ref().is_some_and(|g| g != want)) {
            return Ok(Some(format!("{name} has shape {got:?} where {want:?} is needed")));
        }
        let (first, second) = (self.values(&field, CENTRES, 0.37, self.device)?, self.values(&field, CENTRES, 0.37, self.device)?);
        if first != second {
            return Ok(Some("two calls with one input differ".into()));
        }
        if field.is_static() {
            return Ok(first.iter().any(|v| *v != 0.0).then(|| "a static field moves Gaussians".into()));
        }
        let later = self.values(&field, CENTRES, 0.81, self.device)?;
        if later.len() != first.len() {
            return Ok(Some("heads come and go with time".into()));
        }
        Ok(match (first.iter().chain(&later).all(|v| v.is_finite()), first == later) {
            (false, _) => Some("offsets are not finite".into()),
            (true, true) => Some("offsets do not depend on time".into()),
            (true, false) => None,
        })
    }
    fn gradients_are_slopes(&self) -> Result<Option<String>> {
        let device = self.device.clone().autodiff();
        let mut field = self.shaken(&device)?;
        if field.is_static() || field.parameters().is_empty() {
            return Ok(None);
        }
        let missing = || Error::backend("conformance", "the field returned no offsets", "Return at least one head");
        let tracked = self.offsets(&field, CENTRES, 0.43, &device)?.concatenated().ok_or_else(missing)?;
        let [n, width] = tracked.dims();
        let weights: Vec<f32> = (0..n * width).map(|k| 1.0 + 0.5 * uniform(Seed::root(8), k)).collect();
        let wave = Tensor::<2>::from_inner(Tensor::from_data(TensorData::new(weights.clone(), [n, width]), self.device));
        let gradients = (tracked * wave).sum().backward();
        let loss = |field: &Field| -> Result<f64> {
            Ok(self.values(field, CENTRES, 0.43, &device)?.iter().zip(&weights).map(|(o, w)| f64::from(*o) * f64::from(*w)).sum())
        };
        for place in 0..field.parameters().len() {
            let (name, start, gradient) = {
                let p = field.parameters()[place];
                let Some(gradient) = p.value.grad(&gradients) else { return Ok(Some(format!("no gradient reaches {}", p.name))) };
                (p.name.clone(), to_vec(p.value.clone(), "weights")?, to_vec(gradient, "gradient")?)
            };
            let norm = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            if !norm.is_finite() || norm == 0.0 {
                return Ok(Some(format!("the gradient of {name} has norm {norm}")));
            }
            let mut ends = [0.0; 2];
            for (end, step) in ends.iter_mut().zip([STEP, -STEP]) {
                let moved: Vec<f32> = start.iter().zip(&gradient).map(|(s, g)| s + (step * f64::from(*g) / norm) as f32).collect();
                let count = moved.len();
                field.parameters_mut()[place].value = Tensor::<1>::from_data(TensorData::new(moved, [count]), &device);
                *end = loss(&field)?;
            }
            let count = start.len();
            field.parameters_mut()[place].value = Tensor::<1>::from_data(TensorData::new(start, [count]), &device);
            let slope = (ends[0] - ends[1]) / (2.0 * STEP);
            if (slope / norm - 1.0).abs() > SLOPE_TOLERANCE {
                return Ok(Some(format!("{name}: the loss rises by {slope:.5} per unit along its gradient of norm {norm:.5}")));
            }
        }
        Ok(None)
    }
    fn packing_changes_nothing(&self) -> Result<Option<String>> {
        let field = self.shaken(self.device)?;
        let features = field.spatial(self.centres(CENTRES, self.device))?.values;
        let packed = field.packed(features.clone());
        if packed.dims() != features.dims() {
            return Ok(Some(format!("packed features have shape {:?} in place of {:?}", packed.dims(), features.dims())));
        }
        let read = |features| field.deform(features, 0.37)?.concatenated().map_or(Ok(Vec::new()), |t| to_vec(t, "offsets"));
        let (plain, packed) = (read(features)?, read(packed)?);
        let size = plain.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        let worst = plain.iter().zip(&packed).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        Ok((worst > PACKED_TOLERANCE * size).then(|| format!("packed features change offsets of up to {size} by {worst}")))
    }
    fn weights_carry_everything(&self) -> Result<Option<String>> {
        let (field, mut copy) = (self.shaken(self.device)?, self.field(self.device)?);
        for (to, from) in copy.parameters_mut().into_iter().zip(field.parameters()) {
            if to.name != from.name || to.shape != from.shape {
                return Ok(Some(format!("a fresh field has {} {:?} where this one has {} {:?}", to.name, to.shape, from.name, from.shape)));
            }
            let values = to_vec(from.value.clone(), &from.name)?;
            let n = values.len();
            to.value = Tensor::from_data(TensorData::new(values, [n]), self.device);
        }
        let same = self.values(&field, CENTRES, 0.6, self.device)? == self.values(&copy, CENTRES, 0.6, self.device)?;
        Ok((!same).then(|| "a field with the same weights gives other offsets".into()))
    }
    fn odd_inputs_are_answered(&self) -> Result<Option<String>> {
        let field = self.shaken(self.device)?;
        for n in [0, 1] {
            if self.offsets(&field, n, 0.5, self.device)?.means.is_some_and(|t| t.dims() != [n, 3]) {
                return Ok(Some(format!("{n} centres give offsets for another number")));
            }
        }
        if field.is_static() {
            return Ok(None);
        }
        let odd = Tensor::<2>::from_data(TensorData::new(vec![f32::NAN, f32::INFINITY, 0.0, 1e30, -1e30, 0.5], [2, 3]), self.device);
        let answered = match field.spatial(odd).and_then(|s| field.deform(s.values, 0.5)) {
            // An error is a defined answer too.
            Err(_) => true,
            Ok(offsets) => offsets.concatenated().map_or(Ok(Vec::new()), |t| to_vec(t, "offsets"))?.iter().all(|v| v.is_finite()),
        };
        if !answered {
            return Ok(Some("centres that are not numbers give offsets that are not numbers".into()));
        }
        let features = field.spatial(self.centres(2, self.device))?.values;
        Ok(field.deform(features, f32::NAN).is_ok().then(|| "a time that is not a number was accepted".into()))
    }
}
